"""Sampling rates and delays that are plausible only in another unit: refused, or warned of."""

from __future__ import annotations

import numpy as np

from ..errors import ModelError, warn
from ..values import ComplexArray, FloatArray, positive

#: times half the rate: where even the lowest mode lies above this, the rate is in another unit
_HOPELESS = 10.0
#: samples: a delay between 0 and this changes nothing that can be measured
_NO_DELAY = 0.01
#: samples: a delay beyond this is in another unit, of a loop, an actuator or a sensor
_LONGEST = 1000.0
#: damping ratio up to which a pole is a mode, not a filter
_LIGHT = 0.3


def check_rate(modes: FloatArray, rate: float, delay: float) -> None:
    """Judge a sampling rate [Hz] by the elastic modes [Hz] of a system, and a delay by the rate."""
    rate, delay = positive(rate, "rate"), positive(delay, "delay", zero=True)
    if 0 < delay < _NO_DELAY:
        raise ModelError(
            f"delay={delay:g} is in samples, which here means {delay / rate:.3g} s and changes "
            f"nothing. If {delay:g} s is meant, it is delay={delay * rate:.4g} at {rate:g} Hz."
        )
    if delay > _LONGEST:
        raise ModelError(
            f"delay={delay:g} is in samples, which here means {delay / rate:.3g} s: no loop runs "
            f"that late. If {delay:g} us are meant, it is delay={1e-6 * delay * rate:.4g} at "
            f"{rate:g} Hz."
        )
    if not modes.size or modes.min() <= 0.5 * rate:
        return
    said = (
        f"all {modes.size} elastic modes, {modes.min():.4g} Hz and above, lie above "
        f"half the sampling rate ({0.5 * rate:g} Hz): in its samples they look like slow ones. The "
        "rate is in Hz"
    )
    if modes.min() > 0.5 * _HOPELESS * rate:
        raise ModelError(f"{said}{_meant(rate, float(modes.min()))}.")
    said = f"{said}, the model in SI units: are both?"
    warn(said)


def _meant(rate: float, lowest: float) -> str:
    """Return which other unit would bring the lowest mode below half the rate."""
    if rate < 1 and 2 * lowest <= 1 / rate:
        return f"; {rate:g} s as a sampling period is rate={1 / rate:g}"
    if 2 * lowest <= 1e3 * rate:
        return f"; {rate:g} kHz is rate={1e3 * rate:g}"
    return ""


def check_latency(name: str, latency: float, rate: float) -> None:
    """Raise ModelError when the latency [s] of a port is more than 1000 samples."""
    if latency * rate > _LONGEST:
        raise ModelError(
            f"the latency of {name!r} is {latency:g} s, {latency * rate:.4g} samples at {rate:g} "
            f"Hz: latencies are in seconds. If {latency:g} samples are meant, it is "
            f"latency={latency / rate:.4g}."
        )


def light_modes(poles: ComplexArray) -> FloatArray:
    """Return the frequencies [Hz] of the lightly damped pairs among continuous poles [rad/s]."""
    size = np.abs(poles)
    return np.asarray(size[(poles.imag > 0) & (-poles.real < _LIGHT * size)] / (2.0 * np.pi))

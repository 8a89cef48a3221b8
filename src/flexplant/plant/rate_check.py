"""Sampling rates and delays that are plausible only in another unit: refused, or warned of."""

from __future__ import annotations

import warnings
from typing import Any

import numpy as np

from ..errors import FlexplantWarning, ModelError
from ..lti.joining import block_eigenvalues
from ..values import FloatArray, positive

#: times half the rate: where even the lowest mode lies above this, the rate is in another unit
_HOPELESS = 10.0
#: samples: a delay between 0 and this changes nothing that can be measured
_NO_DELAY = 0.01
#: samples: a delay beyond this is in another unit, of a loop, an actuator or a sensor
_LONGEST = 1000.0
#: damping ratio up to which a pole of a plant made elsewhere is a mode, not a filter
_LIGHT = 0.3


def check_rate(plant: Any, rate: float, delay: float) -> None:
    """Judge a sampling rate [Hz] by the modes of a plant, delays and latencies by the rate.

    Raises
    ------
    ModelError
        When the lowest elastic mode lies far above half the rate; when a delay is a negligible part
        of a sample; when it, or the latency of an actuator or sensor, is more than 1000 samples.

    Warns
    -----
    FlexplantWarning
        When all elastic modes lie above half the rate.
    """
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
    for name, late in (plant.assembled.ports.latencies if plant.is_assembled else {}).items():
        if late * rate > _LONGEST:
            raise ModelError(
                f"the latency of {name!r} is {late:g} s, {late * rate:.4g} samples at {rate:g} Hz: "
                f"latencies are in seconds. If {late:g} samples are meant, it is "
                f"latency={late / rate:.4g}."
            )
    modes = _elastic(plant)
    if not modes.size or modes.min() <= 0.5 * rate:
        return
    said = (
        f"all {modes.size} elastic modes of the plant, {modes.min():.4g} Hz and above, lie above "
        f"half the sampling rate ({0.5 * rate:g} Hz): in its samples they look like slow ones. The "
        "rate is in Hz"
    )
    if modes.min() > 0.5 * _HOPELESS * rate:
        raise ModelError(f"{said}{_meant(rate, float(modes.min()))}.")
    said = f"{said}, the model in SI units: are both?"
    warnings.warn(said, FlexplantWarning, stacklevel=4)


def _meant(rate: float, lowest: float) -> str:
    """Return which other unit would bring the lowest mode below half the rate."""
    if rate < 1 and 2 * lowest <= 1 / rate:
        return f"; {rate:g} s as a sampling period is rate={1 / rate:g}"
    if 2 * lowest <= 1e3 * rate:
        return f"; {rate:g} kHz is rate={1e3 * rate:g}"
    return ""


def _elastic(plant: Any) -> FloatArray:
    """Return the frequencies [Hz] of the elastic modes of a plant."""
    if plant.is_assembled:
        held = plant.modal_blocks[np.linalg.det(plant.modal_blocks) >= 0]
        poles = [block_eigenvalues(block, (2,)) for block in held]
        size = np.array([float(np.sqrt(np.abs(p[0] * p[1]))) for p in poles])
    else:
        found = plant.system.poles()
        size = np.abs(found[(found.imag > 0) & (-found.real < _LIGHT * np.abs(found))])
    return np.asarray(size[size > 0] / (2 * np.pi), dtype=np.float64)

"""A designed loop on the measured response of the machine."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from ..plant.origins import MeasuredResponse
from ..store import Value
from .measured_loop import broken_count, in_axes, measured_between

#: what a loop says of which no measured response of the machine is known
NOT_MEASURED = "not judged on a measurement"


@dataclass(frozen=True, eq=False, repr=False)
class OnMeasurement(Value):
    """Stability and margin of a loop on a measured response of the machine, without a model.

    Parameters
    ----------
    margin : float
        Modulus margin, with the loop opened at u. It is 0 if the loop is unstable, and NaN if the
        measured frequencies do not show whether it is stable.
    freq : float [Hz]
        Frequency at which the sensitivity |S| at u is largest.
    reason : str
        Reason why the stability is not known; empty if it is known.
    added : float [samples]
        Delay of the plant that was added to the response. It is not 0 if the response was measured
        from sample to sample and, as stated, contains no delay. If it contains one, use
        ``plant.measured(frf, delay=...)``.

    Examples
    --------
    >>> import flexplant as fx
    >>> fx.loop.OnMeasurement(0.536, 176.2)
    <OnMeasurement: on the measured response: stable, modulus margin 0.536 at 176.2 Hz>
    """

    margin: float
    freq: float
    reason: str = ""
    added: float = 0.0

    @property
    def is_unstable(self) -> bool:
        """Whether the measured frequencies show an unstable loop."""
        return self.margin == 0.0

    @property
    def summary(self) -> str:
        """Text of the result."""
        if self.reason:
            found = f"stability not known, {self.reason}"
        elif self.is_unstable:
            found = "unstable"
        else:
            found = f"stable, modulus margin {self.margin:.3g} at {self.freq:.4g} Hz"
        added = (
            f" (with {self.added:g} samples of delay added, as the response was said to contain "
            "none: else plant.measured(..., delay=))"
        )
        return f"on the measured response: {found}{added if self.added else ''}"

    def __repr__(self) -> str:
        return f"<OnMeasurement: {self.summary}>"


def judged(loop: Any, known: MeasuredResponse) -> OnMeasurement | None:
    """Return a loop on a measured response of its machine; None where that lacks a channel."""
    plant = loop.plant
    if not set(loop.fed_back) <= set(known.frf.outputs):
        return None
    if not set(loop.driven) <= set(known.frf.inputs):
        return None
    frf = known.frf.select(outputs=loop.fed_back, inputs=loop.driven)
    if plant.dt:
        turn = np.exp(2j * np.pi * frf.freq * known.delay * plant.dt)  # its own delay leaves
        frf = frf.replace(data=frf.data * turn)
        frf = in_axes(frf, rate=1.0 / plant.dt, delay=plant.delay, hold=known.hold)
    law = loop.controller.select(loop.driven, loop.fed_back)
    parts = replace(measured_between(frf, law, {}), forces=loop.broken.forces)
    count = broken_count(parts, None, 0)
    peak, freq = parts.worst("u", bool(parts.mixed("u")))
    added = plant.delay if plant.dt and not (known.hold or known.delay) else 0.0
    if count.unstable is None:
        return OnMeasurement(float("nan"), freq, count.reason, added)
    return OnMeasurement(0.0 if count.unstable else 1.0 / peak, freq, added=added)

"""in_axes: a measured plant in decoupled axes, as a sampled controller meets it."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from ..errors import ModelError, ShapeError
from ..lti.frequency import Frf
from ..lti.statespace import StateSpace, System, as_statespace
from ..values import FloatArray, flag, instance, positive


def in_axes(
    frf: Frf,
    *,
    before: System | FloatArray | None = None,
    after: System | FloatArray | None = None,
    rate: float | None = None,
    delay: float = 0.0,
    hold: bool = True,
) -> Frf:
    """Return the measured plant from the axes of `before` to those of `after`.

    ``after G before``; where a rate is given, times the delay of a sampled controller and its
    zero-order hold, ``exp(-2 pi i f (delay + 1/2) / rate) sinc(f / rate)`` (what aliasing adds is
    left out).

    Parameters
    ----------
    frf : Frf
        Measured, from actuators to sensors.
    before, after : StateSpace or array, optional
        Static transformations: of a `decouple` the `accelerations` (or `to_actuators`) and
        `to_motions`. Names of a StateSpace pick the channels of the Frf.
    rate : float [Hz], optional
        Of the controller; lines above half of it are left out.
    delay : float
        Samples between a measurement and its command, of which the Frf shows nothing.
    hold : bool
        False for an Frf that was measured from sample to sample: it has the hold in it.

    Returns
    -------
    Frf
        Without the statistics of the measurement.

    Raises
    ------
    ModelError, ShapeError, LabelError
        When frf is none, a transformation is not static or does not fit, or a number is wrong.
    """
    frf = instance(frf, Frf, "frf", "Pass a measured one.")
    first = _static(before, frf.inputs, "before")
    last = _static(after, frf.outputs, "after")
    chosen = frf.select(outputs=last.inputs, inputs=first.outputs)
    data = np.einsum("ay,yuf,ub->abf", last.D, chosen.data, first.D)
    freq, late = frf.freq, positive(delay, "delay", zero=True)
    if rate is None and late:
        raise ModelError("delay is counted in samples: give rate= too.")
    if rate is not None:
        freq = freq[freq < 0.5 * positive(rate, "rate")]
        half, shape = (0.5, np.sinc(freq / rate)) if flag(hold, "hold") else (0.0, 1.0)
        late_by = np.exp(-2j * np.pi * freq * (half + late) / rate)
        data = data[:, :, : freq.size] * shape * late_by
    units = {**chosen.channel_units, **first.units, **last.units}
    return Frf(freq, data, first.inputs, last.outputs, quantity=frf.quantity, units=units)


def _static(given: System | FloatArray | None, names: Sequence[str], side: str) -> StateSpace:
    """Return a transformation from or to named channels of the Frf.

    Raises
    ------
    ModelError, ShapeError
        When it has states, or does not fit.
    """
    if given is None:
        eye = np.eye(len(names))
        return StateSpace([], [], [], eye, inputs=names, outputs=names)
    T = as_statespace(given)
    if T.n_states:
        raise ModelError(f"{side} has states: give a static transformation, a matrix.")
    if isinstance(given, np.ndarray | list | tuple | float | int):
        ends = T.outputs if side == "before" else T.inputs
        if len(ends) != len(names):
            raise ShapeError(
                f"{side} has {len(ends)} channels at the plant, the Frf {len(names)}: give one "
                "row (of before) or column (of after) for each."
            )
        return T.replace(outputs=names) if side == "before" else T.replace(inputs=names)
    return T

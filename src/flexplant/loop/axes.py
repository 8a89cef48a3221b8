"""in_axes: a measured plant in decoupled axes, as a sampled controller meets it."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from ..errors import ModelError, ShapeError
from ..lti.frequency import Frf
from ..lti.statespace import StateSpace, System, as_statespace
from ..values import ComplexArray, FloatArray, flag, instance, positive


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
    zero-order hold, ``H(f) = exp(-2 pi i f (delay + 1/2) / rate) sinc(f / rate)``. Lines above half
    the rate are seen at lower frequencies: ``sum_k (G H)(f + k rate)``, as far as they go.

    Parameters
    ----------
    frf : Frf
        Measured, from actuators to sensors.
    before, after : StateSpace or array, optional
        Static transformations: of a `decouple` the `accelerations` (or `to_actuators`) and
        `to_motions`. Names of a StateSpace pick the channels of the Frf.
    rate : float [Hz], optional
        Of the controller; the result ends below half of it.
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

    Examples
    --------
    >>> import flexplant as fx
    >>> frf = fx.Frf([10.0], [[[1.0], [3.0]], [[3.0], [1.0]]])
    >>> half = [[0.5, 0.5], [0.5, -0.5]]
    >>> fx.loop.in_axes(frf, before=half, after=half, hold=False).data[:, :, 0].real
    array([[ 2.,  0.],
           [ 0., -1.]])
    """
    frf = instance(frf, Frf, "frf", "Pass a measured one.")
    first = static_map(before, frf.inputs, "before")
    last = static_map(after, frf.outputs, "after")
    chosen = frf.select(outputs=last.inputs, inputs=first.outputs)
    data = np.einsum("ay,yuf,ub->abf", last.D, chosen.data, first.D)
    freq, late = frf.freq, positive(delay, "delay", zero=True)
    held = flag(hold, "hold")
    if rate is None and late:
        raise ModelError("delay is counted in samples: give rate= too.")
    if rate is not None:
        freq = freq[freq < 0.5 * positive(rate, "rate")]
        if not freq.size:
            raise ModelError(
                f"all lines, from {frf.freq[0]:.4g} Hz, lie above half the rate, {0.5 * rate:g} "
                "Hz: a loop cannot be judged there. Check that rate is in Hz, or measure lower."
            )
        data = _sampled(frf.freq, data, freq, rate, late, held)
    units = {**chosen.channel_units, **first.units, **last.units}
    return Frf(freq, data, first.inputs, last.outputs, quantity=frf.quantity, units=units)


def _sampled(
    lines: FloatArray, data: ComplexArray, freq: FloatArray, rate: float, late: float, held: bool
) -> ComplexArray:
    """Return a measured plant as its samples show it, with delay and, unless held=False, aliases.

    Parameters
    ----------
    lines, data : (n_lines,) and (n_out, n_in, n_lines) arrays
        The measurement; zero beyond its lines, and conjugate at negative frequencies.
    freq : (n_freq,) array [Hz]
        Lines below half the rate.
    """
    if not held:
        turned = np.exp(-2j * np.pi * freq * late / rate)
        return np.asarray(data[:, :, : freq.size] * turned)
    reach = int(np.ceil(lines[-1] / rate))
    total = np.zeros((*data.shape[:2], freq.size), dtype=complex)
    for k in range(-reach, reach + 1):
        moved = freq + k * rate
        at = np.abs(moved)
        G = np.array(
            [[np.interp(at, lines, one, left=0.0, right=0.0) for one in row] for row in data]
        )
        hold = np.sinc(moved / rate) * np.exp(-2j * np.pi * moved * (0.5 + late) / rate)
        total += np.where(moved < 0.0, G.conj(), G) * hold
    return total


def static_map(given: System | FloatArray | None, names: Sequence[str], side: str) -> StateSpace:
    """Return a transformation from or to named channels of the plant.

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
                f"{side} has {len(ends)} channels at the plant, which has {len(names)}: give one "
                "row (of before) or column (of after) for each."
            )
        return T.replace(outputs=names) if side == "before" else T.replace(inputs=names)
    return T

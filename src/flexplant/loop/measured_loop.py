"""A measured plant in a loop: decoupled axes, effect of sampling, and the Nyquist count."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import NamedTuple

import numpy as np

from ..arrays import ComplexArray, FloatArray, IntArray, flag, instance, positive
from ..errors import LabelError, ModelError, ShapeError, counted, unknown_label
from ..lti.frequency import Frf, frequency_response
from ..lti.frequency_sweep import around_resonance
from ..lti.measured_lines import FEWEST, SHOWN, STEP, HiddenModes, MeasuredPlant, on_lines
from ..lti.response_solvers import Responder
from ..lti.statespace import StateSpace, System, as_statespace
from ..tolerances import MOST_STEPS, SAME, TINY
from .broken import BrokenLoop, inverted

#: degrees of freedom above which a variance is not averaged
_FREEDOM = 20.0


def in_axes(
    frf: Frf,
    *,
    before: System | FloatArray | None = None,
    after: System | FloatArray | None = None,
    rate: float | None = None,
    delay: float = 0.0,
    hold: bool = True,
) -> Frf:
    """Return a measured plant with its inputs and outputs transformed, such as to decoupled axes.

    The result is ``after G before``, where G is the measured response. If a `rate` is given, the
    result is multiplied by ``H(f) = exp(-2 pi i f (delay + 1/2) / rate) sinc(f / rate)``. H is the
    response of the delay and the zero-order hold of a sampled controller. Sampling also folds the
    response above half the rate to lower frequencies (aliasing). The result is then the sum ``sum_k
    (G H)(f + k rate)`` over the measured frequencies.

    Parameters
    ----------
    frf : Frf
        Measured response from actuators to sensors.
    before, after : StateSpace or array, optional
        Static transformations of the inputs and of the outputs. For a `decouple` result these are
        `accelerations` (or `to_actuators`) and `to_motions`. The channel names of a StateSpace
        select the channels of the Frf.
    rate : float [Hz], optional
        Sampling rate of the controller. The result ends below half of it.
    delay : float
        Delay between a measurement and its command, in samples, that the Frf does not contain.
    hold : bool
        Whether to add the zero-order hold. Use False if the Frf already contains it, because it was
        measured from sample to sample.

    Returns
    -------
    Frf
        Transformed response. It has the variance of the measurement if the variance or the
        coherence is known, and no other statistics.

    Raises
    ------
    ModelError, ShapeError, LabelError
        When frf is not an Frf, a transformation is not static or does not match, or a number is
        wrong.

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
    variance = line_variance(chosen)
    if variance is not None:
        variance = _error_variance(last.D, first.D, variance, chosen.correlation)
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
        data = _sampled_response(frf.freq, data, freq, rate, late, held)
        if variance is not None:
            aliased = _aliased(frf.freq, variance, freq, rate)
            variance = aliased if held else variance[..., : freq.size]
    units = {**chosen.channel_units, **first.units, **last.units}
    return Frf(
        freq, data, first.inputs, last.outputs,
        quantity=frf.quantity, variance=variance, units=units,
    )  # fmt: skip


def measured_between(plant: Frf, controller: StateSpace, quantities: dict[str, str]) -> BrokenLoop:
    """Return a measured plant and a controller, taken apart between u and y."""
    for name in controller.inputs:
        if name not in plant.outputs:
            error = unknown_label("measured output", name, plant.outputs, "the Frf")
            raise LabelError(
                f"{error} Select what was measured: controller.select(inputs=[...]); references "
                "do not belong to the loop."
            )
        wanted = quantities.get(name, plant.quantity)
        if plant.quantity is not None and wanted != plant.quantity:
            raise ModelError(
                f"the Frf was measured as {plant.quantity}, the controller reads {name!r} as "
                f"{wanted}: convert it, frf.converted({wanted!r})."
            )
    driven = [name for name in controller.outputs if name in plant.inputs]
    if not driven:
        raise unknown_label("measured input", controller.outputs[0], plant.inputs, "the Frf")
    controller = controller.select(driven)
    # at 0 Hz a free body and an integrator are infinite
    lines, P = np.array(plant.freq), plant.select(controller.inputs, driven).data
    measured = MeasuredPlant(lines[lines > 0], P[:, :, lines > 0])
    if not measured.freq.size:
        raise ModelError("the Frf has no line above 0 Hz, which a loop needs: measure more lines.")
    return BrokenLoop(
        tuple(driven), tuple(controller.inputs),
        lambda freq: frequency_response(controller, freq).data, measured.at,
        controller.poles, controller.dt, measured, {**controller.units, **plant.channel_units},
    )  # fmt: skip


def line_variance(frf: Frf) -> FloatArray | None:
    """Return E|error|^2 of the entries of a measured Frf, None if not known.

    It is the variance, or for few runs its mean over neighbouring lines. Otherwise it follows from
    the coherence, ``|G|^2 (1 - c) / (c n)`` (Bendat and Piersol, Random Data, 4th ed., 9.1), with
    the number of averages n = `freedom` + 1, or 2 if not known.
    """
    if frf.variance is not None:
        few = 0 if frf.freedom is None else int(np.ceil(_FREEDOM / frf.freedom))
        return _near_mean(frf.variance, few)
    if frf.coherence is None:
        return None
    averages = 2.0 if frf.freedom is None else frf.freedom + 1.0
    # lower ones are zero: such lines have no weight
    sure = np.maximum(frf.coherence, 1e-6)
    return np.asarray(np.abs(frf.data) ** 2 * (1.0 - np.minimum(sure, 1.0)) / (sure * averages))


def _near_mean(values: FloatArray, reach: int) -> FloatArray:
    """Return the mean over a number of lines to either side."""
    if not reach or values.shape[-1] <= 2 * reach:
        return values
    total = np.cumsum(values, axis=-1, dtype=np.float64)
    total = np.concatenate([np.zeros((*values.shape[:-1], 1)), total], axis=-1)
    places = np.arange(values.shape[-1])
    low, high = np.maximum(places - reach, 0), np.minimum(places + reach + 1, values.shape[-1])
    return np.asarray((total[..., high] - total[..., low]) / (high - low))


def _error_variance(
    after: FloatArray, before: FloatArray, variance: FloatArray, correlation: ComplexArray | None
) -> FloatArray:
    """Return the variance of ``after G before``; errors of different inputs are independent."""
    if correlation is None:
        return np.asarray(np.einsum("ay,yuf,ub->abf", after**2, variance, before**2))
    size = np.sqrt(variance)
    parts = np.einsum(
        "ay,ax,yuf,xuf,yxf,ub->abf", after, after, size, size, correlation.real, before**2
    )
    return np.asarray(np.maximum(parts, 0.0))


def _aliased(lines: FloatArray, variance: FloatArray, freq: FloatArray, rate: float) -> FloatArray:
    """Return the variance of `_sampled_response`: aliases add theirs."""
    total = np.zeros((*variance.shape[:2], freq.size))
    for moved in _alias_frequencies(lines, freq, rate):
        for i, j in np.ndindex(variance.shape[:2]):
            at = np.interp(np.abs(moved), lines, variance[i, j], left=0.0, right=0.0)
            total[i, j] += np.sinc(moved / rate) ** 2 * at
    return total


def _sampled_response(
    lines: FloatArray, data: ComplexArray, freq: FloatArray, rate: float, late: float, held: bool
) -> ComplexArray:
    """Return the response of a sampled measured plant, with delay and aliases (held=True)."""
    if not held:
        turned = np.exp(-2j * np.pi * freq * late / rate)
        return np.asarray(data[:, :, : freq.size] * turned)
    total = np.zeros((*data.shape[:2], freq.size), dtype=complex)
    for moved in _alias_frequencies(lines, freq, rate):
        at = np.abs(moved)
        known = (at >= lines[0]) & (at <= lines[-1])
        G = np.zeros(total.shape, dtype=complex)
        G[..., known] = on_lines(lines, data, at[known])
        hold = np.sinc(moved / rate) * np.exp(-2j * np.pi * moved * (0.5 + late) / rate)
        total += np.where(moved < 0.0, G.conj(), G) * hold
    return total


def _alias_frequencies(lines: FloatArray, freq: FloatArray, rate: float) -> list[FloatArray]:
    """Return the frequencies, including negative ones, that alias to some frequencies."""
    reach = int(np.ceil(lines[-1] / rate))
    return [freq + k * rate for k in range(-reach, reach + 1)]


def static_map(given: System | FloatArray | None, names: Sequence[str], side: str) -> StateSpace:
    """Return a transformation from or to named channels of the plant."""
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
                f"{side} has {counted(len(ends), 'channel')} at the plant, which has {len(names)}: "
                "give one row (of before) or column (of after) for each."
            )
        return T.replace(outputs=names) if side == "before" else T.replace(inputs=names)
    return T


#: largest deviation of the phase of det(I - L) at its ends
_END = 0.25 * np.pi
#: largest difference of the slope of |det(I - L)| at the lowest lines from the number of
#: integrators
_SLOPE = 0.75
#: range below the lowest line or the slowest pole of the controller, whichever is lower, to which a
#: measured plant is extrapolated; number of lines per decade there
_BELOW, _DENSE = 1e-3, 50

#: error of a plant below its lines: a suspension at a third of the lowest line adds this fraction
_ROUGH = 0.1


class NyquistCount(NamedTuple):
    """Unstable poles of a closed loop by the argument principle; None: the reason says why."""

    unstable: int | None
    reason: str = ""
    narrowest: float = 0.0
    near: float = 0.0


def nyquist_count(
    plant: MeasuredPlant,
    controller: Responder,
    hidden: HiddenModes,
    *,
    rigid: int,
    at_zero: int,
    unstable: int,
    poles: ComplexArray,
) -> NyquistCount:
    """Return the unstable poles of ``u = K P u``, counted on the lines and between them.

    From 0+ to the highest frequency the argument of ``F = det(I - K P)`` changes by
    ``pi (p + n0 / 2 - z)``: p unstable and n0 integrating poles of K P, z unstable ones of the
    loop. Below the lines and the `poles` s / (2 pi) [Hz] of the controller F continues as
    ``c / (i w)^n0``, c real; above the lines it ends positive. Around narrow poles of the
    controller, which is known everywhere, F is followed between the lines and below them. A count
    that hangs on an error of the continued plant is not known.
    """
    lines, slowest = plant.freq, float(np.abs(poles).min(initial=np.inf))
    reach = _BELOW * min(1.0, slowest / float(lines[0]))
    low = lines[0] * np.geomspace(reach, 1.0, round(-_DENSE * np.log10(reach)))[:-1]
    freq, respond = np.concatenate([low, lines]), _continued(plant, rigid)

    def gain(at: FloatArray) -> ComplexArray:
        return np.asarray(np.einsum("uyf,yvf->fuv", controller(at), respond(at)))

    F = np.concatenate([np.linalg.det(np.eye(plant.data.shape[1]) - gain(low)), hidden.F])
    if not np.all(np.abs(F) > 0.0):
        return NyquistCount(None, "a line lies on the critical point")
    path = _past_poles(freq, poles)
    places, turns = _followed(gain, freq, path, below=low.size)
    direct = np.angle(F[1:][places] / F[:-1][places])
    steps, unknown, undecided = (
        np.concatenate([np.zeros(low.size, dtype=part.dtype), part])
        for part in (hidden.step, hidden.unknown, hidden.undecided)
    )
    other = np.abs(turns - direct) > np.pi
    # where a mode of the plant and a pole of the controller turn F, neither path holds both
    both = other & (places >= low.size) & (np.abs(steps[places] - direct) > np.pi)
    unknown[places] |= both | np.isnan(turns)
    steps[places] = np.where(other | (places < low.size), turns, steps[places])
    for open_, what in (
        (unknown, "the phase turns too far for its path to be known"),
        (undecided, "may be a mode that is unstable in the loop if it is slightly narrower"),
    ):
        if open_.any():
            begin, end = freq[int(np.argmax(open_)) :][:2]
            place = "between the lines at" if begin >= lines[0] else "below the lines, between"
            return NyquistCount(
                None,
                f"{place} {begin:.4g} and {end:.4g} Hz {what}: measure with a finer "
                "resolution there, or give the loop less gain at that resonance",
            )
    grows = -float(np.polyfit(np.log(freq[:3]), np.log(np.abs(F[:3])), 1)[0])
    if abs(grows - at_zero) > _SLOPE:
        return NyquistCount(
            None,
            f"towards zero frequency det(I - L) grows with slope {grows:.2g}, but plant and "
            f"controller were stated to have {at_zero} integrators: state the rigid-body modes "
            "of these channels",
        )
    last = float(np.angle(F[-1]))
    start = float(np.angle(F[0])) + 0.5 * np.pi * at_zero  # the argument of c: a multiple of pi
    first = start - np.pi * np.round(start / np.pi)
    for miss, place, where in ((first, freq[0], "lower"), (last, freq[-1], "higher")):
        if abs(miss) > _END:
            return NyquistCount(
                None,
                f"at {place:.4g} Hz the loop gain has not reached its limit (the phase is "
                f"{np.degrees(abs(miss)):.0f} deg off): measure at {where} frequencies",
            )
    change = first + float(np.sum(steps)) - last
    count = unstable + 0.5 * at_zero - change / np.pi
    if abs(count - round(count)) > 0.05 or round(count) < 0:
        return NyquistCount(
            None,
            f"the phase turns so that {count:.3g} poles would be unstable: state the rigid-body "
            "and the unstable poles that the plant has",
        )
    early = path[path < lines[0]]
    own = np.linalg.eigvals(gain(early))
    peak = np.abs(own / (1.0 - own)).max(axis=1)  # 1 / peak: factor on P that F = 0 needs
    if peak.max() * _ROUGH > 1.0:
        return NyquistCount(
            None,
            f"below the lines, at {early[np.argmax(peak)]:.4g} Hz, the loop is so close to the "
            f"critical point that the plant must be known there to {100.0 / peak.max():.2g} %: "
            "measure at lower frequencies",
        )
    widest = int(np.argmax(hidden.width))
    near = float(0.5 * np.sum(lines[widest : widest + 2]))
    return NyquistCount(round(count), "", float(hidden.width[widest]), near)


def broken_count(parts: BrokenLoop, rigid: int | None, unstable: int) -> NyquistCount:
    """Return the unstable poles of a broken loop; numbers as for `report_loops`.

    Without `rigid` it is the number of free motions that the lowest lines show.
    """
    grid, poles = parts.grid, parts.poles()
    distance = np.log(np.where(poles == 0, TINY, poles)) if parts.dt else poles
    scale = 1.0 if parts.dt else np.max(np.abs(poles), initial=TINY)
    if parts.measured is None:
        return NyquistCount(int(np.count_nonzero(distance.real >= 0.0)))
    if grid.size < FEWEST:
        return NyquistCount(
            None,
            f"{grid.size} lines are too few to judge stability, {FEWEST} are needed: measure more",
        )
    zero = np.abs(distance) <= SAME * scale
    own = int(np.count_nonzero((distance.real > 0.0) & ~zero))
    plant = parts.measured
    taken = "was found there" if rigid is None else "was stated"
    rigid = plant.free_motions if rigid is None else rigid
    at_zero = 2 * rigid + int(np.count_nonzero(zero))
    swing = distance[~zero] / (2j * np.pi * (parts.dt or 1.0))
    slope = plant.slope
    if abs(slope - (2 if rigid else 0)) > 1.0:
        return NyquistCount(
            None,
            f"at the lowest lines, from {grid[0]:.4g} Hz, the plant has the slope {slope:.2g}, "
            f"but rigid={rigid} {taken}: a free body has slope 2, a held one slope 0. State "
            "rigid=, or measure at lower frequencies",
        )
    return nyquist_count(
        plant, parts.controller, parts.hidden,
        rigid=rigid, at_zero=at_zero, unstable=unstable + own, poles=swing,
    )  # fmt: skip


def _past_poles(freq: FloatArray, poles: ComplexArray) -> FloatArray:
    """Return frequencies and those around poles that they do not resolve."""
    place = np.searchsorted(freq, poles.real) - 1
    inside = (place >= 0) & (place < freq.size - 1)
    poles, wide = poles[inside], np.diff(freq)[place[inside]]
    narrow = poles[2.0 * np.abs(poles.imag) < SHOWN * wide]
    near = narrow.real + np.abs(narrow.imag) * around_resonance()[:, None]
    return np.union1d(freq, near[(near > freq[0]) & (near < freq[-1])])


def _followed(
    gain: Callable[[FloatArray], ComplexArray], freq: FloatArray, path: FloatArray, below: int
) -> tuple[IntArray, FloatArray]:
    """Return the intervals that the path divides or that lie below the lines, and steps of F there.

    A step is NaN where halving does not make it small.
    """
    # det(M) with M = I - L turns as the eigenvalues of M(high) M(low)^-1 do, each of which shows
    # a turn that cancels in their product
    place = np.searchsorted(freq, path[:-1], side="right") - 1
    divided = np.bincount(place, minlength=freq.size - 1) > 1
    divided[:below] = True
    low, high = path[:-1][divided[place]], path[1:][divided[place]]
    steps = np.zeros(freq.size - 1)
    for _ in range(MOST_STEPS):
        if not low.size:
            break
        L = gain(high)
        turn = np.angle(np.linalg.eigvals((np.eye(L.shape[-1]) - L) @ inverted(gain(low))))
        small = np.abs(turn).max(axis=1) <= STEP
        place = np.searchsorted(freq, low, side="right") - 1
        np.add.at(steps, place[small], turn[small].sum(axis=1))
        middle = 0.5 * (low + high)[~small]
        low, high = (np.sort(np.append(end[~small], middle)) for end in (low, high))
    steps[np.searchsorted(freq, low, side="right") - 1] = np.nan
    places = np.flatnonzero(divided)
    return places, steps[places]


def _continued(plant: MeasuredPlant, rigid: int) -> Responder:
    """Return the response of a measured plant on its lines, between them and below them."""
    # below the lines: the largest directions, those of the rigid-body modes, fall with f^2, the
    # others are constant; the imaginary part (delay) falls with another factor f
    first, lowest = plant.data[:, :, 0], plant.freq[0]
    left, sizes, right = np.linalg.svd(first.real)
    to, fro = left[:, :rigid], right[:rigid]
    free = (to * sizes[:rigid]) @ fro + 1j * (to @ to.T @ first.imag @ fro.T @ fro)

    def over(part: ComplexArray, low: FloatArray, fall: FloatArray) -> ComplexArray:
        whole = part[:, :, None]
        return np.asarray((whole.real + 1j * low * whole.imag) / fall)

    def found(freq: FloatArray) -> ComplexArray:
        low = freq[freq < lowest] / lowest
        below = over(free, low, low**2) + over(first - free, low, np.ones(low.size))
        return np.concatenate([below, plant.at(freq[low.size :])], axis=2)

    return found

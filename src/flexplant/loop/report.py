"""report_loops: crossovers, margins and stability, loop by loop, of a model or a measured Frf."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass
from typing import Literal, NamedTuple

import numpy as np

from ..checks import ComplexArray, FloatArray, Value, whole
from ..errors import counted, unknown_label
from ..lti.frequency_sweep import crossings
from ..lti.measured_lines import FEWEST, HiddenModes, low_slope
from ..lti.responses import Responder
from ..tolerances import TINY
from .broken import BrokenLoop, inverted
from .sensitivity import Loop, taken_apart

#: a pole of the controller this near to zero frequency integrates
_INTEGRATES = 1e-9
#: a loop gain at the first or last line that counts as real
_REAL = 0.05
#: slope of its size over frequency at the first line below which it is taken to be level
_LEVEL = 0.5


@dataclass(frozen=True, eq=False, repr=False)
class LoopMargins(Value):
    """One loop, broken at one place while the others stay closed.

    Parameters
    ----------
    name : str
        The channel where it is broken.
    crossovers : tuple of float [Hz]
        Where the loop gain crosses 1; the bandwidth is the first, resonances may add more.
    gain_margin, gain_reduction : float
        Factors on the gain, above and below 1, at which the loop reaches the critical point;
        infinite and 0 where none does.
    phase_margin : float [deg]
        The least at the crossovers, lead or lag; 180 without one. Of an unstable loop this and the
        others are distances to the critical point, no margins.
    modulus_margin : float
        Least distance to the critical point, 1 / max |S|.
    freq : float [Hz]
        Where it is.
    gain_freq, phase_freq : float [Hz]
        Where the nearer of both gain margins and the phase margin are; NaN where there are none.

    Examples
    --------
    >>> import flexplant as fx
    >>> plant = fx.testbeds.three_masses()
    >>> observer = fx.design_kalman(plant)
    >>> servo = fx.design_servo(plant, bandwidth=20.0, observer=observer)
    >>> one = fx.loop.report_loops(fx.close_loop(plant, observer, servo))["u1"]
    >>> round(one.gain_margin, 2), round(one.modulus_margin, 2)
    (3.26, 0.57)
    """

    name: str
    crossovers: tuple[float, ...]
    gain_margin: float
    gain_reduction: float
    phase_margin: float
    modulus_margin: float
    freq: float
    gain_freq: float = float("nan")
    phase_freq: float = float("nan")

    def __repr__(self) -> str:
        first = ", ".join(f"{f:.4g}" for f in self.crossovers[:4])
        more = ", ..." if len(self.crossovers) > 4 else ""
        crosses = f"crosses 1 at {first}{more} Hz" if first else "does not cross 1"
        bounds = [gain for gain in (self.gain_margin, self.gain_reduction) if gain]
        decibel = [
            f"{20.0 * np.log10(gain):.1f} dB" if np.isfinite(gain) else "infinite"
            for gain in bounds
        ]
        return (
            f"{self.name}: {crosses}, gain margin {' and '.join(decibel)}, phase margin "
            f"{self.phase_margin:.0f} deg, modulus margin {self.modulus_margin:.3f} "
            f"({self.freq:.4g} Hz)"
        )


@dataclass(frozen=True, eq=False, repr=False)
class LoopReport(Value, Mapping[str, LoopMargins]):
    """What `report_loops` found: `report["u1"]` is one loop.

    Parameters
    ----------
    loops : tuple of LoopMargins
        Of each channel where the loops are broken.
    modulus_margin : float
        Of all together, ``1 / max sigma_max(S)`` with S where they are broken; 0 when unstable.
        Where the channels have several `units` a singular value mixes them, and it is the scaled
        margin.
    unstable : int, optional
        Poles of the closed loop outside the stability region; None where that is not known.
    reason : str
        Why it is not known.
    narrowest, near : float [Hz]
        Of a measured plant: it is stable if it has no mode of a half-power width below it that its
        lines do not show, and where that mode would be. 0 where the lines show all, and of a model.
    scaled_margin : float
        Of all together, ``1 / max min_D sigma_max(D S D^-1)``: each frequency with its axes scaled
        for the least size (the upper bound of mu, an uncertainty for each axis), to 2 %. No unit
        changes it.
    units : tuple of str
        Of the channels, where they have several.

    Examples
    --------
    >>> import flexplant as fx
    >>> plant = fx.testbeds.three_masses()
    >>> observer = fx.design_kalman(plant)
    >>> servo = fx.design_servo(plant, bandwidth=20.0, observer=observer)
    >>> report = fx.loop.report_loops(fx.close_loop(plant, observer, servo))
    >>> report.is_stable, report.modulus_margin > 0.5
    (True, True)
    """

    loops: tuple[LoopMargins, ...]
    modulus_margin: float
    unstable: int | None
    reason: str = ""
    narrowest: float = 0.0
    near: float = 0.0
    scaled_margin: float = 0.0
    units: tuple[str, ...] = ()

    @property
    def is_stable(self) -> bool | None:
        """Whether the closed loop is stable; None where it cannot be judged.

        Of a measured plant, if it has no hidden mode narrower than `narrowest`.
        """
        return None if self.unstable is None else self.unstable == 0

    @property
    def poles(self) -> str:
        """The number of unstable poles, in words."""
        return counted(self.unstable or 0, "pole")

    def __getitem__(self, name: str) -> LoopMargins:
        for loop in self.loops:
            if isinstance(name, str) and loop.name == name:
                return loop
        raise unknown_label("loop", name, list(self))

    def __iter__(self) -> Iterator[str]:
        return (loop.name for loop in self.loops)

    def __len__(self) -> int:
        return len(self.loops)

    def __repr__(self) -> str:
        state = {True: "stable", False: f"unstable, {self.poles}", None: "stability not judged"}
        limit = (
            f" if no mode is narrower than {self.narrowest:.2g} Hz (near {self.near:.4g} Hz)"
            if self.narrowest and self.is_stable
            else ""
        )
        margin = f"modulus margin {self.modulus_margin:.3f}"
        if self.units:
            margin += (
                f" of {len(self)} loops together, axes scaled (units: {', '.join(self.units)})"
            )
        elif len(self) > 1:
            margin += f" of {len(self)} loops together, {self.scaled_margin:.3f} with scaled axes"
        lines = [f"<LoopReport: {state[self.is_stable]}{limit}, {margin}>"]
        lines += [f"  {loop!r}" for loop in self.loops[:4]]
        lines += [f"  and {len(self) - 4} more"] if len(self) > 4 else []
        lines += [f"  stability: {self.reason}"] if self.reason else []
        return "\n".join(lines)


def report_loops(
    loop: Loop, *, at: Literal["u", "y"] = "u", rigid: int = 0, unstable: int = 0
) -> LoopReport:
    """Return crossovers, gain, phase and modulus margin of each loop, and whether all are stable.

    Each loop is broken while the others stay closed: ``L_i = 1 - 1 / S_ii`` with
    ``S = (I - L)^-1``. Stability of a model follows from the poles; that of a measured plant from
    the Nyquist count, with the poles at zero and outside the stability region that are stated for
    the plant and known of the controller. Modes between the lines are followed as far as the lines
    show them; what they do not show is said, "stable if no mode is narrower than 0.02 Hz", or
    stability is not judged.

    Parameters
    ----------
    loop : ClosedLoop, or (plant, controller)
        As for `loop_gain`; the plant may be a measured Frf, in decoupled axes by `in_axes`.
    at : {"u", "y"}
        Where the loops are broken.
    rigid : int
        Of a measured plant: its rigid-body modes (two poles at zero each); those on springs too
        when the suspension lies below the lines.
    unstable : int
        Of a measured plant: poles outside the stability region (negative stiffness).

    Raises
    ------
    LabelError
        When channels of plant and controller do not match.
    ModelError
        When `loop` is of another type, or a number of poles is none.

    Examples
    --------
    >>> import flexplant as fx
    >>> plant = fx.testbeds.three_masses()
    >>> observer = fx.design_kalman(plant)
    >>> servo = fx.design_servo(plant, bandwidth=20.0, observer=observer)
    >>> report = fx.loop.report_loops(fx.close_loop(plant, observer, servo))
    >>> report.is_stable, round(report["u1"].phase_margin)
    (True, 41)
    """
    rigid, unstable = whole(rigid, "rigid", minimum=0), whole(unstable, "unstable", minimum=0)
    return broken_report(taken_apart(loop), at, rigid, unstable)


def broken_report(
    parts: BrokenLoop, at: Literal["u", "y"], rigid: int, unstable: int
) -> LoopReport:
    """Return the report of a loop that is taken apart; parameters as for `report_loops`."""
    count = broken_count(parts, rigid, unstable)
    loops = broken_margins(parts, at)
    scaled = 0.0 if count.unstable else 1.0 / parts.worst(at, len(loops) > 1)[0]
    units = parts.mixed(at)
    margin = scaled if units or count.unstable else 1.0 / parts.worst(at, False)[0]
    return LoopReport(loops, margin, *count, scaled_margin=scaled, units=units)


def broken_margins(parts: BrokenLoop, at: Literal["u", "y"]) -> tuple[LoopMargins, ...]:
    """Return crossovers and margins of each loop, the others closed."""
    grid = parts.followed
    S = inverted(parts.gain(grid, at))
    names = parts.u if at == "u" else parts.y

    def one(i: int) -> LoopMargins:
        exact = None
        if parts.measured is None:

            def exact(freq: FloatArray) -> ComplexArray:
                return np.asarray(1.0 - 1.0 / inverted(parts.gain(freq, at))[:, i, i])

        return loop_margins(names[i], grid, 1.0 - 1.0 / S[:, i, i], exact, sampled=bool(parts.dt))

    return tuple(one(i) for i in range(len(names)))


def broken_count(parts: BrokenLoop, rigid: int, unstable: int) -> NyquistCount:
    """Return the unstable poles of a loop that is taken apart; numbers as for `report_loops`."""
    grid, poles = parts.grid, parts.poles()
    distance = np.log(np.where(poles == 0, TINY, poles)) if parts.dt else poles
    scale = 1.0 if parts.dt else np.max(np.abs(poles), initial=TINY)
    if parts.measured is None:
        return NyquistCount(int(np.count_nonzero(distance.real >= 0.0)))
    if grid.size < FEWEST:
        return NyquistCount(
            None, f"{grid.size} lines show no stability, {FEWEST} are the fewest: measure more"
        )
    zero = np.abs(distance) <= _INTEGRATES * scale
    own = int(np.count_nonzero((distance.real > 0.0) & ~zero))
    at_zero = 2 * rigid + int(np.count_nonzero(zero))
    plant = parts.plant(grid)
    slope = low_slope(grid, plant)
    if abs(slope - (2 if rigid else 0)) > 1.0:
        return NyquistCount(
            None,
            f"at the lowest lines, from {grid[0]:.4g} Hz, the plant falls with slope {slope:.2g}, "
            f"but rigid={rigid} was stated: a free body falls with slope 2, a held one "
            "does not. State rigid=, or measure at lower frequencies",
        )
    return nyquist_count(
        grid, plant, parts.controller, parts.hidden,
        slope=2 if rigid else 0, at_zero=at_zero, unstable=unstable + own,
    )  # fmt: skip


def loop_margins(
    name: str,
    freq: FloatArray,
    L: ComplexArray,
    exact: Callable[[FloatArray], ComplexArray] | None = None,
    *,
    sampled: bool = False,
) -> LoopMargins:
    """Return the margins of one loop gain (n_freq,); the critical point is +1."""

    def between(f: FloatArray) -> ComplexArray:
        return np.asarray(np.interp(f, freq, L.real) + 1j * np.interp(f, freq, L.imag))

    from scipy.optimize import minimize_scalar

    find = between if exact is None else exact
    crossovers = crossings(lambda f: np.abs(find(f)) - 1.0, freq, np.abs(L) - 1.0)
    phases = np.abs(np.degrees(np.angle(find(crossovers))))
    # L is real where the imaginary part changes sign; positive: towards the critical point
    turns = crossings(lambda f: find(f).imag, freq, L.imag)
    reals = find(turns).real.tolist()
    # and at its ends, half the rate and zero frequency (unless it integrates), where it is real
    slope = (
        np.log(abs(L[1] / L[0])) / np.log(freq[1] / freq[0])
        if freq.size > 1 and np.all(L[:2])
        else 0.0
    )
    ends = [*([0] if abs(slope) < _LEVEL else []), *([-1] if sampled else [])]
    ends = [i for i in ends if abs(L[i].imag) < _REAL * abs(L[i].real)]
    reals += [L[i].real for i in ends]
    places = [*turns.tolist(), *(float(freq[i]) for i in ends)]
    below = [float(x) for x in reals if 0.0 < x < 1.0]
    above = [float(x) for x in reals if x > 1.0]
    near = min(
        ((abs(np.log(x)), place) for x, place in zip(reals, places, strict=True) if x > 0.0),
        default=(0.0, float("nan")),
    )
    size = np.abs(1.0 - L)
    least = int(np.argmin(size))
    where, margin = float(freq[least]), float(size[least])
    if exact is not None and 0 < least < freq.size - 1:
        low, high = float(freq[least - 1]), float(freq[least + 1])
        closer = minimize_scalar(
            lambda f: abs(1 - find(np.array([f]))[0]), bounds=(low, high), method="bounded"
        )
        if closer.fun < margin:
            where, margin = float(closer.x), float(closer.fun)
    return LoopMargins(
        name,
        tuple(crossovers.tolist()),
        1.0 / max(below) if below else float("inf"),
        1.0 / min(above) if above else 0.0,
        float(phases.min(initial=180.0)),
        margin,
        where,
        float(near[1]),
        float(crossovers[np.argmin(phases)]) if crossovers.size else float("nan"),
    )


#: how far the phase of det(I - L) may be from where its ends have to be
_END = 0.25 * np.pi
#: what the slope of |det(I - L)| at the lowest lines may differ from the number of integrators
_SLOPE = 0.75
#: how far, beside the lowest line, a measured plant is continued to lower frequencies
_BELOW = 1e-3


class NyquistCount(NamedTuple):
    """Unstable poles of a closed loop by the argument principle; None: the reason says why."""

    unstable: int | None
    reason: str = ""
    narrowest: float = 0.0
    near: float = 0.0


def nyquist_count(
    lines: FloatArray,
    plant: ComplexArray,
    controller: Responder,
    hidden: HiddenModes,
    *,
    slope: int,
    at_zero: int,
    unstable: int,
) -> NyquistCount:
    """Return the unstable poles of ``u = K P u``, counted on the lines and what lies between them.

    From 0+ to the highest frequency the argument of ``F = det(I - K P)`` changes by
    ``pi (p + n0 / 2 - z)``: p unstable and n0 integrating poles of K P, z unstable ones of the
    loop. Below the lines F continues as ``c / (i w)^n0``, c real; above them it ends positive.
    """
    freq, L = _continued(lines, plant, controller, slope)
    F = np.linalg.det(np.eye(L.shape[-1]) - L)
    if not np.all(np.abs(F) > 0.0):
        return NyquistCount(None, "a line lies on the critical point")
    below_lines = freq.size - lines.size
    below = np.angle(F[1 : below_lines + 1] / F[:below_lines])
    steps = np.concatenate([below, hidden.step])
    for open_, what in (
        (hidden.unknown, "the phase turns too far for its path to be known"),
        (hidden.undecided, "lies a mode that is unstable in the loop if it is a little narrower"),
    ):
        if open_.any():
            worst = int(np.argmax(open_))
            return NyquistCount(
                None,
                f"between the lines at {lines[worst]:.4g} and {lines[worst + 1]:.4g} Hz {what}: "
                "measure with a finer resolution there, or give the loop less gain at that "
                "resonance",
            )
    grows = -float(np.polyfit(np.log(freq[:3]), np.log(np.abs(F[:3])), 1)[0])
    if abs(grows - at_zero) > _SLOPE:
        return NyquistCount(
            None,
            f"towards zero frequency det(I - L) grows with slope {grows:.2g}, where plant and "
            f"controller were stated to integrate {at_zero} times: state the rigid-body modes that "
            "these channels show",
        )
    last = float(np.angle(F[-1]))
    start = float(np.angle(F[0])) + 0.5 * np.pi * at_zero  # the argument of c: a multiple of pi
    low = start - np.pi * np.round(start / np.pi)
    for miss, place, where in ((low, freq[0], "lower"), (last, freq[-1], "higher")):
        if abs(miss) > _END:
            return NyquistCount(
                None,
                f"at {place:.4g} Hz the loop gain has not reached its limit (the phase is "
                f"{np.degrees(abs(miss)):.0f} deg off): measure at {where} frequencies",
            )
    change = low + float(np.sum(steps)) - last
    count = unstable + 0.5 * at_zero - change / np.pi
    if abs(count - round(count)) > 0.05 or round(count) < 0:
        return NyquistCount(
            None,
            f"the phase turns so that {count:.3g} poles would be unstable: state the rigid-body "
            "and the unstable poles that the plant has",
        )
    widest = int(np.argmax(hidden.width))
    return NyquistCount(
        round(count),
        "",
        float(hidden.width[widest]),
        float(0.5 * np.sum(lines[widest : widest + 2])),
    )


def _continued(
    freq: FloatArray, plant: ComplexArray, controller: Responder, slope: int
) -> tuple[FloatArray, ComplexArray]:
    """Return frequencies and K P (n_freq, nu, nu) of a measured plant, also below its lines."""
    # the plant below its lines: its real part over f^slope, its imaginary part (delay) less by f
    low = np.geomspace(_BELOW, 1.0, 150)[:-1]
    first = plant[:, :, :1]
    below = (first.real + 1j * low * first.imag) / low**slope
    every = np.concatenate([low * freq[0], freq])
    P = np.concatenate([below, plant], axis=2)
    return every, np.einsum("uyf,yvf->fuv", controller(every), P)

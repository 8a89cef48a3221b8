"""Figures of loops: crossovers, margins, stability; comparison of several loops."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass, field
from typing import Literal

import numpy as np

from ..arrays import ComplexArray, FloatArray, mapping, whole
from ..errors import LabelError, ModelError, aligned, counted, require_known, unknown_label
from ..lti.frequency_sweep import ROUNDS, crossings, highest
from ..plant.partitioned import NOT_JUDGED
from ..store import Value
from ..tolerances import SPLIT
from .broken import BrokenLoop, crossing, error_sensitivity, inverted, reference_pair
from .closed import ClosedLoop
from .measured_loop import broken_count
from .other_machines import interval_line
from .sensitivity_functions import Loop, taken_apart

#: relative imaginary part of a loop gain at the first or last line that counts as zero
_REAL = 0.05
#: slope of its size over frequency at the first line below which it counts as constant
_LEVEL = 0.5


@dataclass(frozen=True, eq=False, repr=False)
class LoopMargins(Value):
    """Margins of one loop, opened at one channel while the other loops stay closed.

    All loop gains here have the critical point +1.

    Parameters
    ----------
    name : str
        Channel where the loop is opened.
    crossovers : tuple of float [Hz]
        Frequencies at which the magnitude of the loop gain crosses 1. The first is the crossover
        frequency of the loop, and resonances may add more. They differ from `bandwidth`, at which
        |S| crosses 1.
    gain_margin, gain_reduction : float
        Smallest factor above 1 and largest factor below 1 that move the loop gain to the critical
        point when they multiply it. They are infinite and 0 if no such factor exists.
    phase_margin : float [deg]
        Smallest phase change, lead or lag, that moves the loop gain to the critical point at a
        crossover. It is 180 without a crossover. For an unstable loop, this and the other numbers
        are distances to the critical point, not margins.
    modulus_margin : float
        Smallest distance of the loop gain to the critical point. It equals 1 / max |S|.
    freq : float [Hz]
        Frequency at which the modulus margin occurs.
    gain_freq, phase_freq : float [Hz]
        Frequencies that belong to the gain margin and to the phase margin. The first one belongs to
        `gain_margin` or `gain_reduction`, whichever is closer to 0 dB. They are NaN if no such
        margin exists.
    phases : tuple of float [deg]
        Phase of the loop gain at each crossover. If it is positive, a lag of this size moves the
        loop gain to the critical point; if it is negative, a lead does.
    gains : tuple of (float [Hz], float)
        Pairs of a frequency and a factor. The loop gain reaches the critical point at this
        frequency if it is multiplied by the factor.

    Examples
    --------
    >>> import flexplant as fx
    >>> one = fx.loop.report_loops(fx.lti.tf([60.0], [1.0, 0.0]))["in"]
    >>> round(one.phase_margin), one.gain_margin
    (90, inf)
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
    phases: tuple[float, ...] = ()
    gains: tuple[tuple[float, float], ...] = ()

    @property
    def delay_margin(self) -> float:
        """Smallest additional delay [s] that makes the loop gain reach the critical point.

        It is infinite without a crossover.
        """
        pairs = zip(self.phases, self.crossovers, strict=True)
        return min((phase % 360.0 / (360.0 * freq) for phase, freq in pairs), default=float("inf"))

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
    """Result of `report_loops`. `report["u1"]` holds the margins of the loop at u1.

    Parameters
    ----------
    loops : tuple of LoopMargins
        Margins of each channel where the loops are broken.
    modulus_margin : float
        Modulus margin of all loops together, ``1 / max sigma_max(S)``, with S at the channels where
        the loops are broken. It is 0 when unstable. If the channels have different `units`, a
        singular value would mix them, and this number is the `scaled_margin`.
    unstable : int, optional
        Number of poles of the closed loop outside the stability region; None if not known.
    reason : str
        Reason why the number of unstable poles is not known; empty if it is known.
    narrowest, near : float [Hz]
        Width and frequency of a mode that the measured frequencies could miss; only for a measured
        plant. Such a mode lies between two measured frequencies. The loop is stable if no hidden
        mode has a half-power width below `narrowest`. A mode of this width would be near the
        frequency `near`. Both are 0 for a model, and if the frequencies are close enough to show
        all modes.
    scaled_margin : float
        Modulus margin of all loops together with scaled axes, ``1 / max min_D sigma_max(D S
        D^-1)``. D is a diagonal scaling that is optimised at each frequency, so that the result
        does not depend on units. It is the upper bound of the structured singular value mu with one
        uncertainty for each axis. Its relative tolerance is 2 %.
    units : tuple of str
        Units of the channels, if they differ. Actuators of one unit whose forces are not
        comparable have multiples of it: ``("133 N", "1 N")``.
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
        """Whether the closed loop is stable; None if this is not known.

        For a measured plant, the answer assumes that no mode narrower than `narrowest` is hidden.
        """
        return None if self.unstable is None else self.unstable == 0

    @property
    def poles(self) -> str:
        """Text of the number of unstable poles."""
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
            f" unless a mode between the lines near {self.near:.4g} Hz is narrower than "
            f"{self.narrowest:.2g} Hz"
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
    """Return crossovers and margins of each loop, and whether the closed loop is stable.

    Each loop i is broken while the others stay closed. Its loop gain is ``L_i = 1 - 1 / S_ii``,
    where S_ii is a diagonal entry of ``S = (I - L)^-1``. The stability of a model follows from its
    poles. The stability of a measured plant follows from the number of Nyquist encirclements, the
    poles of the controller, and the poles of the plant that `rigid` and `unstable` state. A mode
    between two measured frequencies ("lines") may be missed if it is narrow. The result then names
    a condition: "stable unless a mode between the lines near 80 Hz is narrower than 0.02 Hz". If
    too few lines were measured, stability is not judged.

    Parameters
    ----------
    loop : ClosedLoop, or (plant, controller)
        Loop, as for `loop_gain`. The plant may be a measured Frf, also in decoupled axes (see
        `in_axes`).
    at : {"u", "y"}
        Where the loops are broken.
    rigid : int
        Number of rigid-body modes of a measured plant (two poles at zero each). It includes those
        on springs whose suspension frequency is below the measured frequencies.
    unstable : int
        Number of poles of a measured plant outside the stability region, for example due to
        negative stiffness.

    Returns
    -------
    LoopReport

    Raises
    ------
    LabelError, ModelError
        When channels of plant and controller do not match, `loop` has another type, or a number of
        poles is not valid.

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
    parts = taken_apart(loop)
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
        def exact(freq: FloatArray) -> ComplexArray:
            return np.asarray(1.0 - 1.0 / inverted(parts.gain(freq, at))[:, i, i])

        L, between = 1.0 - 1.0 / S[:, i, i], exact if parts.measured is None else None
        return loop_margins(names[i], grid, L, between, sampled=bool(parts.dt))

    return tuple(map(one, range(len(names))))


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

    @np.errstate(divide="ignore")
    def closeness(L: ComplexArray) -> FloatArray:
        return np.asarray(1.0 / np.abs(1.0 - L))

    find = between if exact is None else exact
    crossovers = crossings(lambda f: np.abs(find(f)) - 1.0, freq, np.abs(L) - 1.0)
    phases = np.degrees(np.angle(find(crossovers)))
    gains = _gain_crossings(freq, L, find, sampled)
    above = [factor for _, factor in gains if factor > 1.0]
    below = [factor for _, factor in gains if factor < 1.0]
    near = min(((abs(np.log(factor)), place) for place, factor in gains), default=(0.0, np.nan))
    rounds = 0 if exact is None else ROUNDS
    peak, where = highest(lambda f: closeness(find(f)), freq, rounds, closeness(L))
    return LoopMargins(
        name,
        tuple(crossovers.tolist()),
        min(above, default=float("inf")),
        max(below, default=0.0),
        float(np.min(np.abs(phases), initial=180.0)),
        1.0 / peak,
        where,
        float(near[1]),
        float(crossovers[np.argmin(np.abs(phases))]) if crossovers.size else float("nan"),
        tuple(phases.tolist()),
        gains,
    )


def _gain_crossings(
    freq: FloatArray, L: ComplexArray, find: Callable[[FloatArray], ComplexArray], sampled: bool
) -> tuple[tuple[float, float], ...]:
    """Return frequencies [Hz] at which L is real and positive, and the factors that make it 1."""
    # L is real where the imaginary part changes sign; positive: towards the critical point. At an
    # undamped pole or zero it changes sign through infinity or zero, where L reverses
    turns = crossings(lambda f: find(f).imag, freq, L.imag)
    before, after = (find(np.clip(turns * by, freq[0], freq[-1])) for by in (1 - SPLIT, 1 + SPLIT))
    turns = turns[(before * after.conj()).real > 0]
    reals = find(turns).real.tolist()
    # and at its ends, half the rate and zero frequency (unless it integrates), where it is real
    slope = (
        np.log(abs(L[1] / L[0])) / np.log(freq[1] / freq[0])
        if freq.size > 1 and np.all(L[:2])
        else 0.0
    )
    ends = [*([0] if abs(slope) < _LEVEL else []), *([-1] if sampled else [])]
    ends = [i for i in ends if abs(L[i].imag) < _REAL * abs(L[i].real)]
    # a change of sign that rounding puts next to an end is that end
    ends = [i for i in ends if not np.any(np.abs(turns - freq[i]) <= SPLIT * freq[i])]
    reals += [L[i].real for i in ends]
    places = [*turns.tolist(), *(float(freq[i]) for i in ends)]
    found = [(place, 1.0 / float(x)) for place, x in zip(places, reals, strict=True) if x > 0.0]
    return tuple(sorted(found))


#: fraction of the bandwidth at which low-frequency suppression is compared
LOW = 0.1


@dataclass(frozen=True, eq=False)
class LoopFigures(Value):
    """Figures of one closed loop, from its sensitivity S.

    S is the response from the reference to the error at the point of interest (POI).

    Parameters
    ----------
    stable : bool
        Whether all eigenvalues are strictly inside the stability region.
    decay : float
        Spectral radius of a sampled loop, or largest real part of the poles [rad/s] of a continuous
        one.
    bandwidth : float [Hz]
        Frequency at which |S| first crosses 1 from below; NaN without a reference or when unstable.
    peak, peak_freq : float [1], [Hz]
        The largest |S| and its frequency.
    low : float [1]
        Value of |S| at `low_freq`.
    low_freq : float [Hz]
        Frequency of `low`, equal for all loops of a comparison.
    margin : float
        Modulus margin with the loop opened at u, ``1 / max_f sigma_max(S_u)``; 0 when unstable.

    Examples
    --------
    >>> import flexplant as fx
    >>> plant = fx.testbeds.three_masses()
    >>> observer = fx.design_kalman(plant)
    >>> servo = fx.design_servo(plant, bandwidth=20.0, observer=observer)
    >>> fx.compare_loops({"servo": fx.close_loop(plant, observer, servo)})["servo"].stable
    True
    """

    stable: bool
    decay: float
    bandwidth: float
    peak: float
    peak_freq: float
    low: float
    low_freq: float
    margin: float


@dataclass(frozen=True, eq=False, repr=False)
class LoopComparison(Value):
    """The figures of several loops; prints as a table.

    Parameters
    ----------
    rows : mapping {name: LoopFigures}
        Figures of each loop.
    channel : str
        Input and output of the sensitivity S, such as ``die:ref to die:error``. Empty when the
        loops have no reference.
    sampled : bool
        Whether the loops are sampled. Then `decay` of the rows is the spectral radius. For
        continuous loops it is the spectral abscissa.
    unjudged : sequence of str
        Names of the loops whose plants have no evaluation model.
    intervals : mapping {name: str}
        Text of the intervals of margin and bandwidth, or the reason why there are none. An interval
        contains the figure for 95 % of the machines ``plant.machines``, which are random draws
        within the known uncertainty of the plant. A loop is included only if the uncertainty of its
        plant is known.
    """

    rows: Mapping[str, LoopFigures]
    channel: str
    sampled: bool = True
    unjudged: tuple[str, ...] = ()
    intervals: Mapping[str, str] = field(default_factory=dict)

    def __getitem__(self, name: str) -> LoopFigures:
        require_known("loop", [name], self.rows)
        return self.rows[name]

    def __repr__(self) -> str:
        low_freq = next(iter(self.rows.values())).low_freq  # nan where none is stable
        measure = f"stable ({'spectral radius' if self.sampled else 'largest real part [rad/s]'})"
        low = f"|S| at {low_freq:.3g} Hz" if self.channel and low_freq > 0 else "|S| low"
        head = ("", measure, "|S| < 1 up to", "max |S|", "at", low, "max |S| at u")
        lines = aligned(head, [(name, *_cells(row)) for name, row in self.rows.items()])
        if self.channel:
            lines.append(f"S is {self.channel}; at u it is 1 / modulus margin.")
        if self.unjudged:
            every = len(self.unjudged) == len(self.rows)
            lines.append(NOT_JUDGED + ("" if every else f": {', '.join(self.unjudged)}"))
        lines += [f"{name} {line}" for name, line in self.intervals.items()]
        return "\n".join(lines)


def compare_loops(
    loops: Mapping[str, ClosedLoop], *, reference: str | None = None, error: str | None = None
) -> LoopComparison:
    """Return stability, bandwidth and peaks of several loops side by side.

    Parameters
    ----------
    loops : mapping {name: ClosedLoop}
        Loops to compare, such as several designs for one machine, or one design on a model and on
        the machine. Each loop is judged on the evaluation model of its plant, if the plant has one.
    reference : str, optional
        Reference (channel of w) for which S is compared; needed if there are several.
    error : str, optional
        Error (channel of z) for which S is compared; by default that of the reference.

    Returns
    -------
    LoopComparison
        Table of the figures. Its column for low frequency shows |S| at a tenth of the largest
        bandwidth of all loops.

    Raises
    ------
    ModelError
        When `loops` is not a mapping of closed loops, or some are sampled and some continuous.
    LabelError
        When a loop lacks the channels, or has several references and none is named.

    Examples
    --------
    >>> import flexplant as fx
    >>> plant = fx.testbeds.three_masses()
    >>> observer, loops = fx.design_kalman(plant), {}
    >>> for hz in (10.0, 20.0):
    ...     servo = fx.design_servo(plant, bandwidth=hz, observer=observer)
    ...     loops[f"{hz:g} Hz"] = fx.close_loop(plant, observer, servo)
    >>> {name: row.stable for name, row in fx.compare_loops(loops).rows.items()}
    {'10 Hz': True, '20 Hz': True}
    """
    hint = "Pass {'servo': close_loop(plant, observer, servo)}."
    mapping(loops, "loops", hint, least=1, kind=ClosedLoop)
    alone = tuple(name for name, loop in loops.items() if loop.plant.unjudged)
    stable = {name: loop for name, loop in loops.items() if loop.plant.dt and loop.is_stable}
    intervals = {name: line for name, loop in stable.items() if (line := interval_line(loop))}
    loops = {name: loop.completed or loop for name, loop in loops.items()}
    pair = reference_pair(next(iter(loops.values())), reference, error)
    for name, loop in loops.items():
        if pair and (pair[0] not in loop.plant.w or pair[1] not in loop.plant.z):
            raise LabelError(
                f"loop {name!r} has no {pair[0]!r} in w or no {pair[1]!r} in z. Compare loops of "
                "the same Ports, or name the channels: reference=, error=."
            )
    sampled = bool(next(iter(loops.values())).plant.dt)
    if any(bool(loop.plant.dt) != sampled for loop in loops.values()):
        raise ModelError(
            "some of the loops are sampled and some continuous: their stability is measured "
            "differently. Compare loops of one kind."
        )
    curves = {
        name: error_sensitivity(loop, *pair) if pair and loop.is_stable else None
        for name, loop in loops.items()
    }
    reached = {
        name: float("nan") if curve is None else crossing(loops[name], pair[0], pair[1], curve)
        for name, curve in curves.items()
    }
    known = [value for value in reached.values() if np.isfinite(value)]
    low_freq = LOW * max(known, default=np.nan)
    rows = {
        name: _figures(loop, curves[name], reached[name], low_freq, pair)
        for name, loop in loops.items()
    }
    channel = f"{pair[0]} to {pair[1]}" if pair else ""
    return LoopComparison(rows, channel, sampled, alone, intervals)


def _figures(
    loop: ClosedLoop,
    curve: tuple[FloatArray, FloatArray] | None,
    reached: float,
    low_freq: float,
    pair: tuple[str, ...],
) -> LoopFigures:
    decay = loop.spectral_radius if loop.plant.dt else loop.spectral_abscissa
    peak = freq = low = float("nan")
    if curve is not None:
        freq, peak = (float(part[np.argmax(curve[1])]) for part in curve)
        if np.isfinite(low_freq):
            low = float(abs(loop.gain(*pair)(np.array([low_freq]))[0, 0, 0]))
    margin = loop.modulus_margin
    return LoopFigures(loop.is_stable, decay, reached, peak, freq, low, low_freq, margin)


def _cells(row: LoopFigures) -> tuple[str, ...]:
    """Return the row of a table: Hz and dB."""
    if not row.stable:
        return (f"NO ({row.decay:.6f})", "-", "-", "-", "-", "-")
    return (
        f"yes ({row.decay:.6f})",
        _hertz(row.bandwidth),
        _decibel(row.peak),
        _hertz(row.peak_freq),
        _decibel(row.low),
        _decibel(1.0 / row.margin),
    )


def _hertz(freq: float) -> str:
    return "-" if np.isnan(freq) else f"{freq:.{1 if freq < 1e3 else 0}f} Hz"


def _decibel(size: float) -> str:
    return "-" if np.isnan(size) or size <= 0 else f"{20.0 * np.log10(size):.1f} dB"

"""Specifications of a closed loop, and the table of achieved values."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from functools import cache, partial
from typing import Any, TypeAlias

import numpy as np

from ..arrays import FloatArray, instance, positive
from ..errors import AssumptionError, ModelError, aligned, in_unit, only_one, require_known, short
from ..loop import ClosedLoop, bandwidth
from ..loop.other_machines import MODULUS_MARGIN
from ..plant import FigureInterval
from ..plant.machine_plants import PlantMachines, interval_text
from ..store import Value, checked
from ..tolerances import INTERVAL
from .exposure import exposure_errors, settling_time
from .response import Response

#: limits that need a run, in the order of the table
_OF_RUNS = ("ma", "msd", "rms", "peak", "settling", "effort")
#: limits of the loop itself
_OF_LOOPS = ("noise", "bandwidth", "modulus_margin")

#: name, unit, value and limit of a requirement, and whether the limit is a lower one
_Row: TypeAlias = tuple[str, str, float, float, bool]
#: a run, or the function of a loop that makes it
_Run: TypeAlias = "Response | Callable[[ClosedLoop], Response]"


def _efforts(value: Any, name: str) -> float | dict[str, float]:
    """Return the limit of all actuators, or of each actuator."""
    if isinstance(value, Mapping):
        return {n: positive(limit, f"{name} of {n}") for n, limit in value.items()}
    return positive(value, name)


@dataclass(frozen=True, eq=False, repr=False)
class Verdict(Value):
    """Achieved values compared with the specified limits; prints as a table.

    `Specification.check` returns it. In a test write ``assert verdict.passed, str(verdict)``; if
    the test fails, the message is the table.

    Parameters
    ----------
    names, units : sequence of str
        Names and units of the requirements.
    values, limits : (n,) arrays
        Achieved and allowed values. An achieved value is NaN if it is not available.
    at_least : (n,) bool array
        Whether the limit is a lower limit.
    low, high : (n,) arrays, optional
        Ends of the interval of each value. The interval contains the value for 95 % of the machines
        ``plant.machines``, which are random draws within the known uncertainty of the plant. NaN
        where no interval is stated.
    sentences : sequence of n str, optional
        The intervals in words, or the reason why there is none. Texts are empty if no uncertainty
        of the plant is known.

    Examples
    --------
    >>> import flexplant as fx
    >>> plant = fx.testbeds.three_masses()
    >>> observer = fx.design_kalman(plant)
    >>> servo = fx.design_servo(plant, bandwidth=20.0, observer=observer)
    >>> loop = fx.close_loop(plant, observer, servo)
    >>> fx.Specification(modulus_margin=0.9).check(loop).failed
    ('modulus margin',)
    """

    names: tuple[str, ...]
    units: tuple[str, ...]
    values: FloatArray
    limits: FloatArray
    at_least: Any
    low: FloatArray = field(default_factory=lambda: np.zeros(0))
    high: FloatArray = field(default_factory=lambda: np.zeros(0))
    sentences: tuple[str, ...] = ()

    def __bool__(self) -> bool:
        return self.passed

    @property
    def met(self) -> Any:
        """Whether each requirement is met (n,). A requirement without a value is not met."""
        above, below = self.values >= self.limits, self.values <= self.limits
        return np.where(self.at_least, above, below)

    @property
    def passed(self) -> bool:
        """Whether all requirements are met."""
        return bool(np.all(self.met))

    @property
    def failed(self) -> tuple[str, ...]:
        """Names of the requirements that are not met."""
        return tuple(name for name, met in zip(self.names, self.met, strict=True) if not met)

    @property
    def met_on_machines(self) -> Any:
        """Whether the whole interval meets each requirement (n,); False without an interval."""
        if not self.sentences:
            return np.zeros(len(self.names), dtype=bool)
        above, below = self.low >= self.limits, self.high <= self.limits
        return np.where(self.at_least, above, below)

    def __getitem__(self, name: str) -> float:
        """Return the achieved value of a requirement."""
        require_known("requirement", [name], self.names)
        return float(self.values[self.names.index(name)])

    def __repr__(self) -> str:
        lines = ["specification: passed" if self.passed else
                 f"specification: FAILED ({', '.join(self.failed)})"]  # fmt: skip
        columns = (self.names, self.units, self.values, self.limits, self.at_least, self.met)
        rows: list[tuple[str, ...]] = []
        for name, unit, value, limit, least, met in zip(*columns, strict=True):
            factor, shown = in_unit(float(limit), unit) if np.isfinite(limit) else (1.0, unit)
            must = f"{'>=' if least else '<='} {limit / factor:.4g}"
            rows.append((name, f"{value / factor:.4g}", must, shown, "" if met else "FAILED"))
        head: tuple[str, ...] = ("", "reached", "limit", "", "")
        if not self.sentences:
            return "\n".join([*lines, *aligned(head, rows)])
        there = zip(self.low, self.high, self.units, self.met_on_machines, strict=True)
        rows = [(*r[:-1], *_on_machines(*one), r[-1]) for r, one in zip(rows, there, strict=True)]
        head = (*head[:-1], f"on {100 * INTERVAL:.3g} % of such machines", "met there", "")
        reasons: dict[str, list[str]] = {}
        for i in np.flatnonzero(np.isnan(self.low)).tolist():
            reasons.setdefault(self.sentences[i], []).append(self.names[i])
        said = [f"{', '.join(names)}: {reason}" for reason, names in reasons.items()]
        return "\n".join([*lines, *aligned(head, rows), *said])


def _on_machines(low: float, high: float, unit: str, met: bool) -> tuple[str, str]:
    """Return the cells of an interval, and of whether a requirement is met all over it."""
    if np.isnan(low):
        return "not stated", "not known"
    return interval_text(low, high, unit), "yes" if met else "NO"


#: figures of a loop, by the name of their row
_FIGURES: dict[str, str | Callable[[ClosedLoop], float]] = {
    "bandwidth": bandwidth,
    "modulus margin": MODULUS_MARGIN,
}
_ONE_RUN = (
    "no interval of a single run: pass a function of a loop, lambda one: simulate(one, ...), "
    "which is repeated on other machines"
)


def _stable(loop: ClosedLoop, known: PlantMachines) -> FigureInterval:
    """Return whether a loop is stable on all machines, as an interval of 0 or 1."""
    if known.missing:
        return loop.interval(MODULUS_MARGIN)
    loops = loop.on_machines
    count = len(loops.loops)
    low, high = float(loops.unstable == 0), float(loops.unstable < count)
    return FigureInterval(low, high, f"stable on {count - loops.unstable} of {count} such machines")


@dataclass(frozen=True, eq=False)
class Specification(Value):
    """Limits for a closed loop and its runs. Only the limits that are given are checked.

    Parameters
    ----------
    ma, msd : float, optional [m or rad]
        Largest allowed moving average |MA| and moving standard deviation MSD of the error over the
        exposures, which are the times in which the machine works (see `exposure_errors`).
    rms, peak : float, optional [m or rad]
        Largest allowed rms and magnitude of the error in the run, from `start` on.
    settling : float, optional [s]
        Largest allowed time after `start` until |MA| (and MSD) stay within `ma` (and `msd`). If it
        is given, the exposures begin at ``start + settling``.
    effort : float or mapping {actuator: float}, optional [N, N m]
        Largest allowed magnitude of a command, at any time of the run.
    noise : float, optional [m or rad]
        Largest allowed stationary rms of the error under the white noises, `ClosedLoop.rms`.
    bandwidth : float, optional [Hz]
        Smallest allowed bandwidth. It is the frequency at which |S| at u first crosses 0 dB.
    modulus_margin : float, optional
        Smallest allowed modulus margin. If truncated modes are known, the margin is checked with
        and without them.
    channel : str, optional
        Channel of the error; by default the only one of the loop.
    window : float [s]
        Length of the window of MA and MSD.
    start : float [s]
        End of the move. Samples before it do not belong to an exposure.

    Raises
    ------
    ModelError
        When a limit is not positive, no limit is given, or `settling` is given without `ma`.

    Examples
    --------
    >>> import flexplant as fx
    >>> plant = fx.testbeds.three_masses()
    >>> observer = fx.design_kalman(plant)
    >>> servo = fx.design_servo(plant, bandwidth=20.0, observer=observer)
    >>> loop = fx.close_loop(plant, observer, servo)
    >>> fx.Specification(modulus_margin=0.4, bandwidth=5.0).check(loop).passed
    True
    """

    ma: float | None = field(default=None, metadata=checked(positive))
    msd: float | None = field(default=None, metadata=checked(positive))
    rms: float | None = field(default=None, metadata=checked(positive))
    peak: float | None = field(default=None, metadata=checked(positive))
    settling: float | None = field(default=None, metadata=checked(positive))
    effort: float | Mapping[str, float] | None = field(default=None, metadata=checked(_efforts))
    noise: float | None = field(default=None, metadata=checked(positive))
    bandwidth: float | None = field(default=None, metadata=checked(positive))
    modulus_margin: float | None = field(default=None, metadata=checked(positive))
    channel: str | None = None
    window: float = field(default=5e-3, metadata=checked(positive))
    start: float = field(default=0.0, metadata=checked(positive, zero=True))

    def __post_init__(self) -> None:
        super().__post_init__()
        if all(getattr(self, name) is None for name in (*_OF_RUNS, *_OF_LOOPS)):
            raise ModelError("a specification needs at least one limit: Specification(ma=5e-9).")
        if self.settling is not None and self.ma is None:
            raise ModelError("settling is the time to reach ma (and msd): give ma as well.")

    def check(self, loop: ClosedLoop, run: _Run | None = None, *, exposures: Any = None) -> Verdict:
        """Return the achieved values of a loop and of its run, compared with the limits.

        If the uncertainty of the plant is known (`StandardPlant.machines`), each value gets an
        interval. It contains the value for 95 % of the machines that are drawn at random within
        this uncertainty.

        Parameters
        ----------
        loop : ClosedLoop
            Loop around a model, or around the machine.
        run : Response or callable, optional
            Run of the loop; limits on errors and efforts need it. All runs of a Response are
            checked. A function of a loop that returns a Response is accepted too: ``lambda one:
            simulate(one, reference=move, duration=0.1)``. A function can be repeated on other
            machines. Only then do the limits on errors and efforts get intervals.
        exposures : (k, 2) array [s], optional
            Exposures, as for `exposure_errors`. By default the exposure begins at `start` (plus
            `settling`).
        """
        instance(loop, ClosedLoop, "loop", "Use close_loop(plant, ...).")
        done = run(loop) if callable(run) else run
        needed = [name for name in _OF_RUNS if getattr(self, name) is not None]
        if needed and not isinstance(done, Response):
            raise ModelError(
                f"the limits on {', '.join(needed)} need a run, got {short(done)}. Pass "
                "simulate(loop, reference=move, duration=...)."
            )
        rows = [("stable", "", float(loop.is_stable), 1.0, True), *self._of_loop(loop)]
        if done is not None:
            rows += self._of_run(loop, done, exposures)
        names, units, values, limits, least = zip(*rows, strict=True)
        found = self._intervals(loop, run, rows, exposures)
        low, high = np.array([one[:2] for one in found], dtype=float).reshape(-1, 2).T
        said = tuple(one.sentence for one in found)
        return Verdict(
            names, units, np.array(values), np.array(limits), np.array(least), low, high, said
        )

    def _intervals(
        self, loop: ClosedLoop, run: _Run | None, rows: Sequence[_Row], exposures: Any
    ) -> list[FigureInterval]:
        """Return the interval of each row over the machines of the plant; none without machines."""
        known = loop.plant.machine.machines
        if known is None:
            return []

        @cache
        def values(one: ClosedLoop) -> dict[str, float]:
            done: Any = run(one) if callable(run) else run
            return {row[0]: row[2] for row in self._of_run(one, done, exposures)}

        def of_run(name: str, one: ClosedLoop) -> float:
            return values(one)[name]

        found = []
        for name, unit, *_ in rows:
            if name == "stable":
                found.append(_stable(loop, known))
            elif name in _FIGURES or name == "noise":
                figure = _FIGURES.get(name) or self._watched(loop)
                found.append(loop.interval(figure, unit=unit))
            elif callable(run):
                found.append(loop.interval(partial(of_run, name), unit=unit))
            else:
                found.append(FigureInterval(None, None, _ONE_RUN))
        return found

    def _watched(self, loop: ClosedLoop) -> str:
        """Return the named channel, or the only error."""
        if self.channel is not None:
            return self.channel
        errors = [name for name in loop.machine.z if name.endswith(":error")]
        return only_one("error channel", errors, None, "Specification(..., channel='y1')")

    def _of_loop(self, loop: ClosedLoop) -> list[tuple[str, str, float, float, bool]]:
        rows = []
        if self.bandwidth is not None:
            try:
                reached = bandwidth(loop)
            except AssumptionError:  # not stable, or |S| is nowhere below 0 dB
                reached = float("nan")
            rows.append(("bandwidth", "Hz", reached, self.bandwidth, True))
        if self.modulus_margin is not None:
            margin = loop.modulus_margin
            if loop.left_out is not None:
                margin = min(margin, loop.left_out.modulus_margin)
            rows.append(("modulus margin", "", margin, self.modulus_margin, True))
        if self.noise is not None:
            channel = self._watched(loop)
            unit = loop.units.get(channel, "")
            reached = loop.rms(channel) if loop.is_stable else float("nan")
            rows.append(("noise", unit, reached, self.noise, False))
        return rows

    def _of_run(
        self, loop: ClosedLoop, run: Response, exposures: Any
    ) -> list[tuple[str, str, float, float, bool]]:
        channel = self._watched(loop)
        instance(run, Response, "run", "Pass simulate(loop, ...).")
        unit = run.units.get(channel, "")
        rows: list[tuple[str, str, float, float, bool]] = []
        if self.ma is not None or self.msd is not None:
            begin = self.start + (self.settling or 0.0)
            found = exposure_errors(
                run, [channel], window=self.window, start=begin, exposures=exposures
            )[channel]
            pairs = (("MA", found.ma, self.ma), ("MSD", found.msd, self.msd))
            rows += [(n, unit, value, lim, False) for n, value, lim in pairs if lim is not None]
        for name in ("rms", "peak"):
            if (limit := getattr(self, name)) is not None:
                worst = np.max(getattr(run, name)(channel, start=self.start))
                rows.append((name, unit, float(worst), limit, False))
        if self.settling is not None and self.ma is not None:
            took = settling_time(
                run, channel, ma=self.ma, msd=self.msd, window=self.window, after=self.start
            )
            rows.append(("settling", "s", float(np.max(took)), self.settling, False))
        if self.effort is not None:
            given = self.effort
            each = given if isinstance(given, Mapping) else dict.fromkeys(loop.driven, given)
            for name, limit in each.items():
                require_known("driven actuator", [name], loop.driven)
                force = float(np.max(np.abs(run[name])))
                rows.append((f"effort {name}", loop.units.get(name, ""), force, limit, False))
        return rows

"""Nonlinear elements of a loop: limits and moves beyond them, quantisation, jitter and others."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any, Protocol, TypeAlias, runtime_checkable

import numpy as np

from ..arrays import (
    ComplexArray,
    FloatArray,
    between,
    divisor,
    instance,
    positive,
    real_array,
    several,
    why_not_called,
)
from ..errors import AssumptionError, ModelError, require_known, short, warn
from ..plant import StandardPlant, driven_axes
from ..plant.axes import complex_gain, resting_frequency
from ..plant.inverse import at_rest, followed_at_rest, solved
from ..store import Value, checked
from ..tolerances import NEGLIGIBLE
from .motion import SetPointProfile


def _upper_limit(value: Any, name: str) -> float:
    """Return a limit, which may be infinite."""
    return np.inf if isinstance(value, float) and value == np.inf else positive(value, name)


def _lower_limit(value: Any, name: str) -> float:
    """Return a limit below, which is not positive."""
    found = float(real_array(value, name, ()))
    if found > 0:
        raise ModelError(
            f"{name} must not be positive, got {found:g}: signals start at 0. Give the limit below."
        )
    return found


@dataclass(frozen=True, eq=False, repr=False)
class Saturation(Value):
    """Limits of a signal v, ``least <= v <= limit``, and of its rate of change.

    Parameters
    ----------
    limit : float [unit of the channel]
        Largest value. Use infinity when only the rate is limited.
    rate : float [unit/s], optional
        Largest change of the signal per time, from sample to sample. The signal starts at 0. With
        None the rate is not limited.
    least : float [unit of the channel], optional
        Smallest value; by default it is ``-limit``. Use 0 for an actuator that can only push.

    Raises
    ------
    ModelError
        When a limit is not positive, or `least` is positive.

    Examples
    --------
    >>> import flexplant as fx
    >>> plant = fx.testbeds.three_masses()
    >>> observer = fx.design_kalman(plant)
    >>> servo = fx.design_servo(plant, bandwidth=20.0, observer=observer)
    >>> loop, weak = fx.close_loop(plant, observer, servo), fx.simulation.Saturation(1e-3)
    >>> acts = {"u1": [weak, fx.simulation.Jitter(2e-4)], "y1": fx.simulation.Quantiser(1e-9)}
    >>> run = fx.simulate(loop, reference=1e-6, duration=0.1, elements=acts, finer=5, rng=1)
    >>> round(float(abs(run["u1:effort"]).max()), 6)
    0.001
    """

    limit: float = field(default=np.inf, metadata=checked(_upper_limit))
    rate: float | None = field(default=None, metadata=checked(positive))
    least: float | None = field(default=None, metadata=checked(_lower_limit))

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.limit == np.inf and self.rate is None and self.least is None:
            raise ModelError("a Saturation without limits does nothing: give limit, rate or both.")


@dataclass(frozen=True, eq=False, repr=False)
class Quantiser(Value):
    """Rounding of a signal v to discrete levels ``step round(v / step)``, as in a converter.

    Parameters
    ----------
    step : float [unit of the channel]
        Distance between two levels of the output (the least significant bit).

    Examples
    --------
    >>> import flexplant as fx
    >>> fx.simulation.Quantiser(1e-9).step  # acting as in the example of `Saturation`
    1e-09
    """

    step: float = field(metadata=checked(positive))


#: function of the values (runs,) of a channel at a sample, which returns new values (runs,)
Act: TypeAlias = Callable[[FloatArray], FloatArray]


@runtime_checkable
class Element(Protocol):
    """Interface of nonlinear elements that you write: any object with the method `begin`.

    In Python this is called a protocol. The example is an element with a dead zone.

    >>> class DeadZone:
    ...     def begin(self, dt, generators):
    ...         return lambda values: np.sign(values) * np.maximum(np.abs(values) - 0.1, 0.0)
    >>> isinstance(DeadZone(), Element)
    True
    """

    def begin(self, dt: float, generators: Sequence[np.random.Generator]) -> Act:
        """Return the function that acts on the values (runs,) of the channel, sample by sample.

        If the element acts on a disturbance, its attribute `reads` is the name of a channel of y.
        The function then receives the values of this channel and returns the force, such as that of
        a mechanical stop or a stiffening spring.

        Parameters
        ----------
        dt : float [s]
            Sampling time of the controller.
        generators : sequence of Generator
            Random generators, one for each run, so that a run does not depend on the others. Each
            call of `begin` starts with an empty memory of the element.
        """
        ...


@dataclass(frozen=True, eq=False)
class Hysteresis(Value):
    """Play (backlash) or hysteresis of a signal: the output only follows changes beyond `width`.

    For the input u the output is ``v[k] = max(u[k] - width, min(u[k] + width, v[k-1]))``, which
    starts at 0. A sum of such elements is the Prandtl-Ishlinskii model of hysteresis.

    Parameters
    ----------
    width : float [unit of the channel]
        Half the width of the loop.

    Examples
    --------
    >>> import flexplant as fx
    >>> loose = fx.simulation.Hysteresis(0.5).begin(1e-3, [None])
    >>> [float(loose(np.array([u]))[0]) for u in (0.2, 2.0, 1.5, 0.4)]
    [0.0, 1.5, 1.5, 0.9]
    """

    width: float = field(metadata=checked(positive))

    def begin(self, dt: float, generators: Sequence[np.random.Generator]) -> Act:
        """Return the function that applies the play, with a separate state for each run."""
        now = np.zeros(len(generators))

        def play(values: FloatArray) -> FloatArray:
            np.maximum(values - self.width, np.minimum(values + self.width, now), out=now)
            return now

        return play


@dataclass(frozen=True, eq=False)
class Dropout(Value):
    """Loss of samples. Instead of a lost sample, the last received value is read again.

    Parameters
    ----------
    share : float
        Probability of losing a sample. Losses are independent, and the first sample is never lost.

    Examples
    --------
    >>> import flexplant as fx
    >>> lossy = fx.simulation.Dropout(0.5).begin(1e-3, [np.random.default_rng(1)])
    >>> [float(lossy(np.array([y]))[0]) for y in (1.0, 2.0, 3.0, 4.0, 5.0)]
    [1.0, 2.0, 2.0, 4.0, 4.0]
    """

    share: float = field(
        metadata=checked(
            between, low=0.0, high=1.0, hint="It is a fraction of the samples, such as 0.01."
        )
    )

    def begin(self, dt: float, generators: Sequence[np.random.Generator]) -> Act:
        """Return the function that loses samples. Each generator belongs to one run."""
        last = np.full(len(generators), np.nan)

        def read(values: FloatArray) -> FloatArray:
            drawn = np.array([one.random() for one in generators])
            np.copyto(last, values, where=(drawn >= self.share) | np.isnan(last))
            return last

        return read


@dataclass(frozen=True, eq=False)
class Friction(Value):
    """Dry friction with presliding (elastic motion before sliding), for a disturbance channel.

    The force is ``-s``, where ``s[k] = s[k-1] + stiffness (x[k] - x[k-1])`` is limited to the range
    from ``-level`` to ``level``. It is computed in every sample of the simulation (see `finer` of
    `simulate`) and is constant over this sample. ``stiffness dt^2`` must therefore be small
    compared with the mass.

    Parameters
    ----------
    level : float [N]
        Force at which the contact slides.
    stiffness : float [N/m]
        Stiffness of the contact before it slides.
    reads : str
        Name of the channel of y that measures the motion x of the contact. Its noise is not
        included.

    Examples
    --------
    >>> import flexplant as fx
    >>> guide = fx.simulation.Friction(level=2.0, stiffness=1e6, reads="y1")
    >>> force = guide.begin(1e-3, [None])
    >>> [round(float(force(np.array([x]))[0]), 6) + 0.0 for x in (0.0, 1e-6, 1e-5, 9e-6)]
    [0.0, -1.0, -2.0, -1.0]
    """

    level: float = field(metadata=checked(positive))
    stiffness: float = field(metadata=checked(positive))
    reads: str = field(metadata=checked(instance, kind=str, hint="Name a channel of y."))

    def begin(self, dt: float, generators: Sequence[np.random.Generator]) -> Act:
        """Return the function that computes the forces, which are zero at the first sample."""
        force, last = np.zeros(len(generators)), np.full(len(generators), np.nan)

        def pull(motion: FloatArray) -> FloatArray:
            moved = np.where(np.isnan(last), 0.0, motion - last)
            np.clip(force + self.stiffness * moved, -self.level, self.level, out=force)
            last[:] = motion
            return -force

        return pull


@dataclass(frozen=True, eq=False)
class Jitter(Value):
    """Random errors of sampling times: a sensor is read early, or a command is applied late.

    The shift of time is between 0 and `spread`. It has a uniform distribution in steps of the finer
    samples, and is independent for each sample and channel. It needs the argument `finer` of
    `simulate`.

    Parameters
    ----------
    spread : float [s]
        Largest shift of time. It must be less than the sampling time of the controller.

    Examples
    --------
    >>> import flexplant as fx
    >>> fx.simulation.Jitter(2e-4).spread  # acting as in the example of `Saturation`
    0.0002
    """

    spread: float = field(metadata=checked(positive))

    def most(self, fine: float, finer: int, name: str) -> int:
        """Return the largest shift as a number of finer samples."""
        found = round(self.spread / fine)
        if not 1 <= found < finer:
            raise ModelError(
                f"the jitter of {name!r}, {self.spread:.3g} s, must be between one finer sample "
                f"({fine:.3g} s) and the time between two samples of the controller "
                f"({finer * fine:.3g} s). Pass simulate(..., finer=) of at least 2, or another "
                "spread."
            )
        return found


#: types that may act on a channel
Acts: TypeAlias = "Saturation | Quantiser | Jitter | Element"


class Acting:
    """The elements on some channels, applied sample by sample and in place.

    Values are quantised first, then limited in rate and magnitude: a converter before its
    amplifier; then the others act in the listed order. `hold` finer samples of dt / hold are one.
    """

    def __init__(
        self, names: Sequence[str], elements: Mapping[str, list[Acts]], dt: float, hold: int = 1
    ) -> None:
        self.limit, self.change = np.full(len(names), np.inf), np.full(len(names), np.inf)
        self.below, step = np.full(len(names), -np.inf), np.zeros(len(names))
        self.dt, self.hold, self.most = dt, hold, np.zeros(len(names), dtype=np.int64)
        self.others: list[tuple[int, Element]] = []
        for name, element in elements.items():
            i = names.index(name)
            for one in element:
                if isinstance(one, Quantiser):
                    step[i] = one.step
                elif isinstance(one, Jitter):
                    self.most[i] = one.most(dt / hold, hold, name)
                elif isinstance(one, Saturation):
                    self.limit[i] = one.limit
                    self.below[i] = -one.limit if one.least is None else one.least
                    self.change[i] = np.inf if one.rate is None else one.rate * dt
                else:
                    self.others.append((i, one))
        self.step, self.coarse = divisor(step), step > 0
        self.counts, self.jitters = bool(np.any(self.coarse)), bool(np.any(self.most))
        self.limits = bool(np.any(np.isfinite(self.limit) | np.isfinite(self.below)))
        self.is_slow = bool(np.any(np.isfinite(self.change)))

    def begin(self, generators: Sequence[np.random.Generator]) -> None:
        """Start a number of runs at 0; random elements do not use the noises of the runs."""
        shape = (len(generators), self.step.size)
        self.last, self.low, self.high = np.zeros((3, *shape))
        self.acts: list[tuple[int, Act]] = []
        if self.others or self.jitters:
            own = [one.spawn(len(self.others) + 1) for one in generators]
            self.drawn = [one[-1] for one in own]
            for j, (i, one) in enumerate(self.others):
                self.acts.append((i, _begun(one, self.dt, [each[j] for each in own])))
        self.due = np.zeros(shape, dtype=np.int64)
        self.past = np.full((self.hold, *shape), np.nan)  # of a sensor's motion; commands: two

    def apply(self, values: FloatArray) -> None:
        """Let the elements act on the values (runs, n) of a sample, in place."""
        low, high = self.low, self.high
        if self.counts:
            np.divide(values, self.step, out=low)
            np.rint(low, out=low)
            np.multiply(low, self.step, out=low)
            np.copyto(values, low, where=self.coarse)
        if self.is_slow:
            np.subtract(self.last, self.change, out=low)
            np.maximum(values, low, out=values)
            np.add(self.last, self.change, out=high)
            np.minimum(values, high, out=values)
        if self.limits:
            np.maximum(values, self.below, out=values)
            np.minimum(values, self.limit, out=values)
        if self.is_slow:
            np.copyto(self.last, values)
        for i, act in self.acts:
            values[:, i] = _acted(act, values[:, i])

    def read(self, j: int, motion: FloatArray, y: FloatArray) -> None:
        """Read sensors early: put past values into y (runs, n); `motion` has the present values."""
        if not self.jitters:
            return
        if not j:
            self._draw()
            early = np.take_along_axis(self.past, (self.hold - self.due)[None] % self.hold, 0)[0]
            y += np.where((self.due > 0) & ~np.isnan(early), early - motion, 0.0)
        self.past[j] = motion

    def send(self, j: int, command: FloatArray) -> None:
        """Apply commands (runs, n) late, in place: until then the previous command acts."""
        if not self.jitters:
            return
        if not j:
            self._draw()
            self.past[1] = np.nan_to_num(self.past[0])
            self.past[0] = command
        np.copyto(command, np.where(j >= self.due, self.past[0], self.past[1]))

    def _draw(self) -> None:
        for run, generator in enumerate(self.drawn):
            self.due[run] = generator.integers(0, self.most, endpoint=True)


def _begun(element: Element, dt: float, generators: Sequence[np.random.Generator]) -> Act:
    """Return the function of an element for these runs; refuse one that cannot be called."""
    why = why_not_called(element.begin, dt, generators)
    if why:
        raise ModelError(
            f"begin of {short(element)} cannot be called with the time between two samples and a "
            f"generator for each run: {why}. Write def begin(self, dt, generators): ..."
        )
    act = element.begin(dt, generators)
    why = why_not_called(act, np.zeros(len(generators)))
    if why:
        raise ModelError(
            f"begin of {short(element)} returned {short(act)}, which cannot be called with the "
            f"values (runs,) of a sample: {why}. Return a function: lambda values: ..."
        )
    return act


def _acted(act: Act, values: FloatArray) -> FloatArray:
    """Return the result of an element for the values (runs,)."""
    found = np.asarray(act(values.copy()))
    if found.shape != values.shape or found.dtype.kind not in "fiu":
        raise ModelError(
            f"an element returned {short(found)} for {len(values)} runs. Return one real number "
            "for each run: element.begin(dt, generators)(values) is (runs,)."
        )
    if np.any(np.isnan(found)) and not np.any(np.isnan(values)):
        raise ModelError(
            f"an element returned {short(found)} for {short(values)}. Correct the element."
        )
    return found


class Answering:
    """Forces that react to motions in every finer sample: the elements on channels of w."""

    def __init__(self, plant: StandardPlant, elements: Mapping[str, list[Acts]], dt: float) -> None:
        self.dt, self.parts = dt, []
        for name, element in elements.items():
            i = plant.w.index(name)
            for one in element:
                reads = getattr(one, "reads", None)
                if not isinstance(one, Element) or reads is None:
                    raise ModelError(
                        f"{name!r} is a disturbance, but {short(one)} does not name the channel of "
                        "y to which it reacts as `reads`. Use simulation.Friction, or an element "
                        "with `reads`; limits act on sensors and actuators."
                    )
                require_known("channel that an element reads", [reads], plant.y, "the plant's y")
                if np.any(plant.D21[:, i]):
                    raise ModelError(
                        f"{name!r} reaches a sensor within the sample, before an element could "
                        "react to its motion. Give the accelerometer dynamics that roll off."
                    )
                self.parts.append((i, plant.y.index(reads), one, plant.B1[:, i].copy()))

    def begin(self, generators: Sequence[np.random.Generator]) -> None:
        """Start again with a number of runs."""
        own = [one.spawn(len(self.parts)) for one in generators]
        self.acts = [
            _begun(part[2], self.dt, [each[j] for each in own]) for j, part in enumerate(self.parts)
        ]

    def push(self, motion: FloatArray, following: FloatArray, w: FloatArray) -> None:
        """Add the forces at motions (runs, ny) to w (runs, nw), and their effect to the states."""
        for act, (i, row, _, column) in zip(self.acts, self.parts, strict=True):
            force = _acted(act, motion[:, row])
            w[:, i] += force
            following += force[:, None] * column


def split_elements(
    elements: Any, plant: StandardPlant, driven: Sequence[str]
) -> list[dict[str, list[Acts]]]:
    """Return the elements on sensors, on actuators and on disturbances, by channel."""
    if elements is None:
        return [{}, {}, {}]
    instance(
        elements, Mapping, "elements", "Name the channel: {'u1': simulation.Saturation(10.0)}."
    )
    forces = [name for name in plant.w if name not in plant.y and not name.endswith(":noise")]
    sides = (plant.y, list(driven), forces)
    require_known("channel for an element", elements, [*plant.y, *driven, *forces])
    listed = {name: _checked_elements(name, element) for name, element in elements.items()}
    return [{n: e for n, e in listed.items() if n in side} for side in sides]


def _checked_elements(name: str, element: Any) -> list[Acts]:
    listed = list(element) if isinstance(element, list | tuple) else [element]
    known = (Saturation, Quantiser, Jitter)
    kinds = [type(one) for one in listed if isinstance(one, known)]
    own = [isinstance(one, Element) and not isinstance(one, type) for one in listed]
    if not listed or len(kinds) + sum(own) < len(listed):
        raise ModelError(
            f"the element on {name!r} must be a Saturation, Quantiser, Hysteresis, Dropout, Jitter "
            f"or Friction or have begin(dt, generators), got {short(element)}. Pass one, or a list."
        )
    if len(set(kinds)) < len(kinds):
        raise ModelError(f"{name!r} has two elements of one kind: give only one.")
    return listed


#: number of derivatives of a move whose forces count: position (springs), velocity, acceleration
_TERMS = 3


def warn_beyond_ranges(
    plant: StandardPlant, signals: Mapping[str, Any], elements: Mapping[str, Any], time: FloatArray
) -> None:
    """Warn of a `Saturation` that moves of references exceed, with the required values.

    Values and rates of forces and readings are those of the plant near rest that follows the moves
    exactly, without the forces that react to disturbances. References without a set-point profile
    count as at rest.
    """
    limits = {name: one for name, given in elements.items() if (one := _limit(given)) is not None}
    moves = {name: move for name, move in signals.items() if isinstance(move, SetPointProfile)}
    if not limits or not moves or not plant.ports.followed:
        return
    for name, needed in _needed(plant, moves, list(limits), time).items():
        limit, unit, driven = limits[name], plant.units.get(name, ""), name in plant.u
        least = -limit.limit if limit.least is None else limit.least
        low, high = float(needed.min(initial=0.0)), float(needed.max(initial=0.0))
        who = f"the move of {', '.join(moves)} needs"
        if low < least * (1.0 + NEGLIGIBLE) or high > limit.limit * (1.0 + NEGLIGIBLE):
            advice = (
                "Lower the acceleration of the move (its stroke, where springs are pushed), or "
                "choose a stronger actuator"
                if driven
                else "Shorten the move, or choose a longer range"
            )
            warn(
                f"{who} {low:.4g} to {high:.4g} {unit} of {name!r}, whose range is {least:.4g} to "
                f"{limit.limit:.4g} {unit}. {advice}."
            )
        fastest = float(np.max(np.abs(np.diff(needed) / np.diff(time)), initial=0.0))
        if limit.rate is not None and fastest > limit.rate * (1.0 + NEGLIGIBLE):
            advice = (
                "Lower the jerk of the move (its velocity, where springs are pushed), or choose a "
                "faster amplifier"
                if driven
                else "Lower the velocity of the move"
            )
            warn(
                f"{who} {name!r} to change by {fastest:.4g} {unit}/s, and its rate is "
                f"{limit.rate:.4g} {unit}/s. {advice}."
            )


def _limit(given: Any) -> Saturation | None:
    """Return the Saturation among the elements of a channel."""
    listed = given if several(given) else [given]
    return next((one for one in listed if isinstance(one, Saturation)), None)


def _needed(
    plant: StandardPlant, moves: Mapping[str, SetPointProfile], names: list[str], time: FloatArray
) -> dict[str, FloatArray]:
    """Return actuator forces and sensor readings over time, by name, during moves."""
    found = {name: moves[name].at(time).position for name in names if name in moves}
    try:
        driven = driven_axes(plant, freq=resting_frequency(plant))
    except AssumptionError:  # the plant has no inverse, which the design reports
        return found
    followed = {
        p.derived(axis, "ref"): p.channel(axis) for p, axis in plant.assembled.ports.followed
    }
    if any(followed.get(name) not in driven.channels for name in moves):
        return found
    signals = np.zeros((len(driven.channels), _TERMS, time.size))
    for name, move in moves.items():
        signals[driven.channels.index(followed[name])] += np.array(move.at(time))[:_TERMS]
    g, T, axes, dt = plant.system, driven.T, driven.channels, plant.dt
    forced = [name for name in names if name in plant.u]
    if forced:

        def inverse(s: complex) -> ComplexArray:
            G = complex_gain(g, s, axes, plant.u) @ T
            return np.asarray(T @ solved(G, np.eye(len(axes), dtype=np.complex128), axes))

        gains = at_rest(inverse, dt, axes, _TERMS)
        forces = np.einsum("uam,amt->ut", gains, signals)
        found |= {name: forces[plant.u.index(name)] for name in forced}
    seen = [name for name in names if name in plant.y and name not in moves]
    if seen:
        places = followed_at_rest(g, T, plant.u, axes, seen, dt)[..., 0]
        found |= dict(zip(seen, places @ signals[:, 0], strict=True))
    return found

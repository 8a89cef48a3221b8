"""Feedforward: forces from the derivatives of a set-point, by the inverse of the plant."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np
import numpy.typing as npt

from ..arrays import (
    ComplexArray,
    FloatArray,
    IntArray,
    divisor,
    flag,
    instance,
    name_list,
    real_array,
    whole,
)
from ..errors import AssumptionError, ModelError, counted, only_one, require_known, warn
from ..loop import ClosedLoop, close_loop
from ..loop.blocks import force_name
from ..loop.broken import error_sensitivity, first_crossing
from ..lti.statespace import StateSpace
from ..plant import Poi, StandardPlant, driven_axes, standard_plant
from ..plant.axes import resting_frequency, states_at
from ..plant.inverse import OfS, SlowZeros, at_rest, slow_zeros, solved
from ..plant.port import DERIVATIVES, TERMS
from ..store import Value
from ..tolerances import SAME
from .motion import SetPointProfile
from .nonlinear_elements import Acts, split_elements, warn_beyond_ranges

#: number of frequency lines of the least squares, and lowest line relative to the bandwidth of the
#: loop, or to one over the duration of the move
_LINES, _SLOWEST = 200, 1e-2
#: frequency relative to the bandwidth above which a set-point has less weight if no move is given:
#: as for a move of about three times one over the bandwidth
_FASTEST = 0.4
#: number of samples of a move in continuous time
_STEPS = 2000
#: relative error after feedforward above which a warning is given
_LEFT = 0.2


@dataclass(frozen=True, eq=False, repr=False)
class Feedforward(Value):
    """Forces that follow from a set-point and its derivatives; a block for `close_loop`.

    The forces are ``u = T sum_m gains[m] d^m r / dt^m``, with the set-point r. The matrix T
    distributes the total force of each axis to the actuators. If the plant has slow zeros, the
    outputs of filters that invert them (`zeros`) are added. `design_feedforward` makes this object.

    Parameters
    ----------
    reference : str
        Channel of the set-point r.
    axes : sequence of str
        Channels of the r axes of POIs (points of interest) that the forces move.
    T : (nu, r) array
        Distribution of the forces of axes to actuators. The magnitudes in a column add up to one.
    actuators : sequence of str
        Names of the actuators.
    gains : (p, r, 5) array
        Gains of position, velocity, acceleration, jerk and snap for each axis. The first index is
        the place of the POI; p is 1 if the gains do not depend on it.
    dt : float [s]
        Sampling time of the plant.
    zeros : SlowZeros, optional
        Filters that invert slow zeros of the plant. Their input is the highest derivative, and
        their output is zero at rest. A zero is slow if its time constant is as long as a move. A
        frame on isolators causes such zeros.
    """

    reference: str
    axes: tuple[str, ...]
    T: FloatArray
    actuators: tuple[str, ...]
    gains: FloatArray
    dt: float
    zeros: SlowZeros | None = None

    def __repr__(self) -> str:
        places = f", {counted(len(self.gains), 'place')}" if len(self.gains) > 1 else ""
        driven = counted(len(self.actuators), "actuator")
        lines = [f"<Feedforward {self.reference} to {driven}{places}>"]
        for axis, row in zip(self.axes, self.gains[0], strict=True):
            shown = "  ".join(f"{t} {g:.4g}" for t, g in zip(TERMS, row, strict=True) if g)
            lines.append(f"  {axis}: {shown or 'nothing'}")
        if self.zeros is not None:
            slow = ", ".join(f"{f:.4g}" for f in self.zeros.freq)
            lines.append(f"  and the inverse of zeros at {slow} Hz")
        return "\n".join(lines)

    @property
    def system(self) -> StateSpace:
        """The block from the set-point and its derivatives to the actuators.

        Without slow zeros it is static. With them it has two states for each slow zero.

        Raises
        ------
        ModelError
            When the gains depend on the place; use `forces` in this case.
        """
        if len(self.gains) != 1:
            raise ModelError(
                f"gains that depend on the place ({len(self.gains)} of them) do not form a "
                "constant block: close the loop with simulation.known_forces(plant) and pass "
                "forces(move, time) to "
                "simulate as references."
            )
        used = [m for m in range(5) if np.any(self.gains[0, :, m])] or [self._highest]
        names = [self.reference if m == 0 else f"{self.reference}:{TERMS[m]}" for m in used]
        named: dict[str, Any] = {"inputs": names, "outputs": self.actuators, "name": "feedforward"}
        D = self.T @ self.gains[0][:, used]
        if self.zeros is None:
            return StateSpace([], [], [], D, self.dt, **named)
        A, B, C, direct = self.zeros.filters(used[-1])
        D[:, -1:] += self.T @ direct
        B = np.hstack([np.zeros((len(B), len(used) - 1)), B])
        return StateSpace(A, B, self.T @ C, D, self.dt, **named)

    @property
    def _highest(self) -> int:
        """The order of the highest derivative with a gain, which drives the filters."""
        return max((m for m in range(5) if np.any(self.gains[:, :, m])), default=2)

    def up_to(self, term: str) -> Feedforward:
        """Return the feedforward without derivatives above `term`, such as "acceleration"."""
        gains = self.gains.copy()
        gains[:, :, term_numbers(term)[0] + 1 :] = 0.0
        return self.replace(gains=gains)

    def forces(self, move: SetPointProfile, time: npt.ArrayLike) -> dict[str, FloatArray]:
        """Return the force of each actuator (n_time,) for a set-point `move` at times [s].

        The names are those of the channels of `known_forces`, such as `u1:feedforward`. If the
        gains depend on the place, the number of times must equal the number of places. The
        set-point must have at least the order of the highest derivative with a gain. With filters
        of slow zeros, the output depends on earlier times. The times must then be the samples of
        the plant, and the first ones must be at rest.
        """
        _check_order(move, self._highest)
        t = real_array(time, "time", (None,) if len(self.gains) == 1 else (len(self.gains),))
        signals = np.array(move.at(t))
        gains = np.broadcast_to(self.gains, (t.size, *self.gains.shape[1:]))
        u = np.einsum("tam,mt->ta", gains, signals)
        if self.zeros is not None:
            u = u + self.zeros.run(signals[self._highest], t, self._highest)
        u = u @ self.T.T
        return {force_name(name): u[:, i] for i, name in enumerate(self.actuators)}


def design_feedforward(
    given: StandardPlant | ClosedLoop,
    move: SetPointProfile | None = None,
    *,
    reference: str | None = None,
    order: int = 4,
    along: npt.ArrayLike | None = None,
    elements: Mapping[str, Acts | Sequence[Acts]] | None = None,
    slow_zeros: bool = True,
) -> Feedforward:
    """Return the feedforward of a plant or a loop, with gains for the derivatives of a set-point.

    For a plant the feedforward is its inverse at low frequency, as a power series. P is the
    response of the axes to forces along them, with a matrix T that distributes these forces to the
    actuators. It includes the hold and all delays and filters of sensors and actuators. The gains
    are the coefficients of ``P(s)^-1 = k_0 + k_1 s + k_2 s^2 + ...``. For a free machine k_2 is the
    mass and k_3 the mass times the delay. k_4 contains half the square of the delay, and the
    negative compliance of the flexible modes between actuators and POI (point of interest). For a
    machine on springs k_0 and k_1 are stiffness and damping. The coefficients are Cauchy integrals
    on a circle around zero. The circle is as large as possible. On it and on a smaller circle the
    integrals must agree, and inside it the series must equal the inverse. Zeros of P lie outside of
    it.

    If the frame of a machine stands on isolators, P has zeros at low frequency. Above their
    frequency, the power series is wrong. If the plant is sampled, its stable zeros below a
    hundredth of the rate are therefore inverted exactly by filters (`zeros`). The input of these
    filters is the highest derivative, and their output is zero at rest. A warning names unstable
    slow zeros. The output of filters depends on the past. They are therefore not combined with
    gains that vary along places (`along`).

    All axes that the actuators move independently (`flexplant.plant.driven_axes`) are treated
    together. The feedforward includes the forces that keep the axes without a reference at rest.

    For a loop the gains minimise the error ``G_u F + G_r - 1`` of the loop by least squares. F is
    the feedforward, and G_u and G_r are the closed-loop responses of the POI to forces and to the
    reference. The inverse of P is not used here, because the feedback opposes it if sensors and POI
    move differently. Poles of the controller and zeros of P that are as slow as the moves are
    allowed. The errors are weighted with the spectrum of the move. If no move is given, the
    spectrum is that of a move with a duration of about ``3 / bandwidth`` of the loop. The
    feedforward then has no force at rest if the plant needs no force to stay at a position. With a
    lower `order`, the gains are the best ones of that order.

    Parameters
    ----------
    given : StandardPlant or ClosedLoop
        Plant that was assembled from a structure, or a closed loop around a model, without
        feedforward. The plant is sampled if the feedforward is for a sampled loop.
    move : SetPointProfile, optional
        Move for which the errors of a loop are minimised. Its order limits the order of the gains.
    reference : str, optional
        Channel of the reference; by default the only one of the plant.
    order : int
        Order of the highest derivative: 2 (acceleration), 3 (jerk) or 4 (snap).
    along : (p, 3) array [m], optional
        Places of a POI that moves (`simulate(moving=)`). Gains are computed for each place.
    elements : mapping {name: element, or a list of some}, optional
        Elements of actuators and sensors, as for `simulate`. If the move exceeds a `Saturation`, a
        warning gives its name and the required value. The gains do not depend on the elements.
    slow_zeros : bool
        Whether filters invert stable slow zeros. In trials, the isolators of the machine differed
        from the model by 3 % in frequency or by a factor of 2 in damping. In 93 % of 448 trials the
        peak error was smaller than with gains alone. In the other trials it was below 0.3 % of the
        error without feedforward. If the frame modes of `testbeds.gantry` are off by 0, 0.3, 1, 3
        or 10 %, the largest peak error of its axes is 0.3, 0.3, 0.7, 2.3 or 7.6 % of that without
        feedforward, with gains alone 10 to 13 %.

    Returns
    -------
    Feedforward
        Feedforward. Its `system` is a block for `close_loop`. The reference of that loop must be a
        SetPoint.

    Raises
    ------
    LabelError
        When it is not clear which reference is meant.
    AssumptionError
        When the actuators cannot move the axes of the POI independently.
    ModelError
        When the plant was not assembled from a structure or is weighted, the order is not 2 to 4, a
        move is given without a loop, or elements are given without a move.

    Warns
    -----
    FlexplantWarning
        When the remaining error of the loop is a fifth or more of the error without feedforward, a
        move exceeds a Saturation, or the inverse of a plant has a slow unstable pole.

    References
    ----------
    [Boerlage2004]_.

    Examples
    --------
    >>> import flexplant as fx
    >>> forward = fx.design_feedforward(fx.testbeds.three_masses())
    >>> forward.gains.shape
    (1, 1, 5)
    >>> forward.up_to("jerk")
    <Feedforward die:ref to 1 actuator>
      die:x: acceleration 3  jerk 0.00225
    """
    loop = given if isinstance(given, ClosedLoop) else None
    plant, poi, axis, name = tracked(given if loop is None else loop.machine, reference)
    highest = whole(order, "order", minimum=2, maximum=4)
    axes = _Tracking.of(plant, poi, poi.channel(axis), name)
    if move is not None:
        instance(move, SetPointProfile, "move", "Use setpoint(...) or scan(...).")
        if loop is None:
            raise ModelError("a move needs a ClosedLoop: pass design_feedforward(loop, move=move).")
        split_elements(elements, plant, plant.u)  # refuses unknown channels
        warn_beyond_ranges(plant, {name: move}, elements or {}, _times(move, plant.dt))
    elif elements is not None:
        raise ModelError("elements are compared with a move: pass design_feedforward(loop, "
                         "move=move, elements=...).")  # fmt: skip
    closed = loop is not None and bool(loop.blocks or move is not None)
    inverted = flag(slow_zeros, "slow_zeros") and along is None
    zeros = axes.slow_zeros(plant, closed) if inverted else None
    gains = at_rest(axes.inverse(_forced(plant, ()), along, zeros), plant.dt, axes.axes)
    if loop is not None and closed:
        last = highest if move is None else min(highest, move.order)
        # a force proportional to the position would remain after the move of a free machine
        first = 0 if move is not None or np.any(gains[..., 0]) else 1
        orders = np.arange(first, last + 1)
        fastest = 0.0 if zeros is None else float(zeros.freq[-1])
        freq, size = _moved_size(loop, name, poi.derived(axis, "error"), move, fastest)
        moved = axes.moved(_forced(plant, loop.blocks), along)
        gains = np.zeros_like(gains)
        gains[:, :, orders], zeros = _least(moved, freq, size, axes.wanted, orders, zeros)
    gains[:, :, highest + 1 :] = 0.0
    return Feedforward(name, axes.axes, axes.T, tuple(plant.u), gains, plant.dt, zeros)


def known_forces(plant: StandardPlant) -> StateSpace:
    """Return the block through which forces that are known in advance reach the actuators.

    Its inputs are `u1:feedforward` and so on. They become references of the loop, for which
    `simulate` needs arrays of forces.

    Parameters
    ----------
    plant : StandardPlant
        Plant with the actuators.

    Raises
    ------
    ModelError
        When `plant` is not a plant.

    Examples
    --------
    >>> import flexplant as fx
    >>> fx.simulation.known_forces(fx.testbeds.three_masses()).outputs
    ('u1',)
    """
    plant = standard_plant(plant)
    names = [force_name(name) for name in plant.u]
    return StateSpace(
        [], [], [], np.eye(len(names)), plant.dt, inputs=names, outputs=plant.u, name="forces"
    )


def tracked(plant: Any, reference: str | None) -> tuple[StandardPlant, Poi, str, str]:
    """Return the plant, the POI and the axis that a reference is for, and its channel."""
    plant = standard_plant(plant)
    found = {p.derived(axis, "ref"): (p, axis) for p, axis in plant.assembled.ports.followed}
    reference = only_one("reference", found, reference, "reference=")
    return plant, *found[reference], reference


def force_axes(plant: StandardPlant) -> tuple[tuple[str, ...], FloatArray]:
    """Return the axes that the actuators move, and T (nu, r): total forces to actuators."""
    driven = driven_axes(plant, freq=resting_frequency(plant))
    return driven.channels, driven.T / np.abs(driven.T).sum(axis=0)


def _forced(plant: StandardPlant, blocks: Sequence[Any]) -> ClosedLoop:
    """Return the loop of some blocks with forces that are known."""
    return close_loop(plant.replace(evaluation=None), *blocks, known_forces(plant))


class _Tracking(NamedTuple):
    """The axes that forces move: one follows a reference, the others are at rest."""

    poi: Poi
    axes: tuple[str, ...]
    T: FloatArray
    wanted: FloatArray
    name: str

    @classmethod
    def of(cls, plant: StandardPlant, poi: Poi, channel: str, name: str) -> _Tracking:
        """Return the axes of a plant, of which one follows a reference."""
        axes, T = force_axes(plant)
        if channel not in axes:
            raise AssumptionError(
                f"the actuators do not move {channel} independently of other POIs: they move "
                f"{', '.join(axes)}. Leave other POIs out of the ports, or add actuators."
            )
        return cls(poi, axes, T, np.array([[float(one == channel)] for one in axes]), name)

    def moved(self, forced: ClosedLoop, along: npt.ArrayLike | None) -> OfS:
        """Return the function of s that gives [G_u, G_r] (p, r, r + 1) of a loop at p places."""
        # a place changes only outputs that the feedback does not read
        g, plant, poi, axes = forced.monitored, forced.machine, self.poi, self.axes
        r = self.T.shape[1]
        # the reference, and its derivatives that the blocks read
        signals = [self.name, *(f"{self.name}:{term}" for term in DERIVATIVES)]
        orders = [m for m, name in enumerate(signals) if name in plant.w]
        acts = np.zeros((len(plant.w), r + len(orders)))
        acts[g.input_index([force_name(u) for u in plant.u]), :r] = self.T
        acts[g.input_index([signals[m] for m in orders]), r + np.arange(len(orders))] = 1.0
        rows = g.output_index(list(axes))
        C, D = g.C[rows][None], (g.D[rows] @ acts)[None]
        if along is not None:
            places = plant.along(poi.name, real_array(along, "along", (None, 3)))
            there = {poi.channel(axis): i for i, axis in enumerate(poi.axes)}
            own = [there[one] for one in axes if one in there]
            at = [i for i, one in enumerate(axes) if one in there]
            u = g.output_index(forced.driven)
            by_u = places.D[:, own][:, :, plant.system.input_index(forced.driven)]
            C = np.repeat(C, len(places.D), axis=0)
            D = np.repeat(D, len(places.D), axis=0)
            C[:, at] = by_u @ g.C[u]
            C[:, at, : plant.system.n_states] += places.C[:, own]
            direct = places.D[:, own][:, :, plant.system.input_index(plant.w)]
            D[:, at] = (direct + by_u @ g.D[u]) @ acts

        def found(s: complex) -> ComplexArray:
            both = C @ states_at(g, g.B @ acts, s) + D
            led = both[..., r:] @ s ** np.array(orders)[:, None]
            return np.concatenate([both[..., :r], led], axis=-1)

        return found

    def slow_zeros(self, plant: StandardPlant, closed: bool) -> SlowZeros | None:
        """Return the slow zeros that the forces invert; warn of unstable ones without a loop."""
        found, unstable = slow_zeros(plant, self.T, self.axes, self.wanted)
        if unstable.size and not closed:
            listed = ", ".join(f"{f:.4g}" for f in unstable)
            warn(
                f"the inverse of the plant for {self.name} has unstable poles at {listed} Hz, so "
                "that forces of derivatives follow moves well below these frequencies only. Use "
                "simulation.inverse_forces, which acts ahead of the set-point, or put sensors, "
                "POI and actuators closer together."
            )
        return found

    def inverse(
        self, forced: ClosedLoop, along: npt.ArrayLike | None, zeros: SlowZeros | None
    ) -> OfS:
        """Return the function of s of F (p, r) of a loop at p places, less its slow zeros."""
        moved = self.moved(forced, along)

        def found(s: complex) -> ComplexArray:
            both = moved(s)
            F = solved(both[:, :, :-1], self.wanted - both[:, :, -1:], self.axes)[..., 0]
            return F if zeros is None else F - zeros.at(s)

        return found


def _times(move: SetPointProfile, dt: float) -> FloatArray:
    """Return the times [s] of a move, in samples or in as many steps as resolve its snap."""
    step = dt or move.duration / _STEPS
    return np.asarray(np.arange(np.ceil(move.duration / step) + 1.0) * step)


def _moved_size(
    loop: ClosedLoop, name: str, error: str, move: SetPointProfile | None, zero: float
) -> tuple[FloatArray, FloatArray]:
    """Return frequencies [Hz] and the size of a reference there, of a move or one for the loop.

    The frequencies go beyond the fastest slow zero [Hz]: below a zero its residue is not known.
    """
    dt = loop.machine.dt
    if move is None:
        grid, sensitivity = error_sensitivity(loop, name, error)
        top = min(first_crossing(grid, sensitivity, None), float(grid[-1]))
        freq = np.geomspace(_SLOWEST * top, max(top, zero / _FASTEST), _LINES)
        return freq, 1.0 / freq / (1.0 + (freq / (_FASTEST * top)) ** 2) ** 2
    time = _times(move, dt)
    freq = np.geomspace(_SLOWEST / move.duration, 0.499 / (time[1] - time[0]), _LINES)
    turns = np.exp(-2j * np.pi * freq[:, None] * time)
    return freq, np.abs(turns @ move.at(time).acceleration) / freq**2


def _least(
    moved: OfS,
    freq: FloatArray,
    size: FloatArray,
    wanted: FloatArray,
    orders: IntArray,
    zeros: SlowZeros | None,
) -> tuple[FloatArray, SlowZeros | None]:
    """Return gains (p, r, orders) and slow zeros of the least errors of a loop, by frequency."""
    s: ComplexArray = np.asarray(2j * np.pi * freq)
    weight = size * np.sqrt(freq)  # of equal ratios of frequencies
    both = np.array([moved(complex(one)) for one in s]) * weight[:, None, None, None]
    powers = s[:, None] ** orders
    if zeros is not None:
        powers = np.hstack([powers, zeros.responses(s, int(orders[-1]))])
    found = []
    for p in range(both.shape[1]):
        effects = np.einsum("fij,fm->fijm", both[:, p, :, :-1], powers)
        error = both[:, p, :, -1] - weight[:, None] * wanted[:, 0]
        matrix = effects.reshape(error.size, -1)
        rows, given = (np.concatenate([x.real, x.imag]) for x in (matrix, error.ravel()))
        unit = divisor(np.linalg.norm(rows, axis=0))
        gains = np.linalg.lstsq(rows / unit, -given, rcond=SAME)[0]
        left = float(np.linalg.norm(given + rows / unit @ gains) / divisor(np.linalg.norm(given)))
        if left > _LEFT:
            warn(
                f"this feedforward leaves {100 * left:.2g} % of the loop's errors: the feedback "
                "opposes the move, because the machine bends between sensors and POI, or zeros of "
                "the plant are about as slow as the move. Close a loop of reference errors with "
                "reference_errors(plant, order=4), make a slower move (move=...), lower the "
                "bandwidth, or use simulation.inverse_forces."
            )
        found.append((gains / unit).reshape(wanted.shape[0], -1))
    gains = np.array(found)
    if zeros is not None:
        real, imag = np.split(gains[0, :, orders.size :], 2, axis=1)
        zeros = zeros.replace(residues=real + 1j * imag)
    return gains[:, :, : orders.size], zeros


def term_numbers(terms: Any) -> list[int]:
    """Return the orders of derivatives that are named."""
    listed = name_list(terms, "terms")
    if not listed:
        raise ModelError(f"terms names no derivative to feed forward. Choose from {list(TERMS)}.")
    require_known("term", listed, TERMS)
    return [TERMS.index(term) for term in listed]


def _check_order(move: Any, highest: int) -> None:
    instance(move, SetPointProfile, "move", "Use setpoint(...) or scan(...).")
    if move.order < highest:
        raise ModelError(
            f"the feedforward uses the {TERMS[highest]}, but {move!r} is of order {move.order}, "
            f"so that its {TERMS[highest]} is impulses. Give the set-point a bound on "
            f"{TERMS[highest]}, or use feedforward.up_to({TERMS[move.order]!r})."
        )

"""Feedforward: forces from the derivatives of a set-point, by the inverse of the plant."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import numpy.typing as npt

from ..arrays import ComplexArray, FloatArray, positive, real_array, whole
from ..errors import AssumptionError, LabelError, ModelError, counted, only_one, short
from ..loop import ClosedLoop, close_loop
from ..loop.blocks import DERIVATIVES, force_name
from ..lti.statespace import StateSpace
from ..plant import Poi, StandardPlant, driven_axes, standard_plant
from ..plant.axes import resting_frequency
from ..plant.rest_expansion import OfS, at_rest, solved
from ..store import Value
from ..tolerances import divisor
from ..words import instance, name_list
from .force_warnings import warn_beyond_ranges
from .motion import SetPointProfile
from .nonlinear_elements import Acts, split_elements
from .response import Response
from .sampled_runs import simulate

#: how long a loop is watched after the beginning of a move, relative to it, for gains of the move
_AFTER = 1.5
#: relative: combinations of gains that change the errors less are left out
_RESOLVED = 1e-8
#: what a set-point gives, by the order of the derivative
TERMS = ("position", *DERIVATIVES)


@dataclass(frozen=True, eq=False, repr=False)
class Feedforward(Value):
    """Forces proportional to a set-point and its derivatives; a block for `close_loop`.

    ``u = T sum_m gains[m] d^m r / dt^m``, T from a total force of each axis to the actuators. Made
    by `design_feedforward`.

    Parameters
    ----------
    reference : str
        The channel of the set-point r.
    axes : sequence of str
        The r channels of POIs that the forces move.
    T : (nu, r) array
        Forces of axes to actuators: sizes of a column add to one.
    actuators : sequence of str
    gains : (p, r, 5) array
        On position, velocity, acceleration, jerk and snap; one row, or one for each of p places.
    dt : float [s]
        Sampling time of the plant.
    """

    reference: str
    axes: tuple[str, ...]
    T: FloatArray
    actuators: tuple[str, ...]
    gains: FloatArray
    dt: float

    def __repr__(self) -> str:
        places = f", {counted(len(self.gains), 'place')}" if len(self.gains) > 1 else ""
        driven = counted(len(self.actuators), "actuator")
        lines = [f"<Feedforward {self.reference} to {driven}{places}>"]
        for axis, row in zip(self.axes, self.gains[0], strict=True):
            shown = "  ".join(f"{t} {g:.4g}" for t, g in zip(TERMS, row, strict=True) if g)
            lines.append(f"  {axis}: {shown or 'nothing'}")
        return "\n".join(lines)

    @property
    def system(self) -> StateSpace:
        """The block: static, from the reference and its derivatives to the actuators.

        Raises
        ------
        ModelError
            When the gains depend on the place: then `forces` gives the signals.
        """
        if len(self.gains) != 1:
            raise ModelError(
                f"gains that depend on the place ({len(self.gains)} of them) are no constant "
                "block: close the loop with simulation.known_forces(plant) and pass "
                "forces(move, time) to "
                "simulate as references."
            )
        used = [m for m in range(5) if np.any(self.gains[0, :, m])] or [2]
        names = [self.reference if m == 0 else f"{self.reference}:{TERMS[m]}" for m in used]
        D = self.T @ self.gains[0][:, used]
        return StateSpace(
            [], [], [], D, self.dt, inputs=names, outputs=self.actuators, name="feedforward"
        )

    def up_to(self, term: str) -> Feedforward:
        """Return the feedforward without the derivatives above position, velocity, ... or snap."""
        gains = self.gains.copy()
        gains[:, :, _term_index(term) + 1 :] = 0.0
        return self.replace(gains=gains)

    def forces(self, move: SetPointProfile, time: npt.ArrayLike) -> dict[str, FloatArray]:
        """Return the force of each actuator at times (n_time,) [s], named for `known_forces`.

        As many times as places where the gains depend on the place. A set-point of an order below
        that of the highest gain is refused.
        """
        _check_order(move, self.gains)
        t = real_array(time, "time", (None,) if len(self.gains) == 1 else (len(self.gains),))
        signals = np.array(move.at(t))
        gains = np.broadcast_to(self.gains, (t.size, *self.gains.shape[1:]))
        u = np.einsum("tam,mt->ta", gains, signals) @ self.T.T
        return {force_name(name): u[:, i] for i, name in enumerate(self.actuators)}


def design_feedforward(
    given: StandardPlant | ClosedLoop,
    *,
    reference: str | None = None,
    order: int = 4,
    move: SetPointProfile | None = None,
    along: npt.ArrayLike | None = None,
    elements: Mapping[str, Acts | Sequence[Acts]] | None = None,
) -> Feedforward:
    """Return the feedforward of a plant or a loop: its inverse at low frequency, term by term.

    With P the response of the axes to forces T along them (the hold, all delays, sensors' and
    actuators' filters in it), ``P(s)^-1 = k_0 + k_1 s + k_2 s^2 + ...``: of a free machine k_2 is
    the mass, k_3 the mass times the delay, and k_4 holds half the square of the delay and,
    negative, the compliance of the flexible modes between actuators and POI; on springs k_0 and k_1
    are their stiffness and damping. In a loop ``G_u F + G_r = 1`` is solved for F instead, G_u and
    G_r the responses of the POI to forces and reference in closed loop: where sensors and POI do
    not move alike, the feedback would oppose the inverse of P. The coefficients are Cauchy's
    integrals on a circle around rest, the largest on which two radii agree and within which the
    expansion is the inverse itself: a zero of P (a mass on a spring beside the POI) is left
    outside. All axes that the actuators move apart (`flexplant.plant.driven_axes`, next to rest)
    are taken together: the forces that keep the axes without a reference at rest are in it.

    With a move the gains are those of least squares of the errors of a loop in that move instead,
    which also serves where zeros of P are as slow as the move.

    Parameters
    ----------
    given : StandardPlant or ClosedLoop
        Assembled from a structure; sampled, for a sampled loop. Of a loop, that without
        feedforward, on a model.
    reference : str, optional
        The reference's channel; the plant's only one when not given.
    order : int
        Highest derivative, 2 to 4: acceleration, jerk, snap.
    move : SetPointProfile, optional
        The move in which a loop is to have the least errors.
    along : (p, 3) array [m], optional
        Places of the POI: gains for each of them, for a POI that moves (`simulate(moving=)`).
    elements : mapping {name: element, or a list of some}, optional
        Of actuators and sensors, as for `simulate`: a `Saturation` that the move exceeds is warned
        of, with what the move needs. The gains do not depend on it.

    Returns
    -------
    Feedforward
        Its `system` is a block for `close_loop`; the loop's reference must then be a SetPoint.

    Raises
    ------
    LabelError
        When it is not clear which reference is meant.
    AssumptionError
        When the actuators cannot move the POI's axes apart from each other.
    ModelError
        When the plant was not assembled from a structure or is weighted, or the order is not 2 to
        4; when a move is given without a loop, or with places, or elements without a move.

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
    driven, T = force_axes(plant)
    wanted = np.array([[1.0 if one == poi.channel(axis) else 0.0] for one in driven])
    if not np.any(wanted):
        raise AssumptionError(
            f"the actuators do not move {poi.channel(axis)} apart from other POIs: they move "
            f"{', '.join(driven)}. Leave other POIs out of the ports, or add actuators."
        )
    empty = Feedforward(name, driven, T, tuple(plant.u), np.zeros((1, len(driven), 5)), plant.dt)
    if elements is not None and move is None:
        raise ModelError("elements are compared with a move: pass design_feedforward(loop, "
                         "move=move, elements=...).")  # fmt: skip
    if move is not None:
        if loop is None or along is not None:
            raise ModelError("a move needs a ClosedLoop, without along=: pass design_feedforward"
                             "(loop, move=move).")  # fmt: skip
        split_elements(elements, plant, plant.u)  # refuses unknown channels
        found = _of_move(empty, loop, move, highest)
        time = np.arange(np.ceil(move.duration / plant.dt) + 1.0) * plant.dt
        warn_beyond_ranges(plant, {name: move}, elements or {}, time)
        return found
    blocks = () if loop is None else loop.blocks
    forced = close_loop(plant.replace(evaluation=None), *blocks, known_forces(plant))
    find = _inverse_of(forced, poi, T, driven, wanted, name, along)
    gains = at_rest(find, plant.dt, driven)
    gains[:, :, highest + 1 :] = 0.0
    return empty.replace(gains=gains)


def known_forces(plant: StandardPlant) -> StateSpace:
    """Return the block that passes forces given to `simulate` on to the actuators.

    Its inputs are `u1:feedforward`, ...: references of the loop, given as arrays.

    Parameters
    ----------
    plant : StandardPlant
        Whose actuators they are.

    Raises
    ------
    ModelError
        When it is no plant.

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


def _inverse_of(
    forced: ClosedLoop,
    poi: Poi,
    T: FloatArray,
    axes: tuple[str, ...],
    wanted: FloatArray,
    name: str,
    along: npt.ArrayLike | None,
) -> OfS:
    """Return the function of s that gives F (p, r) in a loop with known forces, at p places."""
    # a place changes what is seen of the states and of u, which the feedback does not read
    g, plant = forced.monitored, forced.machine
    acts = np.zeros((len(plant.w), T.shape[1] + 1))
    acts[g.input_index([force_name(u) for u in plant.u]), :-1] = T
    acts[g.input_index([name]), -1] = 1.0
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
        both = C @ _states(g, g.B @ acts, s) + D
        return solved(both[:, :, :-1], wanted - both[:, :, -1:], axes)[..., 0]

    return found


def _of_move(
    empty: Feedforward, loop: ClosedLoop, move: SetPointProfile, highest: int
) -> Feedforward:
    """Return the gains by least squares of the errors of a loop in a move."""
    instance(move, SetPointProfile, "move", "Use setpoint(...) or scan(...).")
    duration, orders = _AFTER * move.duration, list(range(min(highest, move.order) + 1))
    plant = loop.machine.replace(evaluation=None)
    alone = close_loop(plant.replace(evaluation=None), *loop.blocks, idle=loop.idle)
    _, poi, axis, _ = tracked(plant, empty.reference)
    others = [one for one in empty.axes if one != poi.channel(axis)]
    channels = [poi.derived(axis, "error"), *others]
    given = {empty.reference: move}
    error = run_errors(simulate(alone, reference=given, duration=duration, noise=False), channels)
    effects = gain_effects(empty, loop, move, duration, orders, channels)
    unit = divisor(np.linalg.norm(effects, axis=1))
    found = np.linalg.lstsq((effects / unit[:, None]).T, -error, rcond=_RESOLVED)[0] / unit
    gains = empty.gains.copy()
    gains[0][:, orders] = found.reshape(len(empty.axes), len(orders))
    return empty.replace(gains=gains)


def gain_effects(
    start: Feedforward,
    loop: ClosedLoop,
    move: SetPointProfile,
    duration: float,
    orders: list[int],
    channels: list[str],
) -> FloatArray:
    """Return what a unit of each gain adds to the errors (n_gain, n_channel * n_time)."""
    plant = loop.machine.replace(evaluation=None)
    forced = close_loop(
        plant.replace(evaluation=None), *loop.blocks, known_forces(plant), idle=loop.idle
    )
    time = np.arange(round(positive(duration, "duration") / loop.machine.dt)) * loop.machine.dt
    signals = move.at(time)
    rows = []
    for axis in range(len(start.axes)):
        for order in orders:
            # of size one: a unit gain may make forces far larger than any that is meant
            size = float(np.max(np.abs(signals[order]))) or 1.0
            force = np.outer(start.T[:, axis], signals[order] / size)
            given = {force_name(u): force[i] for i, u in enumerate(start.actuators)}
            run = simulate(forced, reference=given, duration=duration, noise=False)
            rows.append(size * run_errors(run, channels))
    return np.array(rows)


def run_errors(run: object, channels: list[str]) -> FloatArray:
    """Return the errors one after the other; the mean over runs where there are several."""
    if not isinstance(run, Response) or any(name not in run for name in channels):
        raise ModelError(
            f"a trial must return a Response with {', '.join(channels)}, got {short(run)}. Return "
            "simulate(loop, reference=move, duration=...)."
        )
    signals = [run[name] for name in channels]
    return np.concatenate([s.mean(axis=0) if s.ndim == 2 else s for s in signals])


def _states(g: StateSpace, B: FloatArray, s: complex) -> ComplexArray:
    # next to z = 1 no digit of a slow pole is lost
    shift, eye = (np.expm1(s * g.dt) if g.dt else s), np.eye(g.n_states)
    pencil = shift * eye - (g.A - eye if g.dt else g.A)
    return np.asarray(np.linalg.solve(pencil, B.astype(np.complex128)))


def _term_index(term: Any) -> int:
    if not isinstance(term, str) or term not in TERMS:
        raise LabelError(f"a term is one of {', '.join(TERMS)}, got {short(term)}. Choose one.")
    return TERMS.index(term)


def term_numbers(terms: Any) -> list[int]:
    """Return the orders of derivatives that are named."""
    listed = name_list(terms, "terms")
    if not listed:
        raise ModelError(f"terms names no derivative to feed forward. Choose from {list(TERMS)}.")
    return [_term_index(term) for term in listed]


def _check_order(move: Any, gains: FloatArray) -> None:
    instance(move, SetPointProfile, "move", "Use setpoint(...) or scan(...).")
    highest = max((m for m in range(5) if np.any(gains[:, :, m])), default=0)
    if move.order < highest:
        raise ModelError(
            f"the feedforward uses the {TERMS[highest]}, but {move!r} is of order {move.order}, "
            f"so that its {TERMS[highest]} is impulses. Give the set-point a bound on "
            f"{TERMS[highest]}, or use feedforward.up_to({TERMS[move.order]!r})."
        )

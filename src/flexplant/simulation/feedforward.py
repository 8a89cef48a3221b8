"""Feedforward: forces from the derivatives of a set-point, by the inverse of the plant."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
import numpy.typing as npt

from ..errors import LabelError, ModelError, counted
from ..loop import ClosedLoop, close_loop
from ..loop.known import DERIVATIVES, force_name
from ..lti.statespace import StateSpace
from ..plant import Poi, StandardPlant, decouple, standard_plant
from ..values import ComplexArray, FloatArray, Value, instance, name_list, real_array, short, whole
from .inverse_series import Inverse, coefficients
from .motion import SetPoint

#: what a set-point gives, by the order of the derivative
TERMS = ("position", *DERIVATIVES)


@dataclass(frozen=True, eq=False, repr=False)
class Feedforward(Value):
    """Forces proportional to a set-point and its derivatives; a block for `close_loop`.

    ``u = T sum_m gains[m] d^m r / dt^m``, T from forces and moments of the POI's axes at the
    centre of gravity to the actuators. Made by `design_feedforward`.

    Parameters
    ----------
    reference : str
        The channel of the set-point r.
    axes : sequence of str
        The r axes of the forces.
    T : (nu, r) array
        Forces to actuators.
    actuators : sequence of str
        Their names.
    gains : (p, r, 5) array
        On position, velocity, acceleration, jerk and snap; one row, or one for each of p places.
    dt : float [s]
        Sampling time of the plant.

    Examples
    --------
    >>> import flexplant as fx
    >>> forward = fx.design_feedforward(fx.testbeds.three_masses())
    >>> forward.up_to("acceleration")  # the mass alone
    <Feedforward die:ref to 1 actuator>
      x: acceleration 3
    """

    reference: str
    axes: tuple[str, ...]
    T: FloatArray
    actuators: tuple[str, ...]
    gains: FloatArray
    dt: float

    def __post_init__(self) -> None:
        self._set(
            axes=tuple(self.axes), actuators=tuple(self.actuators), T=self.T, gains=self.gains
        )

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
                "block: close the loop with known_forces(plant) and pass forces(move, time) to "
                "simulate as references."
            )
        used = [m for m in range(5) if np.any(self.gains[0, :, m])] or [2]
        names = [self.reference if m == 0 else f"{self.reference}:{TERMS[m]}" for m in used]
        D = self.T @ self.gains[0][:, used]
        return StateSpace(
            [], [], [], D, self.dt, inputs=names, outputs=self.actuators, name="feedforward"
        )

    def up_to(self, term: str) -> Feedforward:
        """Return the feedforward without the derivatives above one.

        Parameters
        ----------
        term : str
            position, velocity, acceleration, jerk or snap.

        Raises
        ------
        LabelError
            When it is none of these.
        """
        gains = self.gains.copy()
        gains[:, :, _term(term) + 1 :] = 0.0
        return self.replace(gains=gains)

    def forces(self, move: SetPoint, time: npt.ArrayLike) -> dict[str, FloatArray]:
        """Return the force of each actuator over time, named for `known_forces`.

        Parameters
        ----------
        move : SetPoint
            The set-point.
        time : (n_time,) array [s]
            The samples; as many as places where the gains depend on the place.

        Raises
        ------
        ModelError
            When `move` is no SetPoint, or its order is below that of the highest gain.
        ShapeError
            When there are places for other times.
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
    along: npt.ArrayLike | None = None,
) -> Feedforward:
    """Return the feedforward of a plant or a loop: its inverse at low frequency, term by term.

    With P the response from forces at the centre of gravity to the POI (the hold, all delays,
    sensors' and actuators' filters in it), ``P(s)^-1 = k_0 + k_1 s + k_2 s^2 + ...``: of a free
    machine k_2 is the mass, k_3 the mass times the delay, and k_4 holds half the square of the
    delay and, negative, the compliance of the flexible modes between actuators and POI; on springs
    k_0 and k_1 are their stiffness and damping. In a loop ``G_u F + G_r = 1`` is solved for F
    instead, G_u and G_r the responses of the POI to forces and reference in closed loop: where
    sensors and POI do not move alike, the feedback would oppose the inverse of P. The
    coefficients are Cauchy's integrals on a circle, the largest on which they no longer depend on
    its radius. All axes of the POI are taken together: the forces that keep the axes without a
    reference at rest are in it.

    Parameters
    ----------
    given : StandardPlant or ClosedLoop
        Assembled from a structure; sampled, for a sampled loop. Of a loop, that without
        feedforward, on a model.
    reference : str, optional
        The reference's channel; the plant's only one when not given.
    order : int
        Highest derivative, 2 to 4: acceleration, jerk, snap.
    along : (p, 3) array [m], optional
        Places of the POI: gains for each of them, for a POI that moves (`simulate(moving=)`).

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
        When the plant was not assembled from a structure or is weighted, or the order is none.

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
      x: acceleration 3  jerk 0.00225
    """
    loop = given if isinstance(given, ClosedLoop) else None
    plant, poi, name = tracked(given if loop is None else loop.plant, reference)
    highest = whole(order, "order", minimum=2, maximum=4)
    T, axes = force_axes(plant, poi)
    find = _of_plant(plant, poi, T, along) if loop is None else _of_loop(loop, poi, T, name, along)
    gains = coefficients(find, plant.dt, axes)
    gains[:, :, highest + 1 :] = 0.0
    return Feedforward(name, axes, T, tuple(plant.u), gains, plant.dt)


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


def tracked(plant: Any, reference: str | None) -> tuple[StandardPlant, Poi, str]:
    """Return the plant, and the POI and channel of its reference."""
    plant = standard_plant(plant)
    if plant.is_weighted:
        raise ModelError("the plant is weighted: design the feedforward on plant.unweighted.")
    ports = plant.assembled.ports
    pois = {p.derived(p.axes[0], "ref"): p for p in (ports.poi(r.poi) for r in ports.references)}
    if reference is None and len(pois) == 1:
        reference = next(iter(pois))
    if not isinstance(reference, str) or reference not in pois:
        raise LabelError(
            f"need one of the plant's references {list(pois)}, got {short(reference)}. Pass "
            "reference=name; Ports(references=[Reference(poi)]) adds one."
        )
    return plant, pois[reference], reference


def force_axes(plant: StandardPlant, poi: Poi) -> tuple[FloatArray, tuple[str, ...]]:
    """Return T (nu, r), forces along the POI's axes at the centre of gravity to actuators."""
    decoupled = decouple(plant, axes=poi.axes)
    return decoupled.T_u, tuple(decoupled.axes)


def _of_plant(
    plant: StandardPlant, poi: Poi, T: FloatArray, along: npt.ArrayLike | None
) -> Inverse:
    """Return the function of s that gives F (p, r), the POI at p places."""
    g, inputs = plant.system, plant.system.input_index(plant.u)
    rows = g.output_index([poi.channel(axis) for axis in poi.axes])
    C, D = g.C[rows][None], (g.D[np.ix_(rows, inputs)] @ T)[None]
    if along is not None:
        places = plant.along(poi.name, real_array(along, "along", (None, 3)))
        C, D = places.C[:, : rows.size], places.D[:, : rows.size, inputs] @ T
    wanted = np.eye(rows.size)[:, :1]

    def found(s: complex) -> tuple[ComplexArray, ComplexArray]:
        return C @ _states(g, g.B[:, inputs] @ T, s) + D, wanted.astype(np.complex128)

    return found


def _of_loop(
    loop: ClosedLoop, poi: Poi, T: FloatArray, name: str, along: npt.ArrayLike | None
) -> Inverse:
    """Return the function of s that gives F (p, r) in closed loop, the POI at p places.

    A place changes what is seen of the states and of u, which the feedback does not read.
    """
    forced = close_loop(loop.plant, *loop.blocks, known_forces(loop.plant))
    g, plant, r = forced.monitored, forced.plant, len(poi.axes)
    acts = np.zeros((len(plant.w), T.shape[1] + 1))
    acts[g.input_index([force_name(u) for u in loop.plant.u]), :-1] = T
    acts[g.input_index([name]), -1] = 1.0
    rows = g.output_index([poi.channel(axis) for axis in poi.axes])
    C, D = g.C[rows][None], (g.D[rows] @ acts)[None]
    if along is not None:
        places = plant.along(poi.name, real_array(along, "along", (None, 3)))
        own, u = places.D[:, :r], g.output_index(forced.driven)
        by_u = own[:, :, plant.system.input_index(forced.driven)]
        C = by_u @ g.C[u]
        C[:, :, : plant.system.n_states] += places.C[:, :r]
        D = (own[:, :, plant.system.input_index(plant.w)] + by_u @ g.D[u]) @ acts
    wanted = np.eye(r)[:, :1]

    def found(s: complex) -> tuple[ComplexArray, ComplexArray]:
        both = C @ _states(g, g.B @ acts, s) + D
        return both[:, :, :-1], wanted - both[:, :, -1:]

    return found


def _states(g: StateSpace, B: FloatArray, s: complex) -> ComplexArray:
    z = np.exp(s * g.dt) if g.dt else s
    return np.asarray(np.linalg.solve(z * np.eye(g.n_states) - g.A, B.astype(np.complex128)))


def _term(term: Any) -> int:
    if term not in TERMS:
        raise LabelError(f"a term is one of {', '.join(TERMS)}, got {short(term)}. Choose one.")
    return TERMS.index(term)


def term_numbers(terms: Any) -> list[int]:
    """Return the orders of derivatives that are named."""
    return [_term(term) for term in name_list(terms, "terms")]


def _check_order(move: Any, gains: FloatArray) -> None:
    instance(move, SetPoint, "move", "Use setpoint(...) or scan(...).")
    highest = max((m for m in range(5) if np.any(gains[:, :, m])), default=0)
    if move.order < highest:
        raise ModelError(
            f"the feedforward uses the {TERMS[highest]}, but {move!r} is of order {move.order}, "
            f"so that its {TERMS[highest]} is impulses. Give the set-point a bound on "
            f"{TERMS[highest]}, or use feedforward.up_to({TERMS[move.order]!r})."
        )

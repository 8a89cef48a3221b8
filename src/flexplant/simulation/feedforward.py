"""Feedforward: forces from the derivatives of a set-point, by the inverse of the plant."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any, TypeAlias

import numpy as np
import numpy.typing as npt

from ..checks import (
    ComplexArray,
    FloatArray,
    Value,
    instance,
    name_list,
    positive,
    real_array,
    short,
    whole,
)
from ..errors import (
    AssumptionError,
    CertificateError,
    LabelError,
    ModelError,
    counted,
    only_one,
    warn,
)
from ..loop import ClosedLoop, close_loop
from ..loop.blocks import DERIVATIVES, force_name
from ..lti.responses import responder
from ..lti.statespace import StateSpace
from ..plant import Poi, StandardPlant, decouple, standard_plant
from ..plant.partition import require_plain, require_sampled
from ..tolerances import divisor
from .motion import SetPoint
from .simulate import simulate

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

    def forces(self, move: SetPoint, time: npt.ArrayLike) -> dict[str, FloatArray]:
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
    plant, poi, axis, name = tracked(given if loop is None else loop.plant, reference)
    highest = whole(order, "order", minimum=2, maximum=4)
    T, axes = force_axes(plant, poi)
    wanted = np.eye(len(poi.axes))[:, [poi.axes.index(axis)]]
    blocks = () if loop is None else loop.blocks
    forced = close_loop(plant.replace(evaluation=None), *blocks, known_forces(plant))
    gains = coefficients(_inverse_of(forced, poi, T, wanted, name, along), plant.dt, axes)
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


def tracked(plant: Any, reference: str | None) -> tuple[StandardPlant, Poi, str, str]:
    """Return the plant, the POI and the axis that a reference is for, and its channel."""
    plant = standard_plant(plant)
    require_plain(plant, "feedforward acts on a machine")
    found = {p.derived(axis, "ref"): (p, axis) for p, axis in plant.assembled.ports.followed}
    reference = only_one("reference", found, reference, "reference=")
    return plant, *found[reference], reference


def force_axes(plant: StandardPlant, poi: Poi) -> tuple[FloatArray, tuple[str, ...]]:
    """Return T (nu, r), forces along the POI's axes at the centre of gravity to actuators."""
    decoupled = decouple(plant, axes=poi.axes)
    return decoupled.T_u, tuple(decoupled.axes)


def _inverse_of(
    forced: ClosedLoop,
    poi: Poi,
    T: FloatArray,
    wanted: FloatArray,
    name: str,
    along: npt.ArrayLike | None,
) -> Inverse:
    """Return the function of s that gives F (p, r) in a loop with known forces, at p places."""
    # a place changes what is seen of the states and of u, which the feedback does not read
    g, plant, r = forced.monitored, forced.plant, len(poi.axes)
    acts = np.zeros((len(plant.w), T.shape[1] + 1))
    acts[g.input_index([force_name(u) for u in plant.u]), :-1] = T
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

    def found(s: complex) -> tuple[ComplexArray, ComplexArray]:
        both = C @ _states(g, g.B @ acts, s) + D
        return both[:, :, :-1], wanted - both[:, :, -1:]

    return found


def _states(g: StateSpace, B: FloatArray, s: complex) -> ComplexArray:
    z = np.exp(s * g.dt) if g.dt else s
    return np.asarray(np.linalg.solve(z * np.eye(g.n_states) - g.A, B.astype(np.complex128)))


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
    instance(move, SetPoint, "move", "Use setpoint(...) or scan(...).")
    highest = max((m for m in range(5) if np.any(gains[:, :, m])), default=0)
    if move.order < highest:
        raise ModelError(
            f"the feedforward uses the {TERMS[highest]}, but {move!r} is of order {move.order}, "
            f"so that its {TERMS[highest]} is impulses. Give the set-point a bound on "
            f"{TERMS[highest]}, or use feedforward.up_to({TERMS[move.order]!r})."
        )


#: points on a circle of Cauchy's integrals; its largest radius [rad/s], and how often it is halved
_SAMPLES, _LARGEST, _RADII = 16, 6e3, 24
#: relative: two circles give the same coefficients
_SAME = 1e-8
#: condition above which a response counts as singular
_SINGULAR = 1e9
#: the response of a POI to forces, and what is to follow, at s
Inverse: TypeAlias = Callable[[complex], tuple[ComplexArray, ComplexArray]]


def coefficients(find: Inverse, dt: float, axes: Sequence[str]) -> FloatArray:
    """Return k_0, ..., k_4 (p, r, 5) of F(s), G F = rhs, on the largest circle that allows it."""
    radius = min(_LARGEST, 0.5 / dt) if dt else _LARGEST
    powers = np.arange(5)
    outer = _on_circle(find, radius, axes)
    for _ in range(_RADII):
        inner = _on_circle(find, 0.5 * radius, axes)
        size = np.abs(outer) * radius**powers
        scale = size.max(axis=(1, 2), keepdims=True)
        if np.all(np.abs(outer - inner) * (0.5 * radius) ** powers <= _SAME * scale):
            inner[np.abs(inner) * (0.5 * radius) ** powers <= _SAME * scale] = 0.0
            return inner
        outer, radius = inner, 0.5 * radius
    raise AssumptionError(
        f"the response from forces along {', '.join(axes)} to the POI has no inverse that is "
        "regular at low frequency: there is a zero at rest. Check which axes the actuators move."
    )


def _on_circle(find: Inverse, radius: float, axes: Sequence[str]) -> FloatArray:
    """Return k_m = sum F(s_i) s_i^-m / N over N points of a circle (the lower half conjugate)."""
    turns = np.exp(2j * np.pi * (np.arange(_SAMPLES // 2) + 0.5) / _SAMPLES)
    values = []
    for turn in turns:
        G, wanted = find(radius * complex(turn))
        rows = np.max(np.abs(G), axis=2, keepdims=True)
        columns = np.max(np.abs(G), axis=1, keepdims=True)
        flat = rows.min(initial=1.0) <= 0 or columns.min(initial=1.0) <= 0
        if flat or np.max(np.linalg.cond(G / np.sqrt(rows * columns))) > _SINGULAR:
            raise AssumptionError(
                f"the forces along {', '.join(axes)} do not move these axes of the POI apart from "
                "each other, so that there is no inverse. Choose other axes of the POI."
            )
        values.append(
            np.linalg.solve(G, np.broadcast_to(wanted, (len(G), *wanted.shape[-2:])))[..., 0]
        )
    F = np.array(values)[..., None] * (turns[:, None] ** -np.arange(5))[:, None, None, :]
    return np.asarray(2.0 / _SAMPLES * F.sum(axis=0).real / radius ** np.arange(5))


#: gradient of what forces minimise, of that without forces; 2e-13 was seen
AGREEMENT = 1e-7
#: part of the largest force that may fall outside the run
_OUTSIDE = 1e-3


def inverse_forces(
    loop: ClosedLoop,
    move: SetPoint,
    *,
    duration: float,
    bandwidth: float,
    reference: str | None = None,
) -> dict[str, FloatArray]:
    """Return the forces that make the POI follow a set-point, by the plant's regularised inverse.

    Minimises ``|r - P u|^2 + rho |u|^2`` over all forces, those before a change of the set-point
    included: at each frequency ``U = P* (P P* + rho)^-1 R``. A plant with zeros outside the
    stability region (sampled or with sensors away from actuators) has no stable causal inverse;
    this one is stable, and acts ahead of the set-point (preview). In units of acceleration rho is
    ``(2 pi bandwidth)^-4``: far below the bandwidth the plant is inverted, far above nothing is
    done. All axes of the POI are followed, those without a reference at rest. What the feedback of
    the loop would add on the model, because its sensors do not move like the POI, is subtracted.

    Parameters
    ----------
    loop : ClosedLoop
        The controller on a model: a sampled plant, assembled from a free structure.
    move : SetPoint
        With a rest before it that is long enough for the preview; a warning says when it is not.
    duration : float [s]
        Of the run.
    bandwidth : float [Hz]
        Up to which the plant is inverted.
    reference : str, optional
        The reference's channel; the plant's only one when not given.

    Returns
    -------
    dict {channel: (n_time,) array}
        `u1:feedforward`, ...: references of a loop with the block `known_forces(plant)`.

    Raises
    ------
    LabelError, AssumptionError
        As for `design_feedforward`.
    CertificateError
        When responses by the plant's matrices give other forces, at five of the frequencies.
    ModelError
        When the plant is continuous or held, `move` is no SetPoint, or a number is not positive.

    Warns
    -----
    FlexplantWarning
        When forces of more than 0.1 % of the largest fall before the run, or after it.

    References
    ----------
    [VanZundertOomen2018]_.

    Examples
    --------
    >>> import flexplant as fx
    >>> plant = fx.testbeds.three_masses()
    >>> observer = fx.design_kalman(plant)
    >>> servo = fx.design_servo(plant, bandwidth=20.0, observer=observer)
    >>> loop = fx.close_loop(plant, observer, servo, fx.simulation.known_forces(plant))
    >>> move = fx.setpoint(1e-4, velocity=5e-3, acceleration=0.5, jerk=100.0, rest=0.05)
    >>> sorted(fx.simulation.inverse_forces(loop, move, duration=0.2, bandwidth=60.0))
    ['u1:feedforward']
    """
    instance(loop, ClosedLoop, "loop", "Use close_loop(plant, ...).")
    plant, poi, axis, name = tracked(loop.plant, reference)
    instance(move, SetPoint, "move", "Use setpoint(...) or scan(...).")
    require_sampled(plant, "the inverse is of samples", ModelError)
    steps = round(positive(duration, "duration") / plant.dt)
    reach = 2.0 * np.pi * positive(bandwidth, "bandwidth") * plant.dt
    T, axes = force_axes(plant, poi)
    low = design_feedforward(plant, reference=name, order=2)
    if np.any(low.gains[:, :, :2]):
        raise ModelError(
            "the plant is held, so that it takes a force to stay away from rest: this inverse is "
            "of free machines. Use design_feedforward(plant)."
        )
    channels = [poi.channel(axis) for axis in poi.axes]
    size = 1 << int(np.ceil(np.log2(4 * steps)))  # what wraps around has three lengths to decay
    freq: FloatArray = np.asarray(np.fft.rfftfreq(size, plant.dt), dtype=np.float64)
    P = np.moveaxis(responder(plant.system.select(channels, plant.u))(freq[1:]), 2, 0) @ T
    z = np.exp(2j * np.pi * freq[1:] * plant.dt)
    second = z - 2.0 + 1.0 / z  # the second difference of a motion: finite at rest, as P s^2
    H = P * second[:, None, None]
    # in units in which a unit force accelerates its own axis by one unit per sample^2
    masses = decouple(plant, axes=poi.axes).mass.diagonal()
    scale = np.diag(masses / plant.dt**2)
    H = H @ scale
    damping = (np.abs(second) / reach**2) ** 2
    back = H.conj().swapaxes(1, 2)
    gram = H @ back + damping[:, None, None] * np.eye(len(axes))
    position = np.asarray(move.at((np.arange(-1, steps + 1)) * plant.dt).position)
    spectrum = np.fft.rfft(np.diff(position, 2), size)
    target = np.zeros((freq.size - 1, len(axes), 1), dtype=np.complex128)
    target[:, poi.axes.index(axis), 0] = spectrum[1:]
    U = np.zeros((freq.size, len(axes)), dtype=np.complex128)
    U[1:] = (back @ np.linalg.solve(gram, target))[:, :, 0]
    U[0] = low.gains[0, :, 2] / masses * spectrum[0].real
    for k in np.unique(np.geomspace(1, np.count_nonzero(freq <= bandwidth), 5).astype(int)) - 1:
        g, rate = plant.system.select(channels, plant.u), second[k]
        direct = g.C @ np.linalg.solve(z[k] * np.eye(g.n_states) - g.A, g.B) + g.D
        _check_minimum(
            rate * direct @ T @ scale, target[k, :, 0], U[k + 1], damping[k], freq[k + 1]
        )
    force = np.fft.irfft(U, size, axis=0) @ (T @ scale).T
    outside = float(np.max(np.abs(force[steps:])))
    if outside > _OUTSIDE * float(np.max(np.abs(force))):
        late = np.flatnonzero(np.max(np.abs(force), axis=1) > _OUTSIDE * np.abs(force).max())
        ahead = (size - late[late > size // 2].min(initial=size)) * plant.dt
        warn(
            f"forces up to {outside:.3g} N fall outside the run and are cut off: the inverse acts "
            f"{ahead:.3g} s before the run begins, or after it ends. Give the set-point a longer "
            "rest and the run more time, or lower the bandwidth."
        )
    own = force[:steps] - _feedback(loop, force[:steps], move, name)
    return {force_name(actuator): own[:, i] for i, actuator in enumerate(plant.u)}


def _check_minimum(
    H: ComplexArray, target: ComplexArray, U: ComplexArray, damping: float, freq: float
) -> None:
    """Refuse forces at which the gradient of ``|target - H U|^2 + damping |U|^2`` is not zero."""
    back = H.conj().T
    off = float(np.linalg.norm(back @ (target - H @ U) - damping * U))
    alone = float(np.linalg.norm(back @ target))
    if not off <= AGREEMENT * alone:
        raise CertificateError(
            f"forces do not minimise the error at {freq:.4g} Hz: by the plant's matrices the "
            f"gradient is {off / divisor(alone):.2g} of what it would be without forces."
        )


def _feedback(loop: ClosedLoop, force: FloatArray, move: SetPoint, name: str) -> FloatArray:
    """Return what the controller adds (n_time, nu) while these forces move its own plant."""
    plant = loop.plant.replace(evaluation=None)
    names = [force_name(u) for u in plant.u]
    alone = close_loop(plant, known_forces(plant))
    given = {one: force[:, i] for i, one in enumerate(names)}
    duration = len(force) * plant.dt
    run = simulate(alone, reference={**given, name: move}, duration=duration, noise=False)
    # a loop that passes forces on already would count them twice
    passed = {name for block in loop.blocks for name in block.inputs}
    more = () if passed.issuperset(names) else (known_forces(plant),)
    both = close_loop(plant, *loop.blocks, *more)
    law, x = both.controller, np.zeros(both.controller.n_states)
    sensed = [one for one in plant.y if one not in names]
    y_at, f_at = law.input_index(sensed), law.input_index(names)
    rows = law.output_index(plant.u)
    read = np.array([run[one] for one in sensed]).T
    direct = np.linalg.inv(law.D[np.ix_(rows, f_at)])
    known = np.zeros_like(force)
    for k, y in enumerate(read):
        # the force beside the controller's own that makes the sum what is wanted
        known[k] = direct @ (force[k] - law.C[rows] @ x - law.D[np.ix_(rows, y_at)] @ y)
        x = law.A @ x + law.B[:, y_at] @ y + law.B[:, f_at] @ known[k]
    return force - known

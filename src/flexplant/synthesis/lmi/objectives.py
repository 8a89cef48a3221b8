"""Several objectives for one controller: specifications as values, and their LMIs [Scherer1997]_.

One Lyapunov matrix serves all of them.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from itertools import pairwise
from typing import Any, NamedTuple

import numpy as np

from ...arrays import FloatArray, between, positive
from ...lti.norms import h2_norm, peak_gain
from ...lti.response_solvers import continuous_poles
from ...lti.statespace import StateSpace
from ...plant import AnyPlant
from ...store import Value, checked
from ...tolerances import FOUR_DIGITS, MOST_STEPS, NEGLIGIBLE, ROUNDING, TINY, TYPED
from ..preparation import less_feedthrough
from ..structured.judges import (
    OVER,
    GainJudge,
    H2Judge,
    Judge,
    PeakJudge,
    problem_on,
    require_finite_h2,
)
from ..structured.measured_objective import MeasuredObjective
from .lmi_programs import (
    TOLERANCES,
    Matrices,
    Plant,
    changed_back,
    modelling,
    solve_program,
    symmetric_blocks,
)

#: samples of an impulse response that are computed together, and at most
_TOGETHER, _LONGEST = 256, 4e6


@dataclass(frozen=True, eq=False, repr=False)
class H2(MeasuredObjective):
    """The H2 norm from w to z. It is the rms of z for white noise w of unit intensity.

    Parameters
    ----------
    w, z : sequences of str, optional
        Names of the channels; by default all channels of w and z.
    below : float, optional
        Upper bound on the norm. It is not given for the norm that is minimised.

    Examples
    --------
    >>> import flexplant as fx
    >>> slow = fx.lti.low_pass_filter(0.1)
    >>> sys = fx.plant.mixed_sensitivity(fx.lti.tf([1.0], [1.0, 1.0]), S=slow, KS=0.1)
    >>> fx.synthesis.design_lmi(sys, minimize=fx.synthesis.H2()).gamma < 1
    True
    """

    def measured(self, closed: StateSpace) -> float:
        """Return the norm of a closed loop, computed from its Gramians."""
        return h2_norm(closed)

    def judges(self, plant: AnyPlant, order: int) -> list[Judge]:
        """Return the objects that compute the norm of the loop for controllers of `order` states.

        `design_structured` calls this method. See `Judge`.
        """
        w, z = self.chosen(plant)
        require_finite_h2(plant, w, z)
        return [H2Judge(problem_on(plant, w, z), order)]


@dataclass(frozen=True, eq=False, repr=False)
class Hinf(MeasuredObjective):
    """The H-infinity norm from w to z. It is the largest gain over all frequencies.

    Parameters
    ----------
    w, z, below : as for `H2`

    Examples
    --------
    >>> import flexplant as fx
    >>> fx.synthesis.Hinf(w=["amp"], z=["die:x"], below=1.0)
    Hinf(w=['amp'], z=['die:x'], below=1)
    """

    def measured(self, closed: StateSpace) -> float:
        """Return the norm of a closed loop."""
        return peak_gain(closed)[0]

    def judges(self, plant: AnyPlant, order: int) -> list[Judge]:
        """Return the objects that compute the norm of the loop for controllers of `order` states.

        `design_structured` calls this method. See `Judge`.
        """
        return [GainJudge(problem_on(plant, *self.chosen(plant)), order)]


@dataclass(frozen=True, eq=False, repr=False)
class PeakGain(MeasuredObjective):
    """The peak-to-peak gain. It is the largest amplitude of z for w of amplitude one.

    The linear matrix inequality gives a bound that is called the star norm. It bounds the Euclidean
    length of the vector z at all times, for all vectors w whose length is at most one. The result
    is verified by the integral of the absolute impulse response of each channel (by the sum for a
    sampled plant). This is the exact peak-to-peak gain of the channel.

    Parameters
    ----------
    w, z, below : as for `H2`
    decay : float [rad/s], optional
        Decay rate in the linear matrix inequality. By default several values are tried.

    Examples
    --------
    >>> import flexplant as fx
    >>> fx.synthesis.PeakGain(w=["amp"], z=["die:x"], below=1.0)
    PeakGain(w=['amp'], z=['die:x'], below=1)
    """

    decay: float | None = field(default=None, metadata=checked(positive))

    def measured(self, closed: StateSpace) -> float:
        """Return the largest integral (or sum) of an absolute impulse response."""
        return impulse_sum(closed) if closed.dt else impulse_integral(closed)

    def judges(self, plant: AnyPlant, order: int) -> list[Judge]:
        """Return the objects that compute the peak gain of each channel from an input to an output.

        `design_structured` calls this method for controllers of `order` states. See `Judge`.
        """
        w, z = self.chosen(plant)
        return [PeakJudge(problem_on(plant, [i], [o]), order) for i in w for o in z]


@dataclass(frozen=True, eq=False)
class PoleRegion(Value):
    """A region for all poles of the closed loop, including those of weights in the plant.

    Parameters
    ----------
    decay : float [rad/s]
        Smallest decay rate. Real parts of the poles are below -decay. For a sampled plant,
        magnitudes of the poles are below e^(-decay dt).
    damping : float, optional
        Smallest damping ratio of the poles. For a sampled plant it is the damping ratio of ``s =
        log(z) / dt`` with the pole z.
    bandwidth : float [Hz], optional
        Largest magnitude of the poles s, divided by 2 pi. It excludes poles that are too fast for
        the sampling of the controller. For a sampled plant it must be below half the rate.

    Examples
    --------
    >>> import flexplant as fx
    >>> fx.synthesis.PoleRegion(decay=10.0, damping=0.1)
    PoleRegion(decay=10.0, damping=0.1, bandwidth=None)
    """

    decay: float = field(default=0.0, metadata=checked(positive, zero=True))
    damping: float | None = field(
        default=None, metadata=checked(between, low=0.0, high=1.0, hint="It is a ratio below 1.")
    )
    bandwidth: float | None = field(default=None, metadata=checked(positive))

    def outside(self, closed: StateSpace) -> str:
        """Return a description of a pole of the closed loop outside the region; empty: no pole."""
        poles = continuous_poles(closed)
        if not poles.size:
            return ""
        slow = poles[np.argmax(poles.real)]
        # a mille of what is required, or rounding of an integrator
        if slow.real > -self.decay * (1 - 1e-3) - (1e-9 if not self.decay else 0.0):
            return f"{slow:.4g} rad/s decays slower than {self.decay:g} rad/s"
        ratio = -poles.real / np.maximum(np.abs(poles), TINY)
        # as of bounds on norms
        if self.damping is not None and ratio.min() < self.damping * (1 - 1e-3):
            return f"{poles[np.argmin(ratio)]:.4g} rad/s has the damping {ratio.min():.4g}"
        size = np.abs(poles) / (2 * np.pi)
        # as of bounds on norms
        if self.bandwidth is not None and size.max() > self.bandwidth * (1 + 1e-3):
            return f"a pole lies at {size.max():.4g} Hz"
        return ""


def impulse_integral(closed: StateSpace, *, points: int = 4000) -> float:
    """Return the largest of ``|D_ij| + int |h_ij(t)| dt`` of a stable continuous system."""
    # until the slowest pole has decayed; refined until it changes by less than 1e-4
    from scipy.linalg import expm

    poles = closed.poles()
    if not poles.size:
        return float(np.abs(closed.D).max(initial=0.0))
    if not np.max(poles.real) < 0:
        return float("inf")
    end = OVER / float(np.min(-poles.real))
    count = int(min(max(points, 20 * end * np.abs(poles.imag).max() / np.pi), 400_000))
    last = np.inf
    for _ in range(4):
        step = expm(closed.A * (end / count))
        x: FloatArray = closed.B.copy()
        total = 0.5 * np.abs(closed.C @ x)
        for _ in range(count):
            x = step @ x
            total += np.abs(closed.C @ x)
        found = float((np.abs(closed.D) + total * (end / count)).max())
        if abs(found - last) < FOUR_DIGITS * found or count >= 400_000:  # seconds
            break
        last, count = found, 2 * count
    return found


def impulse_sum(closed: StateSpace) -> float:
    """Return the largest of ``sum_k |h_ij[k]|`` of a stable sampled system."""
    # until the slowest pole has decayed; infinite where that takes more than four million samples
    radius = float(np.abs(closed.poles()).max(initial=0.0))
    # a loop of delays alone is over in a few samples
    speed = -np.log(max(radius, 1e-12))
    if not speed * _LONGEST > OVER:
        return float("inf")
    count = 1 + int(OVER / speed) // _TOGETHER
    powers = [np.eye(closed.n_states)]
    for _ in range(_TOGETHER):
        powers.append(closed.A @ powers[-1])
    seen = closed.C @ np.array(powers[:-1])  # C A^k, of a block of samples
    x, total = closed.B.copy(), np.abs(closed.D)
    for _ in range(count + closed.n_states // _TOGETHER + 1):
        total = total + np.sum(np.abs(seen @ x), axis=0)
        x = powers[-1] @ x
    return float(total.max(initial=0.0))


class Channel(NamedTuple):
    """The columns of B1 and rows of C1 of one specification, z in multiples of its bound."""

    columns: list[int]
    rows: list[int]
    unit: float


class Variables:
    """X, Y and the changed controller, with the closed loop's blocks that are affine in them.

    ::

        P = [Y I; I X],   A = [A Y + B2 C_   A + B2 D_ C2],   B = [B1 + B2 D_ D21  ],
                              [A_            X A + B_ C2 ]        [X B1 + B_ D21   ]
        C = [C1 Y + D12 C_,  C1 + D12 D_ C2],   D = D11 + D12 D_ D21
    """

    def __init__(self, plant: Plant, root: float, *, proper: bool) -> None:
        self.cp = cp = modelling()
        p, self.plant, self.root = plant, plant, root
        n, nu, ny = p.A.shape[0], p.B2.shape[1], p.C2.shape[0]
        self.X, self.Y = (cp.Variable((n, n), symmetric=True) for _ in range(2))
        self.K_A, self.K_B = cp.Variable((n, n)), cp.Variable((n, ny))
        self.K_C = cp.Variable((nu, n))
        self.K_D = cp.Constant(np.zeros((nu, ny))) if proper else cp.Variable((nu, ny))
        self.P = symmetric_blocks([[self.Y, np.eye(n)], [self.X]])
        self.A = cp.bmat([
            [p.A @ self.Y + p.B2 @ self.K_C, p.A + p.B2 @ self.K_D @ p.C2],
            [self.K_A, self.X @ p.A + self.K_B @ p.C2],
        ])  # fmt: skip

    def of(self, channel: Channel) -> tuple[Any, Any, Any]:
        """Return B, C and D of a channel, z in its unit."""
        cp, p, (columns, rows, unit) = self.cp, self.plant, channel
        B1, D21 = p.B1[:, columns], p.D21[:, columns]
        C1, D12 = p.C1[rows] / unit, p.D12[rows] / unit
        B = cp.vstack([B1 + p.B2 @ self.K_D @ D21, self.X @ B1 + self.K_B @ D21])
        C = cp.hstack([C1 @ self.Y + D12 @ self.K_C, C1 + D12 @ self.K_D @ p.C2])
        return B, C, p.D11[np.ix_(rows, columns)] / unit + D12 @ self.K_D @ D21

    def sampled(self, rows: list[list[Any]], further: list[Any]) -> Any:
        """Return a block matrix, of a sampled system with the row [t^(1/2) A'; P; ...] second."""
        if not self.root:
            return symmetric_blocks(rows)
        (first, *others), rest = rows[0], rows[1:]
        return symmetric_blocks([[first, self.root * self.A, *others], [self.P, *further], *rest])

    def positive(self) -> list[Any]:
        """Return ``[Y t; t X] > 0``, t above 1: away from the singular I - X Y."""
        apart = (1.0 + NEGLIGIBLE) * np.eye(self.plant.A.shape[0])
        return _strict(symmetric_blocks([[self.Y, apart], [self.X]]))

    def controller(self) -> Matrices:
        """Return A, B, C, D of the controller in the plant's units."""
        changed = (self.K_A.value, self.K_B.value, self.K_C.value, self.K_D.value)
        A, B, C, D = changed_back(self.plant, self.X.value, self.Y.value, changed)
        return A + (np.eye(len(A)) if self.root else 0.0), B, C, D


def _strict(*blocks: Any) -> list[Any]:
    """Return that block matrices are positive, kept away from singular."""
    return [one >> TYPED * np.eye(one.shape[0]) for one in blocks]


def hinf(v: Variables, channel: Channel, gamma: Any) -> list[Any]:
    """Return the bounded real lemma: the gain of a channel is below gamma times its unit."""
    B, C, D = v.of(channel)
    z, w = D.shape
    rows = [
        [-(v.A + v.A.T), B, -C.T],
        [gamma * np.eye(w), D.T],
        [gamma * np.eye(z)],
    ]  # fmt: skip
    return _strict(v.sampled(rows, [np.zeros((v.P.shape[0], w)), v.root * C.T]))


def h2(v: Variables, channel: Channel, square: Any) -> list[Any]:
    """Return the LMIs of an H2 norm: its square is below some number of squared units."""
    B, C, D = v.of(channel)
    z, w = D.shape
    n = v.P.shape[0]
    Q = v.cp.Variable((z, z), symmetric=True)
    first = v.sampled([[-(v.A + v.A.T), B], [np.eye(w)]], [np.zeros((n, w))])
    if v.root:
        second = symmetric_blocks([[Q, C, D / v.root], [v.P, np.zeros((n, w))], [np.eye(w)]])
    else:
        second = symmetric_blocks([[v.P, C.T], [Q]])
    return [*_strict(first, second), v.cp.trace(Q) <= square]


def peak(v: Variables, channel: Channel, gamma: Any, decay: float) -> list[Any]:
    """Return the LMIs of the star norm: peak to peak below gamma units, for one rate."""
    # `x' P x` shrinks at this rate while |w| < 1 adds to it, so that x stays in an ellipsoid, where
    # z is bounded [Abedor1996]_. For a sampled plant one step shrinks it by `1 - decay t`
    B, C, D = v.of(channel)
    z, w = D.shape
    n = v.P.shape[0]
    part = v.cp.Variable()
    rows = [[-(v.A + v.A.T) - decay * v.P, -B], [part * np.eye(w)]]
    if v.root:
        rows = [[*rows[0], v.root * v.A.T], [*rows[1], v.root * B.T], [v.P]]
    first = symmetric_blocks(rows)
    second = symmetric_blocks([
        [decay * v.P, np.zeros((n, w)), C.T],
        [(gamma - part) * np.eye(w), D.T],
        [gamma * np.eye(z)],
    ])  # fmt: skip
    return _strict(first, second)


def _edge(v: Variables, x: float, y: float, most: float) -> Any:
    """Return the LMI of a half plane of z, of a continuous plant one of s through 0."""
    # edges of z are those of (z - 1) / t, with z = 1 as origin
    beyond = 2.0 * (most - x) / v.root**2 * v.P if v.root else 0.0
    even, odd = x * (v.A + v.A.T) - beyond, y * (v.A - v.A.T)
    return -symmetric_blocks([[even, odd], [even]] if y else [[even]])


def _disc(v: Variables, disc: PoleDisc) -> Any:
    """Return ``[-(X + X'), X'; X, radius P] > 0`` with X = A_z - (centre + radius), over t."""
    past = disc.centre + disc.radius - 1.0
    return symmetric_blocks([
        [-(v.A + v.A.T) + 2.0 * past / v.root**2 * v.P, v.root * v.A.T - past / v.root * v.P],
        [disc.radius * v.P],
    ])  # fmt: skip


def size(v: Variables) -> Any:
    """Return a measure of X, Y and the controller that picks one of many."""
    gains = sum(v.cp.norm(one, "fro") for one in (v.K_B, v.K_C, v.K_D))
    return v.cp.trace(v.X) + v.cp.trace(v.Y) + 0.1 * gains


#: angles of z [rad] of the corners of a polygon inside the spiral of a damping ratio
_ANGLES = (0.0, 0.05, 0.2, 0.6, 1.3)
#: centres that are tried for a disc, and points of the curve that it stays inside
_CENTRES, _POINTS = 200, 2000


class PoleDisc(NamedTuple):
    """``|z - centre| <= radius``."""

    centre: float
    radius: float


def damped(ratio: float) -> list[tuple[float, float, float]]:
    """Return the edges of a polygon in which poles z have at least a damping ratio."""
    # each as (x, y, most) of `x Re z + y |Im z| <= most`
    # `z = e^(s dt)` of that ratio is the spiral `|z| = e^(-a phi)`, phi = |arg z|, a = ratio / (1 -
    # ratio^2)^(1/2); from phi = 0 on it is convex, up to where the real part is that of its end on
    # the negative axis. Its chords are the edges
    from scipy.optimize import brentq

    a = ratio / np.sqrt(1.0 - ratio**2)
    end = -np.exp(-a * np.pi)
    leftmost = np.pi - np.arctan(a)  # where the real part of the spiral is least
    last = float(brentq(lambda phi: np.exp(-a * phi) * np.cos(phi) - end, 0.5 * np.pi, leftmost))
    phi = np.array([*_ANGLES, 0.5 * (_ANGLES[-1] + last), last])
    z = np.exp((1j - a) * phi)
    edges = [(-1.0, 0.0, float(-end))]
    for p, q in pairwise(z):
        normal = -1j * (q - p) / abs(q - p)  # to the right of the way, away from the origin
        most = float((np.conj(normal) * p).real)
        edges.append((float(normal.real), float(normal.imag), most))
    return edges


def within(speed: float) -> PoleDisc:
    """Return the largest disc in which stable poles z have ``|log z|`` below a speed."""
    angle = np.linspace(0.5 * np.pi, np.pi, _POINTS)
    curve = np.exp(speed * np.exp(1j * angle))
    centres = np.linspace(np.exp(-speed), 1.0, _CENTRES)
    radii = np.min(np.abs(curve - centres[:, None]), axis=1)
    best = int(np.argmax(radii))
    return PoleDisc(float(centres[best]), float(radii[best]))


@dataclass(frozen=True)
class ObjectivePrograms:
    """The semidefinite programs of one design."""

    given: AnyPlant
    plant: Plant
    minimize: Any
    subject_to: tuple[Any, ...]
    #: size of what is minimised that some controller reaches
    unit: float

    def variables(self) -> Variables:
        """Return the unknowns: no feedthrough where it would make a continuous H2 norm infinite."""
        p, specs = self.plant, (self.minimize, *self.subject_to)
        own = [self.channel(spec, 1.0) for spec in specs if isinstance(spec, H2)]
        proper = not self.given.dt and any(
            bool(np.any(p.D12[one.rows]) and np.any(p.D21[:, one.columns])) for one in own
        )
        root = np.sqrt(self.plant.speed) if self.given.dt else 0.0
        return Variables(self.plant, root, proper=proper)

    def channel(self, spec: Any, bound: float) -> Channel:
        """Return which w and z a specification is about, with its bound in the scaled plant."""
        w, z = spec.chosen(self.given)
        columns = [self.given.w.index(name) for name in w]
        rows = [self.given.z.index(name) for name in z]
        # H2 norms depend on the unit of time
        unit = bound / np.sqrt(self.plant.speed) if isinstance(spec, H2) else bound
        return Channel(columns, rows, unit)

    def constraints(self, v: Variables, spec: Any, level: Any, bound: float, rate: float) -> Any:
        """Return the LMIs of a specification, in units of its bound."""
        if isinstance(spec, PoleRegion):
            return self._poles(v, spec)
        own = self.channel(spec, bound)
        if isinstance(spec, H2):
            return h2(v, own, level)
        if isinstance(spec, PeakGain):
            return peak(v, own, level, self._shrinking(spec, rate))
        return hinf(v, own, level)

    def _shrinking(self, spec: PeakGain, rate: float) -> float:
        """Return the rate at which the reachable set shrinks, in the plant's unit of time."""
        speed, dt = self.plant.speed, self.given.dt
        if spec.decay is None:
            return rate
        return float(1.0 - np.exp(-spec.decay * dt)) / speed if dt else spec.decay / speed

    def _poles(self, v: Variables, spec: PoleRegion) -> list[Any]:
        """Return the LMIs of a region of poles, of z, or of s in the plant's unit of time."""
        speed, dt = self.plant.speed, self.given.dt
        if dt:
            found = [_disc(v, PoleDisc(0.0, float(np.exp(-spec.decay * dt))))]
            if spec.bandwidth is not None:
                found.append(_disc(v, within(2.0 * np.pi * spec.bandwidth * dt)))
            if spec.damping is not None:
                found += [_edge(v, *one) for one in damped(spec.damping)]
            return _strict(*found)
        found = [-symmetric_blocks([[v.A + v.A.T + 2.0 * spec.decay / speed * v.P]])]
        if spec.damping is not None:
            found.append(_edge(v, float(np.sqrt(1.0 - spec.damping**2)), spec.damping, 0.0))
        if spec.bandwidth is not None:
            top = 2 * np.pi * spec.bandwidth / speed * v.P
            found.append(-symmetric_blocks([[-top, v.A], [-top]]))
        return _strict(*found)

    def program(self, v: Variables, level: Any, unit: float, rate: float) -> list[Any]:
        """Return the LMIs of all specifications, what is minimised in units of `unit`."""
        found = [*v.positive(), *self.constraints(v, self.minimize, level, unit, rate)]
        for spec in self.subject_to:
            bound = 1.0 if isinstance(spec, PoleRegion) else float(spec.below)
            found += self.constraints(v, spec, 1.0, bound, rate)
        return found

    def smallest(self, rate: float) -> float:
        """Return the smallest bound of what is minimised, sought again in its own unit."""
        # the unit scales the Lyapunov matrix of this norm, which all objectives share: the bound is
        # smallest in a unit near it, and a third larger in one three times as large
        unit = self.unit
        for _ in range(MOST_STEPS):
            found = self._optimum(unit, rate)
            if 0.5 < found / unit < 2.0 or found < ROUNDING * self.unit:
                break
            unit = found
        return found

    def _optimum(self, unit: float, rate: float) -> float:
        """Return the smallest bound from one program, in some unit."""
        v = self.variables()
        cp, level = v.cp, v.cp.Variable()
        # picks one of the many X and Y, and keeps them finite
        little = 1e-7 * (cp.trace(v.X) + cp.trace(v.Y))
        program = cp.Problem(cp.Minimize(level + little), self.program(v, level, unit, rate))
        self._solve(program)
        found = max(float(level.value), 1e-12)  # it may end below zero
        return float(unit * (np.sqrt(found) if isinstance(self.minimize, H2) else found))

    def controller(self, bound: float, rate: float) -> StateSpace:
        """Return a moderate controller for a bound on what is minimised."""
        v = self.variables()
        program = v.cp.Problem(v.cp.Minimize(size(v)), self.program(v, 1.0, bound, rate))
        self._solve(program)
        g = self.given
        K = less_feedthrough(v.controller(), g.system.D[len(g.z) :, len(g.w) :])
        return StateSpace(*K, g.dt, inputs=g.y, outputs=g.u, name="lmi", units=g.units)

    def _solve(self, program: Any) -> None:
        """Solve a program."""
        # every claim is verified with the closed loop: a small violation does no harm
        settings = dict.fromkeys(TOLERANCES, TYPED)
        solve_program(program, settings, violation=10.0 * TYPED)

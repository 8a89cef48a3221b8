"""The LMIs of several objectives: one Lyapunov matrix for all [Scherer1997]_."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import pairwise
from typing import Any, NamedTuple

import numpy as np

from ...errors import SolverError
from ...lti.statespace import StateSpace
from ...plant import StandardPlant
from ..lmi.lmi_programs import (
    Matrices,
    Plant,
    changed_back,
    modelling,
    solve_program,
    symmetric_blocks,
)
from .specifications import H2, PeakGain, PoleRegion

#: strictness of the inequalities, relative to unit scale
_STRICT = 1e-7
#: how far X Y stays above one
_APART = 1.005


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
        cp = modelling()

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
        cp = modelling()

        p, (columns, rows, unit) = self.plant, channel
        B1, D21 = p.B1[:, columns], p.D21[:, columns]
        C1, D12 = p.C1[rows] / unit, p.D12[rows] / unit
        B = cp.vstack([B1 + p.B2 @ self.K_D @ D21, self.X @ B1 + self.K_B @ D21])
        C = cp.hstack([C1 @ self.Y + D12 @ self.K_C, C1 + D12 @ self.K_D @ p.C2])
        return B, C, p.D11[np.ix_(rows, columns)] / unit + D12 @ self.K_D @ D21

    def sampled(self, rows: list[list[Any]], beside: list[Any]) -> Any:
        """Return a block matrix, of a sampled system with the row [t^(1/2) A'; P; ...] second."""
        if not self.root:
            return symmetric_blocks(rows)
        (first, *others), rest = rows[0], rows[1:]
        return symmetric_blocks([[first, self.root * self.A, *others], [self.P, *beside], *rest])

    def positive(self) -> Any:
        """Return ``[Y t; t X] > 0``, t above 1: away from the singular I - X Y."""
        n = self.plant.A.shape[0]
        return symmetric_blocks([[self.Y, _APART * np.eye(n)], [self.X]]) >> _STRICT * np.eye(2 * n)

    def controller(self) -> Matrices:
        """Return A, B, C, D of the controller in the plant's units."""
        changed = (self.K_A.value, self.K_B.value, self.K_C.value, self.K_D.value)
        A, B, C, D = changed_back(self.plant, self.X.value, self.Y.value, changed)
        return A + (np.eye(len(A)) if self.root else 0.0), B, C, D


def hinf(v: Variables, channel: Channel, gamma: Any) -> list[Any]:
    """Return the bounded real lemma: the gain of a channel is below gamma times its unit."""
    B, C, D = v.of(channel)
    z, w = D.shape
    rows = [
        [-(v.A + v.A.T), B, -C.T],
        [gamma * np.eye(w), D.T],
        [gamma * np.eye(z)],
    ]  # fmt: skip
    block = v.sampled(rows, [np.zeros((v.P.shape[0], w)), v.root * C.T])
    return [block >> _STRICT * np.eye(block.shape[0])]


def h2(v: Variables, channel: Channel, square: Any) -> list[Any]:
    """Return the LMIs of an H2 norm: its square is below some number of squared units."""
    cp = modelling()

    B, C, D = v.of(channel)
    z, w = D.shape
    n = v.P.shape[0]
    Q = cp.Variable((z, z), symmetric=True)
    first = v.sampled([[-(v.A + v.A.T), B], [np.eye(w)]], [np.zeros((n, w))])
    if v.root:
        second = symmetric_blocks([[Q, C, D / v.root], [v.P, np.zeros((n, w))], [np.eye(w)]])
    else:
        second = symmetric_blocks([[v.P, C.T], [Q]])
    return [
        first >> _STRICT * np.eye(first.shape[0]),
        second >> _STRICT * np.eye(second.shape[0]),
        cp.trace(Q) <= square,
    ]


def peak(v: Variables, channel: Channel, gamma: Any, decay: float) -> list[Any]:
    """Return the LMIs of the star norm: peak to peak below gamma units, for one rate.

    ``x' P x`` shrinks by the rate beside what |w| < 1 adds, so that x stays in an ellipsoid, and z
    is bounded there [Abedor1996]_. Of a sampled plant a step shrinks it by
    ``1 - decay t``.
    """
    cp = modelling()

    B, C, D = v.of(channel)
    z, w = D.shape
    n = v.P.shape[0]
    part = cp.Variable()
    rows = [[-(v.A + v.A.T) - decay * v.P, -B], [part * np.eye(w)]]
    if v.root:
        rows = [[*rows[0], v.root * v.A.T], [*rows[1], v.root * B.T], [v.P]]
    first = symmetric_blocks(rows)
    second = symmetric_blocks([
        [decay * v.P, np.zeros((n, w)), C.T],
        [(gamma - part) * np.eye(w), D.T],
        [gamma * np.eye(z)],
    ])  # fmt: skip
    return [one >> _STRICT * np.eye(one.shape[0]) for one in (first, second)]


def poles(v: Variables, region: PolesHeld) -> list[Any]:
    """Return the LMIs of a region of poles, in the plant's unit of time."""
    found = []
    if not v.root:
        found.append(-symmetric_blocks([[v.A + v.A.T + 2.0 * region.decay * v.P]]))
    found += [_disc(v, disc) for disc in region.discs]
    # edges of z are those of (z - 1) / t, with z = 1 as origin
    for x, y, most in region.edges:
        beyond = 2.0 * (most - x) / v.root**2 * v.P if v.root else 0.0
        even, odd = x * (v.A + v.A.T) - beyond, y * (v.A - v.A.T)
        found.append(-symmetric_blocks([[even, odd], [even]] if y else [[even]]))
    if region.bandwidth is not None:
        found.append(-symmetric_blocks([[-region.bandwidth * v.P, v.A], [-region.bandwidth * v.P]]))
    return [one >> _STRICT * np.eye(one.shape[0]) for one in found]


class PolesHeld(NamedTuple):
    """Where poles lie: half planes and discs of z, or what bounds continuous ones.

    Of a continuous plant an edge is one of s through 0.
    """

    decay: float = 0.0
    edges: Sequence[PoleEdge] = ()
    discs: Sequence[PoleDisc] = ()
    bandwidth: float | None = None


def _disc(v: Variables, disc: PoleDisc) -> Any:
    """Return ``[-(X + X'), X'; X, radius P] > 0`` with X = A_z - (centre + radius), over t."""
    past = disc.centre + disc.radius - 1.0
    return symmetric_blocks([
        [-(v.A + v.A.T) + 2.0 * past / v.root**2 * v.P, v.root * v.A.T - past / v.root * v.P],
        [disc.radius * v.P],
    ])  # fmt: skip


def size(v: Variables) -> Any:
    """Return a measure of X, Y and the controller that picks one of many."""
    cp = modelling()

    gains = sum(cp.norm(one, "fro") for one in (v.K_B, v.K_C, v.K_D))
    return cp.trace(v.X) + cp.trace(v.Y) + 0.1 * gains


#: angles of z [rad] of the corners of a polygon inside the spiral of a damping ratio
_ANGLES = (0.0, 0.05, 0.2, 0.6, 1.3)
#: centres that are tried for a disc, and points of the curve that it stays inside
_CENTRES, _POINTS = 200, 2000


class PoleEdge(NamedTuple):
    """The half planes ``x Re z + y |Im z| <= most``."""

    x: float
    y: float
    most: float


class PoleDisc(NamedTuple):
    """``|z - centre| <= radius``."""

    centre: float
    radius: float


def damped(ratio: float) -> list[PoleEdge]:
    """Return the edges of a polygon in which poles z have at least a damping ratio.

    ``z = e^(s dt)`` of that ratio is the spiral ``|z| = e^(-a phi)``, phi = |arg z|,
    a = ratio / (1 - ratio^2)^(1/2); from phi = 0 on it is convex, up to where the real part is that
    of its end on the negative axis. Its chords are the edges.
    """
    from scipy.optimize import brentq

    a = ratio / np.sqrt(1.0 - ratio**2)
    end = -np.exp(-a * np.pi)
    leftmost = np.pi - np.arctan(a)  # where the real part of the spiral is least
    last = float(brentq(lambda phi: np.exp(-a * phi) * np.cos(phi) - end, 0.5 * np.pi, leftmost))
    phi = np.array([*_ANGLES, 0.5 * (_ANGLES[-1] + last), last])
    z = np.exp((1j - a) * phi)
    edges = [PoleEdge(-1.0, 0.0, float(-end))]
    for p, q in pairwise(z):
        normal = -1j * (q - p) / abs(q - p)  # to the right of the way, away from the origin
        most = float((np.conj(normal) * p).real)
        edges.append(PoleEdge(float(normal.real), float(normal.imag), most))
    return edges


def within(speed: float) -> PoleDisc:
    """Return the largest disc in which stable poles z have ``|log z|`` below a speed."""
    angle = np.linspace(0.5 * np.pi, np.pi, _POINTS)
    curve = np.exp(speed * np.exp(1j * angle))
    centres = np.linspace(np.exp(-speed), 1.0, _CENTRES)
    radii = np.min(np.abs(curve - centres[:, None]), axis=1)
    best = int(np.argmax(radii))
    return PoleDisc(float(centres[best]), float(radii[best]))


#: largest part by which a reachable set shrinks in one sample
_MOST = 0.9
#: units in which the optimum is sought
_UNITS = 7
#: of the solver, tried in turn
_TOLERANCES = (1e-8, 1e-6, 1e-5)


@dataclass(frozen=True)
class ObjectivePrograms:
    """The semidefinite programs of one design."""

    given: StandardPlant
    plant: Plant
    minimize: Any
    subject_to: tuple[Any, ...]

    def unit(self, spec: Any, bound: float) -> float:
        """Return a bound in the scaled plant: H2 norms depend on the unit of time."""
        return bound / np.sqrt(self.plant.speed) if isinstance(spec, H2) else bound

    def variables(self) -> Variables:
        """Return the unknowns: no feedthrough where it would make a continuous H2 norm infinite."""
        proper = False
        if not self.given.dt:
            p = self.plant
            for spec in (self.minimize, *self.subject_to):
                if isinstance(spec, H2):
                    own = self.channel(spec, 1.0)
                    proper |= bool(np.any(p.D12[own.rows]) and np.any(p.D21[:, own.columns]))
        root = np.sqrt(self.plant.speed) if self.given.dt else 0.0
        return Variables(self.plant, root, proper=proper)

    def channel(self, spec: Any, bound: float) -> Channel:
        """Return which w and z a specification is about, with its bound in the scaled plant."""
        w, z = spec.chosen(self.given)
        columns = [self.given.w.index(name) for name in w]
        rows = [self.given.z.index(name) for name in z]
        return Channel(columns, rows, self.unit(spec, bound))

    def constraints(self, v: Variables, spec: Any, level: Any, bound: float, rate: float) -> Any:
        """Return the LMIs of a specification, in units of its bound."""
        if isinstance(spec, PoleRegion):
            return poles(v, self._region(spec))
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
            return min(rate, _MOST / speed) if dt else rate
        return float(1.0 - np.exp(-spec.decay * dt)) / speed if dt else spec.decay / speed

    def _region(self, spec: PoleRegion) -> PolesHeld:
        """Return the region of z, or of s in the plant's unit of time."""
        speed, dt = self.plant.speed, self.given.dt
        if not dt:
            edges = []
            if spec.damping is not None:
                edges = [PoleEdge(float(np.sqrt(1.0 - spec.damping**2)), spec.damping, 0.0)]
            top = None if spec.bandwidth is None else 2 * np.pi * spec.bandwidth / speed
            return PolesHeld(spec.decay / speed, edges, (), top)
        discs = [PoleDisc(0.0, float(np.exp(-spec.decay * dt)))]
        if spec.bandwidth is not None:
            discs.append(within(2.0 * np.pi * spec.bandwidth * dt))
        return PolesHeld(0.0, [] if spec.damping is None else damped(spec.damping), discs)

    def program(self, v: Variables, level: Any, unit: float, rate: float) -> list[Any]:
        """Return the LMIs of all specifications, what is minimised in units of `unit`."""
        found = [v.positive(), *self.constraints(v, self.minimize, level, unit, rate)]
        for spec in self.subject_to:
            bound = 1.0 if isinstance(spec, PoleRegion) else float(spec.below)
            found += self.constraints(v, spec, 1.0, bound, rate)
        return found

    def smallest(self, rate: float) -> float:
        """Return the smallest bound of what is minimised, sought again in its own unit."""
        unit, failure = self._guess(), None
        for step in range(_UNITS):
            try:
                found = self._optimum(unit, rate)
            except SolverError as error:  # a unit far from the optimum spoils the numbers
                failure, unit = error, 10.0 * unit
                continue
            if 0.1 < found / unit < 10.0 or step == _UNITS - 1:
                return found
            unit = found
        raise failure or SolverError("the unit of what is minimised did not settle. Report it.")

    def _optimum(self, unit: float, rate: float) -> float:
        """Return the smallest bound from one program, in some unit."""
        cp = modelling()
        v, level = self.variables(), cp.Variable()
        # picks one of the many X and Y, and keeps them finite
        little = 1e-7 * (cp.trace(v.X) + cp.trace(v.Y))
        program = cp.Problem(cp.Minimize(level + little), self.program(v, level, unit, rate))
        self._solve(program)
        found = max(float(level.value), 1e-12)
        return float(unit * (np.sqrt(found) if isinstance(self.minimize, H2) else found))

    def controller(self, bound: float, rate: float) -> StateSpace:
        """Return a moderate controller for a bound on what is minimised."""
        cp = modelling()

        v = self.variables()
        program = cp.Problem(cp.Minimize(size(v)), self.program(v, 1.0, bound, rate))
        self._solve(program)
        A, B, C, D = v.controller()
        g = self.given
        D22 = g.system.D[len(g.z) :, len(g.w) :]
        loop = np.linalg.inv(np.eye(D.shape[0]) + D @ D22)  # u = K (y - D22 u)
        return StateSpace(
            A - B @ D22 @ loop @ C,
            B @ (np.eye(B.shape[1]) - D22 @ loop @ D),
            loop @ C,
            loop @ D,
            g.dt,
            inputs=g.y,
            outputs=g.u,
            name="lmi",
            units=g.units,
        )

    def _solve(self, program: Any) -> None:
        """Solve a program, less accurately where it stops before its tolerance."""
        for i, tolerance in enumerate(_TOLERANCES, 1):
            names = ("tol_gap_abs", "tol_gap_rel", "tol_feas")
            try:
                settings = dict.fromkeys(names, tolerance)
                # every claim is verified by the closed loop: a little violation is no harm
                solve_program(program, settings, violation=10.0 * tolerance)
            except SolverError:
                if i == len(_TOLERANCES):
                    raise
                continue
            return

    def _guess(self) -> float:
        """Return the open gain of what is minimised, away from its poles."""
        own = self.channel(self.minimize, 1.0)
        p = self.plant
        s = 1.3 + 0.7j
        part = np.linalg.solve(s * np.eye(p.A.shape[0]) - p.A, p.B1[:, own.columns])
        gain = float(np.linalg.norm(p.C1[own.rows] @ part + p.D11[np.ix_(own.rows, own.columns)]))
        return (gain or 1.0) / own.unit

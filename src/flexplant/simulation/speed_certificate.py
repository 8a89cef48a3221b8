"""How fast a machine may move and stay stable: a Lyapunov function that depends on its position.

``V = x' P(p) x`` of plant and controller together falls from sample to sample when
``A(p, v)' P(p + v h) A(p, v) < P(p)`` for all positions p and speeds v up to the largest: then the
loop is stable along every path that is no faster. P is linear between nodes.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, field
from itertools import product
from math import comb
from typing import NamedTuple

import numpy as np
import scipy.linalg as la

from ..checks import FloatArray, Value, checked, positive, real_array, whole
from ..errors import AssumptionError, only_one
from ..loop import ClosedLoop, ScheduledLoop
from ..lti.equations import symmetrised
from ..lti.lyapunov import solve_stein
from ..parallel import Progress, expect, one_thread
from ..plant import Ports
from .moving_machine import MovingMachine, Trajectory, known_positions, unscheduled

#: how much of the decay of the slowest pole the Stein equations of the nodes keep: P that decays as
#: fast as the loop itself changes fast with the position
_DECAYS = (0.7, 0.3)
#: rounds in which the decay is asked for where P changes: the speed ceases to rise after three
_ROUNDS = 4
#: of the speed that the nodes allow, what is tried between them
_SHARES = (0.95, 0.8, 0.6, 0.4, 0.2)
#: halvings of an interval between nodes before it is given up: a kink of the rows, at the edge of
#: an element, is then confined to 1e-4 of it
_DEPTH = 13
#: the error of a quadratic, measured at two points of an interval, times this is taken as its bound
_SAFE = 2.0
#: multiplications for each node, of n^3, and time of calls [s]: what is said before the start
_PRODUCTS, _CALLS = 2200.0, 0.04
#: a quadratic for A(p) and a line for P make polynomials of degree 5
_DEGREE = 5


@dataclass(frozen=True, eq=False, repr=False)
class SpeedCertificate(Value):
    """A speed up to which a loop is stable on every path; made by `certify_speed`.

    Parameters
    ----------
    position : str
        The position that moves.
    speed : float [m/s or rad/s]
        The largest speed of it for which stability is proven.
    nodes : (k,) array [m or rad]
        Positions where P is given, linear between them.
    P : (k, n, n) array
        Of the Lyapunov function ``x' P x``, over the states of plant and controller.
    attempts : sequence of (speed, failed_at)
        Speeds that were tried, each with the position where no proof was found; the last is proven.
    """

    position: str
    speed: float = field(metadata=checked(positive))
    nodes: FloatArray = field(metadata=checked(real_array, shape=(None,)))
    P: FloatArray = field(metadata=checked(real_array, shape=("nodes", None, None)))
    attempts: tuple[tuple[float, float | None], ...]

    def __repr__(self) -> str:
        low, high = self.nodes[0], self.nodes[-1]
        return (
            f"<SpeedCertificate: stable on every path of {self.position} up to {self.speed:.3g} a "
            f"second, from {low:g} to {high:g}; {self.nodes.size} nodes>"
        )


@one_thread()
def certify_speed(
    loop: ClosedLoop | ScheduledLoop,
    speed: float | None = None,
    *,
    position: str | None = None,
    nodes: int = 41,
    progress: bool | None = None,
) -> SpeedCertificate:
    """Return the proof that a loop is stable however its machine moves, up to a speed.

    Found is ``P(p)``, linear between nodes, with ``A(p, v)' P(p + v h) A(p, v) < P(p)`` for every
    position in its range and every speed ``|v|`` up to the largest; A is that of plant and
    controller over one sample h, forces and sensors moving within it. It is sufficient, not
    necessary: beyond the speed found a loop may well be stable, which `rms_along` with repeats
    answers for one trajectory.

    Parameters
    ----------
    loop : ClosedLoop or ScheduledLoop
        Around a sampled plant with positions.
    speed : float, optional [m/s or rad/s]
        To prove; the highest that is found when not given.
    position : str, optional
        The position that moves; the only one when not given. Others stay where the plant stands.
    nodes : int
        Positions where P is found, over the range; the places of a schedule come on top.
    progress : bool, optional
        A bar, as for `fx.design_hinf`.

    Returns
    -------
    SpeedCertificate

    Raises
    ------
    AssumptionError
        When the loop is unstable at a node, or no proof is found.
    LabelError
        When the position is unknown, or not named among several.
    ModelError
        When nothing moves, or a port that moves has dynamics of its own.

    Notes
    -----
    At each node P solves the Stein equation ``A' P A / r^2 - P + Q = 0``, with r between the
    spectral radius and one. Q begins as the inverse mean Gramian of the loop; then it is what P
    changes by between nodes, so that V falls fast where it also changes fast.

    Between nodes A(p) is a quadratic, whose error is measured and counted twice, and the inequality
    a polynomial of degree five in p: it holds where the coefficients in Bernstein's basis are
    positive definite, which Cholesky factors decide. Intervals where they are not are halved.

    References
    ----------
    [Wu1996]_ (parameter-dependent Lyapunov functions), [Garloff1993]_ (Bernstein's basis).

    Examples
    --------
    >>> import flexplant as fx
    >>> plate = fx.kirchhoff_plate(size=(0.6, 0.6), thickness=0.0272, elements=(8, 8),
    ...     density=2702, youngs_modulus=70e9, poisson_ratio=0.35)
    >>> places = [(x, y, 0.0) for y in (0.1, 0.5) for x in (0.2, 0.4)]
    >>> ports = fx.Ports(
    ...     u=[fx.Actuator(f"u{i}", at=p, asd=1e-3) for i, p in enumerate(places)],
    ...     z=[fx.Poi("die", at=(0.3, 0.3, 0.0), axes=("z", "rx", "ry"), moves={"x": (-1, 0, 0)})],
    ...     y=[fx.Sensor(f"y{i}", at=p, asd=1e-12, moves={"x": (-1, 0, 0)})
    ...        for i, p in enumerate(places)],
    ...     references=[fx.Reference("die")],
    ...     positions=[fx.plant.Position("x", range=(-0.05, 0.05))],
    ... )
    >>> modes = fx.solve_modes(plate, count=6, damping=fx.ModalDamping(0.01))
    >>> plant = fx.assemble_plant(modes, ports).discretized(5e3, delay=1)
    >>> observer = fx.design_kalman(plant)
    >>> loop = fx.close_loop(plant, observer, fx.design_servo(plant, bandwidth=25.0))
    >>> fx.simulation.certify_speed(loop, 0.8, nodes=11).speed
    0.8
    """
    motion = _Motion.of(loop, position)
    if speed is not None:
        positive(speed, "speed")
    places = _nodes(motion, whole(nodes, "nodes", minimum=3))
    attempts: list[tuple[float, float | None]] = []
    advice = "Fewer nodes or a plant of fewer modes take less."
    with Progress(None, "proof of a speed", progress=progress, advice=advice):
        expect(_PRODUCTS * places.size * motion.scale.size**3, seconds=_CALLS * places.size)
        found = _NodeFunctions(motion, places, np.inf if speed is None else speed / _SHARES[0])
        wished = [share * found.speed for share in _SHARES] if speed is None else [float(speed)]
        for v in wished:
            failed = _unproven(motion, places, found.P, v)
            attempts.append((v, failed))
            if failed is None:
                P = np.array([motion.unscaled(one) for one in found.P])
                return SpeedCertificate(motion.position, v, places, P, tuple(attempts))
    raise AssumptionError(
        f"no proof was found that the loop is stable while {motion.position} moves with "
        f"{wished[-1]:.3g} a second: it fails near {motion.position} = {attempts[-1][1]:.4g}"
        f" (the nodes alone would allow {found.speed:.3g}). Take more nodes, a slower path, or "
        "simulation.rms_along(..., repeats=True) for the growth along one path."
    )


class _Motion:
    """The loop's matrix over position and speed, in coordinates where all states count alike."""

    def __init__(self, loop: ClosedLoop, schedule: ScheduledLoop | None, position: str) -> None:
        self.loop, self.schedule, self.position = loop, schedule, position
        self.h = float(loop.machine.dt)
        self.scale = np.ones(loop.machine.system.n_states + loop.controller.n_states)
        self.factor = np.eye(self.scale.size)
        self._known: dict[tuple[float, float], FloatArray] = {}
        standing = Trajectory(tuple(self._ports.positions), {position: np.zeros_like}, {})
        self.machine = MovingMachine(loop, standing, noise=True, schedule=schedule)
        self.machine.stretch = 1

    @classmethod
    def of(cls, loop: ClosedLoop | ScheduledLoop, position: str | None) -> _Motion:
        """Return the motion of a loop, refused when nothing moves."""
        own, schedule = unscheduled(loop)
        known = [one.name for one in known_positions(own.machine, "a speed is proven of")]
        if schedule is not None and position is None:
            position = schedule.position
        return cls(own, schedule, only_one("position", known, position, "position="))

    @property
    def _ports(self) -> Ports:
        return self.loop.machine.assembled.ports

    @property
    def range(self) -> tuple[float, float]:
        """The least and the largest value of the position."""
        one = next(p for p in self._ports.positions if p.name == self.position)
        return float(one.range[0]), float(one.range[1])

    def closed(self, p: float, v: float = 0.0) -> tuple[FloatArray, FloatArray]:
        """Return A of the closed loop in a sample that begins at p with a speed, and G of noise."""
        low, high = self.range
        paths = {self.position: lambda t: np.clip(p + v * np.asarray(t), low, high)}
        self.machine.path = Trajectory(tuple(self._ports.positions), paths, self._ports.values)
        A, G, _, _ = self.machine.closed(0, next(self.machine.each(1)))
        return A, G

    def A(self, p: float, v: float) -> FloatArray:
        """Return A in the coordinates of the certificate."""
        if (p, v) not in self._known:
            own, _ = self.closed(p, v)
            inner = la.solve_triangular(
                self.factor, own * self.scale / self.scale[:, None] @ self.factor, lower=True
            )
            self._known[p, v] = inner
        return self._known[p, v]

    def balance(self, pairs: list[tuple[FloatArray, FloatArray]]) -> None:
        """Take coordinates in which the mean Gramian, of noise on every state, is one."""
        noisy = np.mean([np.diag(solve_stein(A, G @ G.T)) for A, G in pairs], axis=0)
        least = noisy[noisy > 0].min(initial=np.inf)
        # states that no noise moves: as large as the least of the others
        self.scale = np.sqrt(np.where(noisy > 0, noisy, least if np.isfinite(least) else 1.0))
        eye = np.eye(self.scale.size)
        W = np.mean(
            [solve_stein(A * self.scale / self.scale[:, None], eye) for A, _ in pairs], axis=0
        )
        self.factor = np.linalg.cholesky(W)
        self._known.clear()

    def unscaled(self, P: FloatArray) -> FloatArray:
        """Return P over the loop's own states: both scalings undone."""
        inverse = la.solve_triangular(self.factor, np.diag(1.0 / self.scale), lower=True)
        return symmetrised(inverse.T @ P @ inverse)


def _nodes(motion: _Motion, count: int) -> FloatArray:
    """Return positions over the range, those of the schedule, which is linear between, included."""
    low, high = motion.range
    grid = np.linspace(low, high, count)
    if motion.schedule is None:
        return grid
    own = motion.schedule.places
    inside = own[(own > low) & (own < high)]
    # a node of the grid that is nearly a place of the schedule would make a sliver
    apart = np.abs(grid[:, None] - inside).min(axis=1, initial=np.inf) > 0.1 * (grid[1] - grid[0])
    apart[[0, -1]] = True
    return np.unique(np.concatenate([grid[apart], inside]))


class _NodeFunctions:
    """P at the nodes that allows the highest speed there, or the one that is enough."""

    def __init__(self, motion: _Motion, nodes: FloatArray, enough: float = np.inf) -> None:
        self.motion, self.nodes, self.enough = motion, nodes, enough
        pairs = [motion.closed(p) for p in nodes.tolist()]
        radii = [float(np.abs(np.linalg.eigvals(A)).max(initial=0.0)) for A, _ in pairs]
        worst = int(np.argmax(radii))
        if radii[worst] >= 1.0:
            raise AssumptionError(
                f"the loop is not stable where the machine stands at {motion.position} = "
                f"{nodes[worst]:.4g} (spectral radius {radii[worst]:.6g}): it is on no path through"
                " it. Take less bandwidth, or schedule the design."
            )
        motion.balance(pairs)
        self.A = [motion.A(p, 0.0) for p in nodes.tolist()]
        self.between = [motion.A(p, 0.0) for p in (0.5 * (nodes[1:] + nodes[:-1])).tolist()]
        self.P: list[FloatArray] = []
        self.speed = 0.0
        for decay in _DECAYS:
            if not self.P or self.speed < enough < np.inf:
                self._search(1.0 - (1.0 - radii[worst]) * (1.0 - decay))
        if not self.P:
            raise AssumptionError(
                f"no Lyapunov function that is linear between {nodes.size} nodes shows the loop "
                f"stable while {motion.position} stands: its matrices change too much from node to "
                "node. Take more nodes."
            )

    def _search(self, r: float) -> None:
        """Try Q that follows where P changes; keep the best."""
        Q = np.eye(len(self.A[0]))
        for _ in range(_ROUNDS):
            P = [solve_stein((A / r).T, Q) for A in self.A]
            slopes = _slopes(P, self.nodes)
            speed = self._allowed(P, slopes)
            if speed > self.speed:
                self.P, self.speed = P, speed
            if speed >= self.enough:
                return
            change = np.sum([_absolute(S) for S in slopes], axis=0)
            size = np.trace(change)
            if not size > 0:
                return
            Q = Q / np.trace(Q) + change / size

    def _allowed(self, P: list[FloatArray], slopes: list[FloatArray]) -> float:
        """Return the speed that nodes and the middles between them allow; 0 when V grows."""
        least = np.inf
        for j, S in enumerate(slopes):
            middle = 0.5 * (P[j] + P[j + 1])
            ends = (self.A[j], P[j]), (self.between[j], middle), (self.A[j + 1], P[j + 1])
            for A, own in ends:
                M = symmetrised(own - A.T @ own @ A)
                if not _is_positive(M):
                    return 0.0
                rate = la.eigh(symmetrised(A.T @ S @ A), M, eigvals_only=True)
                fastest = max(float(rate[-1]), -float(rate[0]))
                least = min(least, 1.0 / (fastest * self.motion.h)) if fastest > 0 else least
        return least


def _slopes(P: list[FloatArray], nodes: FloatArray) -> list[FloatArray]:
    return [(P[j + 1] - P[j]) / (nodes[j + 1] - nodes[j]) for j in range(len(P) - 1)]


def _absolute(S: FloatArray) -> FloatArray:
    """Return |S|: the same eigenvectors, positive eigenvalues."""
    size, V = np.linalg.eigh(symmetrised(S))
    return np.asarray((V * np.abs(size)) @ V.T)


def _is_positive(M: FloatArray) -> bool:
    try:
        np.linalg.cholesky(M)
    except np.linalg.LinAlgError:
        return False
    return True


def _unproven(
    motion: _Motion, nodes: FloatArray, P: list[FloatArray], speed: float
) -> float | None:
    """Return a position where the inequality is not shown for a speed; None when it is for all."""
    for p, own in zip(nodes.tolist(), P, strict=True):
        if not _is_positive(own):
            return float(p)
    slopes = _slopes(P, nodes)
    step = speed * motion.h
    for j, S in enumerate(slopes):
        # P of the next sample lies on the slopes that one step reaches
        reach = [
            slopes[i] for i in range(len(slopes))
            if i != j and nodes[i] < nodes[j + 1] + step and nodes[i + 1] > nodes[j] - step
        ]  # fmt: skip
        ends = nodes[j], nodes[j + 1]
        failed = _interval(motion, ends, (P[j], S), reach, speed)
        if failed is not None:
            return float(failed)
    return None


def _interval(
    motion: _Motion,
    ends: tuple[float, float],
    line: tuple[FloatArray, FloatArray],
    reach: list[FloatArray],
    speed: float,
) -> float | None:
    """Halve an interval between nodes until each part is shown, or one is not at a point of it."""
    P0, S = line
    step, open_parts = speed * motion.h, [(*ends, 0)]
    while open_parts:
        low, high, depth = open_parts.pop()
        parts = [P0 + (p - ends[0]) * S for p in (low, high)]
        near = low - step < ends[0] or high + step > ends[1]
        moves = [step * own for own in ([S, *reach] if near else [S])]
        if _inequality_holds(motion, (low, high), parts, moves, speed):
            continue
        middle = 0.5 * (low + high)
        own = 0.5 * (parts[0] + parts[1])
        if depth == _DEPTH or not _holds_at(motion, middle, own, moves, speed):
            return middle
        open_parts += [(low, middle, depth + 1), (middle, high, depth + 1)]
    return None


def _holds_at(
    motion: _Motion, p: float, P: FloatArray, moves: list[FloatArray], speed: float
) -> bool:
    """Return whether the inequality holds at one position, at rest and at both speeds."""
    return all(
        _is_positive(symmetrised(P - A.T @ (P + sign * move) @ A))
        for move in moves
        for sign, A in ((s, motion.A(p, s * speed)) for s in (-1.0, 0.0, 1.0))
    )


def _inequality_holds(
    motion: _Motion,
    ends: tuple[float, float],
    P: list[FloatArray],
    moves: list[FloatArray],
    speed: float,
) -> bool:
    """Return whether the inequality holds all over a part, for all speeds up to the largest."""
    # between rest and full speed A and P+ are linear in the speed, and `A' P+ A` lies below the
    # same combination of its four corners: each of A at rest and at speed, with each P+
    matrices = {s: _Quadratic.of(motion, ends, s * speed) for s in (-1.0, 0.0, 1.0)}
    error = max(one.error(P) for one in matrices.values())
    if not error < 1.0:
        return False
    corners = [(0.0, 0.0 * P[0])]
    for sign in (-1.0, 1.0):
        corners += [(a, sign * move) for move in moves for a in (0.0, sign)]
        corners.append((sign, 0.0 * P[0]))
    return all(
        _is_positive(symmetrised(part))
        for sign, move in corners
        for part in _coefficients(matrices[sign], P, move, error)
    )


class _Quadratic(NamedTuple):
    """A over a part of the range through its ends and middle, in Bernstein's basis.

    And how far it is off at both quarters.
    """

    bernstein: list[FloatArray]
    off: list[FloatArray]

    @classmethod
    def of(cls, motion: _Motion, ends: tuple[float, float], speed: float) -> _Quadratic:
        """Return A over a part of the range for a speed."""
        low, high = ends
        at = low + (high - low) * np.array([0.0, 0.25, 0.5, 0.75, 1.0])
        first, second, middle, fourth, last = (motion.A(p, speed) for p in at.tolist())
        a, b, c = first, 2.0 * middle - 0.5 * (first + last), last
        exact = ((0.25, second), (0.75, fourth))
        off = [A - ((1 - t) ** 2 * a + 2 * t * (1 - t) * b + t * t * c) for t, A in exact]
        return cls([a, b, c], off)

    def error(self, P: list[FloatArray]) -> float:
        """Return the bound of its error, in the norm of P at the two ends."""
        roots = [np.linalg.cholesky(own) for own in P]
        sizes = [
            np.linalg.norm(la.solve_triangular(L, (L.T @ one).T, lower=True), 2)
            for L in roots
            for one in self.off
        ]
        return _SAFE * float(max(sizes))


def _coefficients(
    A: _Quadratic, P: list[FloatArray], move: FloatArray, error: float
) -> Iterator[FloatArray]:
    """Yield Bernstein coefficients of ``(1 - e - e^2) P - (1 + e) A' (P + move) A``, degree 5."""
    # with `(A + E)' P (A + E) <= (1 + e) A' P A + (1 + 1/e) E' P E` and `E' P E <= e^2 P`
    n = _DEGREE
    left, right = (1.0 - error - error**2), 1.0 + error
    for k in range(n + 1):
        own = ((n - k) * P[0] + k * P[1]) / n
        total = np.zeros_like(own)
        for a, b in product(range(3), repeat=2):
            if (c := k - a - b) in (0, 1):
                weight = comb(2, a) * comb(2, b) / comb(n, k)
                total += weight * (A.bernstein[a].T @ (P[c] + move) @ A.bernstein[b])
        yield left * own - right * total

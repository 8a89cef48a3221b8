"""The LMIs of several objectives: one Lyapunov matrix for all [Scherer1997]_."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, NamedTuple

import numpy as np

from ..lmi_plant import Plant
from ..lmi_programs import modelling, symmetric_blocks
from ..lmi_solution import Matrices, changed_back
from .sampled_poles import PoleDisc, PoleEdge

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

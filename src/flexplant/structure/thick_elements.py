"""Elements of beams and plates that shear: bending, shear and rotary inertia without locking."""

from __future__ import annotations

from collections.abc import Sequence
from itertools import combinations_with_replacement
from typing import Any, NamedTuple, TypeAlias

import numpy as np

from ..arrays import FloatArray
from .element_matrices import PLATE_CORNERS

# The shear of an edge is constant and the slope of the section along it quadratic: between ends
# that turn by t1, t2 and move by z1, z2 over a length L,
#     shear = (1 - f) d,  slope = linear + 6 s (1 - s) f d,  d = (z2 - z1) / L - (t1 + t2) / 2,
# with f = 1 / (1 + 12 B / (G L^2)), B the bending and G the shear stiffness, which makes an edge an
# exact Timoshenko beam ([FriedmanKosmatka1993]_). In a plate both carry over linearly to the
# opposite edge: the element of [Katili1993]_ on a rectangle. f = 1 is an edge that does not shear.

#: number of points in each direction, which integrates products of two cubics exactly
_POINTS = 4


def edge_share(softness: Any, length: float) -> Any:
    """Return f of an edge whose bending stiffness is `softness` [m^2] of its shear stiffness."""
    return 1.0 / (1.0 + 12.0 * np.asarray(softness) / length**2)


def beam_parts(s: FloatArray, length: float) -> tuple[FloatArray, FloatArray]:
    """Return the parts (2, p, 4) of deflection and slope of the section that f^0 and f^1 weigh."""
    s, one = np.asarray(s, dtype=np.float64)[:, None], np.ones((np.size(s), 1))
    excess = np.array([-1.0 / length, -0.5, 1.0 / length, -0.5])
    bow = -0.5 * length * s * (1.0 - s) * np.array([0.0, -1.0, 0.0, 1.0])
    z = np.hstack([1.0 - s, 0.0 * s, s, 0.0 * s]) + bow
    slope = np.hstack([0.0 * s, 1.0 - s, 0.0 * s, s])
    cubic = length * s * (1.0 - s) * (2.0 * s - 1.0)
    return (np.stack([z, cubic * excess]), np.stack([slope * one, 6.0 * s * (1.0 - s) * excess]))


def beam_terms(length: float) -> tuple[list[FloatArray], list[FloatArray], FloatArray]:
    """Return masses and rotary inertias (4, 4) by powers 0, 1, 2 of f, and what (1 - f) weighs.

    A beam's stiffness is ``B (f K + (1 - f) K1)`` with K of a beam that does not shear.
    """
    points, weights = np.polynomial.legendre.leggauss(_POINTS)
    z, slope = beam_parts(0.5 * (points + 1.0), length)
    area = 0.5 * length * weights[:, None]
    turning = np.array([0.0, -1.0, 0.0, 1.0])
    return _powers(z, area), _powers(slope, area), np.outer(turning, turning) / length


def _powers(parts: FloatArray, area: FloatArray) -> list[FloatArray]:
    """Return the integrals of a product of two parts, by the power of f that weighs them."""
    first, second = parts
    both = first.T @ (area * second)
    return [first.T @ (area * first), both + both.T, second.T @ (area * second)]


class PlateParts(NamedTuple):
    """Fields of an element at p points, in terms of its DOFs z, rx, ry at four corners.

    The first axis of (3, p, 12) holds the parts that 1, f along x and f along y weigh.
    """

    z: FloatArray
    #: slopes dz/dx and dz/dy of the section
    slopes: tuple[FloatArray, FloatArray]
    #: their derivatives along the same axis, and the twist, the sum of the other two
    curvatures: tuple[FloatArray, FloatArray, FloatArray]
    #: (p, 12): the shear along x and y, over 1 - f of that direction
    shears: tuple[FloatArray, FloatArray]


def plate_parts(s: Any, t: Any, a: float, b: float) -> PlateParts:
    """Return the fields of an element a x b at points s, t (p,) between 0 and 1."""
    place = [np.reshape(np.asarray(one, dtype=np.float64), (-1, 1)) for one in (s, t)]
    # the weights (p, 2) of an edge along x are those of its two places in y
    at_y, at_x = across = [np.hstack([1.0 - one, one]) for one in place[::-1]]
    lengths, count = (a, b), len(place[0])
    low_high = np.array([-1.0, 1.0])
    corner = at_x[:, [0, 1, 0, 1]] * at_y[:, [0, 0, 1, 1]]
    along = (
        at_y[:, [0, 0, 1, 1]] * low_high[[0, 1, 0, 1]] / a,
        at_x[:, [0, 1, 0, 1]] * low_high[[0, 0, 1, 1]] / b,
    )

    def spread(values: FloatArray, column: int, sign: float = 1.0) -> FloatArray:
        found = np.zeros((count, 4, 3))
        found[:, :, column] = sign * values
        return found.reshape(count, 12)

    z, twist = (np.zeros((3, count, 12)) for _ in range(2))
    z[0] = spread(corner, 0)
    slopes, bends, shears = [], [], []
    for axis in range(2):
        # the two edges along an axis, by their corners; the DOF of their slope and its sign
        edges = [(i, i + 1 + axis) for i in np.flatnonzero(PLATE_CORNERS[:, axis] == 0).tolist()]
        column, sign = 2 - axis, 2.0 * axis - 1.0
        x, length, other, blend = place[axis], lengths[axis], 1 - axis, across[axis]
        excess, turn = _edge_rows(edges, column, sign, length)
        bubble = 6.0 * x * (1.0 - x)
        z[0] -= length / 12.0 * bubble * (blend @ turn)
        z[1 + axis] = length / 6.0 * bubble * (2.0 * x - 1.0) * (blend @ excess)
        slope, bend = (np.zeros((3, count, 12)) for _ in range(2))
        slope[0], slope[1 + axis] = spread(corner, column, sign), bubble * (blend @ excess)
        bend[0] = spread(along[axis], column, sign)
        bend[1 + axis] = 6.0 * (1.0 - 2.0 * x) / length * (blend @ excess)
        twist[0] += spread(along[other], column, sign)
        twist[1 + axis] = bubble * (low_high @ excess) / lengths[other]
        slopes.append(slope)
        bends.append(bend)
        shears.append(blend @ excess)
    return PlateParts(
        z, (slopes[0], slopes[1]), (bends[0], bends[1], twist), (shears[0], shears[1])
    )


def _edge_rows(
    edges: Sequence[tuple[int, int]], column: int, sign: float, length: float
) -> tuple[FloatArray, FloatArray]:
    """Return (2, 12) each: chord less mean slope of two edges, and how far their ends turn."""
    excess, turn = np.zeros((2, 4, 3)), np.zeros((2, 4, 3))
    for k, (start, end) in enumerate(edges):
        excess[k, [start, end], 0] = np.array([-1.0, 1.0]) / length
        excess[k, [start, end], column] = -0.5 * sign
        turn[k, [start, end], column] = np.array([-sign, sign])
    return excess.reshape(2, 12), turn.reshape(2, 12)


#: element matrices and their weights: numbers or fields (ny, nx)
Terms: TypeAlias = list[tuple[FloatArray, Any]]


def plate_terms(
    a: float, b: float, softness: Any, *, mass: Any, rotary: Any, bending: Any, nu: Any
) -> tuple[Terms, Terms]:
    """Return the terms of M and K of plate elements a x b.

    `softness` is the bending stiffness over the shear stiffness, `mass` that per area, `rotary` the
    inertia ``rho h^3 / 12`` and `bending` the stiffness ``E h^3 / 12 (1 - nu^2)``.
    """
    line, weights = np.polynomial.legendre.leggauss(_POINTS)
    s, t = (one.ravel() for one in np.meshgrid(0.5 * (line + 1.0), 0.5 * (line + 1.0)))
    area = 0.25 * a * b * np.outer(weights, weights).reshape(-1, 1)
    parts = plate_parts(s, t, a, b)
    xx, yy, xy = parts.curvatures
    f = (1.0, edge_share(softness, a), edge_share(softness, b))
    M: Terms = []
    K: Terms = []
    for i, j in combinations_with_replacement(range(3), 2):

        def of(one: FloatArray, other: FloatArray, i: int = i, j: int = j) -> FloatArray:
            both = one[i].T @ (area * other[j]) + (one[j].T @ (area * other[i]) if i != j else 0.0)
            return np.asarray(0.5 * (both + both.T))

        weight = f[i] * f[j]
        M.append((of(parts.z, parts.z), weight * mass))
        along_x, along_y = parts.slopes
        M.append((of(along_x, along_x) + of(along_y, along_y), weight * rotary))
        K.append((of(xx, xx) + of(yy, yy) + 0.5 * of(xy, xy), weight * bending))
        K.append((2.0 * of(xx, yy) - 0.5 * of(xy, xy), weight * bending * nu))
    for one, share, length in zip(parts.shears, f[1:], (a, b), strict=True):
        # the shear stiffness times (1 - f)^2, also where it is infinite
        scaled = 12.0 / length**2 * share
        own = one.T @ (area * one)
        K.append((0.5 * (own + own.T), bending * softness * scaled**2))
    return _collected(M), _collected(K)


def _collected(terms: Terms) -> Terms:
    """Return the sum of the terms where all weights are numbers."""
    if any(np.ndim(weight) for _, weight in terms):
        return terms
    return [(np.asarray(sum(weight * matrix for matrix, weight in terms)), 1.0)]

"""Element matrices: beams, plates in bending, bricks, for unit material and sizes a, b, c."""

from __future__ import annotations

from functools import cache
from itertools import product
from typing import Any

import numpy as np

from ...checks import FloatArray, IntArray

# the plate's twelve-term polynomial: x^p y^q in coordinates from 0 to 1 over the element
_P = np.array([0, 1, 0, 2, 1, 0, 3, 2, 1, 0, 3, 1])
_Q = np.array([0, 0, 1, 0, 1, 2, 0, 1, 2, 3, 1, 3])
#: corners of a plate element, x fastest
PLATE_CORNERS = np.array([[0, 0], [1, 0], [0, 1], [1, 1]])
#: corners of a brick, x fastest
BRICK_CORNERS = np.array([corner[::-1] for corner in product((0, 1), repeat=3)])


def beam_stiffness(length: float) -> FloatArray:
    """Return the bending stiffness (4, 4) of z, dz/dx at both ends, for E I = 1."""
    h = length
    half = np.array(
        [[6, 3 * h, -6, 3 * h], [0, 2 * h**2, -3 * h, h**2], [0, 0, 6, -3 * h], [0, 0, 0, 2 * h**2]]
    )
    return _mirrored(2 * half / h**3)


def beam_mass(length: float) -> FloatArray:
    """Return the consistent mass (4, 4) of a beam in bending, for unit mass per length."""
    h = length
    half = np.array(
        [
            [156, 22 * h, 54, -13 * h],
            [0, 4 * h**2, 13 * h, -3 * h**2],
            [0, 0, 156, -22 * h],
            [0, 0, 0, 4 * h**2],
        ]
    )
    return _mirrored(half * h / 420)


def beam_rotary(length: float) -> FloatArray:
    """Return the inertia (4, 4) of the cross sections turning with the slope, for rho I = 1."""
    h = length
    half = np.array(
        [
            [36, 3 * h, -36, 3 * h],
            [0, 4 * h**2, -3 * h, -(h**2)],
            [0, 0, 36, -3 * h],
            [0, 0, 0, 4 * h**2],
        ]
    )
    return _mirrored(half / (30 * h))


def hermite(s: float, length: float, order: int = 0) -> FloatArray:
    """Return the weights (4,) of z, dz/dx at both ends in z (or its slope) at s from 0 to 1."""
    if order == 0:
        cubic = 3 * s**2 - 2 * s**3
        return np.array(
            [1 - cubic, length * s * (1 - s) ** 2, cubic, length * (s**3 - s**2)], dtype=np.float64
        )
    bow = 6 * (s - s**2)
    return np.array([-bow / length, 1 - 4 * s + 3 * s**2, bow / length, 3 * s**2 - 2 * s])


def plate_terms(s: Any, t: Any, dp: int, dq: int) -> FloatArray:
    """Return the d^dp/ds^dp d^dq/dt^dq derivatives (..., 12) of the terms s^p t^q."""
    return _derived(_P, s, dp) * _derived(_Q, t, dq)


def _derived(power: IntArray, x: Any, order: int) -> FloatArray:
    factor = np.ones(power.size)
    for k in range(order):
        factor *= power - k
    return np.asarray(
        factor * np.power(np.asarray(x, float)[..., None], np.maximum(power - order, 0)),
        dtype=np.float64,
    )


@cache
def _unit_coefficients() -> FloatArray:
    """Return the polynomial coefficients (12, 12) of unit DOFs z, dz/dt, -dz/ds at the corners."""
    rows = []
    for s, t in PLATE_CORNERS.astype(float):
        rows += [plate_terms(s, t, 0, 0), plate_terms(s, t, 0, 1), -plate_terms(s, t, 1, 0)]
    return np.round(np.linalg.inv(np.array(rows)), 6)  # small whole numbers


def plate_coefficients(a: float, b: float) -> FloatArray:
    """Return the coefficients (12, 12) of unit DOFs z, rx, ry of an element a x b."""
    return np.asarray(_unit_coefficients() * np.tile([1.0, b, a], 4), dtype=np.float64)


def _product(first: tuple[int, int], second: tuple[int, int]) -> FloatArray:
    """Return the exact integrals (12, 12) of products of derivatives over the unit square."""

    def factor(power: IntArray, order: int) -> IntArray:
        return power * (power - 1) if order == 2 else power if order == 1 else np.ones_like(power)

    p = np.add.outer(_P - first[0], _P - second[0])
    q = np.add.outer(_Q - first[1], _Q - second[1])
    scale = np.outer(
        factor(_P, first[0]) * factor(_Q, first[1]), factor(_P, second[0]) * factor(_Q, second[1])
    )
    # where a derivative vanishes its power may be negative
    return np.asarray(scale / (np.maximum(p, 0) + 1) / (np.maximum(q, 0) + 1), dtype=np.float64)


def plate_mass(a: float, b: float) -> FloatArray:
    """Return the consistent mass (12, 12) of a plate element for unit mass per area."""
    shape = plate_coefficients(a, b)
    return _symmetrised(a * b * shape.T @ _product((0, 0), (0, 0)) @ shape)


def plate_stiffness(a: float, b: float) -> tuple[FloatArray, FloatArray]:
    """Return K0, K1 (12, 12): the stiffness is ``E t^3 / 12 (1 - nu^2) (K0 + nu K1)``."""
    xx, yy, xy = (2, 0), (0, 2), (1, 1)
    cross = _product(xx, yy) / (a * b) ** 2
    twist = 2 * _product(xy, xy) / (a * b) ** 2
    shape = plate_coefficients(a, b)
    plain = _product(xx, xx) / a**4 + _product(yy, yy) / b**4 + twist
    return (
        _symmetrised(a * b * shape.T @ plain @ shape),
        _symmetrised(a * b * shape.T @ (cross + cross.T - twist) @ shape),
    )


def brick_shape(point: FloatArray) -> FloatArray:
    """Return the weights (8,) of the corners at a point (3,) of the unit cube."""
    return np.asarray(np.prod(np.where(BRICK_CORNERS, point, 1 - point), axis=1))


def brick_slopes(point: FloatArray) -> FloatArray:
    """Return the derivatives (8, 3) of the corners' weights along the three unit coordinates."""
    parts = np.where(BRICK_CORNERS, point, 1 - point)
    signs = np.where(BRICK_CORNERS, 1.0, -1.0)
    return np.column_stack([signs[:, k] * np.delete(parts, k, 1).prod(axis=1) for k in range(3)])


def brick_mass(a: float, b: float, c: float) -> FloatArray:
    """Return the consistent mass (24, 24) of a brick, x y z at its corners, for unit density."""
    line = np.array([[2.0, 1.0], [1.0, 2.0]]) / 6
    return np.asarray(a * b * c * np.kron(np.kron(line, np.kron(line, line)), np.eye(3)))


def brick_stiffness(a: float, b: float, c: float, nu: float) -> FloatArray:
    """Return the stiffness (24, 24) of a brick for E = 1, three bending modes inside condensed.

    Trilinear displacements and, for each of x, y, z, the incompatible parabolas 1 - xi^2: without
    them a brick in bending shears and is far too stiff (Wilson and Taylor; on rectangular elements
    the patch test holds as it stands).
    """
    law = np.diag([0.5 * (1 - 2 * nu)] * 6)
    law[:3, :3] += nu + 0.5 * (1 - 2 * nu) * np.eye(3)  # lambda + 2 mu on the diagonal
    law /= (1 + nu) * (1 - 2 * nu)
    sizes = np.array([a, b, c])
    points, weights = np.polynomial.legendre.leggauss(3)
    K = np.zeros((33, 33))
    for index in product(range(3), repeat=3):
        xi = points[list(index)]
        slopes = np.vstack([brick_slopes((xi + 1) / 2), np.diag(-4 * xi)]) / sizes
        strain = _strain(slopes)
        K += np.prod(weights[list(index)]) / 8 * a * b * c * strain.T @ law @ strain
    outer, inner = slice(0, 24), slice(24, 33)
    condensed = K[outer, outer] - K[outer, inner] @ np.linalg.solve(
        K[inner, inner], K[inner, outer]
    )
    return _symmetrised(condensed)


def _strain(slopes: FloatArray) -> FloatArray:
    """Return the strains xx, yy, zz, xy, yz, zx (6, 3 m) of m shape functions with these slopes."""
    strain = np.zeros((6, 3 * slopes.shape[0]))
    for k in range(3):
        strain[k, k::3] = slopes[:, k]
    for row, (i, j) in enumerate(((0, 1), (1, 2), (2, 0)), 3):
        strain[row, i::3], strain[row, j::3] = slopes[:, j], slopes[:, i]
    return strain


def _symmetrised(matrix: FloatArray) -> FloatArray:
    return 0.5 * (matrix + matrix.T)


def _mirrored(upper: FloatArray) -> FloatArray:
    return np.asarray(upper + np.triu(upper, 1).T, dtype=np.float64)

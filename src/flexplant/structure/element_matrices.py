"""Element matrices and shape functions of beams, thin plates in bending and bricks."""

from __future__ import annotations

from functools import cache
from itertools import product
from typing import Any

import numpy as np

from ..arrays import FloatArray, IntArray
from .grids import corners

# the plate's twelve terms x^p y^q, in coordinates from 0 to 1 over the element: the full cubic, and
# x^3 y, x y^3
_TERMS = [(n - q, q) for n in range(4) for q in range(n + 1)] + [(3, 1), (1, 3)]
_P, _Q = np.transpose(_TERMS)


def beam_stiffness(length: float) -> FloatArray:
    """Return the bending stiffness (4, 4) of z, dz/dx at both ends, for E I = 1."""
    h = length
    half = np.array(
        [[6, 3 * h, -6, 3 * h], [0, 2 * h**2, -3 * h, h**2], [0, 0, 6, -3 * h], [0, 0, 0, 2 * h**2]]
    )
    return _mirror_upper(2 * half / h**3)


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
    return _mirror_upper(half * h / 420)


#: number of points in each direction, which integrates products of two cubics exactly
POINTS = 4


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
    points, weights = np.polynomial.legendre.leggauss(POINTS)
    z, slope = beam_parts(0.5 * (points + 1.0), length)
    area = 0.5 * length * weights[:, None]
    turning = np.array([0.0, -1.0, 0.0, 1.0])
    return _powers(z, area), _powers(slope, area), np.outer(turning, turning) / length


def _powers(parts: FloatArray, area: FloatArray) -> list[FloatArray]:
    """Return the integrals of a product of two parts, by the power of f that weighs them."""
    first, second = parts
    both = first.T @ (area * second)
    return [first.T @ (area * first), both + both.T, second.T @ (area * second)]


def thin_terms(s: Any, t: Any, dp: int, dq: int) -> FloatArray:
    """Return the d^dp/ds^dp d^dq/dt^dq derivatives (..., 12) of the terms s^p t^q."""
    return _monomials(_P, s, dp) * _monomials(_Q, t, dq)


def _monomials(power: IntArray, x: Any, order: int) -> FloatArray:
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
    for s, t in corners(2).astype(float):
        rows += [thin_terms(s, t, 0, 0), thin_terms(s, t, 0, 1), -thin_terms(s, t, 1, 0)]
    return np.round(np.linalg.inv(np.array(rows)), 6)  # small integers


def thin_coefficients(a: float, b: float) -> FloatArray:
    """Return the coefficients (12, 12) of unit DOFs z, rx, ry of an element a x b."""
    return np.asarray(_unit_coefficients() * np.tile([1.0, b, a], 4), dtype=np.float64)


def _derivative_products(first: tuple[int, int], second: tuple[int, int]) -> FloatArray:
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
    shape = thin_coefficients(a, b)
    return _symmetrised(a * b * shape.T @ _derivative_products((0, 0), (0, 0)) @ shape)


def plate_stiffness(a: float, b: float) -> tuple[FloatArray, FloatArray]:
    """Return K0, K1 (12, 12): the stiffness is ``E t^3 / 12 (1 - nu^2) (K0 + nu K1)``."""
    xx, yy, xy = (2, 0), (0, 2), (1, 1)
    cross = _derivative_products(xx, yy) / (a * b) ** 2
    twist = 2 * _derivative_products(xy, xy) / (a * b) ** 2
    shape = thin_coefficients(a, b)
    plain = _derivative_products(xx, xx) / a**4 + _derivative_products(yy, yy) / b**4 + twist
    return (
        _symmetrised(a * b * shape.T @ plain @ shape),
        _symmetrised(a * b * shape.T @ (cross + cross.T - twist) @ shape),
    )


def brick_shape(points: FloatArray) -> FloatArray:
    """Return the weights (..., 11) of corners and parabolas at points (..., 3) of the unit cube."""
    place = points[..., None, :]
    weights = np.prod(np.where(corners(3), place, 1 - place), axis=-1)
    return np.concatenate([weights, 4 * points * (1 - points)], axis=-1)


def brick_slopes(points: FloatArray) -> FloatArray:
    """Return the derivatives (..., 11, 3) of these weights along the three unit coordinates."""
    place = points[..., None, :]
    parts = np.where(corners(3), place, 1 - place)
    signs = np.where(corners(3), 1.0, -1.0)
    found = [signs[:, k] * np.delete(parts, k, -1).prod(axis=-1) for k in range(3)]
    return np.concatenate([np.stack(found, axis=-1), (4 - 8 * place) * np.eye(3)], axis=-2)


def brick_mass(a: float, b: float, c: float) -> FloatArray:
    """Return the consistent mass (24, 24) of a brick, x y z at its corners, for unit density."""
    line = np.array([[2.0, 1.0], [1.0, 2.0]]) / 6
    return np.asarray(a * b * c * np.kron(np.kron(line, np.kron(line, line)), np.eye(3)))


def brick_stiffness(a: float, b: float, c: float, nu: float) -> FloatArray:
    """Return the stiffness (24, 24) of a brick for E = 1, three bending modes inside condensed."""
    K = _brick_with_bending(a, b, c, nu)
    return _symmetrised(K[:24, :24] + K[:24, 24:] @ brick_bending(a, b, c, nu))


def brick_bending(a: float, b: float, c: float, nu: float) -> FloatArray:
    """Return the bending modes (9, 24) inside a brick that follow the motions of its corners."""
    K = _brick_with_bending(a, b, c, nu)
    return np.asarray(-np.linalg.solve(K[24:, 24:], K[24:, :24]))


def _brick_with_bending(a: float, b: float, c: float, nu: float) -> FloatArray:
    """Return the stiffness (33, 33) of corners and bending modes of a brick for E = 1."""
    # trilinear displacements and, for each of x, y, z, the incompatible parabolas 1 - xi^2: without
    # them a brick in bending is far too stiff (Wilson and Taylor; rectangular elements pass the
    # patch test without changes)
    law = np.diag([0.5 * (1 - 2 * nu)] * 6)
    law[:3, :3] += nu + 0.5 * (1 - 2 * nu) * np.eye(3)  # lambda + 2 mu on the diagonal
    law /= (1 + nu) * (1 - 2 * nu)
    sizes = np.array([a, b, c])
    points, weights = np.polynomial.legendre.leggauss(3)
    K = np.zeros((33, 33))
    for index in product(range(3), repeat=3):
        slopes = brick_slopes((points[list(index)] + 1) / 2) / sizes
        strain = _strain(slopes)
        K += np.prod(weights[list(index)]) / 8 * a * b * c * strain.T @ law @ strain
    return K


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


def _mirror_upper(upper: FloatArray) -> FloatArray:
    return np.asarray(upper + np.triu(upper, 1).T, dtype=np.float64)

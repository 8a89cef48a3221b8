"""Mindlin plates in Legendre polynomials: frequencies and shapes. Never imports flexplant."""

import numpy as np
import scipy.linalg as la
from numpy.polynomial import legendre


def _line(order, x):
    values = legendre.legvander(x, order)
    return values, legendre.legval(x, legendre.legder(np.eye(order + 1), 1)).T


def mindlin_matrices(size, thickness, density, E, nu, *, order=12, k=5 / 6, masses=()):
    """M, K of deflection and two slopes; fields are numbers or functions of (x, y).

    `masses` are pairs of a place (x, y) and kg.
    """
    points, weights = legendre.leggauss(order + 4)
    a, b = 0.5 * size[0], 0.5 * size[1]
    V, D = _line(order, points)
    n = points.size

    def field(in_x, in_y):
        both = np.einsum("pi,qj->pqij", D / a if in_x else V, D / b if in_y else V)
        return both.reshape(n * n, -1)

    x, y = (one.ravel() for one in np.meshgrid(a * (1 + points), b * (1 + points), indexing="ij"))
    area = a * b * np.outer(weights, weights).ravel()

    def at(value):
        return (area * (value(x, y) if callable(value) else value))[:, None]

    def of(value):
        return value(x, y) if callable(value) else np.full(x.size, value)

    h, rho, young = of(thickness), of(density), of(E)
    F, Fx, Fy = field(0, 0), field(1, 0), field(0, 1)
    none = np.zeros_like(F)
    xx, yy = np.hstack([none, Fx, none]), np.hstack([none, none, Fy])
    xy = np.hstack([none, Fy, Fx])
    gx, gy = np.hstack([Fx, -F, none]), np.hstack([Fy, none, -F])
    B = (area * young * h**3 / (12 * (1 - nu**2)))[:, None]
    G = (area * k * young * h / (2 * (1 + nu)))[:, None]
    K = xx.T @ (B * (xx + nu * yy)) + yy.T @ (B * (yy + nu * xx))
    K += 0.5 * (1 - nu) * xy.T @ (B * xy) + gx.T @ (G * gx) + gy.T @ (G * gy)
    plain, turning = (area * rho * h)[:, None], (area * rho * h**3 / 12)[:, None]
    M = la.block_diag(F.T @ (plain * F), *(2 * [F.T @ (turning * F)]))
    for place, mass in masses:
        row = deflection(size, place, order)
        M[: row.size, : row.size] += mass * np.outer(row, row)
    return 0.5 * (M + M.T), 0.5 * (K + K.T)


def deflection(size, place, order=12):
    """Row of the deflection's coefficients at a place."""
    along = [
        _line(order, np.array([2 * p / n - 1]))[0][0] for p, n in zip(place, size, strict=True)
    ]
    return np.kron(*along)


def mindlin_frequencies(*args, count=20, **kwargs):
    """The lowest elastic frequencies [Hz] of a free plate."""
    M, K = mindlin_matrices(*args, **kwargs)
    values = la.eigh(K, M, eigvals_only=True, subset_by_index=(0, count + 2))
    return np.sqrt(values[3:]) / (2 * np.pi)

"""Slow, dense references for structures, written from the equations. Never imports flexplant."""

import numpy as np
import scipy.linalg as la

# design.md's plate: Lx, Ly, thickness, density, Young's modulus, Poisson's ratio
PLATE = {"size": (0.6, 0.6), "thickness": 0.0272, "density": 2702.0, "E": 70e9, "nu": 0.35}
# the twelve terms and their powers, as in the textbooks
TERMS = [
    (0, 0), (1, 0), (0, 1), (2, 0), (1, 1), (0, 2),
    (3, 0), (2, 1), (1, 2), (0, 3), (3, 1), (1, 3),
]  # fmt: skip


def terms(x, y, dx=0, dy=0):
    """The d^dx/dx^dx d^dy/dy^dy derivative of x^p y^q, term by term."""

    def one(value, power, order):
        factor = 1.0
        for k in range(order):
            factor *= power - k
        return factor * value ** (power - order) if power >= order else 0.0

    return np.array([one(x, p, dx) * one(y, q, dy) for p, q in TERMS])


def element_shape(a, b):
    """Coefficients of the polynomial (columns: unit z, rx = dz/dy, ry = -dz/dx at 4 corners)."""
    rows = []
    for x, y in [(0, 0), (a, 0), (a, b), (0, b)]:
        rows += [terms(x, y), terms(x, y, 0, 1), -terms(x, y, 1, 0)]
    return np.linalg.inv(np.array(rows))


def element_matrices(a, b, thickness, density, E, nu):
    """Mass and stiffness of one element by 5 x 5 Gauss points (exact to degree 9)."""
    shape = element_shape(a, b)
    D = E * thickness**3 / 12 / (1 - nu**2)
    D = D * np.array([[1, nu, 0], [nu, 1, 0], [0, 0, (1 - nu) / 2]])
    M, K = np.zeros((12, 12)), np.zeros((12, 12))
    points, weights = np.polynomial.legendre.leggauss(5)
    for s, ws in zip(points, weights, strict=True):
        for t, wt in zip(points, weights, strict=True):
            x, y, w = a * (s + 1) / 2, b * (t + 1) / 2, ws * wt * a * b / 4
            N = terms(x, y) @ shape
            B = np.array([terms(x, y, 2, 0), terms(x, y, 0, 2), 2 * terms(x, y, 1, 1)]) @ shape
            M += w * density * thickness * np.outer(N, N)
            K += w * B.T @ D @ B
    return M, K


def plate_matrices(nx, ny, size=(0.6, 0.6), thickness=0.0272, density=2702.0, E=70e9, nu=0.35):
    """Dense M, K of a free plate, nodes x fastest, z, rx, ry per node."""
    Me, Ke = element_matrices(size[0] / nx, size[1] / ny, thickness, density, E, nu)
    n = 3 * (nx + 1) * (ny + 1)
    M, K = np.zeros((n, n)), np.zeros((n, n))
    for j in range(ny):
        for i in range(nx):
            first = j * (nx + 1) + i
            nodes = [first, first + 1, first + nx + 2, first + nx + 1]
            rows = np.array([3 * node + d for node in nodes for d in range(3)])
            M[np.ix_(rows, rows)] += Me
            K[np.ix_(rows, rows)] += Ke
    return M, K


def nodes(nx, ny, size=(0.6, 0.6)):
    """Coordinates of the nodes, x fastest."""
    return np.array(
        [(i * size[0] / nx, j * size[1] / ny) for j in range(ny + 1) for i in range(nx + 1)]
    )


def undamped(M, K, n_rigid=3):
    """Frequencies [rad/s] and mass-normalised shapes, rigid-body ones set to 0."""
    squares, phi = la.eigh(K, M)
    squares[:n_rigid] = 0.0
    return np.sqrt(squares), phi


def modal_damping_matrix(M, K, zeta, n_rigid=3):
    """M Phi 2 Z Omega Phi^T M over all modes."""
    omega, phi = undamped(M, K, n_rigid)
    return M @ (phi * (2 * zeta * omega)) @ phi.T @ M


def poles(M, D, K):
    """Poles with positive imaginary part, from the first-order form, sorted."""
    n = M.shape[0]
    inv = np.linalg.inv(M)
    A = np.block([[np.zeros((n, n)), np.eye(n)], [-inv @ K, -inv @ D]])
    # displacements and velocities in comparable units, else rounding spoils the low poles
    scale = np.r_[np.full(n, 1e3), np.ones(n)]
    values = la.eigvals(scale[:, None] * A / scale)
    values = values[values.imag > 1.0]
    return values[np.argsort(np.abs(values))]


def elastic_receptance(M, K, row, freq, zeta, n_rigid=3):
    """Collocated receptance without the rigid-body part, by all modes; and the static one."""
    omega, phi = undamped(M, K, n_rigid)
    c2, w0 = (row @ phi)[n_rigid:] ** 2, omega[n_rigid:]
    w = 2 * np.pi * freq[:, None]
    return np.sum(c2 / (w0**2 - w**2 + 2j * zeta * w0 * w), axis=1), float(np.sum(c2 / w0**2))


def static_free(M, K, rigid, force):
    """Elastic static response of a free structure by a bordered system (inertia relief)."""
    r = rigid.shape[1]
    MR = M @ rigid
    border = np.block([[K, MR], [MR.T, np.zeros((r, r))]])
    # the multipliers take the rigid-body acceleration, the last rows make it M-orthogonal
    return np.linalg.solve(border, np.r_[force, np.zeros(r)])[: K.shape[0]]

"""Dense references for grids of varying elements, and closed forms. Never imports flexplant."""

import numpy as np

from oracles_structure import element_matrices

#: beta L of Euler-Bernoulli beams (Blevins, Formulas for Natural Frequency and Mode Shape, 8-1)
BEAM_ROOTS = {
    ("free", "free"): (4.730040745, 7.853204624, 10.99560784),
    ("clamped", "clamped"): (4.730040745, 7.853204624, 10.99560784),
    ("clamped", "free"): (1.875104069, 4.694091133, 7.854757438),
    ("clamped", "pinned"): (3.926602312, 7.068582746, 10.21017612),
    ("free", "pinned"): (3.926602312, 7.068582746, 10.21017612),
    ("pinned", "pinned"): (np.pi, 2 * np.pi, 3 * np.pi),
    ("guided", "guided"): (np.pi, 2 * np.pi, 3 * np.pi),
    ("guided", "pinned"): (np.pi / 2, 3 * np.pi / 2, 5 * np.pi / 2),
    ("clamped", "guided"): (2.365020372, 5.497803919, 8.639379829),
    ("free", "guided"): (2.365020372, 5.497803919, 8.639379829),
}
#: omega a^2 sqrt(rho h / D) of square plates. Free, nu = 0.3: Leissa, J. Sound Vib. 31 (1973),
#: table for F-F-F-F (Ritz: upper bounds); clamped: the same paper, C-C-C-C
LEISSA_FREE = (13.489, 19.789, 24.432, 35.024, 35.024, 61.526)
LEISSA_CLAMPED = (35.992, 73.413, 73.413, 108.27, 131.64, 132.24)


def varied_plate(nx, ny, size, thickness, density, E, nu):
    """Dense M, K of a plate whose elements (arrays (nx, ny)) differ."""
    n = 3 * (nx + 1) * (ny + 1)
    M, K = np.zeros((n, n)), np.zeros((n, n))
    for i in range(nx):
        for j in range(ny):
            Me, Ke = element_matrices(
                size[0] / nx, size[1] / ny, thickness[i, j], density[i, j], E[i, j], nu[i, j]
            )
            first = j * (nx + 1) + i
            nodes = [first, first + 1, first + nx + 2, first + nx + 1]
            rows = np.array([3 * node + d for node in nodes for d in range(3)])
            M[np.ix_(rows, rows)] += Me
            K[np.ix_(rows, rows)] += Ke
    return M, K


def brick(a, b, c, E, nu, rho):
    """Mass and stiffness of a brick on [0, a] x [0, b] x [0, c], corners x fastest.

    Stiffness: the strain energy left when nine amplitudes of x(a-x), y(b-y), z(c-z) relax.
    """
    corners = [(i, j, k) for k in (0, 1) for j in (0, 1) for i in (0, 1)]
    lame, shear = E * nu / (1 + nu) / (1 - 2 * nu), E / 2 / (1 + nu)
    M, K = np.zeros((24, 24)), np.zeros((33, 33))
    points, weights = np.polynomial.legendre.leggauss(4)
    for s, ws in zip(points, weights, strict=True):
        for t, wt in zip(points, weights, strict=True):
            for u, wu in zip(points, weights, strict=True):
                x, y, z = a * (s + 1) / 2, b * (t + 1) / 2, c * (u + 1) / 2
                w = ws * wt * wu * a * b * c / 8
                N, dN = np.zeros(11), np.zeros((11, 3))
                for m, (i, j, k) in enumerate(corners):
                    fx, dx = (x / a, 1 / a) if i else (1 - x / a, -1 / a)
                    fy, dy = (y / b, 1 / b) if j else (1 - y / b, -1 / b)
                    fz, dz = (z / c, 1 / c) if k else (1 - z / c, -1 / c)
                    N[m] = fx * fy * fz
                    dN[m] = dx * fy * fz, fx * dy * fz, fx * fy * dz
                dN[8, 0], dN[9, 1], dN[10, 2] = a - 2 * x, b - 2 * y, c - 2 * z
                for p in range(8):
                    for q in range(8):
                        for d in range(3):
                            M[3 * p + d, 3 * q + d] += w * rho * N[p] * N[q]
                for p in range(11):
                    for q in range(11):
                        # sigma_ij eps_ij of two displacement fields N_p e_d, N_q e_e
                        grad = shear * np.outer(dN[p], dN[q]).T + lame * np.outer(dN[p], dN[q])
                        grad += shear * np.dot(dN[p], dN[q]) * np.eye(3)
                        K[3 * p : 3 * p + 3, 3 * q : 3 * q + 3] += w * grad
    outer, inner = K[:24, :24], K[24:, 24:]
    return M, outer - K[:24, 24:] @ np.linalg.inv(inner) @ K[24:, :24]


def receptance(M, D, K, out, force, freq):
    """Response [m/N] by solving the dense equations at each frequency; K may be complex."""
    found = []
    for f in freq:
        w = 2 * np.pi * f
        found.append(out @ np.linalg.solve(K + 1j * w * D - w**2 * M, force))
    return np.array(found)

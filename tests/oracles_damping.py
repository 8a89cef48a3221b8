"""Dense references for any damping, from M, D, K alone. Never imports flexplant."""

import numpy as np
import scipy.linalg as la


def chain(masses, springs, held=0.0):
    """M, K of masses in a row; the first one held by a spring to ground."""
    n = len(masses)
    K = np.zeros((n, n))
    K[0, 0] = held
    for i, k in enumerate(springs):
        K[i : i + 2, i : i + 2] += k * np.array([[1.0, -1.0], [-1.0, 1.0]])
    return np.diag(np.array(masses, dtype=float)), K


def between(n, i, j, size):
    """A damper between two masses."""
    row = np.zeros(n)
    row[i], row[j] = 1.0, -1.0
    return size * np.outer(row, row)


def modal(M, K, zeta):
    """D with these damping ratios, M X diag(2 zeta omega) X' M."""
    squares, X = la.eigh(K, M)
    return M @ X @ np.diag(2 * np.array(zeta) * np.sqrt(np.maximum(squares, 0.0))) @ X.T @ M


def light_damping(M, K, zeta):
    """The same ratio for all that is elastic, nothing for what is free."""
    squares, X = la.eigh(K, M)
    rate = 2 * zeta * np.sqrt(np.where(squares > 1e-9 * squares[-1], squares, 0.0))
    return M @ X @ np.diag(rate) @ X.T @ M


def poles(M, D, K):
    n = M.shape[0]
    L = np.linalg.cholesky(M)
    Ki = la.solve_triangular(L, la.solve_triangular(L, K, lower=True).T, lower=True)
    Di = la.solve_triangular(L, la.solve_triangular(L, D, lower=True).T, lower=True)
    omega, X = np.sqrt(np.linalg.eigvalsh(Ki)), np.linalg.eigh(Ki)[1]
    C = X.T @ Di @ X
    return np.linalg.eigvals(np.block([[np.zeros((n, n)), np.diag(omega)], [-np.diag(omega), -C]]))


def meets(M, D, grow, K, low, high):
    """The size at which a first pair of poles becomes real, by bisection."""
    for _ in range(200):
        middle = 0.5 * (low + high)
        found = poles(M, D + middle * grow, K)
        real = np.any(np.abs(found.imag) < 1e-12 * np.abs(found))
        low, high = (low, middle) if real else (middle, high)
    return high


def condition(omega, C):
    """Largest 1 / |w' v| of unit eigenvectors in states (Omega p, p')."""
    k = omega.size
    A = np.block([[np.zeros((k, k)), np.diag(omega)], [-np.diag(omega), -C]])
    _, left, right = la.eig(A, left=True)
    return float((1.0 / np.abs(np.sum(left.conj() * right, axis=0))).max())


def sample_covariance(M, D, K, push, asd, h, pieces=200):
    """Covariance of (q, dq/dt) that white force of one-sided asd adds in one sample."""
    n = M.shape[0]
    inverse = np.linalg.inv(M)
    scale = 1000.0
    A = np.block([[np.zeros((n, n)), scale * np.eye(n)], [-inverse @ K / scale, -inverse @ D]])
    b = np.concatenate([np.zeros(n), inverse @ push]) * asd / np.sqrt(2.0)
    nodes, weights = np.polynomial.legendre.leggauss(8)
    step = h / pieces
    Q = np.zeros((2 * n, 2 * n))
    E = la.expm(A * step)
    starts = [la.expm(A * 0.5 * step * (x + 1)) @ b for x in nodes]
    for _ in range(pieces):
        for w, column in zip(weights, starts, strict=True):
            Q += 0.5 * step * w * np.outer(column, column)
        starts = [E @ column for column in starts]
    units = np.concatenate([np.full(n, 1 / scale), np.ones(n)])
    return Q * np.outer(units, units)


def behind(A, B, C, Af, Bf, Cf):
    """A first-order system with a filter after it."""
    n, m = A.shape[0], Af.shape[0]
    whole = np.block([[A, np.zeros((n, m))], [Bf @ C, Af]])
    return whole, np.vstack([B, np.zeros((m, B.shape[1]))]), np.hstack([np.zeros((1, n)), Cf])


def late_run(A, B, C, u, h, push_late, see_late, fine=10):
    """Outputs at k h: inputs held and push_late samples late, outputs see_late samples late."""
    n, m = B.shape
    E = la.expm(np.block([[A, B], [np.zeros((m, n + m))]]) * (h / fine))
    E, F = E[:n, :n], E[:n, n:]
    lag, back = round(push_late * fine), round(see_late * fine)
    x, trace = np.zeros(n), []
    for i in range(u.shape[0] * fine):
        trace.append(C @ x)
        j = (i - lag) // fine
        x = E @ x + F @ (u[j] if j >= 0 else 0 * u[0])
    zero = 0 * trace[0]
    return np.array([trace[k * fine - back] if k * fine >= back else zero for k in range(len(u))])


def gramian(A, B):
    return la.solve_continuous_lyapunov(A, -B @ B.T)


def white_response(A, B, asd):
    return gramian(A, B * asd / np.sqrt(2.0))


def stationary(A, Q):
    return la.solve_discrete_lyapunov(A, Q)

"""Slow, dense references for reductions, written from the equations. Never imports flexplant."""

import numpy as np
import scipy.linalg as la


def frequencies(M, K):
    """All omega [rad/s] of a dense undamped model, rising."""
    return np.sqrt(np.clip(la.eigh(K, M, eigvals_only=True), 0.0, None))


def split(n, kept):
    """The rows that are not kept."""
    return np.setdiff1d(np.arange(n), kept)


def guyan(K, kept):
    """T of static condensation."""
    s = split(K.shape[0], kept)
    T = np.zeros((K.shape[0], len(kept)))
    T[kept] = np.eye(len(kept))
    T[s] = -np.linalg.solve(K[np.ix_(s, s)], K[np.ix_(s, kept)])
    return T


def irs(M, K, kept, iterations):
    """T of the (iterated) improved reduced system, equation by equation."""
    s = split(K.shape[0], kept)
    S = np.zeros_like(K)
    S[np.ix_(s, s)] = np.linalg.inv(K[np.ix_(s, s)])
    T = static = guyan(K, kept)
    for _ in range(iterations):
        T = static + S @ M @ T @ np.linalg.solve(T.T @ M @ T, T.T @ K @ T)
    return T


def craig_bampton(M, K, kept, count):
    """T of static shapes and fixed-interface modes."""
    s = split(K.shape[0], kept)
    modes = la.eigh(K[np.ix_(s, s)], M[np.ix_(s, s)])[1][:, :count]
    inner = np.zeros((K.shape[0], count))
    inner[s] = modes
    return np.hstack([guyan(K, kept), inner])


def free_interface(M, K, kept, count, rigid):
    """A basis of free modes and residual flexibility (inertia relief by a pseudo-inverse)."""
    n = K.shape[0]
    values, phi = la.eigh(K, M)
    elastic, shapes = values[rigid:], phi[:, rigid:]
    loads = np.eye(n)[:, kept]
    flexible = (shapes / elastic) @ (shapes.T @ loads)
    kept_elastic = slice(0, count - rigid)
    given = (shapes[:, kept_elastic] / elastic[kept_elastic]) @ (shapes[:, kept_elastic].T @ loads)
    return np.hstack([phi[:, :count], flexible - given]), elastic


def same_span(one, other):
    """The largest sine between two spans, columns scaled."""
    a = la.orth(one / np.linalg.norm(one, axis=0))
    b = la.orth(other / np.linalg.norm(other, axis=0))
    return max(np.linalg.norm(a - b @ (b.T @ a), 2), np.linalg.norm(b - a @ (a.T @ b), 2))


def response(M, D, K, B, C, s):
    """C (s^2 M + s D + K)^-1 B."""
    return C @ np.linalg.solve(s**2 * M + s * D + K, B.astype(complex))


def taylor(M, D, K, B, C, s, count):
    """Taylor coefficients in s of the response, by the recursion of its derivatives."""
    P, slope = s**2 * M + s * D + K, 2 * s * M + D
    X = [np.linalg.solve(P, B.astype(complex))]
    before = np.zeros_like(X[0])
    for _ in range(count - 1):
        X.append(-np.linalg.solve(P, slope @ X[-1] + M @ before))
        before = X[-2]
    return [C @ x for x in X]


def modal_hankel(omega, zeta, b, c):
    """Hankel values of modes from dense Lyapunov equations."""
    m = omega.size
    A = np.block([[np.zeros((m, m)), np.eye(m)], [-np.diag(omega**2), -np.diag(2 * zeta * omega)]])
    B = np.vstack([np.zeros_like(b), b])
    C = np.hstack([c, np.zeros_like(c)])
    # balance the units of positions and velocities first
    S = np.diag(np.concatenate([omega, np.ones(m)]))
    A, B, C = S @ A @ np.linalg.inv(S), S @ B, C @ np.linalg.inv(S)
    P = la.solve_continuous_lyapunov(A, -B @ B.T)
    Q = la.solve_continuous_lyapunov(A.T, -C.T @ C)
    return np.sqrt(np.sort(np.abs(np.linalg.eigvals(P @ Q)))[::-1])


def effective_independence(rows, count):
    """Which rows are left when the least independent one goes, one by one, from scratch."""
    left = list(range(rows.shape[0]))
    while len(left) > count:
        part = rows[left]
        share = np.diag(part @ np.linalg.solve(part.T @ part, part.T))
        del left[int(np.argmin(share))]
    return left


def greedy(rows, count):
    """Rows taken one by one for the largest smallest singular value."""
    taken = []
    for _ in range(count):
        free = [i for i in range(rows.shape[0]) if i not in taken]
        lowest = [np.linalg.svd(rows[[*taken, i]], compute_uv=False)[-1] for i in free]
        taken.append(free[int(np.argmax(lowest))])
    return taken

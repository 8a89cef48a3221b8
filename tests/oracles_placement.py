"""Placement from the equations, run until they stand still; nothing of flexplant here."""

from itertools import combinations

import numpy as np


def kalman_variance(A, C, Q, R, rows, *, steps=6000):
    """Sum of the variances of `rows` x after a measurement, by the recursion in time.

    In states of unit variance, in which rounding is harmless.
    """
    n = A.shape[0]
    d = np.ones(n)
    for _ in range(2):  # the first run is for the size of the states
        As, Cs, Qs = A * d / d[:, None], C * d, Q / d / d[:, None]
        P = Qs.copy()
        for _ in range(steps):
            K = np.linalg.solve(Cs @ P @ Cs.T + R, Cs @ P).T
            left = np.eye(n) - K @ Cs
            after = left @ P @ left.T + K @ R @ K.T
            P = As @ after @ As.T + Qs
            P = 0.5 * (P + P.T)
        size = np.sqrt(np.diag(after))
        unit = np.where(size > 0, size, 1.0)
        found = float(np.einsum("ij,jk,ik->", rows * d, after, rows * d))
        d = d * unit
    return found


def lqr_cost(A, B, W, rows, effort, *, steps=6000):
    """Least E[|rows x|^2 + effort^2 |u|^2] by value iteration; x may hold delay lines."""
    n, m = B.shape
    d = np.ones(n)
    for _ in range(2):
        As, Bs = A * d / d[:, None], B / d[:, None]
        Cs, R = rows * d, effort**2 * np.eye(m)
        X = Cs.T @ Cs
        for _ in range(steps):
            F = np.linalg.solve(Bs.T @ X @ Bs + R, Bs.T @ X @ As)
            closed = As - Bs @ F
            X = closed.T @ X @ closed + F.T @ R @ F + Cs.T @ Cs
            X = 0.5 * (X + X.T)
        found = float(np.sum(X * (W / d / d[:, None])))
        size = np.sqrt(np.diag(X))
        d = d / np.where(size > 0, size, 1.0)
    return found


def stationary_riccati(A, B, Q, R, scale=None):
    """X of ``X = A'XA + Q - A'XB (R + B'XB)^-1 B'XA`` by doubling, in states of about unit X."""
    if scale is None:
        scale, X = np.ones(len(A)), Q
        for _ in range(300):
            G = np.linalg.solve(B.T @ X @ B + R, B.T @ X @ A)
            X = A.T @ X @ (A - B @ G) + Q
            X = 0.5 * (X + X.T)
        scale = np.sqrt(np.diag(X))
    size = np.sqrt(np.diag(R))
    As, Bs, Qs = A * scale[:, None] / scale, B * scale[:, None] / size, Q / scale / scale[:, None]
    # 2^k steps of the recursion at once: what SciPy's solver returns need not be stabilising here
    F, S, X = As, Bs @ Bs.T, Qs
    for _ in range(40):
        W = np.linalg.inv(np.eye(len(A)) + S @ X)
        F, S, X = F @ W @ F, S + F @ W @ S @ F.T, X + F.T @ X @ W @ F
        S, X = 0.5 * (S + S.T), 0.5 * (X + X.T)
    for _ in range(300):  # single steps take out what rounding doubled along with the steps
        G = np.linalg.solve(Bs.T @ X @ Bs + np.eye(size.size), Bs.T @ X @ As)
        X = As.T @ X @ (As - Bs @ G) + Qs
        X = 0.5 * (X + X.T)
    G = np.linalg.solve(Bs.T @ X @ Bs + np.eye(size.size), Bs.T @ X @ As)
    assert np.linalg.norm(As.T @ X @ (As - Bs @ G) + Qs - X) < 1e-7 * np.linalg.norm(X)
    assert np.max(np.abs(np.linalg.eigvals(As - Bs @ G))) < 1
    return X * scale * scale[:, None]


def best_subset(count, total, value, required=()):
    """Every subset of `range(total)` that holds `required`: the smallest value and all values."""
    free = [i for i in range(total) if i not in required]
    values = {
        tuple(sorted((*required, *rest))): value(tuple(sorted((*required, *rest))))
        for rest in combinations(free, count - len(required))
    }
    best = min(values, key=values.get)
    return best, values

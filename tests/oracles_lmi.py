"""Smallest H-infinity norms known by hand, H2 norms by an LMI, slow norms; no flexplant here."""

import numpy as np


def state_feedback_gamma(a):
    """x' = a x + w + u, z = (x, u), y = x without noise.

    c X^2 + 2 a X + 1 = 0 with c = 1/gamma^2 - 1 needs a root X > 0.
    """
    return 1.0 / np.sqrt(1.0 + a * a) if a < 0 else 1.0


def output_feedback_gamma(a):
    """x' = a x + w1 + u, z = (x, u), y = x + w2: X = Y by symmetry, and X(gamma) = gamma.

    (1/gamma^2 - 1) X^2 + 2 a X + 1 = 0; X falls and gamma grows, so they meet once.
    """

    def X(gamma):
        c = 1.0 - 1.0 / gamma**2
        if abs(c) < 1e-12:
            return -1.0 / (2.0 * a) if a < 0 else np.inf
        inside = a * a + c
        if inside < 0 or (c < 0 and a >= 0):
            return np.inf
        return (a + np.sqrt(inside)) / c

    low, high = 1e-3, 1e3
    for _ in range(200):
        middle = np.sqrt(low * high)
        low, high = (middle, high) if X(middle) > middle else (low, middle)
    return high


def closed_loop(A, B1, B2, C1, C2, D11, D12, D21, K):
    """w -> z with u = K y, D22 = 0."""
    AK, BK, CK, DK = K
    return (
        np.block([[A + B2 @ DK @ C2, B2 @ CK], [BK @ C2, AK]]),
        np.vstack([B1 + B2 @ DK @ D21, BK @ D21]),
        np.hstack([C1 + D12 @ DK @ C2, D12 @ CK]),
        D11 + D12 @ DK @ D21,
    )


def swept_norm(A, B, C, D, points=4000):
    """Largest singular value over frequencies around all poles, one after the other."""
    sizes = np.abs(np.linalg.eigvals(A))
    grid = np.geomspace(1e-3 * sizes.min(), 1e3 * sizes.max(), points)
    omega = np.concatenate([[0.0], grid, np.abs(np.linalg.eigvals(A).imag)])
    eye = np.eye(A.shape[0])
    return max(
        float(np.linalg.norm(C @ np.linalg.solve(1j * w * eye - A, B) + D, 2)) for w in omega
    )


def least_h2_norm(p, sampled):
    """Scherer's linear change of variables, one semidefinite program over all controllers.

    Of a realisation X and Y, its inverse, of the Gramian are unknown, and K^ = (A^, B^, C^, D^).
    """
    import cvxpy as cp

    n, nw = p["B1"].shape
    nu, (ny, nz) = p["B2"].shape[1], (len(p["C2"]), len(p["C1"]))
    X, Y, W = (cp.Variable((k, k), symmetric=True) for k in (n, n, nz))
    K = {"A": (n, n), "B": (n, ny), "C": (nu, n), "D": (nu, ny)}
    K = {name: cp.Variable(shape) for name, shape in K.items()}
    G = cp.bmat([[X, np.eye(n)], [np.eye(n), Y]])
    A = cp.bmat([
        [p["A"] @ X + p["B2"] @ K["C"], p["A"] + p["B2"] @ K["D"] @ p["C2"]],
        [K["A"], Y @ p["A"] + K["B"] @ p["C2"]],
    ])  # fmt: skip
    B = cp.vstack([p["B1"] + p["B2"] @ K["D"] @ p["D21"], Y @ p["B1"] + K["B"] @ p["D21"]])
    C = cp.hstack([p["C1"] @ X + p["D12"] @ K["C"], p["C1"] + p["D12"] @ K["D"] @ p["C2"]])
    D = p["D11"] + p["D12"] @ K["D"] @ p["D21"]
    none, one = np.zeros((2 * n, nw)), np.eye(nw)
    if sampled:
        stable = cp.bmat([[G, A, B], [A.T, G, none], [B.T, none.T, one]])
        seen = cp.bmat([[W, C, D], [C.T, G, none], [D.T, none.T, one]])
        rules = [stable >> 0, seen >> 0]
    else:
        stable = cp.bmat([[-A - A.T, B], [B.T, one]])
        rules = [stable >> 0, cp.bmat([[G, C.T], [C, W]]) >> 0, D == 0]
    problem = cp.Problem(cp.Minimize(cp.trace(W)), rules)
    problem.solve(solver=cp.CLARABEL)
    return float(np.sqrt(problem.value))

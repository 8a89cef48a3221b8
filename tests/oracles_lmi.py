"""Smallest H-infinity norms known by hand, and slow norms; no flexplant here."""

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

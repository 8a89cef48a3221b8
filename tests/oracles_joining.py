"""Joined components by dense algebra, from the equations alone."""

import numpy as np
import scipy.linalg as la


def constrained(matrices, B):
    """Return the matrices on an orthonormal basis of the null space of B."""
    Z = la.null_space(B, rcond=1e-10)
    return [Z.T @ A @ Z for A in matrices]


def frequencies(M, K, B=None):
    """Return the frequencies [Hz] of K on the null space of B, ascending; zeros at rounding."""
    if B is not None:
        M, K = constrained([M, K], B)
    values = la.eigh(K, M, eigvals_only=True)
    return np.sqrt(np.maximum(values, 0.0)) / (2 * np.pi)


def poles(M, D, K):
    """Return the poles [rad/s] in the upper half plane, by magnitude: of the state matrix."""
    n = M.shape[0]
    lower = -la.solve(M, np.hstack([K, D]))
    found = la.eigvals(np.vstack([np.hstack([np.zeros((n, n)), np.eye(n)]), lower]))
    found = found[found.imag > 1e-6 * np.abs(found)]
    return found[np.argsort(np.abs(found))]


def slow_poles(M, D, K):
    """Return all poles [rad/s] by magnitude, inverses of an eigenproblem's: slow ones have digits.

    ``(K + s D + s^2 M) x = 0`` divided by s: ``K^-1 (D + s M) x = -x / s``.
    """
    n = M.shape[0]
    lower = -la.solve(K, np.hstack([M, D]))
    found = 1 / la.eigvals(np.block([[np.zeros((n, n)), np.eye(n)], [lower]]))
    return found[np.argsort(np.abs(found))]


def receptance(M, D, K, B, freq, out, load):
    """Return ``c x`` of ``[A B'; B 0] [x; forces] = [b; 0]``, A the dynamic stiffness, by freq."""
    m, found = B.shape[0], []
    for f in np.atleast_1d(freq):
        s = 2j * np.pi * f
        A = s**2 * M + s * D + K
        size = np.abs(A).max()
        whole = np.block([[A, size * B.T], [size * B, np.zeros((m, m))]])
        # joints may repeat others: the least-squares forces move the same
        x = la.lstsq(whole, np.concatenate([load, np.zeros(m)]), cond=1e-13)[0]
        found.append(out @ x[: load.size])
    return np.array(found)

"""Lowest eigenvalues of stored matrices in extended precision. Never imports flexplant."""

import numpy as np
import scipy.linalg as la

LONG = np.longdouble


def lowest(K, M, start, shift, steps=4):
    """The eigenvalues of dense (K, M) nearest the shapes `start` (n, k), ascending.

    Inverse iteration with (K + shift M): a scaled double factor, refined with residuals in long
    double, so that only the rounding of the stored entries is left, of which there is none.
    """
    K, M = (A.astype(LONG) for A in (K, M))
    A = K + LONG(shift) * M
    scale = 1 / np.sqrt(np.diag(A).astype(float))
    factor = la.cho_factor(scale[:, None] * A.astype(float) * scale)

    def solve(b):
        x = np.zeros_like(b)
        for _ in range(6):
            left = (b - A @ x).astype(float)
            x = x + scale[:, None] * la.cho_solve(factor, scale[:, None] * left)
        return x

    X = start.astype(LONG)
    for _ in range(steps):
        X = solve(M @ X)
        for j in range(X.shape[1]):
            for _ in range(2):
                X[:, j] -= X[:, :j] @ (X[:, :j].T @ (M @ X[:, j]))
            X[:, j] /= np.sqrt(X[:, j] @ (M @ X[:, j]))
        X = X @ la.eigh((X.T @ K @ X).astype(float))[1].astype(LONG)
    return np.sort(np.einsum("ij,ij->j", X, K @ X).astype(float))


def cantilever_omega(length, bending, mass):
    """First frequency [rad/s] of a clamped beam: 1 + cos(x) cosh(x) = 0, mass per length."""
    return 1.8751040687119611664**2 / length**2 * np.sqrt(bending / mass)


def suspended_omega(mass, size, stiffness):
    """A rigid rectangle on springs at its corners: heave, and the two rotations [rad/s].

    4 k (b/2)^2 / (m b^2 / 12) = 3 (4 k / m).
    """
    heave = np.sqrt(4 * stiffness / mass)
    return heave * np.array([1.0, np.sqrt(3.0), np.sqrt(3.0)])

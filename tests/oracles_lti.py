"""Slow and dense answers for the lti room, written from the equations; no flexplant here."""

import numpy as np


def gain_at(A, B, C, D, s):
    """C (s I - A)^-1 B + D at one s."""
    return C @ np.linalg.solve(s * np.eye(A.shape[0]) - A, B) + D


def sweep(A, B, C, D, dt, freq):
    """(p, m, n_freq), one frequency after the other."""
    s = np.exp(2j * np.pi * freq * dt) if dt else 2j * np.pi * freq
    return np.stack([gain_at(A, B, C, D, value) for value in s], axis=2)


def largest_gain(A, B, C, D, dt, freq):
    return max(np.linalg.norm(H, 2) for H in np.moveaxis(sweep(A, B, C, D, dt, freq), 2, 0))


def stein(A, Q):
    """X = A X A' + Q as one linear system of n^2 unknowns."""
    n = A.shape[0]
    return np.linalg.solve(np.eye(n * n) - np.kron(A, A), Q.reshape(-1)).reshape(n, n)


def lyapunov(A, Q):
    """A X + X A' + Q = 0 as one linear system of n^2 unknowns."""
    n = A.shape[0]
    eye = np.eye(n)
    return np.linalg.solve(np.kron(A, eye) + np.kron(eye, A), -Q.reshape(-1)).reshape(n, n)


def solve_extended(M, right):
    """Gauss elimination with pivoting in extended precision (numpy.linalg has none)."""
    M, right = M.copy(), right.copy()
    n = M.shape[0]
    for k in range(n):
        pivot = k + int(np.argmax(np.abs(M[k:, k])))
        M[[k, pivot]], right[[k, pivot]] = M[[pivot, k]], right[[pivot, k]]
        for i in range(k + 1, n):
            factor = M[i, k] / M[k, k]
            M[i] -= factor * M[k]
            right[i] -= factor * right[k]
    for k in range(n - 1, -1, -1):
        right[k] = (right[k] - M[k, k + 1 :] @ right[k + 1 :]) / M[k, k]
    return right


def riccati_recursion(A, C, Q, R, steps, S=None, P=None):
    """The filter's covariance after so many measurements, in extended precision."""
    A, C, Q, R = (np.asarray(M, dtype=np.longdouble) for M in (A, C, Q, R))
    S = np.zeros((A.shape[0], C.shape[0])) if S is None else S
    S = np.asarray(S, dtype=np.longdouble)
    P = Q.copy() if P is None else np.asarray(P, dtype=np.longdouble)
    for _ in range(steps):
        cross = A @ P @ C.T + S
        P = A @ P @ A.T + Q - cross @ solve_extended(C @ P @ C.T + R, cross.T)
        P = (P + P.T) / 2
    return P.astype(float)


def double_integrator_dare(h, q, r):
    """Steady-state gains alpha, beta and covariances P11, P12 (before the measurement).

    Kalata, The tracking index, IEEE Trans. Aerosp. Electron. Syst. 20, 1984 (alpha-beta filter for
    piecewise constant acceleration of variance q, position noise variance r).
    """
    index = h**2 * np.sqrt(q / r)
    damping = (4 + index - np.sqrt(8 * index + index**2)) / 4
    alpha = 1 - damping**2
    beta = 2 * (2 - alpha) - 4 * np.sqrt(1 - alpha)
    innovation = r / (1 - alpha)
    p11, p12 = alpha * innovation, beta * innovation / h
    return alpha, beta, p11, p12


def hankel(A, B, C, discrete=False):
    """Hankel singular values: square roots of the eigenvalues of P Q."""
    solve = stein if discrete else lyapunov
    P, Q = solve(A, B @ B.T), solve(A.T, C.T @ C)
    return np.sqrt(np.sort(np.abs(np.linalg.eigvals(P @ Q)))[::-1])


def matched_filter(poles, zeros, gain, h, z):
    """Poles and zeros of a continuous filter mapped by e^(s h), those at infinity to -1."""
    zeros = np.concatenate([np.exp(zeros * h), -np.ones(len(poles) - len(zeros))])
    value = np.prod([z - q for q in zeros], axis=0) / np.prod(
        [z - p for p in np.exp(poles * h)], axis=0
    )
    return gain * value


def peak_by_search(A, B, C, D, dt):
    """Largest gain of light modes: a dense sweep around every pole, then golden section."""

    def size(f):
        s = np.exp(2j * np.pi * f * dt) if dt else 2j * np.pi * f
        return float(np.linalg.norm(gain_at(A, B, C, D, s), 2))

    poles = np.linalg.eigvals(A)
    poles = np.log(poles[poles.imag > 0]) / dt if dt else poles[poles.imag > 0]
    best = (0.0, 0.0, 0.0)
    for pole in poles:
        for f in np.abs(pole.imag + pole.real * np.linspace(-3, 3, 25)) / (2 * np.pi):
            if not dt or f < 0.5 / dt:
                best = max(best, (size(f), f, abs(pole.real) / (2 * np.pi)))
    low, high = best[1] - 0.3 * best[2], best[1] + 0.3 * best[2]
    ratio = (np.sqrt(5) - 1) / 2
    for _ in range(40):
        a, b = high - ratio * (high - low), low + ratio * (high - low)
        low, high = (low, b) if size(a) > size(b) else (a, high)
    return max(best[0], size(0.5 * (low + high)))


def periodic_answer(law, records):
    """Outputs (period, p) of a sampled system that records (period, m) have driven for ever."""
    x = np.zeros(law.n_states)
    for sample in records:
        x = law.A @ x + law.B @ sample
    over = np.linalg.matrix_power(law.A, len(records))
    x, out = np.linalg.solve(np.eye(len(x)) - over, x), []
    for sample in records:
        out.append(law.C @ x + law.D @ sample)
        x = law.A @ x + law.B @ sample
    return np.array(out)

"""Dense references for ports with filters and delays, from M, D, K. Never imports flexplant."""

import numpy as np
import scipy.linalg as la


def chain():
    """M, D, K of five masses on a line, free, not proportionally damped."""
    M = np.diag([2.0, 1.0, 1.5, 1.0, 2.5])
    K, D = np.zeros((5, 5)), np.zeros((5, 5))
    for i, (k, d) in enumerate([(4e6, 40.0), (6e6, 25.0), (5e6, 60.0), (7e6, 30.0)]):
        pull = np.zeros(5)
        pull[i], pull[i + 1] = 1.0, -1.0
        K += k * np.outer(pull, pull)
        D += d * np.outer(pull, pull)
    return M, D, K


def gain(num, den, s):
    """A filter's response from its polynomials, highest power first."""
    return np.polyval(num, s) / np.polyval(den, s)


def companion(num, den):
    """A, B, C, D of a strictly proper filter in companion form."""
    a = np.array(den[1:]) / den[0]
    n = a.size
    A = np.zeros((n, n))
    A[0], A[1:, :-1] = -a, np.eye(n - 1)
    C = np.zeros((1, n))
    C[0, n - len(num) :] = np.array(num) / den[0]
    return A, np.eye(n)[:, :1], C, np.zeros((1, 1))


def machine_with_filters(M, D, K, push, see, before, after):
    """A, B, C of: inputs -> filters -> forces on the structure -> displacements -> filters.

    `before` and `after` hold a companion (A, B, C, D) or None per channel.
    """
    m, p, n = push.shape[0], see.shape[0], M.shape[0]
    sizes_b = [0 if f is None else f[0].shape[0] for f in before]
    sizes_a = [0 if f is None else f[0].shape[0] for f in after]
    N = 2 * n + sum(sizes_b) + sum(sizes_a)
    A, B, C = np.zeros((N, N)), np.zeros((N, m)), np.zeros((p, N))
    inverse, scale = np.linalg.inv(M), 1000.0
    A[:n, n : 2 * n] = scale * np.eye(n)
    A[n : 2 * n, :n], A[n : 2 * n, n : 2 * n] = -inverse @ K / scale, -inverse @ D
    at = 2 * n
    for i, f in enumerate(before):
        column = inverse @ push[i]
        if f is None:
            B[n : 2 * n, i] = column
            continue
        own = slice(at, at + sizes_b[i])
        A[own, own], B[own, i] = f[0], f[1][:, 0]
        A[n : 2 * n, own] = np.outer(column, f[2][0])
        at += sizes_b[i]
    for j, f in enumerate(after):
        if f is None:
            C[j, :n] = see[j] / scale
            continue
        own = slice(at, at + sizes_a[j])
        A[own, own], C[j, own] = f[0], f[2][0]
        A[own, :n] = np.outer(f[1][:, 0], see[j] / scale)
        at += sizes_a[j]
    return A, B, C


def late_run(A, B, C, u, h, late_in, late_out, fine):
    """Outputs at k h: input i arrives late_in[i] fine steps late, output j is seen so late."""
    n, m = B.shape
    E = la.expm(np.block([[A, B], [np.zeros((m, n + m))]]) * (h / fine))
    E, F = E[:n, :n], E[:n, n:]
    x, seen = np.zeros(n), []
    history = []
    for k in range(u.shape[0] * fine):
        history.append(C @ x)
        if k % fine == 0:
            seen.append([history[k - d][j] if k >= d else 0.0 for j, d in enumerate(late_out)])
        now = [(k - d) // fine for d in late_in]
        x = E @ x + F @ np.array([u[i, c] if i >= 0 else 0.0 for c, i in enumerate(now)])
    return np.array(seen)


def noise_of_late_outputs(A, root, C, h, late, steps=4000):
    """Covariance of (C x(h), c_j x(h - late_j)) from rest under white noise.

    Trapezoidal sum over the moment s at which the noise acts, the map by one small exponential.
    """
    dt = h / steps
    E = la.expm(A * dt)
    moved = [root]
    for _ in range(steps):
        moved.append(E @ moved[-1])
    total = np.zeros((2 * C.shape[0],) * 2)
    lag = np.round(np.array(late) / dt).astype(int)
    for k in range(steps + 1):  # k steps from the noise to h
        own = C @ moved[k]
        then = np.array(
            [C[j] @ moved[k - d] if k >= d else np.zeros(root.shape[1]) for j, d in enumerate(lag)]
        )
        both = np.vstack([own, then])
        total += (0.5 if k in (0, steps) else 1.0) * dt * both @ both.T
    return total


def transmitted(M, D, K, r, s):
    """Absolute motion (n,) of a structure whose ground moves by one along r.

    In absolute coordinates: the ground pulls at springs and dampers, there is no inertia load.
    """
    return np.linalg.solve(s * s * M + s * D + K, (s * D + K) @ r)


def on_a_heavy_base(M, D, K, base, r, s, ratio=1e11):
    """Motion (n,) per acceleration of the base, relative to it: its DOFs are heavy and pushed."""
    heavy = np.zeros_like(M)
    heavy[base, base] = ratio * np.diag(M)[base]
    return np.linalg.solve(s * s * (M + heavy) + s * D + K, heavy @ r) - r / s**2

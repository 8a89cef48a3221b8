"""Estimation errors from the equations, dense and slow; nothing of flexplant here."""

import numpy as np
import scipy.linalg as la


def error_covariance(closed, noise):
    """Stationary covariance of e[k+1] = closed e[k] + noise, in states of similar size."""
    d = np.sqrt(np.maximum(np.diag(noise), 1e-30 * np.max(np.diag(noise))))
    for _ in range(3):
        P = la.solve_discrete_lyapunov(
            closed * d / d[:, None], noise / d / d[:, None], method="bilinear"
        )
        size = np.sqrt(np.abs(np.diag(P)))
        d = d * np.where(size > 1e-12 * size.max(), size, 1.0)
    return (
        P
        * (d / np.where(size > 1e-12 * size.max(), size, 1.0))[:, None]
        * (d / np.where(size > 1e-12 * size.max(), size, 1.0))
    )


def observer_error(plant, observer):
    """Variances of z - hat, for a truth and an observer that may be anything with its dynamics.

    plant: A, C2, C1, Q, R; observer: A, By, C, Dy. The error is a system of its own only when
    A - By C2 = A_observer and C1 - Dy C2 = C_observer: both are asserted.
    """
    scale = np.abs(plant["A"]).max()
    np.testing.assert_allclose(
        plant["A"] - observer["By"] @ plant["C2"], observer["A"], atol=1e-12 * scale
    )
    left = plant["C1"] - observer["Dy"] @ plant["C2"]
    np.testing.assert_allclose(left, observer["C"], atol=1e-12 * np.abs(plant["C1"]).max())
    noise = plant["Q"] + observer["By"] @ plant["R"] @ observer["By"].T
    P = error_covariance(observer["A"], noise)
    return np.diag(left @ P @ left.T + observer["Dy"] @ plant["R"] @ observer["Dy"].T)


def run(plant, observer, B2, u, steps, rng, count=1):
    """Errors z - hat (steps, nz, count) of runs from rest: measure, update, hold, per sample."""
    factor = plant["factor"]
    x, xo = (np.zeros((m["A"].shape[0], count)) for m in (plant, observer))
    deviation = np.sqrt(np.diag(plant["R"]))[:, None]
    errors = np.empty((steps, plant["C1"].shape[0], count))
    for k in range(steps):
        y = plant["C2"] @ x + deviation * rng.standard_normal((deviation.size, count))
        errors[k] = plant["C1"] @ x - observer["C"] @ xo - observer["Dy"] @ y
        xo = observer["A"] @ xo + observer["By"] @ y + (observer["Bu"] @ u[k])[:, None]
        w = factor @ rng.standard_normal((factor.shape[1], count))
        x = plant["A"] @ x + (B2 @ u[k])[:, None] + w
    return errors


def mean_square_and_its_error(runs):
    """Mean square of stationary Gaussian runs (steps, count), and its standard error.

    The variance of the mean square of one run is 2 / n times the sum of its squared
    autocovariance over all lags.
    """
    n, count = runs.shape
    covariance = np.fft.irfft(np.abs(np.fft.rfft(runs, 2 * n, axis=0)) ** 2, axis=0)[:n] / n
    covariance = covariance.mean(axis=1)
    lags = n // 10
    weight = 1 - np.arange(lags) / n
    total = covariance[0] ** 2 + 2 * np.sum(weight[1:] * covariance[1:lags] ** 2)
    return np.mean(runs**2), np.sqrt(2 * total / n / count)


def truncated_covariance(omega, zeta, see, push, asd):
    """Stationary covariance of the motions `see` (p, m) of modes under white forces `push` (w, m).

    Sig_ij = W_ij (d_i + d_j) / ((om_i^2 - om_j^2)^2 + (d_i + d_j)(d_i om_j^2 + d_j om_i^2)).
    """
    W = push.T @ push * asd**2 / 2
    d, square = 2 * zeta * omega, omega**2
    total = d[:, None] + d
    gap = (square[:, None] - square) ** 2
    return see @ (W * total / (gap + total * (d[:, None] * square + d * square[:, None]))) @ see.T


def error_by_frequency(plant, observer):
    """Variances of z - hat by the density of the error over the unit circle.

    Rigid-body motion is in the plant's A; what the observer misses of it must vanish at rest.
    """
    poles = np.concatenate([np.linalg.eigvals(plant["A"]), np.linalg.eigvals(observer["A"])])
    poles = poles[(np.abs(poles) > 0.1) & (np.abs(poles - 1) > 1e-5)]
    angle, width = np.abs(np.angle(poles)), np.maximum(1 - np.abs(poles), 1e-6)
    spread = np.sinh(np.linspace(-8, 8, 97))
    grid = np.unique(np.concatenate([(angle[:, None] + width[:, None] * spread).ravel(),
                                     np.linspace(0, np.pi, 4001)]))  # fmt: skip
    grid = grid[(grid > 1e-4) & (grid <= np.pi)]
    size = np.linalg.norm(plant["factor"], axis=1)
    size = np.where(size > 0, size, size.max())
    values, T = np.linalg.eig(observer["A"])
    B, C = np.linalg.solve(T, observer["B"]), observer["C"] @ T
    root = np.sqrt(np.diag(plant["R"]))
    A, G = plant["A"] * size / size[:, None], plant["factor"] / size[:, None]
    C1, C2 = plant["C1"] * size, plant["C2"] * size
    density = np.empty((grid.size, C1.shape[0]))
    for k, z in enumerate(np.exp(1j * grid)):
        filtered = (C / (z - values)) @ B + observer["D"]
        moved = np.linalg.solve(z * np.eye(A.shape[0]) - A, G)
        density[k] = np.sum(np.abs((C1 - filtered @ C2) @ moved) ** 2, axis=1)
        density[k] += np.sum(np.abs(filtered * root) ** 2, axis=1)
    return np.trapezoid(density, grid, axis=0) / np.pi


def error_in_extended_precision(plant, observer):
    """Variances of z - hat on a damped plant: the joint Stein equation of 64-bit mantissas.

    The plant's motion may be 1e5 times the error, so that its square takes 10 digits of them.
    """
    A, G, C1, C2 = (plant[name].astype(np.longdouble) for name in ("A", "factor", "C1", "C2"))
    own, B, C, D = (observer[name].astype(np.longdouble) for name in "ABCD")
    root = np.sqrt(np.diag(plant["R"]).astype(np.longdouble))
    A = np.block([[A, np.zeros((len(A), len(own)), A.dtype)], [B @ C2, own]])
    G = np.block([[G, np.zeros((len(G), len(root)), A.dtype)],
                  [np.zeros((len(own), G.shape[1]), A.dtype), B * root]])  # fmt: skip
    E, X = np.hstack([C1 - D @ C2, -C]), G @ G.T
    size = np.sqrt(np.diag(X).max())
    for _ in range(48):  # a rate of decay of 1e-13 per sample
        step = A @ X @ A.T
        X, A = X + step, A @ A
        size = np.sqrt(np.maximum(np.diag(X), np.diag(X).max() * 1e-30))
        if np.abs(step / size / size[:, None]).max() < 1e-21:
            break
    return (np.sum((E @ X) * E, axis=1) + np.sum((D * root) ** 2, axis=1)).astype(float)


def batch(plant, y, u, P0, Z, upto):
    """Best linear unbiased estimates of z[k] from the measurements before sample upto[k], dense.

    plant: A, B, C1, D1, C2, D2, Q, R, V, N, S. All states of the record are linear in x'[0], delta
    and the process noise; the measurements that are not NaN are stacked, their covariance is
    inverted, and delta (columns Z, no prior) is found by generalised least squares. Returns
    estimates and variances (N, nz).
    """
    A, C1, C2 = plant["A"], plant["C1"], plant["C2"]
    N, ny = y.shape
    n, nz = A.shape[0], C1.shape[0]
    # unit noises: x'[0], then (w, v, n) of each sample
    joint = np.block([
        [plant["Q"], plant["S"], np.zeros((n, nz))],
        [plant["S"].T, plant["R"], plant["N"].T],
        [np.zeros((nz, n)), plant["N"], plant["V"]],
    ])  # fmt: skip
    root, first = _root(joint), _root(P0)
    width = first.shape[1] + N * root.shape[1]
    X, D, mean = np.zeros((n, width)), Z.copy(), np.zeros(n)
    X[:, : first.shape[1]] = first
    rows = {name: [] for name in ("yX", "yD", "ym", "zX", "zD", "zm")}
    for k in range(N):
        noise = np.zeros((root.shape[0], width))
        at = first.shape[1] + k * root.shape[1]
        noise[:, at : at + root.shape[1]] = root
        rows["yX"].append(C2 @ X + noise[n : n + ny])
        rows["zX"].append(C1 @ X + noise[n + ny :])
        rows["yD"].append(C2 @ D)
        rows["zD"].append(C1 @ D)
        rows["ym"].append(C2 @ mean + plant["D2"] @ u[k])
        rows["zm"].append(C1 @ mean + plant["D1"] @ u[k])
        X, D = A @ X + noise[:n], A @ D
        mean = A @ mean + plant["B"] @ u[k]
    rows = {name: np.array(parts) for name, parts in rows.items()}
    hat, variance = np.full((N, nz), np.nan), np.full((N, nz), np.inf)
    for k in range(N):
        end = min(max(upto[k], 0), N)
        kept = np.isfinite(y[:end]).ravel()
        size = np.sqrt(np.tile(np.diag(plant["R"]), end))[kept]
        Y, H, value = (
            rows[name][:end].reshape(end * ny, width)[kept] / size[:, None]
            for name, width in (("yX", X.shape[1]), ("yD", D.shape[1]), ("ym", 1))
        )
        value = (y[:end].ravel()[kept] / size) - value[:, 0]
        zX, zD, zm = (rows[name][k] for name in ("zX", "zD", "zm"))
        weights = np.linalg.solve(Y @ Y.T, Y @ zX.T).T if end else np.zeros((nz, 0))
        left = zX - weights @ Y
        G = zD - weights @ H
        information = H.T @ np.linalg.solve(Y @ Y.T, H)
        scale = np.sqrt(np.maximum(np.diag(information), 1e-300))
        sizes, V = np.linalg.eigh(information / scale / scale[:, None])
        unseen = sizes < 1e-9 if Z.shape[1] else np.zeros(0, dtype=bool)
        G = G / scale @ V
        if np.any(np.abs(G[:, unseen]) > 1e-6 * np.abs(G).max(initial=0)):
            continue
        G, V, sizes = G[:, ~unseen], V[:, ~unseen], sizes[~unseen]
        delta = V.T @ (H.T @ np.linalg.solve(Y @ Y.T, value) / scale) / sizes
        hat[k] = zm + G @ delta + weights @ value
        variance[k] = np.sum(left**2, axis=1) + np.sum(G**2 / sizes, axis=1)
    return hat, variance


def _root(covariance):
    size = np.sqrt(np.diag(covariance))
    size = np.where(size > 0, size, 1.0)
    values, vectors = np.linalg.eigh(covariance / size / size[:, None])
    return size[:, None] * vectors * np.sqrt(np.maximum(values, 0.0))


def unbiased_late(A, G, C, Q, R, steps=3000):
    """P[k|k] and the input's covariance by Gillijns, De Moor, Automatica 43, 2007, 111-116.

    Their recursion, sections 3 to 5, with alpha of eq. (25).
    """
    n, m = G.shape
    P = np.eye(n)
    for _ in range(steps):
        before = A @ P @ A.T + Q
        spread = C @ before @ C.T + R
        F = C @ G
        inverse = np.linalg.inv(spread)
        M = np.linalg.solve(F.T @ inverse @ F, F.T @ inverse)
        left = np.eye(n) - G @ M @ C
        star = left @ before @ left.T + G @ M @ R @ M.T @ G.T
        S_star = -G @ M @ R
        R_star = C @ star @ C.T + R + C @ S_star + S_star.T @ C.T
        root = np.linalg.inv(np.linalg.cholesky(spread))
        U = np.linalg.svd(root @ F)[0]
        alpha = U[:, m:].T @ root
        K = (star @ C.T + S_star) @ alpha.T @ np.linalg.inv(alpha @ R_star @ alpha.T) @ alpha
        P = star - K @ (star @ C.T + S_star).T
    return P, np.linalg.inv(F.T @ inverse @ F)


def unbiased_direct(A, G, C, H, Q, R, steps=3000):
    """P[k|k] and the input's covariance by Gillijns, De Moor, Automatica 43, 2007, 934-937."""
    P = np.eye(A.shape[0])
    for _ in range(steps):
        spread = C @ P @ C.T + R
        inverse = np.linalg.inv(spread)
        P_d = np.linalg.inv(H.T @ inverse @ H)
        K = P @ C.T @ inverse
        P_x = P - K @ (spread - H @ P_d @ H.T) @ K.T
        P_xd = -K @ H @ P_d
        both = np.block([[P_x, P_xd], [P_xd.T, P_d]])
        P = np.hstack([A, G]) @ both @ np.hstack([A, G]).T + Q
    return P_x, P_d


def periodic_variances(plant, read, periods):
    """POI variances (T, nz) of the Kalman recursion with rows read by phase, run for long."""
    d = np.ones(plant["A"].shape[0])
    A, C2, Q, R = plant["A"], plant["C2"], plant["Q"], plant["R"]
    size = np.sqrt(np.diag(R))
    C2, R = C2 / size[:, None], R / np.outer(size, size)
    P = 1e3 * Q + 1e-30 * np.eye(len(d))
    for _ in range(periods):
        found = []
        for rows in read:
            C = C2[rows]
            inverse = np.linalg.inv(C @ P @ C.T + R[np.ix_(rows, rows)])
            K = P @ C.T @ inverse
            left = np.eye(len(d)) - K @ C
            after = left @ P @ left.T + K @ R[np.ix_(rows, rows)] @ K.T
            found.append(np.diag(plant["C1"] @ after @ plant["C1"].T))
            P = A @ after @ A.T + Q
    return np.array(found)


def records_of(A, C2, C1, factor, R, steps, rng):
    """Measurements (N, ny) and motions (N, nz) of x+ = A x + factor xi, y = C2 x + v, from rest."""
    white = rng.standard_normal((steps, factor.shape[1])) @ factor.T
    x = np.zeros((steps + 1, A.shape[0]))
    for k in range(steps):
        x[k + 1] = A @ x[k] + white[k]
    noise = rng.standard_normal((steps, C2.shape[0])) * np.sqrt(np.diag(R))
    return x[:-1] @ C2.T + noise, x[:-1] @ C1.T


def scalar_likelihood(y, a, q, r):
    """Log likelihood of y[k] = x[k] + v, x+ = a x + w, by the stationary scalar filter."""
    b = r * (1 - a * a) - q
    P = (-b + np.sqrt(b * b + 4 * q * r)) / 2
    K, spread, x, total = a * P / (P + r), P + r, 0.0, 0.0
    for k, value in enumerate(y):
        e = value - x
        x = a * x + K * e
        if k >= 100:
            total -= 0.5 * (np.log(spread) + e * e / spread)
    return total


def correlated_covariance(plant, steps):
    """P[k|k] of the Kalman recursion with E w v' = S (Simon, Optimal State Estimation, 7.1)."""
    A, C, Q, R, S = (plant[name] for name in ("A", "C2", "Q", "R", "S"))
    P = np.eye(A.shape[0])
    for _ in range(steps):
        ahead = A @ P @ C.T + S
        P = A @ P @ A.T + Q - ahead @ np.linalg.solve(C @ P @ C.T + R, ahead.T)
        P = 0.5 * (P + P.T)
    return P - P @ C.T @ np.linalg.solve(C @ P @ C.T + R, C @ P)

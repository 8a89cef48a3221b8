"""Dense, slow references for plants and loops, from M, D, K alone. Never imports flexplant."""

from itertools import pairwise

import numpy as np
import scipy.linalg as la

from oracles_structure import element_shape, modal_damping_matrix, plate_matrices, terms, undamped

L = 0.6


def machine(zeta=0.01, *, mass=0.0, n=8, thickness=0.0272, damper=0.0):
    """M, D, K of the free plate, n x n; D modal, then a mass at (L/2, L/4).

    The damper acts on the bending of three points in a row, so it leaves the rigid body alone.
    """
    M, K = plate_matrices(n, n, thickness=thickness)
    D = modal_damping_matrix(M, K, zeta)
    at = z_row(L / 2, L / 4, n)
    bend = at - 0.5 * (z_row(L / 4, L / 4, n) + z_row(3 * L / 4, L / 4, n))
    return M + mass * np.outer(at, at), D + damper * np.outer(bend, bend), K


def z_row(x, y, n=8):
    """Row over all DOFs that gives z at a point: the polynomial of the element it lies in."""
    a = L / n
    i, j = min(int(x / a), n - 1), min(int(y / a), n - 1)
    first = j * (n + 1) + i
    row = np.zeros(3 * (n + 1) ** 2)
    corners = [first, first + 1, first + n + 2, first + n + 1]
    weights = terms(x - i * a, y - j * a) @ element_shape(a, a)
    for node, part in zip(corners, weights.reshape(4, 3), strict=True):
        row[3 * node : 3 * node + 3] = part
    return row


def motion_row(x, y, direction, n=8):
    """z, or rx = dz/dy, ry = -dz/dx as fourth-order finite differences of the z field.

    The field is cubic along x and y, so they are exact; the point must be 2 mm inside an element.
    """
    if direction == "z":
        return z_row(x, y, n)
    step = 1e-3
    dx, dy = (0.0, step) if direction == "rx" else (step, 0.0)
    near = z_row(x + dx, y + dy, n) - z_row(x - dx, y - dy, n)
    far = z_row(x + 2 * dx, y + 2 * dy, n) - z_row(x - 2 * dx, y - 2 * dy, n)
    return (8 * near - far) / (12 * step) * (1.0 if direction == "rx" else -1.0)


def receptance(M, D, K, see, push, omega):
    """See (-w^2 M + i w D + K)^-1 push', one dense solve a frequency: (n_see, n_push, n_omega)."""
    found = [see @ np.linalg.solve(-w * w * M + 1j * w * D + K, push.T) for w in omega]
    return np.stack(found, axis=2)


def first_order(M, D, K, see, push, scale=1000.0):
    """A, B, C with states (scale q, dq/dt) and displacement outputs."""
    n = M.shape[0]
    inverse = np.linalg.inv(M)
    A = np.block([[np.zeros((n, n)), scale * np.eye(n)], [-inverse @ K / scale, -inverse @ D]])
    B = np.vstack([np.zeros((n, push.shape[0])), inverse @ push.T])
    return A, B, np.hstack([see / scale, np.zeros_like(see)])


def hold(A, B, t):
    """e^(A t) and the response to an input held for t, by one matrix exponential."""
    n, m = B.shape
    E = la.expm(np.block([[A, B], [np.zeros((m, n + m))]]) * t)
    return E[:n, :n], E[:n, n:]


def delayed_run(A, B, C, u, h, delay, fine=10):
    """Outputs at k h when u[k] arrives `delay` samples late: steps of h / fine, held between."""
    E, F = hold(A, B, h / fine)
    lag = round(delay * fine)
    x, seen = np.zeros(A.shape[0]), []
    for k in range(u.shape[0]):
        seen.append(C @ x)
        for i in range(k * fine, (k + 1) * fine):
            now = (i - lag) // fine
            x = E @ x + (F @ u[now] if now >= 0 else 0.0)
    return np.array(seen)


def noise_by_doubling(A, S, h, doublings=12):
    """int_0^h e^(A s) S e^(A' s) ds: Van Loan's block exponential on h / 2^k, then doubled."""
    n, t = A.shape[0], h / 2**doublings
    V = la.expm(np.block([[-A, S], [np.zeros((n, n)), A.T]]) * t)
    E = V[n:, n:].T
    Q = E @ V[:n, n:]
    for _ in range(doublings):
        Q = Q + E @ Q @ E.T
        E = E @ E
    return 0.5 * (Q + Q.T)


def sampled_machine(M, D, K, forces, motions, asd, u, h):
    """A dict of the sampled truth with one sample of delay, from its own undamped modes.

    States (w q, dq/dt) of each mode, w of the first elastic mode for the rigid body, then the
    delayed forces u. `forces` (m, n) are disturbances, `u` (k, n) actuators, `motions` rows of
    displacement; `asd` that of the disturbances.
    """
    omega, phi = undamped(M, K)
    scale = np.where(omega > 0, omega, omega[3])
    n = omega.size
    C0 = phi.T @ D @ phi
    C0[:3], C0[:, :3] = 0.0, 0.0  # rigid-body modes are undamped
    A = np.block([[np.zeros((n, n)), np.diag(scale)], [-np.diag(omega**2 / scale), -C0]])
    push = np.vstack([np.zeros((n, u.shape[0])), phi.T @ u.T])
    noise = np.vstack([np.zeros((n, forces.shape[0])), phi.T @ forces.T])
    E, F = hold(A, push, h)
    Q = noise_by_doubling(A, 0.5 * noise @ np.diag(np.asarray(asd) ** 2) @ noise.T, h)
    k = u.shape[0]
    late = np.zeros((2 * n + k, 2 * n + k))
    late[: 2 * n, : 2 * n], late[: 2 * n, 2 * n :] = E, F
    full = np.zeros_like(late)
    full[: 2 * n, : 2 * n] = Q
    return {
        "A": late,
        "B": np.vstack([np.zeros((2 * n, k)), np.eye(k)]),
        "C": np.hstack([motions @ phi / scale, np.zeros((motions.shape[0], n + k))]),
        "Q": full,
    }


def closed_loop(plant, y, u, blocks):
    """A of the loop, and maps of its signals from (states, sensor noise).

    `plant`: A, B (u), C (y); `blocks`: dicts A, B, C, D, inputs, outputs; outputs named like an
    actuator add to it. Returns A, the input of the sensor noise, and {signal: (row, noise row)}.
    """
    names = [*y, *u]
    names += [name for b in blocks for name in b["outputs"] if name not in names]
    index = {name: i for i, name in enumerate(names)}
    sizes = [plant["A"].shape[0], *(b["A"].shape[0] for b in blocks)]
    edges = np.cumsum([0, *sizes])
    at = [slice(a, b) for a, b in pairwise(edges)]
    P, Qm = np.zeros((len(names), edges[-1])), np.zeros((len(names), len(names)))
    R = np.zeros((len(names), len(y)))
    F, G = np.zeros((edges[-1],) * 2), np.zeros((edges[-1], len(names)))
    P[: len(y), at[0]], R[: len(y)] = plant["C"], np.eye(len(y))
    F[at[0], at[0]] = plant["A"]
    G[at[0], [index[name] for name in u]] = plant["B"]
    for b, place in zip(blocks, at[1:], strict=True):
        F[place, place] = b["A"]
        for j, name in enumerate(b["inputs"]):
            if name not in index:  # a reference, at rest
                continue
            G[place, index[name]] = b["B"][:, j]
            for i, out in enumerate(b["outputs"]):
                Qm[index[out], index[name]] += b["D"][i, j]
        for i, out in enumerate(b["outputs"]):
            P[index[out], place] += b["C"][i]
    solved = np.linalg.solve(np.eye(len(names)) - Qm, np.hstack([P, R]))
    P, R = solved[:, : edges[-1]], solved[:, edges[-1] :]
    signals = {name: (P[i], R[i]) for name, i in index.items()}
    return F + G @ P, G @ R, signals


def stationary_by_doubling(A, Q):
    """X = A X A' + Q as the sum of A^k Q A'^k, two to the power of terms at a time."""
    X = Q
    for _ in range(40):
        X, A = X + A @ X @ A.T, A @ A
        if np.abs(A).max() < 1e-30:
            return X
    raise ValueError("the loop is not stable")

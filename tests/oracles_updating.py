"""Oracles of updating: dense, slow, written from the equations; nothing of the package is used."""

from __future__ import annotations

import numpy as np
import scipy.linalg as la
from scipy.optimize import least_squares

L, H, N, RHO, E, NU = 0.6, 0.0272, 8, 2702.0, 70e9, 0.35


def plate(thickness=H):
    """M, K of the paper's plate: the 12-DOF non-conforming element, by numerical integration.

    Nodes x fastest, DOFs (w, dw/dy, -dw/dx) per node.
    """
    a = L / N
    powers = [(0, 0), (1, 0), (0, 1), (2, 0), (1, 1), (0, 2)]
    powers += [(3, 0), (2, 1), (1, 2), (0, 3), (3, 1), (1, 3)]

    def term(x, y, dx, dy):
        row = []
        for i, j in powers:
            cx = np.prod([i - s for s in range(dx)]) if dx else 1
            cy = np.prod([j - s for s in range(dy)]) if dy else 1
            row.append(cx * cy * x ** max(i - dx, 0) * y ** max(j - dy, 0))
        return np.array(row, dtype=float)

    corners = [(0, 0), (a, 0), (a, a), (0, a)]
    A = np.vstack(
        [r for x, y in corners for r in (term(x, y, 0, 0), term(x, y, 0, 1), -term(x, y, 1, 0))]
    )
    inverse = np.linalg.inv(A)
    bend = E * thickness**3 / 12 / (1 - NU**2)
    C = bend * np.array([[1, NU, 0], [NU, 1, 0], [0, 0, (1 - NU) / 2]])
    points, weights = np.polynomial.legendre.leggauss(6)
    points, weights = (points + 1) * a / 2, weights * a / 2
    me, ke = np.zeros((12, 12)), np.zeros((12, 12))
    for x, wx in zip(points, weights, strict=True):
        for y, wy in zip(points, weights, strict=True):
            n = term(x, y, 0, 0)
            b = np.vstack([term(x, y, 2, 0), term(x, y, 0, 2), 2 * term(x, y, 1, 1)])
            me += wx * wy * RHO * thickness * np.outer(n, n)
            ke += wx * wy * b.T @ C @ b
    me, ke = inverse.T @ me @ inverse, inverse.T @ ke @ inverse
    size = 3 * (N + 1) ** 2
    M, K = np.zeros((size, size)), np.zeros((size, size))
    for row in range(N):
        for column in range(N):
            first = row * (N + 1) + column
            nodes = [first, first + 1, first + N + 2, first + N + 1]
            at = np.concatenate([np.arange(3 * n, 3 * n + 3) for n in nodes])
            M[np.ix_(at, at)] += me
            K[np.ix_(at, at)] += ke
    return M, K


def z_dof(x, y):
    """Row of the z-DOF of the node at (x, y)."""
    return 3 * (round(y / L * N) * (N + 1) + round(x / L * N))


def modal_damping(M, K, zeta, rigid=3):
    """D of equal modal damping of all elastic modes."""
    omega2, phi = la.eigh(K, M)
    omega = np.sqrt(np.maximum(omega2, 0))
    omega[:rigid] = 0
    return M @ phi @ np.diag(2 * zeta * omega) @ phi.T @ M


def poles(M, D, K):
    """Eigenvalues with Im > 0 of lambda^2 M + lambda D + K, by rising frequency.

    In the modal coordinates of (K, M), as states (omega q, dq/dt), whose matrix is nearly skew.
    Eigenvalues under 1 rad/s are left out.
    """
    omega2, phi = la.eigh(K, M)
    omega = np.sqrt(np.maximum(omega2, 0))
    A = np.block([[np.zeros_like(M), np.diag(omega)], [-np.diag(omega), -phi.T @ D @ phi]])
    values = la.eigvals(A)
    values = values[values.imag > 1.0]
    return values[np.argsort(np.abs(values))]


def truth(zeta, thickness=H, mass=0.5):
    """Poles of modes 6 and 7 of the full plate with a mass at a quarter of the centre line."""
    M, K = plate(thickness)
    D = modal_damping(M, K, zeta)
    M = M.copy()
    at = z_dof(L / 2, L / 4)
    M[at, at] += mass
    return poles(M, D, K)[[2, 3]]


def modal_fit(zeta, target, attached):
    """Mass and damping at z8 that bring modes 6 and 7 of 24 modes (and a vector) to `target`.

    The modal form (5) itself, so no desired DOFs; scipy's least squares with finite differences.
    """
    M, K = plate()
    omega2, phi = la.eigh(K, M)
    omega2[:3] = 0
    at = z_dof(L / 2, L / 4)
    # static elastic shape of a unit force (inertia relief) in the modes that are cut off
    basis, stiff = phi[:, :24], omega2[:24]
    if attached:
        vector = phi[:, 24:] @ (phi[at, 24:] / omega2[24:])
        vector /= np.sqrt(vector @ M @ vector)
        basis = np.column_stack([basis, vector])
        stiff = np.append(stiff, vector @ K @ vector)
    row = basis[at]

    def misfit(p):
        found = poles(
            np.eye(row.size) + p[0] * np.outer(row, row),
            np.diag(2 * zeta * np.sqrt(stiff)) + p[1] * np.outer(row, row),
            np.diag(stiff),
        )[[2, 3]]
        gap = target - found
        return np.concatenate([gap.real, gap.imag])

    options = {"xtol": 1e-15, "ftol": 1e-15, "gtol": 1e-15}
    return least_squares(misfit, [0.4, 0.0], jac="3-point", x_scale=[0.1, 1.0], **options).x


def central_difference(M, D, K, parts, value, step, mode):
    """d lambda / d p at `value` by fourth-order central differences; mode counts from 0."""

    def at(p):
        matrices = (a + p * b for a, b in zip((M, D, K), parts, strict=True))
        return poles(*matrices)[mode]

    near = at(value + step) - at(value - step)
    far = at(value + 2 * step) - at(value - 2 * step)
    return (8 * near - far) / (12 * step)


def complex_step(M, D, K, parts, mode, step=1e-20):
    """Lambda and d lambda / d p at zero to rounding, by a complex step through Newton equations.

    Re and Im of (lambda^2 M + lambda D + K) x = 0, c^T x = 1 are real equations in real
    unknowns, so the step's imaginary part carries the derivative without any cancellation.
    """
    n = M.shape[0]
    A = np.block([[np.zeros((n, n)), np.eye(n)], [-la.solve(M, K), -la.solve(M, D)]])
    values, vectors = la.eig(A)
    values, vectors = values[values.imag > 1e-6], vectors[:, values.imag > 1e-6]
    order = np.argsort(np.abs(values))
    lam, x = values[order[mode]], vectors[:n, order[mode]]
    c = np.argmax(np.abs(x))
    x = x / x[c]
    u = np.concatenate([x.real, x.imag, [lam.real, lam.imag]]).astype(complex)
    pin = np.zeros(n)
    pin[c] = 1.0
    for k in range(12):
        p = 1j * step if k > 5 else 0.0
        Mp, Dp, Kp = (a + p * b for a, b in zip((M, D, K), parts, strict=True))
        xr, xi, a, b = u[:n], u[n : 2 * n], u[-2], u[-1]
        P = (a * a - b * b) * Mp + a * Dp + Kp
        Q = 2 * a * b * Mp + b * Dp
        residual = np.concatenate([P @ xr - Q @ xi, Q @ xr + P @ xi, [pin @ xr - 1, pin @ xi]])
        Pa, Pb, Qa, Qb = 2 * a * Mp + Dp, -2 * b * Mp, 2 * b * Mp, 2 * a * Mp + Dp
        J = np.block(
            [
                [P, -Q, (Pa @ xr - Qa @ xi)[:, None], (Pb @ xr - Qb @ xi)[:, None]],
                [Q, P, (Qa @ xr + Pa @ xi)[:, None], (Qb @ xr + Pb @ xi)[:, None]],
                [pin[None], 0 * pin[None], np.zeros((1, 2))],
                [0 * pin[None], pin[None], np.zeros((1, 2))],
            ]
        )
        u = u - la.solve(J, residual)
    return lam, (u[-2].imag + 1j * u[-1].imag) / step


def complex_step_vector(M, D, K, parts, mode, step=1e-20):
    """d lambda / d p and dx / dp with the largest entry of x held at 1; see `complex_step`.

    Re and Im of (lambda^2 M + lambda D + K) x = 0, c^T x = 1 are real equations in real
    unknowns, so the step's imaginary part carries the derivative without any cancellation.
    """
    n = M.shape[0]
    A = np.block([[np.zeros((n, n)), np.eye(n)], [-la.solve(M, K), -la.solve(M, D)]])
    values, vectors = la.eig(A)
    values, vectors = values[values.imag > 1e-6], vectors[:, values.imag > 1e-6]
    order = np.argsort(np.abs(values))
    lam, x = values[order[mode]], vectors[:n, order[mode]]
    c = np.argmax(np.abs(x))
    x = x / x[c]
    u = np.concatenate([x.real, x.imag, [lam.real, lam.imag]]).astype(complex)
    pin = np.zeros(n)
    pin[c] = 1.0
    for k in range(12):
        p = 1j * step if k > 5 else 0.0
        Mp, Dp, Kp = (a + p * b for a, b in zip((M, D, K), parts, strict=True))
        xr, xi, a, b = u[:n], u[n : 2 * n], u[-2], u[-1]
        P = (a * a - b * b) * Mp + a * Dp + Kp
        Q = 2 * a * b * Mp + b * Dp
        residual = np.concatenate([P @ xr - Q @ xi, Q @ xr + P @ xi, [pin @ xr - 1, pin @ xi]])
        Pa, Pb, Qa, Qb = 2 * a * Mp + Dp, -2 * b * Mp, 2 * b * Mp, 2 * a * Mp + Dp
        J = np.block(
            [
                [P, -Q, (Pa @ xr - Qa @ xi)[:, None], (Pb @ xr - Qb @ xi)[:, None]],
                [Q, P, (Qa @ xr + Pa @ xi)[:, None], (Qb @ xr + Pb @ xi)[:, None]],
                [pin[None], 0 * pin[None], np.zeros((1, 2))],
                [0 * pin[None], pin[None], np.zeros((1, 2))],
            ]
        )
        u = u - la.solve(J, residual)
    slope = (u[-2].imag + 1j * u[-1].imag) / step
    return slope, (u[:n].imag + 1j * u[n : 2 * n].imag) / step


# ---- a sampled machine behind a zero-order hold


def sampled_response(M, D, K, B, C, freq, *, rate, delay=0.0, velocity=False):
    """H(z) (o, i, f) of positions (or velocities) at samples, forces held and delayed.

    Stepped with the exponential of [A B; 0 0] over a sample, its two parts where the delay splits
    it. Also for complex M, D and K: real and imaginary parts in z are kept apart, so that a complex
    step in M, D or K passes: the parts of H are returned as [Re; Im] along a first axis.
    """
    k, i = B.shape
    h = 1 / rate
    whole = int(np.floor(delay))
    part = delay - whole
    inverse = np.linalg.inv(M)
    S = np.zeros((2 * k + i, 2 * k + i), dtype=np.result_type(M, D, K))
    S[:k, k : 2 * k] = np.eye(k)
    S[k : 2 * k, :k], S[k : 2 * k, k : 2 * k] = -inverse @ K, -inverse @ D
    S[k : 2 * k, 2 * k :] = inverse @ B
    first, second = la.expm(S * h * part), la.expm(S * h * (1 - part))
    n = 2 * k
    A = second[:n, :n] @ first[:n, :n]
    older, newer = second[:n, :n] @ first[:n, n:], second[:n, n:]
    rows = np.hstack([C * 0, C]) if velocity else np.hstack([C, C * 0])
    found = np.zeros((2, C.shape[0], i, len(freq)), dtype=S.dtype)
    for f, line in enumerate(freq):
        z = np.exp(2j * np.pi * line * h)
        system = np.block(
            [
                [z.real * np.eye(n) - A, -z.imag * np.eye(n)],
                [z.imag * np.eye(n), z.real * np.eye(n) - A],
            ]
        )
        a, b = z ** (-whole), z ** (-whole - 1)
        load = np.vstack([newer * a.real + older * b.real, newer * a.imag + older * b.imag])
        x = np.linalg.solve(system, load)
        found[0, :, :, f], found[1, :, :, f] = rows @ x[:n], rows @ x[n:]
    return found

"""The smallest H-infinity norm of a problem by other hands, SLICOT's. Never imports the package.

`smallest_norm` is an upper bound: SLICOT's central controllers of problems to which a little
disturbance, noise, motion and effort was added, each judged on the problem itself by AB13DD and at
its resonances. `least_cost` is a lower bound that knows nothing of H-infinity: what a signal w that
is known for all times costs at least, by one Riccati equation of SciPy.
"""

import warnings

import numpy as np
import scipy.linalg as la
import slycot

from oracles_synthesis import closed_loop, split, stability

#: sizes of what is added, relative to the channels at the speed of the loop
LEVELS = (1e-3, 1e-4, 1e-5, 1e-6, 1e-7, 1e-8)
#: frequencies in the unit of the loop's speed at which every norm is checked by a sweep
SWEPT = np.geomspace(1e-4, 1e3, 140)


def continuous(parts, dt):
    """The bilinear image s = (z - 1) / (z + 1) of a sampled system: gains are kept."""
    if not dt:
        return parts
    A, B, C, D = parts
    inverse, root = np.linalg.inv(np.eye(len(A)) + A), np.sqrt(2.0)
    return (
        (A - np.eye(len(A))) @ inverse,
        root * inverse @ B,
        root * C @ inverse,
        D - C @ inverse @ B,
    )


def response(parts, points):
    A, B, C, D = parts
    s = np.asarray(points)[:, None, None]
    return C @ np.linalg.solve(s * np.eye(len(A)) - A, B[None]) + D


def scaled(parts, speed):
    """In another unit of time and in balanced states."""
    A, B, C, D = parts
    n, A, B = len(A), A / speed, B / speed
    border = np.zeros((n + 1, n + 1))
    border[:n, :n] = A
    border[:n, n], border[n, :n] = np.linalg.norm(B, axis=1), np.linalg.norm(C, axis=0)
    _, (scale, _) = la.matrix_balance(border, permute=False, separate=True)
    d = scale[:n] / scale[n]
    return A * d / d[:, None], B / d[:, None], C * d, D


def norm_of(loop):
    """AB13DD's norm of a continuous loop, infinite for one that is not stable."""
    A, B, C, D = loop
    if not all(np.isfinite(part).all() for part in loop) or stability(A, 0.0) >= 0:
        return np.inf
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        sizes = len(A), B.shape[1], len(C)
        norm = slycot.ab13dd("C", "I", "S", "D", *sizes, A, np.eye(len(A)), B, C, D, 1e-9)[0]
    # it was seen to pass over resonances, and 7 % below a wide peak next to a lightly damped pole
    poles = np.linalg.eigvals(A)
    omega = np.concatenate([poles.imag, np.abs(poles), SWEPT])
    try:
        found = response(loop, 1j * omega)
    except np.linalg.LinAlgError:  # stable by no more than rounding
        return np.inf
    return max(float(norm), float(np.linalg.norm(found, 2, axis=(1, 2)).max()))


def loop_norm(problem, K):
    """The norm of w -> z with a controller (A, B, C, D), in coordinates that suit the loop."""
    loop = closed_loop(split(*problem.parts, problem.nu, problem.ny), *K)
    plant = continuous(problem.parts, problem.dt)
    return norm_of(scaled(continuous(loop, problem.dt), loop_speed(plant, problem)))


def loop_speed(parts, problem):
    """The highest frequency at which the least channel from u to z still falls."""
    A, B, C, _ = parts
    sizes = np.abs(np.linalg.eigvals(la.matrix_balance(A, permute=False)[0]))
    sizes = sizes[sizes > 1e-12 * sizes.max(initial=0.0)]
    if not sizes.size:
        return 1.0
    omega = np.geomspace(0.1 * sizes.min(), 1e5 * sizes.max(), 400)
    m1, p1 = B.shape[1] - problem.nu, len(C) - problem.ny
    G = np.linalg.norm(response(parts, 1j * omega)[:, :p1, m1:], axis=1).min(axis=1)
    falling = np.flatnonzero(-np.gradient(np.log(G + 1e-300), np.log(omega)) > 0.2)
    return omega[falling[-1]] if falling.size else sizes.max()


def with_added(parts, nu, ny, level):
    """A problem with more w and z, its u and y in units of their own, and these units.

    w also acts at u and on y, z also contains y and u: by a level of the size of the channel.
    """
    p = split(*parts, nu, ny)
    G = response(parts, [np.exp(0.25j * np.pi)])[0]
    m1, p1, n, zero = G.shape[1] - nu, len(G) - ny, len(p["A"]), np.zeros
    gain = np.linalg.norm(G[:p1, :m1], 2) or 1.0
    u = gain / np.maximum(np.linalg.norm(G[:p1, m1:], axis=0), 1e-12 * gain)
    y = np.linalg.norm(G[p1:, :m1], axis=1)[:, None]
    y = np.maximum(y, 1e-12 * np.abs(G[p1:]).max())
    B1 = np.hstack([p["B1"], level * p["B2"] * u, zero((n, ny))])
    C1 = np.vstack([p["C1"], level * gain * p["C2"] / y, zero((nu, n))])
    D11 = la.block_diag(p["D11"], zero((ny + nu, nu + ny)))
    D12 = np.vstack([p["D12"] * u, zero((ny, nu)), level * gain * np.eye(nu)])
    D21 = np.hstack([p["D21"] / y, zero((ny, nu)), level * np.eye(ny)])
    B, C = np.hstack([B1, p["B2"] * u]), np.vstack([C1, p["C2"] / y])
    return (p["A"], B, C, np.block([[D11, D12], [D21, p["D22"] * u / y]])), u, y


def central(parts, nu, ny, gamma):
    """SLICOT's controller for gamma, or None."""
    A, B, C, D = parts
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        try:
            return slycot.sb10fd(len(A), B.shape[1], len(C), nu, ny, gamma, A, B, C, D)[:4]
        except (slycot.exceptions.SlycotError, np.linalg.LinAlgError):
            return None


def smallest_norm(problem):
    """The least norm of w -> z that SLICOT's controllers reach."""
    base, best = continuous(problem.parts, problem.dt), np.inf
    own = loop_speed(base, problem)
    for speed in (own, 10.0 * own, 0.1 * own):
        parts = scaled(base, speed)
        for level in LEVELS:
            best = min(best, _least(parts, problem.nu, problem.ny, level, best))
    return best


def _least(parts, nu, ny, level, known):
    """The least norm reached with what is added of one level, where it is below the known one."""
    changed, u, y = with_added(parts, nu, ny, level)
    plain, least = split(*parts, nu, ny), np.inf

    def reached(gamma):
        nonlocal least
        K = central(changed, nu, ny, gamma)
        if K is None:
            return False
        A, B, C, D = K
        norm = norm_of(closed_loop(plain, A, B / y.T, u[:, None] * C, u[:, None] * D / y.T))
        least = min(least, norm)
        return norm <= gamma * (1.0 + 1e-3)

    # a level that does not reach the least norm known reaches no smaller one
    span, high = (known, 1e-2 * known, 9) if known < np.inf else (1e4, 1e-4, 33), np.inf
    for gamma in np.geomspace(*span):
        if reached(gamma):
            high = gamma
        elif min(high, known) < np.inf:
            break
    low = high / 10**0.25
    for _ in range(10 if high < np.inf else 0):
        middle = np.sqrt(low * high)
        low, high = (low, middle) if reached(middle) else (middle, high)
    return least


def mu_of_two_blocks(M, size):
    """mu of a complex response by SLICOT's AB13MD: a full block of that size, and the rest."""
    rest = max(M.shape) - size
    square = np.zeros((size + rest,) * 2, dtype=complex)
    square[: M.shape[0], : M.shape[1]] = M
    return slycot.ab13md(square, np.array([size, rest]), np.array([2, 2]))[0]


#: decay rates of the signals w of `least_cost`, relative to the speed of the loop
RATES = np.geomspace(1e-5, 1e2, 36)


def least_cost(problem, tiny=1e-7):
    """A lower bound: the least |z| over |w| when the worst w, a sum of exponentials, is known.

    With w = sum c_k exp(-a_k t) known, the least |z|^2 over all u is a quadratic form of c: X of a
    problem of least squares. No controller does better, since it does not know w in advance.
    """
    base = continuous(problem.parts, problem.dt)
    parts = scaled(base, loop_speed(base, problem))
    p = split(*parts, problem.nu, problem.ny)
    n, m1 = p["B1"].shape
    rates = np.repeat(RATES, m1)
    shapes = np.tile(np.eye(m1), RATES.size) * np.sqrt(2.0 * rates)
    A = np.block([[p["A"], p["B1"] @ shapes], [np.zeros((rates.size, n)), -np.diag(rates)]])
    B = np.vstack([p["B2"], np.zeros((rates.size, problem.nu))])
    C = np.hstack([p["C1"], p["D11"] @ shapes])
    size = np.linalg.norm(C) / np.sqrt(len(C))
    R = p["D12"].T @ p["D12"] + (tiny * size) ** 2 * np.eye(problem.nu)
    X = la.solve_continuous_are(A, B, C.T @ C, R, s=C.T @ p["D12"])[n:, n:]
    energy = (shapes.T @ shapes) / (rates[:, None] + rates)
    return float(np.sqrt(la.eigh(X, energy + 1e-12 * np.eye(rates.size), eigvals_only=True)[-1]))


def h2_norm(loop):
    """The H2 norm of a continuous loop by SciPy, infinite if not stable or if Gramians differ."""
    A, B, C, _ = loop
    if not all(np.isfinite(part).all() for part in loop) or stability(A, 0.0) >= 0:
        return np.inf
    A, B, C, _ = scaled(loop, 1.0)
    P, Q = gramian(A, B), gramian(A.T, C.T)
    squares = np.trace(C @ P @ C.T), np.trace(B.T @ Q @ B)
    return float(np.sqrt(max(squares))) if max(squares) <= 1.0002 * min(squares) else np.inf


def gramian(A, B):
    """P of A P + P A' + B B' = 0: next to slow modes SciPy's alone was seen to be 1 % wrong.

    Refined by residuals in extended precision.
    """
    P, A_, B_ = np.zeros(A.shape, np.longdouble), A.astype(np.longdouble), B.astype(np.longdouble)
    for _ in range(4):
        left = A_ @ P + P @ A_.T + B_ @ B_.T
        P = P + la.solve_continuous_lyapunov(A, -left.astype(float))
    return P


def smallest_h2(problem):
    """The least H2 norm of a continuous problem: SciPy's Riccati equations, less and less added."""
    speed = loop_speed(problem.parts, problem)
    parts = scaled(problem.parts, speed)
    plain, best = split(*parts, problem.nu, problem.ny), np.inf
    for level in LEVELS:
        changed, u, y = with_added(parts, problem.nu, problem.ny, level)
        p = split(*changed, problem.nu, problem.ny)
        R, V = p["D12"].T @ p["D12"], p["D21"] @ p["D21"].T
        try:
            S, N = p["C1"].T @ p["D12"], p["B1"] @ p["D21"].T
            X = la.solve_continuous_are(p["A"], p["B2"], p["C1"].T @ p["C1"], R, s=S)
            Y = la.solve_continuous_are(p["A"].T, p["C2"].T, p["B1"] @ p["B1"].T, V, s=N)
        except (np.linalg.LinAlgError, ValueError):
            continue
        F = -np.linalg.solve(R, p["B2"].T @ X + S.T)
        L = -np.linalg.solve(V, p["C2"] @ Y + N.T).T
        A = p["A"] + p["B2"] @ F + L @ p["C2"] + L @ p["D22"] @ F
        K = (A, -L / y.T, u[:, None] * F, np.zeros((problem.nu, problem.ny)))
        best = min(best, h2_norm(closed_loop(plain, *K)))
    return best * np.sqrt(speed)

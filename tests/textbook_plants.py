"""Textbook H-infinity problems of 22 kinds, drawn at random. Never imports the package.

Every problem is a standard plant [w; u] -> [z; y] in matrices. A problem of mixed sensitivity keeps
its plant and weights as polynomials or matrices too, so that a test can pose it as a user does.
"""

from typing import NamedTuple

import numpy as np
import scipy.linalg as la
import scipy.signal


class Problem(NamedTuple):
    """A standard plant, and for mixed sensitivity the plant G and the weights of S, KS, T."""

    kind: str
    parts: tuple  # A, B, C, D of [w; u] -> [z; y]
    nu: int
    ny: int
    dt: float = 0.0
    G: tuple | None = None  # (num, den) or (A, B, C, D)
    weights: dict | None = None  # {"S": (num, den) or number, ...}


def system(given):
    """A, B, C, D of a number, of (num, den), or of matrices."""
    if isinstance(given, tuple) and len(given) == 4:
        return tuple(np.atleast_2d(np.asarray(part, float)) for part in given)
    if isinstance(given, tuple):
        num, den = (np.trim_zeros(np.atleast_1d(part).astype(float), "f") for part in given)
        if den.size > 1:
            return scipy.signal.tf2ss(num, den)
        given = [[num[0] / den[0]]]
    D = np.atleast_2d(np.asarray(given, float))
    return np.zeros((0, 0)), np.zeros((0, D.shape[1])), np.zeros((D.shape[0], 0)), D


def repeated(g, count):
    """The same scalar system for each of so many channels."""
    return tuple(la.block_diag(*[part] * count) for part in system(g))


def series(first, second):
    """A, B, C, D of second after first."""
    A, B, C, D = system(first)
    E, F, H, K = system(second)
    return (
        np.block([[A, np.zeros((len(A), len(E)))], [F @ C, E]]),
        np.vstack([B, F @ D]),
        np.hstack([K @ C, H]),
        K @ D,
    )


def mixed(G, weights):
    """[W_S e; W_KS u; W_T y], e = r - y, y = G u: A, B, C, D of [r; u] -> [z; e]."""
    A, B, C, D = system(G)
    p, m = D.shape
    n = len(A)
    # before the weights: e, u, y of (r, u)
    read = {
        "S": (-C, np.hstack([np.eye(p), -D])),
        "KS": (np.zeros((m, n)), np.hstack([np.zeros((m, p)), np.eye(m)])),
        "T": (C, np.hstack([np.zeros((p, p)), D])),
    }
    drive = np.hstack([np.zeros((n, p)), B])
    As, Bs, rows, through = [A], [drive], [], []
    links, places = [], []
    for key, weight in weights.items():
        reads, direct = read[key]
        E, F, H, K = (
            repeated(weight, len(direct)) if len(system(weight)[3]) == 1 else system(weight)
        )
        links.append(F @ reads)
        As.append(E)
        Bs.append(F @ direct)
        rows.append(K @ reads)
        places.append(H)
        through.append(K @ direct)
    whole = la.block_diag(*As)
    offset = n
    for link, part in zip(links, As[1:], strict=True):
        whole[offset : offset + len(part), :n] = link
        offset += len(part)
    own = la.block_diag(*places)
    out = np.hstack([np.vstack(rows), own])
    error, its = read["S"]
    return (
        whole,
        np.vstack(Bs),
        np.vstack([out, np.hstack([error, np.zeros((p, len(whole) - n))])]),
        np.vstack([*through, its]),
    )


def four_block(G, WS, WT, disturbance, noise):
    """w = (d at u, noise of y), z = (W_S y, W_T u): the GS/T problem."""
    A, B, C, D = series(G, repeated(WS, len(system(G)[3])))
    n, m = len(A), B.shape[1]
    g = system(G)
    Cy = np.hstack([g[2], np.zeros((len(g[2]), n - len(g[0])))])
    Dy, p = g[3], len(g[3])
    E, F, H, K = repeated(WT, m)
    big = la.block_diag(A, E)
    k = len(E)
    zero = np.zeros
    inputs = np.block([[disturbance * B, zero((n, p)), B], [zero((k, m + p)), F]])
    outputs = np.block([[C, zero((len(C), k))], [zero((m, n)), H], [Cy, zero((p, k))]])
    through = np.block(
        [
            [disturbance * D, zero((len(C), p)), D],
            [zero((m, m + p)), K],
            [disturbance * Dy, noise * np.eye(p), Dy],
        ]
    )
    return big, inputs, outputs, through


def sampled(g, dt, method):
    """A system sampled with a hold ("zoh") or by Tustin's map ("bilinear")."""
    A, B, C, D = system(g)
    if not len(A):
        return A, B, C, D
    return scipy.signal.cont2discrete((A, B, C, D), dt, method=method)[:4]


def weight_s(speed, peak=2.0, low=1e-4):
    """The usual weight of S: 1 / peak at high frequencies, 1 / low at low ones."""
    return [1.0 / peak, speed], [1.0, speed * low]


def draw(rng, low, high):
    """A number between two powers of ten."""
    return 10.0 ** rng.uniform(low, high)


def lag(*poles):
    return np.poly(-np.array(poles))


def posed(kind, G, weights):
    p, m = system(G)[3].shape
    return Problem(kind, mixed(G, weights), m, p, 0.0, G, weights)


def usual(rng, kind, G, size=1.0, speed=None):
    """Mixed sensitivity of G: weights of S and KS, one time in three also of T."""
    speed = draw(rng, -0.5, 0.5) if speed is None else speed
    low = draw(rng, -4, -2)
    weights = {"S": weight_s(speed, rng.uniform(1.5, 2.5), low), "KS": draw(rng, -2, -0.5) / size}
    if rng.uniform() < 1 / 3:
        weights["T"] = rng.uniform(0.2, 0.6)
    return posed(kind, G, weights)


def lags(count):
    def drawn(rng):
        poles = [draw(rng, -6, 0) for _ in range(count)]
        if rng.uniform() < 0.4:
            poles = [poles[0]] * count
        return usual(rng, f"{count} lag", ([draw(rng, -0.5, 0.5)], lag(*poles)))

    return drawn


def integrator(rng):
    den = np.polymul([1.0, 0.0], lag(draw(rng, 0, 2)) if rng.uniform() < 0.5 else [1.0])
    return usual(rng, "integrator", ([den[1] or 1.0], den))


def double_integrator(rng):
    return usual(rng, "double integrator", ([draw(rng, -0.5, 0.5)], [1.0, 0.0, 0.0]))


def undamped(rng):
    w = draw(rng, -0.7, 0.7)
    num, den = [1.0], [1.0, 0.0, w * w]
    if rng.uniform() < 0.5:  # a rigid body with it
        num, den = [0.5, 0.0, w * w], np.polymul([1.0, 0.0, 0.0], den)
    return usual(rng, "undamped mode", (num, den))


def slow_beside_fast(rng):
    slow, fast = draw(rng, -5, -3), draw(rng, 2, 4)
    num = [fast]
    return usual(rng, "slow beside fast", (num, lag(slow, fast)))


def rhp_pole(rng):
    p = draw(rng, -1, 0.5)
    den = [1.0, -p] if rng.uniform() < 0.5 else np.polymul([1.0, -p], [1.0, draw(rng, 0.5, 1.5)])
    return usual(rng, "RHP pole", ([den[1] if len(den) == 2 else den[-1]], den), speed=3.0 * p)


def rhp_zero(rng):
    z = draw(rng, -0.5, 0.5)
    den = lag(*(draw(rng, -4, 0) for _ in range(rng.integers(1, 3))))
    return usual(rng, "RHP zero", ([-1.0, z], den), speed=rng.uniform(0.1, 0.4) * z)


def pade(rng):
    delay, order = draw(rng, -1, 0), int(rng.integers(1, 5))
    k = np.arange(order + 1)
    terms = [
        np.prod([order - j for j in range(i)])
        / np.prod([2 * order - j for j in range(i)])
        / np.prod(np.arange(1, i + 1))
        * delay**i
        for i in k
    ]
    den = np.array(terms)[::-1]
    num = den * (-1.0) ** k[::-1]
    lags_ = lag(draw(rng, -3, 0))
    return usual(rng, "Pade delay", (num, np.polymul(den, lags_)), speed=0.3 / delay)


def motor(rng):
    """DC motor from volts to angle: J, b, K, R, L of a small one."""
    J, b, K = draw(rng, -5.5, -2), draw(rng, -7, -1), draw(rng, -2, -1)
    R, L = draw(rng, -0.3, 0.7), draw(rng, -6, -0.5)
    den = np.array([J * L, J * R + b * L, b * R + K * K, 0.0])
    if rng.uniform() < 0.3:
        den = den[:-1]
    poles = np.abs(np.roots(den))
    speed = float(np.sort(poles[poles > 0])[0]) * draw(rng, -0.5, 0.5)
    g = K / abs(np.polyval(den, 1j * speed))
    return usual(rng, "DC motor", ([K], den), size=1.0 / g, speed=speed)


def pendulum(rng):
    """An upright pendulum of length l with torque at the pivot, or on a cart with two sensors."""
    w2 = 9.81 / rng.uniform(0.2, 2.0)
    root = np.sqrt(w2)
    if rng.uniform() < 0.5:
        return usual(rng, "pendulum", ([w2], [1.0, rng.choice([0.0, 0.02]), -w2]), speed=2.0 * root)
    A = np.zeros((4, 4))
    A[0, 1] = A[2, 3] = 1.0
    A[1, 2], A[3, 2] = -0.2 * w2, 1.2 * w2
    B = np.array([[0.0], [1.0], [0.0], [-1.0]])
    C = np.array([[1.0, 0, 0, 0], [0, 0, 1.0, 0]])
    WS = ([0.3, root / 10], [1.0, root / 1000])
    return Problem(
        "pendulum",
        four_block((A, B, C, np.zeros((2, 1))), WS, draw(rng, -2, -1), 1.0, draw(rng, -3, -2)),
        1,
        2,
    )


def distillation(rng):
    """Skogestad's column: condition 142, time constant 75 min, with actuators' lag or not."""
    gain = np.array([[87.8, -86.4], [108.2, -109.6]])
    tau = rng.uniform(50.0, 200.0)
    G = (-np.eye(2) / tau, np.eye(2) / tau, gain, np.zeros((2, 2)))
    if rng.uniform() < 0.5:
        G = series(repeated(([1.0], [rng.uniform(0.2, 1.0), 1.0]), 2), G)
    return usual(rng, "distillation", G, speed=draw(rng, -2, -1))


def aircraft(rng):
    """Longitudinal motion of a transport (u, w, q, theta): elevator to pitch, phugoid slow."""
    A = np.array(
        [
            [-0.0188, 0.0415, 0.0, -9.81],
            [-0.0820, -0.5167, 66.7, 0.0],
            [0.0, -0.0154, -0.60, 0.0],
            [0.0, 0.0, 1.0, 0.0],
        ]
    ) * rng.uniform(0.8, 1.2, size=(4, 4))
    B = np.array([[0.0], [-2.0], [-1.0], [0.0]])
    C = np.array([[0.0, 0.0, 0.0, 1.0]])
    G = series(([10.0], [1.0, 10.0]), (A, B, C, np.zeros((1, 1))))
    return usual(rng, "aircraft", G, speed=draw(rng, -0.7, 0.2))


def two_mass(rng):
    """The benchmark of Wie and Bernstein: force on the first mass, position of the second."""
    k = rng.uniform(0.5, 2.0)
    A = np.zeros((4, 4))
    A[:2, 2:] = np.eye(2)
    A[2:, :2] = k * np.array([[-1.0, 1.0], [1.0, -1.0]])
    B, C = np.array([[0.0], [0], [1], [0]]), np.array([[0.0, 1.0, 0.0, 0.0]])
    G = (A, B, C, np.zeros((1, 1)))
    if rng.uniform() < 0.5:
        return usual(rng, "two masses", G, speed=rng.uniform(0.05, 0.3))
    return Problem(
        "two masses",
        four_block(
            G, weight_s(0.1, low=1e-2), draw(rng, -2, -1), draw(rng, -1, 0), draw(rng, -3, -1)
        ),
        1,
        1,
    )


def suspension(rng):
    """A quarter car: w road, z acceleration, travel and effort, y travel and acceleration."""
    ms, mu = rng.uniform(250, 450), rng.uniform(30, 60)
    ks, bs, kt = rng.uniform(1e4, 3e4), rng.uniform(500, 1500), 190e3
    A = np.array(
        [
            [0, 1, 0, 0],
            [-ks / ms, -bs / ms, ks / ms, bs / ms],
            [0, 0, 0, 1],
            [ks / mu, bs / mu, -(ks + kt) / mu, -bs / mu],
        ]
    )
    road, force = np.array([[0], [0], [0], [kt / mu]]), np.array([[0], [1 / ms], [0], [-1 / mu]])
    travel, body = np.array([[1, 0, -1, 0]]), A[1:2]
    effort = draw(rng, -5, -3)
    noise = draw(rng, -3, -2)
    B = np.hstack([0.07 * road, np.zeros((4, 2)), force])
    C = np.vstack([0.3 * body, 10 * travel, np.zeros((1, 4)), travel, body])
    D = np.zeros((5, 4))
    D[0, 3], D[2, 3], D[3, 1], D[4, 2], D[4, 3] = 0.3 / ms, effort, noise, 10 * noise, 1 / ms
    return Problem("suspension", (A, B, C, D), 1, 2)


def hard_disk(rng):
    """A voice coil: low friction mode or a rigid body, a resonance at some kHz, a driver."""
    w1, w2 = 2 * np.pi * rng.uniform(20, 60), 2 * np.pi * rng.uniform(2e3, 4e3)
    z1 = rng.uniform(0.1, 0.3)
    rigid = [1.0, 2 * z1 * w1, w1**2] if rng.uniform() < 0.5 else [1.0, 0.0, 0.0]
    mode = [1.0, 2 * 0.02 * w2, w2**2]
    gain = draw(rng, 7, 8)
    num = gain * np.polyadd(mode, [rng.uniform(-0.3, 0.5), 0.0, 0.0])
    den = np.polymul(rigid, mode)
    speed = 2 * np.pi * rng.uniform(200, 600)
    size = 1 / abs(np.polyval(num, 1j * speed) / np.polyval(den, 1j * speed))
    return usual(rng, "hard disk", (num, den), size=size, speed=speed)


def reactor(rng):
    """Rosenbrock's unstable batch reactor, two by two."""
    A = np.array(
        [
            [1.38, -0.2077, 6.715, -5.676],
            [-0.5814, -4.29, 0.0, 0.675],
            [1.067, 4.273, -6.654, 5.893],
            [0.048, 4.273, 1.343, -2.104],
        ]
    ) * rng.uniform(0.95, 1.05, size=(4, 4))
    B = np.array([[0.0, 0], [5.679, 0], [1.136, -3.146], [1.136, 0]])
    C = np.array([[1.0, 0, 1, -1], [0, 1, 0, 0]])
    return usual(rng, "reactor", (A, B, C, np.zeros((2, 2))), speed=draw(rng, 0, 0.7))


def gs_t(rng):
    """Disturbance at u and noise; motion and effort: of lags, integrators, masses."""
    den = [[1.0, draw(rng, -6, -1)], [1.0, 0.0], [1.0, 0.0, 0.0], lag(draw(rng, -4, 0), 1.0)][
        rng.integers(4)
    ]
    WS = weight_s(draw(rng, -0.5, 0.3), low=draw(rng, -4, -2))
    parts = four_block(([1.0], den), WS, rng.uniform(0.1, 0.6), 1.0, draw(rng, -3, -1))
    return Problem("GS/T", parts, 1, 1)


def mimo_integrators(rng):
    count = int(rng.integers(2, 4))
    gain = rng.normal(size=(count, count)) + 2 * np.eye(count)
    A, B, C, D = repeated(([1.0], [1.0, 0.0] if rng.uniform() < 0.6 else [1.0, 0.0, 0.0]), count)
    return usual(rng, "MIMO integrators", (A, B @ gain, C, D), size=np.linalg.norm(gain, 2))


#: those that other units and sampling are tried on
SIMPLE = [lags(1), lags(2), integrator, double_integrator, rhp_pole, rhp_zero, gs_t, two_mass]


def other_units(rng):
    """Another unit of time, of u and of y."""
    one = SIMPLE[rng.integers(len(SIMPLE))](rng)
    A, B, C, D = one.parts
    time, unit_u, unit_y = draw(rng, -6, 6), draw(rng, -9, 9), draw(rng, -9, 9)
    columns, rows = np.ones(B.shape[1]), np.ones(len(C))
    columns[-one.nu :], rows[-one.ny :] = unit_u, unit_y
    parts = (A * time, B * time * columns, C * rows[:, None], D * rows[:, None] * columns)
    return Problem("other units", parts, one.nu, one.ny)


def held(rng):
    """Sampled with a hold, the weights by Tustin's map; or all of it by Tustin's map."""
    one = SIMPLE[rng.integers(len(SIMPLE))](rng)
    dt = draw(rng, -2.5, -1)
    if one.G is None:
        return one._replace(kind="sampled", dt=dt, parts=sampled(one.parts, dt, "bilinear"))
    G = sampled(one.G, dt, "zoh")
    weights = {key: sampled(w, dt, "bilinear") for key, w in one.weights.items()}
    return posed("sampled", G, weights)._replace(dt=dt, weights=one.weights)


KINDS = {
    "one lag": lags(1),
    "two lags": lags(2),
    "three lags": lags(3),
    "integrator": integrator,
    "double integrator": double_integrator,
    "undamped mode": undamped,
    "slow beside fast": slow_beside_fast,
    "RHP pole": rhp_pole,
    "RHP zero": rhp_zero,
    "Pade delay": pade,
    "DC motor": motor,
    "pendulum": pendulum,
    "distillation": distillation,
    "aircraft": aircraft,
    "two masses": two_mass,
    "suspension": suspension,
    "hard disk": hard_disk,
    "reactor": reactor,
    "GS/T": gs_t,
    "MIMO integrators": mimo_integrators,
    "other units": other_units,
    "sampled": held,
}


def problem(kind, seed):
    """The problem of a kind and a seed."""
    place = list(KINDS).index(kind)
    return KINDS[kind](np.random.default_rng([place, seed]))._replace(kind=kind)


def strictly_proper(p, speed):
    """The problem with lags on the z that w reaches at once [rad/s]: its H2 norm is finite."""
    A, B, C, D = p.parts
    m1, p1 = B.shape[1] - p.nu, len(C) - p.ny
    at_once = np.flatnonzero(np.any(D[:p1, :m1], axis=1))
    if p.dt or not at_once.size:
        return p
    E = np.eye(len(C))[:, at_once]
    kept = np.eye(len(C)) - E @ E.T
    A = np.block(
        [[A, np.zeros((len(A), at_once.size))], [speed * C[at_once], -speed * np.eye(at_once.size)]]
    )
    B = np.vstack([B, speed * D[at_once]])
    return p._replace(parts=(A, B, np.hstack([kept @ C, E]), kept @ D), G=None, weights=None)

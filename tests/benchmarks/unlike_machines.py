"""Machines that share no code with a drawing: plates in polynomials and their poles and errors.

Never imports flexplant. A machine is a set of modes with the rows of its channels; what a filter
misses on it is a discrete Lyapunov equation over machine and filter.
"""

from dataclasses import dataclass

import numpy as np
import scipy.linalg as la

from oracles_mindlin import _line, mindlin_matrices

#: number of modes of a machine: to four times half the sampling rate
MODES = 120
#: order of the polynomials of a plate: a filter's errors change by less than 1 % up to order 27
ORDER = 21
#: frequency [Hz] at which rigid-body modes swing, so that a Lyapunov equation has a solution: at
#: 0.01 Hz rounding changes errors of 1 nm on free plates by up to 10 %, at 0.1 Hz by 0.01 %
SWING = 0.1
#: a mode is measured where sensors move by this part of what they move in another one
SEEN = 0.1


@dataclass
class Machine:
    """Modes of a machine: omega [rad/s], damping ratios, rows (channels, modes)."""

    omega: np.ndarray
    zeta: np.ndarray
    push: np.ndarray
    sensors: np.ndarray
    poi: np.ndarray
    shapes: np.ndarray | None = None

    def continuous(self, swing=0.01):
        """A, B of forces, C of sensors and POI; a rigid-body mode swings at `swing` [Hz]."""
        n = self.omega.size
        omega = np.where(self.omega > 0, self.omega, 2 * np.pi * swing)
        zeta = np.where(self.omega > 0, self.zeta, 0.7)
        A = np.zeros((2 * n, 2 * n))
        A[np.arange(n), n + np.arange(n)] = omega
        A[n + np.arange(n), np.arange(n)] = -omega
        A[n + np.arange(n), n + np.arange(n)] = -2 * zeta * omega
        B = np.vstack([np.zeros((n, len(self.push))), self.push.T])
        C = np.hstack(
            [np.vstack([self.sensors, self.poi]) / omega, np.zeros((len(self.sensors) + 3, n))]
        )
        return A, B, C

    def measured(self, count):
        """Poles and shapes at the sensors of the lowest modes that swing and are seen there."""
        size = np.linalg.norm(self.sensors, axis=0)
        own = np.flatnonzero((self.omega > 0) & (size > SEEN * size.max()))[:count]
        omega, zeta = self.omega[own], self.zeta[own]
        return omega * (-zeta + 1j * np.sqrt(1 - zeta**2)), self.sensors[:, own]


def _row(size, place, order, slope=None):
    """Row over (deflection, slope x, slope y) of the motion at a place."""
    at = [np.array([2 * p / n - 1]) for p, n in zip(place, size, strict=True)]
    values = np.kron(*(_line(order, one)[0][0] for one in at))
    none = np.zeros_like(values)
    parts = {None: [values, none, none], "rx": [none, none, values], "ry": [none, -values, none]}
    return np.concatenate(parts[slope])


def plate_machine(
    rng,
    size,
    thickness,
    density,
    E,
    nu,
    *,
    forces,
    sensors,
    poi,
    zeta,
    masses,
    scatter=0.02,
    order=ORDER,
):
    """A free Mindlin plate whose stiffness varies by `scatter`, and its dampings by a quarter."""
    heights = rng.normal(size=(3, 3)) * scatter / 1.5

    def stiff(x, y):
        waves = [
            np.cos(np.pi * np.arange(3) * at[..., None] / n)
            for at, n in zip((x, y), size, strict=True)
        ]
        own = 1.0 + np.einsum("...i,ij,...j->...", waves[0], heights, waves[1])
        return own * (E(x, y) if callable(E) else E)

    M, K = mindlin_matrices(size, thickness, density, stiff, nu, order=order, masses=masses)
    values, phi = la.eigh(K, M, subset_by_index=(0, MODES - 1))
    omega = np.sqrt(np.maximum(values, 0.0))
    omega[:3] = 0.0
    damping = zeta * np.exp(0.25 * rng.normal(size=MODES))
    rows = {
        "push": [_row(size, p, order) for p in forces],
        "sensors": [_row(size, p, order) for p in sensors],
        "poi": [_row(size, poi, order, motion) for motion in (None, "rx", "ry")],
    }
    seen = {name: np.array(part) @ phi for name, part in rows.items()}
    return Machine(omega, damping, **seen)


def true_errors(machine, filter_system, forces_asd, noise_asd, rate, count):
    """Rms errors of the estimates on a machine, u at rest: a Lyapunov equation in unit states.

    `filter_system` is (A, B, C, D) from the sensors to the estimates.
    """
    A, B, C = machine.continuous(SWING)
    n, h = A.shape[0], 1.0 / rate
    # exact covariance of white forces over a sample (Van Loan), mode by mode
    Q, Ad = np.zeros((n, n)), la.expm(A * h)
    W = B @ B.T * 0.5 * forces_asd**2
    steps, weights = np.polynomial.legendre.leggauss(24)
    for s, w in zip(0.5 * h * (steps + 1), 0.5 * h * weights, strict=True):
        part = la.expm(A * s)
        Q += w * part @ W @ part.T
    Af, Bf, Cf, Df = filter_system
    y, z = C[:count], C[count:]
    joint = np.block([[Ad, np.zeros((n, Af.shape[0]))], [Bf @ y, Af]])
    R = np.eye(count) * noise_asd**2 * rate / 2
    noise = la.block_diag(Q, Bf @ R @ Bf.T)
    E = np.hstack([z - Df @ y, -Cf])
    X = la.solve_discrete_lyapunov(joint, noise)
    return np.sqrt(np.diag(E @ X @ E.T + Df @ R @ Df.T))


#: order of the polynomials of a solid along x, y and z
SOLID = (17, 14, 3)


def _solid_row(size, place, motion, order=SOLID):
    """Row over the coefficients of x, y, z of a motion at a place; rx is dz/dy, ry is -dz/dx."""
    at = [np.array([2 * p / n - 1]) for p, n in zip(place, size, strict=True)]
    lines = [_line(k, one) for k, one in zip(order, at, strict=True)]
    turned = {"rx": (1, 1.0), "ry": (0, -1.0)}.get(motion)
    factors = [values[0] for values, _ in lines]
    sign = 1.0
    if turned:
        along, sign = turned
        factors[along] = lines[along][1][0] * 2 / size[along]
    row = sign * np.kron(np.kron(factors[0], factors[1]), factors[2])
    which = {"x": 0, "y": 1}.get(motion, 2)
    return np.concatenate([row if i == which else 0.0 * row for i in range(3)])


def solid_matrices(size, density, E, nu, *, springs=(), masses=(), order=SOLID):
    """M, K of a block in Legendre polynomials; E is a number or a function of (x, y).

    `springs` are pairs of a place and the stiffness [N/m] along x, y and z, `masses` of a place
    and kg.
    """
    half = 0.5 * np.asarray(size)
    points, weights = zip(*(np.polynomial.legendre.leggauss(n + 3) for n in order), strict=True)
    lines = [_line(n, p) for n, p in zip(order, points, strict=True)]

    def field(along=None):
        parts = [lines[i][1] / half[i] if i == along else lines[i][0] for i in range(3)]
        return np.kron(np.kron(parts[0], parts[1]), parts[2])

    volume = half.prod() * np.kron(np.kron(weights[0], weights[1]), weights[2])
    grid = np.meshgrid(*(h * (1 + p) for h, p in zip(half, points, strict=True)), indexing="ij")
    young = E(grid[0].ravel(), grid[1].ravel()) if callable(E) else E
    D = [field(i) for i in range(3)]
    shear = volume * young / (2 * (1 + nu))
    bulk = volume * young * nu / ((1 + nu) * (1 - 2 * nu))

    def block(i, j):
        found = D[i].T @ (bulk[:, None] * D[j]) + D[j].T @ (shear[:, None] * D[i])
        if i == j:
            found = found + sum(d.T @ (shear[:, None] * d) for d in D)
        return found

    K = np.block([[block(i, j) for j in range(3)] for i in range(3)])
    F = field()
    M = la.block_diag(*(3 * [F.T @ ((density * volume)[:, None] * F)]))
    for matrix, parts in ((K, springs), (M, masses)):
        for place, amount in parts:
            for motion, size_of in zip("xyz", np.broadcast_to(amount, 3), strict=True):
                row = _solid_row(size, place, motion, order)
                matrix += size_of * np.outer(row, row)
    return 0.5 * (M + M.T), 0.5 * (K + K.T)


def solid_machine(
    rng, size, density, E, nu, *, forces, sensors, poi, zeta, masses, springs, scatter=0.02
):
    """A block on springs whose stiffness varies by `scatter`, and its dampings by a quarter."""
    heights = rng.normal(size=(3, 3)) * scatter / 1.5

    def stiff(x, y):
        waves = [
            np.cos(np.pi * np.arange(3) * at[..., None] / n)
            for at, n in zip((x, y), size[:2], strict=True)
        ]
        return E * (1.0 + np.einsum("...i,ij,...j->...", waves[0], heights, waves[1]))

    M, K = solid_matrices(size, density, stiff, nu, springs=springs, masses=masses)
    values, phi = la.eigh(K, M, subset_by_index=(0, MODES - 1))
    rows = {
        "push": [_solid_row(size, p, "z") for p in forces],
        "sensors": [_solid_row(size, p, "z") for p in sensors],
        "poi": [_solid_row(size, poi, motion) for motion in ("z", "rx", "ry")],
    }
    seen = {name: np.array(part) @ phi for name, part in rows.items()}
    return Machine(np.sqrt(values), zeta * np.exp(0.25 * rng.normal(size=MODES)), **seen)

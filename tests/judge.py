"""A judge of loops on A, B, C, D alone: numpy, and none of the code that designed them."""

from typing import NamedTuple

import numpy as np


class Verdict(NamedTuple):
    """What a loop does, by its matrices."""

    radius: float
    together: float
    alone: float
    freq: np.ndarray
    S: np.ndarray

    @property
    def margin(self):
        """Modulus margin at u: all inputs together, or one loop at a time where that is larger."""
        return max(self.together, self.alone)

    def follows(self, bandwidth):
        """Return |S| of every reference, at a quarter and at a twentieth of a bandwidth."""
        return [
            float(np.max([np.interp(bandwidth / part, self.freq, s) for s in self.S], initial=0.0))
            for part in (4.0, 20.0)
        ]

    def serves(self, bandwidth=None):
        """Return whether it is stable with a margin of 0.4 and follows its references."""
        held = self.radius < 1.0 and self.margin >= 0.4
        if bandwidth is None or not held:
            return held
        near, far = self.follows(bandwidth)
        return near <= 1.3 and far <= 0.3


def closed(plant, blocks):
    """Return A, B, C, D of [references, pushes at u] -> [errors, u of the controller, z].

    The observer reads what the controller commands; a push adds to it on its way to the plant.
    """
    g = plant.system
    parts = [g, *blocks]
    n = [p.A.shape[0] for p in parts]
    A0 = np.zeros((sum(n), sum(n)))
    at = np.cumsum([0, *n])
    signals = [(i, name) for i, p in enumerate(parts) for name in p.outputs]
    row = {}
    for k, (i, name) in enumerate(signals):
        row.setdefault((i == 0, name), []).append(k)
    N = len(signals)
    refs = [name for name in plant.w if name.endswith(":ref")]
    ext = [*refs, *(f"push {name}" for name in plant.u)]
    B0 = []
    C0, D0 = np.zeros((N, sum(n))), []
    pick, entry = [], []
    k = 0
    for i, p in enumerate(parts):
        A0[at[i] : at[i + 1], at[i] : at[i + 1]] = p.A
        C0[k : k + len(p.outputs), at[i] : at[i + 1]] = p.C
        for name in p.inputs:
            source, outer = np.zeros(N), np.zeros(len(ext))
            if i == 0 and name in refs:
                outer[ext.index(name)] = 1.0
            elif name in plant.u:
                source[row.get((False, name), [])] = 1.0  # outputs of blocks to one actuator add
                if i == 0:
                    outer[ext.index(f"push {name}")] = 1.0
            elif i > 0 and (False, name) in row:
                source[row[False, name]] = 1.0
            elif i > 0 and (True, name) in row:
                source[row[True, name]] = 1.0
            elif i > 0:
                raise AssertionError(f"nothing gives {name}")
            pick.append(source)
            entry.append(outer)
        B = np.zeros((sum(n), len(p.inputs)))
        B[at[i] : at[i + 1]] = p.B
        D = np.zeros((N, len(p.inputs)))
        D[k : k + len(p.outputs)] = p.D
        B0.append(B)
        D0.append(D)
        k += len(p.outputs)
    B0, D0, pick, entry = np.hstack(B0), np.hstack(D0), np.array(pick), np.array(entry)
    inner = np.linalg.inv(np.eye(N) - D0 @ pick)
    C, D = inner @ C0, inner @ D0 @ entry
    A, B = A0 + B0 @ pick @ C, B0 @ (entry + pick @ D)
    rows = [row[True, name][0] for name in plant.z]
    u = np.zeros((len(plant.u), N))
    for j, name in enumerate(plant.u):
        u[j, row.get((False, name), [])] = 1.0
    names = [*plant.z, *plant.u]
    return A, B, np.vstack([C[rows], u @ C]), np.vstack([D[rows], u @ D]), ext, names


def gain(A, B, C, D, z):
    """Return C (z I - A)^-1 B + D at each z."""
    eye = np.eye(A.shape[0])
    return np.array([C @ np.linalg.solve(one * eye - A, B) + D for one in z])


def through(poles, dt, points=400):
    """Return frequencies [Hz] up to half the rate, through the resonances of some poles."""
    top = 0.499 / dt
    speed = np.log(poles[np.abs(poles) > 1e-9].astype(complex)) / dt / (2 * np.pi)
    centre, width = np.abs(speed), np.maximum(np.abs(speed.real), 1e-7 * top)
    near = centre[:, None] + width[:, None] * np.linspace(-3, 3, 13)
    grid = np.concatenate([np.geomspace(1e-5 * top, top, points), near.ravel()])
    return np.unique(grid[(grid > 0) & (grid <= top)])


def judged(plant, *blocks):
    """Return the verdict on a sampled plant with blocks that connect by name."""
    blocks = [getattr(one, "system", one) for one in blocks]
    A, B, C, D, ext, names = closed(plant, blocks)
    poles = np.linalg.eigvals(A)
    freq = through(poles, plant.dt)
    T = gain(A, B, C, D, np.exp(2j * np.pi * freq * plant.dt))
    push = [i for i, name in enumerate(ext) if name.startswith("push")]
    own = [names.index(name) for name in plant.u]
    S = np.eye(len(own)) + T[:, own][:, :, push]
    together = 1.0 / np.linalg.svd(S, compute_uv=False)[:, 0].max()
    alone = 1.0 / np.abs(np.einsum("fii->fi", S)).max()
    refs = [name for name in ext if not name.startswith("push")]
    errors = [np.abs(T[:, names.index(_error(name, names)), ext.index(name)]) for name in refs]
    radius = float(np.abs(poles).max())
    return Verdict(
        radius, float(together), float(alone), freq, np.array(errors).reshape(-1, freq.size)
    )


def _error(reference, names):
    name = reference.removesuffix(":ref") + ":error"
    assert name in names
    return name


def inverse_error(plant, feedforward, freq):
    """Return max |P F - 1| of one reference: derivatives of a sine through block and plant."""
    g, f, block = plant.system, feedforward, feedforward.system
    u = [g.inputs.index(name) for name in f.actuators]
    poi = g.outputs.index(_error(f.reference, plant.z))
    s = 2j * np.pi * freq
    P = gain(g.A, g.B[:, u], -g.C[[poi]], -g.D[[poi]][:, u], np.exp(s * g.dt))
    terms = ("velocity", "acceleration", "jerk", "snap")
    orders = [0 if n == f.reference else 1 + terms.index(n.split(":")[-1]) for n in block.inputs]
    forces = gain(block.A, block.B, block.C, block.D, np.exp(s * g.dt))
    forces = np.einsum("fik,fk->fi", forces, s[:, None] ** np.array(orders))
    return float(np.max(np.abs(np.einsum("fi,fi->f", P[:, 0], forces) - 1.0)))

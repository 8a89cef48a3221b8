"""A machine whose ports move with its position, simulated exactly within each sample.

``x+ = A x + sum_i int e^(A (T - s)) b_i(p(s)) f_i(s) ds``: the modes do not depend on the position,
only where forces act and motions are seen. The integrals are taken by Gauss's rule, to rounding,
with b_i quadratic in time over a sample through its ends and its middle.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass
from functools import cached_property
from typing import Any, NamedTuple

import numpy as np
import scipy.sparse as sp

from ..arrays import FloatArray, real_array
from ..errors import ModelError, require_known
from ..loop import ClosedLoop, ScheduledLoop
from ..lti.sampling import pair_expm
from ..plant import Actuator, Poi, StandardPlant
from ..plant.building import WhiteNoise, continuous_factor, white_noise
from ..plant.scheduling import Position
from ..tolerances import ROOT, SAME
from .motion import SetPointProfile
from .nonlinear_elements import Acting
from .runs import ABREAST, STRETCH

#: number of nodes of Gauss's rule in a sample, in addition to one for each radian of the fastest
#: mode
_NODES = 12


@dataclass(frozen=True)
class Trajectory:
    """Values of the positions as functions of time, within their ranges."""

    positions: tuple[Position, ...]
    paths: Mapping[str, Callable[[FloatArray], FloatArray]]
    standing: Mapping[str, float]

    def at(self, time: FloatArray) -> dict[str, FloatArray]:
        """Return the values (n,) of each position at times (n,)."""
        still = {name: np.full(time.size, value) for name, value in self.standing.items()}
        return still | {name: path(time) for name, path in self.paths.items()}


def trajectory(plant: StandardPlant, moving: Mapping[str, Any], time: FloatArray) -> Trajectory:
    """Return the paths of positions: from SetPoints, functions, or a value per sample."""
    ports = plant.assembled.ports
    known = {one.name: one for one in ports.positions}
    require_known("position to move", moving, known)
    dt = float(plant.dt)
    # includes the end of the last sample
    ends = np.append(time, time[-1] + dt)
    paths: dict[str, Callable[[FloatArray], FloatArray]] = {}
    for name, path in moving.items():
        paths[name] = _path(name, path, time)
        for value in (paths[name](ends).min(), paths[name](ends).max()):
            known[name].within(value)
    return Trajectory(tuple(ports.positions), paths, ports.values)


def known_positions(plant: StandardPlant, what: str) -> tuple[Position, ...]:
    """Return the positions of a plant; ModelError where a sampled plant's ports do not move."""
    found = plant.ports.positions if plant.dt else ()
    if not found:
        raise ModelError(
            f"{what} a sampled plant whose ports move: Ports(..., positions=["
            "fx.plant.Position('x', range=...)]) and plant.discretized(rate)."
        )
    return tuple(found)


def _path(name: str, path: Any, time: FloatArray) -> Callable[[FloatArray], FloatArray]:
    """Return a position as a function of time; a value a sample is smooth between them."""
    if isinstance(path, SetPointProfile):
        return lambda t: np.asarray(path.at(t).position)
    if callable(path):
        return lambda t: real_array(path(t), f"position {name!r} over time", (t.size,))
    values = real_array(path, f"position {name!r} over time", (time.size,))
    if time.size < 4:
        raise ModelError(
            f"position {name!r} has {time.size} values: give four samples or more, a "
            "function or a SetPoint."
        )
    from scipy.interpolate import CubicSpline

    spline = CubicSpline(time, values)
    return lambda t: np.asarray(spline(np.minimum(t, time[-1])))


class _Force(NamedTuple):
    """A moving force with its delay: whole samples and a fraction."""

    port: Any
    whole: int
    fraction: float
    asd: float


class Sample(NamedTuple):
    """The plant in one sample: ``x+ = A x + B [w; u] + G n``, ``[z; y] = C x + D [w; u]``."""

    A: FloatArray
    B: FloatArray
    C: FloatArray
    G: FloatArray


class MovingPlant:
    """A sampled plant along a trajectory of positions."""

    stretch = STRETCH

    def __init__(self, plant: StandardPlant, path: Trajectory, *, noise: bool = True) -> None:
        self.plant, self.path, self.first = plant, path, 0
        own = self.realisation = plant.assembled.realisation
        self.modal = plant.modal_states
        ports = plant.assembled.ports
        names = set(path.paths)
        every: tuple[Any, ...] = (*ports.forces, *ports.z, *ports.y)
        moves = [
            port for port in every
            if getattr(port, "moves", None) is not None and names & set(port.moves.names)
        ]  # fmt: skip
        _require_plain(plant, moves)
        moving = {id(port) for port in moves}
        h = float(plant.dt)
        self.forces = [_force_at(plant, port, noise) for port in ports.forces if id(port) in moving]
        sensors: tuple[Any, ...] = tuple(ports.y)
        # ports and axes, with the rows of [z; y] that show them and their signs
        self.shown = [
            (poi, axis, _axis_channels(plant, poi, axis)) for poi in ports.z if id(poi) in moving
            for axis in poi.axes
        ] + [
            (s, s.direction, [(len(plant.z) + plant.y.index(s.name), 1.0)]) for s in sensors
            if id(s) in moving
        ]  # fmt: skip
        self.rule = _Rule(own.pairs, h)
        self._fixed(noise)

    def _fixed(self, noise: bool) -> None:
        """Separate the moving parts of the matrices of the sampled plant."""
        g, plant = self.plant.system, self.plant
        A, B, C = np.array(g.A), np.array(g.B), np.array(g.C)
        #: state or input with the new, and the old, sample of each force
        self.new: list[tuple[bool, int]] = []
        self.old: list[tuple[bool, int]] = []
        for force in self.forces:
            name, m = force.port.name, force.whole
            lines = [f"{name}:delay{age}" for age in (m, m + 1)]
            for kept, age, line in zip((self.new, self.old), (m, m + 1), lines, strict=True):
                if not age:
                    i = int(g.input_index([name])[0])
                    kept.append((False, i))
                    B[self.modal, i] = 0.0
                elif line in g.states:
                    i = g.states.index(line)
                    kept.append((True, i))
                    A[self.modal, i] = 0.0
                else:
                    kept.append((False, -1))
            for i in g.input_index([n for n in (f"{name}:disturbance",) if n in g.inputs]):
                B[self.modal, i] = 0.0
        rows = [i for *_, at in self.shown for i, _ in at]
        C[np.ix_(np.array(rows, dtype=np.int64), self.modal)] = 0.0
        self.A, self.B, self.C, self.D = A, B, C, g.D
        loud = plant if noise else plant.replace(asd={})
        self.noise = _noise_without(loud, {force.port.name for force in self.forces})

    def each(self, count: int) -> Iterator[Sample]:
        """Return the matrices of a number of samples, from the first."""
        self.first = 0
        loud = [force.asd / np.sqrt(2.0) for force in self.forces]
        while self.first < count:
            k = min(self.stretch, count - self.first)
            B, rows = self._columns(k), self._seen(k)
            new, old = self._acting(B)
            kicks = [self.rule.kicks(b) * size for b, size in zip(B, loud, strict=True) if size]
            for i in range(k):
                matrices = np.array(self.A), np.array(self.B)
                for places, effects in ((self.new, new), (self.old, old)):
                    for (is_state, j), effect in zip(places, effects, strict=True):
                        if j >= 0:
                            matrices[1 - is_state][self.modal, j] += effect[i]
                C = np.array(self.C)
                for at, row in rows:
                    for j, sign in at:
                        C[j, self.modal] = sign * row[i]
                G = np.zeros((len(self.A), sum(kick.shape[1] for kick in kicks)))
                if kicks:
                    G[self.modal] = np.vstack([kick[i] for kick in kicks]).T
                yield Sample(*matrices, C, np.hstack([self.noise.factor, G]))
            self.first += k

    def _columns(self, k: int) -> list[FloatArray]:
        """Return each force's columns (k, 3, 2 b) at the begin, the middle and the end."""
        h = float(self.plant.dt)
        time = np.asarray((self.first + 0.5 * np.arange(2 * k + 1)) * h, dtype=np.float64)
        values = self.path.at(time)
        ports = [force.port for force in self.forces]
        rows = [_rows_along(self.realisation, port, port.direction, values) for port in ports]
        columns = [row @ self.realisation.inputs for row in rows]
        return [np.stack([one[:-2:2], one[1:-1:2], one[2::2]], axis=1) for one in columns]

    def _acting(self, B: list[FloatArray]) -> tuple[list[FloatArray], list[FloatArray]]:
        """Return the effects (k, 2 b) of each force's new and old sample."""
        h, parts = float(self.plant.dt), [*zip(self.forces, B, strict=True)]
        new = [self.rule.pushed(columns, force.fraction, h) for force, columns in parts]
        return new, [self.rule.pushed(columns, 0.0, force.fraction) for force, columns in parts]

    def _seen(self, k: int) -> list[tuple[list[tuple[int, float]], FloatArray]]:
        """Return where rows go, with which sign, and the rows (k, 2 b) at each sample."""
        time = np.asarray((self.first + np.arange(k)) * float(self.plant.dt), dtype=np.float64)
        values = self.path.at(time)
        own, out = self.realisation, self.realisation.outputs
        return [(at, _rows_along(own, port, axis, values) @ out) for port, axis, at in self.shown]


class MovingMachine(MovingPlant):
    """Runs of a closed loop along a trajectory of positions, sample by sample."""

    abreast = ABREAST

    def __init__(
        self,
        loop: ClosedLoop,
        path: Trajectory,
        *,
        noise: bool,
        schedule: ScheduledLoop | None = None,
        sensed: Acting | None = None,
    ) -> None:
        super().__init__(loop.machine, path, noise=noise)
        self.loop, self.schedule, self.sensed = loop, schedule, sensed
        if schedule is not None:
            require_known("position that schedules", [schedule.position], path.paths)
        u = [self.plant.u.index(name) for name in loop.driven]
        self.u = len(self.plant.w) + np.array(u, dtype=np.int64)

    def begin(self, start: FloatArray, generators: list[np.random.Generator]) -> None:
        """Put all runs at a state of plant and controller; each draws from its generator."""
        n, count = self.plant.system.n_states, len(generators)
        self.generators, self.first = generators, 0
        self.x, self.c = np.tile(start[:n], (count, 1)), np.tile(start[n:], (count, 1))
        if self.sensed is not None:
            self.sensed.begin(generators)

    def fill(self, given: FloatArray, data: FloatArray) -> bool:
        """Run one stretch: w as `given` (k, nw) or (runs, k, nw) plus noise; return if finite."""
        k, plant, runs = given.shape[-2], self.plant, len(self.x)
        nz, nw, nu = len(plant.z), len(plant.w), len(self.loop.driven)
        B, rows = self._columns(k), self._seen(k)
        new, old = self._acting(B)
        w = np.broadcast_to(given, (runs, k, nw)).copy()
        state_noise = self._drawn(w, B, k)
        inputs = np.zeros((runs, nw + len(plant.u)))
        flow = sp.csr_array(self.A)  # modes only act on themselves
        for i in range(k):
            x = self.x
            inputs[:, :nw] = w[:, i]
            shown = x @ self.C.T
            for at, row in rows:
                shown[:, [j for j, _ in at]] = (x[:, self.modal] @ row[i])[:, None] * [
                    sign for _, sign in at
                ]
            y = shown[:, nz:] + inputs @ self.D[nz:].T
            if self.sensed is not None:
                self.sensed.apply(y)
            A, law_B, law_C, law_D = self.law_at(self.first + i)
            out = self.c @ law_C.T + y @ law_D.T
            self.c = self.c @ A.T + y @ law_B.T
            inputs[:, self.u] = out[:, :nu]
            z = shown[:, :nz] + inputs @ self.D[:nz].T
            following = (flow @ x.T).T + inputs @ self.B.T + state_noise[:, i]
            for f in range(len(self.forces)):
                push = self._held(self.new[f], x, inputs)[:, None] * new[f][i]
                push += self._held(self.old[f], x, inputs)[:, None] * old[f][i]
                following[:, self.modal] += push
            self.x = following
            data[:, :, i] = np.hstack([z, y, out])
        self.first += k
        return bool(np.all(np.isfinite(self.x)))

    def law_at(self, k: int) -> tuple[FloatArray, ...]:
        """Return A, B, C and D of the controller in a sample."""
        if self.schedule is None:
            law = self.loop.controller
            return law.A, law.B, law.C, law.D
        at = self.path.at(np.array([k * float(self.plant.dt)]))
        return self.schedule.matrices(float(at[self.schedule.position][0]))

    def closed(self, k: int, sample: Sample) -> tuple[FloatArray, ...]:
        """Return A, G, C and D of sample k in closed loop: X+ = A X + G n, C X + D n is shown."""
        nz, nu, columns = len(self.plant.z), len(self.loop.driven), self.noise.columns
        law_A, law_B, law_C, law_D = self.law_at(k)
        W = np.zeros((sample.B.shape[1], columns.size))
        W[columns, np.arange(columns.size)] = self.noise.deviation
        C1, C2, D2 = sample.C[:nz], sample.C[nz:], self.D[nz:] @ W
        B_u, D_u = sample.B[:, self.u], self.D[:nz, self.u]
        # commands and what is watched, over x, c and the noises of sensors
        out = law_D @ C2, law_C, law_D @ D2
        of_x, of_c, of_n = (part[:nu] for part in out)
        A = np.block([[sample.A + B_u @ of_x, B_u @ of_c], [law_B @ C2, law_A]])
        none = np.zeros((len(law_A), sample.G.shape[1]))
        G = np.block([[sample.G, sample.B @ W + B_u @ of_n], [none, law_B @ D2]])
        still = np.zeros((len(C2), len(law_A)))
        C = np.block([[C1 + D_u @ of_x, D_u @ of_c], [C2, still], [out[0], out[1]]])
        return A, G, C, np.vstack([self.D[:nz] @ W + D_u @ of_n, D2, out[2]])

    @staticmethod
    def _held(place: tuple[bool, int], x: FloatArray, inputs: FloatArray) -> FloatArray:
        is_state, i = place
        return x[:, i] if is_state else inputs[:, i] if i >= 0 else np.zeros(len(x))

    def _drawn(self, w: FloatArray, B: list[FloatArray], k: int) -> FloatArray:
        """Add noises to w, and return what white forces add to the states (runs, k, n)."""
        runs, noise = len(self.x), self.noise
        loud = [(f, c) for f, c in zip(self.forces, B, strict=True) if f.asd > 0]
        kicks = [self.rule.kicks(c) * (f.asd / np.sqrt(2.0)) for f, c in loud]
        kick = np.concatenate([np.zeros((k, 0, self.modal.size)), *kicks], axis=1)
        mixing = self.rule.white[0] if kicks else np.zeros((0, 0))
        nodes = len(mixing)
        sizes = noise.columns.size, noise.factor.shape[1], nodes * len(kicks)
        drawn = [np.zeros((k, runs, size)) for size in sizes]
        for r, generator in enumerate(self.generators):
            # a whole stretch, so that a longer run begins with the shorter one
            for white, size in zip(drawn, sizes, strict=True):
                white[:, r] = generator.standard_normal((self.stretch, size))[:k]
        w[:, :, noise.columns] += (drawn[0] * noise.deviation).swapaxes(0, 1)
        found: FloatArray = (drawn[1] @ noise.factor.T).swapaxes(0, 1)
        white = drawn[2].reshape(k, runs, len(kicks), nodes) @ mixing
        found[:, :, self.modal] += (white.reshape(k, runs, -1) @ kick).swapaxes(0, 1)
        return found


class _Rule:
    """Integrals over a sample of ``e^(A (T - s)) b(s)``, b quadratic through three columns."""

    def __init__(self, pairs: FloatArray, h: float) -> None:
        self.pairs, self.h = pairs, h
        self._known: dict[tuple[float, float], tuple[FloatArray, FloatArray, FloatArray]] = {}
        fastest = float(np.abs(pairs).sum(axis=2).max(initial=0.0))
        self.nodes, self.weights = np.polynomial.legendre.leggauss(
            _NODES + int(np.ceil(fastest * h))
        )

    def _at(self, start: float, end: float) -> tuple[FloatArray, FloatArray, FloatArray]:
        """Return weights (q,), the columns' shares (q, 3) and e^(A (T - s)) (q, b, 2, 2)."""
        if (start, end) not in self._known:
            s = start + 0.5 * (end - start) * (1.0 + self.nodes)
            t = s / self.h
            share = np.stack([(1 - t) * (1 - 2 * t), 4 * t * (1 - t), t * (2 * t - 1)], axis=1)
            flow = np.array([pair_expm(self.pairs, self.h - one) for one in s.tolist()])
            self._known[start, end] = 0.5 * (end - start) * self.weights, share, flow
        return self._known[start, end]

    def pushed(self, columns: FloatArray, start: float, end: float) -> FloatArray:
        """Return the effect (k, 2 b) of a unit force from start to end of a sample."""
        if end - start <= 0.0:
            return np.zeros((len(columns), columns.shape[2]))
        weight, share, flow = self._at(start, end)
        W = np.einsum("q,qj,qbcd->jbcd", weight, share, flow)
        found = np.einsum("jbcd,kjbd->kbc", W, columns.reshape(*columns.shape[:2], -1, 2))
        return np.asarray(found.reshape(len(columns), -1))

    @cached_property
    def white(self) -> tuple[FloatArray, FloatArray]:
        """Mixing (q, r) of white samples at the nodes, and what r of them add (b, 2 r, 6)."""
        # over the states of each mode, for three columns of two entries: the fastest mode needs
        # many nodes, but the singular values of their effect on all modes decrease fast
        weight, share, flow = self._at(0.0, self.h)
        parts = np.einsum("q,qj,qbcd->qbcjd", np.sqrt(weight), share, flow)
        full = parts.reshape(weight.size, -1)
        U, s, V = np.linalg.svd(full, full_matrices=False)
        kept = int(np.count_nonzero(s > ROOT * s.max(initial=0.0)))
        found = (s[:kept, None] * V[:kept]).reshape(kept, len(self.pairs), 2, 6)
        ordered = found.transpose(1, 2, 0, 3).reshape(len(self.pairs), 2 * kept, 6)
        return U[:, :kept], np.ascontiguousarray(ordered)

    def kicks(self, columns: FloatArray) -> FloatArray:
        """Return the effect of r white samples, mixed by `white`, on the states (k, r, 2 b)."""
        k, b = len(columns), len(self.pairs)
        sides = columns.reshape(k, 3, b, 2).transpose(2, 1, 3, 0).reshape(b, 6, k)
        found = self.white[1] @ sides  # (b, 2 r, k)
        return np.ascontiguousarray(found.reshape(b, 2, -1, k).transpose(3, 2, 0, 1)).reshape(
            k, -1, 2 * b
        )


def _rows_along(
    realisation: Any, port: Any, axis: str, values: Mapping[str, FloatArray]
) -> FloatArray:
    """Return rows (n, DOFs) of a port's place along an axis at values (n,) of the positions."""
    terms = port.moves.points(values)
    return np.asarray(sum(weight * realisation.model.rows(at, axis) for weight, at in terms))


def _axis_channels(plant: StandardPlant, poi: Poi, axis: str) -> list[tuple[int, float]]:
    """Return the channels of z that show an axis of a POI, with their sign."""
    found = [(plant.z.index(poi.channel(axis)), 1.0)]
    error = poi.derived(axis, "error")
    return [*found, (plant.z.index(error), -1.0)] if error in plant.z else found


def _force_at(plant: StandardPlant, port: Any, noise: bool) -> _Force:
    """Return a force that moves, with its delay."""
    is_actuator = isinstance(port, Actuator)
    samples = plant.delay + port.latency / plant.dt if is_actuator else 0.0
    near = round(samples)
    samples = float(near) if abs(samples - near) < SAME * max(near, 1) else float(samples)
    whole = int(samples)
    name = f"{port.name}:disturbance" if is_actuator else port.name
    asd = float(plant.asd.get(name, 0.0)) if noise else 0.0
    return _Force(port, whole, (samples - whole) * float(plant.dt), asd)


def _noise_without(plant: StandardPlant, moving: set[str]) -> WhiteNoise:
    """Return the white noises of a plant without those of forces that move."""
    noise = white_noise(plant)
    if not moving or not noise.factor.size:
        return noise
    still = {n: a for n, a in plant.asd.items() if n.removesuffix(":disturbance") not in moving}
    return noise._replace(factor=continuous_factor(plant.replace(asd=still)))


def _require_plain(plant: StandardPlant, moves: list[Any]) -> None:
    """Refuse inexact cases: moving filters and late sensors, motions that respond without delay."""
    own = plant.assembled.realisation
    if own.coupling is not None or own.static_outputs.size:
        raise ModelError(
            f"the plant's modes are in the form {own.form!r}, or residual vectors respond "
            "without delay: a moving machine needs uncoupled modes. Use proportional or modal "
            "damping, and "
            "residual=fx.plant.FastStates()."
        )
    if plant.modal_states[0] and any(hasattr(port, "push") for port in moves):
        raise ModelError(
            f"forces move, and {plant.system.states[0]!r} of a sensor answers them within a "
            "sample: that is not computed along a trajectory. Take dynamics and latencies of "
            "sensors into the controller's blocks, or let forces stay."
        )
    for port in moves:
        quantity = getattr(port, "quantity", "displacement")
        late = not isinstance(port, Actuator) and bool(getattr(port, "latency", None))
        refused = {
            "has dynamics": getattr(port, "filter", None) is not None,
            f"measures {quantity}": quantity != "displacement",
            "is late": late,
            "is held over samples": getattr(port, "held", False),
            "is absolute": bool(getattr(port, "absolute", None)),
        }
        if why := [reason for reason, holds in refused.items() if holds]:
            raise ModelError(
                f"{port.name!r} moves and {why[0]}: its motion within a sample is not computed "
                "along a trajectory. Leave this out of moving ports, or put its dynamics into "
                "the controller's blocks."
            )

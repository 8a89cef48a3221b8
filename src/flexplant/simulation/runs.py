"""Runs of a sampled closed loop: sample by sample, or in blocks of samples where these agree."""

from __future__ import annotations

from collections.abc import Mapping
from functools import cached_property
from typing import Any, NamedTuple

import numpy as np

from ..arrays import FloatArray, IntArray, divisor
from ..loop import ClosedLoop
from ..loop.blocks import applied_law
from ..lti.response_solvers import CALL, ONE_VECTOR, Blocks, Recursion, cheapest
from ..lti.statespace import StateSpace
from ..parallel import PIECE
from ..plant import StandardPlant
from ..plant.building import WhiteNoise, white_names
from ..tolerances import RESIDUAL, ROOT
from .nonlinear_elements import Acting, Answering


class Conditions(NamedTuple):
    """Conditions under which a run differs from that of the linear loop at its samples.

    `paths` are the places (n_time, 3) of POIs; the controller acts in every `finer`-th sample.
    """

    on_y: Mapping[str, Any] = {}
    on_u: Mapping[str, Any] = {}
    on_w: Mapping[str, Any] = {}
    recovery: float | None = None
    finer: int = 1
    paths: Mapping[str, FloatArray] = {}

    @property
    def one_by_one(self) -> bool:
        """Whether the run has nonlinear elements."""
        return bool(self.on_y or self.on_u or self.on_w)


class Rows(NamedTuple):
    """Channels of z whose rows C (k, c, n) and D (k, c, m) over x and [w; u] differ by sample."""

    shown: list[int]
    C: FloatArray
    D: FloatArray

    def show(self, z: FloatArray, x: FloatArray, inputs: FloatArray) -> None:
        """Put these channels into z (k, nz), for states x (k, n) and [w; u] (k, m)."""
        z[:, self.shown] = np.einsum("kcn,kn->kc", self.C, x)
        z[:, self.shown] += np.einsum("kcm,km->kc", self.D, inputs)


class Moving:
    """The rows of z that change with the places of POIs."""

    def __init__(self, plant: StandardPlant, paths: Mapping[str, FloatArray]) -> None:
        self.plant, self.paths = plant, paths

    def rows(self, first: int, count: int) -> list[Rows]:
        """Return the rows of the samples from `first`; repeated places are computed once."""
        found = []
        for name, points in self.paths.items():
            places, at = np.unique(points[first : first + count], axis=0, return_inverse=True)
            along, again = self.plant.along(name, places), at.ravel()
            shown = [self.plant.z.index(channel) for channel in along.channels]
            found.append(Rows(shown, along.C[again], along.D[again]))
        return found


class Machine(NamedTuple):
    """The matrices of one sample, arranged for speed.

    ``x+ = diagonal x + coupling x[partner] + inflow [x[columns]; u] + noise`` is the plant,
    ``[c+; u; watched] = law [c; y]`` the controller. Where applied commands differ from commands,
    ``command [c; y]`` is the command and ``[c+; u; watched] = law [c; y; u]``.
    """

    diagonal: FloatArray
    coupling: FloatArray
    partner: IntArray
    columns: IntArray
    inflow: FloatArray
    sense: FloatArray
    law: FloatArray
    n_controller: int
    n_driven: int
    command: FloatArray | None = None


class Buffers(NamedTuple):
    """A stretch of samples: states (k + 1, runs, n), y (k, runs, ny), out (k, runs, ...).

    On entry `states[0]` is the present state; `states[1:]` and `y` contain the effects of noise and
    references.
    """

    states: FloatArray
    y: FloatArray
    out: FloatArray


def machine_of(loop: ClosedLoop) -> Machine:
    """Return the matrices of one sample of a closed loop without feedthrough from u to y."""
    plant, law = loop.machine.system, loop.controller
    diagonal, coupling, partner, rest = _split_matrix(plant)
    columns = np.flatnonzero(np.any(rest != 0, axis=0))
    B = plant.B[:, plant.input_index(loop.driven)]
    return Machine(
        diagonal,
        coupling,
        partner,
        columns,
        np.asfortranarray(np.hstack([rest[:, columns], B])),
        np.ascontiguousarray(plant.C[plant.output_index(loop.machine.y)]),
        np.ascontiguousarray(np.block([[law.A, law.B], [law.C, law.D]])),
        law.n_states,
        len(loop.driven),
    )


def step_through(
    m: Machine,
    controller: FloatArray,
    buffers: Buffers,
    sensed: Acting | None = None,
    applied: Acting | None = None,
    hold: int = 1,
    answering: Answering | None = None,
    w: FloatArray | None = None,
) -> FloatArray:
    """Fill `buffers` sample by sample and return the controller's states (runs, n) after them."""
    # elements `sensed` act on y before it is read, `applied` on the commands of a machine that has
    # them; forces `answering` motions are added to w (runs, k, nw). All is done in place. The
    # controller acts in the first of every `hold` samples, and what it commands is held
    # every product is one matrix-vector product per run, never a matrix-matrix product over runs:
    # its rounding, and so a run, does not depend on how many runs go side by side
    states, y, out = buffers
    runs, n = states.shape[1:]
    nc, split = m.n_controller, m.n_controller + m.n_driven
    nj, both = m.columns.size, nc + y.shape[2]
    law_in = np.zeros((runs, m.law.shape[1], 1))
    law_in[:, :nc, 0] = controller
    flow_in = np.zeros((runs, nj + m.n_driven, 1))
    measured = np.zeros((runs, y.shape[2], 1))
    change = np.zeros((runs, n))
    flow = np.zeros((runs, n, 1))
    paired = bool(np.any(m.coupling))
    for k in range(y.shape[0]):
        x, following = states[k], states[k + 1]
        np.matmul(m.sense, x[:, :, None], out=measured)
        y[k] += measured[:, :, 0]
        answer, within = out[k], k % hold
        if sensed is not None:
            sensed.read(within, measured[:, :, 0], y[k])
        if within:
            answer[:] = out[k - 1]
        else:
            if sensed is not None:
                sensed.apply(y[k])
            law_in[:, nc:both, 0] = y[k]
            if m.command is not None and applied is not None:
                np.matmul(m.command, law_in[:, :both], out=law_in[:, both:])
                applied.apply(law_in[:, both:, 0])
            np.matmul(m.law, law_in, out=answer[:, :, None])
            law_in[:, :nc, 0] = answer[:, :nc]
        if applied is not None:
            applied.send(within, answer[:, nc:split])
        if nj:
            flow_in[:, :nj, 0] = x[:, m.columns]
        if answering is not None and w is not None:
            answering.push(measured[:, :, 0], following, w[:, k])
        flow_in[:, nj:, 0] = answer[:, nc:split]
        np.matmul(m.inflow, flow_in, out=flow)
        following += flow[:, :, 0]
        np.multiply(m.diagonal, x, out=change)
        following += change
        if paired:
            np.take(x, m.partner, axis=1, out=change, mode="clip")
            change *= m.coupling
            following += change
    return law_in[:, :nc, 0].copy()


def _split_matrix(g: StateSpace) -> tuple[FloatArray, FloatArray, IntArray, FloatArray]:
    """Split A into a diagonal, a coupling to each state's partner, and the rest."""
    n = g.n_states
    blocks = g.blocks if g.blocks is not None else (n,) if n else ()
    sizes = np.asarray(blocks, dtype=np.int64)
    starts = np.concatenate([[0], np.cumsum(sizes)[:-1]]).astype(np.int64)
    twos = starts[sizes == 2]
    partner = np.arange(n)
    partner[twos], partner[twos + 1] = twos + 1, twos
    rest = g.A.copy()
    index = np.arange(n)
    diagonal = rest[index, index]
    rest[index, index] = 0.0
    paired = partner != index
    coupling = np.where(paired, rest[index, partner], 0.0)
    rest[index[paired], partner[paired]] = 0.0
    return diagonal, coupling, partner, rest


class Drawn:
    """The white noises of a plant, drawn for a stretch of samples at a time.

    Columns of the factor are left out that add less than a fraction of 1e-8 to the variance of
    every state: most moments of forces over a sample. With several forces a column may be a quiet
    force that only an output shows, where the loud ones cancel: it must also be this small in every
    output of this sample and the next. No basis is computed, so that rounding decides nothing.
    Numbers are always drawn for a whole stretch: a longer run begins with the shorter one bit by
    bit.
    """

    def __init__(self, noise: WhiteNoise, plant: StandardPlant) -> None:
        names = [plant.w[i].removesuffix(":noise") for i in noise.columns]
        self.read = np.array([name in plant.y for name in names], dtype=bool)
        self.columns, self.deviation = noise.columns, noise.deviation
        square = np.vstack([noise.factor, _shown(noise.factor, plant)]) ** 2
        part = square / divisor(square.sum(axis=1, keepdims=True))
        kept = part.max(axis=0, initial=0.0) * len(part.T) > ROOT
        self.factor = np.ascontiguousarray(noise.factor[:, kept])

    @property
    def few(self) -> int:
        """Number of white samples for the factor."""
        return int(self.factor.shape[1])

    def draw(self, generator: np.random.Generator, samples: int, hold: int = 1) -> FloatArray:
        """Return (samples, few + k): white samples for the factor, noises of k columns of w."""
        # sensors are read in the first of every `hold` samples, with the noise of that rate
        drawn = generator.standard_normal((samples, self.few + self.columns.size))
        single = drawn[:, self.few :]
        single *= self.deviation
        if hold > 1:
            single[:, self.read] /= np.sqrt(hold)
            single[np.ix_(np.arange(samples) % hold > 0, self.read)] = 0.0
        return drawn


def _shown(factor: FloatArray, plant: StandardPlant) -> FloatArray:
    """Return what a factor of several forces adds to outputs now and a sample later."""
    g, forces = plant.system, white_names(plant)[0]
    rows = np.vstack([g.C, g.C @ g.A])[: None if len(forces) > 1 else 0]
    found = rows @ factor
    # smaller ones may be rounding of states that cancel
    least = ROOT * np.abs(rows) @ np.linalg.norm(factor, axis=1)
    return np.where(np.abs(found) > least[:, None], found, 0.0)


#: number of samples per stretch, a power of two that every size of a block divides, and number of
#: parallel runs that fit the cache of one core
STRETCH, ABREAST = 128, 16
#: length of a run for which the preparation of blocks must pay off [samples]; fixed, since the
#: first samples of a long run equal those of a short one to the last bit
_TYPICAL = 10_000
#: blocks may differ from single samples by this multiple of the rounding of single samples too: a
#: channel that is zero by symmetry is only rounding
_ROUNDING = 100.0


def make_runner(
    loop: ClosedLoop,
    noise: WhiteNoise,
    size: FloatArray,
    *,
    grows: bool = False,
    met: Conditions | None = None,
) -> SampleBySample | InBlocks:
    """Return the faster way through a linear loop, for w given up to a size (nw,).

    Blocks of samples cost less unless a plant in modal blocks is so large that its O(n) operations
    for a sample are fewer. They are used when a block agrees with the same samples one by one to
    1e-10 of each channel's peak, for white inputs as large as those of the run; running single
    samples with three times larger inputs shows their rounding. Moving POIs are computed from the
    plant's states, which come in blocks too; the finer samples of one controller sample are one
    step. Unstable loops and loops with nonlinear elements run sample by sample.
    """
    drawn, met = Drawn(noise, loop.machine), met or Conditions()
    if met.one_by_one:
        return _under(loop, drawn, met)
    moving = Moving(loop.machine, met.paths) if met.paths else None
    single = SampleBySample(loop, machine_of(loop), drawn, hold=met.finer)
    if not grows and loop.machine.system.n_states + loop.controller.n_states:
        blocks = InBlocks(loop, drawn, size, moving, met.finer)
        if blocks.cost < single.cost and blocks.agrees(single, size):
            return blocks
    single.moving = moving
    return single


def _under(loop: ClosedLoop, noise: Drawn, met: Conditions) -> SampleBySample:
    """Return the way through a loop under conditions that are not linear, or change with time."""
    plant, parts, applied = loop.machine, machine_of(loop), None
    dt = met.finer * plant.dt
    if met.on_u:
        command, law = split_law(loop, None if met.recovery is None else met.recovery / dt)
        parts = parts._replace(command=command, law=law)
        applied = Acting(loop.driven, met.on_u, dt, met.finer)
    sensed = Acting(plant.y, met.on_y, dt, met.finer) if met.on_y else None
    moving = Moving(plant, met.paths) if met.paths else None
    answering = Answering(plant, met.on_w, plant.dt) if met.on_w else None
    return SampleBySample(loop, parts, noise, sensed, applied, moving, met.finer, answering)


class SampleBySample:
    """All runs together, sample by sample."""

    abreast = ABREAST

    def __init__(
        self,
        loop: ClosedLoop,
        parts: Machine,
        noise: Drawn,
        sensed: Acting | None = None,
        applied: Acting | None = None,
        moving: Moving | None = None,
        hold: int = 1,
        answering: Answering | None = None,
    ) -> None:
        plant, self.sensed, self.applied = loop.machine, sensed, applied
        self.answering = answering
        self.moving, self.hold = moving, hold
        self.stretch = hold * -(-STRETCH // hold)
        self.parts, self.n, self.ny = parts, plant.system.n_states, len(plant.y)
        self.noise = noise
        u = np.array([plant.u.index(name) for name in loop.driven], dtype=np.int64)
        self.u, self.n_u = u, len(plant.u)
        self.B1, self.D21 = plant.B1, plant.D21
        self.C1, self.D11, self.D12 = plant.C1, plant.D11, plant.D12[:, u]

    @property
    def cost(self) -> float:
        """Operations for a sample: about twelve calls, and products with single vectors."""
        m = self.parts
        products = 2 * ONE_VECTOR * (m.sense.size + m.law.size + m.inflow.size)
        return 12 * CALL + products + 2 * self.noise.factor.size

    def begin(self, start: FloatArray, generators: list[np.random.Generator]) -> None:
        """Put all runs at a state of plant and controller; each draws from its generator."""
        n, count, self.generators = self.n, len(generators), generators
        self.x = np.tile(start[:n], (count, 1))
        self.controller = np.tile(start[n:], (count, 1))
        self.buffers = Buffers(
            np.zeros((self.stretch + 1, count, n)),
            np.zeros((self.stretch, count, self.ny)),
            np.zeros((self.stretch, count, self.parts.law.shape[0])),
        )
        self.w = np.zeros((count, self.stretch, self.B1.shape[1]))
        self.first = 0
        for acting in (self.sensed, self.applied, self.answering):
            if acting is not None:
                acting.begin(generators)

    def fill(self, given: FloatArray, data: FloatArray) -> bool:
        """Run one stretch: w as `given` (k, nw) or (runs, k, nw) plus noise; return if finite."""
        # the channels z, y, driven u and monitored go into `data` (runs, channels, k)
        states, y, _ = self.buffers
        k = given.shape[-2]
        self.w[:, :k], self.w[:, k:] = given, 0.0
        for r, generator in enumerate(self.generators):
            drawn = self.noise.draw(generator, self.stretch, self.hold)
            w, few = self.w[r], self.noise.few
            w[:, self.noise.columns] += drawn[:, few:]
            states[1:, r] = drawn[:, :few] @ self.noise.factor.T + w @ self.B1.T
            y[:, r] = w @ self.D21.T
        return self.advance(k, data)

    def advance(self, k: int, data: FloatArray) -> bool:
        """Run k samples, for which w and what it adds to states and y are in the buffers."""
        states, y, out = self.buffers
        states[0] = self.x
        part = Buffers(states[: k + 1], y[:k], out[:k])
        self.controller = step_through(
            self.parts, self.controller, part, self.sensed, self.applied, self.hold,
            self.answering, self.w,
        )  # fmt: skip
        self.x = states[k].copy()
        nc, nu = self.parts.n_controller, self.parts.n_driven
        places = [] if self.moving is None else self.moving.rows(self.first, k)
        for r in range(self.x.shape[0]):
            x, u = np.ascontiguousarray(states[:-1, r]), out[:, r, nc : nc + nu]
            z = x @ self.C1.T + u @ self.D12.T + self.w[r] @ self.D11.T
            for rows in places:
                inputs = np.zeros((k, self.B1.shape[1] + self.n_u))
                inputs[:, : self.B1.shape[1]] = self.w[r, :k]
                inputs[:, self.B1.shape[1] + self.u] = u[:k]
                rows.show(z[:k], x[:k], inputs)
            data[r] = np.hstack([z[:k], y[:k, r], out[:k, r, nc:]]).T
        self.first += k
        return bool(np.all(np.isfinite(self.x)))


class InBlocks:
    """One run after the other, in blocks of samples of the closed loop as one system.

    Within a block white disturbances move the plant as if nothing were connected. What this adds to
    the plant's outputs enters the loop together with the noises of the sensors: these outputs are
    far fewer than the disturbances and their moments over a sample.
    """

    abreast = 1

    def __init__(
        self,
        loop: ClosedLoop,
        noise: Drawn,
        size: FloatArray,
        moving: Moving | None = None,
        hold: int = 1,
    ) -> None:
        plant, self.plant, self.noise, self.moving = loop.machine, loop.machine, noise, moving
        self.loop, self.hold = loop, hold
        before = len(plant.z) + len(plant.y)
        self.n_shown = before + len(loop.controller.outputs)
        self.driven = slice(before, before + len(loop.driven))
        self.u = [len(plant.w) + plant.u.index(name) for name in loop.driven]
        named, loud = size > 0.0, np.zeros(size.size, dtype=bool)
        loud[noise.columns] = True
        only_read = ~np.any(plant.B1, axis=0) & ~np.any(plant.D11, axis=0)
        self.columns = np.flatnonzero(named | loud & ~only_read)
        own = plant.D21[:, noise.columns] * (only_read & ~named)[noise.columns]
        moved = plant.C2[:, : plant.system.n_states if noise.few else 0]
        self.noisy = np.flatnonzero(np.any(np.hstack([moved, own]), axis=1))
        self.read = own[self.noisy]
        self.outputs = self.n_shown + (plant.system.n_states if moving else 0)
        n, m = plant.system.n_states + loop.controller.n_states, hold * self.inputs
        self.size, cost = cheapest(n, hold * self.outputs, m, _TYPICAL // hold)
        cost += 2 * hold**2 * n**2 * (n + m) / _TYPICAL  # of the samples in one of the controller
        while self.size > 1 and self.size * hold > STRETCH:
            self.size //= 2
        self.cost = cost / hold
        self.stretch = hold * max(PIECE // hold // STRETCH, 1) * STRETCH
        self.w = np.zeros((self.stretch, size.size))

    @property
    def inputs(self) -> int:
        """Number of inputs of the loop."""
        return self.columns.size + self.noisy.size

    @cached_property
    def blocks(self) -> tuple[Blocks, IntArray]:
        """The matrices of a block of the loop, and which of its outputs each output is."""
        states = self.moving is not None
        system = lifted_loop(self.loop, self.columns, self.noisy, self.hold, states)
        return _distinct(system, self.size)

    @cached_property
    def alone(self) -> tuple[Blocks, IntArray]:
        """The same of the plant alone, from what is drawn to noisy y, to z and shown states."""
        g, factor, read = self.plant.system, self.noise.factor, self.read
        states = np.eye(self.outputs - self.n_shown, g.n_states)
        H = np.vstack([self.plant.C2[self.noisy], self.plant.C1, states])
        G = np.hstack([factor, np.zeros((g.n_states, read.shape[1]))])
        J = np.zeros((len(H), G.shape[1]))
        J[: len(read), self.noise.few :] = read
        abreast = self.stretch // (self.size * self.hold)
        size, _ = cheapest(g.n_states, len(H), G.shape[1], _TYPICAL, abreast)
        return _distinct(Recursion(g.A, G, H, J), min(size, self.size))

    def begin(self, start: FloatArray, generators: list[np.random.Generator]) -> None:
        """Put the run at a state of plant and controller; it draws from its generator."""
        self.x, (self.generator,), self.first = start, generators, 0

    def fill(self, given: FloatArray, data: FloatArray) -> bool:
        """Run one stretch."""
        k = given.shape[-2]
        drawn = self.noise.draw(self.generator, self.stretch, self.hold)
        self.w[:k], self.w[k:] = given.reshape(k, -1), 0.0
        self.w[:, self.noise.columns] += drawn[:, self.noise.few :]
        out, self.x = self._run(self.w, drawn, self.x)
        if self.moving is not None:
            self._move(self.moving, out.T[:k])
        data[0] = out[: self.n_shown, :k]
        self.first += k
        return bool(np.all(np.isfinite(self.x)))

    def _run(
        self, w: FloatArray, drawn: FloatArray, x: FloatArray
    ) -> tuple[FloatArray, FloatArray]:
        """Return the outputs (p, N) in single samples, and the last state."""
        v, pushed, nz, noisy = w[:, self.columns], None, len(self.plant.z), self.noisy.size
        if drawn.size:
            alone, each = self.alone
            records = drawn.reshape(-1, self.size * self.hold, drawn.shape[1])
            own, pushed = alone.run(records, np.zeros((len(records), len(alone.step))))
            own = own.reshape(len(w), -1)
            v = np.hstack([v, own[:, each[:noisy]]])
            added = np.take(own.T, each[noisy:], axis=0)
        blocks, shown = self.blocks
        found, x = blocks.run(v.reshape(len(v) // self.hold, -1), x, pushed)
        parts = np.take(found.T, shown, axis=0).reshape(self.hold, self.outputs, -1)
        out = parts.transpose(1, 2, 0).reshape(self.outputs, -1)
        if drawn.size:
            out[:nz] += added[:nz]
            out[self.n_shown :] += added[nz:]
        return out, x

    def _move(self, moving: Moving, out: FloatArray) -> None:
        """Put what POIs along their paths do into out (k, channels, then states)."""
        inputs = np.zeros((out.shape[0], len(self.plant.w) + len(self.plant.u)))
        inputs[:, : len(self.plant.w)] = self.w[: out.shape[0]]
        inputs[:, self.u] = out[:, self.driven]
        for start in range(0, out.shape[0], STRETCH):
            part = slice(start, min(start + STRETCH, out.shape[0]))
            z, states = out[part, : len(self.plant.z)], out[part, self.n_shown :]
            for rows in moving.rows(self.first + start, part.stop - start):
                rows.show(z, states, inputs[part])

    def agrees(self, single: SampleBySample, size: FloatArray) -> bool:
        """Return whether two blocks (or one that fills a stretch) are the same samples singly."""
        block, rng = self.size * self.hold, np.random.default_rng(0)
        k = min(2 * block, max(single.stretch // block, 1) * block)
        w, few = size * rng.standard_normal((k, size.size)), self.noise.few
        drawn = self.noise.draw(rng, k)
        w[:, self.noise.columns] += drawn[:, few:]
        start = np.zeros(self.plant.system.n_states + self.loop.controller.n_states)
        expected = np.zeros((2, self.n_shown, k))
        single.begin(start, [rng, rng])
        states, y, _ = single.buffers
        for r, times in enumerate((1.0, 3.0)):
            single.w[r, :k] = times * w
            states[1 : k + 1, r] = times * (drawn[:, :few] @ self.noise.factor.T + w @ single.B1.T)
            y[:k, r] = times * (w @ single.D21.T)
        single.advance(k, expected)
        rounding = np.abs(expected[1] / 3.0 - expected[0]).max(axis=1)
        wrong = np.abs(self._run(w, drawn, start)[0][: self.n_shown] - expected[0]).max(axis=1)
        allowed = RESIDUAL * np.abs(expected[0]).max(axis=1) + _ROUNDING * rounding
        return bool(np.all(wrong <= allowed))


def _distinct(system: Recursion, size: int) -> tuple[Blocks, IntArray]:
    """Return the matrices of a block, equal outputs once, and which of them each output is."""
    rows = [row.tobytes() for row in np.hstack([system.H, system.J])]
    once = list(dict.fromkeys(rows))
    kept = [rows.index(row) for row in once]
    blocks = system._replace(H=system.H[kept], J=system.J[kept]).in_blocks(size)
    return blocks, np.array([once.index(row) for row in rows], dtype=np.int64)


def lifted_loop(
    loop: ClosedLoop, columns: IntArray, noisy: IntArray, hold: int, states: bool
) -> Recursion:
    """Return a sampled loop whose controller acts in the first of every `hold` samples.

    Its inputs are columns of w and what is added to noisy outputs y.
    """
    plant, law, g = loop.machine, loop.controller, loop.machine.system
    used = [plant.u.index(name) for name in loop.driven]
    n, nc, k = g.n_states, law.n_states, columns.size
    both, m = n + nc, k + noisy.size
    read = np.hstack([plant.D21[:, columns], np.eye(len(plant.y))[:, noisy]])
    # every signal as a matrix over [x; c; inputs of the first sample; of the second; ...]
    unit = np.eye(both + hold * m)
    x, c = unit[:n], unit[n:both]
    seen = []
    for j in range(hold):
        v = unit[both + j * m : both + (j + 1) * m]
        y = plant.C2 @ x + read @ v
        if not j:
            c, out = law.A @ c + law.B @ y, law.C @ c + law.D @ y
            u = out[: len(used)]
        z = plant.C1 @ x + plant.D12[:, used] @ u + plant.D11[:, columns] @ v[:k]
        seen += [z, y, out, *([x] if states else [])]
        x = g.A @ x + plant.B2[:, used] @ u + plant.B1[:, columns] @ v[:k]
    step, shown = np.vstack([x, c]), np.vstack(seen)
    parts = (step[:, :both], step[:, both:], shown[:, :both], shown[:, both:])
    return Recursion(*map(np.ascontiguousarray, parts))


def split_law(loop: ClosedLoop, recovery: float | None) -> tuple[FloatArray, FloatArray]:
    """Return the command, and then the rest, of a controller whose commands are not all applied."""
    law, L = applied_law(loop, recovery)
    nc, ny, nu = law.n_states, len(loop.machine.y), len(loop.driven)
    C, D = law.C[:nu], law.D[:nu, :ny]
    rows = [
        [law.A - L @ C, law.B[:, :ny] - L @ D, law.B[:, ny:] + L],
        [np.zeros((nu, nc + ny)), np.eye(nu)],
        [law.C[nu:], law.D[nu:, :ny], law.D[nu:, ny:]],
    ]
    return np.hstack([C, D]), np.vstack([np.hstack(row) for row in rows])

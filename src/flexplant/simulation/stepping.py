"""The inner loop of a simulation: all runs at once, their white noise drawn stretch by stretch."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from ..checks import FloatArray, IntArray
from ..loop import ClosedLoop
from ..loop.budget import WhiteNoise
from ..lti.statespace import StateSpace
from ..plant import StandardPlant
from ..tolerances import divisor
from .nonlinear_elements import Acting


class Machine(NamedTuple):
    """The matrices of one sample, arranged for speed.

    ``x+ = diagonal x + coupling x[partner] + inflow [x[columns]; u] + noise`` is the plant,
    ``[c+; u; watched] = law [c; y]`` the controller. Where actuators do not apply what they are
    commanded, ``command [c; y]`` is commanded and ``[c+; u; watched] = law [c; y; u]``.
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

    On entry `states[0]` is the state now, `states[1:]` and `y` hold what noise and references add.
    """

    states: FloatArray
    y: FloatArray
    out: FloatArray


def machine(loop: ClosedLoop) -> Machine:
    """Return the matrices of one sample of a closed loop without feedthrough from u to y."""
    plant, law = loop.plant.system, loop.controller
    diagonal, coupling, partner, rest = _split(plant)
    columns = np.flatnonzero(np.any(rest != 0, axis=0))
    B = plant.B[:, plant.input_index(loop.driven)]
    return Machine(
        diagonal,
        coupling,
        partner,
        columns,
        np.asfortranarray(np.hstack([rest[:, columns], B])),
        np.ascontiguousarray(plant.C[plant.output_index(loop.plant.y)]),
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
) -> FloatArray:
    """Fill `buffers` sample by sample and return the controller's states (runs, n) after them.

    Elements `sensed` act on y before it is read, `applied` on the commands of a machine that has
    them. All is done in place. The controller acts in the first of every `hold` samples, and what
    it commands is held.

    Every product is one matrix-vector product per run, never a matrix-matrix product over runs:
    its rounding, and so a run, does not depend on how many runs go side by side.
    """
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
        answer = out[k]
        if k % hold:
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
        if nj:
            flow_in[:, :nj, 0] = x[:, m.columns]
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


def _split(g: StateSpace) -> tuple[FloatArray, FloatArray, IntArray, FloatArray]:
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


#: part of a state's largest noise that is rounding: its square is that of a covariance
_NO_NOISE = 1e-8
#: states of a plant from which on this is not searched for: it would take longer than a run
_MANY = 256
#: samples that are drawn and mixed at a time: they stay in the cache
_CHUNK = 256


class Drawn:
    """The white noises of a plant, drawn for a stretch of samples at a time.

    Few forces through many modes make a factor whose singular values fall fast: r columns of white
    samples are mixed into the few that are not rounding, ``L V'`` the factor. They are drawn as r,
    whose number and order do not hang on rounding. And always for a whole stretch: a longer run
    begins with the shorter one, bit by bit.
    """

    def __init__(self, noise: WhiteNoise, plant: StandardPlant) -> None:
        names = [plant.w[i].removesuffix(":noise") for i in noise.columns]
        self.read = np.array([name in plant.y for name in names], dtype=bool)
        self.columns, self.deviation = noise.columns, noise.deviation
        self.factor, self.mix = noise.factor, np.eye(noise.factor.shape[1])
        self.thin = noise.factor.shape[0] <= _MANY
        if self.thin:
            size = np.linalg.norm(noise.factor, axis=1)
            unit = noise.factor / divisor(size)[:, None]
            U, s, V = np.linalg.svd(unit, full_matrices=False)
            kept = int(np.count_nonzero(s > _NO_NOISE * s.max(initial=0.0)))
            self.factor = size[:, None] * U[:, :kept] * s[:kept]
            self.mix = np.ascontiguousarray(V[:kept].T)
        self.buffer = np.empty((_CHUNK, self.mix.shape[0] + self.columns.size))

    @property
    def cost(self) -> int:
        """Operations for a sample: products of matrices."""
        return 2 * (self.factor.size + (self.mix.size if self.thin else 0))

    def draw(
        self, generator: np.random.Generator, samples: int, hold: int = 1
    ) -> tuple[FloatArray, FloatArray]:
        """Return white samples (samples, few) for the factor, and noises of the columns of w.

        Sensors are read in the first of every `hold` samples, with the noise of that rate.
        """
        rank, few = self.mix.shape
        white, single = np.empty((samples, few)), np.empty((samples, self.columns.size))
        for start in range(0, samples, _CHUNK):
            part = slice(start, min(start + _CHUNK, samples))
            drawn = self.buffer[: part.stop - start]
            generator.standard_normal(out=drawn)
            if self.thin:
                np.matmul(drawn[:, :rank], self.mix, out=white[part])
            else:
                white[part] = drawn[:, :rank]
            np.multiply(drawn[:, rank:], self.deviation, out=single[part])
        if hold > 1:
            single[:, self.read] /= np.sqrt(hold)
            single[np.ix_(np.arange(samples) % hold > 0, self.read)] = 0.0
        return white, single

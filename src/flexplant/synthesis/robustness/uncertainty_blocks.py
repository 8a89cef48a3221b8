"""The scalings that the structure of an uncertainty allows, and its perturbations."""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from ...arrays import ComplexArray, FloatArray, IntArray
from ...lti.blocks_of_states import block_matrix
from ...lti.interconnection import series
from ...lti.statespace import StateSpace, as_statespace
from ...plant.uncertainty.delta_blocks import Block, FullBlock, RepeatedScalar
from ...tolerances import ROUNDING, TINY

#: G of real mu over D, relative to Im M at a resonance. One half makes the bound of a mode alone
#: zero at all frequencies; what is above it is left for the modes nearby
SHARE = 0.7
#: frequencies that sample an interval evenly, and as many by the logarithm, beside the resonances
SAMPLES = 24


class Place(NamedTuple):
    """A block and where its channels are."""

    block: Block
    w: slice
    z: slice


def block_places(blocks: Sequence[Block]) -> list[Place]:
    """Return each block with its channels."""
    found, w, z = [], 0, 0
    for block in blocks:
        found.append(Place(block, slice(w, w + block.w), slice(z, z + block.z)))
        w, z = w + block.w, z + block.z
    return found


class Scalings:
    """The matrices S(x) of scalings D and G, linear in real parameters x.

    ::

        S = [ level D_w    j G  ]     F = [I; M]* S [I; M]
            [   -j G      -D_z  ]       = level D_w - M* D_z M + j (G M - M* G)

    D of a repeated scalar is Hermitian of its size, of a full block a number; G, of real scalars
    alone, is Hermitian. With F > 0 no w = Delta z of ``|Delta|^2 <= 1 / level`` closes the loop
    z = M w: level = mu^2 from above [Fan1991]_. Blocks that are not `leveled` keep
    level 1: their Delta is bounded by one (skewed mu).
    """

    def __init__(self, blocks: Sequence[Block], leveled: Sequence[bool] | None = None) -> None:
        self.places = block_places(blocks)
        self.w, self.z = sum(b.w for b in blocks), sum(b.z for b in blocks)
        #: which blocks are leveled
        self.chosen = np.array([True] * len(blocks) if leveled is None else leveled)
        self.skewed = not self.chosen.all()
        entries: list[tuple[int, int, int, complex, bool]] = []
        start: list[float] = []
        self.d_ranges: list[tuple[slice, ComplexArray]] = []
        #: which x are those of each block
        self.ranges: list[slice] = []
        for place, level in zip(self.places, self.chosen, strict=True):
            block, w, z = place.block, place.w.start, self.w + place.z.start
            basis = _hermitian(block.size if isinstance(block, RepeatedScalar) else 1)
            first = len(start)
            for B in basis:
                full = isinstance(block, FullBlock)
                of_w, of_z = (np.eye(block.w), np.eye(block.z)) if full else (B, B)
                p = len(start)
                start.append(float(np.trace(B).real > 0))
                entries += [(p, w + i, w + k, of_w[i, k], level) for i, k in np.argwhere(of_w)]
                entries += [(p, z + i, z + k, -of_z[i, k], False) for i, k in np.argwhere(of_z)]
            self.d_ranges.append((slice(first, len(start)), basis))
            if isinstance(block, RepeatedScalar) and block.real:
                for B in basis:
                    p = len(start)
                    start.append(0.0)
                    for i, k in np.argwhere(B):
                        entries.append((p, w + i, z + k, 1j * B[i, k], False))
                        entries.append((p, z + k, w + i, -1j * np.conj(B[i, k]), False))
            self.ranges.append(slice(first, len(start)))
        self.count = len(start)
        sizes = [basis.shape[1] for _, basis in self.d_ranges]
        #: blocks of one size together: x of their D (n_blocks, size^2), and the basis of each
        self.alike: list[tuple[IntArray, ComplexArray]] = [
            (
                np.array([np.arange(own.start, own.stop) for own, b in self.d_ranges
                          if b.shape[1] == size]),
                _hermitian(size),
            )
            for size in sorted(set(sizes))
        ]  # fmt: skip
        #: which x are of G
        self.of_G = np.ones(self.count, dtype=bool)
        for own, _ in self.d_ranges:
            self.of_G[own] = False
        #: D = I, G = 0
        self.start: FloatArray = np.array(start)
        self.owner: IntArray = np.array([e[0] for e in entries])
        self.row: IntArray = np.array([e[1] for e in entries])
        self.column: IntArray = np.array([e[2] for e in entries])
        self.value: ComplexArray = np.array([e[3] for e in entries], dtype=np.complex128)
        self.leveled = np.array([e[4] for e in entries])
        # the places of S that derivatives fill: of each entry, and in P of each pair of places
        size = self.w + self.z
        places, self.at = np.unique(self.row * size + self.column, return_inverse=True)
        self.across: IntArray = size * (places % size)[:, None] + places // size

    def coefficients(self, level: float) -> ComplexArray:
        """Return the entries of S for x = 1, at a level."""
        return np.asarray(np.where(self.leveled, level, 1.0) * self.value)

    def matrix(self, x: FloatArray, level: float) -> ComplexArray:
        """Return S (w + z, w + z)."""
        S = np.zeros((self.w + self.z,) * 2, dtype=np.complex128)
        np.add.at(S, (self.row, self.column), self.coefficients(level) * x[self.owner])
        return S

    def stacks(self, x: FloatArray) -> list[ComplexArray]:
        """Return D of the blocks of each size (n_blocks, size, size)."""
        return [np.einsum("bp,pij->bij", x[own], basis) for own, basis in self.alike]

    def shifted(self, x: FloatArray, M: ComplexArray) -> FloatArray:
        """Return x with G of real scalars that takes the imaginary part from the diagonal of M."""
        # `G = -D Im M`: of one real scalar alone F is then `D (level - |M|^2 + 2 (Im M)^2)`
        x = x.copy()
        for place, (own, _), all_x in zip(self.places, self.d_ranges, self.ranges, strict=True):
            size = place.block.w
            if all_x.stop > own.stop:  # its G; the diagonal comes first, in D as in G
                turn = np.diagonal(M[place.z, place.w]).imag
                x[own.stop : own.stop + size] = -x[own.start : own.start + size] * turn
        return x

    def scaled(self, x: FloatArray, sizes: FloatArray) -> FloatArray:
        """Return x for D and G of each block times a number."""
        x = x.copy()
        for own, size in zip(self.ranges, sizes, strict=True):
            x[own] *= size
        return x


def _hermitian(size: int) -> ComplexArray:
    """Return a real basis (size^2, size, size) of Hermitian matrices, the diagonal first."""
    basis = [np.diag(row).astype(np.complex128) for row in np.eye(size)]
    for i in range(size):
        for k in range(i):
            for number in (1.0, 1j):
                B = np.zeros((size, size), dtype=np.complex128)
                B[i, k], B[k, i] = number, np.conj(number)
                basis.append(B)
    return np.array(basis)


def osborne(M: ComplexArray, where: Sequence[Place]) -> FloatArray:
    """Return the squares d of a number for each block that even out ``d_i^(1/2) M_ij d_j^(-1/2)``.

    For one matrix or for each of (n, z, w). Frobenius norms of the blocks stand for their largest
    singular values [Osborne1960]_.
    """
    k = np.arange(len(where))
    square = np.add.reduceat(np.abs(M) ** 2, [one.z.start for one in where], axis=-2)
    square = np.add.reduceat(square, [one.w.start for one in where], axis=-1)
    square[..., k, k] = 0.0
    tiny = ROUNDING * np.maximum(np.sqrt(square.max(axis=(-2, -1), initial=0.0)), TINY)
    d = np.ones(square.shape[:-1])
    inverse = d.copy()
    rows, columns = np.moveaxis(square, -2, 0), np.moveaxis(square, -1, 0)
    for _ in range(20):
        for i in k:
            own = np.sqrt(d[..., i])
            row = np.sqrt(np.vecdot(rows[i], inverse)) * own + tiny
            column = np.sqrt(np.vecdot(columns[i], d)) / own + tiny
            d[..., i] *= column / row
            inverse[..., i] = 1.0 / d[..., i]
    return np.asarray(d / np.exp(np.mean(np.log(d), axis=-1, keepdims=True)))


def evened(M: ComplexArray, where: Sequence[Place]) -> ComplexArray:
    """Return ``d_i^(1/2) M_ij d_j^(-1/2)`` of Osborne's d, of one matrix or of each (n, z, w)."""
    d = np.sqrt(osborne(M, where))
    rows, columns = (
        np.repeat(d, [getattr(one.block, side) for one in where], axis=-1) for side in "zw"
    )
    return np.asarray(rows[..., :, None] * M / columns[..., None, :])


class Perturbation(NamedTuple):
    """A perturbation of size one, at a frequency.

    A number for each scalar block, and for each full block its vectors: ``Delta = b a*``, |a| =
    |b| = 1.
    """

    scalars: tuple[complex, ...]
    vectors: tuple[tuple[ComplexArray, ComplexArray], ...]
    omega: float


def matrix_of(found: Perturbation, where: Sequence[Place]) -> ComplexArray:
    """Return Delta (w, z) of a perturbation."""
    total = np.zeros((where[-1].w.stop, where[-1].z.stop), dtype=np.complex128)
    scalars, vectors = iter(found.scalars), iter(found.vectors)
    for p in where:
        if isinstance(p.block, FullBlock):
            a, b = next(vectors)
            total[p.w, p.z] = np.outer(b, a.conj())
        else:
            total[p.w, p.z] = next(scalars) * np.eye(p.block.size)
    return total


def perturbed(M: ComplexArray, delta: ComplexArray | FloatArray) -> ComplexArray:
    """Return responses (..., z, w) with a Delta on their first channels closed, of each as well."""
    w, z = delta.shape[-2:]
    through = M[..., z:, :w] @ delta
    inner = np.eye(z) - M[..., :z, :w] @ delta
    return np.asarray(M[..., z:, w:] + through @ np.linalg.solve(inner, M[..., :z, w:]))


def realised_delta(found: Perturbation, blocks: Sequence[Block]) -> StateSpace:
    """Return a real, stable system Delta(s) of norm one with the perturbation at its frequency."""
    # each entry of a and b is a number times an all-pass `+-(s - p) / (s + p)` of its phase, so
    # that the gain is one at all frequencies
    where = block_places(blocks)
    scalars, vectors = iter(found.scalars), iter(found.vectors)
    parts: list[StateSpace] = []
    for p in where:
        if isinstance(p.block, FullBlock):
            a, b = next(vectors)
            parts.append(_rank_one(a, b, found.omega))
            continue
        number = complex(next(scalars))
        parts += [_all_pass(number.real if p.block.real else number, found.omega)] * p.block.size
    return _block_diagonal_system(parts)


def _all_pass(number: complex, omega: float) -> StateSpace:
    """Return a real system of gain |number| that is the number at omega [rad/s]."""
    phase, size = float(np.angle(number)), abs(number)
    # a real number needs no filter; of smaller phases the pole would be beyond all others
    if abs(np.sin(phase)) < 1e-9 or not omega > 0:
        return as_statespace(np.array([[size * (1.0 if np.cos(phase) >= 0 else -1.0)]]))
    sign = 1.0 if phase > 0 else -1.0
    turn = phase if phase > 0 else phase + np.pi
    p = omega / np.tan(0.5 * (np.pi - turn))
    # sign size (s - p) / (s + p) = sign size (1 - 2 p / (s + p))
    root = np.sqrt(2.0 * p * size)
    return StateSpace([[-p]], [[root]], [[-sign * root]], [[sign * size]])


def _block_diagonal_system(parts: Sequence[StateSpace]) -> StateSpace:
    A, B, C, D = (block_matrix([getattr(g, name) for g in parts]) for name in "ABCD")
    return StateSpace(A, B, C, D)


def _rank_one(a: ComplexArray, b: ComplexArray, omega: float) -> StateSpace:
    """Return ``b(s) a(s)'`` with the values b and conj(a) at omega."""
    into = _block_diagonal_system([_all_pass(complex(v), omega) for v in a.conj()])
    out = _block_diagonal_system([_all_pass(complex(v), omega) for v in b])
    one = series(into, as_statespace(np.ones((len(b), len(a)))))
    return series(one, out)

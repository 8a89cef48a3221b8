"""What a system answers at many frequencies, or over a record: solvers arranged for speed."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Sequence
from itertools import pairwise
from typing import NamedTuple, TypeAlias

import numpy as np
import numpy.typing as npt

from ..arrays import CACHED, COLUMNS, ComplexArray, FloatArray, IntArray
from ..errors import ModelError
from ..parallel import PIECE, one_thread
from .blocks_of_states import diagonal_blocks, diagonal_form, turning_parts, uncoupled_run
from .equations import scaled_schur
from .statespace import StateSpace

#: attribute with the prepared function of a system, which is often swept several times
_KEPT = "_responder"

#: the responses (p, m, n_freq) at frequencies [Hz]
Responder: TypeAlias = Callable[[FloatArray], ComplexArray]


def responses(g: StateSpace, freq: FloatArray) -> ComplexArray:
    """Return the (n_out, n_in, n_freq) responses at frequencies [Hz] that were checked."""
    return responder(g)(freq)


def responder(g: StateSpace) -> Responder:
    """Return the function of frequency [Hz] that gives the responses, prepared once and kept."""
    known = g.__dict__.get(_KEPT)
    if known is None:
        part = Subsystem(g.A, g.B, g.C, g.dt, g.blocks)
        known = g.__dict__[_KEPT] = _responder(part, g.D)
    return known


def _responder(g: Subsystem, D: FloatArray) -> Responder:
    n = len(g.A)
    if not n or not D.size:
        return lambda freq: np.repeat(D[:, :, None], freq.size, axis=2).astype(np.complex128)
    solve, entries, parts = _solver(g)

    @one_thread()
    def found(freq: FloatArray) -> ComplexArray:
        s, tame = points(g, freq), True
        step = max(1, min(entries // n, max(PIECE // n, freq.size // parts)))
        out = np.empty((*D.shape, freq.size), dtype=np.complex128)
        out[:] = D[:, :, None]
        with np.errstate(divide="ignore", invalid="ignore", over="ignore"):
            for start in range(0, freq.size, step):
                part = slice(start, start + step)
                tame = solve(s[part], out[:, :, part]) and tame
        return out if tame else _finite(out, freq)

    return found


def remembered(find: Responder) -> Responder:
    """Return the same function of frequency, which keeps its answer at the first frequencies."""
    first: list[tuple[FloatArray, ComplexArray]] = []

    def found(freq: FloatArray) -> ComplexArray:
        if first and np.array_equal(freq, first[0][0]):
            return first[0][1]
        data = find(freq)
        data.flags.writeable = False
        if not first:
            first.append((freq, data))
        return data

    return found


def points(g: StateSpace | Subsystem, freq: FloatArray) -> ComplexArray:
    """Return the points s, or z, of frequencies [Hz]."""
    omega = 2 * np.pi * freq
    return np.asarray(np.exp(1j * omega * g.dt) if g.dt else 1j * omega)


def _finite(out: ComplexArray, freq: FloatArray) -> ComplexArray:
    # the sum is infinite or NaN when an entry is; it may also overflow, so that the entries are
    # checked
    with np.errstate(invalid="ignore", over="ignore"):
        suspect = not np.isfinite(out.sum())
    if suspect and (bad := ~np.isfinite(out).all(axis=(0, 1))).any():
        raise ModelError(
            f"the response at {freq[bad][0]:g} Hz is infinite: an undamped pole (rigid-body modes "
            "are poles at 0 Hz) lies there. Leave the frequency out or add damping."
        )
    return out


def continuous_poles(g: StateSpace) -> ComplexArray:
    """Return the poles [rad/s]; of a sampled system their logarithms over dt."""
    poles = g.poles()
    if not g.dt:
        return poles
    with np.errstate(divide="ignore"):
        logs = np.log(poles)
    return np.asarray(logs[np.isfinite(logs)] / g.dt)


def _solver(g: Subsystem) -> tuple[Solver, int, int]:
    """Return a solver, its number of frequencies together times states, and least parts of a grid.

    The arrays of a part of a short grid are below 128 kB: no memory is fetched from the system. The
    grid of modes among other states has no least number: the fixed cost of a part is larger there.
    """
    n, m = g.B.shape
    if g.blocks is None:
        return dense_solver(g)
    first, end, blocks = uncoupled_run(g.A, g.blocks)
    sizes = max(MODAL_CHUNK, 64 * n), PARTS
    if end - first == n:
        return _modal(g), *sizes
    if 2 * (end - first) < n:
        return dense_solver(g)
    return _among_others(g, first, end, blocks), CACHED // (m + 2), 1


def _modal(g: Subsystem) -> Solver:
    """Block-diagonal A: one real matrix product of residues and scalar functions of frequency."""
    # blocks m I + N with N^2 = q I: `(s I - A)^-1 = ((s - m) I + N) / ((s - m)^2 - q)`. Complex
    # numbers are pairs of real columns, so that no complex product is formed
    pairs, slots = diagonal_blocks(g.A, g.blocks or ())
    mean, N, q = turning_parts(pairs)
    real = slots >= 0
    B, C = g.B[slots] * real[:, :, None], (g.C[:, slots] * real).transpose(1, 0, 2)
    split, swing = np.sqrt(np.maximum(q, 0.0)), np.sqrt(np.maximum(-q, 0.0))
    channels = len(g.C) * g.B.shape[1]
    with_s, without = (np.moveaxis(C @ own, 0, 2).reshape(channels, -1) for own in (B, N @ B))
    moving, fixed = _nonzero_columns(with_s), _nonzero_columns(without)
    residues = np.hstack([with_s[:, moving], without[:, fixed]])
    n_moving = with_s[:, moving].shape[1]
    # functions below this, times the residues, cannot overflow
    ceiling = 1e300 / (float(np.abs(residues).sum(axis=1).max(initial=0.0)) or 1.0)

    def add(s: ComplexArray, out: ComplexArray) -> bool:
        y = s.imag
        # on the imaginary axis x of a mode is one number; arrays (b, 1) cost nothing
        x = s.real - mean[:, None] if g.dt or s.real.any() else -mean[:, None]
        functions = np.empty((residues.shape[1], s.size, 2))
        real_part = (swing[:, None] - y) * (swing[:, None] + y)
        real_part += (x - split[:, None]) * (x + split[:, None])
        imag_part = (2.0 * x) * y
        size = real_part * real_part
        size += imag_part * imag_part
        np.divide(1.0, size, out=size)
        real_part *= size
        imag_part *= np.negative(size, out=size)
        # (real_part, imag_part) is 1 / ((s - m)^2 - q) now
        if n_moving:
            x, r, i = x[moving], real_part[moving], imag_part[moving]
            np.subtract(x * r, y * i, out=functions[:n_moving, :, 0])
            np.add(x * i, y * r, out=functions[:n_moving, :, 1])
        functions[n_moving:, :, 0] = real_part[fixed]
        functions[n_moving:, :, 1] = imag_part[fixed]
        flat = functions.reshape(-1, 2 * s.size)
        out += (residues @ flat).view(np.complex128).reshape(out.shape)
        return bool(-ceiling < flat.min(initial=0.0) and flat.max(initial=0.0) < ceiling)

    return add


def _nonzero_columns(residues: FloatArray) -> npt.NDArray[np.bool_] | slice:
    """Return the columns that are not zero; a slice without a copy if these are all."""
    some = np.any(residues, axis=0)
    return slice(None) if some.all() else some


def _among_others(g: Subsystem, first: int, end: int, blocks: Sequence[int]) -> Solver:
    """Modes, the states from `first` to `end`, between others that see them and that drive them."""
    # with A = [[A_h, A_hm, A_ht], [0, A_m, A_mt], [0, 0, A_t]], head (filters of sensors, weights
    # of z) and tail (those of amplifiers, delay lines) are solved for all their states, and the
    # modes are one matrix product again, from [B_m, A_mt] to [C_m; A_hm]. Most filters and lines
    # belong to one channel: products of zeros are left out
    p, (n, m) = len(g.C), g.B.shape
    h, own, t = slice(0, first), slice(first, end), slice(end, n)
    inputs = np.hstack([g.B[own], g.A[own, t]])
    used = np.flatnonzero(inputs.any(axis=0))
    outputs = np.vstack([g.C[:, own], g.A[h, own]])
    modes = _modal(Subsystem(g.A[own, own], inputs[:, used], outputs, g.dt, blocks))
    head, *_ = dense_solver(Subsystem(g.A[h, h], np.eye(first), g.C[:, h], g.dt))
    tail, *_ = dense_solver(Subsystem(g.A[t, t], g.B[t], np.eye(n - end), g.dt))
    direct = np.block([[np.zeros((p, m)), g.C[:, t]], [g.B[h], g.A[h, t]]])

    def add(s: ComplexArray, out: ComplexArray) -> bool:
        gain = np.repeat(direct[:, :, None], s.size, axis=2).astype(np.complex128)
        shown, known, both = (
            np.zeros((*size, s.size), dtype=np.complex128)
            for size in ((p, first), (n - end, m), (p + first, used.size))
        )
        head(s, shown)
        tail(s, known)
        modes(s, both)
        gain[:, used] += both
        found, through = gain[:, :m], gain[:, m:]
        for line, j in np.argwhere(known.any(axis=2)):
            found[:, j] += through[:, line] * known[line, j]
        out += found[:p]
        for i, state in np.argwhere(shown.any(axis=2)):
            out[i] += shown[i, state] * found[p + state]
        return False

    return add


#: number of frequencies together, and least parts of a grid, where poles are known
MODAL_CHUNK, PARTS = 19_200, 7

#: adds ``C (s I - A)^-1 B`` (p, m, n_s) to its second argument, and says whether it is finite for
#: certain: large arrays are not read again
Solver: TypeAlias = Callable[[ComplexArray, ComplexArray], bool]
#: outputs and inputs of a part, by their numbers
_Channels: TypeAlias = list[tuple[IntArray, IntArray]]
#: the responses (p, m, n_s) of parts of one A at points s (n_s,)
_Gains: TypeAlias = Callable[[ComplexArray], list[ComplexArray]]


class Subsystem(NamedTuple):
    """A, B, C, sampling time and blocks of a part of a system."""

    A: FloatArray
    B: FloatArray
    C: FloatArray
    dt: float
    blocks: Sequence[int] | None = None


def dense_solver(g: Subsystem) -> tuple[Solver, int, int]:
    """Return what solves for any A, how many frequencies at a time, times states, and least parts.

    The states are divided into parts that do not act on each other, such as the axes of a servo.
    Parts with the same A are solved together, as those of axes with the same law. Parts with the
    same channels are solved together if their gains are computed from poles.
    """
    alike: dict[bytes, list[IntArray]] = {}
    for own in _separate_states(g.A):
        alike.setdefault(g.A[np.ix_(own, own)].tobytes(), []).append(own)
    solvers: list[tuple[_Gains, _Channels]] = []
    sizes = max(MODAL_CHUNK, 64 * len(g.A)), PARTS
    known: dict[tuple[bytes, ...], tuple[_Channels, list[_Residues]]] = {}
    for parts in alike.values():
        seen = [np.flatnonzero(g.C[:, own].any(axis=1)) for own in parts]
        fed = [np.flatnonzero(g.B[own].any(axis=0)) for own in parts]
        A, channels = g.A[np.ix_(parts[0], parts[0])], list(zip(seen, fed, strict=True))
        Bs = [g.B[np.ix_(own, j)] for own, j in zip(parts, fed, strict=True)]
        Cs = [g.C[np.ix_(i, own)] for own, i in zip(parts, seen, strict=True)]
        if not any(C.size * B.size for C, B in zip(Cs, Bs, strict=True)):
            continue
        found = _by_poles(A, Bs, Cs)
        if found is None:
            solvers.append((_schur_gains(A, Bs, Cs), channels))
            sizes = CACHED // (g.B.shape[1] + 2), 1
        else:
            key = tuple(side.tobytes() for pair in channels for side in pair)
            known.setdefault(key, (channels, []))[1].append(found)
    solvers += [(_pole_gains(every, channels), channels) for channels, every in known.values()]
    placed = [(gains, [np.ix_(i, j) for i, j in channels]) for gains, channels in solvers]

    def add(s: ComplexArray, out: ComplexArray) -> bool:
        for gains, places in placed:
            for place, gain in zip(places, gains(s), strict=True):
                if gain.shape == out.shape:
                    out += gain
                else:
                    out[place] += gain
        return False

    return add, *sizes


def _separate_states(A: FloatArray) -> list[IntArray]:
    """Return the sets of states that do not act on each other."""
    # by reach, which takes two or three steps in a full A: a general graph library takes longer
    # than the poles of a small one
    acts = A != 0
    acts |= acts.T
    left, parts = np.ones(len(A), dtype=bool), []
    while left.any():
        own = np.zeros(len(A), dtype=bool)
        front: Sequence[int] | IntArray = [int(np.argmax(left))]
        while len(front):
            own[front] = True
            front = np.flatnonzero(acts[front].any(axis=0) & ~own)
        parts.append(np.flatnonzero(own))
        left &= ~own
    return parts


class _Residues(NamedTuple):
    """Poles (n,), one of each pair, and residues (channels, n), those of several parts in turn."""

    poles: ComplexArray
    residues: ComplexArray


def _by_poles(A: FloatArray, Bs: list[FloatArray], Cs: list[FloatArray]) -> _Residues | None:
    """Return poles and residues; a pole off the real axis stands for its conjugate too."""
    poles, left, right = diagonal_form(A, np.hstack(Bs), np.vstack(Cs))
    if left is None or right is None:
        return None
    upper = poles.imag >= 0
    poles, left, right = poles[upper], left[:, upper], right[upper]
    right[poles.imag == 0] *= 0.5  # counted twice
    sizes = [(len(C), B.shape[1]) for C, B in zip(Cs, Bs, strict=True)]
    rows, columns = (np.cumsum([0, *(size[i] for size in sizes)]) for i in (0, 1))
    residues = [
        (left[i : i + p, None] * right[:, j : j + m].T).reshape(p * m, poles.size)
        for i, j, (p, m) in zip(rows, columns, sizes, strict=False)
    ]
    return _Residues(poles, np.concatenate(residues))


def _pole_gains(every: list[_Residues], channels: _Channels) -> _Gains:
    """Real residues times functions of s, of all poles with the same channels."""
    poles = np.concatenate([one.poles for one in every])
    residues = np.hstack([one.residues for one in every])
    parts = np.hstack([residues.real, residues.imag])
    sizes = [(i.size, j.size) for i, j in channels]
    ends = np.cumsum([p * m for p, m in sizes])[:-1]

    def gains(s: ComplexArray) -> list[ComplexArray]:
        one, other = 1.0 / (s - poles[:, None]), 1.0 / (s - poles.conj()[:, None])
        both = np.concatenate([one + other, 1j * (one - other)])
        flat = (parts @ both.view(np.float64)).view(np.complex128)
        each = np.split(flat, ends)
        return [part.reshape(*size, s.size) for part, size in zip(each, sizes, strict=True)]

    return gains


def _schur_gains(A: FloatArray, Bs: list[FloatArray], Cs: list[FloatArray]) -> _Gains:
    """Back substitution with the Schur form in even units."""
    B, C = np.hstack(Bs), np.vstack(Cs)
    d, T, U = scaled_schur(A, B, C)
    n, m = B.shape
    turned = U.conj().T @ (B / d[:, None])
    seen = np.split((C * d) @ U, np.cumsum([len(one) for one in Cs])[:-1])
    columns = np.cumsum([0, *(one.shape[1] for one in Bs)])

    def gains(s: ComplexArray) -> list[ComplexArray]:
        X = np.broadcast_to(turned[:, :, None], (n, m, s.size)).copy()
        for end in range(n, 0, -COLUMNS):  # rows below a block go into it by one matrix product
            block = slice(max(end - COLUMNS, 0), end)
            X[block] += (T[block, end:] @ X[end:].reshape(n - end, m * s.size)).reshape(
                -1, m, s.size
            )
            for i in range(end - 1, block.start - 1, -1):
                known = X[i + 1 : end].reshape(end - 1 - i, m * s.size)
                X[i] += (T[i, i + 1 : end] @ known).reshape(m, s.size)
                X[i] /= s - T[i, i]
        return [
            (row @ X[:, first:last].reshape(n, -1)).reshape(len(row), last - first, s.size)
            for row, first, last in zip(seen, columns[:-1], columns[1:], strict=True)
        ]

    return gains


#: sizes of a block [samples]
_SIZES = [2**k for k in range(8)]
#: cost of an operation with a single vector, and of a call, relative to an operation in a matrix
#: product
ONE_VECTOR, CALL = 3.0, 3e4


def cheapest(n: int, p: int, m: int, samples: int, abreast: int = 1) -> tuple[int, float]:
    """Return the cheapest size of a block, and its number of operations per sample."""
    # n states, p outputs, m inputs; the preparation is shared by a number of samples, and a call by
    # records that run abreast
    product = ONE_VECTOR if abreast == 1 else 1.0

    def cost(size: int) -> float:
        prepare = 2 * size * n * n * (m + p) + 2 * np.log2(size) * n**3 + size**2 * n * p * m
        step = (2 * product * n * n + CALL / abreast) / size
        return float(step + 2 * n * (m + p) + (size + 1) * p * m + prepare / max(samples, 1))

    size = min(_SIZES, key=cost)
    return size, cost(size)


class Recursion(NamedTuple):
    """``x[k+1] = F x[k] + G v[k], out[k] = H x[k] + J v[k]``."""

    F: FloatArray
    G: FloatArray
    H: FloatArray
    J: FloatArray

    def run(self, v: FloatArray, start: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Return the outputs (N, p) for inputs (N, m) from a first state (n,), and the last one."""
        out, x = np.empty((v.shape[0], self.J.shape[0])), start
        for piece, part, after in self.pieces(v, start):
            out[piece], x = part, after
        return out, x

    def pieces(
        self, v: FloatArray, start: FloatArray
    ) -> Iterator[tuple[slice, FloatArray, FloatArray]]:
        """Yield samples, their outputs (k, p) and the state after them, piece by piece."""
        x, blocks = start, self.in_blocks(self.best_size(v.shape[0]))
        whole = v.shape[0] // blocks.size * blocks.size
        for first in range(0, whole, PIECE):
            piece = slice(first, min(first + PIECE, whole))
            out, x = blocks.run(v[piece], x)
            yield piece, out, x
        if whole < v.shape[0]:
            rest, x = self.sample_by_sample(v[whole:], x)
            yield slice(whole, v.shape[0]), rest, x

    def sample_by_sample(self, v: FloatArray, x: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Return the outputs (N, p) and the last state, as the equations are written."""
        out = np.empty((v.shape[0], self.J.shape[0]))
        for k in range(v.shape[0]):
            out[k] = self.H @ x + self.J @ v[k]
            x = self.F @ x + self.G @ v[k]
        return out, x

    def best_size(self, samples: int) -> int:
        """Return the size of a block that costs least for a record of this length."""
        p, m = self.J.shape
        return cheapest(self.F.shape[0], p, m, samples)[0]

    def in_blocks(self, size: int) -> Blocks:
        """Return the matrices of a block of a number of samples, a power of two."""
        # with rows: x+ = x F' + v G'. what the first half of a block does to the second passes
        # through the state between them
        step, enter, see = (np.ascontiguousarray(part.T) for part in (self.F, self.G, self.H))
        direct, done = [np.ascontiguousarray(self.J.T)], 1
        while done < size:
            direct.append(enter @ see)
            enter, see = np.vstack([enter @ step, enter]), np.hstack([see, step @ see])
            step, done = step @ step, 2 * done
        return Blocks(step, enter, see, direct, size)


class Blocks(NamedTuple):
    """``x[k+b] = x[k] step + v enter``, ``out = x see + v direct``, rows v and out of b samples.

    `direct` of a sample acts on itself, and then of 1, 2, 4, ... samples on as many that follow.
    """

    step: FloatArray
    enter: FloatArray
    see: FloatArray
    direct: list[FloatArray]
    size: int

    def run(
        self, v: FloatArray, x: FloatArray, pushed: FloatArray | None = None
    ) -> tuple[FloatArray, FloatArray]:
        """Return the outputs (N, p) for inputs (N, m) from a state (n,), and the last state.

        Records (r, N, m) from states (r, n) run abreast. `pushed` (N / b, k) is added to the first
        k states at the end of each block.
        """
        # N is a whole number of blocks. everything except `x step` is a product of two matrices
        *abreast, samples, m = v.shape
        count, total = samples // self.size, math.prod(abreast) * samples
        states = np.empty((*abreast, count + 1, x.shape[-1]))
        before, after = states[..., :-1, :], states[..., 1:, :]
        v = np.ascontiguousarray(v).reshape(total, m)
        states[..., 0, :] = x
        after[...] = (v.reshape(total // self.size, -1) @ self.enter).reshape(after.shape)
        if pushed is not None:
            after[:, : pushed.shape[1]] += pushed
        moved = np.empty(x.shape)
        for now, following in pairwise(np.moveaxis(states, -2, 0)):
            np.matmul(now, self.step, out=moved)
            following += moved
        out = v @ self.direct[0]
        for k, later in enumerate(self.direct[1:], 1):
            first, second = ((total >> k, 2, size) for size in later.shape)
            out.reshape(second)[:, 1] += v.reshape(first)[:, 0] @ later
        by_block = out.reshape(total // self.size, -1)
        by_block += before.reshape(len(by_block), -1) @ self.see
        return out.reshape(*abreast, samples, -1), states[..., -1, :]

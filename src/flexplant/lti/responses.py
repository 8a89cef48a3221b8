"""The gains of a system at many frequencies: closed-form block solves, else Schur form."""

from __future__ import annotations

from collections.abc import Callable
from typing import TypeAlias

import numpy as np
import numpy.typing as npt

from ..errors import ModelError
from ..parallel import one_thread
from ..values import ComplexArray, FloatArray, IntArray
from .statespace import StateSpace

#: entries of the largest intermediate array of a back substitution (complex): it stays in cache
CHUNK = 400_000
#: rows of a back substitution that are solved together
ROWS = 32
#: frequencies at a time in block form: the scalar functions of all modes stay in cache
MODAL_STEP = 512

#: responses (p, m, n_s), and whether they are finite for certain: large arrays are not read again
Modal: TypeAlias = Callable[[ComplexArray], tuple[ComplexArray, bool]]
#: the responses (p, m, n_freq) at frequencies [Hz]
Responder: TypeAlias = Callable[[FloatArray], ComplexArray]
#: adds ``C (s I - A)^-1 B`` (p, m, n_s) to its second argument
Solver = Callable[[ComplexArray, ComplexArray], None]


def responses(g: StateSpace, freq: FloatArray) -> ComplexArray:
    """Return the (n_out, n_in, n_freq) responses at frequencies [Hz] that were checked."""
    return responder(g)(freq)


def responder(g: StateSpace) -> Responder:
    """Return the function of frequency [Hz] that gives the responses, prepared once."""
    shape = len(g.outputs), len(g.inputs)
    if not g.n_states or not g.D.size:
        return lambda freq: np.repeat(g.D[:, :, None], freq.size, axis=2).astype(np.complex128)
    modal = _modal(g) or _fed_by_lines(g)
    if modal is not None:

        @one_thread()
        def by_modes(freq: FloatArray) -> ComplexArray:
            data, tame = modal(points(g, freq))
            return data if tame else _finite(data, freq)

        return by_modes
    solve = _solver(g)
    step = max(1, CHUNK // (g.n_states * (len(g.inputs) + 2)))

    @one_thread()
    def found(freq: FloatArray) -> ComplexArray:
        s = points(g, freq)
        out = np.empty((*shape, freq.size), dtype=np.complex128)
        out[:] = g.D[:, :, None]
        for start in range(0, freq.size, step):
            part = slice(start, start + step)
            with np.errstate(divide="ignore", invalid="ignore", over="ignore"):
                solve(s[part], out[:, :, part])
        return _finite(out, freq)

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


def points(g: StateSpace, freq: FloatArray) -> ComplexArray:
    """Return the points s, or z, of frequencies [Hz]."""
    omega = 2 * np.pi * freq
    return np.asarray(np.exp(1j * omega * g.dt) if g.dt else 1j * omega)


def _finite(out: ComplexArray, freq: FloatArray) -> ComplexArray:
    # the sum is infinite or NaN when an entry is; it may also overflow, which the entries decide
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


def _solver(g: StateSpace) -> Solver:
    if g.blocks is not None and set(g.blocks) <= {1, 2}:
        return _substitution(g, *_paired(g))
    return _schur(g)


def _paired(g: StateSpace) -> tuple[FloatArray, IntArray, FloatArray]:
    """Return the diagonal blocks as (b, 2, 2), the states of each (b, 2; -1 none), and the rest."""
    sizes = np.asarray(g.blocks)
    starts = np.cumsum(sizes) - sizes
    slots = np.stack([starts, np.where(sizes == 2, starts + 1, -1)], axis=1)
    real = slots >= 0
    pairs = g.A[slots[:, :, None], slots[:, None, :]] * (real[:, :, None] & real[:, None, :])
    coupling = g.A.copy()
    for i in (0, 1):
        for j in (0, 1):
            both = real[:, i] & real[:, j]
            coupling[slots[both, i], slots[both, j]] = 0.0
    return pairs, slots, coupling


def _modal(g: StateSpace) -> Modal | None:
    """Block-diagonal A: one real matrix product of residues and scalar functions of frequency.

    With m half the trace of a block, N = A - m I and N^2 = q I (Cayley-Hamilton),
    ``(s I - A)^-1 = ((s - m) I + N) / ((s - m)^2 - q)``: no cancellation near s = m, which matters
    for slow modes of a sampled system. A 1 x 1 block is N = 0. Complex numbers are pairs of real
    columns, so that no complex product is formed.
    """
    if g.blocks is None or not set(g.blocks) <= {1, 2}:
        return None
    pairs, slots, coupling = _paired(g)
    if np.any(coupling):
        return None
    real = slots >= 0
    pairs[~real[:, 1], 1, 1] = pairs[~real[:, 1], 0, 0]  # N = 0 for a 1 x 1 block
    mean = 0.5 * (pairs[:, 0, 0] + pairs[:, 1, 1])
    N = pairs.copy()
    N[:, 0, 0] = 0.5 * (pairs[:, 0, 0] - pairs[:, 1, 1])
    N[:, 1, 1] = -N[:, 0, 0]
    q = N[:, 0, 0] ** 2 + N[:, 0, 1] * N[:, 1, 0]
    split, swing = np.sqrt(np.maximum(q, 0.0)), np.sqrt(np.maximum(-q, 0.0))
    B = g.B[slots] * real[:, :, None]  # (b, 2, m)
    C = (g.C[:, slots] * real).transpose(1, 2, 0)  # (b, 2, p)
    with_s = np.einsum("bip,bim->pmb", C, B).reshape(g.D.size, -1)
    without = np.einsum("bip,bij,bjm->pmb", C, N, B, optimize=True).reshape(g.D.size, -1)
    moving, fixed = _chosen(with_s), _chosen(without)
    through = g.D.reshape(-1, 1) if np.any(g.D) else np.zeros((g.D.size, 0))
    residues = np.hstack([with_s[:, moving], without[:, fixed], through])
    n_moving = with_s[:, moving].shape[1]
    n_both = n_moving + without[:, fixed].shape[1]

    # functions below this, times the residues, cannot overflow
    ceiling = 1e300 / (float(np.abs(residues).sum(axis=1).max(initial=0.0)) or 1.0)

    def found(s: ComplexArray) -> tuple[ComplexArray, bool]:
        data = np.empty((*g.D.shape, s.size), dtype=np.complex128)
        out = data.reshape(g.D.size, -1).view(np.float64)
        tame = True
        for start in range(0, s.size, MODAL_STEP):
            part = s[start : start + MODAL_STEP]
            y = part.imag
            # on the imaginary axis a mode's x is one number: what stays (b, 1) costs nothing
            x = part.real - mean[:, None] if g.dt else -mean[:, None]
            functions = np.empty((residues.shape[1], part.size, 2))
            with np.errstate(divide="ignore", invalid="ignore", over="ignore"):
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
                functions[n_moving:n_both, :, 0] = real_part[fixed]
                functions[n_moving:n_both, :, 1] = imag_part[fixed]
                functions[n_both:] = (1.0, 0.0)
                flat = functions.reshape(residues.shape[1], 2 * part.size)
                tame = tame and -ceiling < flat.min(initial=0.0) and flat.max(initial=0.0) < ceiling
                np.matmul(residues, flat, out=out[:, 2 * start : 2 * (start + part.size)])
        return data, tame

    return found


def _chosen(residues: FloatArray) -> npt.NDArray[np.bool_] | slice:
    """Return which columns are not zero; all of them as a slice, which copies nothing."""
    some = np.any(residues, axis=0)
    return slice(None) if some.all() else some


def _fed_by_lines(g: StateSpace) -> Modal | None:
    """Modes fed by a few further states, such as the delay lines of a sampled plant.

    With A = [[A_h, A_ht], [0, A_t]] and A_h block diagonal, the tail's response X_t is cheap and
    sparse (a line belongs to one input), and the head is again one matrix product: that of the
    inputs [B_h, A_ht].
    """
    if g.blocks is None or not set(g.blocks) <= {1, 2}:
        return None
    ends = np.cumsum(g.blocks)
    starts = ends - np.asarray(g.blocks)
    tied = np.array([np.any(g.A[:i, i:j]) for i, j in zip(starts, ends, strict=True)])
    cut = int(np.argmax(tied))
    head = int(starts[cut]) if np.any(tied) else 0
    n, m = g.B.shape
    if not head or 4 * (n - head) > n:
        return None
    blocks, rest = list(g.blocks[:cut]), list(g.blocks[cut:])
    feeding = np.flatnonzero(np.any(g.A[:head, head:], axis=0))
    names = [f"x{i}" for i in range(m + feeding.size)]
    inputs = np.hstack([g.B[:head], g.A[:head, head + feeding]])
    through = np.hstack([g.D, g.C[:, head + feeding]])
    driven = _modal(
        StateSpace(g.A[:head, :head], inputs, g.C[:, :head], through, g.dt, names, blocks=blocks)
    )
    if driven is None:
        return None
    lines = StateSpace(
        g.A[head:, head:], g.B[head:], np.eye(n - head), np.zeros((n - head, m)), g.dt, blocks=rest
    )
    tail = _solver(lines)
    reached = _reached(g.A[head:, head:], g.B[head:])
    direct = np.setdiff1d(np.flatnonzero(np.any(g.C[:, head:], axis=0)), feeding)

    def found(s: ComplexArray) -> tuple[ComplexArray, bool]:
        X = np.zeros((n - head, m, s.size), dtype=np.complex128)
        with np.errstate(divide="ignore", invalid="ignore", over="ignore"):
            tail(s, X)
        both, _ = driven(s)
        data = np.ascontiguousarray(both[:, :m])
        for i, line in enumerate(feeding):
            for j in np.flatnonzero(reached[line]):
                data[:, j] += both[:, m + i] * X[line, j]
        for line in direct:
            for j in np.flatnonzero(reached[line]):
                data[:, j] += g.C[:, head + line, None] * X[line, j]
        return data, False

    return found


def _reached(A: FloatArray, B: FloatArray) -> npt.NDArray[np.bool_]:
    """Return which states (n, m) each input can move at all."""
    now = B != 0
    for _ in range(A.shape[0]):
        now = now | ((A != 0).astype(float) @ now.astype(float) > 0)
    return np.asarray(now)


def _closed_form(
    g: StateSpace, pairs: FloatArray, real: npt.NDArray[np.bool_]
) -> tuple[FloatArray, FloatArray, FloatArray, FloatArray, ComplexArray, ComplexArray]:
    a, b, c, d = (pairs[:, i, j].copy() for i in (0, 1) for j in (0, 1))
    # a 1 x 1 block gets a partner that nothing drives, with a pole at no frequency of interest
    d[~real[:, 1]] = 0.0 if g.dt else -1.0
    root = np.sqrt((0.25 * (a - d) ** 2 + b * c).astype(np.complex128))
    mean = 0.5 * (a + d)
    first: ComplexArray = np.asarray(mean + root, dtype=np.complex128)
    second: ComplexArray = np.asarray(mean - root, dtype=np.complex128)
    return a, b, c, d, first, second


def _substitution(
    g: StateSpace, pairs: FloatArray, slots: IntArray, coupling: FloatArray
) -> Solver:
    """Block upper triangular A: all blocks of one level (no coupling among them) at once."""
    real = slots >= 0
    a, b, c, d, first, second = _closed_form(g, pairs, real)
    n, m = g.B.shape
    owner = np.empty(n, dtype=np.int64)
    for i in (0, 1):
        owner[slots[real[:, i], i]] = np.flatnonzero(real[:, i])
    level = np.zeros(len(a), dtype=np.int64)
    for i in range(len(a) - 2, -1, -1):
        used = np.flatnonzero(coupling[slots[i][real[i]]].any(axis=0))
        level[i] = 1 + level[owner[used]].max() if used.size else 0

    def add(s: ComplexArray, out: ComplexArray) -> None:
        X = np.zeros((n + 1, m, s.size), dtype=np.complex128)  # the last row takes padding
        for rank in range(int(level.max(initial=0)) + 1):
            blocks = np.flatnonzero(level == rank)
            rows = slots[blocks]
            right = np.zeros((len(blocks), 2, m, s.size), dtype=np.complex128)
            for i in (0, 1):
                there = real[blocks, i]
                into = rows[there, i]
                right[there, i] = g.B[into][:, :, None]
                used = np.flatnonzero(coupling[into].any(axis=0))
                if used.size:
                    known = coupling[np.ix_(into, used)] @ X[used].reshape(used.size, -1)
                    right[there, i] += known.reshape(-1, m, s.size)
            inverse = 1.0 / ((s - first[blocks, None]) * (s - second[blocks, None]))
            x1, x2 = right[:, 0], right[:, 1]
            ab, bb, cb, db = (v[blocks, None, None] for v in (a, b, c, d))
            X[rows[:, 0]] = ((s - db) * x1 + bb * x2) * inverse[:, None]
            X[rows[:, 1]] = (cb * x1 + (s - ab) * x2) * inverse[:, None]
        out += (g.C @ X[:n].reshape(n, -1)).reshape(out.shape)

    return add


def _schur(g: StateSpace) -> Solver:
    """Any A: back substitution with the Schur form of A in even units."""
    d, T, U = g.schur_form
    n, m = g.B.shape
    turned, seen = U.conj().T @ (g.B / d[:, None]), (g.C * d) @ U

    def add(s: ComplexArray, out: ComplexArray) -> None:
        X = np.broadcast_to(turned[:, :, None], (n, m, s.size)).copy()
        for end in range(n, 0, -ROWS):  # rows below a block go into it by one matrix product
            block = slice(max(end - ROWS, 0), end)
            X[block] += (T[block, end:] @ X[end:].reshape(n - end, m * s.size)).reshape(
                -1, m, s.size
            )
            for i in range(end - 1, block.start - 1, -1):
                known = X[i + 1 : end].reshape(end - 1 - i, m * s.size)
                X[i] += (T[i, i + 1 : end] @ known).reshape(m, s.size)
                X[i] /= s - T[i, i]
        out += (seen @ X.reshape(n, -1)).reshape(out.shape)

    return add

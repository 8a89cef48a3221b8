"""The gains of a system at many frequencies: closed-form block solves, else Schur form."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import numpy.typing as npt
import scipy.linalg as la

from ..errors import ModelError
from ..values import ComplexArray, FloatArray, IntArray
from .statespace import StateSpace

#: entries of the largest intermediate array (complex)
CHUNK = 2_000_000


def responses(g: StateSpace, freq: FloatArray) -> ComplexArray:
    """Return the (n_out, n_in, n_freq) responses at frequencies [Hz] that were checked."""
    omega = 2 * np.pi * freq
    s: ComplexArray = np.asarray(np.exp(1j * omega * g.dt) if g.dt else 1j * omega)
    out = np.empty((len(g.outputs), len(g.inputs), freq.size), dtype=np.complex128)
    out[:] = g.D[:, :, None]
    if not g.n_states or not out.size:
        return out
    solve = _solver(g)
    step = max(1, CHUNK // (g.n_states * (len(g.inputs) + 2)))
    for start in range(0, freq.size, step):
        part = slice(start, start + step)
        with np.errstate(divide="ignore", invalid="ignore", over="ignore"):
            solve(s[part], out[:, :, part])
    bad = ~np.isfinite(out).all(axis=(0, 1))
    if bad.any():
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


def _solver(g: StateSpace) -> Callable[[ComplexArray, ComplexArray], None]:
    """Return a function that adds ``C (s I - A)^-1 B`` (p, m, n_s) to its second argument."""
    sizes = set(g.blocks) if g.blocks is not None else {0}
    if sizes <= {1, 2}:
        pairs, slots, coupling = _paired(g)
        if not np.any(coupling):
            return _modal(g, pairs, slots)
        return _substitution(g, pairs, slots, coupling)
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


def _modal(
    g: StateSpace, pairs: FloatArray, slots: IntArray
) -> Callable[[ComplexArray, ComplexArray], None]:
    """Block-diagonal A: ``sum_i C_i adj(s I - A_i) B_i / det(s I - A_i)``, two real products."""
    real = slots >= 0
    a, b, c, d, first, second = _closed_form(g, pairs, real)
    B = g.B[slots] * real[:, :, None]  # (b, 2, m)
    C = (g.C[:, slots] * real).transpose(1, 2, 0)  # (b, 2, p)
    with_s = np.einsum("bip,bim->pmb", C, B)
    adjugate = np.stack([np.stack([-d, b], 1), np.stack([c, -a], 1)], 1)
    without = np.einsum("bip,bij,bjm->pmb", C, adjugate, B)
    shape = (*with_s.shape[:2], -1)
    both = np.concatenate([with_s.reshape(-1, len(a)), without.reshape(-1, len(a))])

    def add(s: ComplexArray, out: ComplexArray) -> None:
        inverse = 1.0 / ((s - first[:, None]) * (s - second[:, None]))  # (b, n_s)
        parts = both @ inverse.real + 1j * (both @ inverse.imag)
        moving, fixed = np.split(parts, 2)
        out += (moving * s + fixed).reshape(shape)

    return add


def _closed_form(
    g: StateSpace, pairs: FloatArray, real: npt.NDArray[np.bool_]
) -> tuple[FloatArray, FloatArray, FloatArray, FloatArray, ComplexArray, ComplexArray]:
    a, b, c, d = (pairs[:, i, j].copy() for i in (0, 1) for j in (0, 1))
    # a 1 x 1 block gets a partner that nothing drives, with a pole that no frequency meets
    d[~real[:, 1]] = 0.0 if g.dt else -1.0
    root = np.sqrt((0.25 * (a - d) ** 2 + b * c).astype(np.complex128))
    mean = 0.5 * (a + d)
    first: ComplexArray = np.asarray(mean + root, dtype=np.complex128)
    second: ComplexArray = np.asarray(mean - root, dtype=np.complex128)
    return a, b, c, d, first, second


def _substitution(
    g: StateSpace, pairs: FloatArray, slots: IntArray, coupling: FloatArray
) -> Callable[[ComplexArray, ComplexArray], None]:
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


def _schur(g: StateSpace) -> Callable[[ComplexArray, ComplexArray], None]:
    """Any A: back substitution with the Schur form of the balanced A.

    Balancing first: the orthogonal transformation mixes rounding with the norm of all of A, which
    plain (q, dq/dt) states let grow with the square of the fastest mode.
    """
    _, (d, _) = la.matrix_balance(g.A, permute=False, separate=True)
    A, B, C = g.A * d / d[:, None], g.B / d[:, None], g.C * d
    T, U = la.schur(A, output="complex")
    n, m = B.shape

    turned, seen = U.conj().T @ B, C @ U

    def add(s: ComplexArray, out: ComplexArray) -> None:
        X = np.broadcast_to(turned[:, :, None], (n, m, s.size)).copy()
        for i in range(n - 1, -1, -1):
            if i < n - 1:
                X[i] += (T[i, i + 1 :] @ X[i + 1 :].reshape(n - 1 - i, -1)).reshape(m, s.size)
            X[i] /= s - T[i, i]
        out += (seen @ X.reshape(n, -1)).reshape(out.shape)

    return add

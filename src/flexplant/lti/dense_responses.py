"""Responses of systems whose A has no known blocks: by poles and residues, else by Schur form."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any, NamedTuple, TypeAlias

import numpy as np
from scipy.sparse import csgraph

from ..values import ComplexArray, FloatArray, IntArray
from .scaling import scaled_schur, state_scale

#: entries of the largest intermediate array of a back substitution (complex): it stays in cache
CHUNK = 400_000
#: functions of frequency at a time, and least parts of a grid, where poles are known
MODAL_CHUNK, PARTS = 19_200, 7
#: rows of a back substitution that are solved together
ROWS = 32
#: largest condition of eigenvectors whose residues are used
POOR = 1e5

#: adds ``C (s I - A)^-1 B`` (p, m, n_s) to its second argument, and says whether it is finite for
#: certain: large arrays are not read again
Solver: TypeAlias = Callable[[ComplexArray, ComplexArray], bool]
#: outputs and inputs of a part, by their numbers
_Channels: TypeAlias = list[tuple[IntArray, IntArray]]
#: the responses (p, m, n_s) of parts of one A at points s (n_s,)
_Gains: TypeAlias = Callable[[ComplexArray], list[ComplexArray]]


class Part(NamedTuple):
    """A, B, C, sampling time and blocks of a part of a system."""

    A: FloatArray
    B: FloatArray
    C: FloatArray
    dt: float
    blocks: Sequence[int] | None = None


def dense_solver(g: Part) -> tuple[Solver, int, int]:
    """Return what solves for any A, how many frequencies at a time, times states, and least parts.

    Parts that share no state, such as the axes of a servo, each with its own channels; those of one
    A, as axes of one law have, together.
    """
    count, owner = csgraph.connected_components(g.A != 0, directed=False)
    alike: dict[bytes, list[IntArray]] = {}
    for own in (np.flatnonzero(owner == i) for i in range(count)):
        alike.setdefault(g.A[np.ix_(own, own)].tobytes(), []).append(own)
    solvers: list[tuple[_Gains, _Channels]] = []
    sizes = max(MODAL_CHUNK, 64 * len(g.A)), PARTS
    for parts in alike.values():
        seen = [np.flatnonzero(g.C[:, own].any(axis=1)) for own in parts]
        fed = [np.flatnonzero(g.B[own].any(axis=0)) for own in parts]
        A = g.A[np.ix_(parts[0], parts[0])]
        Bs = [g.B[np.ix_(own, j)] for own, j in zip(parts, fed, strict=True)]
        Cs = [g.C[np.ix_(i, own)] for own, i in zip(parts, seen, strict=True)]
        if any(C.size * B.size for C, B in zip(Cs, Bs, strict=True)):
            gains = _by_poles(A, Bs, Cs)
            if gains is None:
                gains, sizes = _by_schur(A, Bs, Cs), (CHUNK // (g.B.shape[1] + 2), 1)
            solvers.append((gains, list(zip(seen, fed, strict=True))))

    def add(s: ComplexArray, out: ComplexArray) -> bool:
        for gains, channels in solvers:
            for (i, j), gain in zip(channels, gains(s), strict=True):
                if gain.shape == out.shape:
                    out += gain
                else:
                    out[np.ix_(i, j)] += gain
        return False

    return add, *sizes


class Diagonal(NamedTuple):
    """``C (s I - A)^-1 B = left (s I - diag(poles))^-1 right``; without where V is poor."""

    poles: ComplexArray
    left: ComplexArray | None = None
    right: ComplexArray | None = None


def diagonal_form(A: FloatArray, B: FloatArray, C: FloatArray) -> Diagonal:
    """Return a system in the eigenvectors of A, its poles alone where these are ill-conditioned."""
    d = state_scale(A, B, C)
    found: Any = np.linalg.eig(A * d / d[:, None])
    poles, V = (np.asarray(part, dtype=np.complex128) for part in found)
    try:
        inverse = np.linalg.inv(V)
    except np.linalg.LinAlgError:
        return Diagonal(poles)
    with np.errstate(over="ignore"):  # of defective poles
        condition = np.linalg.norm(V) * np.linalg.norm(inverse)
    if not condition < POOR:
        return Diagonal(poles)
    return Diagonal(poles, (C * d) @ V, inverse @ (B / d[:, None]))


def _by_poles(A: FloatArray, Bs: list[FloatArray], Cs: list[FloatArray]) -> _Gains | None:
    """Real residues times functions of s: a pole off the real axis stands for its conjugate too."""
    poles, left, right = diagonal_form(A, np.hstack(Bs), np.vstack(Cs))
    if left is None or right is None:
        return None
    upper = poles.imag >= 0
    poles, left, right = poles[upper], left[:, upper], right[upper]
    right[poles.imag == 0] *= 0.5  # counted twice
    sizes = [(len(C), B.shape[1]) for C, B in zip(Cs, Bs, strict=True)]
    rows, columns = (np.cumsum([0, *(size[i] for size in sizes)]) for i in (0, 1))
    residues = np.concatenate(
        [
            (left[i : i + p, None] * right[:, j : j + m].T).reshape(p * m, poles.size)
            for i, j, (p, m) in zip(rows, columns, sizes, strict=False)
        ]
    )
    parts = np.hstack([residues.real, residues.imag])
    ends = np.cumsum([p * m for p, m in sizes])[:-1]

    def gains(s: ComplexArray) -> list[ComplexArray]:
        one, other = 1.0 / (s - poles[:, None]), 1.0 / (s - poles.conj()[:, None])
        both = np.concatenate([one + other, 1j * (one - other)])
        flat = (parts @ both.view(np.float64)).view(np.complex128)
        each = np.split(flat, ends)
        return [part.reshape(*size, s.size) for part, size in zip(each, sizes, strict=True)]

    return gains


def _by_schur(A: FloatArray, Bs: list[FloatArray], Cs: list[FloatArray]) -> _Gains:
    """Back substitution with the Schur form in even units."""
    B, C = np.hstack(Bs), np.vstack(Cs)
    d, T, U = scaled_schur(A, B, C)
    n, m = B.shape
    turned = U.conj().T @ (B / d[:, None])
    seen = np.split((C * d) @ U, np.cumsum([len(one) for one in Cs])[:-1])
    columns = np.cumsum([0, *(one.shape[1] for one in Bs)])

    def gains(s: ComplexArray) -> list[ComplexArray]:
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
        return [
            (row @ X[:, first:last].reshape(n, -1)).reshape(len(row), last - first, s.size)
            for row, first, last in zip(seen, columns[:-1], columns[1:], strict=True)
        ]

    return gains

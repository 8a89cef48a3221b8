"""Matrices and names of connected systems, the blocks on the diagonal of A, and their modes.

Systems are anything with A, B, C, D, dt, inputs, outputs, states and blocks: the operators of
`StateSpace` are built upon these functions.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from typing import Any, NamedTuple, TypeAlias

import numpy as np
import scipy.linalg as la

from ..arrays import ComplexArray, FloatArray, IntArray, instance, name_list, several, whole
from ..errors import LabelError, ModelError, ShapeError, short, unknown_label
from ..tolerances import ROUNDING
from .equations import state_scale

#: largest condition of eigenvectors whose residues are used
POOR = 1e5
#: A, B, C, D
Matrices: TypeAlias = tuple[FloatArray, FloatArray, FloatArray, FloatArray]


def in_series(g1: Any, g2: Any) -> dict[str, Any]:
    """Return the fields of ``g2 g1``: the outputs of g1 drive the inputs of g2, in order."""
    if len(g1.outputs) != len(g2.inputs):
        raise ShapeError(
            f"series needs as many outputs of the first system as inputs of the second, got "
            f"{len(g1.outputs)} ({short_list(g1.outputs)}) and {len(g2.inputs)} "
            f"({short_list(g2.inputs)})."
        )
    A, B, C, D = cascaded((g1.A, g1.B, g1.C, g1.D), (g2.A, g2.B, g2.C, g2.D))
    return {
        "A": A,
        "B": B,
        "C": C,
        "D": D,
        "inputs": g1.inputs,
        "outputs": g2.outputs,
        **common_fields([g2, g1]),
        "units": {name: g2.units[name] for name in g2.outputs if name in g2.units}
        | {name: g1.units[name] for name in g1.inputs if name in g1.units},
    }


def cascaded(first: Matrices, second: Matrices) -> Matrices:
    """Return A, B, C, D in series: the second's states first, so that A stays upper triangular."""
    A1, B1, C1, D1 = first
    A2, B2, C2, D2 = second
    n1, n2 = len(A1), len(A2)
    A = np.zeros((n2 + n1, n2 + n1))
    A[:n2, :n2], A[:n2, n2:], A[n2:, n2:] = A2, B2 @ C1, A1
    return A, np.vstack([B2 @ D1, B1]), np.hstack([C2, D2 @ C1]), D2 @ D1


def trapezoidal(matrices: Matrices, a: float) -> Matrices:
    """Return A, B, C, D with ``s = a (z - 1) / (z + 1)``; no pole lies at a."""
    A, B, C, D = matrices
    inverse = np.linalg.inv(a * np.eye(len(A)) - A)
    # x is replaced by the trapezoidal state, scaled so that B and C keep their sizes
    root = np.sqrt(2.0 * a)
    plus = a * np.eye(len(A)) + A
    return plus @ inverse, root * inverse @ B, root * C @ inverse, D + C @ inverse @ B


def bilinear_matrices(matrices: Matrices, a: float) -> Matrices:
    """Return A, B, C, D with ``z = (a + s) / (a - s)``; no pole lies at -1."""
    A, B, C, D = matrices
    eye, root = np.eye(len(A)), np.sqrt(2.0 * a)
    inverse = np.linalg.inv(eye + A)
    return a * inverse @ (A - eye), root * inverse @ B, root * C @ inverse, D - C @ inverse @ B


def in_parallel(g1: Any, g2: Any) -> dict[str, Any]:
    """Return the fields of ``g1 + g2``: same channels, outputs added."""
    if g1.inputs != g2.inputs or g1.outputs != g2.outputs:
        first, second = (f"{short_list(g.inputs)} -> {short_list(g.outputs)}" for g in (g1, g2))
        raise LabelError(
            f"parallel needs the same channels, got {first} and {second}. Rename or select them "
            "first."
        )
    return {
        "A": block_matrix([g1.A, g2.A]),
        "B": np.vstack([g1.B, g2.B]),
        "C": np.hstack([g1.C, g2.C]),
        "D": g1.D + g2.D,
        "inputs": g1.inputs,
        "outputs": g1.outputs,
        **common_fields([g1, g2]),
    }


def common_fields(parts: Sequence[Any]) -> dict[str, Any]:
    """Return dt, states, blocks and units of joined systems, their states following each other."""
    return {
        "dt": common_dt(parts),
        "states": state_names(parts),
        "blocks": joined_blocks(parts),
        "units": joined_units(parts),
    }


def joined_units(parts: Sequence[Any]) -> dict[str, str]:
    """Return the units of the channels of all parts; the first unit given holds."""
    return {name: unit for part in reversed(parts) for name, unit in part.units.items()}


def block_matrix(matrices: Sequence[FloatArray]) -> FloatArray:
    """Block diagonal that keeps the widths of empty matrices (scipy's drops them)."""
    out = np.zeros((sum(m.shape[0] for m in matrices), sum(m.shape[1] for m in matrices)))
    row = col = 0
    for matrix in matrices:
        out[row : row + matrix.shape[0], col : col + matrix.shape[1]] = matrix
        row, col = row + matrix.shape[0], col + matrix.shape[1]
    return out


def common_dt(systems: Iterable[Any]) -> float:
    """Return the sampling time that systems share; static gains fit any."""
    found = {sys.dt for sys in systems if sys.n_states} or {sys.dt for sys in systems}
    if len(found) > 1 and not np.allclose(list(found), next(iter(found)), rtol=ROUNDING, atol=0):
        raise ModelError(
            f"systems with sampling times {sorted(found)} s cannot be connected (0 is continuous). "
            "Discretise them to one rate first."
        )
    return found.pop() if found else 0.0


def state_names(parts: Sequence[Any]) -> list[str]:
    """Join state names; where they clash, add the system's place in the list."""
    plain = [name for part in parts for name in part.states]
    if len(set(plain)) == len(plain):
        return plain
    return [f"{i}:{name}" for i, part in enumerate(parts, 1) for name in part.states]


def joined_blocks(parts: Sequence[Any]) -> list[int]:
    """Return the block sizes of systems one after the other; one block where none are known."""
    sizes: list[int] = []
    for part in parts:
        sizes.extend(
            part.blocks if part.blocks is not None else ((part.n_states,) if part.n_states else ())
        )
    return sizes


def short_list(names: Sequence[str]) -> str:
    """Return the names, abbreviated when there are many."""
    return ", ".join(names) if len(names) <= 4 else f"{names[0]}, ... {names[-1]} ({len(names)})"


def block_eigenvalues(A: FloatArray, blocks: Sequence[int]) -> ComplexArray:
    """Return the eigenvalues of a block upper triangular A; 1 x 1 and 2 x 2 in closed form."""
    starts = np.concatenate([[0], np.cumsum(blocks)[:-1]]).astype(int)
    poles = np.zeros(A.shape[0], dtype=np.complex128)
    sizes = np.asarray(blocks)
    ones, twos = starts[sizes == 1], starts[sizes == 2]
    poles[ones] = A[ones, ones]
    entries = [A[twos + i, twos + j] for i in (0, 1) for j in (0, 1)]
    poles[twos], poles[twos + 1] = pair_eigenvalues(*entries)
    for start, size in zip(starts[sizes > 2], sizes[sizes > 2], strict=True):
        part = slice(start, start + size)
        poles[part] = la.eigvals(A[part, part])
    return poles


def equal_matrices(one: Any, other: Any) -> bool:
    """Return whether two systems have the same A, B, C and D."""
    return all(np.array_equal(getattr(one, name), getattr(other, name)) for name in "ABCD")


def is_block_diagonal(g: Any) -> bool:
    """Return whether A is known to consist of 1 x 1 and 2 x 2 diagonal blocks only."""
    if g.blocks is None or not set(g.blocks) <= {1, 2}:
        return False
    owner = np.repeat(np.arange(len(g.blocks)), g.blocks)
    return not np.any(g.A[owner[:, None] != owner[None, :]])


def diagonal_blocks(A: FloatArray, blocks: Sequence[int]) -> tuple[FloatArray, IntArray]:
    """Return 1 x 1 and 2 x 2 diagonal blocks as (b, 2, 2), and the states of each (b, 2; -1: none).

    A block of one state gets its pole twice; nothing drives the second.
    """
    sizes = np.asarray(blocks)
    starts = np.cumsum(sizes) - sizes
    slots = np.stack([starts, np.where(sizes == 2, starts + 1, -1)], axis=1)
    real = slots >= 0
    pairs = A[slots[:, :, None], slots[:, None, :]] * (real[:, :, None] & real[:, None, :])
    pairs[sizes == 1, 1, 1] = pairs[sizes == 1, 0, 0]
    return pairs, slots


def uncoupled_run(A: FloatArray, blocks: Sequence[int]) -> tuple[int, int, Sequence[int]]:
    """Return the first state, the end and the blocks of the longest uncoupled run."""
    # blocks of one or two states that do not act on each other: modes among filters and delay lines
    if not blocks:
        return 0, 0, ()
    sizes = np.asarray(blocks, dtype=np.int64)
    starts = np.concatenate([[0], np.cumsum(sizes)])
    owner = np.repeat(np.arange(sizes.size), sizes)
    rows, columns = (owner[part] for part in np.nonzero(A))
    # the block behind the last that each acts on: a run that ends here begins there
    after = np.where(sizes > 2, np.arange(1, sizes.size + 1), 0)
    np.maximum.at(after, columns, np.where(rows < columns, rows + 1, 0))
    first = starts[np.maximum.accumulate(after)]
    last = int(np.argmax(starts[1:] - first))
    begin, end = int(first[last]), int(starts[last + 1])
    return begin, end, sizes[np.searchsorted(starts, begin) : last + 1].tolist()


def block_diagonal(pairs: FloatArray) -> FloatArray:
    """Return the (2 b, 2 b) matrix with the (b, 2, 2) blocks on its diagonal."""
    b = pairs.shape[0]
    matrix = np.zeros((b, 2, b, 2))
    matrix[np.arange(b), :, np.arange(b), :] = pairs
    return matrix.reshape(2 * b, 2 * b)


def turning_parts(pairs: FloatArray) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Return m (b,), N (b, 2, 2), q (b,) of blocks ``m I + N``, ``N^2 = q I`` (Cayley-Hamilton)."""
    # no cancellation near a pole m +- q^(1/2), which matters for slow modes of a sampled system
    N = pairs.copy()
    N[:, 0, 0] = 0.5 * (pairs[:, 0, 0] - pairs[:, 1, 1])
    N[:, 1, 1] = -N[:, 0, 0]
    mean = 0.5 * (pairs[:, 0, 0] + pairs[:, 1, 1])
    return mean, N, N[:, 0, 0] ** 2 + N[:, 0, 1] * N[:, 1, 0]


def checked_blocks(A: FloatArray, blocks: Sequence[int]) -> tuple[int, ...]:
    """Return block sizes as a tuple; ShapeError unless A is block upper triangular with them."""
    hint = "Pass whole numbers, or blocks=None."
    given = instance(blocks, Sequence | np.ndarray, "blocks", hint)
    sizes = tuple(given) if several(given) else ()
    if not set(map(type, sizes)) <= {int} or min(sizes, default=0) < 0:
        sizes = tuple(whole(size, "a block", minimum=0) for size in sizes)
    if 0 in sizes or sum(sizes) != A.shape[0]:
        raise ShapeError(f"blocks must be positive and add up to {A.shape[0]} states, got {sizes}.")
    owner = np.repeat(np.arange(len(sizes)), sizes)
    rows, columns = np.nonzero(A)
    if np.any(owner[rows] > owner[columns]):
        raise ShapeError("A is not block upper triangular with the given blocks; pass blocks=None.")
    return sizes


#: selection of channels: a name or number, several, or a slice
Channels: TypeAlias = str | int | slice | Sequence[str | int]


def chosen_names(known: Sequence[str], key: Channels, side: str) -> list[str]:
    """Return the names that a name, a number, several or a slice selects."""
    if isinstance(key, slice):
        return list(known[key])
    given: Any = key
    listed: list[Any] = list(given) if several(given) else [given]
    for item in listed:
        if not isinstance(item, str | int | np.integer) or isinstance(item, bool):
            raise LabelError(
                f"{side}s are chosen by name, number or slice, got {short(item)}. Known are: "
                f"{short_list(known)}."
            )
        if isinstance(item, int | np.integer) and not -len(known) <= item < len(known):
            raise LabelError(
                f"{side} number {item} does not exist: the system has {len(known)} "
                f"({short_list(known)}), counted from 0."
            )
    return [item if isinstance(item, str) else known[item] for item in listed]


def chosen_pair(
    outputs: Sequence[str], inputs: Sequence[str], key: tuple[Channels, Channels]
) -> tuple[list[str], list[str]]:
    """Return the outputs and inputs that `sys[output, input]` selects."""
    if not isinstance(key, tuple) or len(key) != 2:
        raise LabelError(
            f"a channel is a pair, sys[output, input], by name or number, got {short(key)}."
        )
    return chosen_names(outputs, key[0], "output"), chosen_names(inputs, key[1], "input")


def rows_of(known: Sequence[str], names: Iterable[str], side: str, owner: str | None) -> IntArray:
    """Return the positions of names; LabelError where one is unknown."""
    position = {name: i for i, name in enumerate(known)}
    rows = []
    for name in name_list(names, f"{side}s"):
        if name not in position:
            raise unknown_label(side, name, known, owner or "")
        rows.append(position[name])
    return np.array(rows, dtype=np.int64)


def pair_eigenvalues(
    a: FloatArray, b: FloatArray, c: FloatArray, d: FloatArray
) -> tuple[ComplexArray, ComplexArray]:
    """Return both eigenvalues of matrices [a, b; c, d]."""
    # (a-d)^2/4 + b c rather than mean^2 - det: no cancellation for rigid-body pairs (b or c = 0)
    root: ComplexArray = np.sqrt((0.25 * (a - d) ** 2 + b * c).astype(np.complex128))
    return 0.5 * (a + d) + root, 0.5 * (a + d) - root


class ModalMap(NamedTuple):
    """Poles (n,) of A, its eigenvectors T and T^-1: full, or (b, 2, 2) of uncoupled pairs."""

    poles: ComplexArray
    T: ComplexArray
    inverse: ComplexArray

    @classmethod
    def of_pairs(cls, pairs: FloatArray) -> ModalMap:
        """Return the map of separate blocks (b, 2, 2); T^-1 is not finite for defective blocks.

        The poles are m +- r, m half the trace and ``r^2 I = (A - m I)^2`` (Cayley-Hamilton): their
        damping is as accurate as the block.
        """
        mean, N, q = turning_parts(pairs)
        half, e, c = N[:, 0, 0], N[:, 0, 1], N[:, 1, 0]
        plain = (e == 0) & (c == 0)
        root: ComplexArray = np.where(plain, half, np.sqrt(q.astype(np.complex128)))
        first, second = root + half, root - half  # r + N_11, r - N_11; their product is e c
        T = np.where(
            np.abs(e) >= np.abs(c),
            np.array([[e + 0j, e + 0j], [second, -first]]),
            np.array([[first, -second], [c + 0j, c + 0j]]),
        ).transpose(2, 0, 1)
        T[plain] = np.eye(2)
        adjugate = np.stack([T[:, 1, 1], -T[:, 0, 1], -T[:, 1, 0], T[:, 0, 0]], axis=1)
        with np.errstate(divide="ignore", invalid="ignore"):
            inverse = adjugate / (T[:, 0, 0] * T[:, 1, 1] - T[:, 0, 1] * T[:, 1, 0])[:, None]
        poles = np.stack([mean + root, mean - root], axis=1).reshape(-1)
        return cls(poles, T, inverse.reshape(-1, 2, 2))

    def gramian(self, driven: ComplexArray, *, sampled: bool) -> ComplexArray:
        """Return X of ``L X + X L* + d d* = 0``, or ``X = L X L* + d d*``: of modes driven by d."""
        other = self.poles.conj()
        sums = 1.0 - np.outer(self.poles, other) if sampled else -np.add.outer(self.poles, other)
        return np.asarray(driven @ driven.conj().T / sums)

    def seen(self, rows: FloatArray) -> ComplexArray:
        """Return ``rows T``: how outputs (p, n) see the modes."""
        if self.T.ndim == 2:
            return np.asarray(rows @ self.T)
        split = rows.reshape(len(rows), len(self.T), 2)
        return np.asarray(np.einsum("pbi,bij->pbj", split, self.T).reshape(rows.shape))

    def driven(self, columns: FloatArray) -> ComplexArray:
        """Return ``T^-1 columns``: how inputs (n, m) drive the modes."""
        return _times(self.inverse, columns)

    def back(self, columns: ComplexArray) -> ComplexArray:
        """Return ``T columns``: the states (n, m) of modes."""
        return _times(self.T, columns)

    def shapes(self, chosen: IntArray) -> ComplexArray:
        """Return some columns of T."""
        if self.T.ndim == 2:
            return self.T[:, chosen]
        found = np.zeros((len(self.T), 2, chosen.size), dtype=np.complex128)
        found[chosen // 2, :, np.arange(chosen.size)] = self.T[chosen // 2, :, chosen % 2]
        return np.asarray(found.reshape(2 * len(self.T), chosen.size))


def _times(factor: ComplexArray, columns: FloatArray | ComplexArray) -> ComplexArray:
    if factor.ndim == 2:
        return np.asarray(factor @ columns)
    split = columns.reshape(len(factor), 2, columns.shape[1])
    return np.asarray((factor @ split).reshape(columns.shape))


class Diagonal(NamedTuple):
    """``C (s I - A)^-1 B = left (s I - diag(poles))^-1 right``; None for ill-conditioned V."""

    poles: ComplexArray
    left: ComplexArray | None = None
    right: ComplexArray | None = None


def diagonal_form(A: FloatArray, B: FloatArray, C: FloatArray) -> Diagonal:
    """Return a system in the eigenvectors of A; only its poles where these are ill-conditioned."""
    if len(A) == 1:
        return Diagonal(*(part.astype(np.complex128) for part in (A[0], C, B)))
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


def block_form(g: Any) -> Diagonal | None:
    """Return a system in the modes of its blocks, in closed form; None where A has others."""
    if not is_block_diagonal(g):
        return None
    pairs, slots = diagonal_blocks(g.A, g.blocks or ())
    own = ModalMap.of_pairs(pairs)
    if not np.isfinite(own.inverse).all():
        return Diagonal(own.poles)
    real, n = slots >= 0, slots.size
    B, C = g.B[slots] * real[:, :, None], g.C[:, slots] * real
    return Diagonal(own.poles, own.seen(C.reshape(-1, n)), own.driven(B.reshape(n, -1)))

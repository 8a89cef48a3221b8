"""Matrices and names of systems: joined, of transfer functions, blocks of A, zeros.

Systems are anything with A, B, C, D, dt, inputs, outputs, states and blocks: the operators of
`StateSpace` are built upon these functions.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from typing import Any, TypeAlias

import numpy as np
import numpy.typing as npt
import scipy.linalg as la

from ..arrays import ComplexArray, FloatArray, IntArray, complex_array, positive, real_array, whole
from ..errors import LabelError, ModelError, ShapeError, short, unknown_label
from ..tolerances import ROUNDING, SPLIT, divisor
from ..words import instance, name_list, several
from .equations import mean_speed, reciprocal, state_scale

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
    """Return names, of many the first and the last."""
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
    """Return whether A is known to be made of 1 x 1 and 2 x 2 diagonal blocks alone."""
    if g.blocks is None or not set(g.blocks) <= {1, 2}:
        return False
    owner = np.repeat(np.arange(len(g.blocks)), g.blocks)
    return not np.any(g.A[owner[:, None] != owner[None, :]])


def diagonal_blocks(A: FloatArray, blocks: Sequence[int]) -> tuple[FloatArray, IntArray]:
    """Return 1 x 1 and 2 x 2 diagonal blocks as (b, 2, 2), and the states of each (b, 2; -1: none).

    A block of one state has its pole twice: nothing drives the second.
    """
    sizes = np.asarray(blocks)
    starts = np.cumsum(sizes) - sizes
    slots = np.stack([starts, np.where(sizes == 2, starts + 1, -1)], axis=1)
    real = slots >= 0
    pairs = A[slots[:, :, None], slots[:, None, :]] * (real[:, :, None] & real[:, None, :])
    pairs[sizes == 1, 1, 1] = pairs[sizes == 1, 0, 0]
    return pairs, slots


def uncoupled_run(A: FloatArray, blocks: Sequence[int]) -> tuple[int, int, Sequence[int]]:
    """Return the first state, that after the last and the blocks of the longest uncoupled run."""
    # blocks of one or two states that do not see each other: modes among filters and delay lines
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


def checked_blocks(A: FloatArray, blocks: Sequence[int]) -> tuple[int, ...]:
    """Return block sizes as a tuple; ShapeError unless A is block upper triangular with them."""
    hint = "Pass whole numbers, or blocks=None."
    given = instance(blocks, Sequence | np.ndarray, "blocks", hint)
    sizes = tuple(given) if several(given) else ()
    if not all(type(size) is int and size >= 0 for size in sizes):
        sizes = tuple(whole(size, "a block", minimum=0) for size in sizes)
    if 0 in sizes or sum(sizes) != A.shape[0]:
        raise ShapeError(f"blocks must be positive and add up to {A.shape[0]} states, got {sizes}.")
    owner = np.repeat(np.arange(len(sizes)), sizes)
    rows, columns = np.nonzero(A)
    if np.any(owner[rows] > owner[columns]):
        raise ShapeError("A is not block upper triangular with the given blocks; pass blocks=None.")
    return sizes


#: what selects channels: a name or number, several, or a slice
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
                f"there is no {side} number {item}: the system has {len(known)} "
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


def zpk_fields(
    zeros: npt.ArrayLike, poles: npt.ArrayLike, gain: float, dt: float = 0.0
) -> dict[str, Any]:
    """Return A, B, C, D and blocks of ``gain prod(s - zeros) / prod(s - poles)``."""
    # each pair of poles is a block of two states with the zeros nearest to it, the least damped
    # first, so that A keeps its poles to rounding: a companion form of many poles does not
    z, p, dt = _as_roots(zeros, "zeros"), _as_roots(poles, "poles"), positive(dt, "dt", zero=True)
    if z.size > p.size:
        raise ModelError(
            f"the transfer function has {z.size} zeros and {p.size} poles: it differentiates its "
            "input, which no state space does. Add poles beyond the band, such as a low-pass."
        )
    left = root_pairs(z)
    chain = np.zeros((0, 0)), np.zeros((0, 1)), np.zeros((1, 0)), np.ones((1, 1))
    blocks: list[int] = []
    factor = float(real_array(gain, "gain", ()))
    for pair in sorted(root_pairs(p), key=lambda pole: _decay(pole[0], dt)):
        nearest = _near_zeros(pair, left)
        left = [part for part in left if part is not nearest]
        a, b, c, d = _section(pair, nearest)
        # sections of moderate gain: what they lack of the poles' size goes to the factor
        size = float(np.abs(pair).max()) or 1.0
        lacking = size ** (pair.size - nearest.size)
        c, d, factor = c * lacking, d * lacking, factor / lacking
        chain = cascaded(chain, (a, b, c, d))
        blocks = [pair.size, *blocks]
    A, B, C, D = chain
    return {"A": A, "B": B, "C": factor * C, "D": factor * D, "blocks": blocks}


def tf_fields(
    numerator: npt.ArrayLike, denominator: npt.ArrayLike, dt: float = 0.0
) -> dict[str, Any]:
    """Return A, B, C, D and blocks of a ratio of polynomials, highest power first."""
    num, den = (
        np.trim_zeros(np.ravel(real_array(part, name)), "f")
        for part, name in ((numerator, "the numerator"), (denominator, "the denominator"))
    )
    if not den.size:
        raise ModelError("the denominator is zero: a transfer function needs one that is not.")
    if not num.size:
        return zpk_fields([], [], 0.0)
    return zpk_fields(np.roots(num), np.roots(den), num[0] / den[0], dt)


def matrix_fields(channels: list[list[dict[str, Any]]]) -> dict[str, Any]:
    """Return the fields of a matrix of transfer functions, each with states of its own."""
    every = [part for row in channels for part in row]
    inputs = [np.eye(len(row))[j : j + 1] for row in channels for j in range(len(row))]
    outputs = [np.eye(len(channels))[:, i : i + 1] for i, row in enumerate(channels) for _ in row]
    return {
        "A": block_matrix([part["A"] for part in every]),
        "B": np.vstack([part["B"] @ side for part, side in zip(every, inputs, strict=True)]),
        "C": np.hstack([side @ part["C"] for part, side in zip(every, outputs, strict=True)]),
        "D": np.array([[part["D"][0, 0] for part in row] for row in channels]),
        "blocks": [size for part in every for size in part["blocks"]],
    }


def _as_roots(values: npt.ArrayLike, name: str) -> ComplexArray:
    roots = complex_array(values, name).ravel()
    lonely = [root for root in roots if not np.isclose(roots, root.conj(), rtol=SPLIT).any()]
    if lonely:
        raise ModelError(
            f"{name} need the conjugate of {lonely[0]:.6g}: complex ones of a real system come in "
            "pairs."
        )
    return roots


def _decay(pole: complex, dt: float) -> float:
    return 1.0 - abs(pole) if dt else abs(pole.real) / (abs(pole) or 1.0)


def root_pairs(values: ComplexArray) -> list[ComplexArray]:
    """Return conjugate pairs, pairs of neighbouring real values, and one that is left over."""
    upper = values.imag > ROUNDING * np.abs(values)
    pairs = [np.array([v, np.conj(v)]) for v in values[upper]]
    real = np.sort(values[np.abs(values.imag) <= ROUNDING * np.abs(values)].real).astype(complex)
    return pairs + [real[i : i + 2] for i in range(0, real.size, 2)]


def _near_zeros(pair: ComplexArray, left: list[ComplexArray]) -> ComplexArray:
    """Return the zeros nearest to a pair of poles, none where it cannot hold them."""
    fitting = [z for z in left if z.size == pair.size] or [z for z in left if z.size < pair.size]
    if not fitting:
        return np.zeros(0, dtype=np.complex128)
    return min(fitting, key=lambda z: float(np.abs(z[0] - pair[0])))


def _section(
    poles: ComplexArray, zeros: ComplexArray
) -> tuple[FloatArray, FloatArray, FloatArray, FloatArray]:
    """Return ``prod (s - zero) / prod (s - pole)`` of order one or two, with no more zeros."""
    through = np.array([[float(zeros.size == poles.size)]])
    if poles.size == 1:
        p = float(poles[0].real)
        gain = p - float(zeros[0].real) if zeros.size else 1.0
        return np.array([[p]]), np.array([[1.0]]), np.array([[gain]]), through
    # through + (n1 s + n0) / den, zeros and poles compared before they are multiplied out
    if zeros.size == 2:
        n1 = float((poles.sum() - zeros.sum()).real)
        n0 = float((np.prod(zeros) - np.prod(poles)).real)
    else:
        n1, n0 = (1.0, -float(zeros[0].real)) if zeros.size else (0.0, 1.0)
    B = np.array([[0.0], [1.0]])
    real = float(poles[0].real)
    if poles[0].imag:
        imag = abs(float(poles[0].imag))
        A = np.array([[real, imag], [-imag, real]])
        return A, B, np.array([[(n0 + n1 * real) / imag, n1]]), through
    size = float(np.abs(poles).max()) or 1.0
    A = np.array([[real, size], [0.0, float(poles[1].real)]])
    return A, B, np.array([[(n0 + n1 * real) / size, n1]]), through


#: a zero closer to the limit than this, relative to its size, is tested as if it were on it
_ON_AXIS = 1e-6
#: smallest singular value of the scaled system matrix, at which its rank is lost
_LOST = 1e-9
#: singular values below this, relative to the scaled system matrix, are rounding
_ROUNDING = 1e-11


def invariant_zeros(g: Any) -> ComplexArray:
    """Return the finite invariant zeros, where ``[A - s I, B; C, D]`` loses its normal rank."""
    # the system is compressed until D has full row and column rank: outputs that do not feel an
    # input directly are states, and states of the rest. What is left is a regular pencil, whose
    # eigenvalues are the zeros; those at infinity have left with the compressed states.
    # [EmamiNaeiniVanDooren1982]_
    A, B, C, D = _scaled_matrices(g)
    d = state_scale(A, B, C) if A.size else np.ones(0)
    A, B, C = A * d / d[:, None], B / d[:, None], C * d
    A, B, C, D = _full_rank_part(A, B, C, D)
    A, C, B, D = (part.T for part in _full_rank_part(A.T, C.T, B.T, D.T))
    n, m = B.shape
    if not n:
        return np.zeros(0, dtype=np.complex128)
    if not m:
        return np.asarray(la.eigvals(A) * _pole_size(g), dtype=np.complex128)
    # columns that [C D] does not see: the pencil [A - s I, B] on them is square
    unseen = la.qr(np.hstack([C, D]).T)[0][:, -n:]
    alpha, beta = la.eigvals(np.hstack([A, B]) @ unseen, unseen[:n], homogeneous_eigvals=True)
    finite = np.abs(beta) > _ROUNDING * np.abs(alpha)
    return np.asarray(alpha[finite] / beta[finite] * _pole_size(g), dtype=np.complex128)


def _full_rank_part(
    A: FloatArray, B: FloatArray, C: FloatArray, D: FloatArray
) -> tuple[FloatArray, FloatArray, FloatArray, FloatArray]:
    """Return a system of the same finite zeros whose D has full row rank."""
    limit = _ROUNDING * float(np.linalg.norm(np.block([[A, B], [C, D]])))
    while True:
        turn, rank = _row_space(D, limit)
        C, D = turn.T @ C, turn.T @ D
        C_direct, C_late, D = C[:rank], C[rank:], D[:rank]
        turn, fixed = _row_space(C_late.T, limit)  # states that C_late sees come first
        if not fixed:
            return A, B, C_direct, D
        # outputs without feedthrough that are zero hold these states at zero: their rates are
        # the next outputs
        A, B, C_direct = turn.T @ A @ turn, turn.T @ B, C_direct @ turn
        C = np.vstack([C_direct[:, fixed:], A[:fixed, fixed:]])
        D = np.vstack([D, B[:fixed]])
        A, B = A[fixed:, fixed:], B[fixed:]


def _row_space(matrix: FloatArray, limit: float) -> tuple[FloatArray, int]:
    """Return an orthogonal Q and r: the first r columns of Q span the columns of the matrix."""
    if not matrix.size:
        return np.eye(matrix.shape[0]), 0
    left, values, _ = np.linalg.svd(matrix)
    return left, int(np.sum(values > limit))


def axis_zeros(g: Any) -> ComplexArray:
    """Return the invariant zeros on the imaginary axis (unit circle), upper half plane."""
    # where `[A - s I, B; C, D]` loses column rank. With more outputs than inputs they are among the
    # generalised eigenvalues of the pencil with its outputs mixed down to as many as inputs;
    # candidates near the limit are moved onto it. The rank of the whole matrix, states, inputs and
    # outputs scaled to unit size, decides. [EmamiNaeiniVanDooren1982]_; the random mixing replaces
    # their compression
    n, m = g.n_states, len(g.inputs)
    A, B, C, D = _scaled_matrices(g)
    mixing = np.linalg.qr(np.random.default_rng(0).standard_normal((C.shape[0], m)))[0].T
    pencil = np.block([[A, B], [mixing @ C, mixing @ D]])
    E = np.zeros((n + m, n + m))
    E[:n, :n] = np.eye(n)
    alpha, beta = la.eig(pencil, E, right=False, homogeneous_eigvals=True)
    # beyond: rounding of a zero at infinity, which comes out at some 1 / (2e-16)
    finite = np.abs(beta) > 1e-14 * np.abs(alpha)
    speed = _pole_size(g)
    zeros = alpha[finite] / beta[finite]
    size = np.maximum(np.abs(zeros), 0.1)  # double zeros at 0 come out at the root of rounding
    off = np.abs(np.abs(zeros) - 1) if g.dt else np.abs(zeros.real) / size
    near = zeros[(off < _ON_AXIS) & (zeros.imag >= 0)]
    on = near / np.abs(near) if g.dt else 1j * near.imag
    # several at zero frequency come out at a root of rounding, which may be far off: always tested
    on = np.append(on, 1.0 if g.dt else 0.0)
    found: list[complex] = []
    for zero in np.sort_complex(on):
        # in units of the scaled system
        if any(abs(zero - other) < SPLIT * max(abs(zero), 1e-3) for other in found):
            continue
        whole = np.block([[A - zero * np.eye(n), B], [C, D]])
        columns = np.linalg.norm(whole, axis=0)
        if np.linalg.svd(whole / divisor(columns), compute_uv=False)[-1] < _LOST:
            found.append(complex(zero))
    return np.array(found, dtype=np.complex128) * speed


def _pole_size(g: Any) -> float:
    """Return a frequency [rad/s] that makes A of order one; 1 when sampled."""
    return 1.0 if g.dt else mean_speed(g.poles())


def _scaled_matrices(g: Any) -> tuple[FloatArray, FloatArray, FloatArray, FloatArray]:
    """Return the matrices with time in units of the poles, inputs and outputs of unit size."""
    A, B = g.A / _pole_size(g), g.B / _pole_size(g)
    into = reciprocal(np.linalg.norm(B, axis=0) + 0.0)
    B, D = B * into, g.D * into
    out = reciprocal(np.linalg.norm(np.hstack([g.C, D]), axis=1))
    return A, B, g.C * out[:, None], D * out[:, None]

"""The modal block form of any system, its stable part, and how well its poles are known."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np
import scipy.linalg as la

from ..arrays import ComplexArray, FloatArray, positive
from ..errors import SolverError, counted
from ..store import Value
from ..tolerances import NEGLIGIBLE, ROOT, SAME, SPLIT
from .blocks_of_states import block_eigenvalues, is_block_diagonal
from .equations import even_scale, state_scale
from .statespace import StateSpace, System, as_statespace

#: number of roundings of A that a pole may contain
ROUNDINGS = 4.0


@dataclass(frozen=True, eq=False, repr=False)
class ModalForm(Value):
    """A system in modal blocks, or unchanged when its eigenvectors do not allow blocks.

    Parameters
    ----------
    system : StateSpace
        System whose A has 1 x 1 and 2 x 2 diagonal blocks; the system as given when `reason` is not
        empty.
    transformation : (n, n) array
        ``x = T x_modal``; the identity when `reason` is not empty.
    condition : float
        Condition number of the matrix of eigenvectors, for balanced states. Rounding errors grow by
        this factor.
    residual : float
        Norm of the entries of ``T^-1 A T`` outside of the blocks, relative to the norm of A, for
        balanced states. It shows how exact the blocks are.
    reason : str
        Reason why the dense form was kept; empty if blocks were found.

    Examples
    --------
    >>> import flexplant as fx
    >>> fx.modal_form(fx.lti.tf([1.0], [1.0, 3.0, 2.0])).system.A.round(9)
    array([[-2.,  2.],
           [ 0., -1.]])
    """

    system: StateSpace
    transformation: FloatArray
    condition: float
    residual: float
    reason: str = ""

    def __repr__(self) -> str:
        found = self.reason or f"{counted(len(self.system.blocks or ()), 'block')}"
        return f"<ModalForm: {found}, condition {self.condition:.1e}>"


def modal_form(sys: System, *, largest_condition: float = 1e6) -> ModalForm:
    """Return a system with A in real blocks, [[s, w], [-w, s]] for a pair, [p] for a real pole.

    The result is a `ModalForm`, whose attribute `system` is the system in these coordinates. A
    rigid-body mode has two poles at 0 but only one eigenvector. It becomes a pair of integrators
    [[0, w], [0, 0]], whose poles are exactly at 0 (at 1 when sampled). The states are scaled so
    that inputs and outputs have gains of similar size. With such blocks, the cost of frequency
    responses, Gramians and sampling grows only linearly with the number of modes.

    Parameters
    ----------
    sys : StateSpace or control.StateSpace
        Any system. If A has only 2 x 2 and 1 x 1 diagonal blocks, it is returned unchanged.
    largest_condition : float
        Largest condition number of the eigenvectors; above it the system is returned unchanged with
        a `reason`.

    Raises
    ------
    ModelError
        When `sys` is not a system or largest_condition not positive.

    Examples
    --------
    >>> import flexplant as fx
    >>> fx.modal_form(fx.lti.tf([1.0], [1.0, 2.0, 101.0])).system.A.round(9)
    array([[ -1.,  10.],
           [-10.,  -1.]])
    """
    g = as_statespace(sys)
    positive(largest_condition, "largest_condition")
    n = g.n_states
    if not n or is_block_diagonal(g):
        return ModalForm(g, np.eye(n), 1.0, 0.0)
    d = state_scale(g.A, g.B, g.C)
    A = g.A * d / d[:, None]
    try:
        V, pairs, blocks = _basis(A, 1.0 if g.dt else 0.0)
    except la.LinAlgError as error:
        reason = (
            f"dense form kept: two nearly equal poles cannot be set apart from others ({error})"
        )
        return ModalForm(g, np.eye(n), np.inf, 0.0, reason)
    condition = float(np.linalg.cond(V)) if V.shape == A.shape else np.inf
    reason = ""
    if condition > largest_condition:
        reason = (
            f"dense form kept: the eigenvectors have condition {condition:.1e}, above "
            f"{largest_condition:.1e} (defective or nearly parallel modes)"
        )
        return ModalForm(g, np.eye(n), condition, 0.0, reason)
    new = np.linalg.solve(V, A @ V)
    residual = float(np.linalg.norm(new - pairs) / np.linalg.norm(A))
    if residual > SAME:
        reason = f"dense form kept: the blocks leave {residual:.1e} of A out"
        return ModalForm(g, np.eye(n), condition, residual, reason)
    B = np.asarray(np.linalg.solve(V, g.B / d[:, None]), dtype=np.float64)
    C = np.asarray((g.C * d) @ V, dtype=np.float64)
    scale = _balance(B, C, blocks)
    size = scale[:, None]
    names = [
        f"mode{i}:{part}" if size > 1 else f"mode{i}"
        for i, size in enumerate(blocks, 1)
        for part in "ab"[:size]
    ]
    system = g.replace(A=pairs, B=B / size, C=C * scale, states=names, blocks=blocks)
    return ModalForm(system, d[:, None] * V * scale, condition, residual)


def _basis(A: FloatArray, centre: float) -> tuple[FloatArray, FloatArray, list[int]]:
    """Return real eigenvectors (n, n), the block-diagonal A and its blocks, slow poles first."""
    eye = np.eye(A.shape[0])
    # a slow mode is not a rigid-body mode, even if other modes are fast: rounding decides which may
    # be
    values, vectors, error = eigenvalues_with_error(A)
    near = np.abs(values - centre) <= error
    columns, parts = [np.zeros((A.shape[0], 0))], []
    chain = _chains(A - centre * eye, int(near.sum())) if near.sum() > 1 else None
    if chain is not None:
        columns.append(chain[0])
        parts += [centre * np.eye(2) + np.array([[0.0, w], [0.0, 0.0]]) for w in chain[1]]
    else:
        near[:] = False
    done = near.copy()
    for k in np.lexsort((values.imag, np.abs(values - centre))):
        pole, vector = values[k], vectors[:, k]
        if done[k] or pole.imag < 0:
            continue
        twin = _parallel(int(k), values, vectors, done)
        if twin is not None:
            done[twin] = True
            columns.append(_invariant_plane(A, values, [int(k), twin]))
            parts.append(columns[-1].T @ A @ columns[-1])
            continue
        if not pole.imag:
            columns.append(vector.real[:, None])
            parts.append(np.array([[pole.real]]))
            continue
        # the phase that makes real and imaginary part orthogonal: the best conditioned pair
        turned: ComplexArray = vector * np.exp(-0.5j * np.angle(np.sum(vector**2)))
        columns.append(np.stack([turned.real, turned.imag], axis=1) * np.sqrt(2.0))
        parts.append(np.array([[pole.real, pole.imag], [-pole.imag, pole.real]]))
    return np.hstack(columns), la.block_diag(*parts), [len(part) for part in parts]


def _parallel(
    k: int, values: ComplexArray, vectors: ComplexArray, done: np.typing.NDArray[np.bool_]
) -> int | None:
    """Return the pole whose eigenvector is nearly parallel to that of pole k, or None."""
    # the other of two real poles, or the conjugate: a double one that rounding split
    others = values == values[k].conj() if values[k].imag else (values.imag == 0.0) & ~done
    others &= np.abs(values - values[k]) < NEGLIGIBLE * np.abs(values[k])
    others[k] = False
    if not others.any():
        return None
    along = vectors[:, k].conj() @ vectors
    sine = np.linalg.norm(vectors - np.outer(vectors[:, k], along), axis=0)
    twin = int(np.argmin(np.where(others, sine, np.inf)))
    return twin if sine[twin] < NEGLIGIBLE else None


def _invariant_plane(A: FloatArray, values: ComplexArray, two: list[int]) -> FloatArray:
    """Return an orthonormal basis (n, 2) of the invariant plane of two poles (Schur)."""
    rest = np.delete(values, two)

    def chosen(real: float, imag: float) -> bool:
        away = np.abs(values[two] - complex(real, imag))
        return bool(away.min() < np.min(np.abs(rest - complex(real, imag)), initial=np.inf))

    return np.asarray(la.schur(A, sort=chosen)[1][:, :2])


def _chains(N: FloatArray, count: int) -> tuple[FloatArray, FloatArray] | None:
    """Return (n, count) pairs with ``N v = w u, N u = 0``: rigid-body modes, or None."""
    # of the smallest singular values of N^2: N is a square of zero there
    if count % 2:
        return None
    space = la.svd(N @ N)[2][-count:].T
    inner = space.T @ N @ space
    left, speed, right = la.svd(inner)
    half = count // 2
    size = np.linalg.norm(N)
    if speed[half - 1] < SPLIT * size or np.max(speed[half:]) > SPLIT * size:
        return None  # simple poles at the centre, or chains of another length
    pairs = np.empty((N.shape[0], count))
    pairs[:, 0::2] = space @ left[:, :half]
    pairs[:, 1::2] = space @ right[:half].T
    return pairs, speed[:half]


def _balance(B: FloatArray, C: FloatArray, blocks: list[int]) -> FloatArray:
    """Return the size of each block's states that makes B and C equally large, powers of two."""
    owner = np.repeat(np.arange(len(blocks)), blocks)
    drive = np.sqrt(np.bincount(owner, weights=np.sum(B**2, axis=1)))
    seen = np.sqrt(np.bincount(owner, weights=np.sum(C**2, axis=0)))
    both = (drive > 0) & (seen > 0)
    ratio = np.where(both, drive, 1.0) / np.where(both, seen, 1.0)
    return np.repeat(np.exp2(np.round(0.5 * np.log2(ratio))), blocks)


@dataclass(frozen=True, eq=False, repr=False)
class StableSplit(Value):
    """A system as a sum, ``sys = stable + rest``; `parallel` of both is the system again.

    Parameters
    ----------
    stable : StateSpace
        Strictly stable part, with the feedthrough.
    rest : StateSpace
        Part with the rigid-body, marginal and unstable modes, strictly proper.
    separation : float
        Norm of the transformation that separates the two parts; rounding errors grow with it. It is
        0 if A had diagonal blocks, which need no transformation.
    """

    stable: StateSpace
    rest: StateSpace
    separation: float

    def __repr__(self) -> str:
        return (
            f"<StableSplit: {counted(self.stable.n_states, 'stable state')}, "
            f"{counted(self.rest.n_states, 'other')}, "
            f"separation {self.separation:.1e}>"
        )


def split_stable(sys: System) -> StableSplit:
    """Return the additive decomposition into a stable part and the rest.

    If A is block diagonal and no block has poles of both kinds, its blocks are sorted, which is
    exact. Otherwise the ordered Schur form ``[[A1, A12], [0, A2]]`` is used, and the Sylvester
    equation ``A1 X - X A2 + A12 = 0`` removes A12. A pole does not count as stable if its distance
    to the stability limit is below its rounding error (the rounding of A times the condition number
    of the eigenvalue). Poles that are closer to the limit than such a pole do not count as stable
    either.

    Parameters
    ----------
    sys : StateSpace or control.StateSpace
        Continuous or sampled system.

    Returns
    -------
    StableSplit
        Both parts with all channels and their names.

    Raises
    ------
    SolverError
        When the two parts share a pole to working precision.

    Examples
    --------
    >>> import flexplant as fx
    >>> parts = fx.lti.split_stable(fx.lti.tf([1.0], [1.0, 0.0, -1.0]))
    >>> parts.stable.poles().real.round(9), parts.rest.poles().real.round(9)
    (array([-1.]), array([1.]))
    """
    g = as_statespace(sys)
    if not g.n_states:
        return StableSplit(g, g.replace(D=0 * g.D), 0.0)
    found = _by_blocks(g) if is_block_diagonal(g) else None
    if found is not None:
        return found
    poles, error = uncertain_poles(g)
    growth = np.abs(poles) - 1.0 if g.dt else poles.real
    outside = growth >= -error
    edge = float(min(growth[outside].min(), 0.0) - error[outside].max()) if outside.any() else 0.0
    d = state_scale(g.A, g.B, g.C)
    A, B, C = g.A * d / d[:, None], g.B / d[:, None], g.C * d

    def inside(real: float, imag: float) -> bool:
        return bool((np.hypot(real, imag) - 1.0 if g.dt else real) < edge)

    try:
        T, Z, k = la.schur(A, sort=inside)
    except la.LinAlgError as error:  # poles at the limit, which rounding moves across it
        raise _inseparable(g) from error
    if k == g.n_states:
        return StableSplit(g, part_of(g, np.zeros(k, dtype=bool)).replace(D=0 * g.D), 0.0)
    if not k:
        return StableSplit(part_of(g, np.zeros(g.n_states, dtype=bool)), g.replace(D=0 * g.D), 0.0)
    X, scale, info = la.lapack.dtrsyl(T[:k, :k], T[k:, k:], -T[:k, k:], isgn=-1)
    if info or not np.isfinite(X).all():
        raise _inseparable(g)
    X = X / scale
    turned, seen = Z.T @ B, C @ Z
    stable = _part(g, T[:k, :k], turned[:k] - X @ turned[k:], seen[:, :k], g.D)
    rest = _part(g, T[k:, k:], turned[k:], seen[:, :k] @ X + seen[:, k:], 0 * g.D)
    return StableSplit(stable, rest, float(np.linalg.norm(X, 2)))


def _inseparable(g: StateSpace) -> SolverError:
    return SolverError(
        f"{g!r} cannot be split: its stable part and the rest share a pole to working precision. "
        "Add damping, or reduce it in coordinates in which the modes are separated."
    )


def _by_blocks(g: StateSpace) -> StableSplit | None:
    """Return the system with its blocks sorted, or None where one has poles of both kinds."""
    sizes = np.asarray(g.blocks)
    poles = block_eigenvalues(g.A, g.blocks or ())
    owner = np.repeat(np.arange(sizes.size), sizes)
    inside = (np.abs(poles) < 1.0) if g.dt else (poles.real < 0)
    stable = np.bincount(owner, ~inside)[owner] == 0
    if np.any(inside & ~stable):
        return None
    return StableSplit(part_of(g, stable), part_of(g, ~stable).replace(D=0 * g.D), 0.0)


def part_of(g: StateSpace, kept: np.typing.NDArray[np.bool_]) -> StateSpace:
    """Return the system with some states alone, decoupled from the others; whole blocks."""
    blocks = None
    if g.blocks is not None:
        starts = np.cumsum(g.blocks) - g.blocks
        blocks = [b for b, start in zip(g.blocks, starts, strict=True) if kept[start]]
    return g.replace(
        A=g.A[np.ix_(kept, kept)],
        B=g.B[kept],
        C=g.C[:, kept],
        states=[name for name, keep in zip(g.states, kept, strict=True) if keep],
        blocks=blocks,
    )


def _part(g: StateSpace, A: FloatArray, B: FloatArray, C: FloatArray, D: FloatArray) -> StateSpace:
    return g.replace(A=A, B=B, C=C, D=D, states=(), blocks=None)


class Obstacle(NamedTuple):
    """A pole that makes a norm infinite."""

    reason: str
    freq: float  # [Hz]


def obstacle(
    g: StateSpace, *, axis_only: bool = False, known: ComplexArray | None = None
) -> Obstacle | None:
    """Return the worst pole on or beyond the stability limit (or only on it), or None."""
    # rounding moves computed poles: those of a rigid body in dense A have about 1e-4 rad/s with
    # either sign. A pole closer to the limit than its uncertainty (rounding of A times the
    # condition number of the eigenvalue) counts as lying on it. Known eigenvalues are not computed
    # again
    if not g.n_states:
        return None
    poles, error = uncertain_poles(g, known)
    growth = np.abs(poles) - 1.0 if g.dt else poles.real
    on_axis = np.abs(growth) <= error
    beyond = (growth > 0) & ~on_axis & (not axis_only)
    if not (beyond | on_axis).any():
        return None
    worst = int(np.argmax(np.where(beyond if beyond.any() else on_axis, growth, -np.inf)))
    pole, unsure = poles[worst], float(error[worst])
    edge = "the unit circle" if g.dt else "the imaginary axis"
    freq = float(abs(np.angle(pole) / g.dt if g.dt else pole.imag)) / (2 * np.pi)
    if beyond[worst]:
        return Obstacle(
            f"unstable: a pole at {freq:.6g} Hz lies {growth[worst]:.3g}"
            f"{'' if g.dt else ' rad/s'} beyond {edge}",
            freq,
        )
    integrates = abs(pole - 1.0 if g.dt else pole) <= unsure
    kind = "a rigid-body mode or integrator" if integrates else f"an undamped pole at {freq:.6g} Hz"
    rounding = f" (to within its rounding, {unsure:.1g})" if unsure else ""
    return Obstacle(f"marginal: {kind} lies on {edge}{rounding}", 0.0 if integrates else freq)


def uncertain_poles(
    g: StateSpace, known: ComplexArray | None = None
) -> tuple[ComplexArray, FloatArray]:
    """Return the poles and the uncertainty of each by rounding."""
    poles = g.poles() if known is None else known
    if g.blocks is not None and max(g.blocks) <= 2:
        return poles, np.zeros(poles.size)  # closed form: as exact as A
    d = state_scale(g.A, g.B, g.C)
    A = g.A * d / d[:, None]
    gap = np.abs(np.abs(poles) - 1.0 if g.dt else poles.real)
    size = float(np.linalg.norm(A))  # at least the norm, which costs more
    if np.any(gap <= SPLIT * size):
        size = float(np.linalg.norm(A, 2))
    error = np.finfo(float).eps * size * np.ones(poles.size)
    if not np.any(gap <= SPLIT * size):
        return poles, error
    poles, _, error = eigenvalues_with_error(A)
    return poles, error


def eigenvalues_with_error(
    A: FloatArray, largest: float = 1.0 / ROOT
) -> tuple[ComplexArray, ComplexArray, FloatArray]:
    """Return eigenvalues, eigenvectors and the uncertainty of each eigenvalue by rounding."""
    # in the units of LAPACK's balancing, in which blocks of different speed do not affect each
    # other
    found: Any = la.eig(A, left=True, right=True)
    values, left, right = found
    d = even_scale(A)[:, None]
    size = np.linalg.norm(left * d, axis=0) * np.linalg.norm(right / d, axis=0)
    condition = size / np.maximum(np.abs(np.sum(left.conj() * right, axis=0)), size / largest)
    rounding = ROUNDINGS * np.finfo(float).eps * float(np.linalg.norm(A * d.T / d, 2))
    return (
        np.asarray(values, dtype=np.complex128),
        right.astype(np.complex128),
        rounding * condition,
    )

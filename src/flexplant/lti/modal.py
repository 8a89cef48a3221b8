"""The modal block form of any system: real 2 x 2 blocks where its eigenvectors allow them."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import scipy.linalg as la

from ..errors import counted
from ..values import ComplexArray, FloatArray, Value, positive
from .joining import is_block_diagonal
from .scaling import state_scale
from .stability import eigenvalues_with_error
from .statespace import StateSpace, System, as_statespace

#: speed of a rigid-body pair, relative to A, below which there is none
RIGID = 1e-6
#: largest accepted distance of the transformed A from the blocks, relative to A
RESIDUAL = 1e-9


@dataclass(frozen=True, eq=False, repr=False)
class ModalForm(Value):
    """A system in modal blocks, or as it came when its eigenvectors do not allow them.

    Parameters
    ----------
    system : StateSpace
        With 1 x 1 and 2 x 2 blocks; the system as given when `reason` is not empty.
    transformation : (n, n) array
        ``x = T x_modal``; the identity when `reason` is not empty.
    condition : float
        Of the eigenvectors, states balanced: what rounding is multiplied with.
    residual : float
        Norm of what the blocks leave out of ``T^-1 A T``, relative to A, states balanced.
    reason : str
        Why the dense form was kept; empty when the blocks were found.

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
    """Return a system with A in real blocks: [[s, w], [-w, s]] per pair, [p] per real pole.

    Rigid-body modes (pairs of poles at 0, defective) become integrator pairs [[0, w], [0, 0]],
    exactly at 0 (at 1 when sampled). States are balanced between input and output. Responses,
    Gramians and sampling then cost O(n) per mode.

    Parameters
    ----------
    sys : StateSpace or control.StateSpace
        Any; a system that has 2 x 2 and 1 x 1 blocks on its diagonal alone comes back as it is.
    largest_condition : float
        Of the eigenvectors; above it the system is kept as given, and `reason` says so.

    Returns
    -------
    ModalForm

    Raises
    ------
    ModelError
        When `sys` is no system or largest_condition not positive.

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
    V, pairs, blocks = _basis(A, 1.0 if g.dt else 0.0)
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
    if residual > RESIDUAL:
        reason = f"dense form kept: the blocks leave {residual:.1e} of A out"
        return ModalForm(g, np.eye(n), condition, residual, reason)
    B = np.asarray(np.linalg.solve(V, g.B / d[:, None]), dtype=np.float64)
    C = np.asarray((g.C * d) @ V, dtype=np.float64)
    scale = _even(B, C, blocks)
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
    # a slow mode is no rigid-body one, however fast the others: rounding says which may be
    values, vectors, error = eigenvalues_with_error(A)
    near = np.abs(values - centre) <= error
    columns, parts = [np.zeros((A.shape[0], 0))], []
    chain = _chains(A - centre * eye, int(near.sum())) if near.sum() > 1 else None
    if chain is not None:
        columns.append(chain[0])
        parts += [centre * np.eye(2) + np.array([[0.0, w], [0.0, 0.0]]) for w in chain[1]]
    else:
        near[:] = False
    for k in np.lexsort((values.imag, np.abs(values - centre))):
        pole, vector = values[k], vectors[:, k]
        if near[k] or pole.imag < 0:
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


def _chains(N: FloatArray, count: int) -> tuple[FloatArray, FloatArray] | None:
    """Return (n, count) pairs with ``N v = w u, N u = 0``: rigid-body modes, or None.

    The invariant subspace of the poles at the centre is that of the smallest singular values of
    N^2, where N is a square of zero.
    """
    if count % 2:
        return None
    space = la.svd(N @ N)[2][-count:].T
    inner = space.T @ N @ space
    left, speed, right = la.svd(inner)
    half = count // 2
    size = np.linalg.norm(N)
    if speed[half - 1] < RIGID * size or np.max(speed[half:]) > RIGID * size:
        return None  # simple poles at the centre, or chains of another length
    pairs = np.empty((N.shape[0], count))
    pairs[:, 0::2] = space @ left[:, :half]
    pairs[:, 1::2] = space @ right[:half].T
    return pairs, speed[:half]


def _even(B: FloatArray, C: FloatArray, blocks: list[int]) -> FloatArray:
    """Return the size of each block's states that makes B and C equally large, powers of two."""
    owner = np.repeat(np.arange(len(blocks)), blocks)
    drive = np.sqrt(np.bincount(owner, weights=np.sum(B**2, axis=1)))
    seen = np.sqrt(np.bincount(owner, weights=np.sum(C**2, axis=0)))
    both = (drive > 0) & (seen > 0)
    ratio = np.where(both, drive, 1.0) / np.where(both, seen, 1.0)
    return np.repeat(np.exp2(np.round(0.5 * np.log2(ratio))), blocks)

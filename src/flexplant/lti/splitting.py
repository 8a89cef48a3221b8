"""A system as the sum of its stable part and the rest (rigid-body and unstable modes)."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import scipy.linalg as la

from ..errors import SolverError, counted
from ..values import FloatArray, Value
from .joining import block_eigenvalues, is_block_diagonal
from .scaling import state_scale
from .stability import uncertain_poles
from .statespace import (
    StateSpace,
    System,
    as_statespace,
)


@dataclass(frozen=True, eq=False, repr=False)
class Split(Value):
    """``sys = stable + rest``: add the two (`parallel`) to have the system back.

    Parameters
    ----------
    stable : StateSpace
        Strictly stable, with the feedthrough.
    rest : StateSpace
        Rigid-body, marginal and unstable modes, strictly proper.
    separation : float
        Norm of the decoupling transformation: how much rounding grows; 0 when A had blocks.

    Examples
    --------
    >>> import flexplant as fx
    >>> sys = fx.lti.tf([1.0], [1.0, 0.0, -1.0])
    >>> parts = fx.lti.split_stable(sys)
    >>> whole = fx.lti.parallel(parts.stable, parts.rest)
    >>> bool(abs(whole(2j) - sys(2j)) < 1e-12)
    True
    """

    stable: StateSpace
    rest: StateSpace
    separation: float

    def __repr__(self) -> str:
        return (
            f"<Split: {counted(self.stable.n_states, 'stable state')}, "
            f"{counted(self.rest.n_states, 'other')}, "
            f"separation {self.separation:.1e}>"
        )


def split_stable(sys: System) -> Split:
    """Return the additive decomposition into a stable part and the rest.

    Where A is block diagonal and no block has poles of both kinds, its blocks are sorted, exactly.
    Otherwise by ordered Schur form ``[[A1, A12], [0, A2]]`` and the Sylvester equation
    ``A1 X - X A2 + A12 = 0`` that removes A12; a pole nearer to the edge of stability than its
    rounding (of A, times the condition of the eigenvalue) is not called stable, nor is any that
    lies nearer than such a pole.

    Parameters
    ----------
    sys : StateSpace or control.StateSpace
        Continuous or sampled.

    Returns
    -------
    Split
        Both parts with all channels and their names.

    Raises
    ------
    ModelError
        When `sys` is no system.
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
        return Split(g, g.replace(D=0 * g.D), 0.0)
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

    T, Z, k = la.schur(A, sort=inside)
    if k == g.n_states:
        return Split(g, part_of(g, np.zeros(k, dtype=bool)).replace(D=0 * g.D), 0.0)
    if not k:
        return Split(part_of(g, np.zeros(g.n_states, dtype=bool)), g.replace(D=0 * g.D), 0.0)
    X, scale, info = la.lapack.dtrsyl(T[:k, :k], T[k:, k:], -T[:k, k:], isgn=-1)
    if info or not np.isfinite(X).all():
        raise SolverError(
            f"{g!r} cannot be split: its stable part and the rest share a pole to working "
            "precision. Add damping, or reduce it in coordinates where the modes are apart."
        )
    X = X / scale
    turned, seen = Z.T @ B, C @ Z
    stable = _part(g, T[:k, :k], turned[:k] - X @ turned[k:], seen[:, :k], g.D)
    rest = _part(g, T[k:, k:], turned[k:], seen[:, :k] @ X + seen[:, k:], 0 * g.D)
    return Split(stable, rest, float(np.linalg.norm(X, 2)))


def _by_blocks(g: StateSpace) -> Split | None:
    """Return the system with its blocks sorted, or None where one has poles of both kinds."""
    sizes = np.asarray(g.blocks)
    poles = block_eigenvalues(g.A, g.blocks or ())
    owner = np.repeat(np.arange(sizes.size), sizes)
    inside = (np.abs(poles) < 1.0) if g.dt else (poles.real < 0)
    stable = np.bincount(owner, ~inside)[owner] == 0
    if np.any(inside & ~stable):
        return None
    return Split(part_of(g, stable), part_of(g, ~stable).replace(D=0 * g.D), 0.0)


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

"""Responses of a full structure and of its reduced model at chosen frequencies, and statically."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, Protocol, Self

import numpy as np
import scipy.linalg as la
import scipy.sparse as sp

from ..labels import DofSet
from ..modes.attachment_vectors import static_response
from ..modes.modes import Modes
from ..sparse.factor import dense, dynamic_lu
from ..structure import FEModel
from ..values import ComplexArray, FloatArray, Matrix
from .bounds import ErrorBound

#: up to this many DOFs responses are solved densely, at many frequencies
SMALL = 600
#: check frequencies beside the resonances, of small and of large models
_GRID = (60, 6)
#: resonances checked, of small and of large models
_RESONANCES = (200, 6)


@dataclass(frozen=True, eq=False, repr=False, match_args=False)
class Reduced(Protocol):
    """What a comparison reads of a `ReducedModel`, which offers it as its `quality`."""

    M: FloatArray
    D: FloatArray
    K: FloatArray
    T: FloatArray
    full_dofs: DofSet
    rigid_body: FloatArray
    condition: float
    bound: ErrorBound | None

    @property
    def is_physical(self) -> bool:
        """Whether all coordinates are DOFs of the structure."""

    def modes(self) -> Modes:
        """Return all modes."""

    def replace(self, **changes: Any) -> Self:
        """Return a copy with some fields changed."""


def check_frequencies(low: float, high: float, resonances: FloatArray, small: bool) -> FloatArray:
    """Return frequencies [Hz] over a band and at resonances in it, fewer for a large model."""
    which = 0 if small else 1
    start = low if low > 0 else high / 1000
    grid = np.geomspace(start, high, _GRID[which])
    few = resonances
    if few.size > _RESONANCES[which]:
        few = few[np.linspace(0, few.size - 1, _RESONANCES[which]).astype(int)]
    return np.concatenate([grid, few])


def full_response(
    full: FEModel | Modes, modes: Modes, freq: FloatArray, B: FloatArray, C: FloatArray, loss: float
) -> tuple[ComplexArray, str]:
    """Return responses (f, p, q) of the full structure, and how they were found."""
    found = np.zeros((freq.size, C.shape[0], B.shape[1]), dtype=np.complex128)
    if not B.shape[1]:
        return found, "no response: no inputs were named"
    if isinstance(full, Modes):
        return _modal_response(full, freq, B, C), "the sum over the given modes"
    M, K, D = full.M, full.K, full.D
    many = len(full.dofs) > SMALL and sp.issparse(K) and sp.issparse(M)
    for i, f in enumerate(freq):
        omega = 2 * np.pi * float(f)
        stiffness: Any = K * (1 + 1j * loss) if D is None else K + 1j * omega * _as_like(D, K)
        found[i] = C @ _solved(stiffness - omega**2 * M, B, many)
    kind = "sparse" if many else "dense"
    how = "its D" if D is not None else f"loss factor {loss:.3g} in both"
    return found, f"{kind} solutions at {freq.size} frequencies, {how}"


def _as_like(D: Matrix, K: Matrix) -> Any:
    return D if sp.issparse(K) == sp.issparse(D) else (dense(D) if not sp.issparse(K) else D)


def _solved(matrix: Any, B: FloatArray, many: bool) -> ComplexArray:
    is_sparse = sp.issparse(matrix)
    if many and is_sparse:
        lu = dynamic_lu(matrix)
        loads = B.astype(np.complex128)
        solved = lu.solve(loads)
        return np.asarray(solved + lu.solve(loads - matrix @ solved))
    full = matrix.toarray() if is_sparse else np.asarray(matrix)
    size = 1.0 / np.sqrt(np.abs(np.diag(full)))
    scaled = full * size[:, None] * size
    return np.asarray(la.solve(scaled, B * size[:, None]) * size[:, None], dtype=np.complex128)


def _modal_response(modes: Modes, freq: FloatArray, B: FloatArray, C: FloatArray) -> ComplexArray:
    s = 2j * np.pi * freq[:, None]
    if np.iscomplexobj(modes.phi):
        r = modes.n_rigid
        poles = np.asarray(modes.poles)
        phi = np.asarray(modes.phi)
        swing = np.where(poles.imag > 0, poles.imag, 1.0)
        one = np.where(np.arange(poles.size) < r, 1 / s**2, 1 / (2j * swing * (s - poles)))
        two = np.where(np.arange(poles.size) < r, 0.0, 1 / (-2j * swing * (s - poles.conj())))
        total = np.einsum("pk,fk,kq->fpq", C @ phi, one, phi.T @ B)
        total = total + np.einsum("pk,fk,kq->fpq", C @ phi.conj(), two, phi.conj().T @ B)
        return np.asarray(total, dtype=np.complex128)
    omega, zeta = modes.basis_omega, modes.basis_zeta
    gain = 1.0 / (omega**2 + 2 * zeta * omega * s + s**2)
    basis = np.real(modes.basis)
    return np.asarray(np.einsum("pk,fk,kq->fpq", C @ basis, gain, basis.T @ B))


def reduced_response(
    reduced: Reduced, freq: FloatArray, B: FloatArray, C: FloatArray, loss: float | None
) -> ComplexArray:
    """Return responses (f, p, q) of the reduced model: with a loss factor, or its own D."""
    omega = 2 * np.pi * freq[:, None, None]
    if not B.shape[1]:
        return np.zeros((freq.size, C.shape[0], 0), dtype=np.complex128)
    stiffness: Any = reduced.K * (1 + 1j * loss) if loss is not None else reduced.K
    damping = 0.0 if loss is not None else 1j * omega * reduced.D
    size = 1.0 / np.sqrt(np.abs(np.diag(reduced.K)) + np.abs(np.diag(reduced.M)))
    matrix = (stiffness + damping - omega**2 * reduced.M) * size[:, None] * size
    return np.asarray((C * size) @ np.linalg.solve(matrix, (B * size[:, None])[None]))


def static_error(
    full: FEModel | Modes,
    modes: Modes,
    reduced: Reduced,
    B: FloatArray,
    C: FloatArray,
    Br: FloatArray,
    Cr: FloatArray,
) -> FloatArray:
    """Return errors (p, q) of the elastic compliance, of the size of its channels."""
    p, q = C.shape[0], B.shape[1]
    if not q:
        return np.zeros((p, q))
    loads, watched = np.hstack([B, C.T]), np.hstack([Br, Cr.T])
    if isinstance(full, FEModel):
        whole_set = loads.T @ static_response(full.M, full.K, full.rigid_body, loads)
    else:
        if np.iscomplexobj(full.phi):
            return np.full((p, q), np.nan)
        r = modes.n_rigid
        motion = (loads.T @ np.real(full.basis))[:, r:] / full.basis_omega[r:]
        whole_set = motion @ motion.T
    found = watched.T @ static_response(reduced.M, reduced.K, reduced.rigid_body, watched)
    size = np.sqrt(np.abs(np.diag(whole_set)))
    return np.asarray(np.abs(found - whole_set)[q:, :q] / np.outer(size[q:], size[:q]))

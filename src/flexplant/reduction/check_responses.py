"""Responses of a full structure and of its reduced model at chosen frequencies, and statically."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any, Protocol, Self, TypeAlias

import numpy as np

from ..labels import DofSet
from ..modes.attachment_vectors import static_response
from ..modes.direct_check import DirectCheck, antiresonances, checked_response
from ..modes.dynamic_basis import DynamicBasis
from ..modes.modes import Modes
from ..structure import FEModel, Hysteretic
from ..values import ComplexArray, FloatArray
from .bounds import ErrorBound

#: points over the band, beside resonances and antiresonances
_GRID = 200
#: direct solutions that check the responses of a small and of a large structure
_CHECKS, _SMALL = (6, 3), 2000
#: their difference, of the peak, from which on they join the basis
_TOLERANCE = 1e-4


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


#: gives the responses (f, p, q) at frequencies [Hz]
Find: TypeAlias = Callable[[FloatArray], ComplexArray]


class FullResponses:
    """The responses of a full structure, wherever they are wanted."""

    def __init__(
        self,
        full: FEModel | Modes,
        modes: Modes,
        B: FloatArray,
        C: FloatArray,
        loss: float | None,
    ) -> None:
        self.full, self.B, self.C, self.loss = full, B, C, loss
        self.basis: DynamicBasis | None = None
        if isinstance(full, FEModel):
            law = None if loss is None else Hysteretic(loss)
            self.basis = DynamicBasis(full, modes, np.hstack([B, C.T]), law)
        self.check: DirectCheck | None = None

    def at(self, freq: FloatArray) -> ComplexArray:
        """Return the responses (f, p, q)."""
        if not self.B.shape[1]:
            return np.zeros((freq.size, self.C.shape[0], 0), dtype=np.complex128)
        if self.basis is not None:
            return self.basis.response(freq, self.C, self.B)
        assert isinstance(self.full, Modes)  # noqa: S101 - it is no FEModel
        return _modal_response(self.full, freq, self.B, self.C, self.loss or 0.0)

    def checked(self, freq: FloatArray) -> None:
        """Compare the responses in a band with direct solutions, which mend the basis."""
        if self.basis is not None and self.B.shape[1]:
            self.basis, _, self.check = checked_response(
                self.basis,
                freq,
                self.C,
                self.B,
                checks=_CHECKS[self.full.dofs.xyz.shape[0] > _SMALL],
                tolerance=_TOLERANCE,
            )

    def static(self) -> FloatArray:
        """Return the elastic compliance (p + q, p + q) of [inputs, outputs]; NaN if not known."""
        loads = np.hstack([self.B, self.C.T])
        if self.basis is not None:
            return self.basis.compliance(loads.T, loads)
        assert isinstance(self.full, Modes)  # noqa: S101 - it is no FEModel
        if np.iscomplexobj(self.full.phi):
            return np.full((loads.shape[1],) * 2, np.nan)
        r = self.full.n_rigid
        motion = (loads.T @ np.real(self.full.basis))[:, r:] / self.full.basis_omega[r:]
        return np.asarray(motion @ motion.T)

    def __str__(self) -> str:
        how = "its D" if self.loss is None else f"loss factor {self.loss:.3g} in both"
        if self.basis is None:
            return "the sum over the given modes" + (f", {how}" if self.loss is not None else "")
        check = f"; {self.check}" if self.check is not None else ""
        return f"{self.basis.n_modes} modes and {self.basis.n_shapes} static shapes, {how}{check}"


def check_frequencies(
    low: float, high: float, both: Sequence[tuple[Find, FloatArray]]
) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Return frequencies [Hz] over a band, and of these the resonances and antiresonances."""
    start = low if low > 0 else high / 1000
    resonances = np.concatenate([own for _, own in both])
    resonances = resonances[(resonances >= low) & (resonances <= high)]
    deep = np.concatenate([antiresonances(find, own, low, high) for find, own in both])
    return np.concatenate([np.geomspace(start, high, _GRID), resonances, deep]), resonances, deep


def _modal_response(
    modes: Modes, freq: FloatArray, B: FloatArray, C: FloatArray, loss: float
) -> ComplexArray:
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
    gain = 1.0 / (modes.basis_squares * (1 + 1j * loss) + modes.basis_rates * s + s**2)
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


def static_error(whole: FloatArray, reduced: Reduced, Br: FloatArray, Cr: FloatArray) -> FloatArray:
    """Return errors (p, q) of the elastic compliance `whole`, of the size of its channels."""
    q = Br.shape[1]
    watched = np.hstack([Br, Cr.T])
    found = watched.T @ static_response(reduced.M, reduced.K, reduced.rigid_body, watched)
    size = np.sqrt(np.abs(np.diag(whole)))
    return np.asarray(np.abs(found - whole)[q:, :q] / np.outer(size[q:], size[:q]))

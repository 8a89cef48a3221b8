"""Component modes: static shapes of a boundary with fixed-interface or free modes."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass, field
from typing import ClassVar

import numpy as np
import scipy.linalg as la

from ..checks import FloatArray, checked, positive, whole
from ..errors import ModelError, counted
from ..modes.modes import Modes
from ..modes.solve import solve_modes
from ..sparse.factor import dense, unit_diagonal
from ..structure import Damping, FEModel, ModalDamping
from ..tolerances import RANK, TINY
from .condensation import DofPartition
from .methods import (
    ReductionMethod,
    block,
    fe_model,
    inner,
    labels_given,
    projected_model,
)
from .reduced import ReducedModel


@dataclass(frozen=True, eq=False, repr=False)
class CraigBampton(ReductionMethod):
    """Static shapes of the boundary and modes of the interior with the boundary held.

    ``T = [I 0; -Kii^-1 Kib  phi_i]``: coordinates are the boundary DOFs, then one per
    fixed-interface mode ("fixed mode 1", ...). Every frequency is at or above the true one
    (Rayleigh-Ritz) and none rises when modes are added; rigid-body motions are exact.

    Parameters
    ----------
    boundary : sequence of str, DofSet or DofSelection
        DOFs that stay, where loads and other structures attach; held, they stop all rigid-body
        motion.
    modes : int
        Number of fixed-interface modes; 0 is static condensation.
    below : float [Hz], optional
        In place of `modes`: all fixed-interface modes up to this frequency.
    damping : ModalDamping or Rayleigh, optional
        Of the reduced model's own modes; None: ``T^T D T``.

    References
    ----------
    [CraigBampton1968]_.

    Examples
    --------
    >>> import flexplant as fx
    >>> model = fx.chain(masses=[1.0, 1.0, 1.0], stiffnesses=[4e5, 4e5])
    >>> fx.reduce(model, fx.CraigBampton(["1:x", "3:x"], modes=1)).modes().freq.round(2)
    array([  0.  , 100.66, 174.35])
    """

    boundary: Iterable[str] = field(metadata=checked(labels_given, name="boundary DOFs"))
    modes: int = field(default=0, metadata=checked(whole, minimum=0))
    below: float | None = field(default=None, kw_only=True, metadata=checked(positive, unit="Hz"))

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.below is not None and self.modes:
            raise ModelError("give the number of fixed-interface modes or below=, not both.")

    def reduced(self, structure: FEModel | Modes) -> ReducedModel:
        """Return the reduced model; `reduce` is the public way."""
        model, labels = fe_model(structure, self), tuple(self.boundary)
        part = DofPartition(model, labels)
        T, count = part.static, 0
        if self.modes or self.below is not None:
            fixed = self._fixed(model, part)
            count = fixed.shape[1]
            T = np.hstack([T, part.whole(np.zeros((len(labels), count)), fixed)])
        names = [*labels, *(f"fixed mode {i}" for i in range(1, count + 1))]
        return projected_model(
            model,
            T,
            dofs=model.dofs.select(labels),
            coordinates=names,
            method=f"{counted(count, 'fixed-interface mode')} (Craig-Bampton)",
            damping=self.damping,
            static_at=labels,
        )

    def _fixed(self, model: FEModel, part: DofPartition) -> FloatArray:
        rows = part.others
        if self.modes > rows.size:
            raise ModelError(
                f"{counted(self.modes, 'fixed-interface mode')} of an interior of {rows.size} "
                "DOFs: choose fewer."
            )
        interior = FEModel(
            block(model.M, rows, rows),
            part.stiffness,
            dofs=model.dofs.select([model.dofs.labels[i] for i in rows]),
        )
        found = solve_modes(interior, count=self.modes or None, below=self.below)
        return np.real(found.phi)


@dataclass(frozen=True, eq=False, repr=False)
class _FreeInterface(ReductionMethod):
    """Free modes of the whole structure and its residual flexibility at the boundary."""

    boundary: Iterable[str] = field(metadata=checked(labels_given, name="boundary DOFs"))
    modes: int = field(metadata=checked(whole))
    #: whether the residual flexibility has no inertia, and what it is called
    _massless: ClassVar[bool]
    _kind: ClassVar[str]

    def reduced(self, structure: FEModel | Modes) -> ReducedModel:
        """Return the reduced model; `reduce` is the public way."""
        labels = tuple(self.boundary)
        method = f"{counted(self.modes, 'free mode')} and {self._kind} ({type(self).__name__})"
        parts = self._parts(fe_model(structure, self), labels)
        return _built(*parts, labels, self.damping, massless=self._massless, method=method)

    def _parts(
        self, model: FEModel, labels: tuple[str, ...]
    ) -> tuple[FEModel, Modes, FloatArray, FloatArray]:
        """Return the model, its modes with vectors, T, and the map from (u_b, p) to (p, g)."""
        b = len(labels)
        modes = solve_modes(
            model, damping=ModalDamping(0.0), count=self.modes, compliance_at=list(labels)
        )
        rows = model.dofs.indices(labels)
        phi, vectors = np.real(modes.phi), modes.vectors
        at = vectors[rows]
        scaled, _ = unit_diagonal(at @ at.T)
        values = la.eigvalsh(dense(scaled))
        if not values[0] > RANK * values[-1]:
            raise ModelError(
                "the residual flexibility of the boundary is singular (condition "
                f"{values[-1] / max(float(values[0]), TINY):.3g}): some of its DOFs move "
                "together. Leave one of them out, or keep fewer modes."
            )
        # u_b = phi_b p + V_b g
        inverse = la.inv(at)
        k = phi.shape[1]
        back = np.block([[np.zeros((k, b)), np.eye(k)], [inverse, -inverse @ phi[rows]]])
        T = np.hstack([phi, vectors]) @ back
        T[rows] = np.eye(b, b + k)
        return model, modes, T, back


def _built(
    model: FEModel,
    modes: Modes,
    T: FloatArray,
    back: FloatArray,
    labels: tuple[str, ...],
    damping: Damping | None,
    *,
    massless: bool,
    method: str,
) -> ReducedModel:
    k, r = modes.n_modes, modes.n_rigid
    light = np.concatenate([np.ones(k), np.full(modes.n_vectors, 0.0 if massless else 1.0)])
    M = (back.T * light) @ back
    K = (back.T * modes.basis_omega**2) @ back
    if damping is not None:
        count = k if massless else light.size
        shapes, omega = np.real(modes.basis)[:, :count], modes.basis_omega[:count]
        zeta = damping.ratios(omega, shapes, model.K, model.dofs)
        rate = np.zeros(light.size)
        rate[: zeta.size] = 2 * zeta * modes.basis_omega[: zeta.size]
        D = (back.T * rate) @ back
    elif model.D is None:
        D = np.zeros_like(M)
    else:
        D = inner(model.D, np.real(modes.basis)) * np.outer(light, light)
        D = back.T @ D @ back
    rigid = np.zeros((light.size, r))
    b = len(labels)
    rows = model.dofs.indices(labels)
    rigid[:b], rigid[b : b + r] = np.real(modes.phi)[rows, :r], np.eye(r)
    if massless:
        # exactly: zeros say which coordinates have no mass
        for matrix in (M, D):
            matrix[:b], matrix[:, :b] = 0.0, 0.0
    values = la.eigvalsh(dense(unit_diagonal(M[b:, b:] if massless else M)[0]))
    return ReducedModel(
        M=0.5 * (M + M.T),
        D=0.5 * (D + D.T),
        K=0.5 * (K + K.T),
        T=T,
        dofs=model.dofs.select(labels),
        full_dofs=model.dofs,
        rigid_body=rigid,
        method=method,
        condition=float(values[-1] / values[0]),
        condition_of="M*",
        coordinates=(*labels, *(f"mode {i}" for i in range(1, k + 1))),
        static_at=labels,
    )


@dataclass(frozen=True, eq=False, repr=False)
class Rubin(_FreeInterface):
    """Free modes and the residual flexibility of the boundary, with its inertia.

    The span is that of the modes and their residual attachment vectors; coordinates are the
    boundary DOFs, then the modal ones ("mode 1", ...). The modes are exact, the response to loads
    on the boundary is so up to order omega^2, and all other frequencies are above the true ones. A
    free structure's flexibility is that of loads in balance with its inertia (inertia relief).

    Parameters
    ----------
    boundary : sequence of str, DofSet or DofSelection
        DOFs that stay, where loads and other structures attach.
    modes : int
        Number of free modes, rigid-body modes included.
    damping : ModalDamping or Rayleigh, optional
        Of modes and attachment vectors; None: ``T^T D T``.

    References
    ----------
    [Rubin1975]_.

    Examples
    --------
    >>> import flexplant as fx
    >>> model = fx.chain(masses=[1.0, 1.0, 1.0, 1.0], stiffnesses=[4e5, 4e5, 4e5])
    >>> fx.reduce(model, fx.Rubin(["1:x"], modes=2)).modes().freq[:2].round(2)
    array([ 0.  , 77.04])
    """

    _massless = False
    _kind = "residual flexibility"


@dataclass(frozen=True, eq=False, repr=False)
class MacNeal(_FreeInterface):
    """Free modes and the residual flexibility of the boundary, without inertia.

    As `Rubin`, but what lies beyond the modes answers at once: the boundary coordinates have no
    mass (rows of M* are zero), and its poles are those of the modes alone. Exact at 0 Hz for loads
    on the boundary. A plant takes it with a feedthrough; coupling and updating give the boundary
    mass.

    Parameters
    ----------
    boundary, modes
        As for `Rubin`.
    damping : ModalDamping or Rayleigh, optional
        Of the modes; None: their part of D.

    References
    ----------
    [MacNeal1971]_.

    Examples
    --------
    >>> import flexplant as fx
    >>> model = fx.chain(masses=[1.0, 1.0, 1.0, 1.0], stiffnesses=[4e5, 4e5, 4e5])
    >>> fx.reduce(model, fx.MacNeal(["1:x"], modes=2)).modes().freq[:2].round(2)
    array([ 0.  , 77.04])
    """

    _massless = True
    _kind = "static residual flexibility"

"""Modal truncation: the lowest modes, or the most important for channels, with a true bound."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np
import scipy.linalg as la

from ..arrays import FloatArray, whole
from ..errors import ModelError, counted
from ..labels import Place
from ..modes.modes import Modes, require_real
from ..modes.solve import attachment_vectors, labels_of, places, solve_modes, static_response
from ..sparse.symmetric import projected
from ..store import checked
from ..structure import FEModel, ModalDamping
from ..tolerances import SAME
from .condensation import kept_columns, mode_numbers
from .methods import ReductionMethod
from .ranking import ErrorBound, modal_channels, peak_gains, rank_modes
from .reduced import STATIC, ReducedModel

_SUM = "sum of the peaks of the neglected modes"
_RESIDUE = "residual flexibility over twice the damping (Cauchy-Schwarz)"


@dataclass(frozen=True, eq=False, repr=False)
class ModalTruncation(ReductionMethod):
    """The lowest or chosen modes (equation (5) of [paper]_), with or without static correction.

    The coordinates of the modes are named "mode 1", "mode 2" and so on. With `static_at`, residual
    attachment vectors (see `Modes`) keep the static compliance of the truncated modes at these
    places. Their coordinates are named "static 1", "static 2" and so on.

    Parameters
    ----------
    count : int, optional
        Number of modes, rigid-body modes included.
    modes : sequence of int, optional
        Numbers of the kept modes, counted from 1, in place of `count`. They must include all
        rigid-body modes.
    static_at : place or sequence of places
        Places where the static compliance is kept.
    inputs, outputs : place or sequence of places
        Places of forces and displacements for the error bound. Without `outputs`, the displacements
        are taken at the inputs.
    damping : ModalDamping or Rayleigh, optional
        Damping of modes and vectors in place of the model's D. Only for an FEModel.

    Notes
    -----
    If the structure is given as `Modes`, the bound is the sum of the peaks of all truncated modes
    and attachment vectors. A peak is ``||c|| ||b|| / (2 zeta sqrt(1 - zeta^2) omega^2)``, with the
    displacements b of the mode at the inputs and c at the outputs. This bound covers the solved
    modes only (`ErrorBound.covers`).

    For an FEModel with one damping ratio for all modes, the bound covers all modes of the
    structure, including modes that were not solved. By the Cauchy-Schwarz inequality the sum is at
    most ``sqrt(tr(C G C') tr(B' G B)) / (2 zeta sqrt(1 - zeta^2))``. The columns of B are unit
    forces at the inputs, and the rows of C give the displacements at the outputs. G is the residual
    flexibility of the truncated modes, from a static solution. With `static_at`, the peaks of the
    attachment vectors are added.

    `ErrorBound.below` gives a bound for the frequencies up to a limit. Modes above the limit are
    far from their peaks there, so that this bound is often smaller by orders of magnitude.

    Examples
    --------
    The first two modes of a chain of three masses are kept:

    >>> import flexplant as fx
    >>> model = fx.chain(masses=[1.0, 1.0, 1.0], stiffnesses=[4e5, 4e5])
    >>> fx.reduce(model, fx.reduction.ModalTruncation(2)).modes().freq.round(2)
    array([  0.  , 100.66])
    """

    count: int | None = field(default=None, metadata=checked(whole))
    modes: Iterable[int] | None = field(default=None, kw_only=True, metadata=checked(mode_numbers))
    static_at: Place | Iterable[Place] = field(default=(), kw_only=True, metadata=checked(places))
    inputs: Place | Iterable[Place] = field(default=(), kw_only=True, metadata=checked(places))
    outputs: Place | Iterable[Place] = field(default=(), kw_only=True, metadata=checked(places))

    def __post_init__(self) -> None:
        super().__post_init__()
        if (self.count is None) == (self.modes is None):
            raise ModelError(
                "ModalTruncation needs count= (the lowest modes) or modes=, not both. Give one of "
                "them."
            )

    @property
    def _numbers(self) -> tuple[int, ...]:
        if self.modes is not None:
            return tuple(self.modes)
        return tuple(range(1, int(self.count or 0) + 1))

    def reduced(self, structure: FEModel | Modes) -> ReducedModel:
        """Return the truncated model. Call `reduce` instead of this method."""
        numbers, model = self._numbers, structure
        static: Any = self.static_at
        if isinstance(model, Modes):
            if self.damping is not None:
                raise ModelError(
                    "these Modes have their damping: give damping= to solve_modes, or an FEModel."
                )
            bound_of = (self.inputs, self.outputs) if self.inputs else None
            return truncated(model, numbers, static, bound_of, "modal truncation")
        solved = solve_modes(model, damping=ModalDamping(0.0), count=max(numbers))
        law = self.damping
        if law is not None:
            solved = solved.replace(zeta=law.zeta(solved.omega))
        kept = solved.select(kept_columns(numbers, solved))
        if static:
            vectors, omega = attachment_vectors(model, np.real(kept.phi), static)
            zeta = 0.0 * omega if law is None else law.zeta(omega)
            kept = kept.replace(
                vectors=vectors,
                vector_omega=omega,
                vector_zeta=zeta,
                vector_dofs=labels_of(static, model.dofs),
            )
        bound = self._bound(model, kept) if self.inputs else None
        found = _modal_model(kept, numbers, "modal truncation", bound)
        if law is None and model.D is not None:
            found = found.replace(D=projected(model.D, found.T))
        return found

    def _bound(self, model: FEModel, kept: Modes) -> ErrorBound | None:
        law = self.damping
        into, out, force, seen = modal_channels(kept, self.inputs, self.outputs)
        if not isinstance(law, ModalDamping) or not isinstance(law.ratio, float) or not law.ratio:
            return None
        B = np.column_stack([model.dofs.row(place) for place in places(self.inputs)])
        watched = places(self.outputs) or places(self.inputs)
        C = np.array([model.dofs.row(place) for place in watched])
        flexible = static_response(model, np.hstack([B, C.T]))
        r, q = kept.n_rigid, B.shape[1]
        square = kept.omega[r:, None] ** 2
        left = np.sum(B * flexible[:, :q]) - np.sum(force[r:] ** 2 / square)
        right = np.sum(C.T * flexible[:, q:]) - np.sum(seen[:, r:].T ** 2 / square)
        both = float(np.sqrt(max(float(left), 0.0) * max(float(right), 0.0)))
        value = both * float(peak_gains(np.ones(1), np.array([law.ratio]))[0])
        vectors, _ = _channel_terms(_vectors_as_modes(kept), (self.inputs, self.outputs))
        value += _peaks(vectors)
        # with the lowest modes kept, every unsolved mode lies above the last solved one
        lowest = self._numbers == tuple(range(1, kept.n_modes + 1))
        omega = kept.omega[-1] if lowest else 0.0
        terms = np.vstack([[both * omega**2, omega, law.ratio], vectors]) if omega else None
        return ErrorBound(value, into, out, _RESIDUE, terms=terms)


@dataclass(frozen=True, eq=False, repr=False)
class ModalBalanced(ReductionMethod):
    """The modes with the largest modal Hankel values between the channels (balanced truncation).

    Each lightly damped mode that is well separated from the others is almost balanced. Its Hankel
    singular values are about ``||c|| ||b|| / (4 zeta omega^2)``, with the displacements b of the
    mode at the inputs and c at the outputs. The modes with the smallest values are left out,
    whatever their frequency. Rigid-body modes stay. `rank_modes` gives the values.

    Parameters
    ----------
    count : int
        Number of modes, rigid-body modes included.
    inputs, outputs : place or sequence of places
        Places of forces and displacements. Without `outputs`, the displacements are taken at the
        inputs.
    among : int, optional
        Number of lowest modes from which the method chooses. Only for an FEModel. None: all modes
        of a small model.
    static_at, damping
        Places of static correction, and damping, as for `ModalTruncation`.

    Notes
    -----
    The error bound is the sum of the peaks of the neglected modes. It is exact for one neglected
    mode. It covers only the modes that were solved (`ErrorBound.covers`). With `among` or `Modes`,
    these may not be all modes. `ErrorBound.below` gives a smaller bound for a band. The usual bound
    is twice the sum of the neglected Hankel singular values [Glover1984]_, which are listed in
    `ModeRanking.exact`. It holds for the truncation of the exactly balanced model
    (`flexplant.balanced`), which has no mass and stiffness matrices.

    References
    ----------
    [Gawronski2004]_, chapter 6; [Glover1984]_.

    Examples
    --------
    The rigid-body mode and the most important elastic mode are kept:

    >>> import flexplant as fx
    >>> model = fx.chain(masses=[1.0, 1.0, 1.0], stiffnesses=[4e5, 4e5])
    >>> method = fx.ModalBalanced(2, inputs=["1:x"], damping=fx.ModalDamping(0.01))
    >>> fx.reduce(model, method).modes().freq.round(2)
    array([  0.  , 100.66])
    """

    count: int = field(metadata=checked(whole))
    inputs: Place | Iterable[Place] = field(metadata=checked(places))
    outputs: Place | Iterable[Place] = field(default=(), kw_only=True, metadata=checked(places))
    among: int | None = field(default=None, kw_only=True, metadata=checked(whole))
    static_at: Place | Iterable[Place] = field(default=(), kw_only=True, metadata=checked(places))

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.among is not None:
            whole(self.among, "among", minimum=self.count)
        if not self.inputs:
            raise ModelError("ModalBalanced needs inputs, since Hankel values belong to channels.")

    def reduced(self, structure: FEModel | Modes) -> ReducedModel:
        """Return the truncated model. Call `reduce` instead of this method."""
        modes = structure
        if not isinstance(modes, Modes):
            modes = solve_modes(modes, count=self.among, damping=self.damping)
        elif self.damping is not None or self.among is not None:
            raise ModelError(
                "among= and damping= need an FEModel, but Modes were given. Pass damping= to "
                "solve_modes."
            )
        if not modes.n_rigid <= self.count <= modes.n_modes:
            raise ModelError(
                f"count must be from {modes.n_rigid} (rigid-body modes stay) to {modes.n_modes} "
                f"(all modes), got {self.count}."
            )
        ranking = rank_modes(modes, inputs=self.inputs, outputs=self.outputs)
        best = ranking.order[: self.count - modes.n_rigid].tolist()
        numbers = tuple(sorted([*range(1, modes.n_rigid + 1), *best]))
        bound_of = (self.inputs, self.outputs)
        return truncated(modes, numbers, self.static_at, bound_of, "modal Hankel values")


def truncated(
    modes: Modes,
    numbers: tuple[int, ...],
    static: Any,
    bound_of: tuple[Any, Any] | None,
    method: str,
) -> ReducedModel:
    """Return some of the modes, with the static compliance of the others."""
    require_real(modes, "(5) has no diagonal form (an FEModel may be given, its D is projected)")
    columns = kept_columns(numbers, modes)
    basis, omega, zeta = np.real(modes.basis), modes.basis_omega, modes.basis_zeta
    others = np.setdiff1d(np.arange(omega.size), columns)
    gone = Modes(omega[others], zeta[others], basis[:, others], modes.dofs)
    kept = modes.select(columns)
    if static:
        kept = _with_static(kept, gone, static)
    bound = None
    if bound_of is not None:
        into, out, _, _ = modal_channels(gone, *bound_of)
        terms, missed = _channel_terms(gone, bound_of)
        vectors, given = _channel_terms(_vectors_as_modes(kept), bound_of)
        at_rest = float(np.linalg.norm(missed - given, 2)) if others.size else 0.0
        terms = np.vstack([terms, vectors])
        value = _peaks(terms)
        if np.isfinite(value):
            covers = modes.n_modes if modes.n_modes < len(modes.dofs) else None
            bound = ErrorBound(value, into, out, _SUM, terms=terms, static=at_rest, covers=covers)
    left = None
    if others.size:  # the neglected modes, with the attachment vectors
        fields = ("vectors", "vector_omega", "vector_zeta", "vector_dofs")
        left = modes.select(others[others < modes.n_modes])
        left = left.replace(**{name: getattr(modes, name) for name in fields})
    return _modal_model(kept, numbers, method, bound).replace(truncated=left)


def _with_static(kept: Modes, gone: Modes, static: Any) -> Modes:
    """Return modes with attachment vectors computed from the other modes of a known set."""
    shapes, omega, zeta = np.real(gone.phi), gone.omega, gone.zeta
    names = labels_of(static, kept.dofs)
    rows = np.array([kept.dofs.row(place) for place in static])
    moved = (rows @ shapes).T / omega[:, None] ** 2
    vectors, values, _ = la.svd(moved, full_matrices=False)
    if not values.size or values[-1] <= SAME * values[0] or moved.shape[1] > moved.shape[0]:
        raise ModelError(
            f"the truncated modes cannot give {counted(len(static), 'independent static shape')} "
            f"at {', '.join(names)}: they are too few, or a place appears twice. Solve more "
            "modes, or name each place once."
        )
    squares, mix = la.eigh((vectors.T * omega**2) @ vectors)
    mix = vectors @ mix
    return kept.replace(
        vectors=shapes @ mix,
        vector_omega=np.sqrt(squares),
        vector_zeta=np.sum(mix**2 * (zeta * omega)[:, None], axis=0) / np.sqrt(squares),
        vector_dofs=names,
    )


def _vectors_as_modes(kept: Modes) -> Modes:
    """Return attachment vectors as separate modes."""
    return Modes(kept.vector_omega, kept.vector_zeta, kept.vectors, kept.dofs)


def _channel_terms(modes: Modes, bound_of: tuple[Any, Any]) -> tuple[FloatArray, FloatArray]:
    """Return gain, frequency and damping (k, 3) of modes between channels, and their static sum."""
    _, _, force, seen = modal_channels(modes, *bound_of)
    gain = np.linalg.norm(force, axis=1) * np.linalg.norm(seen, axis=0)
    return np.column_stack([gain, modes.omega, modes.zeta]), (seen / modes.omega**2) @ force


def _peaks(terms: FloatArray) -> float:
    """Return the sum of the peaks of modes, by gain, frequency and damping."""
    gain, omega, zeta = terms.T
    with np.errstate(invalid="ignore"):
        return float(gain @ peak_gains(omega, zeta))


def _modal_model(
    modes: Modes, numbers: Sequence[int], method: str, bound: ErrorBound | None
) -> ReducedModel:
    """Return the reduced model whose coordinates are the modes, equation (5)."""
    k, r = modes.basis_omega.size, modes.n_rigid
    static = [f"{STATIC}{i}" for i in range(1, modes.n_vectors + 1)]
    extra = f" and {counted(modes.n_vectors, 'static vector')}" if modes.n_vectors else ""
    return ReducedModel(
        M=np.eye(k),
        D=np.diag(modes.basis_rates),
        K=np.diag(modes.basis_squares),
        T=np.real(modes.basis),
        dofs=modes.dofs.select(()),
        full_dofs=modes.dofs,
        rigid_body=np.eye(k, r),
        method=f"{method}, {counted(modes.n_modes, 'mode')}{extra}",
        coordinates=[*(f"mode {i}" for i in numbers), *static],
        condition_of="M*",
        bound=bound if bound is None or np.isfinite(bound.value) else None,
        n_vectors=modes.n_vectors,
        static_at=modes.vector_dofs,
    )

"""Reduction from the matrices: condensation (Guyan, IRS, SEREP) and component modes."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass, field
from typing import Any, ClassVar

import numpy as np
import scipy.linalg as la

from ..arrays import FloatArray, IntArray, positive, several, whole
from ..errors import ModelError, ShapeError, SolverError, counted
from ..modes.modes import Modes
from ..modes.solve import solve_modes
from ..sparse.symmetric import dense, projected, unit_diagonal
from ..store import checked
from ..structure import FEModel, ModalDamping
from ..tolerances import RANK, ROUNDING, SAME, TINY
from .methods import ReductionMethod, labels_given, refused_partition
from .projection import Solver, block, fe_model, projected_model
from .reduced import ReducedModel

_SINGULAR = (
    "K of the condensed DOFs is singular: with the kept DOFs held, the structure can still move "
    "(rigidly, or as a mechanism), so that it has no static shape. Keep DOFs that prevent its "
    "rigid-body motions: three z-DOFs that are not on a line for a plate."
)


def _loose(model: FEModel, kept: IntArray) -> str:
    """Return that kept DOFs leave rigid-body motions, and which others would hold them."""
    rigid = model.rigid_body / np.linalg.norm(model.rigid_body, axis=0)
    largest = float(np.linalg.norm(rigid[kept], axis=1).max(initial=0.0))
    _, sizes, turned = la.svd(rigid[kept])
    held = np.pad(sizes, (0, rigid.shape[1] - sizes.size))
    left = rigid @ turned[held < SAME * max(largest, held.max(initial=0.0))].T
    # the displacements that move most, one after the other; rotations only where displacements are
    # missing
    names = model.dofs.labels
    straight = model.dofs.kinds < 3
    order = la.qr(np.where(straight[:, None], left, 0.0).T, mode="r", pivoting=True)
    count = left.shape[1]
    corner = np.abs(np.diag(order[0]))
    # displacements alone leave a rotation about the line on which they lie
    if corner.size < count or corner[count - 1] < 1e-6 * corner[0]:
        order = la.qr(left.T, mode="r", pivoting=True)
    add = ", ".join(repr(names[i]) for i in order[1][:count])
    return (
        f"the kept DOFs leave {counted(count, 'rigid-body motion')} free: with them held, "
        f"the structure has no static shape. Keep for example {add} as well; or use Rubin or "
        "ModalTruncation, which hold no DOF."
    )


def mode_numbers(numbers: Any, name: str) -> tuple[int, ...]:
    """Return mode numbers as a sorted tuple."""
    if not several(numbers):
        raise ModelError(f"{name} are given by their numbers, got {numbers!r:.60}: [1, 2, 3, 7].")
    listed = [whole(number, "a mode number") for number in numbers]
    if not listed or len(set(listed)) != len(listed):
        raise ModelError(f"every mode number may appear only once, got {listed!r:.80}.")
    return tuple(sorted(listed))


class DofPartition:
    """Kept rows, the others, and the static shapes ``-Kss^-1 Ksm`` between them."""

    def __init__(self, model: FEModel, labels: tuple[str, ...]) -> None:
        self.kept: IntArray = model.dofs.indices(labels)
        self.others = np.delete(np.arange(model.n_dof), self.kept)
        if not self.others.size:
            every = counted(model.n_dof, "DOF")
            raise ShapeError(
                f"all {every} would be kept, so that nothing is condensed. Keep fewer."
            )
        rigid = model.rigid_body
        if rigid.shape[1]:
            # with the kept DOFs held, no rigid-body motion may remain
            size = la.svdvals(rigid[self.kept] / np.linalg.norm(rigid, axis=0))
            if size.size < rigid.shape[1] or size[-1] < SAME * size[0]:
                raise ModelError(_loose(model, self.kept))
        self.stiffness = block(model.K, self.others, self.others)
        self.solver = Solver(self.stiffness, _SINGULAR)
        loads = dense(block(model.K, self.others, self.kept))
        self.static = self.whole(np.eye(self.kept.size), -self.solver.solve(loads))

    def whole(self, kept: FloatArray, others: FloatArray) -> FloatArray:
        """Return all n rows from those of the two parts."""
        rows = np.zeros((self.kept.size + self.others.size, kept.shape[1]))
        rows[self.kept], rows[self.others] = kept, others
        return rows


@dataclass(frozen=True, eq=False, repr=False)
class Guyan(ReductionMethod):
    """Static condensation to a few DOFs: ``T = [I; -Kss^-1 Ksm]``.

    Kss and Ksm are blocks of K. Here m marks the kept DOFs (masters) and s the condensed ones
    (slaves). The model is exact at 0 Hz for loads on the kept DOFs, and for rigid-body motions.
    Every frequency is at or above the true frequency (Rayleigh-Ritz). It approaches the true
    frequency from above when DOFs are added.

    Parameters
    ----------
    dofs : sequence of str, DofSet or DofSelection
        Kept DOFs. When they are held, the structure must not move as a rigid body.
    damping : ModalDamping or Rayleigh, optional
        Damping of the modes of the reduced model. None: its damping matrix is ``T^T D T``.

    References
    ----------
    [Guyan1965]_.

    Examples
    --------
    Without the middle mass, the two springs of 4e5 N/m act in series:

    >>> import flexplant as fx
    >>> model = fx.chain(masses=[1.0, 1e-3, 1.0], stiffnesses=[4e5, 4e5])
    >>> fx.reduce(model, fx.reduction.Guyan(["1:x", "3:x"])).K.round(3)
    array([[ 200000., -200000.],
           [-200000.,  200000.]])
    """

    dofs: Iterable[str] = field(metadata=checked(labels_given, name="kept DOFs"))

    def reduced(self, structure: FEModel | Modes) -> ReducedModel:
        """Return the condensed model. Call `reduce` instead of this method."""
        model, labels = fe_model(structure, self), tuple(self.dofs)
        part = DofPartition(model, labels)
        return projected_model(
            model,
            part.static,
            dofs=model.dofs.select(labels),
            method="static condensation (Guyan)",
            damping=self.damping,
            static_at=labels,
        )


@dataclass(frozen=True, eq=False, repr=False)
class Irs(ReductionMethod):
    """Improved reduced system: static condensation with the inertia of the condensed DOFs.

    `Guyan` gives the matrix T_s and the reduced matrices M_s and K_s. Kss is the block of K of the
    condensed DOFs. The first iteration is the IRS of O'Callahan, ``T_1 = T_s + S M T_s M_s^-1 K_s``
    with ``S = diag(0, Kss^-1)``. In further iterations, the previous T and its reduced mass and
    stiffness replace T_s, M_s and K_s in the second term. The iterations converge to `Serep`, in
    which as many of the lowest modes are exact as there are kept DOFs.

    Parameters
    ----------
    dofs, damping
        Kept DOFs, and damping of the reduced model, as for `Guyan`.
    iterations : int
        Largest number of iterations.
    tolerance : float
        Relative change of every omega^2 below which the iteration stops.

    Notes
    -----
    Each iteration multiplies the error of a mode by about ``(omega / omega_s)^2``. Here omega is
    the frequency of the mode, and omega_s is the lowest frequency when the kept DOFs are held.

    References
    ----------
    [OCallahan1989a]_; [FriswellGarveyPenny1995]_; [FriswellGarveyPenny1998]_.

    Examples
    --------
    Relative errors of the first frequency, by static condensation and by this method:

    >>> import flexplant as fx
    >>> model = fx.chain(masses=[1.0, 1.0, 1.0], stiffnesses=[4e5, 4e5], ground=1e5)
    >>> exact = fx.solve_modes(model, count=1).freq
    >>> for method in (fx.reduction.Guyan(["1:x", "3:x"]), fx.reduction.Irs(["1:x", "3:x"])):
    ...     print((fx.reduce(model, method).modes().freq[:1] / exact - 1).round(6))
    [0.017545]
    [0.000105]
    """

    dofs: Iterable[str] = field(metadata=checked(labels_given, name="kept DOFs"))
    iterations: int = field(default=1, kw_only=True, metadata=checked(whole))
    tolerance: float = field(default=1e-12, kw_only=True, metadata=checked(positive, zero=True))

    def reduced(self, structure: FEModel | Modes) -> ReducedModel:
        """Return the condensed model. Call `reduce` instead of this method."""
        model, labels = fe_model(structure, self), tuple(self.dofs)
        part = DofPartition(model, labels)
        rigid = model.rigid_body[part.kept]
        T, before = part.static, np.zeros(0)
        done = 0
        while done < self.iterations:
            done += 1
            M, K = projected(model.M, T), projected(model.K, T)
            rates, squares = _rates(M, K)
            inertia = np.asarray(model.M @ T)[part.others] @ rates
            # rigid-body motions have zero frequency, without rounding of K
            inertia = inertia - inertia @ rigid @ la.pinv(rigid) if rigid.shape[1] else inertia
            T = part.static + part.whole(np.zeros_like(rates), part.solver.solve(inertia))
            floor = self.tolerance * np.abs(squares) + ROUNDING * squares[-1]
            if before.size and np.all(np.abs(squares - before) <= floor):
                break
            before = squares
        return projected_model(
            model,
            T,
            dofs=model.dofs.select(labels),
            method=f"improved condensation (IRS, {counted(done, 'iteration')})",
            damping=self.damping,
            singular="The iteration lost modes: use fewer iterations, or other DOFs.",
            static_at=labels,
        )


def _rates(M: FloatArray, K: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Return ``M^-1 K`` and its eigenvalues."""
    scaled, scale = unit_diagonal(M)
    stiffness = scale[:, None] * K * scale
    try:
        lower = la.cholesky(np.asarray(scaled), lower=True)
    except la.LinAlgError as error:
        raise SolverError(
            "the reduced M is singular in the IRS iteration: it lost modes. Use fewer "
            "iterations, or other DOFs."
        ) from error
    rates = scale[:, None] * la.cho_solve((lower, True), stiffness) / scale
    half = la.solve_triangular(lower, stiffness, lower=True)
    squares = la.eigvalsh(la.solve_triangular(lower, half.T, lower=True))
    return np.asarray(rates), np.asarray(squares)


@dataclass(frozen=True, eq=False, repr=False)
class Serep(ReductionMethod):
    """System equivalent reduction (SEREP): k chosen modes are exact in a model of k DOFs.

    As in `DesiredDofs`, the matrix is ``T = phi phi_kk^-1`` with the chosen modes phi, where
    phi_kk holds the rows of phi at the kept DOFs (equations (6) to (8) of [paper]_). In contrast to
    `DesiredDofs`, this method solves for the modes itself. The reduced matrices are ``T^T M T``,
    ``T^T K T`` and ``T^T D T``, and D may be any matrix.

    Parameters
    ----------
    dofs, damping
        Kept DOFs, and damping of the reduced model, as for `Guyan`.
    modes : sequence of int, optional
        Numbers of the modes that are exact, counted from 1. Their number is that of the kept DOFs,
        and all rigid-body modes must be included. None: the lowest modes.

    Notes
    -----
    Fewer modes than DOFs are refused, since the reduced mass matrix would be singular.

    References
    ----------
    [OCallahan1989b]_.

    Examples
    --------
    A model of two DOFs has the first two of three modes exactly:

    >>> import flexplant as fx
    >>> model = fx.chain(masses=[1.0, 1.0, 1.0], stiffnesses=[4e5, 4e5])
    >>> fx.reduce(model, fx.reduction.Serep(["1:x", "3:x"])).modes().freq.round(2)
    array([  0.  , 100.66])
    """

    dofs: Iterable[str] = field(metadata=checked(labels_given, name="kept DOFs"))
    modes: Iterable[int] | None = field(default=None, metadata=checked(mode_numbers))

    def __post_init__(self) -> None:
        super().__post_init__()
        count = len(tuple(self.dofs))
        if self.modes is not None and len(tuple(self.modes)) != count:
            raise ShapeError(
                f"{count} DOFs for {len(tuple(self.modes))} modes: phi_kk must be square, or M* "
                "would be singular. Name as many modes as DOFs."
            )

    def reduced(self, structure: FEModel | Modes) -> ReducedModel:
        """Return the model in these DOFs. Call `reduce` instead of this method."""
        model, labels = fe_model(structure, self), tuple(self.dofs)
        numbers = tuple(self.modes or range(1, len(labels) + 1))
        modes = solve_modes(model, damping=ModalDamping(0.0), count=max(numbers))
        phi = np.real(modes.phi)[:, kept_columns(numbers, modes)]
        condition = refused_partition(modes.dofs, phi, labels, f"{len(labels)} modes")
        return projected_model(
            model,
            la.solve(phi[model.dofs.indices(labels)].T, phi.T).T,
            dofs=model.dofs.select(labels),
            method=f"{counted(len(labels), 'mode')} (SEREP)",
            damping=self.damping,
            condition=condition,
            condition_of="phi_kk",
        )


def kept_columns(numbers: tuple[int, ...], modes: Modes) -> IntArray:
    """Return the columns of mode numbers, all rigid-body modes among them."""
    if numbers[-1] > modes.n_modes:
        raise ModelError(f"mode {numbers[-1]} is required, but there are {modes.n_modes}.")
    left = sorted(set(range(1, modes.n_rigid + 1)) - set(numbers))
    if left:
        raise ModelError(
            f"rigid-body modes {left} are left out: the reduced structure could not move freely. "
            f"Keep modes 1 to {modes.n_rigid}."
        )
    return np.array(numbers, dtype=np.int64) - 1


@dataclass(frozen=True, eq=False, repr=False)
class CraigBampton(ReductionMethod):
    """Static shapes of the boundary and modes of the interior with the boundary held.

    The matrix is ``T = [I 0; -Kii^-1 Kib phi_i]``. Here b marks the boundary DOFs, i marks the
    interior DOFs, and phi_i are the modes with the boundary held (fixed-interface modes). The
    coordinates are the boundary DOFs, then one for each of these modes ("fixed mode 1", ...). Every
    frequency is at or above the true frequency (Rayleigh-Ritz), and additional modes do not raise
    it. Rigid-body motions are exact.

    Parameters
    ----------
    boundary : sequence of str, DofSet or DofSelection
        Kept DOFs, where loads and other structures attach. When they are held, the structure must
        not move as a rigid body.
    modes : int
        Number of fixed-interface modes. With 0, the method is static condensation.
    below : float [Hz], optional
        Highest frequency of the fixed-interface modes, in place of `modes`.
    damping : ModalDamping or Rayleigh, optional
        Damping of the modes of the reduced model. None: its damping matrix is ``T^T D T``.

    References
    ----------
    [CraigBampton1968]_.

    Examples
    --------
    With one fixed-interface mode, all three modes of the chain are exact:

    >>> import flexplant as fx
    >>> model = fx.chain(masses=[1.0, 1.0, 1.0], stiffnesses=[4e5, 4e5])
    >>> fx.reduce(model, fx.reduction.CraigBampton(["1:x", "3:x"], modes=1)).modes().freq.round(2)
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
        """Return the reduced model. Call `reduce` instead of this method."""
        model, labels = fe_model(structure, self), tuple(self.boundary)
        part = DofPartition(model, labels)
        fixed = np.zeros((part.others.size, 0))
        if self.modes or self.below is not None:
            fixed = self._fixed(model, part)
        count = fixed.shape[1]
        names = [*labels, *(f"fixed mode {i}" for i in range(1, count + 1))]
        return projected_model(
            model,
            np.hstack([part.static, part.whole(np.zeros((len(labels), count)), fixed)]),
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
        dofs = model.dofs.select([model.dofs.labels[i] for i in rows])
        interior = FEModel(block(model.M, rows, rows), part.stiffness, dofs=dofs)
        found = solve_modes(interior, count=self.modes or None, below=self.below)
        return np.real(found.phi)


@dataclass(frozen=True, eq=False, repr=False)
class _FreeInterface(ReductionMethod):
    """Free modes of the whole structure and its residual flexibility at the boundary."""

    boundary: Iterable[str] = field(metadata=checked(labels_given, name="boundary DOFs"))
    modes: int = field(metadata=checked(whole))
    #: whether the residual flexibility is without inertia, and its name
    _massless: ClassVar[bool]
    _kind: ClassVar[str]

    def reduced(self, structure: FEModel | Modes) -> ReducedModel:
        """Return the reduced model. Call `reduce` instead of this method."""
        model, labels, massless = fe_model(structure, self), tuple(self.boundary), self._massless
        modes = solve_modes(
            model, damping=ModalDamping(0.0), count=self.modes, compliance_at=list(labels)
        )
        T, back = self._coordinates(modes, labels)
        b, k, r = len(labels), modes.n_modes, modes.n_rigid
        light = np.concatenate([np.ones(k), np.full(modes.n_vectors, 0.0 if massless else 1.0)])
        M = (back.T * light) @ back
        K = (back.T * modes.basis_omega**2) @ back
        if self.damping is not None:
            count = k if massless else light.size
            omega = modes.basis_omega[:count]
            rate = np.zeros(light.size)
            rate[:count] = 2 * self.damping.zeta(omega) * omega
            D = (back.T * rate) @ back
        elif model.D is None:
            D = np.zeros_like(M)
        else:
            D = projected(model.D, np.real(modes.basis)) * np.outer(light, light)
            D = back.T @ D @ back
        rigid = np.zeros((light.size, r))
        rigid[:b], rigid[b : b + r] = np.real(modes.phi)[model.dofs.indices(labels), :r], np.eye(r)
        if massless:
            # exact zeros mark coordinates without mass
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
            method=f"{counted(self.modes, 'free mode')} and {self._kind} ({type(self).__name__})",
            condition=float(values[-1] / values[0]),
            condition_of="M*",
            coordinates=(*labels, *(f"mode {i}" for i in range(1, k + 1))),
            static_at=labels,
        )

    def _coordinates(self, modes: Modes, labels: tuple[str, ...]) -> tuple[FloatArray, FloatArray]:
        """Return T, and the map from (u_b, p) to (p, g)."""
        b, rows = len(labels), modes.dofs.indices(labels)
        phi, vectors = np.real(modes.phi), modes.vectors
        at = vectors[rows]
        values = la.eigvalsh(dense(unit_diagonal(at @ at.T)[0]))
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
        return T, back


@dataclass(frozen=True, eq=False, repr=False)
class Rubin(_FreeInterface):
    """Free modes and the residual flexibility of the boundary, with its inertia.

    The motions are combinations of the modes of the structure with a free boundary and of residual
    attachment vectors. Such a vector is the static displacement under a unit force at a boundary
    DOF, minus the part that the modes describe (the residual flexibility). The coordinates are the
    boundary DOFs, then the modal coordinates ("mode 1", ...). The modes are exact. The response to
    loads on the boundary is exact up to order omega^2. All other frequencies are above the true
    ones. In a free structure, the inertia forces of the rigid-body acceleration balance the unit
    force (inertia relief).

    Parameters
    ----------
    boundary : sequence of str, DofSet or DofSelection
        Kept DOFs, where loads and other structures attach.
    modes : int
        Number of free modes, rigid-body modes included.
    damping : ModalDamping or Rayleigh, optional
        Damping of modes and attachment vectors. None: the damping matrix is ``T^T D T``.

    References
    ----------
    [Rubin1975]_.

    Examples
    --------
    The first two modes of a chain of four masses are exact:

    >>> import flexplant as fx
    >>> model = fx.chain(masses=[1.0, 1.0, 1.0, 1.0], stiffnesses=[4e5, 4e5, 4e5])
    >>> fx.reduce(model, fx.reduction.Rubin(["1:x"], modes=2)).modes().freq[:2].round(2)
    array([ 0.  , 77.04])
    """

    _massless = False
    _kind = "residual flexibility"


@dataclass(frozen=True, eq=False, repr=False)
class MacNeal(_FreeInterface):
    """Free modes and the residual flexibility of the boundary, without inertia.

    The residual flexibility is the static displacement that the truncated modes contribute under
    unit forces on the boundary. In contrast to `Rubin`, they contribute only this static response.
    The boundary coordinates have no mass: their rows of the reduced mass matrix are zero. The poles
    are only those of the modes. The model is exact at 0 Hz for loads on the boundary. A plant of
    this model has a feedthrough. The boundary gets mass when the model is joined to others, or when
    `update` adds a mass there.

    Parameters
    ----------
    boundary, modes, damping
        Kept DOFs, number of free modes, and damping, as for `Rubin`. The damping applies to the
        modes only. Without it, the part of D that acts on the modes is used.

    References
    ----------
    [MacNeal1971]_.

    Examples
    --------
    The first two modes of a chain of four masses are exact:

    >>> import flexplant as fx
    >>> model = fx.chain(masses=[1.0, 1.0, 1.0, 1.0], stiffnesses=[4e5, 4e5, 4e5])
    >>> fx.reduce(model, fx.reduction.MacNeal(["1:x"], modes=2)).modes().freq[:2].round(2)
    array([ 0.  , 77.04])
    """

    _massless = True
    _kind = "static residual flexibility"

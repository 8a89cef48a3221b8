"""A structure in a few coordinates: some of its degrees of freedom, modes, or both."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass, field
from functools import cached_property
from typing import Any

import numpy as np
import scipy.linalg as la

from ..arrays import (
    ComplexArray,
    FloatArray,
    IntArray,
    complex_array,
    name_list,
    positive,
    real_array,
)
from ..errors import ModelError, counted
from ..labels import DofSet, Place
from ..modes.matching import calibration_of
from ..modes.modes import Modes, calibrated_matrices, measured_poles, require_real
from ..modes.normal_forms import normal_form, overdamped_notes
from ..parallel import Progress
from ..sparse.symmetric import orthonormalised, projected
from ..store import Value, checked
from ..structure import FEModel
from ..structure.definite import refuse_unstable, unstable_stiffness
from ..structure.rigid import relative_miss, rigid_motions
from ..tolerances import NEGLIGIBLE, RANK
from .judging import ReductionQuality, quality_of
from .ranking import ErrorBound

#: prefix of the names of coordinates with the static compliance of truncated modes
STATIC = "static "


#: fields: a matrix of the coordinates, and columns over them
_SQUARE = checked(real_array, shape=("coordinates", "coordinates"))
_COLUMNS = checked(real_array, shape=("coordinates", None))


@dataclass(frozen=True, eq=False, repr=False)
class ReducedModel(Value):
    """A reduced structure ``M* q_k'' + D* q_k' + K* q_k = T^T f``, ``q_n = T q_k``.

    The k coordinates q_k are those of the reduced model. The n DOFs q_n are those of the full
    structure, on which the forces f act.

    Parameters
    ----------
    M, D, K : (k, k) arrays
        Reduced matrices of mass, damping and stiffness: M*, D*, K* of equation (8) of the paper.
    T : (n, k) array
        Expansion matrix, which gives the motion of the full structure (equations (4) and (7)).
    dofs : DofSet
        Physical DOFs that are coordinates of the reduced model. With `DesiredDofs` and `Guyan` all
        k coordinates are such DOFs. With `CraigBampton` only the first coordinates are such DOFs.
        With `ModalTruncation` this set is empty.
    full_dofs : DofSet
        The n DOFs of the full structure, with its shape functions.
    rigid_body : (k, r) array
        Rigid-body motions in the k coordinates, with ``K rigid_body = 0``. They are stored because
        an eigenvalue solver for (K*, M*) would find frequencies that differ from 0 by rounding.
    method : str
        Name of the reduction method.
    condition : float
        Condition number of the matrix that the method inverts: phi_kk (the rows of the modes at the
        kept DOFs), or M* scaled to a diagonal of ones.
    coordinates : sequence of k str
        Names of all coordinates: first the labels of `dofs`, then names of coordinates that are not
        DOFs, such as "mode 7". Empty: the labels of `dofs`.
    condition_of : str
        Name of the matrix whose condition number is `condition`.
    bound : ErrorBound, optional
        Bound of the error between channels, where the method has one.
    truncated : Modes, optional
        Modes of the full structure that were solved but left out by `reduce`, with the rows
        `full_dofs`. They are M-orthogonal to the kept modes. An update changes M, D and K but not
        these modes. After it, modes of the updated full structure would be more accurate.
    n_vectors : int
        Number of residual attachment vectors in the basis (see `Modes`). The reduced model has this
        number of additional modes, which are not modes of the structure. They represent the static
        compliance of the truncated modes.
    static_at : sequence of str
        Places whose static compliance is exact.
    joint_motions : (k, m) array, optional
        Rigid motions of the components of a joined machine, as far as its joints allow them.
    joining : Value, optional
        Record of how a machine was joined, with its checks. None after an update.
    calibration : MeasuredModes, optional
        Measured poles that `calibrated` used, if it was called.
    machines : Machines, optional
        Uncertainty of the machine that remains after an update.

    References
    ----------
    [paper]_, equations (6)-(8).

    Examples
    --------
    The two ends of a chain move in opposite directions, and the middle mass stays at rest:

    >>> import flexplant as fx
    >>> modes = fx.solve_modes(fx.chain(masses=[1.0, 1.0, 1.0], stiffnesses=[4e5, 4e5]), count=2)
    >>> small = fx.reduce(modes, fx.DesiredDofs(["1:x", "3:x"]))
    >>> small.expand([1.0, -1.0]).round(6) + 0.0
    array([ 1.,  0., -1.])
    """

    M: FloatArray = field(metadata=_SQUARE)
    D: FloatArray = field(metadata=_SQUARE)
    K: FloatArray = field(metadata=_SQUARE)
    T: FloatArray = field(metadata=checked(real_array, shape=("full_dofs", "coordinates")))
    dofs: DofSet
    full_dofs: DofSet
    rigid_body: FloatArray = field(metadata=_COLUMNS)
    method: str = ""
    condition: float = field(default=1.0, metadata=checked(positive))
    coordinates: Iterable[str] = ()
    condition_of: str = "phi_kk"
    bound: ErrorBound | None = None
    truncated: Modes | None = None
    n_vectors: int = 0
    static_at: Iterable[str] = field(default=(), metadata=checked(name_list))
    joint_motions: FloatArray | None = field(default=None, metadata=_COLUMNS)
    joining: Value | None = None
    calibration: Value | None = None
    machines: Value | None = None

    def __post_init__(self) -> None:
        names = tuple(map(str, self.coordinates)) or self.dofs.labels
        if names[: len(self.dofs)] != self.dofs.labels or len(set(names)) != len(names):
            raise ModelError(
                f"the coordinates {list(names[:3])} ... must be unique and begin with the physical "
                f"DOFs {list(self.dofs.labels[:3])} ...: the rows of T are found by these names."
            )
        self._set(coordinates=names)
        super().__post_init__()
        if self.truncated is not None and self.truncated.dofs.labels != self.full_dofs.labels:
            raise ModelError(
                f"the truncated modes are over {len(self.truncated.dofs)} DOFs that are not the "
                f"{len(self.full_dofs)} of full_dofs, in this order. Take both from the same Modes."
            )

    def __repr__(self) -> str:
        held, every = len(self.dofs), counted(len(self.full_dofs), "DOF")
        extra = counted(self.n_dof - held, "generalised coordinate")
        shown = f"{held} of {every}" if held else f"{extra} for {every}"
        if 0 < held < self.n_dof:
            shown += f" and {extra}"
        left = ""
        if self.truncated is not None:
            count = self.truncated.n_modes
            known = "truncated modes are" if count > 1 else "truncated mode is"
            left = f", {count} {known} known"
        grows = f", {self.n_unstable} unstable" if self.n_unstable else ""
        return (
            f"<ReducedModel: {shown} by {self.method}, "
            f"{counted(self.rigid_body.shape[1], 'rigid-body motion')}{grows}, "
            f"cond({self.condition_of}) {self.condition:.3g}{left}>"
        )

    @property
    def n_dof(self) -> int:
        """Number of coordinates k."""
        return int(self.M.shape[0])

    @property
    def is_physical(self) -> bool:
        """Whether all coordinates are DOFs of the structure."""
        return len(self.dofs) == self.n_dof

    def expand(self, q: FloatArray | ComplexArray) -> FloatArray | ComplexArray:
        """Return the motion ``T q`` of all n DOFs for real or complex motions q (k,) or (k, m)."""
        listed = complex_array(q, "q") if isinstance(q, list | tuple) else q
        shape = (self.n_dof,) if np.ndim(listed) == 1 else (self.n_dof, None)
        check: Any = complex_array if np.iscomplexobj(q) else real_array
        moved: FloatArray | ComplexArray = self.T @ check(q, "q", shape)
        return moved

    def row(self, at: Place, direction: str = "z") -> FloatArray:
        """Return the row (k,) whose product with the coordinates is the motion at a place.

        Its transpose is the load on the coordinates of a unit force at this place.

        Parameters
        ----------
        at : str, (3,) array [m] or mapping
            A DOF label, a point, or {label: weight}. It may be any place of the full structure, not
            only one of the kept DOFs.
        direction : str
            Direction of the motion at a point.
        """
        return np.asarray(self.full_dofs.row(at, direction) @ self.T)

    def rows(self, points: FloatArray, direction: str = "z") -> FloatArray:
        """Return the rows (p, k) of the motion at many points (p, 3) [m]; see `row`."""
        return np.asarray(self.full_dofs.rows(points, direction) @ self.T)

    def inertia(self, motions: FloatArray) -> FloatArray:
        """Return the inertia loads (k, r) of motions (k, r): the product ``M* @ motions``."""
        return np.asarray(self.M @ motions)

    def missed_motions(self, about: Iterable[float] = (0.0, 0.0, 0.0)) -> FloatArray:
        """Return the fraction (6,) of each rigid-body motion that T cannot represent.

        Rotations turn about the point `about` [m].
        """
        wanted = rigid_motions(self.full_dofs, real_array(about, "about", (3,)))
        return relative_miss(self.T @ self.rigid_motions(about), wanted)

    def rigid_motions(self, about: Iterable[float] = (0.0, 0.0, 0.0)) -> FloatArray:
        """Return the six rigid-body motions of the geometry in the k coordinates, as (k, 6).

        Rotations turn about the point `about` [m]. If T cannot represent a motion exactly, its
        column approximates it.
        """
        centre = real_array(about, "about", (3,))
        if self.is_physical:
            return rigid_motions(self.dofs, centre)
        return np.asarray(la.lstsq(self.T, rigid_motions(self.full_dofs, centre))[0])

    @cached_property
    def n_unstable(self) -> int:
        """Number of rigid-body motions that springs of negative stiffness make unstable."""
        stiff = la.eigvalsh(self.K)
        if not self.n_dof or stiff[0] > -RANK * stiff[-1]:
            return 0
        motions = self.body_motions
        if self.rigid_body.shape[1] == motions.shape[1]:
            return 0
        return int(unstable_stiffness(self.K, motions).size)

    @property
    def body_motions(self) -> FloatArray:
        """The M-orthonormal rigid-body motions (k, r) that T can represent.

        Motions that springs to the ground hold are included.
        """
        if self.joint_motions is not None:
            return orthonormalised(self.M, self.joint_motions, dependent="drop")
        made = self.missed_motions() < NEGLIGIBLE
        return orthonormalised(self.M, self.rigid_motions()[:, made], dependent="drop")

    @property
    def massless(self) -> IntArray:
        """Positions (from 0) of coordinates without any mass, as in `MacNeal`."""
        return np.flatnonzero(~np.any(self.M, axis=1))

    def condensed(self) -> tuple[ReducedModel, FloatArray, FloatArray]:
        """Return the model without its massless coordinates, and their flexibility.

        Massless coordinates follow the other coordinates and the loads without delay. The equation
        ``q_k = S q_c + G T^T f`` is therefore exact, where q_c are the c coordinates with mass. The
        method returns three things: the model in the coordinates q_c, the matrix S (k, c), and the
        flexibility G (k, k) [m/N]. G gives the immediate displacement under the loads. If all
        coordinates have mass, the model does not change and G is zero.

        Raises
        ------
        ModelError
            When a massless coordinate is damped or has no stiffness.
        """
        light = self.massless
        if not light.size:
            return self, np.eye(self.n_dof), np.zeros((self.n_dof, self.n_dof))
        heavy, follow, flexibility, K = static_followers(self.D, self.K, light)
        names = np.array(tuple(self.coordinates), dtype=object)[heavy].tolist()
        block = np.ix_(heavy, heavy)
        model = self.replace(
            M=self.M[block],
            D=self.D[block],
            K=K,
            T=self.T @ follow,
            dofs=self.dofs.select([label for label in names if label in self.dofs]),
            rigid_body=self.rigid_body[heavy],
            joint_motions=None if self.joint_motions is None else self.joint_motions[heavy],
            coordinates=names,
        )
        return model, follow, flexibility

    def calibrated(self, measured: Any) -> ReducedModel:
        """Return the model with the measured poles of some modes and the same shapes.

        The new stiffness is ``K* + M* phi diag(omega_m^2 - omega^2) phi^T M*``, with the measured
        frequencies omega_m. D* changes in the same way. Truncated modes do not change, and
        rigid-body modes stay at 0.

        Parameters
        ----------
        measured : MeasuredModes
            Measured poles with their mode numbers, which count from 1 and include rigid-body modes.
            A model can be calibrated by several measurements, one after the other, which are then
            joined as by `MeasuredModes.merged` (shapes at other DOFs are lost).

        Raises
        ------
        ModelError, LabelError
            When `measured` has no numbers, a number is not that of an elastic mode, or the model
            has massless coordinates or unstable modes (magnets).
        SolverError
            When the damping couples the modes so strongly that changes of the single modes do not
            lead to the measured poles.
        """
        if self.massless.size or self.n_unstable:
            raise ModelError(
                "a model with massless coordinates or unstable modes has no modes that measured "
                "poles could replace. Reduce it by DesiredDofs, or calibrate the Modes."
            )
        free = self.rigid_body.shape[1]
        places, poles = measured_poles(measured, range(free + 1, self.n_dof - self.n_vectors + 1))
        D, K = calibrated_matrices(self.M, self.D, self.K, free, places, poles)
        known, machines = calibration_of(self, measured), self.machines
        if machines is not None:  # those of the fit agree with all that was measured
            machines = machines.replace(measured=known)
        return self.replace(D=D, K=K, bound=None, calibration=known, machines=machines)

    def completed(self) -> ReducedModel:
        """Return the model with the truncated modes as further coordinates.

        The result has the matrices ``M = diag(M*, I)``, ``D = diag(D*, 2 Z Omega)``,
        ``K = diag(K*, Omega^2)`` and ``T = [T, phi]``. Here phi, Omega and Z are the shapes,
        frequencies and damping ratios of the truncated modes (equations (5) and (8) of the paper).
        Static coordinates ("static 1", ...) are dropped, since the truncated modes contain their
        compliance. Without truncated modes, the model itself is returned.

        Raises
        ------
        ModelError
            When the truncated modes are complex.
        """
        more = self.truncated
        if more is None:
            return self
        require_real(more, "complex truncated modes cannot be combined with real coordinates")
        names = tuple(self.coordinates)
        kept = [i for i, name in enumerate(names) if not name.startswith(STATIC)]
        block = np.ix_(kept, kept)
        k, r = more.basis_squares.size, self.rigid_body.shape[1]
        return ReducedModel(
            M=la.block_diag(self.M[block], np.eye(k)),
            D=la.block_diag(self.D[block], np.diag(more.basis_rates)),
            K=la.block_diag(self.K[block], np.diag(more.basis_squares)),
            T=np.hstack([self.T[:, kept], np.real(more.basis)]),
            dofs=self.full_dofs.select(()),
            full_dofs=self.full_dofs,
            rigid_body=np.vstack([self.rigid_body[kept], np.zeros((k, r))]),
            method=f"{self.method}, with {counted(more.n_modes, 'truncated mode')}",
            condition=self.condition,
            condition_of=self.condition_of,
            coordinates=[
                *(f"kept {names[i]}" for i in kept),
                *(f"left out {i}" for i in range(1, k + 1)),
            ],
        )

    def modes(self) -> Modes:
        """Return all modes of the reduced model, with rigid-body modes at exactly 0.

        If all coordinates are DOFs, the shapes have a row for each of these DOFs. Otherwise the
        shapes phi_k are expanded by ``T phi_k`` and have a row for each DOF of the full structure.
        They are complex where D is not proportional, for example after a damper was added. Massless
        coordinates and overdamped motions give no modes.

        Raises
        ------
        ModelError
            When M is not positive definite, or D damps the rigid-body motions.

        Warns
        -----
        FlexplantWarning
            When overdamped motions have real poles in the frequency range of the modes.
        """
        model, _, _ = self.condensed()
        held, k = model.rigid_body, model.n_dof
        form = normal_form(model.M, model.D, model.K, held, lambda: model.body_motions, lowest=k)
        phi, dofs = form.phi, model.dofs
        if not self.is_physical:
            phi, dofs = model.expand(phi), model.full_dofs
        notes = overdamped_notes(form, float(np.abs(form.poles).max(initial=0.0)))
        return Modes(form.omega, form.zeta, phi, dofs, n_rigid=form.n_rigid, notes=notes)

    def quality(
        self,
        full: FEModel | Modes,
        *,
        band: tuple[float, float],
        inputs: Place | Iterable[Place] = (),
        outputs: Place | Iterable[Place] = (),
        count: int | None = None,
        freq: FloatArray | None = None,
        loss: float | None = None,
    ) -> ReductionQuality:
        """Return the errors of this model relative to the full model, computed independently.

        Parameters
        ----------
        full : FEModel or Modes
            The full structure. Responses of an FEModel are computed from its modes and static
            shapes, and checked by direct solutions with its matrices.
        band : (float, float) [Hz]
            Frequency band of the comparison.
        inputs, outputs : places
            Places of forces and displacements. A place is a DOF label, a point (x, y, z), at which
            the direction is z, or a mapping {label: weight}. Without `inputs`, the channels are
            those of the error bound. With `inputs` but without `outputs`, the displacements are
            taken at the inputs.
        count : int, optional
            Number of modes that are compared. None: all modes up to the end of the band.
        freq : (m,) array [Hz], optional
            Check frequencies. None: the resonances and antiresonances of both models in the band,
            and a grid over the band.
        loss : float, optional
            Loss factor that replaces the damping of both models if the FEModel has no D. Their
            stiffness is then ``K (1 + i loss)``. None: twice the mean damping ratio of the reduced
            model, or 0.01 if that model is undamped.

        Raises
        ------
        ModelError
            When `full` has another type or size, or the band is not valid.
        """
        refuse_unstable(self, "a comparison of responses")
        with Progress(0, "quality"):
            return quality_of(self, full, band, inputs, outputs, count, freq, loss)


def static_followers(
    D: FloatArray, K: FloatArray, light: IntArray
) -> tuple[IntArray, FloatArray, FloatArray, FloatArray]:
    """Return coordinates with mass (c,), the map (k, c) to all, the flexibility and K."""
    # `q_light = -K_ll^-1 K_lh q_heavy + K_ll^-1 f_light`, exactly; the flexibility (k, k) is that
    # of the second term, and K (c, c) the condensed stiffness
    k = K.shape[0]
    heavy = np.setdiff1d(np.arange(k), light)
    if np.any(D[light]):
        raise ModelError("a massless coordinate is damped: give it a mass, or remove the damper.")
    try:
        inverse = la.inv(K[np.ix_(light, light)])
    except la.LinAlgError as error:
        raise ModelError(
            "a massless coordinate has no stiffness, so that nothing holds it. Give it stiffness "
            "or mass."
        ) from error
    flexibility, follow = np.zeros((k, k)), np.eye(k)[:, heavy]
    flexibility[np.ix_(light, light)] = 0.5 * (inverse + inverse.T)
    follow[light] = -inverse @ K[np.ix_(light, heavy)]
    return heavy, follow, flexibility, projected(K, follow)

"""A structure from a finite-element program: M, D, K and the meaning of their rows."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass, field
from functools import cached_property
from typing import TYPE_CHECKING, Any, Self

import numpy as np
import numpy.typing as npt
import scipy.sparse as sp

from ..arrays import FloatArray, IntArray, Matrix, instance, real_array
from ..errors import ModelError, counted, warn
from ..labels import DofSet, Interpolation
from ..sparse.factor import is_positive_definite
from ..sparse.symmetric import matrix_sum, orthonormalised, with_pattern_of
from ..store import Value, frozen
from .additions import Damping, Part, Rayleigh, added_matrices, damping_matrix
from .definite import (
    MatrixLike,
    check_semidefinite,
    digits_of,
    has_negative_springs,
    slow,
    square,
    symmetric_matrix,
    unstable_stiffness,
    without_inertia,
)
from .rigid import Placed, body_motions, force_parts, nearest_free, rigid_body_basis
from .unit_systems import units
from .zero_energy_motions import endangered, held_by_rounding


@dataclass(frozen=True, eq=False, repr=False)
class HeldShape(Interpolation):
    """The interpolation of a structure after some of its DOFs were held by `FEModel.fixed`.

    Parameters
    ----------
    free : Interpolation
        Interpolation of the structure with all its DOFs.
    rows_left : (n,) array of int
        Positions of the remaining DOFs among all DOFs, counted from 0, in ascending order.

    Examples
    --------
    The first node of a beam is clamped, so that four of six DOFs remain:

    >>> import flexplant as fx
    >>> bar = {"length": 0.2, "elements": 2, "area": 1e-4, "inertia": 1e-9}
    >>> beam = fx.beam(**bar, density=7800.0, youngs_modulus=2.1e11)
    >>> held = beam.fixed(["1:z", "1:ry"])
    >>> held.dofs.interpolation
    HeldShape(free=BeamShape(length=0.2, elements=2), rows_left=[2, 3, 4, 5])
    """

    free: Interpolation
    rows_left: IntArray

    def row(self, xyz: FloatArray, direction: str) -> FloatArray:
        """Return the weights (n,) of the n DOFs in the motion `direction` at `xyz` [m]."""
        return np.asarray(self.free.row(xyz, direction)[self.rows_left])

    def rows(self, points: FloatArray, direction: str) -> FloatArray:
        """Return the weights (p, n) at many points (p, 3) [m], with one row for each point."""
        return np.asarray(self.free.rows(points, direction)[:, self.rows_left])

    def dependent(self, label: str) -> tuple[FloatArray, FloatArray] | None:
        """Return the row (n,) and the coordinates (3,) of a DOF that follows others, or None."""
        found = self.free.dependent(label)
        return None if found is None else (found[0][self.rows_left], found[1])


@dataclass(frozen=True, eq=False, repr=False)
class FEModel(Placed, Value):
    """A linear structure ``M q'' + D q' + K q = f`` (equation (1) of [paper]_).

    Parameters
    ----------
    M : (n, n) array or sparse matrix [kg, kg m, kg m^2]
        Mass matrix, symmetric and positive definite.
    K : (n, n) array or sparse matrix [N/m, N, N m]
        Stiffness matrix, symmetric and positive semi-definite. It is singular if motions are free.
        Negative eigenvalues are allowed only for rigid-body motions (springs of negative stiffness,
        such as magnets). K needs double precision. The rounding of a K in single precision may act
        as springs on the rigid-body motions, which leads to an error or a warning.
        ``FEMatrices(K, M, dofs=dofs).model(free=True)`` removes these springs.
    D : (n, n) array or sparse matrix [N s/m, ...], optional
        Damping matrix, symmetric and positive semi-definite. None: the damping is given later, for
        example by ``solve_modes(model, damping=)``.
    dofs : DofSet, optional
        DOFs of the n rows, with coordinates. By default row i is the displacement of node i along
        x, "1:x" to "n:x", with unknown coordinates.
    name : str, optional
        Name of the model, as it is printed.
    held_inertia : (n, 6) array, optional
        Forces ``M_fs r_s`` that the held DOFs s exert on the free DOFs f through the mass matrix
        when the ground accelerates. There is one column for each of the six rigid-body motions of
        the ground about the origin. `fixed` computes them.
    joint_motions : (n, m) array, optional
        M-orthonormal motions that a joined machine makes without deforming: its components move as
        rigid bodies, as far as the joints (a slide, a hinge) allow. They replace the rigid-body
        motions that follow from the coordinates.
    joining : Value, optional
        Record of how a machine was joined, with its checks. None after M or K was changed.

    Raises
    ------
    ShapeError
        When the sizes of the matrices and of `dofs` differ.
    ModelError
        When a matrix is not finite, not symmetric or not (semi-)definite, or K and M are swapped.
        Negative eigenvalues of K are accepted where they move the structure as a rigid body.

    Warns
    -----
    FlexplantWarning
        When K is in single precision, and its rounding stiffens rigid-body motions or changes the
        first elastic eigenvalue. Also when the frequencies of all DOFs are too low for a machine,
        which may mean that K and M are swapped.

    References
    ----------
    [paper]_, equation (1).

    Examples
    --------
    Two masses with a spring, with given DOFs and with default DOFs:

    >>> dofs = DofSet([1, 2], ["x", "x"], [[0, 0, 0], [1, 0, 0]])
    >>> FEModel([[1, 0], [0, 2]], [[5, -5], [-5, 5]], dofs=dofs, name="two masses")
    <FEModel 'two masses': 2 DOFs, dense, 1 rigid-body motion, D not given>
    >>> FEModel([[1, 0], [0, 2]], [[5, -5], [-5, 5]]).dofs.labels
    ('1:x', '2:x')
    """

    M: Matrix
    K: Matrix
    D: Matrix | None = None
    dofs: DofSet = field(default=None, kw_only=True)  # type: ignore[assignment]
    name: str | None = field(default=None, kw_only=True)
    held_inertia: FloatArray | None = field(default=None, kw_only=True)
    joint_motions: FloatArray | None = field(default=None, kw_only=True)
    joining: Value | None = field(default=None, kw_only=True)

    if TYPE_CHECKING:  # the input is any array-like object

        def __init__(
            self,
            M: MatrixLike,
            K: MatrixLike,
            D: MatrixLike | None = None,
            *,
            dofs: DofSet | None = None,
            name: str | None = None,
            held_inertia: npt.ArrayLike | None = None,
            joint_motions: npt.ArrayLike | None = None,
            joining: Value | None = None,
        ) -> None: ...

    def __post_init__(self) -> None:
        given: Any = self.dofs
        if given is None:
            rows = square(self.K, "K").shape[0]
            self._set(dofs=DofSet(range(1, rows + 1), ["x"] * rows))
        n = len(instance(self.dofs, DofSet, "dofs", "Pass DofSet(nodes, directions, xyz)."))
        if not n:
            raise ModelError("the DofSet is empty, it needs at least one DOF. Check the table.")
        instance(self.name, str | None, "name", "Pass text for reports.")
        digits = digits_of(self.K)
        M, K = symmetric_matrix(self.M, "M", n), symmetric_matrix(self.K, "K", n)
        D = None if self.D is None else symmetric_matrix(self.D, "D", n)
        if not is_positive_definite(M):
            raise ModelError(f"M is not positive definite: {without_inertia(M, K)}")
        self._set(M=M, K=K, D=D)
        # a common sparsity pattern is stored once
        self.__dict__.update(M=with_pattern_of(self.M, self.K), D=with_pattern_of(self.D, self.K))
        try:
            check_semidefinite(K, "K")
        except ModelError as error:
            held = None if digits is None else held_by_rounding(K, M, self.dofs, digits)
            if held:
                raise ModelError(f"{error} {held[0].upper()}{held[1:]}") from None
            if not has_negative_springs(self):
                raise
        if D is not None:
            check_semidefinite(D, "D")
        if self.held_inertia is not None:
            self._set(held_inertia=real_array(self.held_inertia, "held_inertia", (n, 6)))
        if self.joint_motions is not None:
            self._set(joint_motions=real_array(self.joint_motions, "joint_motions", (n, None)))
        remarks: list[str | None] = [slow(M, K, self.dofs.directions)]
        if digits is not None:
            remarks.append(endangered(K, M, digits))
            remarks.append(held_by_rounding(K, M, self.dofs, digits, self.rigid_body))
        for said in filter(None, remarks):
            warn(f"{self.name or 'K'}: {said}")

    def __repr__(self) -> str:
        named = f" {self.name!r}" if self.name else ""
        kind = "sparse" if sp.issparse(self.K) else "dense"
        r = self.rigid_body.shape[1]
        rigid = counted(r, "rigid-body motion") if r else "no rigid-body motions"
        damping = "not given" if self.D is None else "given"
        size = counted(self.n_dof, "DOF")
        if self.n_unstable:
            rigid += f", {self.n_unstable} unstable (negative stiffness)"
        return f"<FEModel{named}: {size}, {kind}, {rigid}, D {damping}>"

    @property
    def n_dof(self) -> int:
        """Number of degrees of freedom n."""
        return len(self.dofs)

    @cached_property
    def rigid_body(self) -> FloatArray:
        """The rigid-body motions R (n, r), with ``K R = 0`` and ``R^T M R = I``.

        They follow from the coordinates and are therefore exact. The order is x, y, z, rx, ry, rz,
        and rotations turn about the centre of gravity. Motions in which the structure is not free
        are left out. A held structure has no such motions, and the array is (n, 0). Even a soft
        spring holds a motion. Pieces that neither K nor M connects have separate motions, and those
        of the largest piece come first. If the coordinates have few digits (down to four), the
        rotations are the null vectors of K that are closest to the rotations of the geometry.
        """
        return np.asarray(
            frozen(rigid_body_basis(self.M, self.K, self.body_motions, self.dofs.xyz))
        )

    @cached_property
    def body_motions(self) -> FloatArray:
        """The M-orthonormal rigid-body motions (n, r), whether the structure is held or not.

        Parts of the structure that nothing joins have separate motions.
        """
        if self.joint_motions is None:
            motions = body_motions(self.M, self.K, self.dofs)
        else:
            # masses or held DOFs may have been added after joining
            given = nearest_free(self.K, self.joint_motions)
            motions = orthonormalised(self.M, given, dependent="drop")
        return np.asarray(frozen(motions))

    @cached_property
    def n_unstable(self) -> int:
        """Number of rigid-body motions that springs of negative stiffness make unstable."""
        if self.rigid_body.shape[1] == self.body_motions.shape[1]:
            return 0
        return int(unstable_stiffness(self.K, self.body_motions).size)

    def inertia(self, motions: FloatArray) -> FloatArray:
        """Return the inertia loads (n, r) of motions (n, r): the product ``M @ motions``."""
        return np.asarray(self.M @ motions)

    def ground_inertia(self, ground: FloatArray) -> FloatArray:
        """Return the inertia load (n,) ``M_ff r_f + M_fs r_s`` of a motion (6,) of the ground.

        The motion holds x, y, z, rx, ry, rz, with rotations about the origin. f marks the free DOFs
        and s the held DOFs, and r_f and r_s are their displacements in this motion. M_fs is known
        only for DOFs that `fixed` holds.
        """
        load = self.inertia(self.rigid_motions() @ ground)
        return load if self.held_inertia is None else load + self.held_inertia @ ground

    def missed_motions(self, about: Iterable[float] = (0.0, 0.0, 0.0)) -> FloatArray:
        """Return how much the DOFs held by `fixed` prevent each of six rigid-body motions (6,).

        The argument `about` is the point [m] about which rotations turn. Springs to ground do not
        count, since the DOFs can still make the motion. For a motion r the result is ``max |K r|_i
        / max (|K| |r|)_i``, where the force on DOF i is divided by the square root of K_ii. The
        terms of K r cancel everywhere except next to held DOFs. The result is therefore 0 for a
        motion that no held DOF prevents.
        """
        if self.held_inertia is None:
            return np.zeros(6)
        return force_parts(self.K, self.rigid_motions(about))

    @property
    def mass(self) -> float:
        """Total mass [kg]: the inertia against translation in one direction."""
        for direction in ("x", "y", "z"):
            if direction in self.dofs.directions:
                moved = np.array([d == direction for d in self.dofs.directions], dtype=np.float64)
                return float(moved @ (self.M @ moved))
        raise ModelError(
            "the model has no translational DOF, so that its mass is not known. Compute "
            "rotation^T M rotation instead, an inertia."
        )

    def with_damping(self, damping: Damping | MatrixLike) -> FEModel:
        """Return the model with the matrix D of a damping law, or with a measured D.

        Modal damping is ``D = M Phi 2 Z Omega Phi^T M`` with the shapes Phi of all n modes. This is
        a full matrix. Rayleigh damping is ``alpha M + beta K``. Both leave rigid-body motions
        undamped, unless the argument `rigid` of the law was given.

        Parameters
        ----------
        damping : ModalDamping, Rayleigh or (n, n) matrix [N s/m, ...]
            Damping law, or D itself. It replaces the previous D, including its dampers.

        Raises
        ------
        ModelError
            When the model is too large for the full D of modal damping, or when a given D is not
            symmetric or not positive semi-definite.
        """
        if not isinstance(damping, Damping):
            if not (sp.issparse(damping) or isinstance(damping, np.ndarray | list)):
                raise ModelError(
                    f"damping must be a ModalDamping, a Rayleigh or a matrix D, "
                    f"got {type(damping).__name__}. Give ModalDamping(0.01) for 1 % in all modes."
                )
            D = symmetric_matrix(damping, "D", self.n_dof)
            check_semidefinite(D, "D")
            return self._with(D=frozen(D))
        free = self.rigid_body.shape[1] > 0
        if isinstance(damping, Rayleigh) and damping.beta and self.n_unstable:
            raise ModelError(
                "Rayleigh damping beta K of a structure on springs of negative stiffness feeds "
                "energy in. Damp the free structure and suspend it then, or use ModalDamping."
            )
        if isinstance(damping, Rayleigh) and not (free and damping.alpha and not damping.rigid):
            return self._with(D=frozen(damping.alpha * self.M + damping.beta * self.K))
        D = damping_matrix(self.K, self.M, self.rigid_body, damping, lambda: self.body_motions)
        return self._with(D=frozen(D))

    def with_parts(self, parts: Iterable[Part] | Part) -> FEModel:
        """Return the model with point masses, springs and dampers added.

        Each part adds ``weight row^T row`` to M, K or D. The weight is its mass, stiffness or
        damping. The row gives the motion at its place, interpolated if it lies between nodes.

        Parameters
        ----------
        parts : PointMass, Spring, Damper, or a sequence of them
            Parts to add.

        Examples
        --------
        >>> from flexplant.structure import Damper, PointMass, Spring, chain
        >>> chain(masses=[1, 2], stiffnesses=[5]).with_parts([
        ...     PointMass("1:x", 0.5), Spring("1:x", 100.0), Damper("1:x", 0.2, to="2:x")])
        <FEModel 'chain': 2 DOFs, sparse, no rigid-body motions, D given>
        """
        added = added_matrices(self.dofs, parts)
        # sums of definite matrices are definite, so that no new check is needed
        return self._with(
            **{name: frozen(matrix_sum(getattr(self, name), more)) for name, more in added.items()}
        )

    def fixed(self, labels: Iterable[str]) -> FEModel:
        """Return the model with some DOFs held still: their rows and columns are taken out.

        Points between nodes can still be used. When the ground moves, the mass of the held DOFs
        causes forces on the free DOFs. These are kept in `held_inertia`. Parts that are added later
        act on free DOFs only.

        Parameters
        ----------
        labels : sequence of str, or DofSet
            DOFs that do not move. For example, ``model.dofs.where(directions="z", box=...)``
            returns the DOFs of an edge.

        Examples
        --------
        >>> from flexplant.structure import chain
        >>> chain(masses=[1, 2], stiffnesses=[5]).fixed(["1:x"])
        <FEModel 'chain': 1 DOF, sparse, no rigid-body motions, D not given>
        """
        held = np.zeros(self.n_dof, dtype=bool)
        held[self.dofs.indices(labels)] = True
        rows, still = np.flatnonzero(~held), np.flatnonzero(held)
        if not rows.size:
            raise ModelError(
                f"all {self.n_dof} DOFs would be fixed: nothing moves. Fix fewer of them."
            )
        shape = self.dofs.interpolation
        if shape is not None:
            shape = HeldShape(shape, rows)
        M: Any = self.M
        load = np.asarray(M[rows][:, still] @ self.rigid_motions()[still])
        if self.held_inertia is not None:
            load = load + self.held_inertia[rows]
        return self._with(
            **{
                name: None if matrix is None else frozen(matrix[rows][:, rows])
                for name, matrix in (("M", self.M), ("K", self.K), ("D", self.D))
            },
            held_inertia=frozen(load),
            joint_motions=None if self.joint_motions is None else frozen(self.joint_motions[rows]),
            dofs=self.dofs._taken(rows).replace(interpolation=shape),
        )

    def converted(
        self, *, length: str | float = "m", mass: str | float = "kg", time: str | float = "s"
    ) -> FEModel:
        """Return the model in SI units, from numbers in the given units.

        Coordinates are scaled as well. Rotations are in radians before and after.

        Parameters
        ----------
        length, mass, time : str or float
            Present units, such as "mm", "t", "s", or the size of each unit in SI units. The unit of
            force follows from them. It is N for mm, t and s.

        Raises
        ------
        ModelError
            When a unit is unknown, or the model has an interpolation. Convert the model before
            `interpolated` adds one.

        Examples
        --------
        >>> dofs = DofSet([1, 2], ["x", "x"], [[0, 0, 0], [250, 0, 0]])
        >>> model = FEModel([[0.001, 0], [0, 0.002]], [[5, -5], [-5, 5]], dofs=dofs)
        >>> si = model.converted(length="mm", mass="t")
        >>> si.M[0, 0], si.K[0, 0], si.dofs.xyz[1, 0]
        (np.float64(1.0), np.float64(5000.0), np.float64(0.25))
        """
        unit, load = units(length, mass, time), self.held_inertia
        given = {"M": self.M, "K": self.K} | ({} if self.D is None else {"D": self.D})
        return self._with(
            held_inertia=None if load is None else frozen(unit.ground_load(load, self.dofs)),
            **{name: frozen(A) for name, A in unit.matrices(given, self.dofs).items()},
            dofs=unit.placed(self.dofs),
        )

    @classmethod
    def _proven(cls, **fields: Any) -> Self:
        """Return a model whose matrices are known to be symmetric and definite, and read-only."""
        # without the checks of the constructor: a factorisation that proves it again takes longer
        # than everything before
        model = object.__new__(cls)
        for name, value in fields.items():
            object.__setattr__(model, name, value)
        return model

    def with_unchecked_damping(self, D: Matrix) -> Self:
        """Return the model with a D that is not checked, since it is known to be valid."""
        return self._with(D=frozen(D))

    def _with(self, **changes: Any) -> Self:
        changes = changes if {"M", "K"}.isdisjoint(changes) else {"joining": None} | changes
        return type(self)._proven(**(self._fields() | changes))

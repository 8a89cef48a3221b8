"""A structure as a finite-element program leaves it: M, D, K and the meaning of their rows."""

from __future__ import annotations

from dataclasses import dataclass, field
from functools import cached_property
from typing import Any, cast

import numpy as np
import scipy.sparse as sp

from ..errors import ModelError, ShapeError
from ..labels import DofSet
from ..values import FloatArray, Matrix, Value, real_array
from .damping import Damping, Rayleigh
from .eigen import elastic_modes
from .factor import DENSE_LIMIT, dense, diagonal, is_positive_definite, unit_diagonal
from .rigid import rigid_body_basis

#: relative to the diagonal: entries of a symmetric matrix differ by less from their mirror images
_SYMMETRY_TOLERANCE = 1e-9
#: relative to the diagonal: K and D may have eigenvalues this far below zero
_SEMIDEFINITE_TOLERANCE = 1e-9
#: modal damping over all modes fills D; beyond this it would not fit the memory comfortably
_DENSE_DAMPING_LIMIT = 5000


@dataclass(frozen=True, eq=False, repr=False)
class FEModel(Value):
    """A linear structure ``M q'' + D q' + K q = f`` (paper, eq. (1)).

    Parameters
    ----------
    M : (n, n) array or sparse matrix [kg, kg m, kg m^2]
        Mass: symmetric, positive definite.
    K : (n, n) array or sparse matrix [N/m, N, N m]
        Stiffness: symmetric, positive semi-definite; singular for a free structure.
    D : (n, n) array or sparse matrix [N s/m, ...], optional
        Viscous damping: symmetric, positive semi-definite. None: damping is given later, by mode.
    dofs : DofSet
        What the n rows stand for, with coordinates.
    name : str, optional
        For display.

    Raises
    ------
    ShapeError
        When the sizes of the matrices and of `dofs` differ.
    ModelError
        When a matrix is not finite, not symmetric, or M, K, D are not (semi-)definite.

    Examples
    --------
    >>> dofs = DofSet([1, 2], ["x", "x"], [[0, 0, 0], [1, 0, 0]])
    >>> FEModel([[1, 0], [0, 2]], [[5, -5], [-5, 5]], dofs=dofs, name="two masses")
    <FEModel 'two masses': 2 DOFs, dense, 1 rigid-body motion, D not given>
    """

    M: Matrix
    K: Matrix
    D: Matrix | None = None
    dofs: DofSet = field(kw_only=True)
    name: str | None = field(default=None, kw_only=True)

    def __post_init__(self) -> None:
        if not isinstance(self.dofs, DofSet):
            raise ModelError(
                f"dofs must be a DofSet, got {type(self.dofs).__name__}: it says what the rows of "
                "M and K are. DofSet(nodes, directions, xyz) or DofSet.from_table(...)."
            )
        n = len(self.dofs)
        if not n:
            raise ModelError("the DofSet holds no DOF: there is no structure. Check the table.")
        M, K = _symmetric(self.M, "M", n), _symmetric(self.K, "K", n)
        D = None if self.D is None else _symmetric(self.D, "D", n)
        if not is_positive_definite(M):
            raise ModelError(
                f"M is not positive definite: {_lowest(M)}. Some motion would have no inertia, or "
                "a negative one. Condense massless DOFs out, or look for a sign."
            )
        for name, matrix in (("K", K), ("D", D)):
            if matrix is not None and not _is_semidefinite(matrix):
                raise ModelError(
                    f"{name} is not positive semi-definite: {_lowest(matrix)}. The structure would "
                    f"{'be unstable' if name == 'K' else 'feed energy in'}. Look for a sign or "
                    "for swapped arguments (the order is M, K, D)."
                )
        self._set(M=M, K=K, D=D)

    def __repr__(self) -> str:
        named = f" {self.name!r}" if self.name else ""
        kind = "sparse" if sp.issparse(self.K) else "dense"
        r = self.rigid_body.shape[1]
        rigid = f"{r} rigid-body motion{'s' * (r != 1)}" if r else "no rigid-body motions"
        damping = "not given" if self.D is None else "given"
        return f"<FEModel{named}: {self.n_dof} DOFs, {kind}, {rigid}, D {damping}>"

    @property
    def n_dof(self) -> int:
        """Number of degrees of freedom n."""
        return len(self.dofs)

    @cached_property
    def rigid_body(self) -> FloatArray:
        """The rigid-body motions (n, r), ``K R = 0`` and ``R^T M R = I``.

        From the coordinates, hence exact: translations first, then rotations about the centre of
        gravity, in the order x, y, z, rx, ry, rz of those that exist; (n, 0) when held.
        """
        basis = rigid_body_basis(self.M, self.K, self.dofs)
        basis.flags.writeable = False
        return basis

    @property
    def mass(self) -> float:
        """Total mass [kg]: the inertia against translation in one direction.

        Raises
        ------
        ModelError
            When the model has no translational DOF.
        """
        for direction in ("x", "y", "z"):
            if direction in self.dofs.directions:
                moved = np.array([d == direction for d in self.dofs.directions], dtype=np.float64)
                return float(moved @ (self.M @ moved))
        raise ModelError("the model has no translational DOF, so that its mass is not known.")

    def with_damping(self, damping: Damping) -> FEModel:
        """Return the model with the matrix D of a damping law.

        Modal damping is ``D = M Phi 2 Z Omega Phi^T M`` over all n modes: a full matrix. Rayleigh
        damping is ``alpha M + beta K``, less what alpha would do to rigid-body motions: these are
        undamped in both.

        Parameters
        ----------
        damping : ModalDamping or Rayleigh
            The law.

        Raises
        ------
        ModelError
            When a full D is needed and the model is too large for one.
        """
        if not isinstance(damping, Damping):
            raise ModelError(
                f"damping must be a ModalDamping or Rayleigh, got {type(damping).__name__}."
            )
        free = self.rigid_body.shape[1] > 0
        if isinstance(damping, Rayleigh) and not (free and damping.alpha):
            return self.replace(D=damping.alpha * self.M + damping.beta * self.K)
        if self.n_dof > _DENSE_DAMPING_LIMIT:
            raise ModelError(
                f"this damping gives a full D, too large for {self.n_dof} DOFs (limit "
                f"{_DENSE_DAMPING_LIMIT}). Pass it to solve_modes(model, damping=...) instead."
            )
        return self.replace(D=_full_damping(self, damping))


def _full_damping(model: FEModel, damping: Damping) -> FloatArray:
    M, K, rigid = dense(model.M), dense(model.K), model.rigid_body
    loaded = M @ rigid
    if isinstance(damping, Rayleigh):
        return damping.alpha * (M - loaded @ loaded.T) + damping.beta * K
    elastic, phi = elastic_modes(M, K, rigid)
    r = rigid.shape[1]
    zeta = damping.zeta(np.concatenate([np.zeros(r), elastic]))[r:]
    forces = M @ phi
    D = (forces * (2 * zeta * elastic)) @ forces.T
    return np.asarray(0.5 * (D + D.T), dtype=np.float64)


def _symmetric(given: Any, name: str, n: int) -> Matrix:
    value, matrix = given, cast(Any, None)
    if sp.issparse(given):
        if value.shape != (n, n):
            raise ShapeError(f"{name} must have shape ({n}, {n}), got {value.shape}.")
        matrix = sp.csc_array(value)
        matrix = sp.csc_array(
            (real_array(matrix.data, f"stored entries of {name}"), matrix.indices, matrix.indptr),
            shape=(n, n),
        )
    else:
        matrix = real_array(value, name, (n, n))
    scaled, _ = unit_diagonal(matrix)
    skew: Any = abs(scaled - scaled.T)
    worst = float(skew.max()) if n else 0.0
    if worst > _SYMMETRY_TOLERANCE:
        i, j = (int(k) for k in np.unravel_index(skew.argmax(), (n, n)))
        raise ModelError(
            f"{name} is not symmetric: entry ({i}, {j}) is {matrix[i, j]:.6g} and ({j}, {i}) is "
            f"{matrix[j, i]:.6g} (counted from 0). Reciprocity would not hold. Symmetrise it, "
            f"0.5 * ({name} + {name}.T), when the difference is only rounding."
        )
    return cast(Matrix, matrix)


def _is_semidefinite(matrix: Matrix) -> bool:
    if sp.issparse(matrix) and matrix.shape[0] > DENSE_LIMIT:
        # the factorisation in solve_modes finds the rest; here it would double the cost
        return not np.any(diagonal(matrix) < 0)
    return is_positive_definite(matrix, _SEMIDEFINITE_TOLERANCE)


def _lowest(matrix: Matrix) -> str:
    entries = diagonal(matrix)
    i = int(np.argmin(entries))
    if entries[i] <= 0:
        return f"its diagonal entry {i} (from 0) is {entries[i]:.3g}"
    if matrix.shape[0] > DENSE_LIMIT:
        return "its factorisation has negative pivots"
    lowest = np.linalg.eigvalsh(dense(unit_diagonal(matrix)[0]))[0]
    return f"scaled to a unit diagonal its lowest eigenvalue is {lowest:.3g}"

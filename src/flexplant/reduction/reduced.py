"""A structure in a few of its own physical degrees of freedom."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from ..labels import DofSet, Place
from ..values import ComplexArray, FloatArray, Value, positive, real_array
from .modes import Modes
from .normal_form import normal_form


@dataclass(frozen=True, eq=False, repr=False)
class ReducedModel(Value):
    """A reduced structure ``M* q_k'' + D* q_k' + K* q_k = T^T f``, ``q_n = T q_k``.

    Parameters
    ----------
    M, D, K : (k, k) arrays
        The paper's M*, D*, K* of equation (8), in the physical DOFs `dofs`.
    T : (n, k) array
        Expansion to the full structure, equations (4) and (7).
    dofs : DofSet
        The k desired DOFs.
    full_dofs : DofSet
        The n DOFs of the full structure, with its shape functions.
    rigid_body : (k, r) array
        Rigid-body motions in the desired DOFs: ``K rigid_body = 0``. Eigenvalues of (K*, M*)
        alone would have them at rounding, some imaginary.
    method : str
        How it was made.
    condition : float
        Condition number of phi_kk.

    Raises
    ------
    ShapeError, ModelError
        When sizes do not match or entries are not finite.
    """

    M: FloatArray
    D: FloatArray
    K: FloatArray
    T: FloatArray
    dofs: DofSet
    full_dofs: DofSet
    rigid_body: FloatArray
    method: str = ""
    condition: float = 1.0

    def __post_init__(self) -> None:
        k, n = len(self.dofs), len(self.full_dofs)
        self._set(
            M=real_array(self.M, "M", (k, k)),
            D=real_array(self.D, "D", (k, k)),
            K=real_array(self.K, "K", (k, k)),
            T=real_array(self.T, "T", (n, k)),
            rigid_body=real_array(self.rigid_body, "rigid_body", (k, None)),
            condition=positive(self.condition, "condition"),
        )

    def __repr__(self) -> str:
        return (
            f"<ReducedModel: {len(self.dofs)} of {len(self.full_dofs)} DOFs by {self.method}, "
            f"{self.rigid_body.shape[1]} rigid-body motions, cond(phi_kk) {self.condition:.3g}>"
        )

    @property
    def n_dof(self) -> int:
        """Number of DOFs k."""
        return len(self.dofs)

    def modes(self) -> Modes:
        """Return all k modes, shapes in the desired DOFs; rigid-body ones exactly at 0.

        Complex where D is not proportional (after a damper was added). `expand` gives the shapes
        of the full structure.

        Raises
        ------
        ModelError
            When M is no longer positive definite, D drags the rigid-body motions, or a mode is
            overdamped.
        """
        form = normal_form(self.M, self.D, self.K, self.rigid_body)
        omega = np.abs(form.poles)
        r = form.n_rigid
        zeta = np.concatenate([np.zeros(r), -form.poles[r:].real / omega[r:]])
        return Modes(omega, zeta, form.phi, self.dofs, n_rigid=r)

    def expand(self, q: FloatArray | ComplexArray) -> FloatArray | ComplexArray:
        """Return the motion ``T q`` of all n DOFs, of motions (k,) or (k, m) of the desired ones.

        Shapes may be complex.

        Raises
        ------
        ShapeError
            When there are not k rows.
        """
        if np.iscomplexobj(q):
            parts = np.asarray(q)
            return np.asarray(self.expand(parts.real) + 1j * self.expand(parts.imag))
        shape = (self.n_dof,) if np.ndim(q) == 1 else (self.n_dof, None)
        return np.asarray(self.T @ real_array(q, "q", shape))

    def row(self, at: Place, direction: str = "z") -> FloatArray:
        """Return the row (k,) that gives the motion at a place of the full structure.

        Its transpose is the reduced load f* of a unit force there.

        Parameters
        ----------
        at : str, (3,) array [m] or mapping
            A DOF label, a point, or {label: weight}: any of the full structure, not only of the
            desired DOFs.
        direction : str
            The motion at a point.

        Raises
        ------
        LabelError
            When the place is unknown.
        """
        return np.asarray(self.full_dofs.row(at, direction) @ self.T)

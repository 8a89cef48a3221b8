"""Ways to reduce a structure; each is a small value given to `reduce`."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass

import numpy as np
import scipy.linalg as la

from ..errors import LabelError, ModelError, ShapeError
from ..values import Value
from .modes import Modes
from .reduced import ReducedModel

#: beyond this, rounding in K* (eps cond^2) spoils the low modes
_CONDITION_LIMIT = 1e6


class ReductionMethod(Value):
    """A way to go from modes to a reduced model."""

    def reduced(self, modes: Modes) -> ReducedModel:
        """Return the reduced model."""
        raise NotImplementedError


@dataclass(frozen=True, eq=False, repr=False)
class DesiredDofs(ReductionMethod):
    """Modal reduction in desired physical DOFs (paper, eq. (6) to (8)).

    Parameters
    ----------
    dofs : sequence of str, DofSet or DofSelection
        As many labels as there are modes plus attachment vectors.

    Raises
    ------
    LabelError
        When a label appears twice.
    """

    dofs: Iterable[str]

    def __post_init__(self) -> None:
        labels = (self.dofs,) if isinstance(self.dofs, str) else tuple(str(d) for d in self.dofs)
        doubled = sorted({label for label in labels if labels.count(label) > 1})
        if doubled:
            raise LabelError(f"desired DOFs {doubled} appear twice: phi_kk would be singular.")
        self._set(dofs=labels)

    def __repr__(self) -> str:
        labels = list(self.dofs)
        more = f", ... {labels[-1]}" if len(labels) > 3 else ""
        return f"<DesiredDofs: {len(labels)} ({', '.join(labels[:3])}{more})>"

    def reduced(self, modes: Modes) -> ReducedModel:
        """Return the model in these DOFs; `reduce` is the public way."""
        labels = list(self.dofs)
        rows = modes.dofs.indices(labels)
        k = modes.n_modes + modes.n_vectors
        if np.iscomplexobj(modes.phi):
            raise ModelError(
                "these modes are complex (the damping is not proportional), and equation (5) has "
                "no diagonal form. Solve with damping=ModalDamping(...), reduce, and add the "
                "dampers to the reduced model."
            )
        if len(labels) != k:
            raise ShapeError(
                f"{len(labels)} desired DOFs for {modes.n_modes} modes plus {modes.n_vectors} "
                f"attachment vectors = {k}: phi_kk in equation (7) must be square. "
                + (
                    f"Name {k - len(labels)} more DOFs or keep fewer modes"
                    if len(labels) < k
                    else f"Leave out {len(labels) - k} DOFs or keep more modes"
                )
                + f"; select_dofs(modes, {k}) finds a good set."
            )
        basis = np.asarray(modes.basis, dtype=np.float64)
        partition = basis[rows]
        singular = la.svdvals(partition)
        condition = float(singular[0] / singular[-1]) if singular[-1] > 0 else np.inf
        if not condition < _CONDITION_LIMIT:
            raise ModelError(
                f"phi_kk is near singular: condition {condition:.3g} (limit "
                f"{_CONDITION_LIMIT:.0e}). The desired DOFs do not tell the {k} modes and vectors "
                f"apart, and M*, K* would be rounding. Choose others: select_dofs(modes, {k}, "
                "required=[those that must stay])."
            )
        inverse = la.inv(partition)
        omega, zeta = modes.basis_omega, modes.basis_zeta
        return ReducedModel(
            M=inverse.T @ inverse,
            D=(inverse.T * (2 * zeta * omega)) @ inverse,
            K=(inverse.T * omega**2) @ inverse,
            T=la.solve(partition.T, basis.T).T,
            dofs=modes.dofs.select(labels),
            full_dofs=modes.dofs,
            rigid_body=partition[:, : modes.n_rigid],
            method=f"{modes.n_modes} modes and {modes.n_vectors} attachment vectors",
            condition=condition,
        )


def reduce(modes: Modes, method: ReductionMethod) -> ReducedModel:
    """Return a reduced model of a structure.

    Parameters
    ----------
    modes : Modes
        Of `solve_modes`, with attachment vectors where the static compliance matters.
    method : DesiredDofs
        How to reduce.

    Returns
    -------
    ReducedModel
        In physical DOFs; its modes are those given.

    Raises
    ------
    ShapeError
        When the number of desired DOFs is not that of modes plus attachment vectors.
    ModelError
        When phi_kk is near singular, or the modes are complex.
    LabelError
        When a DOF is unknown.
    """
    if not isinstance(modes, Modes) or not isinstance(method, ReductionMethod):
        raise ModelError(
            f"reduce needs Modes and a method, got {type(modes).__name__} and "
            f"{type(method).__name__}: reduce(solve_modes(model, count=24), DesiredDofs([...]))."
        )
    return method.reduced(modes)

"""The answer of an update: parameters, their doubt, and the model that has become the machine's."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np

from ..errors import unknown_label
from ..reduction import Modes, solve_modes
from ..values import ComplexArray, FloatArray, Value


@dataclass(frozen=True, eq=False, repr=False)
class History(Value):
    """The iterations of an update, the start first.

    Parameters
    ----------
    parameters : (i + 1, q) array [kg, N s/m, N/m]
        Values of the parameters.
    eigenvalues : (i + 1, m) complex array [rad/s]
        The model's eigenvalues, paired with the measured ones.
    error : (i + 1,) array
        ``e_i`` of the paper's (12).
    fraction : (i + 1,) array
        The part of the Gauss-Newton step that was taken; 1 but where the safeguard halved it,
        0 for the start.
    """

    parameters: FloatArray
    eigenvalues: ComplexArray
    error: FloatArray
    fraction: FloatArray

    def __post_init__(self) -> None:
        self._set(
            parameters=self.parameters,
            eigenvalues=self.eigenvalues,
            error=self.error,
            fraction=self.fraction,
        )

    def __len__(self) -> int:
        return int(self.error.size) - 1

    def __repr__(self) -> str:
        halved = int(np.sum(self.fraction[1:] < 1))
        return (
            f"<History: {len(self)} steps ({halved} shortened), "
            f"error {self.error[0]:.3g} -> {self.error[-1]:.3g}>"
        )


@dataclass(frozen=True, eq=False, repr=False)
class UpdateResult(Value):
    """What `update` found.

    Parameters
    ----------
    parameters : sequence of q str
        Names, in the order given.
    units : sequence of q str
        Their units.
    values : (q,) array
        The estimate.
    covariance : (q, q) array or None
        Of the estimate. With measured covariances C: ``G C G^T`` of the linear estimator
        ``G = (J^T W J)^-1 J^T W`` with J = [Re S; Im S], whatever the weights. Without:
        ``s^2 (J^T W J)^-1`` with the residual variance ``s^2 = e / (2 m - q)``, so weights are
        relative; it then holds the model's own error too. None when neither is known (no
        covariance and 2 m = q).
    correlation : (q, q) array
        The correlation of the estimate for errors of covariance W^-1 (of `covariance` where
        there is one).
    model : ReducedModel or FEModel
        Of the kind given, with M, D and K changed.
    history : History
        Iterations.
    converged : bool
        Whether a tolerance was met.
    reason : str
        Why the iteration ended.
    """

    parameters: tuple[str, ...]
    units: tuple[str, ...]
    values: FloatArray
    covariance: FloatArray | None
    correlation: FloatArray
    model: Any
    history: History
    converged: bool
    reason: str

    def __post_init__(self) -> None:
        self._set(values=self.values, covariance=self.covariance, correlation=self.correlation)

    def __getitem__(self, name: str) -> float:
        if name not in self.parameters:
            raise unknown_label("parameter", name, self.parameters)
        return float(self.values[self.parameters.index(name)])

    @property
    def std(self) -> FloatArray | None:
        """Standard deviations (q,) of the estimate, None when the covariance is not known."""
        return None if self.covariance is None else np.sqrt(np.diag(self.covariance))

    def __repr__(self) -> str:
        std = self.std
        doubts = [""] * len(self.parameters) if std is None else [f" +- {s:.2g}" for s in std]
        lines = [
            f"  {name} = {value:.7g}{doubt} {unit}"
            for name, value, doubt, unit in zip(
                self.parameters[:5], self.values.tolist(), doubts, self.units, strict=False
            )
        ]
        if len(self.parameters) > 5:
            lines.append(f"  ... and {len(self.parameters) - 5} more")
        said = "converged" if self.converged else "NOT CONVERGED"
        head = f"<UpdateResult: {said} in {len(self.history)} steps ({self.reason})"
        return "\n".join([head, *lines]) + ">"

    def modes(self) -> Modes:
        """Return the modes of the updated model on all DOFs of the structure.

        Those of a reduced model are expanded by the paper's (7) and (4): ``phi_n = T phi_k``.

        Returns
        -------
        Modes
            Over `model.full_dofs`.

        Raises
        ------
        ModelError
            When dampers to the ground drag the rigid-body modes.
        """
        if not hasattr(self.model, "T"):
            return solve_modes(self.model)
        reduced: Modes = self.model.modes()
        return reduced.replace(phi=self.model.T @ reduced.phi, dofs=self.model.full_dofs)

"""Gauss-Newton on complex eigenvalues: the paper's equations (9) to (14)."""

from __future__ import annotations

import warnings
from collections.abc import Sequence
from typing import Any

import numpy as np
import scipy.sparse as sp

from ..errors import FlexplantWarning, ModelError
from ..structure.rigid import orthonormalised
from ..values import ComplexArray, FloatArray, Matrix, positive
from .parameters import Parameter
from .pencil import Family
from .residuals import Data, Eigenvalues, checked_data
from .result import History, UpdateResult
from .sensitivity import checked_parameters, checked_values, mode_columns
from .steps import Iterate, advance, slopes, solve


def update(
    model: Any,
    parameters: Sequence[Parameter],
    residuals: Sequence[Eigenvalues],
    *,
    start: Sequence[float] | FloatArray | None = None,
    max_iterations: int = 20,
    tolerance: float = 1e-10,
) -> UpdateResult:
    """Find the parameters with which the model has the measured eigenvalues.

    Gauss-Newton with real unknowns in complex equations, the paper's (13) and (14)::

        Re[S^H W S] dp = Re[S^H W d lambda],    p <- p + dp

    Modes are found by their number in the model at `start` and followed by shape (see
    `flexplant.updating.pairing`), so they may swap order on the way. Modes that are exactly
    repeated there are first turned to the vectors in which the step splits them, the lower mode
    number going to the lower frequency. Steps are halved while M or K would become indefinite,
    a measured mode would cease to oscillate, or the error (12) would grow.

    Parameters
    ----------
    model : ReducedModel or FEModel
        The model; an FEModel is treated densely.
    parameters : sequence of q Parameter
        `AddedMass`, `AddedDamping`, `AddedStiffness`.
    residuals : sequence of Eigenvalues
        What to fit: m eigenvalues altogether.
    start : (q,) array [kg, N s/m, N/m], optional
        Values to begin with; zeros when not given.
    max_iterations : int
        Most Gauss-Newton steps.
    tolerance : float
        Done when a full step, or the residual, changes no eigenvalue by more than this,
        relatively.

    Returns
    -------
    UpdateResult
        With `converged` False, and a FlexplantWarning, when the tolerance was not met.

    Raises
    ------
    ModelError
        When the measured eigenvalues do not depend on a parameter or cannot tell some apart (S is
        singular), or the matrices are indefinite at `start`.
    LabelError
        When a mode number or a place is unknown.
    SolverError
        When no part of a step keeps the model physical.

    References
    ----------
    The paper, section 3.
    """
    listed = checked_parameters(parameters)
    data = checked_data(residuals)
    most = _checked_count(max_iterations)
    enough = positive(tolerance, "tolerance")
    family = Family(model, listed)
    p = checked_values(start, listed, "start")
    eigen = family.at(p)
    columns = mode_columns(data.modes, eigen)
    labels = np.arange(eigen.n_rigid + 1, eigen.n_rigid + eigen.poles.size + 1)
    now = Iterate(p, eigen, labels, columns)
    trail = [(now.p, now.poles, data.error(now.poles), 0.0)]
    S, now = slopes(family, data, now)
    step = solve(family, data, S, data.target - now.poles)
    converged, reason = _met(data, now, enough), "residual below the tolerance"
    while not converged:
        reason = "max_iterations reached"
        if len(trail) > most:
            break
        size = float(np.max(np.abs(S @ step) / np.abs(now.poles)))
        accepted = advance(family, data, now, step)
        if accepted is None:
            converged = size < enough
            reason = "step below the tolerance" if converged else "no part of a step helps"
            break
        now, fraction = accepted
        trail.append((now.p, now.poles, data.error(now.poles), fraction))
        S, now = slopes(family, data, now)
        step = solve(family, data, S, data.target - now.poles)
        if _met(data, now, enough):
            converged, reason = True, "residual below the tolerance"
        elif size < enough and fraction == 1.0:
            converged, reason = True, "step below the tolerance"
    if not converged:
        warnings.warn(
            f"the update did not converge in {len(trail) - 1} steps: {reason}, error "
            f"{trail[-1][2]:.3g} from {trail[0][2]:.3g}. Look at .history; try other mode "
            "numbers, start= or more iterations.",
            FlexplantWarning,
            stacklevel=2,
        )
    covariance, correlation = _doubt(data, S, now)
    return UpdateResult(
        parameters=tuple(q.name for q in listed),
        units=tuple(q.unit for q in listed),
        values=now.p,
        covariance=covariance,
        correlation=correlation,
        model=_changed(model, family, now.p),
        history=History(*(np.array(part) for part in zip(*trail, strict=True))),
        converged=converged,
        reason=reason,
    )


def _met(data: Data, now: Iterate, tolerance: float) -> bool:
    return bool(np.max(np.abs(data.target - now.poles) / np.abs(data.target)) < tolerance)


def _doubt(data: Data, S: ComplexArray, now: Iterate) -> tuple[FloatArray | None, FloatArray]:
    """Return covariance (or None) and correlation of the estimate."""
    J = data.stacked(S)
    length = np.linalg.norm(J, axis=0)
    pinv = np.linalg.pinv(J / length) / length[:, None]
    spare = J.shape[0] - J.shape[1]
    unit = pinv @ pinv.T
    covariance = None
    if data.covariance is not None:
        root = np.sqrt(np.concatenate([data.W, data.W]))
        G = pinv * root
        covariance = unit = G @ data.covariance @ G.T
    elif spare > 0:
        covariance = unit * data.error(now.poles) / spare
    std = np.sqrt(np.diag(unit))
    return covariance, unit / np.outer(std, std)


def _changed(model: Any, family: Family, p: FloatArray) -> Any:
    """Return the model with the parameters at `p`; its own rigid-body basis, as far as left."""
    changes: dict[str, Any] = {
        name: _sum(getattr(model, name), change)
        for name, change in zip("MDK", family.changes(p), strict=True)
    }
    if hasattr(model, "T"):
        # Gram-Schmidt keeps translations first and moves the rotations to the new centre
        left = model.rigid_body @ family.rigid_left(p)
        changes["rigid_body"] = orthonormalised(changes["M"], left)
    try:
        return model.replace(**changes)
    except ModelError as error:
        raise ModelError(
            f"the update ended at {family.text(p)}, which the {type(model).__name__} refuses: "
            f"{error}"
        ) from None


def _sum(part: Matrix | None, change: FloatArray) -> Matrix | None:
    if not np.any(change):
        return part
    if part is None:
        return change
    return sp.csc_array(part + sp.csc_array(change)) if sp.issparse(part) else part + change


def _checked_count(value: Any) -> int:
    if isinstance(value, bool) or not isinstance(value, int | np.integer) or value < 1:
        raise ModelError(f"max_iterations must be a whole number from 1, got {value!r}.")
    return int(value)

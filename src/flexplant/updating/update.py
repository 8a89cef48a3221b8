"""The update of a model from measurements: the paper's equations (9) to (14), and beyond."""

from __future__ import annotations

import warnings
from collections.abc import Sequence
from typing import Any

import numpy as np

from ..errors import FlexplantWarning, ModelError
from ..values import ComplexArray, FloatArray, flag, positive, seed_sequence
from .general import general_update
from .methods import GaussNewton, Method, TrustRegion
from .objective import checked_residuals
from .parameters import Parameter
from .pencil import Family
from .residuals import Data, Eigenvalues, checked_data
from .residuals_base import Residual
from .result import History, UpdateResult
from .sensitivity import checked_parameters, checked_values, mode_columns
from .steps import Iterate, advance, slopes, solve
from .updated_model import changed_model


def update(
    model: Any,
    parameters: Sequence[Parameter],
    residuals: Sequence[Residual],
    *,
    method: Method | None = None,
    start: Sequence[float] | FloatArray | None = None,
    starts: int | FloatArray | None = None,
    seed: int = 0,
    prior: bool = True,
    max_iterations: int | None = None,
    tolerance: float = 1e-10,
) -> UpdateResult:
    """Find the parameters with which the model reproduces the measurement.

    With eigenvalues alone, without bounds and priors: the paper's (13) and (14), Gauss-Newton with
    real unknowns in complex equations::

        Re[S^H W S] dp = Re[S^H W d lambda],    p <- p + dp

    Otherwise ``1/2 |r(p)|^2 + 1/2 |(p - mean)/std|^2``, r the whitened residuals of all kinds, in a
    trust region within the bounds. The second term, of the parameters with a prior, takes part
    where the noise of every residual is known (the answer is then the maximum a posteriori).

    Modes are found by their number in the model at `start` and followed by shape (see
    `flexplant.updating.pairing`), so they may swap order on the way; those with measured shapes
    are assigned by MAC at each step. Modes that are exactly
    repeated there are first turned to the vectors in which the step splits them, the lower mode
    number going to the lower frequency. Steps are shortened while M or K would become indefinite,
    a measured mode would cease to oscillate, or the error (12) would grow.

    Parameters
    ----------
    model : ReducedModel or FEModel
        The model; an FEModel is treated densely.
    parameters : sequence of q Parameter
        `AddedMass`, `AddedDamping`, `AddedStiffness`, `ModeDamping`, `MatrixParameter`.
    residuals : sequence of Residual
        What to fit: `Eigenvalues`, `ModeShapes`, `FrfResidual`, `Antiresonances`,
        `StaticCompliance`, mixed freely.
    method : Method, optional
        `GaussNewton`, `TrustRegion`, `Tikhonov` or `Lasso`. None: as said above.
    start : (q,) array [kg, N s/m, N/m], optional
        Values to begin with; when not given zeros, or the means of priors, inside the bounds.
    starts : int or (s, q) array, optional
        Search from several starts, drawn between the bounds (or from the priors), and keep
        the best; `start` is one of them.
    seed : int
        For drawn starts.
    prior : bool
        Whether priors take part. A parameter with two finite bounds and no prior has one from
        them: zero (or the bound nearest to it) most probable, the farther bound three standard
        deviations away.
    max_iterations : int, optional
        Most steps from one start; 20 for Gauss-Newton, 200 for the others when not given.
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
        When no part of a step keeps the model physical, or no start leads anywhere.

    References
    ----------
    The paper, section 3.
    """
    listed = checked_parameters(parameters)
    given = checked_residuals(residuals)
    if method is not None and not isinstance(method, Method):
        raise ModelError(
            f"method must be GaussNewton(), TrustRegion(), Tikhonov() or Lasso(), got {method!r}. "
            "Pass one of them, or None."
        )
    if max_iterations is not None:
        _checked_count(max_iterations)
    enough = positive(tolerance, "tolerance")
    seed_sequence(seed, "seed")
    takes_part = flag(prior, "prior")
    bounded = any(getattr(q, "bounds", None) is not None for q in listed)
    known = any(getattr(q, "prior", None) is not None for q in listed)
    plain = all(isinstance(r, Eigenvalues) and not r.clusters for r in given)
    newton = isinstance(method, GaussNewton)
    if isinstance(method, GaussNewton) and bounded:
        raise ModelError("GaussNewton knows no bounds: use TrustRegion(), or drop bounds=.")
    direct = not (isinstance(method, GaussNewton) and method.truncate)
    direct = direct and (method is None or newton)
    if plain and direct and not bounded and not known and starts is None:
        return _paper(model, listed, given, start, max_iterations or 20, enough)
    return general_update(
        model,
        listed,
        given,
        method=method or TrustRegion(),
        start=start,
        starts=starts,
        seed=seed,
        prior=takes_part,
        most=max_iterations or (20 if newton else 200),
        tolerance=enough,
    )


def _paper(
    model: Any,
    listed: tuple[Parameter, ...],
    residuals: Sequence[Any],
    start: Any,
    most: int,
    enough: float,
) -> UpdateResult:
    """Return the answer of the paper's iteration."""
    data = checked_data(residuals)
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
            stacklevel=3,
        )
    covariance, correlation = _doubt(data, S, now)
    return UpdateResult(
        parameters=tuple(q.name for q in listed),
        units=tuple(q.unit for q in listed),
        values=now.p,
        covariance=covariance,
        correlation=correlation,
        model=changed_model(model, family, now.p),
        history=History(*(np.array(part) for part in zip(*trail, strict=True))),
        converged=converged,
        reason=reason,
        unknowns=tuple(listed),
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


def _checked_count(value: Any) -> int:
    if isinstance(value, bool) or not isinstance(value, int | np.integer) or value < 1:
        raise ModelError(
            f"max_iterations must be a whole number from 1, got {value!r}. Pass an int."
        )
    return int(value)

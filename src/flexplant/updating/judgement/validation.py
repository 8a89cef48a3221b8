"""Validation on data that were not fitted."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from ...errors import ModelError
from ...values import FloatArray, Rng, Value, generator, positive
from ..parameters.added import Parameter
from ..residuals.residual import Residual
from ..search import Objective, checked_residuals
from ..search.update_method import UpdateMethod
from ..sensitivities import checked_parameters
from ..update import update
from ..update_result import UpdateResult
from .correlation import Correlation, correlate


@dataclass(frozen=True, eq=False, repr=False)
class Validation(Value):
    """An update judged by data that were not fitted.

    Parameters
    ----------
    fit : UpdateResult
        Of the fitted data.
    fitted, unused : (2,) array
        Rms of the whitened residuals before and after the update, of the data that were fitted and
        of those that were not. Where the noise is known, 1 is what noise alone would leave.
    before, after : Correlation
        Of the unused data with the model before and after.
    """

    fit: UpdateResult
    fitted: FloatArray
    unused: FloatArray
    before: Correlation
    after: Correlation

    def __post_init__(self) -> None:
        self._set(fitted=self.fitted, unused=self.unused)

    @property
    def helped(self) -> bool:
        """Whether the update brought the model nearer to data that were not fitted."""
        return bool(self.unused[1] < self.unused[0])

    def __repr__(self) -> str:
        a, b = self.fitted.tolist(), self.unused.tolist()
        return (
            f"<Validation: rms residual of fitted data {a[0]:.3g} -> {a[1]:.3g}, of unused data "
            f"{b[0]:.3g} -> {b[1]:.3g}>"
        )


def validate(
    model: Any,
    parameters: Sequence[Parameter],
    residuals: Sequence[Residual],
    unused: Sequence[Residual],
    *,
    method: UpdateMethod | None = None,
    start: Sequence[float] | FloatArray | None = None,
    starts: int | FloatArray | None = None,
    rng: Rng = 0,
    prior: bool = True,
) -> Validation:
    """Update with some data and report the error on others.

    Parameters
    ----------
    model : ReducedModel or FEModel
        The model.
    parameters : sequence of Parameter
        Unknowns.
    residuals : sequence of Residual
        To fit. `Eigenvalues.select`, `ModeShapes.select` and `FrfResidual.select` take parts, as
        does `split`.
    unused : sequence of Residual
        To judge by.
    method, start, starts, rng, prior
        Of `update`.

    Returns
    -------
    Validation

    Raises
    ------
    FlexplantError
        As `update`.
    """
    listed = checked_parameters(parameters)
    given, kept = checked_residuals(residuals), checked_residuals(unused)
    fit = update(
        model,
        listed,
        given,
        method=method,
        start=start,
        starts=starts,
        rng=rng,
        prior=prior,
    )
    begin = np.asarray(fit.history.parameters[0], dtype=np.float64)
    return Validation(
        fit=fit,
        fitted=_rms(model, listed, given, begin, fit.values),
        unused=_rms(model, listed, kept, begin, fit.values),
        before=correlate(model, kept),
        after=correlate(fit.model, kept),
    )


def split(residual: Any, *, share: float = 0.5, rng: Rng = 0) -> tuple[Any, Any]:
    """Return two residuals of a measurement: a random share of its modes or lines to fit, the rest.

    Parameters
    ----------
    residual : Eigenvalues, ModeShapes or FrfResidual
        To take apart.
    share : float
        To fit, between 0 and 1.
    rng : int, SeedSequence or Generator
        For the choice.

    Raises
    ------
    ModelError
        When the residual has no parts, or one side would be empty.
    """
    measured = getattr(residual, "measured", None)
    parts = getattr(residual, "lines", None)
    if parts is None:
        parts = getattr(measured, "modes", None)
    if not isinstance(residual, Residual) or parts is None:
        raise ModelError(
            f"split takes modes or lines apart, got {type(residual).__name__}. Pass Eigenvalues, "
            "ModeShapes or an FrfResidual."
        )
    if not positive(share, "share") < 1:
        raise ModelError(f"share must lie between 0 and 1, got {share:g}. Choose 0.7, say.")
    items = np.asarray(parts)
    count = round(share * items.size)
    if not 0 < count < items.size:
        raise ModelError(f"a share of {share:g} of {items.size} leaves one side empty.")
    order = generator(rng).permutation(items.size)
    chosen: Any = residual
    first, rest = np.sort(items[order[:count]]), np.sort(items[order[count:]])
    return chosen.select(first.tolist()), chosen.select(rest.tolist())


def _rms(
    model: Any,
    parameters: Sequence[Parameter],
    residuals: Sequence[Residual],
    start: FloatArray,
    end: FloatArray,
) -> FloatArray:
    objective = Objective(model, parameters, residuals, prior=False)
    before = objective.values(objective.begin(start))
    # in steps, so that modes are followed and not lost
    for part in np.linspace(0.0, 1.0, 6)[1:]:
        objective.at(start + part * (end - start), refer=True)
    after = objective.values(objective.at(end))
    return np.sqrt([np.mean(before**2), np.mean(after**2)])

"""Validation on data that were not fitted."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import scipy.linalg as la

from ...checks import FloatArray, Rng, Value, between, generator
from ...errors import ModelError
from ...sparse.factor import dense
from ..parameters.added import Parameter
from ..residuals.residual import Residual
from ..search import Objective, checked_residuals
from ..search.objective import compared_modes
from ..search.update_method import UpdateMethod
from ..sensitivities import checked_parameters
from ..update import update
from ..update_result import UpdateResult
from .correlation import Correlation, correlate
from .goodness import chance, is_bad

#: part of the rms of unused data that a helpful update leaves where the noise is not known
HALF = 0.5


@dataclass(frozen=True, eq=False, repr=False)
class Validation(Value):
    """An update judged by data that were not fitted.

    Parameters
    ----------
    fit : UpdateResult
        Of the fitted data.
    fitted, unused : (2,) array
        Rms of the whitened residuals before and after the update, of the data that were fitted and
        of those that were not. Where the noise is known, 1 is what noise and the uncertainty of
        the parameters would leave: after the update residuals of unused data are whitened by
        ``I + J C J^T``, of fitted data counted per degree of freedom.
    p_value : float or None
        The probability that these alone leave more of the unused data than the updated model
        does; None where the noise is not known. Below 1e-4 a change is missing, or in the wrong
        place.
    before, after : Correlation
        Of the unused data with the model before and after.
    """

    fit: UpdateResult
    fitted: FloatArray
    unused: FloatArray
    before: Correlation
    after: Correlation
    p_value: float | None = None

    @property
    def helped(self) -> bool:
        """Whether the updated model predicts data that were not fitted.

        Nearer than before, and where the noise is known up to that and the uncertainty of the
        parameters (`p_value` of 1e-4 at least); where it is not, to a half of what was left. A
        mass in the wrong place comes nearer too, and predicts nothing.
        """
        if self.p_value is None:
            return bool(self.unused[1] < HALF * self.unused[0])
        return bool(self.unused[1] < self.unused[0]) and not is_bad(self.p_value)

    def __repr__(self) -> str:
        a, b = self.fitted.tolist(), self.unused.tolist()
        return (
            f"<Validation: rms residual of fitted data {a[0]:.3g} -> {a[1]:.3g}, of unused data "
            f"{b[0]:.3g} -> {b[1]:.3g}{'' if self.helped else ', NOT PREDICTED'}>"
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
    ModelError
        When unused data were fitted.

    Examples
    --------
    >>> import flexplant as fx
    >>> modes = fx.solve_modes(fx.chain(masses=[1.0, 1.0, 1.0], stiffnesses=[4e5, 4e5]), count=3)
    >>> drawing = fx.reduce(modes, fx.DesiredDofs(["1:x", "2:x", "3:x"]))
    >>> heavier = fx.chain(masses=[1.0, 1.0, 1.2], stiffnesses=[4e5, 4e5])
    >>> poles = fx.solve_modes(heavier, count=3).poles
    >>> known = fx.Eigenvalues(fx.MeasuredModes(poles=poles[[1]], modes=[2]))
    >>> unused = fx.Eigenvalues(fx.MeasuredModes(poles=poles[[2]], modes=[3]))
    >>> fx.validate(drawing, [fx.AddedMass("3:x")], [known], [unused]).helped
    True
    """
    listed = checked_parameters(parameters)
    given, kept = checked_residuals(residuals), checked_residuals(unused)
    _check_apart(given, kept)
    options: Any = {"start": start, "starts": starts, "rng": rng, "prior": prior}
    fit = update(model, listed, given, method=method, **options)
    begin = np.asarray(fit.history.parameters[0], dtype=np.float64)
    before, _ = _misfit(model, listed, given, begin, fit, spread=False)
    fitted = np.array([before[0], _per_freedom(fit, before)])
    both, chance_of = _misfit(model, listed, kept, begin, fit, spread=True)
    return Validation(
        fit=fit,
        fitted=fitted,
        unused=both,
        before=correlate(model, kept),
        after=correlate(fit.model, kept),
        p_value=chance_of,
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

    Examples
    --------
    >>> import flexplant as fx
    >>> poles = fx.Eigenvalues(fx.MeasuredModes(poles=[630.0j, 1095.0j], modes=[2, 3]))
    >>> fitted, unused = fx.updating.split(poles, rng=0)
    >>> len(fitted.measured.poles), len(unused.measured.poles)
    (1, 1)
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
    share = between(share, "share", 0.0, 1.0, "Choose 0.7, say.")
    items = np.asarray(parts)
    count = round(share * items.size)
    if not 0 < count < items.size:
        raise ModelError(f"a share of {share:g} of {items.size} leaves one side empty.")
    order = generator(rng).permutation(items.size)
    chosen: Any = residual
    first, rest = np.sort(items[order[:count]]), np.sort(items[order[count:]])
    return chosen.select(first.tolist()), chosen.select(rest.tolist())


def _per_freedom(fit: UpdateResult, rms: FloatArray) -> float:
    """Return the rms of fitted data, per degree of freedom where the noise is known."""
    known = fit.chi2 is not None and fit.dof > 0
    return float(np.sqrt((fit.chi2 or 0.0) / fit.dof)) if known else float(rms[1])


def _misfit(
    model: Any,
    parameters: Sequence[Parameter],
    residuals: Sequence[Residual],
    start: FloatArray,
    fit: UpdateResult,
    *,
    spread: bool,
) -> tuple[FloatArray, float | None]:
    """Return the rms before and after, and the chance that noise leaves more than after.

    With `spread`, that of the parameters counts as noise: r^T (N + J C J^T)^-1 r / m.
    """
    objective = Objective(model, parameters, residuals, prior=False)
    before = objective.values(objective.begin(start))
    # in steps, so that modes are followed and not lost
    steps = np.linspace(0.0, 1.0, 6)[:, None]
    point = objective.follow([*(start + steps * (fit.values - start))])
    after = objective.values(point)
    rms = np.sqrt([np.mean(before**2), np.mean(after**2)])
    if not spread or not objective.noise_known or fit.covariance is None:
        return rms, None
    noise = np.eye(after.size)
    for bound, rows in objective.rows(point):
        if bound.noise is not None:
            noise[rows, rows] = dense(bound.noise)
    J = objective.slopes(point)
    chi2 = float(after @ la.solve(noise + J @ fit.covariance @ J.T, after, assume_a="pos"))
    rms[1] = np.sqrt(chi2 / after.size)
    return rms, chance(chi2, after.size)


def _check_apart(given: Sequence[Residual], kept: Sequence[Residual]) -> None:
    """Refuse unused data that were fitted: the same modes or lines of one measurement."""
    for one in given:
        for other in kept:
            if type(one) is not type(other):
                continue
            parts, twice = _parts_of(one), _parts_of(other)
            common = [part for part in twice if part in parts]
            if _same_data(one, other) and (common or not parts):
                which = f"parts {', '.join(map(str, common[:6]))}" if common else "all"
                raise ModelError(
                    f"{other!r} is not unused: {which} of it were fitted, and fitting "
                    "them says nothing of others. Take a measurement apart with split(residual), "
                    "or keep another one back."
                )


def _parts_of(residual: Residual) -> list[int]:
    """Return the modes or lines of a residual."""
    lines = getattr(residual, "lines", None)
    return [int(i) for i in (compared_modes(residual) if lines is None else lines)]


def _same_data(one: Any, other: Any) -> bool:
    """Whether two residuals of one kind are of the same measurement."""
    if hasattr(one, "lines"):
        a, b = one.measured, other.measured
        return a is b or (a.data.shape == b.data.shape and np.array_equal(a.data, b.data))
    if hasattr(one, "measured"):
        a, b = one.measured, other.measured
        shared = [n for n in a.modes or () if n in (b.modes or ())]
        return any(a.poles[a.modes.index(n)] == b.poles[b.modes.index(n)] for n in shared)
    return one is other

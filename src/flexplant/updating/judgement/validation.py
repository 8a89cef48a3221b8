"""Agreement of model and measurement: MAC, FRAC, FDAC, and data that were not fitted."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import scipy.linalg as la

from ...arrays import ComplexArray, FloatArray, Rng, between, complex_array, generator
from ...errors import SHOWN, ModelError, ShapeError
from ...identification import MeasuredModes
from ...modes import matching
from ...sparse.symmetric import dense
from ...store import Value
from ..family import Point
from ..parameters import Parameter, checked_parameters
from ..residuals.frf_residual import FrfResidual
from ..residuals.residual import Residual
from ..residuals.shape_residuals import ModeShapes
from ..search import Objective, checked_residuals
from ..search.least_squares import UpdateMethod
from ..search.objective import chance, compared_modes, independent_share, is_bad
from ..update_result import UpdateResult
from ..updates import update


def mac(X: Any, Y: Any) -> FloatArray:
    """Return the modal assurance criterion (m, m') of each shape of X with each of Y.

    For shapes x and y it is ``|x^H y|^2 / (x^H x  y^H y)``. It is 1 for shapes that differ only by
    a factor, and 0 for orthogonal ones.

    Parameters
    ----------
    X, Y : (n, m), (n, m') real or complex arrays
        Shapes in columns.

    Raises
    ------
    ShapeError, ModelError
        When sizes differ, entries are not finite, or a shape is zero.

    References
    ----------
    [AllemangBrown1982]_.

    Examples
    --------
    A shape is compared with itself and with another shape:

    >>> import flexplant as fx
    >>> fx.updating.mac([[1.0], [0.0]], [[1.0, 1.0], [0.0, 1.0]]).round(6)
    array([[1. , 0.5]])
    """
    left, right = _nonzero_shapes(X, "X"), _nonzero_shapes(Y, "Y")
    if left.shape[0] != right.shape[0]:
        raise ShapeError(f"X has {left.shape[0]} rows and Y {right.shape[0]}.")
    return matching.mac_matrix(left, right)


def frac(H: Any, G: Any) -> FloatArray:
    """Return the frequency response assurance criterion of each channel pair, from 0 to 1.

    For responses H and G of a channel pair it is ``|sum_f H* G|^2 / (sum_f |H|^2  sum_f |G|^2)``.
    The sums run over the frequencies f, and H* is the complex conjugate of H.

    Parameters
    ----------
    H, G : (..., n_freq) complex arrays
        Measured and computed responses.

    Raises
    ------
    ShapeError, ModelError
        When sizes differ or a response is zero.

    References
    ----------
    [HeylenLammens1996]_.

    Examples
    --------
    Responses that differ only by a factor have the value 1:

    >>> import flexplant as fx
    >>> fx.updating.frac([[[1.0, 2.0j]]], [[[2.0, 4.0j]]]).round(6)  # scale does not count
    array([[1.]])
    """
    a, b = complex_array(H, "H"), complex_array(G, "G")
    if a.shape != b.shape or a.ndim < 1:
        raise ShapeError(
            f"H has shape {a.shape} and G {b.shape}: choose the same channels and lines."
        )
    product = np.abs(np.sum(a.conj() * b, axis=-1)) ** 2
    size = np.sum(np.abs(a) ** 2, axis=-1) * np.sum(np.abs(b) ** 2, axis=-1)
    if np.any(size == 0):
        raise ModelError("a response is zero at all lines: its FRAC is not defined.")
    return np.asarray(product / size, dtype=np.float64)


def fdac(H: Any, G: Any) -> FloatArray:
    """Return the frequency domain assurance criterion of all pairs of lines, from -1 to 1.

    The criterion is ``Re(h_f^H g_k) / (|h_f| |g_k|)``, where h_f contains all channels of H at
    frequency line f, and g_k those of G at line k. If the frequencies of G are shifted, the largest
    values lie next to the diagonal.

    Parameters
    ----------
    H, G : (..., n_freq), (..., n_freq') complex arrays
        Measured and computed responses of the same channels.

    Raises
    ------
    ShapeError, ModelError
        When sizes differ or a line is zero.

    References
    ----------
    [Pascual1997]_.

    Examples
    --------
    One channel at two lines. At the second line, the computed response has the opposite sign:

    >>> import flexplant as fx
    >>> fx.updating.fdac([[[1.0, 2.0]]], [[[1.0, -1.0]]]).round(6)
    array([[ 1., -1.],
           [ 1., -1.]])
    """
    a, b = complex_array(H, "H"), complex_array(G, "G")
    if a.shape[:-1] != b.shape[:-1] or a.ndim < 1:
        raise ShapeError(f"H has channels {a.shape[:-1]} and G {b.shape[:-1]}: choose the same.")
    a, b = a.reshape(-1, a.shape[-1]), b.reshape(-1, b.shape[-1])
    size = np.outer(np.linalg.norm(a, axis=0), np.linalg.norm(b, axis=0))
    if np.any(size == 0):
        raise ModelError("a line is zero at all channels: leave it out.")
    return np.asarray(np.real(a.conj().T @ b) / size, dtype=np.float64)


@dataclass(frozen=True, eq=False, repr=False)
class Correlation(Value):
    """Agreement of a model and a measurement: frequencies, damping, MAC, FRAC and FDAC.

    Parameters
    ----------
    modes : (m,) sequence of int
        Numbers of the measured modes.
    freq_error : (m,) array [-]
        Relative error of the model's undamped frequencies.
    zeta_error : (m,) array [-]
        Damping ratios of the model minus the measured ones.
    mac : (m, m) array
        MAC of measured shapes (rows) with those of the model. Empty: no shapes were given.
    frac : (n_out, n_in) array
        Frequency response assurance criterion of the responses. Empty: no responses were given.
    fdac : (n_freq, n_freq) array
        Frequency domain assurance criterion of the responses. Empty: no responses were given.
    alike : sequence of groups of int
        Groups of the model's modes in the measured range whose shapes the sensors cannot
        distinguish. Their MAC with each other at the sensors is above 0.9. These modes are paired
        by frequency, since a high MAC does not show which mode of a group was measured.
    """

    modes: tuple[int, ...]
    freq_error: FloatArray
    zeta_error: FloatArray
    mac: FloatArray
    frac: FloatArray
    fdac: FloatArray
    alike: tuple[tuple[int, ...], ...] = ()

    def __repr__(self) -> str:
        parts = []
        if self.freq_error.size:
            parts.append(f"frequencies within {100 * np.abs(self.freq_error).max():.3g} %")
        if self.mac.size:
            parts.append(f"least MAC {np.diag(self.mac).min():.4f}")
        if self.frac.size:
            parts.append(f"least FRAC {self.frac.min():.4f}")
        text = f"<Correlation: {', '.join(parts) or 'nothing compared'}"
        if self.alike:
            text += "\n  the sensors cannot distinguish the shapes of modes "
            text += "; ".join(", ".join(map(str, group)) for group in self.alike[:SHOWN])
            text += "; ..." if len(self.alike) > SHOWN else ""
        return text + ">"


def correlate(model: Any, residuals: Sequence[Any]) -> Correlation:
    """Compare a model with measurements, for example before and after an update.

    Parameters
    ----------
    model : ReducedModel or FEModel
        Model to compare, such as `UpdateResult.model`.
    residuals : sequence of Residual
        Measurements. Poles, shapes and responses are compared. If there are several of a kind, the
        last one is used.

    Returns
    -------
    Correlation
        Errors of frequencies and damping ratios, and criteria for shapes and responses.

    Raises
    ------
    ModelError, LabelError
        When a mode or place is unknown to the model.

    Examples
    --------
    The second frequency of the model is 2 % above the measured one:

    >>> import flexplant as fx
    >>> drawing = fx.chain(masses=[1.0, 1.0, 1.0], stiffnesses=[4e5, 4e5])
    >>> poles = fx.Eigenvalues(fx.MeasuredModes(poles=[620.0j], modes=[2]))
    >>> fx.updating.correlate(drawing, [poles]).freq_error.round(4)
    array([0.0201])
    """
    objective = Objective(model, [], checked_residuals(residuals))
    point = objective.begin(np.zeros(0))
    poles: ComplexArray = np.zeros(0, complex)
    found = poles
    modes: tuple[int, ...] = ()
    shapes = responses = spectrum = np.zeros((0, 0))
    alike: tuple[tuple[int, ...], ...] = ()
    tied: Any
    for residual, tied in zip(objective.residuals, objective.bounds, strict=True):
        measured = getattr(residual, "measured", None)
        if isinstance(measured, MeasuredModes):
            modes, poles = measured.modes or (), measured.poles
            columns = point.columns(modes)
            found = point.eigen.poles[columns]
            if isinstance(residual, ModeShapes):
                seen = tied.rows @ point.eigen.X
                shapes = mac(residual.shapes, seen[:, columns])
                alike = _alike(seen, point, columns)
        if isinstance(residual, FrfResidual):
            both = [np.moveaxis(H, 0, 2) for H in (tied.data, tied.responses(point))]
            responses, spectrum = frac(*both), fdac(*both)
    return Correlation(
        modes=modes,
        freq_error=np.abs(found) / np.abs(poles) - 1,
        zeta_error=poles.real / np.abs(poles) - found.real / np.abs(found),
        mac=shapes,
        frac=responses,
        fdac=spectrum,
        alike=alike,
    )


def _alike(seen: ComplexArray, point: Point, columns: list[int]) -> tuple[tuple[int, ...], ...]:
    """Return the numbers of modes in the range of those compared that look alike at the sensors."""
    inside = np.arange(min(columns), max(columns) + 1)
    inside = inside[(point.labels[inside] > 0) & np.any(seen[:, inside] != 0, axis=0)]
    near = matching.likeness(seen[:, inside], np.abs(point.eigen.poles[inside]))
    group = matching.groups_alike(near)
    numbers = point.labels[inside]
    found = [np.sort(numbers[group == first]).tolist() for first in np.unique(group)]
    return tuple(tuple(members) for members in found if len(members) > 1)


def _nonzero_shapes(value: Any, name: str) -> ComplexArray:
    array = complex_array(value, name, (None, None))
    if np.any(np.all(array == 0, axis=0)):
        raise ModelError(f"{name} holds a zero shape: its MAC is not defined.")
    return array


#: largest remaining fraction of the rms of unused data after a helpful update, if the noise is not
#: known
HALF = 0.5


@dataclass(frozen=True, eq=False, repr=False)
class Validation(Value):
    """Result of `validate`: an update and its errors for data that were not fitted.

    Parameters
    ----------
    fit : UpdateResult
        Update with the fitted data.
    fitted, unused : (2,) array
        RMS of the whitened residuals before and after the update, for fitted and for unused data.
        Whitened residuals are divided by the standard deviation of their noise. If the noise is
        known, a value of 1 after the update is expected from noise and parameter uncertainty.
        For unused data, the noise includes the uncertainty of the parameters. Its covariance is
        ``I + J C J^T``, with the sensitivities J and the covariance C of the parameters. For fitted
        data the sum of squares is divided by the degrees of freedom.
    p_value : float or None
        Probability that noise and parameter uncertainty alone cause a larger residual of unused
        data. None: the noise is not known. If the probability is below 1e-3, a change is missing or
        in the wrong place.
    before, after : Correlation
        Correlation of the unused data with the model before and after the update.
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

        The residual of unused data must decrease. With known noise it must also agree with noise
        and parameter uncertainty (`p_value` of at least 1e-3). With unknown noise it must decrease
        to less than half. A decrease alone is not enough, because a mass in the wrong place may
        also reduce the residual, although it does not predict the data.
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
    """Update a model with some data and report its error on other data.

    Parameters
    ----------
    model, parameters, method, start, starts, rng, prior
        Arguments of the update, as for `update`.
    residuals, unused : sequences of Residual
        Data to be fitted, and data that are only predicted. `Eigenvalues.select`,
        `ModeShapes.select`, `FrfResidual.select` and `split` return parts of a measurement.

    Returns
    -------
    Validation
        The update, and its errors for fitted and for unused data.

    Raises
    ------
    FlexplantError
        In the same cases as for `update`. Also a ModelError when unused data are fitted too.

    Examples
    --------
    An added mass is fitted to the pole of mode 2. It predicts the pole of mode 3:

    >>> import flexplant as fx
    >>> drawing = fx.chain(masses=[1.0, 1.0, 1.0], stiffnesses=[4e5, 4e5])
    >>> heavier = fx.chain(masses=[1.0, 1.0, 1.2], stiffnesses=[4e5, 4e5])
    >>> poles = fx.solve_modes(heavier, count=3).poles
    >>> known = fx.Eigenvalues(fx.MeasuredModes(poles=poles[[1]], modes=[2]))
    >>> unused = fx.Eigenvalues(fx.MeasuredModes(poles=poles[[2]], modes=[3]))
    >>> fx.updating.validate(drawing, [fx.AddedMass("3:x")], [known], [unused]).helped
    True
    """
    listed = checked_parameters(parameters)
    given, kept = checked_residuals(residuals), checked_residuals(unused)
    _check_apart(given, kept)
    options: Any = {"start": start, "starts": starts, "rng": rng, "prior": prior}
    fit = update(model, listed, given, method=method, **options)
    begin = np.asarray(fit.history.parameters[0], dtype=np.float64)
    before, _ = _misfit(model, listed, given, begin, fit, spread=False)
    # per degree of freedom where the noise is known
    known = fit.chi2 is not None and fit.dof > 0
    after = np.sqrt((fit.chi2 or 0.0) / fit.dof) if known else before[1]
    fitted = np.array([before[0], after])
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
    """Return two residuals of a measurement: a random part of its modes or lines, and the rest.

    Parameters
    ----------
    residual : Eigenvalues, ModeShapes or FrfResidual
        Residual to split.
    share : float
        Fraction of the modes or lines in the first residual, between 0 and 1.
    rng : int, SeedSequence or Generator
        Random generator of the choice, or its seed.

    Raises
    ------
    ModelError
        When the residual has neither modes nor lines, or one of the two results would be empty.

    Examples
    --------
    One of two measured poles is fitted, and the other one is left for the validation:

    >>> import flexplant as fx
    >>> poles = fx.Eigenvalues(fx.MeasuredModes(poles=[630.0j, 1095.0j], modes=[2, 3]))
    >>> fitted, unused = fx.updating.split(poles, rng=0)
    >>> len(fitted.measured.poles), len(unused.measured.poles)
    (1, 1)
    """
    parts = getattr(residual, "lines", None)
    if parts is None:
        parts = getattr(getattr(residual, "measured", None), "modes", None)
    if not isinstance(residual, Residual) or parts is None:
        raise ModelError(
            f"split takes modes or lines apart, got {type(residual).__name__}. Pass Eigenvalues, "
            "ModeShapes or an FrfResidual."
        )
    share = between(share, "share", 0.0, 1.0, "Choose for example 0.7.")
    items = np.asarray(parts)
    count = round(share * items.size)
    if not 0 < count < items.size:
        raise ModelError(f"a share of {share:g} of {items.size} leaves one side empty.")
    order = generator(rng).permutation(items.size)
    chosen: Any = residual
    first, rest = np.sort(items[order[:count]]), np.sort(items[order[count:]])
    return chosen.select(first.tolist()), chosen.select(rest.tolist())


def _misfit(
    model: Any,
    parameters: Sequence[Parameter],
    residuals: Sequence[Residual],
    start: FloatArray,
    fit: UpdateResult,
    *,
    spread: bool,
) -> tuple[FloatArray, float | None]:
    """Return the rms before and after, and the probability of a larger residual by noise."""
    # with `spread`, that of the parameters counts as noise: r^T (N + J C J^T)^-1 r / m
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
    share = independent_share(objective, point)
    return rms, chance(share * chi2, round(share * after.size))


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
                    f"{other!r} is not unused: {which} of it were fitted and do not test the "
                    "prediction. Divide a measurement with split(residual), or use another one."
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

"""How well an update explains the data, how well parameters are known, which ones can be."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import scipy.linalg as la
import scipy.sparse as sp

from ...checks import FloatArray, Value
from ...errors import counted
from ...tolerances import TINY, divisor
from ..family import Point, repeated_groups
from ..parameters import Parameter, checked_parameters, checked_values
from ..search import Objective, checked_residuals

#: a chi-square that noise exceeds more rarely than this is no noise
CHANCE = 1e-4
#: residuals that are named, and modes that are named as missing
NAMED = 3


def chi_square(objective: Objective, point: Point, free: FloatArray) -> tuple[float | None, int]:
    """Return chi-square (None where the noise is not known) and its degrees of freedom."""
    # `min_d |N^-1/2 (r + J d)|^2` to first order, which for residuals weighted by their own
    # covariance is `|r|^2`: distributed as chi-square with (residuals and priors) - (parameters
    # that are free) degrees of freedom, whatever the weights of the fit
    r = objective.values(point)
    dof = r.size - int(np.sum(free))
    if not objective.noise_known:
        return None, max(dof, 0)
    weighted = [one for one in objective.rows(point) if one[0].noise is not None]
    J = objective.slopes(point)[:, free] if weighted else np.zeros((r.size, 0))
    for bound, rows in weighted:
        r[rows] = _whitened(bound.noise, r[rows])
        J[rows] = _whitened(bound.noise, J[rows])
    total = float(r @ r)
    if J.shape[1]:
        length = np.linalg.norm(J, axis=0)
        Q = la.qr(J / divisor(length), mode="economic")[0]
        total -= float(np.sum((Q.T @ r) ** 2))
    return max(total, 0.0), max(dof, 0)


def _whitened(noise: Any, rows: FloatArray) -> FloatArray:
    """Return ``L^-1 rows`` with ``noise = L L^T``, which is banded where it is sparse."""
    if not sp.issparse(noise):
        return np.asarray(la.solve_triangular(la.cholesky(noise, lower=True), rows, lower=True))
    sparse: Any = noise
    coo = sparse.tocoo()
    apart = coo.row - coo.col
    width = int(apart.max())
    band = np.zeros((width + 1, coo.shape[0]))
    below = apart >= 0
    band[apart[below], coo.col[below]] = coo.data[below]
    return np.asarray(la.solve_banded((width, 0), la.cholesky_banded(band, lower=True), rows))


def chance(chi2: float | None, dof: int) -> float | None:
    """Return the probability that noise leaves a larger chi-square, None when not known."""
    if chi2 is None or dof < 1:
        return None
    from scipy.special import chdtrc

    return float(chdtrc(dof, chi2))


def is_bad(probability: float | None) -> bool:
    """Return whether noise alone hardly explains what is left."""
    return probability is not None and probability < CHANCE


def worst(objective: Objective, point: Point) -> str:
    """Return the residuals that fit worst, in words."""
    r = objective.values(point)
    found: dict[str, float] = {}
    for bound, rows in objective.rows(point):
        part, noise = r[rows], bound.noise
        size = np.abs(part) if noise is None else np.abs(part) / np.sqrt(noise.diagonal())
        for row in np.argsort(-size, kind="stable")[: 2 * NAMED].tolist():
            name = bound.row_name(row)
            found[name] = max(found.get(name, 0.0), float(size[row]))
    order = sorted(found, key=lambda name: -found[name])[:NAMED]
    return ", ".join(f"{name} ({found[name]:.3g} standard deviations)" for name in order)


#: singular values of the scaled sensitivities below this part of the largest count as zero
SINGULAR = 1e-9


def covariance(objective: Objective, point: Point) -> tuple[FloatArray | None, FloatArray]:
    """Return covariance (or None) and correlation of the estimate, to first order."""
    # `G N G^T` with `G = (J^T J)^-1 J^T` and N the covariance of the weighted residuals where it is
    # known, else `s^2 (J^T J)^-1` with the variance s^2 of the residuals
    J, r = objective.slopes(point), objective.values(point)
    q = J.shape[1]
    length = np.linalg.norm(J, axis=0)
    safe = divisor(length)
    U, s, Vt = np.linalg.svd(J / safe, full_matrices=False)
    inverse = np.where(s > SINGULAR * s[0], 1 / np.maximum(s, TINY), 0.0)
    half = (Vt.T * inverse) / safe[:, None]
    unit = half @ half.T
    spare = r.size - q
    found: FloatArray | None = None
    if objective.noise_known:
        # N, the covariance of the rows; those of priors have unit variance
        total = U.T @ U
        for bound, rows in objective.rows(point):
            if bound.noise is not None:
                total += U[rows].T @ (bound.noise @ U[rows] - U[rows])
        found = unit = half @ total @ half.T
    elif spare > 0:
        found = unit * float(r @ r) / spare
    std = np.sqrt(np.diag(unit))
    size = divisor(std)
    correlation = unit / np.outer(size, size)
    np.fill_diagonal(correlation, 1.0)
    regular = s.size == q and bool(s[-1] > SINGULAR * s[0])
    return (found if regular else None), correlation


#: correlations beyond this are listed
CORRELATED = 0.99
#: a combination of parameters with a singular value below this part of the largest is lost
LOST = 1e-6
#: a relative change of the data below this part of the relative change of an eigenvalue that the
#: parameter can cause at most is rounding
ROUNDING = 1e-12
#: an eigenvalue that changes by less than this part of what the parts of a combination change it
#: by does not determine the combination
CANCELS = 1e-3


@dataclass(frozen=True, eq=False, repr=False)
class Identifiability(Value):
    """What the residuals determine of the parameters, to first order.

    Parameters
    ----------
    parameters : sequence of q str
    singular_values : (q,) array
        Of the sensitivities, each column scaled to length one: sqrt(q) to zero.
    combinations : (q, q) array
        Columns: the combinations of (scaled) parameters of each singular value.
    std : (q,) array
        Standard deviations to be expected where the noise is known (else for unit noise of the
        weighted residuals); infinite where a parameter cannot be found.
    correlation : (q, q) array
        Of the errors to be expected; zero with parameters that cannot be found.
    unseen : sequence of str
        Parameters that no residual depends on.
    mixed : sequence of (str, ...)
        Groups of parameters of which a combination cannot be determined.
    missing : mapping {str: (int, ...)}
        For parameters that are unseen or mixed: the modes, not measured so far, whose eigenvalues
        would determine the lost combinations, those that change most first; none where no
        eigenvalue does, as of mirror images on a symmetric structure.
    """

    parameters: tuple[str, ...]
    singular_values: FloatArray
    combinations: FloatArray
    std: FloatArray
    correlation: FloatArray
    unseen: tuple[str, ...]
    mixed: tuple[tuple[str, ...], ...]
    missing: dict[str, tuple[int, ...]]

    @property
    def rank(self) -> int:
        """Number of combinations of parameters that can be determined."""
        return int(np.sum(self.singular_values > LOST * self.singular_values[0]))

    def __repr__(self) -> str:
        lines = [
            (
                f"<Identifiability: {self.rank} of {counted(len(self.parameters), 'combination')}, "
                f"singular values {self.singular_values[0]:.3g} to {self.singular_values[-1]:.3g}"
            )
        ]
        if self.unseen:
            lines.append(f"  unseen: {', '.join(self.unseen[:4])}")
        lines += [f"  not distinguished: {', '.join(group[:4])}" for group in self.mixed[:2]]
        q = len(self.parameters)
        close = [
            f"{self.parameters[i]} and {self.parameters[j]} {self.correlation[i, j]:+.3f}"
            for i in range(q)
            for j in range(i)
            if abs(self.correlation[i, j]) > CORRELATED
        ]
        lines += [f"  correlated: {text}" for text in close[:2]]
        for name, modes in list(self.missing.items())[:2]:
            if modes:
                lines.append(f"  measure modes {', '.join(map(str, modes))} for {name}")
            else:
                lines.append(f"  no eigenvalue separates {name}: measure shapes or responses")
        return "\n".join(lines) + ">"


def identifiability(
    model: Any,
    parameters: Sequence[Parameter],
    residuals: Sequence[Any],
    *,
    start: Sequence[float] | FloatArray | None = None,
) -> Identifiability:
    """Return which parameters the residuals determine at a start, before solving.

    The singular values of the weighted sensitivities S, the correlation
    ``(S^T S)^-1`` of the estimate, and which modes are missing. Priors take no part.

    Parameters
    ----------
    model, parameters, start : as for `update`
    residuals : sequence of Residual
        Data; the values are not used, only what they would depend on (and their noise).

    Returns
    -------
    Identifiability

    Raises
    ------
    ModelError, LabelError, ShapeError
        As `update`.

    Examples
    --------
    >>> import flexplant as fx
    >>> drawing = fx.chain(masses=[1.0, 1.0, 1.0], stiffnesses=[4e5, 4e5])
    >>> poles = fx.Eigenvalues(fx.MeasuredModes(poles=[630.0j], modes=[2]))
    >>> found = fx.identifiability(drawing, [fx.AddedMass("1:x"), fx.AddedMass("3:x")], [poles])
    >>> found.rank  # of two: one pole is the same for both ends
    1
    """
    listed = checked_parameters(parameters)
    objective = Objective(model, listed, checked_residuals(residuals), prior=False)
    p = objective.default_start if start is None else checked_values(start, listed, "start")
    point = objective.begin(p)
    J = objective.slopes(point, prior=False)
    names = tuple(q.name for q in listed)
    length = np.linalg.norm(J, axis=0)
    own = np.abs(J).max(initial=0.0) * ROUNDING
    omega = float(np.median(np.abs(point.eigen.poles))) if point.eigen.poles.size else 1.0
    reach = objective.family.strength(omega)
    # a column far below what the parameter can do to this model is rounding: beside the strongest
    # one, and, as a single one is its own strongest, as a relative change of what is measured
    strongest = float(np.max(length / reach, initial=0.0))
    whole = objective.size(point)
    change = np.linalg.norm(J / divisor(whole)[:, None], axis=0)
    # nine decades below the strongest nothing is seen but rounding
    seen = (length > own) & (length > 1e-9 * strongest * reach)
    seen &= change > ROUNDING * reach / omega
    scaled = np.where(seen, J / np.where(seen, length, 1.0), 0.0)
    _, s, Vt = np.linalg.svd(scaled, full_matrices=True)
    s = np.concatenate([s, np.zeros(len(names) - s.size)])
    clear = s > LOST * s[0]
    half = Vt[clear].T / s[clear]
    unit = half @ half.T
    # squares: a share of 1e-3 of a lost combination
    lost = np.sum(Vt[~clear] ** 2, axis=0) > 1e-6
    std = np.where(lost | ~seen, np.inf, np.sqrt(np.diag(unit)) / np.where(seen, length, 1.0))
    size = np.where(lost, 1.0, np.sqrt(np.maximum(np.diag(unit), TINY)))
    correlation = np.where(np.outer(~lost, ~lost), unit / np.outer(size, size), np.eye(lost.size))
    parts = np.array(names, dtype=object)
    groups = [tuple(parts[seen & (np.abs(vector) > 0.1)].tolist()) for vector in Vt[~clear]]
    mixed = [group for group in groups if len(group) > 1]
    unseen = tuple(n for n, ok in zip(names, seen, strict=True) if not ok)
    poor = list(dict.fromkeys([*unseen, *(n for group in mixed for n in group)]))
    # combinations of the parameters themselves that change no residual
    lost = Vt[~clear] / np.where(seen, length, 1.0)
    return Identifiability(
        parameters=names,
        singular_values=s,
        combinations=Vt.T,
        std=std,
        correlation=correlation,
        unseen=unseen,
        mixed=tuple(mixed),
        missing=_missing_modes(objective, point, names, poor, lost),
    )


def _missing_modes(
    objective: Objective, point: Any, names: tuple[str, ...], poor: list[str], lost: FloatArray
) -> dict[str, tuple[int, ...]]:
    """Return the unmeasured modes that determine a lost combination, for poorly known parameters.

    The change of an eigenvalue along the combination counts, against that by its parts.
    """
    numbers = [int(n) for n in point.labels if n and n not in objective.numbers]
    if not poor:
        return {}
    columns = point.columns(numbers)
    size = np.abs(point.eigen.poles[columns])[:, None]
    S = objective.family.sensitivity(point.eigen, columns) / size
    # how repeated modes split has no sign: only their mean has a direction
    for group in repeated_groups(point.eigen.poles):
        mean = np.trace(objective.family.group_derivative(point.eigen, group), axis1=1, axis2=2)
        for i in [i for i, column in enumerate(columns) if column in group]:
            S[i] = mean / len(group) / size[i]
    along = np.abs(S @ lost.T)
    parts = np.abs(S) @ np.abs(lost.T)
    # what cancels but for rounding, or the truncation of the model, determines nothing
    felt = parts > 1e-6 * np.max(parts, axis=0, initial=0.0)
    clear = np.where(felt & (along > CANCELS * parts), along, 0.0)
    found = {}
    for name in poor:
        # takes part
        own = np.abs(lost[:, names.index(name)]) > 1e-3 * np.abs(lost).max(axis=1, initial=0.0)
        share = np.max(clear[:, own], axis=1, initial=0.0)
        order = np.argsort(-share, kind="stable")[:NAMED]
        largest = share.max(initial=0.0)
        # modes that take no part but for rounding
        found[name] = tuple(numbers[i] for i in order if share[i] > 1e-6 * largest > 0)
    return found

"""Goodness of fit of an update, and covariance of its parameters."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import numpy.typing as npt
import scipy.linalg as la
import scipy.sparse as sp

from ...arrays import FloatArray, divisor
from ...tolerances import CHANCE, NEGLIGIBLE, ROUNDING, SAME, TINY, TYPED
from ...words import SHOWN
from ..family import Point
from ..search import Objective


def chi_square(objective: Objective, point: Point, free: FloatArray) -> tuple[float | None, int]:
    """Return `noise_misfit` and its degrees of freedom; those of all rows where no noise is known.

    The degrees of freedom are the number of rows minus the part of the parameters: the trace of
    these rows of the projector on all slopes, which is its rank where all noise is known. Rows
    with shared errors count by their share of independent ones, `Bound.independent`.
    """
    misfit = noise_misfit(objective, point, free)
    taken = np.sum(_orthonormal(objective.slopes(point)[:, free]) ** 2, axis=1)
    dof, data = 0.0, 0
    for bound, rows in objective.rows(point):
        data = rows.stop
        if misfit is None or bound.has_noise:
            left = rows.stop - rows.start - bound.lost - float(np.sum(taken[rows]))
            dof += bound.independent * left
    return misfit, max(round(dof + float(np.sum(1.0 - taken[data:]))), 0)


def independent_share(objective: Objective, point: Point) -> float:
    """Return the share of all rows that count as independent."""
    rows = [(bound.independent, at.stop - at.start) for bound, at in objective.rows(point)]
    return float(sum(share * count for share, count in rows) / sum(count for _, count in rows))


def noise_misfit(objective: Objective, point: Point, free: FloatArray) -> float | None:
    """Return ``|N^-1/2 r|^2`` of the residuals with known noise N, None without such.

    ``min_d |N^-1/2 (r + J d)|^2``, to first order, where all noise is known but other weights are
    given: it is distributed as chi-square for any weights.
    """
    if not any(bound.has_noise for bound in objective.bounds):
        return None
    r = objective.values(point)
    anew = objective.noise_known and not objective.noisy
    J = objective.slopes(point)[:, free] if anew else np.zeros((r.size, 0))
    for bound, at in objective.rows(point):
        if not bound.has_noise:
            r[at] = 0.0
        elif bound.noise is not None:
            r[at], J[at] = _whitened(bound.noise, r[at]), _whitened(bound.noise, J[at])
    Q = _orthonormal(J)
    r -= Q @ (Q.T @ r)
    data = objective.rows(point)
    found = sum(bound.independent * np.sum(r[at] ** 2) for bound, at in data)
    return float(found + np.sum(r[data[-1][1].stop :] ** 2))


def _orthonormal(J: FloatArray) -> FloatArray:
    """Return an orthonormal basis of the columns of J."""
    if not J.size:
        return J
    U, s, _ = np.linalg.svd(J / divisor(np.linalg.norm(J, axis=0)), full_matrices=False)
    return np.asarray(U[:, s > TYPED * s[0]])


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
    """Return the probability of a larger chi-square by noise, None if not known."""
    if chi2 is None or dof < 1:
        return None
    from scipy.special import chdtrc

    return float(chdtrc(dof, chi2))


def is_bad(probability: float | None) -> bool:
    """Return whether noise hardly explains the residual."""
    return probability is not None and probability < CHANCE


def worst(objective: Objective, point: Point) -> str:
    """Return the residuals of known noise that fit worst, in words."""
    r = objective.values(point)
    found: dict[str, float] = {}
    for bound, rows in objective.rows(point):
        if not bound.has_noise:
            continue
        part, noise = r[rows], bound.noise
        size = np.abs(part) if noise is None else np.abs(part) / np.sqrt(noise.diagonal())
        for row in np.argsort(-size, kind="stable")[: 2 * SHOWN].tolist():
            name = bound.row_name(row)
            found[name] = max(found.get(name, 0.0), float(size[row]))
    order = sorted(found, key=lambda name: -found[name])[:SHOWN]
    return ", ".join(f"{name} ({found[name]:.3g} standard deviations)" for name in order)


def covariance(objective: Objective, point: Point) -> tuple[FloatArray | None, FloatArray]:
    """Return covariance (or None) and correlation of the estimate, to first order."""
    # `G N G^T` with `G = (J^T J)^-1 J^T` and N the covariance of the weighted residuals where it is
    # known, the residual variance s^2 of the residuals without a scale
    J, r = objective.slopes(point), objective.values(point)
    q = J.shape[1]
    length = np.linalg.norm(J, axis=0)
    safe = divisor(length)
    U, s, Vt = np.linalg.svd(J / safe, full_matrices=False)
    inverse = np.where(s > SAME * s[0], 1 / np.maximum(s, TINY), 0.0)
    half = (Vt.T * inverse) / safe[:, None]
    unit = half @ half.T
    # U^T N U, with N the covariance of known rows (a unit matrix of priors) and of the others
    known, other = np.zeros((s.size, s.size)), np.zeros((s.size, s.size))
    left, spare, data = 0.0, 0.0, 0
    for bound, rows in objective.rows(point):
        part, data = U[rows].T @ U[rows], rows.stop
        if bound.has_noise:
            known += U[rows].T @ bound.noise_times(U[rows])
        else:
            other += part
            left += float(r[rows] @ r[rows])
            spare += r[rows].size - bound.lost - float(np.trace(part))
    known += U[data:].T @ U[data:]
    found: FloatArray | None = None
    if objective.noise_known or spare > 0.5:
        # half a row: a smaller trace of a projector is rounding
        variance = left / spare if spare > 0.5 else 0.0
        found = half @ (known + variance * other) @ half.T
        unit = found if objective.noise_known else unit
    std = np.sqrt(np.diag(unit))
    size = divisor(std)
    correlation = unit / np.outer(size, size)
    np.fill_diagonal(correlation, 1.0)
    regular = s.size == q and bool(s[-1] > SAME * s[0])
    return (found if regular else None), correlation


@dataclass(frozen=True, eq=False)
class Resolution:
    """Combinations of q parameters that residuals determine at a point, by singular values.

    The sensitivities have columns of length one: ``J diag(1/length) = U diag(values) axes``.
    """

    values: FloatArray
    axes: FloatArray
    #: (q,) one where a parameter is not seen
    length: FloatArray
    #: (q,) whether any residual depends on a parameter
    seen: npt.NDArray[np.bool_]

    @property
    def clear(self) -> npt.NDArray[np.bool_]:
        """Which combinations (q,) are determined."""
        return np.asarray(self.values > TYPED * self.values[0])

    def combinations(self, names: Sequence[str]) -> list[str]:
        """Return a text for each determined combination, with as few parameters as possible."""
        # the rows that span them, solved for the same number of parameters, each of which appears
        # once
        rows = self.axes[self.clear] * self.length
        rank = len(rows)
        pivots = la.qr(self.axes[self.clear], mode="r", pivoting=True)[1][:rank]
        reduced = np.linalg.solve(rows[:, pivots], rows)
        felt = np.abs(reduced) / self.length > NEGLIGIBLE / self.length[pivots][:, None]
        return [
            " ".join(
                [
                    names[pivot],
                    *(
                        f"{'-' if reduced[i, j] < 0 else '+'} {abs(reduced[i, j]):.3g} {names[j]}"
                        for j in np.flatnonzero(felt[i]).tolist()
                        if j not in pivots
                    ),
                ]
            )
            for i, pivot in sorted(enumerate(pivots.tolist()), key=lambda pair: pair[1])
        ]


def resolution(
    objective: Objective, point: Point, pinned: npt.NDArray[np.bool_] | None = None
) -> Resolution:
    """Return what the residuals determine at a point; `pinned`: known otherwise, as by a prior."""
    J = objective.slopes(point, prior=False)
    length = np.linalg.norm(J, axis=0)
    own = np.abs(J).max(initial=0.0) * ROUNDING
    omega = float(np.median(np.abs(point.eigen.poles))) if point.eigen.poles.size else 1.0
    reach = objective.family.strength(omega)
    # a column far below the possible effect of the parameter on this model is rounding: relative to
    # the strongest one, and, for a single parameter, as a relative change of the data
    strongest = float(np.max(length / reach, initial=0.0))
    change = np.linalg.norm(J / divisor(objective.size(point)[: len(J)])[:, None], axis=0)
    # nine decades below the strongest there is only rounding
    seen = (length > own) & (length > 1e-9 * strongest * reach)
    seen &= change > ROUNDING * reach / omega
    length = np.where(seen, length, 1.0)
    known = np.eye(seen.size)[[] if pinned is None else pinned]
    _, s, Vt = np.linalg.svd(np.vstack([np.where(seen, J / length, 0.0), known]))
    s = np.concatenate([s, np.zeros(seen.size - s.size)])
    return Resolution(s, Vt, length, seen)

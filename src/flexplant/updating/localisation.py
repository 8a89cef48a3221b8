"""Where was something added: every candidate scored alone, then the best subset."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import combinations
from typing import Any

import numpy as np

from ..errors import ModelError, SolverError, unknown_label
from ..values import FloatArray, Value
from .methods import TrustRegion
from .objective import Objective, checked_residuals
from .parameters import Parameter
from .search import trust_region
from .sensitivity import checked_parameters
from .sparse_search import bic

#: pairs of the best so many candidates are all tried
PAIRS = 4
#: candidates that may join the best subset
JOIN = 8
#: single candidates within this of the best BIC are as good
ALIKE = 2.0


@dataclass(frozen=True, eq=False, repr=False)
class Localisation(Value):
    """Which candidates explain a measurement.

    Parameters
    ----------
    candidates : sequence of c str
        Names, in the order given.
    values : (c,) array
        What each candidate would have to be if it were the only change; NaN when it could not
        be fitted.
    score : (c,) array
        The share of the residual's sum of squares that each explains alone, at most 1.
    bic : (c,) array
        Bayesian information criterion of each alone.
    chosen : sequence of str
        The subset of least BIC; empty when nothing at all is best.
    chosen_values : array
        Its values.
    chosen_bic, nothing_bic : float
        BIC of the subset, and of no change.
    """

    candidates: tuple[str, ...]
    values: FloatArray
    score: FloatArray
    bic: FloatArray
    chosen: tuple[str, ...]
    chosen_values: FloatArray
    chosen_bic: float
    nothing_bic: float

    def __post_init__(self) -> None:
        self._set(
            values=self.values, score=self.score, bic=self.bic, chosen_values=self.chosen_values
        )

    def __getitem__(self, name: str) -> float:
        """Return the score of a candidate."""
        if name not in self.candidates:
            raise unknown_label("candidate", name, self.candidates)
        return float(self.score[self.candidates.index(name)])

    @property
    def ranking(self) -> tuple[str, ...]:
        """All candidates, the best score first."""
        order = np.argsort(-self.score, kind="stable")
        return tuple(self.candidates[i] for i in order)

    @property
    def alike(self) -> tuple[str, ...]:
        """Single candidates that the data cannot tell from the best one (BIC within 2).

        On a symmetric structure poles alone leave all mirror images alike.
        """
        near = np.flatnonzero(self.bic <= np.min(self.bic) + ALIKE)
        return tuple(self.candidates[i] for i in near[np.argsort(self.bic[near], kind="stable")])

    def __repr__(self) -> str:
        best = ", ".join(f"{name} {self[name]:.4f}" for name in self.ranking[:3])
        found = ", ".join(
            f"{name} = {value:.4g}"
            for name, value in zip(self.chosen[:4], self.chosen_values.tolist(), strict=False)
        )
        if len(self.alike) > 1:
            best += f"; {len(self.alike)} alike"
        return (
            f"<Localisation: {found or 'no change'} (BIC {self.chosen_bic:.4g}, no change "
            f"{self.nothing_bic:.4g})\n  explained alone: {best}>"
        )


def localise(
    model: Any,
    residuals: Sequence[Any],
    candidates: Sequence[Parameter],
    *,
    most: int = 3,
    screen: int = 40,
) -> Localisation:
    """Find which of many candidate changes explains a measurement.

    All candidates are fitted together, each alone, by linearisation (one rank-one change each,
    in one product); the best `screen` of them are fitted exactly. Then subsets of up to `most`
    candidates grow from the best, all pairs of the best four being tried too, and the least
    Bayesian information criterion ``chi^2 + k ln n`` (``n ln(e/n) + k ln n`` where the noise is
    not known) chooses. To know what stands out, give more data than `most` unknowns.

    Parameters
    ----------
    model : ReducedModel or FEModel
        Without the change.
    residuals : sequence of Residual
        Measured with the change.
    candidates : sequence of c Parameter
        Added masses or springs at every DOF in question, say.
    most : int
        Largest subset.
    screen : int
        How many are fitted exactly.

    Returns
    -------
    Localisation

    Raises
    ------
    ModelError, LabelError
        As `update`; or when the counts make no sense.

    References
    ----------
    Schwarz: Estimating the dimension of a model, Annals of Statistics 6, 1978.
    """
    listed = checked_parameters(candidates)
    given = checked_residuals(residuals)
    for name, value in (("most", most), ("screen", screen)):
        if isinstance(value, bool) or not isinstance(value, int | np.integer) or value < 1:
            raise ModelError(f"{name} must be a whole number from 1, got {value!r}.")
    whole = Objective(model, listed, given, prior=False)
    start = whole.default_start
    point = whole.begin(start)
    r = whole.values(point)
    error, rows = float(r @ r), r.size
    explained = _screened(whole, given, point, r)
    fits = _Fits(whole, given, start)
    values, score = np.full(len(listed), np.nan), explained / error
    criterion = np.full(len(listed), np.inf)
    for i in np.argsort(-explained)[:screen].tolist():
        found = fits.fit((i,))
        score[i] = 0.0
        if found is not None:
            values[i], score[i] = found[0][0], 1 - found[1] / error
            criterion[i] = bic(found[1], rows, 1, whole.noisy)
    for i in np.argsort(-explained)[screen:].tolist():
        # known to first order only: never better than what was fitted exactly
        score[i] = min(score[i], float(np.nanmin(score[np.isfinite(criterion)], initial=1.0)))
    nothing = bic(error, rows, 0, whole.noisy)
    best: tuple[float, tuple[int, ...]] = (nothing, ())
    ranked = [i for i in np.argsort(-score, kind="stable").tolist() if np.isfinite(criterion[i])]
    layer = [(i,) for i in ranked]
    for size in range(1, min(most, rows - 1) + 1):
        scores = []
        for subset in layer:
            found = fits.fit(subset)
            if found is not None:
                scores.append((bic(found[1], rows, size, whole.noisy), subset))
        if not scores:
            break
        least = min(scores)
        best = min(best, least)
        grown = {tuple(sorted((*least[1], i))) for i in ranked[:JOIN] if i not in least[1]}
        grown |= set(combinations(sorted(ranked[:PAIRS]), 2)) if size == 1 else set()
        layer = sorted(grown)
    chosen = fits.fit(best[1]) if best[1] else None
    return Localisation(
        candidates=tuple(q.name for q in listed),
        values=values,
        score=score,
        bic=criterion,
        chosen=tuple(listed[i].name for i in best[1]),
        chosen_values=np.zeros(0) if chosen is None else np.array(chosen[0]),
        chosen_bic=best[0],
        nothing_bic=nothing,
    )


def _screened(whole: Objective, residuals: Any, point: Any, r: FloatArray) -> FloatArray:
    """Return what each candidate explains to first order: ``(J_c^T r)^2 / (J_c^T J_c)``.

    Where modes are repeated their slopes depend on the candidate, so each is taken by itself.
    """
    if not point.turned:
        J = whole.slopes(point)
        length = np.sum(J**2, axis=0)
        return np.asarray((J.T @ r) ** 2 / np.where(length > 0, length, np.inf))
    found = []
    for b in range(point.p.size):
        alone = Objective(
            whole.family.model,
            whole.parameters[b : b + 1],
            residuals,
            prior=False,
            family=whole.family.of([b]),
        )
        J = alone.slopes(alone.begin(point.p[b : b + 1]))[:, 0]
        found.append(float(J @ r) ** 2 / max(float(J @ J), 1e-300))
    return np.array(found)


class _Fits:
    """Exact fits of subsets of the candidates, each done once."""

    def __init__(self, whole: Objective, residuals: Any, start: FloatArray) -> None:
        self.whole, self.residuals, self.start = whole, residuals, start
        self.done: dict[tuple[int, ...], tuple[FloatArray, float] | None] = {}

    def fit(self, subset: tuple[int, ...]) -> tuple[FloatArray, float] | None:
        """Return the values and the error of a subset, None when it cannot be fitted."""
        if subset not in self.done:
            self.done[subset] = self._fitted(subset)
        return self.done[subset]

    def _fitted(self, subset: tuple[int, ...]) -> tuple[FloatArray, float] | None:
        picked = list(subset)
        family = self.whole.family.of(picked)
        parameters = [self.whole.parameters[i] for i in picked]
        objective = Objective(family.model, parameters, self.residuals, prior=False, family=family)
        try:
            found = trust_region(
                objective, self.start[picked], TrustRegion(), most=50, tolerance=1e-8
            )
        except (ModelError, SolverError):
            return None
        return found.p, 2 * found.cost

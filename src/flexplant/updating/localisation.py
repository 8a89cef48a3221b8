"""Where was something added: every candidate scored alone, then the best subset."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from itertools import combinations
from typing import Any

import numpy as np

from ..errors import ModelError, SolverError, unknown_label
from ..values import FloatArray, Value
from ..values import whole as counted
from .parameters import Parameter
from .search import Found, Objective, TrustRegion, checked_residuals
from .search.lasso import bic
from .sensitivity import checked_parameters

#: pairs of the best so many candidates are all tried
PAIRS = 4
#: candidates that may join the best subset
JOIN = 8
#: single candidates within this of the best BIC are as good
ALIKE = 2.0
#: share of the residual by which rivals explain less than the best at most
NEAR = 0.01
#: names in a line of a repr, lines in a table
SHOWN, ROWS = 6, 12


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
    nuisance : sequence of n str
        Parameters that were fitted along with every candidate, and with none.
    nuisance_values : (n,) array
        Theirs beside the chosen subset.
    """

    candidates: tuple[str, ...]
    values: FloatArray
    score: FloatArray
    bic: FloatArray
    chosen: tuple[str, ...]
    chosen_values: FloatArray
    chosen_bic: float
    nothing_bic: float
    nuisance: tuple[str, ...] = ()
    nuisance_values: FloatArray = field(default_factory=lambda: np.zeros(0))

    def __post_init__(self) -> None:
        self._set(
            values=self.values,
            score=self.score,
            bic=self.bic,
            chosen_values=self.chosen_values,
            nuisance_values=self.nuisance_values,
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

    @property
    def rivals(self) -> tuple[str, ...]:
        """Candidates that alone explain nearly as much as the best one, at most 1 % less.

        The data tell those that are not `alike` from the best, but only by a small part of the
        residual, which an error of the model itself could make or hide: mirror images on a
        symmetric structure.
        """
        least = float(np.max(self.score)) - NEAR
        return tuple(name for name in self.ranking[1:] if self[name] >= least)

    @property
    def table(self) -> str:
        """The best candidates in lines: value alone, share explained, BIC above the least one's."""
        width = max(len("candidate"), *(len(name) for name in self.ranking[:ROWS]))
        lines = [f"{'candidate':{width}s}{'value alone':>13s}{'explained':>11s}{'BIC +':>10s}"]
        least = float(np.min(self.bic))
        for name in self.ranking[:ROWS]:
            i = self.candidates.index(name)
            known = np.isfinite(self.bic[i])
            more = f"{self.bic[i] - least:10.1f}" if known else f"{'-':>10s}"
            mark = "  chosen" if name in self.chosen else ""
            others = len(self.alike) > 1 and name in self.alike
            mark += "  alike" if others else "  rival" if name in self.rivals else ""
            lines.append(f"{name:{width}s}{self.values[i]:13.5g}{self.score[i]:11.4f}{more}{mark}")
        rest = len(self.candidates) - len(lines) + 1
        return "\n".join([*lines, *([f"and {rest} more"] if rest else [])])

    def __repr__(self) -> str:
        best = ", ".join(f"{name} {self[name]:.4f}" for name in self.ranking[:3])
        found = ", ".join(
            f"{name} = {value:.4g}"
            for name, value in zip(self.chosen[:4], self.chosen_values.tolist(), strict=False)
        )
        if self.nuisance:
            beside = ", ".join(
                f"{name} = {value:.4g}"
                for name, value in zip(self.nuisance, self.nuisance_values.tolist(), strict=True)
            )
            found = f"{found or 'no change'} beside {beside}"
        text = (
            f"<Localisation: {found or 'no change'} (BIC {self.chosen_bic:.4g}, no change "
            f"{self.nothing_bic:.4g})\n  explained alone: {best}"
        )
        if len(self.alike) > 1:
            text += f"\n  AMBIGUOUS, {len(self.alike)} alike: {_shown(self.alike)}"
        rivals = [name for name in self.rivals if len(self.alike) < 2 or name not in self.alike]
        if rivals and self.chosen:
            text += f"\n  told by less than {NEAR:.0%} of the data from: {_shown(rivals)}"
        return text + ">"


def _shown(names: Sequence[str]) -> str:
    more = f" and {len(names) - SHOWN} more" if len(names) > SHOWN else ""
    return ", ".join(names[:SHOWN]) + more


def localise(
    model: Any,
    residuals: Sequence[Any],
    candidates: Sequence[Parameter],
    *,
    nuisance: Sequence[Parameter] = (),
    most: int = 3,
    screen: int = 40,
) -> Localisation:
    """Find which of many candidate changes explains a measurement.

    All candidates are fitted together, each alone, by linearisation (one rank-one change each,
    in one product); the best `screen` of them are fitted exactly. Then subsets of up to `most`
    candidates grow from the best, all pairs of the best four being tried too, and the least
    Bayesian information criterion ``chi^2 + k ln n`` (``n ln(e/n) + k ln n`` where the noise is
    not known) chooses. To know what stands out, give more data than `most` unknowns.

    What is wrong everywhere (Young's modulus, damping) hides what is wrong in one place: as
    `nuisance` it is fitted anew with every candidate and with none at all, so that a candidate is
    scored by what only it explains: ``(J_c^T r)^2 / (J_c^T J_c)`` with r and J_c free of what the
    nuisance explains, before the exact fits.

    Parameters
    ----------
    model : ReducedModel or FEModel
        Without the change.
    residuals : sequence of Residual
        Measured with the change.
    candidates : sequence of c Parameter
        Added masses or springs at every DOF in question, say.
    nuisance : sequence of Parameter, optional
        Unknowns beside the candidates; their priors are not used.
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
        As `update`; or when the counts make no sense, a nuisance is a candidate too, or there
        are no more data than nuisance parameters.

    References
    ----------
    Schwarz: Estimating the dimension of a model, Annals of Statistics 6, 1978.
    """
    listed = checked_parameters(candidates)
    none = isinstance(nuisance, list | tuple) and not nuisance
    beside = () if none else checked_parameters(nuisance)
    both = sorted({q.name for q in listed} & {q.name for q in beside})
    if both:
        raise ModelError(
            f"{', '.join(both)}: a candidate and a nuisance at once. Leave it out of one of them."
        )
    given = checked_residuals(residuals)
    most, screen = counted(most, "most"), counted(screen, "screen")
    whole = Objective(model, [*listed, *beside], given, prior=False)
    fits = _Fits(whole, given, len(listed))
    begin = fits.begin()
    point = whole.begin(begin)
    r = whole.values(point)
    error, rows, n = float(r @ r), r.size, len(beside)
    if rows <= n:
        raise ModelError(
            f"{rows} data do not tell {n} nuisance parameters, let alone a candidate beside them: "
            "measure more modes or lines."
        )
    explained = _screened(whole, given, point, r, len(listed))
    values, score = np.full(len(listed), np.nan), explained / error
    criterion = np.full(len(listed), np.inf)
    for i in np.argsort(-explained)[:screen].tolist():
        found = fits.fit((i,))
        score[i] = 0.0
        if found is not None:
            values[i], score[i] = found[0][0], 1 - found[1] / error
            criterion[i] = bic(found[1], rows, 1 + n, whole.noisy)
    for i in np.argsort(-explained)[screen:].tolist():
        # known to first order only: never better than what was fitted exactly
        score[i] = min(score[i], float(np.nanmin(score[np.isfinite(criterion)], initial=1.0)))
    nothing = bic(error, rows, n, whole.noisy)
    best: tuple[float, tuple[int, ...]] = (nothing, ())
    ranked = [i for i in np.argsort(-score, kind="stable").tolist() if np.isfinite(criterion[i])]
    layer = [(i,) for i in ranked]
    for size in range(1, min(most, rows - 1 - n) + 1):
        scores = []
        for subset in layer:
            found = fits.fit(subset)
            if found is not None:
                scores.append((bic(found[1], rows, size + n, whole.noisy), subset))
        if not scores:
            break
        least = min(scores)
        best = min(best, least)
        grown = {tuple(sorted((*least[1], i))) for i in ranked[:JOIN] if i not in least[1]}
        grown |= set(combinations(sorted(ranked[:PAIRS]), 2)) if size == 1 else set()
        layer = sorted(grown)
    chosen = fits.fit(best[1]) if best[1] else None
    end = begin[len(listed) :] if chosen is None else chosen[0][len(best[1]) :]
    return Localisation(
        candidates=tuple(q.name for q in listed),
        values=values,
        score=score,
        bic=criterion,
        chosen=tuple(listed[i].name for i in best[1]),
        chosen_values=np.zeros(0) if chosen is None else np.array(chosen[0][: len(best[1])]),
        chosen_bic=best[0],
        nothing_bic=nothing,
        nuisance=tuple(q.name for q in beside),
        nuisance_values=np.array(end),
    )


def _screened(
    whole: Objective, residuals: Any, point: Any, r: FloatArray, count: int
) -> FloatArray:
    """Return what each candidate explains to first order, what the nuisance explains taken out.

    Where modes are repeated their slopes depend on the candidate, so each is taken by itself.
    """
    if not point.turned:
        J = whole.slopes(point)
        return _explained(J[:, :count], J[:, count:], r)
    found = []
    for b in range(count):
        picked = [b, *range(count, point.p.size)]
        alone = Objective(
            whole.family.model,
            [whole.parameters[i] for i in picked],
            residuals,
            prior=False,
            family=whole.family.of(picked),
        )
        J = alone.slopes(alone.begin(point.p[picked]))
        found.append(_explained(J[:, :1], J[:, 1:], r)[0])
    return np.array(found)


def _explained(J: FloatArray, beside: FloatArray, r: FloatArray) -> FloatArray:
    Q = np.linalg.qr(beside)[0]
    whole = np.sum(J**2, axis=0)
    J, r = J - Q @ (Q.T @ J), r - Q @ (Q.T @ r)
    length = np.sum(J**2, axis=0)
    # a candidate that is all nuisance explains nothing of its own
    own = length > 1e-12 * whole
    return np.asarray((J.T @ r) ** 2 / np.where(own, length, np.inf))


class _Fits:
    """Exact fits of subsets of the candidates, the nuisance beside them, each done once."""

    def __init__(self, whole: Objective, residuals: Any, count: int) -> None:
        self.whole, self.residuals = whole, residuals
        self.beside = list(range(count, len(whole.parameters)))
        self.start = whole.default_start
        self.done: dict[tuple[int, ...], tuple[FloatArray, float] | None] = {}

    def begin(self) -> FloatArray:
        """Return the start with the nuisance fitted alone."""
        if self.beside:
            p = self._search([]).p
            self.start = self.start.copy()
            self.start[self.beside] = p
        return self.start

    def fit(self, subset: tuple[int, ...]) -> tuple[FloatArray, float] | None:
        """Return values (those of the nuisance last) and error, None when it cannot be fitted."""
        if subset not in self.done:
            try:
                found = self._search([*subset])
                self.done[subset] = found.p, 2 * found.cost
            except (ModelError, SolverError):
                self.done[subset] = None
        return self.done[subset]

    def _search(self, subset: list[int]) -> Found:
        picked = [*subset, *self.beside]
        family = self.whole.family.of(picked)
        parameters = [self.whole.parameters[i] for i in picked]
        objective = Objective(family.model, parameters, self.residuals, prior=False, family=family)
        return TrustRegion().search(objective, self.start[picked], most=50, tolerance=1e-8)

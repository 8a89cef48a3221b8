"""Localisation of changes: every candidate is scored separately, then the best subset."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from ...arrays import FloatArray
from ...arrays import whole as counted
from ...errors import ModelError, aligned, require_known, some_names, warn
from ...parallel import Progress
from ...store import Value
from ...tolerances import CLOSE
from ..family import is_large
from ..full_basis import FullBasis
from ..parameters import Parameter, checked_parameters
from ..search import Objective, checked_residuals
from ..search.objective import chance, is_bad
from .subsets import Subsets
from .twins import ALIKE, alike_sets

#: fraction of the first-order effect of the best candidate above which another one is fitted, and
#: number that is always fitted
WORTH, FEWEST = 0.25, 10


def localise(
    model: Any,
    candidates: Sequence[Parameter],
    residuals: Sequence[Any],
    *,
    nuisance: Sequence[Parameter] = (),
    most: int = 3,
    screen: int = 40,
    progress: bool | None = None,
) -> Localisation:
    """Find which of many candidate changes explains a measurement.

    The call ``found = fx.updating.localise(drawing, candidates, residuals)`` has a candidate for
    every place, for example ``[fx.AddedMass(at) for at in drawing.dofs.labels]``. `found.chosen`
    names up to `most` of them. It is empty if no change explains the data better than the model
    itself. `found.ranking` sorts all candidates by their separate effect. `found.alike_sets` are
    the sets that explain the data equally well, and `found.alike` contains all their members. On a
    symmetric structure there are many such sets. Pass each of them to `update`, or distinguish them
    by measured shapes or responses. Errors of the whole structure (Young's modulus, damping) are
    given as `nuisance`. The method is described in `algorithms`.

    Parameters
    ----------
    model : ReducedModel or FEModel
        Model without the change. An FEModel of more than 150 DOFs is replaced by a basis of its
        modes and the static responses to loads at the candidates.
    candidates : sequence of c Parameter
        Possible changes, for example added masses or springs at every DOF.
    residuals : sequence of Residual
        Residuals measured with the change.
    nuisance : sequence of Parameter, optional
        Unknown parameters that are fitted in addition, but are not candidates. Their priors are not
        used.
    most : int
        Largest number of candidates that are chosen together.
    screen : int
        Largest number of candidates that are fitted. A candidate is fitted if its effect to first
        order is at least a quarter of the best one's. At least ten are fitted.
    progress : bool, optional
        Whether to show a progress bar. None: a bar is shown on a terminal for work of more than two
        seconds.

    Returns
    -------
    Localisation
        Chosen candidates, and the ranking of all candidates.

    Warns
    -----
    FlexplantWarning
        When the residual of the chosen subset exceeds noise with a p-value below 1e-3 (`p_value`).

    Raises
    ------
    ModelError, LabelError
        In the same cases as for `update`. Also when `most` or `screen` is not valid, a nuisance
        parameter is also a candidate, or there are not more data than nuisance parameters.

    Notes
    -----
    The probability that a superfluous candidate is chosen is known. Let n be the number of data,
    and let k of c candidates be chosen already. Another one is added if it lowers chi-square by
    more than the price ``ln n + 2 ln((c - k) / (k + 1))``. By noise alone this happens with the
    probability ``(c - k) P(chi2_1 > price)``, where chi2_1 follows the chi-square distribution with
    one degree of freedom. For 12 to 25 candidates, 20 to 24 data and one true change, this happens
    in 10 to 13 of 100 measurements. The `margin` is then small.

    References
    ----------
    [ChenChen2008]_; [KassRaftery1995]_.

    Examples
    --------
    The third mass is heavier than in the drawing. Among three added masses, the search finds this
    place:

    >>> import flexplant as fx
    >>> drawing = fx.chain(masses=[1.0, 2.0, 1.5], stiffnesses=[4e5, 3e5])
    >>> heavier = fx.chain(masses=[1.0, 2.0, 1.8], stiffnesses=[4e5, 3e5])
    >>> measured = fx.MeasuredModes(poles=fx.solve_modes(heavier, count=3).poles[1:], modes=[2, 3])
    >>> masses = [fx.AddedMass(place, name=place) for place in drawing.dofs.labels]
    >>> fx.updating.localise(drawing, masses, [fx.Eigenvalues(measured)]).ranking[0]
    '3:x'
    """
    listed = checked_parameters(candidates)
    none = isinstance(nuisance, list | tuple) and not nuisance
    extra = () if none else checked_parameters(nuisance)
    both = sorted({q.name for q in listed} & {q.name for q in extra})
    if both:
        raise ModelError(
            f"{', '.join(both)}: both a candidate and a nuisance parameter. Leave it out of one "
            "of them."
        )
    given = checked_residuals(residuals)
    most, screen = counted(most, "most"), counted(screen, "screen")
    if is_large(model):
        model = FullBasis(model, [*listed, *extra], given).at(np.zeros(len(listed) + len(extra)))
    whole = Objective(model, [*listed, *extra], given, prior=False)
    fits = Subsets(whole, given, len(listed))
    if fits.rows <= len(extra):
        raise ModelError(
            f"{fits.rows} data do not determine {counted(len(extra), 'nuisance parameter')} and "
            "a candidate: measure more modes or lines."
        )
    values, score, criterion = _singles(fits, screen, progress)
    ranked = [i for i in np.argsort(-score, kind="stable").tolist() if np.isfinite(criterion[i])]
    best = fits.best(ranked, most)
    fits.polish(best)
    alike = alike_sets(fits, best)
    if alike and fits.score(alike[0]) < fits.score(best):
        best = alike[0]
        fits.polish(best)
    fit = fits.fit(best)
    next_best, next_bic = fits.runner_up(best)
    p = np.zeros(0) if fit is None else fit.p
    chi2, dof = fits.chi2(best)
    found = Localisation(
        candidates=tuple(q.name for q in listed),
        values=values,
        score=score,
        bic=criterion,
        chosen=tuple(listed[i].name for i in best),
        chosen_values=np.array(p[: len(best)]),
        chosen_bic=fits.score(best),
        nothing_bic=fits.score(()),
        nuisance=tuple(q.name for q in extra),
        nuisance_values=np.array(p[len(best) :]),
        chi2=chi2,
        dof=dof,
        units=tuple(q.unit for q in listed),
        next_best=tuple(listed[i].name for i in next_best),
        next_bic=next_bic,
        alike_sets=tuple(tuple(listed[i].name for i in one) for one in alike),
    )
    if fit is not None and is_bad(found.p_value):
        full = len(best) >= most
        warn(
            f"{' and '.join(found.chosen) or 'no change'}, the best of {len(listed)} candidates, "
            f"{'leave' if len(best) > 1 else 'leaves'} more than noise: chi-square "
            f"{chi2:.4g} for dof = {dof}. It fits worst {fits.worst(best)}. "
            "Something else differs between model and machine, or the noise is understated: give "
            f"{'most= more, ' if full else ''}candidates at other places or of another kind, or "
            "errors of the whole structure as nuisance=."
        )
    return found


def _singles(
    fits: Subsets, screen: int, progress: bool | None
) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Return value, share explained and criterion of each candidate alone."""
    nothing = fits.fit(())
    error = 0.0 if nothing is None else nothing.error
    explained = fits.explained(())
    values, score = np.full(fits.count, np.nan), explained / error
    criterion = np.full(fits.count, np.inf)
    order = np.argsort(-explained)
    worth = int(np.sum(explained >= WORTH * np.max(explained)))
    tried = order[: min(screen, max(worth, FEWEST))]
    with Progress(tried.size, "candidates", progress=progress) as bar:
        for i in tried.tolist():
            found = fits.fit((i,))
            score[i] = 0.0
            if found is not None:
                values[i], score[i] = found.p[0], 1 - found.error / error
                criterion[i] = fits.score((i,))
            bar.advance()
    for i in order[tried.size :].tolist():
        # only known to first order: never better than an exact fit
        score[i] = min(score[i], float(np.nanmin(score[np.isfinite(criterion)], initial=1.0)))
    return values, score, criterion


#: difference of BIC that is very strong evidence ([KassRaftery1995]_: 10)
CERTAIN = 10.0
#: number of names in a line of a repr, and of lines in a table
SHOWN, ROWS = 6, 12


@dataclass(frozen=True, eq=False, repr=False)
class Localisation(Value):
    """Result of `localise`: the candidates that explain a measurement.

    Parameters
    ----------
    candidates : sequence of c str
        Names of the candidates.
    values : (c,) array
        Value of each candidate if it were the only change. NaN: the fit failed.
    score : (c,) array
        Fraction of the residual's sum of squares that each candidate alone explains, at most 1.
    bic : (c,) array
        Extended Bayesian information criterion (BIC) of each candidate alone. It is chi-square plus
        a penalty that grows with the number of parameters. A smaller value is better.
    chosen : sequence of str
        Set of candidates with the smallest BIC. It is empty if the model without a change has the
        smallest one.
    chosen_values : array
        Values of the chosen candidates.
    chosen_bic, nothing_bic : float
        BIC of the chosen set, and of the model without a change.
    nuisance : sequence of n str
        Names of the parameters that were fitted in addition, in every fit.
    nuisance_values : (n,) array
        Values of the nuisance parameters with the chosen subset.
    chi2 : float or None
        Chi-square of the chosen subset, None where the noise is not known.
    dof : int
        Number of residuals minus number of fitted parameters.
    units : sequence of c str, optional
        Units of the candidates.
    next_best : sequence of str
        The best of the fitted sets that do not contain all chosen candidates. It is empty if this
        is the model without a change.
    next_bic : float
        BIC of `next_best`. It is infinite if no other set was fitted.
    alike_sets : sequence of tuples of str
        Sets of the same size as the chosen one that explain the data equally well, the best first.
        Their BIC is at most 2 above the least one. On a symmetric structure the data may
        not distinguish a place from its mirror image. Then all sets are listed in which places are
        replaced by their mirror images.
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
    chi2: float | None = None
    dof: int = 0
    units: tuple[str, ...] = ()
    next_best: tuple[str, ...] = ()
    next_bic: float = np.inf
    alike_sets: tuple[tuple[str, ...], ...] = ()

    @property
    def margin(self) -> float:
        """Difference d of the BIC between the next set and the chosen one.

        The chosen set is more likely than the next one by the factor ``exp(d/2)``. If d is below
        10, the next set is possible too. If the residual exceeds noise (`p_value`), the residual is
        caused by errors of the model, and the difference is divided by ``chi2 / dof``.
        """
        wrong = is_bad(self.p_value) and self.chi2 is not None
        size = (self.chi2 or 0.0) / max(self.dof, 1) if wrong else 1.0
        return (self.next_bic - self.chosen_bic) / size

    def __getitem__(self, name: str) -> float:
        """Return the score of a candidate."""
        require_known("candidate", [name], self.candidates)
        return float(self.score[self.candidates.index(name)])

    @property
    def p_value(self) -> float | None:
        """Probability that noise alone causes a larger `chi2`, None if it is not known."""
        return chance(self.chi2, self.dof)

    @property
    def ranking(self) -> tuple[str, ...]:
        """All candidates, the best score first."""
        order = np.argsort(-self.score, kind="stable")
        return tuple(self.candidates[i] for i in order)

    @property
    def leading(self) -> tuple[str, ...]:
        """The twelve best single candidates, and chosen candidates that are not among them."""
        best = self.ranking[:ROWS]
        return (*best, *(name for name in self.chosen if name not in best))

    @property
    def alike(self) -> tuple[str, ...]:
        """Candidates of all `alike_sets`, the best set first.

        If no change is chosen, these are single candidates that the data cannot distinguish from
        the best one. Poles alone do not distinguish mirror images on a symmetric structure.
        """
        if self.chosen:
            return tuple(dict.fromkeys(name for one in self.alike_sets for name in one))
        near = np.flatnonzero(self.bic <= np.min(self.bic) + ALIKE)
        return tuple(self.candidates[i] for i in near[np.argsort(self.bic[near], kind="stable")])

    @property
    def rivals(self) -> tuple[str, ...]:
        """Candidates that alone explain nearly as much as the best one, at most 1 % less.

        Some of them are not in `alike`, for example mirror images on a nearly symmetric structure.
        They explain less than the best one, but the difference is so small that a model error may
        have caused it.
        """
        least = float(np.max(self.score)) - CLOSE
        return tuple(name for name in self.ranking[1:] if self[name] >= least)

    @property
    def table(self) -> str:
        """Table of the leading candidates: value, explained fraction, BIC minus the least BIC."""
        least, rows = float(np.min(self.bic)), []
        for name in self.leading:
            i = self.candidates.index(name)
            more = f"{self.bic[i] - least:.1f}" if np.isfinite(self.bic[i]) else "-"
            mark = "chosen" if name in self.chosen else ""
            others = len(self.alike) > max(len(self.chosen), 1) and name in self.alike
            mark += "  alike" if others else "  rival" if name in self.rivals else ""
            rows.append((name, f"{self.values[i]:.5g}", f"{self.score[i]:.4f}", more, mark))
        rest = len(self.candidates) - len(rows)
        lines = aligned(("candidate", "value alone", "explained", "BIC +", ""), rows)
        return "\n".join([*lines, *([f"and {rest} more"] if rest else [])])

    def __repr__(self) -> str:
        best = ", ".join(f"{name} {self[name]:.4f}" for name in self.ranking[:3])
        found = ", ".join(
            f"{name} = {value:.4g}"
            for name, value in zip(self.chosen[:4], self.chosen_values.tolist(), strict=False)
        )
        if self.nuisance:
            together = ", ".join(
                f"{name} = {value:.4g}"
                for name, value in zip(self.nuisance, self.nuisance_values.tolist(), strict=True)
            )
            found = f"{found or 'no change'} with {together}"
        text = (
            f"<Localisation: {found or 'no change'} (BIC {self.chosen_bic:.4g}, no change "
            f"{self.nothing_bic:.4g})\n  explained alone: {best}"
        )
        if len(self.alike_sets) > 1:
            sets = f"{len(self.alike_sets)} sets of " if len(self.chosen) > 1 else ""
            names = some_names(self.alike, SHOWN)
            text += f"\n  AMBIGUOUS, {sets}{len(self.alike)} alike: {names}"
        rivals = [name for name in self.rivals if name not in self.alike]
        if rivals and self.chosen:
            named = some_names(rivals, SHOWN)
            text += f"\n  differs by less than {CLOSE:.0%} of the data from: {named}"
        if self.chosen and np.isfinite(self.next_bic):
            said = "NOT CERTAIN, next" if self.margin < CERTAIN else "next"
            other = ", ".join(self.next_best) or "no change"
            text += f"\n  {said}: {other}, worse by {self.margin:.3g}"
            text += " (likelihood ratio exp(d/2))"
        if is_bad(self.p_value):
            text += f"\n  RESIDUAL EXCEEDS NOISE: chi2 {self.chi2:.4g} for {self.dof} dof"
        return text + ">"

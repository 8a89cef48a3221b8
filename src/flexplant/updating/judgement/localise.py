"""Where was something added: every candidate scored alone, then the best subset."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np

from ...errors import ModelError, warn
from ...parallel import Progress
from ...structure.model import FEModel
from ...values import FloatArray
from ...values import whole as counted
from ..full_basis import FullBasis
from ..parameters.added import Parameter
from ..search import Objective, checked_residuals
from ..sensitivities import checked_parameters
from .goodness import is_bad
from .localisation import Localisation
from .subsets import Subsets

#: part of what the best candidate explains to first order that makes another worth a fit, and how
#: many are fitted in any case
WORTH, FEWEST = 0.25, 10
#: DOFs of an FEModel above which a basis replaces it
LARGE = 150


def localise(
    model: Any,
    residuals: Sequence[Any],
    candidates: Sequence[Parameter],
    *,
    nuisance: Sequence[Parameter] = (),
    most: int = 3,
    screen: int = 40,
    progress: bool | None = None,
) -> Localisation:
    """Find which of many candidate changes explains a measurement.

    All candidates are screened together, each alone, by linearisation (one rank-one change each,
    in one product); the best `screen` of them are fitted. Then subsets of up to `most`
    candidates grow: all candidates are screened again on what the best subsets leave, all pairs
    to first order, and members are exchanged while that helps; a candidate that explains, to first
    order, less than a quarter of what would lower the criterion does not join. Where modes are
    compared and candidates are of low rank (masses, springs, dampers), each fit is made in few
    coordinates, the modes of the band and how the others follow the candidate's force, with its
    error corrected to second order; the chosen subset is fitted again in all. The least extended
    Bayesian
    information criterion ``chi^2 + k ln n + 2 ln C(c, k)`` (``n ln(e/n)`` for ``chi^2`` where the
    noise is not known) chooses; its last term counts in how many ways k of c places can be chosen,
    so that c places without a change name none. To find what stands out, give more data than
    `most` unknowns.

    What is wrong everywhere (Young's modulus, damping) hides what is wrong in one place: as
    `nuisance` it is fitted anew with every candidate and with none at all, so that a candidate is
    scored by what only it explains: ``(J_c^T r)^2 / (J_c^T J_c)`` with r and J_c free of what the
    nuisance explains, before the exact fits.

    Parameters
    ----------
    model : ReducedModel or FEModel
        Without the change. An FEModel of more than 150 DOFs is replaced by a basis of its modes
        and the static responses to loads at the candidates.
    residuals : sequence of Residual
        Measured with the change.
    candidates : sequence of c Parameter
        Added masses or springs at every DOF in question, say.
    nuisance : sequence of Parameter, optional
        Unknowns beside the candidates; their priors are not used.
    most : int
        Largest subset.
    screen : int
        How many are fitted, at most: those that explain, to first order, a quarter of what
        the best one does, and ten in any case.
    progress : bool, optional
        A bar: None shows one on a terminal for work of more than two seconds.

    Returns
    -------
    Localisation
        Its repr says when the chosen subset leaves more than noise (`p_value`).

    Warns
    -----
    FlexplantWarning
        When the chosen subset leaves more than noise does in one of 10 000 cases.

    Raises
    ------
    ModelError, LabelError
        As `update`; or when the counts make no sense, a nuisance is a candidate too, or there
        are no more data than nuisance parameters.

    References
    ----------
    [ChenChen2008]_.

    Examples
    --------
    >>> import flexplant as fx
    >>> modes = fx.solve_modes(fx.chain(masses=[1.0, 2.0, 1.5], stiffnesses=[4e5, 3e5]), count=3)
    >>> drawing = fx.reduce(modes, fx.DesiredDofs(["1:x", "2:x", "3:x"]))
    >>> heavier = fx.chain(masses=[1.0, 2.0, 1.8], stiffnesses=[4e5, 3e5])
    >>> measured = fx.MeasuredModes(poles=fx.solve_modes(heavier, count=3).poles[1:], modes=[2, 3])
    >>> masses = [fx.AddedMass(place, name=place) for place in drawing.dofs.labels]
    >>> fx.localise(drawing, [fx.Eigenvalues(measured)], masses).ranking[0]
    '3:x'
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
    if isinstance(model, FEModel) and model.n_dof > LARGE:
        model = FullBasis(model, [*listed, *beside], given).at(np.zeros(len(listed) + len(beside)))
    whole = Objective(model, [*listed, *beside], given, prior=False)
    fits = Subsets(whole, given, len(listed))
    if fits.rows <= len(beside):
        raise ModelError(
            f"{fits.rows} data do not determine {counted(len(beside), 'nuisance parameter')}, let "
            "alone a candidate beside them: measure more modes or lines."
        )
    values, score, criterion = _singles(fits, screen, progress)
    ranked = [i for i in np.argsort(-score, kind="stable").tolist() if np.isfinite(criterion[i])]
    best = fits.best(ranked, most)
    fits.polish(best)
    fit = fits.fit(best)
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
        nuisance=tuple(q.name for q in beside),
        nuisance_values=np.array(p[len(best) :]),
        chi2=chi2,
        dof=dof,
        units=tuple(q.unit for q in listed),
    )
    if fit is not None and is_bad(found.p_value):
        full = len(best) >= most
        warn(
            f"{' and '.join(found.chosen) or 'no change'}, the best that {len(listed)} candidates "
            f"give, {'leave' if len(best) > 1 else 'leaves'} more than noise: chi-square "
            f"{chi2:.4g} for dof = {dof}. It fits worst {fits.worst(best)}. "
            "Something else differs between model and machine, or the noise is understated: give "
            f"{'most= more, ' if full else ''}candidates at other places or of another kind, "
            "or what is wrong everywhere as nuisance=."
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
        # known to first order only: never better than what was fitted exactly
        score[i] = min(score[i], float(np.nanmin(score[np.isfinite(criterion)], initial=1.0)))
    return values, score, criterion

"""Sets of candidates that explain a measurement as well as the best, such as mirror images."""

from __future__ import annotations

from itertools import product

import numpy as np

from ...arrays import FloatArray, divisor
from ...errors import ModelError
from ..search import Objective
from .subsets import Subset, Subsets, bic

#: relative difference of effect up to which an equal change elsewhere is a twin: mirror images in a
#: reduced model differ by up to a few per cent
TWIN = 0.05
#: difference of the criterion within which two sets explain the data equally well
ALIKE = 2.0
#: predicted difference of the criterion above which a set is not fitted
HOPELESS = 20.0


def alike_sets(fits: Subsets, best: Subset) -> list[Subset]:
    """Return the sets of the size of `best` that explain the data as well, the best first.

    Members are exchanged for candidates with the same separate effect, in all combinations: the
    joint effect of the changes decides which of these fit.
    """
    fit = fits.fit(best)
    if fit is None or not best:
        return []
    values, nuisance = fit.p[: len(best)].tolist(), fit.p[len(best) :]
    groups = [_twins(fits, i, value) for i, value in zip(best, values, strict=True)]
    for members in product(*groups):
        subset = tuple(sorted(members))
        if len(set(members)) < len(best) or subset in fits.done:
            continue
        own = dict(zip(members, values, strict=True))
        p = np.array([*(own[i] for i in subset), *nuisance])
        left = _predicted(fits, subset, p)
        more = [bic(error, fits.rows, 0, fits.whole.noisy) for error in (left, fit.error)]
        if more[0] < more[1] + HOPELESS:
            fits.guesses[subset] = p
            fits.fit(subset)
    sets = [one for one, found in fits.done.items() if found and len(one) == len(best)]
    least = min(map(fits.score, sets))
    return sorted((s for s in sets if fits.score(s) <= least + ALIKE), key=fits.score)


def _twins(fits: Subsets, member: int, value: float) -> list[int]:
    """Return the candidates of which an equal change has the same effect, the member first."""
    unit = fits.whole.parameters[member].unit
    others = [i for i in range(fits.count) if fits.whole.parameters[i].unit == unit and i != member]

    def left(candidate: int, size: float) -> FloatArray | None:
        nuisance = fits.start[fits.nuisance]
        return _values(fits.few([candidate, *fits.nuisance]), np.array([size, *nuisance]))

    own, nothing = left(member, value), left(member, 0.0)
    if own is None or nothing is None:
        return [member]
    limit = TWIN**2 * float(np.sum((own - nothing) ** 2))
    found = [(i, left(i, value)) for i in others]
    return [member, *(i for i, r in found if r is not None and np.sum((r - own) ** 2) <= limit)]


def _values(objective: Objective, p: FloatArray) -> FloatArray | None:
    """Return the residuals at some values, None where no model is possible there."""
    try:
        objective.begin(np.zeros(p.size))
        return objective.values(objective.at(p, refer=True))
    except ModelError:
        return None


def _predicted(fits: Subsets, subset: Subset, p: FloatArray) -> float:
    """Return the sum of squares that a fit of a set leaves, to first order from some values."""
    objective = fits.few([*subset, *fits.nuisance])
    r = _values(objective, p)
    if r is None:
        return np.inf
    J = objective.slopes(objective.at(p))
    Q = np.linalg.qr(J / divisor(np.linalg.norm(J, axis=0)))[0]
    return float(r @ r - np.sum((Q.T @ r) ** 2))

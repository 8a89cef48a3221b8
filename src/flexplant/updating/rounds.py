"""Defect correction: a fit on a reduced model that ends where the full model's would."""

from __future__ import annotations

from ..values import FloatArray
from .full_basis import FullBasis
from .search import Objective, SearchEnd, UpdateMethod
from .search.objective import Defect

#: standard deviations by which a round moves the estimate that need no further round
STILL = 1e-2


def corrected(
    objective: Objective,
    basis: FullBasis,
    method: UpdateMethod,
    end: SearchEnd,
    *,
    rounds: int,
    most: int | None,
    tolerance: float,
) -> tuple[SearchEnd, list[FloatArray]]:
    """Return the end of the last round, the objective being there, and the estimates on the way.

    In each round the full model is solved at the estimate, and the difference of its residuals
    from those of the reduced model, with its derivative, is added to the reduced model's::

        r(p) = r_reduced(p) + d + d' (p - p_0),   d = r_full(p_0) - r_reduced(p_0)

    Where a round moves the estimate no more, r and dr/dp are those of the full model.

    References
    ----------
    [Stetter1978]_; [AlexandrovLewis2001]_ (the derivative).
    """
    first = end.trail.p[0]
    estimates = [end.p]
    for _ in range(rounds):
        point = objective.at(end.p)
        full = basis.objective(point)
        there = full.at(end.p)
        objective.defect = None
        objective.defect = Defect(
            end.p,
            full.values(there, prior=False) - objective.values(point, prior=False),
            full.slopes(there, prior=False) - objective.slopes(point, prior=False),
        )
        before = end.trail
        # what is drawn to the start is so anew; modes keep the numbers they have there
        objective.path = [] if method.penalised else before.p[:-1]
        begin = first if method.penalised else end.p
        end = method.search(objective, begin, most=most, tolerance=tolerance)
        end.trail = end.trail if method.penalised else before.joined(end.trail)
        estimates.append(end.p)
        if moved(objective, end.p, estimates[-2]) < STILL:
            break
    return end, estimates


def moved(objective: Objective, p: FloatArray, before: FloatArray) -> float:
    """Return how far an estimate moved, in standard deviations: ``|J dp| / sqrt(q)``.

    Of residuals of unit variance where the noise is known; else relative to what is left of them.
    """
    point = objective.at(p)
    change = objective.slopes(point) @ (p - before)
    size = 1.0
    if not objective.noise_known:
        left = objective.values(point)
        size = float(left @ left) / max(left.size - p.size, 1)
    return float((change @ change / max(size, 1e-300) / p.size) ** 0.5)

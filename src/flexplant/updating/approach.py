"""A good start: problems that converge from far away, before the one that was posed."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from ..errors import FlexplantError
from ..values import FloatArray
from .residuals.eigenvalues import Eigenvalues
from .residuals.frf_residual import FrfResidual
from .residuals.mode_shapes import ModeShapes
from .residuals.residual import Residual
from .search import Objective, TrustRegion

#: relative variance of each entry of a response in the first fit, beside its noise
EVEN = 0.1
#: relative tolerance of a fit that only has to come near
ENOUGH = 1e-3


def approached(
    objective: Objective, begin: FloatArray, most: int | None, tolerance: float
) -> list[FloatArray]:
    """Return the points on the way from `begin` to a better start, `begin` alone if none is.

    Complex responses have a minimum wherever a peak of the model lies between two measured ones;
    the logarithm of their magnitude, all entries weighted equally, hardly any. Shapes turn when
    modes are near each other, so poles come first.
    """
    easier = _easier(objective.residuals)
    if easier is None:
        return [begin]
    stage = Objective(
        objective.family.model,
        objective.parameters,
        easier,
        prior=objective.uses_prior,
        family=objective.family,
    )
    try:
        near = max(tolerance, ENOUGH)
        found = TrustRegion().search(stage, begin, most=most, tolerance=near)
        # the modes are numbered at the start, and followed from there
        objective.begin(begin)
        for p in found.trail.p[1:]:
            objective.at(p, refer=True)
    except FlexplantError:
        return [begin]
    return [begin, *found.trail.p[1:]]


def _easier(residuals: Sequence[Residual]) -> list[Residual] | None:
    """Return residuals that converge from farther away, None when they are those given."""
    has_poles = any(isinstance(r, Eigenvalues) for r in residuals)
    found: list[Residual] = []
    for residual in residuals:
        if isinstance(residual, ModeShapes) and has_poles:
            continue
        found.append(_magnitude(residual) if isinstance(residual, FrfResidual) else residual)
    same = len(found) == len(residuals) and all(
        a is b for a, b in zip(found, residuals, strict=True)
    )
    return None if same else found


def _magnitude(residual: FrfResidual) -> FrfResidual:
    """Return the residual of the logarithm of the magnitude, all entries about equally weighted."""
    size = np.abs(residual.measured.data) ** 2
    if residual.magnitude or np.any(size[:, :, residual.lines] == 0):
        return residual
    noise = 0.0 if residual.variance is None else residual.variance
    # lines that are not used may be zero
    variance = np.maximum(EVEN * size + noise, np.finfo(float).tiny)
    return residual.replace(magnitude=True, variance=variance)

"""Exactly repeated modes, turned to the vectors in which the next step of a search splits them."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from ..errors import ModelError
from ..values import ComplexArray, FloatArray
from .family import Eigen, repeated_groups
from .point_model import Point
from .residuals.eigenvalues import BoundEigenvalues
from .sensitivities import GroupDerivatives, group_derivatives, split

#: a parameter's effect below this share of what it could have is rounding
UNSEEN = 1e-9
#: singular values of S, its columns of length one, below which a step leaves them out
SINGULAR = 1e-7


class PoleRows:
    """All measured eigenvalues of an objective, weighted as its residuals weigh them."""

    def __init__(self, bounds: Sequence[BoundEigenvalues]) -> None:
        self.bounds = bounds
        self.numbers = tuple(n for bound in bounds for n in bound.numbers)
        self.target = np.concatenate([bound.target for bound in bounds])

    def whitened(self, rows: ComplexArray) -> FloatArray:
        """Return weighted [Re; Im] of complex rows (m,) or (m, q)."""
        found, first = [], 0
        for bound in self.bounds:
            last = first + len(bound.numbers)
            found.append(bound.whitened(rows[first:last]))
            first = last
        return np.concatenate(found)


def turned(point: Point, data: PoleRows) -> Point:
    """Return the point with exactly repeated modes turned to the split of the next step.

    How repeated modes split depends on the step, and the step on how they split: try both
    directions of every parameter, and keep the step that fits best by the split it causes itself.
    """
    repeated = {i for group in repeated_groups(point.eigen.poles) for i in group}
    if not repeated:
        return point
    try:
        columns = point.columns(data.numbers)
    except ModelError:
        return point  # a mode is lost: an error where it is needed
    family = point.family
    S = family.sensitivity(point.eigen, columns)
    eigen = point.eigen
    if repeated.intersection(columns):
        S, eigen = _best_split(point, columns, S, data)
    found = Point(family, point.p, eigen, point.labels)
    found.turned = dict(zip(data.numbers, S, strict=True))
    return found


def _best_split(
    point: Point, columns: list[int], S: ComplexArray, data: PoleRows
) -> tuple[ComplexArray, Eigen]:
    """Return S of (11) and the modes as the best step splits them."""
    family, poles = point.family, point.eigen.poles[columns]
    gap = data.target - poles
    scale = family.strength(float(np.median(np.abs(data.target))))
    best = (np.inf, S, point.eigen)
    groups = group_derivatives(family, point.eigen)
    for way in np.vstack([np.eye(scale.size), -np.eye(scale.size)]) / scale:
        S, eigen = _along(groups, point.eigen, columns, S, way)
        # rounding in the row of a vector that stays would give a step without bounds
        felt = np.where(np.abs(S) > UNSEEN * scale, S, 0.0)
        scaled, *_ = np.linalg.lstsq(
            data.whitened(felt) / scale, data.whitened(gap), rcond=SINGULAR
        )
        step = scaled / scale
        if np.any(step):
            S, eigen = _along(groups, point.eigen, columns, S, step)
        left = float(np.sum(data.whitened(gap - S @ step) ** 2))
        if left < best[0]:
            best = (left, S, eigen)
    return best[1], best[2]


def _along(
    groups: GroupDerivatives,
    eigen: Eigen,
    columns: list[int],
    S: ComplexArray,
    direction: FloatArray,
) -> tuple[ComplexArray, Eigen]:
    """Return S with the rows of repeated modes as they split along a direction, and the modes."""
    rotation = split(groups, eigen, direction)
    rows = [rotation.sensitivity.get(c, row) for c, row in zip(columns, S, strict=True)]
    return np.array(rows), rotation.eigen

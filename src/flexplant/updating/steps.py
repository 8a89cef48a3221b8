"""One Gauss-Newton step: slopes, the paper's (13), and a safe way along it."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from ..errors import ModelError, SolverError
from ..values import ComplexArray, FloatArray, IntArray
from .pairing import pair
from .pencil import Eigen, Family, repeated_groups
from .residuals import Data
from .sensitivity import split

#: what rounding leaves of an eigenvalue, relatively; the error may rise by as much
ROUNDING = 1e-11
#: a parameter's effect below this share of what it could have is none
UNSEEN = 1e-9
#: singular values of S, its columns of length one, below which parameters cannot be told apart
SINGULAR = 1e-7


@dataclass(frozen=True)
class Iterate:
    """The model at one set of parameters, its modes labelled as in the start model."""

    p: FloatArray
    eigen: Eigen
    #: the mode number each column continues, 0 for one that came up later
    labels: IntArray
    #: the column of each measured mode
    columns: list[int]

    @property
    def poles(self) -> ComplexArray:
        """The model's eigenvalues, paired with the measured ones."""
        return self.eigen.poles[self.columns]


def slopes(family: Family, data: Data, now: Iterate) -> tuple[ComplexArray, Iterate]:
    """Return S of (11), and the iterate with repeated modes turned to the split of its step.

    How repeated modes split depends on the step, and the step on how they split: try both
    directions of every parameter, and keep the step that fits best by the split it causes itself.
    """
    S = family.sensitivity(now.eigen, now.columns)
    repeated = {i for group in repeated_groups(now.eigen.poles) for i in group}
    if not repeated.intersection(now.columns):
        return S, now
    gap = data.target - now.poles
    scale = family.strength(float(np.median(np.abs(data.target))))
    best = (np.inf, S, now.eigen)
    for way in np.vstack([np.eye(scale.size), -np.eye(scale.size)]) / scale:
        S, eigen = _along(family, now, S, way)
        # rounding in the row of a vector that stays would ask for a step without bounds
        felt = np.where(np.abs(S) > UNSEEN * scale, S, 0.0)
        scaled, *_ = np.linalg.lstsq(data.stacked(felt) / scale, data.stacked(gap), rcond=SINGULAR)
        step = scaled / scale
        if np.any(step):
            S, eigen = _along(family, now, S, step)
        left = data.error(now.poles + S @ step)
        if left < best[0]:
            best = (left, S, eigen)
    return best[1], replace(now, eigen=best[2])


def _along(
    family: Family, now: Iterate, S: ComplexArray, direction: FloatArray
) -> tuple[ComplexArray, Eigen]:
    """Return S with the rows of repeated modes as they split along a direction, and the modes."""
    rotation = split(family, now.eigen, direction)
    rows = [rotation.sensitivity.get(c, row) for c, row in zip(now.columns, S, strict=True)]
    return np.array(rows), rotation.eigen


def solve(family: Family, data: Data, S: ComplexArray, gap: ComplexArray) -> FloatArray:
    """Return the step of (13), as the real least-squares problem it comes from."""
    J = data.stacked(S)
    length = np.linalg.norm(J, axis=0)
    scale = family.strength(float(np.median(np.abs(data.target))))
    names = [parameter.name for parameter in family.parameters]
    modes = ", ".join(str(number) for number in data.modes)
    unseen = [
        name
        for name, part, most in zip(names, length, scale, strict=True)
        if part <= UNSEEN * most * np.sqrt(data.W.max())
    ]
    if unseen:
        raise ModelError(
            f"{', '.join(unseen)} cannot be found from modes {modes}: their eigenvalues do not "
            "depend on it (it sits on their nodal lines). Measure a mode that moves there, or drop "
            "the parameter."
        )
    U, s, Vt = np.linalg.svd(J / length, full_matrices=False)
    if len(names) > 2 * len(data.modes) or s[-1] < SINGULAR * s[0]:
        mixed = np.abs(np.linalg.svd(J / length)[2][-1])
        together = [name for name, part in zip(names, mixed, strict=True) if part > 0.1]
        raise ModelError(
            f"{', '.join(together)} cannot be told apart by the eigenvalues of modes {modes} "
            f"({2 * len(data.modes)} real equations, {len(names)} unknowns, S is singular): some "
            "combination of them changes nothing. Measure more modes, drop one of them, or begin "
            "elsewhere (start=)."
        )
    return np.asarray((Vt.T @ ((U.T @ data.stacked(gap)) / s)) / length, dtype=np.float64)


def advance(
    family: Family, data: Data, now: Iterate, step: FloatArray
) -> tuple[Iterate, float] | None:
    """Return the next iterate and the part of the step taken, None when no part lowers (12)."""
    rounding = ROUNDING * np.sqrt(np.sum(data.W * np.abs(data.target) ** 2))
    limit = np.sqrt(data.error(now.poles)) * (1 + ROUNDING) + rounding
    fraction, trouble = 1.0, ""
    for _ in range(30):
        try:
            found = _followed(family, now, now.p + fraction * step)
        except ModelError as error:
            trouble = str(error)
        else:
            trouble = ""
            if np.sqrt(data.error(found.poles)) <= limit:
                return found, fraction
        fraction /= 2
    if trouble:
        raise SolverError(f"no part of a Gauss-Newton step keeps the model physical: {trouble}")
    return None


def _followed(family: Family, now: Iterate, p: FloatArray) -> Iterate:
    """Return the iterate at `p` with the labels of the modes it continues."""
    eigen = family.at(p)
    found = pair(now.eigen.poles, family.weighted(now.eigen.X), family.weighted(eigen.X))
    columns = found[now.columns]
    if np.any(columns < 0):
        lost = [int(now.labels[c]) for c in now.columns if found[c] < 0]
        raise ModelError(f"modes {lost} cease to oscillate.")
    labels = np.zeros(eigen.poles.size, dtype=np.int64)
    labels[found[found >= 0]] = now.labels[found >= 0]
    return Iterate(p, eigen, labels, columns.tolist())

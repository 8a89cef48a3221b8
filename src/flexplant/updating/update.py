"""Gauss-Newton on complex eigenvalues: the paper's equations (9) to (14)."""

from __future__ import annotations

import warnings
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from ..errors import FlexplantWarning, ModelError, SolverError
from ..structure.rigid import orthonormalised
from ..values import ComplexArray, FloatArray, IntArray, positive
from .pairing import pair
from .parameters import Parameter
from .residuals import Eigenvalues
from .result import History, UpdateResult
from .sensitivity import (
    Eigen,
    Family,
    checked_parameters,
    checked_values,
    mode_columns,
    repeated_groups,
    split,
)

#: what rounding leaves of an eigenvalue, relatively; the error may rise by as much
ROUNDING = 1e-11
#: a parameter's effect below this share of what it could have is none
UNSEEN = 1e-9
#: singular values of S, its columns of length one, below which parameters cannot be told apart
SINGULAR = 1e-7


@dataclass(frozen=True)
class Data:
    """All residuals, stacked."""

    target: ComplexArray
    modes: tuple[int, ...]
    W: FloatArray
    covariance: FloatArray | None

    def error(self, poles: ComplexArray) -> float:
        """Return e of (12)."""
        return float(np.sum(self.W * np.abs(self.target - poles) ** 2))

    def stacked(self, rows: ComplexArray) -> FloatArray:
        """Return W^(1/2) [Re; Im] of complex rows."""
        root = np.sqrt(self.W).reshape(-1, *[1] * (rows.ndim - 1))
        return np.concatenate([root * rows.real, root * rows.imag])


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


def update(
    model: Any,
    parameters: Sequence[Parameter],
    residuals: Sequence[Eigenvalues],
    *,
    start: Sequence[float] | FloatArray | None = None,
    max_iterations: int = 20,
    tolerance: float = 1e-9,
) -> UpdateResult:
    """Find the parameters with which the model has the measured eigenvalues.

    Gauss-Newton with real unknowns in complex equations, the paper's (13) and (14)::

        Re[S^H W S] dp = Re[S^H W d lambda],    p <- p + dp

    Modes are found by their number in the model at `start` and followed by shape (see
    `flexplant.updating.pairing`), so they may swap order on the way. Modes that are exactly
    repeated there are first turned to the vectors in which the step splits them, the lower mode
    number going to the lower frequency. Steps are halved while M or K would become indefinite,
    a measured mode would cease to oscillate, or the error (12) would grow.

    Parameters
    ----------
    model : ReducedModel or FEModel
        The model; an FEModel is treated densely.
    parameters : sequence of q Parameter
        `AddedMass`, `AddedDamping`, `AddedStiffness`.
    residuals : sequence of Eigenvalues
        What to fit: m eigenvalues altogether.
    start : (q,) array [kg, N s/m, N/m], optional
        Values to begin with; zeros when not given.
    max_iterations : int
        Most Gauss-Newton steps.
    tolerance : float
        Done when a full step, or the residual, changes no eigenvalue by more than this,
        relatively.

    Returns
    -------
    UpdateResult
        With `converged` False, and a FlexplantWarning, when the tolerance was not met.

    Raises
    ------
    ModelError
        When the measured eigenvalues do not depend on a parameter or cannot tell some apart (S is
        singular), or the matrices are indefinite at `start`.
    LabelError
        When a mode number or a place is unknown.
    SolverError
        When no part of a step keeps the model physical.

    References
    ----------
    The paper, section 3.
    """
    listed = checked_parameters(parameters)
    data = _checked_data(residuals)
    most = _checked_count(max_iterations)
    enough = positive(tolerance, "tolerance")
    family = Family(model, listed)
    p = checked_values(start, listed, "start")
    eigen = family.at(p)
    columns = mode_columns(data.modes, eigen)
    labels = np.arange(eigen.n_rigid + 1, eigen.n_rigid + eigen.poles.size + 1)
    now = Iterate(p, eigen, labels, columns)
    trail = [(now.p, now.poles, data.error(now.poles), 0.0)]
    S, now = _slopes(family, data, now)
    converged, reason = _met(data, now, enough), "residual below the tolerance"
    for _ in range(most):
        if converged:
            break
        step = _solve(family, data, S, data.target - now.poles)
        size = float(np.max(np.abs(S @ step) / np.abs(now.poles)))
        accepted = _advance(family, data, now, step)
        if accepted is None:
            converged, reason = size < enough, "step below the tolerance"
            if not converged:
                reason = "no part of the next step lowers the error"
            break
        now, fraction = accepted
        trail.append((now.p, now.poles, data.error(now.poles), fraction))
        S, now = _slopes(family, data, now)
        if size < enough and fraction == 1.0:
            converged, reason = True, "step below the tolerance"
        elif _met(data, now, enough):
            converged, reason = True, "residual below the tolerance"
    else:
        if not converged:
            reason = "max_iterations reached"
    if not converged:
        warnings.warn(
            f"the update did not converge in {len(trail) - 1} steps: {reason}, error "
            f"{trail[-1][2]:.3g} from {trail[0][2]:.3g}. Look at .history; try other mode "
            "numbers, start= or more iterations.",
            FlexplantWarning,
            stacklevel=2,
        )
    covariance, correlation = _doubt(family, data, S, now)
    return UpdateResult(
        parameters=tuple(q.name for q in listed),
        units=tuple(q.unit for q in listed),
        values=now.p,
        covariance=covariance,
        correlation=correlation,
        model=_changed(model, family, now.p),
        history=History(*(np.array(part) for part in zip(*trail, strict=True))),
        converged=converged,
        reason=reason,
    )


def _met(data: Data, now: Iterate, tolerance: float) -> bool:
    return bool(np.max(np.abs(data.target - now.poles) / np.abs(data.target)) < tolerance)


def _slopes(family: Family, data: Data, now: Iterate) -> tuple[ComplexArray, Iterate]:
    """Return S of (11), and the iterate with repeated modes turned to the split of its step.

    How repeated modes split depends on the step and the step on how they split: iterate from
    both directions of every parameter, keep the step that fits best.
    """
    repeated = [i for group in repeated_groups(now.eigen.poles) for i in group]
    S = family.sensitivity(now.eigen, now.columns)
    rows = [a for a, column in enumerate(now.columns) if column in repeated]
    if not rows:
        return S, now
    gap = data.target - now.poles
    scale = family.strength(float(np.median(np.abs(data.target))))
    best = (np.inf, S, now)
    for b in range(len(family.parameters)):
        for sign in (1.0, -1.0):
            direction = np.zeros(len(family.parameters))
            direction[b] = sign / (scale[b] or 1.0)
            for _ in range(20):
                rotation = split(family, now.eigen, direction)
                for a in rows:
                    S[a] = rotation.sensitivity[now.columns[a]]
                step, *_ = np.linalg.lstsq(
                    data.stacked(S) / scale, data.stacked(gap), rcond=SINGULAR
                )
                step = step / scale
                # judged by how the modes really split along the step
                turned = split(family, now.eigen, step)
                reached = S.copy()
                for a in rows:
                    reached[a] = turned.sensitivity[now.columns[a]]
                left = data.error(now.poles + reached @ step)
                if left < best[0]:
                    labelled = Iterate(now.p, turned.eigen, now.labels, now.columns)
                    best = (left, reached, labelled)
                along = step * scale
                before = direction * scale
                if (
                    np.linalg.norm(along / np.linalg.norm(along) - before / np.linalg.norm(before))
                    < 1e-12
                ):
                    break
                direction = step
    return best[1], best[2]


def _solve(family: Family, data: Data, S: ComplexArray, gap: ComplexArray) -> FloatArray:
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
            "combination of them changes nothing. Measure more modes, or drop one of them."
        )
    return np.asarray((Vt.T @ ((U.T @ data.stacked(gap)) / s)) / length, dtype=np.float64)


def _advance(
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
    found = pair(now.eigen.poles, now.eigen.X, eigen.X)
    columns = found[now.columns]
    if np.any(columns < 0):
        lost = [int(now.labels[c]) for c in now.columns if found[c] < 0]
        raise ModelError(f"modes {lost} cease to oscillate.")
    labels = np.zeros(eigen.poles.size, dtype=np.int64)
    labels[found[found >= 0]] = now.labels[found >= 0]
    return Iterate(p, eigen, labels, columns.tolist())


def _doubt(
    family: Family, data: Data, S: ComplexArray, now: Iterate
) -> tuple[FloatArray | None, FloatArray]:
    """Return covariance (or None) and correlation of the estimate."""
    J = data.stacked(S)
    length = np.linalg.norm(J, axis=0)
    pinv = np.linalg.pinv(J / length) / length[:, None]
    spare = J.shape[0] - J.shape[1]
    unit = pinv @ pinv.T
    covariance = None
    if data.covariance is not None:
        root = np.sqrt(np.concatenate([data.W, data.W]))
        G = pinv * root
        covariance = unit = G @ data.covariance @ G.T
    elif spare > 0:
        covariance = unit * data.error(now.poles) / spare
    std = np.sqrt(np.diag(unit))
    return covariance, unit / np.outer(std, std)


def _changed(model: Any, family: Family, p: FloatArray) -> Any:
    """Return the model with the parameters at `p`; its own rigid-body basis, as far as left."""
    dM, dD, dK = family.changes(p)
    changes: dict[str, Any] = {
        "M": model.M + dM,
        "D": model.D if not np.any(dD) else dD if model.D is None else model.D + dD,
        "K": model.K + dK,
    }
    if hasattr(model, "T"):
        # Gram-Schmidt keeps translations first and moves the rotations to the new centre
        left = model.rigid_body @ family.rigid_left(p)
        changes["rigid_body"] = orthonormalised(changes["M"], left)
    try:
        return model.replace(**changes)
    except ModelError as error:
        raise ModelError(
            f"the update ended at {family.text(p)}, which the {type(model).__name__} refuses: "
            f"{error}"
        ) from None


def _checked_data(residuals: Any) -> Data:
    listed = tuple(residuals) if isinstance(residuals, Sequence) else (residuals,)
    for residual in listed:
        if not isinstance(residual, Eigenvalues):
            raise ModelError(
                f"residuals must be a list of Eigenvalues, got {type(residual).__name__}: wrap "
                "the measurement, [Eigenvalues(measured)]."
            )
    if not listed:
        raise ModelError("residuals is empty: nothing was measured to update from.")
    parts = [residual.measured.covariance for residual in listed]
    known = [part for part in parts if part is not None]
    m = [len(residual.measured) for residual in listed]
    covariance = None
    if len(known) == len(parts):
        covariance = np.zeros((2 * sum(m), 2 * sum(m)))
        first = 0
        for part, size in zip(known, m, strict=True):
            at = np.r_[first : first + size, sum(m) + first : sum(m) + first + size]
            covariance[np.ix_(at, at)] = part
            first += size
    return Data(
        target=np.concatenate([residual.measured.poles for residual in listed]),
        modes=tuple(n for residual in listed for n in residual.measured.modes or ()),
        W=np.concatenate([residual.W for residual in listed]),
        covariance=covariance,
    )


def _checked_count(value: Any) -> int:
    if isinstance(value, bool) or not isinstance(value, int | np.integer) or value < 1:
        raise ModelError(f"max_iterations must be a whole number from 1, got {value!r}.")
    return int(value)

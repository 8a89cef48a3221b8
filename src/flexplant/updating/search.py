"""The searches behind `update`: trust region with bounds, L-curve, Gauss-Newton."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from scipy.optimize import least_squares

from ..errors import ModelError, SolverError
from ..values import FloatArray
from .methods import Loss, TrustRegion
from .objective import Objective

#: weights tried for an L-curve
PATH = 13


@dataclass
class Trail:
    """The points a search has moved to."""

    p: list[FloatArray] = field(default_factory=list)
    poles: list[Any] = field(default_factory=list)
    error: list[float] = field(default_factory=list)
    fraction: list[float] = field(default_factory=list)

    def add(self, objective: Objective, p: FloatArray, fraction: float) -> None:
        """Add the point at `p`, where the objective is."""
        point = objective.at(p)
        self.p.append(np.array(p))
        self.poles.append(objective.poles(point))
        self.error.append(float(np.sum(objective.values(point, prior=False) ** 2)))
        self.fraction.append(fraction)


@dataclass
class Found:
    """What a search ended with."""

    p: FloatArray
    cost: float
    trail: Trail
    converged: bool
    reason: str


#: rows (r, J) added to those of the objective
Extra = Callable[[FloatArray], tuple[FloatArray, FloatArray]]


def trust_region(
    objective: Objective,
    start: FloatArray,
    method: TrustRegion,
    *,
    most: int,
    tolerance: float,
    extra: Extra | None = None,
) -> Found:
    """Minimise by least_squares, first as if there were no bounds, again within them if needed.

    Steps that keep away from bounds cost half as much again where none of them is active. Only
    points that the search moves to become references for the pairing of modes.
    """
    free = np.full(start.size, np.inf)
    if np.any(np.isfinite(objective.lower)) or np.any(np.isfinite(objective.upper)):
        try:
            found = _within(objective, start, method, (-free, free), most, tolerance, extra)
        except (ModelError, np.linalg.LinAlgError):
            found = None
        if (
            found is not None
            and found.converged
            and np.all(found.p >= objective.lower)
            and np.all(found.p <= objective.upper)
        ):
            return found
    limits = (objective.lower, objective.upper)
    return _within(objective, start, method, limits, most, tolerance, extra)


def _within(
    objective: Objective,
    start: FloatArray,
    method: TrustRegion,
    limits: tuple[FloatArray, FloatArray],
    most: int,
    tolerance: float,
    extra: Extra | None,
) -> Found:
    trail = Trail()
    point = objective.begin(start)
    rows = objective.values(point, prior=False).size

    def values(p: FloatArray) -> FloatArray:
        try:
            r = objective.values(objective.at(p))
        except ModelError:
            r = np.full(count, np.inf)
        return r if extra is None else np.concatenate([r, extra(p)[0]])

    def slopes(p: FloatArray) -> FloatArray:
        point = objective.at(p, refer=True)
        trail.add(objective, p, 1.0 if trail.p else 0.0)
        J = objective.slopes(point)
        return J if extra is None else np.vstack([J, extra(p)[1]])

    count = objective.values(point).size
    low, high = limits
    # a start on its bound has nowhere to go
    room = np.where(np.isfinite(high - low), high - low, np.maximum(np.abs(start), 1.0)) * 1e-8
    inside = np.clip(start, low + room, high - room)
    if not np.array_equal(inside, start):
        point = objective.begin(inside)
    loss: Any = method.loss
    if method.loss != "linear":
        loss = _data_loss(method.loss, rows)
    answer = least_squares(
        values,
        inside,
        slopes,
        bounds=(low, high),
        method="trf",
        x_scale=units(objective, objective.slopes(point, prior=False)),
        # the cost is flat at its least: 1e-12 of it are 1e-6 standard deviations
        ftol=max(1e-2 * tolerance, 2.3e-16),
        xtol=max(tolerance, 2.3e-16),
        gtol=1e-15,
        loss=loss,
        f_scale=method.scale,
        max_nfev=most,
    )
    p = np.asarray(answer.x, dtype=np.float64)
    objective.at(p, refer=True)
    if not np.array_equal(trail.p[-1], p):
        trail.add(objective, p, 1.0)
    reason = {0: "max_iterations reached", 1: "gradient is zero", 2: "error no longer falls"}.get(
        answer.status, "step below the tolerance"
    )
    return Found(p, float(answer.cost), trail, answer.status > 0, reason)


def _data_loss(name: Loss, rows: int) -> Callable[[FloatArray], FloatArray]:
    """Return rho, rho', rho'' with the named loss on the first rows and squares on the others.

    A prior is no outlier, however far the data pull.
    """

    def rho(z: FloatArray) -> FloatArray:
        out = np.vstack([z, np.ones_like(z), np.zeros_like(z)])
        t = 1 + z[:rows]
        if name == "cauchy":
            parts = np.log(t), 1 / t, -1 / t**2
        elif name == "soft_l1":
            parts = 2 * (np.sqrt(t) - 1), t**-0.5, -0.5 * t**-1.5
        else:
            root = np.sqrt(np.maximum(z[:rows], 1.0))
            far = z[:rows] > 1
            parts = (
                np.where(far, 2 * root - 1, z[:rows]),
                1 / root,
                np.where(far, -0.5 / root**3, 0),
            )
        out[:, :rows] = parts
        return out

    return rho


def units(objective: Objective, J: FloatArray) -> FloatArray:
    """Return what counts as one change of each parameter."""
    width = (objective.upper - objective.lower) / 2
    length = np.linalg.norm(J, axis=0)
    felt = 1 / np.where(length > 0, length, 1.0)
    unit = np.where(np.isfinite(width), width, felt)
    return np.asarray(np.where(objective.has_prior, objective.prior_std, unit), dtype=np.float64)


def tikhonov(
    objective: Objective, start: FloatArray, weight: float | None, *, most: int, tolerance: float
) -> Found:
    """Minimise with a penalty on the distance from the start, its weight given or by L-curve."""
    J = objective.slopes(objective.begin(start), prior=False)
    unit = units(objective, J)

    def solved(size: float, begin: FloatArray) -> Found:
        def extra(p: FloatArray) -> tuple[FloatArray, FloatArray]:
            return size * (p - start) / unit, np.diag(size / unit)

        return trust_region(
            objective, begin, TrustRegion(), most=most, tolerance=tolerance, extra=extra
        )

    if weight is not None:
        return solved(weight, start)
    largest = float(np.linalg.norm(J * unit, 2))
    sizes = np.geomspace(largest, 1e-6 * largest, PATH)
    curve, found, begin = [], [], start
    for size in sizes.tolist():
        one = solved(size, begin)
        begin = one.p
        change = float(np.linalg.norm((one.p - start) / unit))
        curve.append((np.log(max(one.trail.error[-1], 1e-300)) / 2, np.log(max(change, 1e-300))))
        found.append(one)
    return found[corner(np.array(curve))]


def corner(curve: FloatArray) -> int:
    """Return the point of an L-curve (m, 2) with the largest curvature, of three points each."""
    best, at = -np.inf, len(curve) // 2
    for i in range(1, len(curve) - 1):
        a, b = curve[i] - curve[i - 1], curve[i + 1] - curve[i]
        c = curve[i + 1] - curve[i - 1]
        area = -(a[0] * b[1] - a[1] * b[0])
        sides = float(np.prod([np.linalg.norm(side) for side in (a, b, c)]))
        if sides > 0 and 2 * area / sides > best:
            best, at = 2 * area / sides, i
    return at


def gauss_newton(
    objective: Objective, start: FloatArray, truncate: float, *, most: int, tolerance: float
) -> Found:
    """Gauss-Newton on any residuals, singular values cut off, steps halved where they harm."""
    trail = Trail()
    point = objective.begin(start)
    r = objective.values(point)
    trail.add(objective, start, 0.0)
    p, converged, reason = start, False, "max_iterations reached"
    for _ in range(most):
        J = objective.slopes(point)
        length = np.linalg.norm(J, axis=0)
        if np.any(length == 0):
            names = [q.name for q, n in zip(objective.parameters, length, strict=True) if n == 0]
            raise ModelError(f"{', '.join(names)} cannot be found: no residual depends on it.")
        U, s, Vt = np.linalg.svd(J / length, full_matrices=False)
        keep = s > max(truncate, 1e-12) * s[0]
        if not truncate and not (keep.all() and s.size == p.size):
            raise ModelError(
                "the parameters cannot be told apart by these residuals (S is singular). Ask "
                "identifiability(model, parameters, residuals); measure more, drop parameters, "
                "give priors, or GaussNewton(truncate=1e-3)."
            )
        step = -(Vt[keep].T @ ((U[:, keep].T @ r) / s[keep])) / length
        small = float(np.linalg.norm(J @ step)) <= tolerance * (1 + float(np.linalg.norm(r)))
        fraction, cost = 1.0, float(r @ r)
        trouble = ""
        for _ in range(30):
            try:
                trial = objective.at(p + fraction * step)
                changed = objective.values(trial)
            except ModelError as error:
                trouble = str(error)
            else:
                trouble = ""
                if float(changed @ changed) <= cost * (1 + 1e-10) + 1e-20:
                    break
            fraction /= 2
        else:
            if trouble:
                raise SolverError(f"no part of a step keeps the model physical: {trouble}")
            converged, reason = small, "no part of a step helps"
            break
        p = p + fraction * step
        point, r = objective.at(p, refer=True), changed
        trail.add(objective, p, fraction)
        if small and fraction == 1.0:
            converged, reason = True, "step below the tolerance"
            break
    return Found(p, float(r @ r) / 2, trail, converged, reason)

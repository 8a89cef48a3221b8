"""Levenberg-Marquardt steps in a trust region, within bounds, with robust losses."""

from __future__ import annotations

from collections.abc import Callable
from contextlib import suppress
from dataclasses import dataclass, field
from typing import Any, Literal, TypeAlias

import numpy as np
import scipy.linalg as la

from ...checks import FloatArray, checked, one_of, positive, whole
from ...errors import ModelError
from ...tolerances import divisor
from .objective import Objective, SearchEnd, Trail, UpdateMethod, unit_changes

Loss: TypeAlias = Literal["linear", "huber", "soft_l1", "cauchy"]
LOSSES = ("linear", "huber", "soft_l1", "cauchy")

#: why a search ends where the matrices become indefinite or a mode is lost, however short the step
EDGE = (
    "no step in the direction of descent is possible: with it the matrices are indefinite or a "
    "mode is lost (bounds= keep a parameter to what is possible)"
)

#: why a search ends at a jump of the cost, and the part of the cost that slopes promise there
STUCK = (
    "no step lowers the error as its slopes promise: other modes are paired on the other side, "
    "say (begin elsewhere, start=)"
)
PROMISED = 1e-2


class _ImpossibleError(Exception):
    """No step from the last point is possible."""


@dataclass(frozen=True, eq=False)
class TrustRegion(UpdateMethod):
    """Levenberg-Marquardt steps in a trust region that keeps to the bounds of the parameters.

    `scipy.optimize.least_squares` (method trf) with exact gradients.

    Parameters
    ----------
    loss : {"linear", "huber", "soft_l1", "cauchy"}
        Robust losses take outliers down: rho(r^2) of each whitened residual.
    scale : float
        Residuals above this many (standard deviations) count as outliers.

    References
    ----------
    [Branch1999]_.

    Examples
    --------
    >>> import flexplant as fx
    >>> drawing = fx.chain(masses=[1.0, 1.0, 1.0], stiffnesses=[4e5, 4e5])
    >>> poles = fx.Eigenvalues(fx.MeasuredModes(poles=[615.0j], modes=[2]))
    >>> bounded = [fx.AddedMass("3:x", bounds=(0.0, 0.1))]
    >>> fx.update(drawing, bounded, [poles], method=fx.updating.TrustRegion()).values.round(4)
    array([0.1])
    """

    loss: Loss = field(default="linear", kw_only=True, metadata=checked(one_of, choices=LOSSES))
    scale: float = field(default=1.0, kw_only=True, metadata=checked(positive))

    @property
    def least_squares(self) -> bool:
        """Whether the loss is that of least squares."""
        return self.loss == "linear"

    def search(
        self,
        objective: Objective,
        start: FloatArray,
        *,
        most: int | None = None,
        tolerance: float = 1e-10,
    ) -> SearchEnd:
        """Return where the search from `start` ends; see `UpdateMethod.search`."""
        most = whole(
            most or self.steps, "most"
        )  # the steps are counted up to it: nothing else ends
        bounded = objective.lower, objective.upper
        # steps that keep away from bounds cost half as much again where none of them is active
        if np.any(np.isfinite(bounded)):
            free = np.full(start.size, np.inf)
            with suppress(ModelError, np.linalg.LinAlgError):
                found = self._fitted(objective, start, -free, free, most, tolerance)
                inside = np.all(found.p >= objective.lower) and np.all(found.p <= objective.upper)
                if found.converged and inside:
                    return found
        return self._fitted(objective, start, *bounded, most, tolerance)

    def _fitted(
        self,
        objective: Objective,
        start: FloatArray,
        low: FloatArray,
        high: FloatArray,
        most: int,
        tolerance: float,
    ) -> SearchEnd:
        """Minimise by least_squares; points that it moves to are references to pair modes with."""
        from scipy.optimize import least_squares

        trail = Trail()
        point = objective.begin(start)
        rows, count = (objective.values(point, prior=prior).size for prior in (False, True))
        loss: Any = self.loss if self.loss == "linear" else _data_loss(self.loss, rows)

        def values(p: FloatArray) -> FloatArray:
            try:
                return objective.values(objective.at(p))
            except ModelError:
                # least_squares would shorten the step to the last digit: the tolerance is enough
                if trail.p and la.norm((p - trail.p[-1]) / unit) <= tolerance * max(
                    1.0, float(la.norm(trail.p[-1] / unit))
                ):
                    raise _ImpossibleError from None
                return np.full(count, np.inf)

        def slopes(p: FloatArray) -> FloatArray:
            point = objective.at(p, refer=True)
            if not trail.p or not np.array_equal(trail.p[-1], p):
                trail.add(objective, p, 1.0 if trail.p else 0.0)
            return objective.slopes(point)

        # a start on its bound has nowhere to go
        room = np.where(np.isfinite(high - low), high - low, np.maximum(np.abs(start), 1.0)) * 1e-8
        inside = np.clip(start, low + room, high - room)
        if not np.array_equal(inside, start):
            point = objective.begin(inside)
        unit = unit_changes(objective, objective.slopes(point, prior=False))

        def searched(start: FloatArray, most: int) -> Any:
            return least_squares(
                values,
                start,
                slopes,
                bounds=(low, high),
                method="trf",
                x_scale=unit,
                # the cost is flat at its least: 1e-12 of it are 1e-6 standard deviations
                ftol=max(1e-2 * tolerance, 2.3e-16),
                xtol=max(tolerance, 2.3e-16),
                gtol=1e-15,
                loss=loss,
                f_scale=self.scale,
                max_nfev=most,
            )

        stopped = "max_iterations reached"
        try:
            answer = searched(inside, most)
        except _ImpossibleError:
            answer, stopped = searched(trail.p[-1], 1), EDGE
        p = np.asarray(answer.x, dtype=np.float64)
        objective.at(p, refer=True)
        if not np.array_equal(trail.p[-1], p):
            trail.add(objective, p, 1.0)
        known = {0: stopped, 1: "gradient is zero", 2: "error no longer falls"}
        reason = known.get(answer.status, "step below the tolerance")
        converged = answer.status > 0
        judged = converged and self.loss == "linear"
        if judged and _is_stuck(answer, objective.size(point), tolerance):
            converged, reason = False, STUCK
        return SearchEnd(p, float(answer.cost), trail, converged, reason)


def _is_stuck(answer: Any, size: FloatArray, tolerance: float) -> bool:
    """Return whether slopes promise a lower cost, though every step was refused.

    At a minimum they promise next to nothing; at a jump of the cost they do.
    """
    J = answer.jac[:, answer.active_mask == 0]
    Q = la.qr(J / divisor(np.linalg.norm(J, axis=0)), mode="economic")[0]
    change = Q @ (Q.T @ answer.fun)
    if np.sum(change**2) <= PROMISED * np.sum(answer.fun**2):
        return False
    return bool(np.max(np.abs(change[: size.size]) / size) > tolerance)


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

"""A penalty on the distance from the start, its weight given or by the L-curve."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from ...checks import FloatArray
from ...tolerances import TINY
from .objective import Objective
from .trust_region import TrustRegion, minimised
from .update_method import PenalisedMethod, SearchEnd, unit_changes

#: weights tried for an L-curve
PATH = 13


@dataclass(frozen=True, eq=False)
class Tikhonov(PenalisedMethod):
    """Trust region with a penalty ``weight^2 |(p - start) / unit|^2``.

    The unit of each parameter is its prior standard deviation, half the width of finite bounds, or
    the change that moves the residuals by one.

    Parameters
    ----------
    weight : float, optional
        None: the corner of the L-curve, where the curve of penalty over misfit (both
        logarithmic) turns most.

    References
    ----------
    [Hansen1992]_.

    Examples
    --------
    >>> import flexplant as fx
    >>> modes = fx.solve_modes(fx.chain(masses=[1.0, 1.0, 1.0], stiffnesses=[4e5, 4e5]), count=3)
    >>> drawing = fx.reduce(modes, fx.DesiredDofs(["1:x", "2:x", "3:x"]))
    >>> poles = fx.Eigenvalues(fx.MeasuredModes(poles=[615.0j], modes=[2]))
    >>> ends = [fx.AddedMass("1:x"), fx.AddedMass("3:x")]  # alike: the smallest change has both
    >>> fx.update(drawing, ends, [poles], method=fx.updating.Tikhonov(weight=1e-3)).values.round(3)
    array([0.058, 0.058])
    """

    @property
    def least_squares(self) -> bool:
        """Whether there is no penalty."""
        return False

    def search(
        self,
        objective: Objective,
        start: FloatArray,
        *,
        most: int | None = None,
        tolerance: float = 1e-10,
    ) -> SearchEnd:
        """Return where the search from `start` ends; see `UpdateMethod.search`."""
        J = objective.slopes(objective.begin(start), prior=False)
        unit = unit_changes(objective, J)

        def solved(size: float, begin: FloatArray) -> SearchEnd:
            def extra(p: FloatArray) -> tuple[FloatArray, FloatArray]:
                return size * (p - start) / unit, np.diag(size / unit)

            return minimised(
                objective,
                begin,
                TrustRegion(),
                most=most or self.steps,
                tolerance=tolerance,
                extra=extra,
            )

        if self.weight is not None:
            return solved(self.weight, start)
        largest = float(np.linalg.norm(J * unit, 2))
        # from all to next to nothing of the prior
        sizes = np.geomspace(largest, 1e-6 * largest, PATH)
        curve, found, begin = [], [], start
        for size in sizes.tolist():
            one = solved(size, begin)
            begin = one.p
            change = float(np.linalg.norm((one.p - start) / unit))
            curve.append((np.log(max(one.trail.error[-1], TINY)) / 2, np.log(max(change, TINY))))
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

"""How `update` searches: small values, one for each method."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Literal, TypeAlias

from ..errors import ModelError
from ..values import Value, positive

Loss: TypeAlias = Literal["linear", "huber", "soft_l1", "cauchy"]
LOSSES = ("linear", "huber", "soft_l1", "cauchy")


class Method(Value):
    """A way to minimise the residuals."""


@dataclass(frozen=True, eq=False)
class GaussNewton(Method):
    """The paper's weighted Gauss-Newton iteration, (13) and (14), steps halved where they harm.

    Parameters
    ----------
    truncate : float
        Singular values of the (column-scaled) sensitivities below this part of the largest are
        left out of a step: truncated SVD. Zero: all are used, and a singular S raises.
    """

    truncate: float = field(default=0.0, kw_only=True)

    def __post_init__(self) -> None:
        value = positive(self.truncate, "truncate", zero=True)
        if value >= 1:
            raise ModelError(f"truncate must be below 1, got {value:g}. Choose 1e-3, say.")
        self._set(truncate=value)


@dataclass(frozen=True, eq=False)
class TrustRegion(Method):
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
    Branch, Coleman, Li: A subspace, interior, and conjugate gradient method for large-scale
    bound-constrained minimization problems, SIAM J. Sci. Comput. 21, 1999.
    """

    loss: Loss = field(default="linear", kw_only=True)
    scale: float = field(default=1.0, kw_only=True)

    def __post_init__(self) -> None:
        if self.loss not in LOSSES:
            raise ModelError(
                f"loss must be one of {', '.join(LOSSES)}, got {self.loss!r}. Choose one."
            )
        self._set(scale=positive(self.scale, "scale"))


@dataclass(frozen=True, eq=False)
class Tikhonov(Method):
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
    Hansen: Analysis of discrete ill-posed problems by means of the L-curve, SIAM Review 34, 1992.
    """

    weight: float | None = field(default=None, kw_only=True)

    def __post_init__(self) -> None:
        if self.weight is not None:
            self._set(weight=positive(self.weight, "weight"))


@dataclass(frozen=True, eq=False)
class Lasso(Method):
    """Sparse change: penalty ``weight |(p - start) / unit|_1`` on a sequence of linear problems.

    Most parameters end at exactly their start: those are the ones without a change. The convex
    problems go to Clarabel through cvxpy.

    Parameters
    ----------
    weight : float, optional
        None: of a path of weights the one with the least BIC (Bayesian information criterion), its
        parameters fitted once more without the penalty.

    References
    ----------
    Tibshirani: Regression shrinkage and selection via the lasso, J. R. Stat. Soc. B 58, 1996.
    """

    weight: float | None = field(default=None, kw_only=True)

    def __post_init__(self) -> None:
        if self.weight is not None:
            self._set(weight=positive(self.weight, "weight"))

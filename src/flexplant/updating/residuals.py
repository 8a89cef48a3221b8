"""What the update compares: residuals between the measurement and the model."""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np

from ..errors import LabelError, ModelError
from ..identification import MeasuredModes
from ..values import FloatArray, Value, real_array


@dataclass(frozen=True, eq=False, repr=False)
class Eigenvalues(Value):
    """Residuals of complex eigenvalues, ``lambda_exp - lambda_num``, weighted by W.

    The paper, eqs. (10) and (12): ``e = d lambda^H W d lambda`` with W real, positive and
    diagonal.

    Parameters
    ----------
    measured : MeasuredModes
        Poles with their mode numbers.
    weights : (m,) array [(s/rad)^2], optional
        Diagonal of W. When not given: one over the variance of each pole where `measured` has a
        covariance, else ones.

    Raises
    ------
    ModelError, ShapeError
        When weights are not positive numbers, one for each pole.
    LabelError
        When the poles have no mode numbers.

    Examples
    --------
    >>> Eigenvalues(MeasuredModes([-28.5 + 2870j, -39.3 + 3970j], modes=[6, 7]))
    <Eigenvalues: modes 6, 7, weights equal>
    """

    measured: MeasuredModes
    weights: FloatArray | None = field(default=None, kw_only=True)

    def __post_init__(self) -> None:
        if not isinstance(self.measured, MeasuredModes):
            raise ModelError(
                f"Eigenvalues compares with MeasuredModes, got {type(self.measured).__name__}. "
                "Wrap the poles: MeasuredModes(poles, modes=[...])."
            )
        if self.measured.modes is None:
            raise LabelError(
                f"{self.measured!r} has no mode numbers: which mode of the model each pole "
                "belongs to is not known. Give modes=[...], counted from 1 with the rigid-body "
                "modes."
            )
        if self.weights is not None:
            weights = real_array(self.weights, "weights", (len(self.measured),))
            if weights.min() <= 0:
                raise ModelError(
                    f"weights must be positive, got {weights.min():g}: W of (12) is positive "
                    "definite. Leave a pole out of the measurement instead of weighting it zero."
                )
            self._set(weights=weights)

    def __repr__(self) -> str:
        numbers = ", ".join(str(number) for number in self.measured.modes or ())
        kind = (
            "given"
            if self.weights is not None
            else "equal"
            if self.measured.covariance is None
            else "1/variance"
        )
        return f"<Eigenvalues: modes {numbers}, weights {kind}>"

    @property
    def W(self) -> FloatArray:
        """The diagonal (m,) of W in (12)."""
        m = len(self.measured)
        if self.weights is not None:
            return self.weights
        if self.measured.covariance is None:
            return np.ones(m)
        variance = np.diag(self.measured.covariance)
        return np.asarray(1 / (variance[:m] + variance[m:]), dtype=np.float64)

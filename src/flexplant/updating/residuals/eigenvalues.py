"""What the update compares: residuals between the measurement and the model."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field

import numpy as np
import scipy.linalg as la

from ...checks import ComplexArray, FloatArray, instance, positive, positive_array
from ...errors import LabelError
from ...identification import MeasuredModes
from ...modes.matching import clusters
from ..family import Family
from ..point_model import Point
from .mode_shapes import chosen_modes
from .residual import Bound, Kind, Residual, split_parts

#: relative deviations of frequency and of damping of a good model of a structure: two of them are
#: the 0.5 % and 30 % that an updated model is seldom better than where nothing was measured
USUAL = (2.5e-3, 0.15)
#: least 1 - zeta^2 of a pole that swings
ZETA = 1e-6


def growth(omega: FloatArray, measured: FloatArray) -> FloatArray:
    """Return by how much more than the usual the frequencies (m,) of a model are off.

    What a model leaves out (shear, rotary inertia, what lies between the nodes of a mesh) costs a
    share that grows with the square of the wavenumber, of plates and beams with omega; what is
    wrong everywhere (material, thickness) a constant one. Both are alike at the middle of the
    measured frequencies.
    """
    return np.asarray(0.5 * (1.0 + omega / np.mean(measured)))


@dataclass(frozen=True, eq=False, repr=False)
class Eigenvalues(Residual):
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
    clusters : float
        Modes whose measured poles are closer than this, relatively (0.02, say), are compared by
        their mean, which does not care how they turn into each other. Zero: each by itself.

    Raises
    ------
    ModelError, ShapeError
        When weights are not positive numbers, one for each pole.
    LabelError
        When the poles have no mode numbers.

    References
    ----------
    [paper]_, equations (9)-(12).

    Examples
    --------
    >>> Eigenvalues(MeasuredModes([-28.5 + 2870j, -39.3 + 3970j], modes=[6, 7]))
    <Eigenvalues: modes 6, 7, weights equal>
    """

    measured: MeasuredModes
    weights: FloatArray | None = field(default=None, kw_only=True)
    clusters: float = field(default=0.0, kw_only=True)

    def __post_init__(self) -> None:
        instance(
            self.measured, MeasuredModes, "measured", "Pass MeasuredModes(poles, modes=[...])."
        )
        if self.measured.modes is None:
            raise LabelError(
                f"{self.measured!r} has no mode numbers: which mode of the model each pole "
                "belongs to is not known. Give modes=[...], counted from 1 with the rigid-body "
                "modes."
            )
        if self.weights is not None:
            why = "W of (12) is positive definite: leave a pole out of the measurement instead."
            shape = (len(self.measured),)
            self._set(weights=positive_array(self.weights, "weights", shape, hint=why))
        self._set(clusters=positive(self.clusters, "clusters", zero=True))

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

    def select(self, modes: Sequence[int]) -> Eigenvalues:
        """Return the residual of some of its modes, by number.

        Raises
        ------
        LabelError
            When a mode was not measured.
        """
        chosen, columns = chosen_modes(self.measured, modes)
        weights = None if self.weights is None else self.weights[columns]
        return self.replace(measured=chosen, weights=weights)

    def bound(self, family: Family) -> Bound:
        """Return the residual tied to a family."""
        return BoundEigenvalues(self)


class BoundEigenvalues(Bound):
    """Poles (or means of clusters) whitened by the factor of their covariance, or by W^(1/2)."""

    def __init__(self, residual: Eigenvalues) -> None:
        measured = residual.measured
        self.numbers = measured.modes or ()
        m = len(measured)
        close = clusters(measured.poles, residual.clusters) if residual.clusters else []
        self.clusters = [group.tolist() for group in close]
        alone = [[i] for i in range(m) if not any(i in group for group in self.clusters)]
        self.mean = np.zeros((len(alone) + len(self.clusters), m))
        for row, group in zip(self.mean, [*alone, *self.clusters], strict=True):
            row[group] = 1 / len(group)
        self.target = measured.poles
        self.noisy = residual.weights is None and measured.covariance is not None
        both = np.kron(np.eye(2), self.mean)
        covariance = np.diag(np.tile(1 / residual.W, 2))
        if self.noisy and measured.covariance is not None:
            covariance = measured.covariance
        factor = la.cholesky(both @ covariance @ both.T, lower=True)
        self.white = la.solve_triangular(factor, both, lower=True)
        if measured.covariance is not None and not self.noisy:
            self.noise = self.white @ measured.covariance @ self.white.T
        self.size = np.abs(self.white) @ np.tile(np.abs(self.target), 2)
        self.name = f"modes {', '.join(map(str, self.numbers))}"
        self._members = [*alone, *self.clusters]

    def kinds(self) -> list[Kind]:
        """Return relative errors of frequency (at constant zeta) and of damping.

        Of each mode, and one as large of all modes together (the material's, say), which no mode
        shows by itself.
        """
        grown = growth(np.abs(self.target), np.abs(self.target))
        pole = self.target
        zeta = -pole.real / np.abs(pole)
        # d lambda / d ln zeta
        damped = np.abs(pole) * (-zeta - 1j * zeta**2 / np.sqrt(np.maximum(1 - zeta**2, ZETA)))
        return [
            Kind(name, self.whitened(np.column_stack([np.diag(column), column])), usual)
            for name, column, usual in (
                ("frequency", grown * pole, USUAL[0]),
                ("damping", damped, USUAL[1]),
            )
        ]

    def row_name(self, row: int) -> str:
        """Return the mode or modes of a row."""
        members = self._members[row % len(self._members)]
        return f"mode{'s' * (len(members) > 1)} {', '.join(str(self.numbers[i]) for i in members)}"

    def whitened(self, rows: ComplexArray) -> FloatArray:
        """Return weighted [Re; Im] of complex rows, one for each pole."""
        return np.asarray(self.white @ split_parts(rows), dtype=np.float64)

    def values(self, point: Point) -> FloatArray:
        """Return measured minus model, weighted."""
        gap = self.target - point.eigen.poles[point.columns(self.numbers)]
        return self.whitened(gap)

    def slopes(self, point: Point) -> FloatArray:
        """Return their derivatives."""
        S = point.sensitivity(self.numbers)
        for group in self.clusters:
            # the trace does not depend on the vectors chosen in the subspace
            _, change = point.subspace([self.numbers[i] for i in group])
            S[group] = np.trace(change, axis1=1, axis2=2) / len(group)
        return -self.whitened(S)

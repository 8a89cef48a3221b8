"""Derivatives of complex eigenvalues to parameters, in closed form."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any, TypeAlias

import numpy as np
import scipy.linalg as la

from ..arrays import ComplexArray, FloatArray, divisor
from ..errors import LabelError, ModelError, counted, short
from ..store import Value
from ..tolerances import MISSED, SAME
from ..words import several
from .family import Eigen, Family, Point, repeated_groups
from .parameters import Parameter, checked_parameters, checked_values
from .residuals.modal_residuals import BoundEigenvalues

#: matrices that rotate exactly repeated modes to the vectors in which a change of parameters splits
#: them; and the derivatives (q,) along these, by columns of modes
Split: TypeAlias = Callable[[FloatArray], tuple[Eigen, dict[int, ComplexArray]]]


def splitting(family: Family, eigen: Eigen) -> Split:
    """Return the split of repeated modes along a direction, by eigenvectors of the derivative."""
    # the modes of a group have the order of their new frequencies
    groups = [(one, family.group_derivative(eigen, one)) for one in repeated_groups(eigen.poles)]

    def split(direction: FloatArray) -> tuple[Eigen, dict[int, ComplexArray]]:
        turned = eigen
        rows: dict[int, ComplexArray] = {}
        for columns, G in groups:
            moved, Q = la.eig(np.tensordot(direction, G, axes=1))
            Q = Q[:, np.lexsort((moved.real, moved.imag))]
            turned = turned.rotated(columns, Q)
            own = np.diagonal(la.solve(Q, G @ Q), axis1=1, axis2=2)
            rows |= {column: own[:, i] for i, column in enumerate(columns)}
        return turned, rows

    return split


@dataclass(frozen=True, eq=False, repr=False)
class Sensitivities(Value):
    """Derivatives of complex eigenvalues with respect to parameters (equation (11) of [paper]_).

    Parameters
    ----------
    modes : sequence of m int
        Mode numbers, counted from 1 with rigid-body modes.
    poles : (m,) complex array [rad/s]
        Eigenvalues lambda_a.
    S : (m, q) complex array [rad/s per unit]
        ``S_ab = d lambda_a / d p_b``.
    parameters : sequence of q str
        Names of the parameters.
    """

    modes: tuple[int, ...]
    poles: ComplexArray
    S: ComplexArray
    parameters: tuple[str, ...]

    def __repr__(self) -> str:
        return (
            f"<Sensitivities: {counted(len(self.modes), 'mode')} to {', '.join(self.parameters)}>"
        )


def eigenvalue_sensitivities(
    model: Any,
    parameters: Sequence[Parameter],
    *,
    modes: Sequence[int] | None = None,
    values: Sequence[float] | FloatArray | None = None,
) -> Sensitivities:
    """Return the sensitivities of the complex eigenvalues of a model to parameters.

    By equation (11) of the paper, the derivative is
    ``d lambda/d p = - y^H (lambda^2 dM + lambda dD + dK) x / (y^H (2 lambda M + D) x)``. Here x and
    y are right and left eigenvectors of ``lambda^2 M + lambda D + K``. When a parameter changes,
    exactly repeated modes may split into modes of different frequencies. The eigenvectors of
    repeated modes are not unique. The derivatives use those to which the eigenvectors of the split
    modes tend when the parameter tends to its given value. The modes are sorted by the frequencies
    that they have when the parameter increases.

    Parameters
    ----------
    model, parameters
        Model and parameters, as for `update`. Full matrices are used for an FEModel.
    modes : sequence of int, optional
        Mode numbers, which count from 1 and include rigid-body modes. None: all elastic modes.
    values : (q,) array, optional
        Values of the parameters at which derivatives are taken. None: zeros, which is the model
        itself.

    Returns
    -------
    Sensitivities
        Matrix S of the derivatives, with the poles and their mode numbers.

    Raises
    ------
    LabelError, ModelError
        When a mode number or a place is unknown, two parameters have the same name, or the matrices
        are indefinite at `values`. Also when several parameters split repeated modes into different
        shapes, because the derivatives do not exist then.

    References
    ----------
    [paper]_, equation (11).

    Examples
    --------
    Change of the second pole of a chain with a mass at its end:

    >>> import flexplant as fx
    >>> drawing = fx.chain(masses=[1.0, 1.0, 1.0], stiffnesses=[4e5, 4e5])
    >>> found = fx.updating.eigenvalue_sensitivities(drawing, [fx.AddedMass("3:x")], modes=[2])
    >>> found.S.imag.round(2)  # -omega phi^2 / 2 rad/s per kg
    array([[-158.11]])
    """
    listed = checked_parameters(parameters)
    family = Family(model, listed)
    eigen = family.at(checked_values(values, listed, "values"))
    numbers = range(eigen.n_rigid + 1, eigen.n_rigid + eigen.poles.size + 1)
    columns = mode_columns(numbers if modes is None else modes, eigen)
    growing = 1 / divisor(family.strength(float(np.abs(eigen.poles[0]))))
    turned, _ = splitting(family, eigen)(growing)
    S = family.sensitivity(turned, columns)
    for group in repeated_groups(eigen.poles):
        if set(group) & set(columns):
            G = family.group_derivative(turned, group)
            size = np.abs(G).max(axis=(1, 2), keepdims=True)
            off = np.abs(G) * (1 - np.eye(len(group))) / divisor(size)
            # within a group of equal eigenvalues, as accurate as these are equal
            if off.max() > 1e-6:
                raise ModelError(
                    f"modes {[i + eigen.n_rigid + 1 for i in group]} are repeated, and "
                    f"{', '.join(p.name for p in listed)} split them along different vectors: "
                    "derivatives with respect to all of them do not exist. Use one parameter at "
                    "a time."
                )
    return Sensitivities(
        modes=tuple(i + eigen.n_rigid + 1 for i in columns),
        poles=eigen.poles[columns],
        S=S,
        parameters=tuple(p.name for p in listed),
    )


def mode_columns(modes: Any, eigen: Eigen) -> list[int]:
    """Return the columns of the modes with the given numbers."""
    first, last = eigen.n_rigid + 1, eigen.n_rigid + eigen.poles.size
    if not eigen.poles.size:
        raise ModelError("the model has no oscillating mode and therefore no eigenvalue to follow.")
    if not several(modes) or not len(modes):
        raise LabelError(f"modes must be a list of numbers, got {short(modes)}. Pass [6, 7], say.")
    for number in modes:
        if isinstance(number, bool) or number not in range(1, last + 1):
            raise LabelError(
                f"no mode {number!r}: the model has {eigen.n_rigid} rigid-body and "
                f"{counted(eigen.poles.size, 'oscillating mode')}, numbered from 1 to {last}. "
                "Choose among these."
            )
        if number < first:
            raise LabelError(
                f"mode {number} is a rigid-body mode of the start model (1 to {eigen.n_rigid}): "
                "its eigenvalue is zero, and a spring to the ground moves it with infinite "
                "slope. Leave it out, or start from a spring that is not zero (start=)."
            )
    return [int(number) - first for number in modes]


class PoleRows:
    """All measured eigenvalues of an objective, weighted as its residuals weigh them."""

    def __init__(self, bounds: Sequence[BoundEigenvalues]) -> None:
        self.bounds = bounds
        self.numbers = tuple(n for bound in bounds for n in bound.numbers)
        self.target = np.concatenate([bound.target for bound in bounds])

    def whitened(self, rows: ComplexArray) -> FloatArray:
        """Return weighted [Re; Im] of complex rows (m,) or (m, q)."""
        ends = np.cumsum([len(bound.numbers) for bound in self.bounds])[:-1]
        parts = zip(self.bounds, np.split(rows, ends), strict=True)
        return np.concatenate([bound.whitened(part) for bound, part in parts])


def split_point(point: Point, data: PoleRows) -> Point:
    """Return the point with exactly repeated modes turned to the split of the next step."""
    # the split depends on the step, and the step on the split: among both directions of every
    # parameter, the step that fits best with its own split is used. Their numbers rise with their
    # new frequencies
    groups = repeated_groups(point.eigen.poles)
    if not groups:
        return point
    repeated = {i for group in groups for i in group}
    labels = point.labels.copy()
    for group in groups:
        labels[group] = np.sort(labels[group])
    point = Point(point.family, point.p, point.eigen, labels)
    try:
        columns = point.columns(data.numbers)
    except ModelError:
        return point  # a mode is lost, which raises an error where it is needed
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
    split = splitting(family, point.eigen)

    def along(direction: FloatArray) -> tuple[ComplexArray, Eigen]:
        eigen, rows = split(direction)
        return np.array([rows.get(c, row) for c, row in zip(columns, S, strict=True)]), eigen

    for way in np.vstack([np.eye(scale.size), -np.eye(scale.size)]) / scale:
        turned, eigen = along(way)
        # rounding in the row of a vector that stays would give a step without bounds
        felt = np.where(np.abs(turned) > SAME * scale, turned, 0.0)
        white = data.whitened(felt) / scale
        step = np.linalg.lstsq(white, data.whitened(gap), rcond=MISSED)[0] / scale
        if np.any(step):
            turned, eigen = along(step)
        left = float(np.sum(data.whitened(gap - turned @ step) ** 2))
        if left < best[0]:
            best = (left, turned, eigen)
    return best[1], best[2]

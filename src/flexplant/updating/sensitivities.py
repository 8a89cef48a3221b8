"""Derivatives of complex eigenvalues to parameters, in closed form."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np
import scipy.linalg as la

from ..checks import ComplexArray, FloatArray, Value, instance, real_array, several, short
from ..errors import LabelError, ModelError, ShapeError, counted
from .family import Eigen, Family, repeated_groups
from .parameters.added import Parameter


class Rotation(NamedTuple):
    """Repeated modes turned to the vectors in which a change of parameters splits them."""

    eigen: Eigen
    #: (q, s) derivatives along the vectors, by the group's columns
    sensitivity: dict[int, ComplexArray]


#: columns of exactly repeated modes and their group derivative G (q, s, s)
GroupDerivatives = Sequence[tuple[list[int], ComplexArray]]


def group_derivatives(family: Family, eigen: Eigen) -> GroupDerivatives:
    """Return G of every group of exactly repeated modes: the same for all directions."""
    return [
        (columns, family.group_derivative(eigen, columns))
        for columns in repeated_groups(eigen.poles)
    ]


def split_rotation(groups: GroupDerivatives, eigen: Eigen, direction: FloatArray) -> Rotation:
    """Return exactly repeated modes turned to the eigenvectors of their derivative.

    Along `direction`; the modes of a group come in the order of the frequencies they move to.
    """
    rows: dict[int, ComplexArray] = {}
    for columns, G in groups:
        moved, Q = la.eig(np.tensordot(direction, G, axes=1))
        Q = Q[:, np.lexsort((moved.real, moved.imag))]
        eigen = eigen.rotated(columns, Q)
        own = np.diagonal(la.solve(Q, G @ Q), axis1=1, axis2=2)
        rows |= {column: own[:, i] for i, column in enumerate(columns)}
    return Rotation(eigen, rows)


@dataclass(frozen=True, eq=False, repr=False)
class Sensitivities(Value):
    """Derivatives of complex eigenvalues to parameters: S of the paper's (11).

    Parameters
    ----------
    modes : sequence of m int
        Numbers from 1, rigid-body modes included.
    poles : (m,) complex array [rad/s]
        Eigenvalues lambda_a.
    S : (m, q) complex array [rad/s per unit]
        ``S_ab = d lambda_a / d p_b``.
    parameters : sequence of q str
        Names.
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
    """Return how the complex eigenvalues of a model move with parameters.

    ``d lambda/d p = - y^H (lambda^2 dM + lambda dD + dK) x / (y^H (2 lambda M + D) x)`` with
    right and left eigenvectors x, y of ``lambda^2 M + lambda D + K`` (the paper, eq. (11)).
    Modes that are exactly repeated are first turned to the eigenvectors of the derivative; they
    are given by rising frequency for growing parameters.

    Parameters
    ----------
    model : ReducedModel or FEModel
        The model; an FEModel is treated densely.
    parameters : sequence of q Parameter
        To which the derivatives are taken.
    modes : sequence of int, optional
        Numbers from 1, rigid-body modes included; all elastic modes when not given.
    values : (q,) array, optional
        Values of the parameters to derive at; zeros (the model itself) when not given.

    Returns
    -------
    Sensitivities

    Raises
    ------
    LabelError
        When a mode number or a place is unknown, or names are doubled.
    ModelError
        When the matrices are indefinite at `values`, or several parameters split repeated modes
        along different vectors, so that no derivatives to them all exist.

    References
    ----------
    [paper]_, equation (11).

    Examples
    --------
    >>> import flexplant as fx
    >>> modes = fx.solve_modes(fx.chain(masses=[1.0, 1.0, 1.0], stiffnesses=[4e5, 4e5]), count=3)
    >>> drawing = fx.reduce(modes, fx.DesiredDofs(["1:x", "2:x", "3:x"]))
    >>> found = fx.updating.eigenvalue_sensitivities(drawing, [fx.AddedMass("3:x")], modes=[2])
    >>> found.S.imag.round(2)  # -omega phi^2 / 2 rad/s per kg
    array([[-158.11]])
    """
    listed = checked_parameters(parameters)
    family = Family(model, listed)
    eigen = family.at(checked_values(values, listed, "values"))
    numbers = range(eigen.n_rigid + 1, eigen.n_rigid + eigen.poles.size + 1)
    columns = mode_columns(numbers if modes is None else modes, eigen)
    growing = 1 / _divisor(family.strength(float(np.abs(eigen.poles[0]))))
    rotation = split_rotation(group_derivatives(family, eigen), eigen, growing)
    S = family.sensitivity(rotation.eigen, columns)
    for group in repeated_groups(eigen.poles):
        if set(group) & set(columns):
            G = family.group_derivative(rotation.eigen, group)
            size = np.abs(G).max(axis=(1, 2), keepdims=True)
            off = np.abs(G) * (1 - np.eye(len(group))) / _divisor(size)
            # within a group of equal eigenvalues, as accurate as these are equal
            if off.max() > 1e-6:
                raise ModelError(
                    f"modes {[i + eigen.n_rigid + 1 for i in group]} are repeated, and "
                    f"{', '.join(p.name for p in listed)} split them along different vectors: "
                    "no derivatives to all of them exist. Take one parameter at a time."
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
        raise ModelError("the model has no oscillating mode: there is no eigenvalue to follow.")
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


def checked_parameters(parameters: Any) -> tuple[Parameter, ...]:
    """Return the parameters as a tuple, checked."""
    listed = tuple(parameters) if isinstance(parameters, Sequence) else (parameters,)
    for parameter in listed:
        instance(parameter, Parameter, "a parameter", "Pass [AddedMass('41:z')], say.")
    if not listed:
        raise ModelError("parameters is empty: there is nothing to update.")
    names = [parameter.name for parameter in listed]
    twice = sorted({name for name in names if names.count(name) > 1})
    if twice:
        raise LabelError(
            f"{twice} appear more than once: only their sum could be seen. Drop all but one."
        )
    return listed


def checked_values(values: Any, parameters: Sequence[Parameter], name: str) -> FloatArray:
    """Return one value for each parameter, zeros when none are given."""
    if values is None:
        return np.zeros(len(parameters))
    array = real_array(values, name)
    if array.shape != (len(parameters),):
        raise ShapeError(
            f"{name} needs one value for each of {', '.join(p.name for p in parameters)}, got "
            f"shape {array.shape}. Pass a list."
        )
    return array


def _divisor(sizes: Any) -> Any:
    return np.where(sizes == 0, 1.0, sizes)

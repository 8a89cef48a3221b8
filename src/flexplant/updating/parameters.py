"""Parameters of M, D and K that may differ between model and machine."""

from __future__ import annotations

from abc import abstractmethod
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any, ClassVar, TypeAlias

import numpy as np
import scipy.sparse as sp

from ..arrays import FloatArray, Matrix, instance, real_array
from ..errors import LabelError, ModelError, ShapeError, require_known, short, with_deviation
from ..labels import DIRECTIONS, Place
from ..reduction import ReducedModel
from ..store import Value
from ..structure import FEModel

#: advice for the function that builds a model
MAKES = "Pass a function that returns an FEModel: lambda t: kirchhoff_plate(thickness=t, ...)."
#: derivatives of M, D and K to one parameter, None where zero
Derivatives: TypeAlias = tuple[Matrix | None, Matrix | None, Matrix | None]


class Parameter(Value):
    """One unknown p on which the mass, damping and stiffness matrices M, D and K depend.

    The matrices depend on p linearly, ``M(p) = M + p dM``, unless stated otherwise. A subclass has
    a unique `name`, a `unit` and its `matrices`. Prior knowledge of p may be given by `bounds`
    (lowest, highest) and by a `prior` (mean, standard deviation).

    Examples
    --------
    The library's parameters are instances of this class:

    >>> import flexplant as fx
    >>> isinstance(fx.AddedMass("1:x"), fx.updating.Parameter)
    True
    """

    name: str
    unit: str
    bounds: tuple[float, float] | None = None
    prior: tuple[float, float] | None = None

    @abstractmethod
    def matrices(self, model: FEModel | ReducedModel) -> Derivatives:
        """Return the derivatives (dM, dD, dK) of the model's matrices with respect to p.

        None stands for a derivative that is zero.
        """

    def terms(self, model: FEModel | ReducedModel) -> list[Derivatives]:
        """Return the matrices M_j of ``M(p) = M + sum_j g_j(p) M_j``, and those for D and K.

        The functions g_j are those of `curve`. If the matrices depend on p linearly, there is only
        one term, with g_1 = p.
        """
        return [self.matrices(model)]

    def curve(self, value: float) -> tuple[FloatArray, FloatArray]:
        """Return the functions g_j of ``M(p) = M + sum_j g_j(p) M_j``, and their derivatives.

        They are evaluated at the given value of p. The matrices M_j are those of `terms`. If the
        matrices depend on p linearly, the only function is g_1 = p, with the derivative 1.
        """
        return np.array([value]), np.ones(1)

    def change(self, model: FEModel | ReducedModel, value: float) -> Derivatives:
        """Return the changes of M, D and K for a value of the parameter, None where zero."""
        total: list[Any] = [None, None, None]
        for size, parts in zip(self.curve(value)[0].tolist(), self.terms(model), strict=True):
            for i, part in enumerate(parts):
                if part is not None and size:
                    total[i] = size * part if total[i] is None else total[i] + size * part
        return total[0], total[1], total[2]

    def about(self, value: float) -> Parameter:
        """Return the parameter of the change from a value that the model already has.

        The value zero of the new parameter stands for the matrices of the model.
        """
        return self

    def _check_known(self) -> None:
        """Check bounds and prior."""
        bounds, prior = checked_bounds(self.bounds, self.name), checked_prior(self.prior, self.name)
        self._set(bounds=bounds, prior=prior)

    def text(self, value: float, deviation: float | None = None) -> str:
        """Return a text with name, value, standard deviation (if it is known) and unit."""
        said = f"{value:.6g}" if deviation is None else with_deviation(value, deviation)
        return f"{self.name} = {said} {self.unit}"


@dataclass(frozen=True, eq=False, repr=False)
class PointParameter(Parameter):
    """A parameter p r r^T of one of the matrices, ``r = row(at) - row(to)``, along each motion."""

    at: Place
    direction: str = field(default="z", kw_only=True)
    name: str = field(default="", kw_only=True)
    to: Place | None = field(default=None, kw_only=True)
    bounds: tuple[float, float] | None = field(default=None, kw_only=True)
    prior: tuple[float, float] | None = field(default=None, kw_only=True)

    quantity: ClassVar[str] = ""
    #: of a translation and of a rotation
    units: ClassVar[tuple[str, str]] = ("", "")
    acts_on: ClassVar[int] = 0
    #: directions that mean several motions
    together: ClassVar[tuple[str, ...]] = ("xyz",)

    def __post_init__(self) -> None:
        require_known("direction", [self.direction], (*DIRECTIONS, *self.together))
        place, text = named_place(self.at, self.direction)
        if self.direction in self.together and not isinstance(place, tuple):
            raise LabelError(
                f"{text} names one motion: give a point (x, y, z) for direction={self.direction!r}."
            )
        other = self.to
        if other is not None:
            other, end = named_place(other, self.direction, "to")
            text += f" to {end}"
        name = checked_text(self.name, "name") or f"{self.quantity} at {text}"
        self._set(at=place, name=name, to=other)
        self._check_known()

    def __repr__(self) -> str:
        return f"<{type(self).__name__}: {self.name} [{self.unit}]>"

    @property
    def unit(self) -> str:  # type: ignore[override]
        """Unit of the parameter. It is the unit for rotations if the place is a rotation."""
        labels = [self.at] if isinstance(self.at, str) else self.at
        along = labels if isinstance(labels, Mapping | list) else [f":{self.direction}"]
        return self.units[all(str(label).split(":")[-1].startswith("r") for label in along)]

    def matrices(self, model: FEModel | ReducedModel) -> Derivatives:
        """Return the derivatives (dM, dD, dK) of the model's matrices with respect to p.

        One of them is ``r r^T``, as a sparse matrix if the model is sparse. The others are None.
        An `AddedMass` with the direction "xyz" has the sum of ``r r^T`` over the translations.
        """
        found = np.array(self.rows(model)).T
        if not np.any(found):
            raise ModelError(
                f"{self.name} has no effect: its weights are all zero. Give a place that moves."
            )
        columns: Any = sp.csc_array(found) if sp.issparse(model.M) else found
        parts: list[Matrix | None] = [None, None, None]
        parts[self.acts_on] = columns @ columns.T
        return parts[0], parts[1], parts[2]

    def rows(self, model: FEModel | ReducedModel) -> list[FloatArray]:
        """Return the vector r (n,) of the place on the DOFs of the model, in a list.

        An `AddedMass` with the direction "xyz" has a vector for each translation of the model.
        """
        of = model if hasattr(model, "row") else model.dofs
        along: tuple[str, ...] = (self.direction,)
        if self.direction in self.together:
            known = getattr(model, "full_dofs", None) or model.dofs
            along = tuple(one for one in self.direction if one in known.directions)
        rows = [np.asarray(of.row(self.at, one), dtype=np.float64) for one in along]
        if self.to is not None:
            ends = (np.asarray(of.row(self.to, one), dtype=np.float64) for one in along)
            rows = [row - end for row, end in zip(rows, ends, strict=True)]
        return rows


class AddedMass(PointParameter):
    """A point mass [kg] or rotary inertia [kg m^2] added at a place: M + p r r^T.

    r is the vector of interpolation weights of the place on the DOFs of the model.

    Parameters
    ----------
    at : str, (3,) array [m] or mapping
        Place of the mass: a DOF label, a point (interpolated between nodes) or {label: weight}. The
        mass has inertia in one direction only, except with "xyz".
    direction : str
        Direction of the motion at a point. A label contains its direction. With "xyz", the
        parameter acts along every translation that the model has, as a `PointMass` does. On a plate
        in bending, this is only z.
    name : str, optional
        Name of the parameter in results. None: the name is made from the place.
    to : str, (3,) array [m] or mapping, optional
        Second place, for an inertia against the relative motion of two places. The vector r is
        then that of `at` minus that of `to`. None: the inertia acts against the absolute motion.
    bounds : (lowest, highest), optional
        Limits of the parameter. None or infinity: not limited.
    prior : (mean, standard deviation), optional
        Normal distribution of the parameter that is known before the update.

    Examples
    --------
    A mass that moves along z, and a mass that moves in all directions:

    >>> AddedMass("14:z")
    <AddedMass: mass at 14:z [kg]>
    >>> AddedMass((0.3, 0.2, 0.05), direction="xyz", name="chuck")
    <AddedMass: chuck [kg]>
    """

    quantity = "mass"
    units = "kg", "kg m^2"
    acts_on = 0


class AddedDamping(PointParameter):
    """A viscous damper [N s/m] from a place to the ground or to another place: D + p r r^T.

    The vector r contains the interpolation weights of the place on the DOFs of the model. Between
    two places it is the difference of their vectors. On rotations the unit is [N m s/rad].

    Parameters
    ----------
    at, direction, name
        As for `AddedMass`. With ``at={a: 1, b: -1}``, the damper acts between the DOFs a and b.
    to : str, (3,) array [m] or mapping, optional
        Place of the other end of the damper. None: the ground.
    bounds, prior
        As for `AddedMass`.

    Examples
    --------
    A damper between a point of a plate and the ground:

    >>> AddedDamping((0.3, 0.15, 0.0))
    <AddedDamping: damping at (0.3, 0.15, 0) z [N s/m]>
    """

    quantity = "damping"
    units = "N s/m", "N m s/rad"
    acts_on = 1


class AddedStiffness(PointParameter):
    """A spring [N/m] from a place to the ground or to another place: K + p r r^T.

    The vector r contains the interpolation weights of the place on the DOFs of the model. Between
    two places it is the difference of their vectors. On rotations the unit is [N m/rad].

    On a free structure, a spring to the ground turns the rigid-body modes that move it into
    suspension modes with a frequency proportional to sqrt(p). The derivative of sqrt(p) is infinite
    at zero. These modes can therefore only be fitted from a start value that is not zero.

    Parameters
    ----------
    at, direction, name
        As for `AddedMass`. With ``at={a: 1, b: -1}``, the spring acts between the DOFs a and b.
    to : str, (3,) array [m] or mapping, optional
        Place of the other end of the spring. None: the ground.
    bounds, prior
        As for `AddedMass`.

    Examples
    --------
    A spring between two displacements, and a spring between two rotations:

    >>> AddedStiffness({"14:z": 1.0, "15:z": -1.0}, name="crack")
    <AddedStiffness: crack [N/m]>
    >>> AddedStiffness({"1:rz": 1.0, "2:rz": -1.0}, name="gear")
    <AddedStiffness: gear [N m/rad]>
    """

    quantity = "stiffness"
    units = "N/m", "N m/rad"
    acts_on = 2


def named_place(at: Any, direction: str, what: str = "at") -> tuple[Place, str]:
    """Return a place and its name."""
    if isinstance(at, str):
        if not at:
            raise LabelError(
                f"{what}='' is not a place: give a DOF label such as '41:z', or a point."
            )
        return at, at
    if isinstance(at, Mapping):
        if not at:
            raise LabelError(f"{what}={{}} is not a place: give {{DOF label: weight}}.")
        weights = {
            str(label): float(real_array(weight, f"weight of {label!r}", ()))
            for label, weight in at.items()
        }
        return weights, " ".join(f"{weight:+g}*{label}" for label, weight in weights.items())
    point = tuple(real_array(at, what, (3,)).tolist())
    return point, "(" + ", ".join(f"{x:g}" for x in point) + f") {direction}"


def checked_text(value: Any, what: str) -> str:
    """Return a text."""
    if not isinstance(value, str):
        raise LabelError(f"{what} must be a text, got {short(value)}. Use quotes.")
    return value


def checked_bounds(value: Any, name: str) -> tuple[float, float] | None:
    """Return (lowest, highest), None without bounds."""
    if value is None:
        return None
    pair = np.asarray(value, dtype=object)
    if pair.shape != (2,):
        raise ModelError(
            f"bounds of {name} must be (lowest, highest), got {short(value)}. Pass a pair."
        )
    try:
        low = -np.inf if pair[0] is None else float(pair[0])
        high = np.inf if pair[1] is None else float(pair[1])
    except (TypeError, ValueError) as error:
        raise ModelError(f"bounds of {name} must be two numbers, got {value!r:.60}.") from error
    if not low < high:
        raise ModelError(f"bounds of {name} must be lowest < highest, got ({low:g}, {high:g}).")
    return low, high


def checked_prior(value: Any, name: str) -> tuple[float, float] | None:
    """Return (mean, standard deviation), None without a prior."""
    if value is None:
        return None
    mean, std = real_array(value, f"prior of {name}", (2,)).tolist()
    if std <= 0:
        raise ModelError(
            f"the prior of {name} needs a positive standard deviation, got {std:g}: a parameter "
            "that is known exactly should be part of the model."
        )
    return mean, std


def checked_parameters(parameters: Any) -> tuple[Parameter, ...]:
    """Return the parameters as a tuple, checked."""
    listed = tuple(parameters) if isinstance(parameters, Sequence) else (parameters,)
    if not listed:
        raise ModelError("parameters is empty: give at least one parameter to update.")
    for parameter in listed:
        instance(parameter, Parameter, "a parameter", "Pass for example [AddedMass('41:z')].")
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

"""Point masses, springs and dampers attached to a structure; and structures with held DOFs."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np
import scipy.sparse as sp

from ..arrays import FloatArray, IntArray, floats_of, instance, number, positive, real_array
from ..errors import LabelError, ModelError
from ..labels import DofSet, Interpolation, Place, checked_direction
from ..store import Value, checked


def plain_place(at: Any, name: str) -> Any:
    """Return a label, a point as a tuple or a mapping as they are."""
    if isinstance(at, str | Mapping):
        return at
    try:
        return floats_of(at, "at", 3)
    except ValueError:
        raise LabelError(
            f"{name} must be at a DOF label like '41:z', a point (x, y, z) in metres or a mapping "
            f"{{label: weight}}, got {at!r:.80}. Use dofs.nearest((x, y, z)), which finds a label."
        ) from None


@dataclass(frozen=True, eq=False)
class PointMass(Value):
    """A rigid mass at a place of the structure.

    Parameters
    ----------
    at : str, (3,) array [m] or mapping
        Place of the mass: a DOF label, a point, or a mapping of DOF labels to weights. At a point
        the mass acts on every translation that the model has there. At a DOF label or a mapping it
        acts on this motion only.
    mass : float [kg]
        Mass. When the place is the label of a rotation, it is a moment of inertia [kg m^2].
    inertia : float or (3,) array [kg m^2]
        Moments of inertia about axes along x, y and z through the centre of the mass. They act on
        the rotations of the model at the point. A model without rotational DOFs computes these
        rotations from its displacements.

    Examples
    --------
    A mass of 3 kg is added to the second mass of a chain:

    >>> import flexplant as fx
    >>> model = fx.chain(masses=[1.0, 1.0], stiffnesses=[100.0])
    >>> model.with_parts(fx.PointMass("2:x", 3.0)).M.toarray()
    array([[1., 0.],
           [0., 4.]])
    """

    at: Place = field(metadata=checked(plain_place, name="a point mass"))
    mass: float = field(metadata=checked(positive, name="mass of a point mass", zero=True))
    inertia: float | Sequence[float] = field(default=0.0, kw_only=True)

    def __post_init__(self) -> None:
        super().__post_init__()
        inertia = real_array(self.inertia, "inertia")
        about = np.broadcast_to(inertia, (3,)) if inertia.size == 1 else inertia
        if about.shape != (3,) or np.any(about < 0):
            raise ModelError(
                f"inertia must be one number or three (about x, y, z), none negative, got "
                f"{inertia.tolist()!r:.80}. Leave products of inertia out: turn the axes."
            )
        if about.any() and isinstance(self.at, str | Mapping):
            raise ModelError(
                f"a point mass with inertia needs a point (x, y, z), got {self.at!r:.80}: a label "
                "names one motion only. Use dofs.xyz of the node as the point."
            )
        self._set(inertia=tuple(about.tolist()))

    def added(self, dofs: DofSet) -> list[tuple[str, FloatArray, float]]:
        """Return the additions to the matrix M, as a list of tuples ("M", row, weight).

        The row (n,) gives a motion of the place from the n DOFs, and the weight is the mass or the
        moment of inertia. The addition is ``weight row^T row``.
        """
        if isinstance(self.at, str | Mapping):
            return [("M", dofs.row(self.at), self.mass)]
        moved = [d for d in ("x", "y", "z") if d in dofs.directions]
        if not moved:
            raise ModelError(
                "the model has no translation for a point mass to ride on. Name a DOF by its label."
            )
        turned = zip(("rx", "ry", "rz"), np.asarray(self.inertia).tolist(), strict=True)
        found = [("M", dofs.row(self.at, d), self.mass) for d in moved]
        return found + [("M", dofs.row(self.at, d), j) for d, j in turned if j]


@dataclass(frozen=True, eq=False)
class Spring(Value):
    """A linear spring between a place and the ground, or between two places.

    Parameters
    ----------
    at : str, (3,) array [m] or mapping
        One end: a DOF label, a point, or a mapping of DOF labels to weights.
    stiffness : float [N/m or N m/rad]
        Stiffness of the spring. It may be negative, as for attracting magnets in reluctance
        actuators, whose force increases the displacement. A negative stiffness may make rigid-body
        motions unstable. `solve_modes` and `assemble_plant` accept such a model. They refuse a
        model in which a deformation of the structure is unstable.
    direction : str
        Direction of the motion at a point: x, y, z, rx, ry, rz. A DOF label has its own direction.
    to : place, optional
        Place of the other end. None: the ground.

    Examples
    --------
    A spring to the ground is added to the first mass of a chain:

    >>> import flexplant as fx
    >>> model = fx.chain(masses=[1.0, 1.0], stiffnesses=[100.0])
    >>> model.with_parts(fx.Spring("1:x", 50.0)).K.toarray()
    array([[ 150., -100.],
           [-100.,  100.]])
    """

    at: Place = field(metadata=checked(plain_place, name="a spring"))
    stiffness: float = field(metadata=checked(number, name="stiffness of a spring"))
    direction: str = field(default="z", kw_only=True, metadata=checked(checked_direction))
    to: Place | None = field(
        default=None, kw_only=True, metadata=checked(plain_place, name="a spring")
    )

    def added(self, dofs: DofSet) -> list[tuple[str, FloatArray, float]]:
        """Return the addition to the matrix K, as a list of one tuple ("K", row, weight).

        The row (n,) gives the motion of one end relative to the other from the n DOFs, and the
        weight is the stiffness. The addition is ``weight row^T row``.
        """
        return [("K", _stretch(self, dofs), self.stiffness)]


@dataclass(frozen=True, eq=False)
class Damper(Value):
    """A viscous damper between a place and the ground, or between two places.

    Parameters
    ----------
    at : str, (3,) array [m] or mapping
        One end: a DOF label, a point, or a mapping of DOF labels to weights.
    rate : float [N s/m or N m s/rad]
        Damping, which is the force per velocity. It must not be negative.
    direction : str
        Direction of the motion at a point: x, y, z, rx, ry, rz. A DOF label has its own direction.
    to : place, optional
        Place of the other end. None: the ground. A damper to the ground also damps rigid-body
        motions, which `solve_modes` refuses unless springs to the ground hold these motions too.
        `assemble_plant` accepts such a model, with dense matrices.

    Examples
    --------
    A damper connects the two masses of a chain:

    >>> import flexplant as fx
    >>> model = fx.chain(masses=[1.0, 1.0], stiffnesses=[100.0])
    >>> model.with_parts(fx.Damper("1:x", 2.0, to="2:x")).D.toarray()
    array([[ 2., -2.],
           [-2.,  2.]])
    """

    at: Place = field(metadata=checked(plain_place, name="a damper"))
    rate: float = field(metadata=checked(positive, name="rate of a damper", zero=True))
    direction: str = field(default="z", kw_only=True, metadata=checked(checked_direction))
    to: Place | None = field(
        default=None, kw_only=True, metadata=checked(plain_place, name="a damper")
    )

    def added(self, dofs: DofSet) -> list[tuple[str, FloatArray, float]]:
        """Return the addition to the matrix D, as a list of one tuple ("D", row, weight).

        The row (n,) gives the motion of one end relative to the other from the n DOFs, and the
        weight is the damping. The addition is ``weight row^T row``.
        """
        return [("D", _stretch(self, dofs), self.rate)]


Part = PointMass | Spring | Damper


@dataclass(frozen=True, eq=False, repr=False)
class HeldShape(Interpolation):
    """The interpolation of a structure after some of its DOFs were held by `FEModel.fixed`.

    Parameters
    ----------
    free : Interpolation
        Interpolation of the structure with all its DOFs.
    rows_left : (n,) array of int
        Positions of the remaining DOFs among all DOFs, counted from 0, in ascending order.

    Examples
    --------
    The first node of a beam is clamped, so that four of six DOFs remain:

    >>> import flexplant as fx
    >>> bar = {"length": 0.2, "elements": 2, "area": 1e-4, "inertia": 1e-9}
    >>> beam = fx.beam(**bar, density=7800.0, youngs_modulus=2.1e11)
    >>> held = beam.fixed(["1:z", "1:ry"])
    >>> held.dofs.interpolation
    HeldShape(free=BeamShape(length=0.2, elements=2), rows_left=[2, 3, 4, 5])
    """

    free: Interpolation
    rows_left: IntArray

    def row(self, xyz: FloatArray, direction: str) -> FloatArray:
        """Return the weights (n,) of the n DOFs in the motion `direction` at `xyz` [m]."""
        return np.asarray(self.free.row(xyz, direction)[self.rows_left])

    def rows(self, points: FloatArray, direction: str) -> FloatArray:
        """Return the weights (p, n) at many points (p, 3) [m], with one row for each point."""
        return np.asarray(self.free.rows(points, direction)[:, self.rows_left])

    def dependent(self, label: str) -> tuple[FloatArray, FloatArray] | None:
        """Return the row (n,) and the coordinates (3,) of a DOF that follows others, or None."""
        found = self.free.dependent(label)
        return None if found is None else (found[0][self.rows_left], found[1])


def added_matrices(dofs: DofSet, parts: Iterable[Part] | Part) -> dict[str, sp.csc_array]:
    """Return the terms that parts add to M, K and D, only for the matrices that change."""
    listed = (
        [parts]
        if isinstance(parts, Part)
        else list(instance(parts, Iterable, "parts", "Pass PointMass(...) in [...]."))
    )
    rows: dict[str, list[sp.csc_array]] = {}
    signs: dict[str, list[float]] = {}
    for part in listed:
        instance(part, Part, "a part", "Add your own matrices by model.replace(K=...).")
        for name, row, weight in part.added(dofs):
            if weight:
                scaled = np.sqrt(abs(weight)) * row
                rows.setdefault(name, []).append(sp.csc_array(scaled[:, None]))
                signs.setdefault(name, []).append(float(np.sign(weight)))
    found = {}
    for name, columns in rows.items():
        spread = sp.hstack(columns, format="csc")
        found[name] = sp.csc_array(spread @ sp.diags_array(signs[name]) @ spread.T)
    return found


def _stretch(part: Spring | Damper, dofs: DofSet) -> FloatArray:
    row = dofs.row(part.at, part.direction)
    if part.to is None:
        return row
    row = row - dofs.row(part.to, part.direction)
    if not row.any():
        raise ModelError(
            f"both ends of a {type(part).__name__.lower()} are at {part.at!r:.60}: it would do "
            "nothing. Leave `to` out to fix its other end to the ground."
        )
    return row

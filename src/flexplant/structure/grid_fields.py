"""What varies over a grid of elements: materials, thicknesses, holes, ribs."""

from __future__ import annotations

import functools
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from typing import Any, NamedTuple, TypeAlias

import numpy as np
import scipy.sparse as sp

from ..checks import (
    FloatArray,
    IntArray,
    Value,
    checked,
    floats_of,
    number,
    positive,
    real_array,
    several,
    short,
    whole,
    why_not_called,
)
from ..errors import ModelError, ShapeError
from ..labels import DofSet, Interpolation, node_dofs
from ..tolerances import TYPED
from .element_matrices import Grid, beam_mass, beam_rotary, beam_stiffness

#: one number, an array (nx, ny, ...) with one per element, or a function of an element's centre
Field: TypeAlias = float | Sequence[Any] | FloatArray | Callable[..., float]

#: fields: a place in x and y, a size, and one that may be zero
_PLACE = checked(floats_of, count=2, unit="m")
_SIZE, _OR_ZERO = checked(positive), checked(positive, zero=True)


@dataclass(frozen=True, eq=False, repr=False)
class Rectangle(Value):
    """A rectangular hole: the part of each element that is inside is missing.

    Parameters
    ----------
    lower, upper : (2,) array [m]
        Its corners of smallest and largest x, y.

    Examples
    --------
    >>> import flexplant as fx
    >>> fx.structure.Rectangle((0.1, 0.1), (0.2, 0.3)).holds(np.array([[0.15, 0.2], [0.5, 0.5]]))
    array([ True, False])
    """

    lower: Sequence[float] = field(metadata=_PLACE)
    upper: Sequence[float] = field(metadata=_PLACE)

    def __post_init__(self) -> None:
        super().__post_init__()
        if np.any(np.array(self.upper) <= self.lower):
            raise ModelError(
                f"a rectangle's upper corner must be above its lower one in x and y, got "
                f"{self.lower} and {self.upper}. Swap them, or give it a width."
            )

    def holds(self, centres: FloatArray) -> Any:
        """Return which of the points (p, 2) are inside."""
        return np.all((centres > self.lower) & (centres < self.upper), axis=1)


@dataclass(frozen=True, eq=False, repr=False)
class Disc(Value):
    """A round hole: the part of each element that is inside is missing.

    Parameters
    ----------
    centre : (2,) array [m]
        Its middle.
    radius : float [m]
        Above 0.

    Examples
    --------
    >>> import flexplant as fx
    >>> fx.structure.Disc((0.3, 0.3), radius=0.1).holds(np.array([[0.3, 0.35], [0.5, 0.5]]))
    array([ True, False])
    """

    centre: Sequence[float] = field(metadata=_PLACE)
    radius: float = field(metadata=checked(positive, unit="m"))

    def holds(self, centres: FloatArray) -> Any:
        """Return which of the points (p, 2) are inside."""
        return np.linalg.norm(centres - np.array(self.centre), axis=1) < self.radius


Hole = Rectangle | Disc

#: elements along one axis: more of them are no model for a machine of today
MOST = 10**6
#: elements with less than this part of their area outside all holes are missing
_LEAST = 0.02
#: points along each side of an element: to see whether a hole's edge cuts it, and its area
_FEW, _MANY = 3, 20


def lengths_of(size: Any, count: int) -> tuple[float, ...]:
    """Return `count` positive lengths."""
    values = real_array(size, "size", (count,)).tolist()
    return tuple(
        positive(value, f"size in {axis}") for value, axis in zip(values, "xyz", strict=False)
    )


def _field_values(function: Any, name: str, centres: FloatArray) -> list[Any]:
    """Return what a user's function answers at the centres (elements, d)."""
    if isinstance(function, type):
        raise ModelError(f"{name} is a class, {function.__name__}. Pass a number or a function.")
    names = ", ".join("xyz"[: centres.shape[1]])
    why = why_not_called(function, *centres.tolist()[0]) if len(centres) else ""
    if why:
        raise ModelError(
            f"{name} is evaluated at the centre ({names}) of each element, and this function "
            f"cannot be called so: {why}. Write it as lambda {names}: ..."
        )
    return [function(*centre) for centre in centres.tolist()]


def counts_of(elements: Any, count: int) -> tuple[int, ...]:
    """Return `count` numbers of elements."""
    axes = "xyz"[:count]
    listed = [elements] if count == 1 and not several(elements) else elements
    if not isinstance(listed, Sequence | np.ndarray) or not several(listed) or len(listed) != count:
        raise ShapeError(
            f"elements must be {count} whole numbers (along {', '.join(axes)}), got "
            f"{short(elements)}. Write ({', '.join(['8'] * count)}), say."
        )
    return tuple(
        whole(value, f"elements along {axis}", maximum=MOST)
        for value, axis in zip(listed, axes, strict=True)
    )


def centres_of(lengths: Sequence[float], counts: Sequence[int]) -> FloatArray:
    """Return the centres (elements, d) of all elements, x fastest."""
    lines = [n * (np.arange(k) + 0.5) / k for n, k in zip(lengths, counts, strict=True)]
    return np.column_stack([a.ravel() for a in np.meshgrid(*lines[::-1], indexing="ij")[::-1]])


def field_of(
    value: Any, name: str, lengths: Sequence[float], counts: Sequence[int], present: Any = None
) -> Any:
    """Return one number, or an array (nz, ny, nx) of positive ones where elements are."""
    if callable(value):
        chosen = np.full(int(np.prod(counts)), True) if present is None else present.ravel()
        found = np.ones(chosen.size)
        centres = centres_of(lengths, counts)[chosen]
        answers = _field_values(value, name, centres)
        found[chosen] = real_array(answers, f"{name} of the elements", (len(answers),))
        values = found.reshape(tuple(counts[::-1]))
    else:
        values = real_array(value, name)
        if not values.ndim:
            return positive(value, name)
        if values.shape != tuple(counts):
            raise ShapeError(
                f"{name} must be one number, one for each element in an array of shape "
                f"{tuple(counts)}, or a function of an element's centre, got shape {values.shape}."
            )
        values = values.T
    there = values if present is None else values[present]
    if np.any(there <= 0):
        raise ModelError(
            f"{name} must be positive in every element, got {there.min():g}. Say where elements "
            "are missing by holes=."
        )
    return values


def poisson_of(value: Any, lengths: Sequence[float], counts: Sequence[int], present: Any) -> Any:
    """Return Poisson's ratio: one number, or an array (nz, ny, nx)."""
    if callable(value) or real_array(value, "poisson_ratio").ndim:

        def shifted(item: Any) -> Any:
            if not callable(item):
                return 1.0 + real_array(item, "poisson_ratio")
            if isinstance(item, type):
                return item
            return functools.wraps(item)(lambda *at: 1.0 + item(*at))

        found = field_of(shifted(value), "1 + poisson_ratio", lengths, counts, present) - 1.0
        there = found if present is None else found[present]
    else:
        found = float(real_array(value, "poisson_ratio", ()))
        there = np.array([found])
    if np.any(there <= -1) or np.any(there >= 0.5):
        worst = there.min() if np.any(there <= -1) else there.max()
        raise ModelError(
            f"poisson_ratio must be above -1 and below 0.5, got {worst:g}. Give that of "
            "the material, 0.25 to 0.35 for metals; incompressible ones need other elements."
        )
    return found


def present_of(
    holes: Any, lengths: Sequence[float], counts: Sequence[int], *, corners: bool
) -> Any:
    """Return which elements exist (nz, ny, nx), None when all do."""
    import scipy.ndimage

    if holes is None or (isinstance(holes, Sequence) and not len(holes)):
        return None
    missing = _hole_mask(holes, lengths, counts)
    present = ~missing.reshape(tuple(counts[::-1]))
    if present.all():
        return None
    structure = np.ones((3,) * len(counts)) if corners else None
    pieces = scipy.ndimage.label(present, structure=structure)[1]
    if pieces != 1:
        raise ModelError(
            f"the holes leave {pieces} separate pieces of the structure"
            + (", that is nothing at all" if not pieces else "")
            + ": make them smaller, or model the pieces one by one."
        )
    return present


def _hole_mask(holes: Any, lengths: Sequence[float], counts: Sequence[int]) -> Any:
    if not isinstance(holes, Hole) and not callable(holes):
        given = holes if isinstance(holes, np.ndarray) else np.array(holes, dtype=object)
        if given.size and all(isinstance(one, bool | np.bool_) for one in given.flat):
            given = given.astype(bool)
            if given.shape != tuple(counts):
                raise ShapeError(
                    f"holes must be a mask with one entry for each element, of shape "
                    f"{tuple(counts)}, got {given.shape}. Give True where an element is missing."
                )
            return given.T.ravel()
    centres = centres_of(lengths, counts)
    if callable(holes):
        return np.array([bool(answer) for answer in _field_values(holes, "holes", centres)])
    listed = list(holes) if several(holes) else [holes]
    if len(counts) != 2 or not all(isinstance(hole, Hole) for hole in listed):
        raise ModelError(
            f"holes must be Rectangle and Disc values, a mask of the elements or a function of an "
            f"element's centre, got {short(holes)}. "
            "Pass fx.structure.Rectangle((0.1, 0.1), (0.2, 0.2)), for example."
        )
    return _shares(listed, lengths, counts) < _LEAST


def share_of(holes: Any, lengths: Sequence[float], counts: Sequence[int]) -> Any:
    """Return the part of the area of each element (ny, nx) outside all holes, 1 when uncut."""
    listed = [holes] if isinstance(holes, Hole) else holes
    if not isinstance(listed, Sequence) or not all(isinstance(hole, Hole) for hole in listed):
        return 1.0
    return _shares(listed, lengths, counts).reshape(tuple(counts[::-1])) if listed else 1.0


def _shares(holes: Sequence[Hole], lengths: Sequence[float], counts: Sequence[int]) -> FloatArray:
    """Return the part of the area of each element (elements,) outside all holes."""
    steps = np.array(lengths) / counts
    corners = centres_of(lengths, counts) - 0.5 * steps

    def outside(some: FloatArray, number: int) -> FloatArray:
        line = (np.arange(number) + 0.5) / number
        points = np.stack(np.meshgrid(line, line), axis=-1).reshape(-1, 2) * steps
        every = (some[:, None] + points).reshape(-1, 2)
        held = np.zeros(len(every), dtype=bool)
        for hole in holes:
            held |= hole.holds(every)
        return np.asarray(1.0 - held.reshape(some.shape[0], -1).mean(axis=1))

    found = outside(corners, _FEW)
    cut = np.flatnonzero((found > 0) & (found < 1))
    if cut.size:
        found[cut] = outside(corners[cut], _MANY)
    return found


def dofs_of(
    grid: Grid, lengths: Sequence[float], directions: tuple[str, ...], shape: Interpolation
) -> DofSet:
    """Return the DOFs of a grid that begins at the origin; nodes keep their number beside holes."""
    xyz = np.zeros((grid.nodes.size, 3))
    xyz[:, : len(lengths)] = grid.coordinates(lengths)
    return node_dofs(grid.nodes + 1, directions, xyz, shape)


class Skin(NamedTuple):
    """Thickness and material of a plate: numbers, or arrays (ny, nx)."""

    thickness: Any
    density: Any
    youngs_modulus: Any
    poisson_ratio: Any


@dataclass(frozen=True, eq=False, repr=False)
class Rib(Value):
    """A straight beam on a plate, along edges of its elements: bending and St Venant torsion.

    A rectangular rib (`width`, `height`) stands on the plate. Its stiffness and inertia are taken
    about the plate's middle plane, ``I + A e^2`` with its centre at e = (height + thickness) / 2.
    The two are one piece: in torsion the rib reaches through the plate, a rectangle of the height
    ``height + thickness``, which agrees with the tables for T sections.

    The model errs to both sides. The plate has no motion in its plane, with which the neutral plane
    would move up towards the rib: bending along it is too stiff. The plate under the rib is not
    stiffened across it: bending across is too soft, the more the wider the rib. Beside solid
    elements, frequencies of a plate of 300 x 200 x 6 mm with one rib of 10 mm, 6 to 40 mm high,
    differ by -0.5 to 0.6 % in torsion, by up to 7 % in bending along it and -5 % in bending across;
    with a width of 20 mm by up to 13 % and -10 %. Use ribs narrower than twice the thickness, or a
    solid mesh. In a pair of ribs above and below (``eccentricity=0`` and the section of both)
    bending along it is exact.

    Parameters
    ----------
    start, end : (2,) array [m]
        Both at nodes, one line along x or y.
    width, height : float [m]
        Of a rectangular section, or
    area, inertia : float [m^2], [m^4]
        of any section: its area, and the second moment of area for bending out of the plane, about
        its own centre.
    torsion, polar : float [m^4]
        St Venant torsion constant (0 when not given) and polar second moment of area (`inertia`
        when not given) of such a section.
    eccentricity : float [m]
        Distance of the section's centre from the middle plane; with width and height that of a rib
        standing on the plate, otherwise 0 when not given.
    density, youngs_modulus, poisson_ratio : float, optional
        Of its material; that of the plate under it when not given.

    References
    ----------
    Torsion of a rectangle: [TimoshenkoGoodier1970]_, sec. 109 (a fit within 0.5 %): ``J = w^3 h
    (1/3 - 0.21 w/h (1 - (w/h)^4 / 12))`` for w <= h. Of a T section: [YoungBudynas2002]_, table
    10.1, case 26.

    Examples
    --------
    >>> import flexplant as fx
    >>> rib = fx.structure.Rib((0.0, 0.3), (0.6, 0.3), width=0.01, height=0.03)
    """

    start: Sequence[float] = field(metadata=_PLACE)
    end: Sequence[float] = field(metadata=_PLACE)
    width: float | None = field(default=None, kw_only=True, metadata=_SIZE)
    height: float | None = field(default=None, kw_only=True, metadata=_SIZE)
    area: float | None = field(default=None, kw_only=True, metadata=_SIZE)
    inertia: float | None = field(default=None, kw_only=True, metadata=_OR_ZERO)
    torsion: float | None = field(default=None, kw_only=True, metadata=_OR_ZERO)
    polar: float | None = field(default=None, kw_only=True, metadata=_OR_ZERO)
    eccentricity: float | None = field(default=None, kw_only=True, metadata=_OR_ZERO)
    density: float | None = field(default=None, kw_only=True, metadata=_SIZE)
    youngs_modulus: float | None = field(default=None, kw_only=True, metadata=_SIZE)
    poisson_ratio: float | None = field(default=None, kw_only=True, metadata=checked(number))

    def __post_init__(self) -> None:
        super().__post_init__()
        if (self.start[0] == self.end[0]) == (self.start[1] == self.end[1]):
            raise ModelError(
                f"a rib runs along x or along y, got {self.start} to {self.end}. Make an oblique "
                "one of steps, or of a mesh of your own."
            )
        box = (self.width, self.height)
        free = (self.area, self.inertia, self.torsion, self.polar)
        if (None in box or any(n is not None for n in free)) and (
            None in free[:2] or any(n is not None for n in box)
        ):
            raise ModelError(
                "a rib needs its section: width and height, or area and inertia (with torsion and "
                f"polar), got {self._given()}. Give one of the two, complete."
            )
        if self.poisson_ratio is not None:
            poisson_of(self.poisson_ratio, (), (), None)

    def _given(self) -> dict[str, Any]:
        fields = self._fields()
        return {n: v for n, v in fields.items() if v is not None and n not in ("start", "end")}

    def section(self, thickness: FloatArray) -> tuple[float, FloatArray, FloatArray, FloatArray]:
        """Return area, inertia, torsion and polar inertia about the plate's middle plane."""
        if self.width is not None and self.height is not None:
            w, h = self.width, self.height
            # one that does not stand on the plate is not one piece with it
            deep = np.full_like(thickness, h)
            deep += thickness if self.eccentricity is None else 0.0
            thin, long = np.minimum(w, deep), np.maximum(w, deep)
            q = thin / long
            torsion = thin**3 * long * (1 / 3 - 0.21 * q * (1 - q**4 / 12))
            area, inertia = w * h, w * h**3 / 12
            polar, offset = inertia + h * w**3 / 12, 0.5 * (h + thickness)
        else:
            area, inertia = float(self.area or 0.0), float(self.inertia or 0.0)
            torsion = np.full_like(thickness, float(self.torsion or 0.0))
            polar = inertia if self.polar is None else self.polar
            offset = np.zeros_like(thickness)
        if self.eccentricity is not None:
            offset = np.full_like(thickness, self.eccentricity)
        return area, inertia + area * offset**2, torsion, polar + area * offset**2


def rib_matrices(
    grid: Grid, lengths: Sequence[float], skin: Skin, ribs: Sequence[Rib], M: Any, K: Any
) -> tuple[sp.csc_array, sp.csc_array]:
    """Return mass and stiffness of a plate with its ribs."""
    rows, columns, mass, stiffness = [], [], [], []
    for rib in ribs:
        axis, first, second, under = _edges(grid, lengths, rib)
        h = lengths[axis] / grid.counts[axis]
        thickness = _mean_beside_edges(skin.thickness, under)
        own = {
            name: _mean_beside_edges(getattr(skin, name), under)
            if getattr(rib, name) is None
            else np.full(first.size, float(getattr(rib, name)))
            for name in ("density", "youngs_modulus", "poisson_ratio")
        }
        area, inertia, torsion, polar = rib.section(thickness)
        rho, E = own["density"], own["youngs_modulus"]
        G = E / (2 * (1 + own["poisson_ratio"]))
        turn, line = np.array([[1.0, -1], [-1, 1]]) / h, np.array([[2.0, 1], [1, 2]]) * h / 6
        bent_K, bent_M, bent_R = beam_stiffness(h), beam_mass(h), beam_rotary(h)
        # z, the slope along the rib and its twist at both ends
        K6, M6 = np.zeros((first.size, 6, 6)), np.zeros((first.size, 6, 6))
        bend: Any = (slice(None), *np.ix_([0, 1, 3, 4], [0, 1, 3, 4]))
        twist: Any = (slice(None), *np.ix_([2, 5], [2, 5]))
        K6[bend] = (E * inertia)[:, None, None] * bent_K
        K6[twist] = (G * torsion)[:, None, None] * turn
        M6[bend] = (rho * area)[:, None, None] * bent_M
        M6[bend] += (rho * inertia)[:, None, None] * bent_R
        M6[twist] = (rho * polar)[:, None, None] * line
        # along x the slope is -ry and the twist rx; along y the slope is rx and the twist ry
        dof, sign = (([0, 2, 1], -1.0), ([0, 1, 2], 1.0))[axis]
        signs = np.tile([1.0, sign, 1.0], 2)
        index = 3 * grid.rank[np.column_stack([first, second])][:, :, None] + np.array(dof)
        index = index.reshape(-1, 6)
        rows.append(np.repeat(index, 6, axis=1).ravel())
        columns.append(np.tile(index, (1, 6)).ravel())
        mass.append((M6 * np.outer(signs, signs)).ravel())
        stiffness.append((K6 * np.outer(signs, signs)).ravel())
    place = (np.concatenate(rows), np.concatenate(columns))
    found = []
    for matrix, added in ((M, mass), (K, stiffness)):
        more = sp.csc_array((np.concatenate(added), place), shape=matrix.shape)
        total = sp.csc_array(matrix + 0.5 * (more + more.T))
        for part in (total.data, total.indices, total.indptr):
            part.flags.writeable = False
        found.append(total)
    return found[0], found[1]


def _edges(
    grid: Grid, lengths: Sequence[float], rib: Rib
) -> tuple[int, IntArray, IntArray, list[IntArray]]:
    """Return the axis, the nodes at both ends of each edge, and the elements on both sides."""
    counts = np.array(grid.counts)
    place = np.array([rib.start, rib.end]) / np.array(lengths) * counts
    nodes = np.round(place).astype(int)
    if np.abs(place - nodes).max() > TYPED or np.any(nodes < 0) or np.any(nodes > counts):
        steps = (np.array(lengths) / counts).tolist()
        raise ModelError(
            f"{rib!r} does not run from node to node: the nodes are at multiples of "
            f"{steps[0]:.6g} and {steps[1]:.6g} m in x and y, up to {tuple(lengths)} m. Move its "
            "ends, or choose elements= so that nodes are there."
        )
    axis = int(np.argmax(nodes[0] != nodes[1]))
    low, high = np.sort(nodes[:, axis])
    along, across = np.arange(low, high), int(nodes[0, 1 - axis])
    stride = (1, int(counts[0]) + 1)
    first = along * stride[axis] + across * stride[1 - axis]
    sides = []
    for side in (across - 1, across):
        # -1: there is no element on this side
        exists = np.full(along.size, 0 <= side < counts[1 - axis])
        i, j = (along, np.full_like(along, side))[:: 1 if axis == 0 else -1]
        exists &= grid.present[np.where(exists, j, 0), np.where(exists, i, 0)]
        sides.append(np.where(exists, j * counts[0] + i, -1))
    if np.any((sides[0] < 0) & (sides[1] < 0)):
        raise ModelError(
            f"{rib!r} crosses a hole: there is no plate to hold it. End it at the hole's edge."
        )
    return axis, first, first + stride[axis], sides


def _mean_beside_edges(value: Any, sides: list[IntArray]) -> FloatArray:
    """Return the mean of a property over the elements on both sides of each edge."""
    if np.ndim(value) == 0:
        return np.full(sides[0].size, float(value))
    flat = np.asarray(value).ravel()
    there = np.array([side >= 0 for side in sides])
    found = np.array([flat[side] for side in sides])
    return np.asarray(np.sum(found * there, axis=0) / there.sum(axis=0), dtype=np.float64)

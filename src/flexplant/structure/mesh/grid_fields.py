"""What varies over a grid of elements: materials, thicknesses, holes."""

from __future__ import annotations

import functools
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any, TypeAlias

import numpy as np

from ...checks import (
    FloatArray,
    Value,
    positive,
    real_array,
    several,
    short,
    whole,
    why_not_called,
)
from ...errors import ModelError, ShapeError
from ...labels import DofSet, Interpolation
from .element_matrices import Grid

#: one number, an array (nx, ny, ...) with one per element, or a function of an element's centre
Field: TypeAlias = float | Sequence[Any] | FloatArray | Callable[..., float]


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
    >>> fx.Rectangle((0.1, 0.1), (0.2, 0.3)).holds(np.array([[0.15, 0.2], [0.5, 0.5]]))
    array([ True, False])
    """

    lower: Sequence[float]
    upper: Sequence[float]

    def __post_init__(self) -> None:
        lower, upper = real_array(self.lower, "lower", (2,)), real_array(self.upper, "upper", (2,))
        if np.any(upper <= lower):
            raise ModelError(
                f"a rectangle's upper corner must be above its lower one in x and y, got "
                f"{lower.tolist()} and {upper.tolist()}. Swap them, or give it a width."
            )
        self._set(lower=tuple(lower.tolist()), upper=tuple(upper.tolist()))

    def __repr__(self) -> str:
        return f"<Rectangle {self.lower} to {self.upper} m>"

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
    >>> fx.Disc((0.3, 0.3), radius=0.1).holds(np.array([[0.3, 0.35], [0.5, 0.5]]))
    array([ True, False])
    """

    centre: Sequence[float]
    radius: float

    def __post_init__(self) -> None:
        self._set(
            centre=tuple(real_array(self.centre, "centre", (2,)).tolist()),
            radius=positive(self.radius, "radius"),
        )

    def __repr__(self) -> str:
        return f"<Disc of radius {self.radius:g} m about {self.centre} m>"

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
    value: Any,
    name: str,
    lengths: Sequence[float],
    counts: Sequence[int],
    present: Any = None,
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
            f"element's centre, got {short(holes)}. Rectangle((0.1, 0.1), (0.2, 0.2)), say."
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
    times = len(directions)
    return DofSet(
        np.repeat(grid.nodes + 1, times),
        directions * grid.nodes.size,
        np.repeat(xyz, times, axis=0),
        shape,
    )

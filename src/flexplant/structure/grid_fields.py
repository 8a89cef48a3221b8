"""Fields over a grid of elements: material, thickness, missing elements."""

from __future__ import annotations

import functools
from collections.abc import Callable, Sequence
from typing import Any, TypeAlias

import numpy as np

from ..arrays import FloatArray, positive, real_array, whole
from ..errors import ModelError, ShapeError, short
from ..labels import DofSet, Interpolation, node_dofs
from ..words import several, why_not_called
from .element_matrices import Grid

#: one number, an array (nx, ny, ...) with one per element, or a function of an element's centre
Field: TypeAlias = float | Sequence[Any] | FloatArray | Callable[..., float]

#: largest number of elements along one axis that a machine model may have
MOST = 10**6


def lengths_of(size: Any, count: int) -> tuple[float, ...]:
    """Return `count` positive lengths."""
    values = real_array(size, "size", (count,)).tolist()
    return tuple(
        positive(value, f"size in {axis}") for value, axis in zip(values, "xyz", strict=False)
    )


def _field_values(function: Any, name: str, centres: FloatArray) -> list[Any]:
    """Return the values of a user's function at the centres (elements, d)."""
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
            f"{short(elements)}. Pass for example ({', '.join(['8'] * count)})."
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


def poisson_of(value: Any, lengths: Sequence[float], counts: Sequence[int]) -> Any:
    """Return Poisson's ratio: one number, or an array (nz, ny, nx)."""
    if callable(value) or real_array(value, "poisson_ratio").ndim:

        def shifted(item: Any) -> Any:
            if not callable(item):
                return 1.0 + real_array(item, "poisson_ratio")
            if isinstance(item, type):
                return item
            return functools.wraps(item)(lambda *at: 1.0 + item(*at))

        found = field_of(shifted(value), "1 + poisson_ratio", lengths, counts) - 1.0
    else:
        found = float(real_array(value, "poisson_ratio", ()))
    if np.any(found <= -1) or np.any(found >= 0.5):
        worst = np.min(found) if np.any(found <= -1) else np.max(found)
        raise ModelError(
            f"poisson_ratio must be above -1 and below 0.5, got {worst:g}. Give that of "
            "the material, 0.25 to 0.35 for metals; incompressible materials need other elements."
        )
    return found


def present_of(holes: Any, lengths: Sequence[float], counts: Sequence[int]) -> Any:
    """Return which elements exist (nz, ny, nx), None when all do."""
    import scipy.ndimage

    if holes is None:
        return None
    missing = _hole_mask(holes, lengths, counts)
    present = ~missing.reshape(tuple(counts[::-1]))
    if present.all():
        return None
    pieces = scipy.ndimage.label(present)[1]
    if pieces != 1:
        raise ModelError(
            f"the holes leave {pieces} separate pieces of the structure"
            + (", that is nothing at all" if not pieces else "")
            + ": make them smaller, or model the pieces one by one."
        )
    return present


def _hole_mask(holes: Any, lengths: Sequence[float], counts: Sequence[int]) -> Any:
    """Return which elements are missing (elements,), x fastest."""
    if callable(holes):
        centres = centres_of(lengths, counts)
        return np.array([bool(answer) for answer in _field_values(holes, "holes", centres)])
    given = np.asarray(holes)
    if given.dtype != bool:
        raise ModelError(
            f"holes must be a mask of the elements or a function of an element's centre, got "
            f"{short(holes)}. Give True where an element is missing."
        )
    if given.shape != tuple(counts):
        raise ShapeError(
            f"holes must be a mask with one entry for each element, of shape {tuple(counts)}, got "
            f"{given.shape}. Give True where an element is missing."
        )
    return given.T.ravel()


def dofs_of(
    grid: Grid, lengths: Sequence[float], directions: tuple[str, ...], shape: Interpolation
) -> DofSet:
    """Return the DOFs of a grid that begins at the origin; nodes keep their numbers."""
    xyz = np.zeros((grid.nodes.size, 3))
    xyz[:, : len(lengths)] = grid.coordinates(lengths)
    return node_dofs(grid.nodes + 1, directions, xyz, shape)

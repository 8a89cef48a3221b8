"""Curves that lie on one another: lower ones are drawn wider, so that each of them is seen."""

from __future__ import annotations

from itertools import combinations

import numpy as np
from matplotlib.axes import Axes
from matplotlib.lines import Line2D
from scipy.spatial import cKDTree

from ..arrays import FloatArray

#: distance [pixels] below which two curves look like one, and least fraction of the shorter curve
#: within this distance
_NEAR, _MOST = 1.5, 0.8
#: number of points of a curve that are compared, and largest number of compared curves
_POINTS, _CURVES = 1500, 12
#: width [points] by which a lower curve extends on both sides of the one above it
_RIM = 1.3


def widen_hidden(ax: Axes) -> None:
    """Draw each curve that others cover wider than these, where curves have names."""
    lines = [line for line in ax.get_lines() if _is_named_curve(line)][:_CURVES]
    if len(lines) < 2:
        return
    paths = {line: path for line in lines if len(path := _on_paper(ax, line)) > 1}
    covers: dict[Line2D, int] = dict.fromkeys(paths, 0)
    for below, above in combinations(paths, 2):
        same = below.get_zorder() == above.get_zorder()
        if same and _coincide(paths[below], paths[above]):
            covers[below] += 1
    for line, count in covers.items():
        if count:
            line.set_linewidth(line.get_linewidth() + _RIM * count)


def _is_named_curve(line: Line2D) -> bool:
    named = not str(line.get_label()).startswith("_")
    return (
        named
        and line.get_linestyle() not in ("None", "", " ")
        and len(np.asarray(line.get_xydata())) > 2
    )


def _on_paper(ax: Axes, line: Line2D) -> FloatArray:
    """Return points [pixels] in equal steps along the part of a curve that is in the picture."""
    _ = ax.get_xlim(), ax.get_ylim()  # brings the limits up to date, which the transform does not
    with np.errstate(invalid="ignore", divide="ignore"):
        drawn = ax.transData.transform(np.asarray(line.get_xydata(), dtype=float))
    points: FloatArray = np.asarray(drawn, dtype=float)
    points = points[np.isfinite(points).all(axis=1)]
    if len(points) < 2:
        return points
    way = np.concatenate([[0.0], np.cumsum(np.hypot(*np.diff(points, axis=0).T))])
    at = np.linspace(0.0, way[-1], _POINTS)
    points = np.column_stack([np.interp(at, way, values) for values in points.T])
    low, high = ax.bbox.min, ax.bbox.max
    return np.asarray(points[np.all((points >= low) & (points <= high), axis=1)])


def _coincide(one: FloatArray, other: FloatArray) -> bool:
    """Return whether most of the shorter of two curves lies on the other."""
    few, many = sorted((one, other), key=len)
    away, _ = cKDTree(many).query(few)
    step = np.median(np.hypot(*np.diff(many, axis=0).T))
    return bool(np.mean(away <= _NEAR + step / 2) >= _MOST)

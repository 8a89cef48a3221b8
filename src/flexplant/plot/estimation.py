"""Pictures of estimates: what a design predicts, and what a machine has."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np
import numpy.typing as npt
from matplotlib.axes import Axes
from matplotlib.lines import Line2D

from ..errors import ModelError
from ..simulation import EstimatorComparison
from ..values import FloatArray, real_array, scale, short
from ._axes import CYCLE, MEASURED, axes, finish


def predictions(
    rows: Mapping[str, npt.ArrayLike] | Sequence[EstimatorComparison],
    *,
    colors: Mapping[str, str] | None = None,
    unit: str = "m",
    ax: Axes | None = None,
) -> Axes:
    """Draw predicted errors beside those that were found, one line for each design.

    Parameters
    ----------
    rows : sequence of EstimatorComparison, or mapping {design: (k, 4) array}
        Comparisons of the same estimators in k cases; or for each design and case the predicted
        rms error, the one found, and the ends of its confidence interval.
    colors : mapping {design: color}, optional
        Of the diamonds.
    unit : str
        SI unit of the errors; a prefix is chosen.
    ax : Axes, optional
        Where to draw.

    Returns
    -------
    Axes
        Logarithmic; a diamond is a prediction, a black bar what was found.

    Raises
    ------
    ModelError
        When there is no such mapping, or an error is not positive.
    ShapeError
        When a row has not four columns.
    """
    title = ""
    if isinstance(rows, Sequence) and all(isinstance(c, EstimatorComparison) for c in rows):
        title = f" of {rows[0].channel}" if rows else ""
        rows = {name: [case[name] for case in rows] for name in (rows[0].names if rows else ())}
    if not isinstance(rows, Mapping) or not rows:
        raise ModelError(
            f"need a mapping of designs to errors, got {short(rows)}. Type "
            "[comparison] or {'updated': [(predicted, found, lower, upper)]}."
        )
    tables = {name: real_array(row, f"errors of {name!r}", (None, 4)) for name, row in rows.items()}
    if any(np.any(table[:, :2] <= 0) for table in tables.values()):
        raise ModelError("errors must be positive: they are drawn on a logarithmic axis.")
    ax = axes(ax, figsize=(7.0, 3.6))
    factor, prefix = scale(float(np.median([np.median(t[:, 1]) for t in tables.values()])))
    names = list(tables)
    for i, (name, table) in enumerate(tables.items()):
        color = (colors or {}).get(name, CYCLE[i % len(CYCLE)])
        _row(ax, len(names) - 1 - i, table / factor, color)
    ax.set_xscale("log")
    ax.set_yticks(range(len(names)), names[::-1])
    ax.set_ylim(-0.6, len(names) - 0.4)
    ax.legend(
        handles=_legend(), frameon=False, loc="lower center", bbox_to_anchor=(0.5, 1.0), ncols=2
    )
    return finish(ax, x=f"rms error{title} [{prefix}{unit}]", y="")


def _row(ax: Axes, place: float, table: FloatArray, color: str) -> None:
    """Draw one design: bars first, so that the diamonds around them stay visible."""
    predicted, found, low, high = table.T
    ax.hlines(np.full(found.size, place), np.minimum(predicted, found),
              np.maximum(predicted, found), color=color, linewidth=1.0)  # fmt: skip
    bars = np.maximum(np.array([found - low, high - found]), 0.0)
    ax.errorbar(found, np.full(found.size, place), xerr=bars, fmt="|", color=MEASURED, capsize=4,
                markersize=14, markeredgewidth=2.0)  # fmt: skip
    ax.plot(predicted, np.full(found.size, place), "D", color=color, fillstyle="none",
            markersize=9, markeredgewidth=2.0)  # fmt: skip


def _legend() -> Sequence[Line2D]:
    diamond = {"marker": "D", "fillstyle": "none", "linestyle": "", "color": "0.4"}
    bar = {"marker": "|", "linestyle": "", "color": MEASURED, "markersize": 12}
    return (
        Line2D([], [], label="predicted by the design", **diamond),  # type: ignore[arg-type]
        Line2D([], [], label="on the machine, 95 %", markeredgewidth=2.0, **bar),  # type: ignore[arg-type]
    )

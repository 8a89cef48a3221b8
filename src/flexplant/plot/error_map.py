"""Pictures of the error over a wafer."""

from __future__ import annotations

from matplotlib.axes import Axes

from ..errors import ModelError
from ..simulation import ErrorMap
from ..values import in_unit, instance, short
from ._axes import axes, legend_below, named, plan
from ._style import RED


def error_map(found: ErrorMap, *, what: str = "ma", ax: Axes | None = None) -> Axes:
    """Draw the error over a wafer, seen from above.

    Parameters
    ----------
    found : ErrorMap
        From `flexplant.simulation.error_map`; points that span an area.
    what : str
        "ma" or "msd".
    ax : Axes, optional
        Where to draw.

    Returns
    -------
    Axes
        Filled contours, the worst point marked.

    Raises
    ------
    ModelError
        When `found` is no ErrorMap, has fewer than three points, or `what` is neither.

    Examples
    --------
    >>> import flexplant as fx
    >>> import numpy as np
    >>> points = np.array([(0.0, 0.0, 0.0), (0.3, 0.0, 0.0), (0.0, 0.3, 0.0), (0.3, 0.3, 0.0)])
    >>> ma, msd = np.array([3e-9, 2e-9, 2e-9, 1e-9]), np.full(4, 1e-9)
    >>> found = fx.simulation.ErrorMap("z", "m", points, ma, msd, window=5e-3)
    >>> fx.plot.error_map(found).get_xlabel()
    'x [mm]'
    """
    instance(found, ErrorMap, "found", "Pass what error_map returned.")
    if what not in ("ma", "msd"):
        raise ModelError(f"what must be 'ma' or 'msd', got {short(what)}. Pass one of them.")
    if len(found.points) < 3:
        raise ModelError("a picture needs at least three points that span an area: add some.")
    ax = axes(ax, figsize=(6.0, 5.0))
    values = found.ma if what == "ma" else found.msd
    factor, unit = in_unit(float(values.max()), found.unit)
    x, y = found.points[:, :2].T / plan(ax, found.points)
    contours = ax.tricontourf(x, y, values / factor, levels=20, cmap="viridis")
    label = f"{what.upper()} of the error along {found.axis}"
    ax.figure.colorbar(contours, ax=ax, label=named(label, unit))
    ax.plot(x, y, ".", color="white", markersize=2.0)
    worst = int(values.argmax())
    ax.plot(x[worst], y[worst], "x", color=RED, markersize=10, label="worst point")
    legend_below(ax)
    return ax

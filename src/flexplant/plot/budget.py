"""Pictures of error budgets."""

from __future__ import annotations

from typing import Any

import numpy as np
from matplotlib.axes import Axes

from ..errors import counted
from ..loop import ErrorBudget
from ..values import in_unit, instance, with_unit
from ._axes import axes, finish, named
from ._style import CYCLE

#: of the areas, which differ without colour too
_HATCHES = ("", "//", "", "\\\\", "", "..")
_BESIDE: dict[str, Any] = {"loc": "center left", "bbox_to_anchor": (1.0, 0.5)}


def budget(found: ErrorBudget, *, most: int = 5, ax: Axes | None = None) -> Axes:
    """Draw the cumulative spectra of an error budget as stairs, one source upon the other.

    Each area is the variance that a source has below a frequency; they end at the shares of the
    budget, the top at the square of the rms.

    Parameters
    ----------
    found : ErrorBudget
        From `ClosedLoop.budget`.
    most : int
        Sources that are drawn by themselves, the largest first; the others are one area.
    ax : Axes, optional
        Where to draw.

    Returns
    -------
    Axes

    Raises
    ------
    ModelError
        When it is no ErrorBudget.

    Examples
    --------
    >>> import flexplant as fx
    >>> plant = fx.testbeds.three_masses()
    >>> observer = fx.design_kalman(plant)
    >>> servo = fx.design_servo(plant, bandwidth=20.0, observer=observer)
    >>> ax = fx.plot.budget(fx.close_loop(plant, observer, servo).budget("die:x"))
    >>> ax.get_xlabel()
    'frequency [Hz]'
    """
    instance(found, ErrorBudget, "found", "Pass loop.budget(channel).")
    given, ax = ax is not None, axes(ax, figsize=(9.0, 4.0))
    order = [int(i) for i in np.argsort(-found.variances, kind="stable")]
    shown, rest = order[: max(most, 1)], order[max(most, 1) :]
    factor, unit = in_unit(found.rms, found.unit)
    # from where a thousandth of the variance has come
    low = found.cumulative.sum(axis=0) < 1e-3 * found.variances.sum()
    inside = np.isfinite(found.freq) & (found.freq > 0) & ~low
    freq, stairs = found.freq[inside], found.cumulative[:, inside] / factor**2
    layers = [(found.names[i], stairs[i], found[found.names[i]]) for i in shown]
    if rest:
        others = float(np.sqrt(found.variances[rest].sum()))
        layers.append((f"{counted(len(rest), 'other')}", stairs[rest].sum(axis=0), others))
    base = np.zeros(freq.size)
    for i, (name, rows, rms) in enumerate(layers):
        ax.fill_between(
            freq,
            base,
            base + rows,
            facecolor=CYCLE[i % len(CYCLE)]["color"],
            hatch=_HATCHES[i % len(_HATCHES)],
            alpha=0.75,
            edgecolor="white",
            linewidth=0.8,
            label=f"{name}: {with_unit(rms, found.unit)} rms",
        )
        base = base + rows
    ax.set(xscale="log", ylim=(0.0, None))
    where = {"loc": "upper left"} if given else _BESIDE
    ax.legend(reverse=True, frameon=False, **where)  # the uppermost area comes first
    total = f"{found.channel}: {with_unit(found.rms, found.unit)} rms"
    squared = f"({unit})^2" if set(unit) & set(" /") else f"{unit}^2" if unit else ""
    label = named("variance below the frequency", squared)
    return finish(ax, x="frequency [Hz]", y=label, title=total)

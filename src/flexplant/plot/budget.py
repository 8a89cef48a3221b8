"""Pictures of error budgets."""

from __future__ import annotations

import numpy as np
from matplotlib.axes import Axes

from ..loop import ErrorBudget
from ..values import instance, scale
from ._axes import CYCLE, axes, finish


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
    """
    instance(found, ErrorBudget, "found", "Pass loop.budget(channel).")
    ax = axes(ax, figsize=(7.0, 4.0))
    order = [int(i) for i in np.argsort(-found.variances, kind="stable")]
    shown, rest = order[: max(most, 1)], order[max(most, 1) :]
    factor, prefix = scale(found.rms) if found.unit else (1.0, "")
    # from where a thousandth of the variance has come
    low = found.cumulative.sum(axis=0) < 1e-3 * found.variances.sum()
    inside = np.isfinite(found.freq) & (found.freq > 0) & ~low
    freq, stairs = found.freq[inside], found.cumulative[:, inside] / factor**2
    layers = [(found.names[i], stairs[i], found[found.names[i]]) for i in shown]
    if rest:
        others = float(np.sqrt(found.variances[rest].sum()))
        layers.append((f"{len(rest)} others", stairs[rest].sum(axis=0), others))
    base = np.zeros(freq.size)
    for i, (name, rows, rms) in enumerate(layers):
        ax.fill_between(
            freq,
            base,
            base + rows,
            color=CYCLE[i % len(CYCLE)],
            alpha=0.75,
            linewidth=0.0,
            label=f"{name}: {rms / factor:.3g} {prefix}{found.unit}",
        )
        base = base + rows
    ax.set(xscale="log", ylim=(0.0, None))
    ax.legend(frameon=False, loc="upper left")
    unit = f"[({prefix}{found.unit})$^2$]" if found.unit else ""
    total = f"{found.channel}: {found.rms / factor:.4g} {prefix}{found.unit} rms"
    return finish(ax, x="frequency [Hz]", y=f"variance below the frequency {unit}", title=total)

"""Pictures of an update: how eigenvalues, residual and parameters converge."""

from __future__ import annotations

import numpy as np
from matplotlib.axes import Axes

from ..updating import UpdateResult
from ..values import ComplexArray
from ._axes import CYCLE, MEASURED, UPDATED, axes, finish


def eigenvalues(fit: UpdateResult, measured: ComplexArray, *, ax: Axes | None = None) -> Axes:
    """Draw how the model's eigenvalues reach the measured ones (paper, Fig. 7).

    Parameters
    ----------
    fit : UpdateResult
        The update.
    measured : (m,) complex array [rad/s]
        The measured eigenvalues, in the same order.
    ax : Axes, optional
        Where to draw.

    Returns
    -------
    Axes
        Distance to the measured eigenvalue [rad/s] over iterations, on a log scale.
    """
    ax = axes(ax, figsize=(7.0, 4.0))
    steps = np.arange(len(fit.history) + 1)
    goal = np.asarray(measured)
    for i in range(goal.size):
        gap = fit.history.eigenvalues[:, i] - goal[i]
        for part, style, values in (("Re", "--", gap.real), ("Im", "-", gap.imag)):
            ax.semilogy(
                steps,
                np.maximum(np.abs(values), 1e-13 * abs(goal[i])),
                style,
                marker="o",
                color=CYCLE[i % len(CYCLE)],
                label=f"{part}, measured {goal[i]:.1f} rad/s",
            )
    ax.legend(frameon=False)
    ax.set_xticks(steps)
    return finish(ax, x="iteration", y="distance to measured [rad/s]")


def residual(fit: UpdateResult, *, ax: Axes | None = None) -> Axes:
    """Draw the sum of squared residuals over iterations, e_i of equation (12) (paper, Fig. 8).

    Parameters
    ----------
    fit : UpdateResult
        The update.
    ax : Axes, optional
        Where to draw.

    Returns
    -------
    Axes
    """
    ax = axes(ax, figsize=(7.0, 4.0))
    steps = np.arange(len(fit.history) + 1)
    error = np.maximum(fit.history.error, 1e-300)
    ax.semilogy(steps, error, "o-", color=UPDATED)
    ax.set_xticks(steps)
    return finish(ax, x="iteration", y="sum of squared residuals")


def parameters(
    fit: UpdateResult, *, truth: dict[str, float] | None = None, axs: list[Axes] | None = None
) -> list[Axes]:
    """Draw the parameters over iterations (paper, Fig. 9), one axes each.

    Parameters
    ----------
    fit : UpdateResult
        The update.
    truth : dict, optional
        True values to draw as black lines.
    axs : list of Axes, optional
        Where to draw, one for each parameter.

    Returns
    -------
    list of Axes
    """
    drawn = []
    steps = np.arange(len(fit.history) + 1)
    for i, name in enumerate(fit.parameters):
        ax = axes(None if axs is None else axs[i], figsize=(6.0, 3.5))
        ax.plot(steps, fit.history.parameters[:, i], "o-", color=CYCLE[i])
        if truth is not None and name in truth:
            ax.axhline(truth[name], color=MEASURED, linewidth=0.9)
        ax.set_xticks(steps)
        drawn.append(finish(ax, x="iteration", y=f"{name} [{fit.units[i]}]"))
    return drawn

"""Pictures of an update: how eigenvalues, residual and parameters converge."""

from __future__ import annotations

import numpy as np
from matplotlib.axes import Axes

from ..updating import UpdateResult
from ..values import ComplexArray
from ._axes import axes, finish, legend, named, shown_in
from ._style import BLUE, CYCLE, STYLES


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
        Distance of the real and the imaginary part to the measured one [rad/s] over iterations, on
        a log scale.

    Examples
    --------
    >>> import flexplant as fx
    >>> modes = fx.solve_modes(fx.chain(masses=[1.0, 1.0, 1.0], stiffnesses=[4e5, 4e5]), count=3)
    >>> drawing = fx.reduce(modes, fx.DesiredDofs(["1:x", "2:x", "3:x"]))
    >>> measured = fx.MeasuredModes(poles=[615.0j], modes=[2])
    >>> fit = fx.update(drawing, [fx.AddedMass("3:x")], [fx.Eigenvalues(measured)])
    >>> fx.plot.eigenvalues(fit, measured.poles).get_ylabel()
    'distance to the measured eigenvalue [rad/s]'
    """
    given, ax = ax is not None, axes(ax, figsize=(9.0, 4.0))
    steps = np.arange(len(fit.history) + 1)
    goal = np.asarray(measured)
    for i in range(goal.size):
        gap = fit.history.eigenvalues[:, i] - goal[i]
        for part, style, values in (("Re", "--", gap.real), ("Im", "-", gap.imag)):
            ax.semilogy(
                steps,
                np.maximum(np.abs(values), 1e-13 * abs(goal[i])),
                style,
                marker="os^D"[i % 4],
                color=CYCLE[i % len(CYCLE)]["color"],
                label=f"{part} of {goal[i]:.1f} rad/s",
            )
    legend(ax, given=given)
    ax.set_xticks(steps)
    return finish(ax, x="iteration", y="distance to the measured eigenvalue [rad/s]")


def residual(fit: UpdateResult, *, ax: Axes | None = None) -> Axes:
    """Draw how far the model is from the measurement over iterations (paper, eq. (12), Fig. 8).

    Parameters
    ----------
    fit : UpdateResult
        The update.
    ax : Axes, optional
        Where to draw.

    Returns
    -------
    Axes
        The sum of squares of all differences between model and measurement, each divided by its
        standard deviation where that is known.

    Examples
    --------
    >>> import flexplant as fx
    >>> modes = fx.solve_modes(fx.chain(masses=[1.0, 1.0, 1.0], stiffnesses=[4e5, 4e5]), count=3)
    >>> drawing = fx.reduce(modes, fx.DesiredDofs(["1:x", "2:x", "3:x"]))
    >>> measured = fx.MeasuredModes(poles=[615.0j], modes=[2])
    >>> fit = fx.update(drawing, [fx.AddedMass("3:x")], [fx.Eigenvalues(measured)])
    >>> ax = fx.plot.residual(fit)
    >>> len(ax.get_lines()) > 0
    True
    """
    ax = axes(ax, figsize=(7.0, 4.0))
    steps = np.arange(len(fit.history) + 1)
    error = np.maximum(fit.history.error, 1e-300)
    ax.semilogy(steps, error, "o-", color=BLUE)
    ax.set_xticks(steps)
    return finish(ax, x="iteration", y=error_label(fit))


def parameters(
    fit: UpdateResult, *, truth: dict[str, float] | None = None, axs: list[Axes] | None = None
) -> list[Axes]:
    """Draw the parameters over iterations (paper, Fig. 9), one axes each.

    Parameters
    ----------
    fit : UpdateResult
        The update.
    truth : dict, optional
        True values, drawn as wide lines.
    axs : list of Axes, optional
        Where to draw, one for each parameter.

    Returns
    -------
    list of Axes

    Examples
    --------
    >>> import flexplant as fx
    >>> modes = fx.solve_modes(fx.chain(masses=[1.0, 1.0, 1.0], stiffnesses=[4e5, 4e5]), count=3)
    >>> drawing = fx.reduce(modes, fx.DesiredDofs(["1:x", "2:x", "3:x"]))
    >>> measured = fx.MeasuredModes(poles=[615.0j], modes=[2])
    >>> fit = fx.update(drawing, [fx.AddedMass("3:x")], [fx.Eigenvalues(measured)])
    >>> axs = fx.plot.parameters(fit)
    >>> len(axs)
    1
    """
    drawn = []
    steps = np.arange(len(fit.history) + 1)
    for i, name in enumerate(fit.parameters):
        ax = axes(None if axs is None else axs[i], figsize=(6.0, 3.5))
        values, given = fit.history.parameters[:, i], axs is not None
        factor, unit = shown_in(ax.yaxis, float(np.max(np.abs(values))), fit.units[i])
        if truth is not None and name in truth:
            ax.axhline(truth[name] / factor, label="true value", **STYLES["truth"])
        ax.plot(steps, values / factor, "o-", color=BLUE, label="estimate")
        ax.set_xticks(steps)
        if truth is not None:
            legend(ax, given=given)
        drawn.append(finish(ax, x="iteration", y=named(name, unit)))
    return drawn


def error_label(fit: UpdateResult) -> str:
    """Return the label of an update's error: in units of the noise where that is known."""
    unit = "SI units squared" if fit.chi2 is None else "-"
    return f"sum of squares,\nmodel less measured [{unit}]"

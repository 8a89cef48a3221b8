"""Pictures of an update and of a localisation: explained misfit and parameters."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import matplotlib.pyplot as plt
import numpy as np
from matplotlib.axes import Axes
from matplotlib.ticker import MaxNLocator

from ..arrays import ComplexArray, FloatArray, instance
from ..errors import ModelError, counted, in_unit, with_unit
from ..labels import DofSet
from ..lti.frequency import Frf
from ..tolerances import TINY
from ..updating import Correlation, FrfResidual, Localisation, Residual, UpdateResult, correlate
from ..updating.parameters import Parameter, PointParameter
from ..updating.search import Objective
from ._axes import (
    BLUE,
    CYCLE,
    GREY,
    LIGHT,
    LISTED,
    POINTS,
    RED,
    STYLES,
    TOGETHER,
    axes,
    bottom_only,
    finish,
    legend,
    legend_below,
    named,
    panel_axes,
    plan,
    shown_in,
)

#: colours of chosen candidates, of indistinguishable and hardly distinguishable ones, and of others
COLOURS = {"chosen": RED, "alike": BLUE, "rival": GREY, "other": LIGHT}


def localisation(
    found: Localisation,
    *,
    candidates: Sequence[Parameter] | None = None,
    dofs: DofSet | None = None,
    ax: Axes | None = None,
) -> Axes:
    """Draw the fraction of the misfit that each candidate explains separately.

    Parameters
    ----------
    found : Localisation
        Result of `localise`.
    candidates : sequence of Parameter, optional
        Candidates that were given to `localise`. Together with `dofs` they give a plan view of the
        candidates at their places.
    dofs : DofSet, optional
        DOFs of the model.
    ax : Axes, optional
        Axes to draw on; by default those of a new figure.

    Returns
    -------
    Axes
        Bars of the best candidates; or places in x and y [m], coloured by the explained fraction.

    Raises
    ------
    ModelError
        When `found` is not a Localisation, or candidates do not belong to it.

    Examples
    --------
    >>> import flexplant as fx
    >>> modes = fx.solve_modes(fx.chain(masses=[1.0, 1.0, 1.0], stiffnesses=[4e5, 4e5]), count=3)
    >>> drawing = fx.reduce(modes, fx.DesiredDofs(["1:x", "2:x", "3:x"]))
    >>> measured = fx.MeasuredModes(poles=[615.0j], modes=[2])
    >>> masses = [fx.AddedMass(place) for place in drawing.dofs.labels]
    >>> found = fx.updating.localise(drawing, masses, [fx.Eigenvalues(measured)], most=1)
    >>> fx.plot.localisation(found).get_xlabel()
    'of the misfit explained alone [%]'
    """
    instance(found, Localisation, "found", "Pass what localise returned.")
    if (candidates is None) != (dofs is None):
        raise ModelError("a plan view needs both, candidates= and dofs=.")
    if candidates is None or dofs is None:
        return _bars(found, ax)
    if tuple(q.name for q in candidates) != found.candidates:
        raise ModelError("candidates must be those given to localise, in its order.")
    return _plan(found, candidates, dofs, ax)


def _candidate_kind(found: Localisation, name: str) -> str:
    if name in found.chosen:
        return "chosen"
    if len(found.alike) > 1 and name in found.alike:
        return "alike"
    return "rival" if name in found.rivals else "other"


def _bars(found: Localisation, ax: Axes | None) -> Axes:
    names = found.leading
    ax = axes(ax, figsize=(7.0, 0.8 + 0.33 * len(names)))
    rows = np.arange(len(names))
    kinds = [_candidate_kind(found, name) for name in names]
    for kind, colour in COLOURS.items():
        mine = [i for i in rows.tolist() if kinds[i] == kind]
        if mine:
            share = [100 * found[names[i]] for i in mine]
            ax.barh(mine, share, color=colour, label=kind, height=0.7)
    for i, name in enumerate(names):
        at = found.candidates.index(name)
        value, unit = float(found.values[at]), found.units[at] if found.units else ""
        if np.isfinite(value):
            ax.text(1.0, i, f" {with_unit(value, unit)} alone", va="center", fontsize=8)
    ax.set_yticks(rows, names)
    ax.invert_yaxis()
    ax.set_xlim(0, 105)
    ax.legend(loc="upper center", bbox_to_anchor=(0.5, -0.16), ncols=4, frameon=False)
    return finish(ax, x="of the misfit explained alone [%]", y="")


def _plan(
    found: Localisation, candidates: Sequence[Parameter], dofs: DofSet, ax: Axes | None
) -> Axes:
    ax = axes(ax, figsize=(6.4, 5.4))
    factor = plan(ax, dofs.xyz)
    nodes = np.unique(dofs.xyz[:, :2], axis=0) / factor
    ax.plot(*nodes.T, ".", color=LIGHT, markersize=3, zorder=1)
    placed = [(q, _xy(q, dofs)) for q in candidates if isinstance(q, PointParameter)]
    if not placed:
        raise ModelError("no candidate acts at a place: leave dofs= out for bars.")
    xy = np.array([where for _, where in placed]) / factor
    share = np.array([100 * found[q.name] for q, _ in placed])
    order = np.argsort(share)
    dots = ax.scatter(
        xy[order, 0], xy[order, 1], c=share[order], s=60, cmap="viridis", vmin=0, zorder=2
    )
    ax.figure.colorbar(dots, ax=ax, label="of the misfit explained alone [%]")
    for kind, marker in (("chosen", "*"), ("alike", "o"), ("rival", "s")):
        mine = [i for i, (q, _) in enumerate(placed) if _candidate_kind(found, q.name) == kind]
        if mine:
            ax.scatter(
                xy[mine, 0], xy[mine, 1], marker=marker, s=260, zorder=3, label=kind,
                facecolors="none", edgecolors=COLOURS[kind], linewidths=1.8,
            )  # fmt: skip
    legend_below(ax)
    return ax


def _xy(parameter: PointParameter, dofs: DofSet) -> FloatArray:
    """Return the place of a parameter, the mean of the places of its weights."""
    at = parameter.at
    if isinstance(at, str):
        return np.asarray(dofs.location(at)[:2])
    if isinstance(at, tuple):
        return np.asarray(at[:2])
    row = np.abs(dofs.row(at, parameter.direction))
    return np.asarray(row @ dofs.xyz[:, :2] / row.sum())


def update(
    fit: UpdateResult,
    before: Any,
    residuals: Sequence[Residual],
    *,
    unused: Frf | FrfResidual | None = None,
    level: float = 0.95,
) -> dict[str, Axes]:
    """Draw all results of an update on one page.

    Parameters
    ----------
    fit : UpdateResult
        Result of `fx.update`.
    before : ReducedModel or FEModel
        The model that was updated.
    residuals : sequence of Residual
        Residuals of the update, or other measurements by which it is judged.
    unused : Frf or FrfResidual, optional
        Measured response that was not fitted. It is drawn instead of the response in `residuals`.
        Give an FrfResidual if the channels of the response are not named by DOFs, or if the
        response contains a zero-order hold.
    level : float
        Level of the confidence intervals.

    Returns
    -------
    dict of Axes
        Axes by name. `parameters` shows the estimates with intervals, and the priors in grey; each
        parameter has a row with a separate axis. `convergence` shows the residual over iterations.
        If poles are given, `frequencies` and `damping` show their errors before and after the
        update. If shapes are given, there are `mac before` and `mac after`. If responses are given,
        `response` shows the measured one, and those of the model before and after the update.

    Raises
    ------
    ModelError
        When `fit` is not an UpdateResult, or a residual does not fit the model.

    Examples
    --------
    >>> import flexplant as fx
    >>> modes = fx.solve_modes(fx.chain(masses=[1.0, 1.0, 1.0], stiffnesses=[4e5, 4e5]), count=3)
    >>> drawing = fx.reduce(modes, fx.DesiredDofs(["1:x", "2:x", "3:x"]))
    >>> measured = fx.MeasuredModes(poles=[615.0j], modes=[2])
    >>> residuals = [fx.Eigenvalues(measured)]
    >>> fit = fx.update(drawing, [fx.AddedMass("3:x")], residuals)
    >>> sorted(fx.plot.update(fit, drawing, residuals))
    ['convergence', 'damping', 'frequencies', 'parameters']
    """
    instance(fit, UpdateResult, "fit", "Pass what update returned.")
    old, new = correlate(before, residuals), correlate(fit.model, residuals)
    names = ["frequencies", "damping"] if old.modes else []
    names += ["mac before", "mac after"] if old.mac.size else []
    names += ["parameters", "convergence"]
    shown = [r for r in residuals if isinstance(r, FrfResidual)]
    if isinstance(unused, FrfResidual):
        shown = [unused]
    elif unused is not None:
        shown = [FrfResidual(unused, lines=np.flatnonzero(unused.freq > 0))]
    rows: Any = [names[i : i + 2] for i in range(0, len(names), 2)]
    if shown:
        rows.append(["response", "response"])
    heights = [3.2] * len(rows)
    heights[names.index("parameters") // 2] += 0.45 * max(min(len(fit.parameters), LISTED) - 4, 0)
    figure, drawn = plt.subplot_mosaic(
        rows, figsize=(11.5, sum(heights)), height_ratios=heights, layout="constrained"
    )
    axs: dict[str, Axes] = dict(drawn)
    if old.modes:
        _draw_errors(axs["frequencies"], old, old.freq_error, new.freq_error, "frequency")
        _draw_errors(axs["damping"], old, old.zeta_error, new.zeta_error, "damping ratio")
    for name, seen in (("mac before", old), ("mac after", new)):
        if name in axs:
            _mac(axs[name], seen, name)
    _parameters(axs["parameters"], fit, level)
    _convergence(axs["convergence"], fit, "convergence")
    if shown:
        _draw_responses(axs["response"], shown[-1], before, fit.model)
    said = "converged" if fit.converged else "NOT CONVERGED"
    figure.suptitle(f"update: {said} in {counted(len(fit.history), 'step')} ({fit.reason})")
    return axs


def _draw_errors(ax: Axes, seen: Correlation, old: FloatArray, new: FloatArray, what: str) -> None:
    place = np.arange(len(seen.modes))
    unit = 100.0
    ax.bar(place - 0.2, unit * old, 0.38, color=GREY, label="before")
    # the edge of a bar is visible even if its height is near 0
    ax.bar(place + 0.2, unit * new, 0.38, color=BLUE, edgecolor=BLUE, linewidth=2.0, label="after")
    for x, value in zip(place + 0.2, unit * new, strict=True):
        side, off = ("bottom", 2) if value >= 0 else ("top", -2)
        ax.annotate(
            f"{value:.1g}", (float(x), float(value)), (0, off), textcoords="offset points",
            ha="center", va=side, fontsize=7, color=BLUE,
            bbox={"facecolor": "white", "edgecolor": "none", "alpha": 0.8, "pad": 0.5},
        )  # fmt: skip
    ax.axhline(0.0, color="0.3", linewidth=0.8)
    ax.margins(y=0.2)
    ax.set_xticks(place, [str(number) for number in seen.modes])
    # one legend serves both
    kind, given = ("%", None) if what == "frequency" else ("percentage points", False)
    finish(ax, x="mode", y=f"error [{kind}]", title=f"{what}, model minus measured", given=given)


def _mac(ax: Axes, seen: Correlation, name: str) -> None:
    image = ax.imshow(seen.mac, vmin=0.0, vmax=1.0, cmap="Blues", aspect="auto")
    if name == "mac after":  # one colour bar serves both
        ax.figure.colorbar(image, ax=ax, label="MAC [-]")
    place = np.arange(len(seen.modes))
    if len(seen.modes) <= 12:
        for i, row in enumerate(seen.mac):
            for j, value in enumerate(row):
                ink = "white" if value > 0.6 else "black"
                ax.text(j, i, f"{value:.2f}", ha="center", va="center", color=ink, fontsize=7)
    labels = [str(number) for number in seen.modes]
    ax.set_xticks(place, labels)
    ax.set_yticks(place, labels)
    title = name.replace("mac", "MAC")
    if seen.alike:
        shown = "; ".join(", ".join(map(str, group)) for group in seen.alike[:3])
        more = "; ..." if len(seen.alike) > 3 else ""
        title += f"\nthe sensors cannot distinguish {shown}{more}"
    ax.set(xlabel="mode of the model", ylabel="measured mode", title=title)


def _parameters(ax: Axes, fit: UpdateResult, level: float) -> None:
    """Draw each parameter in a row with its own axis: estimate, interval, prior, start."""
    count = min(len(fit.parameters), LISTED)
    half = np.zeros(len(fit.values))
    if fit.std is not None:
        half = fit.interval(level)[:, 1] - fit.values
    ax.set_axis_off()
    for i in range(count):
        row = ax.inset_axes((0.0, 1.0 - (i + 0.62) / count, 1.0, 0.4 / count))
        prior = getattr(fit.unknowns[i], "prior", None) if fit.unknowns else None
        factor, unit = in_unit(abs(float(fit.values[i])) + half[i], fit.units[i])
        if prior is not None:
            ends = (prior[0] - 1.96 * prior[1]) / factor, 3.92 * prior[1] / factor
            row.barh(0.0, ends[1], 1.2, left=ends[0], color=LIGHT, label="prior, 95 %")
        row.axvline(0.0, color=GREY, linewidth=1.6, label="before")
        bar = None if fit.std is None else [half[i] / factor]
        text = f"after, bar: {100 * level:g} %"
        row.errorbar(
            [fit.values[i] / factor], [0.0], xerr=bar, fmt="o", color=BLUE, capsize=4, label=text
        )
        row.set(ylim=(-1.0, 1.0), yticks=[])
        row.margins(x=0.08)
        row.tick_params(labelsize=7)
        spread = "" if fit.std is None else f" \N{PLUS-MINUS SIGN} {fit.std[i] / factor:.1g}"
        edge = ", AT ITS BOUND" if fit.parameters[i] in fit.at_bound else ""
        text = f"{fit.parameters[i]}: {fit.values[i] / factor:.4g}{spread} {unit}{edge}"
        row.set_title(text, fontsize=8, loc="left", pad=2.0)
    handles, texts = row.get_legend_handles_labels()
    place: Any = {"loc": "upper center", "bbox_to_anchor": (0.5, 0.0), "ncols": 3}
    ax.legend(handles, texts, frameon=False, **place)
    more = len(fit.parameters) - count
    title = "parameters, \N{PLUS-MINUS SIGN} one standard deviation"
    ax.set_title(title + (f" ({more} more not drawn)" if more else ""), pad=16)


def _convergence(ax: Axes, fit: UpdateResult, title: str = "") -> Axes:
    """Draw the error of an update over iterations, in units of the noise where that is known."""
    steps = np.arange(len(fit.history) + 1)
    ax.semilogy(steps, np.maximum(fit.history.error, TINY), "o-", color=BLUE, markersize=4)
    ax.xaxis.set_major_locator(MaxNLocator(integer=True))
    unit = "SI units squared" if fit.chi2 is None else "-"
    y = f"sum of squares,\nmodel less measured [{unit}]"
    return finish(ax, x="iteration", y=y, title=title)


def _draw_responses(ax: Axes, residual: FrfResidual, before: Any, after: Any) -> None:
    frf, lines = residual.measured, residual.lines
    freq = frf.freq[lines]
    # the pair of channels that was measured strongest
    strength = np.sum(np.abs(frf.data) ** 2, axis=2)
    o, i = (int(k) for k in np.unravel_index(np.argmax(strength), strength.shape))
    size = np.abs(frf.data[o, i, lines])
    factor, shown = shown_in(ax.yaxis, float(size.max()), frf.unit(frf.outputs[o], frf.inputs[i]))
    ax.semilogy(freq, size / factor, label="measured", **POINTS)
    for label, model in (("before", before), ("after", after)):
        objective = Objective(model, [], [residual])
        tied: Any = objective.bounds[0]
        H = tied.responses(objective.begin(np.zeros(0)))[:, o, i]
        look = STYLES["nominal" if label == "before" else "model"]
        ax.semilogy(freq, np.abs(H) / factor, label=label, **look)
    name = f"|{frf.outputs[o]} / {frf.inputs[i]}|"
    finish(ax, x="frequency [Hz]", y=named(name, shown), title="response", given=False)


def eigenvalues(fit: UpdateResult, measured: ComplexArray, *, ax: Axes | None = None) -> Axes:
    """Draw the convergence of the eigenvalues to the measured ones ([paper]_, Fig. 7).

    Parameters
    ----------
    fit : UpdateResult
        Result of `fx.update`.
    measured : (m,) complex array [rad/s]
        Measured eigenvalues, in the order of the eigenvalues of `fit`.
    ax : Axes, optional
        Axes to draw on; by default those of a new figure.

    Returns
    -------
    Axes
        Logarithmic axes with the distances of real and imaginary parts from the measured ones
        [rad/s] over iterations.

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
                # exact values need a place on a logarithmic axis
                np.maximum(np.abs(values), 1e-13 * abs(goal[i])),
                style,
                marker="os^D"[i % 4],
                color=CYCLE[i % len(CYCLE)]["color"],
                label=f"{part} of {goal[i]:.1f} rad/s",
            )
    ax.set_xticks(steps)
    y = "distance to the measured eigenvalue [rad/s]"
    return finish(ax, x="iteration", y=y, given=given)


def residual(fit: UpdateResult, *, ax: Axes | None = None) -> Axes:
    """Draw the distance of model and measurement over iterations ([paper]_, eq. (12), Fig. 8).

    Parameters
    ----------
    fit : UpdateResult
        Result of `fx.update`.
    ax : Axes, optional
        Axes to draw on; by default those of a new figure.

    Returns
    -------
    Axes
        Axes with the sum of squared differences between model and measurement, each divided by its
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
    return _convergence(axes(ax, figsize=(7.0, 4.0)), fit)


def parameters(
    fit: UpdateResult, *, truth: dict[str, float] | None = None, axs: list[Axes] | None = None
) -> list[Axes]:
    """Draw the parameters over iterations ([paper]_, Fig. 9), each on separate axes of one figure.

    Parameters
    ----------
    fit : UpdateResult
        Result of `fx.update`.
    truth : dict, optional
        True values, drawn as wide lines.
    axs : list of Axes, optional
        Axes, one for each parameter.

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
    panels = panel_axes(None, len(fit.parameters)) if axs is None else axs
    many = axs is None and len(fit.parameters) > TOGETHER
    steps = np.arange(len(fit.history) + 1)
    for i, (name, ax) in enumerate(zip(fit.parameters, panels, strict=False)):
        values = fit.history.parameters[:, i]
        factor, unit = shown_in(ax.yaxis, float(np.max(np.abs(values))), fit.units[i])
        if truth is not None and name in truth:
            ax.axhline(truth[name] / factor, label="true value", **STYLES["truth"])
        ax.plot(steps, values / factor, "o-", color=BLUE, label="estimate")
        ax.xaxis.set_major_locator(MaxNLocator(integer=True))
        finish(ax, x="iteration", y=f"[{unit}]" if many else named(name, unit))
        if truth is not None and (i == 0 or not many):
            legend(ax, given=axs is not None or many)
        if many:  # a name does not fit next to a low panel
            ax.set_title(name, loc="left", fontsize="medium", pad=3.0)
    bottom_only(panels if axs is None else [])
    return panels

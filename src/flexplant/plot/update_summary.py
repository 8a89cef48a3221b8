"""One picture of an update: frequencies, damping, shapes, parameters, convergence, responses."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import matplotlib.pyplot as plt
import numpy as np
from matplotlib.axes import Axes
from matplotlib.ticker import MaxNLocator

from ..lti.frequency import Frf
from ..updating import Correlation, FrfResidual, Residual, UpdateResult, correlate
from ..updating.search import Objective
from ..values import FloatArray, instance
from ._axes import MEASURED, NOMINAL, UPDATED, finish

#: parameters that are drawn by themselves; the rest are left to the repr
SHOWN = 12


def update(
    fit: UpdateResult,
    before: Any,
    residuals: Sequence[Residual],
    *,
    unused: Frf | FrfResidual | None = None,
    level: float = 0.95,
) -> dict[str, Axes]:
    """Draw all of an update on one page.

    Parameters
    ----------
    fit : UpdateResult
        The update.
    before : ReducedModel or FEModel
        The model that was updated.
    residuals : sequence of Residual
        What it was updated with, or anything measured that it shall be judged by.
    unused : Frf or FrfResidual, optional
        A measurement that was not fitted, drawn instead of that of the residuals; as a residual
        where its channels are not named by their DOFs, or it was measured behind a hold.
    level : float
        Of the confidence intervals.

    Returns
    -------
    dict of Axes
        `frequencies` and `damping` (errors before and after, with poles), `mac before` and
        `mac after` (with shapes), `parameters` (estimates with intervals, priors in grey, each
        parameter scaled by the far end of its interval), `convergence`,
        `response` (measured, before and after, with responses).

    Raises
    ------
    ModelError
        When `fit` is no UpdateResult, or a residual does not fit the model.
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
    figure, drawn = plt.subplot_mosaic(rows, figsize=(10.5, 3.2 * len(rows)), layout="constrained")
    axs: dict[str, Axes] = dict(drawn)
    if old.modes:
        _errors(axs["frequencies"], old, old.freq_error, new.freq_error, "frequency")
        _errors(axs["damping"], old, old.zeta_error, new.zeta_error, "damping ratio")
    for name, seen in (("mac before", old), ("mac after", new)):
        if name in axs:
            _mac(axs[name], seen, name)
    _parameters(axs["parameters"], fit, level)
    _convergence(axs["convergence"], fit)
    if shown:
        _response(axs["response"], shown[-1], before, fit.model)
    said = "converged" if fit.converged else "NOT CONVERGED"
    figure.suptitle(f"update: {said} in {len(fit.history)} steps ({fit.reason})")
    return axs


def _errors(ax: Axes, seen: Correlation, old: FloatArray, new: FloatArray, what: str) -> None:
    place = np.arange(len(seen.modes))
    unit = 100.0
    ax.bar(place - 0.2, unit * old, 0.38, color=NOMINAL, label="before")
    ax.bar(place + 0.2, unit * new, 0.38, color=UPDATED, label="after")
    for x, value in zip(place + 0.2, unit * new, strict=True):
        above = value >= 0
        ax.annotate(
            f"{value:.1g}",
            (float(x), float(value)),
            (0, 2 if above else -2),
            textcoords="offset points",
            ha="center",
            va="bottom" if above else "top",
            fontsize=7,
            color=UPDATED,
            bbox={"facecolor": "white", "edgecolor": "none", "alpha": 0.8, "pad": 0.5},
        )
    ax.axhline(0.0, color="0.3", linewidth=0.8)
    ax.margins(y=0.2)
    ax.set_xticks(place, [str(number) for number in seen.modes])
    ax.legend(frameon=False, fontsize=8)
    kind = "%" if what == "frequency" else "percentage points"
    finish(ax, x="mode", y=f"error [{kind}]", title=f"{what}, model less measured")


def _mac(ax: Axes, seen: Correlation, name: str) -> None:
    image = ax.imshow(seen.mac, vmin=0.0, vmax=1.0, cmap="Blues", aspect="auto")
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
    """Each parameter on its own scale: 0 is no change, 1 the end of its interval."""
    count = min(len(fit.parameters), SHOWN)
    place = np.arange(count)[::-1]
    values = fit.values[:count]
    half = np.zeros(count)
    if fit.std is not None:
        half = fit.interval(level)[:count, 1] - values
    size = np.abs(values) + half
    size = np.where(size > 0, size, 1.0)
    labels = []
    for i in range(count):
        error = "" if fit.std is None else f" ± {fit.std[i]:.1g}"
        edge = ", AT ITS BOUND" if fit.parameters[i] in fit.at_bound else ""
        labels.append(f"{fit.parameters[i]}\n{values[i]:.4g}{error} {fit.units[i]}{edge}")
        prior = getattr(fit.unknowns[i], "prior", None) if fit.unknowns else None
        if prior is not None:
            mean, width = prior[0] / size[i], 1.96 * prior[1] / size[i]
            ax.barh(place[i], 2 * width, 0.5, left=mean - width, color="0.88", label="prior, 95 %")
    ax.errorbar(
        values / size,
        place,
        xerr=None if fit.std is None else half / size,
        fmt="o",
        color=UPDATED,
        capsize=4,
        label=f"estimate, {100 * level:g} %",
    )
    ax.axvline(0.0, color=NOMINAL, linewidth=1.0, label="before")
    ax.set_xlim(-1.4, 1.4)
    ax.set_yticks(place, labels, fontsize=8)
    handles, texts = ax.get_legend_handles_labels()
    unique = dict(zip(texts, handles, strict=True))
    ax.legend(
        unique.values(),
        unique.keys(),
        frameon=False,
        fontsize=8,
        ncols=3,
        loc="upper center",
    )
    ax.set_ylim(-0.7, count + 0.1)
    more = len(fit.parameters) - count
    title = "parameters" + (f" ({more} more not drawn)" if more else "")
    finish(ax, x="value / (|estimate| + half interval) [-]", y="", title=title)


def _convergence(ax: Axes, fit: UpdateResult) -> None:
    steps = np.arange(len(fit.history) + 1)
    ax.semilogy(steps, np.maximum(fit.history.error, 1e-300), "o-", color=NOMINAL, markersize=4)
    ax.xaxis.set_major_locator(MaxNLocator(integer=True))
    finish(ax, x="iteration", y="sum of squares of residuals", title="convergence")


def _response(ax: Axes, residual: FrfResidual, before: Any, after: Any) -> None:
    frf, lines = residual.measured, residual.lines
    freq = frf.freq[lines]
    # the pair of channels that was measured strongest
    o, i = np.unravel_index(np.argmax(np.sum(np.abs(frf.data) ** 2, axis=2)), frf.data.shape[:2])
    style = "-" if lines.size > 100 else ".-"
    ax.semilogy(freq, np.abs(frf.data[o, i, lines]), style, color=MEASURED, label="measured", lw=2)
    for label, model, color in (("before", before, NOMINAL), ("after", after, UPDATED)):
        objective = Objective(model, [], [residual])
        tied: Any = objective.bounds[0]
        H = tied.responses(objective.begin(np.zeros(0)))[:, o, i]
        ax.semilogy(freq, np.abs(H), color=color, label=label, linewidth=1.1)
    ax.legend(frameon=False, fontsize=8)
    name = f"|{frf.outputs[int(o)]} / {frf.inputs[int(i)]}|"
    unit = {"velocity": "m/s", "acceleration": "m/s^2"}.get(frf.quantity or "", "m")
    finish(ax, x="frequency [Hz]", y=f"{name} [{unit} per unit]", title="response")

"""Pictures of a localisation: which candidates explain a measurement, and where they are."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from matplotlib.axes import Axes

from ..checks import FloatArray, instance, with_unit
from ..errors import ModelError
from ..labels import DofSet
from ..updating import Localisation
from ..updating.parameters.added import Parameter, PointParameter
from ._axes import BLUE, GREY, LIGHT, RED, axes, finish, legend_below, plan

#: colours of what was chosen, cannot be distinguished from it, hardly can, and of all others
COLOURS = {"chosen": RED, "alike": BLUE, "rival": GREY, "other": LIGHT}


def localisation(
    found: Localisation,
    *,
    candidates: Sequence[Parameter] | None = None,
    dofs: DofSet | None = None,
    ax: Axes | None = None,
) -> Axes:
    """Draw how much of the misfit each candidate explains alone.

    Parameters
    ----------
    found : Localisation
        Of `localise`.
    candidates : sequence of Parameter, optional
        As given to `localise`. With `dofs`: a plan view, the candidates where they act.
    dofs : DofSet, optional
        Of the model.
    ax : Axes, optional
        Where to draw.

    Returns
    -------
    Axes
        Bars of the best candidates; or places in x and y [m], coloured by the share explained.

    Raises
    ------
    ModelError
        When `found` is no Localisation, or candidates are not those of it.

    Examples
    --------
    >>> import flexplant as fx
    >>> modes = fx.solve_modes(fx.chain(masses=[1.0, 1.0, 1.0], stiffnesses=[4e5, 4e5]), count=3)
    >>> drawing = fx.reduce(modes, fx.DesiredDofs(["1:x", "2:x", "3:x"]))
    >>> measured = fx.MeasuredModes(poles=[615.0j], modes=[2])
    >>> masses = [fx.AddedMass(place) for place in drawing.dofs.labels]
    >>> found = fx.localise(drawing, masses, [fx.Eigenvalues(measured)], most=1)
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


def _kind(found: Localisation, name: str) -> str:
    if name in found.chosen:
        return "chosen"
    if len(found.alike) > 1 and name in found.alike:
        return "alike"
    return "rival" if name in found.rivals else "other"


def _bars(found: Localisation, ax: Axes | None) -> Axes:
    names = found.leading
    ax = axes(ax, figsize=(7.0, 0.8 + 0.33 * len(names)))
    rows = np.arange(len(names))
    kinds = [_kind(found, name) for name in names]
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
        mine = [i for i, (q, _) in enumerate(placed) if _kind(found, q.name) == kind]
        if mine:
            ax.scatter(
                xy[mine, 0],
                xy[mine, 1],
                marker=marker,
                s=260,
                zorder=3,
                label=kind,
                facecolors="none",
                edgecolors=COLOURS[kind],
                linewidths=1.8,
            )
    legend_below(ax)
    return ax


def _xy(parameter: PointParameter, dofs: DofSet) -> FloatArray:
    """Return where a parameter acts, the mean of its weights' places."""
    at = parameter.at
    if isinstance(at, str):
        return np.asarray(dofs.location(at)[:2])
    row = np.abs(dofs.row(at, parameter.direction))
    return np.asarray(row @ dofs.xyz[:, :2] / row.sum())

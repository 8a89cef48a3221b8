"""Pictures of a machine over the range of its positions."""

from __future__ import annotations

import matplotlib.pyplot as plt
import numpy as np
from matplotlib.axes import Axes
from matplotlib.colors import LogNorm

from ..checks import FloatArray, in_unit, instance
from ..errors import ModelError
from ..plant import PositionMap
from ._axes import CYCLE, RED, finish

#: shares of a mode are drawn from here on
_FAINT = 1e-3
#: most modes that a panel names one by one
_NAMED = 24


def position_map(found: PositionMap, *, kind: str = "m") -> list[Axes]:
    """Draw decoupling, modes and figures of a machine over its positions.

    Parameters
    ----------
    found : PositionMap
        From `StandardPlant.map`; of one or two positions.
    kind : {"m", "rad"}
        The unit of the positions.

    Returns
    -------
    list of Axes
        A panel each: the error of decoupling, how far each mode is in the loop (of two positions
        the least of them), each figure, its least and largest value marked.

    Raises
    ------
    ModelError
        When `found` is no PositionMap, or has three or more positions.

    Examples
    --------
    >>> import flexplant as fx
    >>> found = fx.plant.PositionMap(
    ...     {"x": [0.0, 0.1]}, [[0, 0], [0.1, 0.2]], [[1.0], [0.5]], [[1.0], [0.9]], ["mode 7"], {}
    ... )
    >>> [ax.get_ylabel() for ax in fx.plot.position_map(found)]
    ['decoupling error [%]', '']
    """
    instance(found, PositionMap, "found", "Pass what plant.map returned.")
    if len(found.grid) > 2:
        raise ModelError(
            f"a picture has two axes, the map {len(found.grid)} positions: map fewer, "
            "points={'z': [0.0]} holds one where it is."
        )
    draw = _curve_panels if len(found.grid) == 1 else _image_panels
    return draw(found, kind)


def _curve_panels(found: PositionMap, kind: str) -> list[Axes]:
    """Draw panels above each other, over one position."""
    ((name, values),) = found.grid.items()
    factor, unit = in_unit(float(np.abs(values).max()), kind)
    x = values / factor
    decoupled = bool(np.any(np.isfinite(found.decoupling)))
    modes = min(int(np.count_nonzero(found.ever)), _NAMED)
    heights = [1.6] * decoupled + [max(1.2, 0.2 * modes)] * (modes > 0)
    heights += [1.6] * len(found.figures)
    figure, drawn = plt.subplots(
        len(heights), 1, sharex=True, squeeze=False, layout="constrained",
        height_ratios=heights, figsize=(7.5, 1.2 + sum(heights)),
    )  # fmt: skip
    panels = iter(drawn[:, 0])
    if decoupled:
        ax = next(panels)
        for label, line, style in zip(
            ("sensors", "actuators"), found.decoupling.T, CYCLE, strict=False
        ):
            ax.plot(x, 100 * line, label=label, **style)
        ax.set_ylim(bottom=0.0)
        finish(ax, x="", y="decoupling error [%]").legend(loc="best", fontsize=8)
    if modes:
        ax = next(panels)
        # those that leave the loop most, by number
        least = np.where(found.ever, found.visible.min(axis=0), np.inf)
        kept = np.sort(np.argsort(least, kind="stable")[:modes])
        shown = ax.pcolormesh(
            x, np.arange(modes), np.maximum(found.visible[:, kept].T, _FAINT), cmap="viridis",
            norm=LogNorm(_FAINT, 1.0), shading="nearest",
        )  # fmt: skip
        ax.set_yticks(np.arange(modes), [found.modes[i] for i in kept], fontsize=7)
        figure.colorbar(shown, ax=ax, label="share in the loop [-]")
    for (label, line), ax in zip(found.figures.items(), panels, strict=True):
        ax.plot(x, line, **CYCLE[0])
        for i in {int(np.nanargmin(line)), int(np.nanargmax(line))}:
            ax.plot(x[i], line[i], "o", color=RED)
            side = "left" if i < len(x) // 2 else "right"
            ax.annotate(
                f"{line[i]:.3g}", (x[i], line[i]), textcoords="offset points", ha=side, va="center",
                xytext=(8 if side == "left" else -8, 0),
            )  # fmt: skip
        ax.margins(y=0.2)
        finish(ax, x="", y=label)
    drawn[-1, 0].set_xlabel(f"position {name} [{unit}]")
    return list(drawn[:, 0])


def _image_panels(found: PositionMap, kind: str) -> list[Axes]:
    """Draw panels side by side, over two positions."""
    images: dict[str, FloatArray] = {}
    if np.any(np.isfinite(found.decoupling)):
        images["decoupling error [%]"] = 100 * found.decoupling.max(axis=-1)
    if np.any(found.ever):
        images["least share of a mode in the loop [-]"] = found.weakest
    images |= found.figures
    (first, across), (second, up) = found.grid.items()
    size = max(float(np.abs(across).max()), float(np.abs(up).max()))
    factor, unit = in_unit(size, kind)
    figure, drawn = plt.subplots(
        1, len(images), squeeze=False, layout="constrained", figsize=(4.6 * len(images), 4.0)
    )
    for ax, (label, values) in zip(drawn[0], images.items(), strict=True):
        shown = ax.pcolormesh(across / factor, up / factor, values.T, shading="nearest")
        figure.colorbar(shown, ax=ax, label=label)
        worst = np.nanargmax(values) if "decoupling" in label else np.nanargmin(values)
        i, j = np.unravel_index(int(worst), values.shape)
        ax.plot(across[i] / factor, up[j] / factor, "x", color=RED, markersize=10, clip_on=False)
        ax.set_title(f"worst, at the cross: {values[i, j]:.3g}", fontsize=9)
        ax.set(xlabel=f"position {first} [{unit}]", ylabel=f"position {second} [{unit}]")
    return list(drawn[0])

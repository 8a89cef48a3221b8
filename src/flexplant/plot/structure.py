"""Pictures of structures: where the channels are, and how modes move."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from typing import Any

import matplotlib.pyplot as plt
import numpy as np
from matplotlib.axes import Axes

from ..errors import ModelError
from ..labels import DofSet
from ..modes import Modes
from ..plant import Ports
from ._axes import axes, legend_below, plan
from ._style import BLACK, BLUE, GREEN, GREY, PURPLE, RED


def layout(
    dofs: DofSet,
    *,
    ports: Ports | None = None,
    desired: Iterable[str] = (),
    marked: Mapping[str, Any] | None = None,
    ax: Axes | None = None,
) -> Axes:
    """Draw a plate from above: nodes, desired DOFs, actuators, sensors and POIs (paper, Fig. 3).

    Parameters
    ----------
    dofs : DofSet
        Of the full model.
    ports : Ports, optional
        Their places.
    desired : iterable of str
        Labels of the desired DOFs.
    marked : mapping {text: place}, optional
        Further places to name.
    ax : Axes, optional
        Where to draw.

    Returns
    -------
    Axes
    """
    ax = axes(ax, figsize=(6.0, 6.0))
    factor = plan(ax, dofs.xyz)
    nodes = np.unique(dofs.xyz, axis=0) / factor
    ax.plot(nodes[:, 0], nodes[:, 1], ".", color="0.5", label="nodes")
    wanted = list(desired)
    if wanted:
        xyz = dofs.xyz[dofs.indices(wanted)] / factor
        ax.plot(xyz[:, 0], xyz[:, 1], "x", color=PURPLE, label=f"{len(wanted)} desired DOFs")
    if ports is not None:
        for kind, listed, marker, color, size in (
            ("actuators u", ports.u, "o", GREEN, 12),
            ("sensors y", ports.y, "P", BLUE, 9),
            ("points of interest", ports.z, "*", RED, 15),
        ):
            _mark(ax, dofs, factor, kind, listed, marker=marker, color=color, markersize=size)
    for text, place in (marked or {}).items():
        point = _point(dofs, place) / factor
        ax.plot(point[0], point[1], "s", color=BLACK, fillstyle="none", markersize=11)
        ax.annotate(text, (point[0], point[1]), (8, -14), textcoords="offset points")
    legend_below(ax)
    return ax


def _mark(
    ax: Axes, dofs: DofSet, factor: float, kind: str, listed: Sequence[Any], **style: Any
) -> None:
    """Draw and name the ports of one kind."""
    points = [_point(dofs, port.at) / factor for port in listed]
    if not points:
        return
    ax.plot(*np.array(points).T[:2], linestyle="", fillstyle="none", label=kind, **style)
    for port, point in zip(listed, points, strict=True):
        ax.annotate(port.name, (point[0], point[1]), (7, 7), textcoords="offset points")


def _point(dofs: DofSet, at: Any) -> Any:
    if isinstance(at, str):
        return dofs.xyz[dofs.index(at)]
    if isinstance(at, Mapping):
        return np.mean([_point(dofs, place) for place in at], axis=0)
    return np.asarray(at)


def mode_shape(modes: Modes, number: int, *, ax: Any = None, color: str = GREY) -> Any:
    """Draw the z-displacements of one mode as a surface (paper, Figs. 5 and 6).

    Parameters
    ----------
    modes : Modes
        Of a full or reduced plate.
    number : int
        From 1, rigid-body modes included.
    ax : Axes3D, optional
        Where to draw.
    color : str
        Of the surface.

    Returns
    -------
    Axes3D

    Raises
    ------
    ModelError
        When there is no such mode, or no z-DOFs.
    """
    if not 1 <= number <= modes.omega.size:
        raise ModelError(f"there is no mode {number}: modes are numbered 1 to {modes.omega.size}.")
    rows = np.flatnonzero(np.array(modes.dofs.directions) == "z")
    if rows.size < 3:
        raise ModelError("a mode shape needs at least three z-DOFs to draw.")
    shape = np.asarray(modes.phi)[rows, number - 1]
    if np.iscomplexobj(shape):  # a nearly real shape, turned so that it is
        shape = (shape * np.exp(-1j * np.angle(shape[np.argmax(np.abs(shape))]))).real
    shape = shape / shape[np.argmax(np.abs(shape))]
    xyz = modes.dofs.xyz[rows]
    if ax is None:
        ax = plt.figure(figsize=(6.0, 4.5), layout="constrained").add_subplot(projection="3d")
    ax.plot_trisurf(
        xyz[:, 0], xyz[:, 1], shape, color=color, alpha=0.55, edgecolor="0.3", linewidth=0.4
    )
    ax.plot(xyz[:, 0], xyz[:, 1], shape, ".", color="0.2", markersize=3)
    ax.set(xlabel="x [m]", ylabel="y [m]", zlabel="z, scaled to 1")
    ax.set_title(f"mode {number}, {modes.freq[number - 1]:.1f} Hz")
    return ax

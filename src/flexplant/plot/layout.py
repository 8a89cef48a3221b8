"""Pictures of structures: where the nodes and the channels are."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from mpl_toolkits.mplot3d.art3d import Line3DCollection, Poly3DCollection

from ..checks import FloatArray, in_unit
from ..errors import counted
from ..labels import DofSet
from ..plant import Ports
from ._axes import BLACK, GREY, LIGHT, PORTS, PURPLE, Style, axes, legend_below, plan, solid_axes
from .mode_shapes import Surface, surface_of


def layout(
    dofs: DofSet,
    *,
    ports: Ports | None = None,
    desired: Iterable[str] = (),
    marked: Mapping[str, Any] | None = None,
    ax: Axes | None = None,
) -> Any:
    """Draw where nodes, desired DOFs, actuators, sensors and POIs are (paper, Fig. 3).

    A plate is drawn from above, a solid in three dimensions with arrows along which its actuators
    push and its sensors measure.

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
    Axes, of a solid Axes3D

    Raises
    ------
    LabelError
        When a DOF is unknown.
    ModelError
        When a solid has so many nodes that no picture could show them, or is to be drawn on axes of
        two dimensions.

    Examples
    --------
    >>> import flexplant as fx
    >>> size, mesh = {"size": (1.0, 1.0), "thickness": 0.01}, {"elements": (2, 2)}
    >>> steel = {"density": 7800.0, "youngs_modulus": 2.1e11, "poisson_ratio": 0.3}
    >>> ax = fx.plot.layout(fx.kirchhoff_plate(**size, **mesh, **steel).dofs)
    >>> ax.get_aspect()
    1.0
    """
    if np.ptp(dofs.xyz[:, 2]) > 0 and (skin := surface_of(dofs)).is_solid:
        return _solid(skin, dofs, ports, desired, marked or {}, ax)
    ax = axes(ax, figsize=(6.0, 6.0))
    factor = plan(ax, dofs.xyz)
    nodes = np.unique(dofs.xyz, axis=0) / factor
    ax.plot(nodes[:, 0], nodes[:, 1], ".", color="0.5", label="nodes")
    wanted = list(desired)
    if wanted:
        xyz = dofs.xyz[dofs.indices(wanted)] / factor
        text = counted(len(wanted), "desired DOF")
        ax.plot(xyz[:, 0], xyz[:, 1], "x", color=PURPLE, label=text)
    if ports is not None:
        for kind, listed, look in _kinds(ports):
            _mark(ax, dofs, factor, kind, listed, **look)
    for text, place in (marked or {}).items():
        point = _point(dofs, place) / factor
        ax.plot(point[0], point[1], "s", color=BLACK, fillstyle="none", markersize=11)
        ax.annotate(text, (point[0], point[1]), (8, -14), textcoords="offset points")
    ax.margins(0.08)  # for the names of what is at an edge
    legend_below(ax)
    return ax


def _kinds(ports: Ports) -> tuple[tuple[str, Sequence[Any], Style], ...]:
    """Return what is marked, and how."""
    return (
        ("sensors", ports.y, dict(PORTS["sensors"])),
        ("actuators", ports.u, dict(PORTS["actuators"])),
        ("POI", ports.z, dict(PORTS["POI"])),
    )


def _solid(
    skin: Surface,
    dofs: DofSet,
    ports: Ports | None,
    desired: Iterable[str],
    marked: Mapping[str, Any],
    ax: Any,
) -> Any:
    """Draw a solid with its ports in three dimensions."""
    ax = solid_axes(skin.xyz, ax, beyond=0.12 * skin.extent)
    factor = in_unit(skin.extent, "m")[0]
    rest = skin.xyz / factor
    ax.computed_zorder = False  # what is inside and behind shows too
    faces = Poly3DCollection(rest[skin.triangles], facecolors=LIGHT, alpha=0.2, zorder=1)
    ax.add_collection3d(faces)
    ax.add_collection3d(Line3DCollection(rest[skin.edges], colors=GREY, linewidths=0.8, zorder=2))
    wanted = list(desired)
    if wanted:
        xyz = dofs.xyz[dofs.indices(wanted)] / factor
        ax.plot(*xyz.T, "x", color=PURPLE, label=counted(len(wanted), "desired DOF"))
    for kind, listed, look in _kinds(ports) if ports is not None else ():
        points = [_point(dofs, port.at) / factor for port in listed]
        if not points:
            continue
        ax.plot(*np.array(points).T, linestyle="", label=kind, zorder=3, **look)
        for port, point in zip(listed, points, strict=True):
            ax.text(*point, f"  {port.name}")
            along = _along(port)
            if along is not None:
                length = 0.12 * skin.extent / factor
                ax.quiver(*point, *along, length=length, color=look["color"])
    for text, place in marked.items():
        point = _point(dofs, place) / factor
        ax.plot(*point[:, None], "s", color=BLACK, fillstyle="none", markersize=11)
        ax.text(*point, f"  {text}")
    if ax.get_legend_handles_labels()[0]:
        ax.legend(frameon=False, loc="upper center", bbox_to_anchor=(0.5, 1.08), ncols=3)
    return ax


def _along(port: Any) -> FloatArray | None:
    """Return the unit vector that a port acts or measures along; None of rotations and POIs."""
    direction = getattr(port, "direction", None)
    if isinstance(port.at, str):
        direction = port.at.rpartition(":")[2]
    return np.eye(3)["xyz".index(direction)] if direction in ("x", "y", "z") else None


def _mark(
    ax: Axes, dofs: DofSet, factor: float, kind: str, listed: Sequence[Any], **style: Any
) -> None:
    """Draw and name the ports of one kind."""
    points = [_point(dofs, port.at) / factor for port in listed]
    if not points:
        return
    ax.plot(*np.array(points).T[:2], linestyle="", label=kind, **style)
    for port, point in zip(listed, points, strict=True):
        ax.annotate(port.name, (point[0], point[1]), (7, 7), textcoords="offset points")


def _point(dofs: DofSet, at: Any) -> Any:
    if isinstance(at, str):
        return dofs.location(at)
    if isinstance(at, Mapping):
        return np.mean([_point(dofs, place) for place in at], axis=0)
    return np.asarray(at)

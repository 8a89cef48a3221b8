"""Mode shapes in three dimensions, still and moving; places of nodes and channels."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from typing import Any, NamedTuple, TypeAlias

import numpy as np
from matplotlib.axes import Axes
from matplotlib.cm import ScalarMappable
from matplotlib.colors import Normalize
from matplotlib.patheffects import withStroke
from matplotlib.transforms import ScaledTranslation
from mpl_toolkits.mplot3d.art3d import Line3DCollection, Poly3DCollection
from mpl_toolkits.mplot3d.proj3d import proj_transform

from ..arrays import ComplexArray, FloatArray, IntArray, divisor, instance, positive
from ..errors import ModelError, counted, in_unit
from ..labels import DofSet
from ..modes import Modes
from ..plant import Ports
from ..structure.model import FEModel
from ..tolerances import TYPED
from ._axes import (
    BLACK,
    GREY,
    LIGHT,
    PORTS,
    PURPLE,
    Device,
    axes,
    legend_below,
    mark_devices,
    plan,
    solid_axes,
)
from .node_lines import joined_lines, neighbours, translations

_COLOURS = "viridis"
#: number of triangles that are drawn quickly; those of a coarse mesh are divided for smooth colours
_MANY, _PARTS = 3000, 4


def mode_shape(
    modes: Modes,
    number: int,
    *,
    scale: float = 0.15,
    phase: float = 0.0,
    color: str | None = None,
    joined: FEModel | IntArray | None = None,
    ax: Any = None,
) -> Any:
    """Draw a mode of a plate, a solid or a frame in three dimensions ([paper]_, Figs. 5 and 6).

    The surface is found from the nodes; for a solid it has two sides. If the nodes form no surface,
    lines are drawn between neighbouring nodes, or between those that are `joined`. The colour shows
    the magnitude of the displacement vector. Dashed lines are the edges at rest.

    Parameters
    ----------
    modes : Modes
        Modes of a full or reduced model, or of an update (`fit.modes()`).
    number : int
        Number of the mode, counted from 1 with rigid-body modes.
    scale : float
        Largest drawn displacement relative to the largest dimension of the structure.
    phase : float [rad]
        Phase of the motion ``Re(phi exp(i phase))``: 0 is the largest displacement.
    color : str, optional
        One colour for the surface or the lines.
    joined : FEModel or (m, 2) array of int, optional
        Lines to draw in place of a surface, for example for a frame of beams. For a model, lines
        are drawn between nodes that its stiffness matrix joins. An array gives the numbers of the
        two nodes of each line, such as the ends of each element in the file of the model.
    ax : Axes3D, optional
        Axes to draw on, in three dimensions; by default those of a new figure.

    Raises
    ------
    ModelError
        When the mode does not exist, the model has no displacement along x, y or z, or there are
        too many nodes.

    Examples
    --------
    >>> import flexplant as fx
    >>> size, mesh = {"size": (1.0, 1.0), "thickness": 0.01}, {"elements": (2, 2)}
    >>> steel = {"density": 7800.0, "youngs_modulus": 2.1e11, "poisson_ratio": 0.3}
    >>> modes = fx.solve_modes(fx.kirchhoff_plate(**size, **mesh, **steel), count=4)
    >>> ax = fx.plot.mode_shape(modes, 4)
    >>> ax.name
    '3d'
    """
    return _Moving(modes, number, scale, color, joined, ax).at(phase)


class _Moving:
    """A mode on axes, at any phase of its motion."""

    def __init__(
        self, modes: Modes, number: int, scale: float, color: str | None, joined: Any, ax: Any
    ) -> None:
        instance(modes, Modes, "modes", "Pass what solve_modes returned, or model.modes().")
        if not 1 <= number <= modes.omega.size:
            raise ModelError(
                f"mode {number} does not exist: modes are numbered 1 to {modes.omega.size}."
            )
        self.skin = surface_of(modes.dofs, joined)
        motion = real_motion(self.skin.motion(np.asarray(modes.phi)[:, number - 1]))
        size = float(np.max(np.linalg.norm(motion, axis=1)))
        if not size:
            raise ModelError(
                f"mode {number} moves no DOF along x, y or z and cannot be drawn. Expand it "
                "to the full model's DOFs (ReducedModel.expand)."
            )
        self.size = np.linalg.norm(motion, axis=1) / size
        self.motion = positive(scale, "scale") * self.skin.extent * motion / size
        self.ax = solid_axes(self.skin.xyz, ax, beyond=float(scale) * self.skin.extent)
        self.factor = in_unit(self.skin.extent, "m")[0]
        finer = np.sqrt(_MANY / max(len(self.skin.triangles), 1))
        self.parts = _subtriangles(int(np.clip(finer, 1, _PARTS)))
        self.faces, self.lines = self._start(color)
        zeta = modes.zeta[number - 1]
        damped = f", damping {100 * zeta:.2g} %" if zeta else ""
        self.ax.set_title(f"mode {number}, {modes.freq[number - 1]:.1f} Hz{damped}")

    def _start(self, color: str | None) -> tuple[Poly3DCollection | None, Line3DCollection]:
        skin, rest = self.skin, self.skin.xyz / self.factor
        self.ax.computed_zorder = False  # the shape at rest never hides the moving one
        still = Line3DCollection(rest[skin.edges], colors=GREY, linewidths=0.8, linestyles="--")
        shades = ScalarMappable(Normalize(0.0, 1.0), _COLOURS)
        is_frame = not len(skin.triangles)
        look: Any = {"colors": color or BLACK, "linewidths": 2.0 if is_frame else 1.2}
        if is_frame and color is None:
            look["colors"] = shades.to_rgba(self.size[skin.edges].mean(axis=1))
        lines = Line3DCollection(rest[skin.edges], **look)
        self.ax.add_collection3d(still)
        if not skin.is_solid:  # its rear edges would lie on its face
            self.ax.add_collection3d(lines)
        still.set_zorder(1)
        lines.set_zorder(3)
        faces = None
        if color is None:
            label = "displacement, largest 1 [-]"
            self.ax.figure.colorbar(shades, ax=self.ax, label=label, shrink=0.6, pad=0.1)
        if not is_frame:
            colours: Any = color
            if color is None:
                colours = shades.to_rgba(self._divided(self.size[:, None]).mean(axis=(1, 2)))
            edge = colours if color is None else GREY
            faces = Poly3DCollection(
                self._divided(rest), facecolors=colours, edgecolors=edge, linewidths=0.3
            )
            self.ax.add_collection3d(faces)
        return faces, lines

    def _divided(self, values: FloatArray) -> FloatArray:
        """Return values (n, k) of the nodes at the corners of all parts (m, 3, k)."""
        found = np.einsum("pck,tkx->tpcx", self.parts, values[self.skin.triangles])
        return np.asarray(found.reshape(-1, 3, values.shape[1]))

    def at(self, phase: float) -> Any:
        """Draw the motion at a phase; return the axes."""
        moved = (self.skin.xyz + np.real(self.motion * np.exp(1j * phase))) / self.factor
        if self.faces is not None:
            self.faces.set_verts(list(self._divided(moved)))
        self.lines.set_segments(list(moved[self.skin.edges]))
        return self.ax


def _subtriangles(count: int) -> FloatArray:
    """Return corners (count^2, 3, 3) of equal parts of a triangle, in barycentric coordinates."""
    upright = [(i, j) for i in range(count) for j in range(count - i)]
    turned = [(i, j) for i, j in upright if i + j < count - 1]
    corners = [[(i, j), (i + 1, j), (i, j + 1)] for i, j in upright]
    corners += [[(i + 1, j + 1), (i, j + 1), (i + 1, j)] for i, j in turned]
    two = np.array(corners, dtype=np.float64) / count
    return np.concatenate([two, 1.0 - two.sum(axis=2, keepdims=True)], axis=2)


def real_motion(motion: ComplexArray | FloatArray) -> ComplexArray | FloatArray:
    """Return complex displacements turned so that they are as real as can be."""
    if not np.iscomplexobj(motion):
        return motion
    return np.asarray(motion * np.exp(-0.5j * np.angle(np.sum(motion**2))))


#: a mode shape as an array (n_dof,) or (n, 3), real or complex
Shape: TypeAlias = Any

#: largest number of nodes that can be drawn within seconds
MOST = 30_000
#: an edge longer than this number of distances between nodes does not belong to the surface
_REACH = 2.5
#: least fraction of the nodes on the surface; with fewer the structure is drawn as a frame
_WHOLE = 0.6
#: cosine of the angle between two faces below which their common edge is drawn
_EDGE = 0.8


class Surface(NamedTuple):
    """The surface of a structure."""

    xyz: FloatArray
    rows: IntArray
    triangles: IntArray
    edges: IntArray

    @property
    def is_solid(self) -> bool:
        """Whether the nodes fill a volume."""
        return bool(len(self.triangles)) and _dimension(self.xyz) == 3

    @property
    def extent(self) -> float:
        """The largest dimension [m]."""
        return float(np.max(np.ptp(self.xyz, axis=0)))

    def motion(self, shape: Shape) -> Shape:
        """Return the displacements (n, 3) of the nodes by a real or complex shape (n_dof,)."""
        moved: Shape = np.where(self.rows >= 0, shape[self.rows], 0.0)
        return moved


def surface_of(dofs: DofSet, joined: Any = None) -> Surface:
    """Return the surface of a structure, by Delaunay's triangulation of its nodes, or its lines."""
    # edges much longer than the distance between nodes are left out, so that holes and notches
    # wider than two elements stay open; their corners are filled by half an element
    numbers, xyz, rows = translations(dofs)
    if numbers.size > MOST:
        raise ModelError(
            f"{numbers.size} nodes are more than a picture shows ({MOST}): reduce the model, or "
            "choose DOFs of its surface (dofs.where)."
        )
    no_faces = np.zeros((0, 3), dtype=np.int64)
    if joined is not None:
        return Surface(xyz, rows, no_faces, joined_lines(joined, numbers))
    rank = _dimension(xyz)
    if rank < 2 or numbers.size < rank + 1:
        # along x, of equal ones along y, then z
        order = np.argsort(xyz @ np.array([1.0, 1e-3, 1e-6]))
        chain = np.column_stack([order[:-1], order[1:]])
        return Surface(xyz, rows, no_faces, chain)
    flat = _flat_axes(xyz) if rank == 2 else xyz
    triangles = _surface(flat)
    if not len(triangles):
        return Surface(xyz, rows, no_faces, _members(xyz))
    return Surface(xyz, rows, triangles, _outline(xyz, triangles))


def _members(xyz: FloatArray) -> IntArray:
    """Return the lines (m, 2) of a frame: between near nodes without another between them."""
    from scipy.spatial import cKDTree

    pairs = neighbours(xyz)
    near = np.asarray(cKDTree(xyz).query(xyz, k=2)[0])[:, 1]
    length = np.linalg.norm(xyz[pairs[:, 0]] - xyz[pairs[:, 1]], axis=1)
    return np.asarray(pairs[length <= _REACH * near[pairs].max(axis=1)])


def _dimension(xyz: FloatArray) -> int:
    """Return 0 to 3: whether nodes are in one place, on a line, in a plane, or fill a volume."""
    if len(xyz) < 2:
        return 0
    sizes = np.linalg.svd(xyz - xyz.mean(axis=0), compute_uv=False)
    return int(np.count_nonzero(sizes > TYPED * sizes[0]))


def _flat_axes(xyz: FloatArray) -> FloatArray:
    """Return two of the coordinates (n, 2) of nodes in a plane, without the one closest across."""
    normal = np.linalg.svd(xyz - xyz.mean(axis=0), full_matrices=False)[2][2]
    return np.delete(xyz, int(np.argmax(np.abs(normal))), axis=1)


def _surface(points: FloatArray) -> IntArray:
    """Return triangles of points (n, 2), or the outer faces of the tetrahedra between (n, 3).

    A frame, most nodes of which lie on no face, has no faces.
    """
    from scipy.spatial import Delaunay, cKDTree

    scaled = points / _spacings(points)
    simplices = np.asarray(Delaunay(scaled).simplices, dtype=np.int64)
    corners = scaled[simplices]
    sides = corners[:, :, None, :] - corners[:, None, :, :]
    longest = np.sqrt(np.max(np.sum(sides**2, axis=-1), axis=(1, 2)))
    near = np.asarray(cKDTree(scaled).query(scaled, k=2)[0])[:, 1]
    simplices = np.asarray(simplices[longest <= _REACH * near[simplices].max(axis=1)])
    if np.unique(simplices).size <= _WHOLE * len(points):
        return np.zeros((0, 3), dtype=np.int64)
    if points.shape[1] == 2:
        return simplices
    faces = np.vstack([np.delete(simplices, k, axis=1) for k in range(4)])
    _, index, count = np.unique(
        np.sort(faces, axis=1), axis=0, return_index=True, return_counts=True
    )
    return np.asarray(faces[index[count == 1]])


def _spacings(points: FloatArray) -> FloatArray:
    """Return the distance between nodes along each axis: of a grid its steps, else one for all."""
    extent = np.ptp(points, axis=0)
    steps = []
    for k, size in enumerate(extent):
        levels = np.unique(np.round(points[:, k] / size, 6)) * size
        steps.append(float(np.median(np.diff(levels))) if 2 * levels.size <= len(points) else 0.0)
    return np.array(steps) if all(steps) else np.full(extent.size, float(extent.max()))


def _outline(xyz: FloatArray, triangles: IntArray) -> IntArray:
    """Return the sides that belong to one triangle only, or to two at an angle."""
    a, b, c = (xyz[triangles[:, k]] for k in range(3))
    normal = np.cross(b - a, c - a)
    area = np.linalg.norm(normal, axis=1, keepdims=True)
    known = np.flatnonzero(area[:, 0] > TYPED * area.max())
    normal = normal / divisor(area)
    sides = np.sort(np.vstack([triangles[known][:, [k, (k + 1) % 3]] for k in range(3)]), axis=1)
    order = np.lexsort(sides.T)
    sides, owner = sides[order], np.tile(known, 3)[order]
    same = np.all(sides[1:] == sides[:-1], axis=1)
    # of neighbours in a plane |cos| is 1, whichever way their corners are listed
    flat = np.abs(np.sum(normal[owner[1:]] * normal[owner[:-1]], axis=1)) > _EDGE
    inside = np.zeros(len(sides), dtype=bool)
    inside[1:] |= same & flat
    inside[:-1] |= same & flat
    return np.asarray(np.unique(sides[~inside], axis=0))


def layout(
    dofs: DofSet,
    *,
    ports: Ports | None = None,
    desired: Iterable[str] = (),
    marked: Mapping[str, Any] | None = None,
    ax: Axes | None = None,
) -> Any:
    """Draw the places of nodes, desired DOFs, actuators, sensors and POIs ([paper]_, Fig. 3).

    A plate is drawn from above. A solid is drawn in three dimensions; arrows show the directions in
    which its actuators push and its sensors measure.

    Parameters
    ----------
    dofs : DofSet
        DOFs of the full model.
    ports : Ports, optional
        Ports whose places are drawn.
    desired : iterable of str
        Labels of DOFs to mark, for example those that a reduction keeps.
    marked : mapping {text: place}, optional
        Further places, which are drawn with their names.
    ax : Axes, optional
        Axes to draw on; by default those of a new figure.

    Raises
    ------
    ModelError
        When a solid has more nodes than a picture can show, or is to be drawn on axes of
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
    if np.ptp(dofs.xyz[:, 2]) > 0 and _dimension((skin := surface_of(dofs)).xyz) == 3:
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
    mark_devices(ax, factor, _devices(dofs, ports))
    for text, place in (marked or {}).items():
        point = _point(dofs, place) / factor
        ax.plot(point[0], point[1], "s", color=BLACK, fillstyle="none", markersize=11)
        ax.annotate(text, (point[0], point[1]), (8, -14), textcoords="offset points")
    ax.margins(0.08)  # room for names at an edge
    legend_below(ax)
    return ax


def kinds_of(ports: Ports | None) -> dict[str, Sequence[Any]]:
    """Return the ports that views of a structure mark, by kind."""
    if ports is None:
        return {}
    return {"sensors": ports.y, "actuators": ports.u, "POI": ports.z}


def _devices(dofs: DofSet, ports: Ports | None) -> dict[str, list[Device]]:
    """Return what is marked, by kind."""
    return {
        kind: [Device.of(port, _point(dofs, port.at)) for port in listed]
        for kind, listed in kinds_of(ports).items()
    }


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
    ax.computed_zorder = False  # points inside and behind stay visible
    if len(skin.triangles):
        faces = Poly3DCollection(rest[skin.triangles], facecolors=LIGHT, alpha=0.2, zorder=1)
        ax.add_collection3d(faces)
    ax.add_collection3d(Line3DCollection(rest[skin.edges], colors=GREY, linewidths=0.8, zorder=2))
    wanted = list(desired)
    if wanted:
        xyz = dofs.xyz[dofs.indices(wanted)] / factor
        ax.plot(*xyz.T, "x", color=PURPLE, label=counted(len(wanted), "desired DOF"))
    found, length = _devices(dofs, ports), 0.12 * skin.extent / factor
    for kind, listed in found.items():
        if not listed:
            continue
        points = np.array([one.place for one in listed]) / factor
        ax.plot(*points.T, linestyle="", label=kind, zorder=3, **PORTS[kind])
        for one, point in zip(listed, points, strict=True):
            if one.along is not None:
                ax.quiver(*point, *one.along, length=length, color=PORTS[kind]["color"])
    _name_devices(ax, [one for listed in found.values() for one in listed], factor, length)
    for text, place in marked.items():
        point = _point(dofs, place) / factor
        ax.plot(*point[:, None], "s", color=BLACK, fillstyle="none", markersize=11)
        ax.text(*point, f"  {text}")
    if ax.get_legend_handles_labels()[0]:
        ax.legend(frameon=False, loc="upper center", bbox_to_anchor=(0.5, 1.08), ncols=3)
    return ax


#: sides of a mark for its name, and distance [points]
_SIDES, _AWAY = np.exp(0.25j * np.pi * np.arange(8)), 15.0


def _name_devices(ax: Any, listed: Sequence[Device], factor: float, length: float) -> None:
    """Name devices in three dimensions, each on the side farthest from marks, arrows and names."""
    if not listed:
        return
    marks = np.array([one.place for one in listed]) / factor
    along = np.array([np.zeros(3) if one.along is None else one.along for one in listed])
    taken = np.vstack([marks + part * length * along for part in (0.0, 0.5, 1.0)])

    def on_paper(xyz: FloatArray) -> FloatArray:
        x, y, _ = proj_transform(*xyz.T, ax.get_proj())
        return np.asarray(ax.transData.transform(np.column_stack([x, y])) * 72.0 / ax.figure.dpi)

    occupied, spots = on_paper(taken), on_paper(marks)
    sides = _AWAY * np.column_stack([_SIDES.real, _SIDES.imag])
    for one, mark, spot in zip(listed, marks, spots, strict=True):
        away = np.linalg.norm(spot + sides[:, None] - occupied, axis=2)
        side = sides[int(np.argmax(away.min(axis=1)))]
        shift = ScaledTranslation(side[0] / 72.0, side[1] / 72.0, ax.figure.dpi_scale_trans)
        look = {"ha": "center", "va": "center", "fontsize": "small", "zorder": 6}
        text = ax.text(*mark, one.name, transform=ax.transData + shift, **look)
        text.set_path_effects([withStroke(linewidth=2.0, foreground="white")])
        occupied = np.vstack([occupied, spot + side])


def _point(dofs: DofSet, at: Any) -> Any:
    if isinstance(at, str):
        return dofs.location(at)
    if isinstance(at, Mapping):
        return np.mean([_point(dofs, place) for place in at], axis=0)
    return np.asarray(at)

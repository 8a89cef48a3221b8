"""Mode shapes in three dimensions, still and moving."""

from __future__ import annotations

from typing import Any

import numpy as np
from matplotlib.animation import FuncAnimation
from matplotlib.cm import ScalarMappable
from matplotlib.colors import Normalize
from mpl_toolkits.mplot3d.art3d import Line3DCollection, Poly3DCollection

from ..errors import ModelError
from ..modes import Modes
from ..values import ComplexArray, FloatArray, in_unit, instance, positive, whole
from ._axes import solid_axes
from ._style import BLACK, GREY
from ._surface import surface_of

_COLOURS = "viridis"
#: triangles that are drawn quickly; of a coarse mesh each is drawn in parts, whose colours differ
_MANY, _PARTS = 3000, 4


def mode_shape(
    modes: Modes,
    number: int,
    *,
    scale: float = 0.15,
    phase: float = 0.0,
    color: str | None = None,
    ax: Any = None,
) -> Any:
    """Draw a mode of a plate, a solid or a beam in three dimensions (paper, Figs. 5 and 6).

    The surface is found from the nodes: that of a solid has two sides. Its colour is the size of
    the displacement, in all directions together; dashed lines are the edges at rest.

    Parameters
    ----------
    modes : Modes
        Of a full or reduced model, or of an update (`fit.modes()`).
    number : int
        From 1, rigid-body modes included.
    scale : float
        The largest displacement that is drawn, of the largest dimension of the structure.
    phase : float [rad]
        Of the motion ``Re(phi exp(i phase))``: 0 is the end of its way.
    color : str, optional
        One colour for the surface.
    ax : Axes3D, optional
        Where to draw.

    Returns
    -------
    Axes3D

    Raises
    ------
    ModelError
        When there is no such mode, no displacement along x, y or z, or so many nodes that no
        picture could show them.

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
    return _Moving(modes, number, scale, color, ax).at(phase)


def animate_mode(
    modes: Modes,
    number: int,
    *,
    scale: float = 0.15,
    frames: int = 24,
    seconds: float = 1.5,
    color: str | None = None,
    ax: Any = None,
) -> FuncAnimation:
    """Return a mode in motion: ``.save("mode.gif")``, or ``.to_jshtml()`` for a page or notebook.

    Parameters
    ----------
    modes, number, scale, color, ax
        As for `mode_shape`.
    frames : int
        Pictures in one period.
    seconds : float [s]
        The time that a period is shown for.

    Returns
    -------
    matplotlib.animation.FuncAnimation
        Keep it as long as it shall move; its `._fig` is the figure.

    Raises
    ------
    ModelError
        As for `mode_shape`.

    Examples
    --------
    >>> import flexplant as fx
    >>> modes = fx.solve_modes(fx.chain(masses=[1.0, 1.0], stiffnesses=[1e4]))
    >>> moving = fx.plot.animate_mode(modes, 2)  # doctest: +SKIP
    >>> moving.save("mode_2.gif", writer="pillow")  # doctest: +SKIP
    """
    count = whole(frames, "frames", minimum=2)
    moving = _Moving(modes, number, scale, color, ax)
    figure = moving.ax.figure
    figure.draw_without_rendering()
    figure.set_layout_engine("none")  # once is enough: it would take most of the time of a frame
    return FuncAnimation(
        figure,
        lambda k: moving.at(2.0 * np.pi * k / count).collections,
        frames=count,
        interval=1e3 * positive(seconds, "seconds") / count,
        blit=False,
    )


class _Moving:
    """A mode on axes, at any phase of its motion."""

    def __init__(self, modes: Modes, number: int, scale: float, color: str | None, ax: Any) -> None:
        instance(modes, Modes, "modes", "Pass what solve_modes returned, or model.modes().")
        if not 1 <= number <= modes.omega.size:
            raise ModelError(
                f"there is no mode {number}: modes are numbered 1 to {modes.omega.size}."
            )
        self.skin = surface_of(modes.dofs)
        motion = real_motion(self.skin.motion(np.asarray(modes.phi)[:, number - 1]))
        size = float(np.max(np.linalg.norm(motion, axis=1)))
        if not size:
            raise ModelError(
                f"mode {number} moves no DOF along x, y or z: there is nothing to draw. Expand it "
                "to the full model's DOFs (ReducedModel.expand)."
            )
        self.size = np.linalg.norm(motion, axis=1) / size
        self.motion = positive(scale, "scale") * self.skin.extent * motion / size
        self.ax = solid_axes(self.skin.xyz, ax, beyond=float(scale) * self.skin.extent)
        self.factor = in_unit(self.skin.extent, "m")[0]
        finer = np.sqrt(_MANY / max(len(self.skin.triangles), 1))
        self.parts = _parts(int(np.clip(finer, 1, _PARTS)))
        self.faces, self.lines = self._start(color)
        zeta = modes.zeta[number - 1]
        damped = f", damping {100 * zeta:.2g} %" if zeta else ""
        self.ax.set_title(f"mode {number}, {modes.freq[number - 1]:.1f} Hz{damped}")

    def _start(self, color: str | None) -> tuple[Poly3DCollection | None, Line3DCollection]:
        skin, rest = self.skin, self.skin.xyz / self.factor
        self.ax.computed_zorder = False  # what is at rest never hides what moves
        still = Line3DCollection(rest[skin.edges], colors=GREY, linewidths=0.8, linestyles="--")
        lines = Line3DCollection(rest[skin.edges], colors=BLACK, linewidths=1.2)
        self.ax.add_collection3d(still)
        if not skin.is_solid:  # its edges at the back would lie on its face
            self.ax.add_collection3d(lines)
        still.set_zorder(1)
        lines.set_zorder(3)
        faces = None
        if len(skin.triangles):
            colours: Any = color
            if color is None:
                shades = ScalarMappable(Normalize(0.0, 1.0), _COLOURS)
                colours = shades.to_rgba(self._divided(self.size[:, None]).mean(axis=(1, 2)))
                label = "displacement, largest 1 [-]"
                self.ax.figure.colorbar(shades, ax=self.ax, label=label, shrink=0.6, pad=0.1)
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


def _parts(count: int) -> FloatArray:
    """Return the corners (count^2, 3, 3) of equal parts of a triangle, in shares of its corners."""
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

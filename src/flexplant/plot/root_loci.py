"""Root loci: poles of a loop over its gain."""

from __future__ import annotations

import numpy as np
import numpy.typing as npt
from matplotlib.axes import Axes
from scipy.optimize import linear_sum_assignment

from ..arrays import ComplexArray, FloatArray, positive_array
from ..errors import ModelError
from ..lti.statespace import StateSpace, System, as_statespace
from ._axes import BLUE, GREY, RED, axes, finish

#: range of the gain in decades around the given one, and 60 steps per decade, which give smooth
#: curves
_RANGE, _STEPS = 1e3, 361
#: range of the picture relative to the poles at the nominal gain and of the open loop
_ROOM = 1.5


def root_locus(sys: System, gains: npt.ArrayLike | None = None, *, ax: Axes | None = None) -> Axes:
    """Draw the poles of a closed loop with negative feedback of k L, over the gain k.

    The poles are the roots of ``det(I + k L(s)) = 0``. They are computed as eigenvalues of
    ``A - k B (I + k D)^-1 C``. A polynomial is not used, because it would lose lightly damped
    modes.

    Parameters
    ----------
    sys : StateSpace, or a system of python-control or SciPy
        The loop gain L, with as many inputs as outputs.
    gains : (n,) array, optional
        Positive gains k; by default from 1e-3 to 1e3.
    ax : Axes, optional
        Axes to draw on; by default those of a new figure.

    Returns
    -------
    Axes
        Axes of the complex plane [rad/s]. For a sampled system it is the plane of z, with the unit
        circle. Crosses are the poles of L, circles its zeros, and dots the poles of the closed loop
        at k = 1.

    Raises
    ------
    ModelError
        When L has no states, or not as many inputs as outputs, or a gain is not positive.

    Examples
    --------
    >>> import flexplant as fx
    >>> ax = fx.plot.root_locus(fx.lti.tf([1.0, 1.0], [1.0, 0.0, 0.0]))
    >>> ax.get_xlabel()
    'real part [rad/s]'
    """
    g = as_statespace(sys)
    if not g.n_states or len(g.inputs) != len(g.outputs):
        raise ModelError(
            f"{g!r} has no root locus: pass a loop gain with states and as many inputs as outputs."
        )
    if gains is None:
        k = np.geomspace(1.0 / _RANGE, _RANGE, _STEPS)
    else:
        k = np.sort(positive_array(gains, "gains"))
    given, ax = ax is not None, axes(ax, figsize=(6.4, 5.2))
    paths = _paths(g, k)
    for path in paths.T:
        ax.plot(path.real, path.imag, color=BLUE, linewidth=1.0)
    poles, zeros, here = g.poles(), g.zeros(), _closed_poles(g, 1.0)
    ax.plot(poles.real, poles.imag, "x", color="0.2", label="poles of L")
    if zeros.size:
        ax.plot(zeros.real, zeros.imag, "o", color="0.2", fillstyle="none", label="zeros of L")
    right = np.abs(here) >= 1.0 if g.dt else here.real >= 0.0
    ax.plot(here.real, here.imag, ".", color=BLUE, label="poles at k = 1")
    ax.plot(here.real[right], here.imag[right], ".", color=RED)
    _frame(ax, np.concatenate([poles, here]), sampled=bool(g.dt))
    unit = "[-]" if g.dt else "[rad/s]"
    ax.legend(loc="best")
    return finish(ax, x=f"real part {unit}", y=f"imaginary part {unit}", given=given)


def _closed_poles(g: StateSpace, k: float) -> ComplexArray:
    back = k * np.linalg.solve(np.eye(len(g.D)) + k * g.D, g.C)
    return np.asarray(np.linalg.eigvals(g.A - g.B @ back), dtype=np.complex128)


def _paths(g: StateSpace, gains: FloatArray) -> ComplexArray:
    """Return the poles (n_gain, n) for growing gains, each in the column of the closest one."""
    rows = [g.poles()]
    for k in gains:
        fresh = _closed_poles(g, float(k))
        _, order = linear_sum_assignment(np.abs(rows[-1][:, None] - fresh))
        rows.append(fresh[order])
    return np.array(rows)


def _frame(ax: Axes, roots: ComplexArray, *, sampled: bool) -> None:
    """Show the roots, and the stability limit."""
    if sampled:
        circle = np.exp(2j * np.pi * np.linspace(0.0, 1.0, 200))
        ax.plot(circle.real, circle.imag, color=GREY, linewidth=0.8)
        roots = np.concatenate([roots, circle])
    else:
        ax.axvline(0.0, color=GREY, linewidth=0.8)
    size = _ROOM * float(np.max(np.abs(roots), initial=0.0)) or 1.0
    left = min(float(roots.real.min()), 0.0) * _ROOM - 0.05 * size
    ax.set_xlim(left, max(_ROOM * float(roots.real.max()), 0.1 * size))
    ax.set_ylim(-size, size)

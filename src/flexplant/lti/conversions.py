"""Conversions between continuous and sampled time, other rates, descriptor systems."""

from __future__ import annotations

from typing import Any, Literal

import numpy as np
import numpy.typing as npt
import scipy.linalg as la

from ..arrays import FloatArray, between, one_of, positive, real_array
from ..errors import ModelError
from ..tolerances import RANK, ROUNDING, SAME
from .blocks_of_states import bilinear_matrices, trapezoidal
from .sampling import held_exactly
from .statespace import StateSpace, System, as_statespace


def tustin(sys: System, rate: float, *, prewarp: float | None = None) -> StateSpace:
    """Return the bilinear (Tustin) equivalent of a filter at a rate.

    ``s = a (z - 1) / (z + 1)`` with a = 2 rate, or a = w / tan(w / (2 rate)) so that the response
    at one frequency w is kept exactly.

    Parameters
    ----------
    sys : StateSpace
        A continuous system: a weight or a controller; for a plant use `discretized`.
    rate : float [Hz]
        Sampling rate.
    prewarp : float [Hz], optional
        The frequency at which the response is kept.

    Returns
    -------
    StateSpace
        System with dt = 1 / rate and the same names.

    Raises
    ------
    ModelError
        When `sys` is sampled already, prewarp is not below half the rate, or a pole lies at a.

    References
    ----------
    [Franklin1998]_, section 6.1.

    Examples
    --------
    >>> import flexplant as fx
    >>> lag = fx.lti.tf([1.0], [1.0, 1.0])
    >>> fx.lti.tustin(lag, 10.0).poles().real.round(6)  # (20 - 1) / (20 + 1)
    array([0.904762])
    """
    g = as_statespace(sys)
    if g.dt and g.n_states:
        raise ModelError(f"{g!r} is sampled already. Pass the continuous system.")
    a = 2.0 * positive(rate, "rate")
    if prewarp is not None:
        why = "It is in Hz, below half the rate."
        w = 2.0 * np.pi * between(prewarp, "prewarp", 0.0, 0.5 * rate, why)
        a = w / np.tan(w / a)
    if _has_pole_at(a, g.A):
        raise ModelError(f"{g!r} has a pole at {a:g} rad/s, which Tustin maps to infinity.")
    A, B, C, D = trapezoidal((g.A, g.B, g.C, g.D), a)
    return g.replace(A=A, B=B, C=C, D=D, dt=1.0 / rate)


def _has_pole_at(place: float, A: FloatArray) -> bool:
    """Return whether an eigenvalue lies there; a condition number would depend on units."""
    distance = np.abs(np.linalg.eigvals(A) - place)
    return bool(np.min(distance, initial=np.inf) <= ROUNDING * abs(place))


def image_freq(omega: Any, dt: float) -> Any:
    """Return the frequencies [Hz] that belong to those of the bilinear image [rad/s]."""
    return np.arctan(0.5 * dt * omega) / (np.pi * dt) if dt else omega / (2.0 * np.pi)


def bilinear(sys: System, rate: float) -> StateSpace:
    """Return the continuous system that `tustin` would sample to this one."""
    # z = (a + s) / (a - s), a = 2 rate: stability and norms are kept; w = a tan(theta / 2)
    g = as_statespace(sys)
    a = 2.0 * positive(rate, "rate")
    if _has_pole_at(-1.0, g.A):
        raise ModelError(f"{g!r} has a pole at z = -1, which the bilinear map sends to infinity.")
    A, B, C, D = bilinear_matrices((g.A, g.B, g.C, g.D), a)
    return g.replace(A=A, B=B, C=C, D=D, dt=0.0, blocks=None)


def continuous(sys: System, *, method: Literal["hold", "tustin"] = "hold") -> StateSpace:
    """Return the continuous system from which a sampled system can be made (``d2c``).

    With a zero-order hold ``[A_d, B_d; 0, 1] = e^([A, B; 0, 0] dt)``. The logarithm of this matrix
    gives A and B. The result is sampled again as a check.

    Parameters
    ----------
    sys : StateSpace, or a system of python-control or SciPy
        Sampled system.
    method : {"hold", "tustin"}
        Method with which the system was sampled, or by which a controller is to be
        converted.

    Returns
    -------
    StateSpace
        Continuous system with the same names.

    Raises
    ------
    ModelError
        When `sys` is continuous already, or no real continuous system has these samples. This is so
        for a pole at z = 0 (a delay) and for a single pole on the negative real axis.

    Examples
    --------
    >>> import flexplant as fx
    >>> lag = fx.lti.tf([2.0], [1.0, 3.0])
    >>> fx.lti.continuous(fx.lti.discretized(lag, 10.0)).poles().real.round(9)
    array([-3.])
    """
    g = as_statespace(sys)
    one_of(method, "method", ("hold", "tustin"))
    if not g.dt:
        raise ModelError(f"{g!r} is continuous already.")
    if method == "tustin":
        return bilinear(g, 1.0 / g.dt)
    return _unheld(g)


def _unheld(g: StateSpace) -> StateSpace:
    """Return the continuous system that a zero-order hold samples to this one."""
    n, m = g.B.shape
    held = np.block([[g.A, g.B], [np.zeros((m, n)), np.eye(m)]])
    if np.min(np.abs(g.poles()), initial=1.0) < ROUNDING:
        raise ModelError(
            "a pole at 0 is a delay of a sample, which no continuous system with these states has. "
            "Convert the system without its delay."
        )
    log = la.logm(held)
    if np.max(np.abs(np.imag(log)), initial=0.0) > SAME * np.max(np.abs(log)):
        raise ModelError(
            "a single pole on the negative real axis has no real continuous counterpart: it is a "
            "mode at half the rate. Use method='tustin' for a controller."
        )
    flow = np.real(log) / g.dt
    found = g.replace(A=flow[:n, :n], B=flow[:n, n:], dt=0.0, blocks=None)
    again = held_exactly(found, 1.0 / g.dt)
    size = np.linalg.norm(held)
    worst = max(np.linalg.norm(again.A - g.A), np.linalg.norm(again.B - g.B)) / size
    if worst > SAME:
        raise ModelError(
            f"the logarithm of the samples is not accurate, sampled again it is {worst:.1g} off:"
            " its poles lie close together. fx.minimal(sys) or fx.balanced(sys) first may help."
        )
    return found


def resampled(
    sys: System, rate: float, *, method: Literal["hold", "tustin"] = "hold"
) -> StateSpace:
    """Return a sampled system at another rate (``d2d``), by way of its continuous counterpart.

    Parameters
    ----------
    sys : StateSpace, or a system of python-control or SciPy
        Sampled system.
    rate : float [Hz]
        New sampling rate.
    method : {"hold", "tustin"}
        Method as in `continuous`, for both conversions.

    Returns
    -------
    StateSpace
        System with dt = 1 / rate.

    Raises
    ------
    ModelError
        As `continuous`.

    Examples
    --------
    >>> import flexplant as fx
    >>> slow = fx.lti.discretized(fx.lti.tf([1.0], [1.0, 1.0]), 10.0)
    >>> fx.lti.resampled(slow, 20.0).poles().real.round(6)  # exp(-1 / 20)
    array([0.951229])
    """
    found = continuous(sys, method=method)
    positive(rate, "rate")
    return tustin(found, rate) if method == "tustin" else held_exactly(found, rate)


def descriptor(
    A: npt.ArrayLike,
    B: npt.ArrayLike,
    C: npt.ArrayLike,
    D: npt.ArrayLike,
    *,
    E: npt.ArrayLike,
    dt: float = 0.0,
) -> StateSpace:
    """Return the state space of a descriptor system; equations without a derivative are solved.

    The system is ``E dx/dt = A x + B u, y = C x + D u``; if it is sampled, ``E x[k+1]`` replaces
    ``E dx/dt``. A singular value decomposition of E divides the states into x_1, whose derivatives
    occur in the equations, and x_2, whose derivatives do not occur. The equations without a
    derivative, ``0 = A_21 x_1 + A_22 x_2 + B_2 u``, give x_2.

    Parameters
    ----------
    A, B, C, D, E : (n, n), (n, m), (p, n), (p, m), (n, n) arrays
        E may be singular; D may be the number 0.
    dt : float [s]
        Sampling time; 0 for continuous time.

    Returns
    -------
    StateSpace
        System with a number of states equal to the rank of E.

    Raises
    ------
    ShapeError, ModelError
        When sizes do not match, or the equations do not determine x_2. In the second case the
        system would differentiate its inputs (its index is above 1), or has no unique solution.

    Examples
    --------
    >>> import flexplant as fx
    >>> fx.lti.descriptor([[-1, 1], [0, -1]], [[0], [1]], [[1, 0]], 0, E=[[1, 0], [0, 0]])
    <StateSpace: 1 state, continuous, u1 -> y1>
    """
    a = real_array(A, "A", (None, None))
    n = len(a)
    a, e = real_array(A, "A", (n, n)), real_array(E, "E", (n, n))
    b, c = real_array(B, "B", (n, None)), real_array(C, "C", (None, n))
    d = np.zeros((len(c), b.shape[1])) + real_array(D, "D")
    # rows and columns are brought to even sizes first: the rank of E must not hang on units
    left, right = even_factors(np.abs(e) + np.abs(a))
    a, e, b, c = left[:, None] * a * right, left[:, None] * e * right, left[:, None] * b, c * right
    U, sizes, Vh = np.linalg.svd(e)
    r = int(np.sum(sizes > RANK * n * sizes.max(initial=0.0)))
    a, b, c = U.T @ a @ Vh.T, U.T @ b, c @ Vh.T
    slow, fast = slice(r), slice(r, n)
    if n > r and np.linalg.cond(a[fast, fast]) > 1.0 / (RANK * n):
        raise ModelError(
            f"the {n - r} equations without a derivative do not determine as many unknowns: the "
            "system differentiates its inputs, or its equations are not independent. Remove the "
            "constraint that is differentiated from the model."
        )
    # what x_2 is of x_1 and of u
    of_x, of_u = (-np.linalg.solve(a[fast, fast], part[fast]) for part in (a[:, slow], b))
    a, b = a[slow, slow] + a[slow, fast] @ of_x, b[slow] + a[slow, fast] @ of_u
    d, c = d + c[:, fast] @ of_u, c[:, slow] + c[:, fast] @ of_x
    return StateSpace(a / sizes[slow, None], b / sizes[slow, None], c, d, dt)


def even_factors(sizes: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Return factors for rows and columns that bring the largest entries near 1."""
    left, right = np.ones(sizes.shape[0]), np.ones(sizes.shape[1])
    for _ in range(3):  # two rounds bring alternating maxima within a factor of two
        scaled = left[:, None] * sizes * right
        rows = scaled.max(axis=1, initial=0.0)
        left /= np.sqrt(np.where(rows > 0, rows, 1.0))
        columns = (left[:, None] * sizes * right).max(axis=0, initial=0.0)
        right /= np.sqrt(np.where(columns > 0, columns, 1.0))
    return left, right

"""How far a loop is from instability, and how fast it is."""

from __future__ import annotations

import numpy as np

from ..errors import AssumptionError
from ..values import ComplexArray, FloatArray
from .broken import BrokenLoop, inverted, largest
from .sensitivity import Loop, taken_apart


def modulus_margin(loop: Loop) -> float:
    """Return ``1 / max_f sigma_max(S_u)``, the smallest distance to the critical point at u.

    Parameters
    ----------
    loop : ClosedLoop, or (plant, controller)
        As for `loop_gain`. An unstable loop has no margin: 0. For a measured plant the peak is
        that over its lines and through the modes that these show between them; its stability, and
        what the lines leave open, is found by `report_loops`. Where the actuators have several
        units (N and N m) it is the margin with scaled axes, `LoopReport.scaled_margin`.

    Returns
    -------
    float
        At most 1 for sampled loops; |S| below 6 dB is a margin above 0.5.

    Raises
    ------
    LabelError, ModelError
        When channels do not match, or `loop` is of another type.

    References
    ----------
    [Skogestad2005]_, section 2.4 (its inverse, the peak of S).

    Examples
    --------
    >>> import flexplant as fx
    >>> plant = fx.testbeds.three_masses()
    >>> observer = fx.design_kalman(plant)
    >>> servo = fx.design_servo(plant, bandwidth=20.0, observer=observer)
    >>> round(fx.modulus_margin(fx.close_loop(plant, observer, servo)), 2)
    0.57
    """
    return taken_apart(loop).margin()


def bandwidth(loop: Loop) -> float:
    """Return the frequency [Hz] at which |S| first crosses 0 dB from below.

    |S| is the largest singular value of S broken at u, among the directions of u in which the loop
    acts at low frequency: with more actuators than controlled motions S = 1 in the others.

    Parameters
    ----------
    loop : ClosedLoop, or (plant, controller)
        As for `loop_gain`.

    Returns
    -------
    float [Hz]
        Infinite when |S| stays below 0 dB.

    Raises
    ------
    AssumptionError
        When the closed loop is not stable, or |S| is nowhere below 0 dB.
    LabelError, ModelError
        When channels do not match, or `loop` is of another type.

    Examples
    --------
    >>> import flexplant as fx
    >>> plant = fx.testbeds.three_masses()
    >>> observer = fx.design_kalman(plant)
    >>> servo = fx.design_servo(plant, bandwidth=20.0, observer=observer)
    >>> round(fx.loop.bandwidth(fx.close_loop(plant, observer, servo)), 1)
    14.1
    """
    parts = taken_apart(loop)
    if parts.is_unstable:
        raise AssumptionError(
            "the closed loop is not stable, so |S| is the size of no response of it and gives no "
            "bandwidth. Stabilise it first: see loop.spectral_radius and loop.modulus_margin."
        )
    grid = parts.grid
    loop_low = parts.gain(grid[:1])[0]
    vectors, gains, _ = np.linalg.svd(loop_low)
    acting = np.asarray(vectors[:, gains >= 1e-6 * gains[0]], dtype=np.complex128)
    values = _sensitivity_along(acting, parts, grid)
    if not np.any(values < 1.0):
        raise AssumptionError(
            f"|S| is nowhere below 0 dB (least {values.min():.4g}): this feedback suppresses "
            "nothing, so it has no bandwidth. Check the sign of the controller, u = K y."
        )
    right = first_above(values)
    if right is None:
        return float("inf")
    low, high = float(grid[right - 1]), float(grid[right])
    for _ in range(6 if parts.measured is None else 0):
        inner = np.linspace(low, high, 17)
        first = int(np.argmax(_sensitivity_along(acting, parts, inner[1:]) >= 1.0))
        low, high = float(inner[first]), float(inner[first + 1])
    return high


def first_above(size: FloatArray) -> int | None:
    """Return where a size that was below 1 first is not, or None."""
    beyond = np.flatnonzero((size >= 1.0) & np.logical_or.accumulate(size < 1.0))
    return int(beyond[0]) if beyond.size else None


def _sensitivity_along(acting: ComplexArray, parts: BrokenLoop, grid: FloatArray) -> FloatArray:
    """Return sigma_max of S_u in the space of some orthonormal directions of u (columns)."""
    return largest(inverted(acting.conj().T @ parts.gain(grid) @ acting))

"""What a plant does near rest: the expansion of a function of s at zero, on circles around it."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import TypeAlias

import numpy as np

from ..arrays import ComplexArray, FloatArray, divisor
from ..errors import AssumptionError
from ..lti.statespace import StateSpace
from ..tolerances import ROOT, SAME, TYPED
from .axes import apart, complex_gain, felt, resting_frequency
from .partitioned import Partition

#: a function of s, real on the real axis, to an array of any shape
OfS: TypeAlias = Callable[[complex], ComplexArray]

#: points on a circle of Cauchy's integrals
_SAMPLES = 16
#: largest radius [rad/s]: 1 kHz, above the bandwidth of any motion; how often it is halved, to 5e-6
_LARGEST, _RADII = 6e3, 30
#: where the expansion is compared with the function, relative to the radius: in decades, so that
#: poles far inside of the circle are noticed too
_INSIDE = np.logspace(-1, -4, 4)
#: terms that are compared: eight lack 0.1^8 of a function that is regular within the circle
_TERMS = 8


def at_rest(find: OfS, dt: float, axes: Sequence[str], count: int = 5) -> FloatArray:
    """Return k_0, k_1, ... (..., count) of an inverse ``F(s) = k_0 + k_1 s + ...`` around rest.

    They are those on the largest circle within which F has no pole: two circles agree, which they
    also do where both enclose the same poles, and the expansion is F inside of them.
    """
    radius = min(_LARGEST, 0.5 / dt) if dt else _LARGEST
    powers = np.arange(_TERMS)
    outer = _on_circle(find, radius)
    for _ in range(_RADII):
        inner = _on_circle(find, 0.5 * radius)
        size = np.abs(outer) * radius**powers
        scale = divisor(size.max(axis=tuple(range(1, size.ndim)), keepdims=True))
        low = (0.5 * radius) ** powers
        same = np.abs(outer - inner)[..., :count] * low[:count] <= ROOT * scale
        terms = np.where(np.abs(inner) * low <= ROOT * scale, 0.0, inner)
        if np.all(same) and _is_inside(find, terms, 0.5 * radius):
            return np.asarray(terms[..., :count])
        outer, radius = inner, 0.5 * radius
    raise AssumptionError(
        f"the response of {', '.join(axes)} to the actuators has no inverse that is regular at low "
        "frequency: there is a zero at rest. Check which axes the actuators move."
    )


def _is_inside(find: OfS, terms: FloatArray, radius: float) -> bool:
    """Return whether an expansion is the function inside the circle."""
    for part in _INSIDE:
        s = part * radius
        wanted = find(complex(s)).real
        found = terms @ s ** np.arange(terms.shape[-1])
        scale = np.abs(wanted).max(axis=tuple(range(1, wanted.ndim)), keepdims=True)
        if not np.all(np.abs(found - wanted) <= TYPED * divisor(scale)):
            return False
    return True


def _on_circle(find: OfS, radius: float) -> FloatArray:
    """Return k_m = sum F(s_i) s_i^-m / N over N points of a circle (the lower half conjugate)."""
    turns = np.exp(2j * np.pi * (np.arange(_SAMPLES // 2) + 0.5) / _SAMPLES)
    values = np.array([find(radius * complex(turn)) for turn in turns])
    powers = turns[:, None] ** -np.arange(_TERMS)
    summed = np.einsum("t...,tm->...m", values, powers).real
    return np.asarray(2.0 / _SAMPLES * summed / radius ** np.arange(_TERMS))


def solved(G: ComplexArray, wanted: ComplexArray, axes: Sequence[str]) -> ComplexArray:
    """Return ``G^-1 wanted`` of square G (..., r, r), which has to be regular."""
    rows = np.max(np.abs(G), axis=-1, keepdims=True)
    columns = np.max(np.abs(G), axis=-2, keepdims=True)
    flat = rows.min(initial=1.0) <= 0 or columns.min(initial=1.0) <= 0
    if flat or np.max(np.linalg.cond(G / np.sqrt(rows * columns))) > 1.0 / SAME:
        raise AssumptionError(
            f"the actuators do not move {', '.join(axes)} apart from each other, so that there is "
            "no inverse. Choose other axes."
        )
    return np.asarray(
        np.linalg.solve(G, np.broadcast_to(wanted, (*G.shape[:-2], *wanted.shape[-2:])))
    )


def moved_at_rest(plant: Partition, channels: Sequence[str], forces: Sequence[str]) -> FloatArray:
    """Return the independent motions (p, r) of channels that forces make at rest.

    Each is one unit of a channel that the forces move apart from those before it: of a free body
    its rigid-body motions, and not what the forces bend, which is far smaller at rest.
    """
    G = felt(plant, 2.0 * np.pi * resting_frequency(plant), channels, forces)
    chosen: list[int] = []
    for i in range(len(channels)):
        if apart(G[[*chosen, i]]):
            chosen.append(i)
    if not chosen:
        return np.zeros((len(channels), 0))
    axes = [channels[i] for i in chosen]
    T = np.asarray(np.linalg.pinv(G[chosen]), dtype=np.float64)
    return followed_at_rest(plant.system, T, forces, axes, channels, plant.dt)[..., 0]


def followed_at_rest(
    g: StateSpace,
    T: FloatArray,
    inputs: Sequence[str],
    axes: Sequence[str],
    seen: Sequence[str],
    dt: float,
    count: int = 1,
) -> FloatArray:
    """Return where outputs are (p, r, count) by derivatives of each axis: ``G_y T (G_z T)^-1``."""
    names = [*axes, *seen]

    def found(s: complex) -> ComplexArray:
        both = complex_gain(g, s, names, inputs) @ T
        moved, seen_there = both[: len(axes)], both[len(axes) :]
        return np.asarray(np.linalg.solve(moved.T, seen_there.T).T, dtype=np.complex128)

    return at_rest(found, dt, axes, count)

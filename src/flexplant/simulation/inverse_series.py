"""The inverse of a response as a power series in s, by Cauchy's integrals on a circle."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import TypeAlias

import numpy as np

from ..errors import AssumptionError
from ..values import ComplexArray, FloatArray

#: points on a circle of Cauchy's integrals; its largest radius [rad/s], and how often it is halved
_SAMPLES, _LARGEST, _RADII = 16, 6e3, 24
#: relative: two circles give the same coefficients
_SAME = 1e-8
#: condition above which a response counts as singular
_SINGULAR = 1e9
#: the response of a POI to forces, and what is to follow, at s
Inverse: TypeAlias = Callable[[complex], tuple[ComplexArray, ComplexArray]]


def coefficients(find: Inverse, dt: float, axes: Sequence[str]) -> FloatArray:
    """Return k_0, ..., k_4 (p, r, 5) of F(s), G F = rhs, on the largest circle that allows it."""
    radius = min(_LARGEST, 0.5 / dt) if dt else _LARGEST
    powers = np.arange(5)
    outer = _on_circle(find, radius, axes)
    for _ in range(_RADII):
        inner = _on_circle(find, 0.5 * radius, axes)
        size = np.abs(outer) * radius**powers
        scale = size.max(axis=(1, 2), keepdims=True)
        if np.all(np.abs(outer - inner) * (0.5 * radius) ** powers <= _SAME * scale):
            inner[np.abs(inner) * (0.5 * radius) ** powers <= _SAME * scale] = 0.0
            return inner
        outer, radius = inner, 0.5 * radius
    raise AssumptionError(
        f"the response from forces along {', '.join(axes)} to the POI has no inverse that is "
        "regular at low frequency: there is a zero at rest. Check which axes the actuators move."
    )


def _on_circle(find: Inverse, radius: float, axes: Sequence[str]) -> FloatArray:
    """Return k_m = sum F(s_i) s_i^-m / N over N points of a circle (the lower half conjugate)."""
    turns = np.exp(2j * np.pi * (np.arange(_SAMPLES // 2) + 0.5) / _SAMPLES)
    values = []
    for turn in turns:
        G, wanted = find(radius * complex(turn))
        rows = np.max(np.abs(G), axis=2, keepdims=True)
        columns = np.max(np.abs(G), axis=1, keepdims=True)
        flat = rows.min(initial=1.0) <= 0 or columns.min(initial=1.0) <= 0
        if flat or np.max(np.linalg.cond(G / np.sqrt(rows * columns))) > _SINGULAR:
            raise AssumptionError(
                f"the forces along {', '.join(axes)} do not move these axes of the POI apart from "
                "each other, so that there is no inverse. Choose other axes of the POI."
            )
        values.append(
            np.linalg.solve(G, np.broadcast_to(wanted, (len(G), *wanted.shape[-2:])))[..., 0]
        )
    F = np.array(values)[..., None] * (turns[:, None] ** -np.arange(5))[:, None, None, :]
    return np.asarray(2.0 / _SAMPLES * F.sum(axis=0).real / radius ** np.arange(5))

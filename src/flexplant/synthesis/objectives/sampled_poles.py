"""Regions of sampled poles: convex sets of z inside what damping and bandwidth allow."""

from __future__ import annotations

from itertools import pairwise
from typing import NamedTuple

import numpy as np

#: angles of z [rad] of the corners of a polygon inside the spiral of a damping ratio
_ANGLES = (0.0, 0.05, 0.2, 0.6, 1.3)
#: centres that are tried for a disc, and points of the curve that it stays inside
_CENTRES, _POINTS = 200, 2000


class PoleEdge(NamedTuple):
    """The half planes ``x Re z + y |Im z| <= most``."""

    x: float
    y: float
    most: float


class PoleDisc(NamedTuple):
    """``|z - centre| <= radius``."""

    centre: float
    radius: float


def damped(ratio: float) -> list[PoleEdge]:
    """Return the edges of a polygon in which poles z have at least a damping ratio.

    ``z = e^(s dt)`` of that ratio is the spiral ``|z| = e^(-a phi)``, phi = |arg z|,
    a = ratio / (1 - ratio^2)^(1/2); from phi = 0 on it is convex, up to where the real part is that
    of its end on the negative axis. Its chords are the edges.
    """
    from scipy.optimize import brentq

    a = ratio / np.sqrt(1.0 - ratio**2)
    end = -np.exp(-a * np.pi)
    leftmost = np.pi - np.arctan(a)  # where the real part of the spiral is least
    last = float(brentq(lambda phi: np.exp(-a * phi) * np.cos(phi) - end, 0.5 * np.pi, leftmost))
    phi = np.array([*_ANGLES, 0.5 * (_ANGLES[-1] + last), last])
    z = np.exp((1j - a) * phi)
    edges = [PoleEdge(-1.0, 0.0, float(-end))]
    for p, q in pairwise(z):
        normal = -1j * (q - p) / abs(q - p)  # to the right of the way, away from the origin
        most = float((np.conj(normal) * p).real)
        edges.append(PoleEdge(float(normal.real), float(normal.imag), most))
    return edges


def within(speed: float) -> PoleDisc:
    """Return the largest disc in which stable poles z have ``|log z|`` below a speed."""
    angle = np.linspace(0.5 * np.pi, np.pi, _POINTS)
    curve = np.exp(speed * np.exp(1j * angle))
    centres = np.linspace(np.exp(-speed), 1.0, _CENTRES)
    radii = np.min(np.abs(curve - centres[:, None]), axis=1)
    best = int(np.argmax(radii))
    return PoleDisc(float(centres[best]), float(radii[best]))

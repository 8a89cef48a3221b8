"""What machines are like: units in which a model has the density and wave speed of one."""

from __future__ import annotations

from typing import Any

import numpy as np

from ...sparse.factor import diagonal
from .check_facts import Facts

#: nodes that a mesh has at least; lumped models have no waves, and hardly a density
_MESH, _LUMPED = 20, (1e-5, 1e5)
#: density [kg/m^3] in the box around all DOFs, or in the cube of its diagonal where it is flat
_DENSITY, _FLAT = (5.0, 3e4), (1e-2, 3e4)
#: speed of longitudinal waves [m/s] in what machines are made of, and in a plate over its density
_SPEED, _PER_DENSITY = (300.0, 2e4), (0.1, 40.0)
#: sqrt(K_ii / M_ii) times the distance h of nodes, over the speed c, in a mesh of cubes
_SOLID = 2.42
#: sqrt(K_ii / M_ii) h^2 over the thickness times c, of transverse motion in a mesh of plates
_PLATE = 2.02
#: what the numbers may be in place of SI: factors of density and of speed that it would explain
_UNITS = (
    (-9, 3.0, "the coordinates are in mm, the rest in SI", "dofs.replace(xyz=dofs.xyz / 1000)"),
    (-12, 3.0, "all is in mm, t and s (N, MPa)", "converted(length='mm', mass='t')"),
    (-9, 1.5, "lengths are in mm, K in N/mm, but M in kg", "divide M by 1000: mm, t, s"),
    (-9, 0.0, "all is in mm, kg and ms (kN)", "converted(length='mm', mass='kg', time='ms')"),
    (0, -1.5, "K is in N/mm, the rest in SI", "multiply K by 1000"),
    (0, 1.5, "K is 1000 times too large", "divide K by 1000"),
    (-3, 1.5, "M is in t, the rest in SI", "multiply M by 1000"),
    (3, -1.5, "M is in g, the rest in SI", "divide M by 1000"),
)


def unusual(found: Facts) -> tuple[str, str] | None:
    """Return what is odd about density and wave speed, and what to do; None where nothing is.

    The speed follows from neighbours: ``c = sqrt(K_ii / M_ii) h / 2.4`` in solids, h the distance
    of nodes. A plate of areal mass m'' that has transverse motion only shows ``c / density =
    sqrt(K_ii / M_ii) h^2 / (2 m'')``. Both come from local entries: supports do not matter.
    """
    from scipy.spatial import cKDTree

    dofs, M = found.given.dofs, found.given.M
    known = np.isfinite(found.body.mass)
    if dofs is None or M is None or not found.given.located or not known.any():
        return None
    points = np.unique(dofs.xyz, axis=0)
    size, mass = np.ptp(points, axis=0), float(found.body.mass[known].max())
    if len(points) < 2 or mass <= 0:
        return None
    distances: Any = cKDTree(points).query(points, k=2)[0]
    h = float(np.median(distances[:, 1]))
    stiff, heavy = diagonal(found.given.K), diagonal(M)
    straight = (dofs.kinds < 3) & (stiff > 0) & (heavy > 0)
    if not straight.any():
        return None
    rate = float(np.median(np.sqrt(stiff[straight] / heavy[straight])))
    filled = bool(np.all(size > 1e-6 * size.max()))
    volume = float(np.prod(size)) if filled else float(np.linalg.norm(size)) ** 3
    density, dense = mass / volume, _DENSITY if filled else _FLAT
    kinds = set(dofs.kinds.tolist())
    if len(points) < _MESH:
        dense, kinds = _LUMPED, set()
    if filled and {0, 1, 2} <= kinds:
        speed, range_of = rate * h / _SOLID, _SPEED
        shown = f"waves at {speed:.3g} m/s"
    elif not filled and len(kinds & {0, 1, 2}) == 1 and len(kinds & {3, 4, 5}) == 2:
        area = float(np.prod(np.sort(size)[1:]))
        speed, range_of = rate * h**2 * area / mass / _PLATE, _PER_DENSITY
        shown = f"a wave speed of {speed:.3g} m/s over the density in kg/m^3"
    else:
        speed, range_of, shown = np.nan, (0.0, np.inf), ""
    slow, fast = range_of
    light, solid = dense
    if light <= density <= solid and (np.isnan(speed) or slow <= speed <= fast):
        return None
    within = "the box of all DOFs" if filled else "a cube of its size"
    text = f"{density:.3g} kg/m^3 in {within}" + (f", {shown}" if shown else "")
    # of a plate the speed over the density counts, and its density is that of a thinner one
    explained = [
        (cause, step)
        for mass_power, speed_power, cause, step in _UNITS
        if light <= density / 10.0**mass_power <= solid
        and (
            np.isnan(speed)
            or slow <= speed / 10.0 ** (speed_power - (0 if filled else mass_power)) <= fast
        )
    ]
    if not explained:
        return f"{text}: no material is like that", "K, M and coordinates in different units?"
    return (
        f"{text}: as if {' or '.join(cause for cause, _ in explained[:3])}",
        "; or ".join(step for _, step in explained[:3]),
    )

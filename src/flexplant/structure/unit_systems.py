"""Consistent unit systems: models in mm, t and s turned into SI, and recognised."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
import scipy.sparse as sp
from scipy import constants

from ..arrays import FloatArray, positive
from ..errors import ModelError, short
from ..labels import DofSet
from ..sparse.symmetric import diagonal
from ..tolerances import TYPED
from .rigid import RigidMass

#: size of each unit in metres, kilograms, seconds
LENGTHS: Mapping[str, float] = {
    "m": 1.0,
    "dm": constants.deci,
    "cm": constants.centi,
    "mm": constants.milli,
    "um": constants.micro,
    "in": constants.inch,
    "ft": constants.foot,
}
#: [kg], [m/s^2]: by definition
POUND, GRAVITY = constants.pound, constants.g
MASSES: Mapping[str, float] = {
    "kg": 1.0,
    "t": constants.metric_ton,
    "g": constants.gram,
    "mg": constants.micro,
    "lb": POUND,
    # lbf s^2/ft and lbf s^2/in: what makes pound-force consistent with feet and inches
    "slug": constants.slug,
    "slinch": constants.slinch,
}
TIMES: Mapping[str, float] = {"s": 1.0, "ms": constants.milli, "us": constants.micro}


@dataclass(frozen=True)
class Units:
    """One unit of length, mass and time of a foreign model, in SI.

    Forces follow, ``F = m L / t^2``: mm, t and s give N (and MPa); mm, kg and ms give kN.
    """

    length: float
    mass: float
    time: float

    @property
    def force(self) -> float:
        """One unit of force [N]."""
        return self.mass * self.length / self.time**2

    def matrices(self, given: Mapping[str, Any], dofs: DofSet) -> dict[str, Any]:
        """Return those of M (n, n), D and K that are given, in kg, N s/m, N/m times m or m^2."""
        factors = {"M": self.mass, "D": self.mass / self.time, "K": self.mass / self.time**2}
        return {name: self._scaled(A, dofs, factors[name]) for name, A in given.items()}

    def ground_load(self, load: FloatArray, dofs: DofSet) -> FloatArray:
        """Return loads (n, 6) of the six rigid-body accelerations in kg, kg m, kg m^2."""
        rows = self.length / self.of_dofs(dofs)
        return np.asarray(load * np.outer(rows, [1.0] * 3 + [self.length] * 3) * self.mass)

    def of_dofs(self, dofs: DofSet) -> FloatArray:
        """Return one unit of each DOF (n,): metres for displacements, 1 rad for rotations."""
        return np.where(dofs.kinds < 3, self.length, 1.0)

    def placed(self, dofs: DofSet) -> DofSet:
        """Return the DOFs with their coordinates in metres."""
        if self.length == 1.0:
            return dofs
        if dofs.interpolation is not None:
            raise ModelError(
                f"the DOFs carry a {type(dofs.interpolation).__name__}, whose nodes are in "
                "the old unit of length. Convert first and interpolate after: "
                "interpolated(model.replace(dofs=dofs.replace(interpolation=None)).converted(...))."
            )
        return dofs.replace(xyz=self.length * dofs.xyz)

    def _scaled(self, given: Any, dofs: DofSet, factor: float) -> Any:
        # rows are forces, or moments for rotations; columns displacements, or rotations: each
        # rotation brings one length more, and work is the same for all
        unit: Any = self.length / self.of_dofs(dofs)
        dense = not sp.issparse(given)
        if dense:
            return np.asarray(given) * (np.outer(unit, unit) * factor)
        # entry by entry, so that a symmetric matrix stays so to the last bit
        listed = given.tocoo()
        weight = unit[listed.row] * unit[listed.col] * factor
        return sp.csc_array((listed.data * weight, (listed.row, listed.col)), listed.shape)


def units(length: Any = "m", mass: Any = "kg", time: Any = "s") -> Units:
    """Return a unit system by the names of its units, or by their size in SI."""
    return Units(
        _unit_size(length, "length", LENGTHS),
        _unit_size(mass, "mass", MASSES),
        _unit_size(time, "time", TIMES),
    )


def _unit_size(given: Any, name: str, known: Mapping[str, float]) -> float:
    if not isinstance(given, str):
        return positive(given, name)
    if given not in known:
        raise ModelError(
            f"{name} {short(given)} is not a known unit: {', '.join(known)}. Pass one of these, "
            f"or the size of the unit in {next(iter(known))} as a number. The unit of force "
            "follows from length, mass and time: N from mm, t and s."
        )
    return known[given]


#: least number of nodes of a mesh; lumped models have no waves and no meaningful density
_MESH, _LUMPED = 20, (1e-5, 1e5)
#: density [kg/m^3] in the box around all DOFs, or in the cube of its diagonal where it is flat
_DENSITY, _FLAT = (5.0, 3e4), (1e-2, 3e4)
#: speed of longitudinal waves [m/s] in machine materials, and this speed over density for a plate
_SPEED, _PER_DENSITY = (300.0, 2e4), (0.1, 40.0)
#: sqrt(K_ii / M_ii) times the distance h of nodes, over the speed c, in a mesh of cubes
_SOLID = 2.42
#: sqrt(K_ii / M_ii) h^2 over the thickness times c, of transverse motion in a mesh of plates
_PLATE = 2.02
#: possible mistakes of units: factors of density and of wave speed that they would explain
_UNITS = (
    (-9, 3.0, "the coordinates are in mm, the rest in SI", "dofs.replace(xyz=dofs.xyz / 1000)"),
    (-12, 3.0, "all values are in mm, t and s (N, MPa)", "converted(length='mm', mass='t')"),
    (-9, 1.5, "lengths are in mm, K in N/mm, but M in kg", "divide M by 1000: mm, t, s"),
    (
        -9,
        0.0,
        "all values are in mm, kg and ms (kN)",
        "converted(length='mm', mass='kg', time='ms')",
    ),
    (0, -1.5, "K is in N/mm, the rest in SI", "multiply K by 1000"),
    (0, 1.5, "K is 1000 times too large", "divide K by 1000"),
    (-3, 1.5, "M is in t, the rest in SI", "multiply M by 1000"),
    (3, -1.5, "M is in g, the rest in SI", "divide M by 1000"),
)


def unusual(given: Any, body: RigidMass) -> tuple[str, str] | None:
    """Return a text on implausible density or wave speed of FEMatrices and what to do, or None."""
    # the speed follows from neighbours: `c = sqrt(K_ii / M_ii) h / 2.4` in solids, h the distance
    # of nodes. A plate of areal mass m'' that has transverse motion only shows
    # `c / density = sqrt(K_ii / M_ii) h^2 / (2 m'')`. Both come from local entries: supports do not
    # matter
    from scipy.spatial import cKDTree

    dofs, M, known = given.dofs, given.M, np.isfinite(body.mass)
    if dofs is None or M is None or not given.located or not known.any():
        return None
    points = np.unique(dofs.xyz, axis=0)
    size, mass = np.ptp(points, axis=0), float(body.mass[known].max())
    if len(points) < 2 or mass <= 0:
        return None
    distances: Any = cKDTree(points).query(points, k=2)[0]
    h = float(np.median(distances[:, 1]))
    stiff, heavy = diagonal(given.K), diagonal(M)
    straight = (dofs.kinds < 3) & (stiff > 0) & (heavy > 0)
    if not straight.any():
        return None
    rate = float(np.median(np.sqrt(stiff[straight] / heavy[straight])))
    filled = bool(np.all(size > TYPED * size.max()))
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
    # for a plate the ratio of speed to density counts, and its density is that of a thinner plate
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
        return f"{text}: this fits no material", "K, M and coordinates in different units?"
    return (
        f"{text}: as if {' or '.join(cause for cause, _ in explained[:3])}",
        "; or ".join(step for _, step in explained[:3]),
    )

"""Consistent unit systems: what turns a model in mm, t and s into one in SI."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any, TypeVar

import numpy as np
import scipy.sparse as sp

from ..checks import FloatArray, positive, short
from ..errors import ModelError
from ..labels import DofSet

#: one unit of it in metres, kilograms, seconds
LENGTHS: Mapping[str, float] = {
    "m": 1.0,
    "dm": 0.1,
    "cm": 1e-2,
    "mm": 1e-3,
    "um": 1e-6,
    "in": 0.0254,
    "ft": 0.3048,
}
_POUND = 0.45359237
_GRAVITY = 9.80665
MASSES: Mapping[str, float] = {
    "kg": 1.0,
    "t": 1e3,
    "g": 1e-3,
    "mg": 1e-6,
    "lb": _POUND,
    # lbf s^2/ft and lbf s^2/in: what makes pound-force consistent with feet and inches
    "slug": _POUND * _GRAVITY / 0.3048,
    "slinch": _POUND * _GRAVITY / 0.0254,
}
TIMES: Mapping[str, float] = {"s": 1.0, "ms": 1e-3, "us": 1e-6}

AnyMatrix = TypeVar("AnyMatrix")


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

    def mass_matrix(self, M: AnyMatrix, dofs: DofSet) -> AnyMatrix:
        """Return a mass matrix (n, n) in kg, kg m, kg m^2."""
        return self._scaled(M, dofs, self.mass)

    def damping_matrix(self, D: AnyMatrix, dofs: DofSet) -> AnyMatrix:
        """Return a damping matrix (n, n) in N s/m, N s, N m s."""
        return self._scaled(D, dofs, self.mass / self.time)

    def stiffness_matrix(self, K: AnyMatrix, dofs: DofSet) -> AnyMatrix:
        """Return a stiffness matrix (n, n) in N/m, N, N m."""
        return self._scaled(K, dofs, self.mass / self.time**2)

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

    def _scaled(self, matrix: AnyMatrix, dofs: DofSet, factor: float) -> AnyMatrix:
        # rows are forces, or moments for rotations; columns displacements, or rotations: each
        # rotation brings one length more, and work is the same for all
        unit: Any = self.length / self.of_dofs(dofs)
        given: Any = matrix
        scaled: Any
        if sp.issparse(matrix):
            # entry by entry, so that a symmetric matrix stays so to the last bit
            listed: Any = given.tocoo()
            weight = unit[listed.row] * unit[listed.col] * factor
            scaled = sp.csc_array((listed.data * weight, (listed.row, listed.col)), listed.shape)
        else:
            scaled = np.asarray(given) * (np.outer(unit, unit) * factor)
        result: AnyMatrix = scaled
        return result


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
            f"{name} {short(given)} is no unit known here: {', '.join(known)}. Pass one of these, "
            f"or the size of the unit in {next(iter(known))} as a number."
        )
    return known[given]

"""Gramians of the elastic modes: how much sensors see of them and actuators move them."""

from __future__ import annotations

from dataclasses import dataclass
from typing import ClassVar

import numpy as np

from ..errors import ModelError
from ..plant import StandardPlant
from ..values import FloatArray, one_of
from .criterion import Criterion

_MEASURES = ("trace", "log det", "least")


@dataclass(frozen=True, eq=False)
class _Gramian(Criterion):
    """Minus a measure of a Gramian; the base of both.

    Parameters
    ----------
    measure : {"trace", "log det", "least"}
        Sum of the eigenvalues, sum of their logarithms, or the least one.
    """

    measure: str = "log det"

    def __post_init__(self) -> None:
        self._set(measure=one_of(self.measure, "measure", _MEASURES))

    def __call__(self, plant: StandardPlant) -> float:
        """Return minus the measure: infinite where a mode is missed, for log det."""
        sizes = np.linalg.eigvalsh(self.matrix(plant))
        if self.measure == "trace":
            return -float(np.sum(sizes))
        if self.measure == "least":
            return -float(sizes[0])
        # what rounding leaves of an eigenvalue of zero is zero
        if sizes[0] <= 1e-13 * sizes[-1]:
            return np.inf
        return -float(np.sum(np.log(sizes)))

    def matrix(self, plant: StandardPlant) -> FloatArray:
        """Return the Gramian (2 m, 2 m) of the m elastic modes."""
        real = plant.assembled.realisation
        start = 2 * real.n_rigid
        A, rows = real.A[start:, start:], self._rows(plant)[:, start:]
        if not A.size:
            raise ModelError("the plant has no elastic mode, so no Gramian. Keep some modes.")
        if self.sides == "u":
            A = A.T
        poles, modes = np.linalg.eig(A)
        part = rows @ modes
        W = -(part.conj().T @ part) / (poles.conj()[:, None] + poles)
        back = np.linalg.inv(modes)
        found = (back.conj().T @ W @ back).real
        return np.asarray(0.5 * (found + found.T))

    def _rows(self, plant: StandardPlant) -> FloatArray:
        raise NotImplementedError


@dataclass(frozen=True, eq=False)
class ModalObservability(_Gramian):
    """Minus a measure of the observability Gramian of the elastic modes, which sensors see.

    In continuous time, in states whose square is twice the energy of a mode, every entry of
    ``W_ij = -conj(c_i) c_j / (conj(lambda_i) + lambda_j)`` for the eigenvectors: modes of one
    frequency that are alike count as one, which the diagonal alone takes for two. Rigid-body modes,
    whose Gramian is infinite, are left out; filters and delays do not count.

    Parameters
    ----------
    measure : {"trace", "log det", "least"}
        Sum of the eigenvalues, sum of their logarithms, or the least one.

    Raises
    ------
    ModelError
        When the measure is none of these; when called, for a plant without elastic modes.
    """

    sides: ClassVar[str] = "y"

    def _rows(self, plant: StandardPlant) -> FloatArray:
        """Return one row per sensor, in units of its noise where it has any."""
        real = plant.assembled.realisation
        return np.array([s.see(real).row / (s.asd or 1.0) for s in plant.assembled.ports.y])


@dataclass(frozen=True, eq=False)
class ModalControllability(_Gramian):
    """Minus a measure of the controllability Gramian of the elastic modes, which actuators move.

    In continuous time, in states whose square is twice the energy of a mode, every entry of
    ``W_ij = -conj(c_i) c_j / (conj(lambda_i) + lambda_j)`` for the eigenvectors: modes of one
    frequency that are alike count as one, which the diagonal alone takes for two. Rigid-body modes,
    whose Gramian is infinite, are left out; filters and delays do not count.

    Parameters
    ----------
    measure : {"trace", "log det", "least"}
        Sum of the eigenvalues, sum of their logarithms, or the least one.

    Raises
    ------
    ModelError
        When the measure is none of these; when called, for a plant without elastic modes.
    """

    sides: ClassVar[str] = "u"

    def _rows(self, plant: StandardPlant) -> FloatArray:
        """Return one row per actuator: what a newton (newton metre) of it does."""
        real = plant.assembled.realisation
        return np.array([real.force(a.push(real)) for a in plant.assembled.ports.u])

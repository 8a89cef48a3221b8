"""The cost of LQG from one Riccati equation of the sensors and one of the actuators."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np
import numpy.typing as npt

from ..values import FloatArray
from .criterion import Scorer
from .quadratic import Quadratic, measured, quadratic


@dataclass(frozen=True, eq=False)
class Separation(Scorer):
    """``J = tr(S W) + tr(F' (I + b S b') F P_d) + c``: S, F of the actuators, P_d of the sensors.

    P_d is the covariance of the state predicted d samples ahead, ``A^d P A'^d`` and what is added
    meanwhile, P that of the filter.
    """

    A: FloatArray
    noise: FloatArray
    rows: FloatArray
    sensors: FloatArray
    actuators: FloatArray
    delay: int
    measuring: npt.NDArray[np.bool_]
    counts: tuple[int, int] | None = None

    def value(self, chosen: Sequence[int]) -> float:
        """Return the cost of sensors and actuators."""
        place = np.cumsum(self.measuring) - 1, np.cumsum(~self.measuring) - 1
        seeing = tuple(int(place[0][i]) for i in sorted(chosen) if self.measuring[i])
        pushing = tuple(int(place[1][i]) for i in sorted(chosen) if not self.measuring[i])
        S, V = self.control(pushing)
        return float(np.sum(S * self.W) + np.sum(V * self.ahead(self.covariance(seeing))))

    def bound(self, count: int, required: Sequence[int]) -> float:
        """Return the larger of two bounds: with all sensors, and with all actuators.

        Without numbers of each, the cost with all candidates.
        """
        if self.counts is None:
            return self.value(range(self.measuring.size))
        which = np.cumsum(self.measuring) - 1, np.cumsum(~self.measuring) - 1
        y = [int(which[0][i]) for i in required if self.measuring[i]]
        u = [int(which[1][i]) for i in required if not self.measuring[i]]
        return max(
            of_sensors(self).bound(self.counts[0], y), of_actuators(self).bound(self.counts[1], u)
        )

    @property
    def W(self) -> FloatArray:
        """The process noise."""
        return self.noise @ self.noise.T

    def ahead(self, P: FloatArray) -> FloatArray:
        """Return P_d."""
        for _ in range(self.delay):
            P = self.A @ P @ self.A.T + self.W
        return P

    def control(self, pushing: tuple[int, ...]) -> tuple[FloatArray, FloatArray]:
        """Return S and ``F' (I + b S b') F`` = ``H + A' S A - S`` of some actuators."""
        if pushing not in self._controls:
            b, S, _ = self._control.solution(pushing)
            scale = self._control.S.diagonal()
            S, b = S * scale * scale[:, None], b / scale
            seen = b @ S @ self.A
            inner = np.eye(len(b)) + b @ S @ b.T
            self._controls[pushing] = S, seen.T @ np.linalg.solve(inner, seen)
        return self._controls[pushing]

    def covariance(self, seeing: tuple[int, ...]) -> FloatArray:
        """Return the covariance of the estimate after the measurement by some sensors."""
        if seeing not in self._covariances:
            g, X, _ = self._filter.solution(seeing)
            _, after = measured(X, g)
            scale = self._filter.S.diagonal()
            self._covariances[seeing] = after * scale * scale[:, None]
        return self._covariances[seeing]

    @cached_property
    def _filter(self) -> Quadratic:
        return quadratic(self.A.T, self.W, np.eye(len(self.A)), self.sensors)

    @cached_property
    def _control(self) -> Quadratic:
        return quadratic(self.A, self.rows.T @ self.rows, np.eye(len(self.A)), self.actuators)

    @cached_property
    def _controls(self) -> dict[tuple[int, ...], tuple[FloatArray, FloatArray]]:
        return {}

    @cached_property
    def _covariances(self) -> dict[tuple[int, ...], FloatArray]:
        return {}


def of_sensors(p: Separation) -> Quadratic:
    """Return the cost as a function of the sensors beside all actuators of the problem."""
    S, V = p.control(tuple(range(len(p.actuators))))
    constant = float(np.sum(S * p.W) + np.sum(V * p.ahead(np.zeros_like(p.A))))
    looks = _root(V) @ np.linalg.matrix_power(p.A, p.delay)
    return quadratic(p.A.T, p.W, looks, p.sensors, constant=constant)


def of_actuators(p: Separation) -> Quadratic:
    """Return the cost as a function of the actuators beside all sensors of the problem.

    ``tr(S N) + tr(H P_d)`` with the innovations' covariance ``N = A^d (A P A' + W - P) A'^d``.
    """
    P = p.covariance(tuple(range(len(p.sensors))))
    power = np.linalg.matrix_power(p.A, p.delay)
    innovations = _root(power @ (p.A @ P @ p.A.T + p.W - P) @ power.T)
    seen = innovations @ p.rows.T
    constant = float(np.einsum("ij,jk,ik->", p.rows, p.ahead(P), p.rows) + np.sum(seen**2))
    H = p.rows.T @ p.rows
    return quadratic(p.A, H, innovations @ p.A.T, p.actuators, constant=constant)


def _root(X: FloatArray) -> FloatArray:
    """Return r with ``r' r = X``, which is positive semidefinite apart from rounding."""
    size = np.sqrt(np.maximum(X.diagonal(), 0.0))
    unit = np.where(size > 0, size, 1.0)
    values, vectors = np.linalg.eigh(0.5 * (X + X.T) / unit / unit[:, None])
    return np.asarray((vectors * np.sqrt(np.maximum(values, 0.0))).T * unit)

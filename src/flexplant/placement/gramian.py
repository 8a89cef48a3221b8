"""Gramians of the elastic modes, and scores that are sums over the chosen."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Any, ClassVar

import numpy as np

from ..arrays import CACHED, FloatArray, IntArray, divisor, one_of
from ..errors import AssumptionError, ModelError
from ..plant import SensorPort, StandardPlant
from ..plant.realisation import ModalRealisation
from ..store import checked
from ..tolerances import FOUR_DIGITS, NEGLIGIBLE, RANK, ROOT, TINY
from .candidates import Port
from .convex import Below, Branch, Convex, ascended, safe
from .criterion import Criterion, Scorer, by_size

MEASURES = ("trace", "log det", "least")


@dataclass(frozen=True, eq=False)
class SummedWorth(Scorer):
    """Minus the sum of a worth (N,) of each candidate; its bound is exact."""

    worth: FloatArray

    def score(self, sets: Sequence[Sequence[int]]) -> FloatArray:
        """Return the scores (n,) of choices, those of one size at once."""
        return by_size(sets, lambda rows: -self.worth[rows].sum(axis=1))

    def bound(self, count: int, required: Sequence[int]) -> float:
        """Return the score of the best choice, and what rounding may have added to it."""
        kept = list(required)
        free = np.sort(np.delete(self.worth, kept))[::-1]
        used = np.concatenate([self.worth[kept], free[: count - len(kept)]])
        return -float(used.sum() + RANK * np.abs(used).sum())


@dataclass(frozen=True, eq=False)
class SummedMatrices(Scorer):
    """Minus a measure of ``sum_i W_i`` over the chosen: W_i (N, n, n), positive semidefinite.

    It grows with each candidate: the bound is that of all of them.
    """

    matrices: FloatArray

    @property
    def total(self) -> int:
        """How many candidates there are."""
        return int(self.matrices.shape[0])

    def score(self, sets: Sequence[Sequence[int]]) -> FloatArray:
        """Return the scores (n,) of choices, those of one size at once."""
        n = self.matrices.shape[1]
        few = max(1, CACHED // (n * n))

        def of(rows: IntArray) -> FloatArray:
            parts = [self._measured(rows[i : i + few]) for i in range(0, len(rows), few)]
            return np.concatenate(parts)

        return by_size(sets, of)

    def bound(self, count: int, required: Sequence[int]) -> float:
        """Return a number below the score of every choice."""
        return float(safe(np.array(self.value(range(self.total)))))

    def _measured(self, rows: IntArray) -> FloatArray:
        """Return minus the measure of sums over rows (m, k) of indices."""
        return np.asarray(-np.linalg.eigvalsh(self._sums(rows))[:, 0])

    def _sums(self, rows: IntArray) -> FloatArray:
        total = self.matrices[rows[:, 0]]
        for j in range(1, rows.shape[1]):
            total += self.matrices[rows[:, j]]
        return np.asarray(total)


@dataclass(frozen=True, eq=False)
class LogDetOfSum(SummedMatrices, Convex):
    """Minus log det: convex in weights of the candidates, so that it has a relaxation.

    [JoshiBoyd2009]_.
    """

    bound = Convex.bound
    total = SummedMatrices.total

    def cost(self, weights: FloatArray) -> float:
        """Return it at weights (N,): infinite where log det has none."""
        found = self.climbed(weights)
        return np.inf if found is None else -found[0]

    def tangent(self, weights: FloatArray) -> Below:
        """Return the relaxed cost itself, which is cheap to compute."""
        return _LogDet(self)

    def relaxation(self, branch: Branch) -> tuple[float, FloatArray]:
        """Return a lower bound over a branch, and weights near the least relaxed cost."""
        weights = branch.centre(self.total)
        found, weights = self.tangent(weights).least(branch, weights)
        return max(found, self.everything()), weights

    def climbed(self, weights: FloatArray) -> tuple[float, FloatArray] | None:
        """Return log det at weights and its gradient ``tr(F^-1 W_i)``."""
        n = self.matrices.shape[1]
        F = (weights @ self.matrices.reshape(self.total, -1)).reshape(n, n)
        size = np.sqrt(np.maximum(F.diagonal(), TINY))
        sign, logs = np.linalg.slogdet(F / size / size[:, None])
        if sign <= 0:
            return None
        inverse = np.linalg.inv(F / size / size[:, None]) / size / size[:, None]
        rise = self.matrices.reshape(self.total, -1) @ inverse.ravel()
        return float(logs + 2.0 * np.sum(np.log(size))), rise

    def _measured(self, rows: IntArray) -> FloatArray:
        """Return minus log det of sums over rows (m, k) of indices, infinite where it has none."""
        total = self._sums(rows)
        size = np.sqrt(np.maximum(np.einsum("mii->mi", total), TINY))
        try:
            root = np.linalg.cholesky(total / size[:, :, None] / size[:, None, :])
            part = np.einsum("mii->mi", root)
            if np.all(part.min(axis=1) > FOUR_DIGITS):  # far from singular: nothing to decide
                return np.asarray(-2.0 * np.sum(np.log(part) + np.log(size), axis=1))
        except np.linalg.LinAlgError:
            pass
        values = np.linalg.eigvalsh(total)
        singular = values[:, 0] <= RANK * values[:, -1]
        with np.errstate(divide="ignore", invalid="ignore"):
            found = -np.sum(np.log(np.maximum(values, 0.0)), axis=1)
        return np.asarray(np.where(singular, np.inf, found))


class _LogDet(Below):
    """Minus log det as a function of weights: convex, and equal to the cost at choices."""

    def __init__(self, costs: LogDetOfSum) -> None:
        self.costs = costs
        self.rows = costs.matrices.reshape(costs.total, -1)

    def values(self, sets: Sequence[Sequence[int]]) -> FloatArray:
        """Return the costs (m,) of each choice."""
        return self.costs.score(sets)

    def least(self, branch: Branch, start: FloatArray) -> tuple[float, FloatArray]:
        """Return a number below the cost of all choices of a branch, and weights near the least."""
        # a weight of zero may make the sum singular, so that the start is moved inwards
        inner = 0.9 * branch.nearest(start) + 0.1 * branch.centre(start.size)
        most, weights = ascended(
            self.costs.climbed, branch, inner, close=lambda value, most: most - value <= NEGLIGIBLE
        )
        return -most - ROOT, weights


def sum_scorer(matrices: FloatArray, measure: str) -> Scorer:
    """Return the scorer of a measure of ``sum_i W_i``; the trace needs no matrices."""
    if measure == "trace":
        return SummedWorth(np.trace(matrices, axis1=1, axis2=2))
    return LogDetOfSum(matrices) if measure == "log det" else SummedMatrices(matrices)


def noise_sizes(ports: Sequence[Any]) -> FloatArray:
    """Return the densities (N,) of sensors; 1 of actuators, and of sensors if none has noise."""
    sizes = np.array([p.asd if isinstance(p, SensorPort) else 1.0 for p in ports])
    silent = [port.name for port, size in zip(ports, sizes, strict=True) if not size]
    if 0 < len(silent) < sizes.size:
        raise AssumptionError(
            f"sensors {', '.join(silent[:6])} have no noise (asd 0) while others have some: they "
            "would count without limit. Give all of them Sensor(..., asd=), or none."
        )
    return divisor(sizes)


@dataclass(frozen=True, eq=False)
class ModalGramian(Criterion):
    """Minus a measure of a Gramian of the elastic modes; the base of one for each side.

    The Gramian is that of the plant in continuous time. The states are scaled so that the sum of
    their squares is twice the energy of a mode. In coordinates of the eigenvectors its entries are
    ``W_ij = -conj(c_i) c_j / (conj(lambda_i) + lambda_j)``. All entries are used, not only the
    diagonal ones: two modes of equal frequency that a device cannot distinguish count as one mode.
    Rigid-body modes are left out, because their Gramian is infinite. Filters and delays are
    ignored. The Gramian of several devices is the sum of their separate Gramians. It tells
    hardly anything about the motion of a POI (point of interest), as `ModeInformation`.
    """

    scale: ClassVar[float] = 1.0
    measure: str = field(default="log det", metadata=checked(one_of, choices=MEASURES))

    def __call__(self, plant: StandardPlant) -> float:
        """Return minus the measure: infinite where a mode is missed, for log det."""
        return float(sum_scorer(self.matrix(plant)[None], self.measure).score([(0,)])[0])

    def matrix(self, plant: StandardPlant) -> FloatArray:
        """Return the Gramian (2 m, 2 m) of the m elastic modes."""
        ports = getattr(plant.assembled.ports, self.sides)
        return np.asarray(self._each(plant.assembled.realisation, ports).sum(axis=0))

    def scorer(self, plant: StandardPlant, candidates: Sequence[Port]) -> Scorer:
        """Return the measure of sums of the candidates' Gramians."""
        return sum_scorer(self._each(plant.assembled.realisation, candidates), self.measure)

    def _each(self, real: ModalRealisation, ports: Sequence[Any]) -> FloatArray:
        """Return the Gramians (N, 2 m, 2 m) of single ports."""
        start = 2 * real.n_rigid
        A = real.A[start:, start:]
        seeing = self.sides == "y"
        rows = [port.see(real).row if seeing else real.force(port.push(real)) for port in ports]
        part = np.array(rows)[:, start:] / noise_sizes(ports)[:, None]
        if not A.size:
            raise ModelError("the plant has no elastic mode, so no Gramian. Keep some modes.")
        poles, modes = np.linalg.eig(A if seeing else A.T)
        part = part @ modes
        sums = poles.conj()[:, None] + poles
        W = -(part.conj()[:, :, None] * part[:, None, :]) / sums
        back = np.linalg.inv(modes)
        found = (back.conj().T @ W @ back).real
        return np.asarray(0.5 * (found + found.transpose(0, 2, 1)))


@dataclass(frozen=True, eq=False)
class ModalObservability(ModalGramian):
    """Negative measure of the observability Gramian of the elastic modes, for sensors.

    The sign is negative because criteria are minimised. The signal of each sensor is divided by its
    noise density, if it has noise. The Gramian is that of the plant in continuous time, without
    filters and delays, see `ModalGramian`.

    Parameters
    ----------
    measure : {"trace", "log det", "least"}
        Measure of the Gramian: "trace" is the sum of its eigenvalues, "log det" (the default) the
        sum of their logarithms, and "least" the smallest eigenvalue.

    References
    ----------
    [Gawronski2004]_, chapter 4.

    Examples
    --------
    >>> import flexplant as fx
    >>> round(fx.placement.ModalObservability()(fx.testbeds.three_masses()), 3)
    -114.194
    """

    sides: ClassVar[str] = "y"


@dataclass(frozen=True, eq=False)
class ModalControllability(ModalGramian):
    """Negative measure of the controllability Gramian of the elastic modes, for actuators.

    The sign is negative because criteria are minimised. The unit of each input is 1 N or 1 N m. The
    Gramian is that of the plant in continuous time, without filters and delays, see `ModalGramian`.

    Parameters
    ----------
    measure : as for `ModalObservability`

    References
    ----------
    [Gawronski2004]_, chapter 4.

    Examples
    --------
    >>> import flexplant as fx
    >>> round(fx.placement.ModalControllability()(fx.testbeds.three_masses()), 3)
    18.994
    """

    sides: ClassVar[str] = "u"

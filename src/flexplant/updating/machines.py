"""Uncertainty of a machine after an update, as random draws of whole machines."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from typing import Any, NamedTuple

import numpy as np
import scipy.linalg as la

from ..arrays import FloatArray, whole
from ..errors import ModelError, counted
from ..identification import MeasuredModes
from ..modes import Modes
from ..modes.matching import ALIKE
from ..seeds import REFUSED
from ..store import Value
from ..tolerances import TYPED
from ..words import instance
from .parameters import AddedMass, Parameter, PointParameter
from .trend import Trend, trend_of

#: number of draws for an interval by a log-normal distribution: the deviation of the logarithm is
#: then known to 11 %
COUNT = 40


class Draw(NamedTuple):
    """One machine: deviation s, changes (p,) of all parameters, slope, fraction of it as mass.

    `damping` are the mean and deviation of the logarithm of a damping ratio over the model's.
    """

    deviation: float
    parameters: FloatArray
    slope: float
    as_mass: float
    damping: tuple[float, float]
    poles: Any
    rng: np.random.Generator


@dataclass(frozen=True, eq=False, repr=False)
class Machines(Value):
    """Uncertainty of a machine after an update: random draws of whole machines.

    A machine is the real structure, of which the model is an approximation. Each draw is one
    machine that agrees with the measurement `measured`. The object is the result of
    ``fit.machines(measured)`` and is passed to a plant by ``plant.uncertain(machines)``. A plant of
    ``fit.calibrated(measured)`` includes it automatically. Machines are drawn in modal coordinates
    of the plant's evaluation model. There, the mass matrix is the unit matrix I, and Omega is the
    diagonal matrix of the frequencies. Each draw has five steps:

    - The deviation s of frequencies, the changes dp of the parameters and the slope b are drawn
      from their posterior distribution (`Trend`).
    - The trend is ``t = sign(b) log(1 + 2 |b| g) / 2``, where g is the frequency of a mode divided
      by the largest measured frequency. In matrix equations t is the diagonal matrix of these
      values. A fraction r of the trend changes the mass, and the rest changes the stiffness. The
      fraction is uniformly distributed between 0 and 1.
    - The matrices are ``M' = exp(-r t) (I + sum dp dM) exp(-r t)`` and
      ``K' = Omega exp(E) Omega + sum dp dK``. The matrix E is symmetric. Its diagonal elements are
      ``2 (s e + (1 - r) t)`` with standard normal numbers e, and its other elements have the
      standard deviation ``sqrt(2) s``. Frequencies and shapes therefore change together. The
      element of E between a mode below the measured band and a mode in or above it is smaller, by
      the ratio of the two frequencies. Such a low mode is a motion on isolators, which strains
      other springs than the measured modes. The masses of rigid-body modes have the relative
      deviation 2 s, because they are not measured.
    - Where shapes were measured at known places, E is conditioned on them (Gaussian conditioning).
      The noise of the shapes is drawn from its posterior distribution, which the difference of
      measured and computed shapes gives. It contains errors of the model's shapes.
    - The poles of measured modes are drawn from their covariance. The damping ratios of other modes
      follow the predictive distribution (Student's) of the measured ratios.

    Errors that the evaluation model's mesh has above the measured band are not drawn. Take at least
    eight elements per bending wave at the sampling rate of the plant, and `Modes.extrapolated`.

    Parameters
    ----------
    fit : UpdateResult
        Result of the update.
    measured : MeasuredModes
        Measured modes, with the mode numbers of the updated model.
    count : int
        Number of machines that are drawn for the interval of a result.
    seed : int
        Seed of the random draws. Machine i is the same for every `count`.
    left_out : sequence of int
        Numbers of modes that do not matter: they need no measurement, and their measured poles are
        not used. `left_out` is set by plants (see `StandardPlant.machines`).

    Examples
    --------
    By default, 40 machines are drawn:

    >>> import flexplant as fx
    >>> drawing = fx.chain(masses=[1.0] * 5, stiffnesses=[4e5] * 4)
    >>> poles = [-3.9 + 390j, -7.4 + 743j, -10 + 1023j, -12 + 1202j]
    >>> measured = fx.MeasuredModes(poles, modes=[2, 3, 4, 5])
    >>> fit = fx.update(drawing, [fx.AddedMass("3:x")], [fx.Eigenvalues(measured)])
    >>> fit.machines(measured).count
    40
    """

    fit: Any
    measured: MeasuredModes
    count: int = COUNT
    seed: int = 0
    left_out: tuple[int, ...] = ()

    def __post_init__(self) -> None:
        instance(self.measured, MeasuredModes, "measured", "Pass identify_modes(frf), numbered.")
        self._set(
            count=whole(self.count, "count", minimum=2), seed=whole(self.seed, "seed", minimum=0)
        )

    @cached_property
    def trend(self) -> Trend:
        """Test for a residual of measured frequencies that grows with frequency; see `Trend`."""
        return trend_of(self.fit, self.measured, self.left_out)

    @cached_property
    def missing(self) -> str:
        """Reason why no interval of a result can be computed. It is empty if this is possible."""
        return self.trend.missing or next(iter(self.fit.unlike_shapes(self.measured)), "")

    def without(self, untouched: tuple[int, ...]) -> Machines:
        """Return the machines without those modes in the way of an interval that do not matter."""
        known: dict[tuple[int, ...], Machines] = self.__dict__.setdefault("_without", {})
        if untouched not in known:
            found = self
            while causes := {*found._causes} & {*untouched} - {*found.left_out}:
                numbers = found.measured.modes or ()
                kept = [i for i, number in enumerate(numbers) if number not in causes]
                if not kept:
                    break
                out = tuple(sorted({*found.left_out, *causes}))
                found = found.replace(measured=found.measured.select(kept), left_out=out)
            known[untouched] = found
        return known[untouched]

    @property
    def _causes(self) -> tuple[int, ...]:
        """Numbers of the modes that prevent an interval."""
        if self.trend.missing:
            return self.trend.in_the_way
        likeness = self.fit.likeness(self.measured)
        return tuple(mode for mode, mac in likeness.items() if mac < ALIKE)

    @cached_property
    def damping_changes(self) -> FloatArray:
        """Values of ``ln(zeta_measured / zeta_model)`` of the measured modes with damping."""
        poles = self.measured.poles
        found = -poles.real / np.abs(poles)
        return np.log(found[found > TYPED] / self._own_damping[found > TYPED])

    @cached_property
    def _own_damping(self) -> FloatArray:
        """Damping ratios of the model's measured modes; 1 where it has none."""
        modes: Modes = self.fit.modes()
        zeta = np.array([modes.zeta[number - 1] for number in self.measured.modes or ()])
        return np.where(zeta > TYPED, zeta, 1.0)

    def draw(self, rng: np.random.Generator) -> Draw:
        """Return a random draw of one machine. Draws with a negative added mass are repeated."""
        for _ in range(REFUSED):
            s, moved, b = self.trend.posterior(rng)
            dp = np.zeros(self.fit.values.size)
            dp[list(self.trend.moves)] = moved
            masses = (
                value + change >= 0.0
                for q, value, change in zip(self.fit.unknowns, self.fit.values, dp, strict=True)
                if isinstance(q, AddedMass)
            )
            if all(masses):
                return Draw(s, dp, b, rng.random(), self._damping(rng), self._poles(rng), rng)
        raise ModelError(
            f"{REFUSED} consecutive draws have a negative added mass: nothing was added there, "
            "or the model has another error. Leave the parameter out."
        )

    def _damping(self, rng: np.random.Generator) -> tuple[float, float]:
        """Return mean and deviation of log damping, from the posterior of the measured ones."""
        known = self.damping_changes
        if known.size < 2:
            return 0.0, 0.0
        dof = known.size - 1
        size = float(np.std(known, ddof=1)) * np.sqrt(dof / rng.chisquare(dof))
        return float(known.mean() + size / np.sqrt(known.size) * rng.standard_normal()), float(size)

    def _poles(self, rng: np.random.Generator) -> Any:
        """Return the measured poles, drawn from their covariance where they have one."""
        poles, covariance = self.measured.poles, self.measured.covariance
        if covariance is None:
            return poles
        moved = la.cholesky(covariance, lower=True) @ rng.standard_normal(2 * poles.size)
        found = poles + moved[: poles.size] + 1j * moved[poles.size :]
        return np.minimum(found.real, 0.0) + 1j * found.imag

    def located(self) -> list[Parameter]:
        """Return the parameters with points in place of DOF labels, for use with other meshes."""
        model = self.fit.model
        dofs = getattr(model, "full_dofs", None) or model.dofs
        return [_located(q, dofs) for q in self.fit.unknowns]

    def __repr__(self) -> str:
        trend = self.trend
        if self.missing:
            return f"<Machines: no interval: {self.missing}>"
        return (
            f"<Machines: {counted(self.count, 'draw')} of {len(trend.modes)} measured modes, "
            f"frequencies +- {100 * trend.deviation:.2g} %, {trend.dof} dof>"
        )


def _located(parameter: Parameter, dofs: Any) -> Parameter:
    """Return a parameter at a point where its label is; others as they are."""
    if not isinstance(parameter, PointParameter):
        return parameter
    at = parameter.at
    if isinstance(at, str) and parameter.to is None:
        place = dofs.index(at)
        return parameter.replace(
            at=tuple(dofs.xyz[place].tolist()), direction=dofs.directions[place]
        )
    return parameter

"""Uncertainty of a machine after an update: trend of the residual, and draws of whole machines."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from functools import cached_property
from typing import Any, NamedTuple

import numpy as np
import scipy.linalg as la

from ..arrays import REFUSED, FloatArray, instance, whole
from ..errors import ModelError, counted
from ..identification import MeasuredModes
from ..modes import Modes
from ..modes.matching import ALIKE
from ..store import Value
from ..tolerances import INTERVAL, ROUNDING, TINY, TYPED
from .parameters import AddedMass, Parameter, PointParameter
from .residuals.residual import eigenvalue_sensitivities

#: probability that chance alone rejects a slope or a mode: three standard deviations
LEVEL = 0.003
#: gap of two modes, in deviations of a frequency, below which scatter mixes their shapes by more
#: than a tenth: sqrt(2) over the gap
MIXED = 14.0


class _Regression(NamedTuple):
    """Estimates (q + 1,) of dp and b, a root of their covariance over s^2, and what is left.

    `free` is the fraction of a deviation of each row that is left.
    """

    found: FloatArray
    root: FloatArray
    left: FloatArray
    free: FloatArray


@dataclass(frozen=True, eq=False, repr=False)
class Trend(Value):
    """Residual of measured frequencies, regressed on the parameters and on frequency.

    For m measured modes the regression is ``log(f_measured / f_model) = S dp + b g + s e``. S
    contains the derivatives of the logarithms of the model's frequencies with respect to the q
    parameters that change them, and dp are changes of these parameters. g is the measured frequency
    divided by the largest one, and b is the slope. The scatter is ``s e``, with standard normal
    numbers e and the standard deviation s. If the model has no errors except those of its
    parameters and the scatter, b is zero. The estimate of b divided by its standard deviation then
    follows Student's distribution with ``m - q - 1`` degrees of freedom. A significant slope means
    that the model neglects an effect that grows with frequency: shear, rotary inertia, or elements
    that should be smaller.

    Parameters
    ----------
    modes : sequence of m int
        Numbers of the measured modes, from 1.
    freq : (m,) array [Hz]
        Measured frequencies.
    model_freq : (m,) array [Hz]
        Frequencies of the updated model.
    S : (m, q) array [1/unit]
        Derivatives of the logarithms of the model's frequencies with respect to q parameters.
    moves : sequence of int
        Indices of the q parameters that change frequencies, in the list of all parameters of the
        fit. They count from 0.
    shaped : bool
        Whether the modes were numbered by measured shapes.
    unmeasured : sequence of int
        Numbers of the model's modes below `highest` that were not measured. Empty if an FEModel
        was updated.
    unmeasured_freq : array [Hz]
        Frequencies of the modes in `unmeasured`.
    noise : (m,) array
        Relative standard deviations of the measured frequencies caused by noise. Empty: not known.

    Examples
    --------
    Four measured modes and one parameter leave two degrees of freedom:

    >>> import flexplant as fx
    >>> drawing = fx.chain(masses=[1.0] * 5, stiffnesses=[4e5] * 4)
    >>> measured = fx.MeasuredModes(poles=[390j, 743j, 1023j, 1202j], modes=[2, 3, 4, 5])
    >>> fit = fx.update(drawing, [fx.AddedMass("3:x")], [fx.Eigenvalues(measured)])
    >>> fit.trend(measured).dof
    2
    """

    modes: tuple[int, ...]
    freq: FloatArray
    model_freq: FloatArray
    S: FloatArray
    moves: tuple[int, ...]
    shaped: bool = False
    unmeasured: tuple[int, ...] = ()
    unmeasured_freq: FloatArray = field(default_factory=lambda: np.zeros(0))
    noise: FloatArray = field(default_factory=lambda: np.zeros(0))

    @property
    def highest(self) -> float:
        """The largest measured frequency [Hz]."""
        return float(np.max(self.freq))

    @property
    def dof(self) -> int:
        """Degrees of freedom ``m - q - 1``. Below 1, the scatter cannot be estimated."""
        return len(self.modes) - int(self.S.shape[1]) - 1

    @cached_property
    def _regression(self) -> _Regression:
        """The regression on the parameters and on frequency, by a QR decomposition."""
        X = np.column_stack([self.S, self.freq / self.highest])
        size = np.linalg.norm(X, axis=0)
        y = np.log(self.freq / self.model_freq)
        Q, R = la.qr(X / size, mode="economic")
        found = la.solve_triangular(R, Q.T @ y) / size
        free = np.maximum(1.0 - np.sum(Q**2, axis=1), ROUNDING)
        return _Regression(found, la.inv(R) / size[:, None], y - Q @ (Q.T @ y), free)

    @property
    def deviation(self) -> float:
        """Relative standard deviation s of a frequency after the regression."""
        left = self._regression.left
        return float(np.sqrt(left @ left / self.dof))

    @property
    def slope(self) -> float:
        """Slope b: the relative frequency error of the trend at the highest measured frequency."""
        return float(self._regression.found[-1])

    @property
    def slope_deviation(self) -> float:
        """Standard deviation of `slope`."""
        return self.deviation * float(np.linalg.norm(self._regression.root[-1]))

    @property
    def p_value(self) -> float:
        """Probability that a correct model shows a slope of this or a larger size by chance."""
        from scipy.special import stdtr

        if self.dof < 1:
            return 1.0
        ratio = abs(self.slope) / max(self.slope_deviation, np.finfo(float).tiny)
        return float(2.0 * stdtr(self.dof, -ratio))

    @property
    def is_significant(self) -> bool:
        """Whether the slope is significant (probability by chance below 0.3 %)."""
        return self.p_value < LEVEL

    @property
    def unshaped_pairs(self) -> tuple[tuple[int, int], ...]:
        """Neighbouring modes that may be swapped, because no shapes distinguish them."""
        from scipy.special import stdtrit

        if self.shaped or self.dof < 1:
            return ()
        order = np.argsort(self.model_freq)
        gaps = np.diff(np.log(self.model_freq[order]))
        wide = float(stdtrit(self.dof, 0.5 * (1 + INTERVAL))) * np.sqrt(2.0) * self.deviation
        numbers = [self.modes[i] for i in order]
        return tuple((numbers[i], numbers[i + 1]) for i in np.flatnonzero(gaps < wide).tolist())

    @property
    def half_measured_pairs(self) -> tuple[tuple[int, int], ...]:
        """Pairs of a measured and an unmeasured mode that are so close that they may mix."""
        if self.dof < 1:
            return ()
        near = MIXED * self.deviation
        return tuple(
            (mode, other)
            for other, freq in zip(self.unmeasured, self.unmeasured_freq.tolist(), strict=True)
            for mode, own in zip(self.modes, self.model_freq.tolist(), strict=True)
            if abs(np.log(freq / own)) < near
        )

    @cached_property
    def outlier(self) -> tuple[int, float] | None:
        """The mode that is an outlier, with its relative error. None if there is no outlier.

        The test divides the residual of each mode by the deviation that is estimated from the other
        modes (externally studentised residual). It follows Student's distribution with one degree
        of freedom less than `dof`. The measurement noise of the mode is added to the deviation. In
        a correct model an outlier is found by chance in 0.3 % of fits.
        """
        from scipy.special import stdtr

        m, dof = len(self.modes), self.dof
        if dof < 2:
            return None
        left, free = self._regression.left, self._regression.free
        alone = left / free
        others = np.maximum(left @ left - left * alone, TINY) / (dof - 1)
        expected = np.sqrt(others / free + (self.noise**2 if self.noise.size else 0.0))
        chance = 2.0 * m * stdtr(dof - 1, -np.abs(alone) / expected)
        worst = int(np.argmin(chance))
        return (self.modes[worst], float(alone[worst])) if chance[worst] < LEVEL else None

    @property
    def missing(self) -> str:
        """Reason why the uncertainty of machines cannot be computed, or an empty text if it can."""
        return self._obstacle[0]

    @property
    def in_the_way(self) -> tuple[int, ...]:
        """Numbers of the modes for which the uncertainty of machines cannot be computed."""
        return self._obstacle[1]

    @property
    def _obstacle(self) -> tuple[str, tuple[int, ...]]:
        """The reason in words, and the modes that cause it."""
        q = self.S.shape[1]
        if self.dof < 1:
            return (
                f"{len(self.modes)} measured frequencies are too few for {q} parameters, a trend "
                f"and a judgement: measure {q + 2} modes or more"
            ), ()
        if self.outlier is not None:
            mode, off = self.outlier
            return (
                f"mode {mode} deviates by {100 * off:+.2g} % from the other modes: its number "
                "may be wrong, or its pole does not belong to this structure"
            ), (mode,)
        if self.is_significant:
            return (
                f"the model neglects an effect that grows with frequency ({self.text}): shear, "
                "rotary inertia or smaller elements"
            ), ()
        if self.half_measured_pairs:
            mode, other = self.half_measured_pairs[0]
            return (
                f"mode {other} was not measured, and mode {mode}, which is close to it, may be a "
                "mixture of both: measure both, or number them with a smaller least_mac="
            ), (mode, other)
        if self.unshaped_pairs:
            pairs = ", ".join(f"{a} and {b}" for a, b in self.unshaped_pairs)
            return (
                f"modes {pairs} may be swapped: measure their shapes, numbered(identify_modes(frf),"
                " model, at=...)"
            ), tuple(mode for pair in self.unshaped_pairs for mode in pair)
        return "", ()

    @property
    def text(self) -> str:
        """Text with the slope, its standard deviation and the highest measured frequency."""
        return (
            f"{100 * self.slope:+.2g} +- {100 * self.slope_deviation:.1g} % at "
            f"{self.highest:.4g} Hz"
        )

    def posterior(self, rng: np.random.Generator) -> tuple[float, FloatArray, float]:
        """Return a random draw of s, dp (q,) and b from their posterior distribution.

        The prior is flat. With the estimate s_hat of s, the draw is
        ``s^2 = dof s_hat^2 / chi^2_dof``, where chi^2_dof is a draw from the chi-square
        distribution. For this s, dp and b are drawn from normal distributions about their
        estimates.
        """
        if self.dof < 1:
            raise ModelError(f"the posterior does not exist: {self.missing}.")
        found, root, *_ = self._regression
        s = self.deviation * float(np.sqrt(self.dof / rng.chisquare(self.dof)))
        drawn = found + s * (root @ rng.standard_normal(found.size))
        return s, drawn[:-1], float(drawn[-1])

    def __repr__(self) -> str:
        if self.dof < 1:
            return f"<Trend: {self.missing}>"
        held = "significant" if self.is_significant else "not significant"
        return f"<Trend: {self.text}, {held} (p {self.p_value:.2g}, {self.dof} dof)>"


def trend_of(fit: Any, measured: MeasuredModes, left_out: tuple[int, ...] = ()) -> Trend:
    """Return the trend of a fit's model over measured modes; some others need no measurement."""
    about = [q.about(v) for q, v in zip(fit.unknowns, fit.values.tolist(), strict=True)]
    numbers = measured.modes
    if numbers is None:
        raise ModelError(
            "measured modes need the numbers of the model's modes: MeasuredModes(poles, "
            "modes=[...]), or flexplant.numbered(measured, model)."
        )
    found = eigenvalue_sensitivities(fit.model, about, modes=numbers)
    relative, std = np.real(found.S / found.poles[:, None]), measured.std
    # sizes of parameters, so that effects in different units compare
    amounts = np.maximum(np.abs(fit.values), 0.0 if fit.std is None else fit.std)
    size = np.abs(relative).max(axis=0, initial=0.0) * amounts
    moves = np.flatnonzero(size > ROUNDING * np.max(size, initial=0.0))
    freq = np.abs(measured.poles) / (2 * np.pi)
    return Trend(
        tuple(numbers),
        freq,
        np.abs(found.poles) / (2 * np.pi),
        relative[:, moves],
        tuple(moves.tolist()),
        measured.shapes is not None,
        *_unmeasured(fit, (*numbers, *left_out), float(np.max(freq))),
        np.zeros(len(numbers)) if std is None else std.imag / np.abs(measured.poles),
    )


def _unmeasured(
    fit: Any, numbers: Sequence[int], highest: float
) -> tuple[tuple[int, ...], FloatArray]:
    """Return numbers and frequencies [Hz] of a reduced model's modes that were not measured."""
    if not hasattr(fit.model, "T"):
        return (), np.zeros(0)
    freq = np.asarray(fit.model.modes().freq)
    left = (freq > 0.0) & (freq < highest)
    left[np.array(numbers) - 1] = False
    found = np.flatnonzero(left)
    return tuple((found + 1).tolist()), freq[found]


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
        found: list[Parameter] = []
        for q in self.fit.unknowns:
            if isinstance(q, PointParameter) and isinstance(q.at, str) and q.to is None:
                row = dofs.index(q.at)
                found.append(
                    q.replace(at=tuple(dofs.xyz[row].tolist()), direction=dofs.directions[row])
                )
            else:
                found.append(q)
        return found

    def __repr__(self) -> str:
        trend = self.trend
        if self.missing:
            return f"<Machines: no interval: {self.missing}>"
        return (
            f"<Machines: {counted(self.count, 'draw')} of {len(trend.modes)} measured modes, "
            f"frequencies +- {100 * trend.deviation:.2g} %, {trend.dof} dof>"
        )

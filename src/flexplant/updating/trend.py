"""Test whether the residual of an update grows with frequency."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from functools import cached_property
from typing import Any

import numpy as np
import scipy.linalg as la

from ..arrays import FloatArray
from ..errors import ModelError
from ..identification import MeasuredModes
from ..store import Value
from ..tolerances import INTERVAL, ROUNDING, TINY
from .sensitivities import eigenvalue_sensitivities

#: probability that chance alone rejects a slope or a mode: three standard deviations
LEVEL = 0.003
#: gap of two modes, in deviations of a frequency, below which scatter mixes their shapes by more
#: than a tenth: sqrt(2) over the gap
MIXED = 14.0


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
    def _regression(self) -> tuple[FloatArray, FloatArray, float]:
        """The estimates (q + 1,) of dp and b, a root of their covariance over s^2, and s."""
        X = np.column_stack([self.S, self.freq / self.highest])
        size = np.linalg.norm(X, axis=0)
        y = np.log(self.freq / self.model_freq)
        Q, R = la.qr(X / size, mode="economic")
        found = la.solve_triangular(R, Q.T @ y)
        left = y - Q @ (Q.T @ y)
        s = float(np.sqrt(left @ left / self.dof))
        return found / size, la.inv(R) / size[:, None], s

    @property
    def deviation(self) -> float:
        """Relative standard deviation s of a frequency after the regression."""
        return self._regression[2]

    @property
    def slope(self) -> float:
        """Slope b: the relative frequency error of the trend at the highest measured frequency."""
        return float(self._regression[0][-1])

    @property
    def slope_deviation(self) -> float:
        """Standard deviation of `slope`."""
        return self.deviation * float(np.linalg.norm(self._regression[1][-1]))

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
        X = np.column_stack([self.S, self.freq / self.highest])
        Q = la.qr(X / np.linalg.norm(X, axis=0), mode="economic")[0]
        y = np.log(self.freq / self.model_freq)
        left, free = y - Q @ (Q.T @ y), 1.0 - np.sum(Q**2, axis=1)
        alone = left / np.maximum(free, ROUNDING)
        others = np.maximum(left @ left - left * alone, TINY) / (dof - 1)
        own = self.noise**2 if self.noise.size else np.zeros(m)
        expected = np.sqrt(others / np.maximum(free, ROUNDING) + own)
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
        found, root, s_hat = self._regression
        s = s_hat * float(np.sqrt(self.dof / rng.chisquare(self.dof)))
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
    own = [found.modes.index(number) for number in numbers]
    poles, S = found.poles[own], found.S[own]
    relative, std = np.real(S / poles[:, None]), measured.std
    size = np.abs(relative).max(axis=0, initial=0.0) * _amounts(fit)
    moves = np.flatnonzero(size > ROUNDING * np.max(size, initial=0.0))
    freq = np.abs(measured.poles) / (2 * np.pi)
    return Trend(
        tuple(numbers),
        freq,
        np.abs(poles) / (2 * np.pi),
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


def _amounts(fit: Any) -> FloatArray:
    """Return the size of each parameter, so that effects in different units compare."""
    std = np.zeros(fit.values.size) if fit.std is None else fit.std
    return np.asarray(np.maximum(np.abs(fit.values), std))

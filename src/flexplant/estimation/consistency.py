"""Is the model of an estimator true? NIS, NEES and whiteness, with the likely cause in words."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any, Literal, NamedTuple

import numpy as np

from ..arguments import between
from ..errors import ModelError, ShapeError
from ..lti.frequency import frequency_response
from ..lti.statespace import StateSpace
from ..plant import StandardPlant
from ..values import FloatArray, Value, instance, real_array, short
from .estimate import Estimate
from .estimator import KalmanEstimator
from .estimator_channels import poi_channels, row_of
from .whiteness import (
    ExcessPeak,
    PooledSpectrum,
    Statistic,
    cumulative_periodogram,
    level_test,
    ljung_box,
    peaks,
    spectrum_of,
)

Cause = Literal["none", "noise level", "noise ratio", "frequency", "truncation"]
#: fewest samples for a verdict
_FEWEST = 200
#: a peak this close to a mode, relative, belongs to it
_NEAR = 0.06
#: steps of the fit of two noise levels, and what keeps it regular where one of them is not seen
_SCORING, _RIDGE = 40, 1e-9


@dataclass(frozen=True, eq=False, repr=False)
class Consistency(Value):
    """Tests of the innovations of an estimator: level, whiteness, spectrum and likely cause.

    Parameters
    ----------
    nis : float
        Mean normalised innovation squared per sensor, 1 for a right model.
    nis_p, whiteness_p, periodogram_p : float
        Probabilities of values as far off with a right model: of the NIS (chi-square), of the
        Ljung-Box statistic, of the cumulative periodogram.
    sensor_ratios : mapping {sensor: float}
        Deviation of each innovation beside the predicted one.
    nees : mapping {channel: (mean, low, high)}
        Mean normalised squared error of the estimates with its confidence interval, where the
        true motions were given; 1 when the predicted deviations are right.
    peaks : tuple of (float, float)
        Frequencies [Hz] at which the innovations exceed the density that the best levels of
        process and sensor noise explain, and how much, the most significant first.
    cause : {"none", "noise level", "noise ratio", "frequency", "truncation"}
        The likely cause.
    text : str
        The verdict in words.
    level : float
        Of all tests together.

    Examples
    --------
    >>> import flexplant as fx
    >>> plant = fx.testbeds.three_masses()
    >>> observer = fx.design_kalman(plant)
    >>> servo = fx.design_servo(plant, bandwidth=20.0, observer=observer)
    >>> run = fx.simulate(fx.close_loop(plant, observer, servo), duration=2.0, rng=1)
    >>> fx.estimation.consistency(observer, observer.estimate(run)).text
    'the innovations are white and of the predicted size.'
    """

    nis: float
    nis_p: float
    whiteness_p: float
    periodogram_p: float
    sensor_ratios: Mapping[str, float]
    nees: Mapping[str, tuple[float, float, float]]
    peaks: tuple[tuple[float, float], ...]
    cause: Cause
    text: str
    level: float = field(default=0.95)

    def __repr__(self) -> str:
        nees = "".join(f", NEES {name} {m:.3g}" for name, (m, _, _) in self.nees.items())
        return (
            f"<Consistency at {100 * self.level:g} %: NIS {self.nis:.4g} (p {self.nis_p:.2g}), "
            f"Ljung-Box p {self.whiteness_p:.2g}, periodogram p {self.periodogram_p:.2g}{nees};\n"
            f"  {self.text}>"
        )

    @property
    def holds(self) -> bool:
        """Whether no test rejects the model of the innovations."""
        return self.cause == "none"


def consistency(
    observer: KalmanEstimator,
    estimate: Estimate,
    *,
    truth: Any = None,
    level: float = 0.95,
) -> Consistency:
    """Return whether a record agrees with the model of its estimator, and if not, why.

    With a right model the whitened innovations are white noise of unit variance. Three tests share
    the level (each at ``level^(1/3)``): the mean of their squares (NIS, chi-square), their
    correlations over lags (Ljung-Box, all sensors), their cumulative periodogram (Bartlett). The
    likely cause follows from what fails:

    - white, NIS off: the *noise level*; the sensors whose innovations are too large are named;
    - coloured, but no more than other levels of process and sensor noise explain (two levels,
      fitted to the spectrum): the *noise ratio*;
    - a peak beyond that near a mode: the *frequency* or damping of that mode;
    - a peak where the plant has no mode: *truncation*, or a disturbance that it lacks.

    Parameters
    ----------
    observer : KalmanEstimator
        That made the estimate.
    estimate : Estimate
        Of `observer.estimate(records)`.
    truth : mapping {channel: (N,) array}, optional
        True motions at POIs, of a simulation or a reference instrument, for the NEES; its interval
        allows for the correlation of the errors over time.
    level : float
        Share of records at which a right model passes.

    Returns
    -------
    Consistency

    Raises
    ------
    ModelError
        When there are fewer than 200 samples with all innovations, or the kinds are wrong.
    LabelError
        When a channel of `truth` is no motion of a POI.
    ShapeError
        When it has another length than the estimate.

    References
    ----------
    [BarShalom2001]_, ch. 5.4; [LjungBox1978]_; [Bartlett1955]_.

    Examples
    --------
    >>> import flexplant as fx
    >>> plant = fx.testbeds.three_masses()
    >>> observer = fx.design_kalman(plant)
    >>> servo = fx.design_servo(plant, bandwidth=20.0, observer=observer)
    >>> run = fx.simulate(fx.close_loop(plant, observer, servo), duration=2.0, rng=1)
    >>> fx.estimation.consistency(observer, observer.estimate(run)).holds
    True
    """
    if not isinstance(observer, KalmanEstimator) or not isinstance(estimate, Estimate):
        wrong = estimate if isinstance(observer, KalmanEstimator) else observer
        raise ModelError(
            f"consistency needs a KalmanEstimator and its Estimate, got {short(wrong)}. Pass "
            "observer and observer.estimate(records)."
        )
    share = between(level, "level", 0.5, 1.0, "Pass 0.95.", ends="[")
    alpha = 1 - share ** (1 / 3)
    white = estimate.whitened.T
    there = np.isfinite(white).all(axis=1)
    count = int(there.sum())
    if count < _FEWEST:
        raise ModelError(
            f"a verdict needs at least {_FEWEST} samples with all innovations, got {count}. Pass "
            "a longer record."
        )
    nis = level_test(float(np.sum(white[there] ** 2)), count * white.shape[1])
    box = ljung_box(white, min(100, count // 20))
    spectrum = spectrum_of(white)
    bartlett = cumulative_periodogram(spectrum)
    normal = (estimate.innovations / estimate.innovation_deviations).T[there]
    ratios = np.sqrt(np.mean(normal**2, axis=0))
    levels, expected = _levels(observer, spectrum)
    found = peaks(spectrum._replace(density=spectrum.density / expected), alpha)
    verdict = _verdict(
        observer.plant,
        _Facts(nis, box, bartlett, found, levels, ratios, count, alpha),
        estimate.sensors,
    )
    rate = 1.0 / observer.plant.dt
    return Consistency(
        nis.statistic,
        nis.p_value,
        box.p_value,
        bartlett.p_value,
        dict(zip(estimate.sensors, ratios.tolist(), strict=True)),
        _nees(observer, estimate, truth, share),
        tuple((one.freq * rate, one.height) for one in found[:6]),
        *verdict,
        share,
    )


class _Facts(NamedTuple):
    nis: Statistic
    box: Statistic
    bartlett: Statistic
    peaks: list[ExcessPeak]
    levels: FloatArray
    ratios: FloatArray
    samples: int
    alpha: float

    @property
    def white(self) -> bool:
        return min(self.box.p_value, self.bartlett.p_value) >= self.alpha


def _verdict(plant: StandardPlant, facts: _Facts, names: Any) -> tuple[Cause, str]:
    """Return the likely cause and the verdict in words."""
    if facts.white and facts.nis.p_value >= facts.alpha:
        return "none", "the innovations are white and of the predicted size."
    if facts.white:
        return "noise level", _level_text(facts, names)
    if facts.peaks:
        return _peak_verdict(plant, facts.peaks)
    process, sensor = np.sqrt(facts.levels)
    return "noise ratio", (
        "the innovations are coloured as with other noises: the process noise is about "
        f"{process:.3g} times and that of the sensors {sensor:.3g} times the stated one. Estimate "
        "both from the record."
    )


def _level_text(facts: _Facts, names: Any) -> str:
    p = [level_test(float(r * r * facts.samples), facts.samples).p_value for r in facts.ratios]
    off = [i for i, value in enumerate(p) if value < facts.alpha / len(p)]
    size = "larger" if facts.nis.statistic > 1 else "smaller"
    text = (
        f"the innovations are white but {np.sqrt(facts.nis.statistic):.3g} times as large as "
        f"predicted: the noises are {size} than stated"
    )
    if 0 < len(off) < len(p):
        listed = ", ".join(f"{names[i]} ({facts.ratios[i]:.3g} times)" for i in off)
        text += f", at {listed}"
    return f"{text}. Scale the densities by this, or estimate them from the record."


def _peak_verdict(plant: StandardPlant, found: list[ExcessPeak]) -> tuple[Cause, str]:
    """Return the verdict for coloured innovations with peaks."""
    freq, first = _mode_freq(plant)
    rate = 1.0 / plant.dt
    strongest = max(found, key=lambda one: one.height)
    at = strongest.freq * rate
    near = _near(freq, at)
    if near is None:
        above = freq.size and at > np.max(freq[freq < 0.5 * rate], initial=0.0)
        where = "above all modes of the plant" if above else "where the plant has no mode"
        return "truncation", (
            f"the innovations have {strongest.height:.3g} times the density that noise explains at "
            f"{at:.4g} Hz, {where}: a mode left out (above {0.5 * rate:.4g} Hz it appears folded), "
            "or a disturbance that the plant lacks. Keep more modes, or add the disturbance."
        )
    return "frequency", (
        f"the innovations have {strongest.height:.3g} times the density that noise explains at "
        f"{at:.4g} Hz, near mode {first + near} ({freq[near]:.4g} Hz in the plant): its frequency "
        "or damping is not the machine's. Update the model."
    )


def _mode_freq(plant: StandardPlant) -> tuple[FloatArray, int]:
    """Return the frequencies [Hz] of the elastic modes, and the number of the first one."""
    if plant.is_assembled:
        omega = np.sqrt(np.abs(np.linalg.det(plant.modal_blocks)))[plant.n_rigid :]
        return np.asarray(omega / (2 * np.pi)), plant.n_rigid + 1
    poles = np.linalg.eigvals(plant.system.A)
    swinging = poles[(poles.imag > 0) & (np.abs(poles) > 0.1)]
    return np.sort(np.angle(swinging)) / (2 * np.pi * plant.dt), 1


def _near(freq: FloatArray, at: float) -> int | None:
    if not freq.size:
        return None
    best = int(np.argmin(np.abs(freq - at)))
    return best if abs(freq[best] - at) <= _NEAR * freq[best] else None


def _levels(observer: KalmanEstimator, found: PooledSpectrum) -> tuple[FloatArray, FloatArray]:
    """Return the levels (process, sensors) that explain a spectrum best, and what they predict.

    The sensors' noise reaches the whitened innovations by
    ``W (I - C (z I - A + K C)^-1 K) R^(1/2)``; its part s of the density and that of the process,
    1 - s, add up to 1. Levels a, b that scale them are fitted by Whittle's likelihood,
    ``sum log m + I / m`` with m = a (1 - s) + b s, by scoring.
    """
    m, K = observer.model, observer.predictor_gain
    unit = np.linalg.cholesky(m.innovation(observer.predicted_covariance))
    noise = np.linalg.cholesky(m.R)
    g = StateSpace(m.A - K @ m.C2, K, -m.C2, np.eye(len(K.T)), m.dt)
    response = np.moveaxis(frequency_response(g, found.freq / m.dt).data, 2, 0)
    reached = np.linalg.solve(unit, response @ noise)
    part = np.clip(np.mean(np.sum(np.abs(reached) ** 2, axis=2), axis=1), 0.0, 1.0)
    parts, levels = np.stack([1 - part, part]), np.full(2, found.density.mean())
    for _ in range(_SCORING):
        expected = levels @ parts
        weighted = parts / expected**2
        information = weighted @ parts.T + _RIDGE * np.eye(2) * np.trace(weighted @ parts.T)
        step = np.linalg.solve(information, weighted @ (found.density - expected))
        levels = np.clip(levels + step, 0.1 * levels, 10 * levels)
    return levels, levels @ parts


def _nees(
    observer: KalmanEstimator, estimate: Estimate, truth: Any, level: float
) -> dict[str, tuple[float, float, float]]:
    """Return the mean normalised squared errors with their confidence intervals."""
    if truth is None:
        return {}
    instance(truth, Mapping, "truth", "Pass {channel: array}.")
    channels, found = poi_channels(observer.plant), {}
    wanted = [n for n in truth if n in channels] if hasattr(truth, "dt") else list(truth)
    for name in wanted:
        row = row_of(channels, name)
        motion = real_array(truth[name], f"truth of {name!r}", (None,))
        if motion.size != estimate.data.shape[1]:
            raise ShapeError(
                f"truth of {name!r} has {motion.size} samples, the estimate "
                f"{estimate.data.shape[1]}. Pass the same record."
            )
        error = (motion - estimate.data[row]) / estimate.deviations[row]
        found[name] = _mean_square(error[np.isfinite(error)], level)
    return found


def _mean_square(error: FloatArray, level: float) -> tuple[float, float, float]:
    """Return the mean square of a Gaussian record and its interval.

    Its variance is ``2 sum_l c_l^2 / N``, c the autocovariance.
    """
    from scipy.stats import norm

    n = error.size
    if not n:
        return np.nan, np.nan, np.nan
    power = np.abs(np.fft.rfft(error, 2 * n)) ** 2
    covariance = np.fft.irfft(power)[: max(n // 5, 1)] / n
    mean = float(covariance[0])
    spread = np.sqrt(2 * (covariance[0] ** 2 + 2 * np.sum(covariance[1:] ** 2)) / n)
    half = float(norm.ppf(0.5 + 0.5 * level) * spread)
    return mean, mean - half, mean + half

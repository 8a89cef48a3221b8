"""Is the model of an estimator true? NIS, NEES and whiteness, with the likely cause in words."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any, NamedTuple

import numpy as np

from ..checks import FloatArray, Value, between, instance, real_array, short
from ..errors import ModelError, ShapeError, counted
from ..plant import StandardPlant, larger_plant
from ..plant.realisation import Structure
from .causes import (
    Cause,
    LikelyCause,
    known_verdict,
    left_modes,
    offset,
    outlier_text,
    outliers,
    peak_verdict,
    settling,
)
from .estimate import Estimate
from .estimator import KalmanEstimator
from .estimator_channels import poi_channels, read_alike, row_of
from .innovation_spectrum import InnovationLines, InnovationParts, expected, lines_of, parts_of
from .left_out import left_out
from .whiteness import ExcessPeak, Statistic, cumulative_periodogram, level_test, ljung_box, peaks

#: fewest samples for a verdict
_FEWEST = 200
#: tests that share the level
_TESTS = 5
#: samples that are compared with a larger plant: its response is computed at each of their lines
_COMPARED = 32768
#: the innovations are those of the larger plant unless it is this unlikely: they fail as those of
#: the plant already, so that a failure by chance would name a cause that is none
_AGREES = 1e-4
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
    causes : tuple of str
        The likely causes: "none", or of "outliers", "offset", "noise level", "noise ratio",
        "frequency", "truncation", "folding".
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
    causes: tuple[Cause, ...]
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
    def cause(self) -> Cause:
        """The first of the causes."""
        return self.causes[0]

    @property
    def holds(self) -> bool:
        """Whether no test rejects the model of the innovations."""
        return self.cause == "none"


def consistency(
    observer: KalmanEstimator,
    estimate: Estimate,
    *,
    larger: StandardPlant | Structure | None = None,
    truth: Any = None,
    level: float = 0.95,
) -> Consistency:
    """Return whether a record agrees with the model of its estimator, and if not, why.

    With a right model the whitened innovations are white noise of unit variance. Five tests share
    the level (each at ``level^(1/5)``): the mean of their squares (NIS, chi-square), their
    correlations over lags (Ljung-Box, all sensors), their cumulative periodogram (Bartlett), their
    largest one and their mean. The likely causes follow from what fails:

    - single samples of a sensor beyond what noise makes, whose effect on the filter is that of one
      sample: *outliers*;
    - a mean beside the density at the lowest lines: the *offset* of a sensor.

    What these make is taken away, the rest has one more cause:

    - coloured as on the larger plant, where modes left out are known: the plant is right and its
      *truncation*, or the *folding* of modes above half the rate, is what shows;
    - white, NIS off: the *noise level*; the sensors whose innovations are too large are named;
    - coloured, but no more than other levels of process and sensor noise explain (two levels,
      fitted to the spectrum): the *noise ratio*;
    - a peak beyond that, which the change of a mode near it explains better than one more mode
      (the model's own mode is missing then, and the direction is its own): the *frequency* or
      damping of that mode;
    - any other peak: *truncation*, where it lies above all modes or a mode left out is known there;
      *folding*, where the plant has modes above it, or the mode left out lies above half the rate;
      or a disturbance that the plant lacks.

    Parameters
    ----------
    observer : KalmanEstimator
        That made the estimate.
    estimate : Estimate
        Of `observer.estimate(records)`; samples that its gate left out are missing ones.
    larger : Modes, FEModel, ReducedModel or StandardPlant, optional
        With the modes left out, as in `design_kalman`. None: what the observer was designed with.
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
    alpha = 1 - share ** (1 / _TESTS)
    white = estimate.whitened.T
    there = np.isfinite(white).all(axis=1)
    count = int(there.sum())
    if count < _FEWEST:
        raise ModelError(
            f"a verdict needs at least {_FEWEST} samples with all innovations, got {count}. Pass "
            "a longer record."
        )
    normal = (estimate.innovations / estimate.innovation_deviations).T
    raw = _tested(observer, white, normal, None, alpha)
    said, rest = [], raw
    single = outliers(observer, white, normal, alpha)
    if single is not None:
        said.append(LikelyCause("outliers", outlier_text(single, observer, estimate.time)))
        white = single.white
    settled = white.copy()
    settled[: min(settling(observer), len(white) // 4)] = np.nan
    constant = offset(observer, settled, alpha)
    if constant is not None:
        said.append(LikelyCause("offset", constant.text))
        white = settled - constant.mean  # what an offset does at first is no constant
    whole = _whole(observer, larger)
    if said or whole is not None:
        rest = _tested(observer, white, normal, whole, alpha)
    verdict = _verdict(observer, rest, whole, estimate.sensors)
    if not said or verdict.cause != "none":
        said.append(verdict)
    gated = int(estimate.gated.sum())
    left = f" {counted(gated, 'sample')} beyond the gate left out." if gated else ""
    rate = 1.0 / observer.plant.dt
    return Consistency(
        raw.nis.statistic,
        raw.nis.p_value,
        raw.box.p_value,
        raw.bartlett.p_value,
        dict(zip(estimate.sensors, raw.ratios.tolist(), strict=True)),
        _nees(observer, estimate, truth, share),
        tuple((one.freq * rate, one.height) for one in rest.peaks[:6]),
        tuple(one.cause for one in said),
        " ".join(one.text for one in said) + left,
        share,
    )


class _Facts(NamedTuple):
    """Tests of innovations against their filter's model, and beside the best levels of noise."""

    nis: Statistic
    box: Statistic
    bartlett: Statistic
    peaks: list[ExcessPeak]
    lines: InnovationLines
    parts: InnovationParts
    levels: FloatArray
    ratios: FloatArray
    samples: int
    alpha: float

    @property
    def white(self) -> bool:
        return min(self.box.p_value, self.bartlett.p_value) >= self.alpha

    @property
    def expected(self) -> FloatArray:
        """The pooled density with the best levels."""
        return np.asarray(self.levels @ self.parts.pooled)

    @property
    def explained(self) -> bool:
        """Whether the lines have the density of the plant with the levels stated."""
        beside = self.lines.beside(self.parts.both)
        count = 2 * beside.density.size * beside.channels
        total = level_test(count * float(np.mean(beside.density)), count)
        p = min(total.p_value, cumulative_periodogram(beside).p_value)
        return p >= _AGREES and not peaks(beside, _AGREES)


def _tested(
    observer: KalmanEstimator,
    white: FloatArray,
    normal: FloatArray,
    whole: StandardPlant | None,
    alpha: float,
) -> _Facts:
    """Return the tests of whitened innovations (N, p)."""
    there = np.isfinite(white).all(axis=1)
    count = int(there.sum())
    nis = level_test(float(np.sum(white[there] ** 2)), count * white.shape[1])
    box = ljung_box(white, min(100, count // 20))
    lines = lines_of(white if whole is None else white[-_COMPARED:])
    pooled = lines.pooled
    parts = (
        parts_of(observer, None, lines.freq)
        if whole is None
        else expected(observer, whole, lines.samples)
    )
    levels = _levels(parts.pooled, pooled.density)
    found = peaks(pooled._replace(density=pooled.density / (levels @ parts.pooled)), alpha)
    ratios = np.sqrt(np.mean(normal[there] ** 2, axis=0))
    return _Facts(
        nis, box, cumulative_periodogram(pooled), found, lines, parts, levels, ratios, count, alpha
    )


def _whole(observer: KalmanEstimator, larger: Any) -> StandardPlant | None:
    """Return the plant with the modes left out, read like the observer's, or None."""
    plant = observer.plant
    if larger is None:
        found = None if observer.left_out is None else observer.left_out.larger
    else:
        found = None if larger is plant else larger_plant(plant, larger)
    return None if found is None else read_alike(plant, found)


def _verdict(
    observer: KalmanEstimator, facts: _Facts, whole: StandardPlant | None, names: Any
) -> LikelyCause:
    """Return the likely cause and the verdict in words."""
    if facts.white and facts.nis.p_value >= facts.alpha:
        return LikelyCause("none", "the innovations are white and of the predicted size.")
    numbers = None
    if whole is not None and whole.is_assembled:
        missed = observer.left_out if observer.left_out is not None else left_out(
            observer.plant.unweighted, whole.unweighted
        )  # fmt: skip
        numbers = None if missed is None else missed.modes
    if whole is not None and numbers is not None and facts.explained:
        left = left_modes(whole, numbers)
        return known_verdict(observer, left, facts.parts, facts.lines.freq)
    if facts.white:
        return LikelyCause("noise level", _level_text(facts, names))
    if facts.peaks:
        known = None if whole is None or numbers is None else (whole, numbers)
        return peak_verdict(observer, facts.lines, facts.expected, facts.peaks, known)
    process, sensor = np.sqrt(facts.levels)
    return LikelyCause(
        "noise ratio",
        "the innovations are coloured as with other noises: the process noise is about "
        f"{process:.3g} times and that of the sensors {sensor:.3g} times the stated one. Estimate "
        "both from the record.",
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


def _levels(parts: FloatArray, density: FloatArray) -> FloatArray:
    """Return the levels (process, sensors) of the parts (2, m) that explain a density best.

    By Whittle's likelihood, ``sum log m + I / m`` with m the sum of both at their levels, by
    scoring.
    """
    parts = np.maximum(parts, 0.0)
    levels = np.full(2, density.mean() / parts.sum(axis=0).mean())
    for _ in range(_SCORING):
        weighted = parts / (levels @ parts) ** 2
        information = weighted @ parts.T + _RIDGE * np.eye(2) * np.trace(weighted @ parts.T)
        step = np.linalg.solve(information, weighted @ (density - levels @ parts))
        levels = np.clip(levels + step, 0.1 * levels, 10 * levels)
    return levels


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

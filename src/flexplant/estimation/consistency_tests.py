"""Consistency tests of an estimator: NIS, NEES and whiteness, with the likely cause."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any, NamedTuple

import numpy as np

from ..arrays import ComplexArray, FloatArray, between, instance, real_array
from ..errors import ModelError, ShapeError, aligned, counted, short
from ..loop import ClosedLoop
from ..plant import AnyPlant
from ..store import Value
from ..tolerances import MOST_STEPS, SAME
from .causes import (
    Cause,
    Examined,
    LikelyCause,
    Outliers,
    folded,
    known_verdict,
    left_modes,
    offset,
    outlier_text,
    outliers,
    peak_verdicts,
    sampled_modes,
    settling,
)
from .error import row_of
from .estimate import Estimate
from .estimator import KalmanEstimator
from .filter_models import left_out, poi_channels
from .innovations import (
    ExcessPeak,
    InnovationLines,
    InnovationParts,
    Statistic,
    cumulative_periodogram,
    density_of,
    excess_peaks,
    expected,
    level_test,
    lines_of,
    ljung_box,
)
from .kalman import design_kalman
from .mode_changes import ModeChange, MovedModes, moved_modes

#: fewest samples for a verdict
FEWEST = 200
#: number of tests that share the level
_TESTS = 5
#: largest number of samples compared with an evaluation plant, since its response is computed at
#: each line
_COMPARED = 32768
#: p-value below which innovations do not agree with the evaluation plant; small, since they already
#: failed the test with the plant
_AGREES = 1e-4
#: largest number of modes that are fitted one after the other until no peak remains
_MOVED = 6
#: band of a mode in half-widths and in lines to each side, with nearly all of its power
_HALF_WIDTHS, _LINES = 3.0, 2


@dataclass(frozen=True, eq=False, repr=False)
class ConsistencyReport(Value):
    """Tests of the innovations of an estimator: level, whiteness, spectrum and likely cause.

    Parameters
    ----------
    nis : float
        Mean normalised innovation squared per sensor, 1 for a correct model.
    nis_p, whiteness_p, periodogram_p : float
        P-values of the NIS (chi-square), of the Ljung-Box statistic, and of the cumulative
        periodogram.
    sensor_ratios : mapping {sensor: float}
        Ratio of the standard deviation of each innovation to the predicted one.
    nees : mapping {channel: (mean, low, high)}
        Mean normalised squared error of the estimates with its confidence interval, if the true
        motions were given; 1 if the predicted deviations are correct.
    peaks : tuple of (float, float)
        Frequency [Hz] and height of each peak in the spectrum of the innovations. The height is
        the ratio of the spectrum to the spectrum of the model with the best-fitting levels of
        process and sensor noise. The most significant peak comes first.
    causes : tuple of str
        Likely causes: "none", or some of "outliers", "offset", "noise level", "noise ratio",
        "frequency", "truncation" and "folding". `consistency` explains them.
    text : str
        Verdict in words.
    level : float
        Confidence level of all tests together.
    spectra : mapping {mode: (float, float)}
        Ratio of the power of the innovations around each mode of the plant to the predicted one,
        and its p-value.
    moved : MovedModes, optional
        Modes with a different frequency or damping on the machine, with the changes and their
        standard deviations, if this is a cause. ``model.calibrated(found.moved.measured)`` is then
        the model of the machine.
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
    spectra: Mapping[int, tuple[float, float]] = field(default_factory=dict)
    moved: MovedModes | None = None

    def __repr__(self) -> str:
        lines = aligned(["test", "found", "limit", "verdict"], self.tests)
        said = "agrees" if self.holds else "does not agree"
        first = f"<ConsistencyReport at {100 * self.level:g} %: the record {said} with the model."
        table = [f"  {line}" for line in lines]
        return "\n".join([first, *table, f"  {self.text}{self._off()}>"])

    @property
    def tests(self) -> tuple[tuple[str, str, str, str], ...]:
        """Each test in words: its name, what was found, its limit, and whether that is good."""
        least = 1.0 - self.level ** (1.0 / _TESTS)
        named = {
            f"NIS {self.nis:.4g}, 1 expected": self.nis_p,
            "white (Ljung-Box)": self.whiteness_p,
            "flat spectrum (periodogram)": self.periodogram_p,
        }
        found = [
            (name, f"p {p:.2g}", f"at least {least:.2g}", _word(p >= least))
            for name, p in named.items()
        ]
        return tuple(found) + tuple(
            (f"NEES of {name}, 1 expected", f"{mean:.3g}", f"{low:.3g} to {high:.3g} holds 1",
             _word(low <= 1.0 <= high))
            for name, (mean, low, high) in self.nees.items()
        )  # fmt: skip

    def _off(self) -> str:
        """Return a text of modes around which the power differs from the predicted one."""
        allowed = (1.0 - self.level) / max(len(self.spectra), 1)
        off = [f"mode {n} {r:.3g}" for n, (r, p) in self.spectra.items() if p < allowed]
        if not off or self.holds:
            return ""
        return f"\n  Power of the innovations around modes, predicted 1: {', '.join(off)}."

    @property
    def cause(self) -> Cause:
        """The first of the likely causes."""
        return self.causes[0]

    @property
    def holds(self) -> bool:
        """Whether the innovations pass all tests."""
        return self.cause == "none"


def _word(holds: bool) -> str:
    return "good" if holds else "bad"


def consistency(
    observer: KalmanEstimator | ClosedLoop,
    estimate: Estimate | Any,
    *,
    truth: Any = None,
    level: float = 0.95,
) -> ConsistencyReport:
    """Return whether a record agrees with the model of its estimator, with the likely causes.

    With a correct model the whitened innovations are white noise of unit variance. There are five
    tests of the innovations: their mean square (normalised innovation squared, NIS; chi-square),
    their correlations over lags (Ljung-Box, all sensors), their cumulative periodogram (Bartlett),
    their largest value and their mean. Each test has the level ``level^(1/5)``, so that a correct
    model passes all five with the probability `level`. The likely causes follow from the failed
    tests:

    - *outliers*: single wrong samples of a sensor, which noise cannot explain. The innovations that
      follow are the response of the filter to one wrong sample;
    - *offset* of a sensor: the mean of its innovations is larger than the spectrum at the lowest
      frequencies explains.

    Outliers and offsets are removed. One cause is then given for the remaining innovations.
    *Truncation* means that modes of the machine are missing in the plant. *Folding* means that
    modes above half the sampling rate appear at lower frequencies. Innovations that are not white
    are called coloured. The causes are:

    - *truncation* or *folding*: there is an evaluation model, and the innovations have the coloured
      spectrum that it predicts. The plant is then correct except for these modes;
    - *noise level*: the innovations are white, but their NIS differs from 1. The sensors with too
      large innovations are named;
    - *noise ratio*: the innovations are coloured, but two other levels, one of the process noise
      and one of the sensor noise, explain them. The levels are fitted to the spectrum;
    - *frequency*: the spectrum has a peak that the model does not predict, and a change of a
      neighbouring mode explains it better than an additional mode does. Frequency and damping of
      all such modes are fitted to the record by maximum likelihood. The fit includes the commands,
      so that a closed loop does not bias the result (`moved`);
    - any other peak means *truncation* if it lies above all modes of the plant, or at a truncated
      mode that is known. It means *folding* if the plant has modes above the peak, or the truncated
      mode lies above half the rate. A disturbance that is missing in the plant is also possible.

    Parameters
    ----------
    observer : KalmanEstimator or ClosedLoop
        Estimator that is tested. For a ClosedLoop that ran on the machine, it is the Kalman filter
        of the plant of this loop.
    estimate : Estimate, Response or mapping {channel: (N,) array}
        Result of `observer.estimate(records)`, or the records of all sensors and commands. Samples
        that the gate of `estimate` rejected count as missing.
    truth : mapping {channel: (N,) array}, optional
        True motions at POIs, from a simulation or a reference instrument. They are used for the
        normalised estimation error squared (NEES), whose interval takes the correlation of the
        errors over time into account.
    level : float
        Probability that a correct model passes all tests.

    Returns
    -------
    ConsistencyReport
        Verdict, likely causes, and the result of each test.

    Raises
    ------
    ModelError
        When there are fewer than 200 samples with all innovations, or `observer` or `estimate` has
        a wrong type.

    References
    ----------
    [BarShalom2001]_, ch. 5.4; [LjungBox1978]_; [Bartlett1955]_.

    Examples
    --------
    >>> import flexplant as fx
    >>> plant = fx.testbeds.three_masses()
    >>> observer = fx.design_kalman(plant)
    >>> servo = fx.design_servo(plant, bandwidth=20.0, observer=observer)
    >>> run = fx.simulate(fx.close_loop(plant, observer, servo), duration=2.0, rng=2)
    >>> fx.estimation.consistency(observer, run).text
    'the innovations are white and of the predicted size.'
    """
    if isinstance(observer, ClosedLoop):
        observer = design_kalman(observer.plant)
    is_filter = isinstance(observer, KalmanEstimator)
    if is_filter and hasattr(estimate, "keys") and not isinstance(estimate, Estimate):
        estimate = observer.estimate(estimate)
    if not is_filter or not isinstance(estimate, Estimate):
        wrong = estimate if is_filter else observer
        raise ModelError(
            "consistency needs a KalmanEstimator or a ClosedLoop, and an Estimate or a record, got "
            f"{short(wrong)}. Pass observer and observer.estimate(records)."
        )
    share = between(level, "level", 0.5, 1.0, "Pass 0.95.", ends="[")
    alpha = 1 - share ** (1 / _TESTS)
    white = estimate.whitened.T
    there = np.isfinite(white).all(axis=1)
    count = int(there.sum())
    if count < FEWEST:
        raise ModelError(
            f"a verdict needs at least {FEWEST} samples with all innovations, got {count}. Pass "
            "a longer record."
        )
    normal = (estimate.innovations / estimate.innovation_deviations).T
    known = bool(estimate.record.size)  # else the commands are not known
    u = estimate.record[:, len(estimate.sensors) :] if known else np.zeros((len(white), 0))
    raw = _tested(observer, white, normal, None, alpha, u)
    said, rest = [], raw
    single = outliers(observer, white, normal, alpha)
    if single is not None:
        said.append(LikelyCause("outliers", outlier_text(single, observer, estimate.time)))
        white = single.white
    settled, skip = white.copy(), min(settling(observer), len(white) // 4)
    settled[:skip] = np.nan
    constant = offset(observer, settled, alpha)
    if constant is not None:
        said.append(LikelyCause("offset", constant.text))
        white = settled - constant.mean  # the initial effect of an offset is not constant
    whole = _evaluation_plant(observer)
    if said or whole is not None:
        rest = _tested(observer, white, normal, whole, alpha, u)
    verdicts = _verdicts(observer, rest, whole, estimate.sensors, Examined.of([], whole))
    said += [one for one in verdicts if not said or one.cause != "none"]
    moved, changes = None, [one.change for one in verdicts if one.change is not None]
    if changes and known:
        before = Examined.of([one.freq for one in rest.peaks], whole)
        moved, left = _moved_modes(observer, estimate, changes, single, alpha, before)
        said += left
    gated = int(estimate.gated.sum())
    without = f" {counted(gated, 'sample')} beyond the gate left out." if gated else ""
    rate = 1.0 / observer.plant.dt
    capital = (one.text[:1].upper() + one.text[1:] for one in said[1:])
    return ConsistencyReport(
        *raw.nis,
        raw.box.p_value,
        raw.bartlett.p_value,
        dict(zip(estimate.sensors, raw.ratios.tolist(), strict=True)),
        _nees(observer, estimate, truth, share),
        tuple((one.freq * rate, one.height) for one in rest.peaks[:6]),
        tuple(dict.fromkeys(one.cause for one in said)),
        " ".join([said[0].text, *capital]) + without,
        share,
        _spectra(observer, raw),
        moved,
    )


def _moved_modes(
    observer: KalmanEstimator,
    estimate: Estimate,
    changes: Sequence[ModeChange],
    single: Outliers | None,
    alpha: float,
    before: Examined,
) -> tuple[MovedModes | None, list[LikelyCause]]:
    """Return the changed modes, including hidden ones, and the remainder."""
    record = np.array(estimate.record)
    p = len(estimate.sensors)
    missing = [] if single is None else single.places
    for k, i in missing:
        record[k, i] = np.nan
    if estimate.gated.size:
        record[:, :p][estimate.gated.T] = np.nan
    clean, tried = estimate.replace(record=record), {one.mode for one in changes}
    skip = min(settling(observer), len(record) // 4)
    while changes:
        found, machine, seen = moved_modes(observer, clean, changes, skip)
        kept = [one for one, start in zip(found.changes, changes, strict=True) if one.near(start)]
        if len(kept) < len(changes):  # the fit moved to another peak
            changes = kept
            continue
        white = seen.whitened.T.copy()
        white[:skip] = np.nan
        normal = (seen.innovations / seen.innovation_deviations).T
        facts = _tested(machine, white, normal, None, alpha, record[:, p:])
        left = _verdicts(machine, facts, None, estimate.sensors, before)
        peaks = np.append(before.tried, [one.freq for one in facts.peaks])
        before = before._replace(tried=peaks)
        more = [one.change for one in left if one.change is not None]
        more = [one for one in more if one.mode not in {*found.modes, *tried}]
        if not more or len(changes) >= _MOVED:
            break
        tried.update(one.mode for one in more)
        changes = [*found.changes, *more]
    else:
        return None, []
    text = f"{'; '.join(found.texts)}. Calibrate the model with these: moved.measured."
    others = [one for one in left if one.cause not in ("none", "frequency")]
    if left[0].cause == "none":
        text += " The innovations are then white."
    return found, [LikelyCause("frequency", text), *others]


def _spectra(observer: KalmanEstimator, facts: _Facts) -> dict[int, tuple[float, float]]:
    """Return the power of innovations around each mode relative to the predicted one, and p."""
    plant, lines = observer.plant, facts.lines.freq
    if not plant.modal_blocks.size:
        return {}
    kept, found = sampled_modes(plant), {}
    rate, step = 1.0 / float(plant.dt), float(lines[0])
    blocks = plant.modal_blocks[plant.n_rigid :]
    decay = -0.5 * np.trace(blocks, axis1=1, axis2=2) / (2.0 * np.pi)
    expected = facts.parts.pooled.sum(axis=0)
    for n, at, width in zip(kept.numbers.tolist(), folded(kept.freq, rate), decay, strict=True):
        reach = _HALF_WIDTHS * width * plant.dt + _LINES * step
        band = np.flatnonzero(np.abs(lines - at * plant.dt) <= reach)
        if band.size:
            ratio = float(np.mean(facts.lines.pooled.density[band] / expected[band]))
            count = 2 * band.size * facts.lines.X.shape[1]
            found[n] = ratio, level_test(count * ratio, count).p_value
    return found


class _Facts(NamedTuple):
    """Tests of innovations against the model of their filter, and with the best noise levels."""

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
    U: ComplexArray

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
        relative = self.lines.relative_to(self.parts.both)
        count = 2 * relative.density.size * relative.channels
        total = level_test(count * float(np.mean(relative.density)), count)
        p = min(total.p_value, cumulative_periodogram(relative).p_value)
        return p >= _AGREES and not excess_peaks(relative, _AGREES)


def _tested(
    observer: KalmanEstimator,
    white: FloatArray,
    normal: FloatArray,
    whole: AnyPlant | None,
    alpha: float,
    u: FloatArray,
) -> _Facts:
    """Return the tests of whitened innovations (N, p) under commands u (N, nu)."""
    there = np.isfinite(white).all(axis=1)
    count = int(there.sum())
    nis = level_test(float(np.sum(white[there] ** 2)), count * white.shape[1])
    box = ljung_box(white, min(100, count // 20))
    last = white if whole is None else white[-_COMPARED:]
    lines = lines_of(last)
    # commands of missing samples are ignored like their innovations
    commands = np.where(np.isnan(last).any(axis=1, keepdims=True), np.nan, u[-len(last) :])
    pooled = lines.pooled
    if whole is None:
        parts = density_of(observer, None, lines.freq)
    else:
        parts = expected(observer, whole, lines.samples)
    levels = _fitted_levels(parts.pooled, pooled.density)
    found = excess_peaks(pooled._replace(density=pooled.density / (levels @ parts.pooled)), alpha)
    ratios = np.sqrt(np.mean(normal[there] ** 2, axis=0))
    return _Facts(
        nis, box, cumulative_periodogram(pooled), found, lines, parts, levels, ratios, count, alpha,
        lines_of(commands).X,
    )  # fmt: skip


def _evaluation_plant(observer: KalmanEstimator) -> AnyPlant | None:
    """Return the evaluation plant, read like the observer's, or None."""
    plant = observer.plant
    found = plant.machine.evaluation_plant if observer.left_out is None else observer.left_out.whole
    return None if found is None else plant.around(found.machine)


def _verdicts(
    observer: KalmanEstimator, facts: _Facts, whole: AnyPlant | None, names: Any, before: Examined
) -> list[LikelyCause]:
    """Return the likely causes and the text of the verdicts."""
    if facts.white and facts.nis.p_value >= facts.alpha:
        return [LikelyCause("none", "the innovations are white and of the predicted size.")]
    numbers = None
    if whole is not None and whole.modal_blocks.size:
        missed = observer.left_out if observer.left_out is not None else left_out(
            observer.plant.machine, whole.machine
        )  # fmt: skip
        numbers = None if missed is None else missed.modes
    if whole is not None and numbers is not None and facts.explained:
        left = left_modes(whole, numbers)
        return [known_verdict(observer, left, facts.parts, facts.lines.freq)]
    if facts.white:
        return [LikelyCause("noise level", _level_text(facts, names))]
    if facts.peaks:
        known = None if whole is None or numbers is None else (whole, numbers)
        return peak_verdicts(
            observer, facts.lines, facts.U, facts.expected, facts.peaks, known, before
        )
    process, sensor = np.sqrt(facts.levels)
    text = (
        "the innovations are coloured as with other noises: the process noise is about "
        f"{process:.3g} times and that of the sensors {sensor:.3g} times the stated one. Estimate "
        "both from the record."
    )
    return [LikelyCause("noise ratio", text)]


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


def _fitted_levels(parts: FloatArray, density: FloatArray) -> FloatArray:
    """Return the levels (process, sensors) of the parts (2, m) that explain a density best."""
    # by Whittle's likelihood, `sum log m + I / m` with m the sum of both at their levels, by
    # scoring
    parts = np.maximum(parts, 0.0)
    levels = np.full(2, density.mean() / parts.sum(axis=0).mean())
    for _ in range(MOST_STEPS):
        weighted = parts / (levels @ parts) ** 2
        information = weighted @ parts.T + SAME * np.eye(2) * np.trace(weighted @ parts.T)
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
    """Return the mean square of a Gaussian record and its interval."""
    # its variance is `2 sum_l c_l^2 / N`, c the autocovariance
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

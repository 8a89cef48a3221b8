"""Noise levels by channel from records: maximum likelihood of the innovations of a fixed filter."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from types import MappingProxyType
from typing import Any, NamedTuple

import numpy as np

from ..arrays import ComplexArray, FloatArray
from ..errors import AssumptionError, ModelError, SolverError, counted, warn
from ..lti.statespace import System
from ..parallel import PIECE, one_thread
from ..plant import AnyPlant
from ..store import Value
from ..tolerances import (
    CHANCE,
    DEVIATIONS,
    FOUR_DIGITS,
    MOST_STEPS,
    NEGLIGIBLE,
    SETTLED,
    SPLIT,
    TINY,
    TYPED,
)
from .causes import settling
from .consistency_tests import consistency
from .estimate import Estimate
from .estimator import KalmanEstimator
from .filter_models import checked_plant, sensors
from .innovations import seen_from_states, squared
from .kalman import design_kalman

#: largest number of filter designs
_PASSES = 6
_EVALUATION = " Give the plant an evaluation model, if it lacks truncated modes."
#: lags of the autocovariances of the start
_LAGS = 40
#: fewest samples
_FEWEST = 1000
#: least and largest ratio of a variance to the given one in one pass
_LOW, _HIGH = TYPED, 1.0 / TYPED


@one_thread()
def estimate_noise(
    plant: AnyPlant | System, records: Any, *, gate: float | None = None
) -> NoiseLevels:
    """Return the densities of all disturbances and sensor noises that explain a record best.

    The innovations e of a fixed filter are stationary for any noise levels, even if the machine has
    rigid-body motion. Their spectrum is linear in the variances t_i of the channels::

        S(f) = sum_i t_i P_i(f),   P_i = T_i T_i^*,   T_i = H_i + C (z I - A + K C)^-1 (G_i - K H_i)

    A, C and K are the matrices of the filter (K is the predictor gain), G_i and H_i are the gains
    from the noise of channel i to the states and to the sensors, and ``z = exp(2 pi i f dt)``. For
    sensor noise ``G_i = 0``. I is the periodogram of the innovations at a frequency f. Whittle's
    likelihood l, its derivatives and Fisher's information F are sums over the lines of the Fourier
    transform::

        l = -sum_f log det S + tr S^-1 I,   dl/dt_i = -sum_f tr S^-1 P_i - tr S^-1 P_i S^-1 I
        information F_ij = sum_f tr S^-1 P_i S^-1 P_j

    The search for the maximum is Fisher's scoring (Newton's method with F in place of the second
    derivatives) in the logarithms of t_i. It starts at the non-negative least-squares fit of the
    autocovariances, which are linear in t_i as well. The filter is then designed again with the
    result. Its innovations become white, so that the likelihood is that of the exact filter.

    Parameters
    ----------
    plant : StandardPlant
        Sampled plant with guesses of all unknown densities (their orders of magnitude). Every
        sensor needs a density; disturbances without a density are assumed absent. The record is
        explained with the modes of the evaluation model, which should be those of the machine:
        update the model first, ``fit.applied_to(model)``. Without an evaluation model the sensor
        noises include the motion of the truncated modes.
    records : Response, mapping {channel: (N,) array} or data frame
        Records of all sensors and commands; the longest stretch without gaps is used.
    gate : float, optional
        Gate as in `KalmanEstimator.estimate`: outliers count as gaps.

    Returns
    -------
    NoiseLevels
        Levels with `.asd`, `.relative`, and `.plant` with these densities.

    Raises
    ------
    AssumptionError
        In the cases of `design_kalman`; or when the effects of some channels on the sensors cannot
        be separated. The message names these channels.
    LabelError, ShapeError
        When channels are missing or of different lengths.
    ModelError
        When fewer than 1000 samples remain without gaps and start-up.
    SolverError
        When the search does not converge; the message gives the result of `consistency`.

    Warns
    -----
    FlexplantWarning
        When the innovations with these levels are still not white: the model does not match the
        machine, and the stated deviations are not valid.

    References
    ----------
    [Whittle1953]_; [Odelson2006]_.

    Examples
    --------
    >>> import flexplant as fx
    >>> plant = fx.testbeds.three_masses()
    >>> observer = fx.design_kalman(plant)
    >>> servo = fx.design_servo(plant, bandwidth=20.0, observer=observer)
    >>> run = fx.simulate(fx.close_loop(plant, observer, servo), duration=4.0, rng=1)
    >>> found = fx.estimation.estimate_noise(plant, run)
    >>> 0.8 < found.asd["amp"] / 1e-3 < 1.2
    True
    """
    plant = checked_plant(plant)
    channels, whole = _noise_channels(plant), _whole_plant(plant)
    ratios, first = np.ones(len(channels)), np.zeros(0)
    for _ in range(_PASSES):
        now = _scaled(whole, channels, ratios)
        observer = design_kalman(now)
        estimate = observer.estimate(records, gate=gate)
        innovations = _longest_stretch(observer, estimate)
        spectrum = _level_spectrum(observer, _sources(now, channels), innovations)
        if not first.size:
            begin = _least_squares(spectrum)
            first = np.sqrt(begin)
            begin = np.clip(begin, 1e-3, _HIGH)  # all levels are positive
        else:
            begin = np.ones(len(channels))
        found = _scored(spectrum, begin, np.minimum(_LOW / ratios**2, 1.0))
        ratios = ratios * np.sqrt(found.variances)
        covariance = _level_covariance(found, channels)
        # relative to a variance, which has a finite error even where it may be 0
        deviation = 2 * found.variances * np.sqrt(covariance.diagonal())
        # values that are known to a few percent are converged well within this
        if np.all(np.abs(found.variances - 1.0) < np.maximum(2 * NEGLIGIBLE, 0.1 * deviation)):
            break
    else:
        raise SolverError(
            f"the noise levels still change after {_PASSES} designs of the filter, the last one "
            f"by {np.max(np.abs(np.sqrt(found.variances) - 1.0)):.2g}. "
            f"{_advice(observer, estimate, whole is plant)}"
        )
    now = _scaled(whole, channels, ratios)
    final = design_kalman(now)
    verdict = consistency(final, final.estimate(records, gate=gate), level=(1.0 - CHANCE))
    if not verdict.holds:
        warn(
            "the noise levels do not explain the record: "
            f"{verdict.text} The levels include errors of the model, and their deviations are "
            f"only valid for a correct model.{_EVALUATION if whole is plant else ''}"
        )
    return NoiseLevels(
        plant, channels, ratios, covariance, first, found.slope, verdict.nis, len(innovations),
        verdict.text,
    )  # fmt: skip


def _whole_plant(plant: AnyPlant) -> AnyPlant:
    """Return the plant with truncated modes and the densities of the given one."""
    found = plant.machine.evaluation_plant
    if found is None:
        return plant
    if found.model is not None:
        found = found.with_ports(plant.assembled.ports)
    return plant.around(found.machine)


def _advice(observer: KalmanEstimator, estimate: Estimate, alone: bool) -> str:
    """Return the result of the record for the plant if levels are not found, and advice."""
    said = consistency(observer, estimate, level=(1.0 - CHANCE))
    if said.cause in ("none", "noise level", "noise ratio"):
        return "Pass a plant with densities closer to the true ones, or a longer record."
    return f"With the last ones {said.text}{_EVALUATION if alone else ''}"


def _noise_channels(plant: AnyPlant) -> tuple[str, ...]:
    noises = tuple(f"{name}:noise" for name in sensors(plant))
    silent = [name for name in noises if not plant.asd.get(name, 0.0) > 0]
    if silent:
        raise AssumptionError(
            f"{', '.join(silent)} has no density to start from: levels are found only for "
            "sensors with noise. Give Sensor(asd=) a guess, and a plant that reads sensors."
        )
    if plant.machine.continuous.dt:  # the noise of a sample is given as a whole
        return PROCESS, *noises
    forces = [name for name in plant.w if plant.asd.get(name, 0.0) > 0 and name not in noises]
    return *forces, *noises


def _scaled(plant: AnyPlant, channels: tuple[str, ...], ratios: FloatArray) -> AnyPlant:
    none = np.zeros((len(channels), len(channels)))
    return NoiseLevels(plant, channels, ratios, none, ratios, 0.0, 1.0, 0).plant


class _Source(NamedTuple):
    """``x+ += G xi``, ``y += H xi``, xi white of unit variance."""

    G: FloatArray
    H: FloatArray


def _sources(plant: AnyPlant, channels: tuple[str, ...]) -> list[_Source]:
    """Return the contribution of each channel per sample, at its present level."""
    rows = [plant.y.index(name) for name in sensors(plant)]
    n, found = plant.system.n_states, []
    forces = [other for other in channels if other.removesuffix(":noise") not in plant.y]
    for name in channels:
        sensor = name.removesuffix(":noise")
        if sensor in plant.y:
            H = np.zeros((len(rows), 1))
            at = plant.y.index(sensor)
            H[rows.index(at)] = np.sqrt(plant.sensor_noise[at, at])
            found.append(_Source(np.zeros((n, 1)), H))
            continue
        still = {other: 0.0 for other in forces if other != name}
        alone = plant if name == PROCESS else with_densities(plant, still)
        found.append(_Source(alone.noise_factor, alone.noise_direct[rows]))
    return found


def _longest_stretch(observer: KalmanEstimator, estimate: Estimate) -> FloatArray:
    """Return the longest stretch (N, ny) of innovations without gaps, its start-up left out."""
    e = estimate.innovations.T
    there = np.concatenate([[False], np.all(np.isfinite(e), axis=1), [False]])
    edges = np.flatnonzero(np.diff(there.astype(int))).reshape(-1, 2)
    start, end = edges[np.argmax(edges[:, 1] - edges[:, 0])] if len(edges) else (0, 0)
    start = start + min(settling(observer), (end - start) // 4)
    if end - start < _FEWEST:
        raise ModelError(
            f"noise levels need at least {_FEWEST} samples in one stretch after the start-up, got "
            f"{end - start}. Pass a longer record, without gaps."
        )
    return np.asarray(e[start:end])


class _LevelSpectrum(NamedTuple):
    """Periodograms I (M, ny, ny) and the parts P (p, M, ny, ny) of the channels, scaled."""

    seen: ComplexArray
    parts: ComplexArray


def _level_spectrum(
    observer: KalmanEstimator, sources: list[_Source], innovations: FloatArray
) -> _LevelSpectrum:
    """Return the periodogram of innovations and the contribution of each channel."""
    m, K = observer.model, observer.predictor_gain
    count = len(innovations)
    size = np.sqrt(m.innovation(observer.predicted_covariance).diagonal())
    line = slice(1, (count - 1) // 2 + 1)
    X = np.fft.rfft(innovations / size, axis=0)[line] / np.sqrt(count)
    freq = np.fft.rfftfreq(count)[line].astype(np.float64)
    ny = len(size)
    d = np.sqrt(np.maximum(observer.predicted_covariance.diagonal(), TINY))
    closed = (m.A - K @ m.C2) * d / d[:, None]
    parts = np.empty((len(sources), freq.size, ny, ny), dtype=np.complex128)
    for start in range(0, freq.size, PIECE):
        piece = slice(start, start + PIECE)
        to = seen_from_states(closed, m.C2 * d / size[:, None], freq[piece])  # C (z I - A_c)^-1
        for i, one in enumerate(sources):
            T = to @ ((one.G - K @ one.H) / d[:, None]) + one.H / size[:, None]
            parts[i, piece] = squared(T)
    return _LevelSpectrum(X[:, :, None] * X.conj()[:, None, :], parts)


def _least_squares(spectrum: _LevelSpectrum) -> FloatArray:
    """Return non-negative variances by least squares of the autocovariances over some lags."""
    from scipy.optimize import nnls

    def covariances(density: ComplexArray) -> FloatArray:
        return np.asarray(np.fft.irfft(density, axis=0)[:_LAGS].reshape(-1))

    columns = np.stack([covariances(part) for part in spectrum.parts], axis=1)
    size = np.linalg.norm(columns, axis=0)
    return np.asarray(nnls(columns / size, covariances(spectrum.seen))[0] / size)


class _Scored(NamedTuple):
    variances: FloatArray
    information: FloatArray
    slope: float


def _scored(spectrum: _LevelSpectrum, start: FloatArray, lowest: FloatArray) -> _Scored:
    """Return the variances of the largest likelihood, by scoring in their logarithms."""
    # variances at the lower limit that would decrease are left out of the steps
    bottom = np.log(lowest)
    log_t = np.log(start)
    value, slope, information = _likelihood(spectrum, np.exp(log_t))
    # nearly a Newton step: the start is seldom far away
    damping = 1e-6
    for _ in range(MOST_STEPS):
        scale = np.sqrt(np.maximum(information.diagonal(), TINY))
        free = (log_t > bottom) | (slope > 0)
        unit = information / np.outer(scale, scale) * np.outer(free, free)
        unit[np.diag_indices_from(unit)] = 1.0
        if np.max(np.abs(slope / scale)[free], initial=0.0) < FOUR_DIGITS:
            t = np.exp(log_t)
            worst = float(np.max(np.abs(slope / scale)[free], initial=0.0))
            return _Scored(t, information / np.outer(t, t), worst)
        step = np.linalg.solve(unit + damping * np.eye(len(unit)), slope * free / scale) / scale
        trial = np.clip(log_t + np.clip(step, -2.0, 2.0), bottom, np.log(_HIGH))
        try:
            better = _likelihood(spectrum, np.exp(trial))
        except np.linalg.LinAlgError:
            better = (-np.inf, slope, information)
        if better[0] >= value - SETTLED * abs(value):
            log_t, (value, slope, information) = trial, better
            damping = max(0.1 * damping, 1e-12)  # from here on it grows again in few steps
        else:
            damping = max(10 * damping, 1e-3)  # from here on it shortens a step
    raise SolverError(
        f"the likelihood of the noise levels did not converge in {MOST_STEPS} steps: these "
        "channels cannot explain the spectrum of the innovations. Judge the record with "
        "flexplant.estimation.consistency, and give the plant an evaluation model."
    )


def _likelihood(spectrum: _LevelSpectrum, t: FloatArray) -> tuple[float, FloatArray, FloatArray]:
    """Return the likelihood, and its slope and information in the logarithms of t."""
    S = np.tensordot(t, spectrum.parts, 1)
    inverse = np.linalg.inv(S)
    seen = inverse @ spectrum.seen
    value = -np.sum(np.linalg.slogdet(S)[1]) - np.trace(seen, axis1=1, axis2=2).real.sum()
    weighted = inverse @ spectrum.parts  # S^-1 P_i
    flat = weighted.reshape(len(t), -1)
    turned = np.swapaxes(weighted, 2, 3).reshape(len(t), -1)
    information = (flat @ turned.T).real
    slope = -np.trace(weighted, axis1=2, axis2=3).real.sum(axis=1)
    slope += (flat @ np.swapaxes(seen, 1, 2).reshape(-1)).real
    return float(value), slope * t, information * np.outer(t, t)


def _level_covariance(found: _Scored, channels: tuple[str, ...]) -> FloatArray:
    """Return the covariance of the logarithms of the densities, when the channels can be separated.

    Densities are roots of variances: a quarter of the inverse of the information in log t.
    """
    scaled = found.information * np.outer(found.variances, found.variances)
    size = np.sqrt(scaled.diagonal())
    if np.any(size == 0):
        raise AssumptionError(
            f"the sensors do not see {channels[int(np.argmin(size))]!r}, so that its level "
            "cannot be found. Give it no density, or add a sensor."
        )
    values, vectors = np.linalg.eigh(scaled / np.outer(size, size))
    if values[0] < SPLIT:
        involved = np.flatnonzero(np.abs(vectors[:, 0]) > 0.3)
        raise AssumptionError(
            f"the sensors cannot separate the levels of {', '.join(channels[i] for i in involved)}"
            ": other shares of them give the same record. Give only one of them a density, or add "
            "a sensor."
        )
    inverse = np.linalg.inv(scaled / np.outer(size, size))
    return np.asarray(0.25 * inverse / np.outer(size, size))


#: name of the channel for all disturbances of a plant that was not assembled
PROCESS = "process"


@dataclass(frozen=True, eq=False, repr=False)
class NoiseLevels(Value):
    """Amplitude densities of disturbances and sensors from a record, with their uncertainty.

    Parameters
    ----------
    given : StandardPlant
        Plant with the given densities, from which the search started.
    channels : tuple of str
        Disturbances of w, then sensors (`y1:noise`). The name `process` stands for all disturbances
        together if the plant was not made by `assemble_plant`, so that its disturbances have no
        names.
    ratios : (p,) array
        Ratio of the estimated density of each channel to the given one.
    covariance : (p, p) array
        Covariance of the logarithms of the ratios: the inverse of Fisher's information.
    start : (p,) array
        Ratios from the non-negative least-squares fit of the autocovariances, at which the search
        started; 0 for a channel to which this fit assigns no noise.
    slope : float
        Remaining slope at the end of the search: the largest derivative of the log-likelihood with
        respect to one log-ratio. It is divided by the standard deviation that this derivative has
        over random records (the root of Fisher's information). The search ends when it is below
        1e-4.
    nis : float
        Mean normalised innovation squared per sensor, for the filter with these levels on the
        record. It is 1 if the model explains the record.
    samples : int
        Number of used samples.
    verdict : str
        Verdict of `consistency` for the record with these levels.
    """

    given: AnyPlant
    channels: tuple[str, ...]
    ratios: FloatArray
    covariance: FloatArray
    start: FloatArray
    slope: float
    nis: float
    samples: int
    verdict: str = ""

    def __repr__(self) -> str:
        shown = [f"  {name} {self._shown(i)}" for i, name in enumerate(self.channels[:5])]
        more = [f"  ... and {len(self.channels) - 5} more"] if len(self.channels) > 5 else []
        first = f"<NoiseLevels from {counted(self.samples, 'sample')}, NIS {self.nis:.4g}"
        return "\n".join([first, *shown, *more]) + ">"

    def _shown(self, i: int) -> str:
        """Return a text of a level: a bound if it may be 0 (within two deviations)."""
        # the variance t of a ratio has the deviation 2 t times that of the density's logarithm
        ratio, off = float(self.ratios[i]), self.relative[self.channels[i]]
        if 2.0 * DEVIATIONS * off > 1.0:
            most = ratio * np.sqrt(1.0 + 2.0 * DEVIATIONS * off)
            return f"at most {most:.2g} times the given density"
        return f"{ratio:.4g} times the given density, +- {100 * off:.2g} %"

    @property
    def asd(self) -> Mapping[str, float]:
        """Estimated densities [unit/sqrt(Hz)] by channel; `process` has none and is left out."""
        return {
            name: float(ratio * self.given.asd[name])
            for name, ratio in zip(self.channels, self.ratios, strict=True)
            if name in self.given.asd
        }

    @property
    def relative(self) -> Mapping[str, float]:
        """Relative standard deviation of each density."""
        sizes = np.sqrt(np.maximum(self.covariance.diagonal(), 0.0))
        return dict(zip(self.channels, sizes.tolist(), strict=True))

    @property
    def plant(self) -> AnyPlant:
        """The plant with the estimated densities and their standard deviations.

        In the machines ``plant.machines`` of this plant, the densities are random with these
        deviations.
        """
        given = self.given
        if PROCESS in self.channels:
            factor = given.noise_factor * self.ratios[self.channels.index(PROCESS)]
            origin = given.machine.origin.replace(noise_factor=factor)
            return given.replace(asd={**given.asd, **self.asd}, origin=origin)
        return with_densities(given, self.asd, self.relative)


def with_densities(
    plant: AnyPlant, asd: Mapping[str, float], relative: Mapping[str, float] = MappingProxyType({})
) -> AnyPlant:
    """Return an assembled plant with other densities of some of the noises that it has."""

    def changed(ports: Sequence[Any], ending: str = "") -> list[Any]:
        found = []
        for port in ports:
            name = f"{port.name}{ending}"
            level = asd.get(name, port.asd) if port.asd else 0.0
            known = {"asd_deviation": relative[name]} if name in relative else {}
            found.append(port.replace(asd=level, **known))
        return found

    own = plant.assembled.ports
    w, u, y = changed(own.w), changed(own.u, ":disturbance"), changed(own.y, ":noise")
    return plant.around(plant.machine.with_ports(own.replace(w=w, u=u, y=y)))

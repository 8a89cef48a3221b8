"""Noise levels by channel from records: maximum likelihood of the innovations of a fixed filter."""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np

from ..errors import AssumptionError, ModelError, SolverError
from ..lti.frequency import frequency_response
from ..lti.statespace import StateSpace, System
from ..parallel import one_thread
from ..plant import StandardPlant
from ..values import ComplexArray, FloatArray
from .estimator import KalmanEstimator
from .estimator_channels import checked_plant, sensors
from .kalman import design_kalman
from .noise_levels import PROCESS, NoiseLevels, with_densities
from .whiteness import level_test

#: designs of the filter whose innovations are used, and the change of all ratios that ends them
_PASSES, _SETTLED = 6, 1e-3
#: scoring steps, and the slope beside its deviation at which they end
_STEPS, _FLAT = 60, 1e-4
#: lags of the autocovariances of the start
_LAGS = 40
#: smallest eigenvalue of the information of unit size, below which levels cannot be separated
_SEPARATE = 1e-7
#: fewest samples, and lines of the spectrum computed at once
_FEWEST, _LINES = 1000, 4000
#: a variance is kept above this part of the given one, and below this multiple in one pass
_LOW, _HIGH = 1e-6, 1e6


@one_thread()
def estimate_noise(plant: StandardPlant | System, records: Any) -> NoiseLevels:
    """Return the densities of all disturbances and sensor noises that explain a record best.

    The innovations e of a fixed filter are stationary whatever the levels are, rigid-body motion
    included, and their spectrum is linear in the variances t_i of the channels::

        S(f) = sum_i t_i P_i(f),   P_i = T_i T_i^*,   T_i = H_i + C (z I - A + K C)^-1 (G_i - K H_i)

    (``G_i = 0`` for a sensor's own noise). Their likelihood over the lines of the Fourier
    transform (Whittle) and its derivatives are sums::

        l = -sum_f log det S + tr S^-1 I,   dl/dt_i = -sum_f tr S^-1 P_i - tr S^-1 P_i S^-1 I
        information F_ij = sum_f tr S^-1 P_i S^-1 P_j

    Scoring in the logarithms of t_i starts at the non-negative least-squares fit of the
    autocovariances (linear in t_i as well). The filter is designed again with what was found, so
    that its innovations are white in the end: the likelihood is then that of the exact filter.

    Parameters
    ----------
    plant : StandardPlant
        Sampled, with guesses of all densities that are to be found (their orders of magnitude);
        what has none stays without.
    records : Response, mapping {channel: (N,) array} or data frame
        All sensors and commands; the longest stretch without gaps is used.

    Returns
    -------
    NoiseLevels
        `.asd`, `.relative`, and `.plant` with these densities.

    Raises
    ------
    AssumptionError
        As `design_kalman`; or when the sensors cannot separate the channels, which are named.
    LabelError, ShapeError
        When channels are missing or of different lengths.
    ModelError
        When fewer than 1000 samples are left without gaps and start-up.
    SolverError
        When the search does not settle.

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
    channels = _channels(plant)
    ratios, first = np.ones(len(channels)), np.zeros(0)
    for _ in range(_PASSES):
        now = _levels(plant, channels, ratios)
        observer = design_kalman(now, larger=now)
        innovations = _steady(observer, records)
        spectrum = _spectrum(observer, _sources(now, channels), innovations)
        if not first.size:
            begin = _least_squares(spectrum)
            first = np.sqrt(begin)
            begin = np.clip(begin, 1e-3, _HIGH)
        else:
            begin = np.ones(len(channels))
        found = _scored(spectrum, begin, np.minimum(_LOW / ratios**2, 1.0))
        ratios = ratios * np.sqrt(found.variances)
        covariance = _covariance(found, channels)
        # what is known to a few percent only is settled well within that
        known = np.maximum(2 * _SETTLED, 0.1 * np.sqrt(covariance.diagonal()))
        if np.all(np.abs(np.log(found.variances)) < known):
            break
    else:
        raise SolverError(
            f"the noise levels still change after {_PASSES} designs of the filter. Pass a plant "
            "with densities nearer to the true ones, or a longer record."
        )
    final = _levels(plant, channels, ratios)
    return NoiseLevels(
        plant, channels, ratios, covariance, first, found.slope,
        _nis(design_kalman(final, larger=final), records), len(innovations),
    )  # fmt: skip


def _channels(plant: StandardPlant) -> tuple[str, ...]:
    noises = tuple(f"{name}:noise" for name in sensors(plant))
    silent = [name for name in noises if not plant.asd.get(name, 0.0) > 0]
    if silent:
        raise AssumptionError(
            f"{', '.join(silent)} has no density to start from: levels are found for sensors with "
            "noise of their own. Give Sensor(asd=) a guess, and a plant that reads sensors."
        )
    if not plant.is_assembled:
        return PROCESS, *noises
    forces = [name for name in plant.w if plant.asd.get(name, 0.0) > 0 and name not in noises]
    return *forces, *noises


def _levels(plant: StandardPlant, channels: tuple[str, ...], ratios: FloatArray) -> StandardPlant:
    none = np.zeros((len(channels), len(channels)))
    return NoiseLevels(plant, channels, ratios, none, ratios, 0.0, 1.0, 0).plant


class _Source(NamedTuple):
    """``x+ += G xi``, ``y += H xi``, by the covariances of both."""

    Q: FloatArray
    S: FloatArray
    R: FloatArray


def _sources(plant: StandardPlant, channels: tuple[str, ...]) -> list[_Source]:
    """Return what each channel adds per sample, at its present level."""
    rows = [plant.y.index(name) for name in sensors(plant)]
    n, ny, found = plant.system.n_states, len(rows), []
    for name in channels:
        sensor = name.removesuffix(":noise")
        if sensor in plant.y:
            at = plant.y.index(sensor)
            R = np.zeros((ny, ny))
            R[rows.index(at), rows.index(at)] = plant.sensor_noise[at, at]
            found.append(_Source(np.zeros((n, n)), np.zeros((n, ny)), R))
            continue
        forces = [other for other in channels if other.removesuffix(":noise") not in plant.y]
        still = {other: 0.0 for other in forces if other != name}
        alone = plant if name == PROCESS else with_densities(plant, still)
        G, H = alone.noise_factor, alone.noise_direct[rows]
        found.append(_Source(G @ G.T, G @ H.T, H @ H.T))
    return found


def _steady(observer: KalmanEstimator, records: Any) -> FloatArray:
    """Return the longest stretch (N, ny) of innovations without gaps, its start-up left out."""
    e = observer.estimate(records).innovations.T
    there = np.concatenate([[False], np.all(np.isfinite(e), axis=1), [False]])
    edges = np.flatnonzero(np.diff(there.astype(int))).reshape(-1, 2)
    start, end = edges[np.argmax(edges[:, 1] - edges[:, 0])] if len(edges) else (0, 0)
    radius = observer.certificate.spectral_radius
    settling = int(np.ceil(np.log(1e-3) / np.log(radius))) if 0 < radius < 1 else 1
    start = start + min(settling, (end - start) // 4)
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


def _spectrum(
    observer: KalmanEstimator, sources: list[_Source], innovations: FloatArray
) -> _LevelSpectrum:
    """Return the periodogram of innovations and what each channel adds to it."""
    m, K = observer.model, observer.predictor_gain
    count = len(innovations)
    size = np.sqrt(m.innovation(observer.predicted_covariance).diagonal())
    line = slice(1, (count - 1) // 2 + 1)
    X = np.fft.rfft(innovations / size, axis=0)[line] / np.sqrt(count)
    freq = np.fft.rfftfreq(count, m.dt)[line].astype(np.float64)
    n, ny = m.C2.T.shape
    d = np.sqrt(np.maximum(observer.predicted_covariance.diagonal(), 1e-300))
    closed = (m.A - K @ m.C2) * d / d[:, None]
    g = StateSpace(closed, np.eye(n), m.C2 * d / size[:, None], np.zeros((ny, n)), m.dt)
    parts = np.empty((len(sources), freq.size, ny, ny), dtype=np.complex128)
    for start in range(0, freq.size, _LINES):
        piece = slice(start, start + _LINES)
        to = np.moveaxis(frequency_response(g, freq[piece]).data, 2, 0)  # C (z I - A_c)^-1
        back = np.conj(np.swapaxes(to, 1, 2))
        for i, one in enumerate(sources):
            mixed = one.S - K @ one.R
            Q = one.Q - one.S @ K.T - K @ one.S.T + K @ one.R @ K.T
            cross = to @ (mixed / d[:, None] / size)
            own = one.R / size / size[:, None]
            parts[i, piece] = to @ (Q / d / d[:, None]) @ back
            parts[i, piece] += cross + np.conj(np.swapaxes(cross, 1, 2)) + own
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
    """Return the variances of the largest likelihood, by scoring in their logarithms.

    Those at the lower end that would still fall are left out of the steps.
    """
    bottom = np.log(lowest)
    log_t = np.log(start)
    value, slope, information = _likelihood(spectrum, np.exp(log_t))
    damping = 1e-6
    for _ in range(_STEPS):
        scale = np.sqrt(np.maximum(information.diagonal(), 1e-300))
        free = (log_t > bottom) | (slope > 0)
        unit = information / np.outer(scale, scale) * np.outer(free, free)
        unit[np.diag_indices_from(unit)] = 1.0
        if np.max(np.abs(slope / scale)[free], initial=0.0) < _FLAT:
            t = np.exp(log_t)
            worst = float(np.max(np.abs(slope / scale)[free], initial=0.0))
            return _Scored(t, information / np.outer(t, t), worst)
        step = np.linalg.solve(unit + damping * np.eye(len(unit)), slope * free / scale) / scale
        trial = np.clip(log_t + np.clip(step, -2.0, 2.0), bottom, np.log(_HIGH))
        try:
            better = _likelihood(spectrum, np.exp(trial))
        except np.linalg.LinAlgError:
            better = (-np.inf, slope, information)
        if better[0] >= value - 1e-9 * abs(value):
            log_t, (value, slope, information) = trial, better
            damping = max(0.1 * damping, 1e-12)
        else:
            damping = max(10 * damping, 1e-3)
    raise SolverError(
        f"the likelihood of the noise levels did not settle in {_STEPS} steps. Pass a plant with "
        "densities nearer to the true ones, or a longer record."
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


def _covariance(found: _Scored, channels: tuple[str, ...]) -> FloatArray:
    """Return the covariance of the logarithms of the densities, when the channels can be separated.

    Densities are roots of variances: a quarter of the inverse of the information in log t.
    """
    scaled = found.information * np.outer(found.variances, found.variances)
    size = np.sqrt(scaled.diagonal())
    if np.any(size == 0):
        raise AssumptionError(
            f"the sensors show nothing of {channels[int(np.argmin(size))]!r}: its level cannot be "
            "found. Give it no density, or add a sensor."
        )
    values, vectors = np.linalg.eigh(scaled / np.outer(size, size))
    if values[0] < _SEPARATE:
        involved = np.flatnonzero(np.abs(vectors[:, 0]) > 0.3)
        raise AssumptionError(
            f"the sensors cannot separate the levels of {', '.join(channels[i] for i in involved)}"
            ": other shares of them give the same record. Give only one of them a density, or add "
            "a sensor."
        )
    inverse = np.linalg.inv(scaled / np.outer(size, size))
    return np.asarray(0.25 * inverse / np.outer(size, size))


def _nis(observer: KalmanEstimator, records: Any) -> float:
    white = observer.estimate(records).whitened.T
    white = white[np.all(np.isfinite(white), axis=1)]
    return level_test(float(np.sum(white**2)), white.size).statistic

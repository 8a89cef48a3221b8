"""Causes of inconsistent innovations: outliers, offsets, truncated modes."""

from __future__ import annotations

from typing import Literal, NamedTuple

import numpy as np

from ..arrays import ComplexArray, FloatArray, IntArray, divisor
from ..errors import counted, with_unit
from ..modes.matching import NEAR
from ..plant import AnyPlant
from ..tolerances import NEGLIGIBLE, SAME, TINY
from .estimator import KalmanEstimator
from .filter_models import innovation_root
from .innovations import ExcessPeak, InnovationLines, InnovationParts, impulse, steady_gain
from .mode_changes import ModeChange, explained_by_change, peak_band

Cause = Literal[
    "none", "noise level", "noise ratio", "frequency", "truncation", "folding", "offset", "outliers"
]
#: the same next to a higher peak of another cause: typical drift of a machine
_DRIFTED = 0.03
#: largest fraction of outliers, and their number allowed in a short record
_RARE, _FEW = 0.01, 20
#: number of consecutive samples of one burst of motion, and fraction of all that makes them one
_APART, _BURST = 5, 0.5
#: largest number of samples over which the effect of an outlier is followed
_FOLLOWED = 2000
#: largest number of examined peaks
_PEAKS = 12
#: number of lines next to 0 with which an offset is compared
_LOWEST = 8


class LikelyCause(NamedTuple):
    """A likely cause and its text."""

    cause: Cause
    text: str
    #: the changed mode, if this is the cause and it can be found
    change: ModeChange | None = None


class Outliers(NamedTuple):
    """Outliers (k, sensor), their sizes, and the innovations without them."""

    places: list[tuple[int, int]]
    sizes: list[float]
    white: FloatArray


def outliers(
    observer: KalmanEstimator, white: FloatArray, normal: FloatArray, alpha: float
) -> Outliers | None:
    """Return single outliers of sensors, or None."""
    # an outlier is an innovation that is too large for Gaussian ones of the same median; its effect
    # on all later ones, the filter's response to one sample, is removed before the next search.
    # Many consecutive ones are a motion of the machine and not outliers
    from scipy.stats import norm

    count = int(np.isfinite(normal).sum())
    spread = np.nanmedian(np.abs(normal), axis=0) / norm.ppf(0.75)
    # the median of n samples is known within 1.2 / sqrt(n); twice this is added
    limit = norm.isf(0.5 * alpha / count) * (1.0 + 2.4 / np.sqrt(len(normal)))
    bound = limit * np.maximum(spread, TINY)
    if not np.any(np.abs(normal) > bound):
        return None
    left, plain = white.copy(), normal.copy()
    length = min(_FOLLOWED, settling(observer), len(white))
    response = impulse(observer, length)
    model = observer.model
    S = model.innovation(observer.predicted_covariance)
    root, size = innovation_root(S), np.sqrt(S.diagonal())
    places: list[tuple[int, int]] = []
    sizes: list[float] = []
    while np.any(late := np.abs(plain) > bound):
        if len(places) >= max(_FEW, int(_RARE * len(white))):
            return None
        # the first one: later ones may be its effect
        k = int(np.flatnonzero(np.any(late, axis=1))[0])
        i = int(np.argmax(np.where(late[k], np.abs(plain[k]) / bound, 0.0)))
        own = response[: len(white) - k, :, i]
        if (k, i) in places:
            plain[k, i] = 0.0
            continue
        seen = np.all(np.isfinite(left[k : k + len(own)]), axis=1)
        there = left[k : k + len(own)][seen]
        amount = float(np.sum(own[seen] * there) / np.sum(own[seen] ** 2)) if seen.any() else 0.0
        if not seen[0]:
            plain[k, i] = 0.0
            continue
        left[k : k + len(own)] -= amount * own
        plain[k : k + len(own)] -= amount * own @ root.T / size
        places.append((k, i))
        sizes.append(amount)
    at = np.array(sorted(k for k, _ in places))
    near = np.diff(at) <= _APART
    if not places or (at.size > _APART and np.mean(near) > _BURST):
        return None
    return Outliers(places, sizes, left)


def outlier_text(found: Outliers, observer: KalmanEstimator, time: FloatArray) -> str:
    """Return a text of the outliers."""
    units = observer.plant.units
    listed = [
        f"{with_unit(size, units.get(observer.sensors[i]))} of {observer.sensors[i]} at "
        f"{time[k]:.6g} s"
        for (k, i), size in list(zip(found.places, found.sizes, strict=True))[:3]
    ]
    more = len(found.places) - len(listed)
    return (
        f"{counted(len(found.places), 'single sample')} too large for noise: "
        f"{', '.join(listed)}{f' and {more} more' if more else ''}: outliers. Leave them out: "
        "observer.estimate(records, gate=6)."
    )


class Offset(NamedTuple):
    """Mean of the whitened innovations, and text of the verdict."""

    mean: FloatArray
    text: str


def offset(observer: KalmanEstimator, white: FloatArray, alpha: float) -> Offset | None:
    """Return a constant part of the innovations beyond the density at the lowest lines, or None."""
    from scipy.stats import chi2, f

    there = np.all(np.isfinite(white), axis=1)
    n, p = int(there.sum()), white.shape[1]
    x = np.where(there[:, None], white, 0.0)
    mean = x.sum(axis=0) / n
    low = np.fft.rfft(x - np.where(there[:, None], mean, 0.0), axis=0)[1 : _LOWEST + 1]
    around = max(float(np.mean(np.abs(low) ** 2)) / n, TINY)
    power = n * float(mean @ mean) / p
    if f.sf(power / around, p, 2 * p * _LOWEST) >= alpha or chi2.sf(power * p, p) >= alpha:
        return None
    gain, units = steady_gain(observer), observer.plant.units
    along = np.sum(gain**2, axis=0)
    sizes = gain.T @ mean / divisor(along)
    rest = n * (mean @ mean - sizes**2 * along) / around
    possible = [i for i in np.argsort(rest) if rest[i] < chi2.isf(alpha, max(p - 1, 1)) or p == 1]
    if not possible:
        named = "sensors have offsets"
    else:
        each = [
            f"{observer.sensors[i]} by {with_unit(float(sizes[i]), units.get(observer.sensors[i]))}"
            for i in possible[:4]
        ]
        named = f"a sensor has an offset ({' or '.join(each)})"
    return Offset(
        mean,
        f"the innovations have a mean, {np.sqrt(mean @ mean):.3g} of their deviation: {named}, "
        "or a constant force acts that is not in the records. Subtract it from the record.",
    )


def settling(observer: KalmanEstimator) -> int:
    """Return the number of samples in which an error of the filter decays to a thousandth."""
    radius = observer.certificate["spectral radius"]
    return int(np.ceil(np.log(1e-3) / np.log(radius))) if 0 < radius < 1 else 1


class SampledModes(NamedTuple):
    """Elastic modes of a plant: their numbers, from 1, and frequencies [Hz]."""

    numbers: IntArray
    freq: FloatArray

    def named(self, i: int) -> str:
        """Return a text of a mode."""
        return f"mode {self.numbers[i]} ({self.freq[i]:.4g} Hz"


def sampled_modes(plant: AnyPlant) -> SampledModes:
    """Return the elastic modes of a plant."""
    if plant.modal_blocks.size:
        omega = np.sqrt(np.abs(np.linalg.det(plant.modal_blocks)))[plant.n_rigid :]
        return SampledModes(plant.n_rigid + 1 + np.arange(omega.size), omega / (2 * np.pi))
    poles = np.linalg.eigvals(plant.system.A)
    swinging = poles[(poles.imag > 0) & (np.abs(poles) > 0.1)]
    freq = np.sort(np.angle(swinging)) / (2 * np.pi * plant.dt)
    return SampledModes(1 + np.arange(freq.size), freq)


def folded(freq: FloatArray, rate: float) -> FloatArray:
    """Return the apparent frequencies after sampling."""
    return np.asarray(np.abs(freq - rate * np.round(freq / rate)))


class Examined(NamedTuple):
    """Peaks [cycles per sample] without a change so far, and possible distance of modes."""

    tried: FloatArray
    reach: float

    @classmethod
    def of(cls, tried: list[float], whole: AnyPlant | None) -> Examined:
        """Return the peaks; known truncated modes may cause others near kept modes."""
        return cls(np.array(tried), NEAR if whole is None else _DRIFTED)


def peak_verdicts(
    observer: KalmanEstimator,
    lines: InnovationLines,
    U: ComplexArray,
    level: FloatArray,
    peaks: list[ExcessPeak],
    whole: tuple[AnyPlant, IntArray] | None,
    before: Examined,
) -> list[LikelyCause]:
    """Return the verdicts of peaks beyond the pooled `level` (m,); U (m, nu) are the commands."""
    # `whole` is the evaluation plant with the numbers of truncated modes, or None. The highest peak
    # gets any cause, the others only a changed kept mode
    plant, rate = observer.plant, 1.0 / observer.plant.dt
    kept = sampled_modes(plant)
    seen = folded(kept.freq, rate)
    if not plant.modal_blocks.size:  # its modes cannot be changed separately
        highest = max(peaks, key=lambda one: one.height)
        near = _modes_near(seen, highest.freq * rate, NEAR)
        if near.size:
            return [LikelyCause("frequency", _wrong_mode(highest, rate, kept.named(int(near[0]))))]
    causes: list[LikelyCause] = []
    handled: set[int] = set()
    for rank, peak in enumerate(sorted(peaks, key=lambda one: -one.height)[:_PEAKS]):
        at = peak.freq * rate
        near = _modes_near(seen, at, before.reach if rank or before.tried.size else NEAR)
        if whole is not None:  # a truncated mode may be closer
            others = folded(left_modes(*whole).freq, rate)
            near = near[np.abs(seen[near] - at) <= np.min(np.abs(others - at), initial=np.inf)]
        if handled.intersection(near.tolist()):
            continue  # explained already
        if np.any(np.abs(before.tried - peak.freq) <= NEGLIGIBLE * peak.freq):
            near = near[:0]
        for i in near.tolist() if plant.modal_blocks.size else ():
            band = peak_band(lines, U, level, rate, at, float(seen[i]))
            mode, number = float(kept.freq[i]), int(kept.numbers[i])
            straight = abs(mode - rate * np.round(mode / rate) - seen[i]) <= SAME * rate
            change = explained_by_change(observer, band, number, mode, 1.0 if straight else -1.0)
            if change is not None:
                text = _wrong_mode(peak, rate, kept.named(i))
                if any(one.change is not None for one in causes):
                    text = (
                        f"likewise {peak.height:.3g} times at {at:.4g} Hz, near {kept.named(i)})."
                    )
                causes.append(LikelyCause("frequency", text, change))
                handled.add(i)
                break
        else:
            if not rank:
                causes.append(_other_cause(observer, peaks, kept, near, whole))
    return causes


def _modes_near(seen: FloatArray, at: float, reach: float) -> IntArray:
    """Return the modes to which a peak may belong, the closest first."""
    near = np.flatnonzero(np.abs(seen - at) <= reach * np.maximum(seen, TINY))
    return near[np.argsort(np.abs(seen[near] - at))]


def _wrong_mode(peak: ExcessPeak, rate: float, mode: str) -> str:
    return (
        f"{_phrase(peak, rate)}, near {mode} in the plant): its frequency or damping is not the "
        "machine's. Update the model."
    )


def _other_cause(
    observer: KalmanEstimator,
    peaks: list[ExcessPeak],
    kept: SampledModes,
    near: IntArray,
    whole: tuple[AnyPlant, IntArray] | None,
) -> LikelyCause:
    """Return the verdict of a highest peak that no change of a kept mode explains."""
    rate = 1.0 / observer.plant.dt
    top = np.max(kept.freq[kept.freq < 0.5 * rate], initial=0.0)
    highest = max(peaks, key=lambda one: one.height)
    at = highest.freq * rate
    found = None if whole is None else _left_out_mode(observer, left_modes(*whole), at)
    if found is not None:
        return LikelyCause(found.cause, f"{_phrase(highest, rate)}: {found.text}")
    # truncated modes above those of the plant cause peaks among these too, since their compliance
    # is missing
    above = [one for one in peaks if one.freq * rate > top]
    shown = max(above, key=lambda one: one.height, default=highest)
    nyquist = f"{0.5 * rate:.5g} Hz"
    where = "above all modes of the plant" if above else "where the plant has no mode"
    if near.size and shown is highest:
        where = f"which no change of {kept.named(int(near[0]))} in the plant) explains"
    lacks = (
        "or a disturbance that is missing in the plant. Keep more modes, or add the disturbance."
    )
    if above:
        out = f"a truncated mode (above {nyquist} it appears folded)"
        return LikelyCause("truncation", f"{_phrase(shown, rate)}, {where}: {out}, {lacks}")
    return LikelyCause(
        "folding",
        f"{_phrase(shown, rate)}, {where}; it has modes up to {top:.4g} Hz: a truncated one "
        f"above {nyquist} appears folded (from {rate - at:.5g} or {rate + at:.5g} Hz, say), "
        + lacks,
    )


def _phrase(peak: ExcessPeak, rate: float) -> str:
    return (
        f"the innovations have {peak.height:.3g} times the density that noise explains at "
        f"{peak.freq * rate:.4g} Hz"
    )


def left_modes(whole: AnyPlant, numbers: IntArray) -> SampledModes:
    """Return the truncated modes of an evaluation plant."""
    every = sampled_modes(whole)
    at = np.flatnonzero(np.isin(every.numbers, numbers))
    return SampledModes(every.numbers[at], every.freq[at])


def _left_out_mode(observer: KalmanEstimator, left: SampledModes, at: float) -> LikelyCause | None:
    """Return which truncated mode appears at a frequency [Hz], or None."""
    rate = 1.0 / observer.plant.dt
    seen = folded(left.freq, rate)
    i = int(np.argmin(np.abs(seen - at)))
    if abs(seen[i] - at) > NEAR * at:
        return None
    name = f"{left.named(i)} in the evaluation model), which is truncated in the plant"
    cure = (
        "give the plant an evaluation model, so that it counts as noise"
        if observer.left_out is None
        else "leave it: it counts as white noise in this filter"
    )
    if left.freq[i] > 0.5 * rate:
        text = f"{name}, appears folded at {seen[i]:.4g} Hz. Keep it, filter before sampling, or"
        return LikelyCause("folding", f"{text} {cure}.")
    return LikelyCause("truncation", f"{name}. Keep it, or {cure}.")


def known_verdict(
    observer: KalmanEstimator, left: SampledModes, parts: InnovationParts, freq: FloatArray
) -> LikelyCause:
    """Return the verdict for innovations that agree with the evaluation plant."""
    rate = 1.0 / observer.plant.dt
    at = float(freq[np.argmax(parts.pooled.sum(axis=0))]) * rate
    i = int(np.argmin(np.abs(folded(left.freq, rate) - at)))
    end = (
        "Keep more modes, or give the plant an evaluation model, so that they count as noise."
        if observer.left_out is None
        else "These count as white noise in this filter: its predicted errors hold."
    )
    return LikelyCause(
        "folding" if left.freq[i] > 0.5 * rate else "truncation",
        "the innovations agree with the evaluation model: the plant is correct, they are coloured "
        f"by the {counted(left.freq.size, 'truncated mode')} (most at {at:.4g} Hz, next to "
        f"{left.named(i)} in the evaluation model)). {end}",
    )

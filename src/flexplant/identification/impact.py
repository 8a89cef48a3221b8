"""Impact tests: hammer blows found in records, and removal of the window's damping."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field
from typing import Any

import numpy as np
import numpy.typing as npt

from ..arrays import ComplexArray, FloatArray, IntArray, between, instance, positive
from ..errors import ModelError, ShapeError, SolverError, counted, require_known, short
from ..lti.frequency import Frf, error_statistics
from ..store import Value
from ..tolerances import CERTAIN, TINY
from .lines import mains_multiple
from .result import IdentifiedModes
from .spectra import Records, dropouts_warned, records

#: number of equal samples at the extreme value of a channel that indicate clipping, and number of
#: quanta that one of the two preceding steps must exceed. The same number of equal samples at a
#: smooth peak, ``p - c t^2``, means that c is at most a quantum, with preceding steps of ``3 c``
#: and ``5 c`` plus a quantum of rounding
FLAT, STEEP = 3, 6.0
#: exponent of the window's end, exp(-4) = 2 %, by default: resonances are at least 1.3 lines wide
WINDOWS = 4.0
#: complex degrees of freedom of a variance, reached by averaging over lines when blows are few
FREEDOM = 8


@dataclass(frozen=True, eq=False, repr=False)
class Blow(Value):
    """One blow of an impact test.

    Parameters
    ----------
    input : str
        Channel of the force.
    time : float [s]
        Time at which the pulse begins.
    peak : float
        Largest force, in the unit of the record.
    experiment : int
        Number of the record, from 0.
    reason : str
        Reason why the blow is refused and not averaged. Empty: the blow is used.

    Examples
    --------
    A blow that is not used, because another one follows:

    >>> Blow("1:z", 2.0, 180.0, reason="another blow follows after 0.04 s")
    Blow(input='1:z', time=2, peak=180, experiment=0, reason='another blow follows after 0.04 s')
    """

    input: str
    time: float
    peak: float
    experiment: int = 0
    reason: str = ""


@dataclass(frozen=True, eq=False, repr=False)
class ImpactTest(Value):
    """Result of `impact_frf`: FRFs that include the damping of an exponential window.

    `impact_frf` multiplies force and responses by the window ``exp(-t/decay)``, which adds damping
    to every pole. The method `corrected` subtracts this damping.

    Parameters
    ----------
    frf : Frf
        FRF ``H(s + 1/decay)`` at ``s = i omega``, in which every pole has moved by ``-1/decay``.
        The window correlates the errors of neighbouring lines. Fits assume independent errors. The
        variance is therefore multiplied by `dependence`, so that a mean over lines has the correct
        variance.
    used, refused : sequences of Blow
        Averaged blows, and refused blows with the reason.
    segment : float [s]
        Length of record after each blow.
    decay : float [s]
        Time constant of the window. It is infinite without a window.

    Examples
    --------
    The decay rate of the resonance is 2 1/s. The window adds 2 1/s, and `corrected` subtracts it:

    >>> import flexplant as fx
    >>> import numpy as np
    >>> time = np.arange(6000) / 1e3
    >>> force = np.isin(time, [0.1, 3.0]) * 1.0
    >>> ring = np.exp(-2.0 * time) * np.sin(2 * np.pi * 40.0 * time)
    >>> response = np.convolve(force, ring)[:6000]
    >>> response += 1e-4 * np.random.default_rng(1).normal(size=6000)
    >>> test = fx.identification.impact_frf(force, response, 1e3, segment=2.0)
    >>> seen = fx.identify_modes(test.frf, band=(20.0, 60.0))
    >>> -seen.poles.real.round(1), -test.corrected(seen).poles.real.round(1)
    (array([4.]), array([2.]))
    """

    frf: Frf
    used: tuple[Blow, ...] = field(kw_only=True)
    refused: tuple[Blow, ...] = field(default=(), kw_only=True)
    segment: float = field(kw_only=True)
    decay: float = field(kw_only=True)

    @property
    def dependence(self) -> float:
        r"""Sum of the correlations between the error of one line and the errors of all lines.

        It is ``T/tau coth(T/tau)`` with the length T of the segment and the time constant tau of
        the window, and 1 without a window.
        """
        return _dependence(self.segment / self.decay)

    def __repr__(self) -> str:
        window = f"window of {self.decay:.4g} s" if np.isfinite(self.decay) else "no window"
        head = (
            f"<ImpactTest: {counted(len(self.used), 'blow')} used, {len(self.refused)} refused, "
            f"segments of {self.segment:.4g} s, {window}>"
        )
        return "\n".join([head, *(f"  refused {blow!r}" for blow in self.refused)])

    def corrected(self, found: IdentifiedModes) -> IdentifiedModes:
        r"""Return modes identified from `frf` without the damping of the window.

        Poles whose remaining damping is smaller than its standard deviation are moved to
        `rejected`. Force and responses that are multiplied by the window ``w = exp(-t/tau)`` have
        the FRF ``H(s + 1/tau)``. Poles move by exactly -1/tau, and residues do not change.

        The covariance is corrected too. The noise is assumed white, and T is the length of a
        segment. For a pole with the real part -a on the machine, the derivative of the response
        with respect to the pole has the envelope ``g = t exp(-(a + 1/tau) t)``. The fit assumes
        independent errors of the lines. The variance of the pole that follows from this assumption
        is multiplied by

        .. math:: \frac{\int g^2 w^2 dt}{\overline{w^2} \int g^2 dt} = \frac{2T}{\tau}
            \left(\frac{a + 1/\tau}{a + 2/\tau}\right)^3

        where the bar denotes the mean over a segment. It is then divided by `dependence`, by which
        the variance of `frf` was multiplied. For residues the exponent is 1 in place of 3.

        Parameters
        ----------
        found : IdentifiedModes
            Result of `identify_modes` for `frf`.

        Raises
        ------
        ModelError, SolverError
            When the damping of the window was already removed, or no pole has a remaining damping
            above its standard deviation.
        """
        instance(found, IdentifiedModes, "found", "Pass identify_modes(test.frf).")
        if not np.isfinite(self.decay):
            return found
        if found.undamped:
            raise ModelError(
                "the window's damping is already removed from these modes: pass "
                "identify_modes(test.frf)."
            )
        shift = 1.0 / self.decay
        rate = -(found.poles.real + shift)
        known = np.zeros(rate.size) if found.std is None else found.std.real
        mains = [mains_multiple(freq, 1.0 / self.segment) for freq in found.freq.tolist()]
        # a mains line has no damping, but exceeds one deviation by chance in one of six cases
        least = known * np.where([one is None for one in mains], 1.0, 2.0)
        damped = np.flatnonzero((rate > 0) & (rate > least))
        listed = [(f, z - shift / (2 * np.pi * f), why) for f, z, why in found.rejected]
        for k in np.setdiff1d(np.arange(len(found)), damped):
            why = mains[k] or (
                f"without damping beyond the window: {rate[k]:.2g} +- {known[k]:.2g} rad/s"
            )
            listed.append((float(found.freq[k]), float(rate[k] / abs(found.poles[k])), why))
        if not damped.size:
            raise SolverError(
                f"no pole has damping beyond the window's {shift:.3g} rad/s: they are "
                "disturbances with a single frequency, or the segments are too short. Use "
                "longer ones, segment=."
            )
        kept, rate = found.select(damped.tolist()), rate[damped]
        share = (rate + shift) / (rate + 2 * shift)
        whole = 2 * self.segment * shift / -np.expm1(-2 * self.segment * shift)
        whole = whole / self.dependence
        size = np.tile(np.sqrt(whole * share**3), 2)
        spread, residues = kept.covariance, kept.channel_covariance
        poles, shapes, participation = kept.unreported
        return kept.replace(
            poles=kept.poles + shift,
            covariance=None if spread is None else spread * np.outer(size, size),
            channel_covariance=(
                None if residues is None else residues * (whole * share)[:, None, None]
            ),
            unreported=(poles + shift, shapes, participation),
            rejected=tuple(sorted(listed)),
            undamped=shift,
        )


def impact_frf(
    force: npt.ArrayLike | Mapping[str, Any],
    response: npt.ArrayLike | Mapping[str, Any],
    rate: float,
    *,
    segment: float,
    decay: float | None = None,
    level: float = 0.05,
    limits: Mapping[str, float] | float | None = None,
    quantity: str | None = None,
) -> ImpactTest:
    r"""Return the FRFs of an impact test, ``G = sum(Y F^*) / sum(F F^*)`` over its blows.

    Y and F are the Fourier transforms of a response and of the force after a blow, and F^* is the
    complex conjugate of F. A record may contain many blows, which are found as pulses of the force.
    Each blow has a separate segment, in which the force outside the pulse is set to zero (force
    window). Force and responses are multiplied by the exponential window ``exp(-t/decay)``. This
    moves all poles by -1/decay, and `ImpactTest.corrected` moves them back. A vibration that has
    not died out at the end of a segment falsifies the residues, but not the poles. Blows are left
    out if their segment contains another blow, if they are clipped, or if the record ends too
    early. If a record begins with a blow, the machine is assumed to be at rest before it.

    Parameters
    ----------
    force : (n_time,), (n_in, n_time) or (n_exp, n_in, n_time) array, or mapping by name
        Force of the hammer, with one channel for each struck point. A channel is zero while other
        points are struck.
    response : array or mapping
        Measured responses, as for `estimate_frf`.
    rate : float [Hz]
        Sampling rate of the records.
    segment : float [s]
        Length of record for each blow. Its inverse is the resolution.
    decay : float [s], optional
        Time constant of the exponential window. None: a quarter of the segment. Infinity: there is
        no window.
    level : float
        Fraction of the largest force of a record above which a pulse begins, between 0 and 1.
    limits : mapping {channel: value}, or float, optional
        Full scale of each channel, or one value for all channels. A blow is refused as clipped if a
        signal reaches its full scale. If no full scale is given, clipping is found in the signal
        itself. A clipped signal rises steeply to its largest or smallest value and keeps this value
        for several samples. ``limits=1e9`` disables this test. A warning names each output that
        never changes its value.
    quantity : {"displacement", "velocity", "acceleration"}, optional
        Quantity of the responses.

    Returns
    -------
    ImpactTest
        FRF with coherence, variance and correlation, and the used and refused blows.

    Raises
    ------
    ModelError, ShapeError, LabelError
        When records do not match, or an input has no blow that can be used.

    References
    ----------
    [BendatPiersol2010]_, ch. 6 and 9 (H1, its variance); [PintelonSchoukens2012]_, ch. 6.

    Examples
    --------
    Two of four blows are used, and two are too close to each other:

    >>> import numpy as np
    >>> force = np.zeros(3000)
    >>> force[[100, 1000, 2000, 2040]] = 1.0  # the last one rebounds
    >>> response = np.convolve(force, [0.0, 2.0, 1.0])[:3000]
    >>> response += 0.01 * np.random.default_rng(1).normal(size=3000)
    >>> test = impact_frf({"1:z": force}, {"1:z": response}, 1e3, segment=0.5, limits={"1:z": 9.0})
    >>> [blow.time for blow in test.used], [blow.reason for blow in test.refused]
    ([0.1, 1.0], ['another blow follows after 0.04 s', 'a blow came 0.04 s before'])
    """
    data = records(force, response, None, rate, quantity)
    between(level, "level", 0.0, 1.0, "A twentieth is usual: 0.05.")
    length = data.samples(positive(segment, "segment"))
    tau = segment / WINDOWS
    if decay is not None:
        endless = isinstance(decay, float) and decay == float("inf")
        tau = decay if endless else positive(decay, "decay")
    full = _full_scale(limits, data.inputs, data.outputs)
    dropouts_warned(data)
    f = data.u - np.median(data.u, axis=2, keepdims=True)
    y = data.y - np.mean(data.y, axis=2, keepdims=True)
    window = np.exp(-np.arange(length) / (tau * data.rate))
    used: list[Blow] = []
    refused: list[Blow] = []
    forces: list[list[ComplexArray]] = [[] for _ in data.inputs]
    motions: list[list[ComplexArray]] = [[] for _ in data.inputs]
    for e in range(f.shape[0]):
        for blow, i, start, (before, width) in _blows(data, f, e, level, length, full):
            if blow.reason:
                refused.append(blow)
                continue
            used.append(blow)
            # 1 until a pulse's width after it, then half a cosine to zero over another width
            time = np.arange(length) - (before + 2 * width)
            force_window = 0.5 + 0.5 * np.cos(np.pi * np.clip(time / max(width, 1), 0.0, 1.0))
            own = _segment(f[e, i], start, length) * force_window * window
            forces[i].append(np.fft.rfft(own))
            motions[i].append(np.fft.rfft(_segment(y[e], start, length) * window, axis=1))
    for name, own_forces in zip(data.inputs, forces, strict=True):
        if not own_forces:
            why = "; ".join(repr(blow) for blow in refused if blow.input == name)
            raise ModelError(
                f"{name} has no blow that can be used ({why or 'no pulse in its record'}): "
                "shorten segment= where blows follow too soon, check level= and the ranges, or "
                "measure again."
            )
    inner = slice(1, (length + 1) // 2)
    F = [np.array(part)[:, inner] for part in forces]
    Y = [np.array(part)[:, :, inner] for part in motions]
    freq = np.asarray(np.arange(length // 2 + 1)[inner] / length * data.rate, dtype=np.float64)
    names = {"inputs": data.inputs, "outputs": data.outputs, "quantity": quantity}
    frf = _averaged(freq, F, Y, data.rate / length, names)
    if frf.variance is not None:
        frf = frf.replace(variance=frf.variance * _dependence(length / (tau * data.rate)))
    return ImpactTest(
        frf, used=tuple(used), refused=tuple(refused), segment=length / data.rate, decay=tau
    )


def _segment(signals: FloatArray, start: int, length: int) -> FloatArray:
    """Return samples from `start` on, with zeros for what lies before the record."""
    inside = signals[..., max(start, 0) : start + length]
    front = np.zeros((*signals.shape[:-1], length - inside.shape[-1]))
    return np.concatenate([front, inside], axis=-1)


def _averaged(
    freq: FloatArray,
    F: list[ComplexArray],
    Y: list[ComplexArray],
    resolution: float,
    names: dict[str, Any],
) -> Frf:
    """Return H1 over the blows (n_blow, ...) of each input; noise is their common residual."""
    import scipy.ndimage as ndi

    power = np.array([np.sum(np.abs(one) ** 2, axis=0) for one in F])
    if not np.all(power > 0):
        raise ModelError("a force has no power at some lines: check the channel of the hammer.")
    cross = [np.einsum("hof,hf->of", y, f.conj()) for y, f in zip(Y, F, strict=True)]
    G = np.stack([c / p for c, p in zip(cross, power, strict=True)], axis=1)
    spare = sum(len(one) - 1 for one in F)
    variance = correlation = coherence = freedom = None
    if spare:
        error = np.concatenate(
            [y - G[None, :, i] * f[:, None] for i, (y, f) in enumerate(zip(Y, F, strict=True))]
        )
        left = np.einsum("haf,hbf->fab", error, error.conj()) / spare
        lines = -(-FREEDOM // spare) | 1
        left = ndi.uniform_filter1d(left, lines, axis=0, mode="nearest")
        inverse = np.einsum("if,ij->fij", 1.0 / power, np.eye(len(F)))
        variance, correlation = error_statistics(left, inverse)
        if not np.all(variance > 0):
            variance = correlation = None  # no noise at all, hence no weights
        seen = np.stack([np.sum(np.abs(y) ** 2, axis=0) for y in Y], axis=1)
        coherent = np.abs(np.stack(cross, axis=1)) ** 2
        coherence = np.clip(coherent / np.maximum(power[None] * seen, TINY), 0.0, 1.0)
        freedom = None if variance is None else float(spare * lines)
    return Frf(
        freq,
        G,
        **names,
        coherence=coherence,
        variance=variance,
        correlation=correlation,
        freedom=freedom,
        resolution=resolution,
    )


def _blows(
    data: Records, f: FloatArray, e: int, level: float, length: int, full: Mapping[str, float]
) -> Iterator[tuple[Blow, int, int, tuple[int, int]]]:
    """Yield the blows of experiment e: input, start of the segment, samples before, width."""
    from scipy.stats import median_abs_deviation

    largest = float(np.abs(f).max())
    pulses = sorted(
        (begin, end, i)
        for i, force in enumerate(f[e])
        for begin, end in _pulses(force, level, largest)
    )
    before = 2 + max((end - begin for begin, end, _ in pulses), default=0)
    # a force is at rest nearly all the time, within its noise; for responses this is not known
    rest = CERTAIN * median_abs_deviation(f[e], axis=1, scale="normal")
    limited = _limited(data.u[e], data.inputs, full, rest)
    limited |= _limited(data.y[e], data.outputs, full, np.zeros(len(data.outputs)))
    begins = [pulse[0] for pulse in pulses]
    for k, (begin, end, i) in enumerate(pulses):
        start = begin - before
        reason = _unusable(begins, k, start, length, f.shape[2], data.rate)
        pulse = f[e, i, begin:end]
        if not reason and begin == 0 and end > 1 and abs(pulse[0]) > abs(pulse[1]):
            reason = "the record begins within its pulse"
        over = [name for name, at in limited.items() if at[max(start, 0) : start + length].any()]
        if not reason and over:
            reason = f"{over[0]} is at the limit of its range"
        peak = float(pulse[np.argmax(np.abs(pulse))])
        blow = Blow(data.inputs[i], begin / data.rate, peak, e, reason)
        yield blow, i, start, (before, end - begin)


def _pulses(force: FloatArray, level: float, largest: float) -> list[tuple[int, int]]:
    """Return start and end of pulses; pulses closer than the width of one are merged."""
    from scipy.stats import median_abs_deviation

    size = float(np.abs(force).max())
    noise = float(median_abs_deviation(force, scale="normal"))
    high = np.flatnonzero(np.abs(force) > max(level * size, CERTAIN * noise))
    if size < level * largest or not high.size:
        return []
    found = [(int(high[0]), int(high[0]) + 1)]
    for at in high[1:].tolist():
        begin, end = found[-1]
        if at - end <= end - begin:
            found[-1] = (begin, at + 1)
        else:
            found.append((at, at + 1))
    return found


def _unusable(begins: list[int], k: int, start: int, length: int, n_time: int, rate: float) -> str:
    """Return the reason why a blow cannot be used, empty where it can."""
    if k and begins[k] < begins[k - 1] + length - (begins[k] - start):
        return f"a blow came {(begins[k] - begins[k - 1]) / rate:.3g} s before"
    if k + 1 < len(begins) and begins[k + 1] < start + length:
        return f"another blow follows after {(begins[k + 1] - begins[k]) / rate:.3g} s"
    if start + length > n_time:
        return f"the record ends {(n_time - begins[k]) / rate:.3g} s after it"
    return ""


def _limited(
    signals: FloatArray, names: tuple[str, ...], full: Mapping[str, float], rest: FloatArray
) -> dict[str, Any]:
    """Return {channel: samples at the limit of its range} for channels with such samples.

    `rest` is the largest deviation of signals (n, n_time) from their median at rest.
    """
    found = {}
    for name, signal, near in zip(names, signals, rest.tolist(), strict=True):
        if name in full:
            at = np.abs(signal) >= full[name]
        else:
            at = np.zeros(signal.size, dtype=np.bool_)
            steps = np.abs(np.diff(signal))
            # the quantum of a converter, or the rounding of the numbers
            quantum = float(np.diff(np.unique(signal)).min(initial=np.inf))
            for extreme in (signal.max(), signal.min()):
                if abs(extreme - np.median(signal)) > near:
                    at |= _flat_runs(signal == extreme, steps, STEEP * quantum)
        if at.any():
            found[name] = at
    return found


def _flat_runs(extreme: Any, steps: FloatArray, steep: float) -> Any:
    """Return runs of FLAT samples of `extreme` with a step larger than `steep` just before them."""
    edges = np.diff(np.concatenate([[0], extreme.astype(np.int8), [0]]))
    at = np.zeros(extreme.size, dtype=np.bool_)
    begins: IntArray = np.flatnonzero(edges == 1)
    for begin, end in zip(begins, np.flatnonzero(edges == -1), strict=True):
        if end - begin >= FLAT and np.any(steps[max(begin - 2, 0) : begin] > steep):
            at[begin:end] = True
    return at


def _dependence(damped: float) -> float:
    """Return x coth(x) for x = T/tau; 1 without a window."""
    return damped / float(np.tanh(damped)) if damped else 1.0


def _full_scale(limits: Any, inputs: tuple[str, ...], outputs: tuple[str, ...]) -> dict[str, float]:
    """Return limits of known channels, of all where one number is given."""
    names = [*inputs, *outputs]
    if limits is None:
        return {}
    if isinstance(limits, int | float) and not isinstance(limits, bool):
        return dict.fromkeys(names, positive(limits, "limits"))
    if not isinstance(limits, Mapping):
        raise ShapeError(
            "limits is a full scale of all channels, or a mapping {channel: full scale} such as "
            f"{{'force': 500.0}}, got {short(limits)}."
        )
    require_known("channel", limits, names)
    return {name: positive(value, f"limits[{name!r}]") for name, value in limits.items()}

"""Averaged spectra of records, and FRFs from them: H1, H2, Hv, joint input-output."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from ..arrays import ComplexArray, FloatArray, positive, real_array, signal_names
from ..errors import ModelError, ShapeError, require_known, warn
from ..lti.frequency import ORDERS, Frf, checked_overlap, checked_window, error_statistics
from ..store import Value, checked
from ..tolerances import ROUNDING, TINY


@dataclass(frozen=True, eq=False, repr=False, kw_only=True)
class SpectralMethod(Value):
    """Averages of windowed, overlapping segments (Welch); the base of H1, H2 and Hv."""

    segment: float | None = field(default=None, metadata=checked(positive, unit="s"))
    overlap: float = field(default=0.5, metadata=checked(checked_overlap))
    window: str | tuple[Any, ...] = field(default="hann", metadata=checked(checked_window))


class H1Estimator(SpectralMethod):
    """The estimator H1, ``G = S_yu S_uu^-1``, for noise on the outputs.

    S_yu is the matrix of cross spectra between outputs y and inputs u, and S_uu that of the inputs.
    The record is divided into overlapping segments, and the spectra are means over the segments
    (Welch's method). The estimate has no bias from noise on the outputs if the machine is measured
    in open loop.

    Parameters
    ----------
    segment : float, optional
        Length of a segment [s]. Its inverse is the resolution. None: an eighth of the record.
    overlap : float
        Fraction of a segment that overlaps with the next one, from 0 to below 1.
    window : str or tuple
        Window as for `scipy.signal.get_window`. Use "boxcar" if all signals are periodic in a
        segment.

    References
    ----------
    [BendatPiersol2010]_, chapter 9.

    Examples
    --------
    A system of gain 2 is measured with random noise:

    >>> import flexplant as fx
    >>> import numpy as np
    >>> u = np.random.default_rng(0).normal(size=(1, 4000))
    >>> method = fx.identification.H1Estimator(segment=0.1)  # s
    >>> frf = fx.estimate_frf(u, 2 * u, rate=1e3, method=method)
    >>> abs(frf.data[0, 0, :3]).round(6)
    array([2., 2., 2.])
    """


class H2Estimator(SpectralMethod):
    """The estimator H2, ``G = S_yy S_uy^-1``, for noise on the inputs.

    It needs as many outputs as inputs. With one input, each output is estimated separately, so that
    any number of outputs is possible. The spectra are named as in `H1Estimator`.

    Parameters
    ----------
    segment, overlap, window : optional
        Length of the segments, their overlap and their window, as for `H1Estimator`.

    Examples
    --------
    Segments of 0.1 s that overlap by one half:

    >>> H2Estimator(segment=0.1)
    H2Estimator(segment=0.1 s, overlap=0.5)
    """


class HvEstimator(SpectralMethod):
    """The estimator Hv, for noise on inputs and outputs: total least squares.

    At each frequency every output is fitted together with all inputs. Before the fit, each of these
    signals is scaled to unit power. For one input, the magnitude of the estimate is the geometric
    mean of the magnitudes of H1 and H2.

    Parameters
    ----------
    segment, overlap, window : optional
        Length of the segments, their overlap and their window, as for `H1Estimator`.

    Examples
    --------
    Segments of 0.1 s that overlap by one half:

    >>> HvEstimator(segment=0.1)
    HvEstimator(segment=0.1 s, overlap=0.5)
    """


@dataclass(frozen=True, eq=False)
class Averages:
    """Spectra (n_freq, n, n) of [y; u; r] over `count` effective averages."""

    freq: FloatArray
    S: ComplexArray
    count: float
    n_out: int
    n_in: int
    resolution: float

    def block(self, a: str, b: str) -> ComplexArray:
        """Return the cross spectra of two of "y", "u", "r"."""
        n, m = self.n_out, self.n_in
        sides = {"y": slice(0, n), "u": slice(n, n + m), "r": slice(n + m, n + 2 * m)}
        return self.S[:, sides[a], sides[b]]


def averages(data: Records, method: SpectralMethod) -> Averages:
    """Return Welch averages over segments and experiments; zero frequency is left out."""
    from scipy.signal import get_window

    n_time, length = data.u.shape[2], data.samples(method.segment)
    window = np.asarray(get_window(method.window, length), dtype=np.float64)
    hop = max(1, round(length * (1.0 - method.overlap)))
    starts = range(0, n_time - length + 1, hop)
    sides = [data.y, data.u] + ([] if data.r is None else [data.r])
    signals = np.concatenate(sides, axis=1)
    lines = length // 2 + 1
    S = np.zeros((lines, signals.shape[1], signals.shape[1]), dtype=np.complex128)
    for start in starts:
        part = signals[:, :, start : start + length]
        part = (part - part.mean(axis=2, keepdims=True)) * window
        spectrum = np.fft.rfft(part, axis=2)
        S += np.einsum("eaf,ebf->fab", spectrum, spectrum.conj())
    total = len(starts) * signals.shape[0]
    count = signals.shape[0] * _effective(window, hop, len(starts))
    freq: FloatArray = np.asarray(np.fft.rfftfreq(length, 1.0 / data.rate), dtype=np.float64)
    # at zero and at half the rate a spectrum is real, and the mean was removed
    keep = slice(1, (length + 1) // 2)
    sizes = data.y.shape[1], data.u.shape[1]
    return Averages(freq[keep], S[keep] / total, count, *sizes, data.rate / length)


def spectral_frf(data: Records, method: SpectralMethod, quantity: str | None) -> Frf:
    """Return the FRF of averaged spectra, with multiple coherence and variance."""
    found = averages(data, method)
    n_ref = found.n_in
    if found.count <= n_ref + 1:
        raise ModelError(
            f"{found.count:.1f} independent averages cannot separate {n_ref} inputs and noise: "
            "shorten segment=, or measure longer."
        )
    drive = "u"
    if data.r is None:
        G, inverse = _open_loop(found, method), _inverse(found.block("u", "u"))
    else:
        if type(method) is not H1Estimator:
            raise ModelError(
                "with a reference the estimate is joint input-output, G = S_yr S_ur^-1: pass "
                "method=identification.H1Estimator(...) or identification.Periodic(...)."
            )
        drive, back = "r", found.block("u", "r")
        weak_references_warned(found)
        G = _right_divided(found.block("y", "r"), back)
        inverse = _inverse(back @ _divide(found.block("r", "r"), back.conj().transpose(0, 2, 1)))
    explained = _divide(found.block(drive, drive), found.block(drive, "y"))
    coherent = np.einsum("fyu,fuy->fy", found.block("y", drive), explained).real
    power = np.einsum("fyy->fy", found.block("y", "y")).real
    coherence = np.clip(coherent / np.maximum(power, TINY), 0.0, 1.0)
    left = _left_over(found, G, with_reference=data.r is not None)
    left = left * (found.count / (found.count - n_ref))
    variance, correlation = error_statistics(left, inverse / found.count)
    return Frf(
        found.freq,
        G.transpose(1, 2, 0),
        inputs=data.inputs,
        outputs=data.outputs,
        quantity=quantity,
        coherence=np.repeat(coherence.T[:, None, :], found.n_in, axis=1),
        variance=variance,
        correlation=correlation,
        resolution=found.resolution,
        window=method.window,
        overlap=method.overlap,
    )


#: number of averages times the ratio of input power due to references to the rest, below which a
#: warning is given: below it the errors of the quotient are on average a hundred times its
#: variance, above 6 they agree
STRONG = 8.0


def weak_references_warned(found: Averages) -> None:
    """Warn of lines at which references hardly affect the inputs, so that the FRF is unknown."""
    back, power = found.block("u", "r"), np.einsum("fuu->fu", found.block("u", "u")).real
    moved = _divide(found.block("r", "r"), back.conj().transpose(0, 2, 1))
    explained = np.einsum("fur,fru->fu", back, moved).real
    strength = found.count * explained / np.maximum(power - explained, TINY * power)
    weak = found.freq[np.min(strength, axis=1) < STRONG]
    if weak.size:
        warn(
            f"at {weak.size} of {found.freq.size} lines, {weak[0]:.4g} .. {weak[-1]:.4g} Hz, the "
            "references are too weak in the inputs, which consist mostly of noise, and S_yr "
            "S_ur^-1 divides by a small number. The variance is too small there. Leave these "
            "lines out, band=, or excite more there, measure longer, or use "
            "identification.Periodic(...)."
        )


def _left_over(found: Averages, G: ComplexArray, *, with_reference: bool) -> ComplexArray:
    """Return the spectrum (n_freq, n_out, n_out) of the part of y - G u that is noise."""
    n = found.n_out + found.n_in
    S = found.S[:, :n, :n]
    if with_reference:
        known = found.S[:, n:, :n]
        S = S - known.conj().transpose(0, 2, 1) @ _divide(found.block("r", "r"), known)
    row = np.concatenate(
        [np.broadcast_to(np.eye(found.n_out), G.shape[:1] + (found.n_out,) * 2), -G], 2
    )
    return np.asarray(row @ S @ row.conj().transpose(0, 2, 1))


def _open_loop(found: Averages, method: SpectralMethod) -> ComplexArray:
    yu, uu, yy = found.block("y", "u"), found.block("u", "u"), found.block("y", "y")
    if isinstance(method, H2Estimator):
        if found.n_in == 1:
            power = np.einsum("foo->fo", yy)[:, :, None]
            return np.asarray(power / yu.conj())
        if found.n_in != found.n_out:
            raise ShapeError(
                f"H2 inverts the cross spectra of outputs and inputs, got {found.n_out} and "
                f"{found.n_in}: take as many outputs as inputs, or H1Estimator or HvEstimator."
            )
        return _right_divided(yy, yu.conj().transpose(0, 2, 1))
    if isinstance(method, HvEstimator):
        rows = [_total(found, o) for o in range(found.n_out)]
        return np.stack(rows, axis=1)
    return _right_divided(yu, uu)


def _total(found: Averages, output: int) -> ComplexArray:
    places = np.array([output, *range(found.n_out, found.n_out + found.n_in)])
    S = found.S[:, places[:, None], places]
    size = np.sqrt(np.maximum(np.einsum("faa->fa", S).real, TINY))
    vectors = np.linalg.eigh(S / (size[:, :, None] * size[:, None, :]))[1][:, :, 0].conj()
    # eigenvector of the smallest eigenvalue: v_y y + v_u u = 0
    vectors = vectors / size
    return np.asarray(-vectors[:, 1:] / vectors[:, :1])


def _effective(window: FloatArray, hop: int, count: int) -> float:
    """Return the number of independent averages of overlapping segments [Welch1967]_."""
    power, doubled = float(np.sum(window**2)), 0.0
    for lag in range(1, count):
        shift = lag * hop
        if shift >= window.size:
            break
        shared = float(np.sum(window[shift:] * window[:-shift])) / power
        doubled += (1.0 - lag / count) * shared**2
    return count / (1.0 + 2.0 * doubled)


def _right_divided(a: ComplexArray, b: ComplexArray) -> ComplexArray:
    return _divide(b.transpose(0, 2, 1), a.transpose(0, 2, 1)).transpose(0, 2, 1)


def _inverse(a: ComplexArray) -> ComplexArray:
    return _divide(a, np.broadcast_to(np.eye(a.shape[1], dtype=np.complex128), a.shape))


def _divide(a: ComplexArray, b: ComplexArray) -> ComplexArray:
    size = np.linalg.svd(a, compute_uv=False)
    if np.any(size[:, -1] <= ROUNDING * size[:, 0]):
        raise ModelError(
            "the inputs (or references) are dependent at some lines: excite all inputs there, "
            "independently or in as many experiments as there are inputs."
        )
    return np.asarray(np.linalg.solve(a, b))


@dataclass(frozen=True, eq=False)
class Records:
    """Inputs, outputs and references (n_exp, n_channel, n_time) of the same experiments."""

    u: FloatArray
    y: FloatArray
    r: FloatArray | None
    inputs: tuple[str, ...]
    outputs: tuple[str, ...]
    rate: float

    def samples(self, segment: float | None) -> int:
        """Return the length of a segment [s] in samples, an eighth of the record by default."""
        n_time = self.u.shape[2]
        length = n_time // 8 if segment is None else round(segment * self.rate)
        if not 8 <= length <= n_time:
            raise ModelError(
                f"a segment of {length} samples in a record of {n_time}: choose segment= between "
                f"{8 / self.rate:g} and {n_time / self.rate:g} s."
            )
        return length


def records(inputs: Any, outputs: Any, reference: Any, rate: Any, quantity: Any) -> Records:
    """Return records from arrays or mappings by name; the quantity of the outputs is checked."""
    rate = positive(rate, "rate")
    if quantity is not None:
        require_known("quantity", [quantity], ORDERS)
    u, in_names = signals(inputs, "inputs", "u")
    y, out_names = signals(outputs, "outputs", "y")
    sides = {"outputs": y}
    r = None
    if reference is not None:
        r, _ = signals(reference, "reference", "r")
        sides["reference"] = r
        if r.shape[1] != u.shape[1]:
            raise ShapeError(
                f"joint input-output needs one reference per input, got {r.shape[1]} for "
                f"{u.shape[1]}: the inputs' response to the references must be invertible."
            )
    for name, side in sides.items():
        if (side.shape[0], side.shape[2]) != (u.shape[0], u.shape[2]):
            raise ShapeError(
                f"inputs have {u.shape[0]} experiments of {u.shape[2]} samples, {name} "
                f"{side.shape[0]} of {side.shape[2]}: they must be the same experiments."
            )
    return Records(u, y, r, in_names, out_names, rate)


def signals(value: Any, side: str, prefix: str) -> tuple[FloatArray, tuple[str, ...]]:
    """Return records (n_exp, n_channel, n_time) and the names of their channels."""
    names: tuple[str, ...] = ()
    if isinstance(value, Mapping):
        names = tuple(str(name) for name in value)
        parts = [real_array(part, f"{side}[{name!r}]") for name, part in value.items()]
        if len({part.shape for part in parts}) != 1 or not parts[0].ndim:
            raise ShapeError(
                f"all {side} must have the same shape, (samples,) or (experiments, samples). Pass "
                "{name: record}."
            )
        array = np.stack(parts, axis=-2)
    else:
        array = real_array(value, side)
    if array.ndim == 1:
        array = array[None, :]
    if array.ndim == 2:
        array = array[None]
    if array.ndim != 3 or 0 in array.shape:
        raise ShapeError(
            f"{side} must have shape (n_channel, n_time) or (n_exp, n_channel, n_time), or be a "
            f"mapping from names to (n_time,) or (n_exp, n_time), got {array.shape}."
        )
    if not names:
        cure = f"{side}.T" if np.ndim(value) == 2 else f"np.swapaxes({side}, 1, 2)"
        channels, samples = array.shape[1:]
        if channels > samples:
            raise ShapeError(
                f"{side} have {channels} channels of {samples} samples each: their axes are "
                f"swapped, time is the last one here. Pass {cure}; in a mapping, each name has its "
                "own record."
            )
    return array, signal_names(names, array.shape[1], prefix, side)


#: number of equal samples, beyond the effect of quantisation, that counts as a drop-out
LONGEST = 20
#: factor on the logarithm of the number of runs, an upper limit for the longest run of quantised
#: noise
CHANCE = 3.0


def dropouts_warned(data: Records) -> None:
    """Warn of outputs that repeat one value for longer than quantisation explains."""
    # a cable, a buffer or an interferometer failed, which disturbs all lines of an FRF. Values
    # before the first change belong to the machine at rest
    for name, record in zip(data.outputs, np.moveaxis(data.y, 1, 0), strict=True):
        for signal in record:
            at, length = _longest(signal)
            if length:
                warn(
                    f"{name} keeps the value {signal[at]:.4g} for {length} samples from "
                    f"{at / data.rate:.4g} s on ({length / data.rate:.3g} s): a drop-out? The "
                    "estimate counts it as measured. Leave out this section of the record, or "
                    "its period."
                )
                break


def _longest(signal: FloatArray) -> tuple[int, int]:
    """Return start and length of the longest run of one value, 0 where it is normal."""
    ends = np.flatnonzero(np.diff(signal) != 0) + 1
    if ends.size < 3:
        return 0, 0
    # the first run is the machine at rest
    starts, lengths = ends[:-1], np.diff(ends)
    last = signal.size - int(ends[-1])
    starts, lengths = np.append(starts, ends[-1]), np.append(lengths, last)
    usual = float(np.mean(np.delete(lengths, np.argmax(lengths))))
    i = int(np.argmax(lengths))
    ordinary = LONGEST + CHANCE * usual * np.log(lengths.size)
    return (int(starts[i]), int(lengths[i])) if lengths[i] > ordinary else (0, 0)

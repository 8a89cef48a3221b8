"""Residuals of measured frequency responses."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np
import scipy.sparse as sp

from ...arrays import (
    ComplexArray,
    FloatArray,
    divisor,
    flag,
    instance,
    one_of,
    positive,
    spread_array,
)
from ...errors import ModelError, counted, require_known, short, warn
from ...labels import DIRECTIONS, Place
from ...lti import Frf
from ...lti.frequency import ORDERS
from ..family import Family, Point
from .point_residuals import Held
from .residual import Bound, Kind, Residual, channel_places, place_rows, split_parts

#: number of standard deviations of the noise below which a line is left out
SIGNAL = 3.0
#: degrees of freedom of a variance below which chi-square is not reliable
LEAST = 1.5


@dataclass(frozen=True, eq=False, repr=False)
class FrfResidual(Residual):
    """Residuals of measured frequency responses, complex or of the logarithm of their magnitude.

    The residual is ``r = (H_exp - H(p)) / sigma`` with real and imaginary part as separate rows, or
    ``r = ln |H_exp / H(p)| / (sigma / |H_exp|)`` for magnitudes. The variance of the real part and
    that of the imaginary part are ``sigma^2 = variance / 2``. The model's response is
    ``H = C (i omega)^d (K + i omega D - omega^2 M)^-1 B``, where d is 0 for displacement, 1 for
    velocity and 2 for acceleration. A machine that is sampled with a zero-order hold has the exact
    response ``H = z^-n C (z - e^{AT})^-1 (Gamma_1 + Gamma_0/z)``. Here A is the state matrix of the
    model, T the sampling time and n the delay in whole samples. The input matrices Gamma_1 and
    Gamma_0 describe the hold and a fractional delay.

    Parameters
    ----------
    measured : Frf
        Responses of outputs to inputs [quantity / N]. `measured.quantity` is displacement, velocity
        or acceleration. None: displacement.
    variance : float or array that spreads to (n_out, n_in, n_freq), optional
        Variance ``E|noise|^2`` of each entry. None: the variance of `measured`. If
        `measured.freedom` gives the number nu of degrees of freedom with which this variance was
        estimated, the variance is multiplied by ``nu / (nu - 1)``, and the covariance of the
        parameters by ``(nu - 1) / (nu - 2)``, since the weights of the lines are uncertain (by at
        most 3: with nu of 2 or less the uncertainty depends on the number of lines). The
        correlation of neighbouring lines follows from the window of the Frf, and that of outputs
        from its `correlation`. Both count in the covariance and in chi-square. If no variance is
        known, each entry is divided by the rms of its channel pair.
    lines : sequence of int or (n_freq,) bool array, optional
        Frequency lines to use. None: the lines at which the median of ``|H|^2 / variance`` over the
        channels is above 9. Without a variance, these are all lines. The line 0 Hz is not used.
    places : mapping {channel: place}, optional
        Places of channels by name. The name of any other channel is taken as a DOF label.
    direction : str
        Direction of motion and force at points.
    magnitude : bool
        Whether to compare ln |H| instead of H. The fit is then not sensitive to phase errors, and
        it converges from start values that are farther away.
    hold : float, optional [Hz]
        Rate of the zero-order hold between the inputs and the machine, if the response was measured
        on the sampled machine. Modes above half the rate then appear in the band as aliases.
    delay : float [samples]
        Delay from the command to the held force, if the measurement contains it. It may be a
        fraction of a sample.

    Raises
    ------
    ModelError, ShapeError, LabelError
        When no line remains, the variance is not positive, or channels are unknown. When lines lie
        above half the rate of the hold, or a delay is given without a hold. When accelerations are
        given with a hold, since they jump at the sampling instants.

    Examples
    --------
    A response with known noise, and the response of a sampled machine:

    >>> frf = Frf([1.0, 2.0], [[[1.0, 0.5j]]], inputs=["1:z"], outputs=["2:z"])
    >>> FrfResidual(frf, variance=1e-4)
    <FrfResidual: 1 x 1 channel, 2 of 2 lines, complex, noise known>
    >>> FrfResidual(frf, hold=100.0, delay=1)
    <FrfResidual: 1 x 1 channel, 2 of 2 lines, complex, noise not known, held at 100 Hz, delay 1>
    """

    measured: Frf
    variance: FloatArray | None = field(default=None, kw_only=True)
    lines: Any = field(default=None, kw_only=True)
    places: Mapping[str, Place] | None = field(default=None, kw_only=True)
    direction: str = field(default="z", kw_only=True)
    magnitude: bool = field(default=False, kw_only=True)
    hold: float | None = field(default=None, kw_only=True)
    delay: float = field(default=0.0, kw_only=True)

    def __post_init__(self) -> None:
        frf = self.measured
        instance(frf, Frf, "frf", "Pass Frf(freq, data, ...).")
        one_of(frf.quantity or "displacement", "quantity", ORDERS)
        variance = self.variance
        if variance is None:
            variance = _fair(frf)
            _warn_of_freedom(frf)
        if variance is not None:
            variance = spread_array(variance, "variance", frf.data.shape)
        require_known("direction", [self.direction], DIRECTIONS)
        channel_places([*frf.outputs, *frf.inputs], self.places)
        lines = _checked_lines(self.lines, frf, variance)
        hold, delay = _checked_hold(self.hold, self.delay, frf, lines)
        self._set(variance=variance, lines=lines, hold=hold, delay=delay)
        self._set(magnitude=flag(self.magnitude, "magnitude"))

    def __repr__(self) -> str:
        frf = self.measured
        kind = "log-magnitude" if self.magnitude else "complex"
        known = "not known" if self.variance is None else "known"
        held = "" if self.hold is None else f", held at {self.hold:g} Hz"
        late = f", delay {self.delay:g}" if self.delay else ""
        return (
            f"<FrfResidual: {len(frf.outputs)} x {counted(len(frf.inputs), 'channel')}, "
            f"{self.lines.size} of {counted(frf.freq.size, 'line')}, {kind}, noise "
            f"{known}{held}{late}>"
        )

    @property
    def loaded(self) -> tuple[tuple[Place, str], ...]:
        """Places and directions of the channels."""
        channels = [*self.measured.outputs, *self.measured.inputs]
        return tuple((place, self.direction) for place in channel_places(channels, self.places))

    @property
    def top(self) -> float:
        """Highest frequency [rad/s] of the lines. With a hold, it is the rate of the hold."""
        highest = float(np.max(self.measured.freq[self.lines]))
        return 2 * np.pi * max(highest, self.hold or 0.0)

    def select(self, lines: Sequence[int]) -> FrfResidual:
        """Return the residual at some of the lines, given by their positions in `measured`."""
        if lines is None:
            raise ModelError("select needs numbers of lines, got None. Pass for example [0, 4].")
        return self.replace(lines=lines)

    def bound(self, family: Family) -> Bound:
        """Return the residual as `update` uses it, for one model with its parameters.

        The argument `family` is this model with its parameters. The result computes the values of
        the residual and their derivatives; see `Bound`.
        """
        return _BoundFrf(self, family)


class _BoundFrf(Bound):
    def __init__(self, residual: FrfResidual, family: Family) -> None:
        frf, lines = residual.measured, residual.lines
        places = channel_places([*frf.outputs, *frf.inputs], residual.places)
        count = len(frf.outputs)
        self.C = place_rows(family, places[:count], residual.direction)
        self.B = place_rows(family, places[count:], residual.direction).T
        self.omega = 2 * np.pi * frf.freq[lines]
        self.order = ORDERS[frf.quantity or "displacement"]
        self.factor = (1j * self.omega) ** self.order
        self.hold, self.delay = residual.hold, residual.delay
        self.data = np.moveaxis(frf.data[:, :, lines], 2, 0)
        self.magnitude = residual.magnitude
        self.noisy = residual.variance is not None
        if residual.variance is not None:
            sigma = np.sqrt(np.moveaxis(residual.variance[:, :, lines], 2, 0) / 2)
        else:
            rms = np.sqrt(np.mean(np.abs(self.data) ** 2, axis=0))
            sigma = np.broadcast_to(divisor(rms), self.data.shape)
            if self.magnitude:
                sigma = np.abs(self.data)
        if self.magnitude:
            sigma = sigma / np.abs(self.data)
        self.sigma = sigma
        R = frf.line_correlation() if self.noisy else None
        if R is not None:
            # lines of windowed segments share data: rows are [Re; Im] by line, output and input
            R = R[lines][:, lines]
            one = sp.kron(R, sp.eye_array(self.data[0].size))
            self.noise = sp.csc_array(one if self.magnitude else sp.block_diag([one, one]))
        self.lines = R
        nu = None if frf.freedom is None else max(frf.freedom, LEAST)
        self.root: ComplexArray | None = None
        if self.noisy and frf.correlation is not None:
            C = np.moveaxis(frf.correlation[:, :, lines], 2, 0)
            self.root, self.independent = _root(C), _independent_share(C, nu)
        fair = _fair(frf)
        if nu is not None and fair is not None and np.all(residual.variance == fair):
            # |error|^2 over an estimated variance has Fisher's distribution: its variance, over
            # that of chi-square, for rows of all inputs, which share the noise of their output
            shared = len(frf.inputs) / (2.0 if self.magnitude else 1.0)
            left = max(nu - 2.0, LEAST - 1.0)
            self.independent *= left / (nu - 1.0 + shared)
            # with weights 1/s^2 of estimated variances s^2 it is mean(1/s^4) / mean(1/s^2)^2
            self.scatter = max(nu - 1.0, LEAST) / left
        whole = 1 / sigma
        if not self.magnitude:
            whole = np.sqrt(np.mean(np.abs(self.data) ** 2, axis=0)) / sigma
        self.size = np.tile(divisor(whole).ravel(), 1 if self.magnitude else 2)
        self._freq, self._pairs = (
            frf.freq[lines],
            [f"{o} / {i}" for o in frf.outputs for i in frf.inputs],
        )
        self.name = f"{counted(lines.size, 'line')} of FRFs"
        self._last: tuple[Point, ComplexArray, Any] | None = None

    def noise_times(self, columns: FloatArray) -> FloatArray:
        """Return ``N columns``, in which errors of outputs are correlated as in the Frf."""
        if self.root is None:
            return super().noise_times(columns)
        # the error of an output is `L e` by line, with the root L of the correlation of outputs and
        # errors e that are correlated between lines only
        lines, outputs, inputs = self.data.shape
        turn = (self.data / np.abs(self.data))[..., None] if self.magnitude else np.ones(1)
        z = (
            columns
            if self.magnitude
            else columns[: self.data.size] + 1j * columns[self.data.size :]
        )
        z = turn * z.reshape(lines, outputs, inputs, -1)
        z = np.einsum("lab,lbic->laic", self.root, z)
        if self.lines is not None:
            z = (self.lines @ z.reshape(lines, -1)).reshape(z.shape)
        z = turn.conj() * np.einsum("lab,lbic->laic", self.root, z)
        z = z.reshape(self.data.size, -1)
        return np.asarray(z.real) if self.magnitude else split_parts(z)

    def kinds(self) -> list[Kind]:
        """Return no discrepancy, since model errors are correlated over lines."""
        return []

    def row_name(self, row: int) -> str:
        line, channel = divmod(row % self.data.size, len(self._pairs))
        return f"{self._pairs[channel]} at {self._freq[line]:.4g} Hz"

    def responses(self, point: Point) -> ComplexArray:
        """Return H (l, o, i)."""
        return self._solved(point)[0]

    def _solved(self, point: Point) -> tuple[ComplexArray, Any]:
        """Return H and what its slopes are made from."""
        if self._last is None or self._last[0] is not point:
            if self.hold is None:
                # Z^-1 B and Z^-T C^T at all lines; Z is symmetric
                M, D, K = point.matrices
                w, loads = self.omega[:, None, None], np.hstack([self.B, self.C.T])
                solved: Any = np.linalg.solve(K - w**2 * M + 1j * w * D, loads[None] + 0j)
                X, Y = np.split(solved, [self.B.shape[1]], axis=2)
                H = np.matmul(self.C, X) * self.factor[:, None, None]
                self._last = (point, H, (X, Y))
            else:
                held = Held(
                    point, self.B, self.C, rate=self.hold, delay=self.delay, order=self.order
                )
                H, z, X = held.responses(self.omega)
                self._last = (point, H, (held, z, X))
        return self._last[1:]

    def values(self, point: Point) -> FloatArray:
        H = self.responses(point)
        if self.magnitude:
            return np.asarray((np.log(np.abs(self.data / H)) / self.sigma).ravel())
        return split_parts(((self.data - H) / self.sigma).ravel())

    def slopes(self, point: Point) -> FloatArray:
        H, made = self._solved(point)
        q = point.p.size
        if self.hold is None:
            # -Y^T (dK + i omega dD - omega^2 dM) X
            X, Y = made
            lines, k, n_in = X.shape
            s = np.repeat(1j * self.omega, n_in)
            flat = np.moveaxis(X, 0, 1).reshape(k, lines * n_in)
            moved = point.family.moved(flat, (s**2, s, np.ones_like(s)))
            moved = moved.reshape(q, k, lines, n_in).transpose(0, 2, 1, 3)
            dH = -np.matmul(Y.transpose(0, 2, 1), moved) * self.factor[:, None, None]
        else:
            held, z, X = made
            dH = held.slopes(z, X)
        if self.magnitude:
            return np.asarray(-(np.real(dH / H) / self.sigma).reshape(q, -1).T)
        return split_parts(-(dH / self.sigma).reshape(q, -1).T)


def _fair(frf: Frf) -> FloatArray | None:
    """Return the variance with which ``|error|^2 / variance`` is 1 in the mean."""
    if frf.variance is None or frf.freedom is None:
        return frf.variance
    nu = max(frf.freedom, LEAST)
    return np.asarray(frf.variance * (nu / (nu - 1)))


def _warn_of_freedom(frf: Frf) -> None:
    if frf.variance is not None and frf.freedom is not None and frf.freedom <= LEAST:
        warn(
            f"the variance of this Frf has {frf.freedom:.3g} degrees of freedom: |error|^2 / "
            "variance hardly has a mean, and chi-square is not reliable. Average more runs or "
            "periods, or give variance= from another source."
        )


def _root(C: ComplexArray) -> ComplexArray:
    """Return the Hermitian square roots of correlations (l, o, o)."""
    values, vectors = np.linalg.eigh(C)
    return np.asarray((vectors * np.sqrt(np.maximum(values, 0.0))[:, None]) @ vectors.conj().mT)


def _independent_share(C: ComplexArray, freedom: float | None) -> float:
    """Return the share of outputs with independent errors, ``o / sum |C|^2``."""
    alike = np.mean(np.abs(C) ** 2, axis=0)
    if freedom is not None:
        # independent errors have |C|^2 = 1/nu in the mean
        alike = np.maximum((alike - 1 / freedom) / (1 - 1 / freedom), 0.0)
    return float(len(alike) / (len(alike) + np.sum(alike * (1 - np.eye(len(alike))))))


def _checked_hold(hold: Any, delay: Any, frf: Frf, lines: Any) -> tuple[float | None, float]:
    late = positive(delay, "delay", zero=True)
    if hold is None:
        if late:
            raise ModelError(
                f"delay={late:g} is in samples of a hold: give hold= its rate, or, of continuous "
                "signals, turn the phase of the measurement back."
            )
        return None, late
    rate = positive(hold, "hold")
    if frf.quantity == "acceleration":
        raise ModelError(
            "accelerations behind a zero-order hold jump at the instants they are sampled: their "
            "response depends on which side was taken. Measure positions or velocities, or divide "
            "the hold's own response out of the measurement and leave hold= out."
        )
    if frf.freq[lines].max() >= rate / 2:
        raise ModelError(
            f"lines up to {frf.freq[lines].max():g} Hz and a hold at {rate:g} Hz do not match: "
            f"the response is only known up to {rate / 2:g} Hz. Choose lines= below it."
        )
    return rate, late


def _checked_lines(lines: Any, frf: Frf, variance: FloatArray | None) -> Any:
    count = frf.freq.size
    if lines is None:
        size = np.abs(frf.data) ** 2
        keep = np.any(size > 0, axis=(0, 1)) & (frf.freq > 0)
        if variance is not None:
            keep &= np.median(size / variance, axis=(0, 1)) > SIGNAL**2
        chosen = np.flatnonzero(keep)
    else:
        try:
            chosen = np.asarray(lines)
        except (TypeError, ValueError):
            raise ModelError(
                f"lines must be numbers of lines, got {short(lines)}. Pass [0, 4], say."
            ) from None
        if chosen.dtype == bool and chosen.shape == (count,):
            chosen = np.flatnonzero(chosen)
        if chosen.ndim != 1 or (chosen.size and chosen.dtype.kind not in "iu"):
            raise ModelError(
                f"lines must be numbers of lines or {count} booleans. Pass [0, 4], say."
            )
        if chosen.size and (chosen.min() < 0 or chosen.max() >= count):
            raise ModelError(f"lines must lie between 0 and {count - 1}.")
        chosen = np.unique(chosen)
    if not chosen.size:
        raise ModelError(
            "no frequency line remains: all are below the noise, or none was chosen. Give lines=."
        )
    return chosen.astype(np.int64)

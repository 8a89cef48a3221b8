"""Modes with other frequencies on the machine, found from a record."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np

from ..arrays import BoolArray, ComplexArray, FloatArray
from ..errors import with_deviation
from ..identification import MeasuredModes
from ..lti.frequency import frequency_response
from ..parallel import one_thread
from ..plant import AnyPlant
from ..plant.uncertainty.delta import Delta, with_changes
from ..plant.uncertainty.mode_delta import DampingDelta, FrequencyDelta
from ..store import Value
from .estimate import Estimate
from .estimator import KalmanEstimator
from .innovations import InnovationLines, density_of, whitening
from .kalman import redesigned
from .steady_filter import Filter

#: largest numbers of lines of a band and of evaluations in the search for a mode's change; widths
#: of a new mode
_BAND, _SEARCH, _WIDTHS = 400, 40, (3e-4, 1e-3, 3e-3, 1e-2, 3e-2, 1e-1)
#: number of steps of the maximisation of the likelihood, and step in standard deviations at which
#: it ends
_STEPS, _SETTLED = 12, 0.05
#: fraction of the largest step within which the derivatives of the innovations are reused
_LINEAR = 0.3
#: finite difference of a frequency in half-widths of the mode, and of the logarithm of damping: far
#: above rounding and within the linear range
_CHANGE = 0.02
#: largest relative distance of the end of a fit from its peak: peaks are found within a few lines
_NEAR = 5e-3


class ModeChange(NamedTuple):
    """A mode's number, and the logarithms of the ratios of its |pole| and of its decay rate."""

    mode: int
    frequency: float
    decay: float

    def near(self, start: ModeChange) -> bool:
        """Whether a fit ended at the peak at which it began."""
        return abs(self.frequency - start.frequency) <= max(_NEAR, 0.3 * abs(start.frequency))

    @property
    def amounts(self) -> list[tuple[Delta, float]]:
        """The relative changes of stiffness and damping, for `with_changes`."""
        n = self.mode
        return [
            (FrequencyDelta.of(n, 1.0), float(np.expm1(2.0 * self.frequency))),
            (DampingDelta.of(n, 1.0), float(np.expm1(self.decay))),
        ]


@dataclass(frozen=True, eq=False, repr=False)
class MovedModes(Value):
    """Modes whose poles on the machine differ from those of the plant model.

    `consistency` estimates the poles of the machine from a record by maximum likelihood. The decay
    rate of a mode is minus the real part of its pole.

    Parameters
    ----------
    modes : sequence of m int
        Numbers of the modes in the plant, counted from 1 with rigid-body modes.
    expected : (m,) complex array [rad/s]
        Poles of the plant.
    poles : (m,) complex array [rad/s]
        Poles of the machine.
    covariance : (2 m, 2 m) array
        Covariance of the errors of 2 m values: first the m values ``log |pole|``, then the m
        logarithms of the decay rates.

    Examples
    --------
    >>> import flexplant as fx
    >>> plant = fx.testbeds.three_masses()
    >>> stiffer = fx.chain(masses=[1.0, 1.0, 1.0], stiffnesses=[4.2e5, 4.2e5])
    >>> stiffer = stiffer.with_damping(fx.ModalDamping(0.01))
    >>> machine = fx.assemble_plant(stiffer, plant.assembled.ports).discretized(2e3, delay=1)
    >>> observer = fx.design_kalman(plant)
    >>> servo = fx.design_servo(plant, bandwidth=20.0, observer=observer)
    >>> run = fx.simulate(fx.close_loop(machine, observer, servo), duration=8.0, rng=1)
    >>> fx.estimation.consistency(observer, run).moved.modes
    (2, 3)
    """

    modes: tuple[int, ...]
    expected: ComplexArray
    poles: ComplexArray
    covariance: FloatArray

    def __repr__(self) -> str:
        return "<MovedModes: " + "; ".join(self.texts) + ">"

    @property
    def frequency(self) -> dict[int, tuple[float, float]]:
        """Relative change of each mode's frequency and its standard deviation, by mode number."""
        change = np.abs(self.poles / self.expected) - 1.0
        return self._with(change, np.sqrt(np.diag(self.covariance))[: len(self.modes)])

    def _with(self, sizes: FloatArray, deviations: FloatArray) -> dict[int, tuple[float, float]]:
        both = zip(sizes.tolist(), deviations.tolist(), strict=True)
        return dict(zip(self.modes, both, strict=True))

    @property
    def damping(self) -> dict[int, tuple[float, float]]:
        """Damping ratio of each mode on the machine and its standard deviation, by mode number."""
        m = len(self.modes)
        turned = np.hstack([-np.eye(m), np.eye(m)])
        deviation = np.sqrt(np.diag(turned @ self.covariance @ turned.T))
        zeta = -self.poles.real / np.abs(self.poles)
        return self._with(zeta, zeta * deviation)

    @property
    def texts(self) -> list[str]:
        """A sentence for each mode: its frequency and damping on the machine and in the plant."""
        found = []
        for i, n in enumerate(self.modes):
            (df, sf), (z, sz) = self.frequency[n], self.damping[n]
            at, before = (abs(p[i]) / (2 * np.pi) for p in (self.poles, self.expected))
            expected = -self.expected[i].real / abs(self.expected[i])
            found.append(
                f"mode {n} is at {at:.5g} Hz, not at {before:.5g} Hz (by "
                f"{with_deviation(100 * df, 100 * sf)} %), its damping ratio is "
                f"{with_deviation(100 * z, 100 * sz)} %, not {100 * expected:.2g} %"
            )
        return found

    @property
    def changes(self) -> tuple[ModeChange, ...]:
        """Logarithms of the ratios, machine to plant, of |pole| and decay rate of each mode."""
        size = np.log(np.abs(self.poles / self.expected))
        decay = np.log(self.poles.real / self.expected.real)
        return tuple(
            ModeChange(*one) for one in zip(self.modes, size.tolist(), decay.tolist(), strict=True)
        )

    @property
    def measured(self) -> MeasuredModes:
        """Poles of the machine with mode numbers and covariance.

        ``model.calibrated(moved.measured)`` returns the model with these poles.
        """
        m = len(self.modes)
        real, imag = self.poles.real, self.poles.imag
        # |p| and decay rate: d Re = Re d(log decay), d Im = (|p|^2 d(log |p|) - Re dRe) / Im
        size = np.abs(self.poles) ** 2
        G = np.block([
            [np.zeros((m, m)), np.diag(real)],
            [np.diag(size / imag), np.diag(-(real**2) / imag)],
        ])  # fmt: skip
        return MeasuredModes(self.poles, modes=self.modes, covariance=G @ self.covariance @ G.T)


@one_thread()
def moved_modes(
    observer: KalmanEstimator, estimate: Estimate, starts: Sequence[ModeChange], skip: int
) -> tuple[MovedModes, KalmanEstimator, Estimate]:
    """Return the modes of the machine, and observer and estimate of the changed plant."""
    # maximum likelihood of the record by the innovations of the filter of the changed plant, the
    # commands counted, so that feedback does not bias it; Gauss-Newton, the noises known but for
    # one common level: `n/2 log(sum |W e|^2 / n) - n_k log det W`. The first samples are skipped
    task = _Likelihood(observer, estimate, [one.mode for one in starts], skip)
    theta = np.array([[one.frequency for one in starts], [one.decay for one in starts]]).ravel()
    information = np.eye(theta.size)
    now = task.at(theta)
    steps = np.r_[_CHANGE * task.widths, np.full(task.widths.size, _CHANGE)]
    reach = np.r_[task.widths, np.ones(task.widths.size)]
    J, log_size = None, np.zeros(theta.size)
    for _ in range(_STEPS):
        if J is None:
            near = [task.at(theta + row) for row in np.diag(steps)]
            J = np.array([one.white - now.white for one in near]) / steps[:, None]
            log_size = np.array([one.log_size - now.log_size for one in near]) / steps
        information = J @ J.T / now.level
        gradient = J @ now.white / now.level + now.samples * log_size
        step = -np.linalg.solve(information, gradient)
        part = float(np.max(np.abs(step) / reach))
        step = step / max(part, 1.0)
        trial = task.at(theta + step)
        while trial.cost > now.cost and np.any(np.abs(step) > 0.1 * steps):
            step = 0.5 * step
            trial = task.at(theta + step)
        if trial.cost > now.cost:
            break
        theta, now = theta + step, trial
        if step @ information @ step <= _SETTLED**2 * step.size:
            break
        if part > _LINEAR:
            J = None
    p = task.poles(now.observer.plant)
    covariance = np.asarray(np.linalg.inv(information), dtype=np.float64)
    found = MovedModes(tuple(task.modes), task.poles(observer.plant), p, covariance)
    return found, now.observer, now.estimate


class _Trial(NamedTuple):
    """Whitened innovations of a changed plant's filter, its log det, and their filter."""

    white: FloatArray
    log_size: float
    samples: int
    observer: KalmanEstimator
    estimate: Estimate

    @property
    def level(self) -> float:
        return float(np.mean(self.white**2))

    @property
    def cost(self) -> float:
        return float(0.5 * self.white.size * np.log(self.level) + self.samples * self.log_size)


class _Likelihood:
    """The likelihood of a record over changes of some modes."""

    def __init__(
        self, observer: KalmanEstimator, estimate: Estimate, modes: list[int], skip: int
    ) -> None:
        self.observer, self.modes = observer, modes
        names = [*observer.sensors, *observer.model.commands]
        self.record = dict(zip(names, estimate.record.T, strict=True))
        self.counted: BoolArray = np.isfinite(estimate.whitened)
        self.counted[:, :skip] = False
        poles = self.poles(observer.plant)
        self.widths: FloatArray = np.asarray(-poles.real / np.abs(poles))

    def poles(self, plant: AnyPlant) -> ComplexArray:
        """Return the poles [rad/s] of the modes."""
        blocks = plant.modal_blocks[np.array(self.modes) - 1]
        found = np.linalg.eigvals(blocks).astype(np.complex128)
        return np.asarray(found[np.arange(len(found)), np.argmax(found.imag, axis=1)])

    def at(self, theta: FloatArray) -> _Trial:
        """Return the innovations with changed modes."""
        parts = zip(self.modes, *theta.reshape(2, -1).tolist(), strict=True)
        changes = [amount for one in parts for amount in ModeChange(*one).amounts]
        observer = redesigned(
            self.observer, lambda plant: plant.around(with_changes(plant.machine, changes))
        )
        estimate = observer.estimate(self.record, Filter())
        S = observer.model.innovation(observer.predicted_covariance)
        log_size = 0.5 * float(np.linalg.slogdet(S)[1])
        white = estimate.whitened[self.counted]
        return _Trial(white, log_size, int(self.counted.all(axis=0).sum()), observer, estimate)


class PeakBand(NamedTuple):
    """Lines [Hz] around a peak at which innovations (m, p) and commands (m, nu) are compared."""

    freq: FloatArray
    X: ComplexArray
    U: ComplexArray
    level: FloatArray
    #: frequencies of the peak, and of the neighbouring mode after sampling
    at: float
    seen: float


def peak_band(
    lines: InnovationLines, U: ComplexArray, level: FloatArray, rate: float, at: float, seen: float
) -> PeakBand:
    """Return the lines around a peak and the mode near it."""
    reach = 3.0 * abs(at - seen) + 0.02 * at
    freq = lines.freq * rate
    band = np.flatnonzero(np.abs(freq - 0.5 * (at + seen)) <= reach)
    band = band[:: -(-band.size // _BAND)]
    return PeakBand(freq[band], lines.X[band], U[band], level[band], at, seen)


def explained_by_change(
    observer: KalmanEstimator, band: PeakBand, mode: int, freq: float, sign: float
) -> ModeChange | None:
    """Return the change of a mode [Hz] that explains a peak better than one more mode, or None."""
    # both are fitted to the lines around by Whittle's likelihood: the mode's change by what the
    # commands and the noises of the changed plant make of the innovations, `V (G - G') U` and the
    # density, the new mode as `h v v* g^2 / ((f - f_0)^2 + g^2)` with any direction v; each
    # parameter costs half the logarithm of the number of lines. A changed mode is missing at its
    # place in the model, and appears in its own direction. `sign` is -1 where its frequency is
    # folded
    from scipy.optimize import minimize

    plant, p = observer.plant, band.X.shape[1]
    lines = band.freq * plant.dt
    V, before = whitening(observer, lines), _commanded(observer, plant, band.freq)
    usual = density_of(observer, plant, lines, V).both
    driven = bool(np.any(band.U))

    def change(x: FloatArray) -> ModeChange:
        moved = freq + sign * (band.at - band.seen) * x[0]
        # a step may cross zero
        return ModeChange(mode, float(np.log(max(moved, 1e-3 * freq) / freq)), float(x[1]))

    def cost(x: FloatArray) -> float:
        if not -0.5 <= x[0] <= 1.5:
            return np.inf  # not this peak
        machine = plant.around(with_changes(plant.machine, change(x).amounts))
        S = density_of(observer, machine, lines, V).both - usual + np.eye(p)[None]
        left = band.X
        if driven:
            shown = V @ (before - _commanded(observer, machine, band.freq)) @ band.U[:, :, None]
            left = left + shown[:, :, 0]
        return _whittle(S * band.level[:, None, None], left)

    starts = [np.array([share, factor]) for share in (0.0, 0.5, 1.0) for factor in (-1.4, 0.0, 1.4)]
    with np.errstate(all="ignore"):
        first = min(starts, key=cost)
        best: Any = minimize(
            cost,
            first,
            method="Nelder-Mead",
            options={
                "maxfev": _SEARCH,
                "initial_simplex": first + np.array([[0.0, 0.0], [0.2, 0.2], [0.2, -0.3]]),
                "xatol": 1e-2,
                "fatol": 0.5,
            },
        )
    new = min(_new_mode(band, width * band.at) for width in _WIDTHS)
    price = 0.5 * np.log(band.freq.size)
    return change(best.x) if best.fun + 2 * price <= new + (2 * p + 1) * price else None


def _commanded(observer: KalmanEstimator, plant: AnyPlant, freq: FloatArray) -> ComplexArray:
    """Return the responses (m, ny, nu) of the sensors to the commands."""
    path = plant.system.select(observer.sensors, observer.model.commands)
    return np.asarray(frequency_response(path, freq).data.transpose(2, 0, 1))


def _new_mode(band: PeakBand, width: float) -> float:
    """Return the cost of a mode of some width in any one direction."""
    shape = width**2 / ((band.freq - band.at) ** 2 + width**2)
    unit = band.X / np.sqrt(band.level)[:, None]
    v = np.linalg.eigh(np.einsum("k,ki,kj->ij", shape, unit, unit.conj()))[1][:, -1]
    seen = np.abs(unit @ v.conj()) ** 2
    rest = np.sum(np.abs(unit) ** 2) - np.sum(seen)
    rest += band.X.shape[1] * np.sum(np.log(band.level))
    heights = np.geomspace(0.1, 1e6, 60)[:, None]
    m = 1.0 + heights * shape
    return float(np.min(np.sum(np.log(m) + seen / m, axis=1)) + rest)


def _whittle(S: ComplexArray, X: ComplexArray) -> float:
    """Return ``sum log det S + X* S^-1 X``, infinite where S is not a density."""
    try:
        root = np.linalg.cholesky(S)
    except np.linalg.LinAlgError:
        return np.inf
    white = np.linalg.solve(root, X[:, :, None])
    size = np.log(np.diagonal(root, axis1=1, axis2=2).real)
    return float(2.0 * np.sum(size) + np.sum(np.abs(white) ** 2))

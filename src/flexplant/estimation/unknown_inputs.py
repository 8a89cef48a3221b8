"""Joint estimation of the state and of inputs that nothing, or little, is known of."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from functools import partial
from typing import NamedTuple

import numpy as np
import scipy.linalg as la

from ..arrays import FloatArray, positive
from ..certificates import Certificate, Verified, stability_check
from ..errors import AssumptionError, CertificateError, ModelError, SolverError, counted
from ..lti.lyapunov import solve_stein
from ..lti.riccati import filter_dare
from ..lti.statespace import StateSpace, System
from ..parallel import one_thread
from ..plant import AnyPlant
from ..store import Value, checked
from ..tolerances import TINY, TYPED, divisor
from ..words import instance, sizes_of
from .error import error_variances
from .estimator_channels import checked_plant, poi_channels, read_alike, row_of
from .filter_models import (
    AGREEMENT,
    FilterModel,
    check_noises,
    difference_check,
    filter_model,
    filter_system,
    noise_root,
    weigh,
)
from .invertible_inputs import (
    InputEntry,
    InvertibilityReport,
    input_entry,
    ranks_and_zeros,
    unknown_names,
)
from .kalman import filter_design
from .left_out_modes import beyond_text, left_out
from .noise_from_records import with_densities

#: Newton steps, and the relative change of a variance at which they end
_STEPS, _SETTLED = 30, 1e-12


@dataclass(frozen=True)
class Unbiased(Value):
    """Nothing is assumed of the inputs: minimum-variance unbiased filters of Gillijns, De Moor.

    Examples
    --------
    >>> import flexplant as fx
    >>> fx.estimation.Unbiased()
    Unbiased()
    """


@dataclass(frozen=True)
class Augmented(Value):
    """Inputs are states of the filter: random walks, or first-order noise with a corner.

    ``d' = -2 pi corner d + drift xi``: sampled with ``a = exp(-2 pi corner / rate)``, its variance
    per sample is ``drift^2 (1 - a^2) / (4 pi corner)``, ``drift^2 / rate`` for a random walk.

    Parameters
    ----------
    drift : float [N/sqrt(s)]
        Deviation of a random walk after one second.
    corner : float [Hz]
        Zero: a random walk.

    Examples
    --------
    >>> import flexplant as fx
    >>> fx.estimation.Augmented(drift=1.0).step(1e3)
    (1.0, 1000.0)
    """

    drift: float = field(metadata=checked(positive))
    corner: float = field(default=0.0, metadata=checked(positive, zero=True))

    def step(self, dt: float) -> tuple[float, float]:
        """Return the pole and the variance per sample."""
        rate = 2 * np.pi * self.corner
        spread = dt if not rate else -np.expm1(-2 * rate * dt) / (2 * rate)
        return float(np.exp(-rate * dt)), float(self.drift**2 * spread)


@one_thread()
def design_input_estimator(
    plant: AnyPlant | System, inputs: Sequence[str], method: Unbiased | Augmented = Unbiased()
) -> InputEstimator:
    """Return a filter of the POIs that also estimates disturbances held over each sample.

    With ``x+ = A x + B2 u + G d + w``, ``y = C2 x + D22 u + H d + v``:

    `Unbiased()` assumes nothing of d. Where H has full column rank, ::

        S = C2 P C2' + R,  M = (H' S^-1 H)^-1 H' S^-1,  d_hat[k] = M (y - C2 x[k|k-1] - D22 u)
        x[k|k] = x[k|k-1] + P C2' S^-1 (I - H M)(y - C2 x[k|k-1] - D22 u)

    where H = 0 and F = C2 G has, the same with F, one sample later::

        M = (F' S^-1 F)^-1 F' S^-1,  d_hat[k-1] = M (y - C2 x[k|k-1] - D22 u)
        x[k|k] = x[k|k-1] + (P C2' S^-1 + (G - P C2' S^-1 F) M)(y - C2 x[k|k-1] - D22 u)

    The stationary P is found by Newton steps: the Stein equation of the gains gives P, P the next
    gains; each is unbiased. They start at the Kalman filter of white inputs with a large variance.

    `Augmented(drift)` makes d a state; the Kalman filter of the larger model exists without any
    condition on ranks, as long as no invariant zero lies at the pole of d.

    Parameters
    ----------
    plant : StandardPlant
        Sampled. The asd of the unknown inputs counts as zero.
    inputs : sequence of str
        Disturbances in w.
    method : Unbiased or Augmented
        What is assumed of them.

    Returns
    -------
    InputEstimator

    Raises
    ------
    AssumptionError
        When the plant is continuous, a sensor has no noise, the inputs are not determined by the
        sensors (the ranks and zeros are named), or a POI sees an input that is known late.
    ModelError
        When the plant is weighted, its noise is not known, or the method is none.
    SolverError
        When no stable filter exists for another reason.
    CertificateError
        When the filter is biased, not stable, or its variances fail the check.

    References
    ----------
    [GillijnsDeMoor2007a]_; [GillijnsDeMoor2007b]_ (direct feedthrough); [Kitanidis1987]_.

    Examples
    --------
    >>> import flexplant as fx
    >>> plant = fx.testbeds.three_masses()
    >>> method = fx.estimation.Augmented(drift=1.0)
    >>> found = fx.estimation.design_input_estimator(plant, ["amp"], method)
    >>> found.inputs, found.system.outputs
    (('amp',), ('die:hat', 'amp:hat'))
    """
    instance(
        method,
        Unbiased | Augmented,
        "method",
        "Pass estimation.Unbiased() or estimation.Augmented(drift).",
    )
    plant = checked_plant(plant)
    names = unknown_names(plant, inputs)
    quiet = _without_noise(plant, names)
    check_noises(quiet)
    model, d = filter_model(quiet), input_entry(plant, names)
    found = ranks_and_zeros(model, d, names)
    find = _unbiased if isinstance(method, Unbiased) else partial(_augmented, method)
    nz, k, ny, nu = len(model.C1), len(names), len(model.C2), model.B.shape[1]
    # below the POIs the inputs themselves, which the states do not show
    wider = model.replace(
        C1=np.vstack([model.C1, np.zeros((k, len(model.A)))]),
        D1=np.vstack([model.D1, np.zeros((k, nu))]),
        V=np.zeros((nz + k, nz + k)),
        N=np.zeros((nz + k, ny)),
    )
    design = find(wider, d._replace(at_pois=np.vstack([d.at_pois, np.eye(k)])), found)
    _check_certificate(design.certificate)
    system = filter_system(plant, design.model, design.K, design.L, "input_estimator", names)
    variances, missing = design.variances[:nz], None
    whole = plant.machine.evaluation_plant
    if whole is not None:
        still, missed = _without_noise(whole, names), left_out(plant, whole)
        missing = 0 if missed is None else missed.modes.size
        if missing:
            hats = system.select(outputs=system.outputs[:nz])
            variances = error_variances(read_alike(plant, still), hats).values
    return InputEstimator(
        system,
        plant,
        names,
        int(design.late),
        variances,
        design.variances[nz:],
        found,
        design.certificate,
        missing,
    )


def _unbiased(model: FilterModel, d: InputEntry, found: InvertibilityReport) -> _InputDesign:
    if not found.holds:
        raise AssumptionError(
            f"the unknown inputs are not determined by the sensors: {found.text}. Add a sensor, or "
            "use estimation.Augmented(drift=...), which assumes how fast they change."
        )
    late = found.delay == 1
    if late and (np.any(model.S) or np.any(d.at_pois[: -len(found.inputs)])):
        raise AssumptionError(
            "inputs that the sensors show one sample late cannot be combined with noise that "
            "reaches a sensor, or inputs that reach a POI, at once. Use "
            "estimation.Augmented(drift=...)."
        )
    gains = _late_gains if late else _direct_gains
    P = _initial_covariance(model, d, late)
    try:
        for _ in range(_STEPS):
            found_gains = gains(model, d, P)
            last, P = P, found_gains.covariance(model)
            if np.max(np.abs(last - P).diagonal() / divisor(P.diagonal())) < _SETTLED:
                break
    except SolverError as error:
        raise AssumptionError(
            f"no unbiased filter is stable to working precision: {error} A zero from "
            f"{', '.join(found.inputs)} to the sensors lies too close to the unit circle. Add a "
            "sensor, or use estimation.Augmented(drift=...)."
        ) from error
    return _input_design(model, found_gains, last, P)


def _initial_covariance(m: FilterModel, d: InputEntry, late: bool) -> FloatArray:
    """Return a covariance to start at: that with white inputs of a large variance."""
    F, spread = (m.C2 @ d.G, m.C2 @ m.Q @ m.C2.T + m.R) if late else (d.H, m.R)
    left = _weighted_inverse(F, spread)
    size = (1.0 / TYPED) * np.sum((left @ spread) * left, axis=1)
    G, H = d.G * size, d.H * size
    return filter_dare(m.A, m.C2, Q=m.Q + G @ d.G.T, R=m.R + H @ d.H.T, S=m.S + G @ d.H.T).P


class _InputGains(NamedTuple):
    """``x+ = A x + B u + K e``, ``[hat; d_hat] = C1 x + D1 u + L e``, e = y - C2 x - D2 u.

    `closed` is the dynamics of the error and `driven` its noise (of x[k|k] when `late`, of
    x[k|k-1] otherwise), bias how much of d enters.
    """

    K: FloatArray
    L: FloatArray
    closed: FloatArray
    driven: FloatArray
    late: bool
    bias: float

    def covariance(self, m: FilterModel) -> FloatArray:
        """Return the covariance of x[k|k-1] without the unknown input, by the Stein equation."""
        X = solve_stein(self.closed, self.driven)
        return m.A @ X @ m.A.T + m.Q if self.late else X


def _direct_gains(m: FilterModel, d: InputEntry, P: FloatArray) -> _InputGains:
    """Return the gains with feedthrough; P is the covariance of x[k|k-1]."""
    spread = m.innovation(P)
    M = _weighted_inverse(d.H, spread)
    rest = np.eye(len(spread)) - d.H @ M
    L_x = weigh(P @ m.C2.T, spread) @ rest
    # noise that reaches state and sensors together: what the innovation shows of it beside d
    K = m.A @ L_x + d.G @ M + weigh(m.S, spread) @ rest
    L = m.C1 @ L_x + d.at_pois @ M
    return _InputGains(K, L, m.A - K @ m.C2, m.driven(K), False, _bias(M, d.H, K, d.G))


def _late_gains(m: FilterModel, d: InputEntry, P: FloatArray) -> _InputGains:
    """Return the gains without feedthrough; P is that of x[k|k-1], the input left out."""
    spread, F = m.innovation(P), m.C2 @ d.G
    M = _weighted_inverse(F, spread)
    plain = weigh(P @ m.C2.T, spread)
    L_x = plain + (d.G - plain @ F) @ M
    still = np.eye(len(P)) - L_x @ m.C2
    L = m.C1 @ L_x + d.at_pois @ M
    driven = still @ m.Q @ still.T + L_x @ m.R @ L_x.T
    return _InputGains(m.A @ L_x, L, still @ m.A, driven, True, _bias(M, F, L_x, d.G))


def _augmented(
    method: Augmented, m: FilterModel, d: InputEntry, found: InvertibilityReport
) -> _InputDesign:
    """Return the Kalman filter of the plant with the inputs as states."""
    n, k = d.G.shape
    pole, variance = method.step(m.dt)
    (G, H), drift = noise_root(m), np.sqrt(variance) * np.eye(k)
    larger = m.replace(
        A=np.block([[m.A, d.G], [np.zeros((k, n)), pole * np.eye(k)]]),
        B=np.vstack([m.B, np.zeros((k, m.B.shape[1]))]),
        C1=np.hstack([m.C1, d.at_pois]),
        C2=np.hstack([m.C2, d.H]),
        Q=la.block_diag(m.Q, variance * np.eye(k)),
        S=np.vstack([m.S, 0 * d.H.T]),
        root=np.vstack([la.block_diag(G, drift), np.hstack([H, np.zeros((len(H), k))])]),
    )
    try:
        design = filter_design(larger)
    except SolverError as error:
        raise AssumptionError(
            f"no filter holds {', '.join(found.inputs)} as states: {error} The condition without "
            f"assumptions: {found.text}. Add a sensor, or give Augmented a corner above 0."
        ) from error
    certificate = _certificate(design.radius, 0.0, design.difference)
    return _InputDesign(larger, design.K, design.L_z, design.variances, certificate)


class _InputDesign(NamedTuple):
    model: FilterModel
    K: FloatArray
    L: FloatArray
    variances: FloatArray
    certificate: Certificate
    late: bool = False


def _input_design(m: FilterModel, g: _InputGains, claim: FloatArray, P: FloatArray) -> _InputDesign:
    """Return the design with the variances of its errors, and what was checked about it."""
    left, noise = m.C1 - g.L @ m.C2, np.sum((g.L @ m.R) * g.L, axis=1)
    both = [np.sum((left @ X) * left, axis=1) + noise for X in (claim, P)]
    difference = float(np.max(np.abs(both[0] - both[1]) / divisor(both[1])))
    radius = float(np.max(np.abs(np.linalg.eigvals(g.closed)), initial=0.0))
    certificate = _certificate(radius, g.bias, difference)
    return _InputDesign(m, g.K, g.L, both[1], certificate, g.late)


def _certificate(radius: float, bias: float, difference: float) -> Certificate:
    """Return what was checked: stability, what of an input enters the errors, the variances."""
    stable, differing = stability_check(radius, sampled=True), difference_check(difference)
    return Certificate(
        (stable, Verified("bias", bias, "M F - I and G - L F", AGREEMENT), differing)
    )


def _check_certificate(found: Certificate) -> None:
    if not found.holds:
        raise CertificateError(
            f"the estimator of unknown inputs fails its check: spectral radius "
            f"{found['spectral radius']:.9f}, bias {found['bias']:.1e}, variances differ by "
            f"{found['difference']:.1e} (allowed {AGREEMENT:.0e}). The sensors hardly determine "
            "the inputs. Add a sensor, or use estimation.Augmented(drift=...)."
        )


def _without_noise(plant: AnyPlant, names: Sequence[str]) -> AnyPlant:
    """Return the plant without the white noise of some disturbances."""
    loud = [name for name in names if plant.asd.get(name, 0.0) > 0]
    if not loud:
        return plant
    if plant.machine.continuous.dt:  # the noise of a sample is known as a whole only
        raise ModelError(
            f"unknown inputs {', '.join(loud)} have a noise density, which is part of the given "
            "noise_factor. Give the plant a factor without them, and no asd of theirs."
        )
    return with_densities(plant, dict.fromkeys(loud, 0.0))


def _weighted_inverse(F: FloatArray, spread: FloatArray) -> FloatArray:
    """Return ``(F' S^-1 F)^-1 F' S^-1``, sensors and inputs of unit size inside."""
    size = np.sqrt(spread.diagonal())
    scaled = F / size[:, None]
    columns = np.linalg.norm(scaled, axis=0)
    root = np.linalg.cholesky(spread / size / size[:, None])
    whitened = la.solve_triangular(root, scaled / columns, lower=True)
    inverse = np.linalg.pinv(whitened) @ la.solve_triangular(root, np.diag(1 / size), lower=True)
    return np.asarray(inverse / columns[:, None])


def _bias(M: FloatArray, F: FloatArray, L: FloatArray, G: FloatArray) -> float:
    """Return the largest entry of ``M F - I``, and of ``L F - G`` beside the columns of G."""
    off = M @ F - np.eye(len(M)), (L @ F - G) / np.maximum(np.abs(G).max(axis=0), TINY)
    return max(float(np.max(np.abs(part), initial=0.0)) for part in off)


@dataclass(frozen=True, eq=False, repr=False)
class InputEstimator(Value):
    """A stationary filter of the motions at the POIs and of unknown inputs d.

    Parameters
    ----------
    system : StateSpace
        From the sensors and the applied u to `die:hat`, ... and `amp1:hat`, ...
    plant : StandardPlant
        What it was designed on.
    inputs : tuple of str
        Names of d.
    delay : int [samples]
        The output `amp1:hat` at sample k is the estimate of the input at k - delay.
    variances : (nz,) array [m^2 or rad^2]
        Of the errors at the POIs.
    input_variances : (m,) array [N^2 or (N m)^2]
        Of the errors of the inputs.
    invertibility : InvertibilityReport
        Whether the sensors determine the inputs without any assumption of them.
    certificate : Certificate
    left_out : int, optional
        Number of modes of the evaluation model that the plant lacks: they are in `variances`.
    """

    system: StateSpace
    plant: AnyPlant
    inputs: tuple[str, ...]
    delay: int
    variances: FloatArray
    input_variances: FloatArray
    invertibility: InvertibilityReport
    certificate: Certificate
    left_out: int | None = None

    def __repr__(self) -> str:
        names = [*poi_channels(self.plant), *self.inputs]
        rms = sizes_of({name: self.rms(name) for name in names}, self.plant.units)
        late = "in their own sample" if not self.delay else f"{self.delay} sample late"
        return (
            f"<InputEstimator: {counted(self.system.n_states, 'state')}, inputs {late}, spectral "
            "radius "
            f"{self.certificate['spectral radius']:.6f}\n  rms error {rms} "
            f"({beyond_text(self.plant, self.left_out)})>"
        )

    def rms(self, channel: str) -> float:
        """Return the rms of the error of a POI's motion or an unknown input: `die`, `amp1:hat`."""
        row = row_of([*poi_channels(self.plant), *self.inputs], channel)
        both = np.concatenate([self.variances, self.input_variances])
        return float(np.sqrt(max(both[row], 0.0)))

"""Filters for what the noise model does not hold: the largest gain, or several machines."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np
import scipy.linalg as la

from ..certificates import Certificate
from ..checks import FloatArray, between, members, whole
from ..errors import AssumptionError, CertificateError, ModelError, SolverError, counted
from ..lti.equations import powers, scale_of, stein_sum, sylvester
from ..lti.lyapunov import solve_stein
from ..lti.norms import hinf_norm
from ..lti.riccati import filter_dare
from ..lti.statespace import StateSpace, System
from ..parallel import Progress, one_thread, tick
from ..plant import AnyPlant, StandardPlant, UncertainPlant, standard_plant
from ..tolerances import TINY
from .error import PoiFilter, error_variances, moving_parts
from .estimator_channels import same_pois
from .filter_model import (
    FilterModel,
    error_system,
    filter_model,
    filter_system,
    own_variances,
    weigh,
)
from .kalman import design_kalman


@dataclass(frozen=True, eq=False, repr=False)
class HinfFilterCertificate(Certificate):
    """What was checked about an H-infinity filter after it was computed.

    Parameters
    ----------
    gamma : float
        Largest gain of the error at any frequency, by the norm of the error's own system. Noises
        have unit density, each POI motion is in units of the Kalman filter's deviation: the
        one-sided density of its error stays below ``gamma (2 dt)^(1/2)`` times that deviation.
    lower : float
        A level at which the Riccati equation has no solution of the right inertia: no filter
        reaches it.
    kalman : float
        The same gain of the Kalman filter.

    Examples
    --------
    >>> import flexplant as fx
    >>> found = fx.estimation.design_hinf_filter(fx.testbeds.three_masses()).certificate
    >>> found.gamma <= 1.01 * found.kalman  # the Kalman filter's gain is no smaller
    True
    """

    gamma: float
    lower: float
    kalman: float


@dataclass(frozen=True, eq=False, repr=False)
class MinimaxCertificate(Certificate):
    """What was checked about a filter for several machines.

    Parameters
    ----------
    worst : float
        Largest mean over the POI motions of ``variance / sizes^2`` among the machines, by
        `error_variances`, which has nothing in common with the search.
    kalman : float
        The same of the Kalman filter of the nominal plant.
    lower : float
        No filter is better: the largest one among the machines, each with the Kalman filter of
        its own.
    difference : float
        Largest relative difference between the search's own values and `error_variances`.
    slope : float
        Norm of the gradient of the smoothed worst value at the end, relative to its value, in
        gains of unit size: 0 at a stationary point.

    Examples
    --------
    >>> import flexplant as fx
    >>> plant = fx.testbeds.three_masses()
    >>> found = fx.estimation.design_minimax_filter(plant, [plant], iterations=20).certificate
    >>> found.worst <= 1.001 * found.kalman
    True
    """

    worst: float
    kalman: float
    lower: float
    difference: float
    slope: float


@dataclass(frozen=True, eq=False, repr=False)
class RobustFilter(PoiFilter):
    """A stationary filter of the motions at the POIs with two gains.

    ::

        e[k]   = y[k] - C2 x[k] - D22 u[k]
        hat[k] = C1 x[k] + D12 u[k] + L_z e[k]
        x[k+1] = A x[k] + B2 u[k] + K e[k]

    Parameters
    ----------
    system : StateSpace
        From the sensors and the applied u to the estimates `die:hat`, ...
    plant : StandardPlant
        Whose matrices it holds.
    gain : (n, ny) array
        K.
    poi_gain : (nz, ny) array
        L_z.
    sizes : (nz,) array [m or rad]
        Deviation of each POI motion's error with the Kalman filter of the plant: the unit in which
        motions of different kinds are compared.
    variances : (nz,) array [m^2 or rad^2]
        Of its errors on its own plant.
    certificate : HinfFilterCertificate or MinimaxCertificate
    """

    system: StateSpace
    plant: AnyPlant
    gain: FloatArray
    poi_gain: FloatArray
    sizes: FloatArray
    variances: FloatArray
    certificate: HinfFilterCertificate | MinimaxCertificate

    def __repr__(self) -> str:
        return (
            f"<RobustFilter: {counted(self.system.n_states, 'state')}, "
            f"{counted(len(self.sensors), 'sensor')};\n"
            f"  rms error on its own plant {self.rms_text};\n  {self.certificate!r}>"
        )


#: the gain of the error's own system may exceed the level of the Riccati equation by this part
_AGREEMENT = 1e-6


@one_thread()
def design_hinf_filter(plant: AnyPlant | System, *, accuracy: float = 1e-3) -> RobustFilter:
    """Return the filter with the smallest largest gain from the noises to the POI errors.

    The Kalman filter is best for noise that is white with the stated densities; what it pays for
    that is a high peak at a few frequencies, where noise of another spectrum does harm. This
    filter bounds the error of any noise of finite energy::

        sum |z - hat|^2 < gamma^2 (sum |xi|^2 + sum v' R^-1 v)

    with x+ = A x + G xi, y = C2 x + v, and z in units of the Kalman filter's deviations. With the
    stabilising solution of the filter's Riccati equation with an indefinite weight::

        P = A P A' + G G' - A P [C2' C1'] ([C2; C1] P [C2' C1'] + diag(R, -gamma^2 I))^-1 (...)'

    one exists when ``C1 (P - P C2' (C2 P C2' + R)^-1 C2 P) C1' < gamma^2 I``, P >= 0; it is then
    the Kalman filter with this P. The level is found by bisection.

    Parameters
    ----------
    plant : StandardPlant
        Sampled, not weighted, its noises as for `design_kalman`.
    accuracy : float
        The level is at most this part above one that cannot be reached; 1e-6 to 1.

    Returns
    -------
    RobustFilter
        Its certificate holds the gain of the error's system, computed apart.

    Raises
    ------
    AssumptionError, ModelError, LabelError
        As `design_kalman`, whose assumptions are the same.
    SolverError
        When no Kalman filter exists.
    CertificateError
        When the gain of the error's system exceeds the level.

    References
    ----------
    [Hassibi1999]_, ch. 4.

    Examples
    --------
    >>> import flexplant as fx
    >>> found = fx.estimation.design_hinf_filter(fx.testbeds.three_masses())
    >>> found.certificate.gamma >= found.certificate.lower
    True
    """
    why = "Closer to the optimum the Riccati equation has no digits left. Pass 1e-3, say."
    accuracy = between(accuracy, "accuracy", 1e-6, 1.0, why, ends="[]")
    kalman = design_kalman(standard_plant(plant).replace(evaluation=None))
    plant = kalman.plant
    sizes = np.sqrt(kalman.variances)
    model = kalman.model
    scaled = model.replace(C1=model.C1 / sizes[:, None])
    own = kalman.predictor_gain, scaled.C1 @ kalman.gain
    peak = hinf_norm(error_system(scaled, *own))
    # the mean over frequencies of the density of a motion is at least 1, so is the largest gain
    lower, upper, best = 1.0, peak * (1 + accuracy), None
    while best is None or upper > lower * (1 + accuracy):
        level = upper if best is None else float(np.sqrt(lower * upper))
        found = _central_gains(scaled, level)
        if found is not None:
            upper, best = level, found
        elif best is None:
            raise SolverError(
                f"the H-infinity filter was not found at the gain {level:.6g} of the Kalman "
                "filter, where one exists: the Riccati equation is too badly conditioned. Take "
                "modes that hardly matter out of the plant."
            )
        else:
            lower = level
    K, L_z = best
    gain = hinf_norm(error_system(scaled, K, L_z))
    if not gain <= upper * (1 + _AGREEMENT):
        raise CertificateError(
            f"the error of the H-infinity filter has the gain {gain:.9g}, more than the level "
            f"{upper:.9g} of its Riccati equation. The filter cannot be trusted; a larger "
            "accuracy keeps away from the optimum."
        )
    L_z = L_z * sizes[:, None]
    system = filter_system(plant, model, K, L_z, "hinf_filter")
    certificate = HinfFilterCertificate(gain, lower, peak)
    return RobustFilter(system, plant, K, L_z, sizes, own_variances(model, K, L_z), certificate)


def _central_gains(m: FilterModel, gamma: float) -> GainPair | None:
    """Return the gains of the central filter of a level, None when there is none."""
    rows, nz = np.vstack([m.C2, m.C1]), len(m.C1)
    weight = la.block_diag(m.R, -(gamma**2) * np.eye(nz))
    cross = np.hstack([m.S, np.zeros((len(m.A), nz))])
    try:
        P = filter_dare(m.A, rows, Q=m.Q, R=weight, S=cross).P
    except SolverError:
        return None
    unit = np.sqrt(np.maximum(np.abs(P.diagonal()), TINY))
    # rounding leaves 1e-12 of a unit diagonal; a solution of the wrong sign some 1
    if np.min(np.linalg.eigvalsh(P / unit / unit[:, None])) < -1e-9:
        return None
    innovation = m.innovation(P)
    gain, shift = (weigh(part, innovation) for part in (P @ m.C2.T, m.S))
    left = m.C1 @ (P - gain @ m.C2 @ P) @ m.C1.T
    if np.max(np.linalg.eigvalsh(0.5 * (left + left.T))) >= gamma**2:
        return None
    return GainPair(m.A @ gain + shift, m.C1 @ gain)


#: width of the smooth maximum relative to the largest value, from coarse to fine
_WIDTHS = (0.1, 0.01, 0.001)
#: the search's values and those of the errors in closed form agree to this
_ALIKE = 1e-6
#: step of a state's variance per innovation's, where the POIs do not say how large it may be
_PART = 0.03
#: what a bar calls the variances that are computed
STEPS = "steps of the search"


@one_thread()
def design_minimax_filter(
    plant: AnyPlant | System,
    machines: Sequence[StandardPlant],
    *,
    iterations: int = 200,
    progress: bool | None = None,
) -> RobustFilter:
    """Return the filter on one plant's matrices whose worst error over machines is smallest.

    A Kalman filter is best on its own plant; on a machine whose modes lie half a percent beside
    them its error may be twice as large. The filter keeps the matrices A, B2, C1, C2 of the plant
    and chooses both gains::

        minimise over K, L_z   max_i  mean_j  E(z_j - hat_j)^2 on machine i / sizes_j^2

    The variances follow from a Stein equation of machine and filter, ``X = F X F' + N N'``, their
    gradients from its dual, ``dJ/dF = 2 Y F X``, and a smooth maximum
    ``t log sum exp(J_i / t)`` is minimised by BFGS for three widths t, the last a thousandth of
    the worst value. The problem is not convex: the search starts at the Kalman filter and is never
    worse.

    Parameters
    ----------
    plant : StandardPlant
        Sampled, not weighted: the nominal plant.
    machines : sequence of StandardPlant
        Sampled alike, with the same ports: `plant.uncertain(fit).sample(rng, 20)`.
    iterations : int
        At most so many for each width.
    progress : bool, optional
        A bar: None shows one on a terminal or in a notebook, for work of more than two seconds.

    Returns
    -------
    RobustFilter
        Its certificate holds the worst value over the machines by `error_variances`, beside that
        of the Kalman filter and that of the worst machine's own Kalman filter, which no filter
        betters.

    Raises
    ------
    AssumptionError
        As `design_kalman`; or when the error of the nominal Kalman filter on a machine has no
        variance: a rigid-body motion enters it.
    ModelError, LabelError
        When there is no machine, or one has another sampling time or other channels.
    SolverError
        When no Kalman filter exists.
    CertificateError
        When the search's variances are not those of `error_variances`.

    References
    ----------
    [Geromel1999]_ (the finite set of machines); [LevineAthans1970]_ (the dual Stein equation
    for the gradient).

    Examples
    --------
    >>> import flexplant as fx
    >>> plant = fx.testbeds.three_masses()
    >>> found = fx.estimation.design_minimax_filter(plant, [plant], iterations=20)
    >>> bool(abs(found.rms("die") / fx.design_kalman(plant).rms("die") - 1) < 1e-3)
    True
    """
    steps = whole(iterations, "iterations")
    kalman = design_kalman(standard_plant(plant).replace(evaluation=None))
    plant, model = kalman.plant, kalman.model
    sizes = np.sqrt(kalman.variances)
    if isinstance(machines, UncertainPlant):
        raise ModelError(
            "machines are sampled plants, got an UncertainPlant: draw them from it, "
            "uncertain.sample(rng, 20), so that it is known which ones the worst case is of."
        )
    hint = "Pass plant.uncertain(fit).sample(rng, 20)."
    listed = members(machines, StandardPlant, "machines", hint)
    others = [same_pois(plant, other) for other in listed]
    start = GainPair(kalman.predictor_gain, model.C1 @ kalman.gain)
    P = kalman.predicted_covariance
    scale, unit = scale_of(P.diagonal()), np.sqrt(sizes.size) * sizes[:, None]

    def part(gains: GainPair) -> FilterPart:
        return filter_part(model, gains, scale, unit)

    errors = [machine_error(plant, model, other, start, scale, unit) for other in others]
    spread = kalman.covariance.diagonal() / scale**2
    units = _Units.of(part(start).sight, model.innovation(P), spread, (scale, unit))
    with Progress(None, STEPS, progress=progress):
        found, slope = _best_gains(errors, part, units, start, steps)
    values = np.array([error.value_and_slopes(part(found))[0] for error in errors])
    system = filter_system(plant, model, found.K, found.L_z, "minimax_filter")
    truth = _means(others, system, sizes)
    difference = float(np.max(np.abs(values - truth) / truth))
    if not difference <= _ALIKE:
        raise CertificateError(
            f"the variances of the search and those of the filter in closed form differ by "
            f"{difference:.1e} (allowed {_ALIKE:.0e}). The filter cannot be trusted."
        )
    best = [design_kalman(other.replace(evaluation=None)).variances for other in others]
    certificate = MinimaxCertificate(
        float(truth.max()),
        float(_means(others, kalman.system, sizes).max()),
        float(np.mean(np.array(best) / sizes**2, axis=1).max()),
        difference,
        slope,
    )
    own = own_variances(model, *found)
    return RobustFilter(system, plant, found.K, found.L_z, sizes, own, certificate)


def _means(machines: Sequence[AnyPlant], system: StateSpace, sizes: FloatArray) -> FloatArray:
    """Return the mean relative variance of a filter on each machine."""
    found = [error_variances(machine, system).values for machine in machines]
    return np.asarray(np.mean(np.array(found) / sizes**2, axis=1))


class _Units(NamedTuple):
    """Changes of K and L_z are ``left x right``: at the Kalman filter J has the Hessian 2 I.

    There ``J(K) = J + tr(Y dK S dK')``, S the covariance of the innovation and Y the Gramian of
    the error from states to POIs; in other units the search takes a thousand steps.
    """

    states: FloatArray
    right: FloatArray

    scale: FloatArray
    unit: FloatArray

    @classmethod
    def of(
        cls, Y: FloatArray, innovation: FloatArray, spread: FloatArray, into: tuple[FloatArray, ...]
    ) -> _Units:
        """Return the units from Y and variances of states; `into` scales states and POIs."""
        # what the POIs hardly see moves by a part of its deviation for an innovation of one
        values, vectors = np.linalg.eigh(Y + np.diag(1.0 / (_PART * np.maximum(spread, 1e-12))))
        states = vectors / np.sqrt(values)
        size = np.sqrt(innovation.diagonal())
        values, vectors = np.linalg.eigh(innovation / size / size[:, None])
        return cls(states, (vectors / np.sqrt(values)).T / size, *into)

    def change(self, x: FloatArray) -> GainPair:
        """Return the change of the gains for a vector (n ny + nz ny,)."""
        n, ny = len(self.states), len(self.right)
        K, L = x[: n * ny].reshape(n, ny), x[n * ny :].reshape(-1, ny)
        return GainPair(
            self.scale[:, None] * (self.states @ K @ self.right), self.unit * (L @ self.right)
        )

    def slope(self, rate: GainPair) -> FloatArray:
        """Return the derivatives to that vector from those to gains in scaled states."""
        both = self.states.T @ rate.K @ self.right.T, rate.L_z @ self.right.T
        return np.concatenate([one.reshape(-1) for one in both])


def _best_gains(
    errors: Sequence[MachineError],
    part: Callable[[GainPair], FilterPart],
    units: _Units,
    start: GainPair,
    steps: int,
) -> tuple[GainPair, float]:
    """Return the best gains that were found, and the relative slope there."""
    from scipy.optimize import minimize

    best: list[tuple[float, GainPair]] = []

    def smooth(x: FloatArray, width: float, scale: float) -> tuple[float, FloatArray]:
        """Return the smooth maximum relative to a scale, and its slope."""
        tick(STEPS)
        change = units.change(x)
        at = GainPair(start.K + change.K, start.L_z + change.L_z)
        try:
            shared = part(at)
            found = [error.value_and_slopes(shared) for error in errors]
        except SolverError:  # the filter is not stable
            return np.inf, np.zeros(x.size)
        values = np.array([value for value, _ in found])
        worst = float(values.max())
        weight = np.exp((values - worst) / (width * scale))
        if not best or worst < best[0][0]:
            best[:] = [(worst, at)]
        shares = zip(weight / weight.sum(), found, strict=True)
        slope = np.sum([share * units.slope(rate) for share, (_, rate) in shares], axis=0)
        return worst / scale + width * float(np.log(weight.sum())), slope / scale

    x = np.zeros(start.K.size + start.L_z.size)
    if not np.isfinite(smooth(x, 1.0, 1.0)[0]):
        raise AssumptionError(
            "the Kalman filter of the nominal plant is not stable to working precision, so the "
            "search has no start."
        )
    steepness = 0.0
    for width in _WIDTHS:
        limits: Any = {"maxiter": steps, "gtol": 1e-5}  # of the logarithm of a variance
        with np.errstate(all="ignore"):
            result = minimize(
                smooth, x, args=(width, best[0][0]), jac=True, method="BFGS", options=limits
            )
        x = result.x
        steepness = float(np.linalg.norm(result.jac))
    return best[0][1], steepness


#: what a filter may miss of a rigid-body motion that it should follow without error
_MISSED = 1e-7


class GainPair(NamedTuple):
    """K (n, ny) and L_z (nz, ny), or the derivatives of a number to them."""

    K: FloatArray
    L_z: FloatArray


class FilterPart(NamedTuple):
    """What the errors on all machines share: the filter with some gains, states of unit size."""

    K: FloatArray
    L: FloatArray
    powers: list[FloatArray]
    C0: FloatArray
    E: FloatArray
    sight: FloatArray


@np.errstate(over="ignore", invalid="ignore")
def filter_part(m: FilterModel, gains: GainPair, scale: FloatArray, unit: FloatArray) -> FilterPart:
    """Return the part of the errors that does not depend on the machine."""
    K, L, C0 = gains.K / scale[:, None], gains.L_z / unit, m.C2 * scale
    repeated = powers(m.A * scale / scale[:, None] - K @ C0)
    E = m.C1 * scale / unit - L @ C0
    return FilterPart(K, L, repeated, C0, E, stein_sum(repeated, repeated, E.T @ E, turned=True))


class MachineError(NamedTuple):
    """Error of ``x_o+ = A0 x_o + K (y - C0 x_o)``, ``hat = C1 x_o + L_z (y - C0 x_o)``.

    On a machine ``x+ = A x + G xi``, ``y = C x + v``, ``z = C1e x``, without the rigid-body motion
    x_r that both share: x and x_o are what is left beside V_e x_r and V_o x_r. All in states of
    unit size.
    """

    powers: list[FloatArray]
    C: FloatArray
    C1e: FloatArray
    G: FloatArray
    X: FloatArray
    back: FloatArray
    driven: FloatArray
    root: FloatArray

    def value_and_slopes(self, part: FilterPart) -> tuple[float, GainPair]:
        """Return the mean relative variance and its derivatives to K and L of the part."""
        # `J = tr(E X E')`, X = F X F' + N N', Y = F' Y F + E' E: dJ/dF = 2 Y F X, dJ/dN = 2 Y N,
        # dJ/dE = 2 E X with `F = [A, 0; B, A_o]`, B = K C - back; of Y the rows of the filter are
        # enough
        A, A_o, Y = self.powers[0], part.powers[0], part.sight
        powers = self.powers
        while len(powers) < len(part.powers):
            powers.append(powers[-1] @ powers[-1])
        B, own = part.K @ self.C - self.back, self.root.shape[1] - self.G.shape[1]
        N = part.K @ self.root
        N[:, own:] -= self.driven
        E = self.C1e - part.L @ self.C
        entering = B @ self.X
        X_oe = stein_sum(part.powers, powers, entering @ A.T + N[:, own:] @ self.G.T)
        half = A_o @ X_oe @ B.T
        X_oo = stein_sum(part.powers, part.powers, entering @ B.T + half + half.T + N @ N.T)
        Y_oe = stein_sum(part.powers, powers, A_o.T @ Y @ B - part.E.T @ E, turned=True)
        direct = part.L @ self.root
        to_e, to_o = E @ self.X - part.E @ X_oe, E @ X_oe.T - part.E @ X_oo
        value = float(np.sum(to_e * E) - np.sum(to_o * part.E) + np.sum(direct**2))
        left, right = Y_oe @ A + Y @ B, Y @ A_o
        to_Fe, to_Fo = left @ self.X + right @ X_oe, left @ X_oe.T + right @ X_oo
        to_N = Y @ N
        to_N[:, own:] += Y_oe @ self.G
        K = to_Fe @ self.C.T - to_Fo @ part.C0.T + to_N @ self.root.T
        L = -to_e @ self.C.T + to_o @ part.C0.T + direct @ self.root.T
        return value, GainPair(2 * K, 2 * L)


def machine_error(
    plant: AnyPlant,
    model: FilterModel,
    machine: AnyPlant,
    start: GainPair,
    scale: FloatArray,
    unit: FloatArray,
) -> MachineError:
    """Return the error of filters on a plant's matrices when they run on a machine."""
    # undamped motions x_r of the machine have no variance. A filter that holds them follows with
    # V_o x_r whatever its gains are: `A0 V_o = V_o A_rr`, `C0 V_o = C_r`, `C1 V_o = C1_r`
    m, own = model, filter_model(machine)
    G_all = machine.noise_factor
    rigid, rest = moving_parts(machine)
    rr, re, er = (own.A[np.ix_(*pair)] for pair in ((rigid, rigid), (rigid, rest), (rest, rigid)))
    A, C, C1e, G = own.A[np.ix_(rest, rest)], own.C2[:, rest], own.C1[:, rest], G_all[rest]
    C_r, C1_r = own.C2[:, rigid], own.C1[:, rigid]
    back, driven = np.zeros((m.A.shape[0], rest.size)), np.zeros((m.A.shape[0], G.shape[1]))
    if rigid.size:
        if np.any(er):  # filters of sensors follow the motion too
            V_e = sylvester(A, rr, er)
            C_r, C1_r, G, A = C_r + C @ V_e, C1_r + C1e @ V_e, G - V_e @ G_all[rigid], A - V_e @ re
        V = sylvester(m.A - start.K @ m.C2, rr, start.K @ C_r)
        both = np.vstack([C_r, C1_r])
        missed = np.vstack([m.C2, m.C1]) @ V - both
        size = np.maximum(np.linalg.norm(both, axis=1, keepdims=True), TINY)
        if np.max(np.abs(missed) / size) > _MISSED:
            raise AssumptionError(
                "a rigid-body motion (or undamped mode) of a machine is not one of the plant: a "
                "filter with other gains would lose it, so that no worst error is finite. "
                f"The plant is {plant!r}; assemble both with the same ports, sampled alike."
            )
        back, driven = V @ re, V @ G_all[rigid]
    rows = [machine.y.index(name) for name in own.sensors]
    at_once = machine.noise_direct[rows]
    alone = machine.sensor_noise_factor[rows]
    X = solve_stein(A, G @ G.T)
    d = scale_of(X.diagonal())
    inside = A * d / d[:, None], C * d, C1e * d / unit, G / d[:, None], X / d / d[:, None]
    beside = back * d / scale[:, None], driven / scale[:, None], np.hstack([alone, at_once])
    return MachineError([inside[0]], *inside[1:], *beside)

"""The error of an observer on any sampled plant, in closed form, and over machines.

The model of its design is not used.
"""

from __future__ import annotations

from collections.abc import Sequence
from contextlib import suppress
from functools import cached_property
from typing import Any, NamedTuple

import numpy as np
import scipy.linalg as la

from ..arrays import ComplexArray, FloatArray, IntArray, divisor
from ..errors import (
    SHOWN,
    AssumptionError,
    CertificateError,
    ModelError,
    SolverError,
    sizes_of,
    unknown_label,
    warn,
)
from ..loop import ClosedLoop, close_loop
from ..loop.budget import check_stationary, source_variances, sources
from ..lti.blocks_of_states import ModalMap, equal_matrices
from ..lti.equations import (
    accumulated,
    difference_of,
    scale_of,
    shifted_columns,
    solve_stein,
    stein,
    sylvester,
)
from ..lti.lyapunov import dual_variances, stein_root
from ..lti.sampling import uncoupled_pairs
from ..lti.statespace import StateSpace, System
from ..plant import AnyPlant
from ..plant.machine_plants import FigureInterval, interval, interval_text
from ..store import Value
from ..tolerances import CLOSE, INTERVAL, MISSED, ROOT, ROUNDING, TINY, TYPED
from .filter_models import poi_channels, same_pois, sensors

#: fraction of a variance above which such modes are named
_MOST = 0.5


class Variances(NamedTuple):
    """Variances (n_poi,) of the error, and their uncertainty: by the dual, and by rounding."""

    values: FloatArray
    difference: float


def error_variances(plant: AnyPlant, observer: StateSpace) -> Variances:
    """Return the variances of ``z - hat`` at the sample instants, with u zero or known exactly.

    ``x[k+1] = A x[k] + w[k]``, ``y = C2 x + v``; the observer reads y. A rigid-body motion x_r has
    no variance, nor has an undamped mode (poles on the unit circle); the observer follows them with
    the states V x_r, ``A_o V - V A_rr = -B_y C2_r``, so that the rest ``x' = x - V x_r`` is stable
    and has a separate Stein equation. Damped modes that it follows, such as those of a suspension,
    are treated in the same way. The elastic states are solved mode by mode, O(n^2) of them. The
    dual equation, from the output back to the noises, gives the same variances by another way.
    """
    joint, missed = _apart(_joint(plant, observer))
    primal, dual = _two_ways(joint)
    size = divisor(primal)
    # both have the same poles, so that neither shows the effect of rounding on their damping
    rounded = np.sum(missed.variances * (np.finfo(np.float64).eps / missed.gap), axis=1)
    difference = difference_of(dual, primal) + float(np.max(rounded / size, initial=0.0))
    if not difference <= CLOSE:
        raise CertificateError(
            "the variance of the estimation error on a plant and its dual differ by "
            f"{difference:.1e} (allowed {CLOSE:.0e}): the number cannot be trusted. Look for "
            "poles within rounding of the unit circle, and damp them."
        )
    _note_hardly_damped(plant, missed, size)
    return Variances(primal + joint.direct, difference)


def _two_ways(joint: _Joint) -> tuple[FloatArray, FloatArray]:
    """Return the variances by the equation of the states and by its dual."""
    if joint.modal is None:
        X = solve_stein(joint.A, joint.noise @ joint.noise.T)
        primal = np.sum((joint.E @ X) * joint.E, axis=1)
        dual = np.array([_dual_dense(joint, row) for row in joint.E])
    else:
        primal, dual = _primal(joint), _gain_trace(joint)
    if not difference_of(dual, primal) <= CLOSE:  # squares that cancel: by their roots
        with suppress(SolverError):  # poles on the circle: refused by the difference
            L = stein_root(joint.A, joint.noise)
            dual = dual_variances(joint.A, joint.noise, joint.E, np.linalg.norm(L, axis=1))
            primal = np.sum((joint.E @ L) ** 2, axis=1)
    return primal, dual


class _Missed(NamedTuple):
    """Modes that the observer follows: poles (f,), missed parts (nz, f), ``1 - |lambda|^2``."""

    poles: ComplexArray
    variances: FloatArray
    gap: FloatArray


def _note_hardly_damped(plant: AnyPlant, missed: _Missed, total: FloatArray) -> None:
    """Warn when most of a variance comes from the missed part of nearly undamped motions."""
    slow = missed.gap < ROOT
    shares = np.sum(missed.variances[:, slow], axis=1) / total
    if not np.any(shares > _MOST):
        return
    named = [c for c, share in zip(poi_channels(plant), shares, strict=True) if share > _MOST]
    freq = np.sort(np.abs(np.angle(missed.poles[slow]))) / (2 * np.pi * plant.dt)
    listed = ", ".join(f"{value:.3g}" for value in freq[:6]) + (", ..." if freq.size > 6 else "")
    warn(
        f"{np.max(shares):.0%} of the variance of the estimation error of {', '.join(named)} is "
        f"from modes at {listed} Hz with almost no damping: white disturbances move them so far "
        "that the smallest difference between the filter's model and this plant matters. Give "
        "them the damping of the machine: fx.plant.GroundSpring(..., damping=) for a "
        "suspension, fx.ModalDamping for the structure."
    )


class _Joint(NamedTuple):
    """``x' = A x + noise``, ``error = E x`` + white of variance `direct`; elastic states first."""

    A: FloatArray
    noise: FloatArray
    E: FloatArray
    direct: FloatArray
    n_elastic: int
    modal: ModalMap | None

    @property
    def any_modal(self) -> ModalMap:
        """The plant's modes, without eigenvalues that nearly coalesce."""
        if self.modal is not None:
            return self.modal
        found: Any = la.eig(self.A[: self.n_elastic, : self.n_elastic], left=True)
        values, left, right = found
        overlap = np.sum(left.conj() * right, axis=0)
        good = np.abs(overlap) * (1.0 / TYPED) > 1.0
        inverse = (left[:, good] / overlap[good].conj()).conj().T
        return ModalMap(values[good], right[:, good], inverse)

    @property
    def parts(self) -> tuple[ModalMap, FloatArray, ComplexArray, ComplexArray, FloatArray]:
        """Modes, A_o, the coupling B_y C2 T, and both parts of the noise (modal, observer)."""
        assert self.modal is not None  # noqa: S101
        n, own = self.n_elastic, self.modal
        coupling = own.seen(self.A[n:, :n])
        return own, self.A[n:, n:], coupling, own.driven(self.noise[:n]), self.noise[n:]


def _joint(plant: AnyPlant, observer: StateSpace) -> _Joint:
    g, factor = plant.system, plant.noise_factor
    read = [name for name in observer.inputs if name in plant.y and name not in plant.w]
    observer = observer.select(observer.outputs, read)
    C1, C2 = g.C[g.output_index(poi_channels(plant))], g.C[g.output_index(read)]
    noise = plant.sensor_noise_factor[[plant.y.index(name) for name in read]]
    rigid, rest = moving_parts(plant)
    n, m, k = rest.size, observer.n_states, rigid.size
    A = np.zeros((n + m, n + m))
    A[:n, :n], A[n:, n:] = g.A[np.ix_(rest, rest)], observer.A
    A[n:, :n] = observer.B @ C2[:, rest]
    E = np.hstack([C1[:, rest] - observer.D @ C2[:, rest], -observer.C])
    drive = np.zeros((n + m, factor.shape[1] + noise.shape[1]))
    drive[:n, : factor.shape[1]], drive[n:, factor.shape[1] :] = factor[rest], observer.B @ noise
    at_once = plant.noise_direct[[plant.y.index(name) for name in read]]
    drive[n:, : factor.shape[1]] += observer.B @ at_once
    if k:
        entering = np.vstack([g.A[np.ix_(rest, rigid)], observer.B @ C2[:, rigid]])
        V = _solve_sylvester(A, n, entering, g.A[np.ix_(rigid, rigid)])
        back = np.zeros((k, n + m))
        back[:, :n] = g.A[np.ix_(rigid, rest)]
        seen = C1[:, rigid] - observer.D @ C2[:, rigid] + E @ V
        _check_seen(plant, seen, C1[:, rigid])
        A = A - V @ back
        drive[:, : factor.shape[1]] -= V @ factor[rigid]
    direct = np.sum((observer.D @ np.hstack([noise, at_once])) ** 2, axis=1)
    return _Joint(A, drive, E, direct, n, _plant_modes(A[:n, :n], A[:n, n:]))


def _apart(joint: _Joint) -> tuple[_Joint, _Missed]:
    """Return the same error in states relative to the plant's modes, and the missed part."""
    # a mode T_j of eigenvalue lambda_j moves the observer by V_j, `(lambda_j - A_o) V_j = B_y C2
    # T_j`. A suspension moves up to 1e5 times as far as the estimate errs, whose variance is then a
    # difference of large squares; relative to `[T_j; V_j]` only amplitudes cancel. V_j need not be
    # exact: the remaining coupling of the modes to the other states stays in A
    n = joint.n_elastic
    own, keep = joint.A[n:, n:], joint.E[:, n:]
    modes = joint.any_modal
    values, see, entering = modes.poles, modes.seen(joint.E[:, :n]), modes.seen(joint.A[n:, :n])
    with np.errstate(divide="ignore", invalid="ignore", over="ignore"):
        V = shifted_columns(own, 1 / values, entering / values)
    # not finite where the observer has a pole there as well: that mode is not followed
    V = np.where(np.all(np.isfinite(V), axis=0), V, 0.0)
    gap = np.maximum(1 - np.abs(values) ** 2, np.finfo(np.float64).eps)
    moved = np.linalg.norm(modes.driven(joint.noise[:n]), axis=1) / np.sqrt(gap)
    terms, missed = (np.abs(see) + np.abs(keep @ V)) * moved, np.abs(see + keep @ V) * moved
    size = np.linalg.norm(terms, axis=1, keepdims=True)
    part = [np.linalg.norm(x / divisor(size), axis=0) for x in (missed, terms)]
    known = part[0] < CLOSE * part[1]
    if joint.modal is not None:
        known = np.repeat(known.reshape(-1, 2).all(axis=1), 2)
    # one of each pair: the real and the imaginary part are its motion
    chosen = np.flatnonzero(known & (values.imag >= 0))
    left_over = _Missed(values[chosen], 2 * missed[:, chosen] ** 2, gap[chosen])
    shapes = np.vstack([modes.shapes(chosen), V[:, chosen]])
    motion: FloatArray = np.hstack([shapes.real, shapes.imag[:, values[chosen].imag > 0]])
    if not motion.size:
        return joint, left_over
    # the same number of states of the plant represents the modes; F gives the others from these
    rows = la.qr(motion[:n].T, mode="r", pivoting=True)[1][: motion.shape[1]]
    F = np.asarray(np.linalg.solve(motion[rows].T, motion.T).T)
    F[rows] = 0.0
    A, E = joint.A.copy(), joint.E.copy()
    A[:, rows] += A @ F
    E[:, rows] += E @ F
    noise = joint.noise - F @ joint.noise[rows]
    return joint._replace(A=A - F @ A[rows], noise=noise, E=E), left_over


def moving_parts(plant: AnyPlant) -> tuple[IntArray, IntArray]:
    """Return the states of modes on the unit circle, and all others affected by noise."""
    g, factor = plant.system, plant.noise_factor
    states = plant.modal_states.reshape(-1, 2)
    blocks = g.A[states[:, :, None], states[:, None, :]]
    undamped = np.abs(np.linalg.eigvals(blocks)).max(axis=1) >= (1.0 - ROUNDING)
    undamped[: plant.n_rigid] = True
    kept = states[undamped].reshape(-1)
    reached = np.any(factor != 0, axis=1)
    pattern = g.A != 0
    while np.any(grown := ~reached & np.any(pattern[:, reached], axis=1)):
        reached |= grown
    reached[kept] = False
    return kept, np.flatnonzero(reached)


def _solve_sylvester(A: FloatArray, n: int, entering: FloatArray, kept: FloatArray) -> FloatArray:
    """Return V of ``A V - V A_rr = -entering``; n states stand before the observer's."""
    V = np.zeros_like(entering)
    start = 0 if np.any(entering[:n]) else n
    V[start:] = sylvester(A[start:, start:], kept, entering[start:])
    return V


def _check_seen(plant: AnyPlant, seen: FloatArray, motion: FloatArray) -> None:
    worst = np.linalg.norm(seen, axis=1) / np.maximum(np.linalg.norm(motion, axis=1), TINY)
    if np.max(worst) > MISSED:
        raise AssumptionError(
            f"the estimate of {poi_channels(plant)[int(np.argmax(worst))]!r} misses "
            f"{np.max(worst):.2g} of a rigid-body motion or undamped mode of the plant: its error "
            "grows without limit. The two models differ in places, filters, delays or undamped "
            "modes. Damp the modes of a suspension, as in the machine: "
            "fx.plant.GroundSpring(..., damping=)."
        )


def _plant_modes(block: FloatArray, above: FloatArray) -> ModalMap | None:
    """Return the modes of a plant whose modes are uncoupled, or None."""
    pairs = None if np.any(above) else uncoupled_pairs(block)
    if pairs is None:
        return None
    # states of one size: those of a mode are its omega q and dq/dt
    found = ModalMap.of_pairs(pairs)
    if len(pairs) and np.max(np.linalg.cond(found.T)) > (1.0 / TYPED):
        return None
    return found


def _primal(joint: _Joint) -> FloatArray:
    """Return ``E X E'`` with ``X = A X A' + noise noise'``."""
    modes, A, coupling, driven, noise = joint.parts
    values, n = modes.poles, joint.n_elastic
    inner = modes.gramian(driven, sampled=True)
    entering = coupling @ inner
    cross = shifted_columns(A, values.conj(), entering * values.conj() + noise @ driven.conj().T)
    half = A @ cross @ coupling.conj().T
    entered = np.real(entering @ coupling.conj().T) + noise @ noise.T
    own = _stein_solution(A, entered + np.real(half + half.conj().T), _observer_state_sizes(joint))
    see, keep = modes.seen(joint.E[:, :n]), joint.E[:, n:]
    total = np.sum((see @ inner + 2 * keep @ cross) * see.conj(), axis=1).real
    return np.asarray(total + np.sum((keep @ own) * keep, axis=1))


def _observer_state_sizes(joint: _Joint) -> FloatArray:
    """Return the sizes of the observer's states from the sensor noise only, powers of two."""
    # of all states alike, also of those that the POIs do not see: the dual's are their inverses
    A, noise = joint.A[joint.n_elastic :, joint.n_elastic :], joint.noise[joint.n_elastic :]
    return scale_of(accumulated(A, noise @ noise.T))


def _stein_solution(A: FloatArray, load: FloatArray, d: FloatArray) -> FloatArray:
    """Return X of ``X = A X A' + load`` in states of sizes d; the load may be indefinite."""
    As, Qs = A * d / d[:, None], 0.5 * (load + load.T) / d / d[:, None]
    return np.asarray(stein(As, Qs) * d * d[:, None])


def _gain_trace(joint: _Joint) -> FloatArray:
    """Return ``trace(noise' Y noise)`` with ``Y = A' Y A + row' row`` for each row of E."""
    modes, A, coupling, driven, noise = joint.parts
    values, n = modes.poles, joint.n_elastic
    see, keep = modes.seen(joint.E[:, :n]), joint.E[:, n:]
    sizes = 1.0 / _observer_state_sizes(joint)
    own = np.array([_stein_solution(A.T, np.outer(row, row), sizes) for row in keep])
    right = A.T @ own @ coupling + keep[:, :, None] * see[:, None, :]
    # the columns of all rows side by side, by one Schur form
    cross = shifted_columns(A.T, np.tile(values, len(keep)), np.hstack(list(right)))
    # Y of the modes is `load / (1 - conj(values) values')`; what its trace with the noise has in
    # common for all rows is formed once
    weight = (driven.conj() @ driven.T) / (1 - np.outer(values.conj(), values))
    entering, both = coupling.conj() @ weight, noise @ driven.T
    found = []
    for row, mine, across in zip(see, own, np.split(cross, len(keep), axis=1), strict=True):
        total = np.sum((mine @ coupling) * entering) + row.conj() @ weight @ row
        total += 2 * np.sum(across * (entering * values + both))
        found.append(float(total.real + np.sum(noise * (mine @ noise))))
    return np.array(found)


def _dual_dense(joint: _Joint, row: FloatArray) -> float:
    Y = solve_stein(joint.A.T, np.outer(row, row))
    return float(np.sum(joint.noise * (Y @ joint.noise)))


def loop_variances(plant: AnyPlant, estimator: StateSpace, loop: ClosedLoop) -> FloatArray:
    """Return the variances (nz,) of ``z - hat`` in a closed loop, at the sample instants."""
    # the effect of u on a machine that differs from the estimator's model enters the error,
    # although the estimator reads u: the Stein equation of the whole loop, `X = A X A' + G G'`,
    # each noise twice (`loop.budget`)
    same_pois(plant, loop.plant)
    channels = poi_channels(plant)
    hats = estimates(channels)
    own = [block for block in loop.blocks if set(hats) & set(block.outputs)]
    if not own:
        loop = close_loop(loop.plant.replace(evaluation=None), *loop.blocks, estimator)
    elif not all(equal_matrices(block, estimator) for block in own):
        raise ModelError(
            f"the loop has {', '.join(hats)} from another estimator. Close it with this one: "
            "close_loop(machine, observer, servo)."
        )
    check_stationary(loop.obstacle, "the error of an estimator")
    g = loop.monitored
    z, hat = g.output_index(channels), g.output_index(hats)
    error = StateSpace(
        g.A, g.B, g.C[z] - g.C[hat], g.D[z] - g.D[hat], g.dt,
        inputs=g.inputs, outputs=hats, states=g.states,
    )  # fmt: skip
    noises = sources(loop.plant, error)
    return np.array([source_variances(error, row, noises)[0].sum() for row in range(len(hats))])


class PoiEstimator(Value):
    """Common base of estimators of motions at the POIs: intervals of their errors."""

    system: StateSpace
    plant: AnyPlant

    def interval(self, channel: str, level: float = INTERVAL) -> FigureInterval:
        """Return the interval of the rms error over the machines that the plant may be.

        These machines are ``plant.machines``. They exist if the plant was made from
        ``fit.calibrated(measured)`` or from ``plant.uncertain(...)``, for example with
        ``fit.machines(measured)``. Each machine is a random draw that agrees with the measurement
        or the stated uncertainty.

        Parameters
        ----------
        channel : str
            Motion of a POI under any of its names: `die`, `die:z`, `die:hat`, `die:error`.
        level : float
            Fraction of the machines in the interval, between 0 and 1.

        Returns
        -------
        FigureInterval
            ``(low, high, sentence)`` [m or rad]; low and high are None if the interval does not
            exist; the sentence gives the reason.

        Raises
        ------
        LabelError, ModelError
            When the channel is not a motion of a POI, or the level is out of range.
        """
        row = row_of(poi_channels(self.plant), channel)
        unit = self.plant.units.get(poi_channels(self.plant)[row], "")
        known = self.plant.machine.machines
        given = "" if known is None else known.densities
        return interval(known, lambda: self.on_machines[:, row], level, unit, given)

    def compared(
        self, other: PoiEstimator, channel: str, level: float = INTERVAL
    ) -> FigureInterval:
        """Return the interval of the ratio of this rms error to that of another estimator.

        The ratio is computed on each of the machines ``plant.machines`` that the plant may be (see
        `interval`). If the ratio is below 1, this estimator is better. To compare two places of a
        sensor, design an estimator for each place, on plants of the same evaluation model.

        Parameters
        ----------
        other : KalmanEstimator or StaticEstimator
            Estimator of the same POIs, on a plant of the same machines.
        channel : str
            Motion of a POI under any of its names: `die`, `die:z`, `die:hat`, `die:error`.
        level : float
            Fraction of the machines in the interval, between 0 and 1.

        Returns
        -------
        FigureInterval
            ``(low, high, sentence)`` of the ratio of the errors; low and high are None if the
            interval does not exist; the sentence gives the reason.

        Raises
        ------
        LabelError, ModelError
            When the channel is not a motion of a POI, the level is out of range, or the plant of
            the other estimator has another number of machines.
        """
        own, others = (row_of(poi_channels(one.plant), channel) for one in (self, other))

        def ratios() -> FloatArray:
            if self.on_machines.shape[0] != other.on_machines.shape[0]:
                raise ModelError(
                    "the estimators are compared on the same machines: make both plants from one, "
                    "plant.with_ports(...) or plant.at(...)."
                )
            return np.asarray(self.on_machines[:, own] / other.on_machines[:, others])

        known = self.plant.machine.machines
        found = interval(known, ratios, level, "")
        if found.low is None:
            return found
        better = int(np.count_nonzero(ratios() < 1.0))
        said = f"{found.sentence} times the other error, smaller on {better} of {ratios().size}"
        return found._replace(sentence=said)

    @cached_property
    def on_machines(self) -> FloatArray:
        """RMS errors (n, n_poi) [m or rad] on each of the n machines ``plant.machines``."""
        known = self.plant.machine.machines
        plants = [] if known is None else known.plants
        return np.sqrt([
            error_variances(same_pois(self.plant, one), self.system).values for one in plants
        ])  # fmt: skip


class PoiFilter(PoiEstimator):
    """Common base of stationary filters of the motions at the POIs."""

    variances: FloatArray

    @property
    def sensors(self) -> tuple[str, ...]:
        """The sensors, in the order of the columns of the gains."""
        return sensors(self.plant)

    @property
    def rms_text(self) -> str:
        """Text of the predicted rms errors, with intervals or the reason why there are none."""
        channels, units = poi_channels(self.plant), self.plant.units
        known = self.plant.machine.machines if self.plant.dt else None
        if known is None:
            return sizes_of({name: self.rms(name) for name in channels}, units)
        said: list[str] = []
        for name in channels[:SHOWN]:
            low, high, sentence = self.interval(name)
            if low is None or high is None:
                return f"{sizes_of({n: self.rms(n) for n in channels}, units)}\n  ({sentence})"
            ends = interval_text(low, high, units.get(name, ""))
            on = "" if said else f" on {100 * INTERVAL:.3g} % of such machines{known.densities}"
            said.append(f"{sizes_of({name: self.rms(name)}, units)} ({ends}{on})")
        more = [f"... ({len(channels) - SHOWN} more)"] if len(channels) > SHOWN else []
        return ",\n    ".join(said + more)

    def rms(self, channel: str, *, on: AnyPlant | ClosedLoop | System | None = None) -> float:
        """Return the rms of the estimation error at the sample instants.

        Parameters
        ----------
        channel : str
            Motion of a POI under any of its names: `die`, `die:z`, `die:hat`, `die:error`.
        on : StandardPlant or ClosedLoop, optional
            Another sampled plant, with other modes or noises, on which the error is computed with
            ``u = 0``. It may also be a closed loop around such a plant. Then u also excites the
            differences between this plant and the filter's model. The error is computed from a
            Lyapunov equation, not by simulation. By default the predicted error is returned.

        Returns
        -------
        float [m or rad]

        Raises
        ------
        LabelError
            When the channel is not a motion of a POI, or is missing in the other plant.
        ModelError
            When the other plant has another sampling time, its noise is not known, or a loop has
            the estimates of another filter.
        AssumptionError
            When the error would contain a rigid-body motion of the other plant, or the loop is not
            stable.
        """
        row = row_of(poi_channels(self.plant), channel)
        variances = self.variances
        if isinstance(on, ClosedLoop):
            variances = loop_variances(self.plant, self.system, on)
        elif on is not None:
            variances = error_variances(same_pois(self.plant, on), self.system).values
        return float(np.sqrt(max(variances[row], 0.0)))


def estimates(channels: Sequence[str], kind: str = "hat") -> tuple[str, ...]:
    """Return the names of the estimates, such as `die:hat` and `die:rx:hat`."""
    first = _firsts(channels)
    owners = [channel.rpartition(":")[0] or channel for channel in channels]
    return tuple(
        f"{poi if first[poi] == i else channels[i]}:{kind}" for i, poi in enumerate(owners)
    )


def row_of(channels: Sequence[str], name: str) -> int:
    """Return the POI channel of a name: `die`, `die:z`, `die:hat` and `die:error` are equal."""
    known: dict[str, int] = {}
    for kind in ("hat", "error"):
        known |= {alias: i for i, alias in enumerate(estimates(channels, kind))}
    known |= _firsts(channels)
    known |= {channel: i for i, channel in enumerate(channels)}
    if not isinstance(name, str) or name not in known:
        raise unknown_label("POI channel", name, channels)
    return known[name]


def _firsts(channels: Sequence[str]) -> dict[str, int]:
    """Return the first channel of each POI."""
    last_first = reversed([*enumerate(channels)])
    return {channel.rpartition(":")[0] or channel: i for i, channel in last_first}

"""The model of a filter with its noises: those of the plant, and what it leaves out as noise.

Truncated modes are noise on sensors and POIs and a static compliance; so is what machines do that
the model does not.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np

from ..arrays import ComplexArray, FloatArray, IntArray, divisor
from ..errors import AssumptionError, ModelError, SolverError, counted, unknown_label
from ..lti.blocks_of_states import ModalMap
from ..lti.equations import square_root
from ..lti.statespace import StateSpace, System
from ..modes.matching import NEAR, assigned
from ..plant import AnyPlant, GeneralizedPlant, StandardPlant, plant_of, standard_plant
from ..plant.building import loud_like, sampled_like, structure_system, wired, with_filters
from ..plant.origins import Assembled
from ..plant.partitioned import NOT_JUDGED
from ..plant.ports import Ports
from ..plant.realisation import ModalRealisation
from ..reduction import ReducedModel
from ..reduction.reduced import STATIC
from ..store import Value
from ..tolerances import ROUNDING, SAME

#: error text where a covariance cannot be followed sample by sample
FEW_DIGITS = (
    "the noise of the sensors is so small compared with the motion that the covariance of the "
    "error does not give the filter's gain in double precision: deviations of single samples, "
    "delayed and smoothed estimates cannot be computed. The filter itself is correct: run it by "
    "observer.system, "
    "observer.step or close_loop; or give the sensors the asd of their data sheet, checking units."
)

#: entry of a certificate: number of truncated modes
LEFT_OUT = "truncated modes"
#: weight of a different shape relative to a different frequency when modes are paired
_SHAPE = 0.02
#: parts of the difference between machines and model that are tried as noise: a difference at a
#: resonance is not white, so that all of it may be too much
PARTS = (1.0, 0.5, 0.25)


@dataclass(frozen=True, eq=False, repr=False)
class FilterModel(Value):
    """The plant model and the noise covariances of a Kalman filter.

    ::

        x[k+1] = A x[k] + B u[k] + G xi[k]            [G xi]   [Q  0  S]
        z[k]   = C1 x[k] + D1 u[k] + n[k]         cov [  n ] = [0  V  N]
        y[k]   = C2 x[k] + D2 u[k] + H xi[k]          [H xi]   [S' N' R]

    The noises xi[k] and n[k] are independent from sample to sample. The matrices ``Q = G G'``,
    ``R = H H'`` and ``S = G H'`` follow from G and H. In the methods, x[k|j] is the estimate of the
    state at sample k from the measurements up to sample j. An innovation is a measurement minus its
    prediction.

    Parameters
    ----------
    A, B, C1, D1, C2, D2 : arrays
        Model from the commands u to the motions z at the POIs and to the sensors y.
    G : (n, r) array
        Gain from xi, white noises of unit variance, to the state x of the next sample. It
        represents the effect of the disturbances on the states.
    H : (ny, r) array
        Gain from xi to the sensors. It represents the noise of the sensors and the motion of
        truncated modes, which counts as noise. Disturbances that are held constant over each sample
        are included as well, because an acceleration sensor responds to them at once.
    V : (nz, nz) array
        Covariance of n, the motion of truncated modes at the POIs.
    N : (nz, ny) array
        Covariance between n and the noise of the sensors.
    dt : float [s]
        Sampling time.
    channels, sensors, commands : tuples of str
        Names of z, y and u.

    Examples
    --------
    >>> import flexplant as fx
    >>> model = fx.design_kalman(fx.testbeds.three_masses()).model
    >>> model.sensors, model.commands, model.A.shape
    (('y1', 'y2'), ('u1',), (7, 7))
    """

    A: FloatArray
    B: FloatArray
    C1: FloatArray
    D1: FloatArray
    C2: FloatArray
    D2: FloatArray
    G: FloatArray
    H: FloatArray
    V: FloatArray
    N: FloatArray
    dt: float
    channels: tuple[str, ...]
    sensors: tuple[str, ...]
    commands: tuple[str, ...]

    @cached_property
    def Q(self) -> FloatArray:
        """Covariance (n, n) of the effect of disturbances on x in one sample."""
        return self.G @ self.G.T

    @cached_property
    def R(self) -> FloatArray:
        """Covariance (ny, ny) of the noise at the sensors in one sample."""
        return self.H @ self.H.T

    @cached_property
    def S(self) -> FloatArray:
        """Covariance (n, ny) between the noises of process and sensors."""
        return self.G @ self.H.T

    def scaled(self, d: FloatArray, s: FloatArray) -> FilterModel:
        """Return the model with states x / d and measurements y / s.

        Parameters
        ----------
        d : (n,) array
            Unit of each new state.
        s : (ny,) array
            Unit of each new measurement.
        """
        return self.replace(
            A=self.A * d / d[:, None],
            B=self.B / d[:, None],
            C1=self.C1 * d,
            C2=self.C2 * d / s[:, None],
            D2=self.D2 / s[:, None],
            G=self.G / d[:, None],
            H=self.H / s[:, None],
            N=self.N / s,
        )

    def innovation(self, P: FloatArray) -> FloatArray:
        """Return the covariance ``C2 P C2' + R`` of the innovations.

        Parameters
        ----------
        P : (n, n) array
            Covariance of the error of x[k|k-1].
        """
        return np.asarray(self.C2 @ P @ self.C2.T + self.R)

    def updated(self, P: FloatArray, gain: FloatArray) -> FloatArray:
        """Return the covariance of the error of x[k|k] for any gain L, by Joseph's form.

        Parameters
        ----------
        P : (n, n) array
            Covariance of the error of x[k|k-1].
        gain : (n, ny) array
            Gain L of the innovations.
        """
        left = np.eye(P.shape[0]) - gain @ self.C2
        updated = left @ P @ left.T + gain @ self.R @ gain.T
        return np.asarray(0.5 * (updated + updated.T))

    def driven(self, gain: FloatArray) -> FloatArray:
        """Return the covariance ``(G - K H)(G - K H)'`` that one sample adds to the error.

        Parameters
        ----------
        gain : (n, ny) array
            Predictor gain K, from the innovation to x[k+1|k].
        """
        entering = self.G - gain @ self.H
        return entering @ entering.T


def innovation_root(S: FloatArray) -> FloatArray:
    """Return the Cholesky factors of covariances (..., ny, ny) of innovations."""
    try:
        return np.asarray(np.linalg.cholesky(0.5 * (S + np.swapaxes(S, -1, -2))))
    except np.linalg.LinAlgError:
        raise SolverError(FEW_DIGITS) from None


def weigh(part: FloatArray, spread: FloatArray) -> FloatArray:
    """Return ``part S^-1`` of a covariance S, its channels of unit size inside."""
    size = np.sqrt(spread.diagonal())
    try:
        weighed = np.linalg.solve(spread / size / size[:, None], (part / size).T)
    except np.linalg.LinAlgError as error:
        raise SolverError(FEW_DIGITS) from error
    return np.asarray(weighed.T / size)


def filter_model(plant: AnyPlant, found: LeftOut | None = None) -> FilterModel:
    """Return the model of a sampled plant, with known truncated modes as noise."""
    own = plant if found is None else found.plant
    g = own.system
    y, z = sensors(own), poi_channels(own)
    toward, at = g.select(y, own.u), g.select(z, own.u)
    rows = [own.y.index(name) for name in y]
    H = [own.noise_direct[rows], own.sensor_noise_factor[rows]]
    V, N = np.zeros((len(z), len(z))), np.zeros((len(z), len(y)))
    if found is not None:
        H, V, N = [*H, square_root(found.sensors)], found.pois, found.cross
    silent = [np.zeros((g.n_states, part.shape[1])) for part in H[1:]]
    return FilterModel(
        g.A, toward.B, at.C, at.D, toward.C, toward.D, np.hstack([own.noise_factor, *silent]),
        np.hstack(H), V, N, own.dt, z, y, tuple(own.u),
    )  # fmt: skip


def beyond_text(plant: AnyPlant, count: int | None) -> str:
    """Return a text on the truncated modes in predicted errors, and their number."""
    if count is None:
        alone = f"{NOT_JUDGED}: truncation is not in these numbers"
        return alone if plant.unjudged else "no modes are truncated"
    return f"with {counted(count, 'truncated mode')}" if count else "as if no modes were truncated"


@dataclass(frozen=True, eq=False, repr=False)
class LeftOut(Value):
    """Effect of the truncated modes of a plant on its sensors y and POIs z.

    Parameters
    ----------
    modes : (m,) array of int
        Numbers of the truncated modes in the evaluation model, from 1.
    sensors : (ny, ny) array
        Stationary covariance R_t of the motion of the truncated modes at the sensors.
    pois : (nz, nz) array
        Stationary covariance V_t of this motion at the POIs.
    cross : (nz, ny) array
        Stationary covariance N_t of this motion between POIs and sensors.
    plant : StandardPlant
        Plant whose response to u includes the static compliance of the truncated modes. The
        compliance may be represented by additional fast modes. Their shapes are attachment vectors
        (static shapes under unit forces), and only u acts on them.
    whole : StandardPlant
        Plant that includes the truncated modes. It is used to compute these values for other POIs.

    Examples
    --------
    >>> import flexplant as fx
    >>> model = fx.chain(masses=[1.0] * 4, stiffnesses=[4e5] * 3)
    >>> modes = fx.solve_modes(model, count=4, damping=fx.ModalDamping(0.01))
    >>> ports = fx.testbeds.three_masses().assembled.ports
    >>> plant = fx.assemble_plant(modes.select([0, 1, 2]), ports, evaluation=modes)
    >>> fx.design_kalman(plant.discretized(2e3, delay=1)).left_out.modes
    array([4])
    """

    modes: IntArray
    sensors: FloatArray
    pois: FloatArray
    cross: FloatArray
    plant: AnyPlant
    whole: AnyPlant

    def __repr__(self) -> str:
        return f"<LeftOut: {counted(self.modes.size, 'mode')} as noise and static compliance>"


def left_out(plant: AnyPlant, whole: AnyPlant) -> LeftOut | None:
    """Return the effect of modes of an evaluation plant that a plant lacks; None without any.

    With the poles lambda of the truncated modes, b what white noise of unit intensity drives and c
    what is seen, ``X_ij = - b_i b_j^* / (lambda_i + lambda_j^*)`` is the stationary covariance,
    ``c X c*`` that of the motions. For modes with modal damping this is::

        Sig_ij = W_ij (d_i + d_j) / ((om_i^2 - om_j^2)^2 + (d_i + d_j)(d_i om_j^2 + d_j om_i^2))
        R_t = P_y Sig P_y',  N_t = P_z Sig P_y',  V_t = P_z Sig P_z'

    with d = 2 zeta omega and ``W_ij = sum_w phi_iw phi_jw asd_w^2 / 2``. A sample has the same
    covariance. Coloured disturbances excite a mode with their density at its frequency, and their
    slow part moves it statically; filters and delays of sensors act at its pole.
    """
    own, others_own = plant.assembled, whole.assembled
    small, big, ports = own.realisation, others_own.realisation, own.ports
    bare = structure_system(small, ports)
    kept = _mode_blocks(small, bare)
    all_modes = _mode_blocks(big, structure_system(big, others_own.ports))
    kept_omega, kept_static = kept.omega, kept.static
    genuine = np.setdiff1d(np.arange(kept_omega.size), _of_vectors(small))
    if genuine.size > all_modes.omega.size:
        raise ModelError(
            f"the evaluation model has {counted(all_modes.omega.size, 'elastic mode')}, fewer than "
            f"the {genuine.size} of the plant. Pass more modes of the full structure."
        )
    rows, columns = _same_modes(kept, all_modes, genuine)
    others = np.setdiff1d(np.arange(all_modes.omega.size), columns)
    if not others.size:
        return None
    stand_ins = np.setdiff1d(np.arange(kept_omega.size), rows)
    flexibility = all_modes.static[others].sum(axis=0) - kept_static[stand_ins].sum(axis=0)
    flexibility[:, np.logical_not(_may_follow(plant, ports))] = 0.0
    # an acceleration has no static part
    moving = [i for i, sensor in enumerate(ports.y) if sensor.order == 2]
    flexibility[[len(flexibility) - len(ports.y) + i for i in moving]] = 0.0
    covariance = _motion_covariance(all_modes, others, whole)
    nz = covariance.shape[0] - len(ports.y)
    y = plant.machine.y
    read = plant.reading_gain[np.ix_(
        [plant.y.index(name) for name in sensors(plant)], [y.index(port.name) for port in ports.y]
    )]  # fmt: skip
    fresh = _with_flexibility(plant, bare, flexibility)
    quiet = _quiet(fresh.machine, plant.machine, plant.n_rigid + stand_ins)
    return LeftOut(
        others + big.n_rigid + 1,
        read @ covariance[nz:, nz:] @ read.T,
        covariance[:nz, :nz],
        covariance[:nz, nz:] @ read.T,
        plant.around(quiet),
        whole,
    )


@dataclass(frozen=True, eq=False)
class _Blocks:
    """Elastic modes of a structure between its ports; two poles each."""

    poles: ComplexArray  # (b, 2)
    see: ComplexArray  # (p, b, 2)
    push: ComplexArray  # (b, 2, m)
    static: FloatArray  # (b, p, m)

    @property
    def omega(self) -> FloatArray:
        return np.asarray(np.sqrt(np.abs(np.prod(self.poles, axis=1))))


def _mode_blocks(realisation: ModalRealisation, g: StateSpace) -> _Blocks:
    """Return the elastic modes of a structure that is g between its ports."""
    r = realisation.n_rigid
    n = g.n_states // 2 - r
    A, B, C = g.A[2 * r :, 2 * r :], g.B[2 * r :], g.C[:, 2 * r :]
    if realisation.coupling is None:
        own = ModalMap.of_pairs(realisation.pairs[r:])
    else:
        values, T = np.linalg.eig(A.astype(np.complex128))
        # conjugate pairs side by side, then the poles of overdamped modes
        order = np.lexsort((values.imag, np.round(np.abs(values), 9), values.imag == 0))
        own = ModalMap(values[order], T[:, order], np.linalg.inv(T)[order])
    poles = own.poles.reshape(n, 2)
    see, push = own.seen(C).reshape(len(C), n, 2), own.driven(B).reshape(n, 2, B.shape[1])
    static = -np.real(np.einsum("pbi,bi,bim->bpm", see, 1 / poles, push))
    return _Blocks(poles, see, push, static)


def _of_vectors(realisation: ModalRealisation) -> IntArray:
    """Return which elastic modes are attachment vectors that represent truncated modes."""
    r = realisation.n_rigid
    names = realisation.names[2 * r :: 2]
    model = realisation.model
    if not isinstance(model, ReducedModel) or not model.n_vectors:
        return np.array([i for i, n in enumerate(names) if n.startswith("residual")], np.int64)
    shapes = realisation.outputs.reshape(model.n_dof, -1, 2)[:, r:]
    size = np.sum(shapes**2, axis=(0, 2))
    held = [i for i, name in enumerate(model.coordinates) if name.startswith(STATIC)]
    if held:
        part = np.sum(shapes[held] ** 2, axis=(0, 2)) / size
    else:  # frequencies of vectors are means of those of truncated modes
        part = np.sqrt(np.abs(np.linalg.det(realisation.pairs[r:])))
    return np.sort(np.argsort(part)[part.size - model.n_vectors :])


def _same_modes(kept: _Blocks, every: _Blocks, genuine: IntArray) -> tuple[IntArray, IntArray]:
    """Return the common modes of both, by frequency and compliance."""
    one, two = kept.static[genuine], every.static
    # what no mode passes from a force to a motion is rounding, which distinguishes no modes
    root = np.sqrt(np.abs(every.poles))
    seen = np.max(np.abs(every.see) / root, axis=(1, 2), initial=0.0)
    driven = np.max(np.abs(every.push) / root[:, :, None], axis=(0, 1), initial=0.0)
    size = np.abs(two).max(axis=0, initial=0.0)
    size = np.where(size > ROUNDING * np.outer(seen, driven), size, np.inf)
    one, two = ((part / size).reshape(len(part), size.size) for part in (one, two))
    lengths = np.outer(np.linalg.norm(one, axis=1), np.linalg.norm(two, axis=1))
    alike = np.abs(one @ two.T) / divisor(lengths)
    apart = np.abs(np.log(kept.omega[genuine][:, None] / every.omega))
    partner = assigned(np.minimum(apart, 1.0) + _SHAPE * (1.0 - alike))
    near = (partner >= 0) & (apart[np.arange(partner.size), partner] < NEAR)
    return genuine[near], partner[near]


def _may_follow(plant: AnyPlant, ports: Ports) -> FloatArray:
    """Return the forces (m,) to which a static compliance may respond."""
    # a white disturbance has no value at an instant, and u must not reach y in the sample in which
    # it is computed from y
    late = {port.name: plant.delay + port.latency / plant.dt > 0 for port in ports.u}
    parts = [(port.name, port.filter) for port in ports.forces]
    return np.array(
        [late.get(name, False) or (f is not None and not np.any(f.D)) for name, f in parts]
    )


def _motion_covariance(blocks: _Blocks, chosen: IntArray, plant: AnyPlant) -> FloatArray:
    """Return the stationary covariance of the motions of some modes of a plant."""
    ports = plant.assembled.ports
    poles = blocks.poles[chosen].reshape(-1)
    if np.any(poles.real >= 0):
        raise ModelError(
            "a truncated mode has no damping: its motion under white noise has no variance. Give "
            "solve_modes(damping=...)."
        )
    omega = np.asarray(1j * np.repeat(blocks.omega[chosen], 2), dtype=np.complex128)
    drive = blocks.push[chosen].reshape(poles.size, -1)
    # the root of the two-sided density at each mode's frequency; of actuators their input noise
    levels = [
        plant.asd.get(port.name, plant.asd.get(f"{port.name}:disturbance", 0.0)) / np.sqrt(2.0)
        for port in ports.forces
    ]
    shaped = [np.abs(_siso_response(port.filter, omega)) for port in ports.forces]
    drive = drive * (np.array(levels)[:, None] * np.reshape(shaped, (-1, poles.size))).T
    see = blocks.see[:, chosen].reshape(-1, poles.size).copy()
    turn = np.where(poles.imag >= 0, omega, -omega)
    first = see.shape[0] - len(ports.y)
    for row, sensor in enumerate(ports.y, first):
        see[row] *= np.exp(-turn * sensor.latency) * _siso_response(sensor.filter, turn)
    X = -(drive @ drive.conj().T) / np.add.outer(poles, poles.conj())
    return np.asarray(np.real(see @ X @ see.conj().T))


def _siso_response(part: StateSpace | None, at: ComplexArray) -> ComplexArray:
    if part is None:
        return np.ones(at.size, dtype=np.complex128)
    return np.array([part.evaluated(s)[0, 0] for s in at])


def _with_flexibility(plant: AnyPlant, bare: StateSpace, flexibility: FloatArray) -> AnyPlant:
    """Return a plant with an additional static compliance (p, m), with the same sampling."""
    ports, realisation = plant.assembled.ports, plant.assembled.realisation
    physical = with_filters(bare.replace(D=bare.D + flexibility), realisation, ports)
    noisy = [port for port in ports.u if f"{port.name}:disturbance" in ports.input_noises]
    direct = [port for port in noisy if port.filter is None or np.any(port.filter.D)]
    if direct:  # white noise has no value at an instant that a compliance could follow
        columns = physical.input_index([f"{port.name}:disturbance" for port in direct])
        without = with_filters(bare, realisation, ports)
        B, D = np.array(physical.B), np.array(physical.D)
        B[:, columns], D[:, columns] = without.B[:, columns], without.D[:, columns]
        physical = physical.replace(B=B, D=D)
    fresh = wired(StandardPlant, Assembled(ports, realisation, physical), None)
    return sampled_like(plant.machine, loud_like(plant.machine, fresh))


def _quiet(fresh: StandardPlant, plant: StandardPlant, modes: IntArray) -> StandardPlant:
    """Return the new plant with the noise of the old one, except on some modes (from 0)."""
    # shapes that represent truncated modes have no noise, which the sensors already include
    factor = np.array(plant.noise_factor)
    factor[plant.modal_states.reshape(-1, 2)[modes].reshape(-1)] = 0.0
    return fresh.replace(origin=fresh.assembled.replace(noise_factor=factor))


def unsure_noise(found: LeftOut, plant: AnyPlant, machines: Any) -> list[LeftOut]:
    """Return noises for a filter that weighs modes by their uncertainty, one for each of `PARTS`.

    The stationary covariance of what the sensors and POIs of a machine show beyond the model of
    the filter, both driven by the same disturbances, replaces that of the truncated modes:
    the mean over the machines, of which the covariance on the evaluation model is a part.
    """
    if machines.missing:
        raise AssumptionError(f"no filter weighs modes by their uncertainty: {machines.missing}.")
    model = _driven_modes(found.plant)
    alone = _difference(_driven_modes(found.whole), model)
    mean = np.mean([_difference(_driven_modes(one), model) for one in machines.plants], axis=0)
    nz = len(poi_channels(plant))
    noises = []
    for part in PARTS:
        S = part * (mean - alone)
        noises.append(
            found.replace(
                pois=found.pois + S[:nz, :nz],
                sensors=found.sensors + S[nz:, nz:],
                cross=found.cross + S[:nz, nz:],
            )
        )
    return noises


def _driven_modes(plant: AnyPlant) -> tuple[ComplexArray, ComplexArray, ComplexArray]:
    """Return elastic poles (m,), what white noise drives (m, w) and what is seen (nz + ny, m)."""
    before: Any = plant.machine.continuous
    g = before.system
    noisy = [name for name in before.w if before.asd.get(name, 0.0) > 0.0 and ":noise" not in name]
    rigid = np.asarray(before.modal_states).reshape(-1, 2)[: before.n_rigid].reshape(-1)
    rest = np.setdiff1d(np.arange(g.n_states), rigid)
    size = np.array([before.asd[name] for name in noisy]) / np.sqrt(2.0)
    poles, T = np.linalg.eig(g.A[np.ix_(rest, rest)])
    driven = np.linalg.solve(T, g.B[np.ix_(rest, g.input_index(noisy))] * size)
    rows = g.output_index([*poi_channels(plant), *sensors(plant)])
    return poles, driven, np.asarray(g.C[np.ix_(rows, rest)] @ T)


def _difference(one: Any, other: Any) -> FloatArray:
    """Return the covariance (n, n) of the difference of two motions under the same noise."""
    poles, driven = np.concatenate([one[0], other[0]]), np.vstack([one[1], other[1]])
    seen = np.hstack([one[2], -other[2]])
    X = -(driven @ driven.conj().T) / (poles[:, None] + poles.conj())
    return np.asarray((seen @ X @ seen.conj().T).real)


#: z channels that are not motions of a POI
DERIVED = (":error", ":effort")


def checked_plant(given: AnyPlant | System) -> AnyPlant:
    """Return a StandardPlant that has something to estimate and to measure."""
    plant = plant_of(given)
    if isinstance(plant, GeneralizedPlant) and plant.scaled:
        plant = standard_plant(plant)  # refuses weights: an estimator is of physical channels
    plain = plant.machine
    mixed = [plain.y.index(name) for name in plain.y if name in plain.w]
    rows = [plant.y.index(name) for name in sensors(plant)]
    if np.any(plant.reading_gain[np.ix_(rows, mixed)]):
        raise ModelError(
            "the block that the plant is read through mixes references with sensors: a reference "
            "would look like a motion. Estimate from the sensors, on plant.unweighted."
        )
    for side, names in (("POI in z", poi_channels(plant)), ("sensor in y", sensors(plant))):
        if not names:
            raise AssumptionError(f"the plant has no {side}, which an estimator needs.")
    return plant


def sensors(plant: AnyPlant) -> tuple[str, ...]:
    """Return the names in y that are measurements; references are in w as well."""
    return tuple(name for name in plant.y if name not in plant.w)


def poi_channels(plant: AnyPlant) -> tuple[str, ...]:
    """Return the names in z that are motions of POIs."""
    return tuple(name for name in plant.z if not name.endswith(DERIVED))


def same_pois(plant: AnyPlant, on: AnyPlant | System) -> AnyPlant:
    """Return another plant that has the sensors, POIs and sampling time of the first."""
    other: AnyPlant = plant.around(plant_of(on).machine)
    if not np.isclose(other.dt, plant.dt, rtol=SAME, atol=0.0):
        raise ModelError(
            "the error of an estimator needs a plant of its sampling time, "
            f"{plant.dt:g} s, got {other.dt:g} s. Sample both at one rate."
        )
    for side, names in (("z", poi_channels(plant)), ("y", sensors(plant))):
        for name in names:
            if name not in getattr(other, side):
                raise unknown_label(f"channel of {side} of the other plant", name, names)
    if poi_channels(other) != poi_channels(plant):
        raise ModelError(
            f"the other plant has the POIs {', '.join(poi_channels(other))}, the filter's has "
            f"{', '.join(poi_channels(plant))}. Assemble both with the same ports."
        )
    return other

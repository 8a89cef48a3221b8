"""Truncated modes of a filter's model: noise on sensors and POIs, and static compliance.

Also a check of how well the mesh of the evaluation model resolves them.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from ..arrays import ComplexArray, FloatArray, IntArray, divisor
from ..errors import ModelError, counted
from ..lti.modal_map import ModalMap
from ..lti.statespace import StateSpace
from ..modes.matching import NEAR, assigned
from ..plant import AnyPlant, StandardPlant
from ..plant.building import loud_like, sampled_like, structure_system, wired, with_filters
from ..plant.evaluation_model import NOT_JUDGED
from ..plant.origins import Assembled
from ..plant.ports import Ports
from ..plant.realisation import ModalRealisation
from ..reduction import ReducedModel
from ..reduction.reduced import STATIC
from ..store import Value
from ..tolerances import ROUNDING
from .estimator_channels import sensors

#: weight of a different shape relative to a different frequency when modes are paired
_SHAPE = 0.02


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

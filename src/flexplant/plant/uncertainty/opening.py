"""Channels for Deltas: a plant whose modes, shapes, gains or parameters are uncertain."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np
import scipy.linalg as la

from ...checks import FloatArray, members, positive
from ...errors import ModelError
from ...identification import MeasuredModes
from ...labels import Place
from ...lti.statespace import StateSpace
from ...sparse.symmetric import dense
from ...tolerances import ROUNDING, SAME, TINY
from ...updating import ModalUncertainty, UpdateResult
from ...updating.matrix_parameters import MatrixParameter
from ...updating.parameters import Parameter
from ..building import P, continuous_plant, rebuilt
from ..partition import Partition
from ..port import QUANTITIES, ForcePort, Quantity, SensorPort
from ..realisation import ModalRealisation
from .deltas import (
    Known,
    about_fit,
    calibration_of,
    check_range,
    checked_fit,
    correlated_deltas,
    pole_deltas,
    port_deltas,
    shape_deltas,
    stated_amounts,
    stated_deltas,
)
from .neglected import NeglectedModes, neglected_modes, with_neglected
from .uncertain_plant import (
    Delta,
    UncertainPlant,
    elastic_part,
    modal_realisation,
    reshaped,
    with_changes,
)

#: relative: a dependence of what a mode's stiffness or damping changes, and of what its shape
#: changes, below which it is rounding
_AFFINE, _LEAST = 1e-8, 1e-9
#: relative change at which the plant's dependence on a Delta is read off
_READ_OFF = 0.25
#: values of the Deltas at which the channels are compared with a plant assembled anew
_PROBE = 0.5


def uncertain(
    plant: P,
    source: UpdateResult | ModalUncertainty | MeasuredModes | None = None,
    parameters: Sequence[Parameter] | None = None,
    *,
    frequency: Any = None,
    damping: Any = None,
    gain: Any = None,
    delay: float | None = None,
    modes: Sequence[int] | None = None,
    deviations: float = 2.0,
    neglected: Any = None,
    shapes: Any = None,
) -> UncertainPlant[P]:
    """Return a plant with channels for Deltas; see `StandardPlant.uncertain`."""
    many = positive(deviations, "deviations")
    by_mode = frequency is not None or damping is not None
    alone = source is None and shapes is None
    beside = port_deltas(plant, gain, delay)
    if by_mode or isinstance(parameters, Mapping):
        if not alone or not (parameters is None or isinstance(parameters, Mapping)):
            raise ModelError(
                "frequency=, damping= and parameters={parameter: amount} state an uncertainty by "
                "hand; a fit or measured modes bring their own. Pass one or the other; gain= and "
                "delay= go beside both."
            )
        if by_mode or modes is not None:
            beside = stated_deltas(modal_realisation(plant), frequency, damping, modes) + beside
        if parameters is not None:
            known, amounts = stated_amounts(plant, parameters)
            return _by_parameters(plant, known, amounts, many, neglected, beside=beside)
    if beside and alone and parameters is None:
        return _by_modes(plant, Known(beside, np.eye(len(beside)) / many**2), many, neglected)
    if shapes is not None and not isinstance(source, MeasuredModes):
        raise ModelError(
            "deviations of shapes go with measured modes; those of a fit follow from its "
            "parameters, in sample. Leave shapes= out."
        )
    fitted = source if isinstance(source, UpdateResult) else None
    about: Sequence[Parameter] = ()
    if fitted is not None:
        about = fitted.unknowns if parameters is None else parameters
        about = members(about, Parameter, "parameters", "Pass those of the fit.", least=0)
    if fitted is not None and not plant.is_weighted and plant.form.startswith("dense"):
        covariance = checked_fit(fitted, about)
        if modes is not None:
            raise ModelError(
                f"the modes of this plant are coupled by damping ({plant.form}): its Deltas are "
                "the parameters of the fit, which act on all modes. Leave modes out."
            )
        put_in = calibration_of(plant)
        _check_model(plant, fitted.model if put_in is None else fitted.calibrated(put_in))
        return _by_parameters(
            plant, about_fit(fitted, about), covariance, many, neglected, fitted, beside
        )
    realisation = modal_realisation(plant)
    put_in = calibration_of(plant)
    if fitted is not None and (
        put_in is not None or (fitted.discrepancy and fitted.fitted_poles is not None)
    ):
        source, fitted = fitted.uncertainty(put_in), None
    more: Sequence[Delta] = ()
    if isinstance(source, ModalUncertainty):
        found = correlated_deltas(realisation, source, modes, many)
    else:
        found = pole_deltas(realisation, source, about, modes, many)
        if shapes is not None and isinstance(source, MeasuredModes):
            more = shape_deltas(plant, shapes, source.modes or (), found.modes, many)
    own = la.block_diag(found.covariance, np.eye(len(beside)) / many**2)
    found = Known((*found.deltas, *beside), own)
    whole = _by_modes(plant, found, many, neglected, more)
    return (
        whole if fitted is None else whole.replace(fit=fitted, parameters=about_fit(fitted, about))
    )


def _by_modes(
    plant: P, known: Known, deviations: float, neglected: Any, shapes: Sequence[Delta] = ()
) -> UncertainPlant[P]:
    """Return a plant with channels for Deltas of modes, of shapes and of neglected modes."""
    deltas, covariance = known.deltas, known.covariance
    check_range(deltas, deviations)
    own = [delta for delta in deltas if delta.mode]
    gains = [delta for delta in deltas if delta.kind == "gain"]
    base = plant.continuous
    matrix, system = system_matrix(base.system), base.system
    if own:
        found = {delta: _mode_channels(base, delta, matrix) for delta in own}
        system = _opened(base, system, found)
        do = "Give the sensor a `row` and a quantity."
        _require_exact(base, system, own, "the modes", do)
    if shapes:
        found = {delta: _shape_channels(base, delta, matrix) for delta in shapes}
        system = _opened(base, system, found)
        own += shapes
        _require_exact(base, system, own, "the shapes of modes", "Leave shapes= out.")
        covariance = la.block_diag(covariance, np.eye(len(shapes)) / deviations**2)
    if gains:  # last: they scale what all others do
        system, _ = with_gain_channels(base, system, gains)
        _require_exact(base, system, [*own, *gains], "the gains", "Leave gain= out.")
    return _with_bound(plant, system, neglected, (*deltas, *shapes), covariance, deviations)


def _by_parameters(
    plant: P,
    parameters: tuple[Parameter, ...],
    covariance: FloatArray,
    deviations: float,
    neglected: Any,
    fit: UpdateResult | None = None,
    beside: tuple[Delta, ...] = (),
) -> UncertainPlant[P]:
    """Return a plant with Deltas on parameters, stated or of a fit, and others beside them."""
    check_range(beside, deviations)
    std = np.sqrt(np.diag(covariance))
    modes = tuple(delta for delta in beside if delta.mode)
    scale = np.array([*(std if fit is None else deviations * std), *(d.scale for d in modes)])
    every = (*parameters, *(_as_parameter(plant, delta) for delta in modes))
    base = plant.continuous
    system, deltas = _parameter_channels(base, every, scale)
    if gains := [delta for delta in beside if delta.kind == "gain"]:
        alone, _ = with_gain_channels(base, base.system, gains)
        _require_exact(base, alone, gains, "the gains", "Leave gain= out.")
        system, _ = with_gain_channels(base, system, gains)
    own = la.block_diag(covariance / np.outer(std, std), np.eye(len(beside))) / deviations**2
    deltas = (*deltas[: len(parameters)], *modes, *(one for one in beside if not one.mode))
    whole = _with_bound(plant, system, neglected, deltas, own, deviations)
    return whole.replace(fit=fit, parameters=every)


def _with_bound(
    plant: P,
    system: StateSpace,
    neglected: Any,
    deltas: tuple[Delta, ...],
    covariance: FloatArray,
    deviations: float,
) -> UncertainPlant[P]:
    """Return an uncertain plant, the modes that it lacks bounded by a model that has them."""
    if neglected is not None and not isinstance(neglected, NeglectedModes):
        neglected = neglected_modes(plant, neglected)
    if neglected is not None:
        count = len(system.inputs) - len(plant.system.inputs)
        system = with_neglected(system, neglected, count)
    return UncertainPlant(plant, system, deltas, covariance, deviations, neglected)


def _as_parameter(plant: Partition, delta: Delta) -> MatrixParameter:
    """Return a Delta on a mode as a change of K, omega^2 (M phi)(M phi)', or of D."""
    realisation = plant.assembled.realisation
    push = np.asarray(plant.model.M @ realisation.inputs[:, 2 * delta.mode - 1])
    pair = realisation.pairs[delta.mode - 1]
    if delta.kind == "freq":
        return MatrixParameter(delta.name, dK=float(np.linalg.det(pair)) * np.outer(push, push))
    return MatrixParameter(delta.name, dD=-float(np.trace(pair)) * np.outer(push, push))


def _check_model(plant: Partition, other: Any) -> None:
    """Refuse a fit of another model than the plant's."""
    for name in "MDK":
        own, others = getattr(plant.model, name, None), getattr(other, name)
        if own is None or own.shape != others.shape or not np.allclose(
            dense(own), dense(others), rtol=SAME, atol=0.0
        ):  # fmt: skip
            raise ModelError(
                f"the plant has another {name} than the fit's model. Assemble it from fit.model."
            )


class _Channel(NamedTuple):
    """A channel of a Delta: what it moves (n + p,), and what it reads of states and inputs.

    By `rate`, of the states' rates (n,) instead, with what all Deltas make of them.
    """

    left: FloatArray
    right: FloatArray
    name: str = ""
    rate: FloatArray | None = None


def _opened(
    plant: Partition, system: StateSpace, found: Mapping[Delta, Sequence[_Channel]]
) -> StateSpace:
    """Return a plant's system with the channels of Deltas after those that it has already."""
    # first those of all Deltas, then their further ones
    n, m = plant.system.n_states, len(plant.system.inputs)
    before = len(system.inputs) - m
    rates = np.hstack([system.A, system.B])
    every = [(delta, own[0]) for delta, own in found.items()]
    every += [(delta, one) for delta, own in found.items() for one in own[1:]]
    root = [np.sqrt(delta.scale) for delta, _ in every]
    left = np.array([size * one.left for size, (_, one) in zip(root, every, strict=True)]).T
    right, feed = np.zeros((len(every), n + before + m)), np.zeros((len(every), len(every)))
    for i, (size, (_, one)) in enumerate(zip(root, every, strict=True)):
        if one.rate is None:
            right[i] = size * np.insert(one.right, [n] * before, 0.0)
        else:
            right[i], feed[i] = size * one.rate @ rates, size * one.rate @ left[:n]
    return with_channels(
        system, before, [f"{delta.name}{one.name}" for delta, one in every], left, right, feed
    )


def _mode_channels(plant: Partition, delta: Delta, base: FloatArray) -> list[_Channel]:
    """Return the channel of a mode's stiffness or damping, two where accelerations need it."""
    # a mode's A is affine in its Deltas, `A0 + sum_j delta_j l_j R_j`, and so are displacements and
    # velocities. An acceleration `S A (A x + N' f)` holds products of them where the damping of a
    # mode is not proportional. With the rate `x'` of the states, which a first copy of the Deltas
    # drives, it is `S A0 x' + sum_j (S l_j) delta_j R_j x'`: a second copy of each Delta that reads
    # `R_j x'` makes it exact. The columns are read off the plant assembled with one mode changed,
    # so that they hold for any port
    n = plant.system.n_states
    changed = system_matrix(with_changes(plant, [(delta, _READ_OFF)]).system)
    change = (changed - base) / _READ_OFF
    # of a mode's block the second row changes
    R = change[int(plant.modal_states[2 * delta.mode - 1])]
    R = R / np.linalg.norm(R)
    rate = R[:n] @ changed[:n]
    rate_size = float(np.linalg.norm(rate))
    seen = np.linalg.lstsq(np.array([R, rate / rate_size]).T, change.T, rcond=None)[0]
    plain = np.abs(seen[1]) <= _AFFINE * np.linalg.norm(change, axis=1)
    left = np.where(plain, change @ R, seen[0])
    again = np.where(plain, 0.0, seen[1] / rate_size)
    even = np.sqrt(max(float(np.abs(left[:n]).max()), TINY))
    first = _Channel(left / even, even * R)
    if not np.any(again):
        return [first]
    return [first, _Channel(again / even, even * R, ":rate", even * R[:n])]


def _shape_channels(plant: Partition, delta: Delta, base: FloatArray) -> list[_Channel]:
    """Return the channels of the shape of a mode."""
    # `phi + d v` drives the mode by `d v^T f` more and shows `d v q`, `d v q'` or `d v q''` of its
    # motion more: four channels at most, of which q'' feels what the first one drives. Their
    # columns are read off the plant assembled with forces or motions changed alone, so that they
    # hold for any port and filter
    q, v = (int(plant.modal_states[2 * delta.mode - i]) for i in (2, 1))
    realisation = modal_realisation(plant)
    driven, seen = (
        system_matrix(rebuilt(plant, realisation=one).system) - base
        for one in (
            reshaped(realisation, delta, 1.0, outputs=False),
            reshaped(realisation, delta, 1.0, inputs=False),
        )
    )
    row = driven[v]
    parts = [(driven @ row / (row @ row), row, None)] if np.any(row) else []
    # displacements and velocities read the states, accelerations what else their rate holds
    size, rest, beyond = np.linalg.norm(seen, axis=1), seen.copy(), base[v].copy()
    rest[:, [q, v]], beyond[[q, v]] = 0.0, 0.0
    amount = rest @ beyond / max(float(beyond @ beyond), TINY)
    amount[np.linalg.norm(rest, axis=1) <= _LEAST * size] = 0.0
    plain = seen - np.outer(amount, base[v])
    motion, speed = (np.eye(base.shape[1])[i] for i in (q, v))
    for column, right, rate in (
        (plain[:, q], motion, None),
        (plain[:, v], speed, None),
        (amount, base[v], np.eye(plant.system.n_states)[v]),
    ):
        small = np.abs(column) * np.linalg.norm(right) <= _LEAST * size
        parts += [] if np.all(small) else [(np.where(small, 0.0, column), right, rate)]
    if not parts:
        raise ModelError(f"{delta.name} moves no port of the plant: leave that mode out.")
    found = []
    for i, (left, right, rate) in enumerate(parts, 1):
        even = np.sqrt(np.linalg.norm(left) / np.linalg.norm(right))
        name = f":{i}" if i > 1 else ""
        found.append(
            _Channel(left / even, even * right, name, None if rate is None else even * rate)
        )
    return found


def system_matrix(g: StateSpace) -> FloatArray:
    """Return ``[A B; C D]``."""
    return np.block([[g.A, g.B], [g.C, g.D]])


def with_channels(
    g: StateSpace,
    before: int,
    names: Sequence[str],
    left: FloatArray,
    right: FloatArray,
    feed: FloatArray | None = None,
) -> StateSpace:
    """Return a system with channels `name:w` and `name:z` after its first inputs and outputs."""
    # left (n + p, k): what w adds to states and later outputs; right (k, n + m): what z reads of
    # states and all inputs; feed (k, k): from w to z, zero when not given
    n, k = g.n_states, len(names)
    feed = np.zeros((k, k)) if feed is None else feed
    D = np.block([
        [g.D[:before, :before], np.zeros((before, k)), g.D[:before, before:]],
        [right[:, n : n + before], feed, right[:, n + before :]],
        [g.D[before:, :before], left[n:], g.D[before:, before:]],
    ])  # fmt: skip
    return StateSpace(
        g.A,
        np.hstack([g.B[:, :before], left[:n], g.B[:, before:]]),
        np.vstack([g.C[:before], right[:, :n], g.C[before:]]),
        D,
        g.dt,
        inputs=[*g.inputs[:before], *(f"{name}:w" for name in names), *g.inputs[before:]],
        outputs=[*g.outputs[:before], *(f"{name}:z" for name in names), *g.outputs[before:]],
        states=g.states,
        name=g.name,
        blocks=g.blocks,
    )


def with_gain_channels(
    plant: Partition, system: StateSpace, deltas: Sequence[Delta]
) -> tuple[StateSpace, list[tuple[str, int]]]:
    """Return a system with a first channel for each Delta on a gain, and their names, in order."""
    # `(1 + d) u` acts by d times the command's column more, all but its own effort, and so does
    # noise at the amplifier's input; `(1 + d) y` adds d times what the sensor shows of the motion,
    # with what the actuators' Deltas do
    order = sorted(deltas, key=lambda one: one.name.removesuffix(":gain") in plant.y)
    for delta in order:
        name = delta.name.removesuffix(":gain")
        n, (k, m) = system.n_states, (len(system.outputs), len(system.inputs))
        left, right = np.zeros((n + k, 1)), np.zeros((1, n + m))
        if name in plant.u:
            column = system.inputs.index(name)
            left[:, 0] = np.concatenate([system.B[:, column], system.D[:, column]])
            left[n + system.outputs.index(f"{name}:effort")] = 0.0
            right[0, n + column] = delta.scale
            if f"{name}:disturbance" in system.inputs:  # at the amplifier's input: scaled as well
                noise = system.inputs.index(f"{name}:disturbance")
                its = np.concatenate([system.B[:, noise], system.D[:, noise]])
                share = float(left[:, 0] @ its) / float(left[:, 0] @ left[:, 0])
                right[0, n + noise] = delta.scale * share
        else:
            row = system.outputs.index(name)
            left[n + row] = 1.0
            right[0] = delta.scale * np.concatenate([system.C[row], system.D[row]])
            if f"{name}:noise" in system.inputs:
                right[0, n + system.inputs.index(f"{name}:noise")] = 0.0
        system = with_channels(system, 0, [delta.name], left, right)  # first: all others see it
    return system, [(delta.name, 1) for delta in reversed(order)]


def _require_exact(
    plant: Partition, system: StateSpace, deltas: Sequence[Delta], what: str, do: str
) -> None:
    """Raise ModelError unless the channels give the plant with all modes changed at once."""
    values = {d.name: _PROBE * (1.0 if j % 2 else -0.5) for j, d in enumerate(deltas)}
    changes = [(delta, values[delta.name] * delta.scale) for delta in deltas]
    wanted = system_matrix(with_changes(plant, changes).system)
    base, whole = system_matrix(plant.system), system_matrix(system)
    n, count = system.n_states, len(system.inputs) - len(plant.system.inputs)
    owner = [name.removesuffix(":w") for name in system.inputs[:count]]
    amounts = np.diag([
        next(v for name, v in values.items() if f"{one}:".startswith(f"{name}:")) for one in owner
    ])  # fmt: skip
    inner = np.arange(n, n + count)
    outer, columns = (np.delete(np.arange(size), inner) for size in whole.shape)
    closed = np.linalg.solve(
        np.eye(count) - whole[np.ix_(inner, inner)] @ amounts, whole[np.ix_(inner, columns)]
    )
    made = whole[np.ix_(outer, columns)] + whole[np.ix_(outer, inner)] @ amounts @ closed
    # of the change six digits, where rounding of the whole leaves them
    allowed = 1e-6 * np.abs(wanted - base).max(axis=1) + ROUNDING * np.abs(wanted).max(axis=1)
    bad = np.flatnonzero(np.abs(made - wanted).max(axis=1) > allowed)
    if bad.size:
        name = (*plant.system.states, *plant.system.outputs)[int(bad[0])]
        raise ModelError(
            f"{name!r} does not depend on {what} as displacements, velocities and accelerations "
            f"do, so that no Deltas express it. {do}"
        )


@dataclass(frozen=True, eq=False)
class _Load(ForcePort):
    """A force along a vector over the model's DOFs."""

    name: str
    along: FloatArray

    def push(self, realisation: ModalRealisation) -> FloatArray:
        """Return the vector."""
        return self.along


@dataclass(frozen=True, eq=False)
class _Felt(SensorPort):
    """A motion along a vector over the model's DOFs; accelerations are absolute, as inertia is."""

    name: str
    along: FloatArray
    at: Place = ""
    quantity: Quantity = "displacement"

    def row(self, realisation: ModalRealisation) -> FloatArray:
        """Return the vector."""
        return self.along


def _parameter_channels(
    plant: Partition, parameters: Sequence[Parameter], scales: FloatArray
) -> tuple[StateSpace, tuple[Delta, ...]]:
    """Return the continuous plant with channels for Deltas on the parameters, and these."""
    # `(M + sum d_i dM_i) q'' + (D + sum d_i dD_i) q' + (K + sum d_i dK_i) q = f`: with `dM_i = U s
    # U'` the change is the force `-U s d_i U' q''`, a feedback around the (absolute) acceleration,
    # and so for velocities and displacements. Each Delta has as many channels as its matrices have
    # rank. Exact for any port and any damping
    realisation, ports = plant.assembled.realisation, plant.assembled.ports
    model: Any = realisation.model  # one with M, D and K: `uncertain` has checked it
    deltas: list[Delta] = []
    loads: list[_Load] = []
    felt: list[_Felt] = []
    for parameter, scale in zip(parameters, scales.tolist(), strict=True):
        deltas.append(Delta(parameter.name, 0, "parameter", scale))
        for order, part in zip((2, 1, 0), parameter.matrices(model), strict=True):
            if part is None:
                continue
            whole = dense(part)
            if order == 1:
                whole = elastic_part(model, realisation, whole)
            values, vectors = np.linalg.eigh(0.5 * (whole + whole.T))
            for i in np.flatnonzero(np.abs(values) > ROUNDING * np.abs(values).max()).tolist():
                name = f"{parameter.name}:{len(loads) + 1}"
                size = np.sqrt(scale * abs(values[i]))
                loads.append(_Load(f"{name}:w", -np.sign(values[i]) * size * vectors[:, i]))
                felt.append(_Felt(f"{name}:z", size * vectors[:, i], quantity=QUANTITIES[order]))
    wider = ports.replace(w=[*loads, *ports.w], y=[*ports.y, *felt])
    system = continuous_plant(type(plant), realisation, wider, None).system
    return (
        system.select(
            [*(port.name for port in felt), *plant.z, *plant.y],
            [*(port.name for port in loads), *plant.w, *plant.u],
        ),
        tuple(deltas),
    )

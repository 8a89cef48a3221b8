"""Channels for Deltas: a plant whose modes are uncertain by a fit's covariance."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any, Literal, NamedTuple

import numpy as np
import scipy.linalg as la
import scipy.sparse as sp

from ...checks import ComplexArray, FloatArray, instance, members, positive, several
from ...errors import LabelError, ModelError, require_known, unknown_label
from ...identification import MeasuredModes
from ...labels import Place
from ...lti.statespace import StateSpace
from ...tolerances import SAME, TINY
from ...updating import ModalUncertainty, UpdateResult, eigenvalue_sensitivities
from ...updating.matrix_parameters import MatrixParameter
from ...updating.parameters import Parameter
from ..building import P, continuous_plant
from ..partition import Partition
from ..port import QUANTITIES, ForcePort, Quantity, SensorPort
from ..realisation import ModalRealisation
from .delta_channels import require_exact, system_matrix, with_channels, with_gain_channels
from .mode_deltas import KNOWN, SAME_MODEL, check_poles, correlated_deltas, stated
from .neglected import NeglectedModes, neglected_modes, with_neglected
from .shape_channels import shape_deltas, with_shape_channels
from .uncertain_plant import (
    Delta,
    UncertainPlant,
    elastic_part,
    modal_realisation,
    with_changes,
)

#: relative: a dependence on the rates of the states below this is rounding
_AFFINE = 1e-8
#: relative change at which the plant's dependence on a Delta is read off
_PROBE = 0.25
#: relative distance of measured poles from the plant's: they were typed, of that machine
_TYPED_POLES = 0.1


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
    beside = _of_ports(plant, gain, delay)
    if by_mode or isinstance(parameters, Mapping):
        if not alone or not (parameters is None or isinstance(parameters, Mapping)):
            raise ModelError(
                "frequency=, damping= and parameters={parameter: amount} state an uncertainty by "
                "hand; a fit or measured modes bring their own. Pass one or the other; gain= and "
                "delay= go beside both."
            )
        if by_mode or modes is not None:
            beside = stated(modal_realisation(plant), frequency, damping, modes) + beside
        if parameters is not None:
            known, amounts = _amounts(plant, parameters)
            return _by_parameters(plant, known, amounts, many, neglected, beside=beside)
    if beside and alone and parameters is None:
        return _with_deltas(plant, beside, np.eye(len(beside)) / many**2, many, neglected)
    if shapes is not None and not isinstance(source, MeasuredModes):
        raise ModelError(
            "deviations of shapes go with measured modes; those of a fit follow from its "
            "parameters, in sample. Leave shapes= out."
        )
    if (
        isinstance(source, UpdateResult)
        and not plant.is_weighted
        and plant.form.startswith("dense")
    ):
        unknowns = tuple(source.unknowns if parameters is None else parameters)
        covariance = _checked_fit(source, unknowns)
        if modes is not None:
            raise ModelError(
                f"the modes of this plant are coupled by damping ({plant.form}): its Deltas are "
                "the parameters of the fit, which act on all modes. Leave modes out."
            )
        _check_model(plant, source.model)
        about = about_fit(source, unknowns)
        return _by_parameters(plant, about, covariance, many, neglected, source, beside)
    realisation = modal_realisation(plant)
    if isinstance(source, UpdateResult) and source.discrepancy and source.fitted_poles is not None:
        source = source.uncertainty()
    more: Sequence[Delta] = ()
    if isinstance(source, ModalUncertainty):
        deltas, own = correlated_deltas(realisation, source, modes, many)
    else:
        deltas, own, numbers = _of_poles(realisation, source, parameters, modes, many)
        if shapes is not None and isinstance(source, MeasuredModes):
            more = shape_deltas(plant, shapes, source.modes or (), numbers, many)
    own = la.block_diag(own, np.eye(len(beside)) / many**2)
    fit = source if isinstance(source, UpdateResult) else None
    about = about_fit(fit, fit.unknowns if parameters is None else parameters) if fit else ()
    return _with_deltas(plant, (*deltas, *beside), own, many, neglected, more, fit, about)


def _of_poles(
    realisation: ModalRealisation,
    source: Any,
    parameters: Sequence[Parameter] | None,
    modes: Sequence[int] | None,
    deviations: float,
) -> tuple[tuple[Delta, ...], FloatArray, Sequence[int]]:
    """Return Deltas of the poles of a fit or a measurement, their covariance, and the modes."""
    if isinstance(source, UpdateResult):
        parameters = source.unknowns if parameters is None else parameters
        numbers, poles, covariance = _fitted_poles(realisation, source, parameters, modes)
        check_poles(realisation, numbers, poles, SAME_MODEL, "fit")
    elif isinstance(source, MeasuredModes):
        numbers, poles, covariance = _measured_poles(source, modes)
        check_poles(realisation, numbers, poles, _TYPED_POLES, "measurement")
    else:
        raise ModelError(
            "uncertainty comes from an UpdateResult or MeasuredModes, got "
            f"{type(source).__name__}: pass one, fit.uncertainty(measured), or state it: "
            "frequency=0.005, damping=0.3."
        )
    G = _log_derivatives(poles)
    covariance = G @ covariance @ G.T
    scale = deviations * np.sqrt(np.diag(covariance))
    kinds: tuple[Literal["freq", "damping"], ...] = ("freq", "damping")
    named = [(kind, number) for kind in kinds for number in numbers]
    every = [
        Delta(f"mode{number}:{kind}", number, kind, float(size))
        for (kind, number), size in zip(named, scale, strict=True)
    ]
    keep = sorted(np.flatnonzero(scale > KNOWN), key=lambda i: (every[i].mode, i))
    if not keep:
        raise ModelError(f"modes {list(numbers)} have no variance: there is nothing uncertain.")
    own = covariance[np.ix_(keep, keep)] / np.outer(scale[keep], scale[keep])
    return tuple(every[i] for i in keep), own, numbers


def _of_ports(plant: Partition, gain: Any, delay: float | None) -> tuple[Delta, ...]:
    """Return Deltas of stated gains of actuators and sensors, and of the delay."""
    found: list[Delta] = []
    if gain is not None:
        ports = plant.assembled.ports
        names = [*(port.name for port in ports.u), *(port.name for port in ports.y)]
        if isinstance(gain, Mapping):
            require_known("actuator or sensor", list(gain), names)
        else:
            gain = dict.fromkeys(names, gain)
        sizes = {name: positive(size, f"gain of {name!r}") for name, size in gain.items()}
        found += [Delta(f"{name}:gain", 0, "gain", size) for name, size in sizes.items()]
    if delay is not None:
        late = positive(delay, "delay")
        if not plant.dt or late > plant.delay:
            raise ModelError(
                f"the delay is uncertain by {late:g} samples, and the plant has "
                f"{plant.delay:g}: it is that of a sampled plant, and cannot become negative. "
                "Pass plant.discretized(rate, delay=...) with the delay in the middle."
            )
        found.append(Delta("delay", 0, "delay", late))
    return tuple(found)


def _amounts(
    plant: Partition, stated: Mapping[Parameter, Any]
) -> tuple[tuple[Parameter, ...], FloatArray]:
    """Return parameters and the covariance at which their amounts are one deviation each."""
    if not stated:
        raise ModelError("parameters= is empty: name at least one, {AddedMass('41:z'): 0.025}.")
    for parameter in stated:
        given: Any = parameter
        instance(given, Parameter, "a key of parameters", "Such as AddedMass('41:z').")
    if not hasattr(plant.model, "rigid_body") or not hasattr(plant.model, "replace"):
        raise ModelError(
            "parameters change the matrices of a model, and this plant was not assembled from "
            "one: assemble it from a ReducedModel or an FEModel."
        )
    sizes = [positive(size, f"amount of {p.name}") for p, size in stated.items()]
    return tuple(stated), np.diag(np.square(sizes))


def _with_deltas(
    plant: P,
    deltas: tuple[Delta, ...],
    covariance: FloatArray,
    deviations: float,
    neglected: Any,
    shapes: Sequence[Delta] = (),
    fit: UpdateResult | None = None,
    parameters: tuple[Parameter, ...] = (),
) -> UncertainPlant[P]:
    """Return a plant with channels for Deltas of modes, of shapes and of neglected modes."""
    _check_range(deltas, deviations)
    own = [delta for delta in deltas if delta.mode]
    system = _opened(plant.continuous, own) if own else plant.continuous.system
    gains = [delta for delta in deltas if delta.kind == "gain"]
    if gains:
        system, _ = with_gain_channels(plant.continuous, system, gains)
        require_exact(plant.continuous, system, [*own, *gains], "the gains", "Leave gain= out.")
    if shapes:
        system = with_shape_channels(plant.continuous, system, deltas, shapes)
        covariance = la.block_diag(covariance, np.eye(len(shapes)) / deviations**2)
    weight = None
    if neglected is not None:
        known = isinstance(neglected, NeglectedModes)
        weight = neglected if known else neglected_modes(plant, neglected)
        system = with_neglected(system, weight, len(system.inputs) - len(plant.w) - len(plant.u))
    return UncertainPlant(
        plant, system, (*deltas, *shapes), covariance, deviations, weight, fit, parameters
    )


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
    _check_range(beside, deviations)
    std = np.sqrt(np.diag(covariance))
    modes = tuple(delta for delta in beside if delta.mode)
    scale = np.array([*(std if fit is None else deviations * std), *(d.scale for d in modes)])
    every = (*parameters, *(_as_parameter(plant, delta) for delta in modes))
    system, deltas = by_parameters(plant.continuous, every, scale)
    if gains := [delta for delta in beside if delta.kind == "gain"]:
        base = plant.continuous
        alone, _ = with_gain_channels(base, base.system, gains)
        require_exact(base, alone, gains, "the gains", "Leave gain= out.")
        system, _ = with_gain_channels(base, system, gains)
    weight = None
    if neglected is not None:
        weight = neglected_modes(plant, neglected)
        system = with_neglected(system, weight, len(system.inputs) - len(plant.w) - len(plant.u))
    own = la.block_diag(covariance / np.outer(std, std), np.eye(len(beside))) / deviations**2
    deltas = (*deltas[: len(parameters)], *modes, *(one for one in beside if not one.mode))
    return UncertainPlant(plant, system, deltas, own, deviations, weight, fit, every)


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
            _to_dense(own), _to_dense(others), rtol=SAME, atol=0.0
        ):  # fmt: skip
            raise ModelError(
                f"the plant has another {name} than the fit's model. Assemble it from fit.model."
            )


def _checked_fit(fit: UpdateResult, parameters: Sequence[Parameter]) -> FloatArray:
    """Return the covariance of a fit whose parameters are given."""
    names = tuple(parameter.name for parameter in parameters)
    if names != tuple(fit.parameters):
        raise LabelError(
            f"the fit is of {list(fit.parameters)}, got the parameters {list(names)}: pass those "
            "given to update, in the same order: plant.uncertain(fit, parameters)."
        )
    if fit.covariance is None:
        raise ModelError(
            "the fit has no covariance: as many numbers were measured as were fitted. Measure "
            "another mode, or give MeasuredModes(covariance=...)."
        )
    return fit.covariance


def about_fit(fit: UpdateResult, parameters: Sequence[Parameter]) -> tuple[Parameter, ...]:
    """Return the parameters counted from their estimates, which the fit's model has already."""
    return tuple(q.about(v) for q, v in zip(parameters, fit.values.tolist(), strict=True))


class _Channels(NamedTuple):
    """How a plant depends on its Deltas: ``M0 + left W right + again W R (A0 + left_A W right)``.

    With M = [A B; C D], W the diagonal of relative changes, and R the part of `right` (m, n + m)
    over the states: accelerations see the rates of the states, which the Deltas change once more.
    """

    base: FloatArray
    left: FloatArray
    right: FloatArray
    again: FloatArray
    n: int

    @property
    def rates(self) -> FloatArray:
        """R [A0 B0] (m, n + m): what the second copies of the Deltas see."""
        return np.asarray(self.right[:, : self.n] @ self.base[: self.n])

    @property
    def crossed(self) -> FloatArray:
        """What they see of the first copies (m, m)."""
        return np.asarray(self.right[:, : self.n] @ self.left[: self.n])

    @property
    def repeated(self) -> FloatArray:
        """Which Deltas (m,) have a second copy."""
        return np.asarray(np.any(self.again != 0, axis=0))


def _opened(plant: Partition, deltas: Sequence[Delta]) -> StateSpace:
    """Return the continuous plant with a channel for each Delta, two where accelerations need it.

    A mode's A is affine in its Deltas, ``A0 + sum_j delta_j l_j R_j``, and so are displacements and
    velocities. An acceleration ``S A (A x + N' f)`` holds products of them where the damping of a
    mode is not proportional. With the rate ``x'`` of the states, which a first copy of the Deltas
    drives, it is ``S A0 x' + sum_j (S l_j) delta_j R_j x'``: a second copy of each Delta that reads
    ``R_j x'`` makes it exact. The columns are read off the plant assembled with one mode changed,
    so that they hold for any port.
    """
    own = _delta_channels(plant, deltas)
    twice = np.flatnonzero(own.repeated)
    left = np.hstack([own.left, own.again[:, twice]])
    right = np.vstack([own.right, own.rates[twice]])
    feed = np.zeros((right.shape[0], right.shape[0]))
    feed[len(deltas) :, : len(deltas)] = own.crossed[twice]
    names = [d.name for d in deltas] + [f"{deltas[j].name}:rate" for j in twice.tolist()]
    system = with_channels(plant.system, 0, names, left, right, feed)
    do = "Give the sensor a `row` and a quantity."
    require_exact(plant, system, deltas, "the modes", do)
    return system


def _delta_channels(plant: Partition, deltas: Sequence[Delta]) -> _Channels:
    """Return how the plant depends on its Deltas, read off with one mode changed at a time."""
    base, n = system_matrix(plant.system), plant.system.n_states
    left, right = np.zeros((base.shape[0], len(deltas))), np.zeros((len(deltas), base.shape[1]))
    again = np.zeros_like(left)
    for j, delta in enumerate(deltas):
        changed = system_matrix(with_changes(plant, [(delta, _PROBE)]).system)
        change = (changed - base) / _PROBE
        # of a mode's block the second row changes
        R = change[int(plant.modal_states[2 * delta.mode - 1])]
        R = R / np.linalg.norm(R)
        rate = R[:n] @ changed[:n]
        rate_size = float(np.linalg.norm(rate))
        seen = np.linalg.lstsq(np.array([R, rate / rate_size]).T, change.T, rcond=None)[0]
        size = np.linalg.norm(change, axis=1)
        plain = np.abs(seen[1]) <= _AFFINE * size
        left[:, j] = np.where(plain, change @ R, seen[0])
        again[:, j] = np.where(plain, 0.0, seen[1] / rate_size)
        right[j] = R
        even = np.sqrt(delta.scale * max(float(np.abs(left[:n, j]).max()), TINY))
        right[j] *= even
        left[:, j] *= delta.scale / even
        again[:, j] *= delta.scale / even
    return _Channels(base, left, right, again, n)


def _fitted_poles(
    realisation: ModalRealisation,
    fit: UpdateResult,
    parameters: Sequence[Parameter] | None,
    modes: Sequence[int] | None,
) -> tuple[tuple[int, ...], ComplexArray, FloatArray]:
    """Return mode numbers, poles and J C J', the covariance of [Re lambda; Im lambda]."""
    if parameters is not None:
        parameters = members(parameters, Parameter, "parameters", "Pass those of the fit.", least=0)
    covariance = _checked_fit(fit, tuple(parameters or ()))
    elastic = range(realisation.n_rigid + 1, realisation.n_modes + 1)
    chosen = list(elastic) if modes is None else modes
    if several(chosen) and not len(tuple(chosen)):
        raise ModelError("modes is empty: nothing would be uncertain. Name some, or leave it out.")
    found = eigenvalue_sensitivities(fit.model, about_fit(fit, parameters or ()), modes=chosen)
    J = np.vstack([found.S.real, found.S.imag])
    return found.modes, found.poles, J @ covariance @ J.T


def _measured_poles(
    measured: MeasuredModes, modes: Sequence[int] | None
) -> tuple[tuple[int, ...], ComplexArray, FloatArray]:
    """Return mode numbers, poles and the covariance of [Re lambda; Im lambda], as measured."""
    if measured.covariance is None or measured.modes is None:
        raise ModelError(
            "the measured modes need mode numbers and a covariance: "
            "MeasuredModes(poles, modes=[...], covariance=...)."
        )
    chosen = list(measured.modes if modes is None else modes)
    for number in chosen:
        if number not in measured.modes:
            raise unknown_label("measured mode", number, map(str, measured.modes))
    at = [measured.modes.index(number) for number in chosen]
    both = [*at, *(i + len(measured) for i in at)]
    return tuple(chosen), measured.poles[at], measured.covariance[np.ix_(both, both)]


def _log_derivatives(poles: ComplexArray) -> FloatArray:
    """Return the derivatives of [log omega^2; log 2 zeta omega] to [Re lambda; Im lambda]."""
    size = np.abs(poles) ** 2
    damped = np.where(poles.real != 0, poles.real, np.inf)
    zero = np.zeros((poles.size, poles.size))
    return np.block(
        [
            [np.diag(2 * poles.real / size), np.diag(2 * poles.imag / size)],
            [np.diag(1 / damped), zero],
        ]
    )


def _check_range(deltas: Sequence[Delta], deviations: float) -> None:
    """Refuse Deltas that reach negative stiffness or damping."""
    for delta in deltas:
        if delta.kind == "gain" and delta.scale >= 1:
            raise ModelError(
                f"{delta.name} is uncertain by {100 * delta.scale:.3g} %: its sign is not known, "
                "and no controller is robust to that. Calibrate it."
            )
        if delta.mode and delta.scale >= 1:
            what = "stiffness" if delta.kind == "freq" else "damping"
            raise ModelError(
                f"the {what} of mode {delta.mode} is uncertain by {100 * delta.scale:.3g} % at "
                f"{deviations:g} standard deviations, so it may be negative: no controller is "
                "robust to that. Measure it better, leave the mode out, or lower deviations."
            )


#: relative: eigenvalues of a parameter's matrix below this are rounding
_RANK = 1e-12


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


def by_parameters(
    plant: Partition, parameters: Sequence[Parameter], scales: FloatArray
) -> tuple[StateSpace, tuple[Delta, ...]]:
    """Return the continuous plant with channels for Deltas on the parameters, and these.

    ``(M + sum d_i dM_i) q'' + (D + sum d_i dD_i) q' + (K + sum d_i dK_i) q = f``: with
    ``dM_i = U s U'`` the change is the force ``-U s d_i U' q''``, a feedback around the (absolute)
    acceleration, and so for velocities and displacements. Each Delta has as many channels as its
    matrices have rank. Exact for any port and any damping.
    """
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
            whole = _to_dense(part)
            if order == 1:
                whole = elastic_part(model, realisation, whole)
            values, vectors = np.linalg.eigh(0.5 * (whole + whole.T))
            for i in np.flatnonzero(np.abs(values) > _RANK * np.abs(values).max()).tolist():
                name = f"{parameter.name}:{len(loads) + 1}"
                size = np.sqrt(scale * abs(values[i]))
                loads.append(_Load(f"{name}:w", -np.sign(values[i]) * size * vectors[:, i]))
                felt.append(_Felt(f"{name}:z", size * vectors[:, i], quantity=QUANTITIES[order]))
    wider = ports.replace(w=[*loads, *ports.w], y=[*ports.y, *felt])
    system = continuous_plant(type(plant), realisation, wider).system
    return (
        system.select(
            [*(port.name for port in felt), *plant.z, *plant.y],
            [*(port.name for port in loads), *plant.w, *plant.u],
        ),
        tuple(deltas),
    )


def _to_dense(matrix: object) -> FloatArray:
    return np.asarray(matrix.toarray() if sp.issparse(matrix) else matrix)  # type: ignore[attr-defined]

"""Deltas of a plant: of a fit, of a measurement, or stated; and by how much each may be off."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any, Literal, NamedTuple

import numpy as np

from ...checks import ComplexArray, FloatArray, instance, positive, real_array, several
from ...errors import LabelError, ModelError, require_known, unknown_label
from ...identification import MeasuredModes
from ...modes.matching import assigned
from ...updating import ModalUncertainty, UpdateResult, eigenvalue_sensitivities
from ...updating.parameters import Parameter
from ..partition import Partition
from ..realisation import ModalRealisation
from .uncertain_plant import Delta, modal_realisation

#: relative standard deviations below this open no channel
_KNOWN = 1e-12
#: largest relative uncertainty of a damping: an interval reaches farther above than below, where
#: it ends at zero
_DAMPING = 0.99
#: relative distance of poles of one model; and of measured ones, typed, from those of the machine
_SAME_MODEL, _TYPED_POLES = 1e-6, 0.1
_KINDS: tuple[Literal["freq", "damping"], ...] = ("freq", "damping")


class Known(NamedTuple):
    """Deltas, their covariance as random numbers, and the modes that were asked for."""

    deltas: tuple[Delta, ...]
    covariance: FloatArray
    modes: Sequence[int] = ()


class _Poles(NamedTuple):
    """Mode numbers, poles, and the covariance of [Re lambda; Im lambda]."""

    modes: tuple[int, ...]
    values: ComplexArray
    covariance: FloatArray


def _of_modes(numbers: Sequence[int], scales: FloatArray) -> tuple[Delta, ...]:
    """Return Deltas of stiffness and damping by relative scales (2 m,), mode by mode."""
    named = [(number, kind) for number in numbers for kind in _KINDS]
    return tuple(
        Delta(f"mode{number}:{kind}", number, kind, float(size))
        for (number, kind), size in zip(named, scales, strict=True)
    )


def correlated_deltas(
    realisation: ModalRealisation,
    source: ModalUncertainty,
    modes: Sequence[int] | None,
    deviations: float,
) -> Known:
    """Return Deltas of modes as uncertain as they are, correlated, half-widths two deviations."""
    numbers = _renumbered(realisation, source)
    known = [number for number in numbers if number]
    chosen = tuple(sorted(known) if modes is None else modes)
    require_known("elastic mode", chosen, known)
    at = np.array([numbers.index(number) for number in chosen], dtype=np.int64)
    _check_poles(realisation, chosen, source.poles[at], _SAME_MODEL, "fit")
    both = np.stack([at, at + len(numbers)], axis=1).ravel()
    scale = 0.5 * deviations * source.share[both]
    scale[::2] *= 2.0  # stiffness is omega^2
    scale[1::2] = np.minimum(scale[1::2], _DAMPING)
    every = _of_modes(chosen, scale)
    keep = np.flatnonzero([_acts(realisation, delta) for delta in every])
    covariance = source.covariance[np.ix_(both[keep], both[keep])]
    size = deviations * np.sqrt(np.diag(covariance))
    return Known(tuple(every[i] for i in keep), covariance / np.outer(size, size), chosen)


def _renumbered(realisation: ModalRealisation, source: ModalUncertainty) -> list[int]:
    """Return the number in the plant of each mode of a source, 0 where the plant lacks it."""
    # calibration puts modes in another order where measured frequencies cross
    elastic = list(realisation.elastic)
    own = np.linalg.eigvals(realisation.pairs[[number - 1 for number in elastic]])
    size = np.abs(source.poles)
    gap = np.abs(size[:, None, None] - np.abs(own)).min(axis=2) / size[:, None]
    same = np.equal.outer(source.modes, elastic)
    found = assigned(gap + np.where(same, 0.0, _SAME_MODEL))
    return [elastic[i] if i >= 0 else 0 for i in found.tolist()]


def _acts(realisation: ModalRealisation, delta: Delta) -> bool:
    """Return whether a Delta is not on the damping of an undamped mode."""
    return delta.kind != "damping" or bool(np.trace(realisation.pairs[delta.mode - 1]))


def calibration_of(plant: Partition) -> Any:
    """Return the measured poles that the plant was calibrated with, None without any."""
    found = getattr(plant.model, "calibration", None)
    if found is None:
        return None
    own = np.linalg.eigvals(plant.assembled.realisation.A)
    poles = found.poles[np.abs(found.poles) <= (1.0 + _SAME_MODEL) * np.abs(own).max()]
    gap = np.abs(poles[:, None] - own).min(axis=1)
    # a model that was updated after it was calibrated has other poles
    return found if np.all(gap <= _SAME_MODEL * np.abs(poles)) else None


def stated_deltas(
    realisation: ModalRealisation, frequency: Any, damping: Any, modes: Sequence[int] | None
) -> tuple[Delta, ...]:
    """Return Deltas of stated relative uncertainties of frequency and damping, mode by mode."""
    # negative stiffness, as of magnets, is no frequency; its modes are uncertain by name only
    swing = [n for n in realisation.elastic if np.linalg.det(realisation.pairs[n - 1]) > 0]
    chosen = tuple(swing if modes is None else modes)
    _require_elastic(realisation, chosen)
    # stiffness is omega^2
    sizes = (
        2.0 * _by_mode(frequency, "frequency of a mode", chosen),
        _by_mode(damping, "damping of a mode", chosen),
    )
    every = _of_modes(chosen, np.stack(sizes, axis=1).ravel())
    deltas = tuple(d for d in every if d.scale > _KNOWN and _acts(realisation, d))
    if not deltas:
        raise ModelError("frequency= and damping= are zero: there is nothing uncertain.")
    return deltas


def _by_mode(given: Any, name: str, modes: Sequence[int]) -> FloatArray:
    """Return a number for each mode: of one for all, an array, or {mode: number}."""
    if given is None:
        return np.zeros(len(modes))
    if isinstance(given, Mapping):
        require_known("uncertain mode", map(str, given), map(str, modes))
        given = [given.get(number, 0.0) for number in modes]
    values = real_array(given, name)
    values = real_array(values if values.ndim else np.full(len(modes), values), name, (len(modes),))
    if np.any(values < 0):
        raise ModelError(
            f"the {name} is uncertain by a share of it, 0 or more, got {values.min()}."
        )
    return values


def _require_elastic(realisation: ModalRealisation, modes: Sequence[int]) -> None:
    for number in modes:
        if number not in realisation.elastic:
            known = map(str, realisation.elastic)
            raise unknown_label("elastic mode of the plant", number, known)


def _check_poles(
    realisation: ModalRealisation,
    modes: Sequence[int],
    poles: ComplexArray,
    limit: float,
    name: str,
) -> None:
    """Refuse a plant without the modes that are uncertain."""
    _require_elastic(realisation, modes)
    for number, pole in zip(modes, poles, strict=True):
        own = np.linalg.eigvals(realisation.pairs[number - 1])
        # by frequency: the plant may have damping where the model that was fitted has none
        if np.min(np.abs(np.abs(own) - abs(pole))) > limit * abs(pole):
            raise ModelError(
                f"mode {number} has the pole {pole:.6g} in the {name} and {own[0]:.6g} in the "
                "plant: they are not of the same model. Assemble the plant from fit.model, or "
                "from fit.calibrated(measured)."
            )


def pole_deltas(
    realisation: ModalRealisation,
    source: Any,
    parameters: Sequence[Parameter],
    modes: Sequence[int] | None,
    deviations: float,
) -> Known:
    """Return Deltas of the poles of a fit or a measurement, with their covariance."""
    if isinstance(source, UpdateResult):
        found = _fitted_poles(realisation, source, parameters, modes)
        _check_poles(realisation, found.modes, found.values, _SAME_MODEL, "fit")
    elif isinstance(source, MeasuredModes):
        found = _measured_poles(source, modes)
        _check_poles(realisation, found.modes, found.values, _TYPED_POLES, "measurement")
    else:
        raise ModelError(
            "uncertainty comes from an UpdateResult or MeasuredModes, got "
            f"{type(source).__name__}: pass one, fit.uncertainty(measured), or state it: "
            "frequency=0.005, damping=0.3."
        )
    G = _log_derivatives(found.values)
    covariance = G @ found.covariance @ G.T
    rising = np.argsort(found.modes, kind="stable")
    order = np.stack([rising, rising + rising.size], axis=1).ravel()  # mode by mode
    scale = deviations * np.sqrt(np.diag(covariance))[order]
    every = _of_modes([found.modes[i] for i in rising], scale)
    keep = np.flatnonzero(scale > _KNOWN)
    if not keep.size:
        raise ModelError(f"modes {list(found.modes)} have no variance: there is nothing uncertain.")
    own = covariance[np.ix_(order[keep], order[keep])] / np.outer(scale[keep], scale[keep])
    return Known(tuple(every[i] for i in keep), own, found.modes)


def _fitted_poles(
    realisation: ModalRealisation,
    fit: UpdateResult,
    parameters: Sequence[Parameter],
    modes: Sequence[int] | None,
) -> _Poles:
    """Return the poles of a fit's model, their covariance J C J'."""
    covariance = checked_fit(fit, parameters)
    chosen = list(realisation.elastic) if modes is None else modes
    if several(chosen) and not len(tuple(chosen)):
        raise ModelError("modes is empty: nothing would be uncertain. Name some, or leave it out.")
    found = eigenvalue_sensitivities(fit.model, about_fit(fit, parameters), modes=chosen)
    J = np.vstack([found.S.real, found.S.imag])
    return _Poles(found.modes, found.poles, J @ covariance @ J.T)


def _measured_poles(measured: MeasuredModes, modes: Sequence[int] | None) -> _Poles:
    """Return the poles of modes as measured."""
    if measured.covariance is None or measured.modes is None:
        raise ModelError(
            "the measured modes need mode numbers and a covariance: "
            "MeasuredModes(poles, modes=[...], covariance=...)."
        )
    chosen = tuple(measured.modes if modes is None else modes)
    require_known("measured mode", chosen, measured.modes)
    at = [measured.modes.index(number) for number in chosen]
    both = [*at, *(i + len(measured) for i in at)]
    return _Poles(chosen, measured.poles[at], measured.covariance[np.ix_(both, both)])


def _log_derivatives(poles: ComplexArray) -> FloatArray:
    """Return the derivatives of [log omega^2; log 2 zeta omega] to [Re lambda; Im lambda]."""
    size = np.abs(poles) ** 2
    damped = np.where(poles.real != 0, poles.real, np.inf)
    return np.block([
        [np.diag(2 * poles.real / size), np.diag(2 * poles.imag / size)],
        [np.diag(1 / damped), np.zeros((poles.size, poles.size))],
    ])  # fmt: skip


def checked_fit(fit: UpdateResult, parameters: Sequence[Parameter]) -> FloatArray:
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


def port_deltas(plant: Partition, gain: Any, delay: float | None) -> tuple[Delta, ...]:
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


def stated_amounts(
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


def shape_deltas(
    plant: Partition,
    shapes: FloatArray,
    measured: Sequence[int],
    chosen: Sequence[int],
    deviations: float,
) -> list[Delta]:
    """Return a Delta for each direction (n,) of `shapes` (m, n, r) of the chosen modes."""
    realisation = modal_realisation(plant)
    given = real_array(shapes, "shapes", (len(measured), realisation.outputs.shape[0], None))
    found = []
    for number in chosen:
        phi = realisation.inputs[:, 2 * number - 1]
        for j, direction in enumerate(given[list(measured).index(number)].T, 1):
            size = float(np.linalg.norm(direction) / np.linalg.norm(phi))
            if size > 0:
                name = f"mode{number}:shape{j}"
                found.append(Delta(name, number, "shape", deviations * size, direction / size))
    return found


def check_range(deltas: Sequence[Delta], deviations: float) -> None:
    """Refuse Deltas that reach negative stiffness or damping, or a gain of unknown sign."""
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

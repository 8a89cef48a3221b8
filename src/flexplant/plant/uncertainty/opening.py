"""Channels for Deltas: a plant whose modes are uncertain by a fit's covariance."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, Literal

import numpy as np

from ...errors import LabelError, ModelError, unknown_label
from ...identification import MeasuredModes
from ...lti.statespace import StateSpace
from ...updating import UpdateResult, eigenvalue_sensitivities
from ...updating.parameters.added import Parameter
from ...values import ComplexArray, FloatArray, positive
from ..building import P
from ..partition import Partition
from ..realisation import ModalRealisation
from .neglected import neglected_modes, opened
from .uncertain_plant import Delta, UncertainPlant, modal_realisation, with_changes

#: relative standard deviations below this open no channel
_KNOWN = 1e-12
#: relative change at which the plant's dependence on a Delta is read off
_PROBE = 0.25


def uncertain(
    plant: P,
    source: UpdateResult | MeasuredModes,
    parameters: Sequence[Parameter] | None = None,
    *,
    modes: Sequence[int] | None = None,
    deviations: float = 2.0,
    neglected: Any = None,
) -> UncertainPlant[P]:
    """Return a plant with channels for Deltas; see `StandardPlant.uncertain`."""
    realisation = modal_realisation(plant)
    many = positive(deviations, "deviations")
    if isinstance(source, UpdateResult):
        parameters = source.unknowns if parameters is None else parameters
        numbers, poles, covariance = _fitted_poles(realisation, source, parameters, modes)
    elif isinstance(source, MeasuredModes):
        numbers, poles, covariance = _measured_poles(source, modes)
    else:
        raise ModelError(
            f"uncertainty comes from an UpdateResult or MeasuredModes, got {type(source).__name__}."
        )
    _check_poles(realisation, numbers, poles, isinstance(source, UpdateResult))
    G = _relative(poles)
    covariance = G @ covariance @ G.T
    scale = many * np.sqrt(np.diag(covariance))
    kinds: tuple[Literal["freq", "damping"], ...] = ("freq", "damping")
    every = [
        Delta(f"mode{number}:{kind}", number, kind, float(size))
        for (kind, number), size in zip(
            ((kind, number) for kind in kinds for number in numbers), scale, strict=True
        )
    ]
    keep = sorted(np.flatnonzero(scale > _KNOWN), key=lambda i: (every[i].mode, i))
    if not keep:
        raise ModelError(f"modes {list(numbers)} have no variance: there is nothing uncertain.")
    deltas = tuple(every[i] for i in keep)
    _check_range(deltas, many)
    system = _opened(plant.continuous, deltas)
    weight = None
    if neglected is not None:
        weight = neglected_modes(plant, neglected)
        system = opened(system, weight, len(deltas))
    return UncertainPlant(
        plant,
        system,
        deltas,
        covariance[np.ix_(keep, keep)] / np.outer(scale[keep], scale[keep]),
        many,
        weight,
        source if isinstance(source, UpdateResult) else None,
        tuple(parameters or ()),
    )


def _opened(plant: Partition, deltas: Sequence[Delta]) -> StateSpace:
    """Return the continuous plant with a channel for each Delta.

    All matrices are affine in the Deltas, [A B; C D] + sum delta_j L_j R_j: each L_j R_j is read
    off the plant assembled with that mode changed, so it holds for any port.
    """
    base, g = _matrix(plant.system), plant.system
    n, m = g.n_states, len(g.inputs)
    left, right = np.zeros((base.shape[0], len(deltas))), np.zeros((len(deltas), n + m))
    for j, delta in enumerate(deltas):
        change = (_matrix(with_changes(plant, [(delta, _PROBE)]).system) - base) / _PROBE
        sizes = np.linalg.norm(change, axis=1)
        R = change[np.argmax(sizes)] / np.sqrt(sizes.max())
        left[:, j] = change @ R / (R @ R) * np.sqrt(delta.scale)
        right[j] = R * np.sqrt(delta.scale)
    _check_affine(plant, deltas, left, right)
    zero = np.zeros((len(deltas), len(deltas)))
    return StateSpace(
        g.A,
        np.hstack([left[:n], g.B]),
        np.vstack([right[:, :n], g.C]),
        np.block([[zero, right[:, n:]], [left[n:], g.D]]),
        inputs=[*(f"{delta.name}:w" for delta in deltas), *g.inputs],
        outputs=[*(f"{delta.name}:z" for delta in deltas), *g.outputs],
        states=g.states,
        name=g.name,
        blocks=g.blocks,
    )


def _check_affine(
    plant: Partition, deltas: Sequence[Delta], left: FloatArray, right: FloatArray
) -> None:
    amounts = [_PROBE * (1.0 if j % 2 else -0.5) for j in range(len(deltas))]
    wanted = _matrix(with_changes(plant, list(zip(deltas, amounts, strict=True))).system)
    weights = np.array(amounts) / np.array([delta.scale for delta in deltas])
    off = np.abs(wanted - _matrix(plant.system) - (left * weights) @ right)
    row = np.abs(wanted - _matrix(plant.system)).max(axis=1)
    bad = np.flatnonzero(off.max(axis=1) > 1e-6 * row + 1e-12 * np.abs(wanted).max(axis=1))
    if bad.size:
        i = int(bad[0]) - plant.system.n_states
        name = plant.system.outputs[i] if i >= 0 else plant.system.states[int(bad[0])]
        raise ModelError(
            f"{name!r} depends on products of Deltas: an acceleration of a mode whose damping is "
            "not proportional does. Measure displacement or velocity there, or assemble from "
            "modes with proportional damping."
        )


def _matrix(g: StateSpace) -> FloatArray:
    return np.block([[g.A, g.B], [g.C, g.D]])


def _fitted_poles(
    realisation: ModalRealisation,
    fit: UpdateResult,
    parameters: Sequence[Parameter] | None,
    modes: Sequence[int] | None,
) -> tuple[tuple[int, ...], ComplexArray, FloatArray]:
    """Return mode numbers, poles and J C J', the covariance of [Re lambda; Im lambda]."""
    names = tuple(parameter.name for parameter in parameters or ())
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
    elastic = range(realisation.n_rigid + 1, realisation.n_modes + 1)
    chosen = list(elastic if modes is None else modes)
    found = eigenvalue_sensitivities(fit.model, list(parameters or ()), modes=chosen)
    J = np.vstack([found.S.real, found.S.imag])
    return found.modes, found.poles, J @ fit.covariance @ J.T


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


def _relative(poles: ComplexArray) -> FloatArray:
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


def _check_poles(
    realisation: ModalRealisation, modes: Sequence[int], poles: ComplexArray, strict: bool
) -> None:
    """Refuse a plant without the modes that are uncertain."""
    count = realisation.n_modes
    for number, pole in zip(modes, poles, strict=True):
        if not realisation.n_rigid < number <= count:
            known = range(realisation.n_rigid + 1, count + 1)
            raise unknown_label("elastic mode of the plant", number, map(str, known))
        own = np.linalg.eigvals(realisation.pairs[number - 1])
        off = np.min(np.abs(own - pole)) / abs(pole)
        if off > (1e-6 if strict else 0.1):
            raise ModelError(
                f"mode {number} has the pole {pole:.6g} in the "
                f"{'fit' if strict else 'measurement'} and {own[0]:.6g} in the plant: they are "
                "not of the same model. Assemble the plant from fit.model."
            )


def _check_range(deltas: Sequence[Delta], deviations: float) -> None:
    """Refuse Deltas that reach negative stiffness or damping."""
    for delta in deltas:
        if delta.scale >= 1:
            what = "stiffness" if delta.kind == "freq" else "damping"
            raise ModelError(
                f"the {what} of mode {delta.mode} is uncertain by {100 * delta.scale:.3g} % at "
                f"{deviations:g} standard deviations, so it may be negative: no controller is "
                "robust to that. Measure it better, leave the mode out, or lower deviations."
            )

"""Channels for Deltas: a plant whose modes are uncertain by a fit's covariance."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, Literal

import numpy as np

from ...errors import ModelError
from ...identification import MeasuredModes
from ...lti.statespace import StateSpace
from ...updating import UpdateResult
from ...updating.parameters.added import Parameter
from ...values import FloatArray, positive
from ..building import P
from ..partition import Partition
from .delta import Delta, modal_realisation, with_changes
from .neglected import neglected_modes, opened
from .pole_covariance import check_poles, check_range, fitted_poles, measured_poles, relative
from .uncertain_plant import UncertainPlant

#: relative doubts below this open no channel
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
    """Return a plant with the doubt of a fit opened; see `Partition.uncertain`."""
    realisation = modal_realisation(plant)
    many = positive(deviations, "deviations")
    if isinstance(source, UpdateResult):
        parameters = source.unknowns if parameters is None else parameters
        numbers, poles, doubt = fitted_poles(realisation, source, parameters, modes)
    elif isinstance(source, MeasuredModes):
        numbers, poles, doubt = measured_poles(source, modes)
    else:
        raise ModelError(
            f"uncertainty comes from an UpdateResult or MeasuredModes, got {type(source).__name__}."
        )
    check_poles(realisation, numbers, poles, isinstance(source, UpdateResult))
    G = relative(poles)
    doubt = G @ doubt @ G.T
    scale = many * np.sqrt(np.diag(doubt))
    kinds: tuple[Literal["freq", "damping"], ...] = ("freq", "damping")
    every = [
        Delta(f"mode{number}:{kind}", number, kind, float(size))
        for (kind, number), size in zip(
            ((kind, number) for kind in kinds for number in numbers), scale, strict=True
        )
    ]
    keep = sorted(np.flatnonzero(scale > _KNOWN), key=lambda i: (every[i].mode, i))
    if not keep:
        raise ModelError(f"modes {list(numbers)} have no doubt: there is no uncertainty to open.")
    deltas = tuple(every[i] for i in keep)
    check_range(deltas, many)
    system = _opened(plant.continuous, deltas)
    weight = None
    if neglected is not None:
        weight = neglected_modes(plant, neglected)
        system = opened(system, weight, len(deltas))
    return UncertainPlant(
        plant,
        system,
        deltas,
        doubt[np.ix_(keep, keep)] / np.outer(scale[keep], scale[keep]),
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

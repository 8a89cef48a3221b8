"""D-K iteration with one channel a mode: robust performance under uncertain frequencies."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, NamedTuple

import numpy as np

from ...checks import FloatArray
from ...errors import (
    AssumptionError,
    CertificateError,
    SolverError,
    attempted,
    counted,
)
from ...lti.frequency_sweep import resonance_grid
from ...lti.interconnection import lft
from ...lti.preparation import prepared
from ...lti.responses import responder
from ...lti.statespace import StateSpace
from ...parallel import Progress
from ...plant import StandardPlant
from ...plant.uncertainty.uncertain_plant import UncertainPlant
from ..controller import Controller, SynthesisMethod
from ..hinf.hinf_riccati import quick_answer
from ..hinf.mode_channels import (
    ModeChannel,
    ModeLoop,
    mode_channels,
    rebalanced,
    with_mode_channels,
)
from .uncertain_loop import weighted_names

#: relative decrease of mu below which the iteration ends
_SETTLED = 0.02
#: relative distance of mu from the level that D was found for, from which on D is found again
_NEAR = 0.02
#: machines at corners of the uncertainty that are closed exactly, and by how much their gain may
#: exceed the bound: the first order of the channels
_MACHINES, _BEYOND = 8, 0.05


class _Step(NamedTuple):
    """A controller and its mu."""

    mu: float
    controller: StateSpace
    channels: Sequence[ModeChannel]


def by_mode_channels(
    uncertain: UncertainPlant[Any],
    w: Any,
    z: Any,
    most: int,
    method: SynthesisMethod | None,
    progress: bool | None,
) -> Controller | None:
    """Return the controller of the smallest mu over the steps; None where no step shows any.

    Step k solves the H-infinity problem of Deltas and weights divided by the mu of the step before:
    at a fixed point the norm is 1 and mu what it was divided by.
    """
    plant = uncertain.plant
    weighted = _performance_plant(plant, w, z)
    stated = None
    with attempted("mode by mode", AssumptionError):  # no disturbance moves them: no D to begin
        stated = mode_channels(weighted, uncertain)
    if stated is None:
        return None
    best: _Step | None = None
    found: list[float] = []
    level = 1.0
    channels: Sequence[ModeChannel] = stated
    with Progress(most, "steps of D-K", progress=progress) as bar:
        for number in range(most):
            bar.advance(int(number > 0))
            step = None
            with attempted(f"step {number + 1} of the D-K iteration"):
                step = _dk_iteration(weighted, channels, level, method)
            if step is None:
                break
            found.append(step.mu)
            settled = best is not None and step.mu > (1.0 - _SETTLED) * best.mu
            if best is None or step.mu < best.mu:
                best = step
            if settled:
                break
            level = min(step.mu, 2.0 * level)
            channels = step.channels
    if best is None or not np.isfinite(best.mu):
        return None
    certificate = {"mu": best.mu} | {f"mu of step {i}": mu for i, mu in enumerate(found, 1)}
    certificate["largest gain of machines over mu"] = _corner_ratio(uncertain, best, w, z)
    return Controller(
        best.controller,
        f"D-K iteration with one channel a mode, {counted(len(found), 'step')}",
        gamma=best.mu,
        certificate=certificate,
    )


def _dk_iteration(
    weighted: StandardPlant,
    channels: Sequence[ModeChannel],
    level: float,
    method: SynthesisMethod | None,
) -> _Step:
    """Return the controller for Deltas and weights over a level, its mu, and channels for it."""
    sized = [one.of_size(1.0 / level) for one in channels]
    plant = with_mode_channels(weighted, sized)
    own = plant.system.output_index(weighted.z)
    scale = np.ones(len(plant.system.outputs))
    scale[own] = 1.0 / level
    g = plant.system
    system = g.replace(C=g.C * scale[:, None], D=g.D * scale[:, None])
    problem = prepared(system, plant.u, plant.y)
    found = quick_answer(problem) if method is None else method.solve(problem)
    K = problem.restored(found.A, found.B, found.C, found.D).replace(name="mu", units=plant.units)
    if not lft(system, K).is_stable:
        raise SolverError("the controller does not stabilise in rounding.")
    again = rebalanced(channels, with_mode_channels(weighted, channels), K)
    loop = ModeLoop.of(again, with_mode_channels(weighted, again), K, 2.0, weighted=True)
    mu = loop.level(level)
    if abs(mu / level - 1.0) > _NEAR:  # D is found for a level
        mu = min(mu, loop.level(mu))
    return _Step(mu, K, again)


def _performance_plant(plant: StandardPlant, w: Any, z: Any) -> StandardPlant:
    """Return a plant with the channels of performance alone, weighted."""
    sides = {}
    for side, given in (("z", z), ("w", w)):
        names, weights = weighted_names(given, side)
        own = {name: weights.get(name, 1.0) for name in names}
        sides[side] = dict.fromkeys(getattr(plant, side)) | own  # None leaves one out
    return plant.weighted(**sides)


def _corner_ratio(uncertain: UncertainPlant[Any], best: _Step, w: Any, z: Any) -> float:
    """Return the largest weighted gain of machines at corners, each closed exactly, over mu."""
    chance, size = np.random.default_rng(0), min(1.0, 1.0 / best.mu)
    names = [delta.name for delta in uncertain.deltas]
    most = 0.0
    for _ in range(_MACHINES):
        ends = size * chance.choice([-1.0, 1.0], len(names))
        machine = uncertain.lft(dict(zip(names, ends.tolist(), strict=True)))
        loop = lft(_performance_plant(machine, w, z).system, best.controller)
        most = max(most, _grid_peak(loop) / best.mu if loop.is_stable else np.inf)
    if most > 1.0 + _BEYOND:
        raise CertificateError(
            f"of machines within {size:.3g} of the uncertainty one has {most:.4g} times the gain "
            f"of mu <= {best.mu:.4g} (inf: it is unstable): the changes are too large for the "
            "first order of one channel a mode. State less uncertainty, or raise the rate."
        )
    return most


def _grid_peak(loop: StateSpace) -> float:
    """Return the largest singular value over a grid through the resonances."""
    freq: FloatArray = resonance_grid(loop.poles(), loop.dt)
    return float(np.linalg.norm(np.moveaxis(responder(loop)(freq), 2, 0), 2, axis=(1, 2)).max())

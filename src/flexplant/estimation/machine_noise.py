"""What machines do that a filter's model does not, as noise: filters for uncertain modes."""

from __future__ import annotations

from typing import Any

import numpy as np

from ..arrays import ComplexArray, FloatArray
from ..errors import AssumptionError
from ..plant import AnyPlant
from .estimator_channels import poi_channels, sensors
from .left_out_modes import LeftOut

#: parts of the difference between machines and model that are tried as noise: a difference at a
#: resonance is not white, so that all of it may be too much
PARTS = (1.0, 0.5, 0.25)


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

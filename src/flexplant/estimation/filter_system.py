"""A filter of two gains as a system, and the system that its error is on its own model."""

from __future__ import annotations

import numpy as np

from ..lti.lyapunov import solve_stein
from ..lti.statespace import StateSpace
from ..plant import StandardPlant
from ..values import FloatArray
from .estimator_channels import estimates
from .filter_model import FilterModel


def filter_system(
    plant: StandardPlant, model: FilterModel, K: FloatArray, L_z: FloatArray, name: str
) -> StateSpace:
    """Return the filter, from sensors and u to the estimates.

    ``x+ = A x + B u + K e``, ``hat = C1 x + D1 u + L_z e`` with the innovation
    ``e = y - C2 x - D2 u``.
    """
    m = model
    return StateSpace(
        m.A - K @ m.C2,
        np.hstack([K, m.B - K @ m.D2]),
        m.C1 - L_z @ m.C2,
        np.hstack([L_z, m.D1 - L_z @ m.D2]),
        plant.dt,
        inputs=[*m.sensors, *m.commands],
        outputs=estimates(m.channels),
        states=plant.system.states,
        name=name,
        units=plant.units,
    )


def noise_root(model: FilterModel) -> tuple[FloatArray, FloatArray]:
    """Return G (n, r) and H (ny, r): process and sensor noise are G xi and H xi, xi of unit size.

    A factor of ``[Q S; S' R]`` by its eigenvectors, each row scaled to unit size before.
    """
    n, joint = model.A.shape[0], np.block([[model.Q, model.S], [model.S.T, model.R]])
    size = np.sqrt(np.maximum(joint.diagonal(), 0.0))
    size = np.where(size > 0, size, 1.0)
    values, vectors = np.linalg.eigh(joint / size / size[:, None])
    root = size[:, None] * vectors * np.sqrt(np.maximum(values, 0.0))
    return root[:n], root[n:]


def error_system(model: FilterModel, K: FloatArray, L_z: FloatArray) -> StateSpace:
    """Return the error of a filter on its own model, driven by noise of unit variance."""
    m, (G, H) = model, noise_root(model)
    return StateSpace(m.A - K @ m.C2, G - K @ H, m.C1 - L_z @ m.C2, -L_z @ H, m.dt)


def own_variances(model: FilterModel, K: FloatArray, L_z: FloatArray) -> FloatArray:
    """Return the variances (nz,) of the error of a filter on its own model."""
    m, left = model, model.C1 - L_z @ model.C2
    X = solve_stein(m.A - K @ m.C2, m.driven(K))
    return np.asarray(np.sum((left @ X) * left, axis=1) + np.sum((L_z @ m.R) * L_z, axis=1))

"""By what share frequencies of a calibrated model may be off: what is measured, and what is not."""

from __future__ import annotations

from typing import Any

import numpy as np

from ..checks import instance
from ..modes.calibration import measured_poles
from ..modes.mesh_error import MeshError

#: least relative error of a measured frequency (a machine drifts by more than its noise), and of
#: one that was not: no updated model of a structure did better
_MEASURED, _OTHER = 1e-3, 5e-3
#: deviations that count of a measured pole, and of the misfit where nothing was measured
_DEVIATIONS = 2.0
#: of the error that two meshes show: it covered 55 to 100 % of modes
_MESH = 1.5


def frequency_uncertainty(
    model: Any, measured: Any, mesh: MeshError | None = None
) -> dict[int, float]:
    """Return {mode: relative uncertainty}; see `UpdateResult.frequency_uncertainty`."""
    instance(mesh, MeshError | None, "mesh", "Make it by modes.mesh_error(finer).")
    own = model.modes()
    known = range(own.n_rigid + 1, own.n_modes + 1)
    places, poles = measured_poles(measured, known)
    size = np.abs(poles)
    misfit = float(np.sqrt(np.mean((size / np.abs(own.poles[places]) - 1.0) ** 2)))
    found = dict.fromkeys(known, max(_OTHER, _DEVIATIONS * misfit))
    if mesh is not None:
        for mode, error in zip(mesh.modes.tolist(), mesh.error.tolist(), strict=True):
            if mode in found:
                found[mode] = max(found[mode], _MESH * abs(error))
    deviation = np.zeros(size.size)
    if measured.covariance is not None:
        m = size.size
        deviation = np.sqrt(np.diag(measured.covariance)[m:]) / size
    for place, share in zip(places.tolist(), deviation.tolist(), strict=True):
        found[place + 1] = max(_MEASURED, _DEVIATIONS * share)
    return found

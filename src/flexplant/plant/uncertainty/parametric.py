"""Deltas on the parameters of a fit, where damping couples the modes so that none is by itself."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import scipy.sparse as sp

from ...errors import ModelError
from ...labels import Place
from ...lti.statespace import StateSpace
from ...updating import UpdateResult
from ...updating.parameters.added import Parameter
from ...values import FloatArray
from ..building import continuous_plant
from ..partition import Partition
from ..port import QUANTITIES, ForcePort, Quantity, SensorPort
from ..realisation import ModalRealisation
from .uncertain_plant import Delta, elastic_part

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
    plant: Partition, fit: UpdateResult, parameters: Sequence[Parameter], deviations: float
) -> tuple[StateSpace, tuple[Delta, ...]]:
    """Return the continuous plant with channels for Deltas on the parameters, and these.

    ``(M + sum d_i dM_i) q'' + (D + sum d_i dD_i) q' + (K + sum d_i dK_i) q = f``: with
    ``dM_i = U s U'`` the change is the force ``-U s d_i U' q''``, a feedback around the (absolute)
    acceleration, and so for velocities and displacements. Each Delta has as many channels as its
    matrices have rank. Exact for any port and any damping.
    """
    realisation, ports = plant.assembled.realisation, plant.assembled.ports
    model = realisation.model
    for name in "MDK":
        own, others = getattr(model, name, None), getattr(fit.model, name)
        if own is None or own.shape != others.shape or not np.allclose(
            _dense(own), _dense(others), rtol=1e-9, atol=0.0
        ):  # fmt: skip
            raise ModelError(
                f"the plant has another {name} than the fit's model. Assemble it from fit.model."
            )
    std = np.sqrt(np.diag(fit.covariance)) * deviations  # type: ignore[arg-type]
    deltas: list[Delta] = []
    loads: list[_Load] = []
    felt: list[_Felt] = []
    for parameter, scale in zip(parameters, std.tolist(), strict=True):
        deltas.append(Delta(parameter.name, 0, "parameter", scale))
        for order, part in zip((2, 1, 0), parameter.matrices(model), strict=True):
            if part is None:
                continue
            whole = _dense(part)
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


def _dense(matrix: object) -> FloatArray:
    return np.asarray(matrix.toarray() if sp.issparse(matrix) else matrix)  # type: ignore[attr-defined]

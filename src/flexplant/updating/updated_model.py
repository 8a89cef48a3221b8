"""The model with the parameters of an update in its matrices."""

from __future__ import annotations

import warnings
from collections.abc import Sequence
from typing import Any

import numpy as np
import scipy.sparse as sp

from ..errors import FlexplantWarning, ModelError
from ..structure.model import FEModel
from ..structure.rigid import orthonormalised
from ..values import FloatArray, Matrix
from .parameters import Parameter
from .pencil import Family


def changed_model(model: Any, family: Family, p: FloatArray) -> Any:
    """Return the model with the parameters at `p`; its own rigid-body basis, as far as left."""
    changes: dict[str, Any] = {
        name: _sum(getattr(model, name), change if np.any(change) else None)
        for name, change in zip("MDK", family.changes(p), strict=True)
    }
    if hasattr(model, "T"):
        # Gram-Schmidt keeps translations first and moves the rotations to the new centre
        left = model.rigid_body @ family.rigid_left(p)
        changes["rigid_body"] = orthonormalised(changes["M"], left)
    return _replaced(model, changes, family.parameters, p)


def applied(model: Any, parameters: Sequence[Parameter], p: FloatArray) -> Any:
    """Return another model of the same structure with the parameters at `p`.

    A large FEModel stays sparse; of a reduced model the rigid-body basis is brought up to date.
    """
    if not isinstance(model, FEModel):
        return changed_model(model, Family(model, parameters), p)
    total: dict[str, Matrix | None] = dict.fromkeys("MDK")
    for parameter, value in zip(parameters, p.tolist(), strict=True):
        for name, part in zip("MDK", parameter.matrices(model), strict=True):
            if part is not None and value:
                total[name] = _sum(total[name], value * part)
    if total["D"] is not None and model.D is None:
        warnings.warn(
            "the model has no D of its own: that of the updated model holds the parameters of the "
            "update alone, and solve_modes(..., damping=) would replace it. Apply the update to a "
            "model that has its damping, model.with_damping(ModalDamping(0.01)), say.",
            FlexplantWarning,
            stacklevel=4,
        )
    changes = {name: _sum(getattr(model, name), change) for name, change in total.items()}
    return _replaced(model, changes, parameters, p)


def _replaced(
    model: Any, changes: dict[str, Any], parameters: Sequence[Parameter], p: FloatArray
) -> Any:
    try:
        return model.replace(**changes)
    except ModelError as error:
        text = ", ".join(q.text(v) for q, v in zip(parameters, p.tolist(), strict=True))
        raise ModelError(
            f"the update ended at {text}, which the {type(model).__name__} refuses: {error}"
        ) from None


def _sum(matrix: Matrix | None, change: Matrix | None) -> Matrix | None:
    """Return the sum of two matrices, sparse where the first one is, of which any may be None."""
    if matrix is None or change is None:
        return change if matrix is None else matrix
    if sp.issparse(matrix):
        return sp.csc_array(matrix + sp.csc_array(change))
    return np.asarray(matrix + change, dtype=np.float64)

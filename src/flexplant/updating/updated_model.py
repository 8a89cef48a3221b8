"""The model with the parameters of an update in its matrices."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np

from ..errors import ModelError, warn
from ..modes import solve_modes
from ..modes.normal_form import RIGID_DRAG
from ..structure.attachments import summed
from ..structure.model import FEModel
from ..structure.rigid import orthonormalised
from ..values import FloatArray, Matrix
from .family import Family
from .parameters.added import Parameter


def changed_model(
    model: Any, parameters: Sequence[Parameter], p: FloatArray, family: Family | None = None
) -> Any:
    """Return the model with the parameters at `p`; a sparse FEModel stays sparse.

    Of a reduced model the rigid-body basis is brought up to date, as far as it is left; `family`
    is that of the model and the parameters, where it is there already.
    """
    if isinstance(model, FEModel):
        return _changed_structure(model, parameters, p)
    family = Family(model, parameters) if family is None else family
    changes: dict[str, Any] = {
        name: summed(getattr(model, name), change if np.any(change) else None)
        for name, change in zip("MDK", family.changes(p), strict=True)
    }
    if hasattr(model, "T"):
        # Gram-Schmidt keeps translations first and moves the rotations to the new centre
        left = model.rigid_body @ family.rigid_left(p)
        changes["rigid_body"] = orthonormalised(changes["M"], left)
    return _replaced(model, changes, parameters, p)


def applied(model: Any, parameters: Sequence[Parameter], p: FloatArray) -> Any:
    """Return another model of the same structure with the parameters at `p`."""
    damped = isinstance(model, FEModel) and model.D is None
    if damped and any(
        q.matrices(model)[1] is not None and v for q, v in zip(parameters, p, strict=True)
    ):
        warn(
            "the model has no D of its own: that of the updated model holds the parameters of the "
            "update alone, and solve_modes(..., damping=) would replace it. Apply the update to a "
            "model that has its damping, model.with_damping(ModalDamping(0.01)), say."
        )
    return changed_model(model, parameters, p)


def _changed_structure(model: FEModel, parameters: Sequence[Parameter], p: FloatArray) -> FEModel:
    total: dict[str, Matrix | None] = dict.fromkeys("MDK")
    for parameter, value in zip(parameters, p.tolist(), strict=True):
        for name, part in zip("MDK", parameter.change(model, value), strict=True):
            total[name] = summed(total[name], part)
    changes = {name: summed(getattr(model, name), change) for name, change in total.items()}
    try:
        changed: FEModel = _replaced(model, changes, parameters, p)
    except ModelError:
        found = _with_drag(model, changes)
        if found is None:
            raise
        return found
    return changed


def _with_drag(model: FEModel, changes: dict[str, Any]) -> FEModel | None:
    """Return the model when its D fails for nothing but a slight negative drag of rigid motion.

    A damper to ground that is found from elastic poles comes out at a small number of either sign.
    What it does to rigid-body motion is left out wherever it is below 1e-4 of the first elastic
    frequency (`normal_form`), so that its sign there does not matter. With d the drag,
    ``D + d M`` must be positive semi-definite: no elastic mode gains more than that.
    """
    D = changes["D"]
    if D is None or not model.rigid_body.shape[1]:
        return None
    try:
        held = model.replace(M=changes["M"], K=changes["K"], D=None)
    except ModelError:
        return None
    rigid = held.rigid_body
    drag = float(np.abs(np.linalg.eigvalsh(rigid.T @ np.asarray(D @ rigid))).max())
    first = solve_modes(held, count=rigid.shape[1] + 1).omega[-1]
    if drag > RIGID_DRAG * float(first):
        return None
    # the rigid-body part of D + d M comes out at 0 in theory, so twice d: above rounding
    shifted = summed(D, 2.0 * drag * held.M)
    try:
        model.replace(D=shifted)
    except ModelError:
        return None
    return held.with_unchecked_damping(D)


def _replaced(
    model: Any, changes: dict[str, Any], parameters: Sequence[Parameter], p: FloatArray
) -> Any:
    try:
        # how a machine was joined was checked with the matrices before
        gone = {"joining": None} if getattr(model, "joining", None) is not None else {}
        return model.replace(**changes, **gone)
    except ModelError as error:
        text = ", ".join(q.text(v) for q, v in zip(parameters, p.tolist(), strict=True))
        raise ModelError(
            f"the update ended at {text}, which the {type(model).__name__} refuses: {error}"
        ) from None

"""A model with parameters of an update at other values, and why a model may refuse them."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np

from ..checks import FloatArray, Matrix
from ..errors import ModelError, attempted, warn
from ..modes import solve_modes
from ..modes.normal_form import RIGID_DRAG
from ..structure.attachments import matrix_sum
from ..structure.definite import why_indefinite
from ..structure.model import FEModel
from ..structure.rigid import orthonormalised
from .family import Family
from .parameters.added import Parameter


def changed_model(
    model: Any,
    parameters: Sequence[Parameter],
    p: FloatArray,
    family: Family | None = None,
    std: FloatArray | None = None,
) -> Any:
    """Return the model with the parameters at `p`; a sparse FEModel stays sparse.

    A reduced model has the rigid-body basis that is left; `family`: of the same parameters; `std`:
    their standard deviations, for an error.
    """
    if isinstance(model, FEModel):
        return _changed_structure(model, parameters, p, std)
    family = Family(model, parameters) if family is None else family
    changes: dict[str, Any] = {
        name: matrix_sum(getattr(model, name), change if np.any(change) else None)
        for name, change in zip("MDK", family.changes(p), strict=True)
    }
    if hasattr(model, "T"):
        # Gram-Schmidt keeps translations first and moves the rotations to the new centre
        left = model.rigid_body @ family.rigid_left(p)
        changes["rigid_body"] = orthonormalised(changes["M"], left)
    return _replaced(model, changes, parameters, p, std)


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


def _changed_structure(
    model: FEModel, parameters: Sequence[Parameter], p: FloatArray, std: FloatArray | None
) -> FEModel:
    total: dict[str, Matrix | None] = dict.fromkeys("MDK")
    for parameter, value in zip(parameters, p.tolist(), strict=True):
        for name, part in zip("MDK", parameter.change(model, value), strict=True):
            total[name] = matrix_sum(total[name], part)
    changes = {name: matrix_sum(getattr(model, name), change) for name, change in total.items()}
    try:
        changed: FEModel = _replaced(model, changes, parameters, p, std)
    except ModelError:
        found = _with_drag(model, changes)
        if found is None:
            raise
        return found
    return changed


def _with_drag(model: FEModel, changes: dict[str, Any]) -> FEModel | None:
    """Return the model when its D fails for nothing but a slight negative drag of rigid motion.

    A drag d below 1e-4 of the first elastic frequency is left out wherever it is (`normal_form`):
    its sign does not matter. ``D + d M`` must be positive semi-definite.
    """
    D = changes["D"]
    if D is None or not model.rigid_body.shape[1]:
        return None
    held = None
    with attempted("the updated model without its damping", ModelError):
        held = model.replace(M=changes["M"], K=changes["K"], D=None)
    if held is None:
        return None
    rigid = held.rigid_body
    drag = float(np.abs(np.linalg.eigvalsh(rigid.T @ np.asarray(D @ rigid))).max())
    first = solve_modes(held, count=rigid.shape[1] + 1).omega[-1]
    if drag > RIGID_DRAG * float(first):
        return None
    # the rigid-body part of D + d M comes out at 0 in theory, so twice d: above rounding
    shifted = matrix_sum(D, 2.0 * drag * held.M)
    try:
        model.replace(D=shifted)
    except ModelError:
        return None
    return held.with_unchecked_damping(D)


def _replaced(
    model: Any,
    changes: dict[str, Any],
    parameters: Sequence[Parameter],
    p: FloatArray,
    std: FloatArray | None,
) -> Any:
    try:
        # how a machine was joined was checked with the matrices before
        gone = {"joining": None} if getattr(model, "joining", None) is not None else {}
        return model.replace(**changes, **gone)
    except ModelError as error:
        deviations = [None] * p.size if std is None else std.tolist()
        found = zip(parameters, p.tolist(), deviations, strict=True)
        text = ", ".join(q.text(v, deviation) for q, v, deviation in found)
        why = _impossible(model, changes, parameters, p) or error
        raise ModelError(
            f"the update ended at {text}, which the {type(model).__name__} refuses: {why}"
        ) from None


def _impossible(
    model: Any, changes: dict[str, Any], parameters: Sequence[Parameter], p: FloatArray
) -> str:
    """Return in words that D or K is indefinite, by which parameters; empty when neither is."""
    for name in "DK":
        said = "" if changes[name] is None else why_indefinite(changes[name], name)
        if not said:
            continue
        at = "MDK".index(name)
        negative = [
            q.name
            for q, v in zip(parameters, p.tolist(), strict=True)
            if v < 0 and q.change(model, v)[at] is not None
        ]
        keep = ", ".join(negative) or "the parameters"
        return (
            f"{said} The measurement alone does not keep {keep} to what is possible: give bounds=, "
            "(0.0, None) for what can only be added, or measure more."
        )
    return ""

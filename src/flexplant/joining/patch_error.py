"""How much a patch bends: its compliance on average, and as a rigid plate."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
import scipy.linalg as la
import scipy.sparse as sp

from ..labels import DIRECTIONS
from ..modes.attachment_vectors import static_response
from ..modes.shifted import stiffness_factor
from ..sparse.factor import DENSE_LIMIT
from ..values import FloatArray
from .component import Component
from .ends import split_end
from .links import Link
from .patch import Patch

#: patches of more displacements are not examined: each is a load of the component
_MOST = 1000
#: singular values of the compliance of a patch below this part of the largest are none
_RANK = 1e-11


def patch_errors(links: Sequence[Link], parts: Sequence[Component]) -> dict[str, float]:
    """Return, for each patch of a joint, how far apart its bounds of the compliance are.

    With u the displacements of the nodes, C their elastic compliance on the component alone, A the
    rigid motions of the patch and W the mean, ``W A = I``: a load on the mean motion meets
    ``W C W^T``, on a patch that stays rigid ``(A^T C^-1 A)^-1``, which is less (Gauss and Markov).
    What is returned is the largest of 1 - rigid / mean over the axes joined; NaN for a patch of
    more than 1000 displacements, or of an unstable component.
    """
    found: dict[str, float] = {}
    joints = list({id(link.joint): link.joint for link in links}.values())
    for number, joint in enumerate(joints, 1):
        axes = [DIRECTIONS.index(link.axis) for link in links if link.joint is joint]
        for end in (joint.first, joint.second):
            if isinstance(end, Patch):
                name = split_end(f"{end.component}/", [part.name for part in parts])[0]
                part = next(part for part in parts if part.name == name)
                mean, rigid = compliances(part, end, axes)
                found[f"joint {number}, {end!r}"] = float(np.max(1.0 - rigid / mean))
    return found


def compliances(
    part: Component, patch: Patch, axes: Sequence[int]
) -> tuple[FloatArray, FloatArray]:
    """Return the elastic compliance (k,) along axes: of the mean motion, and of a rigid patch."""
    rows, point = patch.rows(part.dofs), patch.point(part.dofs)
    W, A, _ = patch.mean(part.dofs, point)
    if rows.size > _MOST or part.model.n_unstable:
        return np.full(len(axes), np.nan), np.full(len(axes), np.nan)
    C = _compliance(part, rows)
    W, A = W[list(axes)], A[:, list(axes)]
    mean = np.diag(W @ C @ W.T)
    # motions of A cost no energy here, so that C is invertible where the patch can move at all
    beside = float(np.trace(C)) / max(float(np.sum(A**2)), 1e-300)
    stiffness = la.pinvh(C + beside * A @ A.T, rtol=_RANK)
    rigid = np.diag(la.inv(A.T @ stiffness @ A)) - beside
    return np.asarray(mean), np.asarray(rigid)


def _compliance(part: Component, rows: Any) -> FloatArray:
    """Return the elastic compliance (m, m) of some DOFs of a component, free or held."""
    model: Any = part.model
    loads = np.asarray(part.T[rows].T.todense() if not part.is_reduced else part.T[rows].T)
    large = sp.issparse(model.K) and model.n_dof > DENSE_LIMIT
    if large:
        moved = stiffness_factor(model).static(loads)
    else:
        moved = static_response(model.M, model.K, model.rigid_body, loads)
    found = loads.T @ moved
    return np.asarray(0.5 * (found + found.T))

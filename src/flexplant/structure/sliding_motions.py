"""Slides: motions without energy that are not rigid-body motions, as drives need them."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
import scipy.linalg as la

from ..arrays import FloatArray, name_list
from ..errors import ModelError, require_known
from ..sparse.factor import DENSE_LIMIT
from ..sparse.symmetric import dense, unit_diagonal
from ..tolerances import NULL
from .model import FEModel


def slides(model: FEModel) -> dict[str, FloatArray]:
    """Return the zero-energy motions that are not rigid-body motions, each named by a DOF.

    A carriage on its guide, a joint or a screw moves without elastic energy, and a drive controls
    this motion. In an imported model, `solve_modes` refuses such a motion as a mechanism. The
    function `sliding` declares it as a slide, and `solve_modes` then accepts it.

    Parameters
    ----------
    model : FEModel
        A model of at most 3000 DOFs.

    Returns
    -------
    dict {label: (n,) array}
        Motions by the label of a DOF. Each motion moves this DOF by one unit, and does not move the
        DOFs of the other labels.

    Raises
    ------
    ModelError
        When the model is too large.

    Examples
    --------
    A free mass without a slide:

    >>> import flexplant as fx
    >>> dofs = fx.DofSet([1, 1], ["x", "y"], [[0, 0, 0], [0, 0, 0]])
    >>> model = fx.FEModel([[1, 0], [0, 1]], [[0, 0], [0, 5]], dofs=dofs)
    >>> list(fx.structure.slides(model))  # a free x is a rigid-body motion of the geometry
    []
    """
    if model.n_dof > DENSE_LIMIT:
        raise ModelError(
            f"slides are found of at most {DENSE_LIMIT} DOFs, the model has {model.n_dof}: reduce "
            "it first, or pass your own joint_motions=."
        )
    scaled, scale = unit_diagonal(model.K)
    values, vectors = la.eigh(dense(scaled))
    zero = scale[:, None] * vectors[:, np.abs(values) <= NULL * max(float(values[-1]), 1.0)]
    rigid = model.rigid_body
    left = zero - rigid @ (np.asarray(model.M @ rigid).T @ zero)
    extra = zero.shape[1] - rigid.shape[1]
    if extra <= 0:
        return {}
    space = la.svd(left, full_matrices=False)[0][:, :extra]
    chosen = la.qr(space.T, mode="economic", pivoting=True)[2][:extra]
    motions = space @ np.linalg.inv(space[chosen])
    return {model.dofs.labels[row]: motions[:, i] for i, row in enumerate(chosen.tolist())}


def sliding(model: FEModel, names: Sequence[str] | None = None) -> FEModel:
    """Return a model whose free motions (slides) `solve_modes` accepts as modes at 0 Hz.

    Parameters
    ----------
    model : FEModel
        Model with slides: motions without energy that are not rigid-body motions, such as that of a
        carriage on its guide.
    names : sequence of str, optional
        Labels of the accepted slides, as `slides` returns them. None: all slides. `solve_modes`
        refuses every other free motion as a mechanism.

    Raises
    ------
    LabelError, ModelError
        When a named slide does not exist, or the model is too large for `slides`.

    Examples
    --------
    The third mass is held by a spring, and the first two move freely together as a slide:

    >>> import flexplant as fx
    >>> dofs = fx.DofSet([1, 2, 3], ["x", "x", "x"], [[0, 0, 0], [1, 0, 0], [2, 0, 0]])
    >>> K = [[9e3, -9e3, 0], [-9e3, 9e3, 0], [0, 0, 1e4]]
    >>> model = fx.FEModel([[1, 0, 0], [0, 1, 0], [0, 0, 1]], K, dofs=dofs)
    >>> fx.solve_modes(fx.structure.sliding(model), count=3).n_rigid
    1
    """
    found: dict[str, Any] = slides(model)
    chosen = list(found) if names is None else name_list(names, "names")
    require_known("slide", chosen, found)
    motions = [model.rigid_body, *(found[name][:, None] for name in chosen)]
    return model.replace(joint_motions=np.hstack(motions))

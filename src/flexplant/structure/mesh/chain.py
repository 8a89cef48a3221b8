"""Masses in a row, springs and dampers between them."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
import scipy.sparse as sp

from ...checks import FloatArray, frozen, positive, positive_array
from ...errors import ModelError, ShapeError
from ...labels import DofSet
from ..model import FEModel


def chain(
    *,
    masses: Sequence[float] | FloatArray,
    stiffnesses: Sequence[float] | FloatArray,
    dampings: Sequence[float] | FloatArray | None = None,
    ground: float | Sequence[float] | FloatArray = 0.0,
    spacing: float = 1.0,
    name: str | None = None,
) -> FEModel:
    """Return masses in a row along x, springs and dampers between neighbours.

    ``m_i x_i'' = k_{i-1} (x_{i-1} - x_i) + k_i (x_{i+1} - x_i) - g_i x_i``, likewise with dampers.

    Parameters
    ----------
    masses : (n,) array [kg]
        The masses; their DOFs are "1:x", "2:x", ...
    stiffnesses : (n - 1,) array [N/m]
        Between neighbours.
    dampings : (n - 1,) array [N s/m], optional
        Between neighbours; without them the model has no D.
    ground : float or (n,) array [N/m]
        From each mass to the ground.
    spacing : float [m]
        Between neighbours; only the coordinates depend on it.
    name : str, optional
        For display.

    Returns
    -------
    FEModel
        Sparse, of n DOFs.

    Raises
    ------
    ModelError, ShapeError
        When numbers are negative or do not fit one another.

    Examples
    --------
    >>> chain(masses=[1, 2, 3], stiffnesses=[5, 7])
    <FEModel 'chain': 3 DOFs, sparse, 1 rigid-body motion, D not given>
    """
    m = positive_array(masses, "masses", (None,), hint="Leave massless ones out.")
    n = m.size
    if not n:
        raise ModelError("masses is empty: a chain needs one mass at least. Pass [1.0], say.")
    shape = None if np.ndim(ground) == 0 else (n,)
    held = np.zeros(n) + positive_array(ground, "ground", shape, zero=True)
    k = _between(stiffnesses, "stiffnesses", n)
    xyz = np.zeros((n, 3))
    xyz[:, 0] = positive(spacing, "spacing") * np.arange(n)
    return FEModel._proven(
        M=frozen(sp.diags_array(m, format="csc")),
        K=frozen(_laplacian(k, held)),
        D=None
        if dampings is None
        else frozen(_laplacian(_between(dampings, "dampings", n), np.zeros(n))),
        dofs=DofSet(np.arange(1, n + 1), ("x",) * n, xyz),
        name="chain" if name is None else name,
    )


def _between(given: Any, name: str, n: int) -> FloatArray:
    values = positive_array(given, name, (None,), zero=True)
    if values.size != n - 1:
        raise ShapeError(
            f"{n} masses have {n - 1} {name} between them, got {values.size}. Springs to the "
            "ground are given by ground=, dampers by model.with_parts([Damper(...)])."
        )
    return values


def _laplacian(between: FloatArray, ground: FloatArray) -> sp.csc_array:
    main = ground + np.append(between, 0.0) + np.append(0.0, between)
    return sp.csc_array(sp.diags_array([-between, main, -between], offsets=[-1, 0, 1]))

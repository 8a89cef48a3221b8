"""Natural frequencies of matrices without names or places of their rows."""

from __future__ import annotations

from typing import Any

import numpy as np
import scipy.sparse as sp

from ..arrays import FloatArray
from ..errors import ModelError, SolverError
from ..sparse.factor import multifrontal_inertia
from ..sparse.lowest import lowest_modes
from ..sparse.symmetric import EXTRA_VALUES
from ..tolerances import ROOT, TINY

#: largest number of frequencies, since inverse iteration stores all shapes
MOST = 60


def natural_frequencies(K: Any, M: Any, count: int, *, rounding: float) -> FloatArray:
    """Return the lowest frequencies [Hz], zero for motions without energy."""
    n = K.shape[0]
    found = lowest_modes(K, M, min(count + EXTRA_VALUES, n), rounding=rounding)
    values, shapes = found.values, found.shapes
    order = np.argsort(np.where(np.arange(values.size) < found.n_zero, -np.inf, values))
    values, shapes = values[order], shapes[:, order]
    if found.negative is not None or np.any(values[found.n_zero :] <= 0):
        raise ModelError(
            "K has motions of negative energy and cannot be the stiffness of a structure. "
            "check(matrices) names "
            "them."
        )
    values[: found.n_zero] = 0.0
    force, size = K @ shapes - (M @ shapes) * values, abs(K) @ np.abs(shapes)
    off = np.linalg.norm(force, axis=0) / (np.linalg.norm(size, axis=0) + TINY)
    if off.max(initial=0.0) > max(ROOT, rounding):
        raise SolverError(
            f"a shape leaves {off.max():.1g} of its forces: the frequencies are not accurate. "
            "Scale the matrices, or give the DOFs and solve_modes."
        )
    kept = min(count, values.size)
    if values.size < np.count_nonzero(M.diagonal()) and values.size > found.n_zero + 1:
        # by Sylvester's law, in the widest gap
        first = max(found.n_zero, min(kept, values.size - 1))
        ratios = values[first:] / np.maximum(values[first - 1 : -1], TINY)
        at = first + int(np.argmax(ratios))
        shift = 0.5 * (values[at - 1] + values[at])
        below = multifrontal_inertia(sp.csc_array(K - shift * M))
        if below != at:
            raise SolverError(
                f"a Sturm count finds {below} frequencies below {np.sqrt(shift) / 2 / np.pi:.6g} "
                f"Hz, {at} were found. Ask for some more or fewer."
            )
    return np.asarray(np.sqrt(values[:kept]) / (2 * np.pi))

"""Square sparse matrices out of what files hold: one triangle, both, dense or listed."""

from __future__ import annotations

from typing import Any, cast

import numpy as np
import scipy.sparse as sp

from ..errors import ShapeError
from ..values import FloatArray, real_array


def square(given: Any, name: str) -> sp.csc_array:
    """Return a square sparse matrix with finite real entries, without stored zeros."""
    stored: Any = given
    if not sp.issparse(given):
        array = real_array(given, name)
        if array.ndim != 2 or array.shape[0] != array.shape[1]:
            raise ShapeError(
                f"{name} must be square, got shape {array.shape}. Pass an (n, n) array."
            )
        return sp.csc_array(array)
    listed: Any = stored.tocoo()
    if listed.ndim != 2 or listed.shape[0] != listed.shape[1]:
        raise ShapeError(f"{name} must be square, got shape {listed.shape}. Pass an (n, n) array.")
    data: FloatArray = real_array(listed.data, f"stored entries of {name}")
    matrix: Any = sp.csc_array((data, (listed.row, listed.col)), shape=listed.shape)
    matrix.sum_duplicates()
    matrix.eliminate_zeros()
    return cast("sp.csc_array", matrix)


def completed(given: Any, name: str) -> tuple[sp.csc_array, str | None]:
    """Return a symmetric matrix of which a file holds one triangle, and a note of what was done.

    A matrix that stores every pair (i, j), (j, i) at most once, in either triangle, is completed;
    one that stores both is left as it is, for `check` to compare them.
    """
    matrix = square(given, name)
    lower: Any = sp.tril(matrix, -1, format="csc")
    upper: Any = sp.triu(matrix, 1, format="csc")
    if not lower.nnz and not upper.nnz:
        return matrix, None
    pattern = [abs(part).astype(bool).astype(np.int8) for part in (lower, upper.T)]
    if pattern[0].multiply(pattern[1]).nnz:
        return matrix, None
    half: Any = lower + upper
    which = "each pair once" if lower.nnz and upper.nnz else None
    which = which or ("upper triangle only" if upper.nnz else "lower triangle only")
    full: Any = sp.csc_array(half + half.T + sp.diags_array(matrix.diagonal()))
    return full, f"{name}: {which}, completed"

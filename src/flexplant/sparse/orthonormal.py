"""M-orthonormal vectors that extend a basis."""

from __future__ import annotations

from typing import Any

import numpy as np
import scipy.linalg as la

from ..values import FloatArray

#: part of a vector, beyond the basis, below which it depends on it
_DEPENDENT = 1e-5


def beyond(M: Any, V: FloatArray, part: FloatArray, *, dependent: float = _DEPENDENT) -> FloatArray:
    """Return M-orthonormal vectors that span, with V, what V and `part` span."""
    if not part.shape[1]:
        return part
    length = np.sqrt(np.sum(part * np.asarray(M @ part), axis=0))
    part = part / np.where(length > 0, length, 1.0)
    for _ in range(2):
        part = part - V @ (V.T @ np.asarray(M @ part))
    gram = part.T @ np.asarray(M @ part)
    size, mix = la.eigh((gram + gram.T) / 2)
    keep = size > dependent**2
    new = part @ (mix[:, keep] / np.sqrt(size[keep]))
    # once more: what was nearly dependent has lost digits
    new = new - V @ (V.T @ np.asarray(M @ new))
    factor = la.cholesky(new.T @ np.asarray(M @ new), lower=True)
    return np.asarray(la.solve_triangular(factor, new.T, lower=True).T)

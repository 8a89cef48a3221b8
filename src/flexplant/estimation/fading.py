"""The start of a filter in blocks: what a stationary filter does not know of the state yet."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from ..values import FloatArray
from .sight import Sight
from .steady import Steady
from .unknowns import KnownParameters

#: what is left out of a start changes all later estimates, summed over time, by the root of this
#: part of their deviations
FADED = 1e-12
#: largest part of the stationary variance of a state that may still be unknown of it
_LARGEST = 1e4
#: samples of the first stretch, and of the longest: twice as many each time
FIRST, LONGEST = 64, 1024


class ShownSoFar(NamedTuple):
    """What the measurements of a stretch say of eta, before the first and after each of them."""

    value: FloatArray  # (k + 1, r)
    covariance: FloatArray  # (k + 1, r, r)


def excess(
    steady: Steady, weight: FloatArray, P: FloatArray, Z: FloatArray, found: KnownParameters | None
) -> FloatArray | None:
    """Return Y (n, r) with ``P_k = P + Y Y'``, P_k the covariance now and P the stationary one.

    The filter of any first covariance P_k above the stationary P is the stationary filter of a
    first state ``x + Y eta``, eta of zero mean and unit covariance, whose innovations
    ``e = C F^k Y eta + white noise`` show eta by least squares: the partitioned filter. None where
    P_k is not above P, or has so much to show still that digits would be lost.

    References
    ----------
    [Lainiotis1975]_.
    """
    more = P - steady.P
    if Z.shape[1]:
        if found is None or found.open.size:
            return None
        X = Z @ found.X
        if np.any(np.sum(X**2, axis=1) > _LARGEST * steady.P.diagonal().max()):
            return None
        more = more + X @ X.T
    sizes, vectors = np.linalg.eigh(0.5 * (more + more.T))
    below = vectors[:, sizes < 0] * np.sqrt(-sizes[sizes < 0])
    if np.sum((weight @ below) * below) > FADED + 1e-13 * np.sum(np.abs(weight * steady.P)):
        return None
    return kept(weight, vectors[:, sizes > 0] * np.sqrt(sizes[sizes > 0]))


def kept(weight: FloatArray, Y: FloatArray) -> FloatArray:
    """Return the combinations of columns of Y that still matter to later estimates."""
    sizes, mix = np.linalg.eigh(Y.T @ weight @ Y)
    gone = np.cumsum(np.maximum(sizes, 0.0)) < FADED
    return np.asarray(Y @ mix[:, ~gone])


def faded(F: FloatArray, Y: FloatArray, samples: int) -> FloatArray:
    """Return ``F^k Y`` for k = 0 .. samples (samples + 1, n, r)."""
    moved = np.empty((samples + 1, *Y.shape))
    moved[0] = Y
    for k in range(samples):
        np.matmul(F, moved[k], out=moved[k + 1])
    return moved


def shown(rows: FloatArray, white: FloatArray) -> ShownSoFar:
    """Return what whitened innovations ``white = rows eta + noise`` (k, ny) show of eta."""
    count, _, r = rows.shape
    information, values = np.zeros((count + 1, r, r)), np.zeros((count + 1, r))
    information[0] = np.eye(r)
    np.matmul(rows.transpose(0, 2, 1), rows, out=information[1:])
    values[1:] = np.einsum("kyr,ky->kr", rows, white)
    covariance = np.linalg.inv(np.cumsum(information, axis=0))
    covariance = 0.5 * (covariance + covariance.transpose(0, 2, 1))
    return ShownSoFar(np.einsum("krs,ks->kr", covariance, np.cumsum(values, axis=0)), covariance)


def seen(steady: Steady, here: Sight, moved: FloatArray, *, predict: bool) -> FloatArray:
    """Return how eta enters the estimates (k, nz, r)."""
    n = moved.shape[1]
    enter = steady.entering(steady.gains, predict=predict)
    rows = here.c[:, :, :n] - here.c @ enter @ steady.model.C2
    return np.asarray(rows @ moved)

"""Coordinates without mass: they follow the others statically."""

from __future__ import annotations

import numpy as np
import scipy.linalg as la

from ..errors import ModelError
from ..values import FloatArray, IntArray


def static_followers(
    D: FloatArray, K: FloatArray, light: IntArray
) -> tuple[IntArray, FloatArray, FloatArray, FloatArray]:
    """Return the coordinates with mass (c,), how all k follow them (k, c), flexibility and K.

    ``q_light = -K_ll^-1 K_lh q_heavy + K_ll^-1 f_light``, exactly; the flexibility (k, k) is that
    of the second term, K (c, c) what is left of the stiffness.
    """
    k = K.shape[0]
    heavy = np.setdiff1d(np.arange(k), light)
    if np.any(D[light]):
        raise ModelError("a massless coordinate is damped: give it a mass, or no damper.")
    try:
        inverse = la.inv(K[np.ix_(light, light)])
    except la.LinAlgError as error:
        raise ModelError("a massless coordinate has no stiffness: nothing holds it.") from error
    flexibility = np.zeros((k, k))
    flexibility[np.ix_(light, light)] = 0.5 * (inverse + inverse.T)
    follow = np.zeros((k, heavy.size))
    follow[heavy] = np.eye(heavy.size)
    follow[light] = -inverse @ K[np.ix_(light, heavy)]
    left = follow.T @ K @ follow
    return heavy, follow, flexibility, np.asarray(0.5 * (left + left.T), dtype=np.float64)

"""Where a record starts: a machine in its stationary motion, of unknown rigid-body motion."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
import scipy.linalg as la
from scipy.sparse import csgraph

from ..lti.lyapunov import solve_stein
from ..values import FloatArray, IntArray
from .filter_model import FilterModel

#: modulus of a sampled pole from which a mode has no stationary motion
_ON_CIRCLE = 1.0 - 1e-12


class Start(NamedTuple):
    """A first state ``x = Z delta + x'``: delta (r,) quite unknown, x' of covariance P."""

    P: FloatArray
    Z: FloatArray


def stationary_start(model: FilterModel) -> Start:
    """Return the state before a record of a machine that has run for long, with u at rest.

    Modes that are damped have the covariance of their stationary motion, ``P = A P A' + Q``. Modes
    on or outside the unit circle (rigid bodies, undamped ones) have none: their states x_r are
    unknown parameters delta, without any prior. Others that follow them (such as late outputs) do
    so with the states V x_r, ``A_e V - V A_r = -A_er``, so that the rest ``x' = x - V x_r`` is
    stationary.
    """
    n = model.A.shape[0]
    kept = kept_states(model.A)
    rest = np.setdiff1d(np.arange(n), kept)
    P, Z = np.zeros((n, n)), np.zeros((n, kept.size))
    Z[kept, np.arange(kept.size)] = 1.0
    A, Q = model.A[np.ix_(rest, rest)], model.Q[np.ix_(rest, rest)]
    entering = model.A[np.ix_(rest, kept)]
    if np.any(entering):
        V = la.solve_sylvester(A, -model.A[np.ix_(kept, kept)], -entering)
        Z[rest] = V
        A = A - V @ model.A[np.ix_(kept, rest)]
        left = np.zeros((rest.size, n))
        left[:, rest], left[:, kept] = np.eye(rest.size), -V
        Q = left @ model.Q @ left.T
    P[np.ix_(rest, rest)] = solve_stein(A, 0.5 * (Q + Q.T))
    return Start(P, Z)


def kept_states(A: FloatArray) -> IntArray:
    """Return the states of modes on or outside the unit circle.

    Judged on the parts of A that are coupled both ways, so that the two eigenvalues 1 of a
    rigid-body mode are exact.
    """
    count, owner = csgraph.connected_components(A != 0, directed=True, connection="strong")
    kept = []
    for part in range(count):
        states = np.flatnonzero(owner == part)
        radius = np.max(np.abs(np.linalg.eigvals(A[np.ix_(states, states)])))
        if radius >= _ON_CIRCLE:
            kept.append(states)
    return np.sort(np.concatenate(kept)) if kept else np.zeros(0, dtype=np.int64)

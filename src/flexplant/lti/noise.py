"""White noise through a sampled system: one discretisation for filter design and simulation."""

from __future__ import annotations

import numpy as np
import scipy.linalg as la

from ..values import FloatArray
from .discretisation import diagonal_pairs, pair_expm
from .statespace import StateSpace


def noise_factor(g: StateSpace, asd: FloatArray, h: float) -> FloatArray:
    """Return G with ``G G' = Q_d``, the covariance that white noise adds to x in one sample.

    ``Q_d = int_0^h e^(A s) B S B' e^(A' s) ds`` with S = diag(asd^2 / 2), the intensity of noise
    with the one-sided amplitude spectral density asd. The integral is Gauss-Legendre quadrature
    with the exact (closed-form) exponential at each node; the order is chosen from the fastest
    eigenvalue so that the quadrature is exact to rounding. As a sum of squares Q_d is positive
    semidefinite by construction, for any scaling of the states; the block exponential of Van Loan
    was seen to lose that on large models.

    Parameters
    ----------
    g : StateSpace
        Continuous, m inputs.
    asd : (m,) array [input unit / sqrt(Hz)]
        One-sided; zero for inputs without noise.
    h : float [s]
        Sampling time.

    Returns
    -------
    (n, r) array
        r <= n.
    """
    n = g.n_states
    active = np.flatnonzero(asd)
    if not n or not active.size:
        return np.zeros((n, 0))
    B = g.B[:, active] * (np.asarray(asd)[active] / np.sqrt(2.0))
    turns = 2.0 * h * float(np.max(np.abs(g.poles()), initial=0.0))
    # Gauss-Legendre of order N integrates e^(i t s) over [0, 1] to rounding once N > t / 4 + 12
    nodes, weights = np.polynomial.legendre.leggauss(16 + int(np.ceil(0.35 * turns)))
    times, weights = 0.5 * h * (nodes + 1.0), 0.5 * h * weights
    pairs = diagonal_pairs(g)
    parts = []
    for time, weight in zip(times, weights, strict=True):
        if pairs is None:
            moved = la.expm(g.A * time) @ B
        else:
            E = pair_expm(pairs, time)
            moved = np.einsum("bij,bjm->bim", E, B.reshape(-1, 2, B.shape[1])).reshape(B.shape)
        parts.append(np.sqrt(weight) * moved)
    G = np.hstack(parts)
    if G.shape[1] <= n:
        return G
    return np.asarray(la.qr(G.T, mode="r")[0][:n].T)

"""White noise through a sampled system: one discretisation for filter design and simulation."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import scipy.linalg as la

from ..values import FloatArray
from .discretisation import block_diagonal, diagonal_pairs, pair_expm
from .factors import compressed
from .statespace import StateSpace

#: nodes that integrate ``e^(A s) B B' e^(A' s)`` to rounding over a piece of |A| s <= 1
_NODES = 10


def accumulated_noise(
    at: Callable[[float], FloatArray], force: FloatArray, time: float, rate: float
) -> FloatArray:
    """Return G (n, r) with ``G G' = int_0^time e^(A s) force force' e^(A' s) ds``.

    Gauss-Legendre quadrature. Over the whole interval where as many nodes as make it exact to
    rounding give less than n columns, as for a large structure with few forces. Else over a piece
    so short that ten nodes are exact, then ``G(2 t) = [G(t), e^(A t) G(t)]``: log2(time rate)
    steps, however fast the modes are. Sums of squares, so that G G' is positive semidefinite in
    any units; the block exponential of [VanLoan1978]_ was seen to lose that on large models.
    """
    n, m = force.shape
    # the error is a Bessel function of order 2 count and argument |A| time: nothing beyond there
    size = min(rate * time, 2.0 * n)
    count, doublings = _NODES + int(np.ceil(0.5 * size + 4.0 * np.cbrt(size))), 0
    if count * m >= n:
        count, doublings = _NODES, max(0, int(np.ceil(np.log2(max(rate * time, 1e-300)))))
    piece = time / 2**doublings
    nodes, weights = np.polynomial.legendre.leggauss(count)
    parts = [
        np.sqrt(0.5 * piece * weight) * (at(0.5 * piece * (node + 1.0)) @ force)
        for node, weight in zip(nodes, weights, strict=True)
    ]
    G = compressed(np.hstack(parts))
    for k in range(doublings):
        G = compressed(np.hstack([G, at(piece * 2**k) @ G]))
    return G


def noise_factor(g: StateSpace, asd: FloatArray, h: float) -> FloatArray:
    """Return G with ``G G' = Q_d``, the covariance that white noise adds to x in one sample.

    ``Q_d = int_0^h e^(A s) B S B' e^(A' s) ds`` with S = diag(asd^2 / 2), the intensity of noise
    with the one-sided amplitude spectral density asd (`accumulated_noise`).
    """
    n = g.n_states
    active = np.flatnonzero(asd)
    if not n or not active.size:
        return np.zeros((n, 0))
    B = g.B[:, active] * (np.asarray(asd)[active] / np.sqrt(2.0))
    pairs = diagonal_pairs(g)
    if pairs is None:
        rate = float(np.linalg.norm(g.A, 1))
        return accumulated_noise(lambda time: np.asarray(la.expm(g.A * time)), B, h, rate)
    rate = float(np.max(np.abs(g.poles()), initial=0.0))
    return accumulated_noise(lambda time: block_diagonal(pair_expm(pairs, time)), B, h, rate)

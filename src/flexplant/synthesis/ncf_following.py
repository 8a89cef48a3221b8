"""Loop shaping with two degrees of freedom: the loop is robust and follows a reference model."""

from __future__ import annotations

import numpy as np
import scipy.linalg as la

from ..errors import ModelError
from ..lti.discretisation import tustin
from ..lti.minimal import minimal
from ..lti.responses import responses
from ..lti.statespace import StateSpace
from ..values import FloatArray
from .hinf import design_hinf
from .ncf import continuous, riccati_solutions

#: frequency, beside the slowest pole of the model, that stands for zero
_SLOW = 1e-4


def following(shaped: StateSpace, model: StateSpace, weight: float) -> tuple[StateSpace, float]:
    """Return ``[K1 W, K2]``, from references and y to u, of a shaped plant, and its gamma.

    ``u = K1 r + K2 y`` minimises the norm from [r; phi] to [u; y; e], where ``y = M^-1 (N u +
    phi)`` with the normalised left coprime factors N, M of the plant, ``r`` counts rho times and
    ``e = rho (y - rho T_ref r)``: the larger rho (`weight`), the closer the loop follows the model
    T_ref, the less robust it is. W brings the gain at zero frequency to that of the model.

    References
    ----------
    [Hoyle1991]_; [Limebeer1993]_.
    """
    p, m = len(shaped.outputs), len(shaped.inputs)
    if model.dt or model.D.shape != (p, p) or not model.is_stable:
        raise ModelError(
            f"the reference model must be continuous and stable, with {p} inputs and outputs, got "
            f"{model!r}. Pass low-passes of the loop's bandwidth, one for each axis."
        )
    part = minimal(shaped)
    _, Z = riccati_solutions(part)
    g = continuous(part)
    values, vectors = np.linalg.eigh(np.eye(p) + g.D @ g.D.T)
    root, inverse = ((vectors * values**e) @ vectors.T for e in (0.5, -0.5))
    P = _problem(g, model, Z, root, inverse, weight)
    found = design_hinf(P, u=P.inputs[-m:], y=P.outputs[-2 * p :])
    K = tustin(found.system, 1.0 / shaped.dt) if shaped.dt else found.system
    W = la.block_diag(_scaling(shaped, model, K), np.eye(p))
    return K.replace(B=K.B @ W, D=K.D @ W), float(found.gamma or np.nan)


def _problem(
    g: StateSpace,
    model: StateSpace,
    Z: FloatArray,
    root: FloatArray,
    inverse: FloatArray,
    rho: float,
) -> StateSpace:
    """Return [r; phi; u] -> [u; y; e; rho r; y]."""
    p, m = g.D.shape
    n, q = g.n_states, model.n_states
    zero = np.zeros
    A = np.block([[g.A, zero((n, q))], [zero((q, n)), model.A]])
    shake = (g.B @ g.D.T + Z @ g.C.T) @ inverse
    B = np.block([[zero((n, p)), shake, g.B], [model.B, zero((q, p + m))]])
    C = np.block(
        [
            [zero((m, n + q))],
            [g.C, zero((p, q))],
            [rho * g.C, -(rho**2) * model.C],
            [zero((p, n + q))],
            [g.C, zero((p, q))],
        ]
    )
    D = np.block(
        [
            [zero((m, 2 * p)), np.eye(m)],
            [zero((p, p)), root, g.D],
            [-(rho**2) * model.D, rho * root, rho * g.D],
            [rho * np.eye(p), zero((p, p + m))],
            [zero((p, p)), root, g.D],
        ]
    )
    return StateSpace(A, B, C, D)


def _scaling(shaped: StateSpace, model: StateSpace, K: StateSpace) -> FloatArray:
    """Return W with ``(I - G K2)^-1 G K1 W = T_ref`` at a frequency that stands for zero."""
    slowest = float(np.abs(model.poles()).min(initial=np.inf)) / (2.0 * np.pi)
    freq = np.array([_SLOW * (slowest if np.isfinite(slowest) else 1.0)])
    G, gains, T = (responses(s, freq)[:, :, 0] for s in (shaped, K, model))
    p = T.shape[0]
    X = np.linalg.solve(np.eye(p) - G @ gains[:, p:], G @ gains[:, :p])
    return np.asarray(np.linalg.solve(X, T).real)

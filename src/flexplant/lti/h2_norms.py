"""The H2 norm, by both Gramians."""

from __future__ import annotations

import numpy as np

from ..errors import CertificateError
from ..parallel import one_thread
from ..values import FloatArray
from .lyapunov import controllability_gramian, observability_gramian
from .stability import obstacle
from .statespace import System, as_statespace

#: the squares of the H2 norm by both Gramians agree to this, or to rounding of their terms
AGREEMENT, ROUNDING = 2e-8, 1e-13


@one_thread()
def h2_norm(sys: System) -> float:
    """Return the H2 norm: the rms of all outputs together for white inputs of unit intensity.

    ``trace(C P C')^(1/2)``, P the controllability Gramian (``trace(C P C' + D D')^(1/2)`` when
    sampled). Exact in modal blocks. The observability Gramian Q gives it a second time,
    ``trace(B' Q B) = trace(C P C')``: both agree to 1e-8, or to the rounding of their terms.

    Parameters
    ----------
    sys : StateSpace or control.StateSpace
        Continuous or sampled.

    Returns
    -------
    float
        Infinite when the system is not strictly stable (rigid-body modes are not), or continuous
        with feedthrough; `norm_report` says which.

    Raises
    ------
    ModelError
        When `sys` is no system.
    SolverError
        When a Gramian is too badly conditioned for its residual.
    CertificateError
        When the two Gramians give different norms.

    References
    ----------
    [ZhouDoyleGlover1996]_, section 4.6.

    Examples
    --------
    >>> import flexplant as fx
    >>> print(f"{fx.h2_norm(fx.StateSpace([[-2.0]], [[1.0]], [[1.0]], [[0.0]])):.3f}")
    0.500
    """
    g = as_statespace(sys)
    if obstacle(g) is not None or (not g.dt and g.n_states and np.any(g.D)):
        return float("inf")
    if not g.n_states:
        return float(np.linalg.norm(g.D)) if g.dt else (float("inf") if np.any(g.D) else 0.0)
    square, terms = _trace(g.C, controllability_gramian(g))
    other, their = _trace(g.B.T, observability_gramian(g))
    direct = float(np.sum(g.D**2)) if g.dt else 0.0
    allowed = AGREEMENT * (max(square, other) + direct) + ROUNDING * max(terms, their)
    if not abs(square - other) <= allowed:
        raise CertificateError(
            f"the H2 norm of {g!r} is {np.sqrt(max(square, 0.0)):.9g} by the controllability "
            f"Gramian and {np.sqrt(max(other, 0.0)):.9g} by the observability Gramian: a pole is "
            "too close to the edge of stability for double precision. Check the least damped poles."
        )
    return float(np.sqrt(max(square + direct, 0.0)))


def _trace(C: FloatArray, P: FloatArray) -> tuple[float, float]:
    """Return ``trace(C P C')`` and the size of its terms before they cancel."""
    deviation = np.abs(C) @ np.sqrt(np.maximum(P.diagonal(), 0.0))
    return float(np.sum(C @ P * C)), float(np.sum(deviation**2))

"""Riccati equations by structure-preserving doubling, scaled inside, corrected, checked.

The forms are those of the filter (`control_dare` and `control_care` are the duals)::

    P = A P A' - (A P C' + S) (C P C' + R)^-1 (A P C' + S)' + Q        discrete
    0 = A P + P A' - (P C' + S) R^-1 (P C' + S)' + Q                   continuous

R is symmetric and non-singular, not necessarily definite (H-infinity). Models of machines in SI
units (1e-9 m/N, 1e-10 m, rigid-body modes at 1) defeat solvers that do not scale.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np

from ..errors import ModelError, counted
from ..values import ComplexArray, FloatArray, Value, real_array
from .doubling import Continuous, Discrete, RiccatiProblem, solved
from .lyapunov import symmetric


@dataclass(frozen=True, eq=False, repr=False)
class RiccatiSolution(Value):
    """The stabilising solution of a Riccati equation, with what was checked about it.

    Parameters
    ----------
    P : (n, n) array
        Symmetric.
    gain : (n, p) array
        ``K = (A P C' + S) (C P C' + R)^-1`` (or ``(P C' + S) R^-1``): the filter's closed loop is
        A - K C. From the control forms it is F (m, n), closed loop A - B F.
    poles : (n,) array
        Eigenvalues of the closed loop.
    residual : float
        Norm of the equation's residual relative to P, states scaled to unit variance.
    iterations : int
        Doubling and Newton steps.

    Examples
    --------
    >>> import flexplant as fx
    >>> found = fx.lti.solve_dare([[1.0]], [[1.0]], Q=[[2.0]], R=[[1.0]])
    >>> round(found.spectral_radius, 6), found.residual < 1e-12
    (0.267949, True)
    """

    P: FloatArray
    gain: FloatArray
    poles: ComplexArray
    residual: float
    iterations: int

    def __repr__(self) -> str:
        return (
            f"<RiccatiSolution: {counted(self.P.shape[0], 'state')}, residual {self.residual:.1e}, "
            f"{counted(self.iterations, 'iteration')}>"
        )

    @property
    def spectral_radius(self) -> float:
        """Largest modulus of the closed-loop eigenvalues (below 1 for a discrete equation)."""
        return float(np.max(np.abs(self.poles), initial=0.0))

    @property
    def spectral_abscissa(self) -> float:
        """Largest real part of the closed-loop eigenvalues (below 0 for a continuous equation)."""
        return float(np.max(self.poles.real, initial=-np.inf))


def solve_dare(
    A: FloatArray,
    C: FloatArray,
    *,
    Q: FloatArray,
    R: FloatArray,
    S: FloatArray | None = None,
) -> RiccatiSolution:
    """Return the stabilising solution of the discrete filter Riccati equation.

    ``P = A P A' - (A P C' + S) (C P C' + R)^-1 (A P C' + S)' + Q``. Structure-preserving
    doubling in scaled states, then Newton steps on the residual (each a Stein equation) in
    states of unit variance.

    Parameters
    ----------
    A : (n, n) array
        May have eigenvalues on and outside the unit circle.
    C : (p, n) array
        Outputs.
    Q : (n, n) array
        Symmetric; covariance of the process noise for a filter.
    R : (p, p) array
        Symmetric, non-singular, possibly indefinite.
    S : (n, p) array, optional
        Cross term; zero when not given.

    Returns
    -------
    RiccatiSolution
        P of x before its measurement, and the predictor gain.

    Raises
    ------
    ShapeError, ModelError
        For bad sizes, entries that are not finite, a singular R.
    SolverError
        When no strictly stabilising solution exists (a mode on the unit circle that Q does not
        excite, an unstable one that C does not see) or the residual stays bad.

    References
    ----------
    [Chu2004]_.

    Examples
    --------
    >>> import numpy as np
    >>> one = np.eye(1)
    >>> print(f"{solve_dare(one, one, Q=one, R=one).P[0, 0]:.12f}")  # the golden ratio
    1.618033988750
    """
    return RiccatiSolution(*solved(_problem(A, C, Q, R, S), Discrete()))


def solve_care(
    A: FloatArray,
    C: FloatArray,
    *,
    Q: FloatArray,
    R: FloatArray,
    S: FloatArray | None = None,
) -> RiccatiSolution:
    """Return the stabilising solution of the continuous filter Riccati equation.

    ``0 = A P + P A' - (P C' + S) R^-1 (P C' + S)' + Q``, by a Cayley transform to the doubling
    of the discrete equation, then Newton steps on its own residual.

    Parameters
    ----------
    A, C, Q, R, S : arrays
        As in `solve_dare`; Q and R intensities instead of covariances.

    Returns
    -------
    RiccatiSolution
        Closed loop A - K C with K = (P C' + S) R^-1.

    Raises
    ------
    ShapeError, ModelError, SolverError
        As `solve_dare`.

    References
    ----------
    [Chu2005]_.

    Examples
    --------
    >>> import flexplant as fx
    >>> found = fx.lti.solve_care([[0.0]], [[1.0]], Q=[[4.0]], R=[[1.0]])
    >>> found.P.round(9), found.poles.real.round(9)  # p^2 = 4
    (array([[2.]]), array([-2.]))
    """
    return RiccatiSolution(*solved(_problem(A, C, Q, R, S), Continuous()))


def control_dare(
    A: FloatArray,
    B: FloatArray,
    *,
    Q: FloatArray,
    R: FloatArray,
    S: FloatArray | None = None,
) -> RiccatiSolution:
    """Return X of ``X = A' X A - (A' X B + S) (B' X B + R)^-1 (A' X B + S)' + Q``.

    The dual of `solve_dare`: `gain` is F with u = -F x, closed loop A - B F.

    Parameters
    ----------
    A : (n, n) array
        May have eigenvalues that are not stable.
    B : (n, m) array
        Inputs.
    Q : (n, n) array
        Symmetric; cost of x.
    R : (m, m) array
        Symmetric, non-singular, possibly indefinite; cost of u.
    S : (n, m) array, optional
        Cross term; zero when not given.

    Returns
    -------
    RiccatiSolution
        X as `P`, and the gain (m, n).

    Raises
    ------
    ShapeError, ModelError, SolverError
        As `solve_dare`.

    References
    ----------
    [Chu2004]_.

    Examples
    --------
    >>> import flexplant as fx
    >>> fx.lti.control_dare([[1.0]], [[1.0]], Q=[[2.0]], R=[[1.0]]).P.round(9)  # p^2 = 2 p + 2
    array([[2.73205081]])
    """
    return _dual(solve_dare, A, B, Q=Q, R=R, S=S)


def control_care(
    A: FloatArray,
    B: FloatArray,
    *,
    Q: FloatArray,
    R: FloatArray,
    S: FloatArray | None = None,
) -> RiccatiSolution:
    """Return X of ``0 = A' X + X A - (X B + S) R^-1 (X B + S)' + Q``.

    The dual of `solve_care`: `gain` is F with u = -F x, closed loop A - B F.

    Parameters
    ----------
    A, B, Q, R, S : arrays
        As in `control_dare`.

    Returns
    -------
    RiccatiSolution
        X as `P`, and the gain (m, n).

    Raises
    ------
    ShapeError, ModelError, SolverError
        As `solve_dare`.

    References
    ----------
    [Chu2005]_.

    Examples
    --------
    >>> import flexplant as fx
    >>> fx.lti.control_care([[0.0]], [[1.0]], Q=[[4.0]], R=[[1.0]]).P.round(9)
    array([[2.]])
    """
    return _dual(solve_care, A, B, Q=Q, R=R, S=S)


def _dual(
    solve: Callable[..., RiccatiSolution], A: FloatArray, B: FloatArray, **rest: Any
) -> RiccatiSolution:
    solution = solve(np.asarray(A).T, np.asarray(B).T, **rest)
    return solution.replace(gain=solution.gain.T)


def _problem(
    A: FloatArray, C: FloatArray, Q: FloatArray, R: FloatArray, S: FloatArray | None
) -> RiccatiProblem:
    A = real_array(A, "A", (None, None))
    n = A.shape[0]
    A = real_array(A, "A", (n, n))
    C = real_array(C, "C", (None, n))
    p = C.shape[0]
    Q = symmetric(Q, "Q", n)
    R = symmetric(R, "R", p)
    cross = np.zeros((n, p)) if S is None else real_array(S, "S", (n, p))
    largest = np.sqrt(np.max(np.abs(R), axis=1, initial=0.0))
    if np.any(largest == 0):
        raise ModelError(
            f"row {int(np.argmin(largest))} of R is zero: the Riccati equation needs a "
            "non-singular R. Give every output noise (every input a cost)."
        )
    values, vectors = np.linalg.eigh(R / largest / largest[:, None])
    if p and np.min(np.abs(values)) < 1e-13:
        raise ModelError(
            f"R is singular to working precision (scaled eigenvalue {np.min(np.abs(values)):.1e}). "
            "Give every combination of outputs noise (of inputs a cost)."
        )
    whitening = (vectors / np.sqrt(np.abs(values))).T / largest
    J = np.sign(values)
    C, cross = whitening @ C, cross @ whitening.T
    shift = cross * J
    return RiccatiProblem(A - shift @ C, C, Q - shift @ cross.T, J, shift, whitening)

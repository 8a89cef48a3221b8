"""Riccati equations: doubling (discrete), the Hamiltonian (continuous); scaled, corrected, checked.

The forms are those of the filter (`control_dare` and `control_care` are the duals)::

    P = A P A' - (A P C' + S) (C P C' + R)^-1 (A P C' + S)' + Q        discrete
    0 = A P + P A' - (P C' + S) R^-1 (P C' + S)' + Q                   continuous

R is symmetric and non-singular, not necessarily definite (H-infinity). Models of machines in SI
units (1e-9 m/N, 1e-10 m, rigid-body modes at 1) defeat solvers that do not scale.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, NamedTuple, TypeAlias

import numpy as np
import scipy.linalg as la

from ..arrays import ComplexArray, FloatArray, divisor, real_array
from ..errors import ModelError, SolverError, counted
from ..parallel import one_thread
from ..store import Value
from ..tolerances import CLOSE, MISSED, MOST_STEPS, NULL, RANK, ROOT, SAME, SETTLED, SPLIT
from .equations import (
    OnAxisError,
    accumulated,
    cayley,
    doubled,
    doubled_riccati,
    lyapunov,
    relative,
    scale_of,
    stable_subspace,
    state_scale,
    symmetric,
    symmetrised,
    triangular,
)
from .lyapunov import stein_root


@dataclass(frozen=True, eq=False, repr=False)
class RiccatiSolution(Value):
    """The stabilising solution of a Riccati equation, with its checks.

    Parameters
    ----------
    P : (n, n) array
        Solution of the equation, symmetric.
    gain : (n, p) array
        Gain of the filter or of the controller. A filter has the gain
        ``K = (A P C' + S) (C P C' + R)^-1`` in discrete time, or ``K = (P C' + S) R^-1`` in
        continuous time, and the closed loop A - K C. The control equations have the gain F (m, n),
        with the closed loop A - B F.
    poles : (n,) array
        Eigenvalues of the closed loop.
    residual : float
        Norm of the residual of the equation relative to the norm of its terms, computed in states
        that are scaled to unit variance.
    iterations : int
        Number of doubling and Newton steps.
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


def filter_dare(
    A: FloatArray, C: FloatArray, *, Q: FloatArray, R: FloatArray, S: FloatArray | None = None
) -> RiccatiSolution:
    """Return the stabilising solution of the discrete filter Riccati equation.

    ``P = A P A' - (A P C' + S) (C P C' + R)^-1 (A P C' + S)' + Q`` is solved by the
    structure-preserving doubling algorithm in scaled states. Newton steps then refine the solution,
    in states that are scaled to unit variance; each step solves a Stein equation (discrete Lyapunov
    equation).

    Parameters
    ----------
    A : (n, n) array
        State matrix; eigenvalues on and outside the unit circle are allowed.
    C : (p, n) array
        Outputs.
    Q : (n, n) array
        Symmetric matrix; for a filter it is the covariance of the process noise.
    R : (p, p) array
        Symmetric, non-singular matrix; for a filter it is the covariance of the sensor noise. It
        may be indefinite.
    S : (n, p) array, optional
        Cross term; by default zero.

    Returns
    -------
    RiccatiSolution
        Covariance P of x before its measurement, and the gain of the predictor.

    Raises
    ------
    ShapeError, ModelError
        For wrong sizes, entries that are not finite, or a singular R.
    SolverError
        When no strictly stabilising solution exists, because Q does not excite a mode on the unit
        circle or C does not see an unstable mode. Also when the residual stays too large.

    References
    ----------
    [Chu2004]_.

    Examples
    --------
    >>> import numpy as np
    >>> one = np.eye(1)
    >>> print(f"{filter_dare(one, one, Q=one, R=one).P[0, 0]:.12f}")  # the golden ratio
    1.618033988750
    """
    return _solve_riccati(_riccati_problem(A, C, Q, R, S, discrete=True))


def filter_care(
    A: FloatArray, C: FloatArray, *, Q: FloatArray, R: FloatArray, S: FloatArray | None = None
) -> RiccatiSolution:
    """Return the stabilising solution of the continuous filter Riccati equation.

    ``0 = A P + P A' - (P C' + S) R^-1 (P C' + S)' + Q`` is solved by the stable subspace of the
    Hamiltonian in scaled states. Some problems have poles so slow, about 1e-12 times the fastest,
    that eigenvalues of the Hamiltonian lie on the imaginary axis within rounding. A Cayley
    transform then turns the problem into a discrete one, which the doubling of `filter_dare`
    solves. In both cases Newton steps refine the solution.

    Parameters
    ----------
    A, C, Q, R, S : arrays
        As in `filter_dare`, but Q and R are intensities instead of covariances.

    Returns
    -------
    RiccatiSolution
        Closed loop A - K C with K = (P C' + S) R^-1.

    Raises
    ------
    ShapeError, ModelError, SolverError
        As `filter_dare`.

    References
    ----------
    [Laub1979]_, [Chu2005]_.

    Examples
    --------
    >>> import flexplant as fx
    >>> found = fx.lti.filter_care([[0.0]], [[1.0]], Q=[[4.0]], R=[[1.0]])
    >>> found.P.round(9), found.poles.real.round(9)  # p^2 = 4
    (array([[2.]]), array([-2.]))
    """
    return _solve_riccati(_riccati_problem(A, C, Q, R, S, discrete=False))


def control_dare(
    A: FloatArray, B: FloatArray, *, Q: FloatArray, R: FloatArray, S: FloatArray | None = None
) -> RiccatiSolution:
    """Return X of ``X = A' X A - (A' X B + S) (B' X B + R)^-1 (A' X B + S)' + Q``.

    This equation is the dual of that of `filter_dare`. The `gain` of the result is F of the law
    ``u = -F x``, which gives the closed loop A - B F.

    Parameters
    ----------
    A : (n, n) array
        State matrix; unstable eigenvalues are allowed.
    B : (n, m) array
        Inputs.
    Q : (n, n) array
        Symmetric weight of the states x in the cost.
    R : (m, m) array
        Symmetric, non-singular weight of the inputs u in the cost; it may be indefinite.
    S : (n, m) array, optional
        Cross term; by default zero.

    Returns
    -------
    RiccatiSolution
        X as `P`, and the gain (m, n).

    Raises
    ------
    ShapeError, ModelError, SolverError
        As `filter_dare`.

    Examples
    --------
    >>> import flexplant as fx
    >>> fx.lti.control_dare([[1.0]], [[1.0]], Q=[[2.0]], R=[[1.0]]).P.round(9)  # p^2 = 2 p + 2
    array([[2.73205081]])
    """
    return _dual(filter_dare, A, B, Q=Q, R=R, S=S)


def control_care(
    A: FloatArray, B: FloatArray, *, Q: FloatArray, R: FloatArray, S: FloatArray | None = None
) -> RiccatiSolution:
    """Solve ``0 = A' X + X A - (X B + S) R^-1 (X B + S)' + Q``; the result contains X as `P`.

    The result is a `RiccatiSolution`, whose attribute `P` is X. This equation is the dual of that
    of `filter_care`. The `gain` of the result is F of the law ``u = -F x``, which gives the closed
    loop A - B F.

    Parameters
    ----------
    A, B, Q, R, S : as in `control_dare`

    Raises
    ------
    ShapeError, ModelError, SolverError
        As `filter_dare`.

    Examples
    --------
    >>> import flexplant as fx
    >>> fx.lti.control_care([[0.0]], [[1.0]], Q=[[4.0]], R=[[1.0]]).P.round(9)
    array([[2.]])
    """
    return _dual(filter_care, A, B, Q=Q, R=R, S=S)


def _dual(
    solve: Callable[..., RiccatiSolution], A: FloatArray, B: FloatArray, **rest: Any
) -> RiccatiSolution:
    A, B = (real_array(part, name, (None, None)) for part, name in ((A, "A"), (B, "B")))
    solution = solve(A.T, B.T, **rest)
    return solution.replace(gain=solution.gain.T)


def _riccati_problem(
    A: FloatArray,
    C: FloatArray,
    Q: FloatArray,
    R: FloatArray,
    S: FloatArray | None,
    *,
    discrete: bool,
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
    if p and np.min(np.abs(values)) < RANK:
        raise ModelError(
            f"R is singular to working precision (scaled eigenvalue {np.min(np.abs(values)):.1e}). "
            "Give every combination of outputs noise (of inputs a cost)."
        )
    whitening = (vectors / np.sqrt(np.abs(values))).T / largest
    J = np.sign(values)
    C, cross = whitening @ C, cross @ whitening.T
    shift = cross * J
    return RiccatiProblem(A - shift @ C, C, Q - shift @ cross.T, J, shift, whitening, discrete)


class RiccatiProblem(NamedTuple):
    """A problem with whitened outputs (R is J, a diagonal of signs) and no cross term."""

    A: FloatArray
    C: FloatArray
    Q: FloatArray
    J: FloatArray  # (p,) of +1 and -1
    gain: FloatArray  # (n, p), contribution of the cross term to the gain
    whitening: FloatArray  # (p, p), whitened y = whitening y
    discrete: bool

    @property
    def G(self) -> FloatArray:
        """Return ``C' J C``, the information of one measurement."""
        return np.asarray((self.C.T * self.J) @ self.C)

    @property
    def whole(self) -> FloatArray:
        """Return Q without the part of the cross term."""
        return np.asarray(self.Q + (self.gain * self.J) @ self.gain.T)

    def scaled(self, d: FloatArray) -> RiccatiProblem:
        """Return the problem in states x / d."""
        return self._replace(
            A=self.A * d / d[:, None],
            C=self.C * d,
            Q=self.Q / d / d[:, None],
            gain=self.gain / d[:, None],
        )


def _growth(p: RiccatiProblem, poles: ComplexArray) -> FloatArray:
    """Return the distance of poles beyond the stability limit."""
    return np.asarray(np.abs(poles) - 1.0 if p.discrete else poles.real)


def _riccati_gain(p: RiccatiProblem, P: FloatArray) -> FloatArray:
    """Return the gain K (n, p) that belongs to P."""
    if not p.discrete:
        return np.asarray(P @ p.C.T * p.J)
    inner = (p.C @ P) @ p.C.T + np.diag(p.J)
    return np.asarray(la.solve(inner, p.C @ P @ p.A.T, assume_a="sym").T)


def _residual(p: RiccatiProblem, P: FloatArray, K: FloatArray) -> tuple[FloatArray, float]:
    """Return the residual of the equation, given the gain of P, and its relative size."""
    closed = p.A - K @ p.C
    # Joseph form: a sum of squares in P and J, so rounding stays relative to P
    driven = (K * p.J) @ K.T + p.Q
    size = float(np.linalg.norm(P))
    if p.discrete:
        residual = closed @ P @ closed.T + driven - P
        return residual, relative(residual, size)
    residual = closed @ P + P @ closed.T + driven
    return residual, relative(residual, float(np.linalg.norm(p.A)) * size, float(la.norm(p.Q)))


def _sizes(p: RiccatiProblem) -> FloatArray:
    """Return sizes of the states for which noise and information are even."""
    if not p.discrete:
        return 1.0 / state_scale(p.A.T, p.C.T, np.sqrt(np.abs(p.whole.diagonal()))[None, :])
    return _even_sizes(p.A.T, p.G, p.Q)


def _even_sizes(A: FloatArray, G: FloatArray, Q: FloatArray) -> FloatArray:
    """Return those of the states of a discrete equation in control form."""
    states, information = accumulated(A.T, Q), accumulated(A, G)
    return scale_of(
        np.where(
            (states > 0) & (information > 0),
            np.sqrt(states) / np.sqrt(divisor(information)),
            np.where(states > 0, states, 1.0 / divisor(information)),
        )
    )


def _discrete(p: RiccatiProblem) -> tuple[FloatArray, ...]:
    """Return A, G, Q of the discrete equation (control form) of the same solution."""
    return (p.A.T, p.G, p.Q) if p.discrete else cayley(p.A.T, p.G, p.Q)


#: a first P in states x / d, d, and the number of doublings
_Start: TypeAlias = tuple[FloatArray, FloatArray, int]


def _by_subspace(p: RiccatiProblem) -> _Start:
    """Start the continuous equation from the stable subspace of its Hamiltonian."""
    d = _sizes(p)
    q = p.scaled(d)
    return stable_subspace(q.A.T, q.G, q.Q, np.ones(d.size), q.whole), d, 0


def _by_doubling(p: RiccatiProblem) -> _Start:
    """Start from the doubling of the discrete equation, of a continuous one's Cayley transform."""
    d = _even_sizes(*_discrete(p))
    P, doublings = doubled_riccati(*_discrete(p.scaled(d)))
    return P, d, doublings


@one_thread()
@np.errstate(over="ignore", invalid="ignore")
def _solve_riccati(problem: RiccatiProblem) -> RiccatiSolution:
    """Return the stabilising solution, scaled back."""
    n = problem.A.shape[0]
    if not n:
        empty = np.zeros((0, problem.C.shape[0]))
        return RiccatiSolution(np.zeros((0, 0)), empty, np.zeros(0, dtype=np.complex128), 0.0, 0)
    # doubling misses unstable modes without noise; the Schur form of the Hamiltonian, which does
    # not, puts poles of 1e-12 times the fastest on the axis
    way = _by_doubling if problem.discrete or not _is_unstable(problem) else _by_subspace
    try:
        return _solution(problem, *way(problem))
    except (SolverError, OnAxisError, np.linalg.LinAlgError) as error:
        equation = f"{'discrete' if problem.discrete else 'continuous'} Riccati equation"
        reason = _defect(problem.scaled(_sizes(problem))) or error
        raise SolverError(f"{equation}: {reason}") from error


def _is_unstable(p: RiccatiProblem) -> bool:
    """Return whether a pole of A lies beyond the stability limit by more than rounding."""
    poles = np.asarray(la.eigvals(p.A), dtype=np.complex128)
    return bool(np.max(_growth(p, poles)) > SPLIT * np.max(np.abs(poles)))


def _solution(
    problem: RiccatiProblem, P: FloatArray, d: FloatArray, doublings: int
) -> RiccatiSolution:
    """Return the checked solution of Newton's steps from a start."""
    first = problem.scaled(d)
    # scaled to unit variances, so that residual and correction are relative
    unit = scale_of(np.abs(P.diagonal()))
    d, P = d * unit, P / unit / unit[:, None]
    scaled = problem.scaled(d)
    P, K, residual, steps = _newton(scaled, P)
    poles = np.asarray(la.eigvals(scaled.A - K @ scaled.C), dtype=np.complex128)
    stable = np.max(_growth(first, poles)) < 0.0
    if not stable or not residual <= SAME:
        raise SolverError(
            f"the residual is {residual:.1e} of P (allowed {SAME:.0e}), the closed loop is "
            f"{'' if stable else 'not '}strictly stable. The problem is too badly "
            "conditioned for double precision."
        )
    # noise that excites a rigid-body mode only by rounding gives a slow, meaningless loop
    size = 1.0 if first.discrete else float(np.max(np.abs(poles)))
    if np.max(_growth(first, poles)) > -CLOSE * size and (reason := _defect(first)):
        raise SolverError(reason)
    gain = ((K + scaled.gain) * d[:, None]) @ problem.whitening
    return RiccatiSolution(P * d * d[:, None], gain, poles, residual, doublings + steps)


def _newton(p: RiccatiProblem, P: FloatArray) -> tuple[FloatArray, FloatArray, float, int]:
    """Correct P by Newton (Kleinman) steps until the correction is rounding."""
    last, correction = np.inf, doubled if p.discrete else lyapunov
    for taken in range(1, MOST_STEPS + 1):  # noqa: B007 - its last value is returned
        K = _riccati_gain(p, P)
        change = correction(p.A - K @ p.C, _residual(p, P, K)[0])
        size = float(np.linalg.norm(change) / np.linalg.norm(P)) if np.any(P) else 0.0
        # far from the solution the second step may be larger, since the first one is arbitrary
        if size < last or last > MISSED:
            P = symmetrised(P + change)
        if size < NULL or (size >= 0.5 * last and last < MISSED):
            break
        last = min(size, last)
    else:
        raise SolverError(
            f"the solution is determined to {last:.1e} only (Newton steps stall there): a mode is "
            "hardly excited by Q, or hardly seen in the outputs."
        )
    K = _riccati_gain(p, P)
    return P, K, _residual(p, P, K)[1], taken


def _defect(p: RiccatiProblem) -> str:
    """Return why no strictly stabilising solution exists, or "" (Popov-Belevitch-Hautus)."""
    marginal = 1.0 if p.discrete else 0.0
    lam = la.eigvals(p.A).astype(np.complex128)
    size = max(marginal, float(np.max(np.abs(lam), initial=0.0)))
    critical = lam[_growth(p, lam) >= -SAME * size]
    # a Jordan block of a rigid-body mode comes out of eigvals at the root of the rounding
    near = np.abs(critical - marginal) < SPLIT * size
    distinct = [complex(marginal)] if near.any() else []
    for value in critical[~near]:
        if all(abs(value - seen) > SPLIT * size for seen in distinct):
            distinct.append(complex(value))
    for value in distinct:
        shifted = p.A - value * np.eye(p.A.shape[0])
        missed = _hidden(shifted, p.G)
        if missed:
            return (
                f"{missed} mode(s) of A at {value:.6g} (rigid-body or unstable) cannot be seen in "
                "the outputs (reached by the inputs, in the control form), so their error is "
                "unbounded. Add or move sensors (actuators)."
            )
        missed = _hidden(shifted.conj().T, p.Q) if _growth(p, np.array(value)) < SPLIT * size else 0
        if missed:
            return (
                f"{missed} mode(s) of A at {value:.6g} (rigid-body) are not excited by the noise Q "
                "(of the cost, in the control form), so the stationary closed loop is not strictly "
                "stable. Add a disturbance that moves them."
            )
    return ""


def _hidden(shifted: ComplexArray, weight: FloatArray) -> int:
    """Return how many directions of the null space of `shifted` the quadratic form misses."""
    _, sizes, right = la.svd(shifted)
    null = right[sizes < SAME * max(1.0, float(sizes[0]))].conj().T
    if not null.size:
        return 0
    form = null.conj().T @ weight @ null
    spread = np.sqrt(np.abs(form.diagonal().real))
    if np.any(spread == 0):
        return int(np.count_nonzero(spread == 0))
    values = la.eigvalsh(form / spread / spread[:, None])
    # as a covariance: 3e-7 of an amplitude; smaller values are rounding
    return int(np.count_nonzero(np.abs(values) < RANK))


#: largest accepted change of a standard deviation where rounding of the gain prevents smaller ones:
#: of 12 such filters at 3e-4, 8 were within 1e-6 of the optimum
_STALLED = 3e-4
#: number of consecutive steps that need not halve the least change, before quadratic convergence
_STALLS = 6


class RiccatiRoot(NamedTuple):
    """The stationary filter of ``x+ = A x + G e, y = C x + H e``, e of unit variance.

    The predictor gain is K, ``L L'`` the covariance of x before its measurement and ``X X'`` that
    of the innovation, X lower triangular; `change` is that of a standard deviation in the last
    step.
    """

    L: FloatArray
    K: FloatArray
    X: FloatArray
    change: float
    steps: int

    def weighed(self, part: FloatArray) -> FloatArray:
        """Return ``part (X X')^-1``."""
        return np.asarray(la.cho_solve((self.X, True), part.T).T)


def _measured(
    A: FloatArray, C: FloatArray, G: FloatArray, H: FloatArray, L: FloatArray
) -> tuple[FloatArray, FloatArray]:
    """Return the gain K of a covariance L L', and X with ``X X' = C L L' C' + H H'``."""
    p = C.shape[0]
    T = triangular(np.vstack([np.hstack([H, C @ L]), np.hstack([G, A @ L])]))
    X, Y = T[:p, :p], T[p:, :p]
    return np.asarray(la.solve_triangular(X, Y.T, lower=True, trans="T").T), X


def riccati_root(A: FloatArray, C: FloatArray, G: FloatArray, H: FloatArray) -> RiccatiRoot:
    """Return the stationary filter, by Newton's steps from that of noisier sensors."""
    # in square roots `P = L L'`, twice the digits of P: with little noise and large motion P has
    # directions of 1e-16 relative to others, below its rounding, and the gain depends on them
    start = _noisier(A, C, G, H)
    d = scale_of(np.abs(start.P.diagonal()))
    found = _newton_in_roots(A * d / d[:, None], C * d, G / d[:, None], H, start.gain / d[:, None])
    return found._replace(L=found.L * d[:, None], K=found.K * d[:, None])


def _noisier(A: FloatArray, C: FloatArray, G: FloatArray, H: FloatArray) -> RiccatiSolution:
    """Return the filter with added sensor noise, with which P has enough digits for a stable gain.

    The added noise has 8000 times the size of the sensors' own noise and of the motion in a sample.
    """
    R = H @ H.T
    reach = np.diag(R) + np.sum((C @ G) ** 2, axis=1)
    return filter_dare(A, C, Q=G @ G.T, R=R + np.diag(reach) / ROOT, S=G @ H.T)


def _newton_in_roots(
    A: FloatArray, C: FloatArray, G: FloatArray, H: FloatArray, K: FloatArray
) -> RiccatiRoot:
    """Improve a stable gain: compute its error, then the best gain for this error [Hewer1971]_."""
    last, least, stalls = np.zeros(A.shape[0]), np.inf, 0
    for taken in range(1, MOST_STEPS + 1):
        closed = A - K @ C
        if np.max(np.abs(la.eigvals(closed)), initial=0.0) >= 1.0:
            raise SolverError("no strictly stable filter was found in square roots either.")
        L = stein_root(closed, G - K @ H)
        size = np.linalg.norm(L, axis=1)
        change = float(np.max(np.abs(size - last) / np.where(size > 0, size, 1.0), initial=0.0))
        K, X = _measured(A, C, G, H, L)
        stalls = stalls + 1 if change >= 0.5 * least else 0
        if change <= (_STALLED if stalls >= _STALLS else SETTLED):
            return RiccatiRoot(L, K, X, change, taken)
        last, least = size, min(least, change)
    raise SolverError(
        f"the filter did not converge in {MOST_STEPS} steps of Newton in square roots: a standard "
        f"deviation still changes by {change:.1e} of it."
    )

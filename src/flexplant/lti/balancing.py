"""Balanced reduction: fewer states, with an error bound and the actual error."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from ..arrays import FloatArray, positive
from ..errors import ModelError, SolverError, counted
from ..parallel import one_thread
from ..store import Value
from ..tolerances import RANK
from .equations import compressed
from .interconnection import parallel, series
from .lyapunov import controllability_factor, observability_factor
from .modal import StableSplit, obstacle, split_stable
from .norms import axis_peak, h2_norm, peak_gain
from .statespace import StateSpace, System, as_statespace


@dataclass(frozen=True, eq=False, repr=False)
class BalancedReduction(Value):
    """A system of reduced order, and its error.

    Parameters
    ----------
    system : StateSpace
        Reduced system. Its states are the balanced ones, followed by the unchanged rigid-body and
        unstable ones.
    hankel : (n_stable,) array [output unit / input unit]
        Hankel singular values of the stable part, the largest first. With weights they are those of
        the weighted stable part.
    bound : float [output unit / input unit]
        Twice the sum of the discarded values. The error is not larger at any frequency. NaN with
        weights, because this bound does not hold for them.
    error : float [output unit / input unit]
        H-infinity norm of the difference between the given and the reduced system, computed from
        this difference. With weights it is the norm of the weighted difference.
    error_freq : float [Hz]
        Frequency of the largest error.
    n_kept : int
        Number of rigid-body and unstable states, which are kept exactly.

    Examples
    --------
    >>> import flexplant as fx
    >>> found = fx.balanced(fx.lti.low_pass_filter(1.0) * fx.lti.low_pass_filter(100.0), order=1)
    >>> found.hankel.round(4), bool(found.error < 1.001 * found.bound)
    (array([0.5049, 0.0049]), True)
    """

    system: StateSpace
    hankel: FloatArray
    bound: float
    error: float
    error_freq: float
    n_kept: int

    def __repr__(self) -> str:
        full = self.hankel.size + self.n_kept
        limit = f"bound {self.bound:.3g}" if np.isfinite(self.bound) else "no bound (weighted)"
        return (
            f"<BalancedReduction: {full} -> {counted(self.system.n_states, 'state')} "
            f"({self.n_kept} kept "
            f"exactly), error {self.error:.3g} at {self.error_freq:.4g} Hz, {limit}>"
        )


@one_thread()
def balanced(
    sys: System,
    *,
    order: int | None = None,
    tol: float | None = None,
    match_dc: bool = False,
    input_weight: System | None = None,
    output_weight: System | None = None,
) -> BalancedReduction:
    """Return a system with fewer states by balanced truncation or residualisation.

    The result is a `BalancedReduction`, whose attribute `system` is the reduced system. The error
    obeys ``|G - G_r| <= 2 (s_{r+1} + ... + s_n)`` in the H-infinity norm. Here G is the given
    system and G_r the reduced one, and s_{r+1} to s_n are the Hankel singular values of the stable
    part that are discarded. Rigid-body and unstable modes are split off first and kept exactly.
    With weights, the Gramians are those of the weighted system ``W_o G W_i`` (method of Enns), and
    the error is the norm of ``W_o (G - G_r) W_i``.

    Parameters
    ----------
    sys : StateSpace or control.StateSpace
        Continuous or sampled system.
    order : int, optional
        Number of states of the result, including those kept exactly. Give this or `tol`.
    tol : float, optional
        Relative error: the result has the smallest order whose bound is at most this times the
        largest Hankel singular value.
    match_dc : bool
        True keeps the gain at 0 Hz by residualisation (singular perturbation): the discarded states
        are assumed to be at rest (their derivatives are zero). False keeps the gain at infinite
        frequency by truncation: the discarded states themselves are set to zero. The error bound is
        the same.
    input_weight, output_weight : StateSpace, optional
        Stable filters before the inputs and after the outputs, connected in order.

    Raises
    ------
    ModelError
        When not exactly one of order and tol is given, order is out of range, or a weight does not
        match or is not stable.
    SolverError
        When a two-sided weight leaves the reduced system unstable.

    References
    ----------
    [Enns1984]_; [LiuAnderson1989]_; [Laub1987]_.

    Examples
    --------
    >>> import flexplant as fx
    >>> found = fx.balanced(fx.lti.low_pass_filter(1.0) * fx.lti.low_pass_filter(100.0), order=1)
    >>> found.system.n_states, bool(found.error < 1.001 * found.bound)
    (1, True)
    """
    g = as_statespace(sys)
    if (order is None) == (tol is None):
        raise ModelError("balanced needs either order= (states) or tol= (relative error bound).")
    weighted = input_weight is not None or output_weight is not None
    before, after = _as_weight(input_weight, g, "input"), _as_weight(output_weight, g, "output")
    split = split_stable(g)
    stable = split.stable
    # series puts the states of its second system first
    Lp = compressed(controllability_factor(series(before, stable))[: stable.n_states])
    seen = observability_factor(series(stable, after))
    Lq = compressed(seen[len(seen) - stable.n_states :])
    left, values, right = np.linalg.svd(Lq.T @ Lp)
    rank = int(np.sum(values > RANK * values[0])) if values.size and values[0] > 0 else 0
    n_kept = split.rest.n_states
    r = min(_reduced_order(order, tol, values, n_kept), rank)
    W = Lq @ left[:, :rank] / np.sqrt(values[:rank])
    T = Lp @ right[:rank].T / np.sqrt(values[:rank])
    reduced = _project(stable, W, T, r, residual=match_dc)
    if (problem := obstacle(reduced)) is not None:
        raise SolverError(
            f"the weighted reduction to {counted(r, 'stable state')} is {problem.reason}: with "
            "weights on both sides stability is not guaranteed. Take another order or one weight."
        )
    error, freq = peak_gain(series(series(before, parallel(stable, -reduced)), after))
    bound = float("nan") if weighted else 2.0 * float(np.sum(values[r:]))
    return BalancedReduction(_rejoined(g, split, reduced), values, bound, error, freq, n_kept)


def _reduced_order(order: int | None, tol: float | None, values: FloatArray, n_kept: int) -> int:
    """Return the number of stable states."""
    if order is not None:
        r = int(order) - n_kept
        if order != int(order) or not 0 <= r <= values.size:
            raise ModelError(
                f"order must be a whole number from {n_kept} (rigid-body and unstable states, "
                f"kept exactly) to {n_kept + values.size}, got {order}."
            )
        return r
    limit = positive(tol, "tol") * float(np.max(values, initial=0.0))
    tails = np.append(2.0 * np.cumsum(values[::-1])[::-1], 0.0)
    return int(np.argmax(tails <= limit))


def _project(g: StateSpace, W: FloatArray, T: FloatArray, r: int, *, residual: bool) -> StateSpace:
    A, B, C, D = W.T @ g.A @ T, W.T @ g.B, g.C @ T, g.D
    if residual and r < A.shape[0]:
        # the discarded states at rest: 0 = A21 x1 + A22 x2 + B2 u (x2 = ... when sampled)
        rest = (np.eye(A.shape[0] - r) if g.dt else 0.0) - A[r:, r:]
        solved = np.linalg.solve(rest, np.hstack([A[r:, :r], B[r:]]))
        x, u = solved[:, :r], solved[:, r:]
        A, B, C, D = (
            A[:r, :r] + A[:r, r:] @ x,
            B[:r] + A[:r, r:] @ u,
            C[:, :r] + C[:, r:] @ x,
            (D + C[:, r:] @ u),
        )
    return g.replace(A=A[:r, :r], B=B[:r], C=C[:, :r], D=D, states=(), blocks=None)


def _rejoined(g: StateSpace, split: StableSplit, reduced: StateSpace) -> StateSpace:
    names = [f"balanced{i}" for i in range(1, reduced.n_states + 1)]
    both = parallel(reduced, split.rest) if split.rest.n_states else reduced
    kept = [f"kept{i}" for i in range(1, split.rest.n_states + 1)]
    return both.replace(states=[*names, *kept], name=g.name)


def _as_weight(weight: System | None, g: StateSpace, side: str) -> StateSpace:
    """Return a weight, ones where it is not given."""
    ours = g.inputs if side == "input" else g.outputs
    w = as_statespace(np.eye(len(ours)) if weight is None else weight)
    theirs = w.outputs if side == "input" else w.inputs
    if len(theirs) != len(ours):
        raise ModelError(
            f"the {side} weight needs {len(ours)} {'outputs' if side == 'input' else 'inputs'} "
            f"for the {side}s of the system, got {len(theirs)}."
        )
    if w.n_states and w.dt != g.dt:
        raise ModelError(f"the {side} weight has sampling time {w.dt:g} s, the system {g.dt:g} s.")
    if (problem := obstacle(w)) is not None:
        raise ModelError(f"the {side} weight is {problem.reason}: weights must be stable.")
    return w.replace(dt=g.dt)


def hankel_values(sys: System) -> FloatArray:
    """Return the Hankel singular values, the largest first.

    They are the square roots of the eigenvalues of P Q, where P is the controllability Gramian and
    Q the observability Gramian. They are computed from factors of the two Gramians, so that values
    far below the largest one are accurate too.

    Parameters
    ----------
    sys : StateSpace or control.StateSpace
        Strictly stable system, continuous or sampled.

    Returns
    -------
    (n_states,) array [output unit / input unit]

    Raises
    ------
    SolverError
        When the system is not strictly stable: its Gramians are infinite.

    References
    ----------
    [Glover1984]_.

    Examples
    --------
    >>> from flexplant.lti import StateSpace
    >>> print(hankel_values(StateSpace([[-1.0]], [[2.0]], [[3.0]], [[0.0]])))
    [3.]
    """
    g = as_statespace(sys)
    if (problem := obstacle(g)) is not None:
        raise SolverError(
            f"{g!r} has no Hankel singular values: {problem.reason}. Take its stable part first: "
            "split_stable."
        )
    if not g.n_states:
        return np.zeros(0)
    inner = observability_factor(g).T @ controllability_factor(g)
    return np.asarray(np.linalg.svd(inner, compute_uv=False))


def hankel_norm(sys: System) -> float:
    """Return the Hankel norm: the largest gain from past inputs to future outputs.

    It is the largest of the `hankel_values`, and infinite when the system is not strictly stable.

    Parameters
    ----------
    sys : StateSpace or control.StateSpace
        Continuous or sampled system; its feedthrough does not matter.

    Raises
    ------
    ModelError
        When `sys` is not a system.

    Examples
    --------
    >>> from flexplant.lti import StateSpace
    >>> print(f"{hankel_norm(StateSpace([[-1.0]], [[2.0]], [[3.0]], [[0.0]])):.3f}")
    3.000
    """
    g = as_statespace(sys)
    if obstacle(g) is not None:
        return float("inf")
    return float(np.max(hankel_values(g), initial=0.0))


@dataclass(frozen=True, eq=False, repr=False)
class NormReport(Value):
    """All norms of a system, the frequency of its peak, and reasons for infinite norms.

    Parameters
    ----------
    h2, hinf, linf, hankel : float
        The norms; infinite with a reason.
    freq : float [Hz]
        Frequency of the peak of the response, or of the pole that makes the norms infinite.
    reasons : sequence of str
        Reasons why norms are infinite, one sentence for each reason; empty when all norms are
        finite.

    Examples
    --------
    >>> import flexplant as fx
    >>> found = fx.lti.norm_report(fx.lti.tf([1.0], [1.0, 1.0]))
    >>> round(found.h2, 6), round(found.hinf, 6), round(found.hankel, 6)
    (0.707107, 1.0, 0.5)
    """

    h2: float
    hinf: float
    linf: float
    hankel: float
    freq: float
    reasons: tuple[str, ...] = ()

    def __repr__(self) -> str:
        first = (
            f"<NormReport: H2 {self.h2:.6g}, Hinf {self.hinf:.6g}, Linf {self.linf:.6g}, Hankel "
            f"{self.hankel:.6g}, peak or pole at {self.freq:.6g} Hz"
        )
        return "\n  ".join((first, *self.reasons)) + ">"


def norm_report(sys: System) -> NormReport:
    """Return the H2, H-infinity, L-infinity and Hankel norms as a `NormReport`.

    For each infinite norm the report also states the reason.

    Parameters
    ----------
    sys : StateSpace or control.StateSpace
        Continuous or sampled system.

    Raises
    ------
    SolverError
        When a norm cannot be computed.

    Examples
    --------
    >>> from flexplant.lti import StateSpace
    >>> mass = StateSpace([[0, 1], [0, 0]], [[0], [1]], [[1, 0]], [[0]], blocks=[2])
    >>> print(norm_report(mass).reasons[0])
    marginal: a rigid-body mode or integrator lies on the imaginary axis
    """
    g = as_statespace(sys)
    problem, reasons = obstacle(g), []
    if problem is not None:
        reasons.append(problem.reason)
    if not g.dt and np.any(g.D):
        reasons.append(
            "feedthrough: a continuous system with D passes white noise of infinite power (H2)"
        )
    linf, freq = axis_peak(g)
    infinite = float("inf")
    if problem is not None and not np.isfinite(linf):
        freq = problem.freq
    return NormReport(
        h2_norm(g),
        linf if problem is None else infinite,
        linf,
        hankel_norm(g),
        freq,
        tuple(reasons),
    )

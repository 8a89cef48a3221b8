"""Hankel singular values, and all norms of a system in one report with their reasons."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from ..errors import SolverError
from ..values import FloatArray, Value
from .factors import controllability_factor, observability_factor
from .h2_norms import h2_norm
from .norms import axis_peak
from .stability import obstacle
from .statespace import System, as_statespace


def hankel_values(sys: System) -> FloatArray:
    """Return the Hankel singular values, the largest first.

    The square roots of the eigenvalues of P Q, from factors of the two Gramians, which are never
    formed: values far below the largest keep their digits.

    Parameters
    ----------
    sys : StateSpace or control.StateSpace
        Strictly stable, continuous or sampled.

    Returns
    -------
    (n_states,) array [output unit / input unit]

    Raises
    ------
    ModelError
        When `sys` is no system.
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

    Parameters
    ----------
    sys : StateSpace or control.StateSpace
        Continuous or sampled; the feedthrough does not matter.

    Returns
    -------
    float
        The largest Hankel singular value; infinite when the system is not strictly stable.

    Raises
    ------
    ModelError
        When `sys` is no system.

    References
    ----------
    [Glover1984]_.

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
    """All norms of a system, where its peak lies, and why a norm is infinite.

    Parameters
    ----------
    h2, hinf, linf, hankel : float
        The norms; infinite with a reason.
    freq : float [Hz]
        Of the peak of the frequency response, or of the pole that makes the norms infinite.
    reasons : sequence of str
        One sentence for each thing that makes a norm infinite; empty when all are finite.

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
    """Return the H2, H-infinity, L-infinity and Hankel norms, with the reason of an infinite one.

    Parameters
    ----------
    sys : StateSpace or control.StateSpace
        Continuous or sampled.

    Returns
    -------
    NormReport

    Raises
    ------
    ModelError
        When `sys` is no system.
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

"""Gains by the names that textbooks give them: LQR, LQI, LQG, Kalman gain, pole placement."""

from __future__ import annotations

from collections.abc import Iterable

import numpy as np
import numpy.typing as npt

from ..arrays import FloatArray, complex_array
from ..errors import AssumptionError, ModelError, counted, some_names
from ..lti.conversions import even_factors
from ..lti.riccati import RiccatiSolution, control_care, control_dare, filter_care, filter_dare
from ..lti.statespace import StateSpace, System, as_statespace
from ..tolerances import NEGLIGIBLE, RANK


def lqr(
    sys: System, *, Q: FloatArray, R: FloatArray, N: FloatArray | None = None
) -> RiccatiSolution:
    """Return the linear-quadratic regulator (LQR), continuous or sampled.

    The feedback ``u = -F x`` minimises the cost ``int x' Q x + 2 x' N u + u' R u dt``. For a
    sampled system the cost is the sum over the samples (as in ``dlqr``). The attribute `gain` of
    the result is F.

    Parameters
    ----------
    sys : StateSpace, or a system of python-control or SciPy
        System with n states, m inputs and p outputs.
    Q, R, N : (n, n), (m, m), (n, m) arrays
        Weights on states (Q), inputs (R) and their products (N). R is positive definite.

    Returns
    -------
    RiccatiSolution
        Solution with the gain F (m, n) as `gain` and the poles of A - B F as `poles`. With the
        matrix `P`, the cost from a state x is x' P x.

    Raises
    ------
    ShapeError, ModelError, SolverError
        When the weights have wrong sizes, R is singular, or a mode cannot be stabilised. The errors
        are those of `flexplant.lti.control_care`.

    References
    ----------
    [AndersonMoore1979]_.

    Examples
    --------
    >>> import flexplant as fx
    >>> mass = fx.StateSpace([[0, 1], [0, 0]], [[0], [1]], [[1, 0]], 0)
    >>> fx.synthesis.lqr(mass, Q=[[1, 0], [0, 0]], R=[[1]]).gain.round(4)
    array([[1.    , 1.4142]])
    """
    g = as_statespace(sys)
    solve = control_dare if g.dt else control_care
    return solve(g.A, g.B, Q=Q, R=R, S=N)


def lqi(
    sys: System, *, Q: FloatArray, R: FloatArray, outputs: Iterable[str] | None = None
) -> RiccatiSolution:
    """Return the linear-quadratic regulator with integral action (LQI).

    The feedback ``u = -F [x; q]`` minimises the cost of `lqr` for the states x and the integrals q.
    They follow ``dq/dt = r - y``, or ``q[k+1] = q[k] + dt (r - y)`` if the system is sampled. The
    outputs y follow constant references r without a stationary error.

    Parameters
    ----------
    sys : StateSpace, or a system of python-control or SciPy
        System with n states, m inputs and p outputs.
    Q : (n + p, n + p) array
        Weight on the n states, followed by the p integrals.
    R : (m, m) array
        Weight on the inputs, positive definite.
    outputs : iterable of str, optional
        Outputs that are integrated; by default all. Here p is the number of these outputs.

    Returns
    -------
    RiccatiSolution
        Solution with the gain F (m, n + p) as `gain`.

    Raises
    ------
    AssumptionError
        When the system has a zero at zero frequency, or more outputs than inputs. Some integrals
        can then not be stabilised.
    ShapeError, ModelError, SolverError
        As for `lqr`.

    Examples
    --------
    >>> import numpy as np
    >>> import flexplant as fx
    >>> lag = fx.lti.tf([1.0], [1.0, 1.0])
    >>> fx.synthesis.lqi(lag, Q=np.diag([0.0, 1.0]), R=[[1.0]]).gain.round(3)
    array([[ 0.732, -1.   ]])
    """
    g = as_statespace(sys)
    seen = g if outputs is None else g.select(outputs)
    _require_answer_at_rest(seen)
    return lqr(_with_integrals(g, outputs), Q=Q, R=R)


def _require_answer_at_rest(g: StateSpace) -> None:
    """Refuse outputs that constant inputs do not reach: ``[A - z I, B; C, D]`` is singular."""
    n, m, p = g.n_states, len(g.inputs), len(g.outputs)
    if p > m:
        raise AssumptionError(
            f"{counted(p, 'output')} are integrated and there are {counted(m, 'input')}: constant "
            "inputs hold as many outputs as there are inputs. Name these, outputs=['y1']."
        )
    M = np.block([[g.A - np.eye(n) if g.dt else g.A, g.B], [g.C, g.D]])
    left, right = even_factors(np.abs(M))
    U, sizes, _ = np.linalg.svd(left[:, None] * M * right)
    limit = RANK * (n + p) * sizes[0] if sizes.size else 0.0
    reached = np.linalg.svd((left[:, None] * M * right)[:n], compute_uv=False)
    if sizes[n + p - 1] > limit or np.any(reached <= limit):  # a mode that u misses is lqr's to say
        return
    lost = np.abs(U[n:, -1])
    names = [name for name, size in zip(g.outputs, lost, strict=True) if size > 0.1 * lost.max()]
    raise AssumptionError(
        f"{some_names(names)} cannot be integrated: constant inputs do not reach "
        f"{'it' if len(names) == 1 else 'one combination of these'} (a zero at rest, as velocities "
        "and accelerations have), so that its integral cannot be stabilised. Leave it out of "
        "outputs=, or integrate a displacement."
    )


def _with_integrals(g: StateSpace, outputs: Iterable[str] | None) -> StateSpace:
    """Return a system whose last states are the integrals of -y."""
    seen = g if outputs is None else g.select(outputs)
    n, p = g.n_states, len(seen.outputs)
    step = g.dt or 1.0
    A = np.block(
        [[g.A, np.zeros((n, p))], [-step * seen.C, np.eye(p) if g.dt else np.zeros((p, p))]]
    )
    B = np.vstack([g.B, -step * seen.D])
    return StateSpace(A, B, np.eye(n + p), np.zeros((n + p, g.B.shape[1])), g.dt, inputs=g.inputs)


def lqe(sys: System, *, W: FloatArray, V: FloatArray, N: FloatArray | None = None) -> StateSpace:
    """Return the Kalman filter of a system. It estimates the states from inputs u and outputs y.

    The system is ``dx/dt = A x + B u + w, y = C x + D u + v`` with white noises w and v. The
    estimate x^ follows ``dx^/dt = A x^ + B u + K e`` with the innovation ``e = y - C x^ - D u`` and
    the filter gain K. For a sampled system x^ is the state predicted for the next sample. For a
    StandardPlant, use `flexplant.design_kalman`, which also computes the error of the estimate.

    Parameters
    ----------
    sys : StateSpace, or a system of python-control or SciPy
        System with n states, m inputs and p outputs.
    W, V, N : (n, n), (p, p), (n, p) arrays
        Spectral densities of w, of v and between w and v. For a sampled system they are
        covariances. N is zero by default.

    Returns
    -------
    StateSpace
        The filter. Its outputs have the names of the states of `sys`.

    Raises
    ------
    ShapeError, ModelError, SolverError
        As for `flexplant.lti.filter_care`.

    References
    ----------
    [AndersonMoore1979]_.

    Examples
    --------
    >>> import flexplant as fx
    >>> walk = fx.StateSpace([[0.0]], [[1.0]], [[1.0]], 0, states=["position"])
    >>> fx.synthesis.lqe(walk, W=[[4.0]], V=[[1.0]])
    <StateSpace: 1 state, continuous, u1, y1 -> position>
    """
    g = as_statespace(sys)
    K = _observer_gain(g, W, V, N)
    B = np.hstack([g.B - K @ g.D, K])
    n = g.n_states
    return StateSpace(
        g.A - K @ g.C, B, np.eye(n), np.zeros((n, B.shape[1])), g.dt,
        inputs=[*g.inputs, *g.outputs], outputs=g.states, units=g.units,
    )  # fmt: skip


def _observer_gain(
    g: StateSpace, W: FloatArray, V: FloatArray, N: FloatArray | None = None
) -> FloatArray:
    solve = filter_dare if g.dt else filter_care
    return solve(g.A, g.C, Q=W, R=V, S=N).gain


def lqg(
    sys: System,
    *,
    Q: FloatArray,
    R: FloatArray,
    W: FloatArray,
    V: FloatArray,
    integrate: Iterable[str] | None = None,
) -> StateSpace:
    """Return the linear-quadratic Gaussian (LQG) controller from measurements y to inputs u.

    The controller is the state feedback of `lqr` on the estimate of `lqe`. If outputs are
    integrated, it is the state feedback of `lqi`. The controller K includes the sign of the
    feedback (``u = K y``). The closed loop is therefore ``fx.lti.feedback(sys, K, sign=1)``, and
    its margins are ``fx.loop.report_loops((sys, K))``.

    Parameters
    ----------
    sys : StateSpace, or a system of python-control or SciPy
        System with n states, m inputs and p outputs.
    Q, R : (n, n), (m, m) arrays
        Weights as in `lqr`. If outputs are integrated, Q also weights their integrals, as in `lqi`.
    W, V : (n, n), (p, p) arrays
        Spectral densities (or covariances) of the noises, as in `lqe`.
    integrate : iterable of str, optional
        Outputs that are integrated, so that they follow a constant reference without an error. The
        controller then has inputs `y1:ref`, ... after the measurements.

    Returns
    -------
    StateSpace
        Controller from the measurements, and the references if outputs are integrated, to the
        inputs.

    Raises
    ------
    ShapeError, ModelError, SolverError
        As for `lqr` and `lqe`.

    Examples
    --------
    >>> import numpy as np
    >>> import flexplant as fx
    >>> mass = fx.StateSpace([[0, 1], [0, 0]], [[0], [1]], [[1, 0]], 0)
    >>> K = fx.synthesis.lqg(mass, Q=np.eye(2), R=[[1]], W=np.diag([0, 1]), V=[[1]])
    >>> fx.loop.report_loops((mass, K)).is_stable
    True
    """
    g = as_statespace(sys)
    names = [] if integrate is None else list(integrate)
    seen = g.select(names) if names else None
    F = (lqi(g, Q=Q, R=R, outputs=names) if names else lqr(g, Q=Q, R=R)).gain
    L = _observer_gain(g, W, V)
    n, p, m = g.n_states, len(names), len(g.inputs)
    Fx, Fq = F[:, :n], F[:, n:]
    # u = -Fx x^ - Fq q; the estimate sees u, and the integrals see r - y
    step = g.dt or 1.0
    estimate = np.hstack([g.A - L @ g.C - (g.B - L @ g.D) @ Fx, -(g.B - L @ g.D) @ Fq])
    integral = np.hstack([np.zeros((p, n)), np.eye(p) if g.dt else np.zeros((p, p))])
    picked = np.zeros((p, len(g.outputs)))
    if seen is not None:
        picked[range(p), g.output_index(names)] = 1.0
    B = np.block([[L, np.zeros((n, p))], [-step * picked, step * np.eye(p)]])
    return StateSpace(
        np.vstack([estimate, integral]), B, -F, np.zeros((m, B.shape[1])), g.dt,
        inputs=[*g.outputs, *(f"{name}:ref" for name in names)], outputs=g.inputs,
        units={k: u for k, u in g.units.items() if k in (*g.inputs, *g.outputs)},
    )  # fmt: skip


def place(sys: System, poles: npt.ArrayLike) -> FloatArray:
    """Return the state feedback F (m, n) that places the poles of A - B F.

    With several inputs, F is not unique. The remaining freedom is used to make the eigenvectors of
    A - B F as independent as possible, so that the poles are not sensitive to errors.

    Parameters
    ----------
    sys : StateSpace, or a system of python-control or SciPy
        System with n states, m inputs and p outputs.
    poles : (n,) array [rad/s, or 1 where sampled]
        Poles in conjugate pairs; for a sampled system they lie in the z-plane and have no unit.
        Each may be given at most as many times as there are inputs.

    Returns
    -------
    (m, n) array
        Gain F of the feedback ``u = -F x``.

    Raises
    ------
    ShapeError
        When the number of poles differs from the number of states.
    ModelError
        When the poles cannot be placed. Either no input moves one of the modes, or a pole is given
        more often than there are inputs.

    References
    ----------
    [Kautsky1985]_.

    Examples
    --------
    >>> import flexplant as fx
    >>> mass = fx.StateSpace([[0, 1], [0, 0]], [[0], [1]], [[1, 0]], 0)
    >>> fx.synthesis.place(mass, [-1.0, -2.0]).round(6)
    array([[2., 3.]])
    """
    from scipy.signal import place_poles  # heavy

    g = as_statespace(sys)
    asked = complex_array(poles, "poles", (g.n_states,))
    try:
        gain = np.asarray(place_poles(g.A, g.B, asked).gain_matrix, dtype=np.float64)
    except ValueError as error:
        raise ModelError(
            f"{counted(g.n_states, 'pole')} cannot be placed: {error} Ask for conjugate pairs, "
            "none more often than there are inputs, and of modes that an input reaches."
        ) from error
    found = np.linalg.eigvals(g.A - g.B @ gain)
    away = max((float(np.min(np.abs(found - pole))) for pole in asked), default=0.0)
    if away > NEGLIGIBLE * float(np.max(np.abs(asked), initial=0.0)):
        raise ModelError(
            f"a pole came {away:.2g} from its place: no input, or hardly one, reaches its mode. "
            "fx.minimal(sys) shows which states are reached."
        )
    return gain

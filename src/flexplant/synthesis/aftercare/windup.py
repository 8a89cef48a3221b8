"""A controller that follows what its actuators apply: Hanus' conditioned form, observer form."""

from __future__ import annotations

from typing import Any

import numpy as np

from ...checks import FloatArray, positive
from ...errors import AssumptionError, ModelError
from ...lti.riccati import solve_care, solve_dare
from ...lti.statespace import StateSpace, as_statespace
from ...tolerances import divisor

#: D of a conditioned controller is inverted up to this condition
_LARGEST = 1e8


def anti_windup_form(controller: Any, *, recovery: float | None = None) -> StateSpace:
    """Return the controller with the applied u as inputs, unchanged until an actuator saturates.

    ::

        x' = (A - L C) x + (B - L D) y + L u_applied,    u = C x + D y

    Where u_applied = u it is the controller. Where actuators saturate, its states follow those of
    a controller that commanded what was applied, with the poles of A - L C:

    Hanus (`recovery` not given): ``L = B D^-1``, which makes ``A - L C`` the zeros of the
    controller. Observer: L of a steady filter that settles within the recovery time.

    Parameters
    ----------
    controller : StateSpace or Controller
        From y to u, continuous or sampled.
    recovery : float [s], optional
        Time constant of the slowest pole of A - L C.

    Returns
    -------
    StateSpace
        Inputs [y; u], outputs u: a block of `close_loop`, which feeds it what the actuators
        apply; `simulate` needs no other anti_windup then.

    Raises
    ------
    AssumptionError
        When Hanus' form needs the inverse of a D that is singular, or its poles (the zeros of the
        controller) are not stable: give a recovery time.
    ModelError
        When slow states are not seen in the commands.

    References
    ----------
    [Hanus1987]_; [AstromWittenmark1997]_, section 9.4.

    Examples
    --------
    >>> import flexplant as fx
    >>> plant = fx.testbeds.three_masses()
    >>> observer = fx.design_kalman(plant)
    >>> servo = fx.design_servo(plant, bandwidth=20.0, observer=observer)
    >>> fx.synthesis.anti_windup_form(servo, recovery=0.05).inputs
    ('die:ref', 'die:hat', 'u1')
    """
    K = as_statespace(controller)
    L = back_gain(K, recovery)
    n_u = len(K.outputs)
    return K.replace(
        A=K.A - L @ K.C,
        B=np.hstack([K.B - L @ K.D, L]),
        D=np.hstack([K.D, np.zeros((n_u, n_u))]),
        inputs=[*K.inputs, *K.outputs],
        blocks=None,
    )


def back_gain(K: StateSpace, recovery: float | None) -> FloatArray:
    """Return L (n, nu): the states move by ``L (applied - commanded)``, with stable A - L C."""
    L = _hanus(K) if recovery is None else _observer(K, positive(recovery, "recovery"))
    A = K.A - L @ K.C
    poles = np.linalg.eigvals(A) if K.n_states else np.zeros(0)
    size = np.abs(poles)
    growth = np.max(size - 1.0 if K.dt else poles.real, initial=-np.inf)
    # Tustin's rule puts zeros at exactly -1, several at once, which rounding moves by its root
    if not growth < -(1e-7 if K.dt else 1e-9 * np.max(size, initial=0.0)):
        raise AssumptionError(
            "the zeros of the controller, which Hanus' form has as poles, are not all stable, or "
            "not clearly: its states would run off while an actuator saturates. Give a recovery "
            "time."
        )
    return L


def _hanus(K: StateSpace) -> FloatArray:
    """Return ``B D^-1``, of a wide D its least solution."""
    size = np.linalg.svd(K.D, compute_uv=False)
    rank = int(np.count_nonzero(size > size.max(initial=0.0) / _LARGEST))
    if rank < len(K.outputs) or not size.max(initial=0.0) > 0:
        raise AssumptionError(
            f"Hanus' form divides by D, which has rank {rank} for {len(K.outputs)} actuators: a "
            "controller that rolls off has none. Give a recovery time: the observer form."
        )
    return np.asarray(K.B @ np.linalg.pinv(K.D))


def _observer(K: StateSpace, recovery: float) -> FloatArray:
    """Return the gain of a filter that reads the command, its poles shifted by the recovery time.

    With ``A + I / T`` in place of A (sampled: A e^(dt / T)) its stable loop decays with T.
    """
    n = K.n_states
    if not n:
        return np.zeros((0, len(K.outputs)))
    size = np.linalg.norm(K.C, axis=1)
    C = K.C / divisor(size)[:, None]
    scale = np.linalg.norm(K.B, axis=1)
    scale = np.where(scale > 0, scale, np.max(scale, initial=1.0))
    grow = float(np.exp(K.dt / recovery)) if K.dt else 1.0 / recovery
    A = K.A * grow if K.dt else K.A + grow * np.eye(n)
    # all states a little, so that each has a stabilising gain
    Q = np.diag(scale**2) * 1e-6
    seen = float(np.sum((C * scale) ** 2)) or 1.0
    try:
        found = (solve_dare if K.dt else solve_care)(A, C, Q=Q, R=1e-2 * seen * np.eye(len(C)))
    except Exception as error:
        raise ModelError(
            f"slow states of the controller cannot be found from its commands: {error} Let fewer "
            "integrators drive each actuator, or reduce the controller first."
        ) from error
    gain = found.gain / (grow if K.dt else 1.0)
    return np.asarray(gain / divisor(size))

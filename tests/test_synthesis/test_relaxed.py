"""Lower bounds of singular problems, against scalar ones known by hand, and the search's misses."""

import numpy as np
import pytest
import scipy.linalg as la

from flexplant.lti import StateSpace
from flexplant.lti.preparation import prepared
from flexplant.synthesis import design_hinf
from flexplant.synthesis.hinf.lower_bound import full_information, pointwise_bound, relaxed_bound
from oracles_lmi import output_feedback_gamma, state_feedback_gamma


def named(A, B, C, D, nu=1, ny=1):
    u, y = [f"u{i}" for i in range(nu)], [f"y{i}" for i in range(ny)]
    w = [f"w{i}" for i in range(np.shape(B)[1] - nu)]
    z = [f"z{i}" for i in range(np.shape(C)[0] - ny)]
    return StateSpace(A, B, C, D, inputs=[*w, *u], outputs=[*z, *y]), u, y


def behind_lags(a, noise, count=1):
    """``x' = a x + w1 + v``, z = (x, v), y = x + noise w2; v behind lags that cost nothing.

    u can make v whatever it likes, at infinite speed: the smallest gamma is that of v as input.
    """
    n = 1 + count
    A = np.diag(np.ones(count), 1) - np.eye(n)
    A[0, 0] = a
    B, C, D = np.zeros((n, 3)), np.zeros((3, n)), np.zeros((3, 3))
    B[0, 0] = B[-1, 2] = 1.0
    C[0, 0] = C[1, 1] = C[2, 0] = 1.0
    D[2, 1] = noise
    return A, B, C, D


def dual(A, B, C, D):
    """Actuator and sensor change places, and so do w and z."""
    return A.T, C.T, B.T, D.T


@pytest.mark.parametrize("a", [-2.0, 0.5, 1.0])
@pytest.mark.parametrize("count", [1, 3])
@pytest.mark.parametrize("side", ["u", "y"])
def test_states_that_cost_nothing_are_inputs(a, count, side):
    """Control and estimation together: rho(X Y) = gamma^2 of the problem without lags."""
    best = output_feedback_gamma(a)
    parts = behind_lags(a, 1.0, count)
    P = named(*(parts if side == "u" else dual(*parts)))
    problem = prepared(*P)
    found = relaxed_bound(problem, 1.05 * best, 0.0)
    assert 0.998 * best <= found <= best * (1 + 1e-6)
    known = pointwise_bound(problem)
    assert known < 0.997 * best
    # never above what is reached
    assert 0.85 * best < relaxed_bound(problem, 0.9 * best, known) <= 0.9 * best


def test_all_states_known():
    """Without noise of the sensor what is left is state feedback; the design comes near it."""
    best = state_feedback_gamma(-0.5)
    P = named(*behind_lags(-0.5, 0.0))
    found = design_hinf(P[0], u=P[1], y=P[2])
    assert 0.99 * best <= found.lower <= best * (1 + 1e-6)
    assert found.gamma <= 1.055 * best


def test_many_states():
    """Forty-eight, in dense coordinates: 24 plants side by side, the worst one counts."""
    each = [behind_lags(a, 1.0) for a in np.linspace(-2.0, 1.0, 24)]
    A, B, C, D = (la.block_diag(*parts) for parts in zip(*each, strict=True))
    order = np.concatenate([np.arange(72)[np.arange(72) % 3 != 2], np.arange(2, 72, 3)])
    T = np.linalg.qr(np.random.default_rng(0).normal(size=(48, 48)))[0]
    P = named(T.T @ A @ T, T.T @ B[:, order], C[order] @ T, D[np.ix_(order, order)], 24, 24)
    best = output_feedback_gamma(1.0)
    assert 0.998 * best <= relaxed_bound(prepared(*P), 1.05 * best, 0.0) <= best * (1 + 1e-6)


def test_what_is_reduced():
    """A chain of lags to the cost: each becomes the input of the one before it."""
    A, B, C, D = behind_lags(1.0, 1.0, 4)
    found = full_information(A, B[:, :2], B[:, 2:], C[:2], D[:2, :2], D[:2, 2:])
    np.testing.assert_allclose(found.A, [[1.0]], atol=1e-12)
    assert abs(found.D12[0, 0]) < 1e-12 < abs(found.D12[1, 0])
    assert abs(found.B2[0, 0]) == pytest.approx(abs(found.D12[1, 0]))
    np.testing.assert_allclose(np.abs(found.T[:, 0]), np.eye(5)[0], atol=1e-12)
    # u that moves nothing and costs nothing is no input at all
    none = full_information(A, B[:, :2], 0 * B[:, 2:], C[:2], D[:2, :2], D[:2, 2:])
    assert none.B2.shape[1] == 0 and none.A.shape == A.shape

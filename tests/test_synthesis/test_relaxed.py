"""Lower bounds of singular problems, against scalar ones known by hand, and the search's misses."""

import numpy as np
import pytest
import scipy.linalg as la

from flexplant.lti import StateSpace
from flexplant.synthesis import Lmi, design_hinf
from flexplant.synthesis.hinf.lower_bound import (
    FullInformation,
    pointwise_bound,
    relaxed_bound,
    zero_bound,
)
from flexplant.synthesis.preparation import prepared
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
    parts = A, B[:, :2], B[:, 2:], C[:2], D[:2, :2], D[:2, 2:], np.eye(len(A))
    found = FullInformation(*parts).regular()
    np.testing.assert_allclose(found.A, [[1.0]], atol=1e-12)
    assert abs(found.D12[0, 0]) < 1e-12 < abs(found.D12[1, 0])
    assert abs(found.B2[0, 0]) == pytest.approx(abs(found.D12[1, 0]))
    np.testing.assert_allclose(np.abs(found.T[:, 0]), np.eye(5)[0], atol=1e-12)
    # u that moves nothing and costs nothing is no input at all
    none = FullInformation(*parts)._replace(B2=0 * parts[2]).regular()
    assert none.B2.shape[1] == 0 and none.A.shape == A.shape


def test_the_pointwise_bound_by_hand():
    """Two z, one u that moves the first only: the second is w's own gain, at most 2."""
    P, u, y = named(
        np.diag([-1.0, -1.0]),
        np.array([[1.0, 1.0], [2.0, 0.0]]),
        np.array([[1.0, 0.0], [0.0, 1.0], [1.0, 0.0]]),
        np.array([[0.0, 0.0], [0.0, 0.0], [1.0, 0.0]]),
        1,
        1,
    )
    assert pointwise_bound(prepared(P, u, y)) == pytest.approx(2.0, rel=1e-9)


@pytest.mark.parametrize("side", ["u", "y"])
@pytest.mark.parametrize("omega", [0.0, 2.0])
def test_the_bound_of_a_zero_on_the_axis_by_hand(side, omega):
    """``u -> z = (s^2 + omega^2) / (s + 1)^2`` (s / (s + 1)^2 at zero): there u moves nothing.

    What is left is ``w -> z = 3 / (s + 1)^2 + 0.5`` at j omega.
    """
    A = np.array([[0.0, 1.0], [-1.0, -2.0]])
    c = [omega**2 - 1.0, -2.0] if omega else [0.0, 1.0]
    # x1 + r, r' = -r + 3 x3: w acts on the same states and on two more that u does not reach
    A = la.block_diag(A, A)
    B = np.array([[0.0, 0.0, 0.0], [0.0, 0.0, 1.0], [0.0, 0.0, 0.0], [3.0, 0.0, 0.0]])
    C = np.array([[*c, 1.0, 0.0], [0.0, 0.0, 1.0, 0.0]])
    D = np.array([[0.5, 0.0, 1.0 if omega else 0.0], [0.0, 0.0, 0.0]])
    parts = A, B, C, D
    # y knows w: x3 of the dual is what u would have to move
    problem = prepared(*named(*(parts if side == "u" else dual(*parts))))
    best = abs(3.0 / (1.0 + 1j * omega) ** 2 + 0.5)
    assert zero_bound(problem) == pytest.approx(best, rel=1e-9)


def flexible(modes, seed=0):
    """Modes of 0.1 % damping with a rigid body: forces, positions with noise, little effort."""
    rng = np.random.default_rng(seed)
    omega = np.concatenate([[0.0], np.geomspace(1.0, 30.0, modes - 1)])
    zero, one = np.zeros((modes, modes)), np.eye(modes)
    A = np.block([[zero, one], [-np.diag(omega**2), -np.diag(2e-3 * omega)]])
    B = np.vstack([np.zeros((modes, 6)), rng.normal(size=(modes, 6))])
    B[:, 2:4] = 0.0
    C = np.hstack([rng.normal(size=(6, modes)), np.zeros((6, modes))])
    C[2:4] = 0.0
    D = np.zeros((6, 6))
    D[4:, 2:4] = D[2:4, 4:] = 1e-2 * np.eye(2)
    return named(A, B, C, D, 2, 2)


@pytest.mark.slow
@pytest.mark.parametrize("modes", [4, 12])
def test_rigid_body_and_light_damping(modes):
    """Riccati equations beside the LMIs, each bound below what the other reaches."""
    P, u, y = flexible(modes)
    found = design_hinf(P, u=u, y=y)
    assert found.lower <= found.gamma <= 1.06 * found.lower
    if modes > 4:  # a minute of Clarabel
        return
    other = design_hinf(P, Lmi(), u=u, y=y)
    assert other.gamma == pytest.approx(found.gamma, rel=0.06)
    assert other.lower <= found.gamma
    assert found.lower <= other.gamma


@pytest.mark.slow
def test_units_of_z_change_nothing():
    P, u, y = flexible(4)
    plain = design_hinf(P, u=u, y=y)
    for unit in (1e-9, 1e-3, 1e6):
        rows = np.where(np.arange(len(P.outputs)) < len(P.outputs) - len(y), unit, 1.0)[:, None]
        found = design_hinf(P.replace(C=rows * P.C, D=rows * P.D), u=u, y=y)
        assert found.gamma == pytest.approx(unit * plain.gamma, rel=3e-3, abs=0)
        assert found.lower == pytest.approx(unit * plain.lower, rel=1e-3, abs=0)


def test_what_was_tried_is_in_the_answer():
    P, u, y = flexible(2)
    found = design_hinf(P, u=u, y=y)
    assert found.tried == {"Riccati()": found.gamma}


@pytest.mark.parametrize("side", ["u", "y"])
@pytest.mark.parametrize("seed", range(4))
def test_feedthrough_that_u_does_not_reach(side, seed):
    """With D12 = 0 (D21 = 0) no controller changes D11: its norm is a lower bound."""
    rng = np.random.default_rng(seed)
    n = 3
    A = rng.normal(size=(n, n)) - 4.0 * np.eye(n)
    B, C = 0.1 * rng.normal(size=(n, 2)), 0.1 * rng.normal(size=(2, n))
    parts = A, B, C, np.array([[0.8, 0.0], [1.0, 0.0]])
    P, u, y = named(*(parts if side == "u" else dual(*parts)))
    assert pointwise_bound(prepared(P, u, y)) == pytest.approx(0.8, rel=1e-12)
    found = design_hinf(P, u=u, y=y)
    assert 0.8 * (1 - 1e-9) <= found.lower <= found.gamma

"""White noise per sample: against quadrature, Van Loan, and the stationary covariance."""

import numpy as np
import pytest
import scipy.linalg as la
from hypothesis import given
from hypothesis import strategies as st
from scipy.integrate import quad_vec

from flexplant.lti import StateSpace
from flexplant.lti.sampling import sample_and_hold
from oracles_plant import noise_by_doubling


def pairs(omega, zeta, *, inputs=2, seed=0, blocks=True):
    omega = np.asarray(omega, float)
    scale, k = np.where(omega > 0, omega, 10.0), np.arange(omega.size)
    n = 2 * omega.size
    A = np.zeros((n, n))
    A[2 * k, 2 * k + 1], A[2 * k + 1, 2 * k] = scale, -(omega**2) / scale
    A[2 * k + 1, 2 * k + 1] = -2 * np.asarray(zeta) * omega
    B = np.random.default_rng(seed).standard_normal((n, inputs))
    D = np.zeros((1, inputs))
    return StateSpace(A, B, np.ones((1, n)), D, blocks=[2] * omega.size if blocks else None)


def covariance(g, asd, h):
    G = noise_factor(g, np.asarray(asd), h)
    return G @ G.T


def scaled_gap(found, wanted):
    size = np.sqrt(np.outer(wanted.diagonal(), wanted.diagonal()))
    return float(np.abs((found - wanted) / size).max())


def noise_factor(g, asd, h):
    return sample_and_hold(g, 1.0 / h, {}, asd=asd)[1]


MODEL = ([0.0, 30.0, 300.0, 4000.0], [0.0, 0.3, 0.01, 0.001])


@pytest.mark.parametrize("blocks", [True, False])
@pytest.mark.parametrize("h", [1e-4, 1e-3, 1e-2])
def test_against_quadrature(blocks, h):
    g = pairs(*MODEL, blocks=blocks)
    asd = np.array([2.0, 0.5])
    S = g.B @ np.diag(asd**2 / 2) @ g.B.T
    wanted, _ = quad_vec(lambda s: la.expm(g.A * s) @ S @ la.expm(g.A * s).T, 0, h, epsrel=1e-12)
    assert scaled_gap(covariance(g, asd, h), wanted) < 1e-10


def test_against_van_loan_on_a_small_model():
    g = pairs([30.0, 90.0], [0.1, 0.05])
    h, asd = 1e-3, np.array([1.0, 3.0])
    S = g.B @ np.diag(asd**2 / 2) @ g.B.T
    V = la.expm(np.block([[-g.A, S], [np.zeros((4, 4)), g.A.T]]) * h)
    wanted = V[4:, 4:].T @ V[:4, 4:]
    assert scaled_gap(covariance(g, asd, h), wanted) < 1e-11
    assert scaled_gap(noise_by_doubling(g.A, S, h), wanted) < 1e-11  # the oracle itself
    assert scaled_gap(covariance(g, 1.01 * asd, h), wanted) > 1e-2


def test_a_rigid_body_in_closed_form():
    g = pairs([0.0], [0.0], inputs=1)
    g = g.replace(B=[[0.0], [1.0]])
    h = 1e-3
    wanted = 0.5 * np.array([[100 * h**3 / 3, 10 * h**2 / 2], [10 * h**2 / 2, h]])
    np.testing.assert_allclose(covariance(g, [1.0], h), wanted, rtol=1e-13)


@pytest.mark.slow
@given(st.integers(0, 100), st.floats(1e-6, 1e-2), st.floats(1e-12, 1e12))
def test_it_is_a_covariance_of_the_right_size(seed, h, asd):
    g = pairs(*MODEL, seed=seed)
    G = noise_factor(g, np.array([asd, 0.0]), h)
    assert G.shape[0] == 8
    assert G.shape[1] <= 8
    one = covariance(g, [1.0, 0.0], h)
    assert scaled_gap(G @ G.T / asd**2, one) < 1e-12
    # two halves of a sample make a sample
    half = covariance(g, [1.0, 0.0], h / 2)
    E = la.expm(g.A * h / 2)
    assert scaled_gap(half + E @ half @ E.T, one) < 1e-9


def test_stationary_it_is_the_lyapunov_solution():
    g = pairs([30.0, 300.0], [0.3, 0.01])
    asd = np.array([1.0, 2.0])
    wanted = la.solve_continuous_lyapunov(g.A, -g.B @ np.diag(asd**2 / 2) @ g.B.T)
    h = 1e-3
    found = la.solve_discrete_lyapunov(la.expm(g.A * h), covariance(g, asd, h))
    assert scaled_gap(found, wanted) < 1e-9


@pytest.mark.parametrize("h", [1e-5, 1e-3, 1e-2])
def test_many_modes_under_few_forces_that_turn_often_in_a_sample(h):
    """X - E X E' with X stationary; the nodes of one interval reach up to 30 rad."""
    g = pairs(np.linspace(20.0, 3000.0, 60), np.full(60, 0.01), inputs=1)
    X, E = la.solve_continuous_lyapunov(g.A, -0.5 * g.B @ g.B.T), la.expm(g.A * h)
    size = np.sqrt(np.outer(X.diagonal(), X.diagonal()))
    found = covariance(g, [1.0], h)
    assert float(np.abs((found - X + E @ X @ E.T) / size).max()) < 1e-9


@pytest.mark.parametrize("rate", [1e4, 100.0, 1.0])
@pytest.mark.parametrize("blocks", [True, False])
def test_a_slow_sampler_of_a_fast_mode(rate, blocks):
    """A mode of 5 kHz at 1 Hz turns 5000 times a sample: X - E X E', X stationary and diagonal."""
    omega, zeta, h = 2 * np.pi * 5e3, 1e-3, 1 / rate
    A = np.array([[0.0, 1.0], [-(omega**2), -2 * zeta * omega]])
    g = StateSpace(A, [[0.0], [1.0]], [[1.0, 0.0]], [[0.0]], blocks=[2] if blocks else None)
    damped, decay = omega * np.sqrt(1 - zeta**2), np.exp(-zeta * omega * h)
    c, s = np.cos(damped * h), np.sin(damped * h) / damped
    E = decay * np.array([[c + zeta * omega * s, s], [-(omega**2) * s, c - zeta * omega * s]])
    X = 0.5 * np.diag([1 / (4 * zeta * omega**3), 1 / (4 * zeta * omega)])
    assert scaled_gap(covariance(g, [1.0], h), X - E @ X @ E.T) < 1e-9


@pytest.mark.slow
@pytest.mark.parametrize("size", [0.1, 3.0, 40.0, 300.0])
@pytest.mark.parametrize("zeta", [0.001, 0.3, 0.99])
def test_many_modes_and_few_forces_take_few_columns(size, zeta):
    """In closed form: v = x1 - i x2 follows v' = p v + f, with p and its conjugate."""
    n, h = 300, 1e-4
    p = np.geomspace(0.01, 1.0, n) * size / h * (-zeta + 1j * np.sqrt(1 - zeta**2))
    A, k = np.zeros((2 * n, 2 * n)), 2 * np.arange(n)
    A[k, k], A[k + 1, k + 1], A[k, k + 1], A[k + 1, k] = p.real, p.real, p.imag, -p.imag
    B = np.random.default_rng(3).standard_normal((2 * n, 2))
    g = StateSpace(A, B, np.ones((1, 2 * n)), np.zeros((1, 2)), blocks=[2] * n)
    G = noise_factor(g, np.ones(2), h)
    assert G.shape[1] <= 2 * (0.5 * size + 4 * np.cbrt(size) + 11)
    found, force = G[::2] - 1j * G[1::2], (B[::2] - 1j * B[1::2]) / np.sqrt(2)
    for other, right, q in ((found.conj(), force.conj(), p.conj()), (found, force, p)):
        s = p[:, None] + q
        wanted = force @ right.T * np.expm1(s * h) / s
        deviation = np.linalg.norm(found, axis=1)
        gap = np.abs(found @ other.T - wanted) / np.outer(deviation, deviation)
        assert gap.max() < 1e-11


def test_no_noise():
    g = pairs(*MODEL)
    assert noise_factor(g, np.zeros(2), 1e-3).shape == (8, 0)
    gain = StateSpace([], [], [], [[1.0]])
    assert noise_factor(gain, np.ones(1), 1e-3).shape == (0, 0)

"""normal_form against first-order eigenvalues, repeated poles, refusals."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

import oracles_structure as oracle
from flexplant.errors import ModelError
from flexplant.modes import NormalForm, normal_form


def chain(masses, stiffnesses):
    """A free chain."""
    n = len(masses)
    K = np.zeros((n, n))
    for i, k in enumerate(stiffnesses):
        K[i : i + 2, i : i + 2] += k * np.array([[1, -1], [-1, 1]])
    return np.diag(masses).astype(float), K


def receptance(form, s):
    """The receptance from poles and shapes, rigid-body part as 1/s^2."""
    r = form.n_rigid
    rigid = form.phi[:, :r].real
    H = rigid @ rigid.T / s**2
    for pole, x in zip(form.poles[r:], form.phi[:, r:].T, strict=True):
        residue = np.outer(x, x) / (2j * pole.imag)
        H = H + residue / (s - pole) + residue.conj() / (s - pole.conj())
    return H


def test_free_chain_without_damping():
    M, K = chain([1, 2, 3], [50, 70])
    form = normal_form(M, None, K, np.ones((3, 1)))
    omega, _ = oracle.undamped(M, K, 1)
    np.testing.assert_allclose(form.poles, 1j * omega, rtol=1e-12)
    assert form.poles[0] == 0
    assert form.is_real
    assert repr(form) == "<NormalForm: 3 modes, 1 rigid-body, real shapes>"
    np.testing.assert_allclose(form.phi.T @ M @ form.phi, np.eye(3), atol=1e-13)


@given(st.integers(0, 10**6), st.booleans())
def test_transfer_functions_equal_those_of_the_matrices(seed, proportional):
    rng = np.random.default_rng(seed)
    n = 5
    M, K = chain(rng.uniform(1, 3, n), rng.uniform(1e3, 1e4, n - 1))
    D = 1e-3 * K
    if not proportional:
        i = int(rng.integers(n - 1))
        D[i : i + 2, i : i + 2] += 5 * np.array([[1, -1], [-1, 1]])
    form = normal_form(M, D, K, np.ones((n, 1)))
    assert form.is_real == proportional
    for s in (3 + 40j, 70j, 150j):
        exact = np.linalg.inv(s**2 * M + s * D + K)
        np.testing.assert_allclose(receptance(form, s), exact, atol=1e-10 * np.abs(exact).max())
    rigid = form.phi[:, :1]
    np.testing.assert_allclose(rigid.T @ M @ rigid, 1, rtol=1e-13)


def test_repeated_poles_with_a_full_set_of_vectors():
    # two equal oscillators, seen in rotated coordinates, and a third that couples by D to neither
    Q = np.linalg.qr(np.random.default_rng(0).standard_normal((4, 4)))[0]
    K = Q @ np.diag([100.0, 100, 400, 900]) @ Q.T
    C = np.diag([0.5, 0.5, 1, 2])
    C[2, 3] = C[3, 2] = 0.7
    form = normal_form(np.eye(4), Q @ C @ Q.T, K, np.zeros((4, 0)))
    assert not form.is_real
    np.testing.assert_allclose(form.poles[0], form.poles[1], rtol=1e-12)
    s = 9j
    exact = np.linalg.inv(s**2 * np.eye(4) + s * (Q @ C @ Q.T) + K)
    np.testing.assert_allclose(receptance(form, s), exact, atol=1e-11)


def test_repeated_complex_poles():
    # two equal oscillators of two masses, damped non-proportionally, in rotated coordinates:
    # each complex pole twice, its vectors mixed at will by the eigenvalue solver
    Q = np.linalg.qr(np.random.default_rng(0).standard_normal((4, 4)))[0]
    K = Q @ np.kron([[300.0, -100], [-100, 900]], np.eye(2)) @ Q.T
    D = Q @ np.kron([[3.0, 0.5], [0.5, 0.2]], np.eye(2)) @ Q.T
    form = normal_form(np.eye(4), D, K, np.zeros((4, 0)))
    assert not form.is_real
    np.testing.assert_allclose(form.poles[::2], form.poles[1::2], rtol=1e-10)
    for s in (17j, 30j):
        exact = np.linalg.inv(s**2 * np.eye(4) + s * D + K)
        np.testing.assert_allclose(receptance(form, s), exact, atol=1e-11)


def test_a_damper_on_one_of_a_repeated_pair():
    D = np.array([[0.5, 0.5], [0.5, 0.5]])
    form = normal_form(np.eye(2), D, 100 * np.eye(2), np.zeros((2, 0)))
    found = np.sort(form.poles.real)
    np.testing.assert_allclose(found, [-0.5, 0.0], atol=1e-12)


def test_rigid_vectors_need_not_be_orthonormal():
    M, K = chain([1, 2, 3], [50, 70])
    one = normal_form(M, None, K, np.ones((3, 1)))
    other = normal_form(M, None, K, -7 * np.ones((3, 1)))
    np.testing.assert_allclose(other.poles, one.poles, rtol=1e-14)


def test_weak_dampers_to_ground_leave_rigid_body_modes_alone():
    M, K = chain([1, 2, 3], [5e4, 7e4])
    ground = np.diag([1e-4, 0, 0])
    form = normal_form(M, ground, K, np.ones((3, 1)))
    assert form.poles[0] == 0
    with pytest.raises(ModelError, match="dampers to ground"):
        normal_form(M, 1e6 * ground, K, np.ones((3, 1)))


@pytest.mark.parametrize(
    ("D", "K", "says"),
    [
        (np.diag([100.0, 100]), np.eye(2) * 100, "overdamped"),
        (np.array([[90.0, 10], [10, 30]]), np.diag([100.0, 400]), "overdamped"),
        (None, np.diag([1.0, -1.0]), "negative stiffness"),
        (None, np.diag([1.0, 0.0]), "no stiffness"),
    ],
)
def test_refusals(D, K, says):
    with pytest.raises(ModelError, match=says):
        normal_form(np.eye(2), D, K, np.zeros((2, 0)))


def test_indefinite_mass_is_refused():
    with pytest.raises(ModelError, match="positive definite"):
        normal_form(np.diag([1.0, -1.0]), None, np.eye(2), np.zeros((2, 0)))
    with pytest.raises(ModelError, match="depends"):
        normal_form(np.eye(2), None, np.zeros((2, 2)), np.ones((2, 2)))


def test_it_is_a_value():
    form = NormalForm(np.array([1j]), np.array([[1.0]]), 0)
    with pytest.raises(ValueError, match="read-only"):
        form.phi[0, 0] = 2


def test_slow_close_modes_beside_fast_ones_stay_apart():
    # rounding of the fastest mode over the gap of the slow ones: 1e-16 * 5e5 / 1e-6
    n = 60
    omega = np.concatenate([[10.0, 10.0 * (1 + 1.2e-7)], np.geomspace(4e3, 5e5, n - 2)])
    mixed = np.random.default_rng(1).standard_normal((n, n))
    D = np.diag(0.01 * omega) + 1e-5 * mixed @ mixed.T * np.sqrt(np.outer(omega, omega))
    form = normal_form(np.eye(n), D, np.diag(omega**2), np.zeros((n, 0)))
    X, poles = form.phi, form.poles
    whole = 2 * np.real((X * poles / (2j * poles.imag)) @ X.T)  # M^-1
    np.testing.assert_allclose(whole, np.eye(n), atol=1e-10)

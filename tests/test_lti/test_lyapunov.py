"""Stein and Lyapunov equations and Gramians, against one linear system of n^2 unknowns."""

from fractions import Fraction

import numpy as np
import pytest
import scipy.linalg as la
from hypothesis import given
from hypothesis import strategies as st

from flexplant.errors import ModelError, ShapeError, SolverError
from flexplant.lti import (
    StateSpace,
    controllability_gramian,
    equations,
    observability_gramian,
    solve_lyapunov,
    solve_stein,
)
from oracles_lti import lyapunov, stein


def stable(seed, n=6, *, discrete):
    rng = np.random.default_rng(seed)
    A = rng.standard_normal((n, n))
    if discrete:
        A *= rng.uniform(0.1, 0.999) / np.abs(la.eigvals(A)).max()
    else:
        A -= np.eye(n) * (la.eigvals(A).real.max() + rng.uniform(0.01, 2.0))
    G = rng.standard_normal((n, n))
    return A, G + G.T, rng


@given(st.integers(0, 10_000))
def test_stein_is_the_linear_system(seed):
    A, Q, _ = stable(seed, discrete=True)
    X = solve_stein(A, Q)
    np.testing.assert_allclose(X, stein(A, Q), atol=1e-9 * np.abs(X).max())
    np.testing.assert_array_equal(X, X.T)


@given(st.integers(0, 10_000))
def test_lyapunov_is_the_linear_system(seed):
    A, Q, _ = stable(seed, discrete=False)
    X = solve_lyapunov(A, Q)
    np.testing.assert_allclose(X, lyapunov(A, Q), atol=1e-9 * np.abs(X).max())
    np.testing.assert_array_equal(X, X.T)


@pytest.mark.parametrize("shape", [np.triu, np.tril, np.asarray])
@pytest.mark.parametrize("diagonal", [0.0, 1e-27, 1e-12])
def test_stein_of_a_right_side_with_a_small_diagonal(shape, diagonal):
    """Some or all diagonal entries of Q are rounding, in any units of the states."""
    rng = np.random.default_rng(5)
    for _ in range(100):
        n = int(rng.integers(2, 7))
        A = shape(rng.standard_normal((n, n)))
        A *= 0.95 / np.abs(la.eigvals(A)).max()
        Q = rng.standard_normal((n, n))
        Q += Q.T
        small = np.flatnonzero(rng.random(n) < rng.choice([0.3, 1.0]))
        Q[small, small] = diagonal * rng.standard_normal(small.size)
        d = 2.0 ** rng.integers(-30, 30, n)
        X = solve_stein(A * d[:, None] / d, Q * d * d[:, None]) / d / d[:, None]
        expected = stein(A, Q)
        np.testing.assert_allclose(X, expected, rtol=0, atol=1e-9 * np.abs(expected).max())


def test_a_wrong_entry_of_a_stein_solution_is_found(monkeypatch):
    """Each entry is held against its own terms: one that is off by 1e-8 of them is refused."""
    rng = np.random.default_rng(6)
    A = np.triu(rng.standard_normal((4, 4)))
    A *= 0.9 / np.abs(la.eigvals(A)).max()
    Q = rng.standard_normal((4, 4))
    Q += Q.T
    Q[3, 3] = 1e-27
    right = equations.stein
    for i, j in np.ndindex(4, 4):
        change = np.zeros((4, 4))
        change[i, j] = 1e-7
        monkeypatch.setattr(equations, "stein", lambda A, Q, by=change: right(A, Q) * (1.0 + by))
        with pytest.raises(SolverError, match="residual"):
            solve_stein(A, Q)


def test_scalar_values():
    assert solve_stein(np.array([[0.5]]), np.array([[3.0]]))[0, 0] == pytest.approx(
        4.0, rel=1e-15, abs=0
    )
    assert solve_lyapunov(np.array([[-2.0]]), np.array([[8.0]]))[0, 0] == pytest.approx(2.0)
    assert solve_stein(np.zeros((0, 0)), np.zeros((0, 0))).shape == (0, 0)
    assert solve_lyapunov(np.zeros((0, 0)), np.zeros((0, 0))).shape == (0, 0)
    assert not solve_stein(0.5 * np.eye(2), np.zeros((2, 2))).any()


@pytest.mark.slow
@given(st.lists(st.integers(-30, 30), min_size=6, max_size=6))
def test_units_do_not_matter(powers):
    d = 2.0 ** np.array(powers)
    for solve, discrete in ((solve_stein, True), (solve_lyapunov, False)):
        A, Q, _ = stable(3, discrete=discrete)
        Q = Q @ Q
        X, moved = solve(A, Q), solve(A * d[:, None] / d, Q * d * d[:, None])
        scale = np.sqrt(np.diag(X))
        error = (moved / d / d[:, None] - X) / scale / scale[:, None]
        assert np.abs(error).max() < 1e-9


def modal(blocks_seed, *, sampled):
    rng = np.random.default_rng(blocks_seed)
    sizes, parts = rng.integers(1, 3, 7), []
    for size in sizes:
        w, z = 10 ** rng.uniform(0, 4), 10 ** rng.uniform(-4, 0)
        pair = np.array([[0.0, w], [-w, -2 * z * w]]) if size == 2 else np.array([[-w]])
        parts.append(la.expm(pair * 1e-4) if sampled else pair)
    A = la.block_diag(*parts)
    n = A.shape[0]
    return StateSpace(
        A,
        rng.standard_normal((n, 2)),
        rng.standard_normal((3, n)),
        np.zeros((3, 2)),
        1e-4 if sampled else 0.0,
        blocks=sizes,
    )


@pytest.mark.parametrize("sampled", [False, True])
@pytest.mark.parametrize("seed", range(5))
def test_modal_gramians_are_those_of_the_dense_system(seed, sampled):
    g = modal(seed, sampled=sampled)
    oracle = stein if sampled else lyapunov
    P, Q = controllability_gramian(g), observability_gramian(g)
    for found, expected in ((P, oracle(g.A, g.B @ g.B.T)), (Q, oracle(g.A.T, g.C.T @ g.C))):
        scale = np.sqrt(np.diag(expected))
        np.testing.assert_allclose(
            found / scale / scale[:, None], expected / scale / scale[:, None], atol=1e-8
        )
    dense = controllability_gramian(g.replace(blocks=None))
    scale = np.sqrt(np.diag(P))
    np.testing.assert_allclose(
        P / scale / scale[:, None], dense / scale / scale[:, None], atol=1e-8
    )


def test_gramian_of_coupled_blocks_takes_the_dense_way():
    g = StateSpace(
        [[-1.0, 5.0], [0.0, -2.0]], [[0.0], [1.0]], np.eye(2), np.zeros((2, 1)), blocks=[1, 1]
    )
    np.testing.assert_allclose(controllability_gramian(g), lyapunov(g.A, g.B @ g.B.T), atol=1e-12)


def test_marginal_systems_are_refused():
    integrator = np.array([[0.0, 1.0], [0.0, 0.0]])
    with pytest.raises(SolverError, match="not strictly stable"):
        solve_stein(np.eye(2), np.eye(2))
    with pytest.raises(SolverError, match="not strictly stable"):
        solve_stein(1.5 * np.eye(2), np.eye(2))
    with pytest.raises(SolverError, match="not strictly stable"):
        solve_lyapunov(integrator, np.eye(2))
    with pytest.raises(SolverError, match="rigid-body"):
        controllability_gramian(StateSpace(integrator, np.eye(2), np.eye(2), np.zeros((2, 2))))


@pytest.mark.parametrize("solve", [solve_stein, solve_lyapunov])
@pytest.mark.parametrize(
    ("A", "Q", "error"),
    [
        (np.ones((2, 3)), np.eye(2), ShapeError),
        (0.5 * np.eye(2), np.eye(3), ShapeError),
        (0.5 * np.eye(2), np.array([[1.0, 2.0], [0.0, 1.0]]), ModelError),
        (np.array([[np.inf]]), np.eye(1), ModelError),
    ],
)
def test_bad_input(solve, A, Q, error):
    with pytest.raises(error, match=r"^[AQ] (must|has a NaN)"):
        solve(A, Q)


def test_a_nearly_triangular_matrix_of_any_sizes():
    """Scales beyond 2^63: scipy's matrix_balance reads those as permutations, with a warning.

    The reference has the triangle alone, which is solved by substitution without cancellation.
    """
    n = 4
    A = np.diag(np.full(n - 1, 1e13), 1) - np.diag(np.arange(1.0, n + 1))
    X = la.solve_continuous_lyapunov(A, -np.eye(n))
    found = solve_lyapunov(A + np.tril(np.full((n, n), 1e-300), -1), np.eye(n))
    size = np.sqrt(np.outer(X.diagonal(), X.diagonal()))
    np.testing.assert_allclose(found / size, X / size, rtol=0, atol=1e-14)


def test_the_residual_refuses_a_wrong_lyapunov_solution(monkeypatch):
    exact = equations.lyapunov
    monkeypatch.setattr(equations, "lyapunov", lambda A, Q: (1 + 1e-6) * exact(A, Q))
    with pytest.raises(SolverError, match="of its terms"):
        solve_lyapunov(np.diag([-1.0, -2.0]), np.eye(2))


def test_sylvester_equation_of_two_matrices():
    rng = np.random.default_rng(3)
    A, B = rng.standard_normal((5, 5)), rng.standard_normal((3, 3)) + 9 * np.eye(3)
    X = rng.standard_normal((5, 3))
    found = equations.sylvester(A, B, X @ B - A @ X)
    np.testing.assert_allclose(found, X, rtol=0, atol=1e-12 * np.abs(X).max())


@pytest.mark.parametrize("zeta", [1e-7, 1e-3, 0.5, 0.999])
def test_the_gramian_of_light_modes_has_all_its_digits(zeta):
    """By hand: of one mode diag(1 / 4 z w^3, 1 / 4 z w); of two, velocities by the same force."""
    w = np.array([1.0, 1.0 + 1e-6, 300.0])
    A = la.block_diag(*([[0.0, 1.0], [-(f**2), -2.0 * zeta * f]] for f in w))
    B = np.tile([[0.0], [1.0]], (3, 1))
    g = StateSpace(A, B, np.eye(6), np.zeros((6, 1)), blocks=[2, 2, 2])
    X = controllability_gramian(g)
    np.testing.assert_allclose(X[0::2, 0::2].diagonal(), 0.25 / (zeta * w**3), rtol=1e-13, atol=0)
    np.testing.assert_allclose(X[1::2, 1::2].diagonal(), 0.25 / (zeta * w), rtol=1e-13, atol=0)
    # E v_a v_b = (c b^2 + d a^2) / ((a^2 - b^2)^2 + (c + d) (c b^2 + d a^2)), c = 2 z a, d = 2 z b
    a, b = (Fraction(float(one)) for one in w[:2])
    c, d = (2 * Fraction(zeta) * one for one in (a, b))
    found = X[1, 3] * float((a**2 - b**2) ** 2 + (c + d) * (c * b**2 + d * a**2))
    assert found == pytest.approx(float(c * b**2 + d * a**2), rel=1e-9)

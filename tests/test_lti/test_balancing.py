"""Hankel values and balanced reduction: closed forms, dense Gramians, promised and made errors."""

import numpy as np
import pytest
import scipy.linalg as la
from hypothesis import given
from hypothesis import strategies as st

from flexplant.errors import ModelError, SolverError
from flexplant.lti import (
    StateSpace,
    append,
    balanced,
    discretized,
    frequency_response,
    hankel_norm,
    hankel_values,
    hinf_norm,
    linf_norm,
    minimal,
    modal_form,
    norm_report,
    split_stable,
    tf,
)
from flexplant.lti.lyapunov import controllability_factor, observability_factor
from oracles_lti import hankel, largest_gain, lyapunov, stein, sweep
from systems_lti import machine

LAG = StateSpace([[-2e3]], [[2e3]], [[1.0]], [[0.0]])


def stable(seed, n=6, m=2, p=3):
    rng = np.random.default_rng(seed)
    A = rng.standard_normal((n, n))
    A -= np.eye(n) * (la.eigvals(A).real.max() + rng.uniform(0.1, 1.0))
    D = rng.standard_normal((p, m))
    return StateSpace(A, rng.standard_normal((n, m)), rng.standard_normal((p, n)), D)


@pytest.mark.slow
@given(st.integers(0, 10_000), st.booleans())
def test_factors_and_hankel_values_against_dense_gramians(seed, sampled):
    g = stable(seed)
    g = g.replace(A=la.expm(0.3 * g.A), dt=0.3) if sampled else g
    solve = stein if sampled else lyapunov
    P, Q = solve(g.A, g.B @ g.B.T), solve(g.A.T, g.C.T @ g.C)
    L, M = controllability_factor(g), observability_factor(g)
    np.testing.assert_allclose(L @ L.T, P, rtol=0, atol=1e-9 * np.abs(P).max())
    np.testing.assert_allclose(M @ M.T, Q, rtol=0, atol=1e-9 * np.abs(Q).max())
    expected = hankel(g.A, g.B, g.C, sampled)
    np.testing.assert_allclose(hankel_values(g), expected, rtol=1e-6, atol=1e-7 * expected[0])
    assert hankel_norm(g) == pytest.approx(expected[0], rel=1e-9)
    assert hankel_norm(g) <= hinf_norm(g.replace(D=0 * g.D)) * (1 + 1e-9)


def test_small_hankel_values_keep_their_digits():
    # first-order lags far apart: the values are those of a Cauchy matrix, known in closed form
    poles = np.array([1.0, 1e2, 1e4])
    B = np.sqrt(np.array([[1.0], [1e-5], [1e-9]]))
    g = StateSpace(-np.diag(poles), B, B.T, [[0.0]])
    # symmetric: P = Q, so the values are the eigenvalues of P; determinant of a Cauchy matrix
    found = hankel_values(g)
    cauchy = np.prod([(poles[i] - poles[j]) ** 2 for i in range(3) for j in range(i)]) / np.prod(
        poles[:, None] + poles[None, :]
    )
    assert np.prod(found) == pytest.approx(cauchy * np.prod(B) ** 2, rel=1e-10, abs=0)
    assert found[-1] < 1e-12 * found[0]


@pytest.mark.parametrize("delay", [None, 1.0])
def test_hankel_values_of_a_machine_equal_slycot(delay):
    slycot = pytest.importorskip("slycot")
    g = machine(0, 12, m=3, p=2)
    g = g if delay is None else discretized(g, 1e4, delay=delay)
    parts = g.A.copy(), g.B.copy(), g.C.copy()
    found = slycot.ab09ad("D" if g.dt else "C", "B", "S", g.n_states, 3, 2, *parts, nr=10)
    np.testing.assert_allclose(hankel_values(g)[:20], found[4][:20], rtol=1e-8)


@pytest.mark.slow
@given(st.integers(0, 10_000), st.integers(0, 6), st.booleans(), st.booleans())
def test_promised_and_made_error(seed, order, match_dc, sampled):
    g = stable(seed)
    g = g.replace(A=la.expm(0.3 * g.A), dt=0.3) if sampled else g
    found = balanced(g, order=order, match_dc=match_dc)
    r = found.system
    assert r.n_states == order
    assert r.is_stable
    assert (r.inputs, r.outputs, r.dt) == (g.inputs, g.outputs, g.dt)
    expected = hankel(g.A, g.B, g.C, sampled)
    assert found.bound == pytest.approx(2 * expected[order:].sum(), rel=1e-5, abs=1e-7)
    grid = np.concatenate([[0.0], np.geomspace(1e-3, 1.6, 150)])
    difference = sweep(g.A, g.B, g.C, g.D, g.dt, grid) - sweep(r.A, r.B, r.C, r.D, r.dt, grid)
    made = max(np.linalg.norm(H, 2) for H in np.moveaxis(difference, 2, 0))
    floor = 1e-9 * hankel_norm(g)
    assert made <= found.error * (1 + 1e-8) + floor
    assert found.error <= found.bound * (1 + 1e-6) + floor
    if order < 6:  # no reduction does better than the next Hankel value
        assert found.error >= expected[order] * (1 - 1e-5) - floor
    if match_dc:
        np.testing.assert_allclose(difference[:, :, 0], 0, atol=1e-8 * np.abs(g.D).max() + 1e-7)
    elif not sampled:
        np.testing.assert_array_equal(r.D, g.D)


def test_one_lag_less():
    # 1/(s+1) + e/(s+9): P and Q are known, the error of a symmetric system is the bound
    g = StateSpace(np.diag([-1.0, -9.0]), [[1.0], [0.1]], [[1.0, 0.1]], [[0.0]])
    P = np.array([[1 / 2, 0.1 / 10], [0.1 / 10, 0.01 / 18]])
    values = np.sort(la.eigvalsh(P))[::-1]
    np.testing.assert_allclose(hankel_values(g), values, rtol=1e-10)
    found = balanced(g, order=1)
    assert found.bound == pytest.approx(2 * values[1], rel=1e-9)
    assert found.error == pytest.approx(2 * values[1], rel=1e-7)
    assert found.error_freq == pytest.approx(0.0, abs=1e-9)


@pytest.mark.parametrize("delay", [None, 1.0])
@pytest.mark.parametrize("blocks", [True, False])
def test_rigid_body_modes_are_kept(blocks, delay):
    g = machine(3, 12, m=3, p=2, zeta=1e-2)
    g = g if delay is None else discretized(g, 1e4, delay=delay)
    found = balanced(g if blocks else g.replace(blocks=None), order=20)
    assert (found.n_kept, found.system.n_states) == (6, 20)
    freq = np.geomspace(0.1, 4900.0, 300)
    difference = frequency_response(g, freq).data - frequency_response(found.system, freq).data
    made = np.linalg.svd(np.moveaxis(difference, 2, 0), compute_uv=False)[:, 0]
    low = frequency_response(g, np.array([0.1])).data
    assert made[0] < 1e-5 * np.abs(low).max()
    assert made[100:].max() <= found.error * (1 + 1e-3)
    assert found.error <= found.bound
    assert found.system.states[-1] == "kept6"
    assert "27" not in repr(found) and "6 kept exactly" in repr(found)


def test_an_unstable_mode_is_kept():
    g = append(
        stable(1, m=1, p=1).replace(inputs=["a"], outputs=["x"]),
        StateSpace([[0.5]], [[1.0]], [[1.0]], [[0.0]], inputs=["b"], outputs=["y"]),
    )
    found = balanced(g, order=4)
    assert found.n_kept == 1
    assert np.max(found.system.poles().real) == pytest.approx(0.5)


def test_the_smallest_order_within_a_tolerance():
    g = machine(0, 12, m=2, p=2, zeta=1e-2)
    values = hankel_values(g)
    for tol in (1.0, 0.1, 1e-3):
        found = balanced(g, tol=tol)
        r = found.system.n_states
        assert 2 * values[r:].sum() <= tol * values[0]
        assert 2 * values[r - 1 :].sum() > tol * values[0]
    assert balanced(g, tol=100.0).system.n_states == 0
    again = balanced(g, order=24)
    assert again.bound == 0.0
    assert again.error < 1e-10 * values[0]


@pytest.mark.slow
def test_weights_move_the_error_out_of_their_band():
    g = machine(0, 16, m=2, p=2, zeta=1e-2)
    low = append(
        *(LAG.replace(inputs=[f"a{i}"], outputs=[f"b{i}"], states=[f"s{i}"]) for i in range(2))
    )
    plain = balanced(g, order=10)
    for sides in (
        {"input_weight": low},
        {"output_weight": low},
        {"input_weight": low, "output_weight": low},
    ):
        found = balanced(g, order=10, **sides)
        assert np.isnan(found.bound)
        assert "no bound (weighted)" in repr(found)
        r = found.system
        grid = np.concatenate([[0.0], np.linspace(100, 5000, 300), [found.error_freq]])

        def weighted(h, grid=grid, sides=sides):
            H = sweep(h.A, h.B, h.C, h.D, 0.0, grid)
            W = 1 / (1 + 2j * np.pi * grid / 2e3) ** len(sides)
            return H * W

        made = weighted(g) - weighted(r)
        size = np.linalg.svd(np.moveaxis(made, 2, 0), compute_uv=False)[:, 0]
        assert size.max() == pytest.approx(found.error, rel=1e-6, abs=0)
        other = weighted(g) - weighted(plain.system)
        worse = np.linalg.svd(np.moveaxis(other, 2, 0), compute_uv=False)[:, 0].max()
        assert found.error < worse * (1 + 1e-9)


def test_a_weight_of_one_changes_nothing():
    g = stable(3)
    one = StateSpace([], [], [], np.eye(2))
    np.testing.assert_allclose(
        balanced(g, order=3, input_weight=one).system.poles(), balanced(g, order=3).system.poles()
    )


def test_bad_reductions():
    g = stable(0)
    for bad in ({}, {"order": 2, "tol": 0.1}):
        with pytest.raises(ModelError, match=r"either order= .* or tol="):
            balanced(g, **bad)
    for order in (-1, 7, 2.5):
        with pytest.raises(ModelError, match="order must be a whole number from 0"):
            balanced(g, order=order)
    with pytest.raises(ModelError, match="order must be a whole number from 6"):
        balanced(machine(3, 3), order=5)
    with pytest.raises(ModelError, match="tol"):
        balanced(g, tol=0.0)
    with pytest.raises(ModelError, match="needs 2 outputs"):
        balanced(g, order=2, input_weight=LAG)
    with pytest.raises(ModelError, match="unstable"):
        balanced(
            stable(0, m=1), order=2, input_weight=StateSpace([[1.0]], [[1.0]], [[1.0]], [[0.0]])
        )
    with pytest.raises(ModelError, match="sampling time"):
        balanced(stable(0, m=1), order=2, input_weight=LAG.replace(A=[[0.5]], dt=0.1))
    with pytest.raises(SolverError, match=r"no Hankel singular values: marginal.*split_stable"):
        hankel_values(machine(2, 2))
    with pytest.raises(SolverError, match="not strictly stable"):
        controllability_factor(StateSpace([[1.0]], [[1.0]], [[1.0]], [[0.0]]))


@given(st.integers(0, 10_000), st.booleans())
@pytest.mark.slow
def test_peak_on_the_axis_of_unstable_systems(seed, sampled):
    rng = np.random.default_rng(seed)
    A = rng.standard_normal((5, 5))
    g = StateSpace(A, rng.standard_normal((5, 2)), rng.standard_normal((3, 5)), np.zeros((3, 2)))
    g = g.replace(A=la.expm(0.5 * A), dt=0.5) if sampled else g
    norm = linf_norm(g)
    top = 1.0 if sampled else 30.0
    poles = la.eigvals(A).imag
    grid = np.concatenate(
        [np.linspace(0, min(top, 3.0), 2000), np.abs(poles[np.abs(poles) < 6]) / (2 * np.pi)]
    )
    seen = largest_gain(g.A, g.B, g.C, g.D, g.dt, grid)
    assert seen <= norm * (1 + 1e-9)
    assert norm <= seen * 1.02
    if g.is_stable:
        assert norm == hinf_norm(g)
    else:
        assert hinf_norm(g) == np.inf


def test_a_block_with_poles_of_both_kinds_is_split():
    """1 / (s^2 - 1) is one block of 2 states: -0.5 / (s + 1) and 0.5 / (s - 1)."""
    parts = split_stable(tf([1.0], [1.0, 0.0, -1.0]))
    for part, pole in ((parts.stable, -1.0), (parts.rest, 1.0)):
        np.testing.assert_allclose(part.poles(), [pole], rtol=1e-12)
        assert part(2j) == pytest.approx(0.5 * pole / (2j - pole), rel=1e-12, abs=0)


def test_the_reason_of_an_infinite_norm():
    rigid = machine(1, 2, m=1, p=1)
    dense = rigid.replace(blocks=None)
    mixing = np.random.default_rng(0).standard_normal((6, 6))
    # mixed, the double pole at 0 comes out at some 1e-5 rad/s, on either side
    assert np.abs(rigid.transformed(mixing).poles()).min() > 0
    for g in (rigid, dense, discretized(dense, 1e4), rigid.transformed(mixing)):
        report = norm_report(g)
        assert (report.h2, report.hinf, report.linf, report.hankel) == (np.inf,) * 4
        assert report.freq == 0.0
        (reason,) = report.reasons
        assert reason.startswith("marginal: a rigid-body mode or integrator lies on")
        assert reason in repr(report)
    unstable = StateSpace([[0.1, 5.0], [-5.0, 0.1]], np.eye(2), np.eye(2), np.zeros((2, 2)))
    report = norm_report(unstable)
    assert report.linf == pytest.approx(10.0)
    assert report.freq == pytest.approx(5 / (2 * np.pi))
    assert (report.h2, report.hinf, report.hankel) == (np.inf,) * 3
    assert report.reasons == (
        "unstable: a pole at 0.795775 Hz lies 0.1 rad/s beyond the imaginary axis",
    )
    swinging = StateSpace([[0.0, 5.0], [-5.0, 0.0]], np.eye(2), np.eye(2), np.zeros((2, 2)))
    for g in (swinging, swinging.replace(blocks=[2])):
        report = norm_report(g)
        assert report.linf == np.inf
        assert report.freq == pytest.approx(5 / (2 * np.pi))
        assert "an undamped pole at 0.795775 Hz" in report.reasons[0]
    through = norm_report(StateSpace([[-1.0]], [[1.0]], [[1.0]], [[1.0]]))
    assert (through.h2, through.hinf, through.linf) == (np.inf, *(pytest.approx(2.0),) * 2)
    assert through.reasons[0].startswith("feedthrough")
    fine = norm_report(machine(0, 2))
    assert fine.reasons == ()
    assert np.isfinite([fine.h2, fine.hinf, fine.linf, fine.hankel]).all()


def test_light_damping_is_not_called_marginal():
    for zeta in (1e-3, 1e-6):
        g = machine(0, 24, zeta=zeta, m=2, p=2)
        assert np.isfinite(hinf_norm(g))
        assert hinf_norm(g.replace(blocks=None)) == pytest.approx(hinf_norm(g), rel=1e-6, abs=0)
    slow = StateSpace(np.diag([-1e-4, -1e5]), np.ones((2, 1)), np.ones((1, 2)), [[0.0]])
    assert hinf_norm(slow) == pytest.approx(1e4, rel=1e-8)


@pytest.mark.parametrize("dt", [0.0, 1e-3])
def test_nothing_is_printed_where_no_state_is_stable(capfd, dt):
    """LAPACK complains on the screen about matrices without rows."""
    free = StateSpace([[0.0, 1.0], [0.0, 0.0]], [[0.0], [1.0]], [[1.0, 0.0]], [[0.0]])
    free = discretized(free, 1 / dt) if dt else free
    gain = StateSpace(np.zeros((0, 0)), np.zeros((0, 1)), np.zeros((1, 0)), [[2.0]], dt)
    with pytest.raises(ModelError, match="a whole number from 2"):
        balanced(free, order=1)
    assert balanced(free, order=2).system.n_states == 2
    assert balanced(gain, order=0).system.D == 2
    assert hankel_values(gain).size == 0
    for g in (free, gain):
        assert minimal(g).n_states == modal_form(g).system.n_states == g.n_states
    assert norm_report(gain).linf == 2
    assert capfd.readouterr() == ("", "")

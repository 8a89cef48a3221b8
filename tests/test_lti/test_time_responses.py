"""Answers over time, beside SciPy's integrator and python-control."""

import control
import numpy as np
import pytest
from scipy.integrate import solve_ivp

import flexplant as fx


def drawn(rng, m=2, p=2, dt=0.0):
    """Return a random stable system with a lightly damped mode and an integrator beside it."""
    n = int(rng.integers(2, 6))
    A = rng.normal(size=(n, n))
    A -= (max(np.linalg.eigvals(A).real) + 0.02) * np.eye(n)
    if dt:
        A = A / (1.02 * np.max(np.abs(np.linalg.eigvals(A))))
    D = rng.normal(size=(p, m))
    return fx.StateSpace(A, rng.normal(size=(n, m)), rng.normal(size=(p, n)), D, dt)


def integrated(g, u, time, start):
    """Return the outputs at instants by an adaptive integrator, for a function of time u."""
    found = solve_ivp(
        lambda t, x: g.A @ x + g.B @ u(t), (0, time[-1]), start, t_eval=time, rtol=1e-9, atol=1e-11,
        max_step=time[1],
    )  # fmt: skip
    return g.C @ found.y + g.D @ np.array([u(t) for t in time]).T


@pytest.mark.parametrize("seed", range(8))
def test_steps_and_impulses_are_those_of_an_integrator(seed):
    rng = np.random.default_rng(seed)
    g = drawn(rng)
    time = np.linspace(0, 8, 60)
    for j in range(2):
        one = np.eye(2)[j]
        expected = integrated(g, lambda t, one=one: one, time, np.zeros(g.n_states))
        np.testing.assert_allclose(fx.lti.step(g, time).data[:, j], expected, rtol=1e-6, atol=1e-7)
        free = integrated(g, lambda t: np.zeros(2), time, g.B[:, j])
        np.testing.assert_allclose(fx.lti.impulse(g, time).data[:, j], free, rtol=1e-6, atol=1e-7)


@pytest.mark.parametrize("between", ["held", "linear"])
@pytest.mark.parametrize("seed", range(4))
def test_any_signal_is_followed_exactly(seed, between):
    rng = np.random.default_rng(seed)
    g, time = drawn(rng), np.linspace(0, 6, 40)
    u, start = rng.normal(size=(2, time.size)), rng.normal(size=g.n_states)
    x, expected = start, [g.C @ start + g.D @ u[:, 0]]
    for k in range(time.size - 1):  # a step at a time: nothing jumps within one

        def slope(t, x, k=k):
            share = (t - time[k]) / time[1] if between == "linear" else 0.0
            return g.A @ x + g.B @ (u[:, k] + share * (u[:, k + 1] - u[:, k]))

        x = solve_ivp(slope, (time[k], time[k + 1]), x, rtol=1e-10, atol=1e-12).y[:, -1]
        expected.append(g.C @ x + g.D @ u[:, k + 1])
    found = fx.lti.lsim(g, u, time, start=start, between=between)
    np.testing.assert_allclose(found.data[:, 0], np.transpose(expected), rtol=1e-6, atol=1e-6)


@pytest.mark.parametrize("seed", range(4))
def test_sampled_systems_are_run_sample_by_sample(seed):
    g = drawn(np.random.default_rng(seed), dt=0.01)
    theirs = control.ss(g.A, g.B, g.C, g.D, g.dt)
    time = g.dt * np.arange(50)
    for ours, their in (
        (fx.lti.step, control.step_response),
        (fx.lti.impulse, control.impulse_response),
    ):
        np.testing.assert_allclose(
            ours(g, time).data, their(theirs, time).outputs, atol=1e-9, rtol=1e-9
        )


@pytest.mark.slow
@pytest.mark.parametrize(
    "poles", [(-1.0, -3.0), (-0.1 + 2j, -0.1 - 2j), (-1.0, -1e-3), (-0.7 + 0.7j, -0.7 - 0.7j)]
)
@pytest.mark.parametrize("gain", [1.0, -2e-9])
def test_figures_of_a_step_are_python_controls(poles, gain):
    den = np.real(np.poly(poles))
    g = fx.lti.tf([gain * den[-1]], den)
    found = fx.lti.step_info(g)
    time = np.linspace(0, 12 / min(abs(np.real(poles))), 200_001)
    theirs = control.step_info(control.tf([gain * den[-1]], den), T=time)
    for ours, their in (
        (found.rise, "RiseTime"), (found.settling, "SettlingTime"),
        (found.peak_time if found.overshoot else 1.0, "PeakTime" if found.overshoot else None),
    ):  # fmt: skip
        if their:
            assert ours == pytest.approx(theirs[their], rel=0.01), their
    assert found.overshoot == pytest.approx(theirs["Overshoot"], rel=0.01, abs=0.1)
    assert found.steady == pytest.approx(gain)


def test_a_loop_answers_its_references_by_name():
    plant = fx.testbeds.three_masses()
    observer = fx.design_kalman(plant)
    loop = fx.close_loop(plant, observer, fx.design_servo(plant, bandwidth=20.0, observer=observer))
    reference = "die:ref"
    answer = fx.lti.step(loop, duration=0.5)
    assert answer["die:x", reference][-1] == pytest.approx(1.0, abs=0.01)
    assert answer.units["die:x"] == "m"
    info = fx.lti.step_info(loop, output="die:x", input=reference)
    assert 0 < info.rise < info.settling < 0.5
    assert info.steady == pytest.approx(1.0, rel=1e-6)


def test_what_cannot_be_answered_says_why():
    lag, pair = fx.lti.tf([1.0], [1.0, 1.0]), fx.StateSpace(-np.eye(2), np.eye(2), np.eye(2), 0)
    for call, words in (
        (lambda: fx.lti.step(lag, [0.0, 1.0, 3.0]), "equal steps"),
        (lambda: fx.lti.step(lag, [1.0, 2.0]), "begin at 0"),
        (lambda: fx.lti.step(fx.lti.discretized(lag, 10.0), [0.0, 1.0]), "its own instants"),
        (lambda: fx.lti.step_info(pair), "say output="),
        (lambda: fx.lti.step_info(fx.lti.tf([1.0], [1.0, 0.0])), "not stable"),
        (lambda: fx.lti.step_info(fx.lti.tf([1.0, 0.0], [1.0, 1.0])), "static gain is 0"),
        (lambda: fx.lti.lsim(pair, [1.0, 2.0], [0.0, 1.0]), r"\(2, 2\)"),
        (lambda: fx.lti.step(pair)["y1"], "several inputs"),
    ):
        with pytest.raises(fx.FlexplantError, match=words):
            call()

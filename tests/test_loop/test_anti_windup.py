"""The recovery time of anti-windup is that of the slowest poles, by back-calculation and poles."""

import numpy as np
import pytest
import scipy.linalg as la

import flexplant as fx
from flexplant.errors import ModelError
from flexplant.loop.anti_windup import recovery_gain


def growth(A, dt):
    poles = la.eigvals(A)
    return np.sort(np.log(np.abs(poles)) / dt if dt else poles.real)


def random_law(rng, dt):
    """Poles, integrators among them, of which at most three are slower than the recovery time."""
    recovery, n_u = 10 ** rng.uniform(-2, 2), int(rng.integers(1, 4))
    slow, fast = int(rng.integers(1, 4)), int(rng.integers(0, 4))
    real = -rng.uniform(0.0, 0.8, slow) * (rng.random(slow) < 0.5)
    real = np.concatenate([np.unique(real), -rng.uniform(1.5, 9.0, fast)]) / recovery
    parts = [np.array([[value]]) for value in real]
    for decay in (rng.uniform(0.1, 0.7), rng.uniform(1.5, 5.0))[: rng.integers(0, 3)]:
        swing = rng.uniform(1.0, 5.0) / recovery
        parts.append(np.array([[-decay / recovery, swing], [-swing, -decay / recovery]]))
    A = la.block_diag(*parts)
    T = la.qr(rng.standard_normal(A.shape))[0] * 2.0 ** rng.integers(-3, 4, len(A))
    A = T @ A @ np.linalg.inv(T)
    C = rng.standard_normal((n_u, len(A))) * 10.0 ** rng.integers(-9, 9, (n_u, 1))
    return (la.expm(A * dt) if dt else A), C, recovery


@pytest.mark.slow
@pytest.mark.parametrize("sampled", [False, True])
def test_slow_poles_move_to_the_recovery_time_and_others_stay(sampled):
    for seed in range(200):
        rng = np.random.default_rng(seed)
        dt = 1e-3 if sampled else 0.0
        A, C, recovery = random_law(rng, dt)
        found = growth(A - recovery_gain(A, C, recovery, dt) @ C, dt)
        expected = np.sort(np.minimum(growth(A, dt), -1.0 / recovery))
        np.testing.assert_allclose(found, expected, rtol=2e-2, err_msg=f"seed {seed}")


@pytest.mark.parametrize("n_u", [1, 2, 3])
def test_integrators_return_as_by_back_calculation(n_u):
    """One integrator for each actuator, any units: the commands decay towards what is applied."""
    rng = np.random.default_rng(n_u)
    for recovery in (1e-2, 5.0, 1e4):
        C = np.diag(10.0 ** rng.uniform(-9, 9, n_u))
        dt = 1e-3
        L = recovery_gain(np.zeros((n_u, n_u)), C, recovery, 0.0)
        np.testing.assert_allclose(C @ L, np.eye(n_u) / recovery, atol=1e-9 / recovery)
        L = recovery_gain(np.eye(n_u), C, recovery, dt)
        back = -np.expm1(-dt / recovery)
        np.testing.assert_allclose(C @ L, np.eye(n_u) * back, atol=1e-8 * back)


def test_what_the_commands_do_not_show_is_refused():
    for A, dt in ((np.zeros((2, 2)), 0.0), (np.eye(2), 1e-3)):
        with pytest.raises(
            ModelError, match=r"2 slow states .* cannot all be determined from the 1 com"
        ):
            recovery_gain(A, np.array([[1.0, 2.0]]), 0.1, dt)
        with pytest.raises(ModelError, match="cannot all be determined"):
            recovery_gain(A, np.array([[0.0, 0.0]]), 0.1, dt)


def test_nothing_moves_where_nothing_is_slow():
    A, C = np.diag([-5.0, -9.0]), np.ones((1, 2))
    assert not recovery_gain(A, C, 1.0, 0.0).any()
    assert recovery_gain(np.zeros((0, 0)), np.zeros((1, 0)), 1.0, 0.0).shape == (0, 1)


@pytest.mark.parametrize("recovery", [0.5, 3.0, 5.0])
def test_a_saturated_pi_loop_is_that_of_back_calculation(recovery):
    """2 / (5 s + 1), a PI of gain 3 and 5 s, limit 0.6, step 1; sample by sample."""
    dt, gain, integral = 0.05, 3.0, 5.0
    plant = fx.lti.discretized(fx.lti.tf([2.0], [5.0, 1.0]), 1 / dt)
    law = fx.StateSpace(
        [[1.0]], [[dt, -dt]], [[gain / integral]], [[gain, -gain]], dt,
        inputs=["r", "y"], outputs=["u"],
    )  # fmt: skip
    both = fx.StateSpace(
        plant.A, plant.B, np.vstack([0 * plant.C, plant.C]), [[0.0], [0.0]], dt,
        inputs=["u"], outputs=["r", "y"],
    )  # fmt: skip
    both = both.replace(
        B=np.hstack([[[0.0]], plant.B]), D=[[1.0, 0.0], [0.0, 0.0]], inputs=["step", "u"]
    )
    machine = fx.StandardPlant.from_statespace(both, w=["step"], u=["u"], y=["r", "y"])
    loop = fx.close_loop(machine, law)
    run = fx.simulate(
        loop, disturbance={"step": np.ones(400)}, duration=400 * dt, noise=False,
        elements={"u": fx.simulation.Saturation(0.6)}, anti_windup=recovery,
    )  # fmt: skip
    x, c, expected = 0.0, 0.0, []
    back = -np.expm1(-dt / recovery) * integral / gain
    for _ in range(400):
        y = plant.C[0, 0] * x
        command = gain / integral * c + gain * (1.0 - y)
        u = np.clip(command, -0.6, 0.6)
        expected.append(y)
        c += dt * (1.0 - y) + back * (u - command)
        x = plant.A[0, 0] * x + plant.B[0, 0] * u
    np.testing.assert_allclose(run["y"], expected, atol=1e-12)
    form = fx.synthesis.anti_windup_form(law, recovery=recovery)
    assert -dt / np.log(form.poles().real) == pytest.approx(recovery, rel=1e-9)

"""The H2 norm of closed loops: an observer beside its plant, levitated bodies, SI units."""

from functools import cache

import numpy as np
import pytest
import scipy.linalg as la

from flexplant.errors import CertificateError, SolverError
from flexplant.estimation import design_kalman, design_static
from flexplant.loop import close_loop
from flexplant.lti import StateSpace, equations, h2_norm, solve_stein
from flexplant.lti import norms as h2_norms
from flexplant.plant import Sensor, assemble_plant
from flexplant.synthesis import design_servo
from machines import observer, servo, stage
from stages import INSET, NOISE, ports, reduced, sampled


def by_scipy(g):
    """The norm by SciPy's solvers (bilinear map, Schur form), which share nothing with ours."""
    if g.dt:
        P = la.solve_discrete_lyapunov(g.A, g.B @ g.B.T)
    else:
        P = la.solve_continuous_lyapunov(g.A, -g.B @ g.B.T)
    return np.sqrt(np.trace(g.C @ P @ g.C.T) + (np.sum(g.D**2) if g.dt else 0.0))


@cache
def kalman_loop(damping, bandwidth):
    """The servo on the Kalman filter's estimate: 54 states of the plate beside 66 of the laws."""
    plant = sampled(reduced(damping))
    return close_loop(plant, design_kalman(plant), design_servo(plant, bandwidth=bandwidth))


@pytest.mark.parametrize(("damping", "bandwidth"), [(0.01, 30.0), (0.01, 5.0), (0.001, 20.0)])
def test_loops_on_an_estimate(damping, bandwidth):
    """States that the efforts of 1e6 N drive and hardly move are no reason to refuse the norm."""
    g = kalman_loop(damping, bandwidth).system
    assert h2_norm(g) == pytest.approx(by_scipy(g), rel=1e-8, abs=0)


def test_other_loops():
    plant = sampled(reduced(0.01))
    loops = [
        close_loop(plant, design_static(plant), design_servo(plant, bandwidth=20.0)),
        close_loop(stage(), observer(), servo()),
    ]
    for loop in loops:
        assert h2_norm(loop.system) == pytest.approx(by_scipy(loop.system), rel=1e-8, abs=0)


def test_a_continuous_loop():
    """Proportional and derivative feedback from sensors beside the actuators of the free plate."""
    beside = [Sensor(f"y{i}", at=p, asd=NOISE) for i, p in enumerate(INSET, 1)]
    plant = assemble_plant(reduced(0.001), ports(y=beside))
    lag, k, d = 1e-4, 2e4, 2e2
    law = StateSpace(
        -np.eye(4) / lag, np.eye(4) / lag, d / lag * np.eye(4), -(k + d / lag) * np.eye(4),
        inputs=plant.y[:4], outputs=plant.u,
    )  # fmt: skip
    g = close_loop(plant, law).system.select(plant.z[:3], plant.w[:4])
    assert not g.D.any()
    assert h2_norm(g) == pytest.approx(by_scipy(g), rel=1e-8, abs=0)


def test_the_gramians_judge_each_other(monkeypatch):
    g = kalman_loop(0.01, 30.0).system
    exact = h2_norms.observability_factor  # a dense system's norm is that of two factors
    monkeypatch.setattr(h2_norms, "observability_factor", lambda g: (1 + 1e-5) * exact(g))
    with pytest.raises(CertificateError, match="by the observability Gramian"):
        h2_norm(g)


def test_the_residual_judges_the_series(monkeypatch):
    g = kalman_loop(0.01, 30.0).system
    exact = equations.doubled
    monkeypatch.setattr(equations, "doubled", lambda A, Q: (1 + 1e-3) * exact(A, Q))
    with pytest.raises(SolverError, match="of its terms"):
        solve_stein(g.A, g.B @ g.B.T)

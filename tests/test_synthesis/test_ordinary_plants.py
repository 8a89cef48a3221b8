"""Ordinary plants, with dead time, lags, one integrator or none, are served by both tuners."""

import numpy as np
import pytest

import flexplant as fx
from flexplant.synthesis import tune_pid

LAG = 1 / (2 * np.pi * 0.01)
#: numerator, denominator, rate [Hz], dead time [s]
PLANTS = {
    "process with dead time": ([2.0], [10.0, 1.0], 2.0, 2.0),
    "position of a DC motor": ([1.0], [5e-5, 0.0105, 0.2, 0.0], 500.0, 0.0),
    "speed of a DC motor": ([10.0], [0.05, 1.0], 500.0, 0.0),
    "temperature, pole at 0.01 Hz": ([1.0], [LAG, 1.0], 10.0, 0.0),
    "static gain": ([3.0], [1.0], 100.0, 0.0),
    "two lags and dead time": ([5.0], np.polymul([100.0, 1.0], [20.0, 1.0]), 1.0, 5.0),
    "integrating tank": ([1.0], [1.0, 0.0], 10.0, 0.0),
    "cooling": ([-4.0], [3.0, 1.0], 20.0, 0.1),
    "unstable lag": ([1.0], [1.0, -1.0], 100.0, 0.0),
    "zero in the right half plane": ([-1.0, 1.0], [2.0, 3.0, 1.0], 5.0, 0.0),
}


@pytest.mark.long
@pytest.mark.parametrize("name", PLANTS)
def test_both_tuners_serve_it(name):
    """Stable by the sampled loop's own eigenvalues, with the margin that was asked for."""
    num, den, rate, dead = PLANTS[name]
    g = fx.lti.tf(num, den) if len(den) > 1 else fx.StateSpace([], [], [], [[num[0]]])
    g = g.replace(inputs=["u"], outputs=["y"])
    sampled = fx.lti.discretized(g, rate, delay=dead * rate) if g.n_states else g
    if not g.n_states:
        sampled = g.replace(dt=1 / rate)
    pid = tune_pid(g, rate=rate, dead_time=dead, margin=0.5)
    loops = fx.tune_loops(sampled)
    for law in (pid.controller, loops.system):
        K = law.replace(inputs=["y"], outputs=["u"])
        A = closed(sampled, K)
        assert np.abs(np.linalg.eigvals(A)).max() < 1.0
        z = np.exp(1j * np.geomspace(1e-6, np.pi * 0.999, 8000))
        L = -np.array([(sampled.evaluated(one) @ K.evaluated(one))[0, 0] for one in z])
        assert np.abs(1 + L).min() >= 0.5 * (1 - 5e-3)
    assert pid.bandwidth > 0 and loops.report["y"].crossovers[0] > 0


def closed(g, K):
    """A of the loop u = K y, written out."""
    R = np.linalg.inv(np.eye(1) - K.D @ g.D)
    S = np.linalg.inv(np.eye(1) - g.D @ K.D)
    return np.block([
        [g.A + g.B @ R @ K.D @ g.C, g.B @ R @ K.C],
        [K.B @ S @ g.C, K.A + K.B @ S @ g.D @ K.C],
    ])  # fmt: skip

"""Continuous delays against Lambert's function, formulas by hand, Pade's systems and fine steps."""

import numpy as np
import pytest
from scipy.special import lambertw

import flexplant as fx
from flexplant.errors import AssumptionError, ModelError
from flexplant.loop import DelayedLoop
from flexplant.lti import Delayed, tf

pytestmark = pytest.mark.long


@pytest.mark.parametrize("seed", range(4))
def test_the_count_is_that_of_the_roots_of_lamberts_function(seed):
    """``s - a + k e^(-s tau) = 0``: ``s = a + W_n(-k tau e^(-a tau)) / tau``, all branches."""
    rng = np.random.default_rng(seed)
    for _ in range(3):
        a, k, tau = rng.uniform(-2, 1), rng.uniform(0.2, 12.0), rng.uniform(0.2, 2.0)
        branches = np.arange(-40, 41)
        roots = a + lambertw(-k * tau * np.exp(-a * tau), branches) / tau
        if np.abs(roots.real).min() < 1e-3:
            continue
        loop = DelayedLoop(Delayed(tf([1.0], [1.0, -a]), tau), tf([-k], [1.0]))
        assert loop.unstable_poles == np.count_nonzero(roots.real > 0)
        assert loop.is_stable == bool(np.all(roots.real < 0))


@pytest.mark.parametrize("k", [0.3, 0.7, 1.2, 1.5])
def test_margins_of_an_integrator_with_a_second_of_delay(k):
    """Gain pi / (2 k), phase 90 deg - k, delay (pi / 2 - k) / k; the edge at k = pi / 2."""
    loop = DelayedLoop(Delayed(tf([1.0], [1.0, 0.0]), 1.0), tf([-k], [1.0]))
    found = loop.margins
    assert found["gain"] == pytest.approx((np.pi / 2 / k, 0.25), rel=1e-6)
    assert found["phase"][0] == pytest.approx(90 - np.degrees(k), rel=1e-6)
    assert found["delay"] == pytest.approx(((np.pi / 2 - k) / k, k / (2 * np.pi)), rel=1e-6)
    assert loop.is_stable and not DelayedLoop(loop.plant, tf([-1.001 * np.pi / 2], [1.0])).is_stable


@pytest.mark.parametrize(
    ("num", "den", "law", "delay"),
    [
        ([1.0], [1.0, 0.0], ([0.2, 0.6], [1.0]), 1.0),  # PD, improper
        ([1.0], [1.0, 0.5, 0.0], ([1.0, 0.3], [1.0]), 1.0),
        ([1.0], [1.0, 0.02, 1.0], ([0.2, 0.0], [1.0]), 0.3),  # velocity of a light mode
        ([2.0], [1.0, -1.0], ([1.1], [1.0]), 0.2),  # unstable
        ([1.0], [1.0, 1.0], ([0.5, 1.0, 0.4], [1.0, 0.0]), 1.0),  # PID of a lag: neutral
    ],
)
def test_norms_are_those_with_pades_delay(num, den, law, delay):
    """The norms of S and T of an ordinary system with a delay of order 8."""
    plant, K = Delayed(tf(num, den), delay), -Delayed.tf(*law)
    loop = DelayedLoop(plant, K)
    L = fx.lti.minimal(loop.gain.pade(8))
    S = fx.lti.feedback(fx.StateSpace([], [], [], [[1.0]]), L)
    T = fx.lti.feedback(L, fx.StateSpace([], [], [], [[1.0]]))
    assert loop.is_stable and S.is_stable
    if loop.gain.system.D[0, 0] == 0:  # else Pade's phase ends, a neutral loop's does not
        assert loop.norm("S")[0] == pytest.approx(fx.hinf_norm(S), rel=1e-3)
        assert loop.norm("T")[0] == pytest.approx(fx.hinf_norm(T), rel=1e-3)
    assert loop.gain.pade_error(12, 0.3 / delay) < 1e-6
    assert loop.modulus_margin == pytest.approx(1 / loop.norm("S")[0])


def test_steps_by_hand_and_by_fine_samples():
    """An integrator: k (t - 1), then - k^2 (t - 2)^2 / 2; a PD loop by steps of 1e-4 s."""
    k = 0.5
    loop = DelayedLoop(Delayed(tf([1.0], [1.0, 0.0]), 1.0), tf([-k], [1.0]))
    t = np.array([0.5, 1.5, 2.5, 3.0])
    wanted = [0.0, k * 0.5, k * 1.5 - k**2 * 0.125, 2 * k - k**2 / 2]
    assert loop.step(t)[0] == pytest.approx(np.array(wanted), abs=1e-9)
    pd = DelayedLoop(Delayed(tf([1.0], [1.0, 0.5, 0.0]), 1.0), -Delayed.tf([1.0, 0.3], [1.0]))
    # L = (0.3 + s) / (s^2 + 0.5 s) e^-s by hand: p' = e, v' = -0.5 v + e, y = 0.6 p + 0.4 v
    h, n = 1e-3, 8000
    p = v = 0.0
    error, y = np.ones(n + 1), np.zeros(n + 1)
    for i in range(n):
        y[i] = 0.6 * p + 0.4 * v
        error[i] = 1.0 - y[i]
        late = error[i - 1000] if i >= 1000 else 0.0
        p, v = p + h * late, v * np.exp(-0.5 * h) + late * (1 - np.exp(-0.5 * h)) / 0.5
    assert pd.step([2.0, 4.0, 6.0])[0] == pytest.approx(y[[2000, 4000, 6000]], abs=3e-3)


def test_two_axes_and_products():
    """det(I + L) of a coupled plant, and K S, by numpy at single frequencies."""
    rng = np.random.default_rng(2)
    g = fx.StateSpace(
        -np.eye(3) + 0.2 * rng.standard_normal((3, 3)), rng.standard_normal((3, 2)),
        rng.standard_normal((2, 3)), 0, inputs=["a", "b"], outputs=["c", "d"],
    )  # fmt: skip
    K = fx.StateSpace([], [], [], -0.1 * np.eye(2), inputs=["c", "d"], outputs=["a", "b"])
    loop = DelayedLoop(Delayed(g, 0.5), K)
    s = 2j * np.pi * 0.3
    G = g.evaluated(s) * np.exp(-0.5 * s)
    S = np.linalg.inv(np.eye(2) - G @ K.D)
    assert loop.response("S", 0.3)[:, :, 0] == pytest.approx(S, rel=1e-9)
    assert loop.response("KS", 0.3)[:, :, 0] == pytest.approx(-K.D @ S, rel=1e-9)
    assert loop.is_stable and 0 < loop.modulus_margin < 1
    with pytest.raises(ModelError, match="2 channels"):
        _ = loop.margins
    product = Delayed.tf([1.0, 2.0], [1.0], delay=0.1) * tf([1.0], [1.0, 3.0])
    assert product(2j) == pytest.approx((2j + 2) / (2j + 3) * np.exp(-0.2j), rel=1e-12)
    frf = product.frequency_response([1.0])
    assert frf.data[0, 0, 0] == pytest.approx(product(2j * np.pi), rel=1e-12)


def test_bad_input_is_refused():
    """With the cause."""
    lag = tf([1.0], [1.0, 1.0])
    with pytest.raises(ModelError, match="neither plant nor controller"):
        DelayedLoop(lag, -lag)
    with pytest.raises(ModelError, match="grows without limit"):
        DelayedLoop(Delayed.tf([1.0, 1.0], [1.0], delay=1.0), -tf([1.0], [1.0]))
    with pytest.raises(AssumptionError, match="infinitely many"):
        _ = DelayedLoop(Delayed(lag, 1.0), -Delayed.tf([1.5, 1.0], [1.0])).unstable_poles
    with pytest.raises(ModelError, match="is sampled"):
        Delayed(fx.lti.tustin(lag, 10.0), 1.0)
    with pytest.raises(ModelError, match="delay must"):
        Delayed(lag, -1.0)
    with pytest.raises(ModelError, match="differentiates twice"):
        Delayed.tf([1.0, 0.0, 0.0], [1.0])
    with pytest.raises(ModelError, match="has no state space"):
        Delayed.tf([1.0, 0.0], [1.0], delay=1.0).pade(2)
    with pytest.raises(ModelError, match="which must"):
        DelayedLoop(Delayed(lag, 1.0), -lag).response("X", 1.0)

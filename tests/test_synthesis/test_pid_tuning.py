"""PID controllers of ordinary plants, judged by polynomials and by the delay itself."""

import numpy as np
import pytest
from scipy.signal import cont2discrete

import flexplant as fx
from flexplant.synthesis import tune_pid

#: name: numerator, denominator, rate [Hz] or None, dead time [s]
PLANTS = {
    "oven": ([40.0], [600.0, 1.0], 2.0, 20.0),
    "slow lag": ([1.0], [1.0, 2 * np.pi * 0.01], 10.0, 0.0),
    "motor": ([9.0], [0.02, 1.0, 0.0], 1000.0, 0.002),
    "motor, in continuous time": ([9.0], [0.02, 1.0, 0.0], None, 0.0),
    "three tanks": ([2e-3], np.poly([-0.01, -0.02, -0.05]), 1.0, 5.0),
    "double integrator": ([1e-3], [1.0, 0.0, 0.0], 200.0, 0.0),
    "cools when driven": ([-3.0], [30.0, 1.0], 2.0, 4.0),
    "wrong way first": ([-1.0, 1.0], np.poly([-1.0, -1.0, -0.5]), None, 0.0),
    "unstable": ([1.0], [1.0, -1.0], None, 0.0),
    "resonant": ([1.0], [1.0, 2e-3 * 50.0, 2500.0], 500.0, 0.0),
}
#: plants of which thousands of laws are tried before one is stable with its margin
SLOWEST = ("three tanks", "wrong way first")


def loop_gain(name, found):
    """Return L of negative feedback at frequencies, with hold and dead time, and its poles."""
    num, den, rate, late = PLANTS[name]
    w = 2 * np.pi
    k, w_i, w_d, w_f = found.gain, w * found.integral, w * found.lead, w * found.roll_off
    c_num, c_den = np.array([k, k * w_i]), np.array([1.0, 0.0])
    if np.isfinite(w_d):
        c_num, c_den = np.polymul(c_num, [1 / w_d, 1]), np.polymul(c_den, [1 / w_f, 1])
    if rate is None:
        poles = np.roots(np.polyadd(np.polymul(num, c_num), np.polymul(den, c_den)))

        def L(f):
            s = 2j * np.pi * f
            return (
                np.polyval(num, s)
                * np.polyval(c_num, s)
                / np.polyval(den, s)
                / np.polyval(c_den, s)
            )

        return L, np.exp(poles)
    whole = round(late * rate)
    b, a, _ = cont2discrete((num, den), 1 / rate, "zoh")
    b, a = np.ravel(b), np.polymul(np.ravel(a), [1.0] + [0.0] * whole)
    K = -found.controller
    c_num, c_den = None, None
    A = K.A
    c_den = np.real(np.poly(A))
    c_num = np.real(np.poly(A - K.B @ K.C) + (K.D.item() - 1) * c_den)
    poles = np.roots(np.polyadd(np.polymul(b, c_num), np.polymul(a, c_den)))

    def L(f):
        z = np.exp(2j * np.pi * f / rate)
        return np.polyval(b, z) * np.polyval(c_num, z) / np.polyval(a, z) / np.polyval(c_den, z)

    return L, poles


@pytest.mark.parametrize(
    "name",
    [pytest.param(name, marks=pytest.mark.long) if name in SLOWEST else name for name in PLANTS],
)
@pytest.mark.slow
def test_ordinary_plants_are_served(name):
    (num, den, rate, late), margin = PLANTS[name], 0.5
    found = tune_pid(fx.lti.tf(num, den), margin=margin, rate=rate, dead_time=late)
    L, poles = loop_gain(name, found)
    assert np.abs(poles).max() < 1.0
    top = rate / 2 if rate else 1e4 * found.crossover
    freq = np.geomspace(1e-4 * found.crossover, top, 20_000)
    assert np.abs(1 + L(freq)).min() >= 0.999 * margin
    assert np.abs(L(np.array([found.crossover]))) == pytest.approx(1.0, rel=1e-6)
    assert found.margin >= margin


def test_what_no_pid_can_do_says_so():
    late = fx.lti.tf([1.0], [1.0, 1.0])
    for call, words in (
        (lambda: tune_pid(late, rate=100.0, dead_time=2.0, bandwidth=5.0), "ask for less"),
        (lambda: tune_pid(late, dead_time=2.0), "needs a rate"),
        (lambda: tune_pid(late, rate=10.0, bandwidth=7.0), "half the rate"),
        (
            lambda: tune_pid(fx.lti.append(late, late.replace(inputs=["a"], outputs=["b"]))),
            "several channels",
        ),
    ):
        with pytest.raises(fx.FlexplantError, match=words):
            call()

"""Back to continuous time, to another rate, and from descriptor equations."""

import numpy as np
import pytest
import scipy.linalg as la
from scipy.signal import cont2discrete

import flexplant as fx
from flexplant.lti import continuous, descriptor, resampled


def drawn(seed, n=5):
    rng = np.random.default_rng(seed)
    A = rng.normal(size=(n, n)) - np.eye(n)
    return fx.StateSpace(
        A, rng.normal(size=(n, 2)), rng.normal(size=(2, n)), rng.normal(size=(2, 2))
    )


@pytest.mark.parametrize("seed", range(6))
@pytest.mark.parametrize("method", ["hold", "tustin"])
def test_samples_lead_back_to_the_system(seed, method):
    g, h = drawn(seed), 0.05
    kind = {"hold": "zoh", "tustin": "bilinear"}[method]
    A, B, C, D, _ = cont2discrete((g.A, g.B, g.C, g.D), h, kind)
    found = continuous(fx.StateSpace(A, B, C, D, h), method=method)
    s = 1j * np.array([0.0, 0.3, 2.0, 40.0])
    for point in s:
        np.testing.assert_allclose(found(point), g(point), rtol=1e-8, atol=1e-10)
    A, B, C, D, _ = cont2discrete((g.A, g.B, g.C, g.D), 0.02, kind)
    again, direct = (
        resampled(
            fx.lti.tustin(g, 20.0) if method == "tustin" else fx.lti.discretized(g, 20.0),
            50.0,
            method=method,
        ),
        fx.StateSpace(A, B, C, D, 0.02),
    )
    for point in np.exp(1j * np.array([0.01, 0.5, 3.0])):
        np.testing.assert_allclose(again(point), direct(point), rtol=1e-7, atol=1e-9)


def test_integrators_and_light_modes_come_back():
    plant = fx.lti.append(
        fx.lti.tf([1.0], [1.0, 0.0, 0.0]),
        fx.lti.tf([1.0], [1.0, 0.4, 4e4]).replace(inputs=["f"], outputs=["x"]),
    )
    back = continuous(fx.lti.discretized(plant, 1000.0))
    np.testing.assert_allclose(back(2j), plant(2j), rtol=1e-6, atol=1e-9)


def test_what_has_no_continuous_counterpart_says_why():
    for A, words in ((0.0, "a delay"), (-0.5, "negative real axis")):
        with pytest.raises(fx.FlexplantError, match=words):
            continuous(fx.StateSpace([[A]], [[1.0]], [[1.0]], 0, 0.1))
    with pytest.raises(fx.FlexplantError, match="continuous already"):
        continuous(fx.lti.tf([1.0], [1.0, 1.0]))


@pytest.mark.parametrize("seed", range(6))
def test_a_descriptor_system_has_the_same_response(seed):
    """C (s E - A)^-1 B + D, in units that differ by twelve decades between rows."""
    rng = np.random.default_rng(seed)
    n, r = 6, int(rng.integers(2, 7))
    left, right = (10.0 ** rng.uniform(-6, 6, n) for _ in range(2))
    E = left[:, None] * (rng.normal(size=(n, r)) @ rng.normal(size=(r, n))) * right
    A = left[:, None] * rng.normal(size=(n, n)) * right
    B, C, D = (
        left[:, None] * rng.normal(size=(n, 2)),
        rng.normal(size=(3, n)) * right,
        rng.normal(size=(3, 2)),
    )
    found = descriptor(A, B, C, D, E=E)
    assert found.n_states == r
    for s in (0.5j, 3.0j, 1.0 + 1j):
        pencil = (s * E - A) / left[:, None] / right
        expected = (C / right) @ la.solve(pencil, B / left[:, None]) + D
        np.testing.assert_allclose(found(s), expected, rtol=1e-6, atol=1e-8)


def test_a_differentiator_is_refused():
    with pytest.raises(fx.FlexplantError, match="differentiates"):
        descriptor(np.eye(2), [[0], [1]], [[1, 0]], 0, E=[[0, 1], [0, 0]])

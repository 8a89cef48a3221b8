"""Matched sampling against poles and zeros mapped by hand."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from flexplant.errors import ModelError
from flexplant.lti import StateSpace, frequency_response, matched
from oracles_lti import matched_filter
from systems_lti import machine

RATE = 200.0


def from_roots(poles, zeros, gain):
    """Controller form of a transfer function with these roots."""
    den, num = np.poly(poles).real, gain * np.atleast_1d(np.poly(zeros).real)
    n = len(poles)
    num = np.concatenate([np.zeros(n + 1 - len(num)), num])
    A = np.diag(np.ones(n - 1), 1)
    A[-1] = -den[:0:-1]
    B = np.zeros((n, 1))
    B[-1] = 1.0
    C = (num[1:] - num[0] * den[1:])[::-1]
    return StateSpace(A, B, C[None], [[num[0]]], inputs=["e"], outputs=["u"], name="filter")


def assert_same_roots(found, wanted, rtol):
    assert found.size == wanted.size
    for root in wanted:
        assert np.abs(found - root).min() < rtol * abs(root)


def roots(rng, count):
    pairs = [complex(-rng.uniform(1, 60), rng.uniform(5, 200)) for _ in range(count // 2)]
    values = [*pairs, *(p.conjugate() for p in pairs)]
    return np.array(values + [-rng.uniform(1, 80)] * (count % 2))


@given(st.integers(0, 10_000))
def test_poles_zeros_and_gain(seed):
    rng = np.random.default_rng(seed)
    n = int(rng.integers(1, 6))
    poles, zeros = roots(rng, n), roots(rng, int(rng.integers(0, n + 1)))
    g = from_roots(poles, zeros, rng.choice([-3.0, 0.2]))
    assert_same_roots(g.zeros(), zeros, 1e-6)
    found = matched(g, RATE)
    assert (found.inputs, found.outputs, found.name) == (("e",), ("u",), "filter")
    assert found.dt == pytest.approx(1 / RATE)
    freq = np.linspace(0.0, 99.0, 12)
    z = np.exp(2j * np.pi * freq / RATE)
    wanted = matched_filter(poles, zeros, 1.0, 1 / RATE, z)
    wanted *= frequency_response(g, np.zeros(1)).data[0, 0, 0] / wanted[0]
    np.testing.assert_allclose(
        frequency_response(found, freq).data[0, 0], wanted, rtol=1e-5, atol=1e-8 * abs(wanted[0])
    )


def test_a_notch_keeps_its_frequency_and_depth():
    w = 2 * np.pi * 50.0
    root = w * np.exp(1j * np.array([1, -1]) * np.arccos(-0.01))
    g = from_roots(w * np.exp(1j * np.array([1, -1]) * np.arccos(-0.5)), root, 1.0)
    found = matched(g, RATE)
    gain = np.abs(frequency_response(found, np.array([0.0, 49.0, 50.0, 51.0])).data[0, 0])
    assert gain[0] == pytest.approx(1.0)
    assert gain[2] < min(gain[1], gain[3])
    assert_same_roots(finite_zeros_sampled(found), np.exp(root / RATE), 1e-9)


def finite_zeros_sampled(g):
    """Zeros of a system with feedthrough: eigenvalues of A - B D^-1 C."""
    return np.linalg.eigvals(g.A - g.B @ g.C / g.D.item())


def test_first_order_lag_by_hand():
    found = matched(StateSpace([[-10.0]], [[10.0]], [[1.0]], [[0.0]]), 100.0)
    p = np.exp(-0.1)
    # gain (z + 1) / (z - p) with one at z = 1
    z = np.exp(0.3j)
    wanted = (1 - p) / 2 * (z + 1) / (z - p)
    value = frequency_response(found, np.array([0.3 * 100 / (2 * np.pi)])).data[0, 0, 0]
    assert value == pytest.approx(wanted, rel=1e-12)


def test_an_integrator_is_matched_elsewhere():
    integrator = StateSpace([[0.0]], [[1.0]], [[1.0]], [[0.0]])
    with pytest.raises(ModelError, match=r"at 0 Hz is inf .*at="):
        matched(integrator, RATE)
    found = matched(integrator, RATE, at=1.0)
    assert found.poles()[0] == 1.0
    value = frequency_response(found, np.array([1.0])).data[0, 0, 0]
    assert value == pytest.approx(1 / (2j * np.pi), rel=1e-12)  # the trapezoidal rule, scaled
    differentiator = from_roots([-100.0], [0.0], 100.0)
    with pytest.raises(ModelError, match="at 0 Hz is 0 "):
        matched(differentiator, RATE)
    assert matched(differentiator, RATE, at=1.0).n_states == 1


def test_a_long_filter_keeps_its_poles():
    g = machine(0, 24, m=1, p=1)
    found = matched(g, 1e4)
    wanted = np.exp(g.poles() / 1e4)
    assert_same_roots(found.poles(), wanted, 1e-12)
    freq = np.array([20.0, 100.0, 400.0])
    ratio = frequency_response(found, freq).data / frequency_response(g, freq).data
    np.testing.assert_allclose(np.abs(ratio), 1.0, atol=2e-2)


def test_refusals():
    with pytest.raises(ModelError, match="one input and one output, got 4 and 5"):
        matched(machine(), RATE)
    lag = StateSpace([[-1.0]], [[1.0]], [[1.0]], [[0.0]])
    with pytest.raises(ModelError, match="sampled already"):
        matched(matched(lag, RATE), RATE)
    with pytest.raises(ModelError, match="below half the rate"):
        matched(lag, RATE, at=100.0)
    with pytest.raises(ModelError, match="rate"):
        matched(lag, 0.0)
    with pytest.raises(ModelError, match="cannot be matched"):
        matched(lag.replace(B=[[0.0]]), RATE)
    with pytest.raises(ModelError, match="python-control or SciPy"):
        matched("filter", RATE)
    gain = StateSpace([], [], [], [[3.0]])
    assert matched(gain, RATE).dt == 1 / RATE


def test_a_filter_without_response_is_refused():
    """Zero in its matrices, or with an input whose states the output does not see."""
    lag = StateSpace([[-1.0]], [[1.0]], [[1.0]], [[0.0]])
    apart = StateSpace([[-1.0, 0.0], [0.0, -2.0]], [[1.0], [0.0]], [[0.0, 1.0]], [[0.0]])
    for mute in (lag.replace(B=[[0.0]]), apart):
        with pytest.raises(ModelError, match="cannot be matched"):
            matched(mute, RATE)
    # a state that the input does not reach is a zero
    assert lag.replace(B=[[0.0]], D=[[1.0]]).zeros() == pytest.approx([-1.0])

"""Sampling against scipy.linalg.expm, and delays against runs at ten times the rate."""

from decimal import Decimal, localcontext

import numpy as np
import pytest
import scipy.linalg as la
from hypothesis import given
from hypothesis import strategies as st

from flexplant.errors import FlexplantWarning, LabelError, ModelError, ShapeError
from flexplant.lti import (
    StateSpace,
    append,
    discretized,
    frequency_response,
    low_pass_filter,
    series,
    tustin,
)
from flexplant.lti.conversions import bilinear
from flexplant.lti.sampling import held_exactly, pair_expm, pair_exponential
from oracles_plant import delayed_run, hold

RATE = 200.0


def modal(omega, zeta, *, seed=0, blocks=True):
    """Modes as 2 x 2 blocks in states of one size, two inputs, one output."""
    omega, zeta = np.asarray(omega, float), np.asarray(zeta, float)
    rng = np.random.default_rng(seed)
    n, scale = 2 * omega.size, np.where(omega > 0, omega, 10.0)
    A = np.zeros((n, n))
    k = np.arange(omega.size)
    A[2 * k, 2 * k + 1], A[2 * k + 1, 2 * k] = scale, -(omega**2) / scale
    A[2 * k + 1, 2 * k + 1] = -2 * zeta * omega
    return StateSpace(
        A,
        rng.standard_normal((n, 2)),
        rng.standard_normal((1, n)),
        [[0.3, -0.2]],
        inputs=["a", "b"],
        outputs=["y"],
        blocks=[2] * omega.size if blocks else None,
    )


PLAIN = ([0.0, 10.0, 63.0, 400.0], [0.0, 0.01, 0.7, 0.001])


@pytest.mark.parametrize("blocks", [True, False])
def test_zero_order_hold_is_the_matrix_exponential(blocks):
    g = modal(*PLAIN, blocks=blocks)
    found = discretized(g, RATE)
    A, B = hold(g.A, g.B, 1 / RATE)
    np.testing.assert_allclose(found.A, A, rtol=1e-11, atol=1e-13)
    np.testing.assert_allclose(found.B, B, rtol=1e-11, atol=1e-14)
    np.testing.assert_array_equal(found.C, g.C)
    np.testing.assert_array_equal(found.D, g.D)
    assert found.dt == pytest.approx(1 / RATE, rel=1e-15)
    assert (found.inputs, found.outputs, found.states) == (g.inputs, g.outputs, g.states)


@given(
    st.floats(0.0, 1e5),
    st.floats(0.0, 3.0),
    st.floats(1e-6, 1.0),
    st.sampled_from(["modal", "rotation", "upper"]),
)
def test_a_pair_in_closed_form(omega, zeta, h, kind):
    """Oscillating, critical, overdamped, rigid: e^(A h) and its integral, per block."""
    if omega * h > 200:
        omega = 200 / h
    A = np.array([[0.0, max(omega, 1.0)], [-(omega**2) / max(omega, 1.0), -2 * zeta * omega]])
    if kind == "rotation":
        A = np.array([[-zeta, omega], [-omega, -zeta]])
    if kind == "upper":
        A = np.array([[-zeta, omega], [0.0, -2 * zeta]])
    wanted_E, wanted_I = hold(A, np.eye(2), h)
    # what has decayed by e^-100 is compared by its own size
    size = np.abs(wanted_E).max()
    np.testing.assert_allclose(pair_expm(A[None], h)[0], wanted_E, rtol=1e-7, atol=1e-9 * size)
    E, integral = pair_exponential(A[None], h)
    np.testing.assert_allclose(E[0], wanted_E, rtol=1e-7, atol=1e-9 * size)
    np.testing.assert_allclose(integral[0], wanted_I, rtol=1e-7, atol=1e-9 * h)


def test_a_rigid_body_is_exact():
    g = discretized(modal([0.0], [0.0]), 1000.0)
    np.testing.assert_array_equal(g.A, [[1.0, 0.01], [0.0, 1.0]])
    B = modal([0.0], [0.0]).B
    h = 1e-3
    np.testing.assert_allclose(g.B, [h * B[0] + 10 * h**2 / 2 * B[1], h * B[1]], rtol=1e-14)


def test_a_slow_mode_beside_a_fast_one_keeps_its_digits():
    g = modal([1e-3, 1e5], [0.01, 0.01])
    found = discretized(g, 1e4)
    # oracle: the slow block alone, where the exponential has nothing large in it
    A, B = hold(g.A[:2, :2], g.B[:2], 1e-4)
    np.testing.assert_allclose(found.A[:2, :2], A, rtol=1e-14, atol=1e-22)
    np.testing.assert_allclose(found.B[:2], B, rtol=1e-13)
    assert not found.A[:2, 2:].any()


@pytest.mark.parametrize("delay", [0.0, 0.3, 1.0, 1.7, 2.0, 3.5])
@pytest.mark.parametrize("blocks", [True, False])
def test_delays_against_ten_times_the_rate(delay, blocks):
    g = modal(*PLAIN, blocks=blocks)
    g = g.replace(D=np.zeros((1, 2)))
    rng = np.random.default_rng(3)
    u = rng.standard_normal((30, 2))
    wanted = delayed_run(g.A, g.B, g.C, u, 1 / RATE, delay)
    found = discretized(g, RATE, delay=delay)
    x, y = np.zeros(found.n_states), []
    for row in u:
        y.append(found.C @ x + found.D @ row)
        x = found.A @ x + found.B @ row
    np.testing.assert_allclose(y, wanted, rtol=1e-9, atol=1e-9 * np.abs(wanted).max())
    assert found.n_states == g.n_states + 2 * int(np.ceil(delay))
    if blocks and delay:
        assert tuple(found.blocks[:4]) == (2, 2, 2, 2)
        np.testing.assert_allclose(
            np.sort(np.abs(found.poles())),
            np.sort(np.abs(la.eigvals(found.A))),
            atol=1e-3,  # delays: defective eigenvalues at 0
        )


def test_only_the_named_inputs_are_delayed():
    g = modal(*PLAIN)
    found = discretized(g, RATE, delay=1.4, delayed=["b"])
    assert found.states[-2:] == ("b:delay2", "b:delay1")
    now = discretized(g, RATE)
    np.testing.assert_array_equal(found.B[: g.n_states, 0], now.B[:, 0])
    assert not found.B[: g.n_states, 1].any()
    np.testing.assert_array_equal(found.D, [[0.3, 0.0]])  # its feedthrough comes late too
    late = frequency_response(found, np.array([7.0])).data[0, 1, 0]
    # oracle: e^(-s tau) times the held response of the fine loop, by linearity of the two parts
    A, B = hold(g.A, g.B[:, 1:], 0.6 / RATE)
    _, part = hold(g.A, g.B[:, 1:], 0.4 / RATE)
    full, _ = hold(g.A, g.B[:, 1:], 1 / RATE)
    z = np.exp(2j * np.pi * 7.0 / RATE)
    push = B / z + A @ part / z**2
    wanted = g.C @ np.linalg.solve(z * np.eye(8) - full, push) + g.D[0, 1] / z**2
    np.testing.assert_allclose(late, wanted[0, 0], rtol=1e-10)


def test_nothing_to_delay_and_nothing_to_hold():
    g = modal(*PLAIN)
    assert discretized(g, RATE, delay=2.5, delayed=[]).n_states == g.n_states
    gain = StateSpace([], [], [], [[2.0]], inputs=["a"], outputs=["y"])
    late = discretized(gain, RATE, delay=1.0)
    assert late.n_states == 1
    np.testing.assert_array_equal(late.D, [[0.0]])
    value = frequency_response(late, np.array([20.0])).data[0, 0, 0]
    assert value == pytest.approx(2.0 * np.exp(-2j * np.pi * 20.0 / RATE))


def test_refusals():
    g = modal(*PLAIN)
    for bad in (0.0, -5.0, np.nan, np.inf, "fast", [1.0, 2.0]):
        with pytest.raises((ModelError, ShapeError), match="rate"):
            discretized(g, bad)
    for bad in (-0.1, np.nan):
        with pytest.raises(ModelError, match="delay"):
            discretized(g, RATE, delay=bad)
    with pytest.raises(LabelError, match="'c'"):
        discretized(g, RATE, delay=1, delayed=["c"])
    with pytest.raises(LabelError, match="more than once"):
        discretized(g, RATE, delay=1, delayed=["b", "b"])
    with pytest.raises(ModelError, match=r"sampled already.*continuous"):
        discretized(discretized(g, RATE), RATE)
    with pytest.raises(ModelError, match="StateSpace"):
        discretized("g", RATE)


def test_tustin_is_the_bilinear_map():
    g = modal([10.0, 63.0], [0.2, 0.7])
    freq = np.array([0.5, 3.0, 20.0, 90.0])
    z = np.exp(2j * np.pi * freq / RATE)
    s = 2 * RATE * (z - 1) / (z + 1)
    wanted = [g.C @ np.linalg.solve(v * np.eye(4) - g.A, g.B) + g.D for v in s]
    found = frequency_response(tustin(g, RATE), freq).data
    np.testing.assert_allclose(found, np.moveaxis(wanted, 0, 2), rtol=1e-10)
    warped = tustin(g, RATE, prewarp=20.0)
    exact = frequency_response(g, np.array([20.0])).data
    np.testing.assert_allclose(frequency_response(warped, np.array([20.0])).data, exact, rtol=1e-10)
    assert abs(frequency_response(tustin(g, RATE), np.array([20.0])).data / exact - 1).max() > 1e-3
    assert (warped.inputs, warped.outputs) == (g.inputs, g.outputs)


def test_tustin_refuses():
    g = modal([10.0], [0.2])
    for bad in (0.0, 100.0, 120.0, -3.0, np.nan):
        with pytest.raises(ModelError, match="prewarp"):
            tustin(g, RATE, prewarp=bad)
    with pytest.raises(ModelError, match="rate"):
        tustin(g, np.nan)
    with pytest.raises(ModelError, match="sampled already"):
        tustin(tustin(g, RATE), RATE)
    pole = StateSpace([[2 * RATE]], [[1.0]], [[1.0]], [[0.0]])
    with pytest.raises(ModelError, match="infinity"):
        tustin(pole, RATE)


@pytest.mark.parametrize(("omega", "rate"), [(10.0, 1e9), (1e3, 1e8), (1e4, 3e7), (1.0, 2.0000001)])
@pytest.mark.parametrize("h", [1e-4, 1e-2])
def test_heavy_overdamping_neither_overflows_nor_loses_the_slow_pole(omega, rate, h):
    """Against the poles of s^2 + c s + w^2 in fifty digits: cosh of half c h overflows."""
    with localcontext(prec=50):
        w, c, t = Decimal(omega), Decimal(rate), Decimal(h)
        root = (c * c / 4 - w * w).sqrt()
        slow, fast = -c / 2 + root, -c / 2 - root
        es, ef = (slow * t).exp(), (fast * t).exp()
        odd = (es - ef) / (slow - fast)
        first = (slow * ef - fast * es) / (slow - fast)
        second = (slow * es - fast * ef) / (slow - fast)
        wanted = np.array([[first, w * odd], [-w * odd, second]], dtype=float)
    pair = np.array([[[0.0, omega], [-omega, -rate]]])
    with np.errstate(all="raise", under="ignore"):
        found, integral = pair_exponential(pair, h)
    np.testing.assert_allclose(found[0], wanted, rtol=1e-9, atol=1e-15)
    assert abs(found[0, 0, 0] - wanted[0, 0]) < 4e-16
    # A int = e^(A h) - I, whose first row is omega times that of the integral's second
    np.testing.assert_allclose(
        omega * integral[0, 1], wanted[0] - [1.0, 0.0], rtol=1e-9, atol=1e-15
    )


@pytest.mark.parametrize(
    ("rate", "delay", "said"),
    [
        (1e-4, 0.0, "0.0001 s as a sampling period is rate=10000"),
        (10.0, 0.0, "10 kHz is rate=10000"),
        (1e4, 1e-4, "delay=1 at 10000 Hz"),
    ],
)
def test_a_period_for_a_rate_and_seconds_for_samples_are_warned_of(rate, delay, said):
    mode = StateSpace([[0, 1], [-(3e3**2), -60]], [[0], [1]], [[1, 0]], [[0]])
    with pytest.warns(FlexplantWarning, match=said):
        discretized(mode, rate, delay=delay)
    with pytest.warns(FlexplantWarning, match=r"477\.5 Hz and above, lie above half"):
        discretized(mode, 500.0)
    slow = StateSpace([[-3e3]], [[3e3]], [[1]], [[0]])  # a filter: sampled at any rate
    assert discretized(slow, 10.0).dt == 0.1
    with pytest.raises(ModelError, match="at most 1000 samples"):
        discretized(slow, 10.0, delay=1001)


def test_the_bilinear_maps_do_not_depend_on_the_units_of_the_states():
    """A filter at 2 kHz whose states differ by 1e12, there and back; a pole at 2 rate is none."""
    w = 2 * np.pi * np.array([3.0, 120.0])
    A = np.array([[-w[0], 1e12], [0.0, -w[1]]])
    G = StateSpace(A, [[0.0], [1.0]], [[1e-9, 0.0]], [[0.0]])
    sampled = tustin(G, 2000.0)
    back = bilinear(sampled, 2000.0)
    freq = np.array([1.0, 20.0, 300.0])
    given, found = (frequency_response(g, freq).data for g in (G, back))
    np.testing.assert_allclose(found, given, rtol=1e-9)
    with pytest.raises(ModelError, match="Tustin maps to infinity"):
        tustin(G.replace(A=np.array([[4000.0, 1e12], [0.0, -w[1]]])), 2000.0)
    with pytest.raises(ModelError, match="z = -1"):
        bilinear(sampled.replace(A=np.array([[-1.0, 1e12], [0.0, 0.5]])), 2000.0)


@pytest.mark.parametrize("delay", [0.0, 0.4, 1.0, 2.3])
@pytest.mark.parametrize(("count", "push"), [(1, 1.0), (15, 1e-3), (15, 1e3), (15, 1e6), (45, 1.0)])
def test_a_series_of_filters_and_modes_keeps_its_blocks(count, push, delay):
    """Series either way, with frequencies far above the rate: expm rounds below the blocks."""
    rng = np.random.default_rng(count + 1)
    omega, zeta = 10.0 ** rng.uniform(0, 6, count), 10.0 ** rng.uniform(-3, -1, count)
    A = np.zeros((2 * count, 2 * count))
    for i, (w, z) in enumerate(zip(omega, zeta, strict=True)):
        A[2 * i : 2 * i + 2, 2 * i : 2 * i + 2] = [[0, w], [-w, -2 * z * w]]
    B, C = np.zeros((2 * count, 3)), np.zeros((3, 2 * count))
    B[1::2], C[:, ::2] = push * rng.normal(size=(count, 3)), rng.normal(size=(3, count)) / omega
    u, y = ["u1", "u2", "u3"], ["y1", "y2", "y3"]
    modes = StateSpace(A, B, C, np.zeros((3, 3)), inputs=u, outputs=y, blocks=[2] * count)

    def filters(inputs, outputs):
        parts = []
        for name, to, order in zip(inputs, outputs, (1, 2, 2), strict=True):
            lag = low_pass_filter(10.0 ** rng.uniform(0, 3.5), order=order)
            parts.append(lag.renamed(inputs={lag.inputs[0]: name}, outputs={lag.outputs[0]: to}))
        return append(*parts)

    before, after = filters(["c1", "c2", "c3"], u), filters(y, ["m1", "m2", "m3"])
    for g in (series(before, modes), series(modes, after), series(series(before, modes), after)):
        for rate in (3e2, 3e3, 3e4):
            sampled = held_exactly(g, rate, delay=delay)
            assert sampled.blocks[: len(g.blocks)] == g.blocks
            # of a triangular matrix: those of the blocks, whatever stands above them
            assert np.allclose(
                np.sort(np.abs(sampled.poles()))[-g.n_states :],
                np.sort(np.exp(g.poles().real / rate)),
                rtol=1e-9,
                atol=1e-9,
            )

"""S, T, KS and margins against dense evaluation, closed forms and a brute-force grid."""

import numpy as np
import pytest

import oracles_loop as oracle
from flexplant.errors import AssumptionError, LabelError, ModelError, ShapeError
from flexplant.loop import (
    bandwidth,
    close_loop,
    complementary_sensitivity,
    control_sensitivity,
    loop_gain,
    modulus_margin,
    sensitivity,
)
from flexplant.loop.broken import sensitivity_size
from flexplant.lti import Frf, StateSpace, frequency_response
from machines import RATE, observer, servo, stage

FREQ = np.array([0.5, 4.0, 9.0, 59.0, 153.0, 700.0])


@pytest.fixture(scope="module")
def loop():
    return close_loop(stage(), observer(), servo())


def dense(loop, f):
    """Return K and P between the sensors and the actuators at one frequency."""
    z = np.exp(2j * np.pi * f / RATE)
    g, k = loop.plant.system, loop.controller
    P = oracle.gain(g.A, g.B[:, 4:], g.C[4:6], g.D[4:6, 4:], z)
    K = oracle.gain(k.A, k.B[:, :2], k.C[:2], k.D[:2, :2], z)
    return K, P


def test_sensitivities_are_those_of_dense_algebra(loop):
    S, T = sensitivity(loop, freq=FREQ), complementary_sensitivity(loop, freq=FREQ)
    Sy, KS = sensitivity(loop, freq=FREQ, at="y"), control_sensitivity(loop, freq=FREQ)
    L = loop_gain(loop, freq=FREQ)
    assert (S.inputs, S.outputs) == (("u1", "u2"), ("u1", "u2"))
    assert (Sy.inputs, Sy.outputs) == (("y1", "y2"), ("y1", "y2"))
    assert (KS.inputs, KS.outputs) == (("y1", "y2"), ("u1", "u2"))
    for i, f in enumerate(FREQ):
        K, P = dense(loop, f)
        close = {"rtol": 1e-8, "atol": 1e-11}
        np.testing.assert_allclose(L.data[:, :, i], K @ P, **close)
        np.testing.assert_allclose(S.data[:, :, i], np.linalg.inv(np.eye(2) - K @ P), **close)
        np.testing.assert_allclose(Sy.data[:, :, i], np.linalg.inv(np.eye(2) - P @ K), **close)
        np.testing.assert_allclose(T.data[:, :, i], np.eye(2) - S.data[:, :, i], **close)
        np.testing.assert_allclose(
            KS.data[:, :, i],
            K @ np.linalg.inv(np.eye(2) - P @ K),
            rtol=1e-8,
            atol=1e-8 * abs(K).max(),
        )


def test_sensitivity_is_the_closed_loop_transfer_from_a_force_at_u():
    """An independent route: w acting exactly at u1, seen in what the actuator must do."""
    plant = stage(delay=0.0)
    loop = close_loop(plant, observer(), servo())
    g = loop.monitored
    u_to_y = plant.system.select(["y1", "y2"], ["u1", "u2"])
    f = 6.0
    z = np.exp(2j * np.pi * f / RATE)
    # noise on y to u is K S_y = S_u K; then S_u = I + (S_u K) P
    noise_to_u = g.select(["u1", "u2"], ["y1:noise", "y2:noise"]).evaluated(z)
    by_noise = np.eye(2) + noise_to_u @ u_to_y.evaluated(z)
    S = sensitivity(loop, freq=np.array([f])).data[:, :, 0]
    np.testing.assert_allclose(S, by_noise, rtol=1e-8)


def test_a_measured_plant_gives_the_same(loop):
    frf = frequency_response(loop.plant.Gyu.select(["y1", "y2"]), FREQ)
    measured = Frf(FREQ, frf.data, inputs=["u1", "u2"], outputs=["y1", "y2"])
    K = loop.controller.select(["u1", "u2"], ["y1", "y2"])
    S = sensitivity((measured, K))
    np.testing.assert_allclose(S.data, sensitivity(loop, freq=FREQ).data, rtol=1e-9)
    assert S.freq.tolist() == FREQ.tolist()
    peak = np.linalg.svd(np.moveaxis(S.data, -1, 0), compute_uv=False).max()
    assert modulus_margin((measured, K)) == pytest.approx(1 / peak, rel=1e-12)
    part = sensitivity((measured, K), freq=FREQ[2:4])
    np.testing.assert_allclose(part.data, S.data[:, :, 2:4], rtol=1e-12)


def test_plant_and_controller_may_come_as_a_pair(loop):
    pair = (loop.plant, loop.controller)
    np.testing.assert_allclose(
        sensitivity(pair, freq=FREQ).data, sensitivity(loop, freq=FREQ).data, rtol=1e-9
    )
    assert modulus_margin(pair) == pytest.approx(loop.modulus_margin, rel=1e-5)


@pytest.mark.slow
def test_modulus_margin_is_the_peak_of_a_brute_force_grid(loop):
    grid = np.concatenate(
        [np.linspace(a, b, 4000) for a, b in ((1, 50), (50, 70), (140, 160), (380, 420))]
    )
    peak = 0.0
    for f in grid[::1]:
        K, P = dense(loop, f)
        peak = max(peak, np.linalg.svd(np.linalg.inv(np.eye(2) - K @ P), compute_uv=False)[0])
    assert loop.modulus_margin == pytest.approx(1 / peak, rel=1e-5)
    assert loop.modulus_margin <= 1 / peak * (1 + 1e-9)


@pytest.mark.parametrize("zeta", [0.5, 1e-2, 1e-5])
def test_modulus_margin_finds_a_narrow_peak(zeta):
    """A resonance moved by feedback: S and so its peak are known in closed form.

    With P = 1/(s^2 + 2 zeta s + 1) and K = g > 0 (positive position feedback),
    S = (s^2 + 2 zeta s + 1) / (s^2 + 2 zeta s + 1 - g).
    """
    g = 0.5
    plant = StateSpace([[0, 1], [-1, -2 * zeta]], [[0], [1]], [[1, 0]], [[0]])
    K = StateSpace([], [], [], [[g]], inputs=["y1"], outputs=["u1"])
    omega = np.sqrt(0.5) + zeta * np.linspace(-3, 3, 200001)
    s = 1j * omega
    peak = np.abs((s**2 + 2 * zeta * s + 1) / (s**2 + 2 * zeta * s + 1 - g)).max()
    peak = max(peak, 1 / (1 - g))  # at low frequency
    assert modulus_margin((plant, K)) == pytest.approx(1 / peak, rel=1e-6)


@pytest.mark.parametrize("seed", range(4))
def test_the_narrowest_of_many_peaks_is_seen_between_the_points_of_a_grid(seed):
    """Modes in rotated axes, each moved by its own gain: |S| is the largest of closed forms.

    In the axes ``S = (s^2 + 2 zeta w s + w^2) / (s^2 + 2 zeta w s + (1 - g) w^2)``.
    """
    rng = np.random.default_rng(seed)
    w, zeta, g = 10 ** rng.uniform(0, 2, 5), 10 ** rng.uniform(-5, -2, 5), rng.uniform(0.1, 0.8, 5)
    w[1] = w[0] * (1 + 1e-7 * seed)
    U = np.linalg.qr(rng.standard_normal((5, 5)))[0]
    none, turn = np.zeros((5, 5)), np.diag(w)  # states w q and v of each mode
    A = np.block([[none, turn], [-turn, -2 * zeta * turn]])
    B, C = np.vstack([none, U.T]), np.hstack([U * w, none])
    names = {"inputs": [f"u{i}" for i in range(5)], "outputs": [f"y{i}" for i in range(5)]}
    plant = StateSpace(A, B, C, np.zeros((5, 5)), **names)
    back = {"inputs": names["outputs"], "outputs": names["inputs"]}
    K = StateSpace([], [], [], U @ np.diag(g) @ U.T, **back)
    top = w * np.sqrt(1 - g)
    s = 1j * (top + zeta * w * np.linspace(-2, 2, 40001)[:, None])
    size = abs((s**2 + 2 * zeta * w * s + w**2) / (s**2 + 2 * zeta * w * s + (1 - g) * w**2))
    assert modulus_margin((plant, K)) == pytest.approx(1 / size.max(), rel=1e-6)


def test_bandwidth_of_an_integrator():
    """L = -c/s: |S| = |s/(s + c)| stays below 1; with a second lag it crosses at a known place."""
    c, tau = 10.0, 0.05
    integrator = StateSpace([[0.0]], [[1.0]], [[c]], [[0.0]])
    K = StateSpace([], [], [], [[-1.0]], inputs=["y1"], outputs=["u1"])
    assert bandwidth((integrator, K)) == np.inf
    lag = StateSpace([[-1 / tau]], [[1 / tau]], [[-1.0]], [[0.0]], inputs=["y1"], outputs=["u1"])
    # |1 + L|^2 = 1 for L = c/(s (1 + tau s)): (c - tau w^2)^2 + w^2 = w^2 + tau^2 w^4
    omega = np.sqrt(c / (2 * tau))
    assert bandwidth((integrator, lag)) == pytest.approx(omega / (2 * np.pi), rel=1e-7)


def test_bandwidth_looks_only_where_the_controller_acts(loop):
    """Two actuators, one controlled motion: the other direction has S = 1 and does not count."""
    assert 8.0 < bandwidth(loop) < 11.0
    f = np.array([bandwidth(loop)])
    both = np.array([1.0, 1.0]) / np.sqrt(2)
    S = sensitivity(loop, freq=f).data[:, :, 0]
    K, P = dense(loop, f[0])
    assert abs(both @ S @ both) == pytest.approx(1.0, abs=1e-6)
    assert np.linalg.matrix_rank(K @ P, tol=1e-9 * abs(K @ P).max()) == 1


def test_bandwidth_is_not_fooled_by_a_controller_that_vanishes_at_nyquist(loop):
    """There the directions of K are rounding: they must not count as driven."""
    mixed = StateSpace(
        [], [], [], [[0.3, 0.3], [0.7, 0.7]], inputs=["a1", "a2"], outputs=["m1", "m2"]
    )
    mean = StateSpace(
        np.zeros((2, 2)), np.eye(2), 0.5 * np.eye(2), 0.5 * np.eye(2), 1 / RATE,
        inputs=["m1", "m2"], outputs=["u1", "u2"],
    )  # fmt: skip
    slow = servo(hz=4.0).renamed(outputs={"u1": "a1", "u2": "a2"})
    smooth = close_loop(loop.plant, observer(), slow, mixed, mean)
    assert smooth.is_stable
    assert 3.0 < bandwidth(smooth) < 8.0


def test_bandwidth_needs_some_suppression(loop):
    wrong = StateSpace([], [], [], [[0.3]], inputs=["y1"], outputs=["u1"])
    lag = StateSpace([[-1.0]], [[1.0]], [[1.0]], [[0.0]])
    with pytest.raises(AssumptionError, match="sign of the controller"):
        bandwidth((lag, wrong))


def test_bad_input(loop):
    with pytest.raises(ModelError, match=r"need a ClosedLoop, .* or a loop gain"):
        sensitivity(loop.plant)
    with pytest.raises(ShapeError, match="freq must have shape"):
        sensitivity(loop, freq=3.0)
    with pytest.raises(ModelError, match="positive"):
        sensitivity(loop, freq=[0.0, 1.0])
    with pytest.raises(LabelError, match="'u' or 'y'"):
        sensitivity(loop, freq=FREQ, at="z")
    with pytest.raises(LabelError, match=r"no measured output 'die:ref'.*Select what was measured"):
        frf = Frf(FREQ, np.ones((2, 2, FREQ.size)), inputs=["u1", "u2"], outputs=["y1", "y2"])
        sensitivity((frf, loop.controller))
    with pytest.raises(ModelError, match="own frequencies"):
        sensitivity((frf, loop.controller.select(["u1"], ["y1"])), freq=[1.0])
    with pytest.raises(LabelError, match="'y9'"):
        sensitivity((loop.plant, servo().renamed(inputs={"die:hat": "y9"})), freq=FREQ)
    with pytest.raises(LabelError, match="no actuator 'up'"):
        sensitivity((loop.plant.Gyu, loop.controller.select(["die:hat"]).renamed(
            outputs={"die:hat": "up"})), freq=FREQ)  # fmt: skip
    with pytest.raises(ModelError, match="discretise"):
        slow = loop.controller.replace(dt=1.0)
        sensitivity((loop.plant.Gyu, slow), freq=FREQ)


@pytest.mark.parametrize("size", [3.0, 0.02])
def test_frequencies_of_small_gain_hide_no_peak(size):
    """They are left out of the singular values; where all gains are small none is."""
    rng = np.random.default_rng(5)
    L = rng.normal(size=(200, 3, 3)) + 1j * rng.normal(size=(200, 3, 3))
    L *= size * np.geomspace(1e-4, 1.0, 200)[:, None, None] / 6
    found = sensitivity_size(L)
    exact = np.linalg.svd(np.linalg.inv(np.eye(3) - L), compute_uv=False)[:, 0]
    assert found.max() == pytest.approx(exact.max(), rel=1e-12)
    assert np.argmax(found) == np.argmax(exact)
    assert np.all(found <= exact * (1 + 1e-12))


@pytest.mark.parametrize("inner", [0.0, 0.3])
@pytest.mark.parametrize("apart", [0.0, 0.02, 0.5])
def test_loops_that_are_nearly_a_number_times_one_hide_no_peak(apart, inner):
    """Of any gain, with an inner loop or not; at the critical point itself too."""
    rng = np.random.default_rng(7)

    def drawn(size):
        return size * (rng.normal(size=(300, 4, 4)) + 1j * rng.normal(size=(300, 4, 4)))

    turn = np.exp(1j * np.linspace(-np.pi, -0.4, 300)) * np.geomspace(1e4, 1e-3, 300)
    L, own = turn[:, None, None] * (np.eye(4) + drawn(apart)), drawn(inner / 4)
    exact = np.linalg.svd(np.linalg.solve(np.eye(4) - L, np.eye(4) - own), compute_uv=False)[:, 0]
    for near in (0.8, 1.0):
        found = sensitivity_size(L, own, near)
        assert found.max() == pytest.approx(exact.max(), rel=1e-9)
        assert np.all(found <= exact * (1 + 1e-9))
    L[150] = np.eye(4)
    assert np.argmax(sensitivity_size(L)) == 150 and sensitivity_size(L)[150] > 1e9

"""Frequency responses against one dense solve per frequency, and python-control."""

import numpy as np
import pytest
import scipy.linalg as la
from hypothesis import given
from hypothesis import strategies as st

from flexplant.errors import LabelError, ModelError, ShapeError
from flexplant.lti import (
    Frf,
    StateSpace,
    append,
    default_freq,
    discretized,
    frequency_response,
    series,
)
from flexplant.lti.frequency_sweep import POINTS, swept_gains
from flexplant.lti.response_solvers import diagonal_form
from oracles_lti import sweep
from systems_lti import machine

FREQ = np.unique(np.concatenate([np.geomspace(1.0, 4900.0, 150), np.linspace(245.0, 3700.0, 21)]))


def assert_same(g, freq, rtol=1e-10):
    found = frequency_response(g, freq).data
    expected = sweep(g.A, g.B, g.C, g.D, g.dt, freq)
    size = np.abs(expected).max(axis=(0, 1))
    np.testing.assert_array_less(np.abs(found - expected).max(axis=(0, 1)), rtol * size)


@pytest.mark.parametrize("delay", [None, 0.0, 1.0, 2.5])
@pytest.mark.parametrize("blocks", [True, False])
def test_lightly_damped_machine_is_exact(delay, blocks):
    g = machine()
    if delay is not None:
        g = discretized(g, 1e4, delay=delay)
    assert_same(g if blocks else g.replace(blocks=None), FREQ)


@pytest.mark.slow
@given(st.integers(0, 10_000))
def test_block_upper_triangular_systems(seed):
    rng = np.random.default_rng(seed)
    sizes = rng.integers(1, 3, rng.integers(1, 7))
    n = int(sizes.sum())
    owner = np.repeat(np.arange(sizes.size), sizes)
    A = rng.standard_normal((n, n)) * (owner[:, None] <= owner[None, :])
    A = np.where((rng.random((n, n)) < 0.5) & (owner[:, None] < owner[None, :]), 0.0, A)
    A -= 3 * np.eye(n)
    g = StateSpace(
        A, rng.standard_normal((n, 2)), rng.standard_normal((3, n)), rng.standard_normal((3, 2)),
        blocks=sizes,
    )  # fmt: skip
    freq = np.geomspace(1e-3, 10.0, 30)
    assert_same(g, freq)
    assert_same(g.replace(dt=0.04, A=A / 20), freq)


@given(st.integers(0, 10_000))
def test_block_diagonal_systems_of_any_kind(seed):
    """Oscillating, overdamped, critical, real and unstable blocks, with feedthrough."""
    rng = np.random.default_rng(seed)
    sizes = rng.integers(1, 3, rng.integers(1, 7))
    A = la.block_diag(*(rng.standard_normal((k, k)) * 10 ** rng.uniform(-1, 1) for k in sizes))
    n = A.shape[0]
    B, C = rng.standard_normal((n, 2)), rng.standard_normal((3, n))
    g = StateSpace(A, B, C, rng.standard_normal((3, 2)) * rng.integers(0, 2), blocks=sizes)
    freq = np.geomspace(1e-3, 10.0, 30)
    assert_same(g, freq)
    assert_same(g.replace(dt=0.04, A=A / 20), freq)


def test_more_frequencies_than_one_pass_takes():
    g = machine(3, 5)
    freq = np.linspace(1.0, 4000.0, 1300)
    assert_same(g, freq)
    assert_same(g.replace(D=np.ones((5, 4))), freq)


def test_slow_poles_of_a_sampled_system_keep_their_digits():
    rate = 1e4
    slow = np.array([0.01, 0.3]) / rate  # poles at exp(-slow), a millionth from 1
    A = np.diag(np.exp(-slow))
    g = StateSpace(A, slow[:, None], np.eye(2), np.zeros((2, 1)), 1 / rate, blocks=[1, 1])
    freq = np.geomspace(1e-5, 1.0, 40)
    found = frequency_response(g, freq).data[:, 0]
    # z - p as expm1 terms: no difference of numbers near 1
    z = np.expm1(2j * np.pi * freq[None] / rate) - np.expm1(-slow[:, None])
    np.testing.assert_allclose(found, slow[:, None] / z, rtol=1e-9)


@given(st.integers(0, 10_000))
def test_dense_systems(seed):
    rng = np.random.default_rng(seed)
    n = int(rng.integers(1, 9))
    g = StateSpace(
        rng.standard_normal((n, n)), rng.standard_normal((n, 2)), rng.standard_normal((1, n)),
        rng.standard_normal((1, 2)),
    )  # fmt: skip
    assert_same(g, np.geomspace(1e-3, 10.0, 30), rtol=1e-8)


@pytest.mark.parametrize("split", [0.0, 1e-12, 1e-3])
def test_dense_systems_whose_eigenvectors_are_next_to_parallel(split):
    """Five poles at -1, or next to it, in one chain: no residues are formed of them."""
    rng = np.random.default_rng(4)
    U = np.linalg.qr(rng.standard_normal((5, 5)))[0]
    A = U @ (np.diag(-1.0 - split * np.arange(5)) + np.eye(5, k=1)) @ U.T
    g = StateSpace(A, rng.standard_normal((5, 2)), rng.standard_normal((3, 5)), np.zeros((3, 2)))
    assert diagonal_form(g.A, g.B, g.C).left is None
    assert_same(g, np.geomspace(1e-3, 10.0, 30), rtol=1e-9)


def test_series_of_two_machines_uses_its_blocks():
    first, second = machine(0, 5, m=2, p=3, seed=1), machine(0, 4, m=3, p=2, seed=2)
    both = series(first.replace(outputs=["a", "b", "c"]), second)
    assert set(both.blocks) == {2}
    assert_same(both, FREQ)


def test_names_static_gain_and_empty_grid():
    gain = StateSpace(
        *(np.zeros(s) for s in ((0, 0), (0, 2), (1, 0))), [[1.0, 2.0]], inputs=["a", "b"]
    )
    frf = frequency_response(gain, np.array([0.0, 3.0]))
    np.testing.assert_array_equal(frf["y1", "b"], [2.0, 2.0])
    assert frf.inputs == ("a", "b")
    assert frequency_response(machine(), np.zeros(0)).data.shape == (5, 4, 0)


def test_an_input_that_moves_nothing():
    still = StateSpace([[0, 1], [-4, -0.1]], [[0], [0]], [[1, 0]], [[0]], blocks=[2])
    np.testing.assert_array_equal(frequency_response(still, [1.0, 2.0]).data, 0.0)


def test_takes_a_control_system():
    import control

    g = machine(0, 3, m=1, p=1)
    twin = control.StateSpace(g.A, g.B, g.C, g.D, inputs=["f"], outputs=["x"])
    frf = frequency_response(twin, FREQ)
    expected = control.frequency_response(twin, 2 * np.pi * FREQ).complex
    np.testing.assert_allclose(frf["x", "f"], expected, rtol=1e-8)


def test_first_order_gain_in_closed_form():
    g = StateSpace([[-10.0]], [[10.0]], [[1.0]], [[0.0]])
    corner = 10 / (2 * np.pi)
    assert frequency_response(g, np.array([corner]))["y1", "u1"][0] == pytest.approx(0.5 - 0.5j)
    held = discretized(g, 100.0)
    z = np.exp(2j * np.pi * corner / 100)
    pole = np.exp(-0.1)
    value = frequency_response(held, np.array([corner]))["y1", "u1"][0]
    assert value == pytest.approx((1 - pole) / (z - pole), rel=1e-12, abs=0)


@pytest.mark.slow
@pytest.mark.parametrize(("size", "zeta"), [(1, 1e-3), (4, 1e-2), (4, 1e-4)])
@pytest.mark.parametrize("sampled", [False, True])
def test_the_line_through_the_default_grid_is_the_response(size, zeta, sampled):
    g = machine(2, 8, m=size, p=size, zeta=zeta, seed=4)
    g = discretized(g, 1e4, delay=1.5) if sampled else g
    freq = default_freq(g)
    found = np.log(np.abs(frequency_response(g, freq).data))
    # not only in the middles, where the refinement looked
    for part in (0.2, 0.5, 0.77):
        between = freq[:-1] + part * np.diff(freq)
        truth = np.log(np.abs(sweep(g.A, g.B, g.C, g.D, g.dt, between)))
        line = (1 - part) * found[:, :, :-1] + part * found[:, :, 1:]
        assert np.abs(line - truth).max() < 0.1
    assert freq.size < 3000
    assert np.all(np.diff(freq) > 0)


def test_the_default_grid_meets_peaks_and_dips():
    g = machine(0, 3, m=1, p=1, seed=4)
    freq = default_freq(g)
    found = np.abs(frequency_response(g, freq)["y1", "u1"])
    dense = np.linspace(200, 4000, 400_001)
    truth = np.abs(sweep_fast(g, dense))
    assert found.max() == pytest.approx(truth.max(), rel=1e-2, abs=0)
    dips = np.flatnonzero((truth[1:-1] < truth[:-2]) & (truth[1:-1] < truth[2:])) + 1
    assert dips.size == 2
    line = np.interp(dense[dips], freq, np.log(found))
    np.testing.assert_allclose(line, np.log(truth[dips]), rtol=0, atol=0.1)
    assert frequency_response(g).freq.size == freq.size


def test_the_default_grid_keeps_to_its_number_of_points():
    g = machine(0, 20, m=3, p=3)
    assert default_freq(g).size > 700
    assert default_freq(g, points=700).size == 700
    assert default_freq(g, points=50).size == 50
    assert default_freq(g, tolerance=1.0).size < default_freq(g).size
    for bad in ({"points": 1}, {"points": -5}, {"tolerance": 0.0}):
        with pytest.raises(ModelError, match=next(iter(bad))):
            default_freq(g, **bad)


def test_a_channel_of_rounding_costs_no_points():
    """Decoupled axes: what crosses over is noise; a tiny row alone is only a matter of units."""
    axes = [machine(0, 10, m=1, p=1, seed=k) for k in range(4)]
    clean = append(
        *(
            g.replace(inputs=[f"u{k}"], outputs=[f"y{k}"], states=[f"s{k}:{i}" for i in range(20)])
            for k, g in enumerate(axes)
        )
    )
    noise = np.random.default_rng(0).standard_normal(clean.B.shape)
    assert default_freq(clean.replace(B=clean.B + 1e-18 * noise)).size == default_freq(clean).size
    assert (
        default_freq(clean.replace(B=clean.B + 0.1 * noise)).size > 1.2 * default_freq(clean).size
    )
    g = axes[0]
    assert default_freq(g.replace(C=1e-22 * g.C)).size == default_freq(g).size


def sweep_fast(g, freq):
    """Residues of the modes: sum of c b / (omega^2 - w^2 + 2 i zeta omega w)."""
    omega2, damping = -g.A[1::2, ::2].diagonal(), -g.A[1::2, 1::2].diagonal()
    w = 2 * np.pi * freq
    residues = g.C[0, ::2] * g.B[1::2, 0]
    return sum(
        r / (o - w**2 + 1j * d * w) for r, o, d in zip(residues, omega2, damping, strict=True)
    )


def test_default_grid_of_a_sampled_system_stays_below_half_the_rate():
    freq = default_freq(discretized(machine(3, 5, m=1, p=1), 1e4, delay=1))
    assert freq[-1] <= 5000.0
    assert freq[0] > 0


def test_frf_is_a_mapping_and_selects():
    data = np.arange(12).reshape(2, 3, 2) * (1 + 1j)
    frf = Frf(
        [1.0, 2.0], data, inputs=["a", "b", "c"], outputs=["x", "y"], coherence=np.ones((2, 3, 2))
    )
    assert len(frf) == 6
    assert list(dict(frf)) == [(o, i) for o in "xy" for i in "abc"]
    np.testing.assert_array_equal(frf["y", "c"], data[1, 2])
    part = frf.select(inputs=["c", "a"])
    np.testing.assert_array_equal(part.data, data[:, [2, 0]])
    assert part.coherence.shape == (2, 2, 2)
    assert repr(frf) == "<Frf: a, b, c -> x, y, 2 frequencies 1 .. 2 Hz>"
    with pytest.raises(ValueError, match="read-only"):
        frf.data[0, 0, 0] = 1.0


def test_frf_saves_and_loads(tmp_path):
    from flexplant import load

    frf = frequency_response(machine(0, 2, m=1, p=1), FREQ)
    frf.save(tmp_path / "frf.npz")
    again = load(tmp_path / "frf.npz")
    np.testing.assert_array_equal(again.data, frf.data)
    assert again.inputs == frf.inputs


@pytest.mark.parametrize(
    ("fields", "error", "message"),
    [
        ({"freq": [2.0, 1.0]}, ModelError, "increase"),
        ({"freq": [-1.0, 1.0]}, ModelError, "negative"),
        ({"freq": [1.0]}, ShapeError, "data must have shape"),
        ({"data": np.ones((2, 1))}, ShapeError, "data must have shape"),
        ({"data": np.full((1, 1, 2), np.nan)}, ModelError, "NaN"),
        ({"inputs": ["a", "b"]}, ShapeError, "names"),
        ({"outputs": ["a.b"]}, LabelError, "cannot name"),
        ({"coherence": np.full((1, 1, 2), 2.0)}, ModelError, "coherence"),
        ({"coherence": np.ones((1, 2))}, ShapeError, "coherence"),
    ],
)
def test_frf_bad_input(fields, error, message):
    with pytest.raises(error, match=message):
        Frf(**({"freq": [1.0, 2.0], "data": np.ones((1, 1, 2))} | fields))


def test_bad_frequencies():
    g = machine()
    with pytest.raises(ModelError, match="negative"):
        frequency_response(g, np.array([-1.0]))
    with pytest.raises(ModelError, match="half the sampling rate"):
        frequency_response(discretized(g, 1e4), np.array([5001.0]))
    with pytest.raises(ModelError, match="undamped pole"):
        frequency_response(g, np.array([0.0, 1.0]))
    with pytest.raises(ModelError, match="increase"):
        frequency_response(g, np.array([2.0, 1.0]))
    with pytest.raises(LabelError, match="no output 'y9'"):
        frequency_response(g, FREQ)["y9", "u1"]
    with pytest.raises(LabelError, match="no input 'z'"):
        frequency_response(g, FREQ).select(inputs=["z"])
    with pytest.raises(LabelError, match="a channel is a pair"):
        frequency_response(g, FREQ)["y1"]
    assert la.norm(frequency_response(machine(0, 2), np.array([0.0])).data) > 0


@pytest.mark.parametrize("delay", [1.0, 0.5, 2.4])
def test_modes_fed_by_delay_lines(delay):
    # oracle: one dense solve a frequency; two of three inputs are late, so lines feed some columns
    rng = np.random.default_rng(3)
    omega = np.array([6.0, 200.0, 1500.0, 4000.0, 9000.0, 2e4])
    A = np.zeros((12, 12))
    for i, w in enumerate(omega):
        A[2 * i, 2 * i + 1], A[2 * i + 1, 2 * i] = w, -w
        A[2 * i + 1, 2 * i + 1] = -2e-3 * w
    B, C, D = (
        rng.standard_normal((12, 3)),
        rng.standard_normal((4, 12)),
        rng.standard_normal((4, 3)),
    )
    modes = StateSpace(A, B, C, D, inputs=["w", "u1", "u2"], blocks=[2] * 6)
    g = discretized(modes, 1e4, delay=delay, delayed=["u1", "u2"])
    freq = np.geomspace(0.5, 4990.0, 300)
    z = np.exp(2j * np.pi * freq * g.dt)
    dense = np.array([g.C @ np.linalg.solve(x * np.eye(g.n_states) - g.A, g.B) + g.D for x in z])
    found = frequency_response(g, freq).data.transpose(2, 0, 1)
    size = np.abs(dense).max(axis=(1, 2), keepdims=True)
    assert np.max(np.abs(found - dense) / size) < 1e-10


@pytest.mark.parametrize("blocks", [[2, 2, 2], None])
@pytest.mark.parametrize("omega", [(2.0, 63.0, 400.0), (63.0, 63.0, 64.0)])
def test_a_grid_of_our_own_leaves_undamped_resonances_out(omega, blocks):
    """Structures without D are common: their response is shown beside the poles, not refused."""
    A = la.block_diag(*([[0.0, w], [-w, 0.0]] for w in omega))
    g = StateSpace(
        A, np.tile([[0.0], [1.0]], (3, 1)), np.tile([[1.0, 0.0]], 3), [[0.0]], blocks=blocks
    )
    found = frequency_response(g)
    assert np.all(np.isfinite(found.data))
    for w in omega:
        off = np.abs(2 * np.pi * found.freq - w)
        assert off.min() < 1e-4 * w  # close enough to show the resonance
        assert np.abs(found.data).max() > 1e3
    s = 2j * np.pi * found.freq
    wanted = sum(w / (s**2 + w**2) for w in omega)
    assert np.max(np.abs(found["y1", "u1"] / wanted - 1)) < 1e-6


def test_measured_rotations_have_their_units_from_their_labels_and_keep_them():
    """A response of rotations per moment was printed in m/N."""
    frf = Frf([1.0, 2.0], np.ones((2, 2, 2)), ["1:rz", "1:x"], ["2:rz", "2:x"], "velocity")
    units = ("rad/s", "N m", "m/s", "N")
    assert [frf.unit("2:rz", "1:rz"), frf.unit("2:x", "1:x")] == ["rad/s/(N m)", "m/s/N"]
    named = frf.replace(outputs=["joint", "tip"], inputs=["motor", "hammer"])
    found = (*(named.channel_units[name] for name in ("joint", "motor", "tip", "hammer")),)
    assert found == units
    assert Frf([1.0], np.ones((1, 1, 1)), ["1:rz"], ["2:rz"]).unit("2:rz", "1:rz") is None


def test_a_sweep_in_pieces_shows_every_gain_near_the_largest():
    """Gains off the peak are bounds from below; no piece of the responses is larger than stated."""
    rng, sizes = np.random.default_rng(5), []
    freq = np.linspace(1.0, 2.0, 3 * POINTS + 7)
    H = rng.standard_normal((3, 4, freq.size)) + 1j * rng.standard_normal((3, 4, freq.size))

    def respond(part):
        sizes.append(part.size)
        return H[:, :, np.searchsorted(freq, part)]

    found = swept_gains(respond, freq)
    exact = np.linalg.svd(np.moveaxis(H, 2, 0), compute_uv=False)[:, 0]
    near = exact >= np.linalg.norm(H, axis=(0, 1)).max() / np.sqrt(3.0)
    assert np.argmax(exact) in np.flatnonzero(near)
    np.testing.assert_allclose(found[near], exact[near], rtol=1e-12)
    assert np.all(found <= exact * (1 + 1e-12))
    assert max(sizes) <= POINTS

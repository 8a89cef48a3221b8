"""Response: servo metrics against exact arithmetic, and what it refuses."""

import pickle

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

import oracles_loop as oracle
from flexplant import load
from flexplant.errors import LabelError, ModelError, ShapeError
from flexplant.simulation import Response


def response(signal, dt=1e-3):
    signal = np.asarray(signal)
    return Response(np.arange(signal.shape[-1]) * dt, signal[None], ["e"])


@pytest.mark.slow
@given(
    st.integers(1, 60).flatmap(
        lambda n: st.tuples(st.integers(1, n), st.lists(st.floats(-1, 1), min_size=n, max_size=n))
    )
)
def test_moving_windows_are_exact(drawn):
    count, signal = drawn
    run = response(signal)
    if run.time.size < 2:
        return
    mean, deviation = oracle.moving_moments(signal, count)
    np.testing.assert_allclose(run.moving_average("e", window=count * 1e-3), mean, atol=1e-15)
    # squares lose half the digits of a deviation that is small beside the window's spread
    np.testing.assert_allclose(run.moving_std("e", window=count * 1e-3), deviation, atol=3e-8)


@pytest.mark.slow
def test_nanometres_on_top_of_decimetres_keep_their_digits():
    rng = np.random.default_rng(1)
    still = 1e-9 * rng.standard_normal(400)
    signal = np.concatenate([0.1 + still, np.linspace(0.1, -0.1, 300), -0.1 + still])
    run = response(signal)
    mean, deviation = oracle.moving_moments(signal, 20)
    np.testing.assert_allclose(run.moving_std("e", window=0.02), deviation, rtol=1e-12)
    # the mean is right to the spacing of doubles at 0.1
    np.testing.assert_allclose(run.moving_average("e", window=0.02), mean, rtol=0, atol=2.8e-17)


def test_a_constant_has_no_deviation():
    assert np.all(response(np.full(100, 0.1)).moving_std("e", window=0.007) == 0.0)


def test_sine_over_its_period():
    """Over one period MA = 0 and MSD = amplitude / sqrt 2."""
    t = np.arange(1000) * 1e-3
    run = response(3.0 * np.sin(2 * np.pi * 50 * t))
    inner = slice(20, -20)
    np.testing.assert_allclose(run.moving_average("e", window=0.02)[inner], 0.0, atol=1e-13)
    np.testing.assert_allclose(
        run.moving_std("e", window=0.02)[inner], 3.0 / np.sqrt(2.0), rtol=1e-12
    )


def test_rms_and_peak_from_a_start():
    run = response([9.0, 9.0, 3.0, -4.0])
    assert run.rms("e", start=2e-3) == pytest.approx(np.sqrt(12.5), rel=1e-15)
    assert run.peak("e", start=2e-3) == 4.0
    assert run.peak("e") == 9.0


def test_runs_keep_their_axis():
    data = np.random.default_rng(0).standard_normal((3, 2, 50))
    run = Response(np.arange(50) * 0.1, data, ["a", "b"])
    assert run["b"].shape == (3, 50)
    np.testing.assert_allclose(run.rms("b"), np.sqrt((data[:, 1] ** 2).mean(axis=1)))
    assert run.moving_std("b", window=1.0).shape == (3, 50)
    one = Response(run.time, data[1], ["a", "b"])
    np.testing.assert_array_equal(
        one.moving_std("b", window=1.0), run.moving_std("b", window=1.0)[1]
    )


def test_the_interval_of_the_rms_covers_the_truth():
    """White noise of 1 nm in 5 runs, 400 times: the 95 % interval holds 1 nm in 95 % of them."""
    rng = np.random.default_rng(3)
    hits = 0
    for _ in range(400):
        data = 1e-9 * rng.standard_normal((5, 1, 60))
        run = Response(np.arange(60) * 0.1, data, ["e"])
        value, low, high = run.rms_interval("e", start=1.0)
        assert low < value < high
        assert value == pytest.approx(np.sqrt((data[..., 10:] ** 2).mean()), rel=1e-12, abs=0)
        hits += low <= 1e-9 <= high
    # binomial, 99.9 %: 380 +- 3.3 * sqrt(400 * 0.95 * 0.05)
    assert 365 <= hits <= 395
    with pytest.raises(ModelError, match="scatter between runs"):
        response([1.0, 2.0]).rms_interval("e")
    with pytest.raises(ModelError, match="between 0 and 1"):
        run.rms_interval("e", level=95)


def test_exposure_is_the_worst_window_after_a_time():
    rng = np.random.default_rng(8)
    data = rng.standard_normal((2, 1, 400))
    data[0, 0, 50] = 300.0  # before the start
    run = Response(np.arange(400) * 1e-3, data, ["e"])
    late = run.time >= 0.1
    average, deviation = run.moving_average("e", window=0.02), run.moving_std("e", window=0.02)
    found = run.exposure("e", window=0.02, start=0.1)
    assert found == (np.abs(average[:, late]).max(), deviation[:, late].max())
    assert run.exposure("e", window=0.02)[0] > 10 * found[0]
    with pytest.raises(ModelError, match="is too late"):
        run.exposure("e", start=1.0)


def test_is_a_mapping_and_a_value(tmp_path):
    run = response([1.0, 2.0, 3.0])
    assert list(run) == ["e"] and "e" in run and len(run) == 1
    assert dict(run)["e"].tolist() == [1.0, 2.0, 3.0]
    assert run == run and run != response([1.0, 2.0, 3.0])
    for again in (pickle.loads(pickle.dumps(run)),):
        assert again["e"].tolist() == [1.0, 2.0, 3.0]
        with pytest.raises(ValueError, match="read-only"):
            again["e"][0] = 5.0
    run.save(tmp_path / "run.npz")
    assert load(tmp_path / "run.npz")["e"].tolist() == [1.0, 2.0, 3.0]
    assert repr(run) == "<Response 3 samples over 0.003 s, 1 channel: e>"


def test_bad_input():
    run = response(np.zeros(10))
    with pytest.raises(LabelError, match="no channel 'f'"):
        run["f"]
    assert run.get("f") is None
    with pytest.raises(LabelError, match="no channel"):
        run.rms("f")
    with pytest.raises(ModelError, match="choose a window of 1 to 10 samples"):
        run.moving_average("e", window=0.1)
    with pytest.raises(ModelError, match="0 samples"):
        run.moving_std("e", window=1e-4)
    with pytest.raises(ModelError, match="window must be positive"):
        run.moving_std("e", window=0.0)
    with pytest.raises(ModelError, match="is too late"):
        run.rms("e", start=1.0)
    with pytest.raises(ModelError, match="equal steps"):
        Response([0.0, 1.0, 3.0], np.zeros((1, 3)), ["e"])
    with pytest.raises(ShapeError, match=r"\(1, 3\)"):
        Response([0.0, 1.0, 2.0], np.zeros((2, 3)), ["e"])
    with pytest.raises(LabelError, match="more than once"):
        Response([0.0], np.zeros((2, 1)), ["e", "e"])
    with pytest.raises(ModelError, match="NaN"):
        Response([0.0], [[np.nan]], ["e"])


@pytest.mark.parametrize("size", [1e-300, 1e-170, 1.0, 1e160, 1e300, 1.7e308])
def test_signals_whose_squares_leave_all_numbers(size):
    """A run that grew, or one in units far too large: rms and moving figures scale with it."""
    one = np.random.default_rng(0).uniform(-1.0, 1.0, (1, 40))
    small, large = (Response(np.arange(40) * 0.1, k * one, ["e"]) for k in (1.0, size))
    assert large.rms("e") / size == pytest.approx(small.rms("e"), rel=1e-12)
    for name in ("moving_average", "moving_std"):
        wanted, found = (getattr(run, name)("e", window=0.7) for run in (small, large))
        np.testing.assert_allclose(found / size, wanted, rtol=1e-12, atol=1e-15)
    assert Response([0.0, 0.1], np.zeros((1, 2)), ["e"]).rms("e") == 0.0

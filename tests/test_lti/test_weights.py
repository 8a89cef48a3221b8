"""Filters: gains in closed form."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from flexplant.errors import ModelError, ShapeError
from flexplant.lti import (
    frequency_response,
    high_pass_filter,
    inverse_sensitivity,
    lead_lag_filter,
    low_pass_filter,
    notch_filter,
    series,
    tustin,
)

FREQS = st.floats(1e-2, 1e4)


def size(sys, *freq):
    return np.abs(frequency_response(sys, np.array(freq)).data[0, 0])


@given(FREQS, st.sampled_from([1, 2]), st.floats(0.01, 100.0))
def test_corners_are_at_minus_3_db(freq, order, gain):
    low, high = (make(freq, order=order, gain=gain) for make in (low_pass_filter, high_pass_filter))
    for sys in (low, high):
        np.testing.assert_allclose(size(sys, freq), gain / np.sqrt(2), rtol=1e-12)
        assert sys.is_stable
        assert sys.n_states == order
    # Butterworth in closed form a decade away
    far = gain / np.sqrt(1 + 10.0 ** (2 * order))
    np.testing.assert_allclose(size(low, 10 * freq), far, rtol=1e-9)
    np.testing.assert_allclose(size(high, freq / 10), far, rtol=1e-9)
    np.testing.assert_allclose(size(low, 0.0), gain, rtol=1e-12)
    np.testing.assert_allclose(size(high, 0.0), 0.0, atol=1e-12 * gain)


@given(FREQS, st.floats(0.0, 1.0), st.floats(0.01, 2.0))
def test_notch(freq, depth, width):
    sys = notch_filter(freq, depth=depth, width=width)
    p = 1j * 1.3
    wanted = abs((p**2 + 2 * depth * width * p + 1) / (p**2 + 2 * width * p + 1))
    np.testing.assert_allclose(size(sys, freq, 1.3 * freq), [depth, wanted], rtol=1e-9, atol=1e-12)
    np.testing.assert_allclose(size(sys, 0.0, 1e5 * freq), 1.0, rtol=1e-6)
    assert sys.is_stable


@given(FREQS, FREQS, st.floats(0.01, 10.0))
def test_leadlag(zero, pole, gain):
    sys = lead_lag_filter(zero, pole, gain=gain)
    f = np.sqrt(zero * pole)
    wanted = [gain, gain * abs((1j * f / zero + 1) / (1j * f / pole + 1))]
    np.testing.assert_allclose(size(sys, 0.0, f), wanted, rtol=1e-9)
    np.testing.assert_allclose(sys.D[0, 0], gain * pole / zero, rtol=1e-12)
    turn = np.angle(frequency_response(sys, np.array([f])).data[0, 0, 0])
    assert turn >= -1e-12 if zero <= pole else turn <= 1e-12


@pytest.mark.slow
@given(FREQS, st.floats(1.05, 10.0), st.floats(1e-6, 0.5), st.sampled_from([1, 2]))
def test_inverse_sensitivity_crosses_at_the_bandwidth(bandwidth, peak, floor, slope):
    sys = inverse_sensitivity(bandwidth, peak=peak, floor=floor, slope=slope)
    found = size(sys, 0.0, bandwidth, 1e6 * bandwidth)
    np.testing.assert_allclose(found, [1 / floor, 1.0, 1 / peak], rtol=1e-6)
    np.testing.assert_allclose(found[1], 1.0, rtol=1e-10)
    assert sys.n_states == slope
    assert sys.is_stable
    # the bound 1 / |W| only rises with frequency
    assert np.all(np.diff(size(sys, *np.geomspace(1e-3 * bandwidth, 1e3 * bandwidth, 50))) < 0)


def test_the_slope_is_that_asked_for():
    for slope in (1, 2):
        gains = size(inverse_sensitivity(100.0, floor=1e-8, slope=slope), 0.5, 1.0)
        assert np.log2(gains[0] / gains[1]) == pytest.approx(slope, abs=0.01)


def test_sampled_they_keep_the_gain_at_the_prewarped_frequency():
    sys = tustin(notch_filter(300.0), 2000.0, prewarp=300.0)
    np.testing.assert_allclose(size(sys, 300.0), 0.05, rtol=1e-9)


def test_filters_chain():
    both = series(low_pass_filter(10.0), notch_filter(30.0).renamed(inputs={"in": "mid"}))
    np.testing.assert_allclose(size(both, 30.0), 0.05 / np.sqrt(10), rtol=1e-9)


@pytest.mark.parametrize("bad", [0.0, -1.0, np.nan, np.inf, "fast", [1.0, 2.0]])
def test_bad_frequencies(bad):
    for make in (
        lambda: low_pass_filter(bad),
        lambda: high_pass_filter(bad, order=2),
        lambda: notch_filter(bad),
        lambda: notch_filter(10.0, width=bad),
        lambda: lead_lag_filter(bad, 10.0),
        lambda: lead_lag_filter(10.0, bad),
        lambda: inverse_sensitivity(bad),
    ):
        with pytest.raises((ModelError, ShapeError), match=r"must|has a NaN"):
            make()


def test_bad_shapes_of_filters():
    for make in (low_pass_filter, high_pass_filter):
        with pytest.raises(ModelError, match=r"order must be 1 or 2, got 3.*in series"):
            make(10.0, order=3)
    with pytest.raises(ModelError, match="depth"):
        notch_filter(10.0, depth=-0.1)
    with pytest.raises(ModelError, match="slope must be a whole number from 1 to 2"):
        inverse_sensitivity(10.0, slope=3)
    for numbers in ({"floor": 1.0}, {"peak": 0.9}):
        with pytest.raises(ModelError, match="0 < floor < 1 < peak"):
            inverse_sensitivity(10.0, **numbers)
    for numbers in ({"floor": 0.0}, {"peak": np.nan}):
        with pytest.raises(ModelError, match=f"{next(iter(numbers))} (must be pos|has a NaN)"):
            inverse_sensitivity(10.0, **numbers)
    for make in (low_pass_filter, high_pass_filter, lead_lag_filter):
        with pytest.raises(ModelError, match="gain"):
            make(10.0, gain=np.nan) if make is not lead_lag_filter else make(1.0, 2.0, gain=np.nan)

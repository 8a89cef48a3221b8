"""A response between its lines: exact for one mode, with an error that says when it is not."""

import numpy as np
import pytest

from flexplant import Frf
from flexplant.loop import in_axes
from flexplant.lti.measured_lines import between_lines


def mode(freq, centre=100.0, zeta=1e-3):
    """One pole and a constant: half-power width 0.2 Hz."""
    return 0.3 - 0.2j + 1.0 / (freq - centre * (1 + 1j * zeta))


def test_one_mode_is_exact_between_lines_four_widths_apart():
    lines = np.arange(90.0, 110.5, 0.8)
    freq = np.linspace(90.1, 109.9, 2000)
    found, error = between_lines(lines, np.stack([mode(lines), 2.0 * mode(lines)]), freq)
    np.testing.assert_allclose(found[1], 2.0 * mode(freq), rtol=1e-7)
    assert error.max() < 1e-7
    straight = np.interp(freq, lines, mode(lines).real)
    assert np.abs(straight - mode(freq).real).max() > 3.0


def test_where_two_modes_share_an_interval_the_error_says_so():
    lines = np.arange(90.0, 110.5, 0.8)
    freq = np.linspace(99.0, 101.0, 500)
    found, error = between_lines(lines, mode(lines) + mode(lines, 100.5), freq)
    wrong = np.abs(found - mode(freq) - mode(freq, 100.5))
    assert wrong.max() > 0.5
    assert error[np.argmax(wrong)] > 0.1 * wrong.max()


@pytest.mark.slow
def test_the_variance_of_a_plant_in_axes():
    """after G before, aliases added, beside 500 draws; and by coherence."""
    rng = np.random.default_rng(4)
    freq = np.arange(1.0, 80.0)
    G = rng.standard_normal((2, 2, freq.size)) + 1j * rng.standard_normal((2, 2, freq.size))
    variance = rng.uniform(0.1, 2.0, G.shape)
    before, after = np.array([[1.0, 0.5], [0.2, -1.0]]), np.array([[1.0, 2.0], [-0.3, 0.4]])
    frf = Frf(freq, G, variance=variance)
    found = in_axes(frf, before=before, after=after, rate=100.0).variance
    draws = []
    for _ in range(500):
        noise = rng.standard_normal((2, *G.shape)) * np.sqrt(variance / 2)
        one = frf.replace(data=noise[0] + 1j * noise[1], variance=None)
        draws.append(in_axes(one, before=before, after=after, rate=100.0).data)
    ratio = np.mean(np.abs(draws) ** 2, axis=0) / found
    assert np.abs(ratio - 1.0).max() < 0.3
    coherent = frf.replace(variance=None, coherence=np.full(G.shape, 0.8), freedom=9.0)
    np.testing.assert_allclose(in_axes(coherent).variance, np.abs(G) ** 2 * 0.2 / 0.8 / 10)

"""Modes of a few hertz beside modes of hundreds, on one record of evenly spaced lines."""

import numpy as np
import pytest

from flexplant.errors import FlexplantWarning
from flexplant.identification import identify_modes, stabilisation_diagram
from flexplant.identification.lines import Lines, prepared_lines
from flexplant.identification.refine import pivoted
from flexplant.lti import Frf
from oracles_identification import modal_frf, pole

#: [Hz]: suspension modes, two of them close, and modes of the structure
LOW, HIGH = [2.1, 2.4, 3.4, 4.8, 5.0], [62.0, 62.3, 118.0, 203.0, 341.0]


def record(seed, *, spacing, noise=0.01, known=True, top=500.0):
    """Frequencies [Hz] of ten modes of 1 % damping and noisy responses, and their FRF."""
    rng = np.random.default_rng(seed)
    freq = np.array(LOW + HIGH) * rng.uniform(0.8, 1.25)
    phi = rng.normal(size=(4, 10))
    lines = np.arange(spacing, top, spacing)
    H = modal_frf(lines, pole(freq, rng.uniform(0.007, 0.013, 10)), phi, phi[:2])
    deviation = noise * np.abs(H)
    error = rng.normal(size=(2, *H.shape)) * deviation / np.sqrt(2)
    variance = deviation**2 if known else None
    return freq, Frf(lines, H + error[0] + 1j * error[1], variance=variance)


def nearest(values, freq):
    """Relative distance of each frequency to the nearest of some values."""
    return np.array([np.min(np.abs(values / one - 1)) for one in freq])


@pytest.mark.slow
@pytest.mark.parametrize("known", [True, False])
@pytest.mark.parametrize("seed", range(2))
def test_a_diagram_shows_modes_far_below_the_top_of_the_band(seed, known):
    """A part of its own near zero, with the conjugate lines: at 500 Hz they are 1 % of a part."""
    freq, frf = record(10 + seed, spacing=0.25, known=known)
    chosen = stabilisation_diagram(frf).automatic()
    assert np.all(nearest(np.abs(chosen.poles) / (2 * np.pi), freq) < 0.01)
    assert len(chosen) == freq.size


@pytest.mark.long
def test_low_modes_are_identified_with_half_a_hertz_between_lines():
    """All ten; five were found, and the lines are twelve half-widths of the lowest apart."""
    freq, frf = record(1, spacing=0.5)
    found = identify_modes(frf)
    assert np.all(nearest(found.freq, freq) < 0.005)
    assert found.freq.size == freq.size


@pytest.mark.slow
def test_lines_too_coarse_for_low_modes_are_named_with_their_band():
    freq, frf = record(2, spacing=2.5)
    with pytest.warns(FlexplantWarning, match=r"lines, .* apart.*band=\("):
        found = identify_modes(frf, refine=False)
    assert np.all(nearest(found.freq, freq[5:]) < 0.01)


def test_poles_that_nearly_coincide_keep_the_equations_of_a_step_positive():
    """Their difference held rounding of the residual terms: an eigenvalue of -2e-8, refused."""
    _, frf = record(3, spacing=0.5)
    ready = prepared_lines(frf, None)
    lines = Lines(ready.freq, ready.data, ready.weight, lower=2, upper=9)
    poles = pole([0.98151, 0.98177, 63.0, 120.0, 200.0, 340.0], np.array([1e-7, 1e-7, *[1e-2] * 4]))
    part = np.random.default_rng(3).normal(size=(2, 6)) + 0j
    part[:, 1] = part[:, 0] * (1 + 1e-2j)
    fit = pivoted(lines, poles, part)
    for Q, (smooth, _) in zip(fit.bases, lines.smooth_bases, strict=True):
        rows = Q.T.reshape(Q.shape[1], 2, -1).swapaxes(0, 1)
        assert np.max(np.abs(rows @ smooth)) < 1e-14
    N, _ = fit.gradient()
    J = np.concatenate([one.reshape(-1, one.shape[-1]) for one in fit.jacobians()])
    size = np.sqrt(np.diag(N))
    error = N - (J.conj().T @ J).real
    np.testing.assert_allclose(error / np.outer(size, size), 0.0, atol=2e-9)

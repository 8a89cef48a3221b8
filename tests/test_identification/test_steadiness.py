"""Periodic records that are not periodic: a wrong period or rate, transients still there."""

import re
import warnings

import numpy as np
import pytest
import scipy.signal as ss

from flexplant.errors import FlexplantWarning
from flexplant.identification import Periodic, estimate_frf, multisine
from oracles_identification import held_mode, pole

RATE, FREQS = 400.0, np.array([40.0, 85.0, 130.0])
PHI = np.array([[1.0, 0.7, -0.8], [0.6, -1.0, 0.5]])


def moved(u, zeta):
    """Displacements (n_exp, 2, n_time) of a machine at rest before u (n_exp, 1, n_time)."""
    y = np.zeros((u.shape[0], 2, u.shape[2]))
    for k, f in enumerate(FREQS):
        w = 2 * np.pi * f
        mode = ss.cont2discrete(([w * w], [1.0, 2 * zeta * w, w * w]), 1 / RATE)
        y += PHI[:, k, None] * PHI[0, k] * ss.lfilter(mode[0][0], mode[1], u, axis=2)
    return y


def record(zeta, periods, seed, lead=0, noise=0.01):
    """Inputs and outputs of some periods of 1 s, after `lead` others."""
    u = multisine(1, rate=RATE, period=1.0, periods=periods + lead, band=(10.0, 180.0), rng=seed)
    y = moved(u, zeta)
    y += noise * np.std(y) * np.random.default_rng(seed).normal(size=y.shape)
    return u[..., lead * 400 :], y[..., lead * 400 :]


def said(u, y, rate=RATE, period=1.0, discard=1):
    """The warnings of an estimate, and the estimate."""
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        frf = estimate_frf(u, y, rate, method=Periodic(period=period, discard=discard))
    assert all(one.category is FlexplantWarning for one in caught)
    return [str(one.message) for one in caught], frf


def true_frf(freq, zeta):
    modes = pole(FREQS, zeta)
    held = [held_mode(freq, p, RATE) * abs(p) ** 2 for p in modes]
    return np.einsum("ok,kf->of", PHI * PHI[0], np.array(held))[:, None]


@pytest.mark.parametrize(
    ("zeta", "periods", "discard"), [(5e-4, 3, 1), (2e-3, 3, 1), (2e-3, 6, 2), (1e-3, 4, 0)]
)
def test_a_transient_in_the_periods_kept_is_warned_of(zeta, periods, discard):
    """The decay that is named is the slowest mode's; the periods that are asked for are enough."""
    for seed in range(3):
        u, y = record(zeta, periods, seed)
        texts, frf = said(u, y, discard=discard)
        assert len(texts) == 1
        freq, decay = re.search(r"near ([\d.]+) Hz (\d+)%", texts[0]).groups()
        nearest = FREQS[np.argmin(np.abs(FREQS - float(freq)))]
        assert abs(float(freq) - nearest) < 5
        assert float(decay) / 100 == pytest.approx(np.exp(-2 * np.pi * nearest * zeta), abs=0.1)
        wrong = np.abs(frf.data - true_frf(frf.freq, zeta)).max()
        enough = int(re.search(r"discard=(\d+)", texts[0]).group(1))
        if seed == 0:
            u, y = record(zeta, periods - discard + enough, seed)
            texts, frf = said(u, y, discard=enough)
            assert not texts
            assert np.abs(frf.data - true_frf(frf.freq, zeta)).max() < 0.2 * wrong


@pytest.mark.parametrize(("periods", "discard"), [(3, 1), (4, 0), (10, 1)])
def test_a_settled_machine_is_not_warned_of(periods, discard):
    for seed in range(8):
        u, y = record(2e-3, periods, seed, lead=40)
        assert not said(u, y, discard=discard)[0]


@pytest.mark.parametrize(
    ("rate", "period", "repeats"),
    [
        (RATE, 1.0025, "400 samples"),
        (RATE, 0.75, "400 samples"),
        (RATE, 1.5, "400 samples|800 samples"),
        (404.0, 1.0, "400 samples.*rate is 400 Hz"),
        (200.0, 1.0, "400 samples"),
    ],
)
def test_a_wrong_period_or_rate_is_warned_of(rate, period, repeats):
    u, y = record(2e-2, 6, 1)
    texts, _ = said(u, y, rate=rate, period=period)
    assert len(texts) == 1
    assert re.search(repeats, texts[0])
    assert re.search("period= or rate is wrong", texts[0])


def test_random_inputs_are_not_periodic_and_two_periods_are_a_period():
    u = np.random.default_rng(0).normal(size=(1, 1, 2400))
    texts, _ = said(u, moved(u, 0.02))
    assert len(texts) == 1
    assert "not periodic" in texts[0]
    u, y = record(2e-2, 6, 1)
    assert not said(u, y, period=2.0)[0]


def test_noise_on_the_inputs_of_many_periods_is_sound():
    u, y = record(2e-2, 40, 1)
    noisy = u + 0.3 * np.random.default_rng(3).normal(size=u.shape)
    assert not said(noisy, y)[0]

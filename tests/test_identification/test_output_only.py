"""Modes of a machine that shakes by itself: exact white excitation, noisy sensors."""

import numpy as np
import pytest
import scipy.signal as ss

from flexplant.errors import ModelError, SolverError
from flexplant.identification import identify_output_only
from oracles_identification import mac, pole

RATE = 100.0
TRUE = pole([3.1, 7.0, 7.5, 14.0], [0.015, 0.01, 0.012, 0.008])
PHI = np.array(
    [[0.5, 0.7, 0.6, 0.9], [0.9, 0.5, -0.6, -0.6], [1.0, -0.4, -0.5, 0.8], [0.6, -0.9, 0.8, -0.3]]
)


def shaken(rng, count, noise=0.02):
    """Displacements under white modal forces, sampled exactly: one complex recursion a mode.

    ``x' = lambda x + f``, ``q = Im(x) / Im(lambda)``; over a step w has ``E|w|^2 = (e^{2 Re} - 1) /
    (2 Re lambda)`` and ``E w^2 = (e^{2 lambda T} - 1) / (2 lambda)``.
    """
    motion = np.zeros((4, count))
    T = 1 / RATE
    for k, lam in enumerate(TRUE):
        power = np.expm1(2 * lam.real * T) / (2 * lam.real)
        square = np.expm1(2 * lam * T) / (2 * lam)
        C = 0.5 * np.array([[power + square.real, square.imag], [square.imag, power - square.real]])
        w = np.linalg.cholesky(C) @ rng.normal(size=(2, count + 2000))
        x = ss.lfilter([1.0], [1.0, -np.exp(lam * T)], w[0] + 1j * w[1])[2000:]
        motion += PHI[:, [k]] * (x.imag / lam.imag * abs(lam) ** 0.5)
    return motion + noise * np.std(motion) * rng.normal(size=motion.shape)


@pytest.mark.long
def test_poles_and_their_uncertainty():
    """12 records of 400 s: the errors are as large as the deviations that are stated."""
    scores = []
    for seed in range(12):
        found = identify_output_only(shaken(np.random.default_rng(seed), 40_000), rate=RATE,
                                     band=(2.0, 20.0))  # fmt: skip
        assert len(found) == 4
        error = found.poles - TRUE
        scores.append([*(error.real / found.std.real), *(error.imag / found.std.imag)])
        if seed == 0:
            assert np.abs(error / TRUE).max() < 0.01
            for k in range(4):
                assert mac(found.shapes[:, k], PHI[:, k]) > 0.99
            assert np.abs(found.shapes).max() == pytest.approx(1.0)
            # 0.5 % of frequency, 30 % of damping: no more is in 400 s
            assert (found.std.imag / np.abs(TRUE)).max() < 5e-3
            assert 0.05 < (found.std.real / np.abs(TRUE.real)).max() < 0.5
    scores = np.array(scores)
    # squares of 96 scores of Student's distribution with 19 degrees, of variance 1: 3.5 deviations
    assert np.mean(scores**2) == pytest.approx(1.0, abs=3.5 * np.sqrt((2 + 6 / 15) / scores.size))
    assert np.mean(np.abs(scores) < 2) > 0.9
    assert np.abs(scores.mean(axis=0)).max() < 4 / np.sqrt(12)


@pytest.mark.slow
def test_what_the_record_does_not_hold_is_refused():
    y = shaken(np.random.default_rng(0), 6000)
    named = dict(zip("abcd", y, strict=True))
    found = identify_output_only(named, rate=RATE, band=(2.0, 20.0), blocks=8)
    assert found.dofs == ("a", "b", "c", "d")
    with pytest.raises(ModelError, match=r"blocks of 60 samples are too short for 50 lags"):
        identify_output_only(y, rate=RATE, band=(2.0, 20.0), blocks=100)
    with pytest.raises(ModelError, match="not below half the rate"):
        identify_output_only(y, rate=RATE, band=(2.0, 60.0))
    with pytest.raises(SolverError, match="no pole is stable"):
        white = np.random.default_rng(0).normal(size=(2, 6000))
        identify_output_only(white, rate=RATE, band=(20.0, 20.5), blocks=8)

"""The hidden 0.5 kg from noise: is the stated doubt the true one? From responses: benchmarks."""

import numpy as np
import pytest

import oracles_updating as oracle
from flexplant.identification import MeasuredModes
from flexplant.updating import AddedDamping, AddedMass, Eigenvalues, update
from noisy_plate import Campaign, judged, with_mass

TRIALS = 100


@pytest.mark.long
def test_a_few_noisy_responses_find_the_mass():
    campaign, rng = Campaign(), np.random.default_rng(1)
    fits = [campaign.fit(rng) for _ in range(4)]
    assert judged(fits)[1] < 0.01
    assert fits[0].std[0] < 0.01


@pytest.mark.long
def test_interval_from_poles_covers_the_mass(plate):
    rom = plate.reduced(0.01, True)
    poles = oracle.poles(*with_mass())[:6]
    std = 2e-4 * np.abs(poles)
    rng = np.random.default_rng(6)
    fits = []
    for _ in range(TRIALS):
        noise = (rng.normal(size=6) + 1j * rng.normal(size=6)) * std / np.sqrt(2)
        data = MeasuredModes(poles + noise, modes=range(4, 10), covariance=std**2)
        unknowns = [AddedMass(plate.z8), AddedDamping(plate.z8)]
        fits.append(update(rom, unknowns, [Eigenvalues(data)], starts=1))
    covered, error = judged(fits)
    assert 0.9 <= covered <= 0.99
    assert error < 0.01

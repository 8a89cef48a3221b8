"""Updates from FRFs averaged over Hann segments: the claimed deviation is that of the errors."""

import numpy as np
import pytest

import noisy_plate
from flexplant.errors import FlexplantWarning
from flexplant.lti import Frf
from flexplant.updating import AddedDamping, AddedMass, FrfResidual, localise, update


def windowed(campaign, rng):
    """Return FRFs whose errors are correlated over neighbouring lines as Hann windows make them."""
    steps = zip(range(-2, 3), [1, 16, 36, 16, 1], strict=True)
    freq = noisy_plate.FREQ
    root = np.linalg.cholesky(sum(r / 36 * np.eye(freq.size, k=k) for k, r in steps))
    noise = rng.normal(size=campaign.H.shape) + 1j * rng.normal(size=campaign.H.shape)
    return Frf(
        freq,
        campaign.H + (noise @ root.T) * np.sqrt(campaign.variance / 2),
        inputs=campaign.inputs,
        outputs=campaign.outputs,
        variance=campaign.variance,
        window="hann",
        resolution=freq[1] - freq[0],
    )


@pytest.mark.slow
def test_localisation_judges_by_the_correlated_noise(monkeypatch):
    """Half a kilogram among places: found, and what is left is noise as its correlation says."""
    monkeypatch.setattr(noisy_plate, "FREQ", np.linspace(420, 480, 60))
    campaign = noisy_plate.Campaign()
    places = [campaign.at, *campaign.inputs, *campaign.outputs]
    masses = [AddedMass(place, name=place) for place in places]
    data = [FrfResidual(windowed(campaign, np.random.default_rng(7)))]
    damping = [AddedDamping(campaign.at)]
    found = localise(campaign.rom, masses, data, nuisance=damping, most=2)
    assert found.chosen == (campaign.at,)
    assert found.dof == 2 * 2 * 60 - 2
    assert found.chi2 / found.dof == pytest.approx(1.0, abs=0.3)
    assert found.p_value > 1e-3
    fit = update(campaign.rom, [masses[0], *damping], data)
    assert found.chi2 == pytest.approx(fit.chi2, rel=1e-4)
    with pytest.warns(FlexplantWarning, match="leaves more than noise"):
        wrong = localise(campaign.rom, masses[1:], data, nuisance=damping, most=1)
    assert wrong.p_value < 1e-9


@pytest.mark.long
def test_an_update_counts_the_correlation_of_windowed_lines(monkeypatch):
    """24 measurements, a resonance of some 14 lines, errors correlated by 4/9 and 1/36."""
    freq = np.linspace(420, 480, 90)
    monkeypatch.setattr(noisy_plate, "FREQ", freq)
    campaign, rng = noisy_plate.Campaign(), np.random.default_rng(5)
    parameters = [AddedMass(campaign.at), AddedDamping(campaign.at)]
    scores, chi2, alone = [], [], []
    for _ in range(24):
        frf = windowed(campaign, rng)
        fit = update(campaign.rom, parameters, [FrfResidual(frf)], start=[0.4, 0.0], starts=1)
        scores.append((fit.values[0] - 0.5) / fit.std[0])
        chi2.append(fit.chi2 / fit.dof)
        alone.append(fit.std)
    plain = update(campaign.rom, parameters, [FrfResidual(frf.replace(window=None))])

    assert np.sqrt(np.mean(np.square(scores))) == pytest.approx(1.0, abs=0.35)
    assert np.mean(chi2) == pytest.approx(1.0, abs=0.05)
    assert np.all(alone[-1] / plain.std > 1.2)

"""Updates from FRFs averaged over Hann segments: the claimed deviation is that of the errors."""

import numpy as np
import pytest

import noisy_plate
from flexplant.lti import Frf
from flexplant.updating import AddedDamping, AddedMass, FrfResidual, update


@pytest.mark.slow
def test_an_update_counts_the_correlation_of_windowed_lines(monkeypatch):
    """24 measurements, a resonance of some 14 lines, errors correlated by 4/9 and 1/36."""
    freq = np.linspace(420, 480, 90)
    monkeypatch.setattr(noisy_plate, "FREQ", freq)
    campaign, rng = noisy_plate.Campaign(), np.random.default_rng(5)
    steps = zip(range(-2, 3), [1, 16, 36, 16, 1], strict=True)
    root = np.linalg.cholesky(sum(r / 36 * np.eye(freq.size, k=k) for k, r in steps))
    parameters = [AddedMass(campaign.at), AddedDamping(campaign.at)]
    scores, chi2, alone = [], [], []
    for _ in range(24):
        noise = rng.normal(size=campaign.H.shape) + 1j * rng.normal(size=campaign.H.shape)
        frf = Frf(
            freq,
            campaign.H + (noise @ root.T) * np.sqrt(campaign.variance / 2),
            inputs=campaign.inputs,
            outputs=campaign.outputs,
            variance=campaign.variance,
            window="hann",
            resolution=freq[1] - freq[0],
        )
        fit = update(campaign.rom, parameters, [FrfResidual(frf)])
        scores.append((fit.values[0] - 0.5) / fit.std[0])
        chi2.append(fit.chi2 / fit.dof)
        alone.append(fit.std)
    plain = update(campaign.rom, parameters, [FrfResidual(frf.replace(window=None))])

    assert np.sqrt(np.mean(np.square(scores))) == pytest.approx(1.0, abs=0.35)
    assert np.mean(chi2) == pytest.approx(1.0, abs=0.05)
    assert np.all(alone[-1] / plain.std > 1.2)

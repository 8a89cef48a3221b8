"""Updates from few averaged runs: estimated variances and correlated outputs are taken as such."""

import numpy as np
import pytest
import scipy.stats as stats

import noisy_plate
from flexplant.errors import FlexplantWarning
from flexplant.identification import average_frfs
from flexplant.lti import Frf
from flexplant.structure import chain
from flexplant.updating import AddedDamping, AddedMass, FrfResidual, update
from flexplant.updating.family import Family

FREQ = np.linspace(420, 480, 40)


@pytest.fixture
def campaign(monkeypatch):
    monkeypatch.setattr(noisy_plate, "FREQ", FREQ)
    return noisy_plate.Campaign()


def averaged(campaign, rng, runs, alike):
    """Return the mean of runs with errors of which a part `alike` is common to both outputs."""
    root = np.linalg.cholesky(np.array([[1.0, alike], [alike, 1.0]]))
    found = []
    for _ in range(runs):
        e = rng.normal(size=campaign.H.shape) + 1j * rng.normal(size=campaign.H.shape)
        e = np.einsum("ab,bif->aif", root, e) * np.sqrt(campaign.variance / 2 * runs)
        found.append(Frf(FREQ, campaign.H + e, inputs=campaign.inputs, outputs=campaign.outputs))
    return average_frfs(found)


@pytest.mark.slow
@pytest.mark.parametrize(("runs", "alike", "magnitude"), [(8, 0.8, False), (6, 0.0, True)])
def test_chance_and_deviation_with_few_runs(campaign, runs, alike, magnitude):
    """Forty measurements: p-values are uniform, and errors are as large as their deviations."""
    rng = np.random.default_rng(3)
    parameters = [AddedMass(campaign.at), AddedDamping(campaign.at)]
    scores, chances = [], []
    for _ in range(40):
        data = FrfResidual(averaged(campaign, rng, runs, alike), magnitude=magnitude)
        fit = update(campaign.rom, parameters, [data], start=[0.4, 0.0], starts=1)
        scores.append((fit.values[0] - 0.5) / fit.std[0])
        chances.append(fit.p_value)
    assert np.sqrt(np.mean(np.square(scores))) == pytest.approx(1.0, abs=0.3)
    assert stats.kstest(chances, "uniform").pvalue > 1e-3
    assert min(chances) > 1e-4


@pytest.mark.slow
@pytest.mark.filterwarnings("ignore:the updated model leaves more")  # four runs raise false alarms
def test_errors_of_four_runs_are_as_large_as_their_deviations(campaign):
    """With exact weights they would be 0.71 of what they are."""
    rng = np.random.default_rng(4)
    scores = []
    for _ in range(100):
        data = FrfResidual(averaged(campaign, rng, 4, 0.0))
        parameters = [AddedMass(campaign.at), AddedDamping(campaign.at)]
        fit = update(campaign.rom, parameters, [data], start=[0.4, 0.0], starts=1)
        scores.append((fit.values - [0.5, 0.0]) / fit.std)
    assert 0.75 < np.sqrt(np.mean(np.square(scores))) < 1.1
    assert 0.93 < np.mean(np.abs(scores) < 1.96) < 0.99


@pytest.mark.parametrize("magnitude", [False, True])
def test_covariance_of_correlated_outputs(campaign, magnitude):
    """N has the correlation of outputs and lines: the dense matrix, made entry by entry."""
    frf = averaged(campaign, np.random.default_rng(1), 12, 0.6)
    frf = frf.replace(window="hann", resolution=FREQ[1] - FREQ[0])
    bound = FrfResidual(frf, magnitude=magnitude).bound(Family(campaign.rom, []))
    n, R = FREQ.size, frf.line_correlation().toarray()
    values, vectors = np.linalg.eigh(np.moveaxis(frf.correlation, 2, 0))
    root = vectors @ (np.sqrt(values)[:, :, None] * vectors.conj().transpose(0, 2, 1))
    C = np.zeros((n, 2, n, 2), complex)
    for a in range(n):
        for b in range(n):
            C[a, :, b] = R[a, b] * root[a] @ root[b]
    if magnitude:
        turn = (frf.data / np.abs(frf.data))[:, 0].T
        C = np.einsum("ao,aobp,bp->aobp", turn.conj(), C, turn)
    C = C.reshape(2 * n, 2 * n)
    N = C.real if magnitude else np.block([[C.real, -C.imag], [C.imag, C.real]])
    np.testing.assert_allclose(bound.noise_times(np.eye(len(N))), N, atol=1e-9)
    np.testing.assert_allclose(np.diag(N), 1.0, atol=1e-9)


@pytest.mark.slow
@pytest.mark.parametrize(("runs", "magnitude"), [(8, False), (300, True)])
def test_a_model_that_is_wrong_widens_the_covariance_by_its_residual(campaign, runs, magnitude):
    """Responses 5 % too large: as wide as by the mean square of the residual."""
    campaign.variance = campaign.variance / 100.0
    frf = averaged(campaign, np.random.default_rng(2), runs, 0.0)
    wrong = frf.replace(data=1.05 * frf.data, correlation=None)
    parameters = [AddedMass(campaign.at), AddedDamping(campaign.at)]
    options = {"start": [0.4, 0.0], "starts": 1}
    found, plain = [], []
    for given in (
        wrong,
        wrong.replace(freedom=None, variance=(runs - 1) / (runs - 2) * wrong.variance),
    ):
        with pytest.warns(FlexplantWarning, match="leaves more than noise"):
            data = FrfResidual(given, magnitude=magnitude)
            fit = update(campaign.rom, parameters, [data], **options)
        found.append(fit.std)
        plain.append(fit.chi2 / fit.dof)
    # and by its uncertain weights, of which the plain variance does not know
    found[1] *= np.sqrt((runs - 2) / (runs - 3))
    np.testing.assert_allclose(*found, rtol=0.02)
    np.testing.assert_allclose(*plain, rtol=0.02)


@pytest.mark.parametrize("runs", [4, 8])
def test_uncertain_weights_scatter_estimates(runs):
    """The mean of n lines with weights 1/s^2, drawn: its variance over that of the plain mean."""
    rng = np.random.default_rng(0)
    n, draws = 400, 5000
    weights = (runs - 1) / rng.gamma(runs - 1, size=(draws, n))
    mean = np.sum(weights * rng.normal(size=(draws, n)), axis=1) / np.sum(weights, axis=1)
    frf = Frf(FREQ, np.ones((1, 1, FREQ.size)), inputs=["1:x"], outputs=["1:x"])
    frf = frf.replace(variance=np.full(frf.data.shape, 1e-2), freedom=runs - 1)
    family = Family(chain(masses=[1.0, 1.0], stiffnesses=[1e4]), [])
    scatter = FrfResidual(frf, direction="x").bound(family).scatter
    assert scatter == pytest.approx(n * np.var(mean), rel=0.06)
    fewer = FrfResidual(frf.replace(freedom=runs - 2), direction="x").bound(family)
    assert fewer.scatter > scatter
    assert FrfResidual(frf, variance=2e-2, direction="x").bound(family).scatter == 1.0


def test_independent_outputs_count_whole_whoever_gives_the_variance(campaign):
    """Four runs show correlations of one third by chance."""
    frf = averaged(campaign, np.random.default_rng(1), 4, 0.0)
    own, given = (
        FrfResidual(frf, variance=variance).bound(Family(campaign.rom, [])).independent
        for variance in (None, campaign.variance)
    )
    assert given > 0.9
    assert own == pytest.approx(given / 3.0)  # (nu - 2) / nu of three degrees of freedom

"""Data that were not fitted judge an update: noise, what the parameters are known to, and place."""

import numpy as np
import pytest
from scipy import stats

import oracles_updating as oracle
from flexplant.errors import FlexplantWarning, ModelError
from flexplant.identification import MeasuredModes
from flexplant.lti import Frf
from flexplant.updating import AddedDamping, AddedMass, Eigenvalues, FrfResidual, split, validate

LINKS = [(0, None, 90), (0, 1, 110), (1, 2, 70), (2, 3, 130), (3, 4, 90), (4, 5, 70), (5, None, 60)]


@pytest.fixture
def chain(make):
    return make([1, 2, 1.5, 1.2, 0.9, 1.4], LINKS, beta=2e-3)


def poles_of(model, place, mass, rng, level=1e-3):
    M = np.array(model.M)
    M[place, place] += mass
    exact = oracle.poles(M, model.D, model.K)
    std = level * np.abs(exact)
    noise = (rng.normal(size=6) + 1j * rng.normal(size=6)) * std / np.sqrt(2)
    return Eigenvalues(MeasuredModes(exact + noise, modes=range(1, 7), covariance=std**2))


@pytest.mark.long
def test_a_right_model_leaves_noise(chain):
    """Two modes are fitted, whose errors are those of two parameters: 60 trials, uniform p."""
    rng = np.random.default_rng(3)
    unknown = [AddedMass("2:z"), AddedDamping("5:z")]
    found = []
    for _ in range(60):
        data = poles_of(chain, 1, 0.3, rng)
        found.append(validate(chain, unknown, [data.select([1])], [data.select([2, 3, 4, 5, 6])]))
    assert stats.kstest([one.p_value for one in found], "uniform").pvalue > 1e-3
    assert all(one.helped for one in found)
    # so many degrees of freedom in all: 1 is noise alone
    total = sum(10 * one.unused[1] ** 2 for one in found)
    assert 1e-3 < stats.chi2.sf(total, 600) < 1 - 1e-3


@pytest.mark.slow
def test_a_mass_in_the_wrong_place_does_not_help(chain):
    """It comes nearer to what was not fitted, and predicts nothing."""
    data = poles_of(chain, 1, 0.3, np.random.default_rng(0))
    with pytest.warns(FlexplantWarning, match="leaves more than noise"):
        wrong = validate(
            chain, [AddedMass("3:z")], [data.select([1, 2, 4])], [data.select([3, 5, 6])]
        )
    assert 1 < wrong.unused[1] < wrong.unused[0]
    assert wrong.p_value < 1e-4
    assert not wrong.helped
    assert "NOT PREDICTED" in repr(wrong)
    right = validate(chain, [AddedMass("2:z")], [data.select([1, 2, 4])], [data.select([3, 5, 6])])
    assert right.helped
    assert "NOT" not in repr(right)


def test_fitted_data_are_not_unused(chain):
    data = poles_of(chain, 1, 0.3, np.random.default_rng(0))
    unknown = [AddedMass("2:z")]
    with pytest.raises(ModelError, match=r"is not unused: parts 2 of it were fitted"):
        validate(chain, unknown, [data.select([1, 2])], [data.select([2, 3])])
    freq = np.linspace(0.4, 3.0, 20)
    w = 2 * np.pi * freq[:, None, None]
    H = np.linalg.inv(chain.K - w**2 * chain.M + 1j * w * chain.D)[:, :1, :1]
    frf = FrfResidual(Frf(freq, np.moveaxis(H, 0, 2), inputs=["1:z"], outputs=["1:z"]))
    with pytest.raises(ModelError, match="parts 0, 1, 2, 3, 4, 5 of it were fitted"):
        validate(chain, unknown, [frf], [frf])
    some, rest = split(frf)
    assert validate(chain, unknown, [some], [rest]).p_value is None

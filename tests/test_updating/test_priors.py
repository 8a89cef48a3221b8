"""No parameter is said to be known less well than by its prior, and an unused prior is named."""

import re
import warnings

import numpy as np
import pytest

import flexplant as fx
from flexplant.errors import FlexplantWarning


@pytest.mark.parametrize("seed", range(20))
def test_data_that_are_worth_less_leave_the_priors_as_they_are(seed):
    """Against the linear problem, its rows of data weighed anew."""
    rng = np.random.default_rng(seed)
    q, m = int(rng.integers(1, 6)), int(rng.integers(1, 9))
    J = rng.standard_normal((m, q)) * 10.0 ** rng.uniform(-3, 3, q)
    prior = 10.0 ** rng.uniform(-3, 3, q)
    prior[1:][rng.uniform(size=q - 1) < 0.3 * (m >= q)] = np.inf
    factor = 10.0 ** rng.uniform(0, 4)

    def covariance(rows):
        both = np.vstack([rows, np.diag(1 / prior)])
        length = np.linalg.norm(both, axis=0)
        half = np.linalg.pinv(both / length, rcond=1e-15) / length[:, None]
        return half @ half.T

    names = tuple(f"p{i}" for i in range(q))
    history = fx.updating.History(np.zeros((1, q)), np.zeros((1, 0)), np.ones(1), np.zeros(1))
    fit = fx.UpdateResult(
        parameters=names,
        units=("",) * q,
        values=np.zeros(q),
        covariance=covariance(J),
        correlation=np.eye(q),
        model=None,
        history=history,
        converged=True,
        reason="",
        prior_std=prior,
    )
    expected = covariance(J / np.sqrt(factor))
    size = np.sqrt(np.diag(expected))
    np.testing.assert_allclose(
        fit.widened(factor) / np.outer(size, size),
        expected / np.outer(size, size),
        rtol=0,
        atol=1e-6,
    )
    assert np.all(np.sqrt(np.diag(fit.widened(factor))) <= prior * (1 + 1e-6))
    free = fit.replace(prior_std=None).widened(factor)
    np.testing.assert_allclose(free, factor * fit.covariance, rtol=1e-12, atol=0)


@pytest.fixture(params=range(6))
def wrong(request):
    """A chain, three of its springs with priors, poles of one with other springs, their std."""
    rng = np.random.default_rng(request.param)
    n = 6
    m, k = rng.uniform(1, 2, n), rng.uniform(1e6, 2e6, n)
    lower = np.eye(n) - np.eye(n, k=-1)
    K = [lower.T @ np.diag(k * unit) @ lower for unit in np.eye(n)]
    dofs = fx.DofSet(range(1, n + 1), ["x"] * n, np.column_stack([np.arange(n), np.zeros((n, 2))]))
    model = fx.FEModel(np.diag(m), sum(K), dofs=dofs)
    chosen = rng.permutation(n)
    fitted = [fx.MatrixParameter(f"k{i}", dK=K[i], prior=(0.0, 0.3)) for i in chosen[:3]]
    true = fx.FEModel(np.diag(m), sum(K) + 1.5 * K[chosen[3]] - 0.6 * K[chosen[4]], dofs=dofs)
    omega = fx.solve_modes(true, count=4).omega
    return model, fitted, 1j * omega, 1e-3 * omega


def printed(fit):
    """The deviations in print."""
    return [float(text) for text in re.findall(r"\+- ([\d.e+-]+\d)", repr(fit))]


def test_a_printed_deviation_is_at_most_that_of_the_prior(wrong):
    model, fitted, poles, std = wrong
    measured = fx.MeasuredModes(poles, modes=range(1, 5), covariance=np.diag(np.tile(std**2, 2)))
    with pytest.warns(FlexplantWarning, match="leaves more than noise"):
        fit = fx.update(model, fitted, [fx.Eigenvalues(measured)])
    assert fit.discrepancy and len(printed(fit)) == 3
    assert max(printed(fit)) <= 0.3
    half = (fit.interval(0.95)[:, 1] - fit.values) / 1.96
    assert np.all(half >= fit.std * (1 - 1e-3)) and np.all(half <= 0.3 * (1 + 1e-3))


@pytest.mark.slow
def test_a_prior_that_takes_no_part_is_named(wrong):
    model, fitted, poles, _ = wrong
    bare = fx.MeasuredModes(poles, modes=range(1, 5))
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        fit = fx.update(model, fitted, [fx.Eigenvalues(bare)])
    said = [str(one.message) for one in caught if "are not used" in str(one.message)]
    assert len(said) == 1
    assert all(q.name in said[0] for q in fitted) and "modes 1, 2, 3, 4" in said[0]
    assert "unused priors: " in repr(fit)
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        fx.update(model, fitted, [fx.Eigenvalues(bare)], prior=False)
    assert not any("are not used" in str(one.message) for one in caught)

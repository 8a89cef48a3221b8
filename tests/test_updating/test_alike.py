"""On a symmetric machine all combinations of mirror images are named, whichever is chosen."""

import warnings

import numpy as np
import pytest
import scipy.linalg as la
from scipy import stats

import flexplant as fx
from flexplant.updating import AddedMass, Eigenvalues, localise
from flexplant.updating.judgement.subsets import Subsets
from flexplant.updating.search import Objective


def chain(masses, springs):
    """A free chain: model, M and K."""
    n = len(masses)
    K = np.zeros((n, n))
    for i, k in enumerate(springs):
        K[i : i + 2, i : i + 2] += k * np.array([[1, -1], [-1, 1]])
    dofs = fx.DofSet(range(1, n + 1), ["z"] * n, np.column_stack([np.arange(n), np.zeros((n, 2))]))
    return fx.FEModel(np.diag(masses), K, dofs=dofs), np.diag(masses), K


def poles(M, K, hidden, rng, noise, count):
    """Noisy poles of the elastic modes, in order, with hidden masses, by scipy alone."""
    M = M + np.diag([hidden.get(i, 0.0) for i in range(len(M))])
    omega = np.sqrt(la.eigh(K, M, eigvals_only=True)[1 : count + 1])
    std = noise * omega
    error = std / np.sqrt(2) * (rng.standard_normal(count) + 1j * rng.standard_normal(count))
    found = -2e-3 * omega + 1j * omega + error
    measured = fx.MeasuredModes(found, modes=range(2, count + 2), covariance=std**2)
    return [Eigenvalues(measured)]


def damped(model, K, M):
    """The model with 0.2 % of damping in each mode: D = M phi diag(4e-3 omega) phi' M."""
    square, phi = la.eigh(K, M)
    D = M @ phi @ np.diag(4e-3 * np.sqrt(np.maximum(square, 0.0))) @ phi.T @ M
    return fx.FEModel(M, K, D, dofs=model.dofs)


@pytest.mark.slow
@pytest.mark.parametrize("count", [1, 2])
@pytest.mark.parametrize("seed", range(6))
def test_all_images_of_the_true_places_are_alike(seed, count):
    rng = np.random.default_rng(10 * seed + count)
    n = int(rng.integers(8, 12))
    half, springs = rng.uniform(1.0, 2.0, n), rng.uniform(0.5e6, 2e6, n - 1)
    masses, springs = half + half[::-1], springs + springs[::-1]
    model, M, K = chain(masses, springs)
    places = rng.permutation(n)[:count].tolist()
    hidden = {i: rng.uniform(0.2, 0.5) for i in places}
    candidates = [AddedMass(f"{i + 1}:z", name=str(i)) for i in range(n)]
    data = poles(M, K, hidden, rng, 1e-5, n - 2)
    # small damping moves frequencies by 2e-6: a fifth of the noise
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", fx.errors.FlexplantWarning)
        found = localise(damped(model, K, M), candidates, data, most=count)
    sets = [frozenset(one) for one in found.alike_sets]
    images = {frozenset(map(str, places)), frozenset(str(n - 1 - i) for i in places)}
    assert images <= set(sets)
    assert frozenset(found.chosen) == sets[0]
    assert set(found.chosen) <= set(found.alike)
    assert {str(i) for i in places} <= set(found.alike)
    if len(images) > 1:
        assert "AMBIGUOUS" in repr(found)


@pytest.mark.long
def test_a_place_too_many_is_as_rare_as_the_page_says():
    """One change: of c - 1 other places one explains its price by chance."""
    rng, trials, extra = np.random.default_rng(5), 60, 0
    n, count = 12, 10
    model, M, K = chain(rng.uniform(1.0, 3.0, n), rng.uniform(0.5e6, 2e6, n - 1))
    model = damped(model, K, M)
    candidates = [AddedMass(f"{i + 1}:z", name=str(i)) for i in range(n)]
    for _ in range(trials):
        place = int(rng.integers(n))
        data = poles(M, K, {place: rng.uniform(0.2, 0.5)}, rng, 1e-4, count)
        found = localise(model, candidates, data, most=2)
        assert str(place) in found.chosen
        extra += len(found.chosen) > 1
    price = np.log(2 * count) + 2 * np.log((n - 1) / 2)
    expected = (n - 1) * stats.chi2.sf(price, 1)
    assert stats.binom.cdf(extra, trials, expected) > 1e-3
    assert stats.binom.sf(extra - 1, trials, expected) > 1e-3


@pytest.mark.parametrize("seed", range(5))
def test_a_fit_in_few_coordinates_is_polished(seed):
    rng = np.random.default_rng(seed)
    n = 8
    model, M, K = chain(rng.uniform(1.0, 2.0, n), rng.uniform(0.5e6, 2e6, n - 1))
    place, size = int(rng.integers(n)), rng.uniform(0.1, 0.5)
    data = poles(M, K, {place: size}, rng, 1e-6, 5)
    candidates = [AddedMass(f"{i + 1}:z", name=str(i)) for i in range(n)]
    whole = Objective(damped(model, K, M), candidates, data, prior=False)
    fits = Subsets(whole, data, n)
    fits.fit((place,))
    fits.polish((place,))
    assert fits.fit((place,)).p[0] == pytest.approx(size, rel=1e-2)

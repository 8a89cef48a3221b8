"""Draws on measured shapes: Gaussian conditioning by hand, shapes of machines by an eigensolver."""

import numpy as np
import pytest
import scipy.linalg as la

from flexplant.plant.machine_draws import MeasuredShapes

RIGID, SIZE = 2, 9
OMEGA = np.array([0.0, 0.0, 1.0, 1.7, 2.5, 4.0, 5.5, 8.0, 11.0])
MEASURED = np.array([2, 3, 5])
S = 2e-3


def matrices(E):
    """Mass and stiffness of a scatter: rows of rigid-body motions are mass."""
    held = np.outer(OMEGA > 0.0, OMEGA > 0.0)
    return np.eye(SIZE) + np.where(held, 0.0, E), OMEGA[:, None] * (np.eye(SIZE) + E) * OMEGA


def shapes_of(E, rows):
    """Shapes of the measured modes at the places, scaled to the model's."""
    M, K = matrices(E)
    V = la.eigh(K, M)[1]
    found = rows @ V[:, MEASURED]
    model = rows[:, MEASURED]
    return found * np.sum(found * model, axis=0) / np.sum(found**2, axis=0)


def scatter(rng, count=1):
    N = S * rng.normal(size=(count, SIZE, SIZE))
    return N + N.transpose(0, 2, 1)


def case(seed, noise=2e-4, pairs=()):
    rng = np.random.default_rng(seed)
    rows = rng.normal(size=(8, SIZE))
    true = scatter(rng)[0]
    seen = shapes_of(true, rows)
    seen += noise * la.norm(rows[:, MEASURED], axis=0) * rng.normal(size=seen.shape)
    scales = np.array([2.0, -0.3j, 1.0 + 1.0j])
    known = MeasuredShapes(
        rows, seen * scales, OMEGA, MEASURED, pairs, np.full((SIZE, SIZE), 2.0), S
    )
    return rng, rows, true, seen, known


@pytest.mark.parametrize("seed", range(3))
def test_drawn_machines_have_the_measured_shapes(seed):
    rng, rows, _, seen, known = case(seed)

    def off(E):
        return np.sqrt(np.mean((shapes_of(E, rows) - seen) ** 2))

    free, bound = [], []
    for E in scatter(rng, 20):
        M, K = known.given(*matrices(E), S, rng)
        V = la.eigh(K, M)[1]
        found, model = rows @ V[:, MEASURED], rows[:, MEASURED]
        found *= np.sum(found * model, axis=0) / np.sum(found**2, axis=0)
        bound.append(np.sqrt(np.mean((found - seen) ** 2)))
        free.append(off(E))
    assert np.mean(bound) < 0.2 * np.mean(free)


def test_more_places_than_modes_are_noise_alone_beyond_what_modes_show():
    """The posterior of the noise by the whole covariance of all places."""
    rng = np.random.default_rng(5)
    rows = rng.normal(size=(30, SIZE))
    seen = shapes_of(scatter(rng)[0], rows)
    sizes = la.norm(rows[:, MEASURED], axis=0)
    seen += 5e-4 * sizes * rng.normal(size=seen.shape)
    known = MeasuredShapes(rows, seen, OMEGA, MEASURED, (), np.full((SIZE, SIZE), 2.0), S)
    assert known.off.shape == (MEASURED.size, SIZE)
    basis = la.qr(rows, mode="economic")[0]
    effects = [basis @ part for part in known.effects]
    G = np.zeros((seen.size, SIZE * SIZE))
    for k, i in enumerate(MEASURED):
        for j in range(SIZE):
            for at in {(i, j), (j, i)}:
                G[30 * k : 30 * k + 30, SIZE * at[0] + at[1]] = effects[k][:, j]
    same = np.array([[i * SIZE + j, j * SIZE + i] for i in range(SIZE) for j in range(i)])
    G = G[:, same[:, 0]]
    off = []
    for k, i in enumerate(MEASURED):
        own = rows[:, i] / sizes[k]
        scaled = seen[:, k] * (seen[:, k] @ rows[:, i]) / (seen[:, k] @ seen[:, k])
        off.append((scaled - own * (own @ scaled)) / sizes[k])
    values, V = la.eigh(2.0 * S**2 * G @ G.T)
    free = la.null_space(la.block_diag(*(rows[:, i : i + 1] for i in MEASURED)).T)
    inner = free.T @ (V * values) @ V.T @ free
    values, V = la.eigh(inner)
    misfit = (V.T @ free.T @ np.concatenate(off)) ** 2
    of = np.maximum(values, 0.0)[:, None] + known.variances
    log = np.log(known.variances) - np.sum(np.log(of) + misfit[:, None] / of, axis=0)
    chance = np.exp(0.5 * (log - log.max()))
    np.testing.assert_allclose(known.chances, chance / chance.sum(), atol=1e-9)


@pytest.mark.slow
@pytest.mark.parametrize("seed", range(2))
def test_draws_are_those_of_gaussian_conditioning(seed):
    """Mean and covariance of the scatter's elements; effects by differences of an eigensolver."""
    rng, rows, _, seen, known = case(seed, noise=2e-3)
    known.chances = np.eye(known.variances.size)[np.argmax(known.chances)]  # of one noise
    noise = known.variances @ known.chances
    model = rows[:, MEASURED]
    elements = [(i, j) for i in range(SIZE) for j in range(max(i + 1, RIGID), SIZE)]

    def across(shapes):  # what is left without the scale, over the shape's size
        own = model / la.norm(model, axis=0)
        return ((shapes - own * np.sum(own * shapes, axis=0)) / la.norm(model, axis=0)).ravel()

    step, effects = 1e-6, []
    for i, j in elements:
        E = np.zeros((SIZE, SIZE))
        E[i, j] = E[j, i] = step
        effects.append((across(shapes_of(E, rows)) - across(shapes_of(-E, rows))) / (2 * step))
    H, r = np.array(effects).T, across(seen)
    prior = 2 * S**2 * np.eye(len(elements))
    gain = prior @ H.T @ la.inv(H @ prior @ H.T + noise * np.eye(len(r)))
    mean, covariance = gain @ r, prior - gain @ H @ prior
    drawn = []
    for E in scatter(rng, 1500):
        np.fill_diagonal(E, 0.0)  # first order
        M, K = known.given(*matrices(E), S, rng)
        stiff = K / np.maximum(np.outer(OMEGA, OMEGA), 1e-9)
        drawn.append([M[i, j] if i < RIGID else stiff[i, j] for i, j in elements])
    std = np.sqrt(np.diag(covariance))
    error = (np.mean(drawn, axis=0) - mean) / (std / np.sqrt(1500))
    assert np.sqrt(np.mean(error**2)) < 1.6
    np.testing.assert_allclose(np.std(drawn, axis=0) / std, 1.0, atol=0.1)


def test_the_noise_contains_errors_of_the_model():
    known = [case(seed, noise=0.05)[-1] for seed in range(20)]
    variance = np.mean([one.variances @ one.chances for one in known])
    assert 0.045 < np.sqrt(variance) < 0.065


def test_a_close_pair_says_nothing_of_the_scatter_within_it():
    rng, _, _, _, known = case(4, pairs=[(0, 1)])
    E = scatter(rng)[0]
    _, K = known.given(*matrices(E), S, rng)
    assert K[2, 3] == matrices(E)[1][2, 3]
    assert not np.isclose(K[2, 5], matrices(E)[1][2, 5], rtol=1e-6, atol=0.0)

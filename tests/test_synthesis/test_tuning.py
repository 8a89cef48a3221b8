"""The tuner beside brute force over the same laws, beyond resonances, on noise and coarse lines."""

import numpy as np
import pytest

from flexplant import Frf
from flexplant.synthesis import tune_loops
from oracles_tuning import best_bandwidth

RATE, MASS = 1e4, 2.0
#: elastic modes [Hz] and their residues beside that of the rigid body
PLANTS = {
    "free": {},
    "collocated, below crossover": {300.0: 1.0},
    "turned by half, below crossover": {80.0: -0.1, 700.0: 0.6},
    "turned by half, above crossover": {600.0: -0.4},
    "two above": {1500.0: 0.5, 2300.0: -0.7},
}


def response(freq, modes, late=1.0):
    """A mass with modes of 0.1 %, held and delayed by some samples: continuous closed forms."""
    s = 2j * np.pi * freq
    G = 1 / s**2
    for f, residue in modes.items():
        w = 2 * np.pi * f
        G = G + residue / (s**2 + 2e-3 * w * s + w**2)
    return G / MASS * np.exp(-s * (late + 0.5) / RATE) * np.sinc(freq / RATE)


def dense(modes, points=300):
    """Frequencies through the resonances."""
    around = 1 + 1e-3 * np.sinh(np.linspace(-5, 5, 61))
    own = [f * around for f in modes]
    return np.unique(np.concatenate([np.geomspace(0.5, 4990.0, points), *own]))


def on_truth(law, modes):
    """The largest |S| on the plant itself, and where the loop of the mass alone crosses 1."""
    freq = dense(modes, 20_000)
    C = law.response(freq)
    F = 1 + C * response(freq, modes)
    assert abs(np.angle(F[1:] / F[:-1]).sum() - 1.5 * np.pi) < 0.6  # stable
    line = np.abs(C) / (MASS * (2 * np.pi * freq) ** 2)
    return 1 / np.abs(F).min(), freq[np.flatnonzero(line > 1.0)[-1]]


@pytest.mark.slow
@pytest.mark.parametrize(
    ("name", "notches"),
    [*((name, 1) for name in PLANTS), ("free", 0), ("turned by half, below crossover", 2)],
)
def test_as_fast_as_brute_force(name, notches):
    """On the same lines no search over the same laws finds one that is 2 % faster."""
    modes = PLANTS[name]
    freq = dense(modes)
    G = response(freq, modes)
    best = best_bandwidth(freq, G, RATE, MASS, list(modes), notches)
    found = tune_loops(Frf(freq, G[None, None]), rate=RATE, hold=False, notches=notches)
    peak, bandwidth = on_truth(found.laws["y1"], modes)
    assert peak < 2.02
    assert bandwidth > 0.98 * best
    if name == "collocated, below crossover" or notches == 2:
        assert bandwidth > min(modes)


@pytest.mark.slow
@pytest.mark.parametrize("known", ["variance", "coherence", "nothing"])
def test_noise_is_not_fitted(known):
    """3 % noise on lines of 2 Hz: the plant itself keeps 6 dB, at the cost of a third at most."""
    modes, rng = PLANTS["two above"], np.random.default_rng(5)
    freq = np.arange(2.0, 4990.0, 2.0)
    G = response(freq, modes)
    noisy = G * (1 + 0.03 * rng.standard_normal((2, freq.size)).T @ [0.5**0.5, 0.5**0.5 * 1j])
    share = np.full((1, 1, freq.size), 0.03**2)
    kinds = {
        "variance": {"variance": share * np.abs(G) ** 2},
        "coherence": {"coherence": 1 / (1 + 10 * share), "freedom": 9.0},
        "nothing": {},
    }[known]
    found = tune_loops(Frf(freq, noisy[None, None], **kinds), rate=RATE, hold=False, notches=1)
    peak, bandwidth = on_truth(found.laws["y1"], modes)
    exact = tune_loops(Frf(freq, G[None, None]), rate=RATE, hold=False, notches=1)
    assert peak < 2.02
    assert bandwidth > 0.66 * on_truth(exact.laws["y1"], modes)[1]


@pytest.mark.slow
def test_a_mode_that_lines_do_not_resolve_stays_below():
    """A mode 0.16 Hz wide on lines of 1 Hz with 1 % noise: no law relies on its phase."""
    modes, rng = PLANTS["turned by half, below crossover"], np.random.default_rng(5)
    freq = np.arange(2.0, 4990.0, 1.0) + 0.3
    noise = 1 + 0.01 * rng.standard_normal((2, freq.size)).T @ [0.5**0.5, 0.5**0.5 * 1j]
    frf = Frf(freq, (response(freq, modes) * noise)[None, None])
    found = tune_loops(frf, rate=RATE, hold=False, notches=1)
    peak, bandwidth = on_truth(found.laws["y1"], modes)
    assert peak < 2.05
    assert bandwidth < 80.0


@pytest.mark.slow
def test_a_plant_that_moves_against_its_force_is_named():
    freq = np.geomspace(1.0, 4990.0, 400)
    found = tune_loops(Frf(freq, -response(freq, {})[None, None]), rate=RATE, hold=False, notches=0)
    assert found.laws["y1"].gain < 0.0
    assert "moves against its force" in repr(found)

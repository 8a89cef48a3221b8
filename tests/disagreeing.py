"""Measurements whose outputs, inputs or runs are of machines with frequencies of their own."""

import numpy as np

from flexplant.lti import Frf
from oracles_identification import modal_frf, noisy, pole


def roving(shift, seed, zeta=0.004, n_in=1, step=0.1, truth=(40.0, 75.0, 110.0, 160.0), setups=6):
    """Six outputs, each (or set-up) of a machine of frequencies off by a draw of its own."""
    rng, freq = np.random.default_rng(seed), np.arange(20.0, 200.0, step)
    phi, drive = rng.normal(size=(6, 4)), rng.normal(size=(n_in, 4)) + 1.0
    draws = np.repeat(1.0 + shift * rng.normal(size=setups), 6 // setups)
    H = np.array([
        modal_frf(freq, pole(np.array(truth) * own, zeta), phi[[o]], drive)[0]
        for o, own in enumerate(draws)
    ])  # fmt: skip
    deviation = 1e-3 * np.sqrt(np.mean(np.abs(H) ** 2))
    variance = np.full(H.shape, deviation**2)
    return Frf(freq, noisy(H, deviation, rng), variance=variance), pole(truth, zeta)


def drifting(shift, seed, zeta=0.01):
    """Six runs of five outputs and two inputs; the machine of each run is off by a draw."""
    rng, freq, truth = np.random.default_rng(seed), np.arange(20.0, 200.0, 0.5), [40.0, 75.0, 150.0]
    phi, runs = rng.normal(size=(5, 3)), []
    for own in 1.0 + shift * rng.normal(size=6):
        H = modal_frf(freq, pole(np.array(truth) * own, zeta), phi, phi[:2])
        sigma = 1e-3 * np.sqrt(np.mean(np.abs(H) ** 2))
        runs.append(Frf(freq, noisy(H, sigma, rng), variance=np.full(H.shape, sigma**2)))
    return runs, pole(truth, zeta), phi

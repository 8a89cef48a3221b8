"""Identification beside its peers on a pair at 47.5 and 48.2 Hz; run with ``-m benchmark -s``."""

import time

import numpy as np
import pytest

from flexplant.identification import identify_modes
from flexplant.lti import Frf
from oracles_identification import modal_frf, noisy, pole

FREQ = np.arange(10.0, 150.0, 0.05)
TRUTH = pole([47.5, 48.2, 112.0], [0.004, 0.004, 0.01])
PHI = np.random.default_rng(0).normal(size=(5, 3))


def responses():
    H = modal_frf(FREQ, TRUTH, PHI, PHI[:1])
    deviation = 1e-3 * np.sqrt(np.mean(np.abs(H) ** 2))
    return noisy(H, deviation, np.random.default_rng(1)), deviation


def worst(poles):
    return max(np.min(np.abs(np.asarray(poles) - p)) / abs(p) for p in TRUTH)


@pytest.mark.benchmark
def test_the_close_pair():
    H, deviation = responses()
    start = time.perf_counter()
    found = identify_modes(Frf(FREQ, H, variance=np.full(H.shape, deviation**2)))
    print(f"\nflexplant: error {worst(found.poles):.1e}, {time.perf_counter() - start:.2f} s")
    assert len(found) == 3
    assert worst(found.poles) < 1e-4


@pytest.mark.benchmark
def test_vector_fitting_beside_it():
    skrf = pytest.importorskip("skrf")
    H, _ = responses()
    network = skrf.Network(f=FREQ, s=H[:1, :1].transpose(2, 0, 1) / np.abs(H).max(), f_unit="hz")
    start = time.perf_counter()
    fit = skrf.VectorFitting(network)
    fit.vector_fit(n_poles_real=0, n_poles_cmplx=3)
    print(f"\nVectorFitting: error {worst(fit.poles):.1e}, {time.perf_counter() - start:.2f} s")

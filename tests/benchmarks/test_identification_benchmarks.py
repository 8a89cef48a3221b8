"""Identification beside its peers on a pair at 47.5 and 48.2 Hz; run with ``-m benchmark -s``."""

import time
import warnings

import numpy as np
import pytest

from flexplant.identification import identify_modes
from flexplant.lti import Frf
from oracles_identification import modal_frf, noisy, pole

pytestmark = pytest.mark.benchmark
FREQ = np.arange(10.0, 150.0, 0.05)
TRUTH = pole([47.5, 48.2, 112.0], [0.004, 0.004, 0.01])
PHI = np.random.default_rng(0).normal(size=(5, 3))


def responses(level):
    H = modal_frf(FREQ, TRUTH, PHI, PHI[:1])
    deviation = level * np.sqrt(np.mean(np.abs(H) ** 2))
    return noisy(H, deviation, np.random.default_rng(1)), deviation


def errors(poles):
    """Relative error of the pole nearest to each true one, and how many modes are met."""
    away = np.abs(np.asarray(poles)[:, None] - TRUTH) / np.abs(TRUTH)
    return away.min(axis=0), np.unique(away.argmin(axis=0)).size


def of_flexplant(H, deviation):
    return identify_modes(Frf(FREQ, H, variance=np.full(H.shape, deviation**2))).poles


def of_vector_fitting(H, deviation):
    skrf = pytest.importorskip("skrf")
    # one port matrix is fitted with common poles: outputs on its diagonal
    S = np.zeros((FREQ.size, 5, 5), dtype=complex)
    S[:, :, 0] = H[:, 0].T / np.abs(H).max()
    S[:, 0, 1:] = S[:, 1:, 0]
    fit = skrf.vectorFitting.VectorFitting(skrf.Network(f=FREQ, s=S, f_unit="hz"))
    fit.vector_fit(n_poles_real=0, n_poles_cmplx=3, fit_constant=True, fit_proportional=False)
    return fit.poles


def of_sdypy(H, deviation):
    EMA = pytest.importorskip("sdypy.EMA")
    model = EMA.Model(H[:, 0], FREQ, lower=10, upper=150, pol_order_high=30, frf_form="receptance")
    model.get_poles(show_progress=False)
    model.select_closest_poles(list(np.abs(TRUTH) / (2 * np.pi)), f_window=1)
    omega, zeta = 2 * np.pi * np.array(model.nat_freq), np.array(model.nat_xi)
    return -zeta * omega + 1j * omega * np.sqrt(1 - zeta**2)


@pytest.mark.parametrize("level", [1e-3, 1e-2], ids=["60 dB", "40 dB"])
def test_the_close_pair_beside_peers(level):
    """No peer is told the poles from noise; sdypy-EMA is even told the true frequencies."""
    H, deviation = responses(level)
    rows = {}
    for name, method in {
        "flexplant": of_flexplant,
        "sdypy-EMA": of_sdypy,
        "scikit-rf VectorFitting": of_vector_fitting,
    }.items():
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            start = time.process_time()
            poles = method(H, deviation)
            rows[name] = (*errors(poles), time.process_time() - start)
    ours = rows["flexplant"]
    print(f"\n{level:g} noise           errors at 47.5, 48.2, 112 Hz   poles  CPU [s]  time ratio")
    for name, (error, count, spent) in rows.items():
        print(
            f"{name:24s} {error[0]:.1e} {error[1]:.1e} {error[2]:.1e}    {count}    {spent:6.2f}"
            f"   {spent / ours[2]:6.2f}"
        )
    assert ours[1] == 3
    assert ours[0].max() < 0.1 * level
    for error, _, _ in rows.values():
        assert ours[0].max() < 1.5 * error.max()

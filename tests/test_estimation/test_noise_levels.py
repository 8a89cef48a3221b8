"""Noise levels from records: known ones, their stated uncertainty, exact likelihood, refusals."""

import re

import numpy as np
import pytest
from scipy.optimize import minimize
from scipy.signal import lfilter
from scipy.stats import chi2
from test_consistency import machine, plant, recorded
from test_kalman import INSET, one_state

from flexplant.errors import AssumptionError, FlexplantWarning, ModelError
from flexplant.estimation import consistency, design_kalman, estimate_noise
from flexplant.estimation import noise_from_records as inner
from flexplant.loop import close_loop
from flexplant.modes import solve_modes
from flexplant.plant import Disturbance, Sensor, assemble_plant
from flexplant.simulation import simulate
from flexplant.structure import ModalDamping, chain
from flexplant.synthesis import design_servo
from flexplant.testbeds import three_masses
from oracles_estimation import scalar_likelihood


def scalar_record(seed, count, a=0.9, q=1.0, r=2.0):
    rng = np.random.default_rng(seed)
    x = lfilter([0.0, 1.0], [1.0, -a], np.sqrt(q) * rng.standard_normal(count + 500))[500:]
    return {"y1": x + np.sqrt(r) * rng.standard_normal(count), "u1": np.zeros(count)}


@pytest.mark.long
def test_known_levels_from_50000_samples():
    """Eight levels, guesses off by factors of 3 and 2: within 10 % and four deviations."""
    records, _ = recorded(machine(), steps=50000)
    found = estimate_noise(plant(scale=0.3, sensor_scale=2.0), records)
    off = np.array([found.asd[name] / machine().asd[name] - 1 for name in found.channels])
    stated = np.array([found.relative[name] for name in found.channels])
    assert len(found.channels) == 8
    assert np.all(np.abs(off) < 0.1)
    assert np.all(np.abs(off) < 4 * stated)
    assert np.all(stated < 0.02)
    # already the least-squares fit of the autocovariances comes close
    np.testing.assert_allclose(found.start, [1 / 0.3] * 4 + [0.5] * 4, rtol=0.1)
    assert found.nis == pytest.approx(1.0, abs=0.01)
    assert found.slope < 1e-3
    assert found.plant.asd == pytest.approx(dict(found.asd), rel=1e-12)
    # with these levels the record is consistent
    observer = design_kalman(found.plant)
    assert consistency(observer, observer.estimate(records)).holds


@pytest.mark.long
def test_the_stated_deviations_are_those_of_repeated_records():
    """40 records of 2000 samples: the squared scores of both levels are chi-square."""
    scores = []
    for seed in range(100, 140):
        found = estimate_noise(one_state(0.9, q=2.0, r=1.0), scalar_record(seed, 2000))
        truth = np.log([np.sqrt(1 / 2), np.sqrt(2 / 1)])
        scores.append((np.log(found.ratios) - truth) @ np.linalg.solve(
            found.covariance, np.log(found.ratios) - truth
        ))  # fmt: skip
    low, high = chi2.ppf([1e-3, 1 - 1e-3], 2 * len(scores))
    assert low < np.sum(scores) < high


@pytest.mark.slow
def test_it_is_the_exact_maximum_likelihood():
    """Scalar: the exact likelihood of the stationary filter, maximised without gradients."""
    records = scalar_record(3, 4000)
    found = estimate_noise(one_state(0.9, q=2.0, r=1.0), records)
    best = minimize(
        lambda x: -scalar_likelihood(records["y1"], 0.9, *np.exp(x)),
        np.log([2.0, 1.0]),
        method="Nelder-Mead",
        options={"xatol": 1e-6, "fatol": 1e-8},
    )
    mine = np.log(found.ratios**2 * [2.0, 1.0])
    deviation = 2 * np.sqrt(np.diag(found.covariance))
    assert np.all(np.abs(mine - best.x) < 0.3 * deviation)


def test_slope_and_information_by_differences():
    rng = np.random.default_rng(2)
    parts = rng.standard_normal((3, 40, 2, 2)) + 1j * rng.standard_normal((3, 40, 2, 2))
    parts = parts @ np.conj(np.swapaxes(parts, 2, 3))
    X = rng.standard_normal((40, 2)) + 1j * rng.standard_normal((40, 2))
    spectrum = inner._LevelSpectrum(X[:, :, None] * X.conj()[:, None, :], parts)
    t = np.array([0.5, 1.0, 2.0])
    _, slope, information = inner._likelihood(spectrum, t)
    for i in range(3):
        up, down = t.copy(), t.copy()
        up[i], down[i] = t[i] * np.exp(1e-5), t[i] * np.exp(-1e-5)
        change = inner._likelihood(spectrum, up)[0] - inner._likelihood(spectrum, down)[0]
        assert slope[i] == pytest.approx(change / 2e-5, rel=1e-6, abs=0)
    S = np.tensordot(t, parts, 1)
    wanted = sum(
        np.trace(np.linalg.solve(S[k], parts[0, k]) @ np.linalg.solve(S[k], parts[2, k])).real
        for k in range(40)
    )
    assert information[0, 2] == pytest.approx(wanted * t[0] * t[2], rel=1e-10, abs=0)


def test_a_level_that_is_zero_goes_to_zero():
    records = scalar_record(5, 4000, q=1e-12)
    found = estimate_noise(one_state(0.9, q=0.5, r=1.0), records)
    assert found.ratios[0] < 0.15
    assert found.ratios[1] == pytest.approx(np.sqrt(2.0), rel=0.05, abs=0)


def chain_record(count, rate, seed, duration=4.0):
    """A chain of masses held by a servo, all its modes in truth: its plant, modes and record."""
    masses = chain(masses=[1.0] * count, stiffnesses=[4e5] * (count - 1))
    every = solve_modes(masses, count=count, damping=ModalDamping(0.01))
    own = three_masses().assembled.ports
    sensors = [Sensor("y1", at="1:x", asd=1e-12), Sensor("y2", at=f"{count}:x", asd=3e-12)]
    truth = assemble_plant(every, own.replace(y=sensors)).discretized(rate, delay=1)
    observer = design_kalman(truth)
    servo = design_servo(truth, bandwidth=10.0, observer=observer)
    run = simulate(close_loop(truth, observer, servo), duration=duration, rng=seed)
    return truth, every, run


@pytest.mark.slow
@pytest.mark.parametrize(
    ("count", "kept", "rate", "kind"),
    [(5, 3, 2e3, "modes"), pytest.param(8, 4, 1e4, "plant", marks=pytest.mark.long)],
)
def test_modes_left_out_are_no_noise_of_the_sensors(count, kept, rate, kind):
    """Without an evaluation model sensors would be 100 times noisier, +- 0.3 %."""
    truth, every, run = chain_record(count, rate, seed=1)
    small = every.select(range(kept))
    design = assemble_plant(small, truth.assembled.ports).discretized(rate, delay=1)
    found = estimate_noise(design.replace(evaluation=every if kind == "modes" else truth), run)
    t = found.ratios**2
    stated = 2 * t * list(found.relative.values())
    assert np.all(np.abs(t - 1) < 4 * stated)
    assert stated[0] < 0.05 and stated[2] < 0.05
    assert found.plant.system.n_states == design.system.n_states
    assert found.nis == pytest.approx(1.0, abs=0.03)
    assert "white" in found.verdict


@pytest.mark.slow
def test_levels_that_stand_for_modes_left_out_are_warned_of():
    with pytest.warns(
        FlexplantWarning, match="do not explain the record.*Give the plant an evaluation"
    ):
        blind = estimate_noise(plant(), recorded(plant(count=12))[0])
    assert "a truncated mode" in blind.verdict


@pytest.mark.slow
@pytest.mark.parametrize("seed", [0, 1, 2])
def test_a_level_that_nothing_shows_has_a_bound(seed):
    """True levels given: the first sensor's noise is far below its motion within a sample."""
    truth, _, run = chain_record(3, 2e3, seed)
    found = estimate_noise(truth, run)
    assert np.all(np.abs(found.ratios[[0, 2]] - 1) < 0.05)
    text = repr(found)
    bound = float(re.search(r"y1:noise at most ([\d.]+) times", text).group(1))
    assert 1.0 < bound < 20.0
    assert "y2:noise at most" not in text


def test_outliers_are_left_out_by_a_gate():
    records = scalar_record(11, 6000)
    records["y1"][3000] += 1e3
    found = estimate_noise(one_state(0.9), records, gate=8)
    assert np.all(np.abs(found.ratios - [1.0, 1.0]) < 0.6)


@pytest.mark.slow
def test_refusals():
    with pytest.raises(ModelError, match="at least 1000 samples"):
        estimate_noise(one_state(0.9), scalar_record(1, 900))
    own = machine().assembled.ports
    twin = own.replace(w=[*own.w, Disturbance("twin", at=INSET[0], asd=1e-3)])
    records, _ = recorded(machine(), steps=4000)
    with pytest.raises(AssumptionError, match="cannot separate the levels of amp1, twin"):
        estimate_noise(machine().with_ports(twin), records)

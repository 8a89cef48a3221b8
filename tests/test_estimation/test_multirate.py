"""Sensors at different rates: the recursion run until it repeats, decimation, a run, refusals."""

import numpy as np
import pytest
from test_kalman import one_state, plate_plant

from flexplant.errors import LabelError, ModelError, SolverError
from flexplant.estimation import design_kalman, design_multirate
from flexplant.estimation.filter_models import filter_model
from oracles_estimation import periodic_variances

EVERY = {"y3": 4, "y4": (6, 1)}


def matrices(plant):
    m = filter_model(plant)
    return {name: getattr(m, name) for name in ("A", "C1", "C2", "Q", "R")}


@pytest.mark.slow
def test_variances_are_those_of_the_recursion_in_the_long_run():
    plant = plate_plant(1e-2, count=8, sensor_asd=1e-10)
    found = design_multirate(plant, EVERY)
    k = np.arange(12)
    read = np.array([k >= 0, k >= 0, k % 4 == 0, k % 6 == 1]).T
    wanted = periodic_variances(matrices(plant), read, periods=400)
    np.testing.assert_allclose(found.variances, wanted, rtol=1e-6)
    assert found.period == 12
    assert found.certificate["difference"] < 1e-6
    fastest, slowest = design_kalman(plant), design_multirate(plant, {"y3": 12})
    assert fastest.rms("die") < found.rms("die")
    assert min(found.rms("die", k) for k in range(12)) < max(found.rms("die", k) for k in range(12))
    assert slowest.rms("die") > fastest.rms("die")


def test_all_sensors_in_each_sample_is_the_kalman_filter():
    plant = plate_plant(1e-2, count=8)
    kalman, found = design_kalman(plant), design_multirate(plant, {"y1": 1})
    assert found.rms("die") == pytest.approx(kalman.rms("die"), rel=1e-8, abs=0)
    scale = np.abs(kalman.gain).max()
    np.testing.assert_allclose(found.gains[0], kalman.gain, atol=1e-7 * scale)
    np.testing.assert_allclose(found.system(0).D, kalman.system.D, atol=1e-7)


def test_a_sensor_read_seldom_is_the_filter_of_the_slow_process():
    """x+ = a x + w read every third sample is x+ = a^3 x + w', a scalar Riccati equation."""
    a, q, r = 0.9, 1.0, 2.0
    found = design_multirate(one_state(a, q, r), {"y1": 3})
    slow, noise = a**3, q * (1 + a**2 + a**4)
    b = r * (1 - slow**2) - noise
    P = (-b + np.sqrt(b * b + 4 * noise * r)) / 2
    after = P * r / (P + r)
    wanted = [after, a**2 * after + q, a**2 * (a**2 * after + q) + q]
    np.testing.assert_allclose(found.variances[:, 0], wanted, rtol=1e-10)
    assert found.rms("die") == pytest.approx(np.sqrt(np.mean(wanted)), rel=1e-10, abs=0)


@pytest.mark.slow
def test_a_record():
    plant = one_state(0.9)
    found = design_multirate(plant, {"y1": (3, 1)})
    rng = np.random.default_rng(2)
    steps = 60000
    x, z, y = 0.0, np.zeros(steps), np.full(steps, np.nan)
    for k in range(steps):
        z[k] = x
        if k % 3 == 1:
            y[k] = x + np.sqrt(2.0) * rng.standard_normal()
        x = 0.9 * x + rng.standard_normal()
    error = z - found.estimate({"y1": y, "u1": np.zeros(steps)})["die:hat"]
    shown = np.sqrt(np.mean(error.reshape(-1, 3) ** 2, axis=0))
    np.testing.assert_allclose(shown, [found.rms("die", k) for k in range(3)], rtol=0.02)
    with pytest.raises(ModelError, match="is read in sample 4, where the record has NaN"):
        found.estimate({"y1": np.where(np.arange(steps) == 4, np.nan, y), "u1": np.zeros(steps)})


def test_refusals():
    plant = one_state(0.9)
    with pytest.raises(LabelError, match="no sensor 'y7'"):
        design_multirate(plant, {"y7": 2})
    with pytest.raises(ModelError, match="offset of 'y1'"):
        design_multirate(plant, {"y1": (3, 3)})
    with pytest.raises(ModelError, match="repeat after"):
        design_multirate(plate_plant(1e-2, count=4), {"y1": 97, "y2": 89})
    with pytest.raises(SolverError, match="no stabilising solution"):
        # a wave of period two that is read in every second sample looks like a constant
        design_multirate(one_state(1.0, q=1e-300), {"y1": 2})

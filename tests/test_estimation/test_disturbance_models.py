"""Shaped, held and rigid-body forces: spectra, closed forms, dense oracles, detectability."""

import numpy as np
import pytest
from test_kalman import CORNERS, INSET, modes, ports

from flexplant.errors import AssumptionError, ModelError
from flexplant.estimation import design_kalman
from flexplant.estimation.filter_models import filter_model
from flexplant.loop import close_loop
from flexplant.plant import Disturbance, RandomWalk, RigidForce, Sensor, assemble_plant
from flexplant.simulation import simulate
from flexplant.synthesis import design_servo
from oracles_estimation import correlated_covariance


def biased(axes=("z", "rx", "ry"), **options):
    own = ports(**options)
    w = [*own.w, *(RandomWalk(1e-2).rigid(f"bias:{axis}", axis) for axis in axes)]
    return assemble_plant(modes(1e-2, 8), own.replace(w=w)).discretized(2e3, delay=1)


def test_a_rigid_force_bends_nothing():
    own = ports()
    forces = [RigidForce("pull", "z", asd=1.0), RigidForce("turn", "rx", asd=1.0)]
    plant = assemble_plant(modes(), own.replace(w=forces))
    elastic = plant.modal_states[2 * plant.n_rigid :]
    column = plant.system.B[:, plant.system.input_index(["pull", "turn"])]
    assert np.abs(column[elastic]).max() < 1e-9 * np.abs(column).max()
    # one newton accelerates the centre of the plate by 1 / m
    mass, g = 2702 * 0.6 * 0.6 * 0.0272, plant.system
    middle = plant.at(poi=(0.3, 0.3, 0.0)).system
    row = middle.C[middle.output_index(["die:z"])]
    assert (row @ g.A @ column[:, :1])[0, 0] == pytest.approx(1 / mass, rel=1e-9, abs=0)


def test_bias_is_a_state_of_the_filter():
    """The filter resolves the bias to a part of its prior; sensors on one line do not show rx."""
    plant = biased()
    kalman = design_kalman(plant)
    states = [i for i, name in enumerate(plant.system.states) if name.startswith("bias:")]
    prior = RandomWalk(1e-2).rms ** 2
    assert np.all(np.diag(kalman.covariance)[states] < 1e-2 * prior)
    line = [Sensor(f"y{i}", at=(0.2 * i, 0.3, 0.0), asd=1e-12) for i in range(4)]
    with pytest.raises(AssumptionError, match="y does not see the rigid-body rotation rx"):
        design_kalman(biased(y=line))


def held_ports(**options):
    own = ports(**options)
    w = [Disturbance(f"amp{i}", at=p, asd=1e-3, held=True) for i, p in enumerate(INSET, 1)]
    fast = [
        Sensor(f"a{i}", at=p, quantity="acceleration", asd=1e-6) for i, p in enumerate(CORNERS, 1)
    ]
    return own.replace(w=w, y=[*own.y, *fast])


def with_accelerometers():
    return assemble_plant(modes(1e-2, 8), held_ports()).discretized(2e3, delay=1)


@pytest.mark.slow
def test_accelerometers_by_the_textbook():
    """Simon, Optimal State Estimation, section 7.1: correlated process and sensor noise, run
    until it is stationary in states, sensors and noises of unit size."""
    plant = with_accelerometers()
    kalman = design_kalman(plant)
    m = filter_model(plant)
    assert np.abs(m.S).max() > 0
    d, s = np.sqrt(np.diag(kalman.predicted_covariance)) + 1e-300, np.sqrt(np.diag(m.R))
    d = np.where(d > 1e-200, d, 1.0)
    A, C = m.A * d / d[:, None], m.C2 * d / s[:, None]
    Q, R, S = m.Q / np.outer(d, d), m.R / np.outer(s, s), m.S / np.outer(d, s)
    P = correlated_covariance({"A": A, "C2": C, "Q": Q, "R": R, "S": S}, 20000)
    C1 = m.C1 * d
    np.testing.assert_allclose(kalman.variances, np.diag(C1 @ P @ C1.T), rtol=1e-6)
    without = assemble_plant(modes(1e-2, 8), ports()).discretized(2e3, delay=1)
    assert kalman.rms("die") < design_kalman(without).rms("die")
    # the correlation is in the error on another plant as well
    assert kalman.rms("die", on=plant) == pytest.approx(kalman.rms("die"), rel=1e-6, abs=0)


def test_accelerometers_without_held_noise_are_refused():
    own = held_ports()
    loud = own.replace(w=[w.replace(held=False) for w in own.w])
    plant = assemble_plant(modes(1e-2, 8), loud).discretized(2e3, delay=1)
    with pytest.raises(AssumptionError, match=r"held=True"):
        design_kalman(plant)
    with pytest.raises(ModelError, match="held of 'amp'"):
        Disturbance("amp", at=INSET[0], held="yes")


@pytest.mark.slow
def test_simulated_accelerometers_give_the_predicted_error():
    plant = with_accelerometers()
    kalman = design_kalman(plant)
    loop = close_loop(plant, kalman, design_servo(plant, bandwidth=20.0))
    run = simulate(loop, duration=4.0, rng=3, runs=4)
    # the closed form of the loop counts held noise as the simulation does
    assert loop.rms("die:z") == pytest.approx(run.rms_interval("die:z", start=1.0)[0], rel=0.1)
    error = run["die:z"] - run["die:hat"]
    shown = np.sqrt(np.mean(error[:, 1000:] ** 2))
    assert shown == pytest.approx(kalman.rms("die"), rel=0.03, abs=0)

"""Every filter, controller, loop, score and budget accounts for the evaluation model, unasked."""

import numpy as np
import pytest

import flexplant as fx
from flexplant.estimation import Augmented, design_input_estimator, design_multirate
from plates import make_plate
from stages import ports

PLATE = make_plate(elements=(4, 4)).with_damping(fx.ModalDamping(0.01))
MODES = fx.solve_modes(PLATE, count=20)
FEW = fx.assemble_plant(MODES.select(range(9)), ports()).discretized(10e3, delay=1.5)
JUDGED = FEW.replace(evaluation=MODES)
SAID = "not judged on a larger model"
LEFT = "left out"
YS = ["y1", "y2", "y3", "y4"]


def servo(plant):
    return fx.design_servo(plant, bandwidth=40.0, observer=fx.design_static(plant))


def loop(plant):
    return fx.close_loop(plant, servo(plant), fx.design_static(plant))


def weighted(plant):
    return plant.weighted(fx.stage_weights(plant, 30.0))


ANSWERS = {
    "Kalman filter": fx.design_kalman,
    "filter of several rates": lambda plant: design_multirate(plant, {"y1": 2}),
    "input estimator": lambda plant: design_input_estimator(plant, ["amp1"]),
    "input estimator that assumes": lambda plant: design_input_estimator(
        plant, ["amp1"], Augmented(1e-3)
    ),
    "servo": servo,
    "H2": lambda plant: fx.design_h2(weighted(plant)),
    "coprime factors": fx.design_ncf,
    "loop": loop,
    "budget": lambda plant: loop(plant).budget("die:error"),
}


@pytest.mark.slow
@pytest.mark.parametrize("name", ANSWERS)
@pytest.mark.filterwarnings("ignore:.*evaluation= of a finer mesh")
def test_an_answer_accounts_for_the_modes_left_out_or_says_that_it_does_not(name):
    alone, judged = (repr(ANSWERS[name](plant)) for plant in (FEW, JUDGED))
    assert alone.count(SAID) == 1 and LEFT not in alone
    assert SAID not in judged and LEFT in judged


@pytest.mark.slow
@pytest.mark.filterwarnings("ignore:.*evaluation= of a finer mesh")
def test_scores_are_those_of_the_filters_that_are_judged():
    for plant in (FEW, JUDGED):
        scores = fx.score_sensors(plant, [YS], fx.PoiVariance("die"))
        placed = fx.place_sensors(plant, YS, count=3, criterion=fx.PoiVariance("die"))
        wanted = fx.design_kalman(plant).variances[0]
        assert scores.values[0] == pytest.approx(wanted, rel=1e-6, abs=0)
        assert [repr(found).count(SAID) for found in (scores, placed)] == [plant is FEW] * 2
    assert wanted > 2.0 * fx.design_kalman(FEW).variances[0]


@pytest.mark.slow
@pytest.mark.filterwarnings("ignore:.*evaluation= of a finer mesh")
@pytest.mark.filterwarnings("ignore:.*nodes a wavelength")
def test_a_filter_that_reads_all_sensors_in_each_sample_has_the_gains_of_the_stationary_one():
    """The modes left out enter both as the same noise, correlated between sensors and POIs."""
    ours, theirs = design_multirate(JUDGED, {}).system(0), fx.design_kalman(JUDGED).system
    for name in "ABCD":
        one, two = getattr(ours, name), getattr(theirs, name)
        np.testing.assert_allclose(one, two, rtol=1e-8, atol=1e-8 * np.abs(two).max())


@pytest.mark.slow
def test_errors_of_an_input_estimator_on_the_whole_machine_are_those_of_its_modes():
    """Predicted with the modes left out against samples of the whole plant, amp1 at rest."""
    found = design_input_estimator(JUDGED, ["amp1"])
    whole = JUDGED.evaluation_plant
    rng, steps = np.random.default_rng(3), 40_000
    g, quiet = whole.system, whole.replace(asd=whole.asd | {"amp1": 0.0})
    noise = rng.standard_normal((steps, quiet.noise_factor.shape[1])) @ quiet.noise_factor.T
    reading = rng.standard_normal((steps, len(YS))) * np.sqrt(quiet.sensor_noise.diagonal()[:4])
    rows = g.C[g.output_index([*YS, "die:z"])]
    x, seen = np.zeros(g.n_states), np.empty((steps, 5))
    for k in range(steps):
        seen[k] = rows @ x
        x = g.A @ x + noise[k]
    f, hat = found.system.select(inputs=YS, outputs=["die:hat"]), np.empty(steps)
    state = np.zeros(f.n_states)
    for k in range(steps):
        y = seen[k, :4] + reading[k]
        hat[k] = (f.C @ state + f.D @ y)[0]
        state = f.A @ state + f.B @ y
    error = (seen[:, 4] - hat)[5000:]
    assert np.sqrt(np.mean(error**2)) == pytest.approx(found.rms("die"), rel=0.1)
    assert found.rms("die") > 3.0 * design_input_estimator(FEW, ["amp1"]).rms("die")

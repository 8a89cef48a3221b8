"""Every filter, controller, loop, score and budget accounts for the evaluation model, unasked."""

import pytest

import flexplant as fx
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
    "servo": servo,
    "H2": lambda plant: fx.design_h2(weighted(plant)),
    "H-infinity": lambda plant: fx.design_hinf(weighted(plant)),
    "coprime factors": fx.design_ncf,
    "loop": loop,
    "table": lambda plant: fx.compare_loops({"a": loop(plant)}),
    "budget": lambda plant: loop(plant).budget("die:error"),
}


@pytest.mark.slow
@pytest.mark.parametrize("name", ANSWERS)
@pytest.mark.filterwarnings("ignore:with the modes that the plant left out")
def test_an_answer_accounts_for_the_modes_left_out_or_says_that_it_does_not(name):
    alone, judged = (repr(ANSWERS[name](plant)) for plant in (FEW, JUDGED))
    assert alone.count(SAID) == 1 and LEFT not in alone
    assert SAID not in judged
    # a table has no words for it: its figures are those on the evaluation model
    assert LEFT in judged or (name == "table" and judged not in alone)


@pytest.mark.slow
def test_scores_are_those_of_the_filters_that_are_judged():
    for plant in (FEW, JUDGED):
        scores = fx.score_sensors(plant, [YS], fx.PoiVariance("die"))
        placed = fx.place_sensors(plant, YS, count=3, criterion=fx.PoiVariance("die"))
        wanted = fx.design_kalman(plant).variances[0]
        assert scores.values[0] == pytest.approx(wanted, rel=1e-6, abs=0)
        assert [repr(found).count(SAID) for found in (scores, placed)] == [plant is FEW] * 2
    assert wanted > 2.0 * fx.design_kalman(FEW).variances[0]

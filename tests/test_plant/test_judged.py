"""Every filter, controller, loop, score and budget accounts for the evaluation model, unasked."""

import numpy as np
import pytest

import flexplant as fx
from plates import make_plate
from stages import ports

PLATE = make_plate(elements=(4, 4)).with_damping(fx.ModalDamping(0.01))
MODES = fx.solve_modes(PLATE, count=20)
FEW = fx.assemble_plant(MODES.select(range(9)), ports()).discretized(10e3, delay=1.5)
JUDGED = FEW.replace(evaluation=MODES)
SAID = "not judged on a larger model"
LEFT = "truncated"
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
@pytest.mark.filterwarnings("ignore:with the modes that the plant truncates")
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


def response(gain=1.0):
    """The response of a machine with all modes, from actuators to sensors, not held."""
    g = JUDGED.continuous.evaluation_plant.Gyu.select(outputs=YS)
    lines = np.concatenate([np.arange(1.0, 2500.0), np.arange(2500.0, 2e4, 5.0)])
    frf = fx.frequency_response(g, lines)
    return frf.replace(data=gain * frf.data)


DESIGNED = ("servo", "H2", "H-infinity", "coprime factors", "loop")


@pytest.mark.slow
@pytest.mark.parametrize("name", DESIGNED)
@pytest.mark.filterwarnings("ignore:with the modes that the plant truncates")
def test_a_design_is_judged_on_the_measured_response_or_says_that_it_is_not(name):
    alone, measured = (ANSWERS[name](one) for one in (JUDGED, JUDGED.measured(response())))
    assert repr(alone).count("not judged on a measurement") == 1
    assert "not judged on a measurement" not in repr(measured)
    assert "on the measured response: stable, modulus margin" in repr(measured)


@pytest.mark.slow
def test_the_margin_on_the_measured_response_is_that_of_its_lines():
    made = loop(JUDGED.measured(response()))
    found = made.on_measurement
    f = np.arange(1.0, 2500.0)
    law = made.controller.select(made.driven, YS)
    K = fx.frequency_response(law, f).data
    # the machine behind a zero-order hold, 1.5 samples late, and what folds back from above
    every, P = response(), 0.0
    for k in (-1, 0, 1):
        at = np.abs(f + k * 10e3)
        data = np.array([[np.interp(at, every.freq, one) for one in row] for row in every.data])
        data = np.where(f + k * 10e3 < 0, data.conj(), data)
        held = np.sinc((f + k * 10e3) / 10e3) * np.exp(-1j * np.pi * (f + k * 10e3) / 10e3)
        P = P + data * held * np.exp(-2j * np.pi * (f + k * 10e3) * 1.5 / 10e3)
    S = np.linalg.inv(np.eye(4) - np.einsum("uyf,yvf->fuv", K, P))
    assert found.margin == pytest.approx(1.0 / np.linalg.norm(S, 2, axis=(1, 2)).max(), rel=0.01)
    assert found.margin == pytest.approx(made.completed.modulus_margin, rel=0.02)


@pytest.mark.slow
def test_a_loop_that_is_unstable_on_the_measured_response_warns():
    with pytest.warns(fx.errors.FlexplantWarning, match="unstable on the measured response"):
        found = loop(JUDGED.measured(response(gain=8.0)))
    assert found.is_stable and found.on_measurement.is_unstable
    with pytest.raises(fx.errors.LabelError, match="no sensor"):
        JUDGED.measured(response().replace(outputs=("a", "b", "c", "d")))
    # another rate, another position: the machine is the same
    assert JUDGED.measured(response()).at((0.1, 0.1, 0.0)).measurement is not None


@pytest.mark.slow
def test_a_response_from_20_hz_up_that_holds_a_delay_judges_a_slow_filter_with_integrators():
    whole = response()
    keep = whole.freq >= 20.0
    given = fx.Frf(whole.freq[keep], whole.data[..., keep], whole.inputs, whole.outputs)
    late = given.replace(data=given.data * np.exp(-2j * np.pi * given.freq * 0.7 / 10e3))
    observer = fx.design_kalman(JUDGED)
    servo = fx.design_servo(JUDGED, bandwidth=40.0, observer=observer)
    for plant in (JUDGED.measured(given), JUDGED.measured(late, delay=0.7)):
        found = fx.close_loop(plant, observer, servo)
        margin = found.completed.modulus_margin
        assert found.on_measurement.margin == pytest.approx(margin, rel=0.02)
    # measured from sample to sample, where a delay is usual: it says that it adds the plant's
    texts = [
        repr(fx.close_loop(JUDGED.measured(given, hold=False, delay=d), observer, servo))
        for d in (0.0, 1.5)
    ]
    assert ["with 1.5 samples of delay added" in text for text in texts] == [True, False]
    with pytest.raises(fx.errors.ModelError, match="delay counts samples"):
        JUDGED.continuous.measured(given, delay=0.7)


def test_a_plant_is_checked_by_its_own_method():
    with pytest.raises(fx.errors.ModelError, match=r"method check\(\)"):
        fx.check(FEW)

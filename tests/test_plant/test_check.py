"""check(): rigid-body modes that a plant does not reach or see, in physical words."""

import re

import numpy as np
import pytest

from flexplant.errors import AssumptionError
from flexplant.estimation import design_kalman
from flexplant.lti import StateSpace
from flexplant.plant import Actuator, Disturbance, Poi, Sensor, StandardPlant, assemble_plant
from flexplant.synthesis import design_servo
from stages import CORNERS, INSET, RATE, L, ports, reduced, some_modes

MIDDLE = [(0.1, L / 2, 0.0), (0.3, L / 2, 0.0), (0.5, L / 2, 0.0)]  # one line y = L/2
CENTRE = (L / 2, L / 2, 0.0)


def report(**changes):
    return assemble_plant(some_modes(), ports(**changes)).check()


def noises(places, **more):
    return [Disturbance(f"d{i}", at=p, asd=1e-3, **more) for i, p in enumerate(places)]


def sensors(places, **more):
    return [Sensor(f"s{i}", at=p, asd=1e-12, **more) for i, p in enumerate(places)]


def test_the_example_meets_everything():
    for plant in (
        assemble_plant(some_modes(), ports()),
        assemble_plant(reduced(), ports()).discretized(RATE, delay=1),
    ):
        found = plant.check()
        assert found.ok
        assert [item.key for item in found.assumptions] == [
            "excited", "detectable", "performance", "stabilisable", "D12", "D21", "P12", "P21",
        ]  # fmt: skip
        assert repr(found).splitlines()[0] == "<AssumptionReport: all hold>"


# a force or sensor along a line y = L/2 leaves out the rotation rx about it, and so on
CASES = [
    ("excited", {"w": noises(MIDDLE)}, "w does not excite the rigid-body rotation rx"),
    ("excited", {"w": noises([CENTRE])}, "rotation rx and rotation ry"),
    ("excited", {"w": noises([CENTRE], direction="rx")}, "translation z and rotation ry"),
    ("excited", {"asd": 0.0, "w": []}, "translation z and rotation rx and rotation ry"),
    ("detectable", {"y": sensors(MIDDLE)}, "y does not see the rigid-body rotation rx"),
    ("detectable", {"y": sensors([(p[1], p[0], 0.0) for p in MIDDLE])}, "rigid-body rotation ry"),
    # a skew line through the centre: rotation about it, two parts of rx to one of ry
    (
        "detectable",
        {"y": sensors([(0.1, 0.2, 0.0), CENTRE, (0.5, 0.4, 0.0)])},
        "rotation rx and rotation ry",
    ),
    ("detectable", {"y": sensors([CENTRE])}, "rotation rx and rotation ry"),
    ("detectable", {"y": sensors(CORNERS, direction="rx")}, "translation z and rotation ry"),
    (
        "performance",
        {"z": [Poi("die", at=CENTRE)]},
        "z does not see the rigid-body rotation rx and rotation ry",
    ),
    ("performance", {"z": [Poi("die", at=CENTRE, axes=("z", "rx"))]}, "rigid-body rotation ry"),
    (
        "stabilisable",
        {"u": [Actuator(f"u{i}", at=p) for i, p in enumerate(MIDDLE)]},
        "u does not reach the rigid-body rotation rx",
    ),
]


@pytest.mark.parametrize("model", [some_modes(), reduced()], ids=["modes", "reduced"])
@pytest.mark.parametrize(("key", "changes", "words"), CASES)
def test_what_is_missing_is_named(key, changes, words, model):
    found = assemble_plant(model, ports(**changes)).check()
    item = found[key]
    assert not item.holds
    assert not found.ok
    text = item.finding
    for word in words.split(" and "):
        assert word in text
    for motion in ("translation z", "rotation rx", "rotation ry", "translation x", "rotation rz"):
        assert (motion in text) == (motion in words)
    assert item.remedy
    assert "NOT all hold" in repr(found)
    assert f"NO  {key}" in repr(found)
    others = {"excited", "detectable", "performance", "stabilisable"} - {key}
    assert all(found[other].holds for other in others)


def test_velocities_do_not_see_where_the_plate_is():
    found = report(y=sensors(CORNERS, quantity="velocity"))
    assert not found["detectable"].holds
    assert "displacement" in found["detectable"].remedy
    mixed = [*sensors(CORNERS[:2]), Sensor("v", at=CORNERS[2], quantity="velocity", asd=1e-9)]
    assert "rotation rx" in report(y=mixed)["detectable"].finding


def test_a_force_without_noise_excites_only_when_none_has():
    quiet = [*noises(MIDDLE), Disturbance("floor", at=INSET[0])]
    assert not report(w=quiet)["excited"].holds
    still = [Disturbance(f"d{i}", at=p) for i, p in enumerate(INSET)]
    assert not report(w=still)["excited"].holds  # the sensors have noise, no force has
    assert report(w=still, sensor_asd=0.0)["excited"].holds


def test_a_slight_offset_is_enough_in_any_units():
    near = [MIDDLE[0], MIDDLE[1], (0.5, L / 2 + 1e-4, 0.0)]
    assert report(y=sensors(near))["detectable"].holds
    assert report(asd=1e-30)["excited"].holds


def test_ranks():
    silent = report(y=[*ports().y[:3], Sensor("deaf", at=CORNERS[3])])
    assert not silent["D21"].holds
    assert "deaf is free of noise" in silent["D21"].finding
    plant = assemble_plant(some_modes(), ports())
    bare = plant.weighted(z={"u2:effort": None}).check()
    assert not bare["D12"].holds
    assert "u2 costs nothing in z" in bare["D12"].finding


def test_designs_refuse_in_the_same_words():
    plant = assemble_plant(some_modes(), ports(w=noises(MIDDLE))).discretized(RATE, delay=1)
    words = r"stationary Kalman filter is not possible.*rotation rx.*\(channels: d0, d1, d2\).*Add"
    with pytest.raises(AssumptionError, match=words):
        design_kalman(plant)
    plant = assemble_plant(some_modes(), ports(y=sensors(MIDDLE))).discretized(RATE, delay=1)
    with pytest.raises(AssumptionError, match=r"y does not see.*rotation rx.*displacement sensor"):
        design_kalman(plant)
    u = [Actuator(f"u{i}", at=p) for i, p in enumerate(MIDDLE)]
    plant = assemble_plant(some_modes(), ports(u=u)).discretized(RATE, delay=1)
    with pytest.raises(AssumptionError, match=r"u does not reach.*rotation rx.*actuator"):
        design_servo(plant, bandwidth=50.0)
    report().require(("excited", "detectable"), "anything")


@pytest.mark.parametrize("dt", [0.0, 0.1])
def test_plants_from_elsewhere_by_hautus(dt):
    marginal = 1.0 if dt else 0.0
    A = np.diag([marginal, 0.5 if dt else -0.5])
    B = np.array([[0.0, 1.0], [1.0, 1.0]])
    C = np.array([[1.0, 1.0], [1.0, 1.0]])
    g = StateSpace(A, B, C, np.zeros((2, 2)), dt, inputs=["w", "u"], outputs=["z", "y"])
    good = StandardPlant.from_statespace(g, u=["u"], y=["y"]).check()
    assert good["stabilisable"].holds
    assert good["detectable"].holds
    lost = g.replace(B=B * np.array([[1.0, 0.0], [1.0, 1.0]]))
    found = StandardPlant.from_statespace(lost, u=["u"], y=["y"]).check()
    assert not found["stabilisable"].holds
    assert "u does not reach the pole" in found["stabilisable"].finding
    blind = g.replace(C=C * np.array([[1.0, 1.0], [0.0, 1.0]]))
    found = StandardPlant.from_statespace(blind, u=["u"], y=["y"]).check()
    assert not found["detectable"].holds
    assert "y does not see the pole" in found["detectable"].finding


@pytest.mark.parametrize("seed", range(4))
def test_units_of_states_do_not_change_the_report_of_a_plant_from_elsewhere(seed):
    rng = np.random.default_rng(seed)
    g = assemble_plant(some_modes(), ports()).system
    asd = {name: 1e-3 for name in g.inputs if name.startswith("amp")}
    size = 10.0 ** rng.uniform(-6, 6, g.n_states)
    even = g.replace(blocks=None)
    moved = even.replace(A=g.A * size / size[:, None], B=g.B / size[:, None], C=g.C * size)
    for u, y in ((g.inputs[-4:], g.outputs[-5:]), (["u1"], ["y1"])):
        texts = [
            repr(StandardPlant.from_statespace(system, u=u, y=y, asd=asd).check())
            for system in (even, moved)
        ]
        assert texts[0] == texts[1]
        assert ("yes stabilisable" in texts[0]) == (len(u) == 4)
        assert ("yes detectable" in texts[0]) == (len(u) == 4)


def test_many_findings_are_three_and_a_number():
    plant = assemble_plant(some_modes(0.0), ports(u=[Actuator("u1", at=(0.3, 0.3, 0.0))]))
    found = plant.check()["stabilisable"]
    assert not found.holds
    assert re.search(r"; and \d+ more \(channels: u1\)", found.finding)
    assert len(found.finding) < 500
    with pytest.raises(AssumptionError) as caught:
        plant.check().require(("stabilisable", "detectable"), "this")
    assert len(str(caught.value)) < 2500


def test_missing_motions_are_told_apart():
    # no actuator at all but one that pushes nothing of rx and ry: each axis is said once
    plant = assemble_plant(some_modes(), ports(u=[Actuator("u1", at=(0.3, 0.3, 0.0))]))
    text = plant.check()["stabilisable"].finding
    assert "rotation rx and rotation ry" in text
    none = assemble_plant(some_modes(), ports(u=[]))
    text = none.check()["stabilisable"].finding
    assert "translation z and rotation rx and rotation ry" in text

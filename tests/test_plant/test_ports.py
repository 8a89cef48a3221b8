"""Ports: what they hold, how they are named, and what they refuse."""

import numpy as np
import pytest

from flexplant import load
from flexplant.errors import FlexplantError, LabelError, ModelError, ShapeError
from flexplant.lti import StateSpace
from flexplant.placement import place_both, place_sensors
from flexplant.plant import (
    Actuator,
    Disturbance,
    Poi,
    Ports,
    RandomWalk,
    Reference,
    RigidForce,
    Sensor,
    StandardPlant,
    assemble_plant,
)  # fmt: skip
from flexplant.structure import chain
from flexplant.testbeds import three_masses
from stages import ports

P = (0.1, 0.2, 0.0)


def test_defaults():
    assert Disturbance("d", at=P).asd == 0.0
    assert Disturbance("d", at=P).direction == "z"
    assert Sensor("y", at="3:z").quantity == "displacement"
    assert Poi("die", at=P).axes == ("z",)
    assert Poi("die", at=P, axes="rx").axes == ("rx",)
    assert Actuator("u", at=np.array(P)).at == P
    assert Actuator("u", at={"1:z": 1, "2:z": -1}).at == {"1:z": 1.0, "2:z": -1.0}


def test_places_are_copies():
    point = np.array(P)
    port = Actuator("u", at=point)
    point[0] = 9.0
    assert port.at == P


def test_names_of_channels():
    poi = Poi("die", at=P, axes=("z", "rx"))
    assert poi.channel("rx") == "die:rx"
    assert poi.derived("z", "hat") == "die:hat"
    assert poi.derived("rx", "hat") == "die:rx:hat"


def test_ports_take_one_of_a_kind_without_a_list():
    one = Ports(u=Actuator("u", at=P), y=Sensor("y", at=P))
    assert [port.name for port in one.forces] == ["u"]
    assert one.y[0].name == "y"
    assert ports().poi("die").axes == ("z", "rx", "ry")


def test_repr_tells_the_references():
    text = repr(Ports(z=[Poi("die", at=P)], references=[Reference("die")]))
    assert text == "<Ports z: die, references: die>"


def test_repr_is_one_line_of_names():
    assert repr(Ports(u=[Actuator("u", at=P)], z=[Poi("die", at=P)])) == "<Ports u: u, z: die>"


def test_saves_and_loads(tmp_path):
    ports().save(tmp_path / "p.npz")
    again = load(tmp_path / "p.npz")
    assert repr(again) == repr(ports())
    assert [tuple(s.at) for s in again.y] == [tuple(s.at) for s in ports().y]
    assert again.y[0].asd == ports().y[0].asd


KINDS = (Disturbance, Actuator, Sensor, Poi)


@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.parametrize(
    ("at", "error", "words"),
    [
        ((0.1, 0.2), ShapeError, r"place of 'p' must have shape \(3,\), got \(2,\)"),
        ((0.1, np.nan, 0.0), ModelError, "place of 'p' has a NaN"),
        ((0.1, 1j, 0.0), ModelError, "must be real"),
        ((0.1, "x", 0.0), ModelError, "must hold numbers"),
        (None, ModelError, "must hold numbers, got None"),
        ({}, LabelError, "empty mapping: name at least one DOF"),
        ({"1:z": np.nan}, ModelError, "weight of '1:z'.*NaN"),
        ({"1:z": "much"}, ModelError, "weight of '1:z'.*must be one number"),
    ],
)
def test_bad_places(kind, at, error, words):
    with pytest.raises(error, match=words):
        kind("p", at=at)


@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.parametrize("name", ["", "a.b", "-a"])
def test_bad_names(kind, name):
    with pytest.raises(LabelError, match="Rename"):
        kind(name, at=P)


def test_bad_directions_and_quantities():
    for kind in (Disturbance, Actuator, Sensor):
        with pytest.raises(LabelError, match=r"no direction of 'p' 'up'.*Known are: 'x'"):
            kind("p", at=P, direction="up")
    with pytest.raises(LabelError, match=r"no axis of POI 'p' 'rz2'.*Close matches: 'rz'"):
        Poi("p", at=P, axes=("z", "rz2"))
    with pytest.raises(LabelError, match=r"no quantity of 'p' 'speed'.*'velocity'"):
        Sensor("p", at=P, quantity="speed")
    with pytest.raises(LabelError, match="more than once"):
        Poi("p", at=P, axes=("z", "z"))
    with pytest.raises(LabelError, match="combination of DOFs, so it has one axis"):
        Poi("p", at={"1:z": 0.5, "2:z": 0.5}, axes=("z", "rx"))
    with pytest.raises(LabelError, match=r"'2:-x' has a direction with a sign.*at=\{'2:x': -1.0\}"):
        Poi("p", at="2:-x")


@pytest.mark.parametrize("kind", [Disturbance, Sensor])
@pytest.mark.parametrize("asd", [-1.0, np.nan, np.inf, "loud", [1.0, 2.0]])
def test_bad_densities(kind, asd):
    with pytest.raises((ModelError, ShapeError), match="asd of 'p'"):
        kind("p", at=P, asd=asd)


def test_ports_refuse_strangers_and_doubles():
    u, y, die = Actuator("u", at=P), Sensor("y", at=P), Poi("die", at=P)
    with pytest.raises(ModelError, match=r"Ports.u holds Actuators, got Sensor"):
        Ports(u=[y])
    with pytest.raises(ModelError, match=r"Ports.references holds References, got str"):
        Ports(z=[die], references=["die"])
    with pytest.raises(ModelError, match=r"Ports.z must be a sequence of Pois, got 'die'.*z=\["):
        Ports(z="die")
    with pytest.raises(LabelError, match=r"inputs w and u hold \['u'\] more than once"):
        Ports(w=[Disturbance("u", at=P)], u=[u])
    with pytest.raises(LabelError, match=r"ports w and y hold \['y'\] more than once"):
        Ports(y=[y, y])
    with pytest.raises(LabelError, match="POIs hold"):
        Ports(z=[die, die])
    with pytest.raises(LabelError, match="references hold"):
        Ports(z=[die], references=[Reference("die"), Reference("die")])
    with pytest.raises(LabelError, match=r"no POI 'dye'.*'die'"):
        Ports(z=[die], references=[Reference("dye")])
    with pytest.raises(LabelError, match="no POI 'dye'"):
        ports().poi("dye")


@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.parametrize("ending", ["hat", "ref", "error", "effort", "noise"])
def test_names_of_derived_channels_are_reserved(kind, ending):
    # Actuator("die:hat") would be driven by the observer's estimate: a wrong loop, closed
    with pytest.raises(LabelError, match=rf"'die:{ending}'.*make themselves.*'die_{ending}'"):
        kind(f"die:{ending}", at=P)
    with pytest.raises(LabelError, match=rf"'die:rx:{ending}'"):
        kind(f"die:rx:{ending}", at=P)
    assert kind(ending, at=P).name == ending
    assert kind("left:u", at=P).name == "left:u"


@pytest.mark.parametrize(
    ("make", "words"),
    [
        (lambda: Actuator(3, at=P), "named by a string, got 3"),
        (lambda: Actuator("u", at=P, direction=2), "no direction of 'u' 2"),
        (lambda: Sensor("y", at=P, direction=["z"]), "no direction of 'y'"),
        (lambda: Poi("p", at=P, axes=3), r"axes of POI 'p' are chosen by name, got 3"),
        (lambda: Reference(Poi("p", at=P)), r"of type str, got Poi.*Reference\('die'\)"),
        (lambda: RigidForce("f", shape=RandomWalk(1.0)), r"is a filter, got RandomWalk, wh"),
        (lambda: Ports(u=5), r"Ports.u must be a sequence of Actuators, got 5.*u=\["),
        (lambda: Ports(u=[Sensor("y", at=P)]), r"got Sensor. It belongs in y"),
        (lambda: Sensor("y", at=P, asd=True), "asd of 'y' must be one number"),
        (lambda: Actuator("u", at=P, latency="1 ms"), "latency of 'u'"),
        (lambda: Sensor("y", at="1:z", direction="rx"), r"its own direction, 'z'.*at='1:rx'"),
        (lambda: Sensor("y", at=["1:z", "2:z"]), r"a port for each.*a mapping, \{"),
    ],
)
def test_other_kinds_are_refused_at_the_door(make, words):
    with pytest.raises(FlexplantError, match=words):
        make()


def test_the_axes_of_a_poi_replace_the_direction_of_its_label():
    two = chain(masses=[1.0, 1.0], stiffnesses=[1e3])
    poi = Poi("die", at="2:x", axes=("z",))
    with pytest.raises(LabelError, match=r"at '2:x' with the axes \('z',\), .* no DOF '2:z'"):
        assemble_plant(two, Ports(w=[Disturbance("d", at="1:x")], z=[poi]))


@pytest.mark.parametrize(
    ("at", "axis"),
    [
        ("2:x", "x"),
        ("2:rz", "rz"),
        ((0.1, 0.2, 0.0), "z"),
        ({"2:x": 1.0, "1:x": -1.0, "1:ry": -0.2}, "x"),
        ({"1:ry": -0.2, "2:y": 1.0}, "y"),
        ({"2:rx": 1.0, "1:rx": -1.0}, "rx"),
        ({(0.1, 0.0, 0.0): 0.5, (0.2, 0.0, 0.0): 0.5}, "z"),
    ],
)
def test_a_poi_without_axes_is_named_by_the_direction_of_its_place(at, axis):
    poi = Poi("tool", at=at)
    assert tuple(poi.axes) == (axis,)
    assert poi.channel(axis) == f"tool:{axis}"


def test_an_actuator_and_a_sensor_of_one_name_are_refused_where_the_plant_is_made():
    """Filters and loops connect by name: they failed later, and said less."""
    plant = three_masses()
    own = plant.assembled.ports
    alike = [own.y[0].replace(name="u1"), own.y[1]]
    g = plant.Gyu.renamed(outputs={"y1": "u1"})
    swap = StateSpace(
        [], np.zeros((0, 1)), np.zeros((1, 0)), [[1.0]], inputs=["y1"], outputs=["u1"]
    )
    ways = [
        lambda: assemble_plant(plant.assembled.realisation, own.replace(y=alike)),
        lambda: plant.with_ports(own.replace(y=alike)),
        lambda: plant.through(swap),
        lambda: StandardPlant.from_statespace(g, u=["u1"], y=["u1", "y2"]),
        lambda: place_sensors(plant, alike, 1),
        lambda: place_both(plant, alike, ["u1"], (1, 1)),
    ]
    for way in ways:
        with pytest.raises(LabelError, match=r"\['u1'\] are names in u and in y"):
            way()

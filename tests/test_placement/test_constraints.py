"""Constraints are satisfied by every search, which finds the best choice that satisfies them."""

from itertools import combinations

import numpy as np
import pytest

import flexplant as fx
from flexplant import load
from flexplant.errors import InfeasibleError, LabelError, ModelError
from flexplant.placement import (
    BranchAndBound,
    Budget,
    CountLimits,
    Disc,
    Exchange,
    Excluded,
    Exhaustive,
    JointGroups,
    MinimumDistance,
    OffPoi,
    PoiLqr,
    PoiVariance,
    Rectangle,
    ZoneLimits,
    place_actuators,
    place_sensors,
    sensor_map,
)
from flexplant.placement.problem import layouts_of
from flexplant.plant import Poi, Sensor

GRID = [(x, y, 0.0) for x in (0.0, 0.2, 0.3, 0.5) for y in (0.0, 0.175, 0.35)]
COSTS = {0: 5.0, 2: 4.0, 9: 3.0, 11: 3.0}

XY = np.array(GRID)[:, :2]


#: a constraint and the same in words of Python, over sets of indices
CASES = {
    "excluded": (
        Excluded([Disc((0.5, 0.35), 0.1), Rectangle((-0.1, -0.1), (0.1, 0.1))]),
        lambda s: not s & {0, 11},
    ),
    "off the die": (OffPoi(0.16), lambda s: all(np.hypot(*(XY[i] - (0.2, 0.0))) > 0.16 for i in s)),
    "within": (ZoneLimits(Rectangle((-1, -1), (0.45, 1))), lambda s: not s & {9, 10, 11}),
    "few in a zone": (
        ZoneLimits([Disc((0, 0), 0.01), Disc((0.5, 0), 0.01)], at_most=1, at_least=1),
        lambda s: len(s & {0, 9}) == 1,
    ),
    "apart": (
        MinimumDistance(0.25),
        lambda s: all(np.hypot(*(XY[i] - XY[j])) >= 0.25 for i, j in combinations(s, 2)),
    ),
    "together": (
        JointGroups([("c0", "c11"), ("c2", "c9", "c5")]),
        lambda s: len(s & {0, 11}) != 1 and len(s & {2, 9, 5}) in (0, 3),
    ),
    "one type at a place": (
        CountLimits(["c0", "c1", "c2"], at_most=1),
        lambda s: len(s & {0, 1, 2}) <= 1,
    ),
    "budget": (
        Budget(7.0, {f"c{i}": cost for i, cost in COSTS.items()}),
        lambda s: sum(COSTS.get(i, 1.0) for i in s) <= 7.0,
    ),
}


@pytest.fixture(scope="module")
def machine(make):
    """A plant whose die is on a place of the grid, in the middle of nothing else."""
    plant, sensors, actuators = make(41, count=12)
    die = Poi("die", at=GRID[3], axes=("z", "rx", "ry"))
    plant = plant.with_ports(plant.assembled.ports.replace(z=[die]))
    on_grid = [
        [p.replace(name=f"c{i}", at=GRID[i]) for i, p in enumerate(ports)]
        for ports in (sensors, actuators)
    ]
    return plant, *on_grid


@pytest.mark.slow
@pytest.mark.parametrize(
    ("kind", "side"), [*((kind, "y") for kind in CASES), ("apart", "u"), ("budget", "u")]
)
def test_every_search_finds_the_best_that_satisfies(machine, monkeypatch, kind, side):
    for name, few in (("_SCREENED", 30), ("_SCORED", 5)):
        monkeypatch.setattr(f"flexplant.placement.branch_and_bound.{name}", few)
    plant, sensors, actuators = machine
    candidates = sensors if side == "y" else actuators
    place = place_sensors if side == "y" else place_actuators
    criterion = PoiVariance("die") if side == "y" else PoiLqr("die", effort=1e-8)
    constraint, satisfied = CASES[kind]
    sets = [s for s in combinations(range(12), 4) if satisfied(set(s))]
    if side == "y":  # a sensor on the die is excluded without a word
        sets = [s for s in sets if 3 not in s]
    values = layouts_of(plant, side, candidates, criterion).score(sets)
    best = tuple(f"c{i}" for i in sets[int(np.argmin(values))])
    for method in (Exhaustive(), Exchange(starts=4), BranchAndBound(starts=1)):
        found = place(
            plant, candidates, 4, criterion, constraints=[constraint], method=method, rng=2
        )
        assert found.chosen == best, method
        assert found.value == pytest.approx(values.min(), rel=1e-9, abs=0.0)
        assert found.bound <= values.min()
        assert found.proven or isinstance(method, Exchange)
        if isinstance(method, Exhaustive):
            assert found.evaluations == len(sets)


@pytest.mark.slow
def test_several_at_once_and_required(machine):
    plant, sensors, _ = machine
    given = [CASES["together"][0], CASES["excluded"][0], OffPoi(-1)]
    found = place_sensors(plant, sensors, 4, required=["c3"], constraints=given)
    every = [
        s
        for s in combinations(range(12), 4)
        if 3 in s and CASES["together"][1](set(s)) and not set(s) & {0, 11}
    ]
    assert "c3" in found.chosen
    assert found.evaluations == len(every)
    with pytest.raises(InfeasibleError, match=r"satisfies the constraints OffPoi\(radius=0.0\) "):
        place_sensors(plant, sensors, 4, required=["c3"])
    with pytest.raises(InfeasibleError, match=r"MinimumDistance.*Relax one"):
        place_sensors(plant, sensors, 4, constraints=[MinimumDistance(0.5)])
    # three in a row are apart and cheap, but miss a rotation
    row = [ZoneLimits(Rectangle((-1, -0.1), (1, 0.1)))]
    with pytest.raises(InfeasibleError, match="rigid-body"):
        place_sensors(plant, sensors, 3, constraints=[*row, OffPoi(-1)])


@pytest.mark.slow
def test_places_of_ports_with_several_points(machine):
    """A differential sensor is where each of its points is."""
    plant, sensors, _ = machine
    across = Sensor("across", at={GRID[0]: 1.0, GRID[11]: -1.0}, asd=1e-14)
    given = [*sensors[:6], across]
    free = place_sensors(plant, given, 4)
    assert "across" in free.chosen
    shut = place_sensors(plant, given, 4, constraints=[Excluded(Disc((0.5, 0.35), 0.01))])
    assert "across" not in shut.chosen
    near = place_sensors(plant, given, 4, constraints=[MinimumDistance(1e-3)])
    assert not {"across", "c0"} <= set(near.chosen)


@pytest.mark.slow
def test_several_types_of_devices_at_one_place(machine):
    """A cheap encoder, a good one and a velocity sensor at each place: one of them at most."""
    plant, sensors, _ = machine
    places = [GRID[i] for i in (0, 2, 9, 11, 4)]
    types = {"cheap": (3e-10, 0), "good": (1e-11, 0), "speed": (1e-8, 1)}
    given = [
        Sensor(f"{kind}{i}", at=p, asd=asd, quantity=("displacement", "velocity")[order])
        for kind, (asd, order) in types.items()
        for i, p in enumerate(places)
    ]
    one_each = [CountLimits([f"{kind}{i}" for kind in types], at_most=1) for i in range(5)]
    few_good = CountLimits([f"good{i}" for i in range(5)], at_most=2)
    price = {p.name: {"c": 1.0, "g": 5.0, "s": 2.0}[p.name[0]] for p in given}
    limits = [*one_each, few_good, Budget(13.0, price)]
    search = Exchange(starts=4)
    found = place_sensors(plant, given, 4, constraints=limits, method=search, rng=0)
    assert len({name[-1] for name in found.chosen}) == 4
    assert sum(name.startswith("good") for name in found.chosen) == 2
    assert sum(price[name] for name in found.chosen) <= 13.0
    free = place_sensors(plant, given, 4, method=search, rng=0)
    assert free.value < found.value and found.bound <= found.value
    # all axes of a unit at one place, or none
    unit = [
        Sensor(f"u{i}{axis}", at=GRID[i], direction=axis, asd=1e-9)
        for i in (0, 11)
        for axis in ("z", "rx")
    ]
    groups = JointGroups([("u0z", "u0rx"), ("u11z", "u11rx")])
    both = place_sensors(
        plant, [*sensors[:3], *unit], 4, constraints=[groups], method=search, rng=0
    )
    assert sum(name.startswith("u0") for name in both.chosen) in (0, 2)


@pytest.mark.slow
def test_no_sensor_of_a_map_is_on_the_die(machine):
    plant, sensors, _ = machine
    plant = plant.with_ports(plant.assembled.ports.replace(y=[sensors[i] for i in (0, 2, 9)]))
    found = sensor_map(plant, GRID, asd=1e-11)
    assert len(found.points) == 11
    assert not np.any(np.all(found.points == GRID[3], axis=1))
    assert len(sensor_map(plant, GRID, asd=1e-11, constraints=[OffPoi(-1)]).points) == 12
    wide = sensor_map(plant, GRID, asd=1e-11, constraints=[OffPoi(0.16)])
    assert len(wide.points) == 10
    assert wide.excluded[0].radius == 0.16
    # one more, 0.25 m from those that are there, and not where they are
    apart = sensor_map(plant, GRID, asd=1e-11, constraints=[MinimumDistance(0.25)])
    own = np.array([GRID[i] for i in (0, 2, 9)])
    assert all(np.min(np.linalg.norm(own - p, axis=1)) >= 0.25 for p in apart.points)
    assert len(apart.points) > 2


@pytest.mark.slow
def test_constraints_are_values_and_refuse_what_they_are_not(machine, tmp_path):
    plant, sensors, _ = machine
    for i, (constraint, _) in enumerate(CASES.values()):
        constraint.save(tmp_path / f"{i}.npz")
        assert repr(load(tmp_path / f"{i}.npz")) == repr(constraint)
    with pytest.raises(ModelError, match="a Rectangle or a Disc, got"):
        Excluded([(0.3, 0.3)])
    with pytest.raises(ModelError, match="at_least 3 is above at_most 2"):
        ZoneLimits(Disc((0, 0), 1), at_least=3, at_most=2)
    with pytest.raises(ModelError, match="distance must be positive"):
        MinimumDistance(0.0)
    with pytest.raises(LabelError, match="fewer than two"):
        JointGroups([("a",)])
    with pytest.raises(LabelError, match="candidate of a group 'a'"):
        place_sensors(plant, sensors, 4, constraints=[JointGroups([("a", "c1")])])
    with pytest.raises(LabelError, match="candidate among others 'a'"):
        place_sensors(plant, sensors, 4, constraints=[CountLimits(["a"], at_most=1)])
    with pytest.raises(LabelError, match="candidate with a cost 'a'"):
        place_sensors(plant, sensors, 4, constraints=[Budget(1.0, {"a": 2.0})])
    for bad in ("none", [3], Disc((0, 0), 1), 3.0):
        with pytest.raises(ModelError, match="constraint"):
            place_sensors(plant, sensors, 4, constraints=bad)


@pytest.mark.parametrize("sign", [1, -1])
def test_a_relative_poi_shares_its_frame_with_sensors_whichever_sign_it_has(sign):
    chain = fx.chain(
        masses=[5.0, 1.0, 1.0, 1.0], stiffnesses=[4e5, 3e5, 2e5], ground=[1e5, 0, 0, 0]
    )
    modes = fx.solve_modes(chain, count=4, damping=fx.ModalDamping(0.01))

    def place(at):
        ports = fx.Ports(
            w=[fx.Disturbance("d", at="1:x", asd=1.0)],
            u=[fx.Actuator("u", at="2:x")],
            z=[fx.Poi("tip", at={"4:x": sign, "1:x": -sign})],
            y=[fx.Sensor("y", at={"2:x": sign, "1:x": -sign}, asd=1e-9)],
        )
        plant = fx.assemble_plant(modes, ports).discretized(1000.0)
        return place_sensors(plant, [fx.Sensor("c", at=at, asd=1e-9)], 1, progress=False).chosen

    assert place("1:x") == place({"3:x": sign, "1:x": -sign}) == ("c",)
    for on_tip in ({"4:x": sign, "1:x": -sign}, {"4:x": sign, "3:x": -sign}):
        with pytest.raises(InfeasibleError, match="OffPoi"):
            place(on_tip)

"""Sensors stay off POIs of any kind, relative ones too, and a refusal names who removed which."""

import numpy as np
import pytest

import flexplant as fx
from flexplant.errors import InfeasibleError
from flexplant.placement import MinimumDistance, OffPoi, place_sensors


def grounded(rng):
    """Return n masses in the plane, each on a spring to the ground, coupled at random."""
    n = int(rng.integers(3, 7))
    K = np.diag(rng.uniform(1e5, 1e6, n))
    for i, j in rng.integers(0, n, (2 * n, 2)):
        if i != j:
            k = rng.uniform(1e4, 1e6)
            K[[i, j], [i, j]] += k
            K[i, j] -= k
            K[j, i] -= k
    xyz = np.column_stack([rng.permutation(n), rng.uniform(0, 1, n), np.zeros(n)])
    nodes = rng.permutation(100)[:n] + 1
    dofs = fx.DofSet(nodes, ["x"] * n, xyz)
    return fx.FEModel(np.diag(rng.uniform(0.5, 5.0, n)), K, dofs=dofs), nodes


def place(rng, nodes):
    """Return a mass, or one against another, as a port's place, its nodes, and where it is."""
    a, b = rng.choice(nodes, 2, replace=False).tolist()
    if rng.uniform() < 0.4:
        return f"{a}:x", {a}, {a}
    if rng.uniform() < 0.5:
        return {f"{a}:x": 1.0, f"{b}:x": -1.0}, {a, b}, {a}
    return {f"{a}:x": -1.0, f"{b}:x": 1.0}, {a, b}, {b}


def problem(seed, *, own=True):
    """Return a plant, candidates, and the names of those that it has or with no end on the POI."""
    rng = np.random.default_rng(seed)
    model, nodes = grounded(rng)
    poi, _, on = place(rng, nodes)
    listed = [place(rng, nodes) for _ in range(int(rng.integers(2, 7)))]
    sensors = [fx.Sensor(f"s{i}", at=at, asd=1e-9) for i, (at, _, _) in enumerate(listed)]
    ports = fx.Ports(
        w=[fx.Disturbance("shake", at=f"{nodes[0]}:x", asd=1.0)],
        u=[fx.Actuator("u", at=f"{nodes[-1]}:x")],
        z=[fx.Poi("die", at=poi, axes=("x",))],
        y=sensors if own else (),
    )
    modes = fx.solve_modes(model, count=len(nodes), damping=fx.ModalDamping(0.02))
    plant = fx.assemble_plant(modes, ports).discretized(5e3)
    # what is measured already can be measured
    off = [f"s{i}" for i, (_, ends, _) in enumerate(listed) if own or not ends & on]
    return rng, plant, sensors, off


@pytest.mark.parametrize("seed", range(40))
def test_a_choice_exists_exactly_where_enough_sensors_are_off_the_poi(seed):
    rng, plant, sensors, off = problem(seed, own=bool(seed % 2))
    names = [one.name for one in sensors]
    count = int(rng.integers(1, len(names) + 1))
    required = rng.choice(names, int(rng.integers(0, count + 1)), replace=False).tolist()
    if len(off) >= count and set(required) <= set(off):
        found = place_sensors(plant, sensors, count, required=required)
        assert set(required) <= set(found.chosen) <= set(off)
        assert len(found.chosen) == count
        return
    with pytest.raises(InfeasibleError) as refusal:
        place_sensors(plant, sensors, count, required=required)
    removed = [name for name in names if name not in off]
    assert f"OffPoi(radius=0.0) (removes {', '.join(removed)})" in str(refusal.value)
    anywhere = place_sensors(plant, sensors, count, required=required, constraints=[OffPoi(-1)])
    assert set(required) <= set(anywhere.chosen)


@pytest.mark.parametrize("seed", range(20))
def test_the_sign_of_a_sensor_changes_nothing(seed):
    _, plant, sensors, off = problem(seed, own=False)
    if not off:
        return
    sums = [{one.at: 1.0} if isinstance(one.at, str) else one.at for one in sensors]
    turned = [
        one.replace(at={label: -weight for label, weight in at.items()})
        for one, at in zip(sensors, sums, strict=True)
    ]
    first, second = (place_sensors(plant, each, 1) for each in (sensors, turned))
    assert set(first.chosen) | set(second.chosen) <= set(off)
    assert second.value == pytest.approx(first.value, rel=1e-9, abs=0)


def test_sensors_against_one_body_are_apart():
    rng = np.random.default_rng(3)
    model, nodes = grounded(rng)
    frame = f"{nodes[0]}:x"
    sensors = [
        fx.Sensor(f"s{i}", at={f"{n}:x": 1.0, frame: -1.0}, asd=1e-9)
        for i, n in enumerate(nodes[1:3])
    ]
    onto = fx.Sensor("onto", at={frame: 1.0, f"{nodes[1]}:x": -1.0}, asd=1e-9)
    ports = fx.Ports(
        w=[fx.Disturbance("shake", at=frame, asd=1.0)],
        u=[fx.Actuator("u", at=frame)],
        z=[fx.Poi("die", at=f"{nodes[-1]}:x" if len(nodes) > 3 else frame, axes=("x",))],
        y=sensors,
    )
    modes = fx.solve_modes(model, count=len(nodes), damping=fx.ModalDamping(0.02))
    plant = fx.assemble_plant(modes, ports).discretized(5e3)
    apart = [MinimumDistance(0.1), OffPoi(-1)]
    assert place_sensors(plant, sensors, 2, constraints=apart).chosen == ("s0", "s1")
    with pytest.raises(InfeasibleError, match="MinimumDistance"):
        place_sensors(plant, [sensors[0], onto], 2, constraints=apart)

"""Each criterion decides differently from its neighbours somewhere, and is what it says there."""

from functools import cache
from itertools import combinations

import numpy as np
import pytest

import flexplant as fx
from flexplant import DofSet
from flexplant.errors import AssumptionError, ModelError
from flexplant.estimation import FixedLag, Predictor, Smoother, design_kalman
from flexplant.modes import solve_modes
from flexplant.placement import (
    ClosedLoopH2,
    DeviceLoss,
    Exchange,
    LeftOutModes,
    ModalControllability,
    ModalObservability,
    OffPoi,
    OverMachines,
    PoiLqr,
    PoiVariance,
    place_actuators,
    place_sensors,
    score_sensors,
)
from flexplant.placement.problem import layouts_of
from flexplant.plant import Actuator, Disturbance, Poi, Ports, Reference, Sensor, assemble_plant
from flexplant.structure import FEModel, ModalDamping
from placement_plate import plate_modes

ALL = {"z": 1.0, "rx": 0.05, "ry": 0.05}
WHOLE, PLATE = plate_modes(14), plate_modes(None)
OWN = PoiVariance("die", own_modes=True)

#: (seed of a machine, criterion, its neighbour)
SENSORS = {
    "axis": (41, PoiVariance("die"), PoiVariance("die", "rx")),
    "sum or largest": (48, PoiVariance("die", ALL), PoiVariance("die", ALL, measure="max")),
    "predictor": (48, PoiVariance("die"), PoiVariance("die", lag=Predictor())),
    "lag": (48, PoiVariance("die"), PoiVariance("die", lag=FixedLag(20))),
    "predictor or lag": (
        48,
        PoiVariance("die", lag=Predictor()),
        PoiVariance("die", lag=FixedLag(20)),
    ),
    "loss": (48, PoiVariance("die"), DeviceLoss(PoiVariance("die"))),
    "mean loss": (
        48,
        DeviceLoss(PoiVariance("die"), measure="mean"),
        DeviceLoss(PoiVariance("die")),
    ),
    "loop": (41, PoiVariance("die", ALL), ClosedLoopH2("die", effort=1e-8)),
    "trace": (41, ModalObservability("trace"), ModalObservability("log det")),
    "least": (41, ModalObservability("least"), ModalObservability("log det")),
    "left out": (41, LeftOutModes(), ModalObservability("trace")),
}
ACTUATORS = {
    "left out": (41, LeftOutModes(of="actuators"), ModalControllability("trace")),
    "loop": (41, PoiLqr("die", effort=1e-8), ClosedLoopH2("die", effort=1e-8)),
    "trace": (41, ModalControllability("trace"), ModalControllability("log det")),
}


@cache
def best_of(make, seed, side, criterion):
    """Return the best four of nine by scores of every set; each value is that of the plant."""
    plant, sensors, actuators = make(seed)
    candidates = sensors if side == "y" else actuators
    if "LeftOutModes" in f"{criterion!r}":
        plant = plant.replace(evaluation=WHOLE)
    layouts = layouts_of(plant, side, candidates, criterion)
    sets = list(combinations(range(9), 4))
    values = layouts.score(sets)
    assert np.count_nonzero(np.isfinite(values)) > 100
    for i in (int(np.argmin(values)), 77):
        layouts.confirm(sets[i], values[i])
    bound = layouts.scorer.bound(4, ())
    assert bound <= values.min()
    return sets[int(np.argmin(values))]


@pytest.mark.slow
@pytest.mark.parametrize("name", SENSORS)
def test_sensors(make, name):
    seed, one, other = SENSORS[name]
    assert best_of(make, seed, "y", one) != best_of(make, seed, "y", other)


@pytest.mark.slow
@pytest.mark.parametrize("name", ACTUATORS)
def test_actuators(make, name):
    seed, one, other = ACTUATORS[name]
    assert best_of(make, seed, "u", one) != best_of(make, seed, "u", other)


@pytest.mark.slow
def test_several_pois_are_summed_with_their_weights(make):
    plant, sensors, _ = make(48)
    lens = Poi("lens", at=(0.02, 0.02, 0.0), axes=("z",))
    two = plant.with_ports(plant.assembled.ports.replace(z=[*plant.assembled.ports.z, lens]))
    die, far = (PoiVariance(name, "z")(two) for name in ("die", "lens"))
    both = PoiVariance({"die": 2.0, "lens": 1.0}, "z")
    assert both(two) == pytest.approx(4 * die + far, rel=1e-9, abs=0.0)
    largest = PoiVariance(("die", "lens"), measure="max")
    assert largest(two) == pytest.approx(max(die, far), rel=1e-9, abs=0.0)
    assert "nrad rms" in repr(place_sensors(two, sensors, 4, PoiVariance("die", "rx")))
    chosen = {
        key: place_sensors(two, sensors, 4, criterion).chosen
        for key, criterion in (("die", PoiVariance("die")), ("lens", PoiVariance("lens")))
    }
    together = place_sensors(two, sensors, 4, both)
    assert chosen["die"] != chosen["lens"]
    assert together.value <= both(together.on(two)) * (1 + 1e-9)
    found = place_sensors(two, sensors, 4, largest, method=Exchange(starts=3), rng=0)
    assert 0 < found.bound <= found.value


@pytest.mark.parametrize(("lag", "row"), [(Predictor(), "predictor"), (FixedLag(4), "1 ms")])
def test_predictor_and_lag_are_those_of_the_report(make, lag, row):
    """The report follows from the smoother's recursion; the rate is 4 kHz."""
    plant, _, _ = make(44)
    value = PoiVariance("die", lag=lag)(plant)
    report = design_kalman(plant).report(lags=[1e-3])
    assert np.sqrt(value) == pytest.approx(report[row][0], rel=1e-6, abs=0.0)
    with pytest.raises(ModelError, match="lag must be"):
        PoiVariance("die", lag=Smoother())


@pytest.mark.long
def test_over_machines(make):
    """Machines of other frequencies: the mean and the worst are those of single plants."""
    plant, sensors, _ = make(45)
    machines = [make(45, thickness=t)[0] for t in (0.014, 0.026)]
    names = [[s.name for s in sensors[i : i + 4]] for i in range(5)]
    each = []
    for machine in machines:
        found = score_sensors(machine, names, PoiVariance("die"), candidates=sensors)
        each.append(found.values[np.argsort(found.order)])
    for measure, of in (("worst", np.max), ("mean", np.mean)):
        criterion = OverMachines(PoiVariance("die"), machines, measure=measure)
        found = score_sensors(plant, names, criterion, candidates=sensors)
        np.testing.assert_allclose(found.values[np.argsort(found.order)], of(each, axis=0), rtol=0)
        best = place_sensors(plant, sensors, 4, criterion, method=Exchange(), rng=1)
        proven = place_sensors(plant, sensors, 4, criterion)
        assert best.chosen == proven.chosen
        assert 0 < best.bound <= proven.value
    # what is best for one machine is not best at worst
    alone = place_sensors(machines[0], sensors, 4, PoiVariance("die"))
    worst = OverMachines(PoiVariance("die"), machines)
    robust = place_sensors(plant, sensors, 4, worst)
    assert robust.value < 0.999 * worst(alone.on(plant))


@pytest.mark.slow
def test_after_the_loss_of_one_the_others_suffice(make):
    plant, sensors, actuators = make(48)
    layout = [s.name for s in sensors[:4]]
    found = score_sensors(plant, [layout], DeviceLoss(PoiVariance("die")), candidates=sensors)
    less = [list(part) for part in combinations(layout, 3)]
    singles = score_sensors(plant, less, PoiVariance("die"), candidates=sensors)
    assert found.values[0] == pytest.approx(singles.values[-1], rel=1e-9, abs=0.0)
    three = score_sensors(plant, [layout[:3]], DeviceLoss(PoiVariance("die")), candidates=sensors)
    assert np.isinf(three.values[0])
    lost = DeviceLoss(PoiLqr("die", effort=1e-8), of="actuators")
    best = place_actuators(plant, actuators, 4, lost)
    assert best.value > place_actuators(plant, actuators, 4, lost.criterion).value


def level_of(z, w, noise=1e-8):
    """Return a criterion of the user's: the least H-infinity norm with these weights."""

    def level(plant):
        weights = {"w": dict.fromkeys(plant.w) | w, "z": dict.fromkeys(plant.z) | z}
        weights["w"] |= {n: noise for n in plant.w if n.endswith(":noise")}
        weights["z"] |= {n: 1.0 for n in plant.z if n.endswith(":effort")}
        # a reference without weight is zero in y: D21 would lack rank
        read = [name for name in plant.y if weights["w"].get(name, 1.0) is not None]
        rows = fx.StateSpace([], [], [], np.eye(len(read)), plant.dt, inputs=read, outputs=read)
        return fx.design_hinf(plant.weighted(**weights).through(rows)).gamma

    return level


@pytest.mark.slow
def test_a_short_list_by_the_hinf_level():
    """A synthesis for each sensor of a chain: best beside the force, not where the POI is."""
    K = 1e6 * (2 * np.eye(5) - np.eye(5, k=1) - np.eye(5, k=-1))
    xyz = [(0.1 * i, 0.0, 0.0) for i in range(5)]
    model = FEModel(np.eye(5), K, dofs=DofSet(range(5), ["z"] * 5, xyz))
    ports = Ports(
        w=[Disturbance("f", at=xyz[0], asd=1e-3)],
        u=[Actuator("u", at=xyz[1])],
        z=[Poi("die", at=xyz[3])],
        y=[Sensor(f"s{i}", at=place, asd=1e-9) for i, place in enumerate(xyz)],
    )
    modes = solve_modes(model, count=5, damping=ModalDamping(0.02))
    plant = assemble_plant(modes, ports).discretized(5e3, delay=1)
    singles = [[f"s{i}"] for i in (0, 1, 3)]
    level = level_of({"die:z": 1e6}, {"f": 1.0})
    by_level = score_sensors(plant, singles, level)
    assert by_level.best == ("s0",)
    assert np.all(np.diff(by_level.values) > 0.01)
    assert score_sensors(plant, singles, PoiVariance()).best == ("s3",)
    # a reference that has no weight is no way to a lower level, and one that has is a task more
    followed = plant.with_ports(plant.assembled.ports.replace(references=[Reference("die")]))
    np.testing.assert_allclose(
        score_sensors(followed, singles, level).values, by_level.values, rtol=1e-3, atol=0.0
    )
    tracked = level_of({"die:error": 1e6}, {"f": 1.0, "die:ref": 1e-6})
    assert tracked(followed) > level(plant)
    # one rule for scores and places: the sensor on the POI is the plant's own and may stay there,
    # unless a radius keeps all sensors away
    kept = score_sensors(plant, singles, PoiVariance(), constraints=[OffPoi()])
    sensors = [plant.assembled.ports.y[i] for i in (0, 1, 3)]
    assert place_sensors(plant, sensors, 1, PoiVariance()).chosen == kept.best == ("s3",)
    away = [OffPoi(0.05)]
    off = score_sensors(plant, singles, PoiVariance(), constraints=away)
    assert off.layouts[2] == ("s3",)
    assert "OffPoi" in off.reasons[2]
    placed = place_sensors(plant, sensors, 1, PoiVariance(), constraints=away)
    assert placed.chosen == off.best == ("s1",)


def test_what_wrappers_refuse(make):
    plant, sensors, actuators = make(41)
    with pytest.raises(AssumptionError, match="no truncated modes"):
        place_sensors(plant, sensors, 4, LeftOutModes())
    with pytest.raises(ModelError, match="at least one plant"):
        OverMachines(PoiVariance("die"), [])
    with pytest.raises(ModelError, match="does not depend on actuators"):
        place_actuators(plant, actuators, 4, DeviceLoss(PoiVariance("die"), of="actuators"))
    mixed = [sensors[0].replace(asd=0.0), *sensors[1:]]
    with pytest.raises(AssumptionError, match="s0 have no noise"):
        place_sensors(plant, mixed, 4, ModalObservability())
    with pytest.raises(ModelError, match="must be a function"):
        DeviceLoss("die")

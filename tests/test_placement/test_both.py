"""Sensors and actuators together, the curve of what more devices buy, and the worth of each."""

from itertools import combinations

import numpy as np
import pytest

import flexplant as fx
from flexplant import DofSet, load
from flexplant.errors import AssumptionError, InfeasibleError, ModelError
from flexplant.lti import StateSpace
from flexplant.modes import solve_modes
from flexplant.placement import (
    BranchAndBound,
    ClosedLoopH2,
    Disc,
    Exchange,
    Excluded,
    Exhaustive,
    MinimumDistance,
    OffPoi,
    OverMachines,
    PoiLqr,
    PoiVariance,
    Screened,
    device_worth,
    pareto_curve,
    place_actuators,
    place_both,
    place_sensors,
    score_sensors,
)
from flexplant.plant import (
    Actuator,
    Disturbance,
    Poi,
    Ports,
    Reference,
    Sensor,
    StandardPlant,
    assemble_plant,
)
from flexplant.structure import FEModel, ModalDamping
from flexplant.synthesis import design_h2
from placement_plate import plate_modes

COST = ClosedLoopH2("die", effort=1e-8)


def lqg_plant(plant, criterion):
    """The plant whose H2 norm is the criterion: unit noises per sample, motions and efforts."""
    g = plant.system
    rows = g.C[: len(plant.z)][[plant.z.index(f"die:{axis}") for axis in ("z", "rx", "ry")]]
    noise, spread = plant.noise_factor, np.sqrt(plant.sensor_noise)
    nu, ny = plant.B2.shape[1], len(plant.C2)
    B = np.hstack([noise, np.zeros((g.n_states, ny)), plant.B2])
    C = np.vstack([rows, np.zeros((nu, g.n_states)), plant.C2])
    D = np.zeros((len(C), B.shape[1]))
    D[3 : 3 + nu, -nu:] = criterion.effort * np.eye(nu)
    D[-ny:, noise.shape[1] : noise.shape[1] + ny] = spread
    return StateSpace(
        g.A, B, C, D, dt=plant.dt,
        inputs=[*(f"w{i}" for i in range(noise.shape[1] + ny)), *plant.u],
        outputs=[*(f"z{i}" for i in range(3 + nu)), *plant.y],
    )  # fmt: skip


def test_the_cost_is_the_h2_norm_of_the_best_controller(make):
    plant, _, _ = make(44, delay=1.0)
    system = lqg_plant(plant, COST)
    found = design_h2(system, u=list(plant.u), y=list(plant.y)).gamma
    assert COST(plant) == pytest.approx(found**2, rel=1e-5, abs=0.0)
    # a reference is in y, and no sensor
    led = plant.with_ports(plant.assembled.ports.replace(references=[Reference("die")]))
    assert COST(led) == pytest.approx(COST(plant), rel=1e-9, abs=0.0)


@pytest.mark.slow
@pytest.mark.parametrize("delay", [0.0, 1.0, 2.0])
def test_pairs_equal_every_pair_and_the_bound_bounds(make, delay):
    plant, sensors, actuators = make(44, count=6, delay=delay)
    every = place_both(plant, sensors, actuators, (3, 3), COST, method=Exhaustive())
    assert every.evaluations == 400
    assert every.value == pytest.approx(COST(every.on(plant)), rel=1e-6, abs=0.0)
    found = place_both(plant, sensors, actuators, (3, 3), COST, method=Exchange(starts=4), rng=0)
    assert (found.sensors, found.actuators) == (every.sensors, every.actuators)
    assert 0.5 * every.value < found.bound <= every.value
    assert len(found.sensors) == len(found.actuators) == 3
    # the best sensors for the estimate and the best actuators for full information cost more
    first = place_sensors(plant, sensors, 3, PoiVariance("die"))
    second = place_actuators(plant, actuators, 3, PoiLqr("die", effort=1e-8))
    assert COST(second.on(first.on(plant))) >= every.value * (1 - 1e-9)
    apart = place_both(
        plant, sensors, actuators, (3, 3), COST, constraints=[MinimumDistance(0.05)], rng=0
    )
    points = np.array([port.at for port in apart.ports])
    gaps = np.linalg.norm(points[:, None] - points[None], axis=2) + np.eye(6)
    assert gaps.min() >= 0.05


@pytest.mark.slow
def test_one_side_of_the_loop_has_a_proof(make):
    """Beside given sensors (actuators) the cost is a convex one of the actuators (sensors)."""
    plant, sensors, actuators = make(44, count=8)
    for place, given in ((place_sensors, sensors), (place_actuators, actuators)):
        every = place(plant, given, 4, COST, method=Exhaustive())
        proven = place(plant, given, 4, COST, method=BranchAndBound(starts=1), rng=0)
        assert proven.proven and proven.chosen == every.chosen
        start = place(plant, given, 4, COST, method=Exchange(1))
        assert 0.7 * every.value < start.bound <= every.value


@pytest.mark.slow
def test_more_and_fewer_actuators_than_motions(make):
    """Over-actuated, five for three rigid-body motions; on a held beam one for two."""
    plant, sensors, actuators = make(44, count=7)
    costs = [
        place_both(plant, sensors, actuators, (4, n), COST, method=Exchange(2), rng=0).value
        for n in (3, 5)
    ]
    assert costs[1] < costs[0]
    with pytest.raises(InfeasibleError, match="rigid-body"):
        place_both(plant, sensors, actuators, (4, 2), COST)
    held, y, u = held_chain()
    one = place_both(held, y, u, (2, 1), ClosedLoopH2(effort=1e-7))
    assert one.proven and len(one.actuators) == 1
    with pytest.raises(ModelError, match="counts are two numbers"):
        place_both(held, y, u, 3)


def held_chain(count=5):
    """Masses between two walls, two POIs."""
    K = 1e6 * (2 * np.eye(count) - np.eye(count, k=1) - np.eye(count, k=-1))
    xyz = [(0.1 * i, 0.0, 0.0) for i in range(count)]
    model = FEModel(np.eye(count), K, dofs=DofSet(range(count), ["z"] * count, xyz))
    sensors = [Sensor(f"s{i}", at=place, asd=1e-9) for i, place in enumerate(xyz)]
    actuators = [Actuator(f"a{i}", at=place) for i, place in enumerate(xyz)]
    ports = Ports(
        w=[Disturbance("f", at=xyz[0], asd=1e-3)],
        u=actuators[:2],
        z=[Poi("die", at=xyz[3])],
        y=sensors[:2],
    )
    modes = solve_modes(model, count=count, damping=ModalDamping(0.02))
    return assemble_plant(modes, ports).discretized(5e3, delay=1), sensors, actuators


@pytest.mark.slow
def test_what_one_more_device_buys(make, tmp_path):
    plant, sensors, _ = make(45)
    curve = pareto_curve(plant, sensors, range(2, 7), PoiVariance("die"))
    assert curve.amounts.tolist() == [3, 4, 5, 6]  # two miss a rotation
    assert np.all(np.diff(curve.values) < 0)
    assert np.all(curve.bounds <= curve.values)
    assert "pm rms" in repr(curve) and "e-1" not in repr(curve)
    # with costs: the best of all counts that fit, which is the best of every subset that does
    costs = {"s1": 3.0, "s3": 2.5}
    cost = pareto_curve(plant, sensors[:7], [3.0, 4.0, 6.0], PoiVariance("die"), costs=costs)
    for budget, best in zip(cost.amounts, cost.placements, strict=True):
        sets = [s for k in (3, 4, 5, 6) for s in combinations(range(7), k)]
        sets = [s for s in sets if sum(costs.get(f"s{i}", 1.0) for i in s) <= budget]
        layouts = [[sensors[i] for i in s] for s in sets]
        found = score_sensors(plant, layouts, PoiVariance("die"))
        assert best.value == pytest.approx(found.values[0], rel=1e-9, abs=0.0)
        assert set(best.chosen) == set(found.best)
    curve.save(tmp_path / "curve.npz")
    assert repr(load(tmp_path / "curve.npz")) == repr(curve)
    with pytest.raises(InfeasibleError, match="any of the amounts"):
        pareto_curve(plant, sensors, [1, 2])


@pytest.mark.slow
def test_the_worth_of_each_device(make):
    plant, sensors, actuators = make(45)
    best = place_sensors(plant, sensors, 5, PoiVariance("die"))
    worth = device_worth(plant, best, PoiVariance("die"))
    assert worth.value == pytest.approx(best.value, rel=1e-12, abs=0.0)
    for name in best.chosen:
        left = [port for port in best.ports if port.name != name]
        alone = PoiVariance("die")(plant.with_ports(plant.assembled.ports.replace(y=left)))
        assert worth[name] == pytest.approx(alone, rel=1e-6, abs=0.0)
        assert worth[name] > worth.value
    assert "pm rms with all" in repr(worth)
    pair = place_both(plant, sensors[:5], actuators[:5], (4, 3), COST)
    both = device_worth(plant, pair, COST)
    assert all(np.isinf(both[name]) for name in pair.actuators)
    assert "do not suffice" in repr(both)


@pytest.mark.slow
@pytest.mark.filterwarnings("ignore:.*fewer than 4 nodes a wavelength")  # a coarse mesh suffices
def test_screening_finds_what_every_subset_shows():
    """Eight modes rank the choices; twenty as noise confirm the first few."""
    many = plate_modes(20)
    few = many.select(range(8))
    rng = np.random.default_rng(2)
    at = [(x, y, 0.0) for x, y in rng.uniform(0, 1, (9, 2)) * (0.5, 0.35)]
    sensors = [Sensor(f"s{i}", at=p, asd=3e-11) for i, p in enumerate(at)]
    ports = Ports(
        w=[Disturbance(f"d{i}", at=p, asd=1e-3) for i, p in enumerate(at[:3])],
        u=[Actuator(f"a{i}", at=p) for i, p in enumerate(at[:3])],
        z=[Poi("die", at=(0.2, 0.15, 0.0), axes=("z", "rx", "ry"))],
        y=sensors[:3],
    )
    plant = assemble_plant(few, ports, evaluation=many).discretized(4e3, delay=1)
    goal = PoiVariance("die")
    screen = Screened(OverMachines(PoiVariance("die"), [plant.replace(evaluation=None)]), keep=12)
    found = place_sensors(plant, sensors[:7], 4, goal, method=screen)
    every = place_sensors(plant, sensors[:7], 4, goal, method=Exhaustive())
    assert (found.chosen, found.value) == (every.chosen, every.value)
    assert found.evaluations <= 12 < every.evaluations
    own = PoiVariance("die", own_modes=True)
    alone = place_sensors(plant, sensors[:7], 4, own)
    assert alone.value < found.value


@pytest.mark.slow
@pytest.mark.parametrize("kind", ["y", "u", "yu"])
def test_a_plant_made_elsewhere(make, kind):
    """Candidates are rows and columns of its system: the same choices, values and bounds."""
    plant, sensors, actuators = make(44, count=7)
    whole = plant.with_ports(plant.assembled.ports.replace(y=sensors, u=actuators))
    other = StandardPlant.from_statespace(
        whole.system, w=whole.w, u=whole.u, z=whole.z, y=whole.y, asd=whole.asd,
        noise_factor=whole.noise_factor,
    )  # fmt: skip
    if kind == "yu":
        sides = [
            place_both(p, list(whole.y), list(whole.u), (3, 3), COST, method=Exchange(2), rng=1)
            for p in (whole, other)
        ]
    else:
        place = place_sensors if kind == "y" else place_actuators
        names = list(whole.y if kind == "y" else whole.u)
        goal = PoiVariance("die") if kind == "y" else PoiLqr("die", effort=1e-8)
        sides = [place(p, names, 3, goal, constraints=[OffPoi(-1)]) for p in (whole, other)]
    assert sides[0].chosen == sides[1].chosen
    assert sides[1].value == pytest.approx(sides[0].value, rel=1e-6, abs=0.0)
    assert sides[1].bound <= sides[1].value * (1 + 1e-9)
    left = sides[1].on(other)
    assert left.y == (sides[1].sensors if "y" in kind else other.y)
    assert left.u == (sides[1].actuators if "u" in kind else other.u)
    with pytest.raises(ModelError, match="was made elsewhere"):
        place_sensors(other, list(other.y), 3, constraints=[MinimumDistance(0.1)])


def test_an_actuator_choice_needs_sensors_that_see_the_body(make):
    """Sensors on a line miss the rotation about it, whatever the actuators are."""
    plant, _, actuators = make(44, count=6)
    line = [Sensor(f"l{i}", at=(0.1 * i, 0.3, 0.0), asd=1e-11) for i in (1, 2, 4)]
    poor = plant.with_ports(plant.assembled.ports.replace(y=line))
    with pytest.raises(AssumptionError, match="rigid-body"):
        place_actuators(poor, actuators, 4, COST)


def test_what_there_is_no_choice_of_is_said(make, tmp_path):
    plant, sensors, _ = make(44, count=6)
    with pytest.raises(ModelError, match="no candidates: pass a list"):
        place_sensors(plant, [], 3)
    with pytest.raises(InfeasibleError, match=rf"together with the required {sensors[0].name}\."):
        place_sensors(
            plant, sensors, 3, required=[sensors[0].name],
            constraints=[Excluded(Disc(sensors[0].at[:2], 0.01))],
        )  # fmt: skip
    with pytest.raises(ModelError, match=r"folder .*nowhere of the checkpoint does not exist"):
        place_sensors(plant, sensors, 3, checkpoint=tmp_path / "nowhere" / "search.jsonl")
    curve = pareto_curve(plant, sensors, [4, 40], PoiVariance("die"), rng=0)
    assert curve.amounts.tolist() == [4.0]


def test_sensors_of_the_plant_that_are_no_candidates_are_named():
    """The choice says that it is without them; candidates by name are not left out."""
    plant = fx.testbeds.three_masses()
    more = [fx.Sensor(f"s{i}", at=f"{i}:x", direction="x", asd=1e-10) for i in (1, 2)]
    found = fx.place_sensors(plant, [*more, "y2"], 1)
    assert found.left_out == ("y1",) and "without the plant's own y1" in repr(found)
    assert fx.place_sensors(plant, ["y1", "y2"], 1).left_out == ()

"""Controllers that follow the position of their machine, against loops of where it stands."""

import numpy as np
import pytest

import flexplant as fx
from flexplant.errors import AssumptionError, LabelError, ModelError
from flexplant.loop import schedule_loops
from flexplant.plant import Position
from plates import make_plate

MOVES = {"x": (-1.0, 0.0, 0.0)}
PLACES = np.linspace(-0.1, 0.1, 11)


@pytest.fixture(scope="module")
def plant():
    modes = fx.solve_modes(make_plate(), count=9, damping=fx.ModalDamping(0.01))
    inset = [(x, y, 0.0) for y in (0.2, 0.4) for x in (0.2, 0.4)]
    corners = [(x, y, 0.0) for y in (0.1, 0.5) for x in (0.15, 0.45)]
    ports = fx.Ports(
        u=[fx.Actuator(f"u{i}", at=p, asd=1e-3) for i, p in enumerate(inset)],
        z=[fx.Poi("die", at=(0.3, 0.3, 0.0), axes=("z", "rx", "ry"), moves=MOVES)],
        y=[fx.Sensor(f"y{i}", at=p, asd=1e-12, moves=MOVES) for i, p in enumerate(corners)],
        references=[fx.Reference("die")],
        positions=[Position("x", range=(-0.1, 0.1))],
    )
    return fx.assemble_plant(modes, ports).discretized(1e4, delay=1)


def design(there, bandwidth=25.0):
    return fx.design_kalman(there), fx.design_servo(there, bandwidth=bandwidth, notches=[])


@pytest.fixture(scope="module")
def schedule(plant):
    return schedule_loops(plant, design, places=PLACES)


@pytest.mark.slow
def test_at_a_place_it_is_the_design_there(plant, schedule):
    there = plant.at(x=PLACES[3])
    wanted = fx.close_loop(there, *design(there))
    found = schedule.at(PLACES[3])
    assert found.modulus_margin == pytest.approx(wanted.modulus_margin, rel=1e-9)
    middle = 0.5 * (PLACES[3] + PLACES[4])
    a, b, c = (schedule.at(x).controller for x in (PLACES[3], PLACES[4], middle))
    for part in "ABCD":
        two, one = 0.5 * (getattr(a, part) + getattr(b, part)), getattr(c, part)
        np.testing.assert_allclose(one, two, rtol=1e-9, atol=1e-12 * np.abs(two).max())
    assert "11 designs, x -0.1 to 0.1" in repr(schedule)


def test_runs_and_predictions_of_a_machine_that_stands(schedule):
    x = 0.033
    still, moving = schedule.at(x), {"x": np.full(200, x)}
    options = {"duration": 0.02, "reference": 1e-6, "noise": False}
    run, wanted = (fx.simulate(schedule, moving=moving, **options), fx.simulate(still, **options))
    np.testing.assert_allclose(run["die:z"], wanted["die:z"], atol=1e-9 * 1e-6)
    found = fx.simulation.rms_along(schedule, moving={"x": np.full(20, x)}, duration=2e-3)
    np.testing.assert_allclose(found["die:error"], still.budget("die:error").rms, rtol=1e-6)


@pytest.mark.slow
def test_around_another_machine(schedule):
    """The same controllers on a plate of another formulation."""
    machine = fx.testbeds.wafer_stage(damping=0.01)
    ports = schedule.plant.assembled.ports
    schedule = schedule.replace(places=PLACES[5:9:3], loops=schedule.loops[5:9:3])
    there = machine.scheduled(ports, schedule)
    margins = [loop.modulus_margin for loop in there.loops]
    assert min(margins) > 0.3
    run = machine.run(
        ports, schedule, duration=0.02, rng=1, moving={"x": np.linspace(0, 0.05, 200)}
    )
    assert np.all(np.isfinite(run["die:error"]))


@pytest.mark.long
def test_feedforward_follows_the_path(plant):
    """Forces for a place lift another one askew: the lever arms have moved by 80 mm."""
    ports = plant.assembled.ports
    coils = [
        fx.Actuator(one.name, at=one.at, asd=1e-3, moves=MOVES) for one in ports.u
    ]  # fmt: skip
    plant = plant.with_ports(ports.replace(u=coils))
    frozen = fx.design_feedforward(plant)

    def following(there):
        return *design(there), fx.design_feedforward(there)

    scan = fx.setpoint(0.15, velocity=0.8, acceleration=20.0, jerk=4e3, rate=1e4)
    lift = fx.setpoint(1e-4, velocity=5e-3, acceleration=0.5, jerk=50.0, snap=1e4, rate=1e4)
    worst = {}
    for name, blocks in (
        ("following", following), ("frozen", lambda there: (*design(there), frozen)),
    ):  # fmt: skip
        run = fx.simulate(
            schedule_loops(plant, blocks, places=PLACES),
            reference=lift,
            duration=0.25,
            moving={"x": lambda t: -0.08 + scan.at(t).position},
            noise=False,
        )
        worst[name] = np.abs(run["die:error"]).max()
    assert worst["frozen"] > 1e-6
    assert worst["following"] < 0.02 * worst["frozen"]


@pytest.mark.slow
def test_refusals(plant):
    with pytest.raises(AssumptionError, match="where the controller lies between two designs"):
        schedule_loops(plant, design, places=[-0.1, 0.1])
    with pytest.raises(LabelError, match="position 'w'"):
        schedule_loops(plant, design, position="w", places=PLACES)
    with pytest.raises(ModelError, match="outside its range"):
        schedule_loops(plant, design, places=[0.0, 0.3])
    with pytest.raises(LabelError, match="the plant has no position"):
        schedule_loops(fx.testbeds.three_masses(), design, places=PLACES)

    def growing(there):
        notches = [300.0] * (there.assembled.ports.values["x"] > 0)
        return fx.design_kalman(there), fx.design_servo(there, bandwidth=25.0, notches=notches)

    with pytest.raises(ModelError, match="they cannot be interpolated"):
        schedule_loops(plant, growing, places=[-0.01, 0.01])

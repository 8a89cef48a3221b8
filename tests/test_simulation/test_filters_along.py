"""Kalman filters of a machine on the move, against where it stands and against runs."""

import numpy as np
import pytest

import flexplant as fx
from flexplant.errors import LabelError, ModelError
from flexplant.plant import Position
from plates import make_plate

MOVES = {"x": (-1.0, 0.0, 0.0)}
CORNERS = [(0.15, 0.1), (0.45, 0.1), (0.15, 0.5), (0.45, 0.5)]
INSET = [(x, y) for y in (0.2, 0.4) for x in (0.2, 0.4)]


@pytest.fixture(scope="module")
def plant():
    modes = fx.solve_modes(make_plate(), count=9, damping=fx.ModalDamping(0.01))
    ports = fx.Ports(
        u=[fx.Actuator(f"u{i}", at=(*p, 0.0), asd=1e-3) for i, p in enumerate(INSET)],
        z=[fx.Poi("die", at=(0.3, 0.3, 0.0), axes=("z", "rx", "ry"), moves=MOVES)],
        y=[fx.Sensor(f"y{i}", at=(*p, 0.0), asd=1e-12, moves=MOVES) for i, p in enumerate(CORNERS)],
        references=[fx.Reference("die")],
        positions=[Position("x", range=(-0.1, 0.1))],
    )
    return fx.assemble_plant(modes, ports).discretized(1e4, delay=1)


def scan(t):
    return 0.06 * np.sin(2 * np.pi * 8.0 * t)


def test_standing_still_they_are_the_kalman_filter_there(plant):
    found = fx.simulation.filters_along(plant, moving={"x": np.full(30, 0.04)}, duration=3e-3)
    there = fx.design_kalman(plant.at(x=0.04))
    for i, name in enumerate(("die:z", "die:rx", "die:ry")):
        np.testing.assert_allclose(found.exact[i], there.rms(name), rtol=1e-6)
        np.testing.assert_allclose(found.scheduled[i], there.rms(name), rtol=1e-6)
    # the gain of the centre is a worse one there
    assert np.all(found.price("frozen")["die:z"][5:] > 0)
    assert "die:z exact" in repr(found)


@pytest.mark.slow
def test_the_exact_filter_is_the_best_and_schedules_come_near(plant):
    found = fx.simulation.filters_along(plant, moving={"x": scan}, duration=0.125)
    assert np.all(found.exact <= found.scheduled * (1 + 1e-9))
    assert np.all(found.exact <= found.frozen * (1 + 1e-9))
    assert np.sum(found.scheduled**2) < 1.05 * np.sum(found.exact**2)


@pytest.mark.long
def test_predicted_errors_are_those_of_runs(plant):
    """Along a scan that repeats: 5 % of some 1300 independent errors."""
    observer = fx.design_kalman(plant)
    loop = fx.close_loop(plant, observer, fx.design_servo(plant, bandwidth=40.0, observer=observer))
    moving = {"x": scan}
    found = fx.simulation.filters_along(plant, moving=moving, duration=0.125, repeats=True)
    runs = fx.simulate(loop, moving=moving, duration=1.0, rng=4, runs=2)
    errors = {name: [] for name in found.names}
    for r in range(2):
        record = {name: runs[name][r] for name in (*(f"y{i}" for i in range(4)), *plant.u)}
        made = fx.simulation.estimate_along(plant, record, moving=moving)
        for name, estimate in made.items():
            errors[name].append((estimate - runs[name][r])[2500:])
    for i, name in enumerate(found.names):
        rms = float(np.sqrt(np.mean(found.exact[i] ** 2)))
        assert float(np.sqrt(np.mean(np.square(errors[name])))) == pytest.approx(rms, rel=0.07)


def test_refusals(plant):
    with pytest.raises(LabelError, match="position to move 'w'"):
        fx.simulation.filters_along(plant, moving={"w": scan}, duration=0.01)
    with pytest.raises(ModelError, match="a sampled plant whose ports move"):
        fx.simulation.filters_along(fx.testbeds.three_masses(), moving={}, duration=0.01)
    with pytest.raises(LabelError, match="record 'u0'"):
        fx.simulation.estimate_along(
            plant, {f"y{i}": scan(np.arange(9)) for i in range(4)}, moving={}
        )

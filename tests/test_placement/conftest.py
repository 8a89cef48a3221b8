"""Small random machines: a plate with random candidates, die, disturbances."""

import numpy as np
import pytest

import flexplant.parallel
from flexplant.plant import Actuator, Disturbance, Poi, Ports, Sensor, assemble_plant
from placement_plate import SIZE, plate_modes


def points(rng, count):
    return [(x * SIZE[0], y * SIZE[1], 0.0) for x, y in rng.uniform(0, 1, (count, 2))]


def machine(seed, *, delay=1.0, count=9, thickness=0.02):
    """Return a sampled plant, sensor candidates and actuator candidates."""
    rng = np.random.default_rng(seed)
    noises = 10.0 ** rng.uniform(-11, -10, count)
    sensors = [
        Sensor(f"s{i}", at=p, asd=asd)
        for i, (p, asd) in enumerate(zip(points(rng, count), noises, strict=True))
    ]
    actuators = [Actuator(f"a{i}", at=p) for i, p in enumerate(points(rng, count))]
    ports = Ports(
        w=[
            Disturbance(f"d{i}", at=p, asd=10.0 ** rng.uniform(-4, -2))
            for i, p in enumerate(points(rng, 3))
        ],
        u=actuators[:3],
        z=[Poi("die", at=points(rng, 1)[0], axes=("z", "rx", "ry"))],
        y=sensors[:3],
    )
    return (
        assemble_plant(plate_modes(8, thickness), ports).discretized(4e3, delay=delay),
        sensors,
        actuators,
    )


@pytest.fixture(scope="session")
def make():
    return machine


@pytest.fixture
def send_everything(monkeypatch):
    """All items but the first leave for the executor, in small chunks."""
    monkeypatch.setattr(flexplant.parallel, "PROBE", 0.0)
    monkeypatch.setattr(flexplant.parallel, "CHUNK", 0.01)

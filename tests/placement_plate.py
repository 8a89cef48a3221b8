"""The plate of the tests of placement, and its modes."""

from functools import cache

import numpy as np

from flexplant.modes import solve_modes
from flexplant.plant import Actuator, Disturbance, Poi, Ports, Sensor, assemble_plant
from flexplant.structure import ModalDamping, kirchhoff_plate

SIZE = (0.5, 0.35)


@cache
def plate_modes(count, thickness=0.02):
    """Return so many modes; all of the structure for None."""
    plate = kirchhoff_plate(
        size=SIZE,
        thickness=thickness,
        elements=(4, 4),
        density=2700,
        youngs_modulus=70e9,
        poisson_ratio=0.33,
    )
    if count is None:
        return plate
    return solve_modes(plate, count=count, damping=ModalDamping(0.03))


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

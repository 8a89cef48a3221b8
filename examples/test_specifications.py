"""Specifications of a stage as tests: ``python -m pytest examples/test_specifications.py``.

``python examples/test_specifications.py`` prints the tables that these tests check. The design uses
a reduced model; the tests use a virtual machine with all its modes, computed with another theory.
When a test fails, the message is the table of all requirements, with reached and allowed values.
"""

# %% The stage, its channels and what it must do
from functools import cache

import pytest

import flexplant as fx

pytestmark = pytest.mark.slow  # a machine with all its modes: some seconds

RATE, DELAY, SIDE = 10e3, 1.3, 0.6  # Hz, samples, m
CORNERS = [(x, y, 0.0) for y in (0.0, SIDE) for x in (0.0, SIDE)]
INSET = [(x, y, 0.0) for y in (0.15, 0.45) for x in (0.15, 0.45)]
PORTS = fx.Ports(
    w=[fx.Disturbance(f"amp{i}", at=p, asd=1e-4) for i, p in enumerate(INSET, 1)],
    u=[fx.Actuator(f"u{i}", at=p) for i, p in enumerate(INSET, 1)],
    z=[fx.Poi("die", at=(0.3, 0.3, 0.0), axes=("z", "rx", "ry"))],
    y=[fx.Sensor(f"y{i}", at=p, asd=1e-12) for i, p in enumerate(CORNERS, 1)],
    references=[fx.Reference("die")],
)
MOVE = fx.setpoint(
    100e-6,
    velocity=5e-3,
    acceleration=0.5,
    jerk=100.0,
    snap=4e4,
    settle=0.02,
    exposure=0.05,
    rate=RATE,
)
EXPOSED = fx.Specification(ma=40e-9, msd=20e-9, effort=5.0, start=MOVE.exposures[0, 0])
LOOP = fx.Specification(bandwidth=40.0, modulus_margin=0.5, noise=1.5e-9)


@cache
def machine() -> fx.ClosedLoop:
    """Return the closed loop on the machine."""
    truth = fx.testbeds.wafer_stage(rate=RATE, delay=DELAY)
    plate = fx.kirchhoff_plate(
        size=(SIDE, SIDE), thickness=0.0272, elements=(8, 8),
        density=2702, youngs_modulus=70e9, poisson_ratio=0.35,
    )  # fmt: skip
    modes = fx.solve_modes(plate, count=24, damping=fx.ModalDamping(0.01))
    plant = fx.assemble_plant(modes, PORTS).discretized(RATE, delay=DELAY)
    static = fx.design_static(plant)
    servo = fx.design_servo(plant, bandwidth=60.0, observer=static)
    feedforward = fx.design_feedforward(fx.close_loop(plant, static, servo))
    return truth.loop(PORTS, static, servo, feedforward)


@cache
def run() -> fx.Response:
    """Return three runs of the move on the machine."""
    return fx.simulate(machine(), reference=MOVE, duration=MOVE.duration, runs=3, rng=1)


# %% The tests
def test_the_loop() -> None:
    verdict = LOOP.check(machine())
    assert verdict.passed, str(verdict)


def test_the_exposure_after_a_move() -> None:
    verdict = EXPOSED.check(machine(), run(), exposures=MOVE.exposures)
    assert verdict.passed, str(verdict)


# %% Run it
if __name__ == "__main__":
    print(LOOP.check(machine()))
    print(EXPOSED.check(machine(), run(), exposures=MOVE.exposures))

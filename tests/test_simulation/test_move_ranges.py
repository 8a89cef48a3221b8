"""Ranges of force and stroke against a move: Newton and Hooke by hand say what it needs."""

import re
import warnings

import numpy as np
import pytest

import flexplant as fx
from flexplant.errors import FlexplantWarning, LabelError, ModelError
from flexplant.simulation import Saturation

RATE = 4e3


def machine(mass=5.0, spring=0.0, scale=1.0):
    """Two masses, almost one body, that a drive pushes; a spring to the ground, or none."""
    model = fx.chain(masses=[0.8 * mass, 0.2 * mass], stiffnesses=[1e8], ground=[spring, 0.0])
    modes = fx.solve_modes(model, count=2, damping=fx.ModalDamping(0.01))
    own = fx.Ports(
        u=[fx.Actuator("drive", at="1:x")],
        z=[fx.Poi("tool", at="2:x", axes=("x",))],
        y=[fx.Sensor("encoder", at={"1:x": scale}, asd=1e-10)],
        references=[fx.Reference("tool")],
    )
    return fx.assemble_plant(modes, own).discretized(RATE, delay=1)


def run(plant, move, elements):
    """Run a loop that does nothing: what is said beforehand does not depend on it."""
    law = fx.StateSpace([], [], [], [[0.0, 0.0]], plant.dt, inputs=plant.y, outputs=plant.u)
    fx.simulate(
        fx.close_loop(plant, law), reference=move, duration=0.6, elements=elements, noise=False
    )


def said(plant, move, elements):
    """Return the least and the largest value that the warning says is needed."""
    with pytest.warns(FlexplantWarning, match="needs") as caught:
        run(plant, move, elements)
    (text,) = (str(one.message) for one in caught if "needs" in str(one.message))
    return [float(number) for number in re.search(r"needs (\S+) to (\S+) ", text).groups()]


def a_move(stroke=0.02):
    return fx.setpoint(stroke, velocity=0.2, acceleration=5.0, jerk=500.0)


@pytest.mark.parametrize("seed", range(4))
def test_force_is_mass_times_acceleration_and_stiffness_times_stroke(seed):
    rng = np.random.default_rng(seed)
    mass, stroke = rng.uniform(1.0, 30.0), rng.uniform(0.01, 0.03)
    spring = rng.choice([0.0, mass * (2 * np.pi * rng.uniform(2.0, 10.0)) ** 2])
    move = a_move(stroke)
    at = move.at(np.arange(round(0.6 * RATE)) / RATE)
    force = mass * at.acceleration + spring * at.position
    plant = machine(mass, spring)
    low, high = said(plant, move, {"drive": Saturation(0.9 * force.max())})
    assert low == pytest.approx(min(force.min(), 0.0), rel=0.02, abs=0.02 * force.max())
    assert high == pytest.approx(force.max(), rel=0.02)


@pytest.mark.parametrize("seed", range(3))
def test_a_sensor_reads_its_scale_times_the_stroke(seed):
    rng = np.random.default_rng(seed)
    scale, stroke = rng.uniform(0.5, 3.0), rng.uniform(0.01, 0.03)
    plant = machine(scale=scale)
    low, high = said(plant, a_move(stroke), {"encoder": Saturation(0.8 * scale * stroke)})
    assert (low, high) == pytest.approx((0.0, scale * stroke), rel=2e-3)


def test_a_range_of_the_reference_itself():
    assert said(machine(), a_move(0.02), {"tool:ref": [Saturation(0.015)]}) == [0.0, 0.02]
    pushes = Saturation(1e3, least=0.0)
    low, _ = said(machine(), a_move(), {"drive": [pushes, fx.simulation.Quantiser(1e-6)]})
    assert low == pytest.approx(-5.0 * 5.0, rel=0.02)  # it cannot brake


def test_ranges_that_suffice_are_not_mentioned():
    wide = {
        "drive": Saturation(1.02 * 5.0 * 5.0),
        "encoder": Saturation(0.0201),
        "tool:ref": Saturation(0.02),
    }
    with warnings.catch_warnings():
        warnings.filterwarnings("error", message=".*needs")
        run(machine(), a_move(), wide)
        run(machine(), 1e-3, {"drive": Saturation(1e-6)})  # no SetPoint: nothing is known of it
        # the force changes by mass times jerk, the encoder by the velocity
        run(machine(), a_move(), {"drive": Saturation(rate=1.03 * 5.0 * 500.0)})
        run(machine(), a_move(), {"encoder": Saturation(rate=0.201)})


@pytest.mark.parametrize("seed", range(3))
def test_rates_are_compared_too(seed):
    """A force changes by mass times jerk, a reading by its scale times the velocity."""
    rng = np.random.default_rng(seed)
    mass, scale = rng.uniform(1.0, 30.0), rng.uniform(0.5, 3.0)
    plant, at = machine(mass, scale=scale), a_move().at(np.arange(round(0.6 * RATE)) / RATE)
    rates = {"drive": mass * np.abs(at.jerk).max(), "encoder": scale * np.abs(at.velocity).max(),
             "tool:ref": np.abs(at.velocity).max()}  # fmt: skip
    for name, rate in rates.items():
        with pytest.warns(FlexplantWarning, match="to change by") as caught:
            run(plant, a_move(), {name: Saturation(rate=0.9 * rate)})
        (text,) = (str(one.message) for one in caught if "to change by" in str(one.message))
        found = float(re.search(r"change by (\S+) ", text).group(1))
        assert name in text and found == pytest.approx(rate, rel=0.03)


def test_a_feedforward_of_a_move_is_compared_too():
    plant = fx.testbeds.three_masses()
    observer = fx.design_kalman(plant)
    loop = fx.close_loop(plant, observer, fx.design_servo(plant, bandwidth=20.0, observer=observer))
    move = fx.setpoint(1e-3, velocity=0.05, acceleration=2.0, jerk=200.0)
    plain = fx.design_feedforward(loop, move=move)
    with pytest.warns(FlexplantWarning, match=r"to 6\S* N of 'u1', whose range is -1 to 1 N"):
        found = fx.design_feedforward(loop, move=move, elements={"u1": Saturation(1.0)})
    np.testing.assert_array_equal(found.gains, plain.gains)
    with pytest.raises(ModelError, match="compared with a move"):
        fx.design_feedforward(loop, elements={"u1": Saturation(1.0)})
    with pytest.raises(LabelError, match="u9"):
        fx.design_feedforward(loop, move=move, elements={"u9": Saturation(1.0)})

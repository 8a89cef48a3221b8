"""Actuators that push against each other: the spring between them says by hand with how much."""

import warnings

import numpy as np
import pytest
import scipy.signal

import flexplant as fx
from flexplant.errors import FlexplantWarning
from flexplant.plant.axes import opposing_part
from stages import ports, sampled, some_modes

RATE = 2e3


def carriage(mass, spring, bandwidth, scales):
    """A loop on each end of a beam: two masses on a spring, each with its encoder and PID law.

    The encoders read `scales` times the position; both follow the same reference.
    """
    model = fx.chain(masses=[mass, mass], stiffnesses=[spring])
    modes = fx.solve_modes(model, count=2, damping=fx.ModalDamping(0.03))
    own = fx.Ports(
        u=[fx.Actuator("left", at="1:x"), fx.Actuator("right", at="2:x")],
        z=[fx.Poi("tool", at={"1:x": 0.5, "2:x": 0.5}, axes=("x",))],
        y=[
            fx.Sensor(f"encoder{i}", at={f"{i}:x": scale}, asd=1e-12)
            for i, scale in enumerate(scales, 1)
        ],
        references=[fx.Reference("tool")],
    )
    plant = fx.assemble_plant(modes, own).discretized(RATE, delay=1)
    w = 2 * np.pi * bandwidth
    zeros, poles = [-w / 3, -w / 4], [0.0, -3 * w, -12 * w]
    gain = mass * w**2 / 3 / (w / 3) * (3 * w) * (12 * w)
    law = scipy.signal.ZerosPolesGain(zeros, poles, gain).to_ss()
    A, B, C, D, _ = scipy.signal.cont2discrete((law.A, law.B, law.C, law.D), 1 / RATE, "tustin")
    both = np.array([[-1.0, 0.0, 1.0], [0.0, -1.0, 1.0]])
    eye = np.eye(2)
    names = ["encoder1", "encoder2", "tool:ref"]
    block = fx.StateSpace(
        np.kron(eye, A), np.kron(eye, B) @ both, np.kron(eye, C), np.kron(eye, D) @ both, 1 / RATE,
        inputs=names, outputs=plant.u,
    )  # fmt: skip
    return fx.close_loop(plant, block)


def moved(loop, stroke):
    move = fx.setpoint(stroke, velocity=0.2, acceleration=2.0, jerk=100.0)
    return fx.simulate(loop, reference=move, duration=6.0, rng=1)


@pytest.mark.parametrize("seed", range(4))
def test_two_laws_whose_encoders_disagree_push_against_each_other(seed):
    """Both encoders reach the reference: their difference in scale stretches the spring."""
    rng = np.random.default_rng(seed)
    mass, stroke = rng.uniform(5.0, 20.0), rng.uniform(0.05, 0.1)
    spring = mass / 2 * (2 * np.pi * rng.uniform(20.0, 30.0)) ** 2
    scale = 1.0 + rng.choice([-1.0, 1.0]) * rng.uniform(4e-3, 1e-2)
    force = spring * stroke * (1.0 / scale - 1.0)  # with which `right` pulls
    loop = carriage(mass, spring, 15.0, (1.0, scale))
    assert loop.is_stable
    with pytest.warns(FlexplantWarning, match="push against each other") as said:
        run = moved(loop, stroke)
    assert run["right"][-1] == pytest.approx(force, rel=0.02)
    text = str(said[0].message)
    for name, value in (("left", -force), ("right", force)):
        assert float(text.split(f"{name} with ")[1].split(" N")[0]) == pytest.approx(
            value, rel=0.02
        )


def test_encoders_that_agree_leave_no_force():
    with warnings.catch_warnings(action="error"):
        run = moved(carriage(10.0, 1e5, 15.0, (1.0, 1.0)), 0.05)
    assert abs(run["right"][-100:].mean()) < 0.01 * run.peak("right")


def test_machines_that_move_freely_are_not_accused():
    """A gantry has as many actuators as axes; the plate has four on three, commanded together."""
    gantry = fx.testbeds.gantry()
    plate = sampled(some_modes(0.01, 9, attached=False), ports(asd=1e-4))
    for plant, reference in ((gantry, "tool_x:ref"), (plate, "die:ref")):
        observer = fx.design_kalman(plant)
        servo = fx.design_servo(plant, bandwidth=4.0, observer=observer)
        loop = fx.close_loop(plant, observer, servo)
        move = fx.setpoint(1e-3, velocity=0.05, acceleration=0.5, jerk=50.0)
        with warnings.catch_warnings():
            warnings.filterwarnings("error", message=".*push against")
            fx.simulate(loop, reference={reference: move}, duration=1.0, rng=1)


def test_a_weight_that_actuators_share_is_carried_and_not_opposed():
    """A constant force on the plate is answered by four equal ones, which do move its axes."""
    plate = sampled(some_modes(0.01, 9, attached=False), ports(asd=1e-4))
    observer = fx.design_kalman(plate)
    servo = fx.design_servo(plate, bandwidth=20.0, observer=observer)
    loop = fx.close_loop(plate, observer, servo)
    with warnings.catch_warnings():
        warnings.filterwarnings("error", message=".*push against")
        run = fx.simulate(loop, disturbance={"amp1": 10.0}, duration=1.0, rng=1)
    assert abs(sum(run[name][-1] for name in loop.driven)) > 5.0


@pytest.mark.parametrize("seed", range(5))
def test_what_could_be_left_out_is_found_and_nothing_else(seed):
    """Three actuators on one axis: what is wasted is the smaller sum of pushes of one sign."""
    gains = np.random.default_rng(seed).uniform(0.5, 2.0, 3)
    idle = np.linalg.svd(gains[None])[2][1:].T
    forces = np.array([5.0, 0.0, -3.0]) / gains  # each moves the axis by 5, 0 and -3 alone
    assert opposing_part(idle, forces) * gains == pytest.approx([3.0, 0.0, -3.0], abs=1e-6)
    assert opposing_part(idle, np.array([7.0, 0.0, 0.0])) == pytest.approx(0.0, abs=1e-6)
    assert opposing_part(idle, np.abs(forces)) == pytest.approx(0.0, abs=1e-6)

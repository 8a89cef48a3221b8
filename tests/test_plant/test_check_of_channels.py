"""check() of plants read through blocks, weighted or sampled: what is left of their channels."""

import numpy as np
import pytest
import scipy.linalg as la

from flexplant.errors import AssumptionError
from flexplant.lti import StateSpace
from flexplant.plant import Actuator, Disturbance, Poi, Ports, Sensor, assemble_plant
from flexplant.structure import FEModel, chain
from flexplant.synthesis import design_hinf
from stages import RATE, ports, reduced


def hautus(A, C):
    """Smallest singular value of [lambda - A; C] over the poles that do not decay, C scaled."""
    C = C / max(np.linalg.norm(C), 1e-9)
    poles = [value for value in la.eigvals(A) if abs(value) > 1 - 1e-9]
    return min(la.svdvals(np.vstack([value * np.eye(len(A)) - A, C]))[-1] for value in poles)


def test_one_sensor_that_a_block_leaves_does_not_see_three_motions():
    plant = assemble_plant(reduced(), ports()).discretized(RATE, delay=1)
    one = StateSpace([], [], [], [[1.0]], plant.dt, inputs=["y1"], outputs=["first"])
    seen = plant.through(one)
    found = seen.check()["detectable"]
    assert not found.holds
    assert "y does not see the rigid-body" in found.finding
    assert "(channels: first)" in found.finding
    with pytest.raises(AssumptionError, match="y does not see"):
        design_hinf(seen)
    # two of four sensors, weighted besides; all four, mixed by any regular matrix, see everything
    two = StateSpace([], [], [], np.eye(2), plant.dt, inputs=["y1", "y2"], outputs=["a", "b"])
    assert not plant.through(two).weighted(z={"die:z": 2.0}).check()["detectable"].holds
    mixed = np.random.default_rng(0).standard_normal((4, 4))
    names = [f"y{i}" for i in range(1, 5)]
    four = StateSpace([], [], [], mixed, plant.dt, inputs=names, outputs=list("abcd"))
    assert plant.through(four).check()["detectable"].holds
    twice = plant.through(four).through(
        StateSpace([], [], [], [[1.0, 0, 0, 0]], plant.dt, inputs=list("abcd"), outputs=["e"])
    )
    assert not twice.check()["detectable"].holds
    # visibility is that of the channels which are left
    assert {mode.channels["y"] for mode in seen.check().modes} == {"first"}


@pytest.mark.parametrize("zero", [1.0, 0.5])
def test_a_filter_hides_what_its_zero_is_at(zero):
    plant = assemble_plant(reduced(), ports()).discretized(RATE)
    names = [f"y{i}" for i in range(1, 5)]
    each = np.eye(4)
    washed = StateSpace(
        0.9 * each, each, (0.9 - zero) * each, each, plant.dt, inputs=names, outputs=list("abcd")
    )
    seen = plant.through(washed)
    g = seen.system.select(seen.y, seen.u)
    assert seen.check()["detectable"].holds == (zero != 1.0) == (hautus(g.A, g.C) > 1e-12)


def test_channels_that_weights_leave_out_do_not_count():
    plant = assemble_plant(reduced(), ports())
    assert plant.weighted(w={"amp1": 2.0}).check()["excited"].holds
    fewer = plant.weighted(w={f"amp{i}": None for i in (2, 3, 4)}).check()["excited"]
    assert not fewer.holds
    assert "(channels: amp1)" in fewer.finding
    z = {"die:rx": None, "die:ry": None}
    assert "rotation rx" in plant.weighted(z=z).check()["performance"].finding


def one_mode(freq):
    """A mass on an undamped spring, and its ports."""
    one = chain(masses=[2.0], stiffnesses=[])
    model = FEModel(one.M, [[2.0 * (2 * np.pi * freq) ** 2]], dofs=one.dofs)
    return model, Ports(
        w=[Disturbance("d", at="1:x", asd=1e-3)],
        u=[Actuator("u1", at="1:x")],
        z=[Poi("die", at="1:x", axes=("x",))],
        y=[Sensor("y1", at="1:x", asd=1e-9)],
    )


@pytest.mark.filterwarnings("ignore:all 1 elastic modes")
@pytest.mark.parametrize(
    ("rate", "reached", "seen", "remark"),
    [
        (1000.0, True, True, ""),
        (130.0, True, True, "mode 1 (100 Hz) looks like 30 Hz"),
        (200.0, True, False, "mode 1 (100 Hz) looks like 100 Hz"),
        (100.0, False, False, "mode 1 (100 Hz) looks like 0 Hz"),
    ],
)
@pytest.mark.parametrize("delay", [0.0, 0.4])
def test_a_sampled_plant_is_judged_by_its_samples(rate, reached, seen, remark, delay):
    # at 200 Hz both poles are at -1: of the samples y[k] = (-1)^k one motion is never seen
    model, channels = one_mode(100.0)
    plant = assemble_plant(model, channels).discretized(rate, delay=delay)
    report = plant.check()
    g = plant.system.select(plant.y, plant.u)
    assert (hautus(g.A, g.C) > 1e-9) == seen
    assert report["detectable"].holds == seen
    if not delay:
        assert (hautus(g.A.T, g.B.T) > 1e-9) == (reached and seen)
        assert report["stabilisable"].holds == (reached and seen)
    assert report["excited"].holds  # white noise is not held
    assert (remark in repr(report)) if remark else ("half the sampling rate" not in repr(report))
    assert assemble_plant(model, channels).check().ok


@pytest.mark.filterwarnings("ignore:all 1 elastic modes")
def test_a_mode_that_looks_like_a_rigid_body_needs_a_sensor_of_its_own():
    free = chain(masses=[1.0, 1.0], stiffnesses=[0.5 * (2 * np.pi * 100.0) ** 2])
    for sensors, rate, sees in ((1, 1000.0, True), (1, 100.0, False), (2, 1000.0, True)):
        channels = Ports(
            w=[Disturbance("d", at="1:x", asd=1e-3)],
            u=[Actuator("u1", at="1:x")],
            z=[Poi("die", at="1:x", axes=("x",))],
            y=[Sensor(f"y{i}", at=f"{i}:x", asd=1e-9) for i in range(1, sensors + 1)],
        )
        found = assemble_plant(free, channels).discretized(rate).check()["detectable"]
        assert found.holds == sees
    text = assemble_plant(free, channels).discretized(100.0).check()["stabilisable"].finding
    assert "the rigid-body motions and mode 2 (100 Hz) apart" in text

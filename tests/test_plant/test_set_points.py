"""Set-points on several axes of a POI: names, a stage that follows all of them, what is derived."""

import numpy as np
import pytest

import flexplant as fx
from flexplant.errors import LabelError
from flexplant.plant import Poi, Reference, reference_errors
from flexplant.simulation import error_map, exposure_errors, inverse_forces, known_forces
from oracles_synthesis import rigid_sensor
from stages import AXES, CORNERS, INSET, L, ports, sampled, some_modes

MASS = L * L * 0.0272 * 2702
DIE = (0.2, 0.25, 0.0)
INSET_NAMES = ("u1", "u2", "u3", "u4")
REFS = ("die:ref", "die:rx:ref", "die:ry:ref")


def plant_of(*axes, die=DIE):
    channels = ports(die=die, references=[Reference("die", axes=axes)])
    return sampled(some_modes(), channels)


@pytest.fixture(scope="module")
def plant():
    return plant_of("z", "rx", "ry")


@pytest.fixture(scope="module")
def loop(plant):
    observer = fx.design_static(plant)
    return fx.close_loop(plant, observer, fx.design_servo(plant, bandwidth=40.0, observer=observer))


def moves(**goals):
    """A set-point for each axis, at rest after 0.1 s."""
    long = {"velocity": 1.0, "acceleration": 10.0, "jerk": 1e3}
    return {ref: fx.setpoint(goal, **long) for ref, goal in zip(REFS, goals.values(), strict=True)}


def test_each_axis_has_its_channels(plant):
    """Errors are reference less motion, in w, z and y; the first axis has the short names."""
    assert plant.w[-3:] == plant.y[-3:] == REFS
    errors = ("die:error", "die:rx:error", "die:ry:error")
    assert tuple(n for n in plant.z if n.endswith(":error")) == errors
    g = plant.system
    for axis, ref, error in zip(AXES, REFS, errors, strict=True):
        (e,), (m,) = g.output_index([error]), g.output_index([f"die:{axis}"])
        np.testing.assert_array_equal(g.C[e], -g.C[m])
        expected = [float(name == ref) for name in g.inputs]
        np.testing.assert_array_equal(g.D[e] + g.D[m], expected)
    only = plant_of("ry")
    assert only.w[-1] == "die:ry:ref" and "die:error" not in only.z
    assert only.units["die:ry:ref"] == "rad"


@pytest.mark.slow
def test_a_stage_follows_all_of_them_at_once(plant, loop):
    """Each axis comes to rest at its own goal; another place of the POI sees the same."""
    goals = {"z": 2e-4, "rx": 1e-4, "ry": -3e-4}
    run = fx.simulate(loop, reference=moves(**goals), duration=1.0, noise=False)
    for axis, goal in goals.items():
        assert run[f"die:{axis}"][-1] == pytest.approx(goal, rel=1e-3)
    # of the rigid body at rest: z of a corner from the die's by its arms (rx = dz/dy, ry = -dz/dx)
    (x, y, _), (a, b, _) = CORNERS[-1], DIE
    expected = goals["z"] + goals["rx"] * (y - b) - goals["ry"] * (x - a)
    assert run["y4"][-1] == pytest.approx(expected, rel=1e-3)


def test_a_moved_poi_keeps_its_errors(plant):
    at = (0.4, 0.35, 0.0)
    along, there = plant.along("die", [at]), plant.at({"die": at})
    rows = there.system.output_index(along.channels)
    assert along.channels[3:] == ("die:error", "die:rx:error", "die:ry:error")
    np.testing.assert_allclose(along.C[0], there.system.C[rows], atol=1e-12)


def test_errors_at_the_sensors_vanish_when_the_body_follows(plant):
    block = reference_errors(plant)
    assert block.inputs[-3:] == REFS
    expected = np.array([rigid_sensor(p, DIE, AXES) for p in CORNERS])
    np.testing.assert_allclose(block.D[:, 4:], expected, atol=1e-9)


def test_weights_are_of_all_errors(plant):
    weights = fx.stage_weights(plant, 30.0)
    assert {n for n, w in weights.z.items() if w is None} == {f"die:{axis}" for axis in AXES}
    assert {"die:error", "die:rx:error", "die:ry:error"} < set(weights.z)


@pytest.mark.slow
def test_feedforward_is_of_the_axis_that_is_named(plant, loop):
    """Turning about x takes the plate's moment of inertia, 1/12 m L^2, and no force in z."""
    turned = fx.design_feedforward(plant, reference="die:rx:ref")
    force = turned.T @ turned.gains[0][:, 2]
    arm = DIE[1] - L / 2  # the die, that stays where it is, is not the centre of gravity
    lever = np.array([place[1] for place in INSET]) - L / 2
    assert lever @ force == pytest.approx(MASS * L**2 / 12, rel=2e-3)
    assert force.sum() == pytest.approx(-MASS * arm, rel=2e-3)
    with pytest.raises(LabelError, match=r"there are 3 references \(die:ref, die:rx:ref"):
        fx.design_feedforward(plant)
    forced = fx.close_loop(plant, *loop.blocks, known_forces(plant))
    move = fx.setpoint(1e-4, velocity=5e-3, acceleration=0.5, jerk=100.0, rest=0.05)
    wide = {"duration": 0.25, "bandwidth": 1000.0}
    forces = inverse_forces(forced, move, reference="die:rx:ref", **wide)
    run = fx.simulate(forced, reference={"die:rx:ref": move, **forces}, duration=0.25, noise=False)
    assert np.max(np.abs(run["die:rx:error"])) < 1e-8


def test_figures_of_exposures_are_of_errors_not_motions(plant, loop):
    """An axis with a set-point is judged by its error; of two of three, the third by its motion."""
    run = fx.simulate(loop, reference=moves(z=1e-4, rx=1e-5, ry=1e-5), duration=0.3, noise=False)
    found = exposure_errors(run, start=0.2)
    assert found.channels == ("die:error", "die:rx:error", "die:ry:error")
    mixed = plant_of("z", "ry")
    run = fx.simulate(fx.close_loop(mixed, *[
        b.select(inputs=[n for n in b.inputs if n != "die:rx:ref"]) for b in loop.blocks
    ]), duration=0.3, noise=False)  # fmt: skip
    assert exposure_errors(run, start=0.2).channels == ("die:rx", "die:error", "die:ry:error")


def test_a_map_follows_the_reference_of_its_axis(loop):
    """Turned about y as a whole: errors in ry are alike all over the plate."""
    move = moves(z=1e-4, rx=1e-4, ry=1e-4)["die:ry:ref"]
    found = error_map(
        loop, CORNERS, duration=0.4, reference=move, axis="ry", noise=False, start=0.3
    )
    assert np.all(found.ma < 1e-3 * 1e-4)
    two = fx.close_loop(plant_of("rx", "ry"), *loop.blocks[:1], idle=INSET_NAMES)
    with pytest.raises(LabelError, match=r"2 references .*, 0 of them along 'z'"):
        error_map(two, CORNERS, duration=0.1, reference=move)


def test_what_is_no_axis():
    with pytest.raises(LabelError, match=r"axis of POI 'die'.*'rz'"):
        ports(references=[Reference("die", axes=("z", "rz"))])
    with pytest.raises(LabelError, match="'up'"):
        Reference("die", axes=("up",))
    with pytest.raises(LabelError, match=r"twice|more than once|two"):
        Reference("die", axes=("z", "z"))
    two = ports(references=[Reference("die", axes="rx")])
    assert [(poi.name, axis) for poi, axis in two.followed] == [("die", "rx")]
    assert isinstance(two.followed[0][0], Poi)

"""reference_errors by geometry, stage_weights by their formulas, refusals."""

import numpy as np
import pytest

import flexplant as fx
from flexplant.errors import AssumptionError, LabelError, ModelError
from flexplant.lti import frequency_response
from flexplant.modes import solve_modes
from flexplant.plant import (
    Disturbance,
    Poi,
    Reference,
    Sensor,
    StandardPlant,
    assemble_plant,
    reference_errors,
    stage_weights,
)
from flexplant.structure import ModalDamping, PointMass
from flexplant.synthesis import design_hinf
from oracles_synthesis import rigid_sensor
from stages import AXES, CORNERS, INSET, NOISE, OFF_NODE, L, full, ports, sampled, some_modes

MASS = L * L * 0.0272 * 2702


def size(weight, freq):
    return np.abs(frequency_response(weight, np.atleast_1d(freq)).data[0, 0])


@pytest.mark.parametrize("die", [(L / 2, L / 2, 0.0), OFF_NODE])
def test_errors_vanish_when_the_rigid_body_follows(die):
    """Each sensor of z sees 1 m per 1 m of reference at the die, wherever both are."""
    block = reference_errors(sampled(some_modes(), ports(die=die)))
    assert block.outputs == tuple(f"y{i}:error" for i in range(1, 5))
    expected = np.array([rigid_sensor(p, die, AXES)[0] for p in CORNERS])
    np.testing.assert_allclose(block.D, np.hstack([-np.eye(4), expected[:, None]]), atol=1e-9)


def test_errors_follow_the_first_axis_only():
    """A reference of rotation moves sensors by their arms; other sensors are left out."""
    die = (0.2, 0.25, 0.0)
    y = [Sensor(f"y{i}", at=p, asd=NOISE) for i, p in enumerate(CORNERS[:3], 1)]
    y.append(Sensor("v", at=CORNERS[3], quantity="velocity", asd=1e-9))
    channels = ports(
        z=[Poi("die", at=die, axes=("rx", "z", "ry"))], y=y, references=[Reference("die")]
    )
    block = reference_errors(sampled(some_modes(), channels))
    assert block.inputs == ("y1", "y2", "y3", "die:ref")
    expected = [rigid_sensor(p, die, ("rx",))[0] for p in CORNERS[:3]]
    np.testing.assert_allclose(block.D[:, 3], expected, atol=1e-9)


@pytest.mark.parametrize("rate", [0.0, 1e4])
def test_weights_are_what_their_formulas_say(rate):
    plant = assemble_plant(some_modes(), ports())
    plant = plant.discretized(rate, delay=1) if rate else plant
    weights = stage_weights(plant, 30.0, peak=3.0, disturbance=0.2, effort=0.4, noise=0.01)
    crossing = 48.0
    # each of the four actuators accelerates the centre by 1 / mass
    force = (2 * np.pi * crossing) ** 2 / (2.0 / MASS)
    assert weights.z["die:z"] is None
    error = weights.z["die:error"]
    unit = 1 / (3.0 * 0.2 * 0.4)  # gamma 1 is |T| < peak: W_u W_d = 1 / peak
    assert size(error, crossing)[0] == pytest.approx(unit, rel=1e-3)
    assert size(error, 1e-4)[0] == pytest.approx(100.0 * unit, rel=1e-3)
    assert size(error, 4.9e3)[0] == pytest.approx(unit / 3, rel=1e-3)
    effort = weights.z["u2:effort"]
    assert size(effort, 1e-3)[0] == pytest.approx(unit * 0.4 / force, rel=1e-4)
    corner = unit * 0.4 / force * np.sqrt(2)
    assert size(effort, 6 * crossing)[0] == pytest.approx(corner, rel=2e-2)
    assert weights.w["amp1"] == pytest.approx(0.2 * force)
    assert weights.w["amp1"] * size(effort, 1e-3)[0] == pytest.approx(1 / 3.0, rel=1e-4)
    assert weights.w["y3:noise"] == 0.01
    # the arm of the rotations: the corners are L / 2 from the axis through the centre
    arm = size(weights.z["die:rx"], 10.0)[0] / size(error, 10.0)[0]
    assert arm == pytest.approx(L / 2, rel=1e-6)
    weighted = plant.weighted(z=weights.z, w=weights.w)
    assert weighted.dt == plant.dt
    assert "30 Hz" in repr(weights) and len(repr(weights).splitlines()) == 1


def test_a_disturbing_moment_is_a_force_at_the_arm():
    w = [Disturbance("force", at=INSET[0]), Disturbance("moment", at=INSET[0], direction="rx")]
    weights = stage_weights(sampled(some_modes(), ports(w=w)), 30.0)
    assert weights.w["moment"] == pytest.approx(L / 2 * weights.w["force"], rel=1e-6)


def test_the_arm_is_a_length_whatever_masses_tilt_the_basis_of_the_motions():
    """The same sensors, the centre of mass elsewhere: rounding chooses how the basis mixes."""
    places = {(L / 8, L / 2, 0.0): 1.0, (3 * L / 8, 7 * L / 8, 0.0): 0.4}
    loaded = full().with_parts([PointMass(place, mass) for place, mass in places.items()])
    modes = solve_modes(loaded, count=10, damping=ModalDamping(0.01))
    weights = stage_weights(sampled(modes), 30.0)
    arm = size(weights.z["die:rx"], 10.0)[0] / size(weights.z["die:error"], 10.0)[0]
    assert arm == pytest.approx(L / 2, rel=1e-6)


def test_a_bandwidth_moves_all_frequencies_together():
    plant = sampled(some_modes())
    slow, fast = (stage_weights(plant, f) for f in (10.0, 20.0))
    assert fast.w["amp1"] == pytest.approx(4 * slow.w["amp1"])
    ratio = size(fast.z["die:error"], 20.0) / size(slow.z["die:error"], 10.0)
    assert ratio[0] == pytest.approx(1.0, rel=1e-4)


def test_a_plant_made_elsewhere_is_refused():
    plant = sampled(some_modes())
    other = StandardPlant.from_statespace(plant.system, u=plant.u, y=plant.y)
    for call in (reference_errors, lambda p: stage_weights(p, 30.0)):
        with pytest.raises(ModelError, match="assemble_plant"):
            call(other)


def test_missing_references_axes_and_sensors_are_named():
    without = sampled(some_modes(), ports(references=[]))
    with pytest.raises(AssumptionError, match=r"Reference\(\.\.\.\)"):
        reference_errors(without)
    one_axis = ports(z=[Poi("die", at=INSET[0])])
    with pytest.raises(AssumptionError, match="all its axes"):
        reference_errors(sampled(some_modes(), one_axis))
    kinds = ("velocity", "acceleration")
    y = [Sensor(q, at=CORNERS[0], quantity=q, asd=1e-9) for q in kinds]
    with pytest.raises(
        AssumptionError, match=r"no displacement sensor.*acceleration, velocity.*Add Sensor"
    ):
        reference_errors(assemble_plant(some_modes(), ports(y=y)))
    with pytest.raises(AssumptionError, match=r"no displacement sensor.*none"):
        reference_errors(assemble_plant(some_modes(), ports(y=[])))


@pytest.mark.parametrize(
    "wrong",
    [{"peak": 0.9}, {"disturbance": 0.0}, {"effort": -1.0}, {"noise": np.nan}, {"bandwidth": 0.0}],
)
def test_numbers_out_of_range_are_refused(wrong):
    options = {"bandwidth": 30.0} | wrong
    with pytest.raises(ModelError, match=next(iter(wrong))):
        stage_weights(sampled(some_modes()), options.pop("bandwidth"), **options)


def test_several_references_must_be_named():
    edge = Poi("edge", at=(0.1, 0.2, 0.0), axes=AXES)
    both = [Poi("die", at=OFF_NODE, axes=AXES), edge]
    plant = sampled(some_modes(), ports(z=both, references=[Reference("die"), Reference("edge")]))
    with pytest.raises(LabelError, match=r"die, edge.*poi='die'"):
        reference_errors(plant)
    with pytest.raises(LabelError, match=r"die, edge.*poi='die'"):
        stage_weights(plant, 30.0)
    with pytest.raises(LabelError, match="no followed POI 'dye'"):
        reference_errors(plant, poi="dye")
    block = reference_errors(plant, poi="edge")
    assert block.inputs[-1] == "edge:ref"
    expected = [rigid_sensor(p, (0.1, 0.2, 0.0), AXES)[0] for p in CORNERS]
    np.testing.assert_allclose(block.D[:, -1], expected, atol=1e-9)
    weights = stage_weights(plant, 30.0, poi="edge")
    assert {"die:error", "edge:error"} <= set(weights.z)
    with pytest.raises(ModelError, match="need a StandardPlant, got 'plant'"):
        stage_weights("plant", 30.0)


@pytest.mark.slow
def test_other_points_of_the_body_move_with_the_reference_and_are_left_out():
    """Held at rest beside a reference they would cost a hundredfold, the weight's floor."""
    left, right = (Poi(n, at=(x, 0.3, 0.0), axes=AXES) for n, x in (("left", 0.15), ("right", 0.4)))
    model = some_modes(count=6, attached=False)
    channels = ports(z=[left, right], references=[Reference("left")])
    plant = sampled(model, channels)
    weights = stage_weights(plant, 30.0, poi="left")
    out = [name for name, weight in weights.z.items() if weight is None and "right" in name]
    assert out == ["right:z", "right:rx", "right:ry"]
    assert "left out of z: right (moved by the reference)" in repr(weights)
    alone = sampled(model, ports(z=[left], references=[Reference("left")]))
    single = stage_weights(alone, 30.0)
    assert "left out" not in repr(single)
    gammas = [
        design_hinf(p.through(reference_errors(p)).weighted(z=w.z, w=w.w)).gamma
        for p, w in ((plant, weights), (alone, single))
    ]
    assert gammas[0] == pytest.approx(gammas[1], rel=1e-2)
    assert gammas[0] < 3.0
    resting = stage_weights(sampled(model, ports(z=[left, right], references=[])), 30.0, poi="left")
    assert None not in resting.z.values()


def test_the_weights_are_taken_as_they_are():
    """By `weighted` whole, by name, and by design_hinf from a bandwidth: one plant each time."""
    plant = fx.testbeds.three_masses()
    weights = fx.stage_weights(plant, 20.0)
    by_name = plant.weighted(z=weights.z, w=weights.w).system
    np.testing.assert_array_equal(plant.weighted(weights).system.B, by_name.B)
    other = plant.weighted(weights, z={"u1:effort": 0.0}).system
    np.testing.assert_array_equal(other.C[other.output_index("u1:effort")], 0.0)
    whole = fx.design_hinf(plant, bandwidth=20.0)
    assert whole.gamma == fx.design_hinf(plant.weighted(weights)).gamma
    with pytest.raises(ModelError, match=r"StageWeights, got 3\.0.* Pass stage_weights"):
        plant.weighted(3.0)

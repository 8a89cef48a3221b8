"""reference_errors by geometry, stage_weights by their formulas, refusals."""

import numpy as np
import pytest

import flexplant as fx
from flexplant.errors import AssumptionError, LabelError, ModelError
from flexplant.lti import frequency_response
from flexplant.plant import (
    Actuator,
    Poi,
    Reference,
    Sensor,
    StandardPlant,
    assemble_plant,
    reference_errors,
    stage_weights,
)
from flexplant.synthesis import design_hinf
from oracles_synthesis import rigid_sensor
from stages import AXES, CORNERS, INSET, NOISE, OFF_NODE, L, ports, sampled, some_modes

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


def real_axis(plant, crossing):
    """The sizes by dense solves at sigma: axes of unit motion, forces, and what sensors show."""
    g, sigma = plant.system, 2 * np.pi * crossing
    s = np.exp(sigma * g.dt) if g.dt else sigma
    states = np.linalg.solve(s * np.eye(g.n_states) - g.A, g.B)
    G = g.C @ states + g.D
    at = {name: i for i, name in enumerate(g.outputs)}
    u = [g.inputs.index(name) for name in plant.u]
    z = [at[name] for name in ("die:z", "die:rx", "die:ry")]
    y = [at[f"y{i}"] for i in range(1, 5)]
    T = np.linalg.pinv(G[np.ix_(z, u)]) * np.exp(-sigma * g.dt * (plant.delay + 0.5))
    Y = G[np.ix_(y, u)] @ np.linalg.pinv(G[np.ix_(z, u)])  # what sensors show is not late
    d = np.sqrt((Y**2).sum(axis=0) / (Y[:, 0] ** 2).sum())
    return d, np.sqrt(4 / 3) * np.linalg.norm(T / d, axis=1), np.linalg.norm(Y / d, axis=1)


@pytest.mark.parametrize("rate", [0.0, 1e4])
def test_weights_are_what_their_formulas_say(rate):
    plant = assemble_plant(some_modes(), ports())
    plant = plant.discretized(rate, delay=1) if rate else plant
    weights = stage_weights(plant, 30.0, peak=3.0, disturbance=0.2, effort=0.4, noise=0.01)
    crossing = 48.0
    d, forces, shown = real_axis(plant, crossing)
    force = forces[1]
    # about the force that accelerates the centre: each of four actuators by 1 / mass
    assert force == pytest.approx(0.8 * (2 * np.pi * crossing) ** 2 / (2.0 / MASS), rel=0.02)
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
    # a disturbance at an actuator is nearly of its size: it moves the axes as much
    assert weights.w["amp2"] == pytest.approx(0.2 * force, rel=0.1)
    assert weights.w["y3:noise"] == pytest.approx(0.01 * shown[2] / np.sqrt(3), rel=1e-9)
    # the arm of the rotations: the corners are L / 2 from the axis through the centre
    arm = size(weights.z["die:rx"], 10.0)[0] / size(error, 10.0)[0]
    assert arm == pytest.approx(d[1], rel=1e-9)
    assert arm == pytest.approx(L / 2, rel=0.05)
    weighted = plant.weighted(z=weights.z, w=weights.w)
    assert weighted.dt == plant.dt
    assert "30 Hz" in repr(weights) and len(repr(weights).splitlines()) == 1


def test_forces_have_their_own_units():
    """The dual stage: the long stroke's motor carries both masses, the short stroke's one."""
    plant = fx.testbeds.dual_stage()
    weights = stage_weights(plant, 20.0)
    ratio = weights.w["long:disturbance"] / weights.w["short:disturbance"]
    # (m_long + m_short) and m_short to move the gap and the die
    assert 2.0 < ratio < 8.0
    assert stage_weights(plant, 10.0).w["short:disturbance"] < weights.w["short:disturbance"]


def test_a_reference_of_rotation_has_the_unit_of_its_axis():
    plant = fx.testbeds.hexapod()
    weights = stage_weights(plant, 5.0)
    for axis in ("x", "rx", "rz"):
        name = f"platform_{axis}"
        ratio = size(weights.z[f"{name}:error"], 1.0) / size(weights.z["platform_x:error"], 1.0)
        assert weights.w[f"{name}:ref"] == pytest.approx(1.0 / ratio[0], rel=1e-9)


def test_a_bandwidth_moves_all_frequencies_together():
    plant = sampled(some_modes())
    slow, fast = (stage_weights(plant, f) for f in (10.0, 20.0))
    assert fast.w["amp1"] == pytest.approx(4 * slow.w["amp1"], rel=2e-2)  # the plate bends
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
    few = ports(u=[Actuator("u1", at=INSET[0])], z=[Poi("die", at=OFF_NODE, axes=AXES)])
    few = few.replace(references=[Reference("die", axes=AXES)])
    with pytest.raises(AssumptionError, match="do not move these axes apart"):
        reference_errors(sampled(some_modes(), few))
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


def test_one_of_several_references_is_named():
    edge = Poi("edge", at=(0.1, 0.2, 0.0), axes=AXES)
    both = [Poi("die", at=OFF_NODE, axes=AXES), edge]
    plant = sampled(some_modes(), ports(z=both, references=[Reference("die"), Reference("edge")]))
    with pytest.raises(LabelError, match="no followed POI 'dye'"):
        reference_errors(plant, poi="dye")
    block = reference_errors(plant, poi="edge")
    assert block.inputs[-1] == "edge:ref"
    expected = [rigid_sensor(p, (0.1, 0.2, 0.0), AXES)[0] for p in CORNERS]
    np.testing.assert_allclose(block.D[:, -1], expected, atol=1e-9)
    # both: where the plate is with both points at their references, held otherwise by least force
    together = reference_errors(plant)
    assert together.inputs[-2:] == ("die:ref", "edge:ref")
    places = np.array([[1.0, y, -x] for x, y, _ in (OFF_NODE, (0.1, 0.2, 0.0))])
    body = np.linalg.lstsq(
        np.array([[1.0, y, -x] for x, y, _ in CORNERS]), together.D[:, 4:], rcond=None
    )[0]
    np.testing.assert_allclose(places @ body, np.eye(2), atol=1e-9)
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
    assert resting.z["left:z"] is not None and resting.z["right:z"] is None


@pytest.mark.slow
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

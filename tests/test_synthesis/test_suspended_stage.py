"""A stage on weak springs: servo, weights and error measurements by the geometry of its body."""

from functools import cache

import numpy as np
import pytest

from flexplant.estimation import design_kalman, design_static
from flexplant.loop import close_loop
from flexplant.modes import solve_modes
from flexplant.plant import (
    Actuator,
    Disturbance,
    GroundSpring,
    Poi,
    Ports,
    Reference,
    Sensor,
    assemble_plant,
    reference_errors,
    stage_weights,
    suspend,
)
from flexplant.plant.building import rigid_gain
from flexplant.simulation import simulate
from flexplant.structure import ModalDamping, Spring, kirchhoff_plate, solid_block
from flexplant.synthesis import design_hinf, design_servo
from stages import AXES, CORNERS, INSET, OFF_NODE, L, full, ports, reduced, sampled, some_modes

MASS = L * L * 0.0272 * 2702
INERTIA = MASS * L * L / 12
MODELS = [some_modes, reduced, full]
U = ["u1", "u2", "u3", "u4"]
Z = ["die:z", "die:rx", "die:ry"]


def springs(freq=1.5, zeta=1e-3, points=CORNERS):
    """Springs in the corners: the bounce at a frequency, the rocking at sqrt(3) times it."""
    omega = 2 * np.pi * freq
    k, d = MASS * omega**2 / len(points), 2 * zeta * omega * MASS / len(points)
    return [GroundSpring(p, k, d) for p in points]


@cache
def held(model=some_modes, freq=1.5, die=(L / 2, L / 2, 0.0), axes=AXES):
    channels = ports(z=[Poi("die", at=die, axes=axes)])
    return sampled(suspend(model(), springs(freq)), channels)


def newton(die):
    """Accelerations z, rx, ry at a point per force of each actuator, F = m a of a rigid plate."""
    p = np.asarray(die[:2]) - L / 2
    columns = []
    for place in INSET:
        x, y = np.asarray(place[:2]) - L / 2
        rx, ry = y / INERTIA, -x / INERTIA
        columns.append([1 / MASS + p[1] * rx - p[0] * ry, rx, ry])
    return np.array(columns).T


@pytest.mark.slow
@pytest.mark.parametrize("model", MODELS)
def test_the_rigid_gain_is_newtons_law(model):
    for die in ((L / 2, L / 2, 0.0), OFF_NODE):
        wanted = newton(die)
        found = rigid_gain(sampled(model(), ports(die=die)), Z, U)
        np.testing.assert_allclose(found, wanted, rtol=1e-6, atol=1e-6 * abs(wanted).max())


@cache
def loops(model):
    free, soft = sampled(model()), held(model)
    found = []
    for plant in (free, soft):
        servo = design_servo(plant, bandwidth=50.0, notches=())
        found.append((servo, close_loop(plant, design_kalman(plant), servo)))
    return found


@pytest.mark.slow
def test_the_servo_is_nearly_the_free_ones_and_its_loop_too():
    """By T = pinv(G(sigma)): the mass line is seen above springs of 1 / 33 of the bandwidth."""
    (free, free_loop), (soft, soft_loop) = loops(some_modes)
    for name in "ABCD":
        wanted = getattr(free.system, name)
        np.testing.assert_allclose(
            getattr(soft.system, name), wanted, atol=5e-3 * max(abs(wanted).max(), 1e-300)
        )
    assert soft_loop.spectral_radius < 1
    assert soft_loop.modulus_margin == pytest.approx(free_loop.modulus_margin, rel=5e-2)


@pytest.mark.slow
def test_the_error_settles_on_springs():
    """After a step of the reference, integral action holds the body against its springs."""
    for _, loop in loops(some_modes):
        run = simulate(loop, reference=1e-6, duration=2.0, noise=False)
        error = run["die:error"]
        assert abs(error[0]) > 0.9e-6
        assert np.abs(error[-100:]).max() < 2e-9


@pytest.mark.slow
@pytest.mark.parametrize("bandwidth", [pytest.param(2.0, marks=pytest.mark.long), 10.0, 40.0])
def test_springs_of_any_stiffness_are_held_below_and_above_their_modes(bandwidth):
    """Springs at 6.9 and 12 Hz: on their line, next to their modes, on the mass line."""
    plant = held(freq=6.93)
    servo = design_servo(plant, bandwidth=bandwidth)
    line = {2.0: "spring", 10.0: "mass", 40.0: "mass"}[bandwidth]
    assert f"die:z {line}" in repr(servo)
    assert servo.certificate["modulus margin"] > 0.4


@pytest.mark.parametrize("die", [(L / 2, L / 2, 0.0), OFF_NODE])
def test_error_measurements_and_the_static_relation_are_the_free_ones(die):
    free = sampled(some_modes(), ports(die=die))
    soft = held(die=die)
    # at rest the forces against the springs bend the plate a little: 1.5 Hz beside 245 Hz, squared
    bent = 8.0 * (1.5 / 245.0) ** 2
    static = design_static(soft).gain
    np.testing.assert_allclose(static, design_static(free).gain, atol=bent)
    np.testing.assert_allclose(reference_errors(soft).D, reference_errors(free).D, atol=bent)
    # exactly the static solution: three forces that move the axes, by modes alone
    own = soft.assembled.realisation.model
    shapes = {name: own.row(place, "z") @ own.phi for name, place in zip(U, INSET, strict=True)}
    push = np.array([shapes[name] / own.omega**2 for name in U]).T
    z = np.array([own.row(die, axis) @ own.phi @ push for axis in AXES])
    y = np.array([own.row(place, "z") @ own.phi @ push for place in CORNERS])
    forces = np.linalg.pinv(z)
    np.testing.assert_allclose(static @ y @ forces, np.eye(3), rtol=1e-6, atol=1e-6)


def test_the_static_relation_predicts_the_same_rms_on_springs():
    """But for what the suspension moves beside the relation at rest."""
    free, soft = design_static(sampled(some_modes())), design_static(held())
    assert soft.rms("die") == pytest.approx(free.rms("die"), rel=3e-2)


@pytest.mark.slow
def test_weights_of_a_suspended_stage_are_the_free_ones_and_its_hinf_loop():
    free = sampled(some_modes(count=6, attached=False))
    soft = sampled(suspend(some_modes(count=6, attached=False), springs()))
    gammas = []
    for plant in (free, soft):
        weights = stage_weights(plant, 30.0)
        errors = reference_errors(plant)
        found = design_hinf(plant.through(errors).weighted(z=weights.z, w=weights.w))
        loop = close_loop(plant, errors, found)
        assert loop.spectral_radius < 1
        gammas.append((found.gamma, weights.w["amp1"], loop.modulus_margin))
    np.testing.assert_allclose(gammas[1][1], gammas[0][1], rtol=5e-3)  # (1.5 / 48)^2
    np.testing.assert_allclose(gammas[1], gammas[0], rtol=0.05)


def plate_on_springs(stiffness):
    """A steel plate and where it is held, pushed and seen."""
    plate = kirchhoff_plate(
        size=(0.4, 0.3),
        thickness=0.02,
        elements=(8, 6),
        density=7850.0,
        youngs_modulus=210e9,
        poisson_ratio=0.3,
    )
    corners = [(x, y, 0.0) for x in (0.0, 0.4) for y in (0.0, 0.3)]
    inner = [((x, y, 0.0), "z") for x in (0.1, 0.3) for y in (0.075, 0.225)]
    held = plate.with_parts([Spring(p, stiffness) for p in corners])
    return held, inner, [(p, "z") for p in corners], AXES


def block_on_springs(stiffness, directions):
    """A solid block, in six axes; what no spring holds is free."""
    block = solid_block(
        size=(0.4, 0.3, 0.05),
        elements=(4, 3, 1),
        density=2700.0,
        youngs_modulus=70e9,
        poisson_ratio=0.33,
    )
    corners = [(x, y, z) for x in (0.0, 0.4) for y in (0.0, 0.3) for z in (0.0, 0.05)]
    held = block.with_parts(
        [Spring(p, stiffness, direction=d) for p in corners for d in directions]
    )
    places = [((0, 0, 0), "z"), ((0.4, 0, 0), "z"), ((0, 0.3, 0), "z")]
    places += [((0, 0.1, 0.05), "x"), ((0.1, 0, 0), "y"), ((0.3, 0, 0.05), "y")]
    return held, places, places, ("z", "x", "y", "rx", "ry", "rz")


SUSPENDED = {
    "plate": (plate_on_springs, 4650.0),
    "plate, soft": (plate_on_springs, 4.65e-3),
    "block, six axes": (block_on_springs, 2325.0, "xyz"),
    "block, soft": (block_on_springs, 2.325, "xyz"),
    "block, three axes free": (block_on_springs, 2325.0, "z"),
}


@pytest.mark.slow
@pytest.mark.parametrize("case", SUSPENDED)
def test_hinf_of_plates_and_solids_on_springs_reaches_what_the_weights_require(case):
    make, *how = SUSPENDED[case]
    model, pushed, seen, axes = make(*how)
    at_hand = Ports(
        w=[Disturbance(f"d{i}", at=p, direction=d, asd=1e-3) for i, (p, d) in enumerate(pushed)],
        u=[Actuator(f"u{i}", at=p, direction=d) for i, (p, d) in enumerate(pushed)],
        z=[Poi("die", at=(0.2, 0.15, 0.0), axes=axes)],
        y=[Sensor(f"y{i}", at=p, direction=d, asd=1e-11) for i, (p, d) in enumerate(seen)],
        references=[Reference("die")],
    )
    modes = solve_modes(model, count=10, damping=ModalDamping(0.01))
    plant = assemble_plant(modes, at_hand).discretized(5e3, delay=1)
    errors, weights = reference_errors(plant), stage_weights(plant, 30.0)
    found = design_hinf(plant.through(errors).weighted(z=weights.z, w=weights.w))
    assert found.gamma < 1.0
    assert found.gamma < 1.02 * found.lower
    assert close_loop(plant, errors, found).spectral_radius < 1.0


def test_some_axes_of_a_suspended_body():
    """z and rx alone: the springs hold the third motion."""
    servo = design_servo(held(axes=AXES[:2]), bandwidth=50.0)
    assert servo.system.inputs == ("die:ref", "die:hat", "die:rx:hat")
    assert servo.certificate["spectral radius"] < 1.0

"""A free motion that no POI shows is held by a sensor, or refused; oracle: tests/judge.py."""

import warnings
from itertools import islice

import numpy as np
import pytest

import flexplant as fx
from driven_kinds import gantry
from flexplant.errors import AssumptionError, FlexplantWarning
from judge import judged


def loose(rng):
    """Gantries whose bridge turns freely while no POI shows it, in the order of their seeds."""
    while True:
        plant = gantry(np.random.default_rng(rng.integers(2**32)))
        if plant.n_rigid == 3 and "yaw:rz" not in plant.z:
            yield plant


def two_carts(drives, sensors, axis):
    """Two free masses with a spring-held third on the first; forces and sensors by their places."""
    dofs = fx.DofSet([1, 2, 3], ["x"] * 3, np.arange(3)[:, None] * np.eye(3)[0])
    k = 1e4 * np.array([[1.0, 0.0, -1.0], [0.0, 0.0, 0.0], [-1.0, 0.0, 1.0]])
    slides = np.array([[1.0, 0.0], [0.0, 1.0], [1.0, 0.0]])
    model = fx.FEModel(np.diag([2.0, 3.0, 1.0]), k, dofs=dofs, joint_motions=slides)
    ports = fx.Ports(
        u=[fx.Actuator(f"u{i}", at=at) for i, at in enumerate(drives)],
        z=[fx.Poi("goal", at=axis, axes=("x",))],
        y=[fx.Sensor(name, at=at, **more) for name, (at, more) in sensors.items()],
    )
    return fx.assemble_plant(fx.solve_modes(model, damping=fx.ModalDamping(0.01)), ports)


CARTS = {"one": ("1:x", {}), "two": ("2:x", {})}


def test_a_sensor_is_an_axis_where_no_poi_shows_a_motion():
    found = fx.plant.driven_axes(two_carts(["1:x", "2:x"], CARTS, "1:x"))
    assert found.channels == ("goal:x", "two")
    # an actuator moves one of the carts: the other cannot be held, and is not moved
    assert fx.plant.driven_axes(two_carts(["1:x"], CARTS, "1:x")).channels == ("goal:x",)
    # POIs that show all that moves, and axes that are asked for, stay as they are
    whole = two_carts(["1:x"], CARTS, {"3:x": 1.0, "2:x": -1.0})
    assert fx.plant.driven_axes(whole).channels == ("goal:x",)
    both = two_carts(["1:x", "2:x"], CARTS, "1:x")
    assert fx.plant.driven_axes(both, axes=["goal:x"]).channels == ("goal:x",)
    assert fx.plant.driven_axes(both, poi="goal").channels == ("goal:x",)


@pytest.mark.parametrize(
    ("drives", "sensors", "axis", "lacking"),
    [
        (["1:x", "2:x"], {"one": CARTS["one"]}, "1:x", "Add a displacement sensor"),
        (
            ["1:x", "2:x"],
            {"one": CARTS["one"], "two": ("2:x", {"quantity": "velocity"})},
            "1:x",
            "Add a displacement sensor",
        ),
        # the stretch of the spring alone: with one actuator no axis is left for the motion
        (["1:x"], CARTS, {"3:x": 1.0, "1:x": -1.0}, "Add an actuator"),
    ],
)
def test_a_motion_that_nothing_can_hold_is_named(drives, sensors, axis, lacking):
    plant = two_carts(drives, sensors, axis)
    with pytest.raises(AssumptionError, match=r"rigid-body mode \d \(translation x\)") as said:
        fx.plant.driven_axes(plant)
    assert lacking in str(said.value)
    with pytest.raises(AssumptionError, match=r"would drift"):
        fx.design_servo(plant.discretized(2000.0), bandwidth=1.0)


@pytest.mark.parametrize("seed", range(4))
def test_every_free_motion_has_an_axis(seed):
    """Free masses that random rows show: POIs and chosen sensors have the rank of the motions."""
    rng = np.random.default_rng([77, seed])
    n = int(rng.integers(2, 6))
    p = int(rng.integers(1, n))
    dofs = fx.DofSet(range(1, n + 1), ["x"] * n, np.arange(n)[:, None] * np.eye(3)[0])
    mass, rows = np.exp(rng.standard_normal(n)), rng.standard_normal((p + n + 1, n))

    def at(row):
        return dict(zip(dofs.labels, row.tolist(), strict=True))

    model = fx.FEModel(np.diag(mass), np.zeros((n, n)), dofs=dofs, joint_motions=np.eye(n))
    ports = fx.Ports(
        u=[fx.Actuator(f"u{i}", at=at(row)) for i, row in enumerate(rng.standard_normal((n, n)))],
        z=[fx.Poi(f"p{i}", at=at(row), axes=("x",)) for i, row in enumerate(rows[:p])],
        y=[fx.Sensor(f"y{i}", at=at(row)) for i, row in enumerate(rows[p:])],
    )
    plant = fx.assemble_plant(fx.solve_modes(model), ports)
    found = fx.plant.driven_axes(plant).channels
    assert found[:p] == tuple(f"p{i}:x" for i in range(p))
    assert len(found) == n
    own = [i if name.endswith(":x") else p + int(name[1:]) for i, name in enumerate(found)]
    assert np.linalg.matrix_rank(rows[own] / np.sqrt(mass)) == n


def poles_of(plant, servo):
    """Poles of a plant with a servo that reads the POIs themselves, dense."""
    g, k = plant.system, servo.system
    reads = [name for name in k.inputs if not name.endswith(":ref")]
    seen = [{"tip_x:hat": "tip_x:x", "tip_y:hat": "tip_y:y"}.get(name, name) for name in reads]
    C = g.C[[g.outputs.index(name) for name in seen]]
    B = g.B[:, [g.inputs.index(name) for name in k.outputs]]
    own = [k.inputs.index(name) for name in reads]
    A = np.block([[g.A + B @ k.D[:, own] @ C, B @ k.C], [k.B[:, own] @ C, k.A]])
    return np.linalg.eigvals(A)


@pytest.mark.slow
@pytest.mark.parametrize("seed", range(4))
def test_gantries_that_turn_freely_do_not_drift(seed):
    (plant,) = islice(loose(np.random.default_rng([80, seed])), 1)
    with pytest.warns(FlexplantWarning, match=r"holds Y[12]_scale at zero"):
        servo = fx.design_servo(plant, bandwidth=3.0, notches=())
    assert np.abs(poles_of(plant, servo)).max() < 1.0 - 1e-6
    # the POIs alone: what the design did before, a motion at rest wherever it is
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        alone = fx.design_servo(plant, bandwidth=3.0, notches=(), axes=["tip_x:x", "tip_y:y"])
    assert np.abs(poles_of(plant, alone)).max() > 1.0 - 1e-7


@pytest.mark.slow
@pytest.mark.long
@pytest.mark.parametrize("seed", range(2))
def test_servos_of_gantries_that_turn_freely(seed):
    (plant,) = islice(loose(np.random.default_rng([78, seed])), 1)
    observer = fx.design_kalman(plant)
    held = fx.plant.driven_axes(plant).channels
    assert held[:2] == ("tip_x:x", "tip_y:y")
    assert held[2] in ("Y1_scale", "Y2_scale")
    reach = fx.servo_bandwidth(plant, observer=observer)
    with pytest.warns(FlexplantWarning, match=f"holds {held[2]} at zero"):
        servo = fx.design_servo(plant, bandwidth=0.8 * reach, observer=observer)
    verdict = judged(plant, observer, servo)
    assert verdict.radius < 1.0 - 1e-6
    assert verdict.serves(0.8 * reach)


@pytest.mark.slow
@pytest.mark.long
def test_tuned_loops_of_a_gantry_that_turns_freely():
    (plant,) = islice(loose(np.random.default_rng(79)), 1)
    verdict = judged(plant, fx.tune_loops(plant, progress=False))
    assert verdict.radius < 1.0 - 1e-6
    assert verdict.serves()


@pytest.mark.slow
@pytest.mark.parametrize("seed", range(3))
def test_h_infinity_of_gantries_that_turn_freely(seed):
    (plant,) = islice(loose(np.random.default_rng([81, seed])), 1)
    weights, errors = fx.stage_weights(plant, 3.0), fx.reference_errors(plant)
    (held,) = {"Y1_scale:signal", "Y2_scale:signal"} & set(weights.z)
    assert f"{held.removesuffix(':signal')} held at zero" in repr(weights)
    law = fx.design_hinf(plant.through(errors).weighted(weights))
    verdict = judged(plant, errors, law)
    assert verdict.radius < 1.0 - 1e-6
    assert verdict.serves(3.0)

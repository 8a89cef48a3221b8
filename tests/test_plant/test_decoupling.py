"""gravity_axes: transformations to the centre of gravity, against geometry and a rigid body."""

import numpy as np
import pytest

import flexplant as fx
from flexplant.errors import AssumptionError, LabelError, ModelError
from flexplant.lti import StateSpace, low_pass_filter
from flexplant.plant import (
    Actuator,
    GroundSpring,
    Sensor,
    StandardPlant,
    assemble_plant,
    gravity_axes,
    suspend,
)
from flexplant.plant.axes import force_units
from stages import CORNERS, INSET, NOISE, RATE, Z8, L, full, ports, reduced, some_modes

MASS = 0.6 * 0.6 * 0.0272 * 2702
INERTIA = MASS * 0.6**2 / 12  # bending elements have no rotary inertia of their own


def arms(points, centre=(L / 2, L / 2)):
    """z of each point per z, rx = dz/dy, ry = -dz/dx of the body."""
    return np.array([[1.0, y - centre[1], -(x - centre[0])] for x, y, *_ in points])


@pytest.mark.parametrize("model", [some_modes, reduced, full])
def test_products_are_the_identity(model):
    plant = assemble_plant(model(), ports())
    for base in (plant, plant.discretized(RATE, delay=1)):
        axes = gravity_axes(base)
        assert axes.axes == ("z", "rx", "ry")
        assert axes.to_motions.dt == base.dt
        np.testing.assert_allclose(axes.T_y @ arms(CORNERS), np.eye(3), atol=1e-9)
        np.testing.assert_allclose(arms(INSET).T @ axes.T_u, np.eye(3), atol=1e-9)
        np.testing.assert_allclose(axes.mass, np.diag([MASS, INERTIA, INERTIA]), atol=1e-8)
        np.testing.assert_allclose(axes.centre, [L / 2, L / 2, 0.0], atol=1e-9)
        # least norm: nothing in the null space of four forces on three axes
        null = np.array([1.0, -1.0, -1.0, 1.0])
        np.testing.assert_allclose(null @ axes.T_u, 0.0, atol=1e-9)


def test_the_decoupled_plant_is_a_double_integrator_each_axis():
    plant = assemble_plant(full(), ports())
    axes = gravity_axes(plant)
    assert axes.to_actuators.inputs == ("cog:z:force", "cog:rx:force", "cog:ry:force")
    assert axes.to_motions.outputs == ("cog:z", "cog:rx", "cog:ry")
    s = 2j * np.pi * 0.5  # far below the first elastic mode at 246 Hz
    G = plant.Gyu.select(axes.to_motions.inputs).evaluated(s)
    found = axes.T_y @ G @ axes.accelerations.D * s**2
    np.testing.assert_allclose(found, np.eye(3), atol=1e-4)
    forced = axes.T_y @ G @ axes.T_u * s**2
    np.testing.assert_allclose(forced @ axes.mass, np.eye(3), atol=1e-4)


@pytest.mark.slow
def test_an_added_mass_moves_the_centre():
    axes = gravity_axes(assemble_plant(full(mass=0.5), ports()))
    centre = (MASS * L / 2 + 0.5 * Z8[1]) / (MASS + 0.5)
    np.testing.assert_allclose(axes.centre[:2], [L / 2, centre], rtol=1e-9)
    spread = INERTIA + MASS * (L / 2 - centre) ** 2 + 0.5 * (Z8[1] - centre) ** 2
    np.testing.assert_allclose(np.diag(axes.mass), [MASS + 0.5, spread, INERTIA], rtol=1e-8)
    assert abs(axes.mass[0, 1]) < 1e-9
    np.testing.assert_allclose(axes.T_y @ arms(CORNERS, axes.centre), np.eye(3), atol=1e-9)


def test_on_weak_springs_it_is_the_same():
    free = gravity_axes(assemble_plant(some_modes(), ports()))
    for model, damping in ((some_modes(), 0.5), (some_modes(0.0), 0.0), (reduced(), 0.5)):
        springs = [GroundSpring(p, 300.0, damping) for p in CORNERS]
        plant = assemble_plant(suspend(model, springs), ports())
        assert plant.n_rigid == 0
        held = gravity_axes(plant)
        np.testing.assert_allclose(held.T_y, free.T_y, atol=1e-7)
        np.testing.assert_allclose(held.T_u, free.T_u, atol=1e-7)
        np.testing.assert_allclose(held.mass, free.mass, atol=1e-6)


def test_static_gains_count_and_other_quantities_do_not():
    double = StateSpace([[-9e3]], [[9e3]], [[2.0]], [[0.0]])
    y = [Sensor(f"y{i}", at=p, asd=NOISE, dynamics=double) for i, p in enumerate(CORNERS, 1)]
    y.append(Sensor("v", at=Z8, quantity="velocity", asd=1e-9))
    u = [Actuator(f"u{i}", at=p, dynamics=double) for i, p in enumerate(INSET, 1)]
    axes = gravity_axes(assemble_plant(some_modes(), ports(y=y, u=u)))
    plain = gravity_axes(assemble_plant(some_modes(), ports()))
    assert "v" not in axes.to_motions.inputs
    np.testing.assert_allclose(2 * axes.T_y, plain.T_y, atol=1e-12)
    np.testing.assert_allclose(2 * axes.T_u, plain.T_u, atol=1e-12)


def test_some_axes():
    plant = assemble_plant(some_modes(), ports())
    one = gravity_axes(plant, axes=["rx"])
    np.testing.assert_allclose(one.T_y, gravity_axes(plant).T_y[1:2], atol=1e-12)
    np.testing.assert_allclose(one.mass, [[INERTIA]], rtol=1e-8)
    # two sensors on a line along y tell z and rx, not ry; but at x = L/2 they do not see ry
    y = [Sensor("a", at=(L / 2, 0.1, 0.0)), Sensor("b", at=(L / 2, 0.5, 0.0))]
    two = assemble_plant(some_modes(), ports(y=y, references=[]))
    assert gravity_axes(two, axes=["z", "rx"]).axes == ("z", "rx")
    with pytest.raises(AssumptionError, match=r"'ry' cannot be decoupled.*sensors"):
        gravity_axes(two)
    off = [Sensor("a", at=(0.1, 0.1, 0.0)), Sensor("b", at=(0.1, 0.5, 0.0))]
    with pytest.raises(AssumptionError, match=r"'z' with 'ry'|cannot be decoupled"):
        gravity_axes(assemble_plant(some_modes(), ports(y=off, references=[])), axes=["z", "rx"])


@pytest.mark.slow
def test_what_held_dofs_prevent_is_no_axis():
    hinged = full().fixed(full().dofs.where(directions="z", box=((0, 0, 0), (L, 0, 0))))
    with pytest.raises(AssumptionError, match=r"part in z, ry, against which DOFs .* are held"):
        gravity_axes(assemble_plant(hinged, ports()))
    turning = gravity_axes(assemble_plant(hinged, ports()), axes=["rx"])
    # about the hinge, of what is free to move
    assert turning.mass[0, 0] == pytest.approx(INERTIA + MASS * L**2 / 4, rel=0.02)
    held = full().fixed(full().dofs.where(directions="z", box=((0, 0, 0), (0.1, 0.1, 0))))
    with pytest.raises(ModelError, match="DOFs are held against z, rx, ry"):
        gravity_axes(assemble_plant(held, ports()))


def test_refusals():
    plant = assemble_plant(some_modes(), ports())
    with pytest.raises(LabelError, match="no rigid-body axis 'x'"):
        gravity_axes(plant, axes=["x"])
    with pytest.raises(AssumptionError, match="actuators"):
        gravity_axes(assemble_plant(some_modes(), ports(u=[Actuator("u", at=Z8)])))
    with pytest.raises(ModelError, match="assembled from a structure"):
        gravity_axes(StandardPlant.from_statespace(low_pass_filter(3.0), u=["in"], y=["out"]))
    assert repr(gravity_axes(plant)).startswith(
        "<GravityAxes z, rx, ry at (0.3, 0.3, 0) m: 4 actua"
    )


@pytest.mark.parametrize("seed", range(3))
def test_axes_are_apart_whatever_the_bandwidth(seed):
    """The response is singular far above the modes, as of a robot whose gears are soft there."""
    rng, omega = np.random.default_rng(seed), 2 * np.pi * np.array([1.0, 2.0, 30.0])
    c, b = rng.standard_normal((2, 2)), rng.standard_normal((2, 2))
    more = rng.standard_normal(2)
    c, b = np.column_stack([c, -c @ b @ more / (more @ more)]), np.vstack([b, more])
    xyz = np.arange(3)[:, None] * np.eye(3)[0]
    dofs = fx.DofSet([1, 2, 3], ["x"] * 3, xyz)
    model = fx.FEModel(np.eye(3), np.diag(omega**2), dofs=dofs)

    def plant(b):
        def at(row):
            return dict(zip(dofs.labels, row.tolist(), strict=True))

        drives = [Actuator(f"u{i}", at=at(column)) for i, column in enumerate(b.T)]
        goals = [fx.Poi(f"p{i}", at=at(row), axes=("x",)) for i, row in enumerate(c)]
        modes = fx.solve_modes(model, damping=fx.ModalDamping(1e-4))
        return assemble_plant(modes, fx.Ports(u=drives, z=goals, y=[Sensor("y", at="1:x")]))

    for freq in (0.1, 3.0, 30.0, 3000.0):
        found, sigma = fx.plant.driven_axes(plant(b), freq=freq), 2 * np.pi * freq
        assert found.channels == ("p0:x", "p1:x")
        if freq < 100.0:
            T = np.linalg.inv(c @ np.diag(1 / (sigma**2 + omega**2)) @ b) / sigma**2
            np.testing.assert_allclose(found.T, T, rtol=0, atol=1e-3 * np.abs(T).max())
        with pytest.raises(AssumptionError, match="do not move these axes apart"):
            fx.plant.driven_axes(plant(b[:, [0, 0]]), freq=freq)


def test_the_units_of_unlike_forces_are_kept_and_read_only():
    plant = fx.testbeds.dual_stage()
    units = force_units(plant)
    assert units == {"long": "26.2 N", "short": "1 N"}
    assert force_units(plant) is units
    with pytest.raises(TypeError):
        units["long"] = "N"

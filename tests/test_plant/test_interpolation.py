"""Shapes between the nodes of imported models: exact at nodes, rigid motion, against elements."""

import numpy as np
import pytest

from flexplant import DofSet, load
from flexplant.errors import LabelError, ModelError
from flexplant.modes import solve_modes
from flexplant.plant import Actuator, Poi, Ports, Sensor, assemble_plant
from flexplant.reduction import DesiredDofs, reduce, select_dofs
from flexplant.structure import FEModel, ModalDamping, ScatteredShape, interpolated
from plates import make_plate

RNG = np.random.default_rng(3)
INSIDE = np.column_stack([RNG.uniform(0.02, 0.58, (60, 2)), np.zeros(60)])


def imported(directions=("z", "rx", "ry")):
    """The plate's DOFs as a table would give them: no elements."""
    dofs = make_plate().dofs
    return DofSet(dofs.nodes, dofs.directions, dofs.xyz).where(directions=directions)


def solid(directions=("x", "y", "z"), count=5):
    """Nodes of a block, not on a grid."""
    grid = np.array(np.meshgrid(*[np.linspace(0, 1, count)] * 3)).reshape(3, -1).T
    inner = np.all((grid > 0) & (grid < 1), axis=1)
    grid[inner] += RNG.uniform(-0.05, 0.05, (inner.sum(), 3))
    nodes = grid * [0.4, 0.3, 0.1]
    n = len(directions)
    return DofSet(
        np.repeat(np.arange(1, len(nodes) + 1), n), list(directions) * len(nodes),
        np.repeat(nodes, n, axis=0),
    )  # fmt: skip


def test_exact_at_nodes():
    dofs = interpolated(imported())
    for label in ("1:z", "41:z", "41:rx", "81:ry"):
        row = dofs.row(dofs.xyz[dofs.index(label)], label.split(":")[1])
        np.testing.assert_array_equal(row, np.eye(len(dofs))[dofs.index(label)])


@pytest.mark.parametrize("count", [5, 9])  # smooth everywhere, and nearest nodes of 729
def test_rigid_motion_and_its_rotation_are_exact(count):
    dofs = interpolated(solid(count=count))
    points = RNG.uniform(0.02, 0.98, (10, 3)) * [0.4, 0.3, 0.1]
    shift, turn = np.array([0.3, -1.0, 2.0]), np.array([0.5, 0.2, -0.7])
    u = shift + np.cross(turn, dofs.xyz)
    q = np.array([u[i, "xyz".index(d)] for i, d in enumerate(dofs.directions)])
    wanted = shift + np.cross(turn, points)
    for k, d in enumerate("xyz"):
        np.testing.assert_allclose(dofs.rows(points, d) @ q, wanted[:, k], atol=1e-12)
        np.testing.assert_allclose(dofs.rows(points, f"r{d}") @ q, turn[k], atol=2e-13)


def test_smooth_fields_between_nodes():
    """A quadratic field and its curl: the error falls with the mesh."""
    errors = []
    for count in (4, 7):
        dofs = interpolated(solid(count=count))
        points = RNG.uniform(0.1, 0.9, (40, 3)) * [0.4, 0.3, 0.1]

        def field(p):
            x, y, z = p.T / 0.4
            return np.column_stack([y * z, x**2, x * y + z**2])

        u = field(dofs.xyz)
        q = np.array([u[i, "xyz".index(d)] for i, d in enumerate(dofs.directions)])
        off = max(np.abs(dofs.rows(points, d) @ q - field(points)[:, k]).max()
                  for k, d in enumerate("xyz"))  # fmt: skip
        x, y, _ = points.T / 0.4
        curl = 0.5 * np.column_stack([x, y - y, 2 * x - points[:, 2] / 0.4]) / 0.4
        curl[:, 1] = 0.5 * (y - y) / 0.4  # du/dz - dw/dx = y - y
        turned = max(np.abs(dofs.rows(points, f"r{d}") @ q - curl[:, k]).max()
                     for k, d in enumerate("xyz"))  # fmt: skip
        errors.append((off, turned))
    assert errors[1][0] < 0.01
    assert errors[1][0] < 0.5 * errors[0][0]
    assert errors[1][1] < 0.6 * errors[0][1]


def test_against_the_elements_of_the_plate():
    plate = make_plate()
    modes = solve_modes(plate, count=9)
    for directions, limits in (
        (("z", "rx", "ry"), (0.025, 0.025, 0.025)),
        (("z",), (0.025, 0.15, 0.15)),  # slopes from z alone
    ):
        dofs = interpolated(imported(directions))
        phi = modes.phi[plate.dofs.indices(dofs.labels)]
        for direction, limit in zip(("z", "rx", "ry"), limits, strict=True):
            found = dofs.rows(INSIDE, direction) @ phi
            wanted = plate.dofs.rows(INSIDE, direction) @ modes.phi
            size = np.abs(wanted).max(axis=0)
            # modes 4 to 6: rounding chooses the mixture of the two of one frequency above them
            assert np.all(np.abs(found - wanted).max(axis=0)[3:6] < limit * size[3:6])
            np.testing.assert_allclose(found[:, :3], wanted[:, :3], atol=1e-9)


def test_an_imported_plant_takes_points():
    plate = make_plate()
    bare = FEModel(plate.M, plate.K, dofs=imported())
    model = interpolated(bare)
    ports = Ports(
        u=[Actuator("u", at=(0.15, 0.15, 0.0))],
        y=[Sensor("y", at={(0.1, 0.1, 0.0): 0.5, "81:z": 0.5})],
        z=[Poi("die", at=(0.31, 0.29, 0.0), axes=("z", "rx", "ry"))],
    )
    modes = {m: solve_modes(m, count=12, damping=ModalDamping(0.01)) for m in (plate, model)}
    exact, found = (assemble_plant(modes[m], ports) for m in (plate, model))
    s = 2j * np.pi * 200.0
    np.testing.assert_allclose(found.Gzu.evaluated(s)[:3], exact.Gzu.evaluated(s)[:3], rtol=0.03)
    rom = reduce(modes[model], DesiredDofs(select_dofs(modes[model], 12)))
    small = assemble_plant(rom, ports)
    np.testing.assert_allclose(small.Gzu.evaluated(s), found.Gzu.evaluated(s), rtol=1e-6)
    with pytest.raises(LabelError, match=r"no shape functions.*flexplant.interpolated\(model\)"):
        assemble_plant(solve_modes(bare, count=12), ports)


def test_modes_that_are_already_solved_are_interpolated_as_their_model_is():
    plate = make_plate()
    bare = FEModel(plate.M, plate.K, dofs=imported())
    before = solve_modes(interpolated(bare), count=12)
    after = interpolated(solve_modes(bare, count=12))
    place = (0.123, 0.345, 0.0)
    for direction in ("z", "rx"):
        np.testing.assert_allclose(
            abs(after.row(place, direction)[3:]), abs(before.row(place, direction)[3:]), rtol=1e-6
        )
    reduced = reduce(after, DesiredDofs(select_dofs(after, 12).labels))
    with pytest.raises(ModelError, match="before `reduce`"):
        interpolated(reduced)


def test_sums_of_points_and_labels():
    dofs = interpolated(imported())
    a, b = (0.1, 0.2, 0.0), (0.4, 0.3, 0.0)
    row = dofs.row({a: 2.0, b: -1.0, "7:rx": 3.0}, "z")
    wanted = 2 * dofs.row(a) - dofs.row(b) + 3 * dofs.row("7:rx")
    np.testing.assert_allclose(row, wanted, atol=1e-15)


def test_outside_the_hull_is_an_error_that_says_how_far():
    dofs = interpolated(imported())
    with pytest.raises(LabelError, match=r"0\.05 m outside the nodes with direction 'z'"):
        dofs.row((0.65, 0.3, 0.0))
    with pytest.raises(LabelError, match=r"0\.0136 m outside"):
        dofs.row((0.3, 0.3, 0.0136))
    near = interpolated(imported(), margin=0.014)
    np.testing.assert_allclose(near.row((0.3, 0.3, 0.0136)), dofs.row((0.3, 0.3, 0.0)), atol=1e-11)
    with pytest.raises(LabelError, match="outside"):
        interpolated(solid()).row((0.2, 0.15, 0.11), "x")
    line = DofSet([1, 2, 3], ["x"] * 3, [[0, 0, 0], [1, 0, 0], [2, 0, 0]])
    np.testing.assert_allclose(interpolated(line).row((0.5, 0, 0), "x").sum(), 1.0)
    with pytest.raises(LabelError, match="outside"):
        interpolated(line).row((2.5, 0, 0), "x")


def test_motions_that_are_not_known():
    with pytest.raises(LabelError, match="no motion 'rz'"):
        interpolated(imported(("z",))).row((0.3, 0.3, 0.0), "rz")
    with pytest.raises(LabelError, match="no motion 'x'"):
        interpolated(imported()).row((0.3, 0.3, 0.0), "x")
    with pytest.raises(LabelError, match="direction"):
        interpolated(imported()).row((0.3, 0.3, 0.0), "up")
    flat = interpolated(imported(("z",)))
    flat.row((0.3, 0.3, 0.0), "rx")
    one = DofSet([1], ["z"], [[0, 0, 0]])
    with pytest.raises(LabelError, match="one node"):
        interpolated(one).row((0, 0, 0), "z")
    with pytest.raises(ModelError, match="item must be of type DofSet"):
        interpolated("dofs")
    with pytest.raises(ModelError, match="margin"):
        interpolated(imported(), margin=-1.0)


def test_saves_and_loads(tmp_path):
    dofs = interpolated(imported())
    dofs.save(tmp_path / "d.npz")
    again = load(tmp_path / "d.npz")
    assert isinstance(again.interpolation, ScatteredShape)
    point = (0.123, 0.234, 0.0)
    np.testing.assert_array_equal(again.row(point), dofs.row(point))
    assert repr(again.interpolation).startswith("ScatteredShape(xyz=array (")

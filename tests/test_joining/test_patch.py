"""Patches for meshes that do not match: their mean motion, its bounds, machines in one piece."""

import numpy as np
import pytest
import scipy.linalg as la

import flexplant as fx
from flexplant.errors import LabelError, ModelError
from flexplant.joining.component import components_of
from flexplant.joining.join import compliances

SOLID = {"density": 2700, "youngs_modulus": 70e9, "poisson_ratio": 0.3}


def block(length, elements):
    return fx.solid_block(size=(length, 0.06, 0.04), elements=elements, **SOLID)


def face(name, x):
    return fx.joining.Patch(name, box=[(x - 1e-9, -9, -9), (x + 1e-9, 9, 9)])


@pytest.mark.slow
def test_unlike_meshes_against_one_piece():
    """A bar cut in two, 3 x 2 and 4 x 3 bricks across: as in one piece to 2 %, and no stiffer."""
    left, right = block(0.3, (6, 3, 2)), block(0.3, (6, 4, 3))
    machine = fx.joined(
        {"left": left, "right": right},
        fx.joining.Joint(face("left", 0.3), face("right", 0.3)),
        placed={"right": fx.joining.Pose((0.3, 0, 0))},
    )
    assert machine.joining.n_rigid == 6
    found = fx.solve_modes(machine, count=10).freq[6:]
    whole = [fx.solve_modes(block(0.6, (12, *n)), count=10).freq[6:] for n in ((3, 2), (4, 3))]
    assert np.all(found < 1.001 * np.maximum(*whole))
    np.testing.assert_allclose(found, np.mean(whole, axis=0), rtol=0.02)
    errors = machine.joining.patches
    assert set(errors) == {
        "joint 1, <Patch of left, in a box>",
        "joint 1, <Patch of right, in a box>",
    }
    assert all(0.0 < error < 0.5 for error in errors.values())
    assert "compliance to" in repr(machine.joining)


def test_bounds_of_a_patch_are_those_of_dense_algebra():
    """A load on the mean motion, and on the patch tied rigidly, of a held block."""
    model = block(0.2, (4, 2, 2))
    held = model.fixed(model.dofs.where(box=[(0, -9, -9), (0, 9, 9)]).labels)
    patch = face("bar", 0.2)
    part = components_of({"bar": held}, None)[0]
    mean, rigid = compliances(part, patch, range(6))
    rows, point = patch.rows(held.dofs), patch.point(held.dofs)
    offset = held.dofs.xyz[rows] - point
    A = np.zeros((rows.size, 6))
    for i, (row, (x, y, z)) in enumerate(zip(rows, offset, strict=True)):
        whole = np.array([[1, 0, 0, 0, z, -y], [0, 1, 0, -z, 0, x], [0, 0, 1, y, -x, 0]])
        A[i] = whole["xyz".index(held.dofs.directions[row])]
    K = held.K.toarray()
    F = np.zeros((held.n_dof, 6))
    F[rows] = A @ la.inv(A.T @ A)
    np.testing.assert_allclose(mean, np.diag(F.T @ la.solve(K, F)), rtol=1e-9)
    others = np.setdiff1d(np.arange(held.n_dof), rows)
    T = np.zeros((held.n_dof, 6 + others.size))
    T[rows, :6], T[others, 6 + np.arange(others.size)] = A, 1.0
    np.testing.assert_allclose(rigid, np.diag(la.inv(T.T @ K @ T)[:6, :6]), rtol=1e-7)
    assert np.all(rigid < mean)


def test_the_mean_of_rigid_motion_is_that_motion():
    """Weighted or not; what a line of nodes does not determine is no axis of it."""
    model = block(0.2, (4, 2, 2))
    nodes = np.unique(model.dofs.where(box=[(0.2, -9, -9), (0.2, 9, 9)]).nodes)
    at = (0.2, 0.01, 0.03)
    patch = fx.joining.Patch("bar", nodes, at=at, weights=1.0 + np.arange(nodes.size))
    machine = fx.joined({"bar": model}, fx.joining.Joint(patch, stiffness=[1e5] * 3 + [1e3] * 3))
    motions = machine.rigid_motions(about=at)
    np.testing.assert_allclose(
        motions.T @ (machine.K - model.K) @ motions, np.diag([1e5] * 3 + [1e3] * 3), atol=1e-6
    )
    assert machine.joining.n_rigid == 0
    line = fx.joining.Patch("bar", box=[(0.2, 0, 0), (0.2, 9, 0)])
    with pytest.raises(LabelError, match="has no axis 'ry'"):
        fx.joined({"bar": model}, fx.joining.Joint(line, axes=["ry"], stiffness=1.0))
    with pytest.raises(LabelError, match=r"nodes=.* or box="):
        fx.joining.Patch("bar")
    with pytest.raises(ModelError, match="must be positive"):
        fx.joining.Patch("bar", [1, 2], weights=[1.0, 0.0])


def test_a_component_of_rigid_body_modes_alone_has_no_compliance():
    """All elastic modes truncated: the bounds of its patch are not known, the machine is."""
    size, steel = (0.2, 0.2), {"density": 7800.0, "youngs_modulus": 2.1e11, "poisson_ratio": 0.3}
    plate = fx.kirchhoff_plate(size=size, thickness=0.01, elements=(2, 2), **steel)
    rigid = fx.reduce(fx.solve_modes(plate, count=3), fx.reduction.ModalTruncation(3))
    foot = fx.joining.Patch("lower", box=[(0.0, 0.0, 0.0), (*size, 0.0)])
    with pytest.warns(fx.errors.FlexplantWarning, match="no static shape"):
        machine = fx.joined(
            {"lower": rigid, "upper": plate}, fx.joining.Joint(foot, "upper/5:z", stiffness=1e6)
        )
    assert np.isnan(list(machine.joining.patches.values())).all()
    assert machine.joining.mass == pytest.approx(2 * plate.mass, rel=1e-9)

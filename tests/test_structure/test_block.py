"""The solid block: patch test, bending without locking, rigid-body motions, a dense element."""

import numpy as np
import pytest
import scipy.linalg as la

import oracles_grids as oracle
from flexplant.errors import LabelError, ModelError, ShapeError
from flexplant.structure import BlockShape, FEModel, solid_block

ALU = {"density": 2700.0, "youngs_modulus": 70e9, "poisson_ratio": 0.33}


def make_block(**changes):
    return solid_block(**({"size": (0.4, 0.3, 0.1), "elements": (4, 3, 1)} | ALU | changes))


@pytest.mark.slow
def test_the_element_is_the_oracle_s():
    model = make_block(size=(0.2, 0.5, 0.3), elements=(1, 1, 1))
    M, K = oracle.brick(0.2, 0.5, 0.3, 70e9, 0.33, 2700)
    np.testing.assert_allclose(model.M.toarray(), M, atol=1e-13 * M.max())
    np.testing.assert_allclose(model.K.toarray(), K, atol=1e-12 * K.max())


@pytest.mark.slow
def test_assembly_is_the_oracle_s():
    rng = np.random.default_rng(3)
    missing = np.zeros((3, 2, 2), dtype=bool)
    missing[0, 0, 0] = missing[2, 1, 1] = True
    E, rho = rng.uniform(1e9, 9e9, (3, 2, 2)), rng.uniform(1e3, 3e3, (3, 2, 2))
    model = make_block(elements=(3, 2, 2), youngs_modulus=E, density=rho, holes=missing)
    Me, Ke = oracle.brick(0.4 / 3, 0.15, 0.05, 1.0, 0.33, 1.0)
    n = 4 * 3 * 3
    M, K = np.zeros((3 * n, 3 * n)), np.zeros((3 * n, 3 * n))
    for i, j, k in np.argwhere(~missing):
        nodes = [i + c + 4 * (j + b + 3 * (k + a)) for a in (0, 1) for b in (0, 1) for c in (0, 1)]
        rows = np.array([3 * m + d for m in nodes for d in range(3)])
        M[np.ix_(rows, rows)] += rho[i, j, k] * Me
        K[np.ix_(rows, rows)] += E[i, j, k] * Ke
    there = np.flatnonzero(np.diag(M) > 0)
    assert there.size == 3 * (n - 2)
    np.testing.assert_array_equal(np.unique(there // 3) + 1, np.unique(model.dofs.nodes))
    for ours, theirs in ((model.M, M), (model.K, K)):
        theirs = theirs[np.ix_(there, there)]
        np.testing.assert_allclose(ours.toarray(), theirs, atol=1e-12 * theirs.max())
        assert abs(ours - ours.T).max() == 0


def test_patch_of_constant_strain():
    model = make_block(elements=(3, 2, 2))
    gradient = np.array([[0.1, -0.2, 0.3], [0.5, 0.2, -0.4], [0.3, 0.1, 0.6]])
    q = (model.dofs.xyz[::3] @ gradient.T).ravel()
    strain = 0.5 * (gradient + gradient.T)
    lame, shear = 70e9 * 0.33 / 1.33 / 0.34, 70e9 / 2 / 1.33
    energy = lame * np.trace(strain) ** 2 + 2 * shear * np.sum(strain**2)
    assert q @ (model.K @ q) == pytest.approx(energy * 0.4 * 0.3 * 0.1, rel=1e-12)


def test_bending_is_not_locked():
    # one brick over the height; Poisson's ratio 0 makes the beam formula exact for pure bending
    model = make_block(size=(1.0, 0.02, 0.02), elements=(20, 1, 1), poisson_ratio=0.0)
    x, _, z = model.dofs.xyz[::3].T
    q = np.column_stack([-x * (z - 0.01), 0 * x, 0.5 * x**2]).ravel()
    assert q @ (model.K @ q) == pytest.approx(70e9 * 0.02**4 / 12, rel=1e-8)
    squares = la.eigvalsh(model.K.toarray(), model.M.toarray())
    exact = 4.730040745**2 * np.sqrt(70e9 * 0.02**2 / 12 / 2700)
    # bricks without incompatible modes are off by a factor of three here
    np.testing.assert_allclose(np.sqrt(squares[6:8]), exact, rtol=0.005)


@pytest.mark.slow
def test_thin_block_beside_quadratic_bricks_of_scikit_fem():
    skfem = pytest.importorskip("skfem")
    from skfem.helpers import ddot, dot, eye, sym_grad, trace

    lame, shear = 70e9 * 0.33 / 1.33 / 0.34, 70e9 / 2 / 1.33
    stiffness = skfem.BilinearForm(
        lambda u, v, _: ddot(
            2 * shear * sym_grad(u) + lame * eye(trace(sym_grad(u)), 3), sym_grad(v)
        )
    )
    mass = skfem.BilinearForm(lambda u, v, _: 2700.0 * dot(u, v))
    mesh = skfem.MeshHex.init_tensor(
        *(np.linspace(0, a, k + 1) for a, k in ((0.4, 6), (0.3, 4), (0.02, 1)))
    )
    basis = skfem.Basis(mesh, skfem.ElementVector(skfem.ElementHex2()), intorder=4)
    exact = la.eigvalsh(stiffness.assemble(basis).toarray(), mass.assemble(basis).toarray())[6:10]
    block = make_block(size=(0.4, 0.3, 0.02), elements=(12, 9, 1))
    found = la.eigvalsh(block.K.toarray(), block.M.toarray(), subset_by_index=(6, 9))
    np.testing.assert_allclose(np.sqrt(found), np.sqrt(exact), rtol=0.02)


def test_six_rigid_body_motions():
    model = make_block()
    R = model.rigid_body
    assert R.shape == (120, 6)
    np.testing.assert_allclose(R.T @ (model.M @ R), np.eye(6), atol=1e-12)
    assert np.abs(model.K @ R).max() < 1e-12 * np.abs(abs(model.K) @ np.abs(R)).max()
    assert model.mass == pytest.approx(2700 * 0.012, rel=1e-12)
    # the constructor accepts them
    FEModel(model.M, model.K, dofs=model.dofs)


def test_interpolation():
    model = make_block(elements=(3, 2, 2))
    rng = np.random.default_rng(1)
    shift, turn = rng.standard_normal(3), rng.standard_normal(3)
    q = (shift + np.cross(turn, model.dofs.xyz[::3])).ravel()
    for point in rng.uniform(0, 1, (5, 3)) * (0.4, 0.3, 0.1):
        moved = [model.dofs.row(point, d) @ q for d in ("x", "y", "z", "rx", "ry", "rz")]
        np.testing.assert_allclose(moved, [*(shift + np.cross(turn, point)), *turn], atol=1e-12)
    for label, xyz in list(zip(model.dofs, model.dofs.xyz, strict=True))[::7]:
        row = model.dofs.row(xyz, label.split(":")[1])
        np.testing.assert_allclose(row, model.dofs.row(label), atol=1e-12)
    for at, d in [((0.5, 0, 0), "z"), ((0.1, 0.1, -0.1), "x"), ((0.1, 0.1, 0.1), "w")]:
        with pytest.raises(LabelError, match=r"outside the block|direction|no motion"):
            model.dofs.row(at, d)
    with pytest.raises(LabelError, match="no motion"):
        BlockShape((1, 1, 1), (1, 1, 1)).row(np.zeros(3), "w")


def test_points_in_a_hole_are_refused():
    model = make_block(holes=lambda x, y, z: x < 0.1 and y < 0.1)
    with pytest.raises(LabelError, match="in a hole"):
        model.dofs.row((0.05, 0.05, 0.05), "z")
    # its edge belongs to the neighbour
    assert model.dofs.row((0.1, 0.05, 0.05), "z").sum() == pytest.approx(1)
    assert "1:x" not in model.dofs


@pytest.mark.parametrize(
    ("changes", "error", "says"),
    [
        ({"size": (1, 1)}, ShapeError, "size"),
        ({"elements": (1, 1)}, ShapeError, "3 whole numbers"),
        ({"elements": (0, 1, 1)}, ModelError, "elements along x"),
        ({"poisson_ratio": 0.5}, ModelError, "poisson_ratio"),
        ({"poisson_ratio": [0.3, 0.3]}, ShapeError, "poisson_ratio"),
        ({"density": 0}, ModelError, "density"),
        ({"holes": np.ones((4, 3, 1), dtype=bool)}, ModelError, "nothing at all"),
        ({"holes": lambda x, y, z: 0.1 < x < 0.3}, ModelError, "2 separate pieces"),
        ({"holes": np.ones((4, 3), dtype=bool)}, ShapeError, "mask"),
        ({"holes": "round"}, ModelError, "holes must be"),
    ],
)
def test_bad_blocks(changes, error, says):
    with pytest.raises(error, match=says):
        make_block(**changes)


def test_pieces_that_touch_at_an_edge_only_are_refused():
    # a hinge, not a joint
    holes = np.zeros((2, 2, 1), dtype=bool)
    holes[0, 0], holes[1, 1] = True, True
    with pytest.raises(ModelError, match="2 separate pieces"):
        make_block(elements=(2, 2, 1), holes=holes)


def test_reprs():
    assert (
        repr(make_block().dofs.interpolation)
        == "BlockShape(size=[0.4, 0.3, 0.1], elements=[4, 3, 1], poisson_ratio=0.33)"
    )


@pytest.mark.parametrize("axis", [0, 1])
def test_a_bent_block_is_known_between_its_nodes(axis):
    """Pure bending with its curvature across: exact displacements and rotations at any point."""
    block, nu, size = make_block(), 0.33, np.array([0.4, 0.3, 0.1])

    def bent(points):
        along, across, z = points[..., axis], points[..., 1 - axis], points[..., 2]
        found = np.zeros(points.shape)
        found[..., axis], found[..., 1 - axis] = along * z, -nu * across * z
        found[..., 2] = -0.5 * (along**2 + nu * (z**2 - across**2))
        return found

    own = np.array(block.dofs.xyz), [("x", "y", "z").index(d) for d in block.dofs.directions]
    u = np.take_along_axis(bent(own[0]), np.array(own[1])[:, None], axis=1)[:, 0]
    for point in np.random.default_rng(4).random((6, 3)) * size:
        step = 1e-4
        slopes = [(bent(point + step * e) - bent(point - step * e)) / (2 * step) for e in np.eye(3)]
        G = np.array(slopes)  # G[i, j]: slope of j along i
        curl = [G[1, 2] - G[2, 1], G[2, 0] - G[0, 2], G[0, 1] - G[1, 0]]
        wanted = [*bent(point), *(0.5 * np.array(curl))]
        found = [block.dofs.row(tuple(point), d) @ u for d in ("x", "y", "z", "rx", "ry", "rz")]
        np.testing.assert_allclose(found, wanted, atol=1e-10)

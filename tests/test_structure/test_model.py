"""FEModel: its constructor, its rigid-body motions, its damping matrix."""

import pickle

import numpy as np
import pytest
import scipy.sparse as sp

import oracles_structure as oracle
from flexplant import DofSet, load
from flexplant.errors import ModelError, ShapeError, SolverError
from flexplant.sparse.factor import is_positive_definite, negative_pivots, symmetric_lu
from flexplant.sparse.symmetric import orthonormalised
from flexplant.structure import FEModel, ModalDamping, Rayleigh
from plates import make_plate

CHAIN = DofSet([1, 2, 3], ["x"] * 3, [[0, 0, 0], [1, 0, 0], [2, 0, 0]])
M3 = np.diag([1.0, 2.0, 3.0])
K3 = np.array([[5.0, -5, 0], [-5, 12, -7], [0, -7, 7]])


@pytest.fixture(scope="module")
def plate():
    return make_plate()


def test_chain_knows_itself():
    model = FEModel(M3, K3, dofs=CHAIN, name="chain")
    assert model.n_dof == 3
    assert model.mass == 6.0
    np.testing.assert_allclose(model.rigid_body, np.full((3, 1), 1 / np.sqrt(6)), rtol=1e-14)
    assert repr(model) == "<FEModel 'chain': 3 DOFs, dense, 1 rigid-body motion, D not given>"


def test_rigid_body_motions_of_the_plate(plate):
    R = plate.rigid_body
    assert R.shape == (243, 3)
    np.testing.assert_allclose(R.T @ (plate.M @ R), np.eye(3), atol=1e-13)
    assert np.abs(plate.K @ R).max() < 1e-12 * np.abs(abs(plate.K) @ np.abs(R)).max()
    xy = plate.dofs.xyz[::3, :2] - 0.3
    mass = 0.36 * 0.0272 * 2702
    # z; then rx about the centre (z = y rx); then ry (z = -x ry)
    np.testing.assert_allclose(R[::3, 0], 1 / np.sqrt(mass), rtol=1e-12)
    np.testing.assert_allclose(R[::3, 1], xy[:, 1] / np.sqrt(mass * 0.03), atol=1e-13)
    np.testing.assert_allclose(R[::3, 2], -xy[:, 0] / np.sqrt(mass * 0.03), atol=1e-13)
    np.testing.assert_allclose(R[1::3, 1], 1 / np.sqrt(mass * 0.03), rtol=1e-12)
    np.testing.assert_allclose(R[2::3, 2], 1 / np.sqrt(mass * 0.03), rtol=1e-12)


def test_rotation_is_about_the_centre_of_gravity(plate):
    e = plate.dofs.row("1:z")
    heavy = FEModel(plate.M.toarray() + 5 * np.outer(e, e), plate.K, dofs=plate.dofs)
    R = heavy.rigid_body
    translation = np.tile([1.0, 0, 0], 81)
    np.testing.assert_allclose(translation @ (heavy.M @ R[:, 1:]), 0, atol=1e-12)
    np.testing.assert_allclose(R.T @ (heavy.M @ R), np.eye(3), atol=1e-13)


def test_held_structures_have_fewer(plate):
    K = plate.K.toarray()
    corners = plate.dofs.indices(["1:z", "9:z", "73:z"])
    held = K.copy()
    held[corners, corners] += 1e6
    assert FEModel(plate.M, held, dofs=plate.dofs).rigid_body.shape == (243, 0)
    # one support left out: a hinge about the line through the other two, no axis-parallel motion
    hinge = K.copy()
    hinge[corners[1:], corners[1:]] += 1e6
    R = FEModel(plate.M, hinge, dofs=plate.dofs).rigid_body
    assert R.shape == (243, 1)
    np.testing.assert_allclose(R[corners[1:], 0], 0, atol=1e-12)
    assert np.abs(hinge @ R).max() < 1e-10 * np.abs(np.abs(hinge) @ np.abs(R)).max()
    # a soft mount is a stiffness all the same
    soft = K.copy()
    soft[corners, corners] += 1e3
    assert FEModel(plate.M, soft, dofs=plate.dofs).rigid_body.shape == (243, 0)


def test_six_motions_of_a_solid_body():
    rng = np.random.default_rng(3)
    xyz = rng.standard_normal((5, 3))
    dofs = DofSet(np.repeat(np.arange(1, 6), 3), ["x", "y", "z"] * 5, np.repeat(xyz, 3, axis=0))
    K = np.zeros((15, 15))
    for i in range(5):
        for j in range(i):
            along = np.zeros(15)
            unit = (xyz[i] - xyz[j]) / np.linalg.norm(xyz[i] - xyz[j])
            along[3 * i : 3 * i + 3], along[3 * j : 3 * j + 3] = unit, -unit
            K += 1e4 * np.outer(along, along)
    model = FEModel(np.kron(np.diag([1.0, 2, 3, 4, 5]), np.eye(3)), K, dofs=dofs)
    R = model.rigid_body
    assert R.shape == (15, 6)
    assert np.abs(K @ R).max() < 1e-9
    assert model.mass == pytest.approx(15)
    np.testing.assert_allclose(
        R[:, :3] @ np.diag(1 / R[0:3, :3].diagonal()), np.tile(np.eye(3), (5, 1)), atol=1e-12
    )


def test_rigid_body_motions_far_from_the_origin(plate):
    xyz = plate.dofs.xyz + np.array([300.0, -200, 5])
    far = FEModel(
        plate.M, plate.K, dofs=DofSet(plate.dofs.nodes, plate.dofs.directions, xyz)
    ).rigid_body
    np.testing.assert_allclose(far, plate.rigid_body, atol=1e-11)


def test_fewer_dofs_than_motions():
    dofs = DofSet([1, 2], ["z", "z"], [[0, 0, 0], [1, 0, 0]])
    assert FEModel(np.eye(2), np.zeros((2, 2)), dofs=dofs).rigid_body.shape == (2, 2)
    assert FEModel(np.eye(2), [[1, -1], [-1, 1]], dofs=dofs).rigid_body.shape == (2, 1)
    single = DofSet([1], ["z"], [[0.3, 0.2, 0.1]])
    R = FEModel([[2.0]], [[0.0]], dofs=single).rigid_body
    np.testing.assert_allclose(R, [[1 / np.sqrt(2)]], rtol=1e-15)


@pytest.mark.parametrize(
    ("changes", "error", "says"),
    [
        ({"M": np.eye(4)}, ShapeError, "shape"),
        ({"K": np.ones((3, 2))}, ShapeError, "shape"),
        ({"K": sp.eye_array(4)}, ShapeError, "shape"),
        ({"M": np.diag([1, np.nan, 1])}, ModelError, "NaN"),
        ({"K": sp.csc_array(np.diag([1, np.inf, 1]))}, ModelError, "NaN or infinite"),
        ({"M": np.diag([1, -1, 1])}, ModelError, "positive definite"),
        ({"M": np.diag([1, 0, 1])}, ModelError, "positive definite"),
        ({"M": [[1, 2, 0], [2, 1, 0], [0, 0, 1]]}, ModelError, "lowest eigenvalue is -1"),
        ({"M": sp.csc_array(np.diag([1.0, 0, 1]))}, ModelError, "diagonal entry 1"),
        ({"K": K3 + np.triu(np.full((3, 3), 1e-3), 1)}, ModelError, "not symmetric: entry"),
        ({"K": sp.csc_array(K3 + np.triu(np.ones((3, 3)), 1))}, ModelError, "not symmetric"),
        ({"K": -K3}, ModelError, "positive semi-definite"),
        ({"D": -np.eye(3)}, ModelError, "feed energy"),
        ({"K": 1j * K3}, ModelError, "complex"),
        ({"M": [["a"] * 3] * 3}, ModelError, "numbers"),
        ({"dofs": "1:x"}, ModelError, "DofSet"),
    ],
)
def test_the_door(changes, error, says):
    given = {"M": M3, "K": K3, "D": None, "dofs": CHAIN} | changes
    with pytest.raises(error, match=says):
        FEModel(given["M"], given["K"], given["D"], dofs=given["dofs"])


def test_no_dofs_are_refused():
    empty = np.zeros((0, 0))
    with pytest.raises(ModelError, match="DofSet is empty"):
        FEModel(empty, empty, dofs=DofSet([], [], np.zeros((0, 3))))


def test_mass_needs_a_translation():
    dofs = DofSet([1], ["rx"], [[0, 0, 0]])
    with pytest.raises(ModelError, match="translational"):
        _ = FEModel([[1.0]], [[0.0]], dofs=dofs).mass


def test_rounding_is_no_asymmetry():
    K = K3.copy()
    K[0, 1] *= 1 + 1e-12
    FEModel(M3, K, dofs=CHAIN)


def test_given_sparse_matrices_stay_as_they_are():
    rows = np.tile([2, 1, 0], 3)  # out of order
    K = sp.csc_array((K3[::-1].T.ravel(), rows, np.arange(0, 10, 3)), shape=(3, 3))
    assert np.array_equal(FEModel(sp.csc_array(M3), K, dofs=CHAIN).K.toarray(), K3)
    assert np.array_equal(K.indices, rows)
    assert np.array_equal(K.toarray(), K3)


def test_matrices_with_one_pattern_share_it(plate):
    """So that a large model has it once; nobody can write to it."""
    D = sp.csc_array((1e-5 * plate.K.data, plate.K.indices, plate.K.indptr), shape=plate.K.shape)
    free = FEModel(plate.M, plate.K, D, dofs=plate.dofs)
    for model in (free, free.replace(name="other")):
        for matrix in (model.M, model.D):
            assert np.shares_memory(matrix.indices, model.K.indices)
            assert not matrix.indices.flags.writeable
    other = FEModel(sp.diags_array(plate.M.diagonal()), plate.K, dofs=plate.dofs)
    assert other.M.nnz == plate.n_dof


def test_values_are_frozen_and_travel(plate, tmp_path):
    model = plate.with_damping(ModalDamping(0.01))
    with pytest.raises(ValueError, match="read-only"):
        model.D[0, 0] = 1
    with pytest.raises(ValueError, match="read-only"):
        plate.K.data[0] = 1
    with pytest.raises(ValueError, match="read-only"):
        plate.rigid_body[0, 0] = 1
    model.save(tmp_path / "plate.npz")
    for other in (pickle.loads(pickle.dumps(model)), load(tmp_path / "plate.npz")):
        assert abs(other.M - model.M).max() == 0
        assert np.array_equal(other.D, model.D)
        assert other.dofs.labels == model.dofs.labels
        point = (0.123, 0.234, 0)
        assert np.array_equal(other.dofs.row(point, "rx"), model.dofs.row(point, "rx"))
        with pytest.raises(ValueError, match="read-only"):
            other.M.data[0] = 0


def test_modal_damping_matrix_is_the_oracle_s(plate):
    M, K = oracle.plate_matrices(8, 8)
    expected = oracle.modal_damping_matrix(M, K, 0.01)
    D = plate.with_damping(ModalDamping(0.01)).D
    scale = np.sqrt(np.outer(np.diag(expected), np.diag(expected)))
    assert np.abs((D - expected) / scale).max() < 1e-8
    assert np.array_equal(D, D.T)
    assert np.abs(D @ plate.rigid_body).max() < 1e-8


def test_modal_damping_mode_by_mode():
    model = FEModel(M3, K3, dofs=CHAIN).with_damping(ModalDamping([0.5, 0.01, 0.03]))
    omega, phi = oracle.undamped(M3, K3, 1)
    np.testing.assert_allclose(
        phi.T @ model.D @ phi, np.diag(2 * np.array([0, 0.01, 0.03]) * omega), atol=1e-13
    )
    with pytest.raises(ShapeError, match="2 damping ratios for 3 modes"):
        FEModel(M3, K3, dofs=CHAIN).with_damping(ModalDamping([0.01, 0.01]))


def test_rayleigh_damping_matrix(plate):
    D = plate.with_damping(Rayleigh(alpha=0.0, beta=1e-6)).D
    assert sp.issparse(D)
    assert abs(D - 1e-6 * plate.K).max() == 0
    # rigid-body motions of a free structure stay undamped, elastic ones are
    free = FEModel(M3, K3, dofs=CHAIN).with_damping(Rayleigh(alpha=2.0, beta=0.1))
    omega, phi = oracle.undamped(M3, K3, 1)
    rate = np.diag(phi.T @ free.D @ phi)
    np.testing.assert_allclose(rate, [0, *(2.0 + 0.1 * omega[1:] ** 2)], atol=1e-12)
    held = FEModel(M3, K3 + np.eye(3), dofs=CHAIN).with_damping(Rayleigh(alpha=2.0, beta=0.1))
    np.testing.assert_allclose(held.D, 2 * M3 + 0.1 * (K3 + np.eye(3)), rtol=1e-14)


def test_with_damping_refuses_other_things(plate):
    with pytest.raises(ModelError, match="ModalDamping, a Rayleigh or a matrix D"):
        plate.with_damping(0.01)
    with pytest.raises(ModelError, match="too large"):
        make_plate(elements=(45, 45)).with_damping(ModalDamping(0.01))


@pytest.mark.slow
def test_large_sparse_models_are_checked_too():
    large = make_plate(elements=(24, 24))
    FEModel(large.M, large.K, dofs=large.dofs)
    n = large.n_dof
    # the diagonal stays positive: only the factorisation can tell
    coupled = sp.lil_array(large.M)
    i, j = large.dofs.index("1:z"), large.dofs.index("2:z")
    coupled[i, j] = coupled[j, i] = 2 * np.sqrt(coupled[i, i] * coupled[j, j])
    with pytest.raises(ModelError, match="negative pivots"):
        FEModel(sp.csc_array(coupled), large.K, dofs=large.dofs)
    with pytest.raises(ModelError, match="semi-definite"):
        FEModel(large.M, large.K - 1e9 * sp.eye_array(n), dofs=large.dofs)


def test_inertia_counts_eigenvalues_below_a_shift(plate):
    squares = np.linalg.eigvals(np.linalg.solve(plate.M.toarray(), plate.K.toarray())).real
    for shift in (1e6, 1e7, 1e9):
        count = negative_pivots(symmetric_lu(plate.K - shift * plate.M))
        assert count == np.count_nonzero(squares < shift)


def test_factorisation_refuses_zero_pivots():
    with pytest.raises(SolverError, match="zero pivot"):
        symmetric_lu(sp.csc_array(np.array([[0.0, 1], [1, 0]])))
    with pytest.raises(SolverError, match="singular"):
        symmetric_lu(sp.csc_array(np.zeros((2, 2))))
    assert not is_positive_definite(np.array([[0.0, 0], [0, 1]]))


def test_orthonormalised_refuses_dependent_vectors():
    with pytest.raises(ModelError, match="vector 2"):
        orthonormalised(np.eye(3), np.ones((3, 2)))


def test_a_model_without_dofs_numbers_its_rows():
    K = np.array([[5.0, -5.0], [-5.0, 5.0]])
    model = FEModel(np.diag([1.0, 2.0]), K)
    assert model.dofs.labels == ("1:x", "2:x") and model.rigid_body.shape == (2, 1)
    with pytest.raises(ShapeError, match="K must be square"):
        FEModel(np.eye(2), K[:1])

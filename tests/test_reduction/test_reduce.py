"""reduce: equations (6) to (8), rigid-body zeros, refusals."""

import pickle

import numpy as np
import pytest

import oracles_structure as oracle
from flexplant import DofSet, load
from flexplant.errors import LabelError, ModelError, ShapeError
from flexplant.modes import solve_modes
from flexplant.reduction import DesiredDofs, ReducedModel, reduce, select_dofs
from flexplant.structure import FEModel, ModalDamping
from plates import make_plate

Z8 = "23:z"
CENTRE = "41:z"


@pytest.fixture(scope="module")
def plate():
    return make_plate()


def grid_of(plate):
    """Every second node."""
    steps = [0.15 * i for i in range(5)]
    return [plate.dofs.nearest((x, y, 0), "z") for y in steps for x in steps]


def reduced(plate, vector=False):
    modes = solve_modes(
        plate, count=24, damping=ModalDamping(0.01), compliance_at=[Z8] if vector else ()
    )
    grid = [label for label in grid_of(plate) if vector or label != CENTRE]
    return modes, reduce(modes, DesiredDofs(grid))


def test_condition_of_the_paper_s_grid(plate):
    _, model = reduced(plate)
    assert model.condition == pytest.approx(9.68, abs=0.005)
    # oracle: the same rows of dense modes, up to the rotation of repeated pairs
    _, phi = oracle.undamped(*oracle.plate_matrices(8, 8))
    xy = oracle.nodes(8, 8)
    rows = [
        3 * i
        for i, (x, y) in enumerate(xy)
        if round(x / 0.075) % 2 == 0 and round(y / 0.075) % 2 == 0 and (x, y) != (0.3, 0.3)
    ]
    assert len(rows) == 24
    assert model.condition == pytest.approx(np.linalg.cond(phi[rows, :24]), rel=1e-9)
    assert [plate.dofs.index(label) for label in model.dofs] == rows


@pytest.mark.parametrize("vector", [False, True])
def test_poles_are_kept(plate, vector):
    modes, model = reduced(plate, vector)
    found = model.modes()
    omega, zeta = modes.basis_omega, modes.basis_zeta
    expected = omega * (-zeta + 1j * np.sqrt(1 - zeta**2))
    assert np.array_equal(found.poles[:3], np.zeros(3))
    assert np.abs(found.poles[3:] / expected[3:] - 1).max() < 1e-11
    assert found.n_rigid == 3
    assert not np.iscomplexobj(found.phi)
    # against the oracle's own poles, without this package's modes
    w, _ = oracle.undamped(*oracle.plate_matrices(8, 8))
    np.testing.assert_allclose(np.abs(found.poles[3:24]), w[3:24], rtol=1e-9)


def test_matrices_are_those_of_equation_8(plate):
    modes, model = reduced(plate)
    rows = plate.dofs.indices(model.dofs)
    phi = modes.phi[rows]
    for matrix, diagonal in (
        (model.M, np.ones(24)),
        (model.D, 2 * modes.zeta * modes.omega),
        (model.K, modes.omega**2),
    ):
        np.testing.assert_allclose(
            phi.T @ matrix @ phi, np.diag(diagonal), atol=1e-11 * diagonal.max()
        )
        assert np.abs(matrix - matrix.T).max() < 1e-14 * np.abs(matrix).max()
    np.testing.assert_allclose(model.T @ phi, modes.phi, atol=1e-12)
    np.testing.assert_allclose(model.T[rows], np.eye(24), atol=1e-12)


@pytest.mark.parametrize("vector", [False, True])
def test_rigid_body_motions_are_carried_along(plate, vector):
    _, model = reduced(plate, vector)
    R = model.rigid_body
    np.testing.assert_allclose(R.T @ model.M @ R, np.eye(3), atol=1e-12)
    assert np.abs(model.K @ R).max() < 1e-11 * np.abs(np.abs(model.K) @ np.abs(R)).max()
    np.testing.assert_allclose(model.expand(R), plate.rigid_body, atol=1e-12)
    # an added mass moves the centre of gravity; the motions stay, their shapes are made anew
    e = model.row(Z8)
    heavier = model.replace(M=model.M + 0.5 * np.outer(e, e)).modes()
    assert np.array_equal(heavier.poles[:3], np.zeros(3))
    gram = heavier.phi[:, :3].T @ (model.M + 0.5 * np.outer(e, e)) @ heavier.phi[:, :3]
    np.testing.assert_allclose(gram, np.eye(3), atol=1e-12)


@pytest.mark.slow
def test_a_mass_on_the_reduced_model_gives_the_truth(plate):
    # oracle: first-order poles of the dense full model with the mass
    M, K = oracle.plate_matrices(8, 8)
    D = oracle.modal_damping_matrix(M, K, 0.01)
    row = 3 * (2 * 9 + 4)
    M[row, row] += 0.5
    expected = oracle.poles(M, D, K)[2:4]
    np.testing.assert_allclose(expected[0], -28.569 + 2883.567j, atol=1e-3)

    def error(vector):
        _, model = reduced(plate, vector)
        e = model.row(Z8)
        found = model.replace(M=model.M + 0.5 * np.outer(e, e)).modes().poles[5:7]
        return np.abs(found / expected - 1).max()

    assert 5e-5 < error(False) < 5e-3  # the truncated compliance at z8
    assert error(True) < 1e-6


def test_rows_and_expansion(plate):
    modes, model = reduced(plate, vector=True)
    q = np.arange(25.0)
    full = model.expand(q)
    assert full.shape == (243,)
    for i, label in enumerate(model.dofs):
        assert full[plate.dofs.index(label)] == pytest.approx(q[i], abs=1e-10)
        np.testing.assert_allclose(model.row(label), np.eye(25)[i], atol=1e-12)
    point = (0.137, 0.411, 0)
    assert model.row(point, "rx") @ q == pytest.approx(plate.dofs.row(point, "rx") @ full)
    assert model.expand(np.eye(25)).shape == (243, 25)
    both = model.expand(q + 2j * q)
    np.testing.assert_allclose(both, full * (1 + 2j))
    found = model.modes()
    # of repeated modes any basis may come: the sum of their squares is theirs alone
    omega = modes.basis_omega
    group = np.cumsum(np.diff(omega, prepend=0.0) > 1e-6 * omega)
    squares = [
        np.bincount(group, weights=shape**2)
        for shape in (found.at(Z8), modes.basis[modes.dofs.index(Z8)])
    ]
    assert len(squares[0]) < 20
    np.testing.assert_allclose(*squares, atol=1e-9 * squares[1].max())


def test_complex_modes_after_a_damper(plate):
    _, model = reduced(plate)
    e = model.row("1:z") - model.row("2:z")
    damped = model.replace(D=model.D + 20 * np.outer(e, e)).modes()
    assert np.iscomplexobj(damped.phi)
    assert np.array_equal(damped.poles[:3], np.zeros(3))
    assert np.all(damped.poles[3:].real < model.modes().poles[3:].real + 1e-9)
    ground = np.outer(model.row("1:z"), model.row("1:z"))
    with pytest.raises(ModelError, match="rigid-body"):
        model.replace(D=model.D + 100 * ground).modes()


@pytest.mark.parametrize(("count", "vectors", "given"), [(24, 0, 25), (24, 1, 24), (20, 2, 21)])
def test_wrong_count_prints_both(plate, count, vectors, given):
    modes = solve_modes(plate, count=count, compliance_at=["1:z", "9:z"][:vectors])
    grid = grid_of(plate)[:given]
    with pytest.raises(ShapeError) as raised:
        reduce(modes, DesiredDofs(grid))
    text = str(raised.value)
    assert f"{given} desired DOFs for {count} modes plus {vectors} attachment vectors" in text
    assert "select_dofs" in text


def test_near_singular_partition_says_so(plate):
    modes = solve_modes(plate, count=24)
    # 24 nodes along two edges cannot tell the modes apart
    edge = [plate.dofs.nearest((0.075 * i, y, 0)) for i in range(9) for y in (0, 0.075)]
    edge += [plate.dofs.nearest((0.075 * i, 0.15, 0)) for i in range(6)]
    with pytest.raises(ModelError, match=r"near singular: condition .*select_dofs\(modes, 24"):
        reduce(modes, DesiredDofs(edge))
    # node lines of the torsion: exactly singular
    four = solve_modes(plate, count=4)
    line = [plate.dofs.nearest((0.3, 0.075 * i, 0)) for i in (0, 2, 5, 8)]
    with pytest.raises(ModelError, match="near singular"):
        reduce(four, DesiredDofs(line))


@pytest.mark.slow
def test_refusals(plate):
    modes = solve_modes(plate, count=24)
    with pytest.raises(LabelError, match="twice"):
        DesiredDofs(["1:z", "1:z"])
    with pytest.raises(LabelError, match="no DOF '1:q'"):
        reduce(modes, DesiredDofs(["1:q"]))
    with pytest.raises(ModelError, match="count must be a whole number from 3"):
        reduce(plate, DesiredDofs(["1:z"]))
    with pytest.raises(ModelError, match="need an FEModel"):
        reduce(modes, DesiredDofs(["1:z"], damping=ModalDamping(0.01)))
    with pytest.raises(ModelError, match="Modes and a method"):
        reduce(modes, ["1:z"])
    e = plate.dofs.row(Z8)
    D = plate.with_damping(ModalDamping(0.01)).D
    truth = FEModel(plate.M + 0.5 * np.outer(e, e), plate.K, D, dofs=plate.dofs)
    with pytest.raises(ModelError, match="complex"):
        reduce(solve_modes(truth, count=24), DesiredDofs(grid_of(plate)[:24]))
    _, model = reduced(plate)
    with pytest.raises(LabelError, match="no DOF '99:z'"):
        model.row("99:z")
    with pytest.raises(ShapeError, match="q must have shape"):
        model.expand(np.ones(23))
    with pytest.raises(ModelError, match="different lengths"):
        model.expand([1.0, [2.0]])
    with pytest.raises(ShapeError, match="M must have shape"):
        model.replace(M=np.eye(3))
    with pytest.raises(ModelError, match="positive definite"):
        model.replace(M=-model.M).modes()


def test_selection_goes_straight_in(plate):
    modes = solve_modes(plate, count=24, compliance_at=Z8)
    chosen = select_dofs(modes, 25, required=[Z8])
    model = reduce(modes, DesiredDofs(chosen))
    assert model.condition == pytest.approx(chosen.condition, rel=1e-12)
    assert model.dofs.labels == chosen.labels
    assert repr(DesiredDofs(chosen)).startswith("<DesiredDofs: 25 (23:z, ")
    as_dofs = reduce(modes, DesiredDofs(plate.dofs.select(chosen)))
    assert np.array_equal(as_dofs.K, model.K)


def test_a_chain_in_all_its_dofs_is_itself():
    dofs = DofSet([1, 2, 3], ["x"] * 3, [[0, 0, 0], [1, 0, 0], [2, 0, 0]])
    M, K = np.diag([1.0, 2, 3]), np.array([[5.0, -5, 0], [-5, 12, -7], [0, -7, 7]])
    model = reduce(solve_modes(FEModel(M, K, dofs=dofs)), DesiredDofs(dofs))
    np.testing.assert_allclose(model.M, M, atol=1e-13)
    np.testing.assert_allclose(model.K, K, atol=1e-12)
    np.testing.assert_allclose(model.T, np.eye(3), atol=1e-13)


def test_travels(plate, tmp_path):
    _, model = reduced(plate, vector=True)
    assert repr(model) == (
        "<ReducedModel: 25 of 243 DOFs by 24 modes and 1 attachment vector, "
        "3 rigid-body motions, cond(phi_kk) 11.6>"
    )
    model.save(tmp_path / "rom.npz")
    for other in (pickle.loads(pickle.dumps(model)), load(tmp_path / "rom.npz")):
        assert isinstance(other, ReducedModel)
        assert np.array_equal(other.modes().poles, model.modes().poles)
        assert np.array_equal(other.row((0.1, 0.2, 0)), model.row((0.1, 0.2, 0)))
        with pytest.raises(ValueError, match="read-only"):
            other.M[0, 0] = 1

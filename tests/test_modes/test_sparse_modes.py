"""Modes of large sparse structures: none missing, repeated ones included; beside dense LAPACK."""

import numpy as np
import pytest
import scipy.linalg as la
import scipy.sparse as sp

import flexplant as fx
import meshes
from flexplant import DofSet
from flexplant.errors import ModelError
from flexplant.modes import sparse_modes as counted
from flexplant.modes.sparse_modes import counted_modes, modes_below, stiffness_factor
from flexplant.sparse import ordering
from flexplant.sparse.symmetric import BlockLanczos
from flexplant.structure import FEModel


def model_of(mesh):
    return FEModel(mesh[0], mesh[1], dofs=meshes.dofs_of(mesh))


@pytest.fixture(scope="module", params=["plate", "cube"])
def structure(request):
    """A square plate (pairs) or a cube (triples), and the omega^2 of all its modes."""
    mesh = meshes.plate(13) if request.param == "plate" else meshes.solid(5, 5, 5)
    squares = la.eigh(mesh[1].toarray(), mesh[0].toarray(), eigvals_only=True)
    return model_of(mesh), squares[3 if request.param == "plate" else 6 :]


def assert_modes_of(model, squares, phi, expected):
    """The lowest ones, M-orthonormal to 1e-12, with residuals of rounding size."""
    np.testing.assert_allclose(squares, expected[: squares.size], rtol=1e-8)
    force, mass = model.K @ phi, model.M @ phi
    assert np.abs(phi.T @ mass - np.eye(squares.size)).max() < 1e-12
    left = la.norm(force - mass * squares, axis=0) / la.norm(force, axis=0)
    rounding = 2.2e-16 * la.norm(abs(model.K) @ np.abs(phi), axis=0) / la.norm(force, axis=0)
    assert np.all(left < np.maximum(1e-10, 30 * rounding))


@pytest.mark.parametrize("seed", range(6))
def test_no_member_of_a_repeated_pair_is_missing(structure, seed):
    model, expected = structure
    rng = np.random.default_rng(seed)
    factor = stiffness_factor(model)
    count = int(rng.integers(2, 40))
    lanczos = BlockLanczos(factor.solve, model.M, model.rigid_body, want=count, rng=seed)
    theta, _ = lanczos.lowest(count)
    np.testing.assert_allclose(factor.sigma + 1 / theta, expected[:count], rtol=1e-7)


@pytest.mark.long
def test_none_is_missing_in_many_runs(structure):
    # eigsh drops members of such pairs in 8 of 720 runs
    model, expected = structure
    for count in (8, 12, 17, 24, 40):
        squares, phi, certificate = counted_modes(model, count)
        assert_modes_of(model, squares, phi, expected)
        below = np.count_nonzero(expected < (2 * np.pi * certificate["shift"]) ** 2)
        assert certificate["counted"] == certificate["found"] == below + model.rigid_body.shape[1]
    factor = stiffness_factor(model)
    for seed in range(20):
        lanczos = BlockLanczos(factor.solve, model.M, model.rigid_body, want=20, rng=seed)
        theta, _ = lanczos.lowest(20)
        np.testing.assert_allclose(factor.sigma + 1 / theta, expected[:20], rtol=1e-7)


@pytest.mark.slow
def test_one_starting_vector_is_enough(structure, monkeypatch):
    """In exact arithmetic it sees one member of each pair: rounding or the count brings others."""
    model, expected = structure
    lanczos = counted.BlockLanczos
    monkeypatch.setattr(counted, "BlockLanczos", lambda *a, **k: lanczos(*a, **(k | {"block": 1})))
    squares, phi, _ = counted_modes(model, 12)
    assert_modes_of(model, squares, phi, expected)


def test_what_a_search_missed_is_found_by_the_count(structure, monkeypatch):
    """The first search loses a member of a pair or triple; the count says that one is missing."""
    model, expected = structure
    searches, search = [], counted._search

    def blind(model, factor, locked, want, seed):
        squares, shapes = search(model, factor, locked, want, seed)
        searches.append((locked.shape[1], shapes.shape[1]))
        lost = [4] if len(searches) == 1 else []
        return np.delete(squares, lost), np.delete(shapes, lost, axis=1)

    monkeypatch.setattr(counted, "_search", blind)
    squares, phi, certificate = counted_modes(model, 12)
    assert_modes_of(model, squares, phi, expected)
    (r, all_of_them), (locked, _) = searches
    assert locked == r + all_of_them - 1
    assert certificate["counted"] == certificate["found"]


@pytest.mark.slow
@pytest.mark.parametrize("single", [False, True])
def test_below_a_frequency(structure, monkeypatch, single):
    """Bulky structures are counted and searched with one factor, in single precision."""
    model, expected = structure
    model = FEModel(model.M, model.K, dofs=model.dofs)  # without a factor in use
    i = 9 + int(np.argmax(np.diff(expected[9:14])))
    top = 0.5 * (expected[i] + expected[i + 1])
    made, solve = [], counted.StiffnessFactor.solve
    monkeypatch.setattr(
        counted.StiffnessFactor, "solve", lambda *args: made.append(1) or solve(*args)
    )
    if single:
        monkeypatch.setattr(ordering, "_COSTLY", 0.0)
    squares, phi, certificate = counted_modes(model, 10**6, top)
    # the plate's modes are lost in single precision
    assert bool(made) != (single and model.rigid_body.shape[1] == 6)
    assert squares.size == np.count_nonzero(expected < top)
    assert certificate["counted"] == squares.size + model.rigid_body.shape[1]
    np.testing.assert_allclose(certificate["shift"], np.sqrt(top) / (2 * np.pi))
    assert_modes_of(model, squares, phi, expected)
    for low in (1e-3 * expected[0], 1e-12):  # the other below the rounding of rigid-body modes
        assert counted_modes(model, 5, low)[0].size == 0
    assert modes_below(model, top) == squares.size + model.rigid_body.shape[1]


def test_restarts_give_the_same(structure):
    model, expected = structure
    factor = stiffness_factor(model)
    lanczos = BlockLanczos(factor.solve, model.M, model.rigid_body, want=20)
    lanczos._capacity = model.rigid_body.shape[1] + 60
    theta, _ = lanczos.lowest(20)
    assert lanczos._m <= 60
    np.testing.assert_allclose(factor.sigma + 1 / theta, expected[:20], rtol=1e-7)


def test_one_factor_serves_while_it_is_held(structure):
    model, _ = structure
    factor = stiffness_factor(model)
    assert stiffness_factor(model) is factor
    loads = np.random.default_rng(0).standard_normal((model.n_dof, 3))
    response = factor.static(loads)
    M, K, R = model.M.toarray(), model.K.toarray(), model.rigid_body
    balanced = loads - M @ R @ (R.T @ loads)
    dense = la.lstsq(
        np.vstack([K / abs(K).max(), R.T @ M]),
        np.vstack([balanced / abs(K).max(), np.zeros((R.shape[1], 3))]),
    )[0]
    np.testing.assert_allclose(response, dense, atol=1e-7 * np.abs(dense).max())
    assert np.abs(R.T @ M @ response).max() < 1e-12 * np.abs(response).max() * la.norm(M)
    assert "GB" in repr(factor)


def test_negative_stiffness_is_counted(monkeypatch):
    mesh = meshes.plate(8)
    pull = sp.csc_array(([-1e7, -1e7], ([0, 30], [0, 30])), shape=mesh[1].shape)
    model = FEModel(mesh[0], mesh[1] + sp.csc_array(1e3 * mesh[0]), dofs=meshes.dofs_of(mesh))
    object.__setattr__(model, "K", sp.csc_array(model.K + pull))
    expected = np.count_nonzero(la.eigvalsh(model.K.toarray()) < 0)
    with pytest.raises(ModelError, match=f"{expected} negative eigenvalue"):
        counted_modes(model, 5)
    monkeypatch.setattr(ordering, "_COSTLY", 0.0)  # counted and searched with one factor
    with pytest.raises(ModelError, match="negative"):
        counted_modes(model, 5, 1e6)


@pytest.mark.parametrize("soft", [0.0, 1e-4])
def test_a_search_in_single_precision(structure, monkeypatch, soft):
    """As accurate as one in double precision, which follows where it does not suffice."""
    model, expected = structure
    r = model.body_motions.shape[1]
    if soft:  # on springs
        spring = soft * expected[0]
        model = FEModel(model.M, sp.csc_array(model.K + spring * model.M), dofs=model.dofs)
        expected = np.concatenate([np.full(r, spring), expected + spring])
    used, search = [], counted._search

    def recorded(model, factor, *rest):
        used.append(factor.single)
        return search(model, factor, *rest)

    monkeypatch.setattr(counted, "_search", recorded)
    monkeypatch.setattr(ordering, "_COSTLY", 0.0)
    if r < 6:  # far below the modes of the plate: it does not suffice
        monkeypatch.setattr(counted, "_SINGLE_SHIFT", -1e8)
    squares, phi, certificate = counted_modes(model, 12)
    assert_modes_of(model, squares, phi, expected)
    assert certificate["counted"] == certificate["found"]
    assert used == ([True] if r == 6 else [True, False])


def copies_of(mesh, copies, apart=2.0):
    """Equal structures beside each other, which nothing joins."""
    one = meshes.dofs_of(mesh)
    M, K = (sp.block_diag([part] * copies, format="csc") for part in mesh[:2])
    nodes = np.concatenate([one.nodes + 10**6 * i for i in range(copies)])
    xyz = np.vstack([one.xyz + np.array([apart * i, 0, 0]) for i in range(copies)])
    return FEModel(M, K, dofs=DofSet(nodes, one.directions * copies, xyz))


@pytest.mark.slow
@pytest.mark.parametrize("copies, count", [(13, 30), (40, 4), (40, 30), (25, 61)])
def test_any_multiplicity_is_found(copies, count):
    """More copies of a mode than a block has vectors, or than are wanted."""
    mesh = meshes.solid(2, 2, 2)
    grounded = (mesh[0], sp.csc_array(mesh[1] + 1e9 * mesh[0]), *mesh[2:])
    one = la.eigh(grounded[1].toarray(), grounded[0].toarray(), eigvals_only=True)
    model = copies_of(grounded, copies)
    squares, phi, certificate = counted_modes(model, count)
    assert squares.size == count
    assert_modes_of(model, squares, phi, np.repeat(one, copies))
    assert certificate["counted"] == certificate["found"]


@pytest.mark.long
def test_the_last_copies_of_many_modes_are_accurate():
    """Sixty free chains: the last copies of the third mode come late."""
    one = fx.chain(masses=np.ones(80), stiffnesses=np.full(79, 1e6))
    M, K = (sp.block_diag([part] * 60, format="csc") for part in (one.M, one.K))
    dofs = DofSet(np.arange(4800), ["x"] * 4800, np.arange(4800)[:, None] * [1.0, 0.0, 0.0])
    modes = fx.solve_modes(FEModel(M, K, dofs=dofs), count=200)
    expected = 2e3 * np.sin(np.pi * np.arange(1, 4) / 160)
    np.testing.assert_allclose(modes.omega[60:], np.repeat(expected, 60)[:140], rtol=1e-8)
    assert modes.residual[60:].max() < 1e-9


@pytest.mark.slow
def test_bodies_far_from_the_origin_are_free():
    """Rounding of coordinates leaves forces at a few DOFs only; a spring as soft stays one."""
    mesh = meshes.solid(4, 4, 2)
    model = copies_of(mesh, 25)
    assert model.rigid_body.shape[1] == 6 * 25
    report = fx.check(model)
    assert (report.ok, report.n_rigid, report.n_zero) == (True, 6 * 25, 6 * 25)
    one, last = model.dofs.nodes[-1], model.n_dof - 1
    held = model.with_parts([fx.Spring(f"{one}:z", 1e-9 * model.K[last, last])])
    assert held.rigid_body.shape[1] == 6 * 25 - 1


@pytest.mark.slow
def test_bodies_that_nothing_joins_keep_their_motions():
    """Free solids, more than fifty, and free masses: each has its own rigid-body motions."""
    mesh = meshes.solid(1, 1, 1)
    many = copies_of(mesh, 60)
    M, K = (sp.block_diag([A, extra], format="csc") for A, extra in (
        (many.M, sp.eye_array(4)), (many.K, sp.diags_array([0.0, 0.0, 0.0, 1e9]))
    ))  # fmt: skip
    dofs = DofSet(
        [*many.dofs.nodes, -1, -1, -1, -2],
        [*many.dofs.directions, "x", "y", "z", "x"],
        np.vstack([many.dofs.xyz, [[3.0, 4.0, 5.0]] * 4]),
    )
    model = FEModel(M, K, dofs=dofs)
    assert model.rigid_body.shape[1] == 6 * 60 + 3
    elastic = la.eigh(mesh[1].toarray(), mesh[0].toarray(), eigvals_only=True)[6]
    squares, _, _ = counted_modes(model, 2)
    np.testing.assert_allclose(squares, [1e9, elastic], rtol=1e-8)

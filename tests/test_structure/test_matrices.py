"""Foreign matrices before they are a model: against dense algebra written from the equations."""

import warnings

import numpy as np
import pytest
import scipy.linalg as la
import scipy.sparse as sp

import flexplant as fx
from flexplant.errors import FlexplantWarning, LabelError, ModelError, ShapeError
from flexplant.structure.matrices import completed
from shared_data import data_file, needs

NASTRAN = data_file("fe/nastran")
LINE = ["x"]


def chain(n, *, masses=None, ground=0.0):
    """A line of n masses: stiffness 1000 between neighbours, `ground` on the first."""
    K = np.zeros((n, n))
    for i in range(n - 1):
        K[i : i + 2, i : i + 2] += 1000.0 * np.array([[1, -1], [-1, 1]])
    K[0, 0] += ground
    M = np.diag(np.ones(n) if masses is None else np.asarray(masses, dtype=float))
    dofs = fx.DofSet(
        np.arange(1, n + 1), LINE * n, np.column_stack([np.arange(n), *2 * [np.zeros(n)]])
    )
    return K, M, dofs


def finite_eigenvalues(K, M):
    """Eigenvalues of a pencil with singular M, ascending, by QZ."""
    values = la.eigvals(K, M)
    return np.sort(values[np.isfinite(values) & (np.abs(values) < 1e12)].real)


def beam_with_offset_mass(*, offset=(0.0, 0.3, 0.2), rotary=0.0):
    """Two 6-DOF nodes joined and grounded by full random springs; node 2 carries an offset mass."""
    rng = np.random.default_rng(3)
    A = rng.standard_normal((12, 12))
    K = 1e4 * (A @ A.T + 5 * np.eye(12))
    ex, ey, ez = offset
    rigid = np.hstack([np.eye(3), -np.array([[0, -ez, ey], [ez, 0, -ex], [-ey, ex, 0]])])
    M = np.zeros((12, 12))
    M[:6, :6] = np.diag([2, 2, 2, 0.1, 0.1, 0.1])
    M[6:, 6:] = 3.0 * rigid.T @ rigid
    M[9:, 9:] += rotary * np.eye(3)
    dofs = fx.DofSet(np.repeat([1, 2], 6), ("x", "y", "z", "rx", "ry", "rz") * 2, np.zeros((12, 3)))
    return K, M, dofs


# triangles


@pytest.mark.parametrize("kind", [np.tril, np.triu])
@pytest.mark.parametrize("storage", [np.asarray, sp.coo_array, sp.csr_matrix])
def test_a_triangle_is_completed(kind, storage):
    K, _, _ = chain(5)
    full, note = completed(storage(kind(K)), "K")
    np.testing.assert_array_equal(full.toarray(), K)
    assert ("lower" if kind is np.tril else "upper") in note


def test_each_pair_once_in_either_triangle_is_completed():
    K, _, _ = chain(4)
    mixed = np.diag(np.diag(K))
    mixed[0, 1], mixed[2, 1], mixed[2, 3] = K[0, 1], K[2, 1], K[2, 3]
    full, note = completed(mixed, "K")
    np.testing.assert_array_equal(full.toarray(), K)
    assert "once" in note


def test_both_triangles_are_left_for_the_check():
    K, _, _ = chain(4)
    K[0, 1] *= 2
    full, note = completed(K, "K")
    np.testing.assert_array_equal(full.toarray(), K)
    assert note is None
    assert completed(np.eye(3), "M")[1] is None


# to a model


def test_a_good_pair_is_a_model():
    K, M, dofs = chain(4)
    model = fx.structure.FEMatrices(K, M, dofs=dofs).model(name="chain")
    np.testing.assert_array_equal(model.K.toarray(), K)
    assert model.name == "chain"
    assert model.rigid_body.shape == (4, 1)


def test_massless_dofs_are_named_and_condensed_exactly():
    K, M, dofs = chain(6, masses=[1, 0, 2, 0, 0, 3], ground=50.0)
    found = fx.structure.FEMatrices(K, M, dofs=dofs)
    assert found.massless == ("2:x", "4:x", "5:x")
    with pytest.raises(ModelError, match=r"'2:x', '4:x', '5:x'.*condense"):
        found.model()
    model = found.model(massless="condense")
    assert model.dofs.labels == ("1:x", "3:x", "6:x")
    # springs in series
    np.testing.assert_allclose(model.K.toarray()[0, 1], -500.0, rtol=1e-12)
    np.testing.assert_allclose(
        la.eigh(model.K.toarray(), model.M.toarray(), eigvals_only=True),
        finite_eigenvalues(K, M),
        rtol=1e-10,
    )


def test_damping_between_dofs_with_mass_survives_condensation():
    K, M, dofs = chain(3, masses=[1, 0, 2], ground=50.0)
    D = np.diag([0.7, 0, 0])
    model = fx.structure.FEMatrices(K, M, D, dofs=dofs).model(massless="condense")
    np.testing.assert_array_equal(model.D.toarray(), np.diag([0.7, 0]))
    with pytest.raises(ModelError, match=r"damping.*2:x"):
        fx.structure.FEMatrices(K, M, np.diag([0, 1.0, 0]), dofs=dofs).model(massless="condense")


def test_massless_dofs_that_do_not_follow_are_refused():
    K, M, dofs = chain(4, masses=[1, 1, 0, 0])
    K[1:3, 1:3] -= 1000.0 * np.array([[1, -1], [-1, 1]])  # 3 and 4 hang together in mid air
    with pytest.raises(ModelError, match="motion without stiffness"):
        fx.structure.FEMatrices(K, M, dofs=dofs).model(massless="condense")


def test_an_offset_mass_without_rotary_inertia_is_condensed_exactly():
    K, M, dofs = beam_with_offset_mass()
    found = fx.structure.FEMatrices(K, M, dofs=dofs)
    with pytest.raises(ModelError, match=r"3 motions without inertia, turning .*2:"):
        found.model()
    model = found.model(massless="condense")
    assert model.n_dof == 9
    assert set(model.dofs.labels) > {f"1:{d}" for d in ("x", "y", "z", "rx", "ry", "rz")}
    expected = finite_eigenvalues(K, M)
    got = la.eigh(model.K.toarray(), model.M.toarray(), eigvals_only=True)
    assert expected.size == 9
    np.testing.assert_allclose(got, expected, rtol=1e-8)
    # the DOFs that stay keep their meaning: static compliance at them is that of the full K
    rows = dofs.indices(model.dofs.labels)
    loaded = [i for i, label in enumerate(model.dofs.labels) if label.startswith("1:")]
    compliance = np.linalg.inv(K)[np.ix_(rows, rows)][np.ix_(loaded, loaded)]
    inverse = np.linalg.inv(model.K.toarray())[np.ix_(loaded, loaded)]
    assert np.all(np.linalg.eigvalsh(compliance - inverse) > -1e-12 * np.abs(compliance).max())


def test_an_offset_mass_with_rotary_inertia_needs_nothing():
    K, M, dofs = beam_with_offset_mass(rotary=0.01)
    assert fx.structure.FEMatrices(K, M, dofs=dofs).model().n_dof == 12


def test_an_indefinite_mass_is_refused():
    K, M, dofs = chain(3, ground=1.0)
    M[0, 1] = M[1, 0] = 1.5
    with pytest.raises(ModelError, match="indefinite"):
        fx.structure.FEMatrices(K, M, dofs=dofs).model(massless="condense")


@pytest.mark.parametrize(
    ("change", "match"),
    [({"M": None}, "needs M, which is missing"), ({"dofs": None}, "what the 3 rows stand for")],
)
def test_what_is_missing_is_said(change, match):
    K, M, dofs = chain(3)
    with pytest.raises(ModelError, match=match):
        fx.structure.FEMatrices(K, M, dofs=dofs).replace(**change).model()


def test_unlocated_matrices_make_held_models_only():
    K, M, dofs = chain(3)
    zero = fx.DofSet(dofs.nodes, dofs.directions, np.zeros((3, 3)))
    with pytest.raises(ModelError, match="free to move"):
        fx.structure.FEMatrices(K, M, dofs=zero, located=False).model()
    held = fx.structure.FEMatrices(K + np.diag([5.0, 0, 0]), M, dofs=zero, located=False)
    assert held.model().n_dof == 3
    free = fx.structure.FEMatrices(K, M, dofs=zero, located=False).located_at(
        [3, 2, 1], dofs.xyz[::-1]
    )
    np.testing.assert_array_equal(free.dofs.xyz, dofs.xyz)
    assert free.model().rigid_body.shape == (3, 1)
    with pytest.raises(LabelError, match=r"\[3\]"):
        free.located_at([1, 2], np.zeros((2, 3)))


@pytest.mark.parametrize(
    ("make", "error", "match"),
    [
        (lambda: fx.structure.FEMatrices(np.ones((2, 3))), ShapeError, "square"),
        (lambda: fx.structure.FEMatrices(np.eye(2), np.eye(3)), ShapeError, "like K"),
        (lambda: fx.structure.FEMatrices(np.eye(2), dofs=chain(3)[2]), ShapeError, "3 DOFs"),
        (lambda: fx.structure.FEMatrices([[np.nan]]), ModelError, "NaN"),
        (lambda: fx.structure.FEMatrices([[1j]]), ModelError, "real"),
        (lambda: fx.structure.FEMatrices(sp.csc_array([[np.inf]])), ModelError, "infinite"),
        (lambda: fx.structure.FEMatrices([[1.0]], digits=0), ModelError, "digits"),
        (lambda: fx.structure.FEMatrices([[1.0]], dofs="x"), ModelError, "DofSet"),
        (lambda: fx.structure.FEMatrices([[1.0]]).model(massless="drop"), ModelError, "refuse"),
        (lambda: fx.structure.FEMatrices([[1.0]]).without(["1:x"]), LabelError, "no names"),
        (
            lambda: fx.structure.FEMatrices([[1.0]]).converted(length="mm"),
            LabelError,
            "no names yet",
        ),
    ],
)
def test_bad_input_is_refused(make, error, match):
    with pytest.raises(error, match=match):
        make()


# rows of held DOFs


def test_rows_that_a_solver_left_for_held_dofs_are_dropped():
    K, M, dofs = chain(5)
    for held, diagonal in ((0, 0.0), (3, 1.0)):
        K[held], K[:, held], M[held] = 0, 0, 0
        K[held, held] = diagonal
    left = fx.structure.FEMatrices(K, M, dofs=dofs).trimmed()
    assert left.constrained == ("1:x", "4:x")
    assert left.dofs.labels == ("2:x", "3:x", "5:x")
    assert "2 rows" in left.notes[-1]
    assert left.trimmed() is left


def test_a_penalty_is_named_by_the_check_and_dropped_on_demand():
    K, M, dofs = chain(5)
    K[0, 0] += 1e14
    found = fx.structure.FEMatrices(K, M, dofs=dofs)
    assert "penalties" in fx.check(found).of("note")
    held = found.without(["1:x"])
    assert held.constrained == ("1:x",)
    np.testing.assert_allclose(
        la.eigh(held.K.toarray(), np.eye(4), eigvals_only=True),
        la.eigh(K, eigvals_only=True)[:4],
        rtol=1e-6,
    )


# units and local coordinate systems


def test_units_of_matrices_and_coordinates():
    K, M, dofs = chain(3)
    mm = fx.structure.FEMatrices(K, M, 2 * M, dofs=dofs.replace(xyz=1000 * dofs.xyz))
    si = mm.converted(length="mm", mass="t")
    np.testing.assert_allclose(si.K.toarray(), 1e3 * K, rtol=1e-14)
    np.testing.assert_allclose(si.M.toarray(), 1e3 * M, rtol=1e-14)
    np.testing.assert_allclose(si.D.toarray(), 2e3 * M, rtol=1e-14)
    np.testing.assert_allclose(si.dofs.xyz, dofs.xyz)


def test_local_coordinate_systems_are_turned():
    rng = np.random.default_rng(5)
    K, M, dofs = beam_with_offset_mass(rotary=0.1)
    C = la.qr(rng.standard_normal((3, 3)))[0]
    C *= np.sign(np.linalg.det(C))
    turn = la.block_diag(np.eye(6), C, C)  # q_local = turn q_global
    local = fx.structure.FEMatrices(turn @ K @ turn.T, turn @ M @ turn.T, dofs=dofs)
    back = local.rotated({2: C})
    np.testing.assert_allclose(back.K.toarray(), K, rtol=1e-10, atol=1e-9)
    np.testing.assert_allclose(back.M.toarray(), M, rtol=1e-10, atol=1e-12)
    # the order of the rows does not matter
    order = rng.permutation(12)
    mixed = fx.structure.FEMatrices(
        local.K.toarray()[np.ix_(order, order)],
        dofs=fx.DofSet(dofs.nodes[order], [dofs.directions[i] for i in order], dofs.xyz),
    ).rotated({2: C})
    np.testing.assert_allclose(mixed.K.toarray(), K[np.ix_(order, order)], rtol=1e-10, atol=1e-9)


def test_a_partly_held_node_with_a_local_system_is_refused():
    K, M, dofs = chain(3)
    with pytest.raises(ModelError, match="only 1 of three"):
        fx.structure.FEMatrices(K, M, dofs=dofs).rotated({2: np.eye(3)})
    with pytest.raises(LabelError, match="node 9"):
        fx.structure.FEMatrices(K, M, dofs=dofs).rotated({9: np.eye(3)})
    with pytest.raises(ModelError, match="orthogonal"):
        fx.structure.FEMatrices(K, M, dofs=dofs).rotated({2: np.ones((3, 3))})


# digits


def plate(digits):
    """A free, thin and long plate: soft in bending, stiff in itself; its matrices printed."""
    fe = fx.kirchhoff_plate(
        size=(2.0, 0.05), thickness=5e-4, elements=(60, 2), density=2700, youngs_modulus=7e10,
        poisson_ratio=0.3,
    )  # fmt: skip
    K, M = fe.K.toarray(), fe.M.toarray()
    if digits is None:
        return fx.structure.FEMatrices(K, M, dofs=fe.dofs), fe
    printed = np.vectorize(lambda value: float(f"{value:.{digits - 1}e}"))
    return fx.structure.FEMatrices(printed(K), printed(M), dofs=fe.dofs, digits=digits), fe


@pytest.mark.slow
def test_ten_digits_lose_a_soft_mode_and_are_warned_of():
    few, fe = plate(10)
    R, K, M = fe.rigid_body, few.K.toarray(), few.M.toarray()
    truth = fx.solve_modes(fe, count=4).omega[3] ** 2
    # the first elastic eigenvalue of the printed matrices, rigid motions projected out
    elastic = la.null_space((M @ R).T)
    rounded = la.eigh(elastic.T @ K @ elastic, elastic.T @ M @ elastic, eigvals_only=True)[0]
    lost = abs(rounded / truth - 1)
    assert lost > 1e-5
    with pytest.warns(FlexplantWarning) as said:
        few.model(massless="condense")
    texts = [str(w.message) for w in said]
    assert len(set(texts)) == len(texts), "each is said once"
    assert "10 digits" in " ".join(texts)
    assert "binary" in " ".join(texts)
    enough, _ = plate(16)
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        enough.model()


def test_freed_rigid_body_motions_leave_the_elastic_modes():
    fe = fx.kirchhoff_plate(
        size=(0.6, 0.6), thickness=0.0272, elements=(3, 3), density=2702, youngs_modulus=70e9,
        poisson_ratio=0.35,
    )  # fmt: skip
    printed = np.vectorize(lambda value: float(f"{value:.7e}"))
    K, M = printed(fe.K.toarray()), printed(fe.M.toarray())
    text = fx.structure.FEMatrices(K, M, dofs=fe.dofs, digits=8)
    with pytest.warns(FlexplantWarning, match=r"free=True"):
        text.model()
    free = text.freed()
    assert np.abs(free.K.toarray() @ fe.rigid_body).max() < 1e-12 * np.abs(K).max()
    model = free.replace(digits=None).model()
    assert model.rigid_body.shape[1] == 3
    np.testing.assert_allclose(
        fx.solve_modes(model, count=8).omega[3:], fx.solve_modes(fe, count=8).omega[3:], rtol=1e-6
    )
    held = fx.structure.FEMatrices(K + np.eye(len(K)) * K.max(), M, dofs=fe.dofs, digits=8)
    with pytest.raises(ModelError, match="held"):
        held.freed()


@needs(NASTRAN)
class TestAircraft:
    """femv5p1, 426 DOFs: the f06 lists 2495.120 first, ten digits leave 2478.0 (-0.69 %)."""

    F06 = (6215.511, 10005.35, 13762.26, 39188.23, 56838.38)

    def test_singular_mass_is_condensed_and_lost_digits_are_warned_of(self):
        found = fx.io.read_matrices(NASTRAN / "femv5p1.pch")
        assert found.digits == 10
        assert "digits" in fx.check(found).of("note")
        # coordinates are missing; ground springs as soft as rounding stand in for rigid motions
        with pytest.raises(ModelError, match="free to move"):
            found.model(massless="condense")
        soft = found.replace(K=found.K + 20.0 * found.M)
        with pytest.warns(FlexplantWarning) as said:
            model = soft.replace(located=True).model(massless="condense")
        assert any("10 digits" in str(w.message) for w in said)
        values = la.eigh(model.K.toarray(), model.M.toarray(), eigvals_only=True) - 20.0
        assert model.n_dof == 366
        assert values[6] == pytest.approx(2495.120, rel=0.007)
        assert values[6] != pytest.approx(2495.120, rel=0.006)
        np.testing.assert_allclose(values[7:12], self.F06, rtol=3e-4)

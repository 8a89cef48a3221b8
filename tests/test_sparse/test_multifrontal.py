"""The multifrontal factor and its order: solutions, definiteness and counts beside dense LAPACK."""

import numpy as np
import pytest
import scipy.linalg as la
import scipy.sparse as sp
from hypothesis import given, settings
from hypothesis import strategies as st

import meshes
from flexplant.errors import SolverError
from flexplant.sparse import ordering
from flexplant.sparse.factor import (
    ComplexSymmetricFactor,
    MultifrontalFactor,
    _error_radius,
    is_positive_definite,
    lowest_eigenvalue_bound,
    multifrontal_inertia,
)
from flexplant.sparse.ordering import dissect


def random_sparse(seed, n, links):
    """A symmetric positive definite matrix of a random graph, possibly in several pieces."""
    rng = np.random.default_rng(seed)
    i, j = rng.integers(0, n, (2, links))
    off = sp.coo_array((rng.standard_normal(links), (i, j)), shape=(n, n))
    A = sp.csc_array(off + off.T)
    return sp.csc_array(A + sp.diags_array(np.asarray(abs(A).sum(axis=1)) + rng.random(n) + 0.1))


def check_order(A, dissection):
    """Every DOF once; each front's rows hold all later entries of its columns and children."""
    n = A.shape[0]
    assert np.array_equal(np.sort(dissection.order), np.arange(n))
    position = np.argsort(dissection.order)
    seen = 0
    for front in dissection.fronts:
        assert front.first == seen
        seen = front.last
        columns = A[:, dissection.order[front.first : front.last]]
        later = position[np.unique(columns.nonzero()[0])]
        assert set(later[later >= front.last]) <= set(front.rows)
        for child in front.children:
            rest = dissection.fronts[child].rows
            assert set(rest[rest >= front.last]) <= set(front.rows)
    assert seen == n


@pytest.mark.slow
@settings(max_examples=30)
@given(
    seed=st.integers(0, 10**6),
    n=st.integers(1, 90),
    density=st.floats(0.0, 4.0),
    leaf=st.integers(1, 30),
)
def test_random_graphs(seed, n, density, leaf):
    A = random_sparse(seed, n, int(density * n))
    rng = np.random.default_rng(seed)
    for xyz in (None, rng.random((n, 3)), np.zeros((n, 3))):
        dissection = dissect(A, None, xyz, leaf=leaf)
        check_order(A, dissection)
        b = rng.standard_normal((n, 3))
        x = MultifrontalFactor(A, dissection).solve(b)
        np.testing.assert_allclose(
            x, la.solve(A.toarray(), b, assume_a="pos"), rtol=1e-8, atol=1e-10
        )
        shift = rng.uniform(0, A.diagonal().max())
        indefinite = sp.csc_array(A - shift * sp.eye_array(n))
        expected = np.count_nonzero(la.eigvalsh(indefinite.toarray()) < 0)
        assert multifrontal_inertia(indefinite, dissection) == expected


@pytest.mark.slow
@pytest.mark.parametrize("mesh", [meshes.plate(14), meshes.solid(6, 5, 4)], ids=["plate", "solid"])
@pytest.mark.parametrize("known", [True, False])
def test_meshes(mesh, known):
    M, K, nodes, xyz, _ = mesh
    dissection = dissect(K, nodes, xyz if known else None, leaf=40)
    check_order(sp.csc_array(abs(K) + abs(M)), dissection)
    squares = la.eigh(K.toarray(), M.toarray(), eigvals_only=True)
    n_rigid = 6 if mesh[4][0] == "x" else 3
    for k in (n_rigid, n_rigid + 4, 60, len(squares) // 2, len(squares) - 3):
        k += int(np.argmax(np.diff(squares[k : k + 4])))  # between repeated ones there is no gap
        shift = 0.5 * (squares[k] + squares[k + 1])
        assert multifrontal_inertia(sp.csc_array(K - shift * M), dissection) == k + 1
    b = np.random.default_rng(1).standard_normal(len(nodes))
    A = sp.csc_array(K + squares[n_rigid] * M)
    x = MultifrontalFactor(A, dissection).solve(b)
    assert la.norm(A @ x - b) < 1e-10 * la.norm(b)
    near = MultifrontalFactor(1e60 * A, dissection, single=True).solve(1e-50 * b)
    assert 1e-9 * la.norm(x) < la.norm(1e110 * near - x) < 1e-3 * la.norm(x)
    # DOFs of a node stay together
    assert np.all(np.ptp(nodes[dissection.order].reshape(-1, 3), axis=1) == 0)


@pytest.mark.slow
def test_fill_is_that_of_nested_dissection():
    _, K, nodes, xyz, _ = meshes.plate(60)
    known = dissect(K, nodes, xyz)
    assert known.n_factor < 31 * K.shape[0] * np.log2(61**2)
    # a grid cut by planes is the best there is: the graph's own cuts have 12 % more entries
    for without in (dissect(K, nodes), dissect(K)):
        assert without.n_factor < 1.15 * known.n_factor
    # coordinates that say nothing about the graph are not followed
    wrong = np.random.default_rng(0).permutation(xyz)
    assert dissect(K, nodes, wrong).n_factor < 1.15 * known.n_factor


def test_a_shell_rolled_up_is_cut_along_itself():
    _, K, nodes, xyz, _ = meshes.plate(60)
    turn = 12 * np.pi * xyz[:, 0] / np.ptp(xyz[:, 0])
    radius = 0.1 + 0.01 * turn
    rolled = np.column_stack([radius * np.cos(turn), radius * np.sin(turn), xyz[:, 1]])
    assert dissect(K, nodes, rolled).n_factor < 1.15 * dissect(K, nodes, xyz).n_factor


@pytest.mark.slow
def test_a_solid_without_coordinates_and_bodies_that_do_not_touch():
    _, K, nodes, xyz, _ = meshes.solid(12, 9, 8)
    known = dissect(K, nodes, xyz).n_factor
    assert dissect(K, nodes).n_factor < 1.1 * known
    three = sp.csc_array(sp.block_diag([K, K, K]))
    apart = dissect(three, np.concatenate([nodes + k * (nodes.max() + 1) for k in range(3)]))
    assert apart.n_factor < 1.35 * 3 * known  # the middle one is cut twice
    mixed = np.random.default_rng(2).permutation(K.shape[0])
    assert dissect(sp.csc_array(K[mixed][:, mixed]), nodes[mixed]).n_factor < 1.1 * known


def test_a_hub_does_not_spoil_the_order():
    _, K, nodes, xyz, _ = meshes.plate(40)
    n = K.shape[0]
    arms = sp.csc_array((np.full(n // 3, -1.0), (np.arange(0, n, 3), np.full(n // 3, 600))), (n, n))
    spider = sp.csc_array(K + 1e9 * sp.eye_array(n) + arms + arms.T)
    dissection = dissect(spider, nodes, xyz)
    assert dissection.n_factor < 1.5 * dissect(K, nodes, xyz).n_factor
    b = np.ones(n)
    assert la.norm(spider @ MultifrontalFactor(spider, dissection).solve(b) - b) < 1e-9


def test_indefinite_and_singular_matrices_are_refused():
    A = random_sparse(3, 60, 150)
    with pytest.raises(SolverError, match="not positive"):
        MultifrontalFactor(sp.csc_array(A - 3 * sp.eye_array(60)))


@pytest.mark.parametrize("tiny", [1e-17, 0.0])
def test_a_count_with_unstable_pivots_raises(tiny):
    # leaves of one DOF each, next to singular: nothing to pivot with
    A = sp.csc_array([[tiny, 1.0, 0.0], [1.0, 1.0, 1.0], [0.0, 1.0, tiny]])
    dissection = dissect(A, None, np.eye(3) * 0 + np.arange(3)[:, None], leaf=1)
    assert len(dissection.fronts) == 3
    with pytest.raises(SolverError, match="another frequency"):
        multifrontal_inertia(A, dissection)


@pytest.mark.slow
def test_definiteness_of_large_mass_matrices():
    mesh = meshes.plate(64)
    M = mesh[0]
    scaled = M / M.diagonal().max()
    assert is_positive_definite(M)
    # one DOF out of 12 675 with a little too little mass
    lowest = la.eigvalsh(meshes.plate(3)[0].toarray())[0]
    assert lowest > 0
    row = 6000
    bad = M.tolil()
    bad[row, row] = 0.2 * M[row, row]
    assert not is_positive_definite(sp.csc_array(bad))
    assert lowest_eigenvalue_bound(sp.csc_array(scaled)) < 1


def test_the_bound_is_below_the_lowest_eigenvalue():
    rng = np.random.default_rng(5)
    for lowest in (0.3, 0.02, -0.02):
        A = sp.csc_array(sp.diags_array(np.append(rng.uniform(0.4, 1, 3000), lowest)))
        bound = lowest_eigenvalue_bound(A)
        assert bound < lowest
        assert (bound > 0) == (lowest > 0)


def test_a_complex_symmetric_factor_between_resonances():
    """A damped dynamic stiffness among its eigenvalues, whose real part is indefinite."""
    for seed, links in ((1, 0), (2, 150), (3, 700)):
        A = random_sparse(seed, 300, links)
        values = la.eigvalsh(A.toarray())
        shift = 0.5 * (values[140] + values[141])
        B = sp.csc_array(A * (1 + 1e-3j) - shift * sp.eye_array(300))
        b = np.random.default_rng(seed).standard_normal((300, 2))
        factor = ComplexSymmetricFactor(B, dissect(B, leaf=20))
        wanted = la.solve(B.toarray(), b)
        np.testing.assert_allclose(factor.solve(b), wanted, rtol=0, atol=1e-10 * abs(wanted).max())
        # one column is another kernel's product: alike to what the solution is good to
        single = factor.solve(b[:, 0]) - factor.solve(b)[:, 0]
        assert abs(single).max() < 1e-11 * abs(wanted).max()
    with pytest.raises(SolverError, match="singular"):
        ComplexSymmetricFactor(sp.csc_array((3, 3), dtype=complex))


@pytest.mark.parametrize("mesh", [meshes.plate(6), meshes.solid(3, 3, 3)], ids=["plate", "solid"])
def test_a_count_in_single_precision(mesh, monkeypatch):
    """Taken where the error of the factor is too small to change a sign, which is shown."""
    M, K, nodes, xyz, _ = mesh
    squares = la.eigh(K.toarray(), M.toarray(), eigvals_only=True)
    dissection = dissect(K, nodes, xyz, leaf=40)
    monkeypatch.setattr(ordering, "_COSTLY", 0.0)
    taken = []
    for first in (6, 60):
        k = first + int(np.argmax(np.diff(squares[first : first + 6])))
        for part in (0.5, 1e-8):
            A = sp.csc_array(K - (squares[k] + part * (squares[k + 1] - squares[k])) * M)
            factor = MultifrontalFactor(A, dissection, single=True, signed=True)
            bound = _error_radius(factor, A)
            error = np.eye(len(nodes)) - factor.solve(A.toarray())
            assert np.abs(la.eigvals(error)).max() < bound
            taken.append(bool(bound < 0.5))
            assert factor.negative == k + 1 or not taken[-1]
            assert multifrontal_inertia(A, dissection) == k + 1
    assert taken[0::2] == [True, True]
    assert taken[1::2] == [False, False]


def test_a_pivot_that_is_zero_in_single_precision_is_counted_in_double(monkeypatch):
    monkeypatch.setattr(ordering, "_COSTLY", 0.0)
    A = sp.csc_array(sp.diags_array([2.0, 1e-60, -1.0] * 20))
    assert multifrontal_inertia(A) == 20

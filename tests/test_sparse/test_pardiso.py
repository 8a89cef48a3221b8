"""MKL PARDISO as the factor of a large model, where MKL is installed; the refusal where not."""

import gc

import numpy as np
import pytest
import scipy.linalg as la
import scipy.sparse as sp

import meshes
from flexplant.errors import ModelError, SolverError
from flexplant.modes import solve_modes
from flexplant.sparse import Pardiso
from flexplant.sparse.pardiso import PardisoCholesky, _loaded
from flexplant.structure import FEModel


@pytest.fixture
def installed():
    try:
        _loaded(None)
    except SolverError:
        pytest.skip("MKL is not installed: pip install 'flexplant[mkl]'")


def test_solutions(installed):
    M, K = meshes.plate(12)[:2]
    A = sp.csc_array(K + 1e5 * M)
    b = np.random.default_rng(0).standard_normal((A.shape[0], 3))
    for _ in range(3):  # memory is released and taken again
        factor = PardisoCholesky(A, Pardiso())
        x = factor.solve(b)
        assert la.norm(A @ x - b) < 1e-9 * la.norm(b)
        np.testing.assert_allclose(factor.solve(b[:, 0]), x[:, 0], rtol=1e-9)
        assert factor.n_entries > A.nnz // 2
        del factor
        gc.collect()


def test_indefinite_matrices_are_refused(installed):
    M, K = meshes.plate(6)[:2]
    with pytest.raises(SolverError, match="not positive"):
        PardisoCholesky(sp.csc_array(K - 1e9 * M), Pardiso())


def test_modes(installed):
    mesh = meshes.plate(24)
    model = FEModel(mesh[0], mesh[1], dofs=meshes.dofs_of(mesh))
    with_it = solve_modes(model, count=14, factor=Pardiso(), compliance_at="5:z")
    squares = la.eigh(
        mesh[1].toarray(), mesh[0].toarray(), eigvals_only=True, subset_by_index=(0, 13)
    )
    np.testing.assert_allclose(with_it.omega[3:] ** 2, squares[3:], rtol=1e-7)
    assert with_it.certificate["counted"] == with_it.certificate["found"]


def test_what_to_install_is_said():
    with pytest.raises(SolverError, match=r"pip install 'flexplant\[mkl\]'"):
        PardisoCholesky(sp.eye_array(3, format="csc"), Pardiso(library="/no/where/libmkl_rt.so"))
    assert repr(Pardiso()) == "Pardiso()"
    mesh = meshes.plate(3)
    model = FEModel(mesh[0], mesh[1], dofs=meshes.dofs_of(mesh))
    with pytest.raises(ModelError, match="must be of type Pardiso"):
        solve_modes(model, count=4, factor="pardiso")

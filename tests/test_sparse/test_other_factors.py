"""CHOLMOD as the factor of a large model where it is installed, the refusal where not."""

import gc
import sys

import numpy as np
import pytest
import scipy.linalg as la
import scipy.sparse as sp

import meshes
from flexplant.errors import ModelError, SolverError
from flexplant.modes import solve_modes
from flexplant.sparse import Cholmod
from flexplant.structure import FEModel


@pytest.fixture(params=[Cholmod(), Cholmod(order="metis")], ids=repr)
def method(request):
    try:
        request.param.factored(sp.eye_array(3, format="csc"))
    except SolverError as error:
        pytest.skip(str(error))
    return request.param


@pytest.mark.slow
def test_solutions(method):
    M, K = meshes.plate(12)[:2]
    A = sp.csc_array(K + 1e5 * M)
    b = np.random.default_rng(0).standard_normal((A.shape[0], 3))
    for _ in range(3):  # memory is released and taken again
        factor = method.factored(A)
        x = factor.solve(b)
        assert la.norm(A @ x - b) < 1e-9 * la.norm(b)
        np.testing.assert_allclose(factor.solve(b[:, 0]), x[:, 0], rtol=1e-9)
        assert factor.n_entries > A.nnz // 2
        assert la.norm(A @ factor.solve(b) - b) < 1e-9 * la.norm(b)  # counting changed nothing
        del factor
        gc.collect()


def test_indefinite_matrices_are_refused(method):
    M, K = meshes.plate(6)[:2]
    with pytest.raises(SolverError, match="not positive"):
        method.factored(sp.csc_array(K - 1e9 * M))


@pytest.mark.slow
def test_modes(method):
    mesh = meshes.plate(24)
    model = FEModel(mesh[0], mesh[1], dofs=meshes.dofs_of(mesh))
    with_it = solve_modes(model, count=14, factor=method, compliance_at="5:z")
    squares = la.eigh(
        mesh[1].toarray(), mesh[0].toarray(), eigvals_only=True, subset_by_index=(0, 13)
    )
    np.testing.assert_allclose(with_it.omega[3:] ** 2, squares[3:], rtol=1e-7)
    assert with_it.certificate["counted"] == with_it.certificate["found"]


def test_what_to_install_is_said(monkeypatch):
    identity = sp.eye_array(3, format="csc")
    monkeypatch.setitem(sys.modules, "sksparse", None)
    with pytest.raises(SolverError, match="pip install scikit-sparse"):
        Cholmod().factored(identity)
    assert repr(Cholmod(order="metis")) == "Cholmod(order='metis')"
    mesh = meshes.plate(3)
    model = FEModel(mesh[0], mesh[1], dofs=meshes.dofs_of(mesh))
    with pytest.raises(ModelError, match="must be of type Cholmod"):
        solve_modes(model, count=4, factor="pardiso")
    with pytest.raises(ModelError, match="order must be one of"):
        Cholmod(order="colamd")

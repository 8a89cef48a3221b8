"""Masses in a row against closed forms and dense matrices."""

import numpy as np
import pytest
import scipy.linalg as la

from flexplant.errors import ModelError, ShapeError
from flexplant.structure import chain


def test_matrices():
    model = chain(masses=[1, 2, 3], stiffnesses=[5, 7], dampings=[0.1, 0.2], ground=[1, 0, 4])
    np.testing.assert_array_equal(model.M.toarray(), np.diag([1, 2, 3]))
    np.testing.assert_array_equal(model.K.toarray(), [[6, -5, 0], [-5, 12, -7], [0, -7, 11]])
    np.testing.assert_allclose(
        model.D.toarray(), [[0.1, -0.1, 0], [-0.1, 0.3, -0.2], [0, -0.2, 0.2]]
    )
    assert model.dofs.labels == ("1:x", "2:x", "3:x")
    assert model.rigid_body.shape == (3, 0)


def test_frequencies_of_equal_masses():
    # free: omega = 2 sqrt(k/m) sin(i pi / 2 n), i = 0 ... n - 1
    n, k, m = 12, 3e4, 0.7
    model = chain(masses=[m] * n, stiffnesses=[k] * (n - 1), spacing=0.1)
    squares = la.eigvalsh(model.K.toarray(), model.M.toarray())
    exact = 2 * np.sqrt(k / m) * np.sin(np.arange(n) * np.pi / 2 / n)
    np.testing.assert_allclose(np.sqrt(np.abs(squares))[1:], exact[1:], rtol=1e-12)
    assert model.rigid_body.shape == (n, 1)
    assert model.dofs.xyz[-1, 0] == pytest.approx(1.1)
    # both ends to the ground by equal springs: sin(i pi / 2 (n + 1)), i = 1 ... n
    held = chain(masses=[m] * n, stiffnesses=[k] * (n - 1), ground=[k] + [0] * (n - 2) + [k])
    squares = la.eigvalsh(held.K.toarray(), held.M.toarray())
    exact = 2 * np.sqrt(k / m) * np.sin(np.arange(1, n + 1) * np.pi / 2 / (n + 1))
    np.testing.assert_allclose(np.sqrt(squares), exact, rtol=1e-12)


def test_one_mass():
    assert chain(masses=[2.0], stiffnesses=[], ground=8.0).K.toarray() == 8.0


@pytest.mark.parametrize(
    ("changes", "error", "says"),
    [
        ({"masses": []}, ModelError, "at least"),
        ({"masses": [1, 0, 1]}, ModelError, "positive"),
        ({"masses": 3.0}, ShapeError, "masses"),
        ({"stiffnesses": [1, 2, 3]}, ShapeError, "3 masses have 2 stiffnesses"),
        ({"stiffnesses": [1, -2]}, ModelError, "negative"),
        ({"dampings": [1]}, ShapeError, "dampings"),
        ({"ground": [1, 2]}, ShapeError, "ground"),
        ({"ground": -1}, ModelError, "ground"),
        ({"spacing": 0}, ModelError, "spacing"),
    ],
)
def test_bad_chains(changes, error, says):
    with pytest.raises(error, match=says):
        chain(**({"masses": [1, 2, 3], "stiffnesses": [5, 7]} | changes))

"""Frequencies of matrices without names or places, against LAPACK and ARPACK through SciPy."""

import numpy as np
import pytest
import scipy.io
import scipy.linalg as la
import scipy.sparse as sp
import scipy.sparse.linalg as spla

import flexplant as fx
from flexplant.errors import ModelError


def springs(rng, n, *, free, spread):
    """Masses in random order, each joined to some others; stiffnesses over some decades."""
    K = np.zeros((n, n))
    for i in range(1, n):
        for j in {i - 1, int(rng.integers(0, i))}:
            k = 10 ** rng.uniform(0, spread)
            K[np.ix_([i, j], [i, j])] += k * np.array([[1, -1], [-1, 1]])
    if not free:
        K[0, 0] += 10 ** rng.uniform(0, spread)
    M = np.diag(10 ** rng.uniform(-1, 1, n))
    order = rng.permutation(n)
    return K[np.ix_(order, order)], M[np.ix_(order, order)]


@pytest.mark.parametrize("seed", range(12))
@pytest.mark.parametrize("unit", [(1.0, 1.0), (1e9, 1e3), (1e-6, 1e-9)])
def test_random_structures(tmp_path, seed, unit):
    """One body or two, held or free, in any units; repeated ones too; read from a .mat."""
    rng = np.random.default_rng(seed)
    free = seed % 2 == 0
    parts = [springs(rng, int(rng.integers(3, 40)), free=free, spread=4)]
    if seed % 3 == 0:
        parts.append(parts[0] if rng.random() < 0.5 else springs(rng, 9, free=free, spread=4))
    K, M = (la.block_diag(*each) for each in zip(*parts, strict=True))
    path = tmp_path / "model.mat"
    scipy.io.savemat(path, {"K0": sp.csc_matrix(unit[0] * K), "M0": unit[1] * M})
    found = fx.read_matrices(path)
    values = la.eigh(K, M, eigvals_only=True)
    values[: len(parts) if free else 0] = 0.0
    expected = np.sqrt(values * unit[0] / unit[1]) / (2 * np.pi)
    count = int(rng.integers(1, min(values.size, 20) + 1))
    freq = found.frequencies(count)
    assert np.all(freq[: len(parts) if free else 0] == 0)
    np.testing.assert_allclose(freq, expected[:count], rtol=1e-6)
    assert found.frequencies(60).size == min(60, values.size)


@pytest.mark.parametrize("held", [False, True])
def test_a_plate_whose_rows_are_shuffled(held):
    """Rows without a name, more than dense LAPACK is used for."""
    plate = fx.kirchhoff_plate(
        size=(0.6, 0.5), thickness=0.01, elements=(14, 14), density=2702,
        youngs_modulus=70e9, poisson_ratio=0.35,
    )  # fmt: skip
    rng = np.random.default_rng(3)
    rows = rng.permutation(plate.n_dof)[: plate.n_dof - 40 * held]
    K, M = (sp.csc_array(sp.csc_array(A)[rows][:, rows]) for A in (plate.K, plate.M))
    freq = fx.structure.FEMatrices(K, M).frequencies(12)
    rigid = 0 if held else 3
    np.testing.assert_array_equal(freq[:rigid], 0.0)
    values = spla.eigsh(K, 12, M, sigma=-10.0, return_eigenvectors=False)
    values = np.sort(values)[rigid:]
    np.testing.assert_allclose(freq[rigid:], np.sqrt(values) / (2 * np.pi), rtol=1e-7)


def test_rows_without_mass_have_no_frequency():
    K, M = springs(np.random.default_rng(1), 9, free=False, spread=2)
    M[[2, 5]] = 0.0
    freq = fx.structure.FEMatrices(K, M).frequencies(20)
    rest = np.setdiff1d(np.arange(9), [2, 5])
    out = np.array([2, 5])
    inner = np.linalg.solve(K[np.ix_(out, out)], K[np.ix_(out, rest)])
    condensed = K[np.ix_(rest, rest)] - K[np.ix_(rest, out)] @ inner
    values = la.eigh(condensed, M[np.ix_(rest, rest)], eigvals_only=True)
    np.testing.assert_allclose(freq, np.sqrt(values) / (2 * np.pi), rtol=1e-7)


def test_what_has_no_frequencies_is_said():
    K, M = springs(np.random.default_rng(1), 5, free=False, spread=2)
    with pytest.raises(ModelError, match="need M"):
        fx.structure.FEMatrices(K).frequencies()
    with pytest.raises(ModelError, match="negative energy"):
        fx.structure.FEMatrices(K - 2 * np.diag(np.diag(K)), M).frequencies()
    skew = K.copy()
    skew[0, 1] += 1.0
    with pytest.raises(ModelError, match="K is not symmetric"):
        fx.structure.FEMatrices(skew, M).frequencies()
    for count in (0, 61, 2.5):
        with pytest.raises(ModelError, match="count"):
            fx.structure.FEMatrices(K, M).frequencies(count)
    for refused in (lambda found: found.model(), lambda found: fx.solve_modes(found)):
        with pytest.raises(ModelError, match=r"frequencies\("):
            refused(fx.structure.FEMatrices(K, M))

"""Modes of a changed model in few coordinates, against those in all."""

import numpy as np
import pytest
import scipy.linalg as la

from flexplant.identification import MeasuredModes
from flexplant.updating import (
    AddedDamping,
    AddedMass,
    AddedStiffness,
    Eigenvalues,
    MatrixParameter,
    ModeShapes,
    localise,
)
from flexplant.updating.family import Family, first_point
from flexplant.updating.judgement import subsets
from flexplant.updating.judgement.subsets import coordinates, lifted_point, load_vectors


@pytest.fixture(scope="module")
def family(plate):
    """The plate in 25 DOFs, with 1 % of damping that couples no modes."""
    rom = plate.reduced(0.01, True)
    region = np.diag(np.linspace(0.0, 1.0, rom.n_dof))
    unknowns = [
        AddedMass(plate.z8),
        AddedStiffness({plate.grid[2]: 1.0, plate.grid[3]: -1.0}, name="joint"),
        AddedDamping(plate.grid[7]),
        MatrixParameter("region", dK=region * np.abs(rom.K).max()),
        MatrixParameter("stiffer", dK=rom.K),
    ]
    return Family(rom, unknowns)


def test_forces_that_couple_modes(family):
    """A mass couples by one force, a relative stiffness by none, a region by many."""
    assert [load_vectors(family, i).shape[1] for i in (0, 1, 2, 4)] == [1, 1, 1, 0]
    assert load_vectors(family, 3) is None


def test_few_coordinates_give_the_modes_of_all(family):
    """Frequency, damping and shape of the lowest five elastic modes to 1e-9 and 1e-7."""
    chosen = family.of([0, 2, 4])
    p, numbers = np.array([0.5, 40.0, 0.03]), range(4, 9)
    loads = np.hstack([load_vectors(family, i) for i in (0, 2, 4)])
    exact = first_point(chosen, p).eigen
    top = float(np.abs(exact.poles[4]))
    B = coordinates(family, loads, top)
    assert B.shape[1] < 0.7 * B.shape[0]
    few = first_point(chosen.confined(B), p)
    made = lifted_point(chosen, B, few, numbers).eigen
    before, after = (np.abs(e.poles[:5] / exact.poles[:5] - 1).max() for e in (few.eigen, made))
    assert after < 1e-9
    assert after < before
    for a, b in zip(made.X.T[:5], exact.X.T[:5], strict=True):
        rest = b - a * (a.conj() @ b) / (a.conj() @ a)
        assert np.linalg.norm(rest) < 1e-6 * np.linalg.norm(b)


@pytest.mark.slow
def test_localisation_is_that_in_all_coordinates(plate, monkeypatch):
    """Poles and shapes; candidates that do not couple by few forces beside those that do."""
    rom = plate.reduced(0.01, True)
    M = np.array(rom.M)
    at = rom.dofs.index(plate.z8)
    M[at, at] += 0.3
    squares, shapes = la.eigh(rom.K, M, subset_by_index=(3, 7))
    poles = np.sqrt(squares) * (-0.01 + 1j * np.sqrt(1 - 0.01**2))
    rng = np.random.default_rng(0)
    std = 1e-4 * np.abs(poles)
    noisy = poles + std * (rng.normal(size=5) + 1j * rng.normal(size=5)) / np.sqrt(2)
    measured = MeasuredModes(noisy, modes=range(4, 9), covariance=std**2)
    size = 1e-2 * np.abs(shapes).max()
    shapes = shapes + size * rng.normal(size=shapes.shape)
    data = [Eigenvalues(measured), ModeShapes(measured, shapes, rom.dofs.labels, std=size)]
    pool = [AddedMass(label, name=label) for label in (*rom.dofs.labels[::8], plate.z8)]
    pool.append(MatrixParameter("region", dK=np.diag(np.linspace(0, 1e6, rom.n_dof))))
    sizes = []

    def noted(*arguments):
        B = coordinates(*arguments)
        sizes.append(B.shape)
        return B

    monkeypatch.setattr(subsets, "coordinates", noted)
    found = localise(rom, pool, data, most=1)
    assert max(sizes) < (25, 18)
    monkeypatch.setattr(subsets, "coordinates", lambda *arguments: None)
    exact = localise(rom, pool, data, most=1)
    assert found.chosen == exact.chosen == (plate.z8,)
    np.testing.assert_allclose(found.bic, exact.bic, atol=0.05, rtol=1e-6)
    np.testing.assert_allclose(found.values, exact.values, rtol=1e-4)
    assert found.chosen_bic == pytest.approx(exact.chosen_bic, abs=1e-6)

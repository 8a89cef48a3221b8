"""Unit systems against entries converted by hand."""

import numpy as np
import pytest
import scipy.sparse as sp

import flexplant as fx
from flexplant.errors import ModelError
from flexplant.structure.unit_systems import units

DOFS = fx.DofSet([1, 1], ["z", "rx"], [[1000.0, 0, 0], [1000.0, 0, 0]])


def test_every_kind_of_entry_is_converted_by_its_own_factor():
    system = units("mm", "t")
    # a steel cantilever in N and mm: 12 E I / L^3, 6 E I / L^2, 4 E I / L; in SI by hand
    K = np.array([[12.0, 6000.0], [6000.0, 4.0e6]])  # N/mm, N/rad, N mm/rad
    np.testing.assert_allclose(
        system.matrices({"K": K}, DOFS)["K"], [[12e3, 6000.0], [6000.0, 4.0e3]], rtol=1e-15
    )
    M = np.array([[2e-3, 0.5], [0.5, 300.0]])  # t, t mm, t mm^2
    np.testing.assert_allclose(
        system.matrices({"M": M}, DOFS)["M"], [[2.0, 0.5], [0.5, 0.3]], rtol=1e-15
    )
    D = np.array([[1.0, 1.0], [1.0, 1.0]])  # N s/mm, N s, N mm s
    np.testing.assert_allclose(
        system.matrices({"D": D}, DOFS)["D"], [[1e3, 1.0], [1.0, 1e-3]], rtol=1e-15
    )
    np.testing.assert_array_equal(system.placed(DOFS).xyz, [[1.0, 0, 0], [1.0, 0, 0]])


@pytest.mark.parametrize(
    ("names", "force"),
    [
        (("mm", "t", "s"), 1.0),
        (("mm", "kg", "s"), 1e-3),
        (("mm", "kg", "ms"), 1e3),
        (("mm", "g", "ms"), 1.0),
        (("in", "slinch", "s"), 4.4482216152605),
        (("ft", "slug", "s"), 4.4482216152605),
        (("um", "g", "us"), 1e3),
        ((1e-3, 1e3, 1.0), 1.0),
    ],
)
def test_the_force_of_a_consistent_system(names, force):
    assert units(*names).force == pytest.approx(force, rel=1e-12)


def test_frequencies_change_with_the_unit_of_time_only():
    """And so do the rates at which motions decay, the eigenvalues of M^-1 D."""
    K, M = np.array([[12.0, 6000.0], [6000.0, 4.0e6]]), np.diag([2e-3, 300.0])
    square = np.linalg.eigvals(np.linalg.solve(M, K)).real
    for names, time in ((("mm", "t", "s"), 1.0), (("in", "lb", "ms"), 1e-3)):
        system = units(*names)
        mass = system.matrices({"M": M}, DOFS)["M"]
        stiff = np.linalg.solve(mass, system.matrices({"K": K}, DOFS)["K"])
        np.testing.assert_allclose(np.linalg.eigvals(stiff).real * time**2, square, rtol=1e-12)
        decay = np.linalg.solve(mass, system.matrices({"D": K}, DOFS)["D"])
        np.testing.assert_allclose(np.linalg.eigvals(decay).real * time, square, rtol=1e-12)


def test_a_sparse_matrix_stays_sparse_and_symmetric_to_the_bit():
    given = sp.random_array((2, 2), density=1.0, rng=np.random.default_rng(0))
    given = sp.csc_array(given + given.T)
    scaled = units("in", "lb").matrices({"K": given}, DOFS)["K"]
    assert sp.issparse(scaled)
    assert abs(scaled - scaled.T).max() == 0
    np.testing.assert_allclose(
        scaled.toarray(), units("in", "lb").matrices({"K": given.toarray()}, DOFS)["K"], rtol=1e-15
    )


@pytest.mark.parametrize("wrong", [{"length": "mil"}, {"mass": "kip"}, {"time": 0}, {"length": -1}])
def test_an_unknown_unit_is_refused(wrong):
    with pytest.raises(ModelError, match=next(iter(wrong))):
        units(**wrong)


def test_a_unit_of_force_is_refused_since_it_follows():
    with pytest.raises(ModelError, match=r"force follows .* N from mm, t and s"):
        units("mm", "t", "N")


def test_an_interpolation_does_not_keep_its_old_unit():
    plate = fx.kirchhoff_plate(
        size=(1, 1), thickness=0.01, elements=(2, 2), density=1, youngs_modulus=1, poisson_ratio=0.3
    )
    with pytest.raises(ModelError, match="Convert first"):
        units("mm").placed(plate.dofs)

"""What a mesh costs, by two meshes: the judge is a plate in polynomials, which has no mesh."""

import numpy as np
import pytest

import flexplant as fx
from flexplant.errors import ModelError
from flexplant.modes.modes import sampled_moves
from flexplant.testbeds.virtual_machine import plate_modes, ritz_plate
from oracles_mindlin import mindlin_frequencies

#: so thin that rotary inertia, which the meshes lack, is 1e-6
THIN = {
    "size": (0.6, 0.5),
    "thickness": 5e-4,
    "density": 2700.0,
    "youngs_modulus": 70e9,
    "poisson_ratio": 0.3,
}


def modes(n, count=20):
    return fx.solve_modes(fx.kirchhoff_plate(elements=(n, n), **THIN), count=count)


@pytest.mark.slow
def test_the_error_is_that_from_the_converged_plate():
    found = modes(8, 13).mesh_error(modes(16, 17))  # the order of later ones differs
    exact = plate_modes(ritz_plate(**THIN))[0][: found.modes.size] / (2 * np.pi)
    true = modes(8).freq[found.modes - 1] / exact - 1.0
    assert np.abs(true).max() > 5e-3
    np.testing.assert_allclose(found.error, true, atol=0.15 * np.abs(true).max())
    assert np.median(np.abs(found.error / true - 1.0)) < 0.1
    # what is left of the limit is far smaller than what the mesh costs
    assert np.abs(found.limit / exact - 1.0).max() < 0.15 * np.abs(true).max()


def test_beams_converge_by_their_own_order():
    """A chain in one dimension has twice the nodes for elements half as large."""
    coarse, fine, finest = (
        fx.solve_modes(
            fx.beam(
                length=1.0, elements=n, area=1e-4, inertia=1e-9, density=7800.0,
                youngs_modulus=210e9,
            ),
            count=5,
        )
        for n in (6, 12, 48)
    )  # fmt: skip
    found = coarse.mesh_error(fine, order=4.0)
    assert found.ratio == pytest.approx(13 / 7)
    true = coarse.freq[found.modes - 1] / finest.freq[found.modes - 1] - 1.0
    np.testing.assert_allclose(found.error, true, rtol=0.35, atol=1e-7)


@pytest.mark.slow
def test_meshes_that_say_nothing_are_refused():
    with pytest.raises(ModelError, match="Halve the elements"):
        modes(8).mesh_error(modes(9))
    with pytest.raises(ModelError, match="Halve the elements"):
        modes(16).mesh_error(modes(8))
    with pytest.raises(ModelError, match="order"):
        modes(8).mesh_error(modes(16), order=0.0)


@pytest.mark.slow
def test_it_is_said_in_one_line():
    assert repr(modes(8, 6).mesh_error(modes(16, 6))).startswith("<MeshError: 3 modes, ")


@pytest.mark.slow
@pytest.mark.parametrize("seed", range(2))
def test_frequencies_of_two_meshes_point_to_the_converged_plate(seed):
    """Less than half of the error of the finer mesh is left, of repeated modes too."""
    side = (0.6, 0.6) if seed else (0.6, 0.5)  # a square has modes of one frequency
    drawing = THIN | {"size": side, "thickness": 0.03}

    def solved(n):
        cells = tuple(round(n * length / 0.6) for length in side)
        return fx.solve_modes(fx.plate(elements=cells, **drawing), count=20)

    fine = solved(30)
    found = fine.extrapolated(solved(18))
    exact = mindlin_frequencies(side, 0.03, 2700.0, 70e9, 0.3, order=14, count=11)
    before, after = (np.abs(one.freq[3:14] / exact - 1.0) for one in (fine, found))
    assert before.max() > 3e-3
    assert after.max() < 0.5 * before.max()
    assert np.median(after) < 0.4 * np.median(before)
    assert found.n_rigid == 3
    assert np.all(np.diff(found.freq) >= 0)
    with pytest.raises(ModelError, match="Halve"):
        solved(18).extrapolated(fine)


def test_shapes_of_a_solid_are_compared_along_all_directions():
    """Every sixth translation of this block is along x, so that even steps would miss z."""
    dofs = fx.solid_block(size=(0.6, 0.4, 0.03), elements=(16, 11, 2), density=2700.0,
                          youngs_modulus=70e9, poisson_ratio=0.33).dofs  # fmt: skip
    chosen = [dofs.directions[i] for i in sampled_moves(dofs)]
    assert len(chosen) == 300
    assert min(chosen.count(direction) for direction in "xyz") > 70

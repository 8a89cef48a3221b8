"""What a parameter adds to M, D and K."""

import numpy as np
import pytest
import scipy.sparse as sp

import flexplant as fx
from flexplant import load
from flexplant.errors import LabelError, ModelError, ShapeError
from flexplant.updating import AddedDamping, AddedMass, AddedStiffness

KINDS = [(AddedMass, 0, "kg"), (AddedDamping, 1, "N s/m"), (AddedStiffness, 2, "N/m")]


@pytest.mark.parametrize(("kind", "place", "unit"), KINDS)
def test_a_dof_gives_one_entry_of_one_matrix(plate, kind, place, unit):
    rom = plate.reduced(0.01, False)
    parts = kind(plate.z8).matrices(rom)
    assert [part is None for part in parts] == [i != place for i in range(3)]
    expected = np.zeros((24, 24))
    at = rom.dofs.index(plate.z8)
    expected[at, at] = 1.0
    np.testing.assert_allclose(parts[place], expected, atol=1e-12)
    assert repr(kind(plate.z8)).endswith(f"at {plate.z8} [{unit}]>")


def test_a_point_between_nodes_uses_the_shape_functions(plate):
    rom = plate.reduced(0.01, True)
    point = (0.311, 0.137, 0.0)
    row = plate.model.dofs.row(point) @ rom.T
    dM, _, _ = AddedMass(point).matrices(rom)
    np.testing.assert_allclose(dM, np.outer(row, row), rtol=1e-13, atol=1e-15)
    row = plate.model.dofs.row(point, "rx")
    _, _, dK = AddedStiffness(point, direction="rx").matrices(plate.model)
    assert sp.issparse(dK)  # as the matrices of the full model are
    np.testing.assert_allclose(dK.toarray(), np.outer(row, row), atol=1e-12)


def test_a_mapping_acts_between_dofs(make):
    model = make([1, 1, 1], [(0, 1, 1.0), (1, 2, 1.0)])
    _, _, dK = AddedStiffness({"1:z": 1, "3:z": -1}).matrices(model)
    assert dK.tolist() == [[1, 0, -1], [0, 0, 0], [-1, 0, 1]]


def test_names_say_what_and_where():
    assert AddedMass("14:z").name == "mass at 14:z"
    assert AddedDamping((0.3, 0.15, 0)).name == "damping at (0.3, 0.15, 0) z"
    assert AddedStiffness({"1:z": 1, "2:z": -1}).name == "stiffness at +1*1:z -1*2:z"
    assert AddedMass("14:z", name="actuator").name == "actuator"


def test_a_parameter_survives_a_file(tmp_path):
    AddedStiffness({"1:z": 1, "2:z": -1}, name="crack").save(tmp_path / "p.npz")
    again = load(tmp_path / "p.npz")
    assert isinstance(again, AddedStiffness)
    assert again.name == "crack"
    assert dict(again.at) == {"1:z": 1.0, "2:z": -1.0}


@pytest.mark.parametrize("kind", [AddedMass, AddedDamping, AddedStiffness])
def test_bad_places_are_refused(kind, plate):
    for at, error, cause in [
        ("", LabelError, "is not a place"),
        ({}, LabelError, "is not a place"),
        ((0.1, 0.2), ShapeError, "at must have shape"),
        ((0.1, 0.2, np.nan), ModelError, "at has a NaN"),
        ({"1:z": np.inf}, ModelError, "weight of '1:z'"),
    ]:
        with pytest.raises(error, match=cause):
            kind(at)
    with pytest.raises(LabelError, match="direction"):
        kind("1:z", direction="up")
    rom = plate.reduced(0.01, False)
    with pytest.raises(LabelError, match="999:z"):
        kind("999:z").matrices(rom)
    with pytest.raises(LabelError, match="off the plate"):
        kind((0.7, 0.1, 0.0)).matrices(rom)
    with pytest.raises(ModelError, match="has no effect"):
        kind({plate.z8: 0.0}).matrices(rom)


def test_a_mass_rides_on_all_translations_as_a_point_mass_does():
    """A rigid body gains the whole mass along x, y and z, and what a PointMass adds to M."""
    sides = {"size": (0.4, 0.3, 0.05), "elements": (3, 2, 1)}
    block = fx.solid_block(**sides, density=2700, youngs_modulus=70e9, poisson_ratio=0.33)
    place = (0.31, 0.12, 0.05)
    added = AddedMass(place, direction="xyz")
    dM, dD, dK = added.matrices(block)
    assert sp.issparse(dM) and dD is None and dK is None
    heavier = block.with_parts(fx.PointMass(place, 0.7))
    np.testing.assert_allclose((0.7 * dM).toarray(), (heavier.M - block.M).toarray(), atol=1e-12)
    for axis in "xyz":
        moved = np.array([float(d == axis) for d in block.dofs.directions])
        assert moved @ dM @ moved == pytest.approx(1.0)
    rom = fx.reduce(fx.solve_modes(block, count=12), fx.reduction.ModalTruncation(count=12))
    reduced = added.matrices(rom)[0]
    assert np.linalg.matrix_rank(reduced) == 3
    np.testing.assert_allclose(reduced, rom.T.T @ dM @ rom.T, atol=1e-12)
    assert added.name == "mass at (0.31, 0.12, 0.05) xyz"
    for at in ("14:z", {"14:z": 1.0}):
        with pytest.raises(LabelError, match="names one motion: give a point"):
            AddedMass(at, direction="xyz")
    far = (0.02, 0.2, 0.0)
    isolator = AddedStiffness(place, direction="xyz", to=far).matrices(block)[2].toarray()
    rows = [block.dofs.row(place, axis) - block.dofs.row(far, axis) for axis in "xyz"]
    np.testing.assert_allclose(isolator, sum(np.outer(row, row) for row in rows), atol=1e-12)


@pytest.mark.slow
def test_a_mass_in_three_directions_is_found():
    """On a machine with such a mass; one along z alone leaves the motions in the plane as drawn."""
    sides = {"size": (0.4, 0.3, 0.05), "elements": (3, 2, 1)}
    block = fx.solid_block(**sides, density=2700, youngs_modulus=70e9, poisson_ratio=0.33)
    place = (0.4, 0.3, 0.05)
    truth = fx.solve_modes(block.with_parts(fx.PointMass(place, 0.8)), count=12)
    numbers = [7, 8, 9, 10, 11]
    poles = [1j * truth.omega[k - 1] for k in numbers]
    measured = fx.Eigenvalues(fx.MeasuredModes(poles=poles, modes=numbers))
    rom = fx.reduce(fx.solve_modes(block, count=40), fx.reduction.ModalTruncation(count=40))
    fits = {
        d: fx.update(rom, [AddedMass(place, direction=d)], [measured], full=block)
        for d in ("xyz", "z")
    }
    assert fits["xyz"].values[0] == pytest.approx(0.8, rel=1e-3)
    assert fits["xyz"].history.error[-1] < 1e-4 * fits["z"].history.error[-1]

"""Modes that a reduction left out stay with the reduced model, and come back exactly."""

import pickle

import numpy as np
import pytest

import flexplant as fx
from flexplant.errors import ModelError, ShapeError
from flexplant.modes import solve_modes
from flexplant.reduction import DesiredDofs, ModalBalanced, ModalTruncation, reduce
from flexplant.structure import ModalDamping
from plates import make_plate

PLATE = make_plate(elements=(4, 4))
ALL = solve_modes(PLATE, count=30, damping=ModalDamping(0.01))
GRID = [PLATE.dofs.nearest((x, y, 0), "z") for x in (0, 0.3, 0.6) for y in (0, 0.3, 0.6)]

METHODS = {
    "desired": DesiredDofs(GRID),
    "lowest": ModalTruncation(9),
    "chosen": ModalTruncation(modes=[1, 2, 3, 6, 9]),
    "balanced": ModalBalanced(8, inputs=["1:z", "3:z"]),
    "static": ModalTruncation(9, static_at=["1:z"]),
}


@pytest.mark.parametrize("method", METHODS.values(), ids=METHODS)
def test_kept_and_left_out_are_all_modes(method):
    model = reduce(ALL, method)
    together = model.completed().modes()
    np.testing.assert_allclose(together.omega[3:], ALL.omega[3:], rtol=1e-9)
    assert np.all(together.omega[:3] == 0)
    np.testing.assert_allclose(together.zeta[3:], 0.01, rtol=1e-9)
    # repeated modes may be turned: compare what does not turn, the compliance
    ours, theirs = ((m.phi[:, 3:] / m.omega[3:] ** 2) @ m.phi[:, 3:].T for m in (together, ALL))
    np.testing.assert_allclose(ours, theirs, atol=1e-9 * np.abs(theirs).max())


@pytest.mark.slow
def test_they_survive_saving_pickling_and_the_update(tmp_path):
    model = reduce(ALL, METHODS["desired"])
    assert model.truncated.n_modes == 21
    assert "21 truncated modes are known" in repr(model)
    model.save(tmp_path / "model.npz")
    for twin in (fx.load(tmp_path / "model.npz"), pickle.loads(pickle.dumps(model))):
        np.testing.assert_array_equal(twin.truncated.phi, model.truncated.phi)
        np.testing.assert_array_equal(twin.truncated.omega, ALL.omega[9:])
    measured = fx.MeasuredModes(poles=ALL.poles[[5, 6]] * 0.97, modes=[6, 7])
    fit = fx.update(model, [fx.AddedMass(GRID[1]), fx.AddedDamping(GRID[1])],
                    [fx.Eigenvalues(measured)])  # fmt: skip
    np.testing.assert_array_equal(fit.model.truncated.omega, ALL.omega[9:])
    assert not np.allclose(fit.model.M, model.M)


def test_attachment_vectors_of_the_known_modes_come_back_too():
    """Vectors that ModalTruncation leaves out stand behind the truncated modes."""
    with_vector = solve_modes(PLATE, count=20, damping=ModalDamping(0.01), compliance_at=["1:z"])
    model = reduce(with_vector, ModalTruncation(9))
    assert (model.truncated.n_modes, model.truncated.n_vectors) == (11, 1)
    assert model.completed().n_dof == 21


def test_nothing_left_out_is_nothing_known():
    assert reduce(ALL, ModalTruncation(30)).truncated is None
    model = reduce(solve_modes(PLATE, count=9), DesiredDofs(GRID))
    assert model.truncated is None
    assert model.completed() is model


def test_refusals():
    # with attachment vectors a label too few is a mistake, not a choice
    with_vector = solve_modes(PLATE, count=9, compliance_at=["1:z"])
    with pytest.raises(ShapeError, match="9 desired DOFs for 9 modes plus 1 attachment"):
        reduce(with_vector, DesiredDofs(GRID))
    model = reduce(ALL, METHODS["desired"])
    other = solve_modes(make_plate(elements=(3, 3)), count=12)
    with pytest.raises(ModelError, match="truncated modes are over"):
        model.replace(truncated=other)
    turned = model.truncated.replace(phi=model.truncated.phi + 0j)
    with pytest.raises(ModelError, match="modes are complex"):
        model.replace(truncated=turned).completed()

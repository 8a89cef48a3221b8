"""Beams against the closed forms of all end conditions."""

import numpy as np
import pytest
import scipy.linalg as la

import oracles_grids as oracle
from flexplant.errors import LabelError, ModelError, ShapeError
from flexplant.structure import BeamShape, beam

STEEL = {"density": 7850.0, "youngs_modulus": 210e9, "area": 2e-4, "inertia": 1.5e-9}

RIGID = {("free", "free"): 2, ("free", "pinned"): 1, ("guided", "guided"): 1, ("free", "guided"): 1}


def make_beam(**changes):
    return beam(**({"length": 1.3, "elements": 24} | STEEL | changes))


def frequencies(model):
    return np.sqrt(np.abs(la.eigvalsh(model.K.toarray(), model.M.toarray()))) / (2 * np.pi)


@pytest.mark.parametrize("ends", oracle.BEAM_ROOTS)
def test_frequencies_of_all_end_conditions(ends):
    roots = np.array(oracle.BEAM_ROOTS[ends])
    speed = np.sqrt(210e9 * 1.5e-9 / (7850 * 2e-4))
    exact = roots**2 * speed / 1.3**2 / (2 * np.pi)
    for order in (ends, ends[::-1]):
        model = make_beam(ends=order)
        rigid = model.rigid_body.shape[1]
        assert rigid == RIGID.get(ends, 0)
        np.testing.assert_allclose(frequencies(model)[rigid : rigid + 3], exact, rtol=4e-5)


def test_convergence_is_of_fourth_order():
    exact = (4.730040745 / 1.3) ** 2 * np.sqrt(210e9 * 1.5e-9 / 7850 / 2e-4) / 2 / np.pi
    errors = [frequencies(make_beam(elements=n))[2] / exact - 1 for n in (8, 16)]
    assert errors[0] > 0
    assert errors[0] / errors[1] == pytest.approx(16, rel=0.1)


def test_shape_functions_are_cubic():
    model = make_beam(elements=3)
    c = [0.3, -0.2, 0.5, -0.7]
    x = model.dofs.xyz[::2, 0]
    q = np.column_stack([np.polyval(c, x), -np.polyval(np.polyder(c), x)]).ravel()
    for at in (0.0, 0.2, 1.3 / 3, 0.9, 1.3):
        assert model.dofs.row((at, 0, 0), "z") @ q == pytest.approx(np.polyval(c, at), abs=1e-13)
        slope = -np.polyval(np.polyder(c), at)
        assert model.dofs.row((at, 0, 0), "ry") @ q == pytest.approx(slope, abs=1e-13)
    # a quadratic bends with the exact energy
    q = np.column_stack([x**2, -2 * x]).ravel()
    assert q @ (model.K @ q) == pytest.approx(210e9 * 1.5e-9 * 4 * 1.3, rel=1e-10)


def test_held_ends_keep_places_between_nodes():
    model = make_beam(ends=("clamped", "free"), elements=4)
    assert model.dofs.labels[:2] == ("2:z", "2:ry")
    free = make_beam(elements=4)
    np.testing.assert_array_equal(model.dofs.row((0.1, 0, 0)), free.dofs.row((0.1, 0, 0))[2:])
    np.testing.assert_array_equal(
        model.dofs.rows([(0.1, 0, 0), (0.2, 0, 0)], "ry"),
        free.dofs.rows([(0.1, 0, 0), (0.2, 0, 0)], "ry")[:, 2:],
    )
    assert not model.dofs.row((0, 0, 0)).any()
    # tip deflection of a cantilever F L^3 / 3 E I
    tip = model.dofs.row((1.3, 0, 0))
    sag = tip @ np.linalg.solve(model.K.toarray(), tip)
    assert sag == pytest.approx(1.3**3 / 3 / (210e9 * 1.5e-9), rel=1e-10)


def test_a_stepped_beam():
    # two halves of different inertia: static tip deflection by integrating M^2 / E I
    model = make_beam(
        elements=10, ends=("clamped", "free"), inertia=lambda x: 3e-9 if x < 0.65 else 1e-9
    )
    tip = model.dofs.row((1.3, 0, 0))
    sag = tip @ np.linalg.solve(model.K.toarray(), tip)
    exact = (1.3**3 - 0.65**3) / 3 / (210e9 * 3e-9) + 0.65**3 / 3 / (210e9 * 1e-9)
    assert sag == pytest.approx(exact, rel=1e-10)
    assert make_beam(elements=2, density=[1000, 3000]).mass == pytest.approx(2000 * 2e-4 * 1.3)


def test_reprs():
    assert (
        repr(make_beam()) == "<FEModel 'beam': 50 DOFs, sparse, 2 rigid-body motions, D not given>"
    )
    assert repr(BeamShape(1.3, 4)) == "BeamShape(length=1.3, elements=4)"


@pytest.mark.parametrize(
    ("changes", "error", "says"),
    [
        ({"length": 0}, ModelError, "length"),
        ({"elements": 2.5}, ModelError, "whole number"),
        ({"elements": (2, 2)}, ShapeError, "whole numbers"),
        ({"area": [1e-4] * 3}, ShapeError, "one for each element"),
        ({"inertia": -1e-9}, ModelError, "inertia"),
        ({"inertia": lambda x: -x}, ModelError, "every element"),
        ({"ends": "free"}, ModelError, "two words"),
        ({"ends": ("free", "loose")}, ModelError, "must be one of"),
        ({"ends": ("free", 3)}, ModelError, "must be one of"),
        ({"ends": 3}, ModelError, "two words"),
    ],
)
def test_bad_beams(changes, error, says):
    with pytest.raises(error, match=says):
        make_beam(**changes)


@pytest.mark.parametrize(
    ("at", "direction"), [((2, 0, 0), "z"), ((1, 0.1, 0), "z"), ((1, 0, 0), "rx")]
)
def test_bad_places(at, direction):
    with pytest.raises(LabelError, match=r"off the beam|no motion"):
        make_beam().dofs.row(at, direction)

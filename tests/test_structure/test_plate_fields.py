"""Plates against published parameters; varying elements against dense matrices."""

import numpy as np
import pytest
import scipy.sparse.linalg as spla

import oracles_grids as oracle
from flexplant.errors import LabelError, ModelError, ShapeError
from flexplant.structure import FEModel, PlateShape, Spring
from plates import make_plate

SIDE, T, E, NU, RHO = 0.6, 0.01, 70e9, 0.3, 2700.0
#: frequency parameter omega a^2 sqrt(rho h / D) of one rad/s
UNIT = SIDE**2 * np.sqrt(RHO * T / (E * T**3 / 12 / (1 - NU**2)))


def square(n, **changes):
    fields = {"thickness": T, "density": RHO, "youngs_modulus": E, "poisson_ratio": NU}
    return make_plate(**(fields | {"elements": (n, n)} | changes))


def parameters(model, count, shift=-1e4):
    squares = spla.eigsh(model.K, count, model.M, shift, return_eigenvectors=False)
    return np.sqrt(np.abs(np.sort(squares))) * UNIT


def edges(model, directions=None):
    """DOFs of the four edges."""
    inf = np.inf
    boxes = [
        [(-inf, -inf, -inf), (0, inf, inf)],
        [(SIDE, -inf, -inf), (inf, inf, inf)],
        [(-inf, -inf, -inf), (inf, 0, inf)],
        [(-inf, SIDE, -inf), (inf, inf, inf)],
    ]
    return {label for box in boxes for label in model.dofs.where(directions=directions, box=box)}


def test_free_square_plate_of_leissa():
    found = parameters(square(24), 9)[3:]
    # his Ritz values are upper bounds, within 1.1 % of the exact ones
    assert np.all(found < oracle.LEISSA_FREE)
    np.testing.assert_allclose(found, oracle.LEISSA_FREE, rtol=0.013)


def test_simply_supported_square_plate():
    # z = sin(m pi x / a) sin(n pi y / a): parameter pi^2 (m^2 + n^2)
    exact = np.pi**2 * np.array([2, 5, 5, 8, 10, 10])
    errors = []
    for n in (12, 24):
        plate = square(n)
        found = parameters(plate.fixed(edges(plate, "z")), 6)
        errors.append(np.abs(found / exact - 1).max())
    assert errors[1] < 0.007
    assert errors[0] / errors[1] == pytest.approx(4, rel=0.1)


@pytest.mark.slow
def test_clamped_square_plate_by_fixed_dofs_and_by_stiff_springs():
    plate = square(24)
    clamped = plate.fixed(edges(plate))
    found = parameters(clamped, 6)
    np.testing.assert_allclose(found, oracle.LEISSA_CLAMPED, rtol=0.012)
    springs = [Spring(label, 1e10) for label in edges(plate)]
    np.testing.assert_allclose(parameters(plate.with_parts(springs), 6), found, rtol=1e-4)


def varied(nx=4, ny=3):
    rng = np.random.default_rng(5)
    return {
        "thickness": rng.uniform(0.01, 0.02, (nx, ny)),
        "density": rng.uniform(2e3, 8e3, (nx, ny)),
        "youngs_modulus": rng.uniform(5e10, 9e10, (nx, ny)),
        "poisson_ratio": rng.uniform(0.2, 0.4, (nx, ny)),
    }


def test_varying_elements_are_the_oracle_s():
    fields = varied()
    plate = make_plate(elements=(4, 3), size=(0.8, 0.5), **fields)
    M, K = oracle.varied_plate(4, 3, (0.8, 0.5), *fields.values())
    for ours, theirs in ((plate.M, M), (plate.K, K)):
        scale = np.sqrt(np.outer(np.diag(theirs), np.diag(theirs)))
        assert np.abs((ours.toarray() - theirs) / scale).max() < 1e-12
        assert abs(ours - ours.T).max() == 0
    assert plate.rigid_body.shape[1] == 3
    FEModel(plate.M, plate.K, dofs=plate.dofs)


def test_functions_of_the_centre_and_arrays_are_the_same():
    x, y = (np.arange(4) + 0.5) * 0.2, (np.arange(3) + 0.5) * 0.5 / 3
    centres = np.meshgrid(x, y, indexing="ij")
    one = make_plate(
        elements=(4, 3), size=(0.8, 0.5), thickness=0.01 + 0.01 * centres[0] * centres[1]
    )
    two = make_plate(elements=(4, 3), size=(0.8, 0.5), thickness=lambda x, y: 0.01 + 0.01 * x * y)
    np.testing.assert_allclose(two.K.toarray(), one.K.toarray(), rtol=1e-12, atol=1e-6)


@pytest.mark.parametrize("direction", ["z", "rx", "ry"])
def test_many_points_at_once_are_the_points_one_by_one(direction):
    """Inside and on all edges; a point off the plate is refused."""
    plate = make_plate(elements=(4, 4))
    x, y = np.meshgrid(np.linspace(0.0, 0.6, 9), np.linspace(0.0, 0.6, 13))
    points = np.column_stack([x.ravel(), y.ravel(), np.full(x.size, 0.01)])
    found = plate.dofs.rows(points, direction)
    expected = [plate.dofs.row(point, direction) for point in points]
    np.testing.assert_allclose(found, expected, rtol=1e-12, atol=1e-12)
    with pytest.raises(LabelError, match="off the plate"):
        plate.dofs.rows([*points[:3], (0.7, 0.1, 0.0)], direction)


def test_surfaces_where_the_thickness_varies():
    plate = make_plate(elements=(2, 1), thickness=[[0.01], [0.03]])
    plate.dofs.row((0.5, 0.3, 0.014))
    with pytest.raises(LabelError, match=r"0\.005 m"):
        plate.dofs.row((0.1, 0.3, 0.014))


@pytest.mark.parametrize(
    ("changes", "error", "says"),
    [
        ({"thickness": np.ones((8, 7))}, ShapeError, "one for each element"),
        ({"thickness": lambda x, y: 0.0}, ModelError, "every element"),
        ({"poisson_ratio": np.full((8, 8), 0.6)}, ModelError, "poisson_ratio"),
    ],
)
def test_bad_plates(changes, error, says):
    with pytest.raises(error, match=says):
        make_plate(**changes)


def test_reprs():
    assert (
        repr(PlateShape((1, 1), 0.1, (2, 2)))
        == "PlateShape(size=[1, 1], thickness=0.1, elements=[2, 2])"
    )

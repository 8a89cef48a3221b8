"""The plate element: against Gauss quadrature, patch tests, frequencies, interpolation."""

import time

import numpy as np
import pytest
import scipy.linalg as la
from hypothesis import given
from hypothesis import strategies as st

import oracles_structure as oracle
from flexplant.errors import LabelError, ModelError, ShapeError
from flexplant.structure import FEModel, PlateShape, kirchhoff_plate
from plates import make_plate

# design.md's plate, Hz; oracle: oracles_structure.plate_matrices and scipy.linalg.eigh agree
ELASTIC = [245.754, 359.312, 463.131, 640.083, 640.083]
FINE = [245.50, 358.98, 462.33, 640.01]


@pytest.fixture(scope="module")
def plate():
    return make_plate()


def frequencies(model):
    return np.sqrt(np.abs(la.eigvalsh(model.K.toarray(), model.M.toarray()))) / (2 * np.pi)


def quadratic(xy, c):
    """z, rx, ry of c0 + c1 x + c2 y + c3 x^2 + c4 x y + c5 y^2."""
    x, y = np.asarray(xy).T
    z = c[0] + c[1] * x + c[2] * y + c[3] * x**2 + c[4] * x * y + c[5] * y**2
    return np.column_stack([z, c[2] + c[4] * x + 2 * c[5] * y, -(c[1] + 2 * c[3] * x + c[4] * y)])


def test_frequencies_of_the_paper_s_plate(plate):
    freq = frequencies(plate)
    np.testing.assert_allclose(freq[3:8], ELASTIC, rtol=1e-5)
    np.testing.assert_allclose(freq[22:24], 3767.7, rtol=2e-5)


def test_the_pins_feel_one_percent_of_thickness():
    freq = frequencies(make_plate(thickness=0.0272 * 1.01))
    assert np.all(np.abs(freq[3:8] / ELASTIC - 1) > 5e-3)
    assert np.all(np.abs(freq[22:24] / 3767.7 - 1) > 5e-3)


@pytest.mark.slow
def test_refined_frequencies():
    freq = frequencies(make_plate(elements=(16, 16)))
    np.testing.assert_allclose(freq[3:7], FINE, atol=0.006)


@pytest.mark.parametrize(("elements", "size"), [((8, 8), (0.6, 0.6)), ((3, 2), (0.5, 0.9))])
def test_matrices_equal_gauss_quadrature(elements, size):
    model = make_plate(elements=elements, size=size)
    M, K = oracle.plate_matrices(*elements, size=size)
    for ours, theirs in ((model.M, M), (model.K, K)):
        scale = np.sqrt(np.outer(np.diag(theirs), np.diag(theirs)))
        assert np.abs((ours.toarray() - theirs) / scale).max() < 1e-12


def test_matrices_are_symmetric_to_the_bit_and_definite(plate):
    assert abs(plate.M - plate.M.T).max() == 0
    assert abs(plate.K - plate.K.T).max() == 0
    # the constructor skips the public checks; they must hold all the same
    FEModel(plate.M, plate.K, dofs=plate.dofs)


def test_one_element_plate():
    model = make_plate(elements=(1, 1), size=(0.2, 0.3))
    M, K = oracle.plate_matrices(1, 1, size=(0.2, 0.3))
    np.testing.assert_allclose(model.M.toarray(), M, atol=1e-12 * M.max())
    np.testing.assert_allclose(model.K.toarray(), K, atol=1e-12 * K.max())


@given(
    c=st.lists(st.floats(-1, 1), min_size=6, max_size=6),
    size=st.tuples(st.floats(0.05, 3), st.floats(0.05, 3)),
    elements=st.tuples(st.integers(1, 4), st.integers(1, 4)),
)
def test_patch_of_constant_curvature_stores_the_exact_energy(c, size, elements):
    t, E, nu = 0.01, 70e9, 0.3
    # curvatures of order one, however small those drawn
    c[3:] = np.array(c[3:]) / (np.abs(c[3:]).max() or 1.0)
    model = kirchhoff_plate(
        size=size, thickness=t, elements=elements, density=2700, youngs_modulus=E, poisson_ratio=nu
    )
    q = quadratic(model.dofs.xyz[::3, :2], c).ravel()
    bending = E * t**3 / 12 / (1 - nu**2)
    xx, yy, xy = 2 * c[3], 2 * c[5], c[4]
    density = bending * (xx**2 + yy**2 + 2 * nu * xx * yy + 2 * (1 - nu) * xy**2)
    unit = bending * size[0] * size[1]
    # elements 200 times as long as wide: what cancels is larger than what is left
    rounding = 1e-14 * np.abs(q) @ (abs(model.K) @ np.abs(q))
    assert q @ (model.K @ q) == pytest.approx(
        density * size[0] * size[1], rel=1e-8, abs=1e-9 * unit + rounding
    )


def test_patch_inner_nodes_carry_no_force():
    model = make_plate(elements=(4, 4))
    q = quadratic(model.dofs.xyz[::3, :2], [0.1, 0.2, -0.3, 0.4, 0.5, -0.6]).ravel()
    x, y = model.dofs.xyz[:, 0], model.dofs.xyz[:, 1]
    inner = (x > 1e-9) & (x < 0.6 - 1e-9) & (y > 1e-9) & (y < 0.6 - 1e-9)
    force = model.K @ q
    assert np.abs(force[inner]).max() < 1e-10 * np.abs(force).max()


def test_rigid_motions_cost_nothing_and_weigh_the_plate(plate):
    mass = 0.36 * 0.0272 * 2702
    assert plate.mass == pytest.approx(mass, rel=1e-13)
    xy = plate.dofs.xyz[::3, :2]
    for c in np.eye(6)[:3]:
        q = quadratic(xy, c).ravel()
        assert np.abs(plate.K @ q).max() < 1e-12 * np.abs(abs(plate.K) @ np.abs(q)).max()
    tilt = quadratic(xy, [-0.3, 1, 0, 0, 0, 0]).ravel()
    assert tilt @ (plate.M @ tilt) == pytest.approx(mass * 0.36 / 12, rel=1e-12)


def test_numbering(plate):
    assert plate.dofs.labels[:4] == ("1:z", "1:rx", "1:ry", "2:z")
    np.testing.assert_allclose(plate.dofs.xyz[plate.dofs.index("2:z")], [0.075, 0, 0])
    np.testing.assert_allclose(plate.dofs.xyz[plate.dofs.index("10:z")], [0, 0.075, 0])
    np.testing.assert_array_equal(plate.dofs.xyz[-1], [0.6, 0.6, 0])
    assert plate.dofs.nearest((0.3, 0.15, 0), "z") == "23:z"


@pytest.mark.parametrize(("count", "length"), [(8, 0.6), (11, 0.1), (35, 0.7), (37, 0.6)])
def test_the_last_node_is_at_the_corner(count, length):
    # count * (length / count) is not length for the last three
    plate = make_plate(elements=(count, count), size=(length, length))
    np.testing.assert_array_equal(plate.dofs.xyz.max(axis=0), [length, length, 0])


def test_rounding_of_a_point_does_not_choose_the_element(plate):
    on_edge = plate.dofs.row((0.225, 0.1, 0), "ry")
    for x in (0.225 - 1e-12, 0.225 + 1e-12):
        np.testing.assert_allclose(plate.dofs.row((x, 0.1, 0), "ry"), on_edge, atol=1e-9)
    # the slope does jump there
    beside = plate.dofs.row((0.225 - 1e-6, 0.1, 0), "ry")
    assert np.abs(beside - on_edge).max() > 0.1


def test_interpolation_is_exact_at_nodes():
    model = make_plate(elements=(7, 3), size=(0.7, 0.1))
    for label, xyz, direction in zip(
        model.dofs.labels, model.dofs.xyz, model.dofs.directions, strict=True
    ):
        row = model.dofs.row(xyz, direction)
        np.testing.assert_allclose(row, model.dofs.row(label), atol=1e-12)


@given(
    c=st.lists(st.floats(-1, 1), min_size=6, max_size=6),
    place=st.tuples(st.integers(0, 1000), st.integers(0, 1000)),
    elements=st.tuples(st.integers(1, 6), st.integers(1, 6)),
)
def test_interpolation_reproduces_quadratic_fields(c, place, elements):
    size = (0.6, 0.4)
    shape = PlateShape(size, 0.01, elements)
    # thousandths: on a line of nodes or far from it, not within the 1e-9 that count as on it
    point = np.array([place[0] * size[0] / 1000, place[1] * size[1] / 1000, 0.0])
    c = np.array(c) / (np.abs(c).max() or 1.0)
    q = quadratic(oracle.nodes(*elements, size=size), c).ravel()
    exact = quadratic([point[:2]], c)[0]
    found = [shape.row(point, direction) @ q for direction in ("z", "rx", "ry")]
    assert np.abs(found - exact).max() <= 1e-11 * np.abs(q).max()


def test_interpolation_inside_an_element_is_that_of_the_oracle(plate):
    a = 0.075
    shape = oracle.element_shape(a, a)
    s, t = 0.3 * a, 0.8 * a
    first = 2 * 9 + 4  # element (4, 2)
    columns = [3 * n + d for n in (first, first + 1, first + 10, first + 9) for d in range(3)]
    point = (4 * a + s, 2 * a + t, 0.0)
    for direction, weights in {
        "z": oracle.terms(s, t),
        "rx": oracle.terms(s, t, 0, 1),
        "ry": -oracle.terms(s, t, 1, 0),
    }.items():
        expected = np.zeros(243)
        expected[columns] = weights @ shape
        np.testing.assert_allclose(plate.dofs.row(point, direction), expected, atol=1e-11)


def test_z_is_continuous_across_edges(plate):
    rng = np.random.default_rng(1)
    q = rng.standard_normal(243)
    for y in rng.uniform(0, 0.6, 5):
        left, right = (plate.dofs.row((0.15 + d, y, 0)) @ q for d in (-1e-8, 1e-8))
        assert left == pytest.approx(right, abs=1e-4)


@pytest.mark.parametrize(
    ("point", "direction"),
    [
        ((0.61, 0.3, 0), "z"),
        ((0.3, -0.01, 0), "z"),
        ((0.3, 0.3, 0.02), "z"),
        ((300, 300, 0), "rx"),
        ((0.3, 0.3, 0), "x"),
        ((0.3, 0.3, 0), "rz"),
    ],
)
def test_points_off_the_plate_and_other_motions_are_refused(plate, point, direction):
    with pytest.raises(LabelError, match=r"off the plate|no motion"):
        plate.dofs.row(point, direction)


def test_surfaces_and_edges_belong_to_the_plate(plate):
    row = plate.dofs.row((0.6, 0.6, 0.0136), "z")
    np.testing.assert_allclose(row, plate.dofs.row("81:z"), atol=1e-12)


@pytest.mark.parametrize(
    ("changes", "error"),
    [
        ({"size": (0.6,)}, ShapeError),
        ({"size": (0.6, -1)}, ModelError),
        ({"size": (0.6, np.nan)}, ModelError),
        ({"thickness": 0}, ModelError),
        ({"thickness": np.inf}, ModelError),
        ({"density": -1}, ModelError),
        ({"youngs_modulus": 0}, ModelError),
        ({"poisson_ratio": 0.5}, ModelError),
        ({"poisson_ratio": -1}, ModelError),
        ({"elements": (0, 8)}, ModelError),
        ({"elements": (8.5, 8)}, ModelError),
        ({"elements": (8,)}, ShapeError),
        ({"elements": 8}, ShapeError),
    ],
)
def test_bad_input(changes, error):
    with pytest.raises(error, match=next(iter(changes))):
        make_plate(**changes)


def test_bad_point_is_refused(plate):
    with pytest.raises(ModelError, match="at has a NaN"):
        plate.dofs.row((np.nan, 0, 0))
    with pytest.raises(ShapeError, match="at must have shape"):
        plate.dofs.row((0.1, 0.1))


@pytest.mark.slow
def test_a_hundred_thousand_elements_in_seconds():
    start = time.perf_counter()
    model = make_plate(elements=(400, 250))
    assert time.perf_counter() - start < 10  # about 1.2 s on an idle core
    assert model.n_dof == 3 * 401 * 251
    assert model.mass == pytest.approx(0.36 * 0.0272 * 2702, rel=1e-10)

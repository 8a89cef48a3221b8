"""Plates against published parameters; varying elements, holes and ribs against dense matrices."""

import numpy as np
import pytest
import scipy.linalg as la
import scipy.sparse.linalg as spla

import oracles_grids as oracle
from flexplant.errors import LabelError, ModelError, ShapeError
from flexplant.modes import solve_modes
from flexplant.structure import (
    Disc,
    FEModel,
    PlateShape,
    Rectangle,
    Rib,
    Spring,
    kirchhoff_plate,
    solid_block,
)
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
    missing = np.zeros((nx, ny), dtype=bool)
    missing[0, 0] = missing[2, 1] = True
    fields = {
        "thickness": rng.uniform(0.01, 0.02, (nx, ny)),
        "density": rng.uniform(2e3, 8e3, (nx, ny)),
        "youngs_modulus": rng.uniform(5e10, 9e10, (nx, ny)),
        "poisson_ratio": rng.uniform(0.2, 0.4, (nx, ny)),
    }
    return missing, fields


def test_varying_elements_and_holes_are_the_oracle_s():
    missing, fields = varied()
    plate = make_plate(elements=(4, 3), size=(0.8, 0.5), holes=missing, **fields)
    M, K, there = oracle.varied_plate(
        4, 3, (0.8, 0.5), *(fields[k] for k in fields), missing=missing
    )
    np.testing.assert_array_equal(plate.dofs.nodes, there // 3 + 1)
    assert "1:z" not in plate.dofs
    for ours, theirs in ((plate.M, M), (plate.K, K)):
        scale = np.sqrt(np.outer(np.diag(theirs), np.diag(theirs)))
        assert np.abs((ours.toarray() - theirs) / scale).max() < 1e-12
        assert abs(ours - ours.T).max() == 0
    assert plate.rigid_body.shape[1] == 3
    FEModel(plate.M, plate.K, dofs=plate.dofs)


def test_functions_of_the_centre_and_arrays_are_the_same():
    missing, _ = varied()
    x, y = (np.arange(4) + 0.5) * 0.2, (np.arange(3) + 0.5) * 0.5 / 3
    centres = np.meshgrid(x, y, indexing="ij")
    one = make_plate(
        elements=(4, 3),
        size=(0.8, 0.5),
        holes=missing,
        thickness=0.01 + 0.01 * centres[0] * centres[1],
    )
    two = make_plate(
        elements=(4, 3),
        size=(0.8, 0.5),
        holes={Rectangle((0, 0), (0.2, 1 / 6)), Rectangle((0.4, 1 / 6), (0.6, 1 / 3))},
        thickness=lambda x, y: 0.01 + 0.01 * x * y,
    )
    np.testing.assert_allclose(two.K.toarray(), one.K.toarray(), rtol=1e-12, atol=1e-6)
    three = make_plate(
        elements=(4, 3), size=(0.8, 0.5), holes=lambda x, y: missing[int(x / 0.2), int(y * 6)]
    )
    assert three.dofs.labels == one.dofs.labels
    assert (
        repr(three.dofs.interpolation)
        == "PlateShape(size=[0.8, 0.5], thickness=0.0272, elements=[4, 3], present=array (3, 4))"
    )


@pytest.mark.long
def test_a_disc_cuts_elements_by_their_area():
    """Against a mesh so fine that its staircase does not count."""
    size, disc = {"size": (0.6, 0.4), "thickness": 0.02}, Disc((0.3, 0.2), 0.1)
    plate = make_plate(**size, elements=(24, 16), holes=disc)
    solid = make_plate(**size, elements=(24, 16)).mass
    assert plate.mass == pytest.approx(solid * (1 - np.pi * 0.1**2 / 0.24), rel=3e-3)
    fine = make_plate(
        **size, elements=(120, 80), holes=lambda x, y: np.hypot(x - 0.3, y - 0.2) < 0.1
    )
    freq, exact = (solve_modes(model, count=12).freq[3:] for model in (plate, fine))
    np.testing.assert_allclose(freq, exact, rtol=5e-3)


@pytest.mark.slow
def test_a_rib_twists_as_one_piece_with_its_plate():
    """The lowest mode of a plate with one rib is torsion: beside the same body of bricks."""
    material = {"density": 2700, "youngs_modulus": 70e9, "poisson_ratio": 0.33}
    plate = kirchhoff_plate(
        size=(0.15, 0.1), thickness=0.006, elements=(30, 20), **material,
        ribs=Rib((0, 0.05), (0.15, 0.05), width=0.01, height=0.01),
    )  # fmt: skip
    body = solid_block(
        size=(0.15, 0.1, 0.016), elements=(30, 20, 8), **material,
        holes=lambda x, y, z: z > 0.006 and abs(y - 0.05) > 0.005,
    )  # fmt: skip
    found, exact = solve_modes(plate, count=4).freq[3], solve_modes(body, count=7).freq[6]
    assert found == pytest.approx(exact, rel=0.02)


@pytest.mark.parametrize("direction", ["z", "rx", "ry"])
def test_many_points_at_once_are_the_points_one_by_one(direction):
    """Inside, on all edges and beside a hole; one point in the hole is refused."""
    plate = make_plate(elements=(4, 4), holes=Rectangle((0.3, 0.3), (0.45, 0.45)))
    x, y = np.meshgrid(np.linspace(0.0, 0.6, 9), np.linspace(0.0, 0.6, 13))
    points = np.column_stack([x.ravel(), y.ravel(), np.full(x.size, 0.01)])
    inside = (points[:, :2] > 0.3 + 1e-9) & (points[:, :2] < 0.45 - 1e-9)
    points = points[~np.all(inside, axis=1)]
    found = plate.dofs.rows(points, direction)
    expected = [plate.dofs.row(point, direction) for point in points]
    np.testing.assert_allclose(found, expected, rtol=1e-12, atol=1e-12)
    with pytest.raises(LabelError, match="in a hole"):
        plate.dofs.rows([*points[:3], (0.4, 0.4, 0.0)], direction)
    with pytest.raises(LabelError, match="off the plate"):
        plate.dofs.rows([*points[:3], (0.7, 0.1, 0.0)], direction)


def test_interpolation_beside_holes():
    plate = make_plate(elements=(4, 4), holes=Rectangle((0.3, 0.3), (0.45, 0.45)))
    q = np.column_stack(
        [0.2 + plate.dofs.xyz[::3, :2] @ [1, 2], *np.tile([[2.0], [-1]], 25)]
    ).ravel()
    for point in [(0.1, 0.5, 0), (0.3, 0.4, 0), (0.45, 0.3, 0), (0.3, 0.3, 0)]:
        z = 0.2 + point[0] + 2 * point[1]
        moved = [plate.dofs.row(point, d) @ q for d in ("z", "rx", "ry")]
        np.testing.assert_allclose(moved, [z, 2, -1], atol=1e-12)
    with pytest.raises(LabelError, match=r"in a hole.*nearest node is 13, at \(0.3, 0.3\)"):
        plate.dofs.row((0.34, 0.32, 0))


def test_surfaces_where_the_thickness_varies():
    plate = make_plate(elements=(2, 1), thickness=[[0.01], [0.03]])
    plate.dofs.row((0.5, 0.3, 0.014))
    with pytest.raises(LabelError, match=r"0\.005 m"):
        plate.dofs.row((0.1, 0.3, 0.014))


RIBS = [
    Rib((0, 0.3), (0.6, 0.3), width=0.01, height=0.03),
    Rib((0.45, 0.6), (0.45, 0.15), area=2e-4, inertia=3e-9, torsion=1e-9, eccentricity=0.01,
        density=8000, youngs_modulus=2e11, poisson_ratio=0.25),
]  # fmt: skip


def quadratic(plate, c):
    x, y = plate.dofs.xyz[::3, :2].T
    z = c[0] + c[1] * x + c[2] * y + c[3] * x**2 + c[4] * x * y + c[5] * y**2
    return np.column_stack(
        [z, c[2] + c[4] * x + 2 * c[5] * y, -(c[1] + 2 * c[3] * x + c[4] * y)]
    ).ravel()


def test_ribs_store_the_energy_of_beams():
    """Constant curvature and twist along each rib: E I z_ss^2 + G J z_st^2, exactly."""
    bare, plate = square(8), square(8, ribs=RIBS)
    more = plate.K - bare.K
    q = 0.01 / 0.04  # torsion reaches through the plate
    J = 0.01**3 * 0.04 * (1 / 3 - 0.21 * q * (1 - q**4 / 12))
    first = 0.01 * 0.03**3 / 12 + 3e-4 * 0.02**2
    second = 3e-9 + 2e-4 * 0.01**2
    for c in ([0, 0, 0, 1, 0, 0], [0, 0, 0, 0, 1, 0], [0, 0, 0, 0, 0, 1], [1, 2, 3, -1, 2, 5]):
        q = quadratic(plate, c)
        exact = 0.6 * (E * first * 4 * c[3] ** 2 + E / 2.6 * J * c[4] ** 2)
        exact += 0.45 * (2e11 * second * 4 * c[5] ** 2 + 2e11 / 2.5 * 1e-9 * c[4] ** 2)
        assert q @ (more @ q) == pytest.approx(exact, rel=1e-9)


def test_ribs_have_the_inertia_of_bars():
    bare, plate = square(8), square(8, ribs=RIBS)
    more = plate.M - bare.M
    bar, post = RHO * 3e-4 * 0.6, 8000 * 2e-4 * 0.45
    assert plate.mass - bare.mass == pytest.approx(bar + post, rel=1e-11)
    # turning about x: the bar along x at y = 0.3, its centre 0.02 above the middle plane
    q = quadratic(plate, [-0.3, 0, 1, 0, 0, 0])
    exact = bar * ((0.01**2 + 0.03**2) / 12 + 0.02**2)
    exact += post * (0.45**2 / 12 + 0.075**2) + 8000 * 0.45 * (3e-9 + 2e-4 * 0.01**2)
    assert q @ (more @ q) == pytest.approx(exact, rel=1e-9)
    # turning about y
    q = quadratic(plate, [-0.3, 1, 0, 0, 0, 0])
    exact = bar * (0.6**2 / 12 + 0.03**2 / 12 + 0.02**2) + post * 0.15**2
    exact += 8000 * 0.45 * (3e-9 + 2e-4 * 0.01**2)
    assert q @ (more @ q) == pytest.approx(exact, rel=1e-9)
    assert plate.rigid_body.shape[1] == 3
    FEModel(plate.M, plate.K, dofs=plate.dofs)


def test_a_rib_takes_the_material_beside_it():
    # on the border of two materials: their mean; half on each side of a step
    plate = square(4, youngs_modulus=[[1e10] * 4, [1e10] * 4, [3e10] * 4, [3e10] * 4])
    bent = {"area": 1e-4, "inertia": 1e-9}
    for rib, mean in (
        (Rib((0.3, 0), (0.3, 0.6), **bent), 2e10),
        (Rib((0.15, 0), (0.15, 0.6), **bent), 1e10),
        (Rib((0.6, 0), (0.6, 0.6), **bent), 3e10),
    ):
        stiff = square(4, ribs=rib, youngs_modulus=lambda x, y: 1e10 if x < 0.3 else 3e10)
        q = quadratic(plate, [0, 0, 0, 0, 0, 1])
        assert q @ ((stiff.K - plate.K) @ q) == pytest.approx(mean * 1e-9 * 4 * 0.6, rel=1e-6)


def test_a_plate_of_ribs_alone_is_a_beam():
    """A narrow, weak plate under a strong rib: the beam's frequencies."""
    rib = Rib((0, 0), (0.6, 0), area=1e-4, inertia=1e-9, torsion=1e-9, polar=2e-9,
              density=7850, youngs_modulus=2.1e11, poisson_ratio=0.3)  # fmt: skip
    plate = make_plate(
        size=(0.6, 0.006), elements=(16, 1), thickness=1e-3, density=0.1, youngs_modulus=1e5,
        poisson_ratio=0.3, ribs=[rib],
    )  # fmt: skip
    squares = la.eigvalsh(plate.K.toarray(), plate.M.toarray())
    freq = np.sqrt(np.abs(squares))
    exact = (4.730040745 / 0.6) ** 2 * np.sqrt(2.1e11 * 1e-9 / 7850 / 1e-4)
    assert np.min(np.abs(freq / exact - 1)) < 1e-3


@pytest.mark.parametrize(
    ("changes", "error", "says"),
    [
        ({"start": (0, 0)}, ModelError, "along x or along y"),
        ({"end": (0, 0.3)}, ModelError, "along x or along y"),
        ({"height": None}, ModelError, "needs its section"),
        ({"area": 1e-4}, ModelError, "needs its section"),
        ({"width": None, "height": None, "area": 1e-4}, ModelError, "needs its section"),
        ({"width": -1}, ModelError, "width must be positive"),
        ({"density": 0}, ModelError, "density"),
        ({"poisson_ratio": 0.6}, ModelError, "poisson_ratio"),
        ({"start": (0,)}, ShapeError, "start"),
    ],
)
def test_bad_ribs(changes, error, says):
    fields = {"start": (0, 0.3), "end": (0.6, 0.3), "width": 0.01, "height": 0.02} | changes
    with pytest.raises(error, match=says):
        Rib(**fields)


@pytest.mark.parametrize(
    ("changes", "error", "says"),
    [
        (
            {"ribs": Rib((0, 0.31), (0.6, 0.31), width=0.01, height=0.02)},
            ModelError,
            "node to node",
        ),
        ({"ribs": Rib((0, 0.3), (0.9, 0.3), width=0.01, height=0.02)}, ModelError, "node to node"),
        ({"ribs": "stiff"}, ModelError, "list of Rib"),
        ({"ribs": 3}, ModelError, "list of Rib"),
        ({"thickness": np.ones((8, 7))}, ShapeError, "one for each element"),
        ({"thickness": lambda x, y: 0.0}, ModelError, "every element"),
        ({"poisson_ratio": np.full((8, 8), 0.6)}, ModelError, "poisson_ratio"),
        ({"holes": [Disc((0.3, 0.3), 1.0)]}, ModelError, "nothing at all"),
        ({"holes": Rectangle((0.2, -1), (0.4, 1))}, ModelError, "2 separate pieces"),
        ({"holes": [3]}, ModelError, "holes must be"),
    ],
)
def test_bad_plates(changes, error, says):
    with pytest.raises(error, match=says):
        make_plate(**changes)


def test_a_rib_across_a_hole_is_refused():
    with pytest.raises(ModelError, match="crosses a hole"):
        make_plate(holes=Disc((0.3, 0.3), 0.12), ribs=RIBS[:1])
    # along its edge it has plate on one side
    make_plate(holes=Rectangle((0.2, 0.3), (0.4, 0.4)), ribs=RIBS[:1])


def test_bad_holes():
    with pytest.raises(ModelError, match="upper corner"):
        Rectangle((0, 0), (1, 0))
    with pytest.raises(ModelError, match="radius"):
        Disc((0, 0), 0)


def test_reprs():
    assert repr(RIBS[0]) == "Rib(start=[0, 0.3] m, end=[0.6, 0.3] m, width=0.01, height=0.03)"
    assert repr(RIBS[1]).endswith("youngs_modulus=2e+11, poisson_ratio=0.25)")
    assert repr(Disc((0, 0), 0.1)) == "Disc(centre=[0, 0] m, radius=0.1 m)"
    assert repr(Rectangle((0, 0), (1, 2))) == "Rectangle(lower=[0, 0] m, upper=[1, 2] m)"
    assert (
        repr(PlateShape((1, 1), 0.1, (2, 2)))
        == "PlateShape(size=[1, 1], thickness=0.1, elements=[2, 2])"
    )

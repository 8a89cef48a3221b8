"""Point masses, springs, dampers, held DOFs, permuted DOFs and units: on any model."""

import pickle

import numpy as np
import pytest
import scipy.linalg as la

import oracles_structure as oracle
from flexplant import DofSet, load
from flexplant.errors import LabelError, ModelError, ShapeError
from flexplant.modes import solve_modes
from flexplant.structure import (
    Damper,
    FEModel,
    HeldShape,
    PointMass,
    Spring,
    beam,
    chain,
    interpolated,
    solid_block,
)
from plates import make_plate

STEEL = {"density": 7850.0, "youngs_modulus": 210e9, "area": 2e-4, "inertia": 1.5e-9}
BAR = {"length": 1.0, "elements": 20} | STEEL


def squares(model):
    return la.eigvalsh(model.K.toarray(), model.M.toarray())


def dense(matrix):
    return matrix.toarray() if hasattr(matrix, "toarray") else matrix


def test_each_part_adds_its_row():
    plate = make_plate(elements=(4, 4))
    at, other = (0.21, 0.34, 0), "7:z"
    row, to = plate.dofs.row(at), plate.dofs.row("7:z")
    model = plate.with_parts(
        [
            PointMass(at, 0.5),
            Spring(at, 3e4, to=other),
            Damper("7:rx", 2.0),
            Spring({other: 2.0}, 5),
        ]
    )
    M = plate.M.toarray() + 0.5 * np.outer(row, row)
    K = plate.K.toarray() + 3e4 * np.outer(row - to, row - to) + 5 * np.outer(2 * to, 2 * to)
    D = 2.0 * np.outer(plate.dofs.row("7:rx"), plate.dofs.row("7:rx"))
    np.testing.assert_allclose(model.M.toarray(), M, atol=1e-15 * M.max())
    np.testing.assert_allclose(model.K.toarray(), K, atol=1e-15 * K.max())
    np.testing.assert_allclose(model.D.toarray(), D)
    assert plate.D is None
    assert model.dofs is plate.dofs
    # what is not touched is the same; a second time adds again
    assert plate.with_parts(Spring("1:z", 1.0)).M is plate.M
    twice = model.with_parts([Damper("7:rx", 2.0)])
    np.testing.assert_allclose(twice.D.toarray(), 2 * D)
    # the constructor accepts them
    FEModel(model.M, model.K, model.D, dofs=model.dofs)


def test_dense_imported_models_take_parts_too():
    dofs = DofSet([1, 2], ["x", "x"], [[0, 0, 0], [1, 0, 0]])
    model = FEModel(np.eye(2), np.zeros((2, 2)), dofs=dofs).with_parts(
        [Spring("1:x", 3.0, to="2:x"), PointMass((1, 0, 0), 2.0)]
    )
    np.testing.assert_allclose(dense(model.K), [[3, -3], [-3, 3]])
    np.testing.assert_allclose(dense(model.M), np.diag([1, 3]))
    assert isinstance(model.K, np.ndarray)


def test_mass_at_the_tip_of_a_cantilever():
    # characteristic equation with tip mass ratio r: 1 + cos cosh + r x (cos sinh - sin cosh) = 0
    bar = beam(**BAR, ends=("clamped", "free"))
    ratio = 0.7
    model = bar.with_parts(PointMass((1.0, 0, 0), ratio * 7850 * 2e-4))

    def f(x):
        c, s, ch, sh = np.cos(x), np.sin(x), np.cosh(x), np.sinh(x)
        return 1 + c * ch + ratio * x * (c * sh - s * ch)

    from scipy.optimize import brentq

    speed = np.sqrt(210e9 * 1.5e-9 / (7850 * 2e-4))
    roots = np.array([brentq(f, 0.5, 1.8), brentq(f, 3, 4.6)])
    np.testing.assert_allclose(np.sqrt(squares(model)[:2]), roots**2 * speed, rtol=2e-6)


def test_spring_under_the_tip_of_a_cantilever():
    # 1 + cos cosh - (k L^3 / E I) (cos sinh - sin cosh) / x^3 = 0
    bar = beam(**BAR, ends=("clamped", "free"))
    stiff = 5.0
    model = bar.with_parts(Spring("21:z", stiff * 210e9 * 1.5e-9))

    def f(x):
        c, s, ch, sh = np.cos(x), np.sin(x), np.cosh(x), np.sinh(x)
        return 1 + c * ch - stiff / x**3 * (c * sh - s * ch)

    from scipy.optimize import brentq

    speed = np.sqrt(210e9 * 1.5e-9 / (7850 * 2e-4))
    assert np.sqrt(squares(model)[0]) == pytest.approx(brentq(f, 1, 3.5) ** 2 * speed, rel=1e-6)


def test_inertia_rides_on_rotations():
    plate = make_plate(elements=(4, 4))
    at = (0.31, 0.22, 0)
    model = plate.with_parts(PointMass(at, 2.0, inertia=(0.1, 0.2, 0.0)))
    more = model.M - plate.M
    for c, exact in (
        ([1, 0, 0], 2.0),
        ([0, 0, 1], 0.1 + 2 * 0.22**2),
        ([0, 1, 0], 0.2 + 2 * 0.31**2),
    ):
        x, y = plate.dofs.xyz[::3, :2].T
        q = np.column_stack([c[0] + c[1] * x + c[2] * y, 0 * x + c[2], 0 * x - c[1]]).ravel()
        assert q @ (more @ q) == pytest.approx(exact, rel=1e-12)
    block = solid_block(
        size=(1, 1, 1), elements=(1, 1, 1), density=1, youngs_modulus=1, poisson_ratio=0.2
    )
    heavy = block.with_parts(PointMass((1, 1, 1), 3.0))
    for k in range(3):
        q = np.tile(np.eye(3)[k], 8)
        assert q @ ((heavy.M - block.M) @ q) == pytest.approx(3.0)


def test_dampers_against_dense_poles():
    model = chain(masses=[1, 2, 1.5], stiffnesses=[5e4, 7e4], ground=[3e4, 0, 0]).with_parts(
        [Damper("1:x", 4.0), Damper("3:x", 9.0, to="2:x")]
    )
    M, K = model.M.toarray(), model.K.toarray()
    D = np.diag([4.0, 0, 0]) + 9.0 * np.array([[0, 0, 0], [0, 1, -1], [0, -1, 1]])
    expected = oracle.poles(M, D, K)
    found = solve_modes(model).poles
    np.testing.assert_allclose(found, expected, rtol=1e-9)
    assert np.all(found.real < 0)


def test_grounded_springs_take_rigid_body_motions_away():
    plate = make_plate(elements=(4, 4))
    assert plate.with_parts(Spring("1:z", 1e3)).rigid_body.shape[1] == 2
    three = [Spring(at, 1e3) for at in ((0.1, 0.1, 0), (0.5, 0.1, 0), (0.3, 0.5, 0))]
    assert plate.with_parts(three).rigid_body.shape[1] == 0
    # a spring between two of its places keeps the translation
    assert plate.with_parts(Spring("1:z", 1e3, to="13:z")).rigid_body.shape[1] == 2


def test_stiff_springs_tend_to_fixed_dofs():
    bar = beam(**BAR)
    held = bar.fixed(["1:z", "1:ry"])
    np.testing.assert_allclose(
        squares(held), squares(beam(**BAR, ends=("clamped", "free"))), rtol=1e-12
    )
    errors = []
    for k in (1e8, 1e9):
        soft = bar.with_parts([Spring("1:z", k), Spring("1:ry", k)])
        errors.append(1 - np.sqrt(squares(soft)[0] / squares(held)[0]))
    assert 0 < errors[1] < 1e-5
    assert errors[0] / errors[1] == pytest.approx(10, rel=0.02)


def test_fixed_keeps_places_and_damping():
    plate = make_plate(elements=(4, 4))
    model = plate.with_damping(0.01 * plate.M).fixed(plate.dofs.where(nodes=[1, 5]))
    keep = np.setdiff1d(np.arange(75), plate.dofs.indices(plate.dofs.where(nodes=[1, 5])))
    for name in ("M", "K"):
        whole = getattr(plate, name).toarray()
        np.testing.assert_array_equal(getattr(model, name).toarray(), whole[np.ix_(keep, keep)])
    np.testing.assert_array_equal(model.D.toarray(), 0.01 * model.M.toarray())
    row = model.dofs.row((0.01, 0.01, 0), "rx")
    np.testing.assert_array_equal(row, plate.dofs.row((0.01, 0.01, 0), "rx")[keep])
    assert isinstance(model.dofs.interpolation, HeldShape)
    twice = model.fixed(["2:z"])
    np.testing.assert_array_equal(
        twice.dofs.row((0.01, 0.01, 0)), model.dofs.row((0.01, 0.01, 0))[1:]
    )
    with pytest.raises(LabelError, match=r"no DOF '1:z'"):
        model.fixed(["1:z"])
    with pytest.raises(ModelError, match="all 75 DOFs"):
        plate.fixed(plate.dofs)


def test_order_of_dofs_does_not_matter():
    plate = make_plate(elements=(3, 2))
    order = np.random.default_rng(2).permutation(plate.n_dof)
    mixed = FEModel(
        plate.M[order][:, order],
        plate.K[order][:, order],
        dofs=DofSet(
            plate.dofs.nodes[order],
            [plate.dofs.directions[i] for i in order],
            plate.dofs.xyz[order],
        ),
    )
    parts = [PointMass("5:z", 0.3), Spring("1:z", 1e5, to="12:z"), Spring("6:rx", 10.0)]
    one, two = (m.with_parts(parts).fixed(["3:z"]) for m in (plate, mixed))
    top = np.abs(squares(one)).max()
    np.testing.assert_allclose(squares(two), squares(one), rtol=1e-9, atol=1e-12 * top)
    assert two.mass == pytest.approx(one.mass)
    again = [one.dofs.labels[i] for i in range(one.n_dof)]
    assert set(again) == set(two.dofs.labels)


def test_units():
    si = make_plate(elements=(3, 3))
    mm = make_plate(
        size=(600, 600), thickness=27.2, elements=(3, 3), density=2702e-12, youngs_modulus=70e3
    )
    bare = mm._with(dofs=mm.dofs.replace(interpolation=None), D=1e-3 * mm.M)
    found = bare.converted(length="mm", mass="t")
    for ours, theirs in ((found.M, si.M), (found.K, si.K), (found.D, 1e-3 * si.M)):
        scale = np.sqrt(np.outer(theirs.diagonal(), theirs.diagonal()))
        assert np.abs((ours - theirs).toarray() / scale).max() < 1e-12
    np.testing.assert_allclose(found.dofs.xyz, si.dofs.xyz, atol=1e-12)
    assert found.rigid_body.shape[1] == 3
    # the frequencies never depended on it
    np.testing.assert_allclose(squares(found)[3:], squares(mm)[3:], rtol=1e-9)
    with pytest.raises(ModelError, match="interpolation"):
        mm.converted(length="mm", mass="t")
    with pytest.raises(ModelError, match="parsec"):
        bare.converted(length="parsec")


@pytest.mark.parametrize(
    ("make", "error", "says"),
    [
        (lambda: PointMass("1:z", -1), ModelError, "mass of a point mass"),
        (lambda: PointMass("1:z", 1, inertia=1), ModelError, "needs a point"),
        (lambda: PointMass((0, 0, 0), 1, inertia=(1, 2)), ModelError, "three"),
        (lambda: PointMass((0, 0, 0), 1, inertia=(1, 2, -1)), ModelError, "three"),
        (lambda: PointMass((0, 0), 1), LabelError, "must be at a DOF label"),
        (lambda: PointMass(None, 1), LabelError, "must be at a DOF label"),
        (lambda: Spring("1:z", np.nan), ModelError, "stiffness of a spring"),
        (lambda: Spring((0, 0, 0), 1, direction="up"), LabelError, "direction"),
        (lambda: Damper("1:z", -1), ModelError, "rate of a damper"),
        (lambda: make_plate().with_parts([3]), ModelError, "a part must be of type PointMass"),
        (lambda: make_plate().with_parts(3), ModelError, "parts must be"),
        (lambda: make_plate().with_parts(Spring("99:z", 1)), LabelError, "99:z"),
        (lambda: make_plate().with_parts(Spring("9:z", 1, to="9:z")), ModelError, "both ends"),
        (lambda: make_plate().with_parts(PointMass((9, 9, 0), 1)), LabelError, "off the plate"),
    ],
)
def test_bad_parts(make, error, says):
    with pytest.raises(error, match=says):
        make()


def test_a_point_mass_needs_a_translation():
    dofs = DofSet([1], ["rx"], [[0, 0, 0]])
    with pytest.raises(ModelError, match="no translation"):
        FEModel([[1.0]], [[0.0]], dofs=dofs).with_parts(PointMass((0, 0, 0), 1))


def test_they_travel(tmp_path):
    model = (
        interpolated(chain(masses=[1, 2, 1], stiffnesses=[3, 4], dampings=[0.1, 0.1]))
        .with_parts([Damper("1:x", 1)])
        .fixed(["3:x"])
    )
    model.save(tmp_path / "model.npz")
    for other in (pickle.loads(pickle.dumps(model)), load(tmp_path / "model.npz")):
        assert repr(other) == repr(model)
        np.testing.assert_array_equal(dense(other.D), dense(model.D))
        np.testing.assert_array_equal(
            other.dofs.row((0.4, 0, 0), "x"), model.dofs.row((0.4, 0, 0), "x")
        )
        with pytest.raises(ValueError, match="read-only"):
            other.D.data[0] = 1
    with pytest.raises(ValueError, match="read-only"):
        model.K.data[0] = 1
    part = PointMass((0, 0, 0), 1.0)
    part.save(tmp_path / "part.npz")
    assert load(tmp_path / "part.npz") == part or repr(load(tmp_path / "part.npz")) == repr(part)
    assert repr(part) == "PointMass(at=(0.0, 0.0, 0.0), mass=1.0, inertia=(0.0, 0.0, 0.0))"
    assert repr(model.dofs.interpolation).startswith("HeldShape(free=ScatteredShape(xyz=")


def test_bad_box():
    plate = make_plate(elements=(2, 2))
    with pytest.raises(ShapeError, match="lowest and its highest corner"):
        plate.dofs.where(box=[(1, 1, 1), (0, 0, 0)])

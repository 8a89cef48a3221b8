"""Plates and beams that shear: against polynomials, solids, closed forms and the thin plate."""

import numpy as np
import pytest
import scipy.linalg as la
from hypothesis import given
from hypothesis import strategies as st

import flexplant as fx
from flexplant.errors import ModelError
from flexplant.testbeds.virtual_blocks import ritz_block
from oracles_mindlin import mindlin_frequencies
from oracles_structure import plate_matrices
from plates import PLATE

ALUMINIUM = {"density": 2700.0, "youngs_modulus": 70e9, "poisson_ratio": 0.33}


def frequencies(model, rigid=3):
    values = la.eigvalsh(model.K.toarray(), model.M.toarray())
    return np.sqrt(np.abs(values[rigid:])) / (2 * np.pi)


def made(size, thickness, elements, **changes):
    return fx.plate(size=size, thickness=thickness, elements=elements, **(ALUMINIUM | changes))


def random_plate(seed):
    rng = np.random.default_rng(seed)
    size = rng.uniform(0.2, 0.8, size=2)
    return tuple(size), float(size.min() * 10 ** rng.uniform(-2.5, -0.8)), rng


@pytest.mark.slow
@pytest.mark.parametrize("seed", range(6))
def test_thick_and_thin_plates_converge_to_mindlin_s_theory(seed):
    """From a 300th to a sixth of the side; nothing locks and nothing is left at the limit."""
    size, thickness, _ = random_plate(seed)
    exact = mindlin_frequencies(size, thickness, 2700.0, 70e9, 0.33, order=15, count=10)
    errors = []
    for n in (12, 24):
        cells = tuple(max(round(n * s / max(size)), 4) for s in size)
        errors.append(frequencies(made(size, thickness, cells))[:10] / exact - 1.0)
    assert np.abs(errors[1]).max() < 0.012
    assert np.abs(errors[1]).max() < 0.75 * np.abs(errors[0]).max()


@pytest.mark.slow
def test_errors_fall_with_the_square_of_the_element():
    """Where elements resolve the thickness, along which a free edge twists."""
    exact = mindlin_frequencies((0.4, 0.3), 0.08, 2700.0, 70e9, 0.33, order=16, count=6)
    coarse, fine = (
        np.abs(frequencies(made((0.4, 0.3), 0.08, (4 * n, 3 * n)))[:6] / exact - 1.0)
        for n in (3, 6)
    )
    np.testing.assert_allclose(coarse / fine, 4.0, rtol=0.15)


@pytest.mark.slow
def test_a_thin_plate_is_kirchhoff_s():
    size = (0.6, 0.45)
    thin = frequencies(made(size, 6e-4, (20, 15)))[:10]
    classic = frequencies(
        fx.kirchhoff_plate(size=size, thickness=6e-4, elements=(20, 15), **ALUMINIUM)
    )[:10]
    np.testing.assert_allclose(thin, classic, rtol=8e-3)


@pytest.mark.slow
def test_a_plate_that_does_not_shear_has_only_rotary_inertia():
    size, h = (0.6, 0.45), 0.0272
    stiff = frequencies(made(size, h, (28, 21), shear_factor=None))[:10]
    exact = mindlin_frequencies(size, h, 2700.0, 70e9, 0.33, order=14, k=1e4, count=10)
    np.testing.assert_allclose(stiff, exact, rtol=3e-3)
    shears = mindlin_frequencies(size, h, 2700.0, 70e9, 0.33, order=14, count=10)
    assert np.abs(stiff / shears - 1.0).max() > 0.02


@pytest.mark.slow
def test_a_solid_has_the_frequencies_of_the_thick_plate():
    size, h = (0.3, 0.24), 0.04
    solid = ritz_block(size=(*size, h), orders=(7, 7, 3), **ALUMINIUM)
    values, shapes = la.eigh(solid.K, solid.M)
    out = [i for i, d in enumerate(solid.dofs.directions) if d == "z"]
    share = np.sum(shapes[out] ** 2, axis=0) / np.sum(shapes**2, axis=0)
    bends = (np.arange(values.size) > 5) & (share > 0.5)  # six motions of a rigid body
    bending = np.sqrt(values[bends])[:6] / (2 * np.pi)
    thick = frequencies(made(size, h, (20, 16)))[:6]
    thin = frequencies(fx.kirchhoff_plate(size=size, thickness=h, elements=(20, 16), **ALUMINIUM))[
        :6
    ]
    np.testing.assert_allclose(thick, bending, rtol=6e-3)
    assert np.abs(thin / bending - 1.0).max() > 0.08


@given(
    c=st.lists(st.floats(-1, 1), min_size=3, max_size=3),
    size=st.tuples(st.floats(0.1, 2), st.floats(0.1, 2)),
    elements=st.tuples(st.integers(1, 4), st.integers(1, 4)),
    thickness=st.floats(1e-3, 0.3),
)
def test_patch_of_constant_curvature_stores_the_exact_energy(c, size, elements, thickness):
    c = np.array(c) / (np.abs(c).max() or 1.0)
    model = made(size, thickness, elements)
    x, y = model.dofs.xyz[::3, :2].T
    z = c[0] * x**2 + c[1] * x * y + c[2] * y**2
    q = np.column_stack([z, c[1] * x + 2 * c[2] * y, -(2 * c[0] * x + c[1] * y)]).ravel()
    unit = 70e9 * thickness**3 / 12 / (1 - 0.33**2) * size[0] * size[1]
    xx, yy, xy = 2 * c[0], 2 * c[2], c[1]
    energy = xx**2 + yy**2 + 2 * 0.33 * xx * yy + 2 * (1 - 0.33) * xy**2
    rounding = 1e-13 * np.abs(q) @ (abs(model.K) @ np.abs(q))
    assert q @ (model.K @ q) == pytest.approx(unit * energy, rel=1e-8, abs=1e-9 * unit + rounding)
    # the fields between the nodes are the parabola
    places = np.array([[0.3, 0.8, 0.0], [0.71, 0.13, 0.0], [1.0, 0.4, 0.0]]) * [*size, 1.0]
    x, y, _ = places.T
    exact = {"z": c[0] * x**2 + c[1] * x * y + c[2] * y**2, "ry": -2 * c[0] * x - c[1] * y}
    for direction, motion in exact.items():
        found = np.array([model.dofs.row(place, direction) for place in places]) @ q
        assert np.abs(found - motion).max() <= 1e-9 * np.abs(q).max()


def test_rigid_motions_weigh_what_a_slab_weighs():
    model = made((0.5, 0.3), 0.05, (4, 3))
    assert abs(model.M - model.M.T).max() == 0
    assert abs(model.K - model.K.T).max() == 0
    fx.FEModel(model.M, model.K, dofs=model.dofs)  # the public checks, which the mesh skips
    mass = 0.5 * 0.3 * 0.05 * 2700
    assert model.mass == pytest.approx(mass, rel=1e-12)
    x = model.dofs.xyz[::3, 0]
    tilt = np.column_stack([x - 0.25, 0 * x, -np.ones_like(x)]).ravel()
    assert np.abs(model.K @ tilt).max() < 1e-9 * abs(model.K).max()
    slab = mass * (0.5**2 + 0.05**2) / 12
    assert tilt @ (model.M @ tilt) == pytest.approx(slab, rel=1e-12)


def test_fields_are_the_sum_of_their_elements():
    """One element of a mesh of varying ones is the element of its own numbers."""
    rng = np.random.default_rng(3)
    shape = (3, 2)
    h, rho, E, nu = (
        rng.uniform(*ends, size=shape)
        for ends in ((0.01, 0.08), (2e3, 8e3), (5e10, 2e11), (0.1, 0.45))
    )
    whole = fx.plate(
        size=(0.3, 0.2), thickness=h, elements=shape, density=rho, youngs_modulus=E,
        poisson_ratio=nu,
    )  # fmt: skip
    M, K = (np.zeros(2 * (whole.n_dof,)) for _ in range(2))
    for i in range(3):
        for j in range(2):
            one = fx.plate(
                size=(0.1, 0.1), thickness=h[i, j], elements=(1, 1), density=rho[i, j],
                youngs_modulus=E[i, j], poisson_ratio=nu[i, j],
            )  # fmt: skip
            nodes = np.array([i + 4 * j, i + 1 + 4 * j, i + 4 * (j + 1), i + 1 + 4 * (j + 1)])
            rows = (3 * nodes[:, None] + np.arange(3)).ravel()
            M[np.ix_(rows, rows)] += one.M.toarray()
            K[np.ix_(rows, rows)] += one.K.toarray()
    for ours, sums in ((whole.M, M), (whole.K, K)):
        assert abs(ours - ours.T).max() == 0
        np.testing.assert_allclose(
            ours.toarray(), sums, rtol=1e-12, atol=1e-12 * np.abs(sums).max()
        )


@pytest.mark.slow
def test_fields_are_those_of_the_polynomials():
    def h(x, y):
        return 0.03 * (1.0 + 0.3 * x / 0.5 + 0.2 * y / 0.4)

    def E(x, y):
        return 70e9 * (1.0 - 0.3 * x * y / 0.2)

    exact = mindlin_frequencies((0.5, 0.4), h, 2700.0, E, 0.33, order=14, count=6)
    found = frequencies(made((0.5, 0.4), h, (25, 20), youngs_modulus=E))[:6]
    np.testing.assert_allclose(found, exact, rtol=8e-3)


def test_motion_is_continuous_between_elements():
    model = made((0.4, 0.3), 0.06, (4, 3))
    q = np.random.default_rng(1).normal(size=model.n_dof)
    for axis, edge in ((0, 0.1), (1, 0.2)):
        for direction in ("z", "rx", "ry"):
            sides = []
            for off in (-1e-9, 1e-9):
                at = np.array([0.137, 0.141, 0.0])
                at[axis] = edge + off
                sides.append(model.dofs.row(at, direction) @ q)
            assert sides[0] == pytest.approx(sides[1], abs=1e-5)


def test_many_rows_are_those_one_by_one():
    model = made((0.4, 0.3), 0.06, (4, 3), youngs_modulus=lambda x, y: 70e9 * (1 + x))
    points = np.random.default_rng(2).uniform(size=(7, 3)) * [0.4, 0.3, 0.0]
    for direction in ("z", "rx", "ry"):
        rows = model.dofs.interpolation.rows(points, direction)
        for point, row in zip(points, rows, strict=True):
            np.testing.assert_allclose(row, model.dofs.interpolation.row(point, direction))


@pytest.mark.slow
def test_the_paper_s_plate_is_lower_than_its_thin_drawing():
    thin = np.sqrt(np.abs(la.eigvalsh(*plate_matrices(8, 8)[::-1])))[3:15]
    thick = 2 * np.pi * frequencies(fx.plate(**PLATE))[:12]
    ratio = thick / thin - 1.0
    assert np.all(ratio < 0.02)
    exact = mindlin_frequencies((0.6, 0.6), 0.0272, 2702.0, 70e9, 0.35, order=14, count=4)
    fine = frequencies(fx.plate(**(PLATE | {"elements": (24, 24)})))[:4]
    np.testing.assert_allclose(fine, exact, rtol=9e-3)


@pytest.mark.parametrize("wrong", [0.0, -1.0, "x"])
def test_a_shear_factor_is_positive(wrong):
    with pytest.raises(ModelError, match="shear_factor"):
        made((0.3, 0.2), 0.01, (2, 2), shear_factor=wrong)


# beams
STEEL = {"density": 7850.0, "youngs_modulus": 210e9, "area": 2e-3, "inertia": 2.5e-6}


def timoshenko_pinned(length, n, rho=7850.0, E=210e9, A=2e-3, inertia=2.5e-6, nu=0.3, k=5 / 6):
    """Frequency [Hz] of n half waves between pinned ends: a root of the quadratic in omega^2."""
    wave, G = n * np.pi / length, E / (2 * (1 + nu))
    M = np.diag([rho * A, rho * inertia])
    K = np.array(
        [
            [k * G * A * wave**2, -k * G * A * wave],
            [-k * G * A * wave, E * inertia * wave**2 + k * G * A],
        ]
    )
    return np.sqrt(la.eigvalsh(K, M)[0]) / (2 * np.pi)


@pytest.mark.parametrize("length", [0.2, 0.5, 2.0])
def test_a_beam_between_pins_is_timoshenko_s(length):
    model = fx.beam(
        length=length, elements=40, ends=("pinned", "pinned"), poisson_ratio=0.3, **STEEL
    )
    exact = [timoshenko_pinned(length, n) for n in (1, 2)]  # below those of shear alone
    np.testing.assert_allclose(frequencies(model, 0)[:2], exact, rtol=1.5e-3)
    classic = fx.beam(length=length, elements=40, ends=("pinned", "pinned"), **STEEL)
    assert np.all(frequencies(classic, 0)[:3] > frequencies(model, 0)[:3])


def test_a_cantilever_sinks_by_bending_and_shear_in_one_element():
    model = fx.beam(
        length=0.3, elements=1, ends=("clamped", "free"), poisson_ratio=0.3, shear_factor=0.85,
        **STEEL,
    )  # fmt: skip
    sunk = la.solve(model.K.toarray(), np.array([1.0, 0.0]))
    shear = 0.85 * 210e9 / 2.6 * 2e-3
    exact = 0.3**3 / (3 * 210e9 * 2.5e-6) + 0.3 / shear
    assert sunk[0] == pytest.approx(exact, rel=1e-10)
    whole = np.append(np.zeros(2), sunk)
    free = fx.beam(length=0.3, elements=1, poisson_ratio=0.3, shear_factor=0.85, **STEEL)
    half = free.dofs.row((0.15, 0.0, 0.0), "z") @ whole
    bent = 0.15**2 * (3 * 0.3 - 0.15) / (6 * 210e9 * 2.5e-6)
    assert half == pytest.approx(bent + 0.15 / shear, rel=1e-10)


def test_beams_of_fields_add_up():
    rng = np.random.default_rng(5)
    fields = {name: value * rng.uniform(0.5, 2.0, size=3) for name, value in STEEL.items()}
    nu = rng.uniform(0.1, 0.4, size=3)
    whole = fx.beam(length=0.6, elements=3, poisson_ratio=nu, **fields)
    M, K = np.zeros((8, 8)), np.zeros((8, 8))
    for i in range(3):
        own = {name: value[i] for name, value in fields.items()}
        one = fx.beam(length=0.2, elements=1, poisson_ratio=nu[i], **own)
        M[2 * i : 2 * i + 4, 2 * i : 2 * i + 4] += one.M.toarray()
        K[2 * i : 2 * i + 4, 2 * i : 2 * i + 4] += one.K.toarray()
    np.testing.assert_allclose(whole.M.toarray(), M, rtol=1e-12)
    np.testing.assert_allclose(whole.K.toarray(), K, rtol=1e-9, atol=1e-12 * np.abs(K).max())

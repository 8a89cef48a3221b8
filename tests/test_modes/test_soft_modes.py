"""Soft modes beside stiff ones, small inertias, several bodies: right to a stated rounding."""

import warnings

import numpy as np
import pytest
import scipy.linalg as la
import scipy.sparse as sp

import oracles_modes as oracle
from flexplant import DofSet, check
from flexplant.errors import ModelError
from flexplant.modes import solve, solve_modes, sparse_modes
from flexplant.structure import FEModel, Spring, beam, definite, kirchhoff_plate

ALUMINIUM = {"density": 2702, "youngs_modulus": 70e9, "poisson_ratio": 0.35}
EXTENDED = pytest.mark.skipif(
    np.finfo(np.longdouble).eps > 1e-18, reason="long double has no more digits here"
)


def plate(elements, size=(0.6, 0.5), thickness=0.03):
    return kirchhoff_plate(size=size, thickness=thickness, elements=elements, **ALUMINIUM)


def suspended(free, stiffness):
    (x, y), corners = free.dofs.xyz[:, :2].max(axis=0), [(0, 0), (1, 0), (0, 1), (1, 1)]
    return free.with_parts([Spring((a * x, b * y, 0.0), stiffness) for a, b in corners])


def joined(*models, apart=2.0):
    """Models side by side that nothing joins, x shifted."""
    K, M = (sp.block_diag([getattr(m, name) for m in models], format="csc") for name in "KM")
    nodes = np.concatenate([m.dofs.nodes + 10000 * i for i, m in enumerate(models)])
    xyz = np.vstack([m.dofs.xyz + np.array([apart * i, 0, 0]) for i, m in enumerate(models)])
    directions = [d for m in models for d in m.dofs.directions]
    return FEModel(M, K, dofs=DofSet(nodes, directions, xyz))


def assert_right(modes, exact, n):
    """To 1e-8, or to the rounding that is stated."""
    error = np.abs(modes.omega[:n] / np.sqrt(exact[:n]) - 1)
    assert np.all(error <= np.maximum(1e-8, modes.rounding[:n]))


@EXTENDED
@pytest.mark.parametrize("elements", [100, pytest.param(250, marks=pytest.mark.slow)])
def test_a_fine_clamped_beam(elements):
    model = beam(
        length=1, elements=elements, density=7800, youngs_modulus=2.1e11, area=1e-4, inertia=1e-9,
        ends=("clamped", "free"),
    )  # fmt: skip
    modes = solve_modes(model, count=6)
    exact = oracle.lowest(model.K.toarray(), model.M.toarray(), modes.phi, 0.0)
    assert_right(modes, exact, 4)
    # the stated rounding is that of entries changed by their last digit
    K, phi = abs(model.K.toarray()), np.abs(modes.phi[:, 0])
    assert modes.rounding[0] == pytest.approx(
        2.0**-52 * phi @ K @ phi / (2 * modes.omega[0] ** 2), rel=1e-9, abs=0
    )
    assert modes.certificate["orthonormality"] < 1e-13


@pytest.mark.slow
@pytest.mark.parametrize(
    "elements", [50, 400, pytest.param(700, marks=pytest.mark.long), 751, 2000]
)
def test_a_clamped_beam_of_any_size_has_the_textbook_frequency(elements):
    """Dense up to 750 elements, sparse beyond: 2e-4 off at 400, refused from 500 on before."""
    model = beam(
        length=1, elements=elements, density=7800, youngs_modulus=2.1e11, area=1e-4, inertia=1e-9,
        ends=("clamped", "free"),
    )  # fmt: skip
    modes = solve_modes(model, count=4)
    exact = oracle.cantilever_omega(1.0, 2.1e11 * 1e-9, 7800 * 1e-4)
    # the bound holds by a wide margin
    assert abs(modes.omega[0] / exact - 1) < max(2e-9, modes.rounding[0] / 10)


@pytest.mark.parametrize("factor", [1e3, 1e4, 1e8, 1e12])
def test_a_stiff_grounding_spring_is_a_support(factor):
    free = plate((8, 8))
    modes = solve_modes(free.with_parts([Spring("1:z", factor * free.K.diagonal().max())]), count=8)
    held = solve_modes(free.fixed(["1:z"]), count=8)
    assert modes.n_rigid == held.n_rigid == 2
    # first order in the compliance of the spring, and nothing else
    assert np.abs(modes.omega[2:] / held.omega[2:] - 1).max() < 5e-3 / factor + 1e-9


@pytest.mark.slow
@EXTENDED
@pytest.mark.parametrize(
    ("stiffness", "route"), [(1e-2, "sparse"), (1.0, "dense"), (1e3, "sparse"), (1e6, "dense")]
)
def test_soft_springs_beside_extended_precision(stiffness, route, monkeypatch):
    if route == "sparse":
        for module in (solve, sparse_modes):
            monkeypatch.setattr(module, "DENSE_LIMIT", 100)
        monkeypatch.setattr(solve, "_DENSE_MANY", 100)
    model = suspended(plate((10, 8)), stiffness)
    modes = solve_modes(model, count=20)
    assert modes.n_rigid == 0
    exact = oracle.lowest(model.K.toarray(), model.M.toarray(), modes.phi, 1e-3)
    assert_right(modes, exact, 16)
    assert ("counted" in modes.certificate) == (route == "sparse")


@pytest.mark.slow
@pytest.mark.parametrize("stiffness", [1e-3, 0.1, 10.0, 1e3, 1e5])
def test_a_large_plate_on_springs_from_a_thousandth_to_a_million_newtons_per_metre(stiffness):
    free = plate((24, 24))
    model = suspended(free, stiffness)
    modes = solve_modes(model, count=60)
    report = check(model)
    assert modes.n_rigid == report.n_rigid == report.n_zero == 0
    assert report.grounded == ("z", "rx", "ry") and report.ok
    assert modes.certificate["counted"] == modes.certificate["found"] >= 60
    expected = oracle.suspended_omega(free.mass, (0.6, 0.5), stiffness)
    # the plate bends on its springs: in proportion to their stiffness
    assert np.all(
        np.abs(modes.omega[:3] / expected - 1) < 1e-7 * stiffness + modes.rounding[:3] + 1e-9
    )
    # the others hardly feel the springs: those of the free plate, raised by them in first order
    alone = solve_modes(free, count=60)
    np.testing.assert_allclose(modes.omega[3:], alone.omega[3:], rtol=2e-7 * stiffness + 1e-8)
    assert np.all(modes.omega[3:] > alone.omega[3:] * (1 - 1e-8))


@pytest.mark.slow
@pytest.mark.parametrize("total", [1e4, 10.0, 1.0])
def test_a_bed_of_springs_under_every_node_holds_as_softly(total):
    """No DOF has a larger force than rounding could make at it: all of them add up."""
    free = plate((24, 24))
    each = total / np.unique(free.dofs.nodes).size
    model = free.with_parts([Spring(f"{node}:z", each) for node in np.unique(free.dofs.nodes)])
    modes, report = solve_modes(model, count=5), check(model)
    assert modes.n_rigid == report.n_rigid == report.n_zero == 0
    expected = np.sqrt(total / free.mass)
    assert abs(modes.omega[0] / expected - 1) < 1e-7 * total + modes.rounding[0] + 1e-3


@pytest.mark.slow
def test_what_is_free_says_how_soft_a_suspension_would_look_free():
    free = plate((24, 24))
    modes, report = solve_modes(free, count=5), check(free)
    assert (modes.n_rigid, report.n_rigid, report.n_zero) == (3, 3, 3)
    unseen = modes.certificate["rigid_rounding"]
    K, R = abs(free.K), np.abs(modes.phi[:, :3])
    bound = 2.0**-52 * np.diag(R.T @ (K @ R)).max()
    assert unseen == pytest.approx(np.sqrt(bound) / (2 * np.pi), rel=1e-9, abs=0)
    # springs far below this frequency are lost among the digits of K
    lost = suspended(free, 1e-3 * (2 * np.pi * unseen) ** 2 * free.mass / 4)
    assert solve_modes(lost, count=5).n_rigid == check(lost).n_rigid == 3


@pytest.mark.long
def test_a_soft_suspension_of_a_small_plate_is_found_down_to_a_hundredth_of_a_hertz():
    free = plate((20, 20), size=(0.6, 0.6), thickness=0.0272)
    for hertz in (2.0, 0.1, 0.01):
        stiffness = (2 * np.pi * hertz) ** 2 * free.mass / 4
        modes = solve_modes(suspended(free, stiffness), count=6)
        error = modes.freq[:3] / (hertz * np.array([1, np.sqrt(3), np.sqrt(3)])) - 1
        assert np.abs(error).max() < 5e-5 * hertz**2 + 1e-7 + modes.rounding[0]


@pytest.mark.slow
@pytest.mark.parametrize(("elements", "inertia"), [((10, 10), 1e-12), ((24, 24), 1e-12)])
def test_lumped_masses_with_next_to_no_rotary_inertia(elements, inertia):
    """As condensing the rotations does, exact for none: dense, by another route."""
    full = plate(elements)
    z = full.dofs.kinds == 2
    mass = np.asarray(full.M[z][:, z].sum(axis=1)).ravel()
    mass *= full.mass / mass.sum()
    h = 0.6 / elements[0]
    M = np.zeros(full.n_dof)
    M[z] = mass
    M[~z] = inertia * np.repeat(mass, 2) * h**2
    model = FEModel(sp.diags_array(M).tocsc(), full.K, dofs=full.dofs)
    modes = solve_modes(model, count=20)
    assert modes.phi.shape == (full.n_dof, 20)
    K = full.K.toarray()
    stiff = K[np.ix_(z, z)] - K[np.ix_(z, ~z)] @ la.solve(K[np.ix_(~z, ~z)], K[np.ix_(~z, z)])
    root = 1 / np.sqrt(mass)
    expected = np.sqrt(la.eigvalsh(root[:, None] * stiff * root)[3:20])
    np.testing.assert_allclose(modes.omega[3:], expected, rtol=1e-7)


@pytest.mark.slow
@pytest.mark.parametrize("elements", [(8, 6), (24, 22)])
def test_every_body_has_its_own_rigid_body_motions(elements):
    """Short stroke, long stroke: dense and sparse; elastic modes are those of each by itself."""
    one, other = plate(elements), plate((elements[0], elements[1] - 1), size=(0.4, 0.3))
    model = joined(one, other)
    modes = solve_modes(model, count=16)
    assert modes.n_rigid == 6
    alone = np.sort(np.concatenate([solve_modes(m, count=13).freq[3:] for m in (one, other)]))
    np.testing.assert_allclose(modes.freq[6:], alone[:10], rtol=1e-8)
    # each motion moves one body
    n = one.n_dof
    assert np.all(modes.phi[n:, :3] == 0) and np.all(modes.phi[:n, 3:6] == 0)
    assert check(model).ok and check(model).n_rigid == 6
    # one of them suspended softly: three motions are left
    held = model.with_parts([Spring(f"{node}:z", 50.0) for node in (1, 3, int(one.dofs.nodes[-1]))])
    assert held.rigid_body.shape[1] == 3
    found = solve_modes(held, count=8)
    report = check(held)
    assert (report.n_rigid, report.n_zero, report.mechanisms) == (3, 3, ())
    assert report.ok and report.first_freq == pytest.approx(found.freq[3], rel=1e-2)
    R, rows = one.rigid_body, one.dofs.indices(["1:z", "3:z", f"{one.dofs.nodes[-1]}:z"])
    by_hand = np.sqrt(la.eigvalsh(50.0 * R[rows].T @ R[rows]))
    assert np.all(np.abs(found.omega[3:6] / by_hand - 1) < 1e-3 + found.rounding[3:6])


@pytest.mark.slow
def test_a_soft_spring_between_two_bodies_leaves_the_motions_of_both():
    one = plate((24, 20))
    model = joined(one, one, apart=0.0)
    ends = [("1:z", "10001:z"), ("5:z", "10005:z"), ("400:z", "10400:z")]
    tied = model.with_parts([Spring(a, 20.0, to=b) for a, b in ends])
    assert tied.rigid_body.shape[1] == 3
    assert (check(tied).n_zero, check(tied).mechanisms) == (3, ())
    modes = solve_modes(tied, count=12)
    R, rows = one.rigid_body, one.dofs.indices([a for a, _ in ends])
    # two rigid plates, one above the other, against each other
    G = np.hstack([R[rows], -R[rows]])
    by_hand = np.sqrt(la.eigvalsh(20.0 * G.T @ G)[3:])
    np.testing.assert_allclose(modes.omega[3:6], by_hand, rtol=1e-3)


@pytest.mark.slow
@pytest.mark.parametrize("elements", [(6, 5), (24, 22)])
def test_a_mechanism_is_named_as_check_names_it(elements):
    """A plate hanging by one DOF of another one turns about it."""
    one, other = plate(elements), plate(elements)
    pair = joined(one, other, apart=0.6)
    corner = [f"{one.dofs.nodes[-1]}:z", f"{10000 + other.dofs.nodes[0]}:z"]
    model = pair.with_parts([Spring(corner[0], 1e6, to=corner[1])])
    report = check(model)
    mechanisms = report.mechanisms
    assert report.n_zero == 5 and len(mechanisms) == report.n_zero - report.n_rigid > 0
    with warnings.catch_warnings(), pytest.raises(ModelError, match="no stiffness") as told:
        warnings.simplefilter("error")
        solve_modes(model, count=12)
    assert "mechanism" in str(told.value)
    assert "The first moves " in str(told.value)


@pytest.mark.slow
@pytest.mark.parametrize("elements", [(6, 5), (24, 22)])
def test_soft_springs_do_not_hide_a_mechanism(elements):
    """One of two plates on springs of 10 N/m: it is held, the hinges of the other are named."""
    one, other = plate(elements), plate(elements)
    pair = joined(one, other, apart=0.6)
    last = int(one.dofs.nodes[-1])
    hinge = Spring(f"{last}:z", 1e6, to=f"{10000 + other.dofs.nodes[0]}:z")
    soft = [Spring(f"{node}:z", 10.0) for node in (1, elements[0] + 1, last)]
    report = check(pair.with_parts([hinge, *soft]))
    assert (report.n_rigid, report.n_zero, len(report.mechanisms)) == (0, 2, 2)
    moved = {int(label.split(":")[0]) for label in report.mechanisms[0][:4]}
    assert min(moved) > 10000


def test_the_one_mechanism_has_the_same_dofs_in_both():
    # a hinge in the middle: two bars, three motions without energy, two of them rigid-body ones
    dofs = DofSet([1, 2, 3, 4, 5], ["z"] * 5, [[x, 0, 0] for x in (0.0, 1, 2, 4, 7)])
    bend = np.array([[1.0, -2, 1, 0, 0], [0, 0, 3, -5, 2]])
    model = FEModel(np.eye(5), 1e6 * bend.T @ bend, dofs=dofs)
    (moved,) = check(model).mechanisms
    with pytest.raises(ModelError, match=f"The first moves {', '.join(moved[:4])}\\."):
        solve_modes(model)


def test_rounding_of_a_free_body_is_no_negative_stiffness():
    """In modal coordinates, K of a fit leaves rounding of its stiff modes in a motion at 0 Hz."""
    rng = np.random.default_rng(3)
    for _ in range(20):
        squares = np.r_[0.0, 40.0, 90.0, 10 ** rng.uniform(9, 11, 3)]
        error = np.finfo(float).eps * squares.max() * rng.standard_normal((6, 6))
        error[1:, 1:] = 0.0
        error[0, 0] = -abs(error[0, 0])
        omega, shapes = definite.elastic_modes(
            np.eye(6), np.diag(squares) + (error + error.T) / 2, np.eye(6)[:, :1]
        )
        np.testing.assert_allclose(omega**2, np.sort(squares)[1:], rtol=1e-6)
        assert np.abs(shapes[0]).max() < 1e-9

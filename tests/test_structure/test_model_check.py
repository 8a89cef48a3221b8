"""The report on a model: every verdict is provoked once, on models whose facts are known."""

import time

import numpy as np
import pytest
import scipy.sparse as sp

import flexplant as fx
from flexplant.errors import ModelError

DIRECTIONS = ("x", "y", "z", "rx", "ry", "rz")
#: corners and top of a tetrahedral truss [m], off the origin and off the axes
POINTS = np.array([[1.0, 2, 3], [2.5, 2.2, 3.1], [1.2, 3.9, 2.8], [1.4, 2.6, 4.7]])


def truss(points=POINTS, bars=None, masses=None, scale=1.0):
    """Bars of stiffness 1e5 between points; three displacements at each."""
    n = len(points)
    pairs = [(i, j) for i in range(n) for j in range(i)] if bars is None else bars
    K = np.zeros((3 * n, 3 * n))
    for i, j in pairs:
        along = (points[i] - points[j]) / np.linalg.norm(points[i] - points[j])
        block = 1e5 * np.outer(along, along)
        for a, b, sign in ((i, i, 1), (j, j, 1), (i, j, -1), (j, i, -1)):
            K[3 * a : 3 * a + 3, 3 * b : 3 * b + 3] += sign * block
    m = np.ones(n) if masses is None else np.asarray(masses, dtype=float)
    dofs = fx.DofSet(
        np.repeat(np.arange(1, n + 1), 3), ("x", "y", "z") * n, scale * np.repeat(points, 3, axis=0)
    )
    return fx.structure.FEMatrices(K, np.diag(np.repeat(m, 3)), dofs=dofs, source="truss")


def beam(n=4, length=2.0, scale=1.0):
    """A free Euler-Bernoulli beam along x in the x-y plane: DOFs y and rz."""
    h, EI, mass = length / n, 1e3, 4.0
    K, M = np.zeros((2 * n + 2, 2 * n + 2)), np.zeros((2 * n + 2, 2 * n + 2))
    k = EI / h**3 * np.array(
        [[12, 6 * h, -12, 6 * h], [6 * h, 4 * h**2, -6 * h, 2 * h**2],
         [-12, -6 * h, 12, -6 * h], [6 * h, 2 * h**2, -6 * h, 4 * h**2]]
    )  # fmt: skip
    m = mass / n / 420 * np.array(
        [[156, 22 * h, 54, -13 * h], [22 * h, 4 * h**2, 13 * h, -3 * h**2],
         [54, 13 * h, 156, -22 * h], [-13 * h, -3 * h**2, -22 * h, 4 * h**2]]
    )  # fmt: skip
    for i in range(n):
        K[2 * i : 2 * i + 4, 2 * i : 2 * i + 4] += k
        M[2 * i : 2 * i + 4, 2 * i : 2 * i + 4] += m
    xyz = np.repeat(np.column_stack([np.arange(n + 1) * h, *2 * [np.zeros(n + 1)]]), 2, axis=0)
    dofs = fx.DofSet(np.repeat(np.arange(1, n + 2), 2), ("y", "rz") * (n + 1), scale * xyz)
    return fx.structure.FEMatrices(K, M, dofs=dofs)


def line(report, subject):
    return next(found for found in report.lines if found[1] == subject)


def test_a_free_truss_is_in_order():
    masses = np.array([1.0, 2.0, 3.0, 4.0])
    report = fx.check(truss(masses=masses))
    assert report.ok
    assert report.rigid == DIRECTIONS
    assert (report.n_rigid, report.n_zero, report.grounded) == (6, 6, ())
    center = masses @ POINTS / 10.0
    np.testing.assert_allclose(report.mass, [10.0, 10.0, 10.0], rtol=1e-13)
    np.testing.assert_allclose(report.center, center, rtol=1e-12)
    arms = POINTS - center
    inertia = sum(
        m * (a @ a * np.eye(3) - np.outer(a, a)) for m, a in zip(masses, arms, strict=True)
    )
    np.testing.assert_allclose(report.inertia, inertia, rtol=1e-11, atol=1e-11)
    assert "free in x, y, z, rx, ry, rz" in repr(report)
    found = truss(masses=masses)
    lowest = np.linalg.eigvalsh(found.K.toarray() / np.sqrt(np.outer(*2 * [found.M.diagonal()])))[6]
    assert report.first_freq == pytest.approx(np.sqrt(lowest) / (2 * np.pi), rel=1e-10)


def test_a_model_is_checked_like_its_matrices():
    found = truss()
    model = found.model()
    assert fx.check(model).ok
    assert fx.check(model).n_zero == fx.check(found).n_zero == 6


def test_a_missing_bar_is_a_mechanism_and_its_dofs_are_named():
    bars = [(1, 0), (2, 0), (2, 1), (3, 0), (3, 1)]  # point 4 swings about the line 1-2
    report = fx.check(truss(bars=bars))
    assert report.of("fail") == ("mechanisms",)
    assert (report.n_rigid, report.n_zero, len(report.mechanisms)) == (6, 7, 1)
    # the swing itself, rigid motion taken out: points 3 and 4 turn about the line, 1 and 2 less
    top = {label.split(":")[0] for label in report.mechanisms[0][:2]}
    assert top <= {"3", "4"}
    assert "1 zero-energy motion beyond" in line(report, "mechanisms")[2]


def test_what_is_grounded_is_named():
    found = truss()
    K = found.K.toarray()
    K[2, 2] += 1e4  # node 1 in z
    report = fx.check(found.replace(K=K))
    assert report.n_rigid == report.n_zero == 5
    assert "z" in report.grounded
    assert report.rigid == ("x", "y", "rz")
    said = line(report, "rigid body")[2]
    assert said.startswith("free in x, y, rz, and free to turn about the axis through (1, 2.675")
    assert "along (0, 1, 0)" in said
    held = fx.check(found.replace(K=found.K + 1e4 * sp.eye_array(12)))
    assert held.grounded == DIRECTIONS
    assert held.n_zero == 0
    assert held.ok


def test_directions_that_no_dof_has():
    report = fx.check(beam())
    assert report.ok
    assert report.rigid == ("y", "rz")
    assert "no DOFs for x, z, rx, ry" in line(report, "rigid body")[2]
    np.testing.assert_allclose(report.mass[1], 4.0, rtol=1e-12)
    assert np.isnan(report.mass[[0, 2]]).all()
    np.testing.assert_allclose(report.center[0], 1.0, rtol=1e-12)
    # a slender beam about its middle: m l^2 / 12
    np.testing.assert_allclose(report.inertia[2, 2], 4.0 * 4.0 / 12, rtol=1e-10)


@pytest.mark.parametrize("scale", [1000.0, 0.0254])
def test_coordinates_in_another_unit_are_found_out_by_the_rotations(scale):
    report = fx.check(beam(scale=scale))
    assert "coordinates" in report.of("fail")
    assert f"times {1 / scale:.6g}" in line(report, "coordinates")[2]


def test_large_and_light_looks_like_mm():
    report = fx.check(truss(points=1000 * POINTS, masses=4 * [1e-3]))
    assert "units" in report.of("note")
    assert "mm" in line(report, "units")[2]
    dense = fx.check(truss(points=1e-3 * POINTS, masses=4 * [10.0]))
    assert "this fits no material" in line(dense, "units")[2]
    assert "units" not in fx.check(truss()).of("note")


def test_dofs_without_mass_stiffness_and_both():
    found = truss()
    K, M = found.K.toarray(), found.M.toarray()
    M[0, 0] = 0
    report = fx.check(found.replace(M=M))
    assert report.massless == ("1:x",)
    assert report.of("fail") == ("without mass",)
    assert report.n_zero == 6
    K[4], K[:, 4] = 0, 0
    assert fx.check(found.replace(K=K)).stiffless == ("2:y",)
    M[4, 4] = 0
    both = fx.check(found.replace(K=K, M=M))
    assert "2:y" in line(both, "empty rows")[2]


def test_asymmetry_is_pinned_to_its_entry():
    found = truss()
    K = found.K.toarray()
    K[1, 4] *= 1.01
    report = fx.check(found.replace(K=K))
    assert "symmetry of K" in report.of("fail")
    assert "(2, 5) and (5, 2)" in line(report, "symmetry of K")[2]


def test_negative_stiffness_mass_and_damping():
    found = truss()
    K, M = found.K.toarray(), found.M.toarray()
    w, v = np.linalg.eigh(K)
    bent = K - 2 * w[7] * np.outer(v[:, 7], v[:, 7])
    report = fx.check(found.replace(K=bent))
    assert "definiteness of K" in report.of("fail")
    assert "1 negative" in line(report, "definiteness of K")[2]
    M[3, 3] = -1
    report = fx.check(found.replace(M=M))
    assert "2:x" in line(report, "definiteness of M")[2]
    report = fx.check(found.replace(D=-K))
    assert "definiteness of D" in report.of("fail")
    assert "damping" in fx.check(found.replace(D=0.1 * found.M)).of("note")
    assert fx.check(found.replace(D=1e-4 * found.K)).ok
    assert "mass" in fx.check(found.replace(M=None)).of("fail")


def test_pieces_that_nothing_joins():
    one = truss()
    K = sp.block_diag([one.K, one.K])
    M = sp.block_diag([one.M, one.M])
    dofs = fx.DofSet(
        np.r_[one.dofs.nodes, one.dofs.nodes + 10], one.dofs.directions * 2,
        np.r_[one.dofs.xyz, one.dofs.xyz + np.array([9.0, 0, 0])],
    )  # fmt: skip
    report = fx.check(fx.structure.FEMatrices(K, M, dofs=dofs))
    assert report.n_pieces == 2
    assert (report.n_zero, report.n_rigid, report.mechanisms) == (12, 12, ())
    said = line(report, "rigid body")[2]
    assert "2 separate bodies have 12 rigid-body motions in all" in said
    assert "all move freely together in x" in said
    assert {"connectivity"} <= set(report.of("note"))
    assert fx.check(one).n_pieces == 1


def test_a_stage_that_floats_next_to_a_held_frame_is_kept():
    K, M = (sp.block_diag([part, part]).toarray() for part in (truss().K, truss().M))
    K[0, 0] += 1e4  # the first body in x, all else stays free
    one = truss().dofs
    xyz = np.r_[one.xyz, one.xyz + np.array([9.0, 0, 0])]
    dofs = fx.DofSet(np.r_[one.nodes, one.nodes + 10], one.directions * 2, xyz)
    state, _, said, do = line(fx.check(fx.structure.FEMatrices(K, M, dofs=dofs)), "rigid body")
    assert state == "note"
    assert "2 separate bodies have 11 rigid-body motions in all" in said
    assert do.startswith("rigid-body modes at 0 Hz are kept: a controller holds a stage")


def test_a_solver_diagonal_is_noticed():
    found = truss()
    K = sp.block_diag([found.K, sp.eye_array(3)])
    M = sp.block_diag([found.M, sp.eye_array(3)])
    dofs = fx.DofSet(
        np.r_[found.dofs.nodes, 3 * [5]], (*found.dofs.directions, "x", "y", "z"),
        np.r_[found.dofs.xyz, np.zeros((3, 3))],
    )  # fmt: skip
    report = fx.check(fx.structure.FEMatrices(K, M, dofs=dofs))
    assert "5:x, 5:y, 5:z" in line(report, "uncoupled rows")[2]


def test_matrices_without_names_or_coordinates():
    found = truss()
    report = fx.check(found.replace(dofs=None))
    assert report.n_zero == 6
    assert "with_dofs" in line(report, "rigid body")[3]
    zero = found.dofs.replace(xyz=np.zeros((12, 3)))
    report = fx.check(found.replace(dofs=zero, located=False))
    assert report.ok
    assert "located_at" in line(report, "rigid body")[3]
    assert np.isnan(report.center).all()


def test_constrained_dofs_and_notes_are_passed_on():
    report = fx.check(truss().without(["1:x"]))
    assert "1:x" in line(report, "constrained")[2]
    assert "total mass" in report.of("note")  # 3 kg in x, 4 kg in y and z


def test_it_prints_a_table():
    text = repr(fx.check(truss(bars=[(1, 0), (2, 0), (2, 1), (3, 0), (3, 1)])))
    assert text.splitlines()[0] == "<ModelCheck 'truss': 1 FAILED, 0 warnings>"
    assert "  FAIL mechanisms" in text
    assert "-> fx.joined, or hold them" in text
    assert max(map(len, text.splitlines())) < 160


@pytest.mark.parametrize("wrong", [None, np.eye(3), "model"])
def test_something_else_is_refused(wrong):
    with pytest.raises(ModelError, match="FEModel or FEMatrices"):
        fx.check(wrong)


@pytest.mark.parametrize(
    "K", [np.zeros((3, 3)), [[1.0, 2.0], [2.0, 1.0]], [[0.0, 1.0], [1.0, 0.0]], [[-1.0]], [[1.0]]]
)
def test_hopeless_matrices_get_a_report_too(K):
    report = fx.check(fx.structure.FEMatrices(K))
    assert not report.ok
    assert fx.check(fx.structure.FEMatrices(K, np.zeros_like(K))).of("fail")


@pytest.mark.slow
def test_a_large_plate_takes_seconds():
    plate = fx.kirchhoff_plate(
        size=(0.6, 0.6), thickness=0.0272, elements=(90, 90), density=2702, youngs_modulus=70e9,
        poisson_ratio=0.35,
    )  # fmt: skip
    start = time.process_time()
    report = fx.check(plate)
    assert time.process_time() - start < 10
    assert report.ok
    assert report.rigid == ("z", "rx", "ry")
    np.testing.assert_allclose(report.mass[2], 0.36 * 0.0272 * 2702, rtol=1e-12)


def halves(soft, n=60):
    """A free chain, in the middle of which one spring is softer."""
    springs = np.full(n - 1, 1e9)
    springs[n // 2] *= soft
    return fx.chain(masses=np.ones(n), stiffnesses=springs)


def magnets(n, pull, bends=False):
    """A chain held at one end (not at all), with a spring of negative stiffness at the other."""
    K = sp.lil_array(fx.chain(masses=np.ones(n), stiffnesses=np.full(n - 1, 1e9)).K)
    K[n - 1, n - 1] -= pull
    if bends:
        K[0, 0] += 1e9
    dofs = fx.DofSet(np.arange(1, n + 1), ["x"] * n, np.arange(3 * n).reshape(n, 3) * [1.0, 0, 0])
    return fx.structure.FEMatrices(sp.csc_array(K), sp.eye_array(n, format="csc"), dofs=dofs)


def beside_a_mass(directions):
    """A free truss, and a mass that nothing joins to it."""
    one, m = truss(), len(directions)
    K, M = (sp.block_diag([A, b * sp.eye_array(m)]) for A, b in ((one.K, 0.0), (one.M, 2.0)))
    dofs = fx.DofSet(
        [*one.dofs.nodes, *[99] * m], [*one.dofs.directions, *directions],
        np.vstack([one.dofs.xyz, np.full((m, 3), 7.0)]),
    )  # fmt: skip
    return fx.structure.FEMatrices(K, M, dofs=dofs)


@pytest.mark.slow
@pytest.mark.parametrize(
    "given, taken",
    [
        (halves(1e-13), True),  # above one rounding of K, below thirty
        (halves(0.0), True),  # two bodies
        (magnets(40, 10.0), True),
        (magnets(1600, 1.0), True),
        (magnets(40, 1e11, bends=True), False),
        (magnets(1600, 1e11, bends=True), False),
        (beside_a_mass("xyz"), True),
        (beside_a_mass(["rx"]), True),
    ],
)
def test_check_and_solve_modes_judge_alike(given, taken):
    report = fx.check(given)
    assert report.ok == taken
    if not taken:
        with pytest.raises(ModelError, match=r"unstable|negative"):
            fx.solve_modes(given.model(), count=8)
        return
    model = given if isinstance(given, fx.FEModel) else given.model()
    modes = fx.solve_modes(model, count=min(12, model.n_dof))
    assert report.n_zero == report.n_rigid == modes.n_rigid
    assert (report.n_zero, fx.check(model).ok) == (modes.n_rigid, True)


@pytest.mark.parametrize("seed", range(3))
def test_the_axis_of_a_link_on_a_pedestal_that_stays_at_rest(seed):
    """Nodes along x with the DOFs y and rz, one of them held in y, a motor and a pedestal (rz)."""
    rng = np.random.default_rng(seed)
    hinge = int(rng.integers(0, 5))
    xs, height = np.sort(rng.uniform(-1.0, 1.0, 5)), rng.uniform(0.1, 1.0)
    n = 2 + 2 * len(xs)  # pedestal, motor, then y and rz of the nodes
    K = np.zeros((n, n))

    def spring(k, entries):
        row = np.zeros(n)
        for place, value in entries.items():
            row[place] += value
        K[:] += k * np.outer(row, row)

    spring(3e5, {0: 1.0})
    spring(2e4, {1: 1.0, 3 + 2 * hinge: -1.0})
    spring(1e7, {2 + 2 * hinge: 1.0})
    for i, length in enumerate(np.diff(xs)):
        a, b = 2 + 2 * i, 4 + 2 * i
        spring(1e4, {a + 1: 1.0, b + 1: -1.0})
        spring(1e6, {b: 1.0, a: -1.0, a + 1: -length / 2, b + 1: -length / 2})
    nodes = [1, 2, *np.repeat(np.arange(len(xs)) + 10, 2)]
    xyz = [[xs[hinge], 0.0, 0.0]] * 2 + [[x, 0.0, height] for x in np.repeat(xs, 2)]
    dofs = fx.DofSet(nodes, ["rz", "rz"] + ["y", "rz"] * len(xs), xyz)
    M = np.diag([0.9, 0.6] + [1.0, 0.01] * len(xs))
    line = str(fx.check(fx.FEModel(M, K, dofs=dofs)))
    assert f"free to turn about the axis through ({xs[hinge]:.4g}, 0, " in line
    assert "m along (0, 0, 1); else grounded in y, rx, rz" in line
    assert "e-" not in line.split("inertia about it")[1].split("\n")[0]  # no rounding is printed

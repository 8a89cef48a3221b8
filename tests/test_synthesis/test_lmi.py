"""H-infinity by LMI: gammas known by hand and from COMPleib, the trap of `>>`, refusals."""

import csv
import subprocess
import sys

import numpy as np
import pytest

from flexplant import load
from flexplant.errors import CertificateError, InfeasibleError, ModelError, SolverError
from flexplant.lti import StateSpace, lft
from flexplant.synthesis import Lmi, Riccati, design_hinf
from flexplant.synthesis.controller import certified_norm
from flexplant.synthesis.lmi import lmi_programs as lmi_programs
from flexplant.synthesis.lmi.lmi_programs import Plant, projected, symmetric_blocks
from flexplant.synthesis.preparation import prepared
from oracles_lmi import closed_loop, output_feedback_gamma, state_feedback_gamma, swept_norm
from shared_data import data_file

SETTINGS = {"tol_gap_abs": 1e-9, "tol_gap_rel": 1e-9, "tol_feas": 1e-9}
COMPLEIB = data_file("compleib-open.npz")
KEYS = ("A", "B1", "B2", "C1", "C2", "D11", "D12", "D21")
SMALL = ["NN2", "DIS2", "NN8", "AC15", "AC4", "DIS5", "HE1", "HE2", "NN4", "REA2", "AC2", "EB1"]
LARGE = ["TMD", "DIS1", "HE5", "AC8", "DLR1", "EB2", "TG1", "WEC1", "BDT1", "AGS", "CSE1"]


def system(parts, dt=0.0):
    """(StateSpace, u, y) of the eight matrices."""
    A, B1, B2, C1, C2, D11, D12, D21 = (np.atleast_2d(np.asarray(p, float)) for p in parts)
    nw, nu, nz, ny = B1.shape[1], B2.shape[1], C1.shape[0], C2.shape[0]
    u, y = tuple(f"u{i}" for i in range(nu)), tuple(f"y{i}" for i in range(ny))
    P = StateSpace(
        A,
        np.hstack([B1, B2]),
        np.vstack([C1, C2]),
        np.block([[D11, D12], [D21, np.zeros((ny, nu))]]),
        dt,
        inputs=[*(f"w{i}" for i in range(nw)), *u],
        outputs=[*(f"z{i}" for i in range(nz)), *y],
    )
    return P, u, y


def scalar(a, noise):
    """x' = a x + w1 + u, z = (x, u), y = x + noise w2."""
    return (
        [[a]],
        [[1.0, 0.0]],
        [[1.0]],
        [[1.0], [0.0]],
        [[1.0]],
        np.zeros((2, 2)),
        [[0.0], [1.0]],
        [[0.0, noise]],
    )


def transposed(parts):
    """The dual problem: D12 and D21 change places."""
    A, B1, B2, C1, C2, D11, D12, D21 = (np.asarray(p, float).T for p in parts)
    return A, C1, C2, B1, B2, D11, D21, D12


def problem(parts, dt=0.0):
    return prepared(*system(parts, dt))


def random_parts(seed, n=8, nw=3, nu=2, nz=4, ny=2):
    """Full-rank D12 and D21 and a D11."""
    rng = np.random.default_rng(seed)
    A = rng.standard_normal((n, n)) - 1.0 * np.eye(n)
    return (
        A,
        rng.standard_normal((n, nw)),
        rng.standard_normal((n, nu)),
        rng.standard_normal((nz, n)),
        rng.standard_normal((ny, n)),
        rng.standard_normal((nz, nw)),
        rng.standard_normal((nz, nu)),
        rng.standard_normal((ny, nw)),
    )


def compleib(name):
    if not COMPLEIB.exists():
        pytest.skip("the COMPleib problems are not here")
    with np.load(COMPLEIB) as file:
        parts = tuple(np.atleast_2d(file[f"{name}/{key}"]) for key in KEYS)
    with COMPLEIB.with_suffix(".csv").open() as file:
        gamma = {row["name"]: float(row["gamma"]) for row in csv.DictReader(file)}
    return parts, gamma[name]


def check(parts, gamma):
    """Design, and hold loop, claim and bound against the oracle and the best known gamma."""
    P, u, y = system(parts)
    found = design_hinf(P, Lmi(), u=u, y=y)
    K = found.system
    assert (K.inputs, K.outputs) == (y, u)
    loop = closed_loop(*(np.atleast_2d(np.asarray(p, float)) for p in parts), (K.A, K.B, K.C, K.D))
    assert np.linalg.eigvals(loop[0]).real.max() < 0
    assert found.gamma == pytest.approx(found.certificate["claim"], rel=1e-3)
    assert swept_norm(*loop) <= found.gamma * (1 + 1e-6)
    assert swept_norm(*loop) >= found.gamma * (1 - 1e-2)
    assert found.gamma <= 1.07 * gamma
    # the Riccati equations refute a gamma to 1e-3; those of COMPleib are known to 3-4 digits
    assert (1 - 1e-3) * gamma <= found.lower <= (1 + 1e-4) * gamma
    return found


@pytest.mark.slow
@pytest.mark.parametrize("a", [-2.0, -0.5, 0.0, 1.0])
def test_measurement_without_noise_reaches_state_feedback(a):
    check(scalar(a, 0.0), state_feedback_gamma(a))


@pytest.mark.slow
@pytest.mark.parametrize("a", [-2.0, 0.0, 1.0])
def test_effort_without_weight_is_the_dual(a):
    check(transposed(scalar(a, 0.0)), state_feedback_gamma(a))


@pytest.mark.slow
@pytest.mark.parametrize("a", [-2.0, -0.5, 0.0, 1.0])
def test_scalar_output_feedback_equals_the_root_of_its_riccati_equations(a):
    check(scalar(a, 1.0), output_feedback_gamma(a))


@pytest.mark.slow
@pytest.mark.parametrize(
    "name", [*SMALL[:5], *(pytest.param(name, marks=pytest.mark.slow) for name in SMALL[5:])]
)
def test_compleib(name):
    check(*compleib(name))


@pytest.mark.slow
@pytest.mark.parametrize("name", [*LARGE[:-1], pytest.param(LARGE[-1], marks=pytest.mark.long)])
def test_compleib_up_to_20_states(name):
    check(*compleib(name))


def design_problem(parts):
    """The design by LMIs of the eight matrices."""
    P, u, y = system(parts)
    return design_hinf(P, Lmi(), u=u, y=y)


@pytest.mark.slow
@pytest.mark.parametrize("seed", [0, 1, 2])
def test_bound_and_riccati_meet_with_feedthrough(seed):
    P, u, y = system(random_parts(seed))
    by_riccati = design_hinf(P, Riccati(back_off=0.0, tolerance=1e-4), u=u, y=y)
    by_lmi = design_hinf(P, Lmi(), u=u, y=y)
    assert by_lmi.lower == pytest.approx(by_riccati.gamma, rel=1.2e-3)  # bisected to 1e-3
    assert by_lmi.lower <= by_riccati.gamma
    assert by_lmi.gamma <= 1.05 * 1.001 * by_riccati.gamma


def random_system(n, seed, full):
    """Two z, one y, one u; with the efforts and the noise left out, D12 = 0 and D21 = 0."""
    rng = np.random.default_rng(seed)
    A, B, C = (rng.standard_normal(size) for size in ((n, n), (n, 4), (3, n)))
    D = np.zeros((3, 4))
    D[1, 3] = D[2, 2] = float(full)
    return A, B[:, :3], B[:, 3:], C[:2], C[2:], D[:2, :3], D[:2, 3:], D[2:, :3]


# the solver's own settings stop at "InsufficientProgress" on each of these
@pytest.mark.slow
@pytest.mark.parametrize(
    ("n", "seed", "full"),
    [
        (3, 1, False),
        (5, 22, True),
        *(
            pytest.param(*case, marks=pytest.mark.slow)
            for case in ((3, 2, False), (3, 6, False), (5, 7, True), (5, 23, True))
        ),
    ],
)
def test_a_solver_that_stops_early_is_not_the_end(n, seed, full):
    parts = random_system(n, seed, full)
    P, u, y = system(parts)
    found = design_hinf(P, Lmi(back_off=1e-3), u=u, y=y)
    K = found.system
    loop = closed_loop(*parts, (K.A, K.B, K.C, K.D))
    assert np.linalg.eigvals(loop[0]).real.max() < 0
    assert swept_norm(*loop) <= found.gamma * (1 + 1e-6)
    if full:  # another method, without semidefinite programs
        gamma = design_hinf(P, Riccati(back_off=0.0, tolerance=1e-6), u=u, y=y).gamma
        assert found.gamma <= 1.01 * gamma
        assert found.lower == pytest.approx(gamma, rel=2e-3)


@pytest.mark.slow
def test_sampled_plant_with_rigid_body_and_noise_free_sensor():
    h = 1e-3
    # 2 kg on no spring in SI units, sampled; y in m, z the position error in um and the effort
    parts = (
        [[1.0, h], [0.0, 1.0]],
        [[h * h / 4], [h / 2]],
        [[h * h / 4], [h / 2]],
        [[1e6, 0.0], [0.0, 0.0]],
        [[1.0, 0.0]],
        np.zeros((2, 1)),
        [[0.0], [1.0]],
        [[0.0]],
    )
    P, u, y = system(parts, h)
    found = design_hinf(P, Lmi(), u=u, y=y)
    assert found.system.dt == h
    assert found.certificate["spectral radius"] < 1
    assert found.lower <= found.gamma <= 1.07 * found.lower
    # w and u enter alike: no controller can do better than to cancel w
    assert found.gamma >= 1.0


@pytest.mark.slow
def test_back_off_is_what_the_loop_may_lose():
    P, u, y = system(scalar(-0.5, 1.0))
    tight, loose = (design_hinf(P, Lmi(back_off=b), u=u, y=y) for b in (0.01, 0.3))
    best = output_feedback_gamma(-0.5)
    assert tight.gamma <= 1.0101 * best
    assert loose.gamma <= 1.301 * best
    assert loose.gamma > tight.gamma


def test_flipped_sign_is_refused_by_the_certificate():
    P, u, y = system(scalar(1.0, 1.0))
    found = design_hinf(P, Lmi(), u=u, y=y)
    K = found.system
    assert certified_norm(lft(P, K), found.gamma)["norm"] == found.gamma
    with pytest.raises(CertificateError, match="not stable"):
        certified_norm(lft(P, K.replace(C=-K.C, D=-K.D)), found.gamma)
    with pytest.raises(CertificateError, match="was claimed"):
        certified_norm(lft(P, K), 0.9 * found.gamma)


# --- the trap: `M >> 0` constrains only the symmetric part of M


def test_cvxpy_accepts_what_is_not_symmetric():
    import cvxpy as cp

    M = cp.Variable((2, 2))
    trap = cp.Problem(cp.Maximize(M[0, 1]), [M >> 0, cp.diag(M) == 1, M[1, 0] == -10])
    trap.solve(solver="CLARABEL")
    assert M.value[0, 1] == pytest.approx(12, abs=1e-4)
    # the same blocks made by the helper: the mirror is not another unknown
    b = cp.Variable((1, 1))
    one = np.ones((1, 1))
    meant = cp.Problem(cp.Maximize(b[0, 0]), [symmetric_blocks([[one, b], [one]]) >> 0])
    meant.solve(solver="CLARABEL")
    assert b.value[0, 0] == pytest.approx(1, abs=1e-4)


def test_a_program_that_falls_into_the_trap_is_refused():
    import cvxpy as cp

    M = cp.Variable((2, 2))
    trap = cp.Problem(cp.Maximize(M[0, 1]), [M >> 0, cp.diag(M) == 1, M[1, 0] == -10])
    with pytest.raises(SolverError, match="not symmetric"):
        lmi_programs.solve_program(trap, SETTINGS)


def test_blocks_are_mirrored():
    rng = np.random.default_rng(1)
    a, b, c = rng.standard_normal((3, 3)), rng.standard_normal((3, 2)), rng.standard_normal((2, 2))
    M = symmetric_blocks([[a, b], [c]]).value
    np.testing.assert_allclose(M, np.block([[(a + a.T) / 2, b], [b.T, (c + c.T) / 2]]))


def test_every_lmi_is_symmetric_for_any_values():
    X, Y, constraints = projected(Plant(*random_parts(5, n=4), np.ones(2), np.ones(2)), 1.0)
    rng = np.random.default_rng(0)
    for variable in (X, Y):
        value = rng.standard_normal(variable.shape)
        variable.value = value + value.T
    matrices = [constraint.args[0].value for constraint in constraints]
    assert all(np.max(np.abs(M - M.T)) <= 1e-12 * np.max(np.abs(M)) for M in matrices)
    assert matrices[2].shape == (8, 8)


# --- what is refused


@pytest.mark.parametrize(
    "options",
    [
        {"back_off": 0.0},
        {"back_off": -0.05},
        {"tolerance": 0.0},
        {"tolerance": np.nan},
        {"max_states": -3},
        {"max_states": 7.5},
        {"tolerance": "small"},
    ],
)
def test_bad_options(options):
    with pytest.raises(ModelError, match=next(iter(options))):
        Lmi(**options)


def test_too_many_states_or_none():
    with pytest.raises(ModelError, match=r"1 to 7 states, got 8.*Reduce the order"):
        Lmi(max_states=7).solve(problem(random_parts(0)))
    static = StateSpace(
        np.zeros((0, 0)),
        np.zeros((0, 2)),
        np.zeros((2, 0)),
        [[1.0, 1.0], [1.0, 0.0]],
        inputs=["w", "u"],
        outputs=["z", "y"],
    )
    with pytest.raises(ModelError, match="static plant"):
        Lmi().solve(prepared(static, ["u"], ["y"]))


@pytest.mark.long
def test_the_largest_that_is_served_is_right():
    found = design_problem(random_parts(2, n=Lmi().max_states, nw=6, nu=3, nz=6, ny=3))
    assert found.gamma <= 1.0102 * found.lower


@pytest.mark.long
def test_a_refusal_names_the_number_of_states_that_is_served():
    """Next to the optimum of 20 states with one input and output gammas are 1e5."""
    with pytest.raises(SolverError, match=r"up to 20 states of similar.*plant of 20 states"):
        design_problem(random_parts(1, n=20, nw=2, nu=1, nz=2, ny=1))


def test_an_unreachable_unstable_mode_has_no_controller():
    parts = list(scalar(1.0, 1.0))
    parts[2] = [[0.0]]
    with pytest.raises(SolverError, match="Does u reach"):
        Lmi().solve(problem(parts))


def test_a_proof_of_infeasibility_is_named():
    import cvxpy as cp

    X = cp.Variable((2, 2), symmetric=True)
    impossible = cp.Problem(cp.Minimize(0), [X - np.eye(2) >> 0, -X - np.eye(2) >> 0])
    with pytest.raises(InfeasibleError, match="PrimalInfeasible after"):
        lmi_programs.solve_program(impossible, SETTINGS)


def test_a_violated_lmi_is_named():
    import cvxpy as cp

    X = cp.Variable((2, 2), symmetric=True)
    tight = cp.Problem(cp.Minimize(cp.trace(X)), [X - np.eye(2) >> 0])
    with pytest.raises(SolverError, match=r"an LMI is violated: smallest eigenvalue"):
        lmi_programs.solve_program(tight, SETTINGS, violation=-1e-3)


@pytest.mark.slow
def test_a_disturbance_that_u_cancels_entirely():
    # y = w, w and u enter alike: u = -w leaves nothing, at no cost
    parts = ([[-1.0]], [[1.0]], [[1.0]], [[1.0]], [[0.0]], [[0.0]], [[0.0]], [[1.0]])
    with pytest.raises(InfeasibleError, match=r"gamma has no minimum.*Weight the efforts"):
        Lmi().solve(problem(parts))


@pytest.mark.slow
def test_value_prints_saves_and_stays_light(tmp_path):
    assert repr(Lmi(back_off=0.1)).startswith("Lmi(back_off=0.1")
    Lmi(back_off=0.1).save(tmp_path / "lmi.npz")
    assert repr(load(tmp_path / "lmi.npz")) == repr(Lmi(back_off=0.1))
    code = "import sys, flexplant.synthesis.lmi.lmi_programs; assert 'cvxpy' not in sys.modules"
    subprocess.run([sys.executable, "-c", code], check=True, timeout=60)

"""Riccati equations: closed forms, extended-precision recursion, scipy where it works, refusals."""

import numpy as np
import pytest
import scipy.linalg as la
from hypothesis import given
from hypothesis import strategies as st

import flexplant
from flexplant.errors import ModelError, ShapeError, SolverError
from flexplant.lti import control_care, control_dare, equations, filter_care, filter_dare
from flexplant.rooms import OURS
from oracles_lti import double_integrator_dare, riccati_recursion, stein
from shared_data import data_file


def benign(seed, n=6, p=2):
    rng = np.random.default_rng(seed)
    A = rng.standard_normal((n, n)) / np.sqrt(n) * 1.1
    G = rng.standard_normal((n, n))
    R = rng.standard_normal((p, p))
    return A, rng.standard_normal((p, n)), G @ G.T / n, R @ R.T + 0.5 * np.eye(p), rng


def machine(n_rigid, n_elastic, *, zeta=1e-3, rate=1e4, force=1e-3, noise=1e-10, seed=0, inputs=6):
    """Sampled modes in plain (q, dq/dt), SI: gains of 1e-9 m/N, eigenvalues at 1."""
    rng = np.random.default_rng(seed)
    omega = np.concatenate([np.zeros(n_rigid), 2 * np.pi * np.linspace(245.0, 3700.0, n_elastic)])
    n, h, m = 2 * omega.size, 1 / rate, inputs
    shapes_in = rng.standard_normal((omega.size, m)) / 5
    shapes_out = rng.standard_normal((m, omega.size)) / 5
    A, Q = np.zeros((n, n)), np.zeros((n, n))
    for i, w in enumerate(omega):
        A[2 * i : 2 * i + 2, 2 * i : 2 * i + 2] = la.expm(
            h * np.array([[0, 1], [-(w**2), -2 * zeta * w]])
        )
    nodes, weights = np.polynomial.legendre.leggauss(40)
    for t, weight in zip(h * (nodes + 1) / 2, h * weights / 2, strict=True):
        kick = np.zeros((n, m))
        for i, w in enumerate(omega):
            move = la.expm(t * np.array([[0, 1], [-(w**2), -2 * zeta * w]]))[:, 1]
            kick[2 * i : 2 * i + 2] = np.outer(move, shapes_in[i])
        Q += weight * kick @ kick.T * force**2 / 2
    C = np.zeros((m, n))
    C[:, ::2] = shapes_out
    return A, C, Q, np.eye(m) * noise**2 * rate / 2


@pytest.mark.parametrize(("h", "q", "r"), [(1.0, 1.0, 1.0), (1e-4, 1e-8, 1e-20), (1e-3, 4.0, 1e-9)])
def test_double_integrator_in_closed_form(h, q, r):
    A, g = np.array([[1, h], [0, 1]]), np.array([[h**2 / 2], [h]])
    sol = filter_dare(A, np.array([[1.0, 0.0]]), Q=g @ g.T * q, R=np.array([[r]]))
    alpha, beta, p11, p12 = double_integrator_dare(h, q, r)
    assert sol.P[0, 0] == pytest.approx(p11, rel=1e-9, abs=0)
    assert sol.P[0, 1] == pytest.approx(p12, rel=1e-9, abs=0)
    np.testing.assert_allclose(sol.gain[:, 0], [alpha + beta, beta / h], rtol=1e-9)


@given(st.integers(0, 10_000))
def test_equals_scipy_on_benign_problems(seed):
    A, C, Q, R, rng = benign(seed)
    S = 0.1 * rng.standard_normal((6, 2))
    Q = Q + S @ np.linalg.solve(R, S.T)  # the joint covariance is not indefinite
    sol = filter_dare(A, C, Q=Q, R=R, S=S)
    # SciPy 1.16.0 to 1.16.2 take s without e for a problem with a singular e
    P = la.solve_discrete_are(A.T, C.T, Q, R, e=np.eye(len(A)), s=S)
    np.testing.assert_allclose(sol.P, P, rtol=0, atol=1e-8 * np.abs(P).max())
    np.testing.assert_allclose(
        sol.gain, (A @ P @ C.T + S) @ np.linalg.inv(C @ P @ C.T + R), atol=1e-7
    )
    assert sol.spectral_radius == pytest.approx(
        np.abs(la.eigvals(A - sol.gain @ C)).max(), rel=1e-9
    )
    assert sol.residual < 1e-12


@given(st.integers(0, 10_000))
def test_continuous_equals_scipy_on_benign_problems(seed):
    A, C, Q, R, rng = benign(seed)
    S = 0.1 * rng.standard_normal((6, 2))
    Q = Q + S @ np.linalg.solve(R, S.T)  # the joint covariance is not indefinite
    sol = filter_care(A, C, Q=Q, R=R, S=S)
    P = la.solve_continuous_are(A.T, C.T, Q, R, e=np.eye(len(A)), s=S)
    np.testing.assert_allclose(sol.P, P, rtol=0, atol=1e-8 * np.abs(P).max())
    np.testing.assert_allclose(sol.gain, (P @ C.T + S) @ np.linalg.inv(R), atol=1e-7)
    assert sol.spectral_abscissa < 0


@pytest.mark.slow
@given(st.integers(0, 10_000))
def test_control_forms_are_the_duals(seed):
    A, C, Q, R, _ = benign(seed)
    B = C.T
    X = la.solve_discrete_are(A, B, Q, R)
    sol = control_dare(A, B, Q=Q, R=R)
    np.testing.assert_allclose(sol.P, X, atol=1e-8 * np.abs(X).max())
    np.testing.assert_allclose(
        sol.gain, np.linalg.solve(B.T @ X @ B + R, B.T @ X @ A), rtol=0, atol=1e-7
    )
    X = la.solve_continuous_are(A, B, Q, R)
    sol = control_care(A, B, Q=Q, R=R)
    np.testing.assert_allclose(sol.P, X, atol=1e-8 * np.abs(X).max())
    np.testing.assert_allclose(sol.gain, np.linalg.solve(R, B.T @ X), rtol=0, atol=1e-7)


@pytest.mark.slow
def test_equals_the_recursion_in_extended_precision_in_si_units():
    # one rigid body and two modes at 0.1 %: 1e-10 m, 1e-3 N; recursion from P = Q
    A, C, Q, R = machine(1, 2, inputs=2)
    sol = filter_dare(A, C, Q=Q, R=R)
    assert sol.spectral_radius < 0.998  # 20 000 steps decay to 1e-17
    P = riccati_recursion(A, C, Q, R, 20_000)
    scale = np.sqrt(np.diag(P))
    np.testing.assert_allclose(
        sol.P / scale / scale[:, None], P / scale / scale[:, None], atol=1e-9
    )


@pytest.mark.parametrize("n_rigid", [3, 6])
@pytest.mark.parametrize("force", [1e-5, 1e-3, 1e-1])
@pytest.mark.parametrize("noise", [1e-12, 1e-10, 1e-8])
def test_machines_in_si_units(n_rigid, force, noise):
    A, C, Q, R = machine(n_rigid, 15, force=force, noise=noise)
    sol = filter_dare(A, C, Q=Q, R=R)
    closed = A - sol.gain @ C
    assert np.abs(la.eigvals(closed)).max() < 1
    # the gain's own covariance, as one linear system in scaled states
    d = np.sqrt(np.diag(sol.P))
    scaled = closed * d / d[:, None]
    noise_in = (Q + sol.gain @ R @ sol.gain.T) / d / d[:, None]
    P = scaled @ (sol.P / d / d[:, None]) @ scaled.T + noise_in
    np.testing.assert_allclose(P, sol.P / d / d[:, None], atol=1e-11)
    assert sol.residual < 1e-11


def test_gain_of_a_machine_has_the_covariance_of_its_own_stein_equation():
    A, C, Q, R = machine(3, 4)
    sol = filter_dare(A, C, Q=Q, R=R)
    d = np.sqrt(np.diag(sol.P))
    closed = (A - sol.gain @ C) * d / d[:, None]
    P = stein(closed, (Q + sol.gain @ R @ sol.gain.T) / d / d[:, None])
    np.testing.assert_allclose(np.diag(P), 1.0, rtol=1e-9)


@pytest.mark.slow
@given(st.lists(st.integers(-30, 30), min_size=14, max_size=14), st.integers(-40, 40))
def test_units_of_states_and_noise_do_not_matter(powers, joint):
    A, C, Q, R = machine(3, 4)
    d = 2.0 ** np.array(powers)
    plain = filter_dare(A, C, Q=Q, R=R)
    moved = filter_dare(
        A * d[:, None] / d, C / d, Q=Q * d * d[:, None] * 2.0**joint, R=R * 2.0**joint
    )
    scale = np.sqrt(np.diag(plain.P))
    back = moved.P / d / d[:, None] / 2.0**joint
    np.testing.assert_allclose(
        back / scale / scale[:, None], plain.P / scale / scale[:, None], atol=1e-9
    )


def test_continuous_machine_in_si_units():
    rng = np.random.default_rng(2)
    omega = np.concatenate([np.zeros(3), 2 * np.pi * np.linspace(245.0, 3700.0, 20)])
    n = 2 * omega.size
    A, B, C = np.zeros((n, n)), np.zeros((n, 4)), np.zeros((4, n))
    A[::2, 1::2], A[1::2, ::2] = np.eye(omega.size), -np.diag(omega**2)
    A[1::2, 1::2] = -2e-3 * np.diag(omega)
    B[1::2], C[:, ::2] = rng.standard_normal((23, 4)) / 5, rng.standard_normal((4, 23)) / 5
    Q, R = B @ B.T * 5e-7, np.eye(4) * 5e-21
    sol = filter_care(A, C, Q=Q, R=R)
    assert la.eigvals(A - sol.gain @ C).real.max() < 0
    d = np.sqrt(np.diag(sol.P))
    As, Ps, Cs = A * d / d[:, None], sol.P / d / d[:, None], C * d
    terms = As @ Ps, Ps @ Cs.T @ np.linalg.inv(R) @ Cs @ Ps, Q / d / d[:, None]
    residual = terms[0] + terms[0].T - terms[1] + terms[2]
    assert np.abs(residual).max() < 1e-12 * max(np.abs(term).max() for term in terms)


@pytest.mark.parametrize("gamma", [100.0, 10.0, 3.5])
def test_indefinite_r_of_h_infinity(gamma):
    rng = np.random.default_rng(1)
    n = 8
    A, B, C = rng.standard_normal((n, n)), rng.standard_normal((n, 4)), rng.standard_normal((3, n))
    R = np.diag([-(gamma**2), -(gamma**2), 1.0, 1.0])
    sol = control_care(A, B, Q=C.T @ C, R=R)
    hamiltonian = np.block([[A, -B @ np.linalg.solve(R, B.T)], [-C.T @ C, -A.T]])
    _, U, count = la.schur(hamiltonian, sort="lhp")
    assert count == n
    X = U[n:, :n] @ np.linalg.inv(U[:n, :n])
    np.testing.assert_allclose(sol.P, X, atol=1e-8 * np.abs(X).max())


def test_indefinite_r_discrete():
    A, C, Q, _, _ = benign(3, n=5, p=3)
    A = 0.7 * A
    R = np.diag([-500.0, 1.0, 2.0])
    sol = filter_dare(A, C, Q=Q, R=R)
    P = sol.P
    right = A @ P @ A.T + Q - A @ P @ C.T @ np.linalg.solve(C @ P @ C.T + R, C @ P @ A.T)
    np.testing.assert_allclose(right, P, atol=1e-11 * np.abs(P).max())
    assert np.abs(la.eigvals(A - sol.gain @ C)).max() < 1


@pytest.mark.parametrize("seed", range(4))
def test_noise_that_the_outputs_show_in_full_leaves_the_mirrored_zeros(seed):
    """D square: Q - S R^-1 S' is rounding, the poles are the zeros of w -> y, all made stable."""
    rng = np.random.default_rng(seed)
    A, B, C, D = (rng.normal(size=shape) for shape in ((8, 8), (8, 2), (2, 8), (2, 2)))
    zeros = la.eigvals(A - B @ np.linalg.solve(D, C))
    assert np.any(zeros.real > 0)
    found = filter_care(A, C, Q=B @ B.T, R=D @ D.T, S=B @ D.T)
    mirrored = np.where(zeros.real > 0, -zeros.conj(), zeros)
    poles, wanted = np.sort_complex(found.poles), np.sort_complex(mirrored)
    np.testing.assert_allclose(poles, wanted, rtol=1e-6)


def test_hamiltonian_with_axis_eigenvalues_is_refused():
    # gamma below the smallest possible one: eigenvalues of the Hamiltonian on the axis
    A, B, C = np.array([[-1.0]]), np.array([[1.0, 0.0]]), np.array([[1.0]])
    with pytest.raises(SolverError, match="Riccati"):
        control_care(A, B, Q=C.T @ C, R=np.diag([-0.25, 1.0]))


def test_noise_that_misses_a_rigid_body_mode_is_named():
    A, C, Q, R = machine(3, 4)
    one = Q * 0
    B = np.zeros((14, 1))
    B[1::2, 0] = [0.3, 0.2, -0.4, 1, 1, 1, 1]
    one = B @ B.T * 1e-12
    with pytest.raises(SolverError, match=r"2 mode\(s\) of A at 1.* not excited"):
        filter_dare(A, C, Q=one, R=R)
    Q[0:2] = Q[:, 0:2] = 0.0
    with pytest.raises(SolverError, match=r"1 mode\(s\) of A at 1.* not excited"):
        filter_dare(A, C, Q=Q, R=R)


def test_two_rigid_body_modes_excited_as_one_but_for_rounding_are_refused():
    A, C, _, R = machine(2, 2)
    for apart, refused in ((1e-3, False), (3e-8, True), (0.0, True)):
        B = np.zeros((8, 2))
        B[1::2] = [[1, 1], [1, 1 + apart], [1, 0], [0, 1]]
        Q = B @ B.T * 1e-12
        if refused:
            with pytest.raises(SolverError, match="not excited"):
                filter_dare(A, C, Q=Q, R=R)
        else:
            assert filter_dare(A, C, Q=Q, R=R).spectral_radius < 1


def test_outputs_that_miss_a_rigid_body_mode_are_named():
    A, C, Q, R = machine(3, 4)
    with pytest.raises(SolverError, match=r"cannot be seen"):
        filter_dare(A, C[:2], Q=Q, R=R[:2, :2])
    with pytest.raises(SolverError, match=r"cannot be seen"):
        filter_care(np.diag([1.0, -1.0]), np.array([[0.0, 1.0]]), Q=np.eye(2), R=np.eye(1))


def test_compleib_problems_equal_scipy_or_have_no_solution():
    path = data_file("compleib-open.npz")
    if not path.exists():
        pytest.skip("the COMPleib data are not here")
    data = np.load(path)
    refused = []
    for name in sorted({key.split("/")[0] for key in data.files}):
        A, B1, B2, C1 = (data[f"{name}/{part}"] for part in ("A", "B1", "B2", "C1"))
        B, Q = np.hstack([B1, B2]), C1.T @ C1
        R = np.diag([-1e6] * B1.shape[1] + [1.0] * B2.shape[1])
        hamiltonian = np.block([[A, -B @ np.linalg.solve(R, B.T)], [-Q, -A.T]])
        balanced = la.matrix_balance(hamiltonian, permute=False)[0]
        if np.abs(la.eigvals(balanced).real).min() < 1e-9 * la.norm(balanced):
            with pytest.raises(SolverError, match="not excited"):
                control_care(A, B, Q=Q, R=R)
            refused.append(name)
            continue
        X = la.solve_continuous_are(A, B, Q, R)
        np.testing.assert_allclose(control_care(A, B, Q=Q, R=R).P, X, atol=1e-9 * np.abs(X).max())
    assert refused == ["AC2", "TMD"]


def test_delay_states_have_no_error():
    A, C, Q, R = machine(2, 3)
    n = A.shape[0]
    A = np.block([[A, np.ones((n, 1))], [np.zeros((1, n + 1))]])
    C, Q = np.hstack([C, np.zeros((6, 1))]), la.block_diag(Q, 0.0)
    sol = filter_dare(A, C, Q=Q, R=R)
    assert not sol.P[n].any()
    assert not sol.gain[n].any()


def test_empty_problem_and_repr():
    sol = filter_dare(np.zeros((0, 0)), np.zeros((2, 0)), Q=np.zeros((0, 0)), R=np.eye(2))
    assert sol.P.shape == (0, 0)
    assert repr(sol) == "<RiccatiSolution: 0 states, residual 0.0e+00, 0 iterations>"


EYE = np.eye(2)


@pytest.mark.parametrize("solve", [filter_dare, filter_care, control_dare, control_care])
@pytest.mark.parametrize(
    ("change", "error", "message"),
    [
        ({"A": np.ones((2, 3))}, ShapeError, "A must have shape"),
        ({"C": np.ones((3, 5))}, ShapeError, "C must have shape"),
        ({"Q": np.eye(3)}, ShapeError, "Q must have shape"),
        ({"Q": np.array([[1.0, 1.0], [0.0, 1.0]])}, ModelError, "Q must be symmetric"),
        ({"Q": np.full((2, 2), np.nan)}, ModelError, "NaN"),
        ({"R": np.zeros((2, 2))}, ModelError, "zero"),
        ({"R": np.ones((2, 2))}, ModelError, "singular"),
        ({"S": np.ones((1, 2))}, ShapeError, "S must have shape"),
    ],
)
def test_bad_input(solve, change, error, message):
    given_ = {"A": 0.5 * EYE, "C": EYE, "Q": EYE, "R": EYE} | change
    with pytest.raises(error, match=message):
        solve(given_.pop("A"), given_.pop("C"), **given_)


@pytest.mark.parametrize("A", [[[1.0]], [[2.0, 0.0], [0.0, -1.0]]])
def test_an_unstable_mode_that_nothing_reaches_is_named(A):
    A = np.array(A)
    with pytest.raises(SolverError, match="cannot be seen"):
        control_care(A, np.zeros((len(A), 1)), Q=np.eye(len(A)), R=np.eye(1))


def test_an_indefinite_equation_is_corrected_until_its_residual_is_small(monkeypatch):
    """From a basis that is 1e-5 off, as rounding leaves it of worse equations."""
    rng = np.random.default_rng(2)
    A, B, C = rng.normal(size=(6, 6)) - 3 * np.eye(6), rng.normal(size=(6, 3)), np.eye(6)
    R, S = np.diag([1.0, 1.0, -100.0]), np.zeros((6, 3))
    right, found = equations._stable_first, []

    def wrong(H):
        values, vectors, count = right(H)
        found.append(count)
        return values, vectors * (1.0 + 1e-5 * rng.normal(size=vectors.shape)), count

    monkeypatch.setattr(equations, "_stable_first", wrong)
    X, F = equations.stabilising(A, B, C.T @ C, R, S)
    rest = A.T @ X + X @ A - X @ B @ np.linalg.solve(R, B.T @ X) + C.T @ C
    assert found == [6]
    assert np.linalg.norm(rest) < 1e-10 * np.linalg.norm(A.T @ X)
    assert np.linalg.eigvals(A + B @ F).real.max() < 0.0


@pytest.mark.parametrize(("size", "noise"), [(1e-9, 1e6), (1.0, 1e36)])
def test_a_filter_as_slow_as_one_likes(size, noise):
    """Of a free mass, in closed form: (q c^2 / r)^(1/4) may be 1e-12 of anything else."""
    found = filter_care([[0, 1], [0, 0]], [[size, 0]], Q=np.diag([0.0, size**2]), R=[[noise]])
    speed = (size**4 / noise) ** 0.25
    np.testing.assert_allclose(np.abs(found.poles), speed, rtol=1e-6)
    root = np.sqrt(noise) * size  # P22 = sqrt(2) speed P12, P12 = size sqrt(r) / c
    np.testing.assert_allclose(found.P[0, 1], root / size, rtol=1e-6)


def test_a_slow_walk_beside_fast_poles():
    A, Q = np.diag([0.0, -1e3, -1e4]), np.diag([1e-14, 1.0, 1.0])
    found = filter_care(A, [[1.0, 1.0, 1.0]], Q=Q, R=[[1e3]])
    assert np.abs(found.poles).min() == pytest.approx(np.sqrt(1e-14 / 1e3), rel=1e-4)


@pytest.mark.parametrize(
    ("name", "oracle"),
    [
        ("care", la.solve_continuous_are),
        ("icare", la.solve_continuous_are),
        ("dare", la.solve_discrete_are),
        ("idare", la.solve_discrete_are),
    ],
)
@pytest.mark.parametrize("square", [False, True])
def test_names_of_others_lead_to_the_same_equation(name, oracle, square):
    """With a square B the dual equation has an answer too, which is another one."""
    room, ours = OURS[name].split(".")
    assert f"``{name.removeprefix('i')}``" in getattr(flexplant, room).__doc__
    for seed in range(10):
        rng = np.random.default_rng(seed)
        n = int(rng.integers(2, 6))
        A, B = rng.standard_normal((n, n)), rng.standard_normal((n, n if square else 1))
        Q, R = np.eye(n), np.eye(B.shape[1])
        found = getattr(getattr(flexplant, room), ours)(A, B, Q=Q, R=R)
        expected = oracle(A, B, Q, R)
        np.testing.assert_allclose(found.P, expected, rtol=0, atol=1e-8 * np.abs(expected).max())
        (row,) = [row for row in flexplant.lti.__doc__.splitlines() if "``care``" in row]
        assert f"`fx.{OURS[name]}`" in row

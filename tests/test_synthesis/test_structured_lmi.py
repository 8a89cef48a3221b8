"""StructuredLmi(): its program against dense constraint matrices, its answers against others."""

import csv
from pathlib import Path

import numpy as np
import pytest

import oracles_synthesis as oracle
from flexplant.errors import ModelError, SolverError
from flexplant.lti import StateSpace
from flexplant.lti.preparation import prepared
from flexplant.synthesis import StructuredLmi, design_hinf
from flexplant.synthesis.hinf.lower_bound import pointwise_bound
from flexplant.synthesis.lmi.interior_point import iterates
from flexplant.synthesis.lmi.lmi_solution import Plant, half
from flexplant.synthesis.lmi.structured_lmi import ProjectedLmis, _eliminated

DATA = Path(__file__).parents[3] / "shared" / "data" / "compleib-open.npz"


def named(A, B, C, D, nu, ny):
    u, y = [f"u{i}" for i in range(nu)], [f"y{i}" for i in range(ny)]
    w = [f"w{i}" for i in range(B.shape[1] - nu)]
    z = [f"z{i}" for i in range(C.shape[0] - ny)]
    return StateSpace(A, B, C, D, inputs=[*w, *u], outputs=[*z, *y]), u, y


def flexible(modes, seed=0):
    """Modes of 0.1 % damping with a rigid body: forces, positions with noise, little effort."""
    rng = np.random.default_rng(seed)
    omega = np.concatenate([[0.0], np.geomspace(1.0, 30.0, modes - 1)])
    zero, one = np.zeros((modes, modes)), np.eye(modes)
    A = np.block([[zero, one], [-np.diag(omega**2), -np.diag(2e-3 * omega)]])
    B = np.vstack([np.zeros((modes, 6)), rng.normal(size=(modes, 6))])
    B[:, 2:4] = 0.0
    C = np.hstack([rng.normal(size=(6, modes)), np.zeros((6, modes))])
    C[2:4] = 0.0
    D = np.zeros((6, 6))
    D[4:, 2:4] = D[2:4, 4:] = 1e-2 * np.eye(2)
    return named(A, B, C, D, 2, 2)


def compleib(name):
    with np.load(DATA) as data:
        g = {k: data[f"{name}/{k}"] for k in ("A", "B1", "B2", "C1", "C2", "D11", "D12", "D21")}
    nu, ny = g["B2"].shape[1], g["C2"].shape[0]
    D = np.block([[g["D11"], g["D12"]], [g["D21"], np.zeros((ny, nu))]])
    return named(g["A"], np.hstack([g["B1"], g["B2"]]), np.vstack([g["C1"], g["C2"]]), D, nu, ny)


def known():
    if not DATA.exists():
        return {}
    with DATA.with_suffix(".csv").open() as file:
        return {row["name"]: float(row["gamma"]) for row in csv.DictReader(file)}


def test_the_program_is_that_of_its_dense_constraint_matrices():
    """Adjoint and Schur matrix, entry by entry from the definition ``tr(A_i X A_j Z^-1)``."""
    rng = np.random.default_rng(3)
    program = ProjectedLmis(Plant.of(prepared(*flexible(2))))
    basis = [program.linear(e) for e in np.eye(program.count)]

    def positive(size):
        root = rng.normal(size=(size, size)) + 2.0 * np.eye(size)
        return root @ root.T

    sizes = [const.shape[0] for const in program.const]
    X, inverse = [[positive(size) for size in sizes] for _ in range(2)]
    W = [half(rng.normal(size=(size, size))) for size in sizes]
    np.testing.assert_allclose(
        program.adjoint(W),
        [sum(np.sum(a * w) for a, w in zip(A, W, strict=True)) for A in basis],
        atol=1e-12,
    )
    dense = np.array(
        [
            [
                sum(np.trace(a @ x @ b @ z) for a, b, x, z in zip(A, B, X, inverse, strict=True))
                for B in basis
            ]
            for A in basis
        ]
    )
    roots = [[np.linalg.cholesky(M) for M in blocks[:2]] for blocks in (X, inverse)]
    found = program.schur(*roots, X[2], inverse[2])
    np.testing.assert_allclose(found, dense, rtol=1e-9, atol=1e-9 * np.abs(dense).max())


def test_gamma_and_multipliers_close_the_gap():
    """Weak duality at the end: cost' y + <const, X> = <X, Z> to rounding."""
    program = ProjectedLmis(Plant.of(prepared(*flexible(2))))
    *_, last = iterates(program, program.start(10.0), 10.0)
    paired = sum(np.sum(c * x) for c, x in zip(program.const, last.X, strict=True))
    assert last.gap < 1e-5 * last.y[-1]
    assert last.y[-1] + paired == pytest.approx(0.0, abs=1e-4 * last.y[-1])


@pytest.mark.parametrize("seed", range(3))
def test_what_is_eliminated_solves_its_inequality(seed):
    rng = np.random.default_rng(seed)
    P, C, K = rng.normal(size=(7, 2)), rng.normal(size=(3, 7)), rng.normal(size=(2, 3))
    moved = P @ K @ C
    Q = -0.1 * np.eye(7) - moved - moved.T  # solved by K
    found = P @ _eliminated(Q, P, C) @ C
    assert np.linalg.eigvalsh(Q + found + found.T)[-1] < 0
    with pytest.raises(SolverError, match="rounding hides"):
        _eliminated(np.eye(7), P, C)


@pytest.mark.parametrize(
    "name",
    [
        pytest.param(name, marks=[] if name in ("HE1", "TMD", "EB1") else [pytest.mark.slow])
        for name in known()
    ],
)
def test_compleib(name):
    """Of full rank or not: within 5 % of the best known, gap and bound as they are claimed."""
    P, u, y = compleib(name)
    best = known()[name]
    found = design_hinf(P, StructuredLmi(), u=u, y=y)
    K = found.system
    loop = oracle.closed_loop(oracle.split(P.A, P.B, P.C, P.D, len(u), len(y)), *K_of(K))
    assert oracle.stability(loop[0], 0.0) < 0
    assert oracle.brute_norm(*loop, 0.0) == pytest.approx(found.gamma, rel=1e-3)
    assert best * (1 - 2e-3) <= found.gamma <= 1.05 * best
    assert 0.95 * best <= found.lower <= best * (1 + 1e-3)
    solved = StructuredLmi().smallest(prepared(P, u, y))
    assert solved.value == pytest.approx(best, rel=2e-3)


def K_of(K):
    return K.A, K.B, K.C, K.D


@pytest.mark.parametrize("modes", [4, pytest.param(12, marks=pytest.mark.slow)])
def test_rigid_body_and_light_damping(modes):
    P, u, y = flexible(modes)
    found = design_hinf(P, StructuredLmi(), u=u, y=y)
    assert found.lower <= found.gamma <= 1.06 * found.lower
    other = design_hinf(P, u=u, y=y)
    assert other.gamma == pytest.approx(found.gamma, rel=0.06)
    assert other.lower <= found.gamma
    assert found.lower <= other.gamma


def test_units_of_z_change_nothing():
    P, u, y = flexible(4)
    plain = design_hinf(P, StructuredLmi(), u=u, y=y)
    for unit in (1e-9, 1e-3, 1e6):
        rows = np.where(np.arange(len(P.outputs)) < len(P.outputs) - len(y), unit, 1.0)[:, None]
        found = design_hinf(P.replace(C=rows * P.C, D=rows * P.D), StructuredLmi(), u=u, y=y)
        assert found.gamma == pytest.approx(unit * plain.gamma, rel=3e-3, abs=0)
        assert found.lower == pytest.approx(unit * plain.lower, rel=1e-3, abs=0)


def test_the_pointwise_bound_by_hand():
    """Two z, one u that moves the first only: the second is w's own gain, at most 2."""
    P, u, y = named(
        np.diag([-1.0, -1.0]),
        np.array([[1.0, 1.0], [2.0, 0.0]]),
        np.array([[1.0, 0.0], [0.0, 1.0], [1.0, 0.0]]),
        np.array([[0.0, 0.0], [0.0, 0.0], [1.0, 0.0]]),
        1,
        1,
    )
    assert pointwise_bound(prepared(P, u, y)) == pytest.approx(2.0, rel=1e-9)


@pytest.mark.parametrize("options", [{"back_off": 0}, {"tolerance": -1}, {"max_states": 0.5}])
def test_bad_options(options):
    with pytest.raises(ModelError, match=next(iter(options))):
        StructuredLmi(**options)


def test_too_many_states():
    with pytest.raises(ModelError, match="of 1 to 3 states, got 4"):
        StructuredLmi(max_states=3).solve(prepared(*flexible(2)))


def test_what_was_tried_is_in_the_answer():
    P, u, y = flexible(2)
    named = design_hinf(P, StructuredLmi(), u=u, y=y)
    assert named.tried == {"StructuredLmi()": named.gamma}
    found = design_hinf(P, u=u, y=y)
    assert next(iter(found.tried)) == "Riccati()"
    assert found.gamma in found.tried.values()

"""design_h2 against closed forms, SciPy's Riccati solvers and the norm of perturbed controllers."""

import numpy as np
import pytest
import scipy.linalg as la
from test_spill_over import many, small

from flexplant.errors import AssumptionError, FlexplantWarning
from flexplant.lti import StateSpace
from flexplant.synthesis import design_h2
from oracles_lmi import least_h2_norm
from oracles_synthesis import closed_loop, split, stability
from stages import RATE, ports, reduced, sampled

TIMES = pytest.mark.parametrize("dt", [0.0, 0.1], ids=["continuous", "sampled"])


def plant(A, B, C, D, nu=1, ny=1, dt=0.0):
    names = [f"w{i}" for i in range(B.shape[1] - nu)] + [f"u{i}" for i in range(nu)]
    outputs = [f"z{i}" for i in range(C.shape[0] - ny)] + [f"y{i}" for i in range(ny)]
    return StateSpace(A, B, C, D, inputs=names, outputs=outputs, dt=dt)


def design(P, nu=1, ny=1, **options):
    return design_h2(P, u=P.inputs[-nu:], y=P.outputs[-ny:], **options)


def h2(A, B, C, D, dt):
    """The H2 norm from SciPy's Lyapunov equation; infinite unless stable."""
    if stability(A, dt) >= 0:
        return np.inf
    W = B @ B.T
    P = la.solve_discrete_lyapunov(A, W) if dt else la.solve_continuous_lyapunov(A, -W)
    return np.sqrt(np.trace(C @ P @ C.T) + (np.sum(D**2) if dt else 0.0))


def loop_norm(P, A, B, C, D, nu, ny):
    return h2(*closed_loop(split(P.A, P.B, P.C, P.D, nu, ny), A, B, C, D), P.dt)


def scalar(dt, effort=1.0, noise=1.0, seen=1.0, reach=1.0):
    """The integrator ``w1 + u -> x``, z = [x; effort u], y = x + noise w2."""
    A = np.array([[1.0 if dt else 0.0]])
    B = np.array([[1.0, 0.0, reach]])
    C = np.array([[1.0], [0.0], [seen]])
    D = np.array([[0, 0, 0], [0, 0, effort], [0, noise, 0.0]])
    return plant(A, B, C, D, dt=dt)


def random_plant(dt, units=1.0, seed=3):
    """Two inputs and outputs, cross terms, D22 and (sampled) D11; an unstable pole."""
    rng = np.random.default_rng(seed)
    A = rng.normal(size=(4, 4)) * (0.6 if dt else 1.0)
    B, C, D = rng.normal(size=(4, 5)), rng.normal(size=(5, 4)), 0.3 * rng.normal(size=(5, 5))
    if not dt:
        D[:3, :3] = 0.0
    D[:3, 3:] += np.eye(3, 2)
    D[3:, :3] += np.eye(2, 3)
    B[:, 3:], D[:, 3:] = B[:, 3:] * units, D[:, 3:] * units
    C[3:], D[3:] = C[3:] / units**2, D[3:] / units**2
    assert stability(A, dt) > 0
    return plant(A, B, C, D, 2, 2, dt)


def test_an_integrator_by_hand():
    """X = Y = 1 and F = L = -1: K = -1 / (s + 2), norm 2^(1/2)."""
    found = design(scalar(0.0))
    K = found.system
    assert found.gamma == pytest.approx(np.sqrt(2.0), rel=1e-12)
    assert K.evaluated(3j)[0, 0] == pytest.approx(-1.0 / (3j + 2.0), rel=1e-10)


def test_a_summed_input_by_hand():
    """X = Y = g, the golden ratio; u = -(1/g) of the estimate after its measurement."""
    found = design(scalar(0.1))
    g = (1 + np.sqrt(5)) / 2
    # full state: g; the estimate's variance after the measurement is g / (g + 1) = 1 / g
    assert found.gamma**2 == pytest.approx(g + (g + 1) * g**-2 * g**-1, rel=1e-12)
    # xhat = (1 - 1/g)(xhat + u) + y / g, u = -xhat / g
    z = np.exp(0.7j)
    pole = (1 - 1 / g) * (1 - 1 / g)
    expected = -(1 / g) * (1 / g) * z / (z - pole)
    assert found.system.evaluated(z)[0, 0] == pytest.approx(expected, rel=1e-10)


@TIMES
def test_lqg_is_the_kalman_filter_and_the_regulator(dt):
    """The recipe of the docstring: gains and cost from SciPy's solvers."""
    rng = np.random.default_rng(1)
    A = rng.normal(size=(3, 3)) * (0.5 if dt else 1.0)
    Bu, Cy = rng.normal(size=(3, 2)), rng.normal(size=(1, 3))
    q, r, w, v = 2.0, 0.5, 3.0, 0.1
    zeros = np.zeros
    B = np.hstack([np.sqrt(w) * np.eye(3), zeros((3, 1)), Bu])
    C = np.vstack([np.sqrt(q) * np.eye(3), zeros((2, 3)), Cy])
    D = zeros((6, 6))
    D[3:5, 4:] = np.sqrt(r) * np.eye(2)
    D[5, 3] = np.sqrt(v)
    found = design(plant(A, B, C, D, 2, 1, dt), 2, 1)
    solve = la.solve_discrete_are if dt else la.solve_continuous_are
    X = solve(A, Bu, q * np.eye(3), r * np.eye(2))
    Y = solve(A.T, Cy.T, w * np.eye(3), v * np.eye(1))
    if dt:
        R, S = Bu.T @ X @ Bu + r * np.eye(2), Cy @ Y @ Cy.T + v
        F, Y = np.linalg.solve(R, Bu.T @ X @ A), Y - Y @ Cy.T @ np.linalg.solve(S, Cy @ Y)
    else:
        R, F = r * np.eye(2), Bu.T @ X / r
        poles = np.concatenate([la.eigvals(A - Bu @ F), la.eigvals(A - Y @ Cy.T @ Cy / v)])
        K = found.system
        g = closed_loop(split(A, B, C, D, 2, 1), K.A, K.B, K.C, K.D)
        np.testing.assert_allclose(
            np.sort_complex(la.eigvals(g[0])), np.sort_complex(poles), rtol=1e-8
        )
    expected = np.sqrt(w * np.trace(X) + np.trace(R @ F @ Y @ F.T))
    assert found.gamma == pytest.approx(expected, rel=1e-9)
    assert found.certificate["claim"] == pytest.approx(expected, rel=1e-9)


@TIMES
@pytest.mark.parametrize("units", [1.0, 1e6])
def test_no_controller_nearby_does_better(dt, units):
    """The norm from SciPy is the claim in any units; moving any entry of K makes it larger."""
    P = random_plant(dt, units)
    found = design(P, 2, 2)
    K = found.system
    parts = [K.A, K.B, K.C, K.D]
    least = loop_norm(P, *parts, 2, 2)
    assert found.gamma == pytest.approx(least, rel=1e-8)
    assert found.lower == pytest.approx(least, rel=1e-8)
    assert found.gamma == pytest.approx(design(random_plant(dt), 2, 2).gamma, rel=1e-8)
    rng = np.random.default_rng(0)
    for size in (1e-2, 1e-3):
        for which in (0, 1, 2, *([3] if dt else ())):
            step = size * parts[which] * rng.normal(size=parts[which].shape)
            for sign in (1.0, -1.0):
                moved = list(parts)
                moved[which] = parts[which] + sign * step
                assert loop_norm(P, *moved, 2, 2) > least


@TIMES
def test_cheap_control_and_clean_sensors_reach_their_limits(dt):
    """Without effort in z only the estimation error is left; without noise too, one sample."""
    g = (1 + np.sqrt(5)) / 2
    cheap = design(scalar(dt, effort=0.0))
    # sampled: the error of x before the next measurement, w of this sample in it
    assert cheap.gamma == pytest.approx(np.sqrt(g) if dt else 1.0, rel=5e-3)
    assert cheap.lower is None
    assert "D12 has rank 0 of 1" in cheap.notes[0]
    clean = design(scalar(dt, noise=0.0))
    assert clean.gamma == pytest.approx(np.sqrt(g) if dt else 1.0, rel=5e-3)
    assert "D21" in clean.notes[0]


@pytest.mark.slow
@TIMES
@pytest.mark.parametrize("seed", [3, 5])
def test_a_semidefinite_program_over_all_controllers_does_no_better(dt, seed):
    P = random_plant(dt, seed=seed)
    least = least_h2_norm(split(P.A, P.B, P.C, P.D, 2, 2), bool(dt))
    found = design(P, 2, 2)
    assert found.gamma == pytest.approx(least, rel=1e-4)
    assert found.lower == pytest.approx(least, rel=1e-4)


@TIMES
def test_what_cannot_be_controlled_is_refused(dt):
    with pytest.raises(AssumptionError, match=r"u \(u0\) does not reach .* integrating"):
        design(scalar(dt, reach=0.0))
    with pytest.raises(AssumptionError, match=r"y \(y0\) does not see .* integrating"):
        design(scalar(dt, seen=0.0))


def test_white_noise_at_once_in_z_is_refused():
    P = scalar(0.0)
    D = P.D.copy()
    D[0, 0] = 1e-9
    with pytest.raises(AssumptionError, match="w0 reaches z0 at once"):
        design(P.replace(D=D))


def weighted(model, motion=1e8):
    """The stage with noise per sample, motions (of 10 nm) and forces of 10 N allowed."""
    P = sampled(model, ports(references=[]))
    w = {name: (1e-10 if name.endswith("noise") else 1e-3 * np.sqrt(RATE / 2)) for name in P.w}
    z = {name: (0.1 if name.endswith("effort") else motion) for name in P.z}
    return P.weighted(w=w, z=z)


@pytest.mark.slow
def test_the_stage_holds_its_die_and_the_modes_left_out_are_checked():
    """Rigid body, a sample of delay, SI units: claim, Gramians and a sum of impulses agree."""
    found = design_h2(weighted(reduced()))
    P, K = weighted(reduced()).system, found.system
    A, B, C, D = closed_loop(split(P.A, P.B, P.C, P.D, 4, 4), K.A, K.B, K.C, K.D)
    assert stability(A, P.dt) < 0
    W, power = B @ B.T, A
    for _ in range(30):  # the sum of the squared impulse response, doubled
        W, power = W + power @ W @ power.T, power @ power
    assert found.gamma == pytest.approx(np.sqrt(np.trace(C @ W @ C.T) + np.sum(D**2)), rel=1e-6)
    assert found.certificate["claim"] == pytest.approx(found.gamma, rel=1e-6)
    with pytest.warns(FlexplantWarning, match=r"the loop is unstable .* modes? 17\b"):
        fast = design_h2(weighted(small()).replace(evaluation=many()))
    assert fast.left_out is not None and not fast.left_out.is_stable
    slow = design_h2(weighted(small(), 1e2).replace(evaluation=many()))
    assert slow.left_out is not None and slow.left_out.is_fine

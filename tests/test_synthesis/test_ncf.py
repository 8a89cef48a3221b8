"""design_ncf against closed forms, SciPy's Riccati solvers and coprime perturbations."""

import numpy as np
import pytest
import scipy.linalg as la
from test_spill_over import many, small

from flexplant.errors import AssumptionError, ModelError
from flexplant.loop import bandwidth, close_loop, modulus_margin
from flexplant.lti import StateSpace, discretized, frequency_response
from flexplant.plant import gravity_axes
from flexplant.synthesis import design_ncf, ncf_margin
from oracles_synthesis import brute_norm
from stages import ports, reduced, sampled

INTEGRATOR = StateSpace([[0.0]], [[1.0]], [[1.0]], [[0.0]])
BODY = StateSpace([[0.0, 1.0], [0.0, 0.0]], [[0.0], [1.0]], [[1.0, 0.0]], [[0.0]])


def brute(G, K):
    """[K; I] (I - G K)^-1 [I, G] by dense matrices, its largest gain on a grid."""
    a, b, c, d = G.A, G.B, G.C, G.D
    n, k, p, m = len(a), len(K.A), len(c), b.shape[1]
    # y = (I - D DK)^-1 (C x + D CK xk + n + D f), u = CK xk + DK y
    inner = np.linalg.inv(np.eye(p) - d @ K.D)
    y = inner @ np.hstack([c, d @ K.C, np.eye(p), d])
    u = np.hstack([np.zeros((m, n)), K.C, np.zeros((m, p + m))]) + K.D @ y
    x = np.hstack([a, np.zeros((n, k + p)), b]) + b @ u
    xk = np.hstack([np.zeros((k, n)), K.A, np.zeros((k, p + m))]) + K.B @ y
    all_, z = np.vstack([x, xk]), np.vstack([u, y])
    size = n + k
    return brute_norm(all_[:, :size], all_[:, size:], z[:, :size], z[:, size:], G.dt)


@pytest.mark.parametrize(
    ("G", "least"),
    [(INTEGRATOR, np.sqrt(2.0)), (BODY, np.sqrt(4.0 + 2.0 * np.sqrt(2.0)))],
    ids=["integrator", "rigid body"],
)
def test_the_smallest_gamma_in_closed_form(G, least):
    """X Z = 1; X and Z of the rigid body are [r 1; 1 r] and its mirror, r = 2^(1/2)."""
    found = design_ncf(G, back_off=1e-3)
    assert found.lower == pytest.approx(least, rel=1e-9)
    assert least * (1 - 1e-9) < found.gamma < 1.001 * least
    assert brute(G, found.system) == pytest.approx(found.gamma, rel=1e-3)
    assert ncf_margin(G, found) == pytest.approx(1.0 / found.gamma, rel=1e-6)
    assert found.certificate["smallest gamma"] == pytest.approx(least, rel=1e-6)


@pytest.mark.parametrize("dt", [0.0, 0.2], ids=["continuous", "sampled"])
def test_several_channels_with_feedthrough(dt):
    """gamma_min from SciPy's solvers (discrete: its own equations), the norm by brute force."""
    rng = np.random.default_rng(5)
    A = rng.normal(size=(4, 4)) * (0.6 if dt else 1.0)
    B, C, D = rng.normal(size=(4, 2)), rng.normal(size=(3, 4)), 0.5 * rng.normal(size=(3, 2))
    G = StateSpace(A, B, C, D, dt=dt)
    solve = la.solve_discrete_are if dt else la.solve_continuous_are
    X = solve(A, B, C.T @ C, np.eye(2) + D.T @ D, e=np.eye(4), s=C.T @ D)
    Z = solve(A.T, C.T, B @ B.T, np.eye(3) + D @ D.T, e=np.eye(4), s=B @ D.T)
    least = np.sqrt(1.0 + np.max(la.eigvals(X @ Z).real))
    found = design_ncf(G)
    assert found.lower == pytest.approx(least, rel=1e-7)
    assert found.gamma <= 1.1 * least * (1 + 1e-6)
    assert found.gamma == pytest.approx(brute(G, found.system), rel=1e-3)
    assert ncf_margin(G, -found.system) < 1.0 / found.gamma


@pytest.mark.parametrize("rate", [0.0, 2e4], ids=["continuous", "sampled"])
def test_from_bandwidth_to_margins_on_a_light_mechanism(rate):
    """2 kg and a mode at 900 Hz of 0.1 %, 1e-9 m/N: the bandwidth is reached, robustly."""
    w = 2 * np.pi * 900.0
    A = la.block_diag([[0, 1], [0, 0]], [[0, 1], [-(w**2), -2e-3 * w]])
    G = StateSpace(A, [[0], [0.5], [0], [0.5]], [[1, 0, 0.2, 0]], [[0]], inputs=["f"])
    G = discretized(G, rate) if rate else G
    found = design_ncf(G, bandwidth=80.0)
    assert found.gamma < 4.0
    assert 50.0 < bandwidth((G, found)) < 160.0
    assert modulus_margin((G, found)) == pytest.approx(found.certificate["modulus margin"])
    assert found.certificate["modulus margin"] > 0.4
    slow = np.abs(frequency_response(found.system, [0.01, 0.1]).data[0, 0])
    assert slow[0] > 9.0 * slow[1]  # integral action


def test_what_does_not_go_together_is_refused():
    unmoved = StateSpace([[0.0]], [[0.0]], [[1.0]], [[1.0]])
    with pytest.raises(
        AssumptionError, match=r"u \(u1\) does not reach a mode .*0 Hz.*or a zero of `before`"
    ):
        design_ncf(unmoved)
    unseen = StateSpace([[0.0, 9.0], [-9.0, 0.0]], [[0.0], [1.0]], [[0.0, 0.0]], [[1.0]])
    with pytest.raises(AssumptionError, match=r"y \(y1\) does not see a mode .*1\.43 Hz"):
        design_ncf(unseen)
    lead = StateSpace([[-5.0]], [[5.0]], [[-1.0]], [[1.0]])  # s / (s + 5) hides the integrator
    with pytest.raises(AssumptionError, match=r"does not .* 0 Hz.*, or a zero of `before`"):
        design_ncf(INTEGRATOR, before=lead)
    with pytest.raises(ModelError, match="as many y as u"):
        design_ncf(StateSpace([[0.0]], [[1.0]], [[1.0], [1.0]], [[0.0], [0.0]]), bandwidth=1.0)


@pytest.mark.slow
def test_the_stage_in_decoupled_axes():
    """Three rigid motions, four sensors and actuators, a sample of delay: one gain an axis."""
    P = sampled(reduced(), ports(references=[]))
    axes = gravity_axes(P)
    found = design_ncf(P, before=axes.accelerations, after=axes.to_motions, bandwidth=60.0)
    assert (found.system.inputs, found.system.outputs) == (P.y, P.u)
    assert found.gamma < 5.0
    loop = close_loop(P, found)
    assert loop.is_stable
    assert loop.modulus_margin > 0.3
    fine = design_ncf(
        sampled(small(), ports(references=[])).replace(evaluation=many()),
        before=axes.accelerations,
        after=axes.to_motions,
        bandwidth=20.0,
    )
    assert fine.left_out is not None

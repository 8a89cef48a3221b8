"""Both methods on plants made here, whose smallest gamma is known by another theory.

They cover what the collections of plants do (many channels, modes on the axis, unstable poles,
D12 and D21 of less than full rank), so that a clone without data tests synthesis as sharply.
"""

import numpy as np
import pytest
import scipy.signal

import oracles_synthesis as oracle
from flexplant.errors import CertificateError
from flexplant.lti import StateSpace, lft
from flexplant.synthesis import Lmi, Riccati, design_hinf
from flexplant.synthesis.controller import certified_norm

#: structures with the smallest gamma of Glover and McFarlane's problem
STRUCTURES = {
    "double integrator": (np.array([[0.0, 1], [0, 0]]), np.array([[0.0], [1]]), np.eye(2)[:1]),
    "chain, far end": oracle.chain(),
    "cart and pole": oracle.cart_pole(),
    "six states, 2 by 2": oracle.random_plant(4),
    "five states, 3 by 2": oracle.random_plant(9, n=5, m=3, p=2),
}
METHODS = [Riccati(), Lmi()]


def named(A, B, C, D, nu, ny, dt=0.0):
    u, y = [f"u{i}" for i in range(nu)], [f"y{i}" for i in range(ny)]
    w = [f"w{i}" for i in range(B.shape[1] - nu)]
    z = [f"z{i}" for i in range(C.shape[0] - ny)]
    return StateSpace(A, B, C, D, dt, inputs=[*w, *u], outputs=[*z, *y]), u, y


def judged(P, u, y, method, best, low=2e-3, over=1e-4, high=0.055):
    """The design; its loop from dense matrices, its gamma and bound beside the known optimum."""
    found = design_hinf(P, method, u=u, y=y)
    K = found.system
    parts = oracle.split(P.A, P.B, P.C, P.D, len(u), len(y))
    loop = oracle.closed_loop(parts, K.A, K.B, K.C, K.D)
    assert oracle.stability(loop[0], P.dt) < 0
    assert oracle.brute_norm(*loop, P.dt) == pytest.approx(found.gamma, rel=1e-3)
    assert best * (1 - low) <= found.lower <= best * (1 + over)
    assert best * (1 - 1e-4) <= found.gamma <= best * (1 + high)
    return found


@pytest.mark.slow
@pytest.mark.parametrize("method", METHODS, ids=["Riccati", "Lmi"])
@pytest.mark.parametrize("name", STRUCTURES)
def test_coprime_factors(name, method):
    A, B, C = STRUCTURES[name]
    parts, best = oracle.coprime_problem(A, B, C)
    P, u, y = named(*parts, B.shape[1], C.shape[0])
    found = judged(P, u, y, method, best)
    K = found.system
    for i in range(len(u)):
        sign = np.where(np.arange(len(u)) == i, -1.0, 1.0)[:, None]
        with pytest.raises(CertificateError, match=r"is not stable|norm"):
            certified_norm(lft(P, K.replace(C=sign * K.C, D=sign * K.D)), found.gamma)


def test_the_double_integrator_by_hand():
    """X = Y mirrored: [sqrt2, 1; 1, sqrt2] and its flip; 1 + lambda_max = 4 + 2 sqrt2."""
    _, best = oracle.coprime_problem(*STRUCTURES["double integrator"])
    assert best == pytest.approx(np.sqrt(4 + 2 * np.sqrt(2)), rel=1e-12)


@pytest.mark.slow
@pytest.mark.parametrize("method", METHODS, ids=["Riccati", "Lmi"])
def test_sampled_by_the_bilinear_map(method):
    """It keeps norms, so the optimum; scipy's map, not ours."""
    A, B, C = STRUCTURES["cart and pole"]
    parts, best = oracle.coprime_problem(A, B, C)
    Ad, Bd, Cd, Dd, _ = scipy.signal.cont2discrete(parts, 0.02, method="bilinear")
    judged(*named(Ad, Bd, Cd, Dd, B.shape[1], C.shape[0], 0.02), method, best)


# the infimum is approached only as the Lyapunov matrices grow without bound (the optimal loop
# cancels modes): gamma lies a little above it
@pytest.mark.slow
@pytest.mark.parametrize(("zero", "pole"), [(2.0, -1.0), (0.3, -0.1), (3.0, 1.0), (0.5, 2.0)])
def test_sensitivity_against_a_zero_and_a_pole(zero, pole):
    parts, best = oracle.sensitivity_problem(zero, pole, False)
    found = judged(*named(*parts, 1, 1), Lmi(back_off=1e-3), best, low=1e-3, high=6e-3)
    assert found.gamma <= 1.006 * found.lower


@pytest.mark.slow
@pytest.mark.parametrize(("zero", "pole"), [(2.0, -1.0), (3.0, 1.0)])
def test_without_cost_of_the_effort_at_high_frequency(zero, pole):
    """The infimum is that of the plant without lag, and no controller attains it."""
    parts, best = oracle.sensitivity_problem(zero, pole, True)
    P, u, y = named(*parts, 1, 1)
    judged(P, u, y, Lmi(), best, high=0.08)
    found = judged(P, u, y, None, best, low=5e-2, over=2e-2)
    assert "D12 has rank 0 of 1" in found.notes[0]
    dual = StateSpace(P.A.T, P.C.T, P.B.T, P.D.T, inputs=P.inputs, outputs=P.outputs)
    judged(dual, u, y, Lmi(), best, high=0.08)
    found = judged(dual, u, y, None, best, low=5e-2, over=2e-2)
    assert "D21 has rank 0 of 1" in found.notes[0]
    assert "approached by infinite gain only" in found.notes[1]

"""The plant of [W_S S; W_KS K S; W_T T], against a loop that is closed by hand."""

import numpy as np
import pytest

from flexplant import design_hinf
from flexplant.errors import ModelError
from flexplant.lti import (
    StateSpace,
    high_pass_filter,
    inverse_sensitivity,
    lft,
    low_pass_filter,
    tf,
    tustin,
)
from flexplant.plant import mixed_sensitivity

LAG = tf([200.0], [1.0, 10.1, 1.0]).replace(inputs=["force"], outputs=["x"])


@pytest.mark.parametrize("rate", [0.0, 100.0])
def test_it_is_the_stacked_loop(rate):
    dt = 1 / rate if rate else 0.0
    G = StateSpace([[-1.0, 4.0], [-4.0, -0.2]], np.eye(2), [[1.0, 0.0], [0.3, 1.0]],
                   np.zeros((2, 2)))  # fmt: skip
    G = tustin(G, rate) if rate else G
    K = StateSpace([], [], [], [[0.4, 0.1], [0.0, 0.7]], dt)
    W_S, W_T = inverse_sensitivity(2.0), high_pass_filter(5.0)
    P = mixed_sensitivity(G, S=W_S, KS=0.1, T=W_T)
    assert P.z == ("S:y1", "S:y2", "KS:u1", "KS:u2", "T:y1", "T:y2")
    closed = lft(P.system, K.replace(inputs=P.y, outputs=P.u))
    s = np.exp(0.07j) if rate else 3.0j
    at = [w if not rate else tustin(w, rate) for w in (W_S, W_T)]
    g, k = G.evaluated(s), K.evaluated(s)
    S = np.linalg.inv(np.eye(2) + g @ k)
    wanted = np.vstack([at[0](s) * S, 0.1 * k @ S, at[1](s) * (g @ k @ S)])
    np.testing.assert_allclose(closed.evaluated(s), wanted, rtol=1e-10, atol=1e-13)


def test_a_design_reaches_what_it_says_of_s_and_ks():
    """Weighted S and K S of the loop closed by hand, on a grid: below gamma, and close to it."""
    W_S = inverse_sensitivity(1.0, floor=1e-3)
    P = mixed_sensitivity(LAG, S=W_S, KS=0.1)
    assert (P.w, P.u, P.y) == (("x:ref",), ("force",), ("x:error",))
    controller = design_hinf(P)
    reached = []
    for s in 2j * np.pi * np.geomspace(1e-3, 1e3, 400):
        g, k = LAG(s), controller.system(s)
        reached.append(np.hypot(abs(W_S(s)), abs(0.1 * k)) / abs(1 + g * k))
    assert 0.95 * controller.gamma < max(reached) < (1 + 1e-6) * controller.gamma


def test_refusals():
    with pytest.raises(ModelError, match="no weight is given"):
        mixed_sensitivity(LAG)
    with pytest.raises(ModelError, match=r"weight S must be one by one or 1 by 1"):
        mixed_sensitivity(LAG, S=np.eye(2))
    with pytest.raises(ModelError, match=r"has dt 0.1 s, the plant 0 s"):
        mixed_sensitivity(LAG, S=tustin(low_pass_filter(1.0), 10.0))

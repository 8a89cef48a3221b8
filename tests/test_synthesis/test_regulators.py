"""LQR, LQI, LQG, Kalman gains and pole placement beside python-control."""

import control
import numpy as np
import pytest

import flexplant as fx
from flexplant.errors import AssumptionError
from flexplant.synthesis import lqe, lqg, lqi, lqr, place


def drawn(seed, dt):
    """Return a random system, stable or not, and random weights."""
    rng = np.random.default_rng(seed)
    n, m, p = 4, 2, 2
    A = 0.6 * rng.normal(size=(n, n))
    g = fx.StateSpace(
        A, rng.normal(size=(n, m)), rng.normal(size=(p, n)), 0.1 * rng.normal(size=(p, m)), dt
    )

    def weight(k):
        root = rng.normal(size=(k, k))
        return root @ root.T + 0.1 * np.eye(k)

    return g, weight


@pytest.mark.parametrize("dt", [0.0, 0.1])
@pytest.mark.parametrize("seed", range(4))
def test_gains_are_those_of_python_control(seed, dt):
    g, weight = drawn(seed, dt)
    theirs = control.ss(g.A, g.B, g.C, g.D, dt)
    Q, R, N = weight(4), weight(2), 0.01 * np.ones((4, 2))
    gain, cost, _ = (control.dlqr if dt else control.lqr)(theirs, Q, R, N)
    found = lqr(g, Q=Q, R=R, N=N)
    np.testing.assert_allclose(found.gain, gain, rtol=1e-8, atol=1e-10)
    np.testing.assert_allclose(found.P, cost, rtol=1e-8, atol=1e-10)
    W, V = weight(4), weight(2)
    L, *_ = (control.dlqe if dt else control.lqe)(g.A, np.eye(4), g.C, W, V)
    K = lqe(g, W=W, V=V).B[:, 2:]
    np.testing.assert_allclose(K, L, rtol=1e-8, atol=1e-10)


@pytest.mark.parametrize("dt", [0.0, 0.1])
@pytest.mark.parametrize("seed", range(4))
def test_poles_of_a_loop_are_those_of_feedback_and_of_the_filter(seed, dt):
    """Separation, with and without integrators; a reference is reached without an error."""
    g, weight = drawn(seed, dt)
    W, V, R = weight(4), weight(2), weight(2)
    for integrate, size in ((None, 4), (["y2", "y1"], 6)):
        Q = weight(size)
        K = lqg(g, Q=Q, R=R, W=W, V=V, integrate=integrate)
        feedback = lqi(g, Q=Q, R=R, outputs=integrate) if integrate else lqr(g, Q=Q, R=R)
        wanted = np.concatenate(
            [feedback.poles, np.linalg.eigvals(g.A - lqe(g, W=W, V=V).B[:, 2:] @ g.C)]
        )
        T = fx.lti.feedback(g, K.select(inputs=g.outputs), sign=1)
        far = np.abs(T.poles()[:, None] - wanted)
        assert far.min(axis=0).max() < 1e-6
        assert far.min(axis=1).max() < 1e-6
        if integrate:
            loop = _closed(g, K)
            np.testing.assert_allclose(loop.select(["y2", "y1"]).dcgain(), np.eye(2), atol=1e-8)


def _closed(g, K):
    """Return references to outputs, written out from the matrices."""
    p = len(g.outputs)
    By, Br = K.B[:, :p], K.B[:, p:]
    # u = C_k x_k, y = C x + D u
    A = np.block([[g.A, g.B @ K.C], [By @ g.C, K.A + By @ g.D @ K.C]])
    B = np.vstack([np.zeros((g.n_states, Br.shape[1])), Br])
    C = np.hstack([g.C, g.D @ K.C])
    return fx.StateSpace(A, B, C, 0, g.dt, outputs=g.outputs)


def test_poles_are_where_they_are_asked_for():
    for seed in range(5):
        rng = np.random.default_rng(seed)
        g, _ = drawn(seed, 0.0)
        asked = np.array([-1 + 2j, -1 - 2j, *-rng.uniform(0.5, 5, 2)])
        found = np.linalg.eigvals(g.A - g.B @ place(g, asked))
        np.testing.assert_allclose(np.sort_complex(found), np.sort_complex(asked), rtol=1e-8)
    hidden = fx.StateSpace(np.diag([-1.0, -2.0]), [[1.0], [0.0]], [[1.0, 1.0]], 0)
    with pytest.raises(fx.FlexplantError, match="an input reaches"):
        place(hidden, [-3.0, -4.0])
    with pytest.raises(fx.FlexplantError, match="conjugate pairs"):
        place(hidden, [-3.0 + 1j, -4.0])


def test_a_flexible_machine_in_si_units():
    """A mode of 0.1 % damping at 300 Hz and gains of 1e-9 m/N beside a rigid-body mode."""
    w = 2 * np.pi * 300.0
    A = np.array([[0, 1, 0, 0], [0, 0, 0, 0], [0, 0, 0, 1], [0, 0, -(w**2), -2e-3 * w]])
    B = np.array([[0, 0.1, 0, 0.1]]).T
    g = fx.StateSpace(A, B, [[1, 0, 1, 0]], 0, units={"u1": "N", "y1": "m"})
    K = lqg(g, Q=1e16 * g.C.T @ g.C, R=[[1.0]], W=B @ B.T * 1e-2, V=[[1e-20]])
    assert fx.loop.report_loops((g, K)).is_stable
    assert fx.synthesis.margins((g, K)).disks[0][1].alpha > 0.05


@pytest.mark.parametrize("unit", [1.0, 1e-9, 1e6])
@pytest.mark.parametrize("rate", [None, 1e4])
def test_an_integral_that_no_constant_input_holds_is_refused_for_that(unit, rate):
    """Displacements of random structures are integrated, their velocities are not, in any unit."""
    rng = np.random.default_rng(5)
    for _ in range(6):
        n = int(rng.integers(1, 5))
        F = rng.standard_normal((n, n))
        stiffness, force = 1e4 * (F @ F.T + np.eye(n)), rng.standard_normal((n, 1))
        A = np.block([[np.zeros((n, n)), np.eye(n)], [-stiffness, -0.1 * np.eye(n)]])
        B, see = np.vstack([np.zeros((n, 1)), force]), rng.standard_normal((1, n))
        C = unit * np.block([[see, np.zeros((1, n))], [np.zeros((1, n)), see]])
        g = fx.StateSpace(A, B, C, 0, outputs=["x", "v"])
        g = fx.lti.discretized(g, rate) if rate else g
        Q, R = np.diag([1.0] * 2 * n + [unit**-2]), [[1.0]]
        assert np.all(np.isfinite(lqi(g, Q=Q, R=R, outputs=["x"]).gain))
        with pytest.raises(AssumptionError, match="v cannot be integrated"):
            lqi(g, Q=Q, R=R, outputs=["v"])
        with pytest.raises(AssumptionError, match="2 outputs are integrated"):
            lqi(g, Q=np.eye(2 * n + 2), R=R)


@pytest.mark.parametrize("room", [fx, fx.lti, fx.synthesis, fx.plot, fx.loop])
def test_names_of_other_tools_lead_here_from_every_room(room):
    """``fx.lti.dlqr`` and ``fx.synthesis.d2c`` are answered as ``fx.dlqr`` is."""
    ours = {
        "dlqr": "synthesis.lqr", "kalman": "lqe", "acker": "synthesis.place", "d2c": "continuous",
        "d2d": "resampled", "gram": "controllability_gramian", "hsvd": "hankel_values",
        "stabsep": "split_stable", "dss": "descriptor", "rlocus": "root_locus", "lqg": "lqg",
        "ultidyn": "UnmodelledDynamics", "musyn": "design_mu", "stepinfo": "step_info",
    }  # fmt: skip
    for theirs, here in ours.items():
        if theirs in dir(room):
            continue
        with pytest.raises(AttributeError, match=rf"flexplant\..*{here}"):
            getattr(room, theirs)

"""Unmodelled dynamics and M-Delta structures, against published truths and brute force."""

from functools import cache

import numpy as np
import pytest
import scipy.linalg as la

import flexplant as fx
from flexplant.errors import AssumptionError, FlexplantWarning, LabelError, ModelError, ShapeError
from flexplant.plant import UnmodelledDynamics
from flexplant.synthesis import (
    FullBlock,
    RepeatedScalar,
    design_mu,
    robust_performance,
    robust_stability,
    uncertain_system,
    worst_case_gain,
)

GAIN = np.array([[87.8, -86.4], [108.2, -109.6]])
W_I = fx.lti.tf([1.0, 0.2], [0.5, 1.0])
W_P = fx.lti.tf([0.5, 0.05], [1.0, 1e-4])


@cache
def column():
    """Skogestad and Postlethwaite's distillation column: 20 % error of each input at rest."""
    A, rows, eye, none = -np.eye(2) / 75, GAIN / 75, np.eye(2), np.zeros((2, 2))
    D = np.block([[eye, none], [eye, none]])
    names = {"inputs": ["d1", "d2", "u1", "u2"], "outputs": ["e1", "e2", "y1", "y2"]}
    g = fx.StateSpace(A, np.hstack([none, eye]), np.vstack([rows, rows]), D, **names)
    plant = fx.StandardPlant.from_statespace(g, u=["u1", "u2"], y=["y1", "y2"])
    return plant.uncertain(UnmodelledDynamics(W_I, at="u1"), UnmodelledDynamics(W_I, at="u2"))


def inverse_based():
    """``0.7 / s G(s)^-1``, the sign of the feedback in it."""
    inverse = np.linalg.inv(GAIN)
    return fx.StateSpace(np.zeros((2, 2)), np.eye(2), -0.7 * inverse, -0.7 * 75 * inverse,
                         inputs=["y1", "y2"], outputs=["u1", "u2"])  # fmt: skip


PERFORMANCE = {"w": ["d1", "d2"], "z": {"e1": W_P, "e2": W_P}}


@pytest.mark.long
def test_the_distillation_column():
    """Their section 8.11.3: 0.53 of stability, 5.77 of performance, a worst weighted S of 45."""
    stable = robust_stability(column(), inverse_based())
    assert stable.upper == pytest.approx(0.53, abs=0.01)
    found = robust_performance(column(), inverse_based(), **PERFORMANCE)
    assert 5.70 < found.lower <= found.upper < 5.83
    worst = worst_case_gain(column(), inverse_based(), **PERFORMANCE)
    assert worst.lower <= worst.upper and worst.lower == pytest.approx(44.93, rel=0.01)


@pytest.mark.long
def test_d_k_iteration_makes_the_column_robust():
    """Their section 8.12.4 ends at 1.02; sampled Deltas, closed by hand, stay below the bound."""
    K = design_mu(column(), **PERFORMANCE, order=2, iterations=2)
    assert K.gamma < 1.1
    rng, s = np.random.default_rng(4), 1j * np.geomspace(1e-3, 1e2, 300)
    law = np.array([K.system.evaluated(one) for one in s])
    w_i, w_p = (s + 0.2) / (0.5 * s + 1), (0.5 * s + 0.05) / (s + 1e-4)
    size, worst = 1.0 / K.gamma, 0.0
    for _ in range(200):
        delta = size * np.exp(2j * np.pi * rng.random((s.size, 2)))
        inputs = np.eye(2) * (1 + w_i[:, None] * delta)[:, None, :]
        G = GAIN / (75 * s + 1)[:, None, None] @ inputs
        S = np.linalg.inv(np.eye(2) - G @ law)
        worst = max(worst, (np.abs(w_p) * np.linalg.norm(S, 2, axis=(1, 2))).max())
    assert 0.8 * K.gamma < worst < K.gamma


def benchmark_problem():
    """Wie and Bernstein: two unit masses, a spring of 1.25 +- 0.75, force here, sensor there."""
    A = np.array([[0, 0, 1, 0], [0, 0, 0, 1], [-1.25, 1.25, 0, 0], [1.25, -1.25, 0, 0]])
    B = np.array([[0, 0, 0, 0], [0, 0, 0, 0], [-0.75, 0, 0, 1], [0.75, 1, 0, 0]])
    C = np.array([[1, -1, 0, 0], [0, 1, 0, 0], [0, 0, 0, 0], [0, 1, 0, 0]])
    D = np.zeros((4, 4))
    D[2, 3] = D[3, 2] = 1.0
    M = fx.StateSpace(
        A, B, C, D, inputs=["dk", "w", "noise", "u"], outputs=["k", "x2", "effort", "y"]
    )
    return uncertain_system(M, [RepeatedScalar(name="k")], u=["u"], y=["y"])


def springs(delta):
    """A of the two masses at a spring."""
    k = 1.25 + 0.75 * delta
    return np.array([[0, 0, 1, 0], [0, 0, 0, 1], [-k, k, 0, 0], [k, -k, 0, 0]])


def observer_law(seed):
    """An LQG law of random weights by SciPy, as a system."""
    rng = np.random.default_rng(seed)
    A, B, C = springs(0.0), np.array([[0], [0], [1.0], [0]]), np.array([[0, 1.0, 0, 0]])
    Q = np.diag(rng.uniform(0.2, 2.0, 4))
    F = B.T @ la.solve_continuous_are(A, B, Q, [[rng.uniform(0.5, 3.0)]])
    L = la.solve_continuous_are(A.T, C.T, Q, [[rng.uniform(0.05, 0.5)]]) @ C.T
    return fx.StateSpace(A - B @ F - L @ C, L, -F, [[0.0]], inputs=["y"], outputs=["u"])


@pytest.mark.long
@pytest.mark.parametrize("seed", range(3))
def test_real_stiffness_of_two_masses(seed):
    """mu of one real number is one over the nearest spring at which a dense A is unstable."""
    K = observer_law(seed)

    B, C = np.array([[0], [0], [1.0], [0]]), np.array([[0, 1.0, 0, 0]])
    sizes = np.linspace(0.0, 3.0, 1501)
    loops = [
        np.block([[springs(delta), B @ K.C], [K.B @ C, K.A]])
        for size in sizes
        for delta in (size, -size)
    ]
    worst = np.linalg.eigvals(np.array(loops)).real.max(axis=1).reshape(-1, 2).max(axis=1)
    nearest = sizes[np.argmax(worst >= 0)]
    found = robust_stability(benchmark_problem(), K)
    assert found.upper == pytest.approx(1 / nearest, rel=0.01)
    if nearest < 1.0:  # sought where the uncertainty holds an unstable machine
        assert found.lower == pytest.approx(1 / nearest, rel=0.01)
        assert abs(found.values["k"]) == pytest.approx(nearest, rel=0.01)


@pytest.mark.long
def test_d_k_of_two_masses_holds_every_spring():
    """Every stiffness from 0.5 to 2 is stable, and the gains from w and noise below the bound."""
    w, z = {"w": 0.1, "noise": 0.02}, {"x2": 0.2, "effort": 0.2}
    K = design_mu(benchmark_problem(), w=w, z=z, iterations=3)
    assert K.gamma < 1.0
    law, s = K.system, 1j * np.geomspace(1e-2, 1e2, 400)
    push, see, zero = np.zeros((4, 2)), np.zeros((2, 4)), np.zeros((1, law.n_states))
    push[3, 0], see[0, 1] = 0.1, 0.2
    B, C = np.array([[0], [0], [1.0], [0]]), np.array([[0, 1.0, 0, 0]])
    into = np.vstack([push + 0.02 * B @ law.D @ [[0, 1]], 0.02 * law.B @ [[0, 1]]])
    out = np.block([[see[:1], zero], [0.2 * law.D @ C, 0.2 * law.C]])
    direct = np.array([[0, 0], [0, 0.2 * 0.02 * law.D[0, 0]]])
    for delta in np.linspace(-1.0, 1.0, 21):
        A = np.block([[springs(delta) + B @ law.D @ C, B @ law.C], [law.B @ C, law.A]])
        assert np.linalg.eigvals(A).real.max() < 0
        found = out @ np.linalg.inv(s[:, None, None] * np.eye(len(A)) - A) @ into + direct
        assert np.linalg.norm(found, 2, axis=(1, 2)).max() <= K.gamma * 1.001


def block(rng, rows, columns, s):
    """A random stable first-order system with its values at s."""
    p = rng.uniform(0.5, 5.0)
    B, C, D = (
        rng.standard_normal((1, columns)),
        rng.standard_normal((rows, 1)),
        np.eye(rows, columns),
    )
    return fx.StateSpace([[-p]], B, C, D), C @ B / (s + p)[:, None, None] + D


@pytest.mark.parametrize("rate", [None, 50.0])
@pytest.mark.parametrize(
    "case", [("u1", "u2"), ("y1",), ("u1", "y2"), ("y2", "y1"), "inverse", "coprime"]
)
def test_every_form_is_what_its_formula_says(case, rate):
    """The plant at a Delta, against products and sums of frequency responses."""
    rng = np.random.default_rng(len(case))
    A = rng.standard_normal((4, 4)) - 3.0 * np.eye(4)
    g = fx.StateSpace(A, rng.standard_normal((4, 2)), rng.standard_normal((2, 4)),
                      np.zeros((2, 2)), inputs=["u1", "u2"], outputs=["y1", "y2"])  # fmt: skip
    if rate:
        g = fx.lti.tustin(g, rate)
    plant = fx.StandardPlant.from_statespace(g, u=g.inputs, y=g.outputs)
    form = case if isinstance(case, str) else None
    at = () if case == "coprime" else ("u1", "u2") if form else case
    uncertain = plant.uncertain(UnmodelledDynamics(W_I, at=at, form=form))
    (own,) = uncertain.delta_blocks
    freq = np.array([0.01, 0.3, 2.0])
    s = 2j * np.pi * freq if not rate else 2j * rate * np.tan(np.pi * freq / rate)
    system, delta = block(rng, own.w, own.z, s)
    w = (s + 0.2) / (0.5 * s + 1)
    G = np.moveaxis(fx.frequency_response(g, freq).data, 2, 0)
    made = fx.frequency_response(uncertain.lft({own.name: 0.1 * system}).Gyu, freq).data
    eye, error = np.eye(2), 0.1 * w[:, None, None] * delta
    if form == "coprime":
        M, N = coprime_factors(g, s, rate)
        wanted = np.linalg.solve(M + error[:, :, 2:], N + error[:, :, :2])
        # the sign of Delta_M is Delta's own
        other = np.linalg.solve(M - error[:, :, 2:], N + error[:, :, :2])
        wanted = min(wanted, other, key=lambda one: abs(np.moveaxis(made, 2, 0) - one).max())
    elif form == "inverse":
        wanted = G @ np.linalg.inv(eye - error)
    elif case == ("u1", "u2"):
        wanted = G @ (eye + error)
    else:
        whole = np.zeros_like(G)
        rows = [int(name[1]) - 1 for name in case if name[0] == "y"]
        if "u1" in case:
            whole[:, rows, 0] = error[:, :, 0]
            wanted = G + whole
        else:
            whole[np.ix_(range(len(s)), rows, rows)] = error
            wanted = (eye + whole) @ G
    assert np.abs(np.moveaxis(made, 2, 0) - wanted).max() < 1e-9 * np.abs(wanted).max()


def coprime_factors(g, s, rate):
    """Normalised left coprime factors by SciPy, of the continuous image of a sampled system."""
    A, B, C, D = g.A, g.B, g.C, g.D
    if rate:  # z = (a + s) / (a - s)
        a, eye = 2 * rate, np.eye(len(A))
        P = np.linalg.inv(A + eye)
        A, B, C, D = (
            a * P @ (A - eye),
            np.sqrt(2 * a) * P @ B,
            np.sqrt(2 * a) * C @ P,
            D - C @ P @ B,
        )
    R = np.eye(2) + D @ D.T
    Y = la.solve_continuous_are(A.T, C.T, B @ B.T, R, s=B @ D.T)
    H, root = (Y @ C.T + B @ D.T) @ np.linalg.inv(R), np.linalg.inv(la.sqrtm(R))
    inner = np.linalg.inv(s[:, None, None] * np.eye(len(A)) - (A - H @ C))
    return root @ (np.eye(2) - C @ inner @ H), root @ (C @ inner @ (B - H @ D) + D)


@pytest.mark.slow
@pytest.mark.parametrize("rate", [None, 2e3])
def test_one_block_is_the_peak_of_the_weighted_loop(rate):
    """mu of one multiplicative block is max |W T|, of a coprime one 1 / b(G, K), by a sweep."""
    plant = fx.testbeds.three_masses(rate=rate) if rate else fx.testbeds.three_masses(rate=None)
    law = -1e3 * fx.lti.tf([0.05, 1.0], [0.002, 1.0])
    law = fx.lti.tustin(law, rate) if rate else law
    law = law.replace(inputs=["y1"], outputs=["u1"])
    freq = np.unique(np.concatenate([np.geomspace(0.1, 900.0, 4000), np.linspace(70, 200, 8000)]))
    z = 2j * np.pi * freq if not rate else 2j * rate * np.tan(np.pi * freq / rate)
    G = fx.frequency_response(plant.Gyu.select(["y1"]), freq).data[0, 0]
    K = fx.frequency_response(law, freq).data[0, 0]
    weighted = np.abs((z + 40.0) / (0.5 * z + 400.0) * K * G / (1 - K * G)).max()
    unc = plant.uncertain(UnmodelledDynamics(fx.lti.tf([1.0, 40.0], [0.5, 400.0]), at="u1"))
    found = robust_stability(unc, law, machines=3)
    assert found.upper == pytest.approx(weighted, rel=0.012)
    assert found.upper >= weighted * (1 - 1e-6)
    if found.lower:  # the worst machine is at the edge, unstable
        with pytest.warns(FlexplantWarning, match="unstable"):
            fx.close_loop(found.machine, law)


@pytest.mark.slow
def test_a_coprime_block_gives_the_ncf_margin():
    """1 / mu of a coprime block of weight one is b(G, K), swept by hand."""
    g = fx.StateSpace(
        [[0, 1], [-1, -0.1]], [[0], [1]], [[1, 0]], [[0]], inputs=["u"], outputs=["y"]
    )
    law = fx.StateSpace([[-3.0]], [[1.0]], [[4.0]], [[-2.0]], inputs=["y"], outputs=["u"])
    plant = fx.StandardPlant.from_statespace(g, u=["u"], y=["y"])
    s = 1j * np.geomspace(1e-2, 1e2, 20000)
    G, K = 1 / (s**2 + 0.1 * s + 1), 4 / (s + 3) - 2
    margin = (np.abs(1 - K * G) / np.sqrt((1 + np.abs(K) ** 2) * (1 + np.abs(G) ** 2))).min()
    found = robust_stability(plant.uncertain(UnmodelledDynamics(1.0, form="coprime")), law)
    assert 1 / found.upper == pytest.approx(margin, rel=0.01)


@pytest.mark.long
def test_dynamics_and_frequencies_together():
    """Machines drawn by hand from the answer never beat the bounds; the worst one is unstable."""
    plant = fx.testbeds.three_masses()
    unc = plant.uncertain(UnmodelledDynamics(0.3, at="u1"), frequency=0.01)
    law = fx.lti.tustin(-1e3 * fx.lti.tf([0.05, 1.0], [0.002, 1.0]), 2e3)
    law = law.replace(inputs=["y1"], outputs=["u1"])
    assert robust_stability(unc, law).is_robust
    gain = worst_case_gain(unc, law, w=["amp"], z=["die:x"])
    assert gain.nominal <= gain.lower <= gain.upper
    for machine in unc.machines.drawn(5, rng=3):
        loop = fx.close_loop(machine, law)
        assert loop.is_stable
        assert fx.hinf_norm(loop.system.select(["die:x"], ["amp"])) <= gain.upper * 1.001


def test_a_closed_structure_needs_no_controller():
    """A matrix of two full blocks: the bound of mu by hand is the root of the product."""
    M = fx.StateSpace([[-1.0]], [[1.0, 0.0, 1.0]], [[0.0], [0.5], [1.0]],
                      [[0, 0.4, 0], [0, 0, 0], [0, 0, 0]],
                      inputs=["a", "b", "w"], outputs=["c", "d", "z"])  # fmt: skip
    unc = uncertain_system(M, [FullBlock(), FullBlock()])
    assert [one.name for one in unc.delta_blocks] == ["delta1", "delta2"]
    found = robust_stability(unc)  # det: 1 - 0.4 * 0.5 / (s + 1), largest at 0 Hz
    assert found.upper == pytest.approx(np.sqrt(0.2), rel=6e-3)
    assert robust_performance(unc, w=["w"], z=["z"]).upper >= 1.0


def test_bad_input_is_refused():
    """The cause is named at the public function."""
    plant = fx.testbeds.three_masses()
    with pytest.raises(ModelError, match="unstable"):
        UnmodelledDynamics(fx.lti.tf([1.0], [1.0, 0.0]), at="u1")
    with pytest.raises(ModelError, match="name the actuators or sensors"):
        UnmodelledDynamics(0.2)
    with pytest.raises(ModelError, match="no `at`"):
        UnmodelledDynamics(0.2, at="u1", form="coprime")
    with pytest.raises(ModelError, match="multiplicative and additive follow"):
        UnmodelledDynamics(0.2, at="u1", form="additive")
    with pytest.raises(LabelError, match="y7"):
        plant.uncertain(UnmodelledDynamics(0.2, at="y7"))
    with pytest.raises(ModelError, match="one side"):
        plant.uncertain(UnmodelledDynamics(0.2, at=["u1", "y1"], form="inverse"))
    with pytest.raises(ModelError, match="twice"):
        plant.uncertain(UnmodelledDynamics(0.2, at="u1"), UnmodelledDynamics(0.3, at="u1"))
    with pytest.raises(ModelError, match="dt"):
        plant.uncertain(UnmodelledDynamics(fx.lti.tustin(W_I, 7.0), at="u1"))
    unc = plant.uncertain(UnmodelledDynamics(0.2, at="u1"))
    with pytest.raises(ShapeError, match="1 outputs and 1 inputs"):
        unc.lft({"u1:dynamics": np.eye(2)})
    with pytest.raises(LabelError, match="no Delta"):
        unc.lft({"dynamics": 1.0})
    M = fx.lti.tf([1.0], [1.0, 1.0])
    with pytest.raises(ModelError, match="blocks"):
        uncertain_system(M, 3)
    with pytest.raises(ModelError, match="first channels of M"):
        uncertain_system(M, [FullBlock(2, 2)])
    with pytest.raises(AssumptionError, match="without any uncertainty"):
        robust_stability(uncertain_system(fx.lti.tf([1.0], [1.0, -1.0]), [FullBlock()]))
    with pytest.raises(ModelError, match="name the channels"):
        robust_performance(column(), inverse_based(), w=[], z=[])


def test_structures_go_through_files(tmp_path):
    """What is uncertain is read back with its blocks."""
    column().save(tmp_path / "column.npz")
    read = fx.load(tmp_path / "column.npz")
    assert [one.name for one in read.delta_blocks] == ["u1:dynamics", "u2:dynamics"]
    own = benchmark_problem()
    own.save(tmp_path / "own.npz")
    assert fx.load(tmp_path / "own.npz").system.outputs == own.system.outputs

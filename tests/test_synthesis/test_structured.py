"""Structured H-infinity: exact gradients, optima known by other theory, several plants, laws."""

import time

import numpy as np
import pytest
import scipy.linalg as la
from test_spill_over import many, small

import oracles_synthesis as oracle
from flexplant.errors import InfeasibleError, LabelError, ModelError, ShapeError
from flexplant.lti import StateSpace, discretized
from flexplant.plant import StandardPlant, reference_errors, stage_weights
from flexplant.synthesis import (
    FixedOrder,
    Lead,
    LowPass,
    Notch,
    ObserverGains,
    Parametrised,
    Pid,
    TunedLaws,
    design_hinf,
    design_loops,
    design_structured,
)
from flexplant.synthesis.preparation import prepared
from flexplant.synthesis.structured.nonsmooth import Pieces, bfgs, decrease_left, downhill, minimax
from flexplant.synthesis.structured.structured_design import _StructureSearch
from flexplant.synthesis.structured.structures import ControllerFamily
from stages import ports, sampled


def named(A, B, C, D, nu, ny, dt=0.0):
    u, y = [f"u{i}" for i in range(nu)], [f"y{i}" for i in range(ny)]
    w = [f"w{i}" for i in range(B.shape[1] - nu)]
    z = [f"z{i}" for i in range(C.shape[0] - ny)]
    P = StateSpace(A, B, C, D, dt, inputs=[*w, *u], outputs=[*z, *y])
    return StandardPlant.from_statespace(P, u=u, y=y)


def coprime(A, B, C):
    """The problem of the normalised coprime factors, and its least gamma of any order."""
    parts, best = oracle.coprime_problem(A, B, C)
    return named(*parts, B.shape[1], C.shape[0]), best


def machine(freq=30.0, rate=500.0, stiff=0.0, sight=0.4):
    """A mass with a mode in a tracking problem: z = [w1 (r - y), w2 u], sampled and late."""
    w = 2 * np.pi * freq
    A = la.block_diag([[0, 1], [-stiff, 0]], [[0, 1], [-(w**2), -0.02 * w]])
    B, C = np.array([[0.0], [1], [0], [1]]), np.array([[1.0, 0, sight, 0]])
    G = StateSpace(A, B, C, [[0.0]])
    G = discretized(G, rate, delay=1) if rate else G
    n, k = G.n_states, 2 * np.pi * 3.0
    # integrator weight on the error, gain on the effort
    lag = np.exp(-0.02 * k / rate) if rate else -0.02 * k
    drive = 0.5 * k / rate if rate else 0.5 * k
    A = np.block([[G.A, np.zeros((n, 1))], [-drive * G.C, np.array([[lag]])]])
    B = np.block([[np.zeros((n, 1)), G.B], [np.array([[drive]]), np.zeros((1, 1))]])
    C = np.block(
        [
            [np.zeros((1, n)), np.ones((1, 1))],
            [np.zeros((1, n + 1))],
            [-0.5 * G.C, np.zeros((1, 1))],
            [G.C, np.zeros((1, 1))],
        ]
    )
    D = np.array([[0.0, 0], [0, 1e-4], [0.5, 0], [-1.0, 0]])
    return named(A, B, C, D, 1, 1, G.dt)


def law(freq=30.0):
    pid = Pid.corners((2 * np.pi * 3.0) ** 2 / 3, integrator=0.3, zero=1.0, pole=9.0)
    return pid * LowPass(25.0) * Notch(freq, 0.1)


def judged(plant, found):
    """The norm of the loop by dense matrices and a sweep; the loop is stable."""
    g, K = plant.system, found.system
    parts = oracle.split(g.A, g.B, g.C, g.D, len(plant.u), len(plant.y))
    loop = oracle.closed_loop(parts, K.A, K.B, K.C, K.D)
    assert oracle.stability(loop[0], g.dt) < 0
    return oracle.brute_norm(*loop, g.dt)


def scaled(theta):
    """A law in parameters as any user would write it: continuous, then by hand to rate 500."""
    return design_loops(machine(), float(theta[0]) * law()).system


STRUCTURES = {
    "static": (lambda: machine(rate=0.0, stiff=90.0), FixedOrder(0)),
    "order 2, sampled": (machine, FixedOrder(2)),
    "laws, sampled": (machine, TunedLaws(law(), free=("p", "i", "d", "pole", "freq", "depth"))),
    "a gain and a lead": (machine, TunedLaws(150.0 * Lead(3.0, 12.0) * LowPass(60.0))),
    "observer, sampled": (machine, ObserverGains()),
    "parametrised": (machine, Parametrised(scaled, [1.0])),
}


def test_gains_of_an_observer_have_derivatives_without_differences():
    """They are those of the controller, also with feedthrough of the plant from u to y."""
    rng = np.random.default_rng(1)
    A, B, C, D = (rng.standard_normal(shape) for shape in ((5, 5), (5, 5), (4, 5), (4, 5)))
    plant = named(A, B, C, np.where([[0], [0], [1], [1]], D, 0.0), 3, 2)
    family = ObserverGains().family(plant, prepared(plant.system, plant.u, plant.y))
    theta = family.first + 0.1 * rng.standard_normal(family.first.size)
    exact = family.jacobian(theta)
    by_differences = ControllerFamily(family.matrices, family.first, 0.1).jacobian(theta)
    np.testing.assert_allclose(exact, by_differences, rtol=0, atol=1e-9 * np.abs(exact).max())
    assert not np.any(exact[:, 5:, 5:])  # no feedthrough, not even in rounding


@pytest.mark.slow
@pytest.mark.parametrize("name", STRUCTURES)
def test_gradients_are_exact(name):
    """Of the norm at its peak and of the least stable pole, in parameters, by differences."""
    make, structure = STRUCTURES[name]
    plant = make()
    p = prepared(plant.system, plant.u, plant.y)
    family = structure.family(plant, p)
    search = _StructureSearch(family, [p], 10_000)
    rng = np.random.default_rng(2)
    theta = family.first + 0.05 * rng.standard_normal(family.first.size)

    if not np.isfinite(search.value(theta)[0]):  # any stabilising parameters
        theta, _ = bfgs(search.stability, theta, enough=-1e-3, steps=200)
    value, _ = search.value(theta)
    pieces = search.pieces(theta)
    top = int(np.argmax(pieces.value))
    assert pieces.value[top] == pytest.approx(value, abs=1e-9)
    for function, slope in (
        (search.value, pieces.gradient[top]),
        (search.stability, search.stability(theta)[1]),
    ):
        size = np.linalg.norm(slope)
        for _ in range(3):
            step = rng.standard_normal(theta.size)
            step *= 1e-5 / np.linalg.norm(step)
            change = (function(theta + step)[0] - function(theta - step)[0]) / 2
            assert change == pytest.approx(slope @ step, rel=2e-4, abs=2e-6 * size * 1e-5 + 1e-13)


@pytest.mark.parametrize("finite", [True, False])
def test_second_derivatives_of_a_gain_are_exact(finite):
    """Of entries, which the loop's matrices are linear fractions of; at a peak and at infinity."""
    A = np.array([[0.0, 1, 0, 0], [-2, -0.1, 1, 0], [0, 0, 0, 1], [1, 0, -2, -0.1]])
    B, C = np.eye(4)[:, [1, 3]], np.eye(4)[[1, 3]]
    parts, _ = oracle.coprime_problem(A, B, C)
    if finite:  # forces to positions: nothing is left at infinity
        seen = np.vstack([np.eye(4)[[0, 2]], C])
        parts = (A, np.hstack([B, B]), seen, np.zeros((4, 4)))
    plant = named(*parts, 2, 2)
    p = prepared(plant.system, plant.u, plant.y)
    family = FixedOrder(0).family(plant, p)
    search = _StructureSearch(family, [p], 10_000)
    rng = np.random.default_rng(4)
    for _ in range(3):
        size = 0.3 if finite else 1.5
        theta = size * (0.2 * rng.standard_normal(4) - np.eye(2).ravel())
        assert np.isfinite(search.value(theta)[0])
        pieces = search.pieces(theta)
        H = pieces.hessian(int(np.argmax(pieces.value)))
        step = rng.standard_normal(4)
        step *= 1e-3 / np.linalg.norm(step)
        near = [search.value(theta + k * step)[0] for k in (-1, 0, 1)]
        # differences of values known to 1e-9
        assert near[0] - 2 * near[1] + near[2] == pytest.approx(step @ H @ step, rel=1e-3, abs=1e-8)


@pytest.mark.slow
def test_the_static_gain_at_a_kink():
    """(1 + k^2) max(1, 1/k^2) is least at k = -1: gamma sqrt(2), where no gradient is small."""
    plant, best = coprime(np.zeros((1, 1)), np.ones((1, 1)), np.ones((1, 1)))
    assert best == pytest.approx(np.sqrt(2.0), rel=1e-12)
    found = design_structured(plant, FixedOrder(0))
    assert found.gamma == pytest.approx(best, rel=1e-4)
    assert found.system.D[0, 0] == pytest.approx(-1.0, rel=1e-3)
    assert found.certificate["decrease left"] < 1e-5
    assert judged(plant, found) == pytest.approx(found.gamma, rel=1e-3)


@pytest.mark.slow
def test_order_n_minus_1_reaches_the_optimum_of_any_order():
    """The double integrator: one state is enough for (4 + 2 sqrt(2))^(1/2)."""
    plant, best = coprime(np.array([[0.0, 1], [0, 0]]), np.array([[0.0], [1]]), np.eye(2)[:1])
    found = design_structured(plant, FixedOrder(1), starts=2)
    assert found.system.n_states == 1
    assert best * (1 - 1e-6) <= found.gamma <= 1.005 * best
    assert judged(plant, found) == pytest.approx(found.gamma, rel=1e-3)


@pytest.mark.slow
def test_a_pattern_keeps_its_zeros_and_an_earlier_design_is_a_start():
    A = np.array([[0.0, 1, 0, 0], [-2, -0.1, 1, 0], [0, 0, 0, 1], [1, 0, -2, -0.1]])
    B, C = np.eye(4)[:, [1, 3]], np.eye(4)[[1, 3]]
    plant, _ = coprime(A, B, C)
    each = design_structured(plant, FixedOrder(pattern=np.eye(2)), starts=2)
    assert each.system.D[0, 1] == each.system.D[1, 0] == 0.0
    every = design_structured(plant, FixedOrder(start=each.system), starts=1)
    assert every.gamma <= each.gamma * (1 + 1e-6)
    again = design_structured(plant, every.structure, starts=1)
    assert again.gamma == pytest.approx(every.gamma, rel=1e-3)
    with pytest.raises(ShapeError, match=r"shape \(2, 2\) of \(u, y\)"):
        design_structured(plant, FixedOrder(pattern=np.ones((1, 2))))


@pytest.mark.long
def test_laws_are_tuned_to_a_local_minimum():
    """PID with roll-off and notch, sampled and late: every draw nearby is worse."""
    plant = machine()
    first = design_loops(plant, law())
    found = design_structured(plant, TunedLaws(law()), starts=2)
    assert found.gamma < 0.75 * judged(plant, first)
    assert judged(plant, found) == pytest.approx(found.gamma, rel=2e-3)
    same = design_loops(plant, found.structure.laws).system
    z = np.exp(0.3j)
    assert same.evaluated(z) == pytest.approx(found.system.evaluated(z), rel=1e-6)
    rng = np.random.default_rng(0)
    radius = found.certificate["radius"]
    assert found.certificate["decrease left"] < 1e-4
    family = found.structure.family(plant, prepared(plant.system, plant.u, plant.y))
    assert not family.allows(family.first + 8.0)  # corners end at half rate
    search = _StructureSearch(family, [prepared(plant.system, plant.u, plant.y)], 10_000)
    for _ in range(40):
        step = rng.standard_normal(family.first.size)
        step *= radius / np.linalg.norm(step)
        near = np.exp(search.value(family.first + step)[0])
        assert near >= found.gamma * (1 - 1e-4)


@pytest.mark.long
def test_one_controller_for_several_machines():
    """Modes at 26 and 36 Hz: one law holds both, a law for one is worse on the other."""
    plants = [machine(26.0), machine(36.0)]
    one = design_structured(plants, TunedLaws(law(30.0)), starts=1)
    norms = [judged(plant, one) for plant in plants]
    assert one.gamma == pytest.approx(max(norms), rel=2e-3)
    assert one.certificate["norm of plant 1"] == pytest.approx(norms[0], rel=2e-3)
    alone = design_structured(plants[0], TunedLaws(law(26.0)), starts=1)
    assert alone.gamma <= one.gamma * (1 + 1e-2)
    g, K = plants[1].system, alone.system
    other = oracle.closed_loop(oracle.split(g.A, g.B, g.C, g.D, 1, 1), K.A, K.B, K.C, K.D)
    unstable = oracle.stability(other[0], g.dt) >= 0
    assert unstable or oracle.brute_norm(*other, g.dt) > 1.05 * one.gamma
    with pytest.raises(ModelError, match="plant 2 has other u, y or rate"):
        design_structured([plants[0], machine(26.0, rate=400.0)], TunedLaws(law()))


@pytest.mark.long
def test_the_stage_with_decoupled_laws_at_two_poi_positions():
    """A stage in SI units, one law for each rigid-body axis; the truncated modes are checked."""
    P = sampled(small(), ports()).replace(evaluation=many())
    weighted = []
    for plant in (P, P.at(poi=(0.2, 0.35, 0.0))):
        errors, weights = reference_errors(plant), stage_weights(plant, 20.0)
        weighted.append(plant.through(errors).weighted(z=weights.z, w=weights.w))
    w = (2 * np.pi * 20.0) ** 2
    start = Pid.corners(w / 4, integrator=2.0, zero=5.0, pole=80.0) * LowPass(160.0)
    structure = TunedLaws(start, free=("p", "i", "d", "freq"))
    found = design_structured(weighted, structure, starts=1, evaluations=120)
    norms = [judged(plant, found) for plant in weighted]
    assert found.gamma == pytest.approx(max(norms), rel=2e-3)
    assert found.certificate["norm of plant 2"] == pytest.approx(norms[1], rel=2e-3)
    assert found.left_out is not None and found.left_out.is_stable
    assert set(found.structure.laws) == {"die:z", "die:rx", "die:ry"}


def test_what_cannot_be_stabilised_says_which_pole():
    """A free mass is not held by position feedback alone; the limit of evaluations holds too."""
    plant, _ = coprime(np.array([[0.0, 1], [0, 0]]), np.array([[0.0], [1]]), np.eye(2)[:1])
    with pytest.raises(InfeasibleError, match=r"best leaves a pole at .* Hz .*a higher order"):
        design_structured(plant, FixedOrder(0), starts=2)
    with pytest.raises(InfeasibleError, match="of 1 starts"):
        design_structured(plant, FixedOrder(0), evaluations=1)
    with pytest.raises(
        ModelError, match=r"got <class .*FixedOrder.*such as synthesis\.TunedLaws\(law\)"
    ):
        design_structured(plant, FixedOrder)
    with pytest.raises(LabelError, match="no number of an element 'gain'"):
        TunedLaws(law(), free=("gain",))
    with pytest.raises(ModelError, match="no number of the laws is free"):
        design_structured(machine(), TunedLaws(LowPass(3.0), free=("ratio",)))


class Planes:
    """max_i (g_i' x + c_i)."""

    def __init__(self, slopes, heights):
        self.slopes, self.heights = np.array(slopes, float), np.array(heights, float)

    def value(self, x):
        values = self.slopes @ x + self.heights
        return float(values.max()), int(np.argmax(values))

    def pieces(self, x):
        values = self.slopes @ x + self.heights
        near = np.flatnonzero(values >= values.max() - 1e-3)
        return self._chosen(x, near)

    def piece(self, x, place):
        return self._chosen(x, [place])

    def _chosen(self, x, which):
        bend = np.zeros((x.size, x.size))
        values = self.slopes[which] @ x + self.heights[which]
        return Pieces(values, self.slopes[which], lambda i: bend)


def test_a_minimum_where_several_pieces_are_equally_high():
    """max(|x1|, 3 |x2 - 1|) + |x1 + x2| and random ones in 6 dimensions: the values by LP."""
    corner = [[1, 0, 0], [-1, 0, 0], [0, 3, -3], [0, -3, 3]]
    rows = [[a + s, b + s, c] for a, b, c in corner for s in (1, -1)]
    cases = [(np.array(rows)[:, :2], np.array(rows)[:, 2])]
    for seed in range(4):
        rng = np.random.default_rng(seed)
        slopes = rng.standard_normal((30, 6))
        cases.append((slopes - slopes.mean(axis=0), rng.standard_normal(30)))
    for slopes, heights in cases:
        function = Planes(slopes, heights)
        start = np.full(slopes.shape[1], 2.0)
        found = minimax(function, start, steps=200)
        from scipy.optimize import linprog

        count = slopes.shape[1]
        exact = linprog(
            [0] * count + [1],
            A_ub=np.hstack([slopes, -np.ones((len(slopes), 1))]),
            b_ub=-heights,
            bounds=[(None, None)] * (count + 1),
        )
        assert found.settled
        assert found.value == pytest.approx(exact.fun, abs=1e-4)
        assert decrease_left(function.pieces(found.x), 1e-3)[1] < 1e-4
        assert decrease_left(function.pieces(start), 1e-3)[1] > 1e-4


def test_downhill_is_the_least_of_the_model():
    triangle = np.array([[1.0, 1.0], [3.0, 1.0], [2.0, 4.0]])
    weights, y = downhill(triangle, np.zeros(3))
    np.testing.assert_allclose(y, [-1.0, -1.0], atol=1e-5)
    np.testing.assert_allclose(weights, [1.0, 0.0, 0.0], atol=1e-5)
    # of (1, 1) at 0 and (3, 1) at -1: t = -y'y - ... by hand, both active: y1 = 0.5, no: one alone
    _, y = downhill(np.array([[2.0, -1.0], [2.0, 3.0]]), np.zeros(2))
    np.testing.assert_allclose(y, [-2.0, 0.0], atol=1e-5)
    # both active: 2 y1 - y2 = 2 y1 + 3 y2 - 2 gives y2 = 0.5, the first with weight (3 + 0.5) / 4
    weights, y = downhill(np.array([[2.0, -1.0], [2.0, 3.0]]), np.array([0.0, -2.0]))
    np.testing.assert_allclose(y, [-2.0, 0.5], atol=1e-5)
    np.testing.assert_allclose(weights, [0.875, 0.125], atol=1e-5)


DIS3 = {  # COMPleib, distillation-like academic model; static feedback of 1.0816 is published
    "A": [[-1, 0, 0, 0, 0, 0], [-1, 1, 1, 0, 0, 0], [1, -2, -1, -1, 1, 1],
          [0, 0, 0, -1, 0, 0], [-8, 1, -1, -1, -2, 0], [4, -0.5, 0.5, 0, 0, -4]],
    "B": [[0, 1, 0, 0], [1, 0, 0, 0], [1, 1, 0, 0], [0, 0, 0, -1], [0, 0, 1, 0], [0, 0, 0, 1]],
}  # fmt: skip


@pytest.mark.long
def test_no_clock_decides_and_the_starts_are_listed(monkeypatch):
    """A clock that runs a million times as fast changes nothing; COMPleib's DIS3 within 2 %."""
    B, C = np.array(DIS3["B"]), np.eye(6)[[1, 2, 4, 5]]
    D = np.zeros((10, 10))
    D[2:6, 6:] = np.eye(4)
    plant = named(DIS3["A"], np.hstack([np.eye(6), B]), np.vstack([np.eye(6), C]), D, 4, 4)
    found = design_structured(plant, FixedOrder(0), starts=4)
    for name in ("perf_counter", "monotonic", "process_time", "time"):
        plain = getattr(time, name)
        monkeypatch.setattr(time, name, lambda plain=plain: 1e6 * plain())
    again = design_structured(plant, FixedOrder(0), starts=4)
    assert again.gamma == found.gamma
    assert found.gamma < 1.02 * 1.0816
    assert list(found.tried) == ["start 1", "start 2", "start 3", "start 4"]
    assert min(found.tried.values()) == pytest.approx(found.gamma, rel=1e-3)


@pytest.mark.slow
def test_a_low_order_comes_near_the_full_one():
    """A free mass with a resonance of 0.1 %, in SI units, on any kernel of OpenBLAS."""
    w = 2 * np.pi * 200.0
    A = [[0, 1, 0, 0], [0, 0, 0, 0], [0, 0, 0, 1], [0, 0, -(w**2), -2e-3 * w]]
    b, c = np.array([[0, 0.1, 0, 0.1]]).T, np.array([[1.0, 0, 0.5, 0]])
    D = np.zeros((3, 3))
    D[1, 2], D[2, 1] = 0.1, 1e-8
    P = StateSpace(A, np.hstack([0.1 * b, 0 * b, b]), np.vstack([1e6 * c, 0 * c, c]), D,
                   inputs=["d", "n", "f"], outputs=["e", "effort", "x"])  # fmt: skip
    full = design_hinf(P, u=["f"], y=["x"])
    found = design_structured(P, FixedOrder(3), u=["f"], y=["x"], starts=1)
    assert full.lower <= found.gamma < 1.02 * full.gamma

"""prepared: norms kept, D12 and D21 normalised, the way back exact, units without influence."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from flexplant.errors import ModelError, SolverError
from flexplant.lti import StateSpace, hinf_norm, lft, tf
from flexplant.plant import mixed_sensitivity
from flexplant.synthesis.hinf.hinf_riccati import regular_controller
from flexplant.synthesis.hinf.singular import lacking, made_regular
from flexplant.synthesis.preparation import prepared
from oracles_synthesis import closed_loop, gains, split, stability

U, Y = ("u1", "u2"), ("y1", "y2")


def plant(seed=1, n=5, dt=0.0, d22=0.0):
    """A random plant with three w, two u, four z, two y; full-rank D12 and D21."""
    rng = np.random.default_rng(seed)
    A = rng.normal(size=(n, n))
    if dt:
        A *= 0.9 / np.max(np.abs(np.linalg.eigvals(A)))
    D = rng.normal(size=(6, 5))
    D[4:, 3:] *= d22
    return StateSpace(
        A,
        rng.normal(size=(n, 5)),
        rng.normal(size=(6, n)),
        D,
        dt,
        inputs=["w1", "w2", "w3", *U],
        outputs=["z1", "z2", "z3", "z4", *Y],
    )


def controller(seed=2, k=3):
    rng = np.random.default_rng(seed)
    shapes = (k, k), (k, 2), (2, k), (2, 2)
    return [0.1 * rng.normal(size=shape) for shape in shapes]


def in_units(g, states, inputs, outputs, time=1.0):
    """The same system in other units: x' = T x, u = U u', y' = Y y, t' = t / time."""
    A = g.A * states[:, None] / states
    B, C = g.B * states[:, None] * inputs, g.C / states * outputs[:, None]
    D = g.D * outputs[:, None] * inputs
    if g.dt:
        return g.replace(A=A, B=B, C=C, D=D, dt=g.dt / time)
    return g.replace(A=A * time, B=B * time, C=C, D=D)


@pytest.mark.parametrize("dt", [0.0, 0.02])
@pytest.mark.parametrize("unit", [1.0, 1e-6])
def test_d12_and_d21_are_normalised_and_d22_is_out(dt, unit):
    ones = np.ones
    g = in_units(plant(dt=dt), ones(5), np.r_[ones(3), unit, 1 / unit], np.r_[ones(5), unit])
    p = prepared(g, U, Y)
    np.testing.assert_allclose(p.D12, np.vstack([np.zeros((2, 2)), np.eye(2)]), atol=1e-12)
    np.testing.assert_allclose(p.D21, np.hstack([np.zeros((2, 1)), np.eye(2)]), atol=1e-12)
    np.testing.assert_array_equal(p.system.D[4:, 3:], 0.0)


@pytest.mark.parametrize("dt", [0.0, 0.02])
@pytest.mark.parametrize("d22", [0.0, 0.7])
def test_the_restored_controller_gives_the_loop_of_the_prepared_problem(dt, d22):
    """Gains of w -> z at mapped frequencies agree, the poles are stable together."""
    g = plant(dt=dt, d22=d22)
    p = prepared(g, U, Y)
    AK, BK, CK, DK = controller()
    there = closed_loop(split(p.system.A, p.system.B, p.system.C, p.system.D, 2, 2), AK, BK, CK, DK)
    K = p.restored(AK, BK, CK, DK)
    assert (K.inputs, K.outputs, K.dt) == (Y, U, dt)
    here = closed_loop(split(g.A, g.B, g.C, g.D, 2, 2), K.A, K.B, K.C, K.D)
    omega = np.geomspace(1e-2, 1e2, 30)
    freq = np.array([p.frequency(w) for w in omega])
    points = np.exp(2j * np.pi * freq * dt) if dt else 2j * np.pi * freq
    np.testing.assert_allclose(gains(*here, points), gains(*there, 1j * omega), rtol=1e-9)
    assert (stability(here[0], dt) < 0) == (stability(there[0], 0.0) < 0)


@pytest.mark.slow
@given(
    exponents=st.lists(st.floats(-9, 9), min_size=10, max_size=10),
    dt=st.sampled_from([0.0, 0.02]),
    seed=st.integers(0, 50),
)
def test_units_of_states_channels_and_time_do_not_matter(exponents, dt, seed):
    """The same scaled controller means the same feedback, whatever the user's units."""
    scale = 10.0 ** np.array(exponents)
    g = plant(seed, dt=dt, d22=0.3)
    inputs, outputs = np.r_[np.ones(3), scale[5:7]], np.r_[np.ones(4), scale[7:9]]
    other = in_units(g, scale[:5], inputs, outputs, scale[9])
    one, two = prepared(g, U, Y), prepared(other, U, Y)
    omega = np.geomspace(1e-2, 1e2, 20)
    pick = slice(0, 4), slice(0, 3)
    for w in omega:  # w -> z is the same up to turns of w and z
        first = np.linalg.svd(one.system.evaluated(1j * w)[pick], compute_uv=False)
        second = np.linalg.svd(two.system.evaluated(1j * w)[pick], compute_uv=False)
        np.testing.assert_allclose(first, second, rtol=1e-6)
    assert one.speed * scale[9] == pytest.approx(two.speed, rel=1e-6)


def test_states_of_any_size_are_balanced():
    g = in_units(plant(), 10.0 ** np.array([9, -9, 4, 0, -6]), np.ones(5), np.ones(6))
    p = prepared(g, U, Y)
    rows = np.linalg.norm(np.hstack([p.A, p.B1, p.B2]), axis=1)
    columns = np.linalg.norm(np.vstack([p.A, p.C1, p.C2]), axis=0)
    assert np.all(rows / columns < 10) and np.all(columns / rows < 10)


@pytest.mark.parametrize("dt", [0.0, 0.05])
def test_measured_in_divides_the_norm(dt):
    p = prepared(plant(3, dt=dt, d22=0.5), U, Y)
    q = p.measured_in(50.0)
    AK, BK, CK, DK = controller(5)
    loops = [
        closed_loop(split(s.A, s.B, s.C, s.D, 2, 2), AK, BK, c, d)
        for s, c, d in ((p.system, CK, DK), (q.system, CK / 50.0, DK / 50.0))
    ]
    points = 1j * np.geomspace(0.01, 100, 20)
    np.testing.assert_allclose(gains(*loops[0], points), 50.0 * gains(*loops[1], points))
    np.testing.assert_array_equal(p.D12, q.D12)
    # the way back is the same: K of p is 50 times the gain of K of q
    one, two = p.restored(AK, BK, CK, DK), q.restored(AK, BK, CK / 50.0, DK / 50.0)
    point = np.exp(0.3j) if dt else 0.3j
    np.testing.assert_allclose(one.evaluated(point), two.evaluated(point))


def test_frequencies_come_back_in_hertz():
    p = prepared(plant(), U, Y)
    assert p.frequency(1.0) == pytest.approx(p.speed / (2 * np.pi))
    q = prepared(plant(dt=0.01), U, Y)
    assert q.frequency(1e12) == pytest.approx(50.0)
    # slow frequencies are not bent
    assert q.frequency(1e-6) == pytest.approx(1e-6 * q.speed / (2 * np.pi))


def test_rank_deficient_directions_are_turned_and_kept():
    g = plant()
    D = g.D.copy()
    D[:4, 4] = 2.0 * D[:4, 3]  # u2 costs what u1 costs
    p = prepared(g.replace(D=D), U, Y)
    sizes = np.linalg.svd(p.D12, compute_uv=False)
    np.testing.assert_allclose(sizes, [1.0, 0.0], atol=1e-9)
    assert np.linalg.matrix_rank(p.u_scale) == 2


def test_what_is_not_felt_stays_in_the_unit_of_the_plant():
    """Efforts of 1e-7 of what the plant does: the rank is missing, the efforts are not lost."""
    g = plant()
    D = g.D.copy()
    D[:4, 3:] *= 1e-7
    p = prepared(g.replace(D=D), U, Y)
    sizes = np.linalg.svd(p.D12, compute_uv=False)
    assert np.all((sizes > 1e-9) & (sizes < 1e-5))
    own = np.linalg.svd(D[:4, 3:] @ p.u_scale, compute_uv=False)
    np.testing.assert_allclose(sizes, own, rtol=1e-9)


@pytest.mark.parametrize("dt", [0.0, 0.1])
def test_static_plants_pass(dt):
    rng = np.random.default_rng(0)
    g = StateSpace([], [], [], rng.normal(size=(3, 3)), dt, inputs=["w1", "w2", "u"])
    p = prepared(g, ("u",), ("y3",))
    K = p.restored(np.zeros((0, 0)), np.zeros((0, 1)), np.zeros((1, 0)), np.array([[0.3]]))
    loop = closed_loop(split(g.A, g.B, g.C, g.D, 1, 1), K.A, K.B, K.C, K.D)
    system = p.system
    inner = closed_loop(
        split(system.A, system.B, system.C, system.D, 1, 1), K.A, K.B, K.C, np.array([[0.3]])
    )
    assert np.linalg.norm(loop[3], 2) == pytest.approx(np.linalg.norm(inner[3], 2))


def test_a_pole_at_minus_one_is_refused():
    g = StateSpace([[-1.0]], [[1, 1]], [[1], [1]], [[0, 1], [1, 0]], 0.1)
    with pytest.raises(ModelError, match="z = -1"):
        prepared(g, ("u2",), ("y2",))


def test_a_loop_that_d22_makes_ill_posed_is_refused():
    p = prepared(plant(d22=1.0), U, Y)
    empty = np.zeros((0, 0)), np.zeros((0, 2)), np.zeros((2, 0))
    with pytest.raises(ModelError, match="accelerometers"):
        p.restored(*empty, -np.linalg.inv(p.D22))


def test_two_hundred_states_take_no_time():
    """Twice the states of a stage, far from balanced, by LAPACK and not by loops."""
    import time

    rng = np.random.default_rng(4)
    g = in_units(plant(6, n=200), 10.0 ** rng.uniform(-6, 6, 200), np.ones(5), np.ones(6))
    start = time.perf_counter()
    p = prepared(g, U, Y)
    assert time.perf_counter() - start < 2.0
    assert p.A.shape == (200, 200)


def test_a_controller_that_rounding_leaves_says_so():
    """Where no smaller gamma is reached, and where less noise and effort cannot be added."""
    p = prepared(plant(), U, Y)
    found = regular_controller(p, lambda scaled, unit: (1e-9, 0.0), None)
    K = found.A, found.B, found.C, found.D
    assert "that of least quadratic cost" in found.notes[0] and len(found.notes) == 1
    loop = lft(p.system, StateSpace(*K, inputs=list(Y), outputs=list(U)))
    assert found.gamma == pytest.approx(hinf_norm(loop), rel=1e-3)
    mixed = mixed_sensitivity(tf([1], [1, 0]), S=tf([0.5, 0.3], [1, 3e-4]))  # no effort in z
    singular, calls = prepared(mixed.system, list(mixed.u), list(mixed.y)), []

    def once(problem):
        calls.append(problem)
        if len(calls) > 1:
            raise SolverError("rounding")
        return regular_controller(problem, lambda scaled, unit: (1.0, 0.0), None)

    notes = made_regular(singular, once, lacking(singular)).notes
    assert any("in rounding no more" in note for note in notes)

"""Similarity, modal blocks, the split into stable part and rest, minimal realisations."""

import numpy as np
import pytest
import scipy.linalg as la
import scipy.sparse as sp
from hypothesis import given
from hypothesis import strategies as st
from scipy.io import loadmat

from flexplant.errors import LabelError, ModelError, ShapeError
from flexplant.lti import (
    StateSpace,
    discretized,
    minimal,
    modal_form,
    parallel,
    series,
    split_stable,
)
from flexplant.lti.equations import balanced_matrix, state_scale
from oracles_lti import sweep
from shared_data import data_file
from systems_lti import machine, system

CD_PLAYER = data_file("norms/CDplayer.mat")
FREQ = np.geomspace(1.0, 4900.0, 120)


def error(a, b, freq=FREQ):
    """Largest difference of two responses, relative to the largest entry at each frequency."""
    first, second = (sweep(g.A, g.B, g.C, g.D, g.dt, freq) for g in (a, b))
    return np.max(np.abs(first - second).max(axis=(0, 1)) / np.abs(second).max(axis=(0, 1)))


def channels(g):
    return g.inputs, g.outputs, g.dt, g.name


def mixed(g, seed=0):
    """The same system in orthogonally mixed states of even size: no structure left."""
    balanced = modal_form(g.replace(blocks=None)).system
    Q = np.linalg.qr(np.random.default_rng(seed).standard_normal((g.n_states,) * 2))[0]
    return balanced.transformed(Q)


@given(st.integers(0, 10_000), st.sampled_from([0.0, 0.1]))
def test_a_similarity_changes_states_only(seed, dt):
    rng = np.random.default_rng(seed)
    g = system(seed, dt=dt)
    T = rng.standard_normal((4, 4)) + 3 * np.eye(4)
    moved = g.transformed(T, states=list("abcd"))
    assert channels(moved) == channels(g)
    assert moved.states == ("a", "b", "c", "d")
    assert error(moved, g, np.linspace(0.1, 4.0, 9)) < 1e-9
    np.testing.assert_allclose(T @ moved.A, g.A @ T, atol=1e-9)
    back = moved.transformed(np.linalg.inv(T), states=g.states)
    np.testing.assert_allclose(back.A, g.A, atol=1e-9)
    assert back.states == g.states


def test_a_similarity_of_units_is_no_singular_one():
    g = machine(0, 2, m=1, p=1)
    d = np.array([1e-12, 1.0, 1e12, 1e3])
    assert error(g.transformed(np.diag(d)), g) < 1e-12
    with pytest.raises(ModelError, match="T is singular"):
        g.transformed(np.ones((4, 4)))
    with pytest.raises(ModelError, match="T is singular"):
        g.transformed(np.diag([1.0, 1.0, 0.0, 1.0]))
    with pytest.raises(ShapeError, match="T must have shape"):
        g.transformed(np.eye(3))
    with pytest.raises(LabelError, match="more than once"):
        g.transformed(np.eye(4), states=list("aabc"))


@pytest.mark.parametrize("delay", [None, 0.0, 1.0])
@pytest.mark.parametrize("rigid", [0, 1, 3])
def test_modal_form_of_a_dense_machine(rigid, delay):
    g = machine(rigid, 10, m=3, p=2)
    g = g if delay is None else discretized(g, 1e4, delay=delay)
    dense = g.replace(blocks=None)
    form = modal_form(dense)
    assert not form.reason
    assert form.condition < 100
    assert set(form.system.blocks) <= {1, 2}
    owner = np.repeat(np.arange(len(form.system.blocks)), form.system.blocks)
    assert not form.system.A[owner[:, None] != owner[None, :]].any()
    assert channels(form.system) == channels(g)
    assert error(form.system, g) < 1e-9
    T = form.transformation
    np.testing.assert_allclose(np.linalg.solve(T, dense.B), form.system.B, rtol=1e-6, atol=1e-9)
    centre = 1.0 if delay is not None else 0.0
    # rigid-body modes lie exactly where they belong
    assert np.count_nonzero(form.system.poles() == centre) == 2 * rigid


def test_modal_form_keeps_what_has_blocks_already():
    g = machine(2, 3)
    assert modal_form(g).system is g
    assert modal_form(g.replace(blocks=None)).system.blocks == (2,) * 5
    static = StateSpace([], [], [], [[1.0]])
    assert modal_form(static).system is static


@given(st.integers(0, 10_000))
def test_modal_form_of_random_systems(seed):
    g = system(seed, n=6)
    form = modal_form(g)
    assert form.residual < 1e-9
    assert error(form.system, g, np.linspace(0.01, 3.0, 9)) < 1e-8
    np.testing.assert_allclose(
        np.sort_complex(form.system.poles()), np.sort_complex(g.poles()), atol=1e-9
    )


def test_a_defective_system_stays_dense_and_says_so():
    chain = StateSpace(
        np.diag([-1.0] * 3) + np.diag([1.0, 1.0], 1), np.eye(3), np.eye(3), np.zeros((3, 3))
    )
    form = modal_form(chain)
    assert form.system is chain
    assert form.reason.startswith("dense form kept: the eigenvectors have condition")
    assert "dense form kept" in repr(form)
    assert modal_form(system(3)).reason == ""
    assert modal_form(system(3), largest_condition=1.0).system.blocks is None
    # neither do two samples of delay have two eigenvectors
    assert modal_form(discretized(machine(1, 2), 1e4, delay=1.5)).reason
    # three integrators in a row are no rigid body
    triple = StateSpace(np.diag([1.0, 1.0], 1), [[0], [0], [1.0]], [[1.0, 0, 0]], [[0.0]])
    assert modal_form(triple).reason
    with pytest.raises(ModelError, match="largest_condition"):
        modal_form(chain, largest_condition=-1.0)
    with pytest.raises(ModelError, match="StateSpace"):
        modal_form("plant")


@pytest.mark.parametrize("count", [4, 5, 6, 7])
def test_chains_of_integrators_stay_dense(count):
    """LAPACK cannot order their poles, which rounding spreads over a circle."""
    chain = np.eye(count, k=-1)
    g = StateSpace(chain, np.ones((count, 1)), np.ones((1, count)), 0.0)
    found = modal_form(g)
    assert found.system is g and found.reason.startswith("dense form kept")


@pytest.mark.parametrize("delay", [None, 1.0])
@pytest.mark.parametrize("dense", [False, True])
def test_split_keeps_rigid_bodies_apart(dense, delay):
    g = machine(3, 10, m=3, p=2)
    g = g.replace(D=np.ones((2, 3))) if delay is None else discretized(g, 1e4, delay=delay)
    given_ = mixed(g) if dense else g
    split = split_stable(given_)
    assert split.rest.n_states == 6
    assert split.stable.is_stable
    assert channels(split.stable) == channels(split.rest) == channels(g)
    assert not split.rest.D.any()
    np.testing.assert_array_equal(split.stable.D, g.D)
    assert error(parallel(split.stable, split.rest), g) < (1e-6 if dense else 1e-10)
    centre = 0.0 if delay is None else 1.0
    assert np.abs(split.rest.poles() - centre).max() < (1e-2 if delay is None else 1e-5)
    if not dense and delay is None:
        assert split.stable.blocks == (2,) * 10
        assert split.separation == 0.0


@given(st.integers(0, 10_000), st.sampled_from([0.0, 0.1]))
def test_split_of_random_systems(seed, dt):
    rng = np.random.default_rng(seed)
    A = rng.standard_normal((6, 6))
    g = StateSpace(A, A[:, :2], A[:3], A[:3, :2], dt)
    split = split_stable(g)
    growth = np.abs(la.eigvals(A)) - 1 if dt else la.eigvals(A).real
    assert split.stable.n_states == np.count_nonzero(growth < 0)
    assert split.stable.is_stable
    if split.rest.n_states:
        worst = split.rest.poles()
        assert np.min(np.abs(worst) - 1 if dt else worst.real) >= 0
    both = parallel(split.stable, split.rest)
    assert error(both, g, np.linspace(0.05, 3.0, 9)) < 1e-7 * (1 + split.separation)


def test_split_of_nothing():
    static = StateSpace([], [], [], [[2.0]])
    split = split_stable(static)
    assert (split.stable.D, split.rest.D) == (2.0, 0.0)
    assert split_stable(system(1)).rest.n_states == 0
    assert repr(split) == "<StableSplit: 0 stable states, 0 others, separation 0.0e+00>"
    with pytest.raises(ModelError, match="StateSpace"):
        split_stable(3 + 1j)


@pytest.mark.slow
@pytest.mark.parametrize("delay", [None, 0.0])
@pytest.mark.parametrize("rigid", [0, 2])
def test_minimal_of_a_system_beside_itself(rigid, delay):
    g = machine(rigid, 12, m=3, p=2)
    g = g if delay is None else discretized(g, 1e4, delay=delay)
    assert minimal(g) is g
    for twice in (parallel(g, g), parallel(g, g).replace(blocks=None)):
        found = minimal(twice)
        assert found.n_states == g.n_states
        assert channels(found) == channels(twice)
        assert error(found, twice) < 1e-6  # double poles of a dense A come out at some 1e-4 rad/s
    assert set(minimal(parallel(g, g)).blocks) == {2}


@given(st.integers(0, 10_000), st.sampled_from([0.0, 0.1]))
def test_minimal_finds_the_hidden_states(seed, dt):
    """Kalman's four parts in mixed states: what is left is reached and seen."""
    rng = np.random.default_rng(seed)
    sizes = rng.integers(0, 3, 4)
    sizes[0] += 1
    owner = np.repeat(np.arange(4), sizes)
    n = owner.size
    A = rng.standard_normal((n, n)) * 0.4 - 0.2 * np.eye(n)
    # parts: reached and seen, reached only, seen only, neither
    reached, seen = np.isin(owner, [0, 1]), np.isin(owner, [0, 2])
    A[np.ix_(~reached, reached)] = 0.0
    A[np.ix_(seen, ~seen)] = 0.0
    B = rng.standard_normal((n, 2)) * reached[:, None]
    C = rng.standard_normal((2, n)) * seen
    Q = np.linalg.qr(rng.standard_normal((n, n)))[0]
    g = StateSpace(
        Q @ A @ Q.T, Q @ B, C @ Q.T, np.ones((2, 2)), dt, inputs=["a", "b"], outputs=["x", "y"]
    )
    found = minimal(g, tol=1e-9)
    assert found.n_states == sizes[0]
    assert channels(found) == channels(g)
    assert error(found, g, np.linspace(0.05, 3.0, 9)) < 1e-6


def test_minimal_does_not_confuse_units_with_smallness():
    g = machine(0, 6, m=2, p=2)
    units = g.replace(B=g.B * [1e-9, 1e3], C=g.C * np.array([[1e9], [1e-6]]))
    assert minimal(units) is units
    # one output in tiny units sees a mode that the other, in metres, does not
    only = g.C.copy()
    only[0, 4], only[1] = 0.0, 0.0
    only[1, 4] = 1e-14
    assert minimal(g.replace(C=only)).n_states == g.n_states
    silent = only.copy()
    silent[1] = 0.0
    assert minimal(g.replace(C=silent)).n_states == g.n_states - 2


def test_minimal_cancels_a_pole_and_a_zero():
    lag = StateSpace([[-2.0]], [[1.0]], [[1.0]], [[0.0]], inputs=["u"], outputs=["y"])
    lead = StateSpace([[-3.0]], [[1.0]], [[-1.0]], [[1.0]])  # (s + 2) / (s + 3)
    found = minimal(series(lag, lead))
    assert found.n_states == 1
    assert found.poles()[0] == pytest.approx(-3.0)
    dead = minimal(StateSpace([[-1.0]], [[0.0]], [[1.0]], [[2.0]]))
    assert (dead.n_states, dead.D.item()) == (0, 2.0)
    for bad in (0.0, 1.0, -1.0):
        with pytest.raises(ModelError, match="tol"):
            minimal(lag, tol=bad)


def masses(*pairs):
    """Equal masses on springs side by side: positions of modes (frequency [Hz], damping)."""
    A, B, C = [], [], []
    for freq, zeta in pairs:
        w = 2 * np.pi * freq
        A.append([[0.0, 1.0], [-(w**2), -2 * zeta * w]])
        B.append([[0.0], [1.0]])
        C.append([[1.0, 0.0]])
    blocks = [2] * len(pairs)
    return StateSpace(la.block_diag(*A), np.vstack(B), np.hstack(C), [[0.0]], blocks=blocks)


WIDE = {
    "suspension": [(0.03, 0.05), (3000.0, 0.01)],
    "pendulum": [(1e-4, 0.05), (1e4, 0.01)],
    "free mass": [(0.0, 0.0), (0.03, 0.05), (100.0, 1e-5), (3000.0, 0.01)],
}


@pytest.mark.slow
@pytest.mark.parametrize(
    ("form", "dt"), [("blocks", 0), ("dense", 0), ("mixed", 0), ("blocks", 2e-5), ("dense", 2e-5)]
)
@pytest.mark.parametrize("pairs", WIDE.values(), ids=WIDE)
def test_minimal_judges_each_mode_at_its_own_frequency(pairs, form, dt):
    """Nine decades of response lie between the modes: all are reached and seen, copies are not."""

    def formed(pairs):
        g = masses(*pairs)
        g = discretized(g, 1.0 / dt) if dt else g
        g = g if form == "blocks" else g.replace(blocks=None)
        return mixed(g) if form == "mixed" and not modal_form(g).reason else g

    g = formed(pairs)
    assert minimal(g) is g
    twice = parallel(g, g)
    found = minimal(twice)
    if form == "mixed" and found.n_states > g.n_states:
        # orthogonally mixed, the rounding of 1e8 is there beside 0.03 at slow modes: with some
        # versions of LAPACK the responses agree to 1e-4 only, and less is taken out
        assert pairs is WIDE["free mass"]
        assert error(found, twice, np.array([101.0, 3030.0])) < 1e-3
        return
    assert found.n_states == g.n_states
    freq = np.array([1.01 * freq for freq, _ in pairs if freq])
    assert error(found, parallel(g, g), freq) < 1e-6
    # what is not reached, and what is not seen, goes, wherever the others are
    for other in (g, formed([(1.3 * freq, zeta) for freq, zeta in pairs])):
        for hidden in (other.replace(B=0 * other.B), other.replace(C=0 * other.C)):
            found = minimal(parallel(g, hidden))
            assert found.n_states == g.n_states
            assert error(found, g, freq) < 1e-6


def test_minimal_keeps_all_modes_of_a_cd_player():
    """120 modes from 0.4 Hz to 7 kHz, light and heavy: the smallest is 1e-9 of the largest."""
    if not CD_PLAYER.exists():
        pytest.skip("example data is not in the repository")
    data = loadmat(CD_PLAYER, spmatrix=False)
    A, B, C = (np.asarray(sp.csc_array(data[k]).todense(), dtype=float) for k in "ABC")
    g = StateSpace(A, B, C, np.zeros((2, 2)))
    assert minimal(g) is g


@pytest.mark.parametrize("freq", [1e-5, 1e-4, 1e-2])
@pytest.mark.parametrize("dt", [0.0, 2e-5])
def test_modal_form_of_a_slow_mode_beside_fast_ones(freq, dt):
    """A slow stable pair is no rigid-body mode, however fast the others."""
    g = masses((freq, 0.05), (1e4, 0.01))
    g = discretized(g, 1.0 / dt) if dt else g
    poles = modal_form(g.replace(blocks=None), largest_condition=1e12).system.poles()
    speed = np.log(poles) / dt if dt else poles
    assert np.sort(np.abs(speed))[:2] == pytest.approx(2 * np.pi * freq, rel=1e-6, abs=0)
    assert np.all(speed.real < 0)


def test_scale_of_a_triangular_matrix_stays_moderate():
    g = machine(0, 40, m=2, p=2)
    g = g.transformed(np.random.default_rng(0).standard_normal((80, 80)))
    A, Z = la.schur(g.A)
    d = state_scale(A, Z.T @ g.B, g.C @ Z)
    # balancing A alone, nothing holds the first states to the last
    alone = la.lapack.dgebal(A, scale=1, permute=0)[3]
    assert np.ptp(np.log2(d)) < 0.6 * np.ptp(np.log2(alone))
    np.testing.assert_array_equal(np.log2(d), np.round(np.log2(d)))
    np.testing.assert_allclose(
        np.sort(la.eigvals(balanced_matrix(A)).imag), np.sort(g.poles().imag), rtol=1e-5
    )


@pytest.mark.parametrize("split", [0.0, 1e-8, 1e-5])
def test_a_double_pole_that_rounding_splits_shares_a_block(split):
    """Apart, its modes would cancel each other in a thousand times what they do together."""
    chain = np.array([[-10.0, 1.0], [-split, -10.0]])
    A = la.block_diag(chain, [[-0.5]], [[-1.0, 40.0], [-40.0, -1.0]])
    T = np.linalg.qr(np.random.default_rng(4).normal(size=A.shape))[0] * np.geomspace(1, 30, 5)
    g = StateSpace(T @ A @ np.linalg.inv(T), T @ np.ones((5, 1)), np.ones((1, 5)), [[0.0]])
    form = modal_form(g)
    assert not form.reason
    assert sorted(form.system.blocks) == [1, 2, 2]
    assert form.condition < 1e3
    size = np.abs(form.system.B[:, 0] * form.system.C[0]).max()
    assert size < 1e3
    assert error(form.system, g, np.array([0.01, 1.0, 6.4])) < 1e-9

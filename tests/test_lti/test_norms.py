"""Norms: closed forms, SLICOT's data and routine, dense sweeps; in SI units and lightly damped."""

import numpy as np
import pytest
import scipy.linalg as la
from hypothesis import given
from hypothesis import strategies as st

from flexplant.errors import ModelError
from flexplant.lti import StateSpace, discretized, h2_norm, hinf_norm, lft, norms, peak_gain, peaks
from flexplant.lti import norms as level_set
from flexplant.lti.peaks import Peaks, exceeding, newton_maxima, proved_peak, residues
from flexplant.parallel import Progress
from oracles_lti import largest_gain, lyapunov, peak_by_search, stein, sweep
from shared_data import data_file
from systems_lti import machine

NORMS = data_file("norms")


def resonance(omega=2e3, zeta=1e-3, scale=1.0):
    return StateSpace([[0, 1], [-(omega**2), -2 * zeta * omega]], [[0], [scale]], [[1, 0]], [[0]])


@pytest.mark.parametrize("zeta", [0.5, 1e-2, 1e-3, 1e-5])
@pytest.mark.parametrize("omega", [1e-2, 1.0, 2e3, 1e6])
@pytest.mark.parametrize("scale", [1e-9, 1.0, 1e9])
def test_single_resonance_in_closed_form(omega, zeta, scale):
    g = resonance(omega, zeta, scale)
    gain, freq = peak_gain(g)
    assert gain == pytest.approx(
        scale / (2 * zeta * np.sqrt(1 - zeta**2) * omega**2), rel=1e-8, abs=0
    )
    assert freq == pytest.approx(omega * np.sqrt(1 - 2 * zeta**2) / (2 * np.pi), rel=1e-4, abs=0)
    assert h2_norm(g) == pytest.approx(scale / np.sqrt(4 * zeta * omega**3), rel=1e-9, abs=0)


@pytest.mark.parametrize(
    ("name", "hinf", "omega", "h2"),
    [("build", 0.0052763338, 5.20608, 0.0045300605), ("CDplayer", 2319821, 22.5682, 1102128.9)],
)
def test_slicot_collection(name, hinf, omega, h2):
    path = NORMS / f"{name}.mat"
    if not path.exists():
        pytest.skip("the SLICOT data are not here")
    import scipy.io

    found = scipy.io.loadmat(path, spmatrix=False)
    A, B, C = (_dense(found[k]) for k in "ABC")
    g = StateSpace(A, B, C, np.zeros((C.shape[0], B.shape[1])))
    gain, freq = peak_gain(g)
    assert gain == pytest.approx(hinf, rel=2e-8 if name == "build" else 3e-7, abs=0)
    assert 2 * np.pi * freq == pytest.approx(omega, rel=2e-6, abs=0)
    assert h2_norm(g) == pytest.approx(h2, rel=5e-8, abs=0)


def _dense(matrix):
    return matrix.toarray() if hasattr(matrix, "toarray") else matrix


def slycot_norm(g):
    slycot = pytest.importorskip("slycot")
    n, m, p = g.n_states, len(g.inputs), len(g.outputs)
    kind = "D" if g.dt else "C"
    parts = (g.A.copy(), np.eye(n), g.B.copy(), g.C.copy(), g.D.copy())
    return slycot.ab13dd(kind, "I", "S", "D", n, m, p, *parts, 1e-10)[0]


@pytest.mark.parametrize("blocks", [True, False])
@pytest.mark.parametrize("zeta", [1e-2, 1e-3])
@pytest.mark.parametrize("delay", [None, 1.0])
def test_machine_in_si_units_equals_slycot(blocks, zeta, delay):
    g = machine(0, 24, zeta=zeta, m=3, p=5)
    g = g if delay is None else discretized(g, 1e4, delay=delay)
    assert hinf_norm(g if blocks else g.replace(blocks=None)) == pytest.approx(
        slycot_norm(g), rel=1e-8
    )


@pytest.mark.slow
@pytest.mark.parametrize("blocks", [True, False])
@pytest.mark.parametrize("zeta", [1e-2, 1e-3])
@pytest.mark.parametrize("sampled", [True, False])
def test_machine_with_many_channels_equals_a_search(blocks, zeta, sampled):
    # SLICOT is no judge here: its sampled norm stops 6e-6 below the peak, at any tolerance
    g = machine(0, 24, zeta=zeta, m=8, p=8)
    g = discretized(g, 1e4) if sampled else g
    truth = peak_by_search(g.A, g.B, g.C, g.D, g.dt)
    found = hinf_norm(g if blocks else g.replace(blocks=None))
    assert found == pytest.approx(truth, rel=1e-8, abs=0)


@pytest.mark.slow
@given(st.integers(0, 10_000))
def test_random_systems(seed):
    rng = np.random.default_rng(seed)
    n, m, p = (int(k) for k in rng.integers(1, 7, 3))
    A = rng.standard_normal((n, n))
    A -= np.eye(n) * (la.eigvals(A).real.max() + 10 ** rng.uniform(-3, 0))
    D = rng.standard_normal((p, m)) * rng.integers(0, 2)
    g = StateSpace(A, rng.standard_normal((n, m)), rng.standard_normal((p, n)), D)
    sampled = g.replace(A=la.expm(A), dt=0.5)
    for sys in (g, sampled):
        gain, freq = peak_gain(sys)
        assert gain == pytest.approx(slycot_norm(sys), rel=1e-7, abs=0)
        grid = (
            np.linspace(0, 1.0, 300)
            if sys.dt
            else np.concatenate([[0], np.geomspace(1e-4, 10, 300)])
        )
        assert largest_gain(sys.A, sys.B, sys.C, sys.D, sys.dt, grid) <= gain * (1 + 1e-8)
        if np.isfinite(freq):
            there = largest_gain(sys.A, sys.B, sys.C, sys.D, sys.dt, np.array([freq]))
            assert there == pytest.approx(gain, rel=1e-9, abs=0)
        else:
            assert gain == pytest.approx(np.linalg.norm(sys.D, 2))
    square = stein(sampled.A, g.B @ g.B.T)
    expected = np.sqrt(np.trace(g.C @ square @ g.C.T) + np.sum(D**2))
    assert h2_norm(sampled) == pytest.approx(expected, rel=1e-8, abs=0)
    expected = np.sqrt(np.trace(g.C @ lyapunov(A, g.B @ g.B.T) @ g.C.T))
    assert h2_norm(g.replace(D=0 * D)) == pytest.approx(expected, rel=1e-8, abs=0)


@pytest.mark.slow
def test_a_peak_between_the_poles_is_found_by_the_level_set():
    # the feedthrough cancels at the resonances and the peak lies elsewhere
    g = machine(0, 6, zeta=1e-2, m=2, p=2)
    g = g.replace(D=np.array([[3e-6, 1e-6], [-2e-6, 2e-6]]))
    grid = np.linspace(0.0, 8000.0, 200_001)
    assert hinf_norm(g) == pytest.approx(slycot_norm(g), rel=1e-8, abs=0)
    found = largest_gain(g.A, g.B, g.C, g.D, 0.0, grid[::20])
    assert found <= hinf_norm(g) * (1 + 1e-9)


@pytest.mark.slow
def test_a_flat_peak_just_above_the_feedthrough_is_found():
    """Near the gain of D the Hamiltonian matrix is nearly singular; a sweep finds 8e-4 more."""
    A = [[-0.307, 1.4, -0.0211, 0], [0.78, 0, -5.72, 0], [31.4, 30.5, -52.5, 0]]
    A = np.array([*A, [-0.0873, 0, 0, -0.0175]])
    B = np.array([[0.0, 0], [0, 0], [106, 0.258], [-0.295, 0]])
    C, D = (
        np.array([[0.074, 0, 0, -4.13], [0.266, 0.258, -0.444, 0]]),
        [[0.25, 0], [0.9014, 0.0022]],
    )
    points = 2j * np.pi * np.geomspace(1e-3, 1.0, 4000)
    wanted = max(np.linalg.norm(C @ np.linalg.solve(s * np.eye(4) - A, B) + D, 2) for s in points)
    found, freq = peak_gain(StateSpace(A, B, C, D))
    assert wanted > 1.0007 * np.linalg.norm(D, 2)
    assert found == pytest.approx(wanted, rel=1e-6)
    assert 0.01 < freq < 0.03


@pytest.mark.slow
def test_a_narrow_peak_of_a_closed_loop_is_found():
    # a loop whose poles differ from the plant's: dense A, one very light mode
    g = machine(0, 8, zeta=1e-4, m=1, p=1, seed=3)
    K = StateSpace([[-1e4]], [[1e4]], [[-1e5]], [[0.0]], inputs=["y1"], outputs=["u"])
    P = StateSpace(
        g.A,
        np.hstack([g.B, g.B]),
        np.vstack([g.C, g.C]),
        np.zeros((2, 2)),
        inputs=["w", "u"],
        outputs=["z", "y1"],
    )
    loop = lft(P, K)
    assert loop.poles().real.max() == pytest.approx(-0.5, rel=1e-2, abs=0)
    gain, freq = peak_gain(loop)
    parts = loop.A, loop.B, loop.C, loop.D, 0.0
    assert largest_gain(*parts, np.array([freq])) == pytest.approx(gain, rel=1e-9, abs=0)
    # SLICOT stops 7e-8 below, so a sweep around each pole is the upper bound
    assert slycot_norm(loop) == pytest.approx(gain, rel=1e-7, abs=0)
    for pole in loop.poles():
        around = np.abs(pole.imag - pole.real * np.linspace(-5, 5, 201)) / (2 * np.pi)
        assert largest_gain(*parts, around) <= gain * (1 + 1e-9)
    assert hinf_norm(loop) < 0.5 * hinf_norm(g)


@pytest.mark.parametrize("start", [0.0, 700.0])
@pytest.mark.parametrize("feedthrough", [0.0, 2e-7])
@pytest.mark.parametrize("delay", [None, 1.0])
def test_the_level_set_alone_finds_the_peak(monkeypatch, start, feedthrough, delay):
    g = machine(0, 12, zeta=1e-2, m=2, p=3)
    g = g.replace(D=feedthrough * np.arange(6.0).reshape(3, 2))
    g = g if delay is None else discretized(g, 1e4, delay=delay)
    expected = hinf_norm(g)

    def poor(g, find, top):
        return largest_gain(g.A, g.B, g.C, g.D, g.dt, np.array([start])), start

    monkeypatch.setattr(level_set, "_swept_peak", poor)
    monkeypatch.setattr(norms, "residues", lambda g: (None, None))
    assert hinf_norm(g) == pytest.approx(expected, rel=1e-8, abs=0)


@pytest.mark.parametrize("delay", [None, 1.0])
@pytest.mark.parametrize("part", [0.02, 0.3, 0.9])
@pytest.mark.slow
def test_crossings_of_a_level_are_where_a_singular_value_equals_it(part, delay):
    g = machine(0, 6, zeta=1e-2, m=2, p=3)
    g = g.replace(D=5e-9 * np.arange(6.0).reshape(3, 2))
    g = g if delay is None else discretized(g, 1e4, delay=delay)
    level = part * hinf_norm(g)

    def values(freq):
        H = np.moveaxis(sweep(g.A, g.B, g.C, g.D, g.dt, freq), 2, 0)
        return np.linalg.svd(H, compute_uv=False)

    crossings = level_set._Level(g).crossings(level)
    np.testing.assert_allclose(np.abs(values(crossings) - level).min(axis=1), 0, atol=1e-6 * level)
    above = values(np.linspace(0.0, 5000.0, 20_001)) > level
    assert np.count_nonzero(above[1:] != above[:-1]) == crossings.size > 0


@pytest.mark.parametrize("seed", range(12))
def test_the_proof_by_intervals_agrees_with_the_level_set(seed):
    """Modes and dense systems, feedthrough, sampled: two ways to the same peak."""
    rng = np.random.default_rng(seed)
    m, p = rng.integers(1, 6, 2)
    if seed % 2:
        A = rng.standard_normal((9, 9))
        A -= np.eye(9) * (la.eigvals(A).real.max() + 0.1)
        g = StateSpace(A, rng.standard_normal((9, m)), rng.standard_normal((p, 9)), np.ones((p, m)))
    else:
        g = machine(0, 9, zeta=10.0 ** -rng.uniform(1, 5), m=m, p=p, seed=seed)
    g = discretized(g, 1.5 * np.abs(g.poles()).max()) if seed % 3 == 0 else g
    model, _ = residues(g)
    gain, omega = proved_peak(model, 1e-9)
    wanted, freq = level_set.level_set_peak(g, 1e-9, Progress(0, "", progress=False))
    assert gain == pytest.approx(wanted, rel=4e-9, abs=0)
    assert norms._proved(g, model) == (pytest.approx(gain, rel=1e-9, abs=0), peak_gain(g)[1])
    # a level below the peak is not proved, wherever the climb begins
    none = Peaks(*np.zeros((3, 0)))
    above = exceeding(model, 0.999 * gain, none)
    freq = np.arctan(above) / (np.pi * g.dt) if g.dt else above / (2 * np.pi)
    assert above.size and largest_gain(g.A, g.B, g.C, g.D, g.dt, freq) >= 0.999 * gain * (1 - 1e-9)
    # what lies around a peak: nothing higher; further away there may be
    omega, height, zone = newton_maxima(model, np.array([omega]), 1e-9)
    around = model.series(omega + zone * np.linspace(-1, 1, 401), 0)[0]
    assert zone > 0 and np.linalg.norm(around, 2, axis=(1, 2)).max() <= height * (1 + 1e-9)


def test_a_flat_gain_is_left_to_the_level_set():
    lag = StateSpace([[-1.0]], [[1.0]], [[-2.0]], [[1.0]])
    assert norms._proved(lag, residues(lag)[0]) is None


def test_repeated_modes_share_their_peak():
    """Two equal resonances in two directions of three, turned; a third one below them."""
    blocks = [np.array([[0, w], [-w, -0.02 * w]]) for w in (1.0, 1.0, 5.0)]
    turn, _ = np.linalg.qr(np.random.default_rng(1).normal(size=(3, 3)))
    B, C = np.eye(6)[:, 1::2] @ turn, turn.T @ np.eye(6)[::2]
    g = StateSpace(la.block_diag(*blocks), B, C, np.zeros((3, 3)), blocks=[2, 2, 2])
    wanted = 1 / (0.02 * np.sqrt(1 - 1e-4))
    for one in (g, g.replace(blocks=None)):
        gain, freq = norms._proved(one, residues(one)[0])
        assert gain == pytest.approx(wanted, rel=2e-9, abs=0)
        assert freq == pytest.approx(np.sqrt(1 - 2e-4) / (2 * np.pi), rel=1e-5, abs=0)


def test_units_scale_the_norm():
    g = machine(0, 10, m=2, p=3)
    assert hinf_norm(g.replace(B=g.B * 2.0**40)) == pytest.approx(
        hinf_norm(g) * 2.0**40, rel=1e-12, abs=0
    )
    d = 2.0 ** np.random.default_rng(0).integers(-20, 20, 20)
    moved = g.replace(A=g.A * d[:, None] / d, B=g.B * d[:, None], C=g.C / d)
    assert hinf_norm(moved) == pytest.approx(hinf_norm(g), rel=1e-9, abs=0)
    assert h2_norm(moved) == pytest.approx(h2_norm(g), rel=1e-9, abs=0)


def test_all_pass_has_norm_one():
    g = StateSpace([[-3.0]], [[1.0]], [[-6.0]], [[1.0]])
    assert hinf_norm(g) == pytest.approx(1.0, rel=1e-8, abs=0)


def test_marginal_and_unstable_systems_are_infinite():
    rigid = machine(3, 2)
    assert peak_gain(rigid) == (np.inf, 0.0)
    assert h2_norm(rigid) == np.inf
    assert hinf_norm(discretized(rigid, 1e4)) == np.inf
    unstable = StateSpace([[0.1, 5.0], [-5.0, 0.1]], np.eye(2), np.eye(2), np.zeros((2, 2)))
    gain, freq = peak_gain(unstable)
    assert gain == np.inf
    assert freq == pytest.approx(5 / (2 * np.pi))


def test_static_gains_and_feedthrough():
    n = np.zeros((0, 0))
    gain = StateSpace(n, np.zeros((0, 2)), np.zeros((1, 0)), [[3.0, 4.0]])
    assert peak_gain(gain) == (5.0, 0.0)
    assert h2_norm(gain) == np.inf
    assert h2_norm(gain.replace(dt=0.1)) == 5.0
    assert h2_norm(StateSpace([[-1.0]], [[1.0]], [[1.0]], [[1.0]])) == np.inf
    silent = StateSpace([[-1.0]], [[0.0]], [[1.0]], [[0.0]])
    assert (hinf_norm(silent), h2_norm(silent)) == (0.0, 0.0)
    highpass = StateSpace([[-1.0]], [[1.0]], [[-1.0]], [[1.0]])
    assert peak_gain(highpass) == (pytest.approx(1.0, rel=1e-8, abs=0), np.inf)


@pytest.mark.parametrize("norm", [hinf_norm, h2_norm, peak_gain])
def test_bad_input(norm):
    with pytest.raises(ModelError, match="StateSpace"):
        norm("plant")


@pytest.mark.parametrize("zeta", [1e-3, 1e-6, 1e-9, 1e-12])
def test_the_accuracy_that_is_claimed_at_light_damping(zeta):
    """Modes at 1 and 40 rad/s, the first one alone seen: |H| = 1 / (2 zeta (1 - zeta^2)^(1/2))."""
    block = [np.array([[0, w], [-w, -2 * zeta * w]]) for w in (1.0, 40.0)]
    A = la.block_diag(*block)
    B, C = np.array([[0.0], [1], [0], [1]]), np.array([[1.0, 0, 0, 0]])
    exact = 1.0 / (2.0 * zeta * np.sqrt(1.0 - zeta**2))
    inblocks = StateSpace(A, B, C, [[0.0]], blocks=(2, 2))
    assert hinf_norm(inblocks) == pytest.approx(exact, rel=1e-8)
    T = np.array([[1.0, 2, 0, 1], [0, 1, 1, 0], [1, 0, 1, 2], [0, 1, 0, 2]])
    dense = StateSpace(T @ A @ la.inv(T), T @ B, C @ la.inv(T), [[0.0]])
    claimed = max(1e-8, np.finfo(float).eps * np.linalg.norm(dense.A) / zeta)
    if claimed < 0.1:
        assert hinf_norm(dense) == pytest.approx(exact, rel=claimed)


def test_no_interval_is_passed_in_which_the_gain_is_above_the_level():
    """As wide as intervals are examined, where the rest of the series decides."""
    rng = np.random.default_rng(0)
    for _ in range(40):
        omega, zeta = rng.uniform(1.0, 10.0), 10.0 ** rng.uniform(-3.0, -0.5)
        model, _ = residues(resonance(omega, zeta, 1.0))
        centre = rng.uniform(0.0, 15.0, 1)
        radius = peaks.NEAR * model.nearest(centre)
        inside = centre + radius * np.linspace(-1.0, 1.0, 401)
        most = np.abs(model.series(inside, 0)[0]).max()
        given = model, centre, radius, model.apart(centre)
        assert not peaks._examined(*given, 0.999 * most)[1].any()
        assert peaks._examined(*given, 1e3 * most)[1].all()

"""The default call of design_hinf: units, rounding and methods that fail are not the caller's."""

import re
import time

import numpy as np
import pytest
import scipy.signal

import oracles_synthesis as oracle
from flexplant.errors import AssumptionError, CertificateError, InfeasibleError, SolverError
from flexplant.lti import StateSpace
from flexplant.synthesis import Riccati, design_hinf


def structure(seed, w=1, u=1, z=1, y=1, noise=0.0, effort=0.0, modes=3):
    """Modes of 0.3 % damping between 10 and 100 Hz: A, B, C, D in [N] and [m], w forces.

    Noise and effort are given in what the plant itself does on the channel, z and y in w.
    """
    rng = np.random.default_rng(seed)
    omega = 2 * np.pi * np.geomspace(10.0, 100.0, modes)
    A = np.block(
        [[np.zeros((modes, modes)), np.eye(modes)], [-np.diag(omega**2), -np.diag(6e-3 * omega)]]
    )
    efforts, noises = u * bool(effort), y * bool(noise)
    B = np.zeros((2 * modes, w + noises + u))
    C = np.zeros((z + efforts + y, 2 * modes))
    forces, motions = rng.normal(size=(modes, w + u)), rng.normal(size=(z + y, modes))
    B[modes:] = np.insert(forces, [w] * noises, 0.0, axis=1)
    C[:, :modes] = np.insert(motions, [z] * efforts, 0.0, axis=0)
    D = np.zeros((C.shape[0], B.shape[1]))
    size = np.abs(C @ np.linalg.solve(200.0 * np.exp(0.25j * np.pi) * np.eye(2 * modes) - A, B))
    if effort:
        D[z : z + u, -u:] = effort * size[:z, -u:].max() * np.eye(u)
    if noise:
        D[-y:, w : w + y] = noise * size[-y:, :w].max() * np.eye(y)
    return A, B, C, D


def solved(A, B, C, D, u=1, y=1, dt=0.0):
    """The design, its loop judged from dense matrices."""
    names = [f"u{i}" for i in range(u)], [f"y{i}" for i in range(y)]
    P = StateSpace(
        A,
        B,
        C,
        D,
        dt,
        inputs=[*(f"w{i}" for i in range(B.shape[1] - u)), *names[0]],
        outputs=[*(f"z{i}" for i in range(C.shape[0] - y)), *names[1]],
    )
    found = design_hinf(P, u=names[0], y=names[1])
    K = found.system
    loop = oracle.closed_loop(oracle.split(A, B, C, D, u, y), K.A, K.B, K.C, K.D)
    assert oracle.stability(loop[0], dt) < 0
    assert oracle.brute_norm(*loop, dt) == pytest.approx(found.gamma, rel=2e-3, abs=0)
    return found


@pytest.mark.slow
@pytest.mark.parametrize("noise", [0.0, 1e-2])
def test_the_rounding_of_tustin_gives_no_rank(noise):
    """It keeps norms, so gamma; its D12 and D21 at half the rate are zero but for rounding."""
    plant = structure(5, w=2, noise=noise)
    best = solved(*plant)
    A, B, C, D, dt = scipy.signal.cont2discrete(plant, 1e-3, method="bilinear")
    at_half_the_rate = C @ np.linalg.solve(-np.eye(A.shape[0]) - A, B) + D
    assert 0 < abs(at_half_the_rate[0, -1]) < 1e-10 * best.gamma
    found = solved(A, B, C, D, dt=dt)
    assert found.gamma == pytest.approx(best.gamma, rel=1e-2, abs=0)
    assert found.notes[0].startswith("D12 has rank 0 of 1")
    assert ("D21 has rank 0 of 1" in found.notes[0]) == (not noise)


@pytest.mark.slow
@pytest.mark.parametrize("seed", range(4))
def test_singular_structures_sampled_with_a_hold_are_served(seed):
    plant = structure(seed, w=2, z=2, modes=4)
    A, B, C, D, dt = scipy.signal.cont2discrete(plant, 2e-4, method="zoh")
    found, best = solved(A, B, C, D, dt=dt), solved(*plant)
    # the hold is a small delay
    assert best.lower * 0.99 <= found.gamma <= 1.1 * best.gamma


@pytest.mark.slow
def test_d12_and_d21_of_rounding_are_zero():
    A, B, C, D = structure(5, w=2)
    best = solved(A, B, C, D).gamma
    for size in (1e-17, 1e-14):
        dirty = D.copy()
        dirty[:1, 2:] = dirty[1:, :1] = size * best
        assert solved(A, B, C, dirty).gamma == pytest.approx(best, rel=1e-6, abs=0)


@pytest.mark.slow
@pytest.mark.parametrize("tiny", [1e-6, 1e-8, 1e-10, 1e-12])
def test_tiny_efforts_and_noises_beside_ordinary_ones(tiny):
    """Gamma is between that of no effort and of a larger one, and the same within the back-off."""
    A, B, C, D = structure(1, w=2, u=2, z=2, y=2, noise=1e-2, effort=1e-2)
    small = D.copy()
    small[3] *= tiny
    small[-1] *= tiny
    free = D.copy()
    free[3] = free[-1] = 0.0
    found, best = solved(A, B, C, small, 2, 2), solved(A, B, C, free, 2, 2)
    assert best.lower * (1 - 1e-3) <= found.gamma <= 1.03 * best.gamma
    assert found.gamma <= 1.08 * found.lower


@pytest.mark.slow
def test_units_of_u_and_y_change_nothing():
    A, B, C, D = structure(2, w=2, u=2, z=2, y=2, noise=1e-2, effort=1e-2)
    best = solved(A, B, C, D, 2, 2).gamma
    columns, rows = np.ones(B.shape[1]), np.ones(C.shape[0])
    columns[-2:], rows[-2:] = (1e-9, 1e3), (1e3, 1e-9)
    D = rows[:, None] * D * columns
    found = solved(A, B * columns, rows[:, None] * C, D, 2, 2)
    assert found.gamma == pytest.approx(best, rel=1e-6, abs=0)


@pytest.mark.slow
def test_motions_in_nanometres_beside_efforts_in_kilonewtons():
    """z is what it is, 1e-9 beside 1e3: gamma is that of the large channels."""
    A, B, C, D = structure(3, w=2, z=2, effort=1e-2, noise=1e-2)
    alone = solved(A, B, np.delete(C, 0, axis=0), np.delete(D, 0, axis=0))
    rows = np.array([1e-12, 1.0, 1.0, 1.0])
    found = solved(A, B, rows[:, None] * C, rows[:, None] * D)
    assert found.gamma == pytest.approx(alone.gamma, rel=1e-2, abs=0)


def test_what_fails_raises(monkeypatch):
    """There is one path: no other controller stands in for the one that was not found."""
    plant = structure(5, w=2)
    plain = Riccati.solve

    def promising(self, problem):
        found = plain(self, problem)
        return found._replace(gamma=0.98 * found.gamma)

    monkeypatch.setattr(Riccati, "solve", promising)
    with pytest.raises(CertificateError, match=r"was claimed: the controller is refused"):
        solved(*plant)

    def failing(self, *problem):
        raise SolverError("these equations were not solved.")

    monkeypatch.setattr(Riccati, "_searched", failing)
    monkeypatch.setattr(Riccati, "solve", plain)
    with pytest.raises(SolverError, match=r"^these equations were not solved\.$"):
        solved(*plant)


def oscillator():
    """A mode at 1 rad/s: w force and noise, z position and effort, u force, y position."""
    A, force, position = [[0.0, 1], [-1, -0.02]], [[0.0], [1]], [[1.0, 0]]
    B = np.hstack([force, np.zeros((2, 1)), force])
    C = np.vstack([position, np.zeros((1, 2)), position])
    return np.array(A), B, C, np.array([[0, 0, 0], [0, 0, 1.0], [0, 1.0, 0]])


def unseen(side):
    """An undamped mode at 3 rad/s that y does not see, or u does not reach, beside the other."""
    A, B, C, D = oscillator()
    A = np.block([[A, np.zeros((2, 2))], [np.zeros((2, 2)), np.array([[0.0, 3], [-3, 0]])]])
    B, C = np.vstack([B, [[0, 0, 0], [1, 0, 1]]]), np.hstack([C, [[1.0, 0], [0, 0], [1, 0]]])
    if side == "y":
        C[2, 2] = 0.0
    else:
        B[3, 2] = 0.0
    return A, B, C, D


def without(which):
    """The oscillator without effort in z (a column of D12), or noise in w (a row of D21)."""
    A, B, C, D = oscillator()
    D[(1, 2) if which == "effort" else (2, 1)] = 0.0
    return A, B, C, D


def zero_on_axis(side):
    """``u -> z = (s^2 + 9) / (s + 1)^2``, or ``w -> y``, D12 (D21) of full rank."""
    A, b, c = np.array([[0.0, 1], [-1, -2]]), np.array([[0.0], [1]]), np.array([[8.0, -2]])
    B, C = np.hstack([b, 0 * b, b]), np.vstack([c, [[1.0, 0]]])
    D = np.array([[0, 0, 1.0], [0, 0.1, 0]])
    if side == "z":
        return A, B, C, D
    return A.T, C.T, B.T, D.T


def delayed(samples):
    """A mode that grows e-fold in a second, u delayed by samples of one second."""
    n = samples + 1
    A, B, C = np.eye(n, k=1), np.zeros((n, 3)), np.zeros((3, n))
    A[0, 0], B[0, 0], B[-1, 2], C[0, 0], C[2, 0] = np.e, 1.0, 1.0, 1.0, 1.0
    D = np.zeros((3, 3))
    D[1, 2] = D[2, 1] = 1.0
    return A, B, C, D


def cancelled(gap):
    """An unstable pole at 1 with a zero of u -> y beside it: gamma grows as 1 / gap."""
    _, B, C, D = oscillator()
    C[[0, 2]] = [-1.0 - gap, 1.0]
    return np.array([[0.0, 1], [1, 0]]), B, C, D


def collocated():
    A, B, C, D = structure(0)
    B[:, 1], C[:, : A.shape[0] // 2] = B[:, 0], B[A.shape[0] // 2 :, 0]
    return A, B, C, D


def growing(states=6):
    rng = np.random.default_rng(4006)
    A = rng.normal(size=(states, states))
    A += (100.0 - np.max(np.linalg.eigvals(A).real)) * np.eye(states)
    D = np.zeros((3, 3))
    return A, rng.normal(size=(states, 3)), rng.normal(size=(3, states)), D


#: problem, sampling time, what the message has to say: assumption, channel, where, cure
FAILURES = {
    "an undetectable mode": (
        unseen("y"),
        0.0,
        [r"y \(y0\) does not see a mode .* not stable", r"at 0\.477 Hz", "Add or move .* a sensor"],
    ),
    "an unstabilisable mode": (
        unseen("u"),
        0.0,
        [
            r"u \(u0\) does not reach a mode .* not stable",
            r"at 0\.477 Hz",
            "Add or move an actuator",
        ],
    ),
    "a delay too long": (
        delayed(25),
        1.0,
        [
            r"the delay of 25 s between u \(u0\) and y \(y0\)",
            r"7\.2e\+10 times",
            "Shorten the delay",
        ],
    ),
    "an infimum beyond all gains": (
        cancelled(1e-9),
        0.0,
        [
            r"1 unstable pole\(s\), growing e-fold in 1 s",
            r"u \(u0\) and y \(y0\)",
            "move zeros away",
        ],
    ),
    "poles that no gain holds in rounding": (
        growing(),
        0.0,
        [
            r"6 unstable pole\(s\), growing e-fold in 0\.01 s",
            r"u \(u0\)",
            "Add actuators and sensors",
        ],
    ),
    "an infimum of zero": (
        collocated(),
        0.0,
        [
            r"gamma has no minimum: the infimum is 0",
            r"u \(u0\) cancels w",
            "Weight the efforts in z and",
        ],
    ),
}


@pytest.mark.slow
@pytest.mark.parametrize("case", FAILURES)
def test_each_failure_names_assumption_channel_place_and_cure_at_once(case):
    plant, dt, words = FAILURES[case]
    start = time.perf_counter()
    with pytest.raises((AssumptionError, InfeasibleError, SolverError)) as caught:
        solved(*plant, dt=dt)
    assert time.perf_counter() - start < 5.0
    for word in words:
        assert re.search(word, str(caught.value)), str(caught.value)


#: problem, and what the note of its design says: what is lacking, where, and the cure
NOTES = {
    "a column of D12 zero": (
        without("effort"),
        ["^D12 has rank 0 of 1", "u0 costs nothing in z at high"],
    ),
    "a row of D21 zero": (
        without("noise"),
        ["^D21 has rank 0 of 1", "y0 shows no noise of w at high"],
    ),
    "z has a zero on the axis": (
        zero_on_axis("z"),
        [r"^z does not feel all that u moves at 0\.477 Hz", "u -> z .* zero", "Keep that motion"],
    ),
    "w has a zero on the axis": (
        zero_on_axis("w"),
        [r"^w does not excite all that y sees at 0\.477 Hz", "w -> y .* zero", "Add a disturbance"],
    ),
}


@pytest.mark.slow
@pytest.mark.parametrize("case", NOTES)
def test_what_is_lacking_is_added_with_a_note(case):
    plant, words = NOTES[case]
    found = solved(*plant)
    assert found.certificate["added noise"] <= 1e-3
    for word in words:
        assert re.search(word, " ".join(found.notes)), found.notes

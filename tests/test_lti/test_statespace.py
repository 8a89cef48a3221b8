"""The labelled system: names, blocks, poles, round trips, and what it refuses."""

import pickle

import numpy as np
import pytest
import scipy.linalg as la
from hypothesis import given
from hypothesis import strategies as st

from flexplant import load
from flexplant.errors import LabelError, ModelError, ShapeError
from flexplant.lti import StateSpace, as_statespace
from oracles_lti import gain_at
from systems_lti import machine, same, system


@pytest.mark.parametrize("dt", [0.0, 1e-4])
def test_round_trip_through_control_keeps_names(dt):
    g = system(dt=dt)
    twin = g.to_control()
    assert list(twin.input_labels) == list(g.inputs)
    same(StateSpace.from_control(twin), g)
    same(as_statespace(twin), g)


def test_control_system_without_stated_time_is_refused():
    import control

    for dt in (None, True):
        with pytest.raises(ModelError, match="sampling time"):
            StateSpace.from_control(control.ss([[0.5]], [[1]], [[1]], [[0]], dt))


def test_pickle_and_save(tmp_path):
    g = StateSpace(
        np.diag([-1.0, -2.0]), np.eye(2), np.eye(2), np.eye(2), blocks=[1, 1], inputs=("a", "b")
    )
    g.save(tmp_path / "g.npz")
    for again in (pickle.loads(pickle.dumps(g)), load(tmp_path / "g.npz")):
        same(again, g)
        assert tuple(again.blocks) == (1, 1)
        with pytest.raises(ValueError, match="read-only"):
            again.A[0, 0] = 1.0


def test_arrays_are_copies():
    A = -np.eye(2)
    g = StateSpace(A, np.eye(2), np.eye(2), np.zeros((2, 2)))
    A[0, 0] = 5.0
    assert g.A[0, 0] == -1.0


def test_selection_by_name():
    g = system()
    part = g[["out1"], ["in2", "in0"]]
    assert (part.inputs, part.outputs) == (("in2", "in0"), ("out1",))
    np.testing.assert_array_equal(part.D, g.D[1:2, [2, 0]])
    np.testing.assert_array_equal(part.B, g.B[:, [2, 0]])
    np.testing.assert_array_equal(g["out0", "in1"].C, g.C[:1])
    same(g.select(), g)
    with pytest.raises(LabelError, match=r"no output 'out9'.*Close matches"):
        g["out9", "in0"]
    with pytest.raises(LabelError, match="no input"):
        g.select(inputs=["nothing"])


def test_renaming():
    g = system().renamed(inputs={"in1": "force"}, outputs={"out0": "die:z"})
    assert g.inputs == ("in0", "force", "in2")
    assert g.outputs == ("die:z", "out1")
    with pytest.raises(LabelError, match="no input 'x'"):
        g.renamed(inputs={"x": "y"})
    with pytest.raises(LabelError, match="more than once"):
        g.renamed(inputs={"in0": "force"})


@given(st.integers(0, 10_000))
def test_block_poles_are_the_eigenvalues(seed):
    rng = np.random.default_rng(seed)
    sizes = rng.integers(1, 4, rng.integers(1, 6))
    owner = np.repeat(np.arange(sizes.size), sizes)
    A = rng.standard_normal((owner.size, owner.size)) * (owner[:, None] <= owner[None, :])
    g = StateSpace(A, A[:, :1], A[:1], np.zeros((1, 1)), blocks=sizes)
    found = g.poles()
    for pole in la.eigvals(A):
        nearest = np.argmin(np.abs(found - pole))
        assert abs(found[nearest] - pole) < 1e-5 * (1 + abs(pole))
        found[nearest] = np.inf


def test_poles_of_a_rigid_body_are_exactly_zero_or_one():
    rigid = StateSpace([[0, 2e3], [0, 0]], [[0], [1]], [[1, 0]], [[0]], blocks=[2])
    assert not rigid.poles().any()
    assert not rigid.is_stable
    sampled = StateSpace([[1, 1e-4], [0, 1]], [[0], [1]], [[1, 0]], [[0]], 1e-4, blocks=[2])
    np.testing.assert_array_equal(sampled.poles(), [1.0, 1.0])
    assert not sampled.is_stable


def test_stability():
    assert StateSpace([[-1e-9]], [[1]], [[1]], [[0]]).is_stable
    assert not StateSpace([[0.5]], [[1]], [[1]], [[0]]).is_stable
    assert StateSpace([[0.5]], [[1]], [[1]], [[0]], 0.1).is_stable
    assert not StateSpace([[-1.0]], [[1]], [[1]], [[0]], 0.1).is_stable
    assert as_statespace(np.eye(2)).is_stable


def test_evaluated_and_static_gain():
    g = system()
    np.testing.assert_allclose(g.evaluated(1 + 2j), gain_at(g.A, g.B, g.C, g.D, 1 + 2j), rtol=1e-14)
    gain = as_statespace([[1.0, 2.0]])
    np.testing.assert_array_equal(gain.evaluated(3j), [[1.0, 2.0]])
    assert (gain.n_states, gain.inputs) == (0, ("u1", "u2"))


def test_repr_is_one_short_line():
    assert repr(system()) == "<StateSpace 'sys': 4 states, continuous, in0, in1, in2 -> out0, out1>"
    assert repr(system(m=9, dt=1e-4)).endswith("dt 0.0001 s, in0, ... in8 (9) -> out0, out1>")


GOOD = {"A": -np.eye(2), "B": np.ones((2, 1)), "C": np.ones((1, 2)), "D": np.zeros((1, 1))}


@pytest.mark.parametrize(
    ("change", "error", "message"),
    [
        ({"A": np.ones((2, 3))}, ShapeError, "A must have shape"),
        ({"B": np.ones((3, 1))}, ShapeError, "B must have shape"),
        ({"C": np.ones((1, 3))}, ShapeError, "C must have shape"),
        ({"D": np.zeros(1)}, ShapeError, "D must be a matrix"),
        ({"A": np.array([[0, np.nan], [0, 0]])}, ModelError, r"NaN.*\(0, 1\)"),
        ({"A": 1j * np.eye(2)}, ModelError, "real"),
        ({"A": [["a", "b"], ["c", "d"]]}, ModelError, "numbers"),
        ({"dt": -1.0}, ModelError, "positive"),
        ({"inputs": ["a", "b"]}, ShapeError, "1 inputs need 1 names"),
        ({"inputs": ["a.b"]}, LabelError, "cannot name"),
        ({"outputs": ["-a"]}, LabelError, "cannot name"),
        ({"states": ["x", "x"]}, LabelError, "more than once"),
        ({"blocks": [1]}, ShapeError, "add up to 2"),
        ({"blocks": [2, 0]}, ShapeError, "positive"),
        ({"A": np.ones((2, 2)), "blocks": [1, 1]}, ShapeError, "not block upper triangular"),
    ],
)
def test_bad_input(change, error, message):
    with pytest.raises(error, match=message):
        StateSpace(**(GOOD | change))


def test_a_static_gain_of_nothing_is_refused():
    with pytest.raises(ShapeError, match="rows and columns"):
        as_statespace([])


def triangular_system(rng, channels):
    """A block upper triangular system of random blocks, with an invertible D."""
    sizes = rng.integers(1, 3, rng.integers(1, 5))
    n = sizes.sum()
    owner = np.repeat(np.arange(sizes.size), sizes)
    A = rng.standard_normal((n, n)) * (owner[:, None] <= owner)
    B, C = rng.standard_normal((n, channels)), rng.standard_normal((channels, n))
    D = rng.standard_normal((channels, channels)) + 3 * np.eye(channels)
    return StateSpace(A, B, C, D, float(rng.choice([0.0, 0.1])), blocks=sizes)


@pytest.mark.parametrize("channels", [1, 2, 3])
def test_inverses_of_systems_with_blocks(channels):
    """1 / (1 + L), 1 / L: any number of blocks and channels, continuous and sampled."""
    for seed in range(60):
        rng = np.random.default_rng(seed)
        L = triangular_system(rng, channels)
        eye = np.eye(channels)
        for found, direct in ((1 / L, 0 * eye), (2.0 / (eye + L), eye)):
            for s in (0.3 + 2j, -1.7 + 0.4j):
                gain = gain_at(L.A, L.B, L.C, L.D, s) + direct
                scale = 1.0 if not direct.any() else 2.0
                answer = np.asarray(found(s)).reshape(channels, channels)
                np.testing.assert_allclose(answer @ gain, scale * eye, atol=1e-9)
        np.testing.assert_allclose(
            np.sort_complex(found.poles()),
            np.sort_complex(la.eigvals(L.A - L.B @ np.linalg.solve(L.D + eye, L.C))),
            atol=1e-6,
        )


def test_the_sensitivity_of_a_machine_is_one_over_one_plus_its_loop():
    """The form that the help of the room teaches, on 24 modes."""
    L = machine(m=1, p=1)
    S = 1 / (1 + 10.0 * L)
    for f in (1.0, 245.0, 1000.0):
        s = 2j * np.pi * f
        gain = 1 / (1 + 10.0 * gain_at(L.A, L.B, L.C, L.D, s)[0, 0])
        assert S(s) == pytest.approx(gain, rel=1e-6)

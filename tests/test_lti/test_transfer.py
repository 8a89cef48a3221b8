"""Transfer functions, foreign systems, gains at a point, zeros, channels by number."""

import control
import numpy as np
import pytest
from scipy import signal
from scipy.optimize import linear_sum_assignment

from flexplant.errors import LabelError, ModelError
from flexplant.lti import StateSpace, as_statespace, discretized, tf, zpk
from systems_lti import machine, system

POINT = 0.3 + 2.0j


def farthest(found, wanted):
    """Return the largest relative distance of numbers that are paired one to one."""
    assert found.size == wanted.size
    distance = np.abs(found[:, None] - wanted) / np.abs(wanted)
    return distance[linear_sum_assignment(distance)].max(initial=0.0)


@pytest.mark.parametrize(
    ("num", "den"),
    [
        ([3.0], [1.0]),
        ([1.0], [1.0, 0.0, 0.0]),
        ([2.0, 1.0], [4.0, 3.0]),
        ([1.0, -1.0, 5.0], [2.0, 0.1, 30.0]),
        ([1.0, 2.0], np.poly([-1, -2, -3 + 40j, -3 - 40j, -1e-3])),
        ([0.0, 0.0], [1.0, 1.0]),
    ],
)
def test_a_ratio_of_polynomials(num, den):
    g = tf(num, den)
    wanted = np.polyval(num, POINT) / np.polyval(den, POINT)
    assert g(POINT) == pytest.approx(wanted, rel=1e-12, abs=0)
    assert g.n_states == (np.size(den) - 1 if np.any(num) else 0)


def test_many_lightly_damped_poles_stay_where_they_are():
    """A companion form of these 24 poles moves them by per cents; sections do not."""
    omega = 2 * np.pi * np.geomspace(50.0, 5000.0, 12)
    upper = -1e-4 * omega + 1j * omega
    zeros = 1.1 * upper[:-1]
    g = zpk(np.r_[zeros, zeros.conj()], np.r_[upper, upper.conj()], 7.0)
    assert farthest(g.poles(), np.r_[upper, upper.conj()]) < 1e-12
    s = 1j * omega[5]
    pairs = np.prod((s - zeros) * (s - zeros.conj()) / ((s - upper) * (s - upper.conj()))[:-1])
    wanted = 7.0 * pairs / ((s - upper[-1]) * (s - upper[-1].conj()))
    assert g(s) == pytest.approx(wanted, rel=1e-9, abs=0)


@pytest.mark.parametrize("dt", [0.0, 1e-3])
def test_systems_of_scipy_and_python_control(dt):
    num, den = [1.0, 0.4], [1.0, -0.5, 0.3]
    time = {"dt": dt} if dt else {}
    wanted = np.polyval(num, POINT) / np.polyval(den, POINT)
    ratio = (signal.dlti if dt else signal.lti)(num, den, **time)
    for foreign in (ratio, ratio.to_zpk(), ratio.to_ss(), control.tf(num, den, dt)):
        g = as_statespace(foreign)
        assert g.dt == dt
        assert g(POINT) == pytest.approx(wanted, rel=1e-12, abs=0)


def test_a_matrix_of_transfer_functions_keeps_its_names():
    foreign = control.tf(
        [[[1.0], [2.0, 1.0]], [[1.0, 1.0], [3.0]]],
        [[[1.0, 1.0], [1.0, 2.0]], [[1.0, 2.0, 1.0], [1.0, 5.0]]],
        inputs=["a", "b"], outputs=["p", "q"],
    )  # fmt: skip
    g = StateSpace.from_control(foreign)
    assert (g.inputs, g.outputs) == (("a", "b"), ("p", "q"))
    np.testing.assert_allclose(g(POINT), foreign(POINT), rtol=1e-12)


@pytest.mark.parametrize("dt", [0.0, 1e-3])
def test_gain_at_a_point_and_at_rest_as_python_control(dt):
    g = system(dt=dt)
    twin = g.to_control()
    np.testing.assert_allclose(g(POINT), twin(POINT), rtol=1e-12)
    np.testing.assert_allclose(g.dcgain(), twin.dcgain(), rtol=1e-12)
    one = g["out0", "in1"]
    assert isinstance(one(POINT), complex)
    assert one.dcgain() == pytest.approx(twin.dcgain()[0, 1], rel=1e-12, abs=0)


def test_a_free_mass_has_no_static_gain():
    mass = StateSpace([[0, 1], [0, 0]], [[0], [1]], [[1, 0]], [[0]])
    with pytest.raises(ModelError, match=r"gain at 0 is infinite.*free mass"):
        mass.dcgain()


@pytest.mark.parametrize("shape", [(1, 1), (2, 2), (3, 2), (2, 3)])
@pytest.mark.parametrize("feedthrough", [1.0, 0.0])
def test_invariant_zeros_are_where_rank_is_lost(shape, feedthrough):
    """Judged by the smallest singular value of [A - s, B; C, D]; none of a random tall system."""
    p, m = shape
    g = system(3, n=7, m=m, p=p)
    g = g.replace(D=feedthrough * g.D)
    found = g.zeros()
    assert found.size == (7 - m * (feedthrough == 0) if p == m else 0)
    for s in found:
        whole = np.block([[g.A - s * np.eye(7), g.B], [g.C, g.D]])
        assert np.linalg.svd(whole, compute_uv=False)[-1] < 1e-9 * np.linalg.norm(whole)


@pytest.mark.parametrize("units", [1.0, 1e-9])
def test_zeros_of_a_flexible_machine(units):
    """Collocated force and displacement: zeros between the poles, none of the far side."""
    omega = 2 * np.pi * np.array([100.0, 250.0, 700.0])
    blocks = [np.array([[0.0, 1.0], [-(w**2), -2e-3 * w]]) for w in omega]
    A = np.kron(np.eye(3), np.zeros((2, 2)))
    for i, block in enumerate(blocks):
        A[2 * i : 2 * i + 2, 2 * i : 2 * i + 2] = block
    g = StateSpace(A, np.kron(np.ones((3, 1)), [[0.0], [units]]), np.kron(np.ones(3), [1, 0])[None],
                   [[0.0]])  # fmt: skip
    numerator = sum(
        np.poly(np.concatenate([np.linalg.eigvals(b) for k, b in enumerate(blocks) if k != i]))
        for i in range(3)
    )
    assert farthest(g.zeros(), np.roots(numerator)) < 1e-9
    sampled = discretized(g, 5e3, delay=1)
    for s in sampled.zeros():
        assert abs(sampled(s)) < 1e-7 * abs(sampled(1.0))


def test_hidden_states_are_zeros():
    """Three free masses that move as one under one force: two pairs are zeros at 0."""
    zeros = machine(m=1, p=1).zeros()
    assert np.sum(np.abs(zeros) < 1e-3) == 4


def test_channels_by_number_and_slice():
    g = system()
    assert g[0, -1].inputs == ("in2",)
    assert g[[1, "out0"], 1:].outputs == ("out1", "out0")
    assert g[:, "in1"].inputs == ("in1",)
    with pytest.raises(
        LabelError, match=r"output number 2 does not exist: the system has 2 \(out0, out1\)"
    ):
        _ = g[2, 0]
    with pytest.raises(LabelError, match=r"a channel is a pair"):
        _ = g["out1"]


def test_refusals():
    with pytest.raises(ModelError, match=r"2 zeros and 1 poles: it differentiates"):
        tf([1.0, 0.0, 0.0], [1.0, 1.0])
    with pytest.raises(ModelError, match="denominator is zero"):
        tf([1.0], [0.0])
    with pytest.raises(ModelError, match=r"poles need the conjugate of -1\+2j"):
        zpk([], [-1 + 2j], 1.0)
    with pytest.raises(ModelError, match="NaN or infinite"):
        zpk([], [np.nan], 1.0)
    with pytest.raises(ModelError, match="python-control or SciPy, got dict"):
        as_statespace({})

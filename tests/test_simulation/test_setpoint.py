"""Set-points: bounds, exact integration, and nothing faster by linear programming."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

import oracles_loop as oracle
from flexplant.errors import FlexplantError, ModelError
from flexplant.simulation import SetPoint, setpoint

size = st.floats(-3.0, 3.0).map(lambda power: 10.0**power)
snaps = st.one_of(st.none(), st.floats(-2.0, 6.0).map(lambda power: 10.0**power))


@given(size, size, size, size, snaps, st.sampled_from([-1.0, 1.0]))
def test_bounds_hold_and_the_end_is_reached(distance, v, a, j, snap, sign):
    move = setpoint(sign * distance, velocity=v, acceleration=a, jerk=j, snap=snap, start=0.3)
    t = np.linspace(-0.1 * move.duration, 1.1 * move.duration, 4001)
    p, dp, ddp, dddp = move.at(t)
    assert np.abs(dp).max() <= v * (1 + 1e-12)
    assert np.abs(ddp).max() <= a * (1 + 1e-12)
    assert np.abs(dddp).max() <= j * (1 + 1e-12)
    assert (sign * dp).min() >= 0
    assert p[0] == 0.3
    assert p[-1] == 0.3 + sign * distance
    assert not np.any(dp[t > move.duration]) and not np.any(ddp[t < 0])
    # some bound is active: it could not be faster by ignoring them all
    snap_seen = 0.0
    if snap is not None:
        fine = move.duration * np.linspace(0, 1, 20001)
        snap_seen = np.max(np.abs(np.diff(move.at(fine).jerk))) / (fine[1] * snap)
    active = max(np.abs(dp).max() / v, np.abs(ddp).max() / a, np.abs(dddp).max() / j, snap_seen)
    assert active > 0.99


@given(size, size, size, size, snaps)
def test_derivatives_integrate_to_the_position(distance, v, a, j, snap):
    """Each derivative integrated by Gauss quadrature within each phase gives the next."""
    move = setpoint(distance, velocity=v, acceleration=a, jerk=j, snap=snap)
    half = 0.5 * move.duration
    ramp, hold, steady, cruise = move._phases
    lengths = [ramp, hold, ramp, steady, ramp, hold, ramp, cruise / 2]
    edges = np.concatenate([[0.0], np.cumsum(lengths)])
    edges = np.concatenate([edges, (2 * half - edges[-2::-1])])
    nodes, weights = np.polynomial.legendre.leggauss(4)
    middle, width = 0.5 * (edges[1:] + edges[:-1]), 0.5 * np.diff(edges)
    inside = move.at(middle[:, None] + width[:, None] * nodes)
    for order in range(3):
        change = (inside[order + 1] * weights).sum(axis=1) * width
        scale = np.abs(np.concatenate([np.ravel(inside[order]), [0.0]])).max()
        # times are rounded to their own spacing
        slack = 1e-15 * move.duration * np.abs(np.ravel(inside[order + 1])).max()
        got = np.cumsum(change)[:-1]
        want = np.asarray(move.at(edges[1:-1])[order]) - move.at(0.0)[order]
        # a jerk that jumps belongs to either side of an edge; lower orders are continuous
        np.testing.assert_allclose(got, want, rtol=0, atol=2e-10 * scale + slack)


def test_textbook_third_order():
    """0.1 m, 0.5 m/s, 10 m/s^2, 1000 m/s^3: t_j = 10 ms, t_a = 40 ms, t_v = 140 ms, all by hand."""
    move = setpoint(0.1, velocity=0.5, acceleration=10.0, jerk=1000.0)
    assert move.duration == pytest.approx(4 * 0.01 + 2 * 0.04 + 0.14, rel=1e-14)
    assert float(move.at(0.01).acceleration) == pytest.approx(10.0, rel=1e-12)
    assert float(move.at(0.06).velocity) == pytest.approx(0.5, rel=1e-12)
    assert float(move.at(0.13).position) == pytest.approx(0.05, rel=1e-12)
    # the first pulse: j t^3 / 6
    assert float(move.at(0.005).position) == pytest.approx(1000 * 0.005**3 / 6, rel=1e-12)


@pytest.mark.parametrize(
    ("distance", "bounds"),
    [
        (0.1, (0.5, 10.0, 1000.0)),  # all bounds reached
        (0.01, (0.5, 10.0, 1000.0)),  # velocity not reached
        (1e-4, (0.5, 10.0, 1000.0)),  # jerk only
        (0.1, (0.05, 10.0, 1000.0)),  # acceleration not reached, velocity is
        (0.1, (0.5, 10.0, 1000.0, 2e5)),
        (0.1, (0.05, 10.0, 1000.0, 2e5)),
        (1e-4, (0.005, 10.0, 1000.0, 2e5)),  # snap and velocity
    ],
)
def test_nothing_goes_farther_in_the_same_time(distance, bounds):
    move = setpoint(
        distance, **dict(zip(("velocity", "acceleration", "jerk", "snap"), bounds, strict=False))
    )
    reach = oracle.farthest(move.duration, bounds)
    # the program holds the velocity only at its 120 instants, and may overstep in between
    assert reach <= distance * (1 + 5e-4)
    assert reach >= distance * 0.97
    assert np.abs(move.at(np.linspace(0, move.duration, 999)).velocity).max() <= bounds[0] * (
        1 + 1e-12
    )


@pytest.mark.parametrize("distance", [0.01, 1e-5, 1e-4])
def test_fourth_order_without_cruise_is_near_the_optimum(distance):
    """The optimum is at most 7.5 % quicker: 1.0746^4 of the distance in the same time."""
    bounds = (0.5, 10.0, 1000.0, 2e5)
    move = setpoint(distance, velocity=0.5, acceleration=10.0, jerk=1000.0, snap=2e5)
    reach = oracle.farthest(move.duration, bounds)
    assert distance < reach < distance * 1.0746**4
    assert oracle.farthest(move.duration / 1.0746, bounds) < distance


def test_a_long_cruise_keeps_its_digits():
    """Eight powers of ten between the ramps and the cruise, and the halves still meet."""
    move = setpoint(5303.0, velocity=1e-4, acceleration=0.04, jerk=0.036, snap=150.0)
    before = move.at(np.nextafter(0.5 * move.duration, 0.0)).position
    assert float(before) == pytest.approx(0.5 * 5303.0, rel=1e-14)


def test_rest_shifts_the_motion():
    move = setpoint(1.0, velocity=1.0, acceleration=5.0, jerk=100.0)
    later = setpoint(1.0, velocity=1.0, acceleration=5.0, jerk=100.0, rest=0.25)
    assert later.duration == pytest.approx(move.duration + 0.25)
    t = np.linspace(0, 1.2, 50)
    np.testing.assert_allclose(later.at(t + 0.25).position, move.at(t).position, atol=1e-13)
    assert repr(move).startswith("<SetPoint 0 -> 1 in 1.25 s, order 3")


@pytest.mark.parametrize(
    "wrong", [{"velocity": 0.0}, {"jerk": -1.0}, {"snap": 0.0}, {"distance": 0.0},
              {"distance": np.nan}, {"rest": -1.0}, {"acceleration": np.inf}]
)  # fmt: skip
def test_bad_bounds_are_refused(wrong):
    good = {
        "distance": 1.0,
        "velocity": 1.0,
        "acceleration": 1.0,
        "jerk": 1.0,
        "snap": None,
        "rest": 0.0,
    }
    with pytest.raises(FlexplantError, match=next(iter(wrong))):
        SetPoint(**(good | wrong))


def test_times_must_be_finite():
    with pytest.raises(ModelError, match="t has a NaN"):
        setpoint(1.0, velocity=1.0, acceleration=1.0, jerk=1.0).at([0.0, np.nan])

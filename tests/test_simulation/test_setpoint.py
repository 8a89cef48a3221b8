"""Set-points: bounds, exact integration, and nothing faster by linear programming."""

import math

import numpy as np
import pytest
from hypothesis import assume, given
from hypothesis import strategies as st

import flexplant as fx
import oracles_loop as oracle
from flexplant.errors import FlexplantError, ModelError
from flexplant.simulation import scan, setpoint
from machines import observer, servo, stage

size = st.floats(-3.0, 3.0).map(lambda power: 10.0**power)


bounds_of = st.lists(size, min_size=2, max_size=4)
metres = st.floats(-9.0, 1.0).map(lambda power: 10.0**power)
rates = st.one_of(st.none(), st.sampled_from([1e3, 7e3, 1e4, 2e5]))
NAMES = ("velocity", "acceleration", "jerk", "snap")


def made(distance, bounds, **options):
    return setpoint(distance, **dict(zip(NAMES, bounds, strict=False)), **options)


@given(metres, bounds_of, rates, st.sampled_from([-1.0, 1.0]))
def test_bounds_hold_and_the_end_is_reached(distance, bounds, rate, sign):
    """Orders 2 to 4 from nanometres to metres, on a grid and off it."""
    move = made(sign * distance, bounds, start=0.3, rate=rate)
    inner = np.concatenate([move.at((move.edges + d) * move.tick) for d in (0.0, 0.3, -1e-9)], 1)
    t = np.linspace(-0.1 * move.duration, 1.1 * move.duration, 2001)
    found = np.concatenate([np.array(move.at(t)), inner], axis=1)
    for derivative, bound in zip(found[1:], bounds, strict=False):
        assert np.abs(derivative).max() <= bound * (1 + 1e-12)
    assert (sign * found[1]).min() >= 0
    assert found[0, 0] == 0.3 and found[0, 2000] == move.stop == 0.3 + sign * distance
    # without the exact end: the last phase itself comes to it
    last = np.nextafter(move.duration, 0.0)
    assert abs(float(move.at(last).position) - move.stop) <= 1e-9 * distance + 2e-16
    after = np.array(move.at([move.duration, 2 * move.duration, -1.0]))
    assert not np.any(after[1:])
    if rate is None:  # some bound is active: it could not be faster by ignoring them all
        peaks = [getattr(move.peaks, name) for name in NAMES]
        assert max(p / bound for p, bound in zip(peaks, bounds, strict=False)) > 0.99
    else:
        assert np.all(move.edges == np.round(move.edges))
        free = made(distance, bounds)
        assert move.duration <= free.duration + (2 ** len(bounds)) / rate


@given(metres, bounds_of, st.sampled_from([1e3, 7e3, 1e4]))
def test_samples_of_all_derivatives_are_in_phase(distance, bounds, rate):
    """Held over a sample, the highest derivative moves all others to their next sample."""
    move = made(distance, bounds, rate=rate, rest=2.5 / rate)
    n = min(int(move.edges[-1]) + 2, 4000)
    samples = np.array(move.at(np.arange(n + 1) / rate))
    h, order = 1.0 / rate, len(bounds)
    for m in range(order):
        step = sum(samples[k, :-1] * h ** (k - m) / math.factorial(k - m)
                   for k in range(m, order + 1))  # fmt: skip
        scale = np.abs(samples[m]).max() + (1e-300 if m else 0.0)
        np.testing.assert_allclose(samples[m, 1:], step, rtol=0, atol=1e-11 * scale)


@given(metres, bounds_of)
def test_derivatives_integrate_to_the_position(distance, bounds):
    """Each derivative integrated by Gauss quadrature within each phase gives the one below."""
    move = made(distance, bounds)
    nodes, weights = np.polynomial.legendre.leggauss(4)
    middle, width = 0.5 * (move.edges[1:] + move.edges[:-1]), 0.5 * np.diff(move.edges)
    inside = move.at(middle[:, None] + width[:, None] * nodes)
    for order in range(len(bounds)):
        change = np.cumsum((inside[order + 1] * weights).sum(axis=1) * width)[:-1]
        scale = np.abs(np.concatenate([np.ravel(inside[order]), [0.0]])).max()
        # times are rounded to their own spacing
        slack = 1e-15 * move.duration * np.abs(np.ravel(inside[order + 1])).max()
        want = np.asarray(move.at(move.edges[1:-1])[order]) - move.at(0.0)[order]
        # the highest derivative jumps; lower orders are continuous
        if order < len(bounds):
            got = change + (move.at(0.0)[order] * 0.0)
            np.testing.assert_allclose(got, want, rtol=0, atol=2e-10 * scale + slack)


def test_a_step_and_scan_chain_exposes_what_it_should():
    """A scan, a step over with an exposure at rest, and a scan back: windows and velocities."""
    rate, bounds = 1e4, {"acceleration": 8.0, "jerk": 900.0, "snap": 2e5}
    forth = scan(0.026, velocity=0.3, settle=4e-3, rest=1e-3, rate=rate, **bounds)
    step = setpoint(5e-3, velocity=0.5, settle=3e-3, exposure=5e-3, rate=rate, **bounds)
    back = scan(-0.026, velocity=0.3, settle=4e-3, rate=rate, **bounds)
    chain = forth.then(step).then(back)
    assert chain.exposures.shape == (3, 2)
    t = np.arange(round(chain.duration * rate) + 5) / rate
    p, v, a, j, s = chain.at(t)
    for derivative, bound in ((a, 8.0), (j, 900.0), (s, 2e5)):
        assert 0.5 * bound < np.abs(derivative).max() <= bound * (1 + 1e-12)
    h = 1.0 / rate
    step_by_step = h * (v + h / 2 * (a + h / 3 * (j + h / 4 * s)))[:-1]
    np.testing.assert_allclose(np.diff(p), step_by_step, atol=1e-15)
    for (begin, end), wanted in zip(chain.exposures, (0.026, 0.0, -0.026), strict=True):
        inside = (t >= begin - 1e-9) & (t <= end + 1e-9)
        assert not np.any(a[inside][:-1]) and np.ptp(v[inside]) < 1e-15
        assert np.ptp(p[inside]) == pytest.approx(abs(wanted), rel=1e-12, abs=1e-16)
        assert abs(v[inside][0]) <= 0.3 and end * rate == pytest.approx(round(end * rate))
    assert p[-1] == chain.stop == pytest.approx(5e-3, rel=1e-9)
    assert chain.duration == pytest.approx(forth.duration + step.duration + back.duration)
    assert "order 4" in repr(chain) and "3 exposures, on a grid of 0.0001 s" in repr(chain)
    with pytest.raises(ModelError, match="one order and one grid"):
        forth.then(setpoint(1e-3, velocity=1.0, acceleration=1.0))
    with pytest.raises(ModelError, match="of type SetPoint"):
        forth.then(1.0)


def test_a_scan_of_second_order_without_a_grid():
    """By hand: 0.1 s to 0.2 m/s at 2 m/s^2, 10 mm on the way, 5 ms to settle, 20 mm exposed."""
    move = scan(0.02, velocity=0.2, acceleration=2.0, settle=5e-3, start=1.0)
    assert move.exposures[0] == pytest.approx([0.105, 0.205], rel=1e-12)
    assert move.at(move.exposures[0]).position == pytest.approx([1.011, 1.031], rel=1e-12)
    assert (move.duration, move.stop) == (pytest.approx(0.305), pytest.approx(1.041))


@given(metres, bounds_of, rates)
def test_scans_hold_their_bounds(length, bounds, rate):
    """From nanometres to metres; the exposed stretch is exact, its velocity constant."""
    move = scan(-length, **dict(zip(NAMES, bounds, strict=False)), rate=rate, settle=1e-3)
    peaks = [getattr(move.peaks, name) for name in NAMES]
    assert all(p <= bound * (1 + 1e-11) for p, bound in zip(peaks, bounds, strict=False))
    begin, end = move.exposures[0]
    found = move.at([begin, 0.5 * (begin + end), end])
    slack = 1e-12 * (length + abs(move.stop)) + 4e-16 * move.duration * peaks[0]
    assume(slack < 1e-3 * length)  # or it lies too far away for its digits
    assert found.position[0] - found.position[2] == pytest.approx(length, rel=0, abs=slack)
    assert np.ptp(found.velocity[:2]) == 0.0 and not found.acceleration[1]


def test_what_the_run_cuts_off_is_said():
    loop = fx.close_loop(stage(), observer(), servo())
    move = setpoint(1e-3, velocity=0.02, acceleration=1.0, jerk=100.0, rest=0.01)
    with pytest.warns(fx.FlexplantWarning, match=r"'die:ref' lasts 0.09 s, longer than the run of "
                      r"0.05 s: it is cut off at 0.0005 on its way to 0.001"):  # fmt: skip
        fx.simulate(loop, reference=move, duration=0.05, noise=False)
    gridded = setpoint(1e-3, velocity=0.02, acceleration=1.0, rate=3000.0)
    with pytest.warns(fx.FlexplantWarning, match="between the samples of the loop's 2000 Hz"):
        fx.simulate(loop, reference=gridded, duration=0.2, noise=False)


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
        (0.1, (0.5, 10.0)),  # second order
        (0.01, (0.5, 10.0)),
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
    assert repr(move).startswith("<SetPointProfile 0 -> 1 m or rad in 1.25 s, order 3")


@pytest.mark.parametrize(
    "wrong", [{"velocity": 0.0}, {"jerk": -1.0}, {"snap": 0.0}, {"distance": 0.0},
              {"distance": np.nan}, {"rest": -1.0}, {"acceleration": np.inf}]
)  # fmt: skip
def test_bad_bounds_are_refused(wrong):
    good = {"distance": 1.0, "velocity": 1.0, "acceleration": 1.0, "jerk": 1.0, "rest": 0.0}
    with pytest.raises(FlexplantError, match=next(iter(wrong))):
        setpoint(**(good | wrong))


def test_snap_needs_jerk():
    with pytest.raises(ModelError, match="snap needs one on jerk"):
        setpoint(1.0, velocity=1.0, acceleration=1.0, snap=1.0)
    with pytest.raises(ModelError, match="length must not be 0"):
        scan(0.0, velocity=1.0, acceleration=1.0)


def test_times_must_be_finite():
    with pytest.raises(ModelError, match="t has a NaN"):
        setpoint(1.0, velocity=1.0, acceleration=1.0, jerk=1.0).at([0.0, np.nan])

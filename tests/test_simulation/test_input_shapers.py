"""Shaped moves beside the vibration that an oscillator shows when it is integrated."""

from itertools import pairwise

import numpy as np
import pytest
from scipy.integrate import solve_ivp

import flexplant as fx
from flexplant.simulation import input_shaper, quiet_setpoint


def vibration(move, freq, damping):
    """Return the amplitude that an oscillator on the moved base has after the move."""
    w, edges = 2 * np.pi * freq, move.edges * move.tick
    x = np.zeros(2)
    for left, right in pairwise(edges):  # smooth between the edges

        def slope(t, x):
            return [x[1], -(w**2) * x[0] - 2 * damping * w * x[1] - move.at(t).acceleration.item()]

        inside = (left, right - 1e-12 * right)
        x = solve_ivp(slope, inside, x, rtol=1e-9, atol=1e-14).y[:, -1]
    wd = w * np.sqrt(1 - damping**2)
    return np.hypot(x[0], (x[1] + damping * w * x[0]) / wd)


MOVE = fx.setpoint(0.01, velocity=0.2, acceleration=5.0, jerk=500.0)


@pytest.mark.parametrize("kind", ["ZV", "ZVD", "EI"])
@pytest.mark.slow
@pytest.mark.parametrize("freq", [17.0])
@pytest.mark.parametrize("damping", [0.0, 0.03])
def test_what_is_left_is_what_an_oscillator_shows(kind, freq, damping):
    """For the mode that the shaper is made for and for others, by another route: its motion."""
    shaper = input_shaper(freq, damping=damping, kind=kind)
    shaped = shaper.shaped(MOVE)
    assert shaper.amplitudes.sum() == pytest.approx(1.0)
    for other in (freq, 0.8 * freq):
        free = vibration(MOVE, other, damping)
        found = vibration(shaped, other, damping)
        left = shaper.residual(other, damping).item()
        assert abs(found - left * free) < 1e-6 * free
    # EI leaves 5 %, the others nothing
    assert shaper.residual(freq, damping).item() < (0.051 if kind == "EI" else 1e-12)


def test_a_shaped_move_is_the_sum_of_moves():
    rng = np.random.default_rng(1)
    shaper = input_shaper(rng.uniform(10, 80, 2), damping=rng.uniform(0, 0.05, 2), kind="ZVD")
    shaped, t = shaper.shaped(MOVE), np.linspace(-0.01, MOVE.duration + shaper.duration + 0.01, 997)
    assert shaped.duration == pytest.approx(MOVE.duration + shaper.duration)
    for name in ("position", "velocity", "acceleration"):
        wanted = sum(
            share * getattr(MOVE.at(t - late), name)
            for late, share in zip(shaper.times, shaper.amplitudes, strict=True)
        )
        size = np.abs(wanted).max()
        np.testing.assert_allclose(getattr(shaped.at(t), name), wanted, atol=1e-9 * size)


@pytest.mark.parametrize("change", [0.05, 0.15, 0.3])
@pytest.mark.parametrize("damping", [0.0, 0.02])
def test_a_stated_change_of_the_frequency_is_borne(change, damping):
    shaper = input_shaper(25.0, damping=damping, change=change, left=0.03)
    band = 25.0 * np.linspace(1 - change, 1 + change, 1000)
    assert shaper.residual(band, damping).max() <= 0.0301
    assert input_shaper(25.0, damping=damping).residual(band, damping).max() > 0.03


@pytest.mark.slow
@pytest.mark.parametrize("freq", [40.0, [40.0, 55.0]])
def test_ramps_of_whole_periods_leave_the_modes_at_rest(freq):
    move = quiet_setpoint(0.1, velocity=0.5, acceleration=10.0, freq=freq)
    assert move.peaks.velocity <= 0.5 * (1 + 1e-12)
    assert move.peaks.acceleration <= 10.0 * (1 + 1e-12)
    for one in np.atleast_1d(freq):  # of what the acceleration itself bends
        assert vibration(move, one, 0.0) < 1e-6 * 10.0 / (2 * np.pi * one) ** 2


def test_what_a_shaper_cannot_do_says_why():
    for call, words in (
        (lambda: input_shaper(-1.0), "positive"),
        (lambda: input_shaper(1.0, damping=1.0), "between 0 and 1"),
        (lambda: input_shaper(1.0, change=0.45, left=1e-6), "measure the frequency"),
        (lambda: quiet_setpoint(1.0, velocity=1, acceleration=1, freq=[1, 2, 3]), "input_shaper"),
    ):
        with pytest.raises(fx.FlexplantError, match=words):
            call()

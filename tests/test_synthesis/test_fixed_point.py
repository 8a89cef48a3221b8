"""Controllers in integers: coefficients of stated length, what never comes to rest."""

from functools import cache

import numpy as np
import pytest

import flexplant as fx
from flexplant.errors import CertificateError, ModelError
from flexplant.synthesis import fixed_point


@cache
def masses():
    plant = fx.testbeds.three_masses()
    observer = fx.design_kalman(plant)
    servo = fx.design_servo(plant, bandwidth=20.0, observer=observer)
    loop = fx.close_loop(plant, observer, servo)
    move = fx.setpoint(1e-3, velocity=0.1, acceleration=5.0, jerk=1e3)
    return loop, fx.simulate(loop, reference=move, duration=0.5, rng=1)


@pytest.mark.long
def test_few_bits_lose_the_loop_and_the_fewest_that_keep_it_are_found():
    loop, run = masses()
    found = fixed_point(loop, run, state_bits=32)
    assert 4 < found.bits < 16
    assert f"6 sections, {found.bits - 1} bits" in found.tried
    again = fx.close_loop(loop.plant, found.system)
    assert again.modulus_margin == pytest.approx(found.certificate["modulus margin"], rel=1e-9)
    assert again.modulus_margin >= 0.9 * loop.modulus_margin
    assert found.certificate["cycles sought above, of a word"] < 1e-8
    for one in found.limit_cycles:  # 32 bits: hundreds of steps are little
        assert one.amplitude < 1e-5 * found.ranges[one.channel]
    # words hold what the run has
    for name in loop.plant.y:
        assert np.abs(run[name]).max() * 2 <= found.ranges[name] <= np.abs(run[name]).max() * 9
    with pytest.raises(CertificateError, match="6 sections, 4 bits: the loop becomes unstable"):
        fixed_point(loop, run, bits=4)
    with pytest.raises(CertificateError, match="does not come to rest"):  # of the move's size
        fixed_point(loop, run, state_bits=8)
    with pytest.raises(ModelError, match="do not fit 64"):
        fixed_point(loop, run, bits=32, state_bits=32)
    with pytest.raises(ModelError, match="no channel"):
        fixed_point(loop, {"u1": run["u1"]})


@pytest.mark.long
def test_limit_cycles_are_named_and_shrink_with_the_words():
    """Each bit halves what is left; at the frequencies of the loop."""
    loop, run = masses()
    sizes = {}
    for wide in (16, 20):
        found = fixed_point(loop, run, bits=16, state_bits=wide)
        assert {one.channel for one in found.limit_cycles} >= {"y1", "u1"}
        sizes[wide] = max(one.amplitude for one in found.limit_cycles if one.channel == "y1")
        assert all(0.0 <= one.freq < 1e3 for one in found.limit_cycles)
        assert "limit cycle of" in repr(found)
    assert 2**2 < sizes[16] / sizes[20] < 2**6


@pytest.mark.long
def test_a_budget_of_sections_and_bits():
    loop, run = masses()
    found = fixed_point(loop, run, sections=[3, 4, 6], state_bits=16)
    every = fixed_point(loop, run, state_bits=16)
    assert found.sections < every.sections  # less in all, though a section has more bits
    assert found.sections * found.bits < every.sections * every.bits
    assert found.system.n_states == 2 * found.sections
    assert fx.close_loop(loop.plant, found.system).is_stable

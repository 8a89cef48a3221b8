"""Robust stability and worst-case gain of loops, against the machines themselves."""

import itertools
from functools import cache

import numpy as np
import pytest

import flexplant as fx
from flexplant.errors import AssumptionError, LabelError, ModelError
from flexplant.lti import StateSpace, lft, tustin
from flexplant.plant import Delay, Fit, Neglected
from flexplant.synthesis import design_mu, robust_stability, worst_case_gain
from stages import ports, reduced, sampled, some_modes

RATE = 400.0
pytestmark = pytest.mark.slow


@cache
def plant(sampled=False):
    """Three masses on soft ground: 0.9, 8 and 14 Hz; force on the first, sensor on the last."""
    model = fx.chain(
        masses=[1.0, 1.0, 1.0], stiffnesses=[2500.0, 2500.0], ground=[30.0, 30.0, 30.0]
    )
    modes = fx.solve_modes(model, count=3, damping=fx.ModalDamping(0.01))
    own = fx.Ports(
        w=[fx.Disturbance("d", at="2:x", asd=1e-3)],
        u=[fx.Actuator("f", at="1:x")],
        z=[fx.Poi("tip", at="3:x", axes=("x",))],
        y=[fx.Sensor("s", at="3:x", asd=1e-6)],
    )
    found = fx.assemble_plant(modes, own)
    return found.discretized(RATE, delay=1) if sampled else found


@cache
def uncertain(sampled=False, std=0.04, modes=(2, 3)):
    """Poles known to some part of their frequencies and a tenth of their damping."""
    poles = np.array([complex(*_upper(plant().modal_blocks[k - 1])) for k in modes])
    spread = np.concatenate([0.1 * np.abs(poles.real), std * poles.imag])
    measured = fx.MeasuredModes(poles, modes=modes, covariance=np.diag(spread**2))
    return plant(sampled).uncertain(Fit(measured, deviations=1.0))


def _upper(pair):
    pole = max(np.linalg.eigvals(pair), key=lambda value: value.imag)
    return pole.real, pole.imag


@cache
def lead(sampled=False, gain=60.0):
    """A lead filter around 1.5 Hz that spills over into the modes above."""
    a, b = 2 * np.pi * 0.7, 2 * np.pi * 6.0
    one = StateSpace([[-b]], [[1.0]], [[gain * b / a * (b - a)]], [[-gain * b / a]],
                     inputs=["s"], outputs=["f"])  # fmt: skip
    roll = StateSpace([[-2 * np.pi * 9.0]], [[2 * np.pi * 9.0]], [[1.0]], [[0.0]])
    found = (one * roll).replace(inputs=["s"], outputs=["f"])
    return tustin(found, RATE) if sampled else found


def stable(machine, controller):
    return fx.close_loop(machine, controller).is_stable


@pytest.mark.parametrize("sampled", [False, True])
def test_the_bounds_against_every_corner(sampled):
    """No corner inside the upper bound is unstable, and the machine shown is."""
    deltas, controller = uncertain(sampled, std=0.4), lead(sampled)
    found = robust_stability(deltas, controller)
    assert found.lower <= found.upper <= 1.25 * found.lower
    names = [delta.name for delta in deltas.deltas]
    size = 0.99 / found.upper
    for corner in itertools.product([-size, 0.0, size], repeat=len(names)):
        machine = deltas.lft(dict(zip(names, corner, strict=True)))
        assert stable(machine, controller)
    assert found.machine.dt == (1 / RATE if sampled else 0.0)
    with pytest.warns(fx.FlexplantWarning, match="unstable"):
        assert not stable(found.machine, controller)
    assert max(map(abs, found.values.values())) == pytest.approx(1 / found.lower, rel=1e-2, abs=0)
    assert "machines" in " ".join(found.certificate)
    assert f"{found.upper:.4g}" in repr(found)


@pytest.mark.parametrize("sampled", [False, True])
def test_the_worst_case_gain_is_that_of_a_machine(sampled):
    deltas, controller = uncertain(sampled, std=0.01), lead(sampled, 15.0)
    found = worst_case_gain(deltas, controller, w=["d"], z=["tip:x"])
    assert found.nominal <= found.lower <= found.upper <= 1.1 * found.lower
    loop = fx.close_loop(found.machine, controller)
    assert fx.hinf_norm(loop.system["tip:x", "d"]) == pytest.approx(found.lower, rel=1e-6, abs=0)
    names = [delta.name for delta in deltas.deltas]
    gains = []
    for corner in itertools.product([-1.0, 1.0], repeat=len(names)):
        machine = deltas.lft(dict(zip(names, corner, strict=True)))
        closed = fx.close_loop(machine, controller).system["tip:x", "d"]
        gains.append(fx.hinf_norm(closed))
    assert max(gains) * (1 - 1e-6) <= found.upper
    assert found.lower >= 0.98 * max(gains)
    # a weight multiplies the bound, however small it makes the gain, at no further effort
    small = worst_case_gain(deltas, controller, w=["d"], z={"tip:x": 1e-9})
    assert small.upper == pytest.approx(1e-9 * found.upper, rel=1e-3, abs=0)
    assert len(small.bounds) == pytest.approx(len(found.bounds), abs=3)


def test_it_can_be_simulated():
    found = worst_case_gain(uncertain(True, std=0.01), lead(True, 15.0), w=["d"], z=["tip:x"])
    run = fx.simulate(fx.close_loop(found.machine, lead(True, 15.0)), duration=5.0, rng=1)
    assert run.rms("tip:x") > 0


@pytest.mark.parametrize("sampled", [False, True])
def test_neglected_modes_are_one_full_block(sampled):
    """The third mode left out: its bound decides, and the loop with it in is stable when proven."""
    whole = plant().model
    few = fx.assemble_plant(whole.select([0, 1]), plant().assembled.ports, evaluation=plant())
    given = few.discretized(RATE, delay=1) if sampled else few
    poles = np.array([complex(*_upper(few.modal_blocks[1]))])

    def bounds(std, controller):
        spread = np.array([0.1 * abs(poles[0].real), std * poles[0].imag])
        measured = fx.MeasuredModes(poles, modes=(2,), covariance=np.diag(spread**2))
        deltas = given.uncertain(Fit(measured, deviations=1.0), Neglected(plant()))
        return deltas, robust_stability(deltas, controller)

    _, wide = bounds(0.2, lead(sampled, 90.0))
    assert 1.0 < wide.upper <= 1.3 * wide.lower
    with pytest.warns(fx.FlexplantWarning, match="unstable"):
        assert not stable(wide.machine, lead(sampled, 90.0))
    controller = lead(sampled, 25.0)
    deltas, found = bounds(0.01, controller)
    # all machines are proven stable, so that no worst one is sought
    assert found.upper < 1.0
    assert found.lower == 0.0
    assert found.left_out.is_stable  # the machine with the third mode
    assert found.is_robust
    # the machine with all modes is one of those covered
    worst = worst_case_gain(deltas, controller, w=["d"], z=["tip:x"])
    closed = fx.close_loop(plant(sampled), controller).system["tip:x", "d"]
    assert fx.hinf_norm(closed) <= worst.upper
    assert worst.nominal <= worst.lower * (1 + 1e-9)


def test_refusals():
    with (
        pytest.raises(AssumptionError, match="without any uncertainty"),
        pytest.warns(fx.FlexplantWarning),
    ):
        robust_stability(uncertain(), lead(gain=400.0))
    with pytest.raises(AssumptionError, match="may be unstable"):
        worst_case_gain(uncertain(std=0.3), lead(gain=60.0), w=["d"], z=["tip:x"])
    with pytest.raises(ModelError, match=r"plant\.uncertain"):
        robust_stability(plant(), lead())
    with pytest.raises(ModelError, match="would not be decided"):
        robust_stability(uncertain(), lead(gain=15.0), resolution=1.0)
    late = plant(True).uncertain(Delay(0.2))
    with pytest.raises(ModelError, match=r"1 \+- 0.2 samples passes a whole number"):
        robust_stability(late, lead(True))
    with pytest.raises(LabelError, match="no output 'x'"):
        worst_case_gain(uncertain(), lead(gain=15.0), w=["d"], z=["x"])
    with pytest.raises(ModelError, match="name them"):
        worst_case_gain(uncertain(), lead(gain=15.0), w=[], z=["tip:x"])


@pytest.mark.long
@pytest.mark.parametrize("sampled", [False, True])
def test_dk_iteration_makes_every_machine_keep_the_weights(sampled):
    """mu falls below one, and so does the weighted gain of all corners, where LQG-like did not."""
    deltas = uncertain(sampled, std=0.03)
    slow = fx.lti.low_pass_filter(0.5) * 40.0
    z = {"tip:x": tustin(slow, RATE) if sampled else slow, "f:effort": 0.03}
    w = {"d": 1.0, "s:noise": 0.01}
    found = design_mu(deltas, w=w, z=z)
    assert found.gamma == found.certificate["mu"] < 0.8
    assert found.certificate["mu of step 0"] > 1.5  # designed without the uncertainty
    names = [delta.name for delta in deltas.deltas]
    for corner in itertools.product([-1.0, 1.0], repeat=len(names)):
        machine = deltas.lft(dict(zip(names, corner, strict=True)))
        weighted = machine.weighted(w=w, z={name: z.get(name) for name in machine.z})
        assert fx.hinf_norm(lft(weighted.system, found.system)) <= found.gamma * 1.001
    assert robust_stability(deltas, found, resolution=0.1).upper < found.gamma


@pytest.mark.long
def test_one_channel_a_mode_makes_every_machine_keep_the_weights():
    """Only frequencies are uncertain: mu is that of the machines, and of the general search."""
    deltas = plant(True).uncertain(frequency=0.03)
    z = {"tip:x": tustin(fx.lti.low_pass_filter(0.5) * 40.0, RATE), "f:effort": 0.03}
    w = {"d": 1.0, "s:noise": 0.01}
    found = design_mu(deltas, w=w, z=z)
    assert "one channel a mode" in found.method
    assert found.gamma == found.certificate["mu"] < 0.8
    names = [delta.name for delta in deltas.deltas]
    gains = []
    for corner in itertools.product([-1.0, 0.0, 1.0], repeat=len(names)):
        machine = deltas.lft(dict(zip(names, corner, strict=True)))
        weighted = machine.weighted(w=w, z={name: z.get(name) for name in machine.z})
        gains.append(fx.hinf_norm(lft(weighted.system, found.system)))
    assert 0.9 * found.gamma < max(gains) < 1.01 * found.gamma
    assert 0.9 < found.certificate["largest gain of machines over mu"] < 1.01
    worst = worst_case_gain(deltas, found, w=w, z=z)
    assert worst.lower <= found.gamma * 1.02
    with pytest.raises(LabelError, match="'push'"):
        design_mu(deltas, w={"push": 1.0}, z=z)


def test_weights_of_a_stage_with_a_channel_left_out():
    """The weight of the POI that has a reference is None: each machine is closed by hand."""
    P = sampled(some_modes(0.01, 6, attached=False), ports(asd=1e-2))
    off = P.uncertain(frequency=0.01)
    weights = fx.stage_weights(off, 20.0)
    assert None in weights.z.values()
    found = design_mu(off, w=weights.w, z=weights.z, iterations=2)
    names, gains = [delta.name for delta in off.deltas], []
    left = {name: weights.w.get(name) for name in P.w}
    for corner in itertools.product([-1.0, 1.0], repeat=len(names)):
        machine = off.lft(dict(zip(names, corner, strict=True)))
        weighted = machine.weighted(w=left, z={name: weights.z.get(name) for name in P.z})
        gains.append(fx.hinf_norm(lft(weighted.system, found.system)))
    assert 0.8 * found.gamma < max(gains) < 1.01 * found.gamma


def test_a_delay_within_a_sample_is_a_delta():
    """Some 0.5 samples of 400 Hz at a crossover of 1.5 Hz are little, 3 samples are not."""
    later = plant().discretized(RATE, delay=1.3)
    found = robust_stability(later.uncertain(Delay(0.25)), lead(True))
    machines = [later.uncertain(Delay(0.25)).lft({"delay": one}) for one in (-1.0, 1.0)]
    assert found.is_robust == all(stable(one, lead(True)) for one in machines)
    assert found.lower <= found.upper < 1.0
    both = robust_stability(later.uncertain(Delay(0.25), frequency=0.02), lead(True))
    assert both.upper >= 0.99 * found.upper


@pytest.mark.slow
def test_real_deltas_of_light_modes_are_covered_in_a_few_intervals():
    """Beside a resonance no real Delta closes the loop: G may not grow there without end."""
    sampled_plate = sampled(reduced(0.001))
    known = sampled_plate.uncertain(frequency=dict.fromkeys(range(4, 9), 0.001))
    static = fx.design_static(sampled_plate)
    servo = fx.design_servo(sampled_plate, bandwidth=60.0, observer=static)
    found = robust_stability(known, static, servo, resolution=0.05)
    assert found.upper <= 0.05  # what need not be resolved
    assert 0 < found.certificate["intervals by Hamiltonians"] < 100

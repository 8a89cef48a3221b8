"""Loops in the field beside plain recursions: hysteresis, lost samples, jitter, drift, spectra."""

from types import SimpleNamespace

import numpy as np
import pytest
import scipy.linalg as la
from scipy import signal

import flexplant as fx
import oracles_loop as oracle
from flexplant.errors import FlexplantError, ModelError
from flexplant.simulation import (
    Dropout,
    Friction,
    Hysteresis,
    Jitter,
    Saturation,
    setpoint,
    simulate,
)
from machines import RATE, block, matrices, observer, servo, stage

MOVE = setpoint(1e-3, velocity=0.02, acceleration=1.0, jerk=100.0, rest=0.01)


def loop_of(plant):
    return fx.close_loop(plant, observer(), servo())


class Cubic:
    """An amplifier that is not linear, in which a part of the last value stays."""

    def begin(self, dt, generators):
        last = np.zeros(len(generators))

        def act(values):
            last[:] = 0.2 * last + values - 0.5 * values**3
            return last

        return act


def by_hand(loop, run, given, **parts):
    return oracle.run_sample_by_sample(
        matrices(loop.plant), [block(b) for b in loop.blocks], given, **parts
    )


def same(run, wanted, tolerance=1e-9):
    for name in run:
        scale = np.abs(wanted[name]).max()
        np.testing.assert_allclose(run[name], wanted[name], rtol=0, atol=tolerance * scale)


@pytest.mark.slow
def test_hysteresis_and_an_element_of_ones_own():
    loop = loop_of(stage())
    width = 0.05

    def drive(u, before):
        push = u[0] - before[0]
        play = before[0] if abs(push) <= width else u[0] - width * np.sign(push)
        return np.array([play, 0.2 * before[1] + u[1] - 0.5 * u[1] ** 3])

    elements = {"u1": Hysteresis(width), "u2": Cubic()}
    options = {"reference": MOVE, "duration": 0.4, "noise": False}
    run = simulate(loop, elements=elements, **options)
    same(run, by_hand(loop, run, {"die:ref": MOVE.at(run.time).position}, drive=drive))
    free = simulate(loop, **options)
    assert np.abs(run["die:error"] - free["die:error"]).max() > 0.01 * free.peak("die:error")
    both = simulate(loop, elements=elements, runs=2, **options)
    np.testing.assert_array_equal(both["u1"], [run["u1"]] * 2)


def test_lost_samples_are_the_last_ones_that_came():
    loop = loop_of(stage())
    options = {"reference": MOVE, "duration": 0.4, "noise": False, "elements": {"y1": Dropout(0.3)}}
    run = simulate(loop, rng=3, **options)
    y = run["y1"]
    moving = np.flatnonzero(y)[1:]
    lost = np.zeros(y.size, dtype=bool)
    lost[moving] = y[moving] == y[moving - 1]
    assert np.mean(lost[moving]) == pytest.approx(0.3, abs=0.06)
    # which ones are lost is all that is taken from the run
    pattern, held = iter(lost), []

    def sensed(now):
        held.append(held[-1] if next(pattern) else now[0])
        return np.array([held[-1], *now[1:]])

    same(run, by_hand(loop, run, {"die:ref": MOVE.at(run.time).position}, sensed=sensed))
    several = simulate(loop, rng=3, runs=[2, 0], **options)
    np.testing.assert_array_equal(several["y1"][1], y)
    assert np.any(several["y1"][0] != y)


def masses():
    """Two masses: POI and sensor at the second, force at the first, without a delay."""
    model = fx.chain(masses=[1.0, 0.5], stiffnesses=[4e4])
    ports = fx.Ports(
        w=[fx.Disturbance("d", at="1:x", asd=1.0)],
        u=[fx.Actuator("u1", at="1:x")],
        z=[fx.Poi("tip", at="2:x", axes=("x",))],
        y=[fx.Sensor("y1", at="2:x", asd=1e-9)],
    )
    return fx.assemble_plant(fx.solve_modes(model, damping=fx.ModalDamping(0.02)), ports)


@pytest.mark.parametrize("channel", ["u1", "y1"])
def test_jitter_is_that_of_switching_instants(channel):
    """Oracle: exponentials between the instants, which alone are taken from the run."""
    rate, finer, n = 1e3, 8, 150
    plant = masses()
    law = fx.lti.tustin(-50.0 * fx.lti.tf([0.02, 1.0], [0.002, 1.0]), rate)
    law = law.replace(inputs=["y1"], outputs=["u1"])
    loop = fx.close_loop(plant.discretized(rate), law)
    start = np.zeros(4 + law.n_states)
    start[:4] = np.linalg.lstsq(plant.system.C[:1], [1.0], rcond=None)[0]
    run = simulate(
        loop, duration=n / rate, finer=finer, noise=False, start=start, rng=2,
        elements={channel: Jitter(0.7e-3)},
    )  # fmt: skip
    u, y, tip = (run[name].reshape(n, finer) for name in ("u1", "y1", "tip:x"))
    late, early = np.zeros((2, n), dtype=int)
    if channel == "u1":
        late = np.argmax(u == u[:, -1:], axis=1)
        assert set(late) == set(range(7))
    else:
        for k in range(1, n):
            past = np.concatenate([tip[k - 1], tip[k, :1]])[::-1]
            early[k] = np.argmin(np.abs(past - y[k, 0]))
        assert set(early) == set(range(7))
    A, B = plant.system.A, plant.system.B[:, plant.system.input_index(["u1"])]
    C = plant.system.C[plant.system.output_index(["tip:x"])]
    whole = np.block([[A, B], [np.zeros((1, 5))]])
    fine = 1.0 / rate / finer

    def flown(x, force, steps):
        return (la.expm(steps * fine * whole) @ [*x, force])[:4]

    x, c, force = start[:4], start[4:], 0.0
    before = x
    for k in range(n):
        assert (C @ x)[0] == pytest.approx(tip[k, 0], rel=1e-7, abs=1e-9 * np.abs(tip).max())
        seen = x
        if early[k]:
            seen = flown(before, force, finer - early[k])
        reading = (C @ seen)[0]
        command = (law.C @ c)[0] + law.D[0, 0] * reading
        c = law.A @ c + law.B[:, 0] * reading
        before = x
        if late[k]:
            x = flown(x, force, late[k])
        x, force = flown(x, command, finer - late[k]), command


def sliding(stiffness, limit):
    """A mass on a spring to ground, moved aside and let go; no command."""
    model = fx.chain(masses=[2.0], stiffnesses=[], ground=800.0)
    ports = fx.Ports(
        w=[fx.Disturbance("guide", at="1:x", asd=1.0)], u=[fx.Actuator("u1", at="1:x")],
        z=[fx.Poi("tip", at="1:x", axes=("x",))], y=[fx.Sensor("y1", at="1:x", asd=1e-9)],
    )  # fmt: skip
    plant = fx.assemble_plant(fx.solve_modes(model), ports).discretized(2e3)
    idle = fx.StateSpace([], [], [], [[0.0]], 5e-4, inputs=["y1"], outputs=["u1"])
    loop = fx.close_loop(plant, idle)
    start = np.linalg.lstsq(plant.system.C[[0]], [0.1], rcond=None)[0]
    guide = Friction(limit, stiffness, reads="y1")
    return simulate(
        loop, duration=1.4, finer=4, noise=False, start=start, elements={"guide": guide}
    )


@pytest.mark.slow
def test_friction_takes_four_times_its_level_over_the_stiffness_a_cycle():
    """Closed form of Coulomb's oscillator: in half a period the peak falls by 2 F / k."""
    run = sliding(1e5, 4.0)
    x, half = run["tip:x"], np.pi / np.sqrt(800.0 / 2.0)
    for n in range(1, 9):
        peak = np.abs(x[np.abs(run.time - n * half) < 0.3 * half]).max()
        assert peak == pytest.approx(0.1 - 2 * n * 4.0 / 800.0, abs=1.5e-4)


@pytest.mark.slow
def test_friction_that_yields_is_that_of_the_midpoint_rule():
    """Oracle: the motion with its yielding spring as a differential equation, by hand."""
    run, limit, stiffness, dt = sliding(2e3, 3.0), 3.0, 2e3, 1.25e-4

    def rate(t, state):
        x, v, s = state
        yields = abs(s) >= limit and s * v > 0
        return [v, (-800.0 * x - s) / 2.0, 0.0 if yields else stiffness * v]

    state, found = np.array([0.1, 0.0, 0.0]), []
    for _ in range(4000):
        found.append(state[0])
        middle = state + 0.5 * dt * np.array(rate(0, state))
        state = state + dt * np.array(rate(0, middle))
        state[2] = np.clip(state[2], -limit, limit)
    np.testing.assert_allclose(run["tip:x"][:4000], found, rtol=0, atol=2e-4)


def test_offset_and_drift_of_a_sensor():
    """An array on the channel of a sensor's noise is added to what it measures."""
    loop = loop_of(stage())
    drift = 1e-6 + 1e-6 * np.arange(400) / 400
    run = simulate(loop, disturbance={"y1:noise": drift}, duration=0.2, noise=False)
    wanted = by_hand(loop, run, {"y1:noise": drift[: run.time.size]})
    same(run, wanted)
    assert np.any(run["die:z"])


def test_noise_has_the_spectrum_that_was_measured():
    """Oracle: Welch's average of SciPy; at its end the record does not meet its begin."""
    at, level = [5.0, 30.0, 200.0], [1e-4, 1e-3, 2e-5]
    record = fx.simulation.spectral_noise((at, level), rate=1e3, duration=200.0, rng=1)
    freq, power = signal.welch(record, 1e3, nperseg=1024)
    for f in (10.0, 60.0, 120.0):
        near = np.abs(freq / f - 1) < 0.1
        wanted = np.exp(np.interp(np.log(freq[near]), np.log(at), np.log(level))) ** 2
        assert np.mean(power[near] / wanted) == pytest.approx(1.0, abs=0.1)
    assert power[freq > 220].max() < 1e-4 * 2e-5**2
    again = fx.simulation.spectral_noise((at, level), rate=1e3, duration=200.0, rng=1)
    np.testing.assert_array_equal(again, record)
    ends = fx.simulation.spectral_noise(
        lambda f: 1e-3 * (f < 2), rate=100.0, duration=2.0, runs=400, rng=2
    )
    apart = np.mean((ends[:, -1] - ends[:, 0]) ** 2) / np.mean(ends**2)
    assert apart > 1.0  # samples of a ring would be neighbours: 0


@pytest.mark.slow
def test_one_over_f_at_a_sensor_moves_the_machine_as_its_integral_says():
    """Oracle: the integral of |T|^2 asd^2 over the lines of the record."""
    loop = loop_of(stage())
    asd, seconds = 1e-8, 1.0
    noise = fx.simulation.spectral_noise(
        lambda f: asd / np.sqrt(f), rate=RATE, duration=seconds, runs=48, rng=5
    )
    run = simulate(
        loop, disturbance={"y1:noise": noise}, duration=seconds, noise=False, runs=48, rng=1
    )
    half = run.time.size // 2
    found = np.mean(run["die:z"][:, half:] ** 2)
    freq = np.arange(1, 2 * run.time.size) * RATE / (4 * run.time.size)
    g = loop.system.select(["die:z"], ["y1:noise"])
    z = np.exp(2j * np.pi * freq / RATE)
    T = np.array(
        [(g.C @ np.linalg.solve(one * np.eye(len(g.A)) - g.A, g.B) + g.D)[0, 0] for one in z]
    )
    wanted = np.sum(np.abs(T) ** 2 * asd**2 / freq) * (freq[1] - freq[0])
    assert found == pytest.approx(wanted, rel=0.2, abs=0)


@pytest.mark.parametrize(
    "asd",
    [
        "pink",
        3.0,
        ([1.0, 2.0], [1.0, 0.0]),
        ([2.0, 1.0], [1.0, 1.0]),
        lambda f: -f,
        lambda f: f[:3],
    ],
)
def test_what_is_no_spectrum(asd):
    with pytest.raises(FlexplantError, match="asd"):
        fx.simulation.spectral_noise(asd, rate=100.0, duration=1.0)


@pytest.mark.parametrize("found", [3.0, [np.nan], [1j], "no"])
def test_what_an_element_may_not_return(found):
    class Wrong:
        def begin(self, dt, generators):
            return lambda values: found

    with pytest.raises(ModelError, match="an element returned"):
        simulate(loop_of(stage()), elements={"u1": Wrong()}, duration=0.01)


@pytest.mark.parametrize(
    ("elements", "said"),
    [
        ({"u1": Jitter(1e-4)}, "finer="),
        ({"u1": Cubic}, "must be a Saturation"),
        ({"amp": Hysteresis(1.0)}, "`reads`"),
        ({"amp": Friction(1.0, 1.0, "y7")}, "y7"),
        ({"u1": Jitter(1e-9)}, "one finer sample"),
    ],
)
def test_what_is_no_element(elements, said):
    with pytest.raises(FlexplantError, match=said):
        simulate(loop_of(stage()), elements=elements, duration=0.01)
    with pytest.raises(ModelError, match="must not be positive"):
        Saturation(1.0, least=0.5)


@pytest.mark.parametrize(
    ("begin", "said"),
    [
        (lambda dt: None, "cannot be called with the time between two samples"),
        (lambda dt, generators: 3.0, "is not a callable object"),
        (lambda dt, generators: lambda: 0.0, "cannot be called with the values"),
    ],
)
def test_an_element_that_cannot_be_called(begin, said):
    loop = loop_of(fx.testbeds.three_masses())
    with pytest.raises(ModelError, match=said):
        fx.simulate(loop, duration=0.01, elements={"u1": SimpleNamespace(begin=begin)}, rng=1)

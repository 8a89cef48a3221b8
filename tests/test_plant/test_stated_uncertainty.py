"""Uncertainty of one's own making: by what share frequency and damping of modes may be off."""

from functools import cache

import numpy as np
import pytest

import flexplant as fx
from flexplant.errors import LabelError, ModelError
from flexplant.plant import (
    Dampings,
    Delay,
    Frequencies,
    Gains,
    Parameters,
    Shapes,
    UnmodelledDynamics,
)
from stages import sampled, some_modes


@cache
def plant():
    return sampled(some_modes(1e-3, 8, attached=False))


def swing(one):
    """Frequency [rad/s] and damping ratio of each elastic mode, from the poles of A."""
    poles = np.linalg.eigvals(one.continuous.system.A)
    poles = poles[poles.imag > 1.0]
    poles = poles[np.argsort(np.abs(poles))]
    return np.abs(poles), -poles.real / np.abs(poles)


def test_delta_one_is_the_stated_share():
    omega, zeta = swing(plant())
    uncertain = plant().uncertain(frequency={4: 0.01, 6: 0.02}, damping={6: 0.3})
    assert [d.name for d in uncertain.deltas] == ["mode4:freq", "mode6:freq", "mode6:damping"]
    for sign in (-1.0, 1.0):
        moved = uncertain.lft({"mode4:freq": sign, "mode6:damping": sign})
        f, z = swing(moved)
        # the stiffness goes with the square of the frequency
        np.testing.assert_allclose(f[0] / omega[0], np.sqrt(1 + 0.02 * sign), rtol=1e-9)
        np.testing.assert_allclose(f[1:], omega[1:], rtol=1e-9)
        np.testing.assert_allclose(z[2] / zeta[2], 1 + 0.3 * sign, rtol=1e-6)


def test_one_number_is_for_all_elastic_modes_and_an_array_for_some():
    every = plant().uncertain(frequency=0.005, damping=0.3)
    assert sorted({d.mode for d in every.deltas}) == [4, 5, 6, 7, 8]
    assert {d.kind: d.scale for d in every.deltas} == {"freq": 0.01, "damping": 0.3}
    some = plant().uncertain(Frequencies([0.01, 0.02], modes=[5, 7]))
    assert {d.mode: d.scale for d in some.deltas} == {5: 0.02, 7: 0.04}


@pytest.mark.slow
def test_draws_spread_as_stated():
    """At delta = 1 two standard deviations: nearly all draws lie within."""
    omega = swing(plant())[0]
    draws = plant().uncertain(frequency=0.005).machines.drawn(200, rng=3)
    spread = np.array([swing(one)[0] for one in draws]) / omega - 1.0
    assert spread.std(axis=0) == pytest.approx(np.full(5, 0.0025), rel=0.2)
    # modes 7 and 8 are a pair, which the order of their poles makes alike
    several = np.corrcoef(spread[:, :4].T)[np.triu_indices(4, 1)]
    assert several == pytest.approx(np.zeros(6), abs=0.25)


@pytest.mark.parametrize(
    ("kinds", "error", "said"),
    [
        (lambda: [Frequencies(0.0)], ModelError, "nothing uncertain"),
        (lambda: [Frequencies(-0.1)], ModelError, "0 or more, got -0.1"),
        (lambda: [Frequencies({99: 0.01})], LabelError, "99"),
        (lambda: [Frequencies(0.01, modes=[1])], LabelError, "elastic mode of the plant"),
        (lambda: [Frequencies([0.01, 0.02])], fx.FlexplantError, "stiffness of a mode"),
        (
            lambda: [Frequencies(0.01), Frequencies({4: 0.02})],
            ModelError,
            "freq is uncertain twice",
        ),
        (lambda: [Dampings(1.5)], ModelError, "damping of mode 4"),
        (list, ModelError, "frequency=0.005"),
        (lambda: [Gains({"u9": 0.1})], LabelError, "u9"),
        (lambda: [Gains({"u1": 1.5})], ModelError, "sign is not known"),
        (lambda: [Delay(3.0)], ModelError, "cannot become negative"),
        (lambda: [Parameters({})], ModelError, "empty"),
        (lambda: [Parameters({"mass": 0.1})], ModelError, "AddedMass"),
        (
            lambda: [Parameters({fx.AddedMass("1:z"): 0.1})],
            ModelError,
            "ReducedModel or an FEModel",
        ),
    ],
)
def test_what_cannot_be_stated_is_refused(kinds, error, said):
    with pytest.raises(error, match=said):
        plant().uncertain(*kinds())


def test_no_mode_is_uncertain_by_a_measurement_and_a_share():
    pole = (-1e-3 + 1j) * swing(plant())[0][0]
    measured = fx.MeasuredModes([pole], modes=[4], covariance=1e-2 * np.eye(2))
    with pytest.raises(ModelError, match="mode4:freq is uncertain twice"):
        plant().uncertain(measured, frequency=0.01)
    both = plant().uncertain(measured, frequency={5: 0.01})
    names = [delta.name for delta in both.deltas]
    assert names == ["mode4:freq", "mode4:damping", "mode5:freq"]


def test_gains_and_delay_go_beside_a_source():
    omega = swing(plant())[0][:2]
    poles, covariance = (-1e-3 + 1j) * omega, np.diag([0.1, 0.1, 4.0, 4.0])
    measured = fx.MeasuredModes(poles, modes=[4, 5], covariance=covariance)
    uncertain = plant().uncertain(measured, Gains({"u1": 0.1}), Delay(0.2))
    names = [delta.name for delta in uncertain.deltas]
    assert names[-2:] == ["u1:gain", "delay"] and "mode4:freq" in names
    assert len({one.delay for one in uncertain.machines.drawn(3, rng=2)}) == 3


def response(system, freq):
    """The responses (p, m) of a system at z or s of a frequency [Hz], by its matrices."""
    s = np.exp(2j * np.pi * freq * system.dt) if system.dt else 2j * np.pi * freq
    A, B, C, D = system.A, system.B, system.C, system.D
    return C @ np.linalg.solve(s * np.eye(len(A)) - A, B) + D


def closed_deltas(uncertain, values):
    """The plant of some Deltas by the definition of the channels: w = delta z, by hand."""
    g = uncertain.system
    k = len(g.inputs) - len(uncertain.plant.w) - len(uncertain.plant.u)
    H = response(g, 130.0)
    owner = [uncertain.channels[name.removesuffix(":w")] for name in g.inputs[:k]]
    delta = np.diag([values[name] for name in owner])
    return H[k:, k:] + H[k:, :k] @ delta @ np.linalg.solve(np.eye(k) - H[:k, :k] @ delta, H[:k, k:])


def test_gains_of_actuators_and_sensors():
    uncertain = plant().uncertain(Gains({"u1": 0.05, "y2": 0.02}), frequency={4: 0.01})
    values = {"mode4:freq": 0.5, "u1:gain": 1.0, "y2:gain": -0.5}
    machine = uncertain.lft(values)
    only = uncertain.lft({"mode4:freq": 0.5})
    scale = np.ones((len(plant().y), len(plant().u)))
    scale[:, 0] *= 1.05
    scale[1] *= 0.99
    found, base = (response(one.Gyu, 130.0) for one in (machine, only))
    np.testing.assert_allclose(found, scale * base, rtol=1e-9, atol=1e-20)
    wanted = response(machine.continuous.system, 130.0)
    made = closed_deltas(uncertain, values)
    np.testing.assert_allclose(made, wanted, rtol=1e-9, atol=1e-9 * np.abs(wanted).max())
    # commands are not scaled, and neither is the noise
    assert machine.system.D[machine.system.outputs.index("u1:effort")].max() == 1.0
    noise = machine.system.outputs.index("y2"), machine.system.inputs.index("y2:noise")
    assert machine.system.D[noise] == 1.0


def test_the_delay():
    uncertain = plant().uncertain(Delay(0.2))
    machine = uncertain.lft({"delay": -0.5})
    wanted = plant().continuous.discretized(1.0 / plant().dt, delay=plant().delay - 0.1)
    found = response(machine.system, 130.0)
    np.testing.assert_allclose(found, response(wanted.system, 130.0), rtol=1e-9, atol=1e-20)
    assert len({one.delay for one in uncertain.machines.drawn(4, rng=1)}) == 4


def spring_of_masses(extra=0.0):
    model = fx.chain(masses=[1.0, 1.0, 1.0 + extra], stiffnesses=[4e5, 4e5])
    modes = fx.solve_modes(model, count=3, damping=fx.ModalDamping(0.01))
    drawing = fx.reduce(modes, fx.DesiredDofs(["1:x", "2:x", "3:x"]))
    ports = fx.testbeds.three_masses().assembled.ports
    return fx.assemble_plant(drawing, ports).discretized(2e3, delay=1.3)


@pytest.mark.slow
def test_a_parameter_of_the_model():
    """A mass known to 5 %: the machine is that of the heavier chain, shapes and all."""
    uncertain = spring_of_masses().uncertain(Parameters({fx.AddedMass("3:x"): 0.05}))
    assert "mass at 3:x" in repr(uncertain)
    assert "+- 0.05 kg" in repr(uncertain)
    found = uncertain.lft({"mass at 3:x": 1.0})
    model = fx.chain(masses=[1.0, 1.0, 1.05], stiffnesses=[4e5, 4e5])
    poles = np.linalg.eigvalsh(model.K.toarray() / np.sqrt(np.outer(*[model.M.diagonal()] * 2)))
    np.testing.assert_allclose(swing(found)[0], np.sqrt(poles[1:]), rtol=1e-3)
    wanted = response(found.continuous.system, 130.0)
    made = closed_deltas(uncertain, {"mass at 3:x": 1.0})
    np.testing.assert_allclose(made, wanted, rtol=1e-8, atol=1e-9 * np.abs(wanted).max())
    masses = np.array([swing(one)[0][0] for one in uncertain.machines.drawn(100, rng=1)])
    slope = (swing(found)[0][0] - swing(spring_of_masses())[0][0]) / 2.0
    assert masses.std() == pytest.approx(abs(slope), rel=0.25)  # two deviations at delta = 1


BESIDE = {"mass at 3:x": 1.0, "mode2:freq": -1.0, "mode3:damping": 1.0, "u1:gain": -0.5}


def every_kind(*more, frequency=0.02, damping=0.3, gain=0.1):
    return spring_of_masses().uncertain(
        Parameters({fx.AddedMass("3:x"): 0.05}),
        Frequencies({2: frequency}),
        Dampings({3: damping}),
        Gains({"u1": gain}),
        *more,
    )


@pytest.mark.slow
def test_a_parameter_beside_modes_and_gains():
    """The matrices by hand: a heavier mass, and K and D changed along two modes."""
    M, K = np.eye(3), np.array([[4e5, -4e5, 0.0], [-4e5, 8e5, -4e5], [0.0, -4e5, 4e5]])
    values, phi = np.linalg.eigh(K)
    omega = np.sqrt(np.maximum(values, 0.0))
    zeta = np.array([0.0, 0.01, 0.01 * 1.3])
    K = K - 0.04 * values[1] * np.outer(phi[:, 1], phi[:, 1])
    D = phi @ np.diag(2.0 * zeta * omega) @ phi.T
    M[2, 2] += 0.05
    A = np.block([[np.zeros((3, 3)), np.eye(3)], [-np.linalg.solve(M, K), -np.linalg.solve(M, D)]])
    poles = np.linalg.eigvals(A)
    poles = poles[poles.imag > 1.0]
    uncertain = every_kind()
    found = uncertain.lft(BESIDE)
    np.testing.assert_allclose(swing(found)[0], np.sort(np.abs(poles)), rtol=1e-6)
    s = 2j * np.pi * 130.0
    drive = np.linalg.solve(M * s**2 + D * s + K, np.array([1.0, 0.0, 0.0]))
    assert np.abs(response(found.continuous.Gyu, 130.0)).max() == pytest.approx(
        0.95 * np.abs(drive).max(), rel=1e-6
    )
    made, wanted = closed_deltas(uncertain, BESIDE), response(found.continuous.system, 130.0)
    np.testing.assert_allclose(made, wanted, rtol=1e-8, atol=1e-9 * np.abs(wanted).max())
    draws = every_kind(Delay(0.1)).machines.drawn(20, rng=1)
    assert len({one.delay for one in draws}) == 20
    assert len({swing(one)[0][0] for one in draws}) == 20
    with pytest.raises(ModelError, match="become negative"):
        every_kind(Delay(9.0))
    with pytest.raises(ModelError, match="sign is not known"):
        every_kind(gain=1.0)
    with pytest.raises(ModelError, match="of the shape of a mode"):
        every_kind(Shapes(0.01 * np.ones((1, 3, 1)), [2]))


@pytest.mark.long
def test_a_loop_under_all_kinds_at_once():
    """What mu calls stable is stable on machines at corners, which are solved anew."""
    plant = spring_of_masses()
    observer = fx.design_kalman(plant)
    servo = fx.design_servo(plant, bandwidth=20.0, observer=observer)
    uncertain = every_kind(Delay(0.1), frequency=0.005, damping=0.1)
    found = fx.synthesis.robust_stability(uncertain, observer, servo, machines=2)
    size = 0.98 / found.upper
    random = np.random.default_rng(1)
    loop = fx.close_loop(plant, observer, servo)
    for _ in range(16):
        corner = random.choice([-size, size], len(uncertain.deltas))
        values = {d.name: float(x) for d, x in zip(uncertain.deltas, corner, strict=True)}
        assert loop.around(uncertain.lft(values)).is_stable
    assert found.lower == 0.0 < found.upper < 1.0  # no worst machine is sought below 1


@pytest.mark.slow
def test_a_gain_margin_is_what_mu_says():
    """One uncertain gain: the loop is lost where its poles say so, of gains raised by hand."""
    P = fx.testbeds.three_masses()
    observer = fx.design_kalman(P)
    servo = fx.design_servo(P, bandwidth=20.0, observer=observer)
    uncertain = P.uncertain(Gains({"u1": 0.95}))
    found = fx.synthesis.robust_stability(uncertain, observer, servo, machines=2)

    def stable(delta):
        machine = uncertain.lft({"u1:gain": delta})
        return fx.loop.ClosedLoop(machine, *closed(P, observer, servo)).is_stable

    edge = 1.0 / found.upper
    assert found.lower == pytest.approx(found.upper, rel=0.02)
    assert stable(0.97 * edge) and stable(-0.97 * edge)
    assert not (stable(1.03 * edge) and stable(-1.03 * edge))


def closed(P, *blocks):
    loop = fx.close_loop(P, *blocks)
    return loop.blocks, loop.controller, loop.idle


@pytest.mark.parametrize(("rate", "amplifier"), [(0.0, 0.0), (5e3, 0.0), (0.0, 2e-3), (5e3, 2e-3)])
def test_the_gain_of_an_actuator_behind_its_own_filter(rate, amplifier):
    """It was refused: the filter's state was scaled in the one and not in the other.

    Noise at the amplifier's input passes the same gain.
    """
    model = fx.chain(masses=[2.0, 1.0], stiffnesses=[1e6], ground=[1e5, 0.0])
    modes = fx.solve_modes(model, count=2, damping=fx.ModalDamping(0.01))

    def made(gain):
        own = fx.Ports(
            u=[
                fx.Actuator(
                    "u1", at="1:x", dynamics=gain * fx.lti.low_pass_filter(500.0), asd=amplifier
                )
            ],
            y=[fx.Sensor("y1", at="2:x", asd=1e-10, dynamics=fx.lti.low_pass_filter(900.0))],
        )
        plant = fx.assemble_plant(modes, own)
        return plant.discretized(rate, delay=1.0) if rate else plant

    known = made(1.0).uncertain(Gains({"u1": 0.05}))
    changed, wanted = known.lft({"u1:gain": 1.0}), made(1.05)
    assert ("u1:disturbance" in wanted.w) == bool(amplifier)
    np.testing.assert_allclose(
        fx.frequency_response(changed.system, freq := [3.0, 50.0, 300.0]).data,
        fx.frequency_response(wanted.system, freq).data,
        rtol=1e-12,
    )


@pytest.mark.parametrize("rate", [0.0, 5e3])
@pytest.mark.parametrize(
    "kinds",
    [
        [Frequencies(0.01), Dampings(0.3)],
        [Frequencies(0.01), Gains({"u1": 0.1, "y1": 0.05})],
        [Gains({"u1": 0.1})],
    ],
)
def test_what_loops_feed_back_is_that_of_the_machines_drawn(kinds, rate):
    """The same random numbers; without motions of POIs and without noise of the samples."""
    own = plant().continuous
    uncertain = (own.discretized(rate, delay=1.3) if rate else own).uncertain(*kinds)
    sensors = [name for name in own.y if name not in own.w]
    machines = uncertain.machines
    bare, full = machines.each(3, rng=5, fed_back=True), machines.drawn(3, rng=5)
    for one, whole in zip(bare, full, strict=True):
        assert (tuple(one.y), one.dt, one.delay) == (tuple(sensors), whole.dt, whole.delay)
        given, known = (each.system.select(sensors, own.u) for each in (one, whole))
        assert given.states == known.states
        for name in "ABCD":
            np.testing.assert_allclose(getattr(given, name), getattr(known, name), rtol=1e-12)


def test_a_machine_with_unmodelled_dynamics_keeps_all_its_channels():
    weight = 0.1 * fx.lti.low_pass_filter(100.0)
    known = plant().uncertain(UnmodelledDynamics(weight, at="u1"), frequency=0.01)
    (one,) = known.machines.each(1, rng=2, fed_back=True)
    (whole,) = known.machines.drawn(1, rng=2)
    assert (one.w, one.z) == (whole.w, whole.z)
    np.testing.assert_array_equal(one.system.A, whole.system.A)

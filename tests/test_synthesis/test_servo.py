"""design_servo on a free plate: decoupling by F = m a, PID in closed form, dense eigenvalues."""

import warnings

import numpy as np
import pytest

from flexplant.errors import (
    AssumptionError,
    FlexplantWarning,
    LabelError,
    ModelError,
    ShapeError,
    SolverError,
)
from flexplant.estimation import design_kalman, design_static
from flexplant.loop import close_loop
from flexplant.plant import Actuator, Poi, assemble_plant
from flexplant.synthesis import Controller, design_servo
from flexplant.testbeds import maglev_block
from judge import through
from stages import INSET, RATE, Z8, L, block, fitted, ports, reduced, sampled, some_modes

MASS = L * L * 0.0272 * 2702
INERTIA = MASS * L * L / 12
HATS = ["die:hat", "die:rx:hat", "die:ry:hat"]
CENTRE = np.array([L / 2, L / 2])


def rigid_gain(poi, places):
    """Accelerations (z, rx, ry) of a rigid plate at a point per force: F = m a, M = J alpha."""
    rows = []
    p = np.asarray(poi[:2]) - CENTRE
    for place in places:
        x, y = np.asarray(place[:2]) - CENTRE
        rx, ry = y / INERTIA, -x / INERTIA
        rows.append([1 / MASS + p[1] * rx - p[0] * ry, rx, ry])
    return np.array(rows).T


def at(system, freq, inputs):
    z = np.exp(2j * np.pi * freq * system.dt)
    B = system.B[:, [system.inputs.index(name) for name in inputs]]
    D = system.D[:, [system.inputs.index(name) for name in inputs]]
    return system.C @ np.linalg.solve(z * np.eye(system.n_states) - system.A, B) + D


def pid(freq, bandwidth, *, rolloff=None, integrator=None, notches=(), rate=RATE):
    """Closed form of one axis: Tustin's s, roll-off and notches stay where they are asked."""

    def warped(f):
        return 2 * rate * np.tan(np.pi * f / rate)

    def shape(f):
        s = 1j * warped(f)
        w = 2 * np.pi * bandwidth
        p = s / warped(rolloff or 8 * bandwidth)
        slow = 2 * np.pi * (integrator or bandwidth / 10)
        value = (1 + slow / s) * (1 + 4 * s / w) / (1 + s / (4 * w))
        value = value / (p**2 + np.sqrt(2) * p + 1)
        for f0 in notches:
            q = s / warped(f0)
            value = value * (q**2 + 2 * 0.05 * 0.3 * q + 1) / (q**2 + 2 * 0.3 * q + 1)
        return value

    return (2 * np.pi * bandwidth) ** 2 * shape(freq) / abs(shape(bandwidth))


def exact(plant, channels, bandwidth, **options):
    """The law by dense solves: pinv(G(sigma)), each axis crossing 1 by its response at j omega."""
    g = plant.system
    rows = [g.outputs.index(name) for name in channels]
    B, D = g.B[:, -8:][:, -4:], g.D[rows, -4:]

    def response(s):
        z = np.exp(s * g.dt)
        return g.C[rows] @ np.linalg.solve(z * np.eye(g.n_states) - g.A, B) + D

    w = 2 * np.pi * bandwidth
    T = np.linalg.pinv(response(w).real)
    size = np.abs(np.diag(response(1j * w) @ T))
    return lambda freq: T * pid(freq, bandwidth, **options) / w**2 / size


#: how far a plate that bends at 245 Hz is from F = m a at 50 Hz
BENT = 0.01


@pytest.mark.slow
@pytest.mark.parametrize("die", [(L / 2, L / 2, 0.0), (0.31, 0.1, 0.0)])
@pytest.mark.parametrize("notches", [(), (459.0, 640.0)])
def test_the_controller_in_closed_form(die, notches):
    plant = sampled(reduced(), ports(die=die))
    servo = design_servo(plant, bandwidth=50.0, notches=notches)
    law = exact(plant, ["die:z", "die:rx", "die:ry"], 50.0, notches=notches)
    assert servo.system.inputs == ("die:ref", *HATS)
    assert servo.system.outputs == ("u1", "u2", "u3", "u4")
    gain = rigid_gain(die, INSET)
    for freq in (2.0, 50.0, 459.0, 2000.0):
        K = at(servo.system, freq, HATS)
        np.testing.assert_allclose(K, -law(freq), rtol=1e-6, atol=1e-9 * abs(K).max())
        # nearly that of F = m a: the plate bends a little
        nearly = gain @ K / -pid(freq, 50.0, notches=notches)
        scale = np.diag([1.0, L, L])
        unit = np.linalg.inv(scale) @ nearly @ scale
        np.testing.assert_allclose(unit, np.eye(3), atol=6 * BENT)
        ref = at(servo.system, freq, ["die:ref"])
        np.testing.assert_allclose(ref[:, 0], -K[:, 0], rtol=1e-9, atol=1e-15 * abs(K).max())


@pytest.mark.slow
def test_the_decoupling_takes_least_force():
    # oracle: the pseudo-inverse of F = m a; four actuators, three motions
    servo = design_servo(sampled(reduced()), bandwidth=50.0, notches=())
    T_u = at(servo.system, 50.0, HATS) / -pid(50.0, 50.0)
    wanted = np.linalg.pinv(rigid_gain((L / 2, L / 2), INSET))
    np.testing.assert_allclose(T_u, wanted, rtol=BENT, atol=BENT * abs(wanted).max())
    np.testing.assert_allclose(T_u[:, 0], MASS / 4, rtol=BENT)
    null = np.array([1.0, -1.0, -1.0, 1.0])  # four forces that move no axis
    np.testing.assert_allclose(null @ T_u, 0.0, atol=BENT * abs(wanted).max())
    thick = design_servo(sampled(reduced(thickness=0.0272 * 1.01)), bandwidth=50.0, notches=())
    T_u = at(thick.system, 50.0, HATS) / -pid(50.0, 50.0)
    np.testing.assert_allclose(T_u[:, 0], 1.01 * MASS / 4, rtol=0.5 * BENT)


def test_options_reach_the_controller():
    plant = sampled(reduced())
    options = {"rolloff": 250.0, "integrator": 2.0, "notches": ()}
    servo = design_servo(plant, bandwidth=30.0, **options)
    K = at(servo.system, 100.0, HATS)
    found = rigid_gain((L / 2, L / 2), INSET) @ K
    np.testing.assert_allclose(found[0, 0], -pid(100.0, 30.0, **options), rtol=BENT)


@pytest.mark.slow
@pytest.mark.parametrize("delay", [0, 1, 1.5, 2])
@pytest.mark.parametrize("bandwidth", [10.0, 50.0])
def test_the_certificate_and_the_crossover_by_dense_matrices(delay, bandwidth):
    """Closed by hand on the POI: eigenvalues, |S| at u, and |L| = 1 at the bandwidth, as asked."""
    plant = sampled(reduced(), delay=delay)
    servo = design_servo(plant, bandwidth=bandwidth, notches=())
    g, k = plant.system, servo.system
    rows = [g.outputs.index(name) for name in ("die:z", "die:rx", "die:ry")]
    B, C = g.B[:, -4:], g.C[rows]
    Bk, Dk = k.B[:, 1:], k.D[:, 1:]
    A = np.block([[g.A + B @ Dk @ C, B @ k.C], [Bk @ C, k.A]])
    found = servo.certificate
    assert found["spectral radius"] == pytest.approx(np.abs(np.linalg.eigvals(A)).max(), abs=1e-6)

    def loop(f):
        z = np.exp(2j * np.pi * f / RATE)
        P = C @ np.linalg.solve(z * np.eye(g.n_states) - g.A, B)
        return at(k, f, HATS) @ P, P @ at(k, f, HATS)

    np.testing.assert_allclose(np.abs(np.diag(loop(bandwidth)[1])), 1.0, rtol=1e-6)
    freq = through(np.linalg.eigvals(A), plant.dt)
    least = min(np.linalg.svd(np.eye(4) - loop(f)[0])[1][-1] for f in freq[freq > 1.0])
    assert (1 - 2e-2) * least < found["modulus margin"] <= least * (1 + 1e-6)


def test_the_loop_on_the_plate_is_stable_and_turns_unstable_with_the_sign():
    plant = sampled(reduced())
    observer, servo = design_kalman(plant), design_servo(plant, bandwidth=50.0, notches=[463.1])
    loop = close_loop(plant, observer, servo)
    assert loop.spectral_radius < 1
    assert -20 * np.log10(loop.modulus_margin) < 6.0
    g = servo.system
    wrong = g.replace(C=-g.C, D=-g.D)
    with pytest.warns(FlexplantWarning, match="unstable"):
        assert close_loop(plant, observer, wrong).spectral_radius > 1


def test_the_loop_follows_a_constant_reference():
    plant = sampled(reduced())
    servo = design_servo(plant, bandwidth=50.0)
    loop = close_loop(plant, design_static(plant), servo).system
    still = loop.C @ np.linalg.solve(np.eye(loop.n_states) - loop.A, loop.B) + loop.D
    rows = [loop.outputs.index(name) for name in ("die:z", "die:error")]
    column = loop.inputs.index("die:ref")
    np.testing.assert_allclose(still[rows, column], [1.0, 0.0], atol=1e-5)


@pytest.mark.slow
def test_one_of_several_pois_and_no_reference():
    axes = ("z", "rx", "ry")
    two = [Poi("die", at=(L / 2, L / 2, 0.0), axes=axes), Poi("edge", at=Z8, axes=axes)]
    plant = sampled(some_modes(), ports(z=two, references=[]))
    servo = design_servo(plant, bandwidth=50.0, poi="edge", notches=())
    assert servo.system.inputs == ("edge:hat", "edge:rx:hat", "edge:ry:hat")
    gain = rigid_gain(Z8, INSET)
    K = at(servo.system, 50.0, servo.system.inputs)
    scale = np.diag([1.0, L, L])
    unit = np.linalg.inv(scale) @ gain @ K @ scale / -pid(50.0, 50.0)
    np.testing.assert_allclose(unit, np.eye(3), atol=6 * BENT)
    with pytest.raises(AssumptionError, match=r"do not move these axes apart: die:z, .*axes=\["):
        design_servo(plant, bandwidth=50.0)
    with pytest.raises(LabelError, match="no POI 'dye'"):
        design_servo(plant, bandwidth=50.0, poi="dye")


@pytest.mark.slow
def test_what_it_is():
    servo = design_servo(sampled(reduced()), bandwidth=50.0, notches=())
    assert isinstance(servo, Controller)
    assert repr(servo).startswith("<Controller servo 50 Hz: 12 states")
    assert "lines: die:z mass, die:rx mass, die:ry mass" in repr(servo)
    assert servo.gamma is None
    assert set(block(servo.system)) == {"A", "B", "C", "D", "inputs", "outputs"}
    after = fitted(reduced(), [-28.569 + 2883.567j, -39.451 + 3983.308j]).model
    heavier = design_servo(sampled(after), bandwidth=50.0, notches=())
    T_u = at(heavier.system, 50.0, HATS) / -pid(50.0, 50.0)
    assert T_u[:, 0].sum() == pytest.approx(MASS + 0.5, rel=1e-2)


@pytest.mark.parametrize("name", ["bandwidth", "rolloff", "integrator"])
@pytest.mark.parametrize("bad", [0.0, -1.0, np.nan, np.inf])
def test_bad_frequencies(name, bad):
    options = {"bandwidth": 50.0} | {name: bad}
    with pytest.raises(ModelError, match=r"must be positive|has a NaN|not well below"):
        design_servo(sampled(some_modes()), **options)


@pytest.mark.slow
def test_a_fast_servo_keeps_its_rolloff_below_half_the_rate():
    plant = maglev_block(delay=0)
    with warnings.catch_warnings():  # the block's modes are unstable at this bandwidth
        warnings.simplefilter("ignore", FlexplantWarning)
        fast = design_servo(plant, bandwidth=0.06 * RATE, notches=())
        given = design_servo(plant, bandwidth=0.06 * RATE, notches=(), rolloff=0.4 * RATE)
    np.testing.assert_array_equal(fast.system.A, given.system.A)


@pytest.mark.slow
def test_refusals():
    plant = sampled(some_modes())
    with pytest.raises(ModelError, match="bandwidth 5000 Hz is not well below the rate"):
        design_servo(plant, bandwidth=5000.0)
    with pytest.raises(SolverError, match=r"unstable \(phase margin -.*Lower the bandwidth"):
        design_servo(sampled(some_modes(), delay=3), bandwidth=1500.0)
    with pytest.raises(ModelError, match="notch must be positive"):
        design_servo(plant, bandwidth=50.0, notches=[-1.0])
    with pytest.raises(ShapeError, match=r"notches must have shape \(any,\), got the number 459"):
        design_servo(plant, bandwidth=50.0, notches=459.0)
    for name, options in (
        ("notch", {"notches": [459.0, 0.5 * RATE]}),
        ("notch", {"notches": [6000.0]}),
        ("rolloff", {"rolloff": 0.7 * RATE}),
        ("integrator", {"integrator": 0.5 * RATE}),
    ):
        with pytest.raises(ModelError, match=rf"{name} .* not below half the rate, 5000 Hz.*Leave"):
            design_servo(plant, bandwidth=50.0, **options)
    with pytest.raises(AssumptionError, match=r"discretized\(rate"):
        design_servo(assemble_plant(some_modes(), ports()), bandwidth=50.0)
    with pytest.raises(ModelError, match="need a StandardPlant, got 'plant'"):
        design_servo("plant", bandwidth=50.0)
    with pytest.raises(ModelError, match=r"weighted.*plant.unweighted"):
        design_servo(plant.weighted(z={"die:z": 2.0}), bandwidth=50.0)
    with pytest.raises(AssumptionError, match="no POI"):
        design_servo(plant.with_ports(ports(z=[], references=[])), bandwidth=50.0)
    few = ports(u=[Actuator("u1", at=INSET[0]), Actuator("u2", at=INSET[1])])
    with pytest.raises(
        AssumptionError, match="do not move these axes apart: die:z, die:rx, die:ry"
    ):
        design_servo(plant.with_ports(few), bandwidth=50.0, axes=["die:z", "die:rx", "die:ry"])
    with pytest.raises(AssumptionError, match="u does not reach the rigid-body"):
        design_servo(plant.with_ports(few), bandwidth=50.0)
    with pytest.raises(LabelError, match="no axis 'die:x'"):
        design_servo(plant, bandwidth=50.0, axes=["die:x"])
    with pytest.raises(LabelError, match="no bandwidth is given for die:rx, die:ry"):
        design_servo(plant, bandwidth={"die:z": 50.0})

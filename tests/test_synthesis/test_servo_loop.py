"""The loop that a servo runs in: certificate, notches, largest bandwidth; oracle: dense loops."""

from functools import cache

import numpy as np
import pytest

from flexplant.errors import FlexplantWarning, LabelError, ModelError, SolverError
from flexplant.estimation import design_kalman, design_static
from flexplant.labels import DofSet
from flexplant.loop import close_loop
from flexplant.loop.broken import sensitivity
from flexplant.lti import StateSpace
from flexplant.modes import solve_modes
from flexplant.plant import Actuator, Disturbance, Poi, Ports, Reference, Sensor, assemble_plant
from flexplant.plant.axes import gains_at
from flexplant.structure import FEModel, ModalDamping, chain
from flexplant.synthesis import design_servo, servo_bandwidth
from flexplant.synthesis.laws.servo_design import servo_task
from flexplant.synthesis.laws.servo_loops import Notched, verified_suppression
from flexplant.testbeds import flexible_joint, gantry, three_masses, wafer_stage
from oracles_plant import closed_loop
from stages import RATE, block, calibrated, ports, reduced, sampled

U, Y = [f"u{i}" for i in range(1, 5)], [f"y{i}" for i in range(1, 5)]


@cache
def machine():
    return wafer_stage(damping=0.001, rate=RATE, delay=1)


@cache
def updated():
    plant = sampled(calibrated(reduced(0.001), machine()))
    return plant, design_static(plant), design_kalman(plant)


def truth():
    return assemble_plant(machine().truth, ports()).discretized(RATE, delay=1)


def dense(plant, *systems):
    """Eigenvalues of plant and blocks, dense."""
    g = plant.system
    B, C = g.B[:, -4:], g.C[-5:-1]
    A, _, _ = closed_loop({"A": g.A, "B": B, "C": C}, Y, U, [block(s) for s in systems])
    return np.abs(np.linalg.eigvals(A)).max()


def peak_at_u(plant, observer, servo, freq):
    """max sigma_max of S at u by dense solves."""
    g, top = plant.system, 0.0
    hats = [servo.inputs.index(name) for name in observer.outputs]
    reads = [list(observer.inputs).index(n) for n in Y]
    gives = [list(observer.inputs).index(n) for n in U] if "u1" in observer.inputs else None

    def at(s, z):
        return s.C @ np.linalg.solve(z * np.eye(s.n_states) - s.A, s.B) + s.D

    for z in np.exp(2j * np.pi * freq / RATE):
        P = g.C[-5:-1] @ np.linalg.solve(z * np.eye(g.n_states) - g.A, g.B[:, -4:])
        hat, K = at(observer, z), at(servo, z)[:, hats]
        G = hat[:, reads] @ P + (0 if gives is None else hat[:, gives])
        top = max(top, np.linalg.norm(np.linalg.inv(np.eye(4) - K @ G), 2))
    return top


@pytest.mark.slow
@pytest.mark.parametrize("which", [1, 2], ids=["static", "kalman"])
def test_the_certificate_is_of_the_loop_that_runs(which):
    plant, observer = updated()[0], updated()[which]
    servo = design_servo(plant, bandwidth=50.0, observer=observer)
    found = servo.certificate
    radius = dense(plant, observer.system, servo.system)
    assert radius < 1
    assert found["spectral radius"] == pytest.approx(radius, abs=1e-7)
    loop = close_loop(plant, observer, servo)
    poles = np.log(np.linalg.eigvals(loop.system.A) + 1e-300) * RATE / (2 * np.pi)
    poles = poles[poles.imag > 3.0]
    near = (poles.imag + np.abs(poles.real) * np.linspace(-3, 3, 9)[:, None]).ravel()
    freq = np.unique(np.append(np.geomspace(3, 4900, 300), near[near > 3.0]))
    top = peak_at_u(plant, observer.system, servo.system, freq[freq < 4990])
    # the grid of the oracle may miss the top of a resonance, not exceed it
    assert 0.95 / top < found["modulus margin"] < (1 + 1e-6) / top
    # stable on the machine too
    assert dense(truth(), observer.system, servo.system) < 1


@pytest.mark.slow
def test_without_an_observer_the_loop_is_on_the_poi_itself():
    plant = updated()[0]
    servo = design_servo(plant, bandwidth=50.0)
    assert "certified on the POI itself" in repr(servo)
    g, nz = plant.system, len(plant.z)
    C = g.C[[plant.z.index(name) for name in ("die:z", "die:rx", "die:ry")]]
    hats = list(servo.system.inputs[1:])
    A, _, _ = closed_loop({"A": g.A, "B": g.B[:, -4:], "C": C}, hats, U, [block(servo.system)])
    radius = np.abs(np.linalg.eigvals(A)).max()
    assert nz and servo.certificate["spectral radius"] == pytest.approx(radius, abs=1e-7)


@pytest.mark.long
def test_notches_are_placed_where_they_serve():
    """The Kalman estimate brings the bowl mode back: unstable without a notch, 5 dB with."""
    plant, static, kalman = updated()
    bowl, rate = plant.model.modes().freq[5], 1.0 / plant.dt
    place = rate / np.pi * np.arctan(np.pi * bowl / rate)  # 0.7 % below the mode
    servo = design_servo(plant, bandwidth=50.0, observer=kalman)
    by_hand = design_servo(plant, bandwidth=50.0, observer=kalman, notches=[place])
    assert f"notches at {place:.4g} Hz" in repr(servo)
    np.testing.assert_allclose(servo.system.A, by_hand.system.A, rtol=1e-9)
    with pytest.raises(SolverError, match=r"with its observer is unstable .*mode 6 \(at 45\d"):
        design_servo(plant, bandwidth=50.0, observer=kalman, notches=())
    # the static relation does not see that mode, but another one: on the machine too
    found, without = (
        design_servo(plant, bandwidth=50.0, observer=static, notches=notches)
        for notches in (None, ())
    )
    assert f"{place:.4g} Hz" not in repr(found)
    margins = [machine().loop(ports(), static, one).modulus_margin for one in (found, without)]
    assert margins[0] > 0.55 > 0.5 > margins[1]


@pytest.mark.slow
def test_a_servo_that_cannot_run_is_refused_with_what_finds_one_that_can():
    plant, static, kalman = updated()
    for observer, bandwidth in ((static, 100.0), (kalman, 80.0)):
        with pytest.raises(SolverError, match=r"mode \d+ .* servo_bandwidth finds .* 6 dB"):
            design_servo(plant, bandwidth=bandwidth, observer=observer, notches=())


@pytest.mark.long
def test_one_flipped_sign_is_unstable():
    plant, _, kalman = updated()
    servo = design_servo(plant, bandwidth=50.0, observer=kalman)
    g = servo.system
    for i in (0, 3):
        signs = np.ones(4)
        signs[i] = -1.0
        wrong = g.replace(C=signs[:, None] * g.C, D=signs[:, None] * g.D)
        with pytest.warns(FlexplantWarning, match="unstable"):
            assert close_loop(plant, kalman, wrong).modulus_margin == 0.0
    lying = kalman.system.replace(C=-kalman.system.C, D=-kalman.system.D)
    with pytest.raises(SolverError, match="unstable"):
        design_servo(plant, bandwidth=50.0, observer=lying)


@pytest.mark.long
def test_the_largest_bandwidth_that_holds_6_dB():
    plant, observer = updated()[:2]
    reach = servo_bandwidth(plant, observer=observer)
    servo = design_servo(plant, bandwidth=reach, observer=observer)
    margin = servo.certificate["modulus margin"]
    assert 0.5 <= margin < 0.55
    beyond = design_servo(plant, bandwidth=1.1 * reach, observer=observer)
    assert beyond.certificate["modulus margin"] < 0.5
    assert ["servo_bandwidth" in repr(one) for one in (servo, beyond)] == [False, True]
    assert servo_bandwidth(plant, observer=observer, peak=4.0) > reach


def three_late_masses(chain):
    """A plant with delay, with a chain of two more masses beside it that nothing touches."""
    springs = [(0, 1, 4e6), (1, 2, 4e6), (3, 4, 3e4), (3, 3, 3e4)][: 4 if chain else 2]
    n = 5 if chain else 3
    K = np.zeros((n, n))
    for i, j, k in springs:
        row = np.eye(n)[i] - (i != j) * np.eye(n)[j]
        K += k * np.outer(row, row)
    dofs = DofSet(np.arange(1, n + 1), ["x"] * n, np.zeros((n, 3)))
    model = FEModel(M=np.diag([4.0, 1, 1, 1, 1][:n]), K=K, dofs=dofs)
    modes = solve_modes(model, count=n, damping=ModalDamping(0.01))
    place = Ports(
        w=[Disturbance("d", at="3:x", asd=1e-3)],
        u=[Actuator("u", at="1:x")],
        z=[Poi("p", at="3:x")],
        y=[Sensor("y", at="1:x", asd=1e-12)],
        references=[Reference("p")],
    )
    return assemble_plant(modes, place).discretized(1e3, delay=4.0)


@pytest.mark.slow
def test_modes_that_nothing_touches_do_not_choose_the_law():
    alone, beside = (servo_bandwidth(three_late_masses(chain)) for chain in (False, True))
    assert alone > 15.0  # 6.7 Hz without a wide lead
    assert beside == pytest.approx(alone, rel=1e-6)


def test_search_and_certificate_break_the_same_loop():
    """An observer that reads u is inside: S at the plant's input, on every frequency of the grid.

    Intensities of noise from a quick estimate to a slow one, and an observer that reads no u.
    """
    plant = three_masses()
    sides = {"y1": "1:x", "y2": "3:x"}
    plants = []
    for asd in (1e-12, 1e-10, 1e-8, 1e-7):
        y = [Sensor(name, at=place, asd=asd) for name, place in sides.items()]
        seen = plant.assembled.ports.replace(y=y)
        plants.append(assemble_plant(plant.model, seen).discretized(2e3, delay=1))
    pairs = [(plant, design_static(plant)), *((one, design_kalman(one)) for one in plants)]
    for one, observer in pairs:
        task = servo_task(one, None, None, None, None, (), observer)
        for bandwidth in (5.0, 20.0):
            law = task.law(bandwidth)
            found = sensitivity(*task.loop.broken(law))
            gain = task.closed(law).broken.gain(task.loop.freq)
            np.testing.assert_allclose(found @ (np.eye(gain.shape[1]) - gain), 1.0, rtol=1e-6)
            # and |S| of the reference, by the closed loop from w to z
            assert task._suppressed_up_to(law) == pytest.approx(
                verified_suppression(task.closed(law))
            )


def four_masses():
    """Four masses of which the second carries motor and sensor."""
    model = chain(masses=[6.71, 0.28, 0.58, 0.66], stiffnesses=[80727.0, 4437.0, 1297281.0])
    return assemble_plant(
        solve_modes(model, count=4, damping=ModalDamping(0.0011)),
        Ports(
            w=[Disturbance("w", at="2:x", asd=1e-3)],
            u=[Actuator("u", at="2:x")],
            z=[Poi("die", at="2:x", axes=("x",))],
            y=[Sensor("y", at="2:x", direction="x", asd=1e-10)],
            references=[Reference("die")],
        ),
    ).discretized(5382.0, delay=1)


def test_a_bandwidth_between_unstable_ones_is_found():
    """A chain that holds 6 dB near 46 Hz, below 10.5 Hz, and at none between."""
    plant = four_masses()
    reach = servo_bandwidth(plant)
    assert 40.0 < reach < 55.0
    assert design_servo(plant, bandwidth=reach).certificate["modulus margin"] >= 0.5


@pytest.mark.slow
@pytest.mark.parametrize("make", [four_masses, gantry, flexible_joint])
def test_no_set_of_notches_that_was_ruled_out_serves_better(make):
    """Every set is judged by the closed loop itself, from frequencies far too high to low ones."""
    plant = make()
    task, counts = servo_task(plant, None, None, None, None, None, None), []
    for bandwidth in np.geomspace(0.05, 5e-4, 8) / plant.dt:
        driven = task.driven(float(bandwidth))
        plain = task._plain(driven, np.abs(gains_at(plant, driven)))[0]
        found = task.loop.notched(plain, False, 4.0)
        sets = Notched.all(plain, task.loop._options(plain))
        laws = [sets.some(slice(i, i + 1)).first for i in range(len(sets.chosen))]
        margins = np.array([task.closed(law).modulus_margin for law in laws])
        fewest = np.array([len(law.notches) for law in laws])
        if found is None:
            assert margins.max() < 0.26
            continue
        own = task.closed(found).modulus_margin
        counts.append(len(found.notches))
        like = fewest <= len(found.notches) if own >= 0.5 else fewest >= 0
        assert own >= 0.97 * margins[like].max()
        if own >= 0.5:
            assert margins[fewest < len(found.notches)].max(initial=0.0) < 0.515
    assert len(set(counts)) > 1  # some bandwidths need more notches than others


def test_where_the_estimate_leans_on_the_model_a_bandwidth_is_found():
    """A slow Kalman estimate reads u more than y: broken where both read u no bandwidth held."""
    plant = sampled(reduced(), ports(sensor_asd=1e-8))
    observer = design_kalman(plant)
    held = design_servo(plant, bandwidth=50.0, observer=observer).certificate["modulus margin"]
    assert held > 0.5
    reach = servo_bandwidth(plant, observer=observer)
    assert reach > 50.0
    servo = design_servo(plant, bandwidth=reach, observer=observer)
    assert servo.certificate["modulus margin"] >= 0.5


@pytest.mark.long
def test_modes_left_out_count():
    """The truth as the evaluation model; a higher rate's roll-off reaches its modes less."""
    plant, static, _ = updated()
    servo = design_servo(plant.replace(evaluation=truth()), bandwidth=50.0, observer=static)
    assert servo.left_out.is_stable
    radius = dense(truth(), static.system, servo.system)
    key = "spectral radius with truncated modes"
    assert servo.certificate[key] == pytest.approx(radius, abs=1e-7)
    quick = {"rolloff": 4000.0, "notches": (), "observer": static}
    reach = servo_bandwidth(plant, **quick)
    with_all = servo_bandwidth(plant.replace(evaluation=truth()), **quick)
    assert with_all <= reach * (1 + 1e-9)


@pytest.mark.slow
def test_refusals():
    plant, static, kalman = updated()
    with pytest.raises(LabelError, match="the servo acts on die:ry:hat too"):
        design_servo(
            plant, bandwidth=50.0, observer=static.system.select(outputs=["die:hat", "die:rx:hat"])
        )
    other = kalman.system.renamed(inputs={"y1": "q1"})
    with pytest.raises(LabelError, match="reads q1"):
        design_servo(plant, bandwidth=50.0, observer=other)
    with pytest.raises(ModelError, match="the observer is a str, not a system"):
        design_servo(plant, bandwidth=50.0, observer="kalman")
    slower = kalman.system.replace(dt=2.0 * plant.dt)
    with pytest.raises(ModelError, match=r"the observer <.*> has dt .* s, the plant"):
        design_servo(plant, bandwidth=50.0, observer=slower)
    with pytest.raises(ModelError, match="peak must be above 1"):
        servo_bandwidth(plant, peak=1.0)
    # the law is the cause: at a few hertz rate and delay take hardly any phase
    with pytest.raises(SolverError, match=r"no bandwidth from .*rate and delay take only") as none:
        servo_bandwidth(three_masses(), peak=1.02)
    assert "aise the rate" not in str(none.value)
    assert isinstance(static.system, StateSpace)

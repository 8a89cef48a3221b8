"""Loop quantities of a measured plant: the controller is closed on the FRF first.

Model and machine are one mesh: the exact response of the machine is the oracle of what is measured.
"""

from collections import Counter
from functools import cache

import numpy as np
import pytest
import scipy.linalg as la

from flexplant.errors import LabelError, ModelError
from flexplant.estimation import design_static
from flexplant.loop import (
    bandwidth,
    close_loop,
    complementary_sensitivity,
    control_sensitivity,
    loop_gain,
    modulus_margin,
    sensitivity,
)
from flexplant.loop.measured_loop import broken_count, measured_between
from flexplant.lti import Frf, StateSpace, frequency_response
from flexplant.plant import Sensor, assemble_plant
from flexplant.synthesis import design_servo
from flexplant.testbeds import wafer_stage
from stages import CORNERS, RATE, full, ports

QUANTITIES = [loop_gain, sensitivity, complementary_sensitivity, control_sensitivity]


@cache
def loop_of(mass=0.5):
    """A servo on the static estimate, closed around the plant with the delay of one sample."""
    plant = assemble_plant(full(mass=mass), ports()).discretized(RATE, delay=1)
    return close_loop(plant, design_static(plant), design_servo(plant, bandwidth=40.0))


def frf_of(loop, freq):
    return frequency_response(loop.plant.system.select(loop.fed_back, loop.driven), freq)


@pytest.mark.slow
@pytest.mark.parametrize("quantity", QUANTITIES)
def test_an_frf_of_the_model_gives_what_the_model_gives(quantity):
    loop, freq = loop_of(), np.geomspace(2.0, 2000.0, 60)
    measured, modelled = quantity((frf_of(loop, freq), loop)), quantity(loop, freq=freq)
    assert (measured.inputs, measured.outputs) == (modelled.inputs, modelled.outputs)
    size = np.abs(modelled.data).max()
    np.testing.assert_allclose(measured.data, modelled.data, rtol=1e-7, atol=1e-9 * size)
    if quantity is not control_sensitivity:
        at_y = quantity((frf_of(loop, freq), loop), at="y")
        wanted = quantity(loop, freq=freq, at="y")
        assert at_y.inputs == tuple(loop.fed_back)
        np.testing.assert_allclose(at_y.data, wanted.data, rtol=1e-6, atol=1e-7)


@pytest.mark.slow
def test_channels_of_the_frf_in_any_order_and_more_of_them():
    loop, freq = loop_of(), np.geomspace(5.0, 500.0, 20)
    frf = frf_of(loop, freq)
    extra = np.concatenate([frf.data, 7 * frf.data[:1]])[::-1]
    shuffled = Frf(
        freq, extra[:, ::-1], inputs=frf.inputs[::-1], outputs=("spare", *frf.outputs[::-1])
    )
    np.testing.assert_allclose(
        sensitivity((shuffled, loop)).data, sensitivity(loop, freq=freq).data, rtol=1e-7, atol=1e-9
    )


@pytest.mark.slow
def test_margin_and_bandwidth_on_a_dense_frf_are_those_of_the_model():
    loop = loop_of()
    frf = frf_of(loop, np.arange(1.0, 4000.0, 0.5))
    assert modulus_margin((frf, loop)) == pytest.approx(loop.modulus_margin, rel=1e-3)
    assert modulus_margin((frf, loop)) >= loop.modulus_margin * (1 - 1e-9)  # a grid misses peaks
    found, wanted = bandwidth((frf, loop)), bandwidth(loop)
    assert wanted <= found <= wanted + 0.5 + 1e-9  # the first line above


@cache
def measured():
    """The stage under feedback, its noise acting; the machine's delay put in by its phase."""
    frf = wafer_stage(elements=(8, 8)).measure_frf(
        ports(asd=1e-4), period=0.5, periods=4, amplitude=30.0, rng=3
    )
    return frf.replace(data=frf.data * np.exp(-2j * np.pi * frf.freq / RATE))


@pytest.mark.slow
@pytest.mark.parametrize("quantity", QUANTITIES)
def test_the_machine_measured_under_feedback(quantity):
    """Lines of 2 Hz: what the truth gives, to the error of the measurement."""
    loop, frf = loop_of(), measured()
    low = frf.freq < 1500.0
    found = quantity((frf, loop)).data[:, :, low]
    wanted = quantity(loop, freq=frf.freq[low]).data
    size = np.linalg.norm(wanted, axis=(0, 1))
    off = np.linalg.norm(found - wanted, axis=(0, 1)) / size
    assert np.median(off) < 0.01
    assert off.max() < 0.05
    # and it is the machine: a stage without its hidden mass is told apart
    other = quantity(loop_of(mass=0.0), freq=frf.freq[low]).data
    assert np.max(np.linalg.norm(found - other, axis=(0, 1)) / size) > 10 * off.max()


@pytest.mark.slow
def test_margin_and_bandwidth_of_the_machine():
    loop, frf = loop_of(), measured()
    assert modulus_margin((frf, loop)) == pytest.approx(loop.modulus_margin, rel=2e-3)
    assert bandwidth((frf, loop)) == pytest.approx(bandwidth(loop), abs=2.0)


@pytest.mark.slow
def test_velocity_sensors_and_displacement_controllers():
    """A controller knows what its sensors measure; an Frf of another quantity is refused."""
    loop, freq = loop_of(), np.geomspace(5.0, 500.0, 20)
    speed = [Sensor(s.name, at=p, quantity="velocity") for s, p in zip(ports().y, CORNERS)]  # noqa: B905
    plant = assemble_plant(full(mass=0.5), ports(y=speed))
    velocity = frequency_response(plant.system.select(loop.fed_back, loop.driven), freq)
    velocity = velocity.replace(quantity="velocity")
    with pytest.raises(ModelError, match=r"as velocity.*'y1' as displacement.*converted"):
        sensitivity((velocity, loop))
    moved = velocity.converted("displacement")
    continuous = assemble_plant(full(mass=0.5), ports())
    wanted = frequency_response(continuous.system.select(loop.fed_back, loop.driven), freq)
    size = np.abs(wanted.data).max(axis=2, keepdims=True)
    assert np.max(np.abs(moved.data - wanted.data) / size) < 1e-9
    assert moved.quantity == "displacement"
    S = sensitivity((moved, loop))
    np.testing.assert_allclose(S.data, sensitivity((wanted, loop)).data, rtol=1e-6, atol=1e-9)
    # a bare controller does not know what it reads: then the Frf decides
    bare = loop.controller.select(loop.driven, loop.fed_back)
    assert not np.allclose(sensitivity((velocity, bare)).data, S.data, rtol=0.1)


def test_conversion_by_powers_of_2_pi_i_f():
    frf = Frf([0.0, 2.0], [[[3.0, 1j]]], quantity="displacement")
    acceleration = frf.converted("acceleration")
    np.testing.assert_allclose(acceleration.data[0, 0], [0.0, -1j * (4 * np.pi) ** 2])
    assert acceleration.quantity == "acceleration"
    with pytest.raises(ModelError, match="zero frequency cannot be integrated"):
        acceleration.converted("velocity")
    with pytest.raises(ModelError, match=r"quantity of this Frf is None.*state what was measured"):
        Frf([1.0], [[[1.0]]]).converted("velocity")
    with pytest.raises(LabelError, match="no quantity 'speed'"):
        frf.converted("speed")


@pytest.mark.slow
def test_frf_to_control():
    frf = frf_of(loop_of(), np.array([3.0, 40.0, 900.0]))
    theirs = frf.to_control(1 / RATE)
    assert theirs.input_labels == list(frf.inputs)
    assert theirs.output_labels == list(frf.outputs)
    assert theirs.dt == 1 / RATE
    np.testing.assert_allclose(theirs.omega, 2 * np.pi * frf.freq)
    np.testing.assert_array_equal(theirs.complex, frf.data)
    assert frf.to_control().dt == 0


def test_what_was_not_measured_is_refused():
    loop, freq = loop_of(), np.geomspace(5.0, 500.0, 20)
    frf = frf_of(loop, freq)
    with pytest.raises(LabelError, match="no measured output 'y4'"):
        sensitivity((frf.select(["y1", "y2", "y3"]), loop))
    with pytest.raises(LabelError, match="no measured input"):
        sensitivity((frf.replace(inputs=("a", "b", "c", "d")), loop))
    with pytest.raises(ModelError, match="half the sampling rate"):
        late = Frf([10.0, RATE], np.ones((4, 4, 2)), inputs=frf.inputs, outputs=frf.outputs)
        sensitivity((late, loop))
    with pytest.raises(ModelError, match="own frequencies"):
        control_sensitivity((frf, loop), freq=np.array([33.3]))
    gain = StateSpace([], [], [], [[1.0]], inputs=["y1"], outputs=["u1"])
    assert loop_gain((frf, gain)).data[0, 0, 3] == frf["y1", "u1"][3]


def test_a_measurement_held_by_python_control_is_a_measured_plant():
    control = pytest.importorskip("control")
    loop, freq = loop_of(), np.geomspace(1.0, 4000.0, 300)
    frf = frf_of(loop, freq)
    shuffled = np.random.default_rng(0).permutation(freq.size)
    frd = control.frd(
        frf.data[:, :, shuffled],
        2 * np.pi * freq[shuffled],
        inputs=list(frf.inputs),
        outputs=list(frf.outputs),
    )
    for quantity in QUANTITIES:
        found, wanted = quantity((frd, loop)), quantity((frf, loop))
        assert (found.inputs, found.outputs) == (wanted.inputs, wanted.outputs)
        np.testing.assert_allclose(found.data, wanted.data, rtol=1e-9)
    with pytest.raises(ModelError, match="controller is a frequency response"):
        sensitivity((frf, frd))
    with pytest.raises(ModelError, match="FrequencyResponseData, got int"):
        Frf.from_control(3)


def lqg(seed):
    """A free mass with a mode, in one or two axes, and a filter that models a narrow disturbance.

    The disturbance lies below the lines from 20 Hz or between them; its poles decay or grow.
    """
    rng = np.random.default_rng(seed)
    m = int(rng.integers(1, 3))
    w, zeta = np.append(np.zeros(m), 2 * np.pi * rng.uniform(150, 900)), 0.02
    phi = np.vstack([np.eye(m), 0.3 * rng.standard_normal((1, m))])
    A = la.block_diag(*[[[0, 1], [-(a**2), -2 * zeta * a]] for a in w])
    B, C = np.zeros((len(A), m)), np.zeros((m, len(A)))
    B[1::2], C[:, ::2] = phi, phi.T
    wd = 2 * np.pi * (rng.uniform(1, 15) if seed % 3 else rng.uniform(25, 80))
    grows = rng.choice([-1, 1]) * 10 ** rng.uniform(-5, -2.5)
    Ad = np.kron(np.eye(m), [[0, 1], [-(wd**2), 2 * grows * wd]])
    Cd = np.kron(np.eye(m), [[wd, 0.0]])
    Ae = np.block([[A, B @ Cd], [np.zeros((2 * m, len(A))), Ad]])
    Be, Ce = np.vstack([B, np.zeros((2 * m, m))]), np.hstack([C, np.zeros((m, 2 * m))])
    fed = np.kron(np.eye(m), np.diag([0.0, wd**2])) * 10 ** rng.uniform(-2, 2)
    R = np.eye(m) * (2 * np.pi * rng.uniform(15, 50)) ** -4
    L = la.solve_continuous_are(Ae.T, Ce.T, la.block_diag(B @ B.T, fed), R) @ Ce.T @ la.inv(R)
    F = np.hstack([la.inv(R) @ B.T @ la.solve_continuous_are(A, B, C.T @ C, R), Cd])
    gain = rng.choice([1.0, 1.0, 0.3, 3.0])
    return A, B, C, Ae - Be @ F - L @ Ce, L, -gain * F


@pytest.mark.slow
def test_narrow_poles_of_the_controller_below_and_between_the_lines_are_counted_or_not_known():
    f, known = np.arange(20.0, 1500.0), Counter()
    for seed in range(40):
        try:
            A, B, C, Ak, Bk, Ck = lqg(seed)
        except (la.LinAlgError, ValueError):
            continue
        K = StateSpace(
            Ak,
            Bk,
            Ck,
            np.zeros((len(Ck), len(C))),
            inputs=[f"y{i}" for i in range(len(C))],
            outputs=[f"u{i}" for i in range(len(Ck))],
        )
        resolvent = np.linalg.inv(2j * np.pi * f[:, None, None] * np.eye(len(A)) - A)
        P = Frf(f, np.moveaxis(C @ resolvent @ B, 0, -1), inputs=K.outputs, outputs=K.inputs)
        poles = la.eigvals(np.block([[A, B @ Ck], [Bk @ C, Ak]]))
        found = broken_count(measured_between(P, K, {}), None, 0).unstable
        known[bool(np.any(la.eigvals(Ak).real > 0.0)), found is not None] += 1
        assert found in (None, np.count_nonzero(poles.real > 0.0)), seed
    assert known[True, True] > 8 and known[False, True] > 8


@pytest.mark.parametrize("axes", [1, 2])
def test_a_line_on_the_critical_point_is_named(axes):
    freq, names = np.arange(1.0, 41.0), [f"y{i}" for i in range(axes)]
    data = np.eye(axes)[:, :, None] * (10.0 / (10.0 + 1j * (freq - 10.0)))
    K = StateSpace([], [], [], np.eye(axes), inputs=names, outputs=[f"u{i}" for i in range(axes)])
    found = broken_count(measured_between(Frf(freq, data, K.outputs, names), K, {}), None, 0)
    assert found.unstable is None
    assert "a line lies on the critical point" in found.reason

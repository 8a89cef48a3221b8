"""FRFs of a floating plate measured with its controller on, against the plate's own poles.

The machine is a Ritz plate with masses that no drawing has; its records are stationary, from the
transfer functions of its loop at every line of the record.
"""

import warnings
from functools import cache

import numpy as np
import pytest
import scipy.signal as ss

from flexplant.errors import FlexplantWarning
from flexplant.identification import H1Estimator, Periodic, estimate_frf, identify_modes, multisine
from flexplant.lti import StateSpace, frequency_response
from flexplant.plant import Actuator, Poi, Ports, Sensor
from flexplant.testbeds import wafer_stage

RATE = 5e3
DRIVEN = [(0.15, 0.15, 0.0), (0.45, 0.15, 0.0), (0.3, 0.45, 0.0)]
SEEN = [(0.13, 0.15, 0.0), (0.47, 0.15, 0.0), (0.3, 0.47, 0.0)]
PORTS = Ports(
    u=[Actuator(f"u{i}", at=p) for i, p in enumerate(DRIVEN, 1)],
    y=[Sensor(f"y{i}", at=p) for i, p in enumerate(SEEN, 1)],
    z=[Poi("die", at=(0.3, 0.3, 0.0), axes=("z",))],
)


@cache
def machine():
    return wafer_stage(rate=RATE, delay=0.0)


def law(bandwidth):
    """Forces per error in rigid coordinates, and a lead with roll-off: its num and den."""
    mass = 2702 * 0.0272 * 0.36 + 0.5
    inertia, w = mass * 0.36 / 12, 2 * np.pi * bandwidth

    def rigid(places):
        return np.array([[1.0, y - 0.3, 0.3 - x] for x, y, _ in places])

    gain = np.linalg.inv(rigid(DRIVEN).T) @ np.diag([mass, inertia, inertia])
    lead = w**2 / 3 * np.array([3 / w, 1.0])
    lag = np.polymul([1 / (4 * w), 1.0], [1 / (2 * np.pi * 3000), 1.0])
    num, den, _ = ss.cont2discrete((lead, lag), 1 / RATE, "bilinear")
    return gain @ np.linalg.inv(rigid(SEEN)), num[0], den


@cache
def closed(bandwidth):
    gain, num, den = law(bandwidth)
    A, B, C, D = ss.tf2ss(num, den)
    one = np.eye(3)
    blocks = [np.kron(one, A), -np.kron(one, B), np.kron(gain, C), -gain * D]
    names = {"inputs": ["y1", "y2", "y3"], "outputs": ["u1", "u2", "u3"]}
    return machine().loop(PORTS, StateSpace(*blocks, 1 / RATE, **names))


@cache
def transfer(n):
    """Lines between zero and half the rate, and what the machine does there."""
    freq = np.arange(1, n // 2) * RATE / n
    found = frequency_response(closed(0.5).plant.system, freq)
    return freq, found.select(inputs=["u1", "u2", "u3"], outputs=["y1", "y2", "y3"]).data


def measured(bandwidth, rng, *, force=0.0, setpoint=0.0, sensor=1e-9, shock=0.0):
    """u = S (force + K (setpoint - sensor - G shock)), y = G (u + shock) + sensor."""
    shape = np.shape(force) or np.shape(setpoint)
    n = shape[2]
    freq, G = transfer(n)
    gain, num, den = law(bandwidth)
    K = gain[:, :, None] * ss.freqz(num, den, 2 * np.pi * freq / RATE)[1]

    def spectrum(x):
        return np.fft.rfft(np.broadcast_to(x, shape), axis=2)[:, :, 1 : n // 2]

    def times(a, b):
        return np.einsum("ijf,ejf->eif", a, b)

    noise = times(G, spectrum(shock * rng.normal(size=shape)))
    noise = noise + spectrum(sensor * rng.normal(size=shape))
    S = np.linalg.inv(np.eye(3) + np.einsum("ijf,jkf->fik", K, G)).transpose(1, 2, 0)
    U = times(S, spectrum(force) + times(K, spectrum(setpoint) - noise))
    Y = times(G, U) + noise
    edges = [(0, 0), (0, 0), (1, 1)]
    return [np.fft.irfft(np.pad(X, edges), n, axis=2) for X in (U, Y)]


def true_poles():
    """Those of the sampled machine: modes above half the rate fold into the band."""
    own = machine()._own_poles
    own = RATE * np.log(np.exp(np.concatenate([own, own.conj()]) / RATE))
    return own[own.imag > 0]


@pytest.mark.slow
@pytest.mark.parametrize(
    ("bandwidth", "moved", "side"),
    [(0.5, 0.0, "force"), (5.0, 1e-4, "setpoint"), (50.0, 0.0, "force"), (50.0, 3e-6, "setpoint")],
)
def test_poles_of_a_stage_with_its_controller_on_lie_in_their_intervals(bandwidth, moved, side):
    """Loops of 0.5 to 50 Hz, three actuators, three sensors, periodic forces or set-points."""
    assert closed(bandwidth).is_stable
    band = (1.0, 1500.0) if side == "force" else (200.0, 1500.0)
    r = multisine(3, rate=RATE, period=1.0, periods=5, band=band, rng=1)
    r = r * (1.0 if side == "force" else moved)
    rng = np.random.default_rng(7)
    u, y = measured(bandwidth, rng, **{side: r}, sensor=5e-9, shock=0.05)
    method = Periodic(period=1.0, discard=0)
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        frf = estimate_frf(u, y, RATE, reference=r, method=method, quantity="displacement")
    # as many experiments as inputs: total inputs and outputs alone give the same quotient
    direct = estimate_frf(u, y, RATE, method=method, quantity="displacement")
    common = np.isin(direct.freq, frf.freq)
    np.testing.assert_allclose(direct.data[:, :, common], frf.data, rtol=1e-6)
    found = identify_modes(frf, band=(200.0, 520.0), hold=RATE)
    truth = true_poles()
    for f in (244.70, 355.31, 455.11):
        k = int(np.argmin(np.abs(found.freq - f)))
        error = found.poles[k] - truth[np.argmin(np.abs(truth - found.poles[k]))]
        assert abs(error.real) < 3.5 * found.std[k].real
        assert abs(error.imag) < 3.5 * found.std[k].imag
        assert abs(found.std[k]) < 0.05 * -found.poles[k].real


@pytest.mark.slow
def test_the_direct_way_is_biased_towards_the_controller_and_the_joint_one_is_not():
    """Set-points of 3 um rms, sensor noise of 2 um: off by 4/13 (G + 1/K), 3 deviations."""
    rng = np.random.default_rng(1)
    r = 3e-6 * rng.normal(size=(1, 3, 50_000))
    u, y = measured(50.0, rng, setpoint=r, sensor=2e-6)
    method = H1Estimator(segment=0.5)
    with pytest.warns(FlexplantWarning, match=r"at 1 of 1249 lines, 2 .. 2 Hz, the references"):
        joint = estimate_frf(u, y, RATE, method=method, reference=r)
    direct = estimate_frf(u, y, RATE, method=method)
    freq, G = transfer(2500)
    inner = (freq > 20) & (freq < 200)
    gain, num, den = law(50.0)
    K = gain[:, :, None] * ss.freqz(num, den, 2 * np.pi * freq / RATE)[1]
    inverse = np.linalg.inv(K.transpose(2, 0, 1)).transpose(1, 2, 0)
    bias = -4 / 13 * (G + inverse)  # Svv / (Srr + Svv) of (G Srr - Svv/K) / (Srr + Svv)

    def off(frf, want):
        error = (frf.data - want)[:, :, inner]
        return float(np.sqrt(np.mean(np.abs(error) ** 2 / frf.variance[:, :, inner])))

    assert off(joint, G) == pytest.approx(1.0, abs=0.15)
    assert off(direct, G + bias) == pytest.approx(1.0, abs=0.15)
    assert off(direct, G) > 2.5


@pytest.mark.slow
def test_noise_that_returns_through_the_controller_is_warned_of():
    """Forces of 1 N, disturbances of 0.5 N, a 50 Hz loop; in open loop there is no warning."""
    rng = np.random.default_rng(1)
    r = rng.normal(size=(1, 3, 50_000))
    u, y = measured(50.0, rng, force=r, sensor=3e-9, shock=0.5)
    method = H1Estimator(segment=1.0)
    with pytest.warns(FlexplantWarning, match="made in closed loop.*reference="):
        direct = estimate_frf(u, y, RATE, method=method, quantity="displacement")
    with pytest.warns(FlexplantWarning, match=r"lines, 1 .. \d+ Hz, the references are too weak"):
        joint = estimate_frf(u, y, RATE, method=method, reference=r, quantity="displacement")
    freq, G = transfer(5000)
    off = np.mean(np.abs(joint.data - G) ** 2 / joint.variance, axis=(0, 1))
    assert off[0] > 10.0  # the loop leaves the input to noise
    assert np.mean(off[freq > 40.0]) < 1.2
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        _, own = transfer(50_000)
        Y = np.einsum("ijf,ejf->eif", own, np.fft.rfft(r)[:, :, 1:25_000])
        y = np.fft.irfft(np.pad(Y, [(0, 0), (0, 0), (1, 1)]), 50_000, axis=2)
        for size in (1e-11, 3e-9, 1e-7):
            noise = size * rng.normal(size=y.shape)
            estimate_frf(r, y + noise, RATE, method=method, quantity="displacement")
    low = (freq > 10) & (freq < 60)
    error = [np.mean((np.abs(f.data - G) ** 2 / f.variance)[:, :, low]) for f in (direct, joint)]
    assert error[0] > 2.0
    assert error[1] < 1.5

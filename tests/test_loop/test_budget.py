"""Error budgets against dense Lyapunov equations, folded spectra, integrals and simulations."""

import numpy as np
import pytest
import scipy.linalg as la
from scipy.signal import place_poles

import flexplant as fx
import oracles_loop as oracle
from flexplant.errors import AssumptionError, LabelError, ModelError
from flexplant.loop.budget import Source, source_variances
from flexplant.lti import StateSpace
from flexplant.plant import Actuator, Disturbance, Sensor, StandardPlant
from machines import OMEGA, RATE, SHAPES, observer, servo, stage
from stages import CORNERS, INSET, NOISE, ports, reduced, sampled, some_modes


@pytest.fixture(scope="module")
def loop():
    return fx.close_loop(stage(sensor_asd=3e-7), observer(), servo())


@pytest.fixture(scope="module")
def plate():
    """24 modes at 0.1 % damping under a servo on a Kalman filter; another force at each place."""
    forces = [Disturbance(f"amp{i}", at=p, asd=i * 1e-4) for i, p in enumerate(INSET, 1)]
    late = [Sensor(f"y{i}", at=p, asd=1e3 * i * NOISE, latency=3e-5 * i)
            for i, p in enumerate(CORNERS, 1)]  # fmt: skip
    plant = sampled(reduced(0.001), ports(w=forces, y=late))
    return fx.close_loop(plant, fx.design_kalman(plant), fx.design_servo(plant, bandwidth=25.0))


def dense_variance(loop, channel, factor, sensors):
    """Return the variance by the dense Lyapunov equation of the closed loop."""
    g, plant = loop.monitored, loop.plant
    G = np.zeros((g.n_states, factor.shape[1]))
    G[: factor.shape[0]] = factor
    columns = [g.inputs.index(name) for name in sensors]
    sigma = np.array([plant.asd[name] for name in sensors]) * np.sqrt(0.5 / plant.dt)
    V, W = g.B[:, columns] * sigma, g.D[:, columns] * sigma
    row = g.outputs.index(channel)
    X = la.solve_discrete_lyapunov(g.A, G @ G.T + V @ V.T)
    return float(g.C[row] @ X @ g.C[row] + W[row] @ W[row])


@pytest.mark.parametrize("channel", ["die:error", "y1", "u2", "die:hat"])
def test_the_total_is_that_of_lyapunov_and_of_the_integrated_spectrum(loop, channel):
    sensors = ["y1:noise", "y2:noise"]
    exact = dense_variance(loop, channel, loop.plant.noise_factor, sensors)
    found = loop.budget() if channel == "die:error" else loop.budget(channel)
    assert loop.rms(channel) ** 2 == pytest.approx(exact, rel=1e-9, abs=0)
    assert found.rms**2 == pytest.approx(exact, rel=1e-9, abs=0)
    assert max(found.certificate.values()) < 1e-8
    # the trapezoid rule on the unit circle converges like the slowest pole decays
    freq = np.linspace(0.0, RATE / 2, 40001)
    density = loop.psd(channel, freq).psd
    assert np.trapezoid(density, freq) == pytest.approx(exact, rel=1e-6, abs=0)
    assert found.cumulative[:, -1].sum() == pytest.approx(exact, rel=1e-6, abs=0)
    # stairs: each source rises from nothing to its variance
    assert np.all(np.diff(found.cumulative, axis=1) >= 0) and not np.any(found.cumulative[:, 0])
    middle = found.freq.size // 2
    below = freq <= found.freq[middle]
    part = np.trapezoid(density[below], freq[below])
    assert found.cumulative[:, middle].sum() == pytest.approx(part, rel=2e-2, abs=0)


@pytest.mark.slow
def test_sources_are_told_apart(plate):
    """A plant whose sensors have latencies: states of their own, noise of their own."""
    found = plate.budget("die:error")
    sensors = [f"y{i}:noise" for i in range(1, 5)]
    assert set(found.names) == {"amp1", "amp2", "amp3", "amp4", *sensors}
    total = dense_variance(plate, "die:error", plate.plant.noise_factor, sensors)
    assert found.rms**2 == pytest.approx(total, rel=1e-6, abs=0)
    none = np.zeros((plate.plant.system.n_states, 0))
    for name in sensors:
        alone = dense_variance(plate, "die:error", none, [name])
        assert found[name] ** 2 == pytest.approx(alone, rel=1e-6, abs=0)
    # most of the force is at amp4: its share by the same loop on a plant with that force alone
    own = plate.plant.assembled.ports
    single = own.replace(w=[d if d.name == "amp4" else d.replace(asd=0.0) for d in own.w])
    alone = dense_variance(plate, "die:error", plate.plant.with_ports(single).noise_factor, [])
    assert found["amp4"] ** 2 == pytest.approx(alone, rel=1e-6, abs=0)
    assert found["amp4"] > 2.5 * found["amp1"]
    assert found.shares.sum() == pytest.approx(1.0, rel=1e-12)
    text = repr(found)
    assert text.startswith("rms of die:error [nm] by source") and "total" in text
    assert "not judged on a larger model" in text
    ax = fx.plot.budget(found, most=3)
    assert ax.get_ylim()[1] >= (1e9 * found.rms) ** 2 and "5 others" in str(
        [t.get_text() for t in ax.get_legend().get_texts()]
    )


@pytest.mark.slow
def test_spectra_of_samples_hold_what_folds_back():
    """Sampled at 500 Hz, the mode at 400 Hz shows at 100 Hz: a fifth of what is seen there."""
    rate = 500.0
    plant = stage(rate=rate, sensor_asd=1e-9, delay=1.0)
    loop = fx.close_loop(plant, observer(1 / rate), servo(1 / rate, hz=4.0))
    assert loop.is_stable
    n = 2 * OMEGA.size
    A, B, C = np.zeros((n, n)), np.zeros((n, 1)), np.zeros((3, n))
    for k, omega in enumerate(OMEGA):
        A[2 * k, 2 * k + 1], A[2 * k + 1, 2 * k] = 1.0, -(omega**2)
        A[2 * k + 1, 2 * k + 1] = -0.02 * omega
        B[2 * k + 1, 0] = SHAPES["amp"][k]
        C[:, 2 * k] = [-SHAPES["die"][k], SHAPES["1"][k], SHAPES["2"][k]]
    g = plant.system
    read = [loop.controller.inputs.index(name) for name in ("y1", "y2")]
    drive = [loop.controller.outputs.index(name) for name in ("u1", "u2")]
    parts = {
        "rate": rate,
        "K": lambda z: oracle.gain(*(getattr(loop.controller, m) for m in "ABCD"), z)[
            np.ix_(drive, read)
        ],
        "P": lambda z: oracle.gain(g.A, g.B, g.C, g.D, z)[
            np.ix_(g.output_index(["die:error", "y1", "y2"]), g.input_index(["u1", "u2"]))
        ],
    }
    freq = np.array([1.0, 7.0, 40.0, 60.0, 99.0, 100.0, 101.0, 150.0, 240.0])
    physical = {"A": A, "B": B, "C": C}
    whole = oracle.folded_spectrum(physical, parts, freq, 1e-2, 1e-9, 400)
    bare = oracle.folded_spectrum(physical, parts, freq, 1e-2, 1e-9, 0)
    found = loop.psd("die:error", freq)
    np.testing.assert_allclose(found.psd, whole, rtol=1e-6, atol=0.0)
    assert bare[5] < 0.85 * whole[5]


@pytest.mark.slow
def test_the_total_is_what_a_simulation_has(loop):
    run = fx.simulate(loop, duration=1.5, runs=20, rng=5)
    for channel in ("die:error", "y2", "u1"):
        _, low, high = run.rms_interval(channel, start=0.5, level=0.998)
        assert low <= loop.rms(channel) <= high
    # Welch's estimate from the runs: chi-square with some 24 * 20 degrees of freedom
    freq, density = run.psd("y2", start=0.5, segment=0.1)
    inner = slice(3, -3)
    ratio = density[inner] / loop.psd("y2", freq[inner]).psd
    assert abs(np.mean(ratio[ratio < 2]) - 1.0) < 0.05
    assert np.sum(density) * freq[1] == pytest.approx(
        run.rms_interval("y2", start=0.5)[0] ** 2, rel=0.1
    )


def test_the_residue_of_a_set_point_is_a_part_of_its_own(loop):
    move = fx.setpoint(1e-4, velocity=5e-3, acceleration=0.5, jerk=100.0)
    run = fx.simulate(loop, reference=move, noise=False, duration=0.4)
    found = loop.budget("die:error", residue=run, start=0.1)
    alone = loop.budget("die:error")
    assert found.names == (*alone.names, "set-point residue")
    assert found["set-point residue"] == pytest.approx(run.rms("die:error", start=0.1), rel=1e-12)
    assert found.rms**2 == pytest.approx(alone.rms**2 + run.rms("die:error", start=0.1) ** 2)
    assert found.cumulative[-1, -1] == pytest.approx(found["set-point residue"] ** 2, rel=1e-9)
    with pytest.raises(LabelError, match="no channel 'die:error'"):
        loop.budget("die:error", residue={"y1": run["y1"]})
    with pytest.raises(ModelError, match="leaves 0 samples"):
        loop.budget("die:error", residue=run, start=1.0)
    with pytest.raises(ModelError, match="must be a run"):
        loop.budget("die:error", residue="run")


@pytest.mark.slow
def test_modes_left_out_are_in_where_they_are_known():
    modes, more = some_modes(0.01, 8, attached=False), some_modes(0.01, 24, attached=False)
    plant = sampled(modes)
    blocks = fx.design_static(plant), fx.design_servo(plant, bandwidth=20.0)
    loop = fx.close_loop(plant.replace(evaluation=more), *blocks)
    whole = fx.close_loop(sampled(more), *blocks)
    found = loop.budget("die:error")
    assert found.left_out == pytest.approx(whole.rms("die:error"), rel=1e-9, abs=0)
    assert loop.completed.rms("die:error") == found.left_out
    assert f"with the truncated modes: {1e9 * found.left_out:.5g}" in repr(found)
    assert np.isnan(fx.close_loop(plant, *blocks).budget("die:error").left_out)


def continuous(pole=-100.0):
    """A mass under force and sensor noise, held by a PD controller that rolls off."""
    mass = StateSpace(
        [[0, 1], [0, 0]], [[0, 0, 0], [1, 0, 1]], [[1, 0], [1, 0]], [[0, 0, 0], [0, 1, 0]],
        inputs=["f", "y:noise", "u"], outputs=["z", "y"],
    )  # fmt: skip
    plant = StandardPlant.from_statespace(mass, u=["u"], y=["y"], asd={"f": 0.2, "y:noise": 1e-3})
    law = StateSpace(
        [[pole]], [[1.0]], [[-pole * 1900.0]], [[-2000.0]], inputs=["y"], outputs=["u"]
    )
    return fx.close_loop(plant, law)


def test_a_continuous_loop_is_integrated_to_infinity():
    loop = continuous()
    g = loop.monitored
    Q = sum((level**2 / 2) * np.outer(g.B[:, i], g.B[:, i]) for i, level in ((0, 0.2), (1, 1e-3)))
    X = la.solve_continuous_lyapunov(g.A, -Q)
    found = loop.budget("z")
    assert found.rms**2 == pytest.approx(X[0, 0], rel=1e-9, abs=0)
    assert np.isinf(found.freq[-1]) and max(found.certificate.values()) < 1e-6
    s = 2j * np.pi * 3.0
    H = oracle.gain(g.A, g.B, g.C, g.D, s)[0]
    wanted = 0.2**2 * abs(H[0]) ** 2 + 1e-6 * abs(H[1]) ** 2
    assert loop.psd("z", [3.0]).psd[0] == pytest.approx(wanted, rel=1e-9, abs=0)
    with pytest.raises(ModelError, match="passes straight through to 'u'"):
        loop.rms("u")


def test_what_has_no_stationary_state_is_refused(loop):
    plant = stage()
    with pytest.warns(fx.FlexplantWarning, match="unstable"):
        wrong = fx.close_loop(plant, observer(), servo(sign=-1.0))
    with pytest.raises(AssumptionError, match="needs a stable closed loop"):
        wrong.rms("die:error")
    with pytest.raises(LabelError, match="die:errror"):
        loop.rms("die:errror")
    idle = fx.assemble_plant(some_modes(), ports(u=[Actuator("u1", at=INSET[0])]))
    rest = StateSpace([], [], [], np.zeros((1, 1)), inputs=["y1"], outputs=["u1"])
    with pytest.raises(AssumptionError, match="rigid-body mode or integrator"):
        fx.close_loop(idle, rest).psd("die:z")


def slow_servo(rng, dt=1e-4):
    """Return A, G, c of a mass with one mode, its observer and an integrator of 0.05 Hz."""
    mass, omega = rng.uniform(1, 50), 2 * np.pi * 10 ** rng.uniform(1.5, 3.3)
    held = la.block_diag(*([[[0, 1], [-w * w, -0.02 * w]] for w in (0.0, omega)]))
    drive = np.array([[0.0], [1.0], [0.0], [1.0]]) / mass
    whole = la.expm(dt * np.block([[held, drive], [np.zeros((1, 5))]]))
    A, B, C = whole[:4, :4], whole[:4, 4:], np.array([[1.0, 0.0, 1.0, 0.0]])
    with_sum = np.block([[A, np.zeros((4, 1))], [dt * C, np.eye(1)]])
    fast, faster = 10 ** rng.uniform(1.3, 2.3, 4), 10 ** rng.uniform(2.0, 2.8, 4)
    poles = [np.exp(-2 * np.pi * dt * np.array(f)) for f in ([0.05, *fast], faster)]
    F = place_poles(with_sum, np.vstack([B, [[0.0]]]), poles[0]).gain_matrix
    L = place_poles(A.T, C.T, poles[1]).gain_matrix.T
    joint = np.block(
        [[A, -B @ F], [L @ C, A - B @ F[:, :4] - L @ C, -B @ F[:, 4:]], [dt * C, 0 * C, np.eye(1)]]
    )
    none = np.zeros((4, 1))
    G = np.block([[B, none], [none, 1e-9 * L], [np.zeros((1, 2))]])
    return joint, G, np.hstack([C, np.zeros((1, 5))])


@pytest.mark.parametrize("seed", [7, 28, 50, 59])
def test_a_slow_pole_among_states_of_different_size_has_a_variance(seed):
    """The entries of the Gramians have lost their digits, the rms has not (extended precision)."""
    A, G, c = slow_servo(np.random.default_rng(seed))
    power, X = A.astype(np.longdouble), G.astype(np.longdouble) @ G.T
    for _ in range(26):
        X, power = X + power @ X @ power.T, power @ power
    noise = Source("noise", G, np.zeros((1, 2)))
    found, off = source_variances(StateSpace(A, G, c, np.zeros((1, 2)), 1e-4), 0, [noise])
    assert found[0] == pytest.approx(float((c @ X @ c.T)[0, 0]), rel=1e-6, abs=0)
    assert off < 1e-6

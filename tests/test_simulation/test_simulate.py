"""simulate against a dense recursion, scipy's dlsim and the Lyapunov equation."""

import re
import time

import numpy as np
import pytest
import scipy.signal
from hypothesis import given
from hypothesis import strategies as st

import oracles_loop as oracle
from flexplant import load
from flexplant.errors import AssumptionError, FlexplantWarning, LabelError, ModelError, ShapeError
from flexplant.loop import close_loop
from flexplant.lti import StateSpace
from flexplant.plant import Foreign, StandardPlant
from flexplant.simulation import Quantiser, setpoint, simulate
from flexplant.simulation import simulate as simulate_function
from machines import RATE, block, matrices, observer, servo, stage


@pytest.fixture(scope="module")
def loop():
    return close_loop(stage(), observer(), servo())


MOVE = setpoint(1e-3, velocity=0.02, acceleration=1.0, jerk=100.0, rest=0.01)


@pytest.mark.parametrize("delay", [0.0, 0.4, 1.0, 2.0])
@pytest.mark.parametrize("blocks", [True, False])
def test_a_run_is_the_recursion_by_hand(delay, blocks):
    plant = stage(delay=delay, blocks=blocks)
    loop = close_loop(plant, observer(), servo())
    rng = np.random.default_rng(3)
    force = rng.standard_normal(400)
    run = simulate(
        loop, reference=MOVE, disturbance={"amp": force}, noise=False, duration=400 / RATE
    )
    by_hand = oracle.run_sample_by_sample(
        matrices(plant),
        [block(b) for b in loop.blocks],
        {"amp": force, "die:ref": MOVE.at(run.time).position},
    )
    assert run.time.size == 400
    assert set(run) == set(by_hand)
    for name in run:
        scale = np.abs(by_hand[name]).max()
        np.testing.assert_allclose(run[name], by_hand[name], rtol=0, atol=1e-10 * scale)


def test_a_run_is_dlsim_of_the_closed_loop(loop):
    step = np.ones(300)
    g = loop.monitored
    column = g.inputs.index("die:ref")
    _, expected, _ = scipy.signal.dlsim(
        (g.A, g.B[:, [column]], g.C, g.D[:, [column]], g.dt), step[:, None]
    )
    run = simulate(loop, reference=1.0, noise=False, duration=300 / RATE)
    assert run.names == g.outputs
    for i, name in enumerate(g.outputs):
        scale = max(np.abs(expected[:, i]).max(), 1e-300)
        np.testing.assert_allclose(run[name], expected[:, i], rtol=0, atol=1e-9 * scale)


def test_the_start_is_honoured(loop):
    rng = np.random.default_rng(5)
    n = loop.plant.system.n_states
    x = rng.standard_normal(loop.monitored.n_states)
    run = simulate(loop, start=x, noise=False, duration=50 / RATE)
    g, state = loop.monitored, x.copy()
    for k in range(50):
        expected = g.C @ state
        np.testing.assert_allclose(run.data[:, k], expected, atol=1e-9 * np.abs(expected).max())
        state = g.A @ state
    short = simulate(loop, start=x[:n], noise=False, duration=3 / RATE)
    assert short["die:z"][0] == pytest.approx(loop.plant.C1[0] @ x[:n], rel=1e-12)


@pytest.mark.slow
@pytest.mark.parametrize("source", ["amp", "sensors", "both"])
def test_noise_has_the_variance_of_the_lyapunov_equation(source):
    """Every channel within three standard errors, those from its own autocovariance."""
    plant = stage(
        asd=0.0 if source == "sensors" else 1e-2, sensor_asd=0.0 if source == "amp" else 1e-8
    )
    plant = plant.replace(asd={name: level for name, level in plant.asd.items() if level})
    loop = close_loop(plant, observer(), servo(hz=5.0))
    g, n = loop.monitored, plant.system.n_states
    noise = np.zeros((g.n_states, g.n_states))
    noise[:n, :n] = plant.process_noise
    variance_y = np.array(
        [0.5 * plant.asd.get(f"{y}:noise", 0.0) ** 2 * RATE for y in ("y1", "y2")]
    )
    columns = [g.inputs.index(name) for name in ("y1:noise", "y2:noise")]
    noise += (g.B[:, columns] * variance_y) @ g.B[:, columns].T
    runs, settle, seconds = 16, 4.0, 16.0
    rows = g.output_index(["die:z", "die:error", "u1:effort", "die:hat"])
    samples = runs * round((seconds - settle) * RATE)
    variance, error = oracle.stationary(g.A, noise, g.C[rows], samples)
    direct = (g.D[np.ix_(rows, columns)] ** 2) @ variance_y
    run = simulate(loop, duration=seconds, rng=11, runs=runs)
    for i, row in enumerate(rows):
        mean_square = np.mean(np.asarray(run.rms(g.outputs[row], start=settle)) ** 2)
        # the part through D is white and only adds to the error
        bound = 3 * (
            error[i]
            + direct[i] * np.sqrt(2 / samples)
            + 2 * np.sqrt(variance[i] * direct[i] / samples)
        )
        assert bound < 0.12 * (variance[i] + direct[i])
        assert abs(mean_square - variance[i] - direct[i]) < bound


def test_runs_do_not_depend_on_their_company(loop):
    options = {"reference": MOVE, "duration": 0.2, "rng": 7}
    all_runs = simulate(loop, runs=21, **options)
    assert all_runs.data.shape == (21, len(all_runs.names), 400)
    np.testing.assert_array_equal(simulate(loop, **options).data, all_runs.data[0])
    np.testing.assert_array_equal(
        simulate(loop, runs=[20, 3], **options).data, all_runs.data[[20, 3]]
    )
    assert np.abs(all_runs["die:z"][0] - all_runs["die:z"][1]).max() > 0
    longer = simulate(loop, runs=2, **(options | {"duration": 0.35}))
    np.testing.assert_array_equal(longer.data[:, :, :400], all_runs.data[:2])


def test_every_run_may_have_a_signal_of_its_own(loop):
    """Many runs multiply matrices where one run multiplies vectors: last digits may differ."""
    options = {"duration": 0.05, "rng": 7}

    def close(alone, together):
        np.testing.assert_allclose(alone, together, rtol=0, atol=1e-11 * np.abs(together).max())

    each = 1e-6 * np.linspace(0.0, 1.0, 100) * np.array([[1.0], [-2.0], [0.0]])
    together = simulate(loop, reference=each, disturbance={"amp": 1e-3}, runs=3, **options)
    for i, signal in enumerate(each):
        alone = simulate(loop, reference=signal, disturbance={"amp": 1e-3}, runs=[i], **options)
        close(alone.data[0], together.data[i])
    steps = {"elements": {"y1": Quantiser(1e-9)}}  # sample by sample, all runs at once
    together = simulate(loop, reference=each, runs=3, **options, **steps)
    alone = simulate(loop, reference=each[1], runs=[1], **options, **steps)
    np.testing.assert_array_equal(alone.data[0], together.data[1])


def test_seeds(loop):
    options = {"duration": 0.05}
    by_number = simulate(loop, rng=7, **options).data
    np.testing.assert_array_equal(
        by_number, simulate(loop, rng=np.random.SeedSequence(7), **options).data
    )
    assert np.any(by_number != simulate(loop, rng=8, **options).data)
    assert np.any(simulate(loop, **options).data != simulate(loop, **options).data)
    generators = [np.random.default_rng(7) for _ in range(2)]
    first, second = (simulate(loop, rng=g, **options).data for g in generators)
    np.testing.assert_array_equal(first, second)
    assert np.any(first != simulate(loop, rng=generators[0], **options).data)


def test_a_run_keeps_the_seed_that_gives_it_again(loop, tmp_path):
    """Whatever was passed: a number, several, a generator, a spawned sequence, nothing."""
    spawned = np.random.SeedSequence(2**70 + 3, spawn_key=(2, 2**33)).spawn(2)[1]
    assert simulate(loop, duration=0.01, rng=7).seed == 7
    assert simulate(loop, duration=0.01, rng=7, noise=False).seed is None
    for rng in ([3, 2**40], np.random.default_rng(7), spawned, np.random.SeedSequence(0), None):
        run = simulate(loop, duration=0.01, rng=rng, runs=[4])
        run.save(tmp_path / "run.npz")
        seed = load(tmp_path / "run.npz").seed
        np.testing.assert_array_equal(
            simulate(loop, duration=0.01, rng=seed, runs=[4]).data, run.data
        )


@pytest.mark.slow
@given(st.floats(1e-3, 1e3), st.integers(0, 5))
def test_linear_in_noise_and_reference(factor, seed):
    """All noises and the reference times a: all signals times a."""
    plant = stage(blocks=True)
    loud = plant.replace(
        asd={name: factor * level for name, level in plant.asd.items()},
        origin=Foreign(factor * plant.noise_factor),
    )
    ramp = np.linspace(0, 1e-6, 100)
    options = {"duration": 100 / RATE, "rng": seed}
    small = simulate(close_loop(plant, observer(), servo()), reference=ramp, **options)
    large = simulate(close_loop(loud, observer(), servo()), reference=factor * ramp, **options)
    scale = np.abs(small.data).max(axis=1, keepdims=True)
    np.testing.assert_allclose(
        large.data / scale, factor * small.data / scale, rtol=0, atol=1e-9 * factor
    )


def test_signals_of_all_kinds_agree(loop):
    options = {"duration": 0.1, "noise": False}
    base = simulate(loop, reference=MOVE, **options)
    for signal in (MOVE.at(base.time).position, lambda t: MOVE.at(t).position, {"die:ref": MOVE}):
        np.testing.assert_array_equal(simulate(loop, reference=signal, **options).data, base.data)
    np.testing.assert_array_equal(base["die:ref"], MOVE.at(base.time).position)
    np.testing.assert_allclose(base["die:error"], base["die:ref"] - base["die:z"], atol=1e-18)


def test_set_point_is_followed(loop):
    run = simulate(loop, reference=MOVE, duration=2.0, noise=False)
    assert run["die:z"][-1] == pytest.approx(1e-3, rel=1e-3)
    assert np.abs(run.moving_average("die:error")[-200:]).max() < 1e-6


@pytest.mark.slow
def test_big_machine_is_fast():
    """10 000 samples of 488 states, 5 runs: each step is O(n)."""
    rng = np.random.default_rng(0)
    pairs, dt = 243, 1e-4
    angle = rng.uniform(0.01, 3.0, pairs)
    A = np.zeros((2 * pairs, 2 * pairs))
    k = 2 * np.arange(pairs)
    A[k, k] = A[k + 1, k + 1] = 0.999 * np.cos(angle)
    A[k, k + 1], A[k + 1, k] = 0.999 * np.sin(angle), -0.999 * np.sin(angle)
    g = StateSpace(
        A,
        rng.standard_normal((2 * pairs, 5)) * 1e-3,
        rng.standard_normal((5, 2 * pairs)) * 1e-3,
        np.zeros((5, 5)),
        dt,
        inputs=["w", "u1", "u2", "u3", "u4"],
        outputs=["z", "y1", "y2", "y3", "y4"],
        blocks=[2] * pairs,
    )
    plant = StandardPlant(
        g, ("w",), ("u1", "u2", "u3", "u4"), ("z",), ("y1", "y2", "y3", "y4"), {"w": 1.0},
        Foreign(rng.standard_normal((2 * pairs, 60))),
    )  # fmt: skip
    law = StateSpace(
        0.5 * np.eye(60), 1e-3 * rng.standard_normal((60, 4)), 1e-3 * rng.standard_normal((4, 60)),
        np.zeros((4, 4)), dt, inputs=plant.y, outputs=plant.u,
    )  # fmt: skip
    loop = close_loop(plant, law)
    begin = time.perf_counter()
    run = simulate(loop, duration=1.0, rng=1, runs=5)
    # 0.5 s alone; a dense step of 488 x 488 for each run would take 10 s
    assert time.perf_counter() - begin < 5.0
    np.testing.assert_array_equal(
        run.data[4], simulate(loop, duration=1.0, rng=1, runs=[4]).data[0]
    )


def test_an_unstable_loop_runs_with_a_warning_until_it_leaves_all_numbers():
    with pytest.warns(FlexplantWarning, match="closed loop is unstable"):
        bad = close_loop(stage(), observer(), servo(hz=20.0, sign=-1.0))
        worse = close_loop(stage(), observer(), servo(hz=8.0, sign=-1e6))
    radius = np.abs(np.linalg.eigvals(bad.monitored.A)).max()
    assert radius > 1.0
    growth = re.escape(f"{radius**1000:.3g}")
    words = rf"unstable \(spectral radius {radius:.6f}.* grows {growth} times"
    with pytest.warns(FlexplantWarning, match=words):
        run = simulate(bad, reference=1e-9, noise=False, duration=1000 / RATE)
    assert run.peak("die:z") > 1e-9
    with (
        pytest.warns(FlexplantWarning, match="grows beyond all numbers in these"),
        pytest.raises(ModelError, match="diverged beyond floating-point numbers"),
    ):
        simulate(worse, reference=1.0, duration=3.0)


def test_what_is_only_marginal_is_no_runaway():
    """A free mass that rests: two poles at 1, which rounding may put a little outside."""
    g = StateSpace(
        [[1.0, 0.1], [0.0, 1.0]], [[0.0, 0.0], [0.1, 0.1]], [[1.0, 0.0]] * 2, np.zeros((2, 2)),
        0.1, inputs=["w", "u"], outputs=["z", "y"],
    )  # fmt: skip
    turn = np.linalg.qr(np.random.default_rng(0).standard_normal((2, 2)))[0]
    plant = StandardPlant.from_statespace(g.transformed(turn), u=["u"], y=["y"])
    still = StateSpace([], [], [], [[0.0]], inputs=["y"], outputs=["u"])
    loop = close_loop(plant, still)
    assert loop.spectral_radius > 1.0  # 1e-8 of rounding
    assert "\n  marginal: a rigid-body mode or integrator lies on the unit circle" in repr(loop)
    run = simulate(loop, disturbance={"w": 1.0}, duration=100.0)
    assert run["z"][-1] == pytest.approx(0.5 * 99.9**2, rel=2e-2)


def test_progress_bar_shows_when_asked(loop, capsys):
    simulate(loop, duration=0.1, progress=True)
    assert "simulate" in capsys.readouterr().err
    simulate(loop, duration=0.1, progress=False)
    simulate(loop, duration=0.1)
    assert capsys.readouterr().err == ""


def direct_plant(**changes):
    """u reaches y at once, as an accelerometer sees a force."""
    D = np.array([[0.0, 0.0], [0.0, 2.0]])
    g = StateSpace(
        [[0.5]], [[1.0, 1.0]], [[1.0], [1.0]], D, 0.1, inputs=["w", "u"], outputs=["z", "y"]
    )
    return StandardPlant.from_statespace(g.replace(**changes), u=["u"], y=["y"])


def test_assumptions_are_checked(loop):
    gain = StateSpace([], [], [], [[-0.1]], inputs=["y"], outputs=["u"])
    with pytest.raises(AssumptionError, match=r"'u' reaches 'y' within the sample \(D22 = 2\)"):
        simulate(close_loop(direct_plant(), gain), duration=1.0)
    quiet = direct_plant(D=np.zeros((2, 2)), dt=0.0, A=[[-1.0]])
    with pytest.raises(AssumptionError, match="discretized"):
        simulate(close_loop(quiet, gain), duration=1.0)
    white = direct_plant(D=[[1.0, 0.0], [0.0, 0.0]]).replace(asd={"w": 1.0})
    with pytest.raises(AssumptionError, match="'w' reaches 'z' without delay"):
        simulate(close_loop(white, gain), duration=1.0)
    unknown = direct_plant(D=np.zeros((2, 2))).replace(asd={"w": 1.0})
    with pytest.raises(ModelError, match="process noise"):
        simulate(close_loop(unknown, gain), duration=1.0)
    assert simulate(close_loop(unknown, gain), duration=1.0, noise=False).rms("z") == 0.0
    weighted = loop.plant.weighted(z={"die:error": 1.0})
    with pytest.raises(ModelError, match="unweighted"):
        simulate(close_loop(weighted, *loop.blocks), duration=1.0)


@pytest.mark.parametrize(
    ("options", "error", "message"),
    [
        ({"duration": 1e-5}, ModelError, "less than half a sample"),
        ({"duration": -1.0}, ModelError, "duration must be positive"),
        ({"reference": {"die:reff": 1.0}}, LabelError, "Close matches: 'die:ref'"),
        ({"reference": {"amp": 1.0}}, LabelError, "no reference 'amp'"),
        ({"disturbance": {"die:ref": 1.0}}, LabelError, "no disturbance 'die:ref'"),
        ({"reference": np.zeros(7)}, ShapeError, "reference 'die:ref' must have shape \\(20,\\)"),
        ({"reference": np.zeros((2, 20)), "runs": 3}, ShapeError, r"shape \(3, 20\)"),
        ({"reference": np.zeros((1, 20))}, ShapeError, r"shape \(20,\)"),
        ({"reference": lambda t: t[:3]}, ShapeError, "shape"),
        ({"reference": np.nan}, ModelError, "NaN"),
        ({"runs": 0}, ModelError, "runs must be a whole number from 1 to .*, got 0"),
        ({"runs": 2.0}, ModelError, "runs must be a whole number"),
        ({"runs": "two"}, ModelError, "runs must be a whole number"),
        ({"runs": []}, ModelError, "runs must be at least 1"),
        ({"runs": [-1]}, ModelError, "a run number must be a whole number at least 0"),
        ({"rng": "a"}, ModelError, "rng must be a seed"),
        ({"rng": 1.5}, ModelError, "rng must be a seed"),
        ({"noise": "no"}, ModelError, "noise must be True or False"),
        ({"disturbance": 3.0}, ModelError, "disturbance must be a mapping"),
        ({"start": np.zeros(3)}, ShapeError, "start"),
    ],
)
def test_bad_input(loop, options, error, message):
    with pytest.raises(error, match=message):
        simulate_function(loop, **({"duration": 20 / RATE} | options))


def test_what_cannot_be_simulated(loop):
    with pytest.raises(ModelError, match="close_loop"):
        simulate(loop.plant, duration=1.0)
    gain = StateSpace([], [], [], [[-0.1]], inputs=["y"], outputs=["u"])
    with pytest.raises(LabelError, match="the plant has no reference"):
        simulate(close_loop(direct_plant(D=np.zeros((2, 2))), gain), reference=1.0, duration=1.0)

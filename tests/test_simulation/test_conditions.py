"""Between the samples of the controller, and POIs that move, against matrices by hand."""

import numpy as np
import pytest
import scipy.linalg as la

import oracles_loop as oracle
from flexplant.errors import LabelError, ModelError
from flexplant.estimation import design_kalman
from flexplant.loop import close_loop
from flexplant.plant import assemble_plant
from flexplant.plant.building import white_noise
from flexplant.simulation import Quantiser, Saturation, simulate
from flexplant.simulation.runs import Conditions, InBlocks, SampleBySample, make_runner
from flexplant.simulation.sampled_runs import finer_loop
from flexplant.synthesis import design_servo
from machines import block, matrices, observer, servo, stage
from stages import L, ports, some_modes

RATE, FINER = 2000.0, 4


def made(delay, **options):
    """A plate of six modes and its loop at 2 kHz."""
    modes = some_modes(count=6, attached=False)
    plant = assemble_plant(modes, ports(**options)).discretized(RATE, delay=delay)
    return close_loop(plant, design_kalman(plant), design_servo(plant, bandwidth=20.0))


@pytest.fixture(scope="module")
def loop():
    return made(1.0)


@pytest.mark.parametrize("delay", [1.0, 1.5])
def test_between_samples_is_the_matrix_exponential(delay):
    """The command of a sample acts from `delay` samples later until the next one does."""
    loop, steps = made(delay), 60
    rng = np.random.default_rng(0)
    reference = 1e-6 * rng.standard_normal(steps)
    by_hand = oracle.run_sample_by_sample(
        matrices(loop.plant), [block(b) for b in loop.blocks], {"die:ref": reference}
    )
    run = simulate(
        loop, reference=np.repeat(reference, FINER), noise=False, finer=FINER,
        duration=steps / RATE,
    )  # fmt: skip
    assert run.time.size == FINER * steps
    for name in run:
        scale = np.abs(by_hand[name]).max()
        if ":r" in name and ":ref" not in name:
            continue  # tilts rest by symmetry
        np.testing.assert_allclose(run[name][::FINER], by_hand[name], rtol=0, atol=1e-8 * scale)
    g, h = loop.plant.continuous, 1.0 / RATE / FINER
    n, nu = g.system.n_states, len(g.u)
    held = la.expm(h * np.block([[g.system.A, g.B2], [np.zeros((nu, n + nu))]]))
    u = np.stack([by_hand[name] for name in loop.plant.u], axis=1)
    late, x, row = round(delay * FINER), np.zeros(n), g.z.index("die:z")
    z = np.zeros(FINER * steps)
    for k in range(FINER * steps):
        z[k] = g.C1[row] @ x
        acts = u[(k - late) // FINER] if k >= late else np.zeros(nu)
        x = held[:n, :n] @ x + held[:n, n:] @ acts
    np.testing.assert_allclose(run["die:z"], z, rtol=0, atol=1e-8 * np.abs(z).max())


def test_noise_is_that_of_the_samples_of_the_controller():
    """Commands, in which the noise of the sensors prevails, have the rms in closed form."""
    loop = made(1.0, asd=1e-6, sensor_asd=1e-9)
    budget = loop.budget("u1")
    assert sum(budget.variances[["noise" in name for name in budget.names]]) > 0.9 * budget.rms**2
    fine = simulate(loop, duration=0.5, rng=1, runs=4, finer=2)
    u = fine["u1"][:, ::2]
    np.testing.assert_array_equal(fine["u1"][:, 1::2], u)
    assert np.sqrt(np.mean(u[:, 200:] ** 2)) == pytest.approx(loop.rms("u1"), rel=0.1)


def test_elements_act_in_the_samples_of_the_controller(loop):
    options = {"reference": 1e-6, "noise": False, "duration": 0.05}
    elements = {"u1": Saturation(2e-3, rate=1.0), "y1": Quantiser(1e-7)}
    coarse = simulate(loop, elements=elements, **options)
    fine = simulate(loop, elements=elements, finer=3, **options)
    assert coarse.peak("u1") == pytest.approx(2e-3, rel=1e-12, abs=0)
    for name in ("u1", "u2", "die:z", "y1", "die:hat"):
        scale = np.abs(coarse[name]).max()
        np.testing.assert_allclose(fine[name][::3], coarse[name], rtol=0, atol=1e-8 * scale)


def test_a_moving_poi_is_at_each_sample_that_of_its_place(loop):
    options = {"reference": 1e-6, "noise": False, "duration": 0.05}

    def path(time):
        return np.stack([0.1 + 4.0 * time, 0.2 + 0 * time, 0 * time], axis=1)

    run = simulate(loop, moving={"die": path}, disturbance={"amp1": np.sin(np.arange(100))},
                   **options)  # fmt: skip
    for k in (0, 10, 50, 99):
        point = (0.1 + 4.0 * run.time[k], 0.2, 0.0)
        there = close_loop(loop.plant.at(point), *loop.blocks)
        still = simulate(there, disturbance={"amp1": np.sin(np.arange(100))}, **options)
        for name in ("die:z", "die:rx", "die:ry", "die:error", "u1:effort", "y1"):
            scale = np.abs(still[name]).max()
            np.testing.assert_allclose(run[name][k], still[name][k], rtol=0, atol=1e-9 * scale)
    plain = simulate(loop, disturbance={"amp1": np.sin(np.arange(100))}, **options)
    assert np.abs(run["die:ry"] - plain["die:ry"]).max() > 0.01 * plain.peak("die:ry")


@pytest.mark.slow
@pytest.mark.parametrize(("finer", "moves"), [(1, True), (3, False), (4, True)])
def test_in_blocks_all_is_as_in_single_samples(loop, finer, moves):
    """Under noise, over more than one piece: a POI that moves, and between samples."""
    steps, loop = 5000, finer_loop(loop, finer)
    place = np.linspace(0.1, 0.5, steps)
    path = np.stack([place, 0.3 + 0 * place, 0 * place], axis=1)
    met = Conditions(paths={"die": path} if moves else {}, finer=finer)
    given, noise = np.full((steps, len(loop.plant.w)), 1e-7), white_noise(loop.plant)
    given[:, [name in ("y1:noise", "y3:noise") for name in loop.plant.w]] = 0.0
    found = []
    for grows, kind in ((False, InBlocks), (True, SampleBySample)):
        runner = make_runner(loop, noise, np.abs(given).max(axis=0), grows=grows, met=met)
        assert type(runner) is kind
        shown = len(loop.plant.z) + len(loop.plant.y) + len(loop.controller.outputs)
        data = np.zeros((1, shown, steps))
        start = np.zeros(loop.plant.system.n_states + loop.controller.n_states)
        runner.begin(start, [np.random.default_rng(1)])
        for first in range(0, steps, runner.stretch):
            part = slice(first, min(first + runner.stretch, steps))
            assert runner.fill(given[part], data[:, :, part])
        found.append(data[0])
    wrong = np.abs(found[0] - found[1]).max(axis=1)
    assert np.all(wrong <= 1e-10 * np.abs(found[1]).max(axis=1))


@pytest.mark.parametrize(
    ("options", "error", "message"),
    [
        ({"finer": 0}, ModelError, "finer must be a whole number"),
        ({"moving": 3}, ModelError, "moving must be of type Mapping"),
        ({"moving": {"wafer": np.zeros((20, 3))}}, LabelError, "no POI to move 'wafer'"),
        ({"moving": {"die": lambda t: np.full((t.size, 3), 2 * L)}}, LabelError, "off the plate"),
    ],
)
def test_wrong_conditions(loop, options, error, message):
    with pytest.raises(error, match=message):
        simulate(loop, duration=0.01, **options)


def test_between_the_samples_of_a_plant_made_elsewhere():
    with pytest.raises(ModelError, match="finer= needs the plant before it was sampled"):
        simulate(close_loop(stage(), observer(), servo()), duration=0.01, finer=2)

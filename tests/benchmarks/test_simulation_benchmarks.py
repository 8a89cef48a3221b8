"""A linear loop over 100 000 samples: ours beside python-control and SciPy."""

import time
from pathlib import Path

import numpy as np
import pytest
import scipy.signal
from timing import best

import flexplant as fx
from flexplant.parallel import one_thread
from flexplant.plant.building import white_noise
from flexplant.simulation.runs import Drawn, SampleBySample, machine_of
from stages import L, ports

COUNT = 100_000


def stage_loop():
    """100 states of a plate with delayed commands, 118 of observer and servo, at 10 kHz."""
    plate = fx.kirchhoff_plate(
        size=(L, L), thickness=0.0272, elements=(8, 8), density=2702,
        youngs_modulus=70e9, poisson_ratio=0.35,
    )  # fmt: skip
    modes = fx.solve_modes(plate, count=48, damping=fx.ModalDamping(0.01))
    plant = fx.assemble_plant(modes, ports()).discretized(1e4, delay=1)
    return fx.close_loop(plant, fx.design_kalman(plant), fx.design_servo(plant, bandwidth=50.0))


def noisy_peer(loop, count, reference=0.0):
    """Return a run of a loop with its noises by python-control, as a function."""
    import control

    g, noise, random = loop.monitored, white_noise(loop.plant), np.random.default_rng(0)
    white, w = noise.factor.shape[1], loop.plant.w
    enter = np.vstack([noise.factor, np.zeros((g.n_states - len(noise.factor), white))])
    loud = control.ss(g.A, np.hstack([g.B, enter]), g.C, np.hstack([g.D, 0 * g.C @ enter]), g.dt)
    times = g.dt * np.arange(count)

    def run():
        given = random.standard_normal((len(w) + white, count))
        given[: len(w)] = 0.0
        given[w.index("die:ref")] = reference
        single = random.standard_normal((noise.columns.size, count))
        given[noise.columns] += noise.deviation[:, None] * single
        return control.forced_response(loud, times, given)

    return run


@pytest.mark.benchmark
def test_a_linear_loop():
    loop = stage_loop()
    g = loop.monitored
    options = {"duration": COUNT * g.dt, "reference": 1e-6}
    run, seconds = best(lambda: fx.simulate(loop, noise=False, **options))
    rows = [("simulate", seconds)]
    _, seconds = best(lambda: fx.simulate(loop, rng=1, **options))
    rows.append(("simulate, with noise", seconds))
    given = np.zeros((COUNT, len(loop.plant.w)))
    given[:, loop.plant.w.index("die:ref")] = 1e-6

    def plain():
        silent = loop.plant.replace(asd={})
        single = SampleBySample(loop, machine_of(loop), Drawn(white_noise(silent), silent))
        single.begin(np.zeros(g.n_states), [np.random.default_rng(0)])
        data = np.zeros((1, len(g.outputs), COUNT))
        with one_thread():
            for first in range(0, COUNT, single.stretch):
                part = slice(first, first + single.stretch)
                single.fill(given[part], data[:, :, part])
        return data[0]

    wanted, seconds = best(plain, 1)
    rows.append(("sample by sample, mode by mode", seconds))
    control = pytest.importorskip("control")
    times, theirs = g.dt * np.arange(COUNT), g.to_control()
    control.forced_response(theirs, times[:9], given[:9].T)  # imports of its own
    answer, seconds = best(lambda: control.forced_response(theirs, times, given.T), 2)
    rows.append(("control.forced_response", seconds))
    noise, random = Drawn(white_noise(loop.plant), loop.plant), np.random.default_rng(0)
    draws = noise.factor.shape[1] + noise.columns.size
    buffer = np.empty((COUNT // 100, draws))
    _, seconds = best(lambda: [random.standard_normal(out=buffer) for _ in range(100)])
    rows.append((f"its {draws} draws a sample alone", seconds))
    _, seconds = best(noisy_peer(loop, COUNT, 1e-6), 1)
    rows.append(("control.forced_response, with noise", seconds))
    (_, theirs, _), seconds = best(lambda: scipy.signal.dlsim((g.A, g.B, g.C, g.D, g.dt), given), 1)
    rows.append(("scipy.signal.dlsim", seconds))
    scale = np.abs(wanted).max(axis=1, keepdims=True)
    # symmetry keeps tilts at zero: there is nothing but rounding
    seen = [i for i, name in enumerate(run.names) if ":r" not in name]
    for other, digits in ((run.data, 1e-10), (answer.outputs, 1e-9), (theirs.T, 1e-9)):
        np.testing.assert_allclose((other / scale)[seen], (wanted / scale)[seen], atol=digits)
    print(f"\n{COUNT} samples, {g.n_states} states, {len(run.names)} channels")
    for name, seconds in rows:
        print(f"{name:36s}{1e3 * seconds:10.1f} ms{seconds / rows[0][1]:9.1f} x")


@pytest.mark.benchmark
def test_a_machine_of_a_fleet(monkeypatch):
    """Update, plant, Kalman, H-infinity and a second at 10 kHz, on one core: CPU seconds."""
    monkeypatch.syspath_prepend(str(Path(__file__).parents[2] / "examples"))
    import fleet

    monkeypatch.setattr(fleet, "DURATION", 1.0)
    times = []
    with one_thread():
        for machine in fleet.fleet(4):
            start = time.process_time()
            assert fleet.pipeline(machine, np.random.default_rng(0))["stable"]
            times.append(time.process_time() - start)
    print("\nrun on all its 490 states" + "".join(f"{seconds:8.2f} s" for seconds in times))

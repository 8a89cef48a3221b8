"""A record through the stationary filter: ours beside filterpy, python-control and SciPy."""

import numpy as np
import pytest
import scipy.signal
from timing import best

import flexplant as fx
from stages import L, ports

COUNT, PART = 100_000, 5_000


def observer():
    """48 states, 8 displacement sensors, 4 commands at 10 kHz."""
    plate = fx.kirchhoff_plate(
        size=(L, L), thickness=0.0272, elements=(8, 8), density=2702,
        youngs_modulus=70e9, poisson_ratio=0.35,
    )  # fmt: skip
    spots = [(x, y, 0.0) for x in (0.0, 0.3, 0.6) for y in (0.0, 0.3, 0.6) if (x, y) != (0.3, 0.3)]
    sensors = [fx.Sensor(f"y{i}", at=p, asd=1e-11) for i, p in enumerate(spots, 1)]
    modes = fx.solve_modes(plate, count=24, damping=fx.ModalDamping(0.01))
    plant = fx.assemble_plant(modes, ports().replace(y=sensors)).discretized(1e4)
    return fx.design_kalman(plant.replace(evaluation=None))


@pytest.mark.benchmark
def test_a_record_through_the_stationary_filter():
    kalman = observer()
    g = kalman.system
    assert (g.n_states, len(kalman.sensors)) == (48, 8)
    rng = np.random.default_rng(0)
    y = 1e-9 * rng.standard_normal((COUNT, 8))
    u = 1e-2 * rng.standard_normal((COUNT, len(kalman.plant.u)))
    records = dict(zip((*kalman.sensors, *kalman.plant.u), np.hstack([y, u]).T, strict=True))
    at_rest = np.zeros(g.n_states)
    ours, seconds = best(lambda: kalman.estimate(records, start=at_rest), 30)
    _, smooth = best(lambda: kalman.estimate(records, fx.estimation.Smoother(), start=at_rest), 2)
    rows = [("estimate", seconds), ("estimate, Smoother()", smooth)]
    both = np.hstack([y, u])

    def plain():
        x, hats = at_rest, np.empty((COUNT, len(g.outputs)))
        for k in range(COUNT):
            hats[k] = g.C @ x + g.D @ both[k]
            x = g.A @ x + g.B @ both[k]
        return hats

    def stepping():
        state = None
        for k in range(PART):
            _, state = kalman.step(y[k], u[k], state)

    wanted, seconds = best(plain, 1)
    np.testing.assert_allclose(ours.data.T, wanted, rtol=0, atol=1e-10 * np.abs(wanted).max())
    rows.append(("plain loop", seconds))
    _, seconds = best(stepping, 5)
    rows.append((f"observer.step, {1e6 * seconds / PART:.1f} us a call", seconds * COUNT / PART))
    (_, theirs, _), seconds = best(lambda: scipy.signal.dlsim((g.A, g.B, g.C, g.D, g.dt), both), 1)
    np.testing.assert_allclose(theirs, wanted, rtol=0, atol=1e-9 * np.abs(wanted).max())
    rows.append(("scipy.signal.dlsim", seconds))
    import control

    system, times = kalman.to_control(), g.dt * np.arange(COUNT)
    answer, seconds = best(lambda: control.forced_response(system, times, both.T), 1)
    np.testing.assert_allclose(answer.outputs.T, wanted, rtol=0, atol=1e-9 * np.abs(wanted).max())
    rows.append(("control.forced_response", seconds))
    twin = kalman.to_filterpy()

    def filterpy():
        for k in range(PART):
            twin.update(y[k])
            twin.predict(u[k])

    _, seconds = best(filterpy, 1)
    rows.append(("filterpy, time-varying", seconds * COUNT / PART))
    print(f"\n{COUNT} samples, 48 states, 8 sensors")
    for name, seconds in rows:
        print(f"{name:36s}{1e3 * seconds:10.1f} ms{seconds / rows[0][1]:9.1f} x")

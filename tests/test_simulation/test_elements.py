"""Saturation, rate limits, quantisers and pure delays against loops written out by hand."""

import numpy as np
import pytest

import oracles_loop as oracle
from flexplant.errors import AssumptionError, LabelError, ModelError
from flexplant.loop import close_loop
from flexplant.lti import StateSpace
from flexplant.plant import StandardPlant
from flexplant.simulation import Quantiser, Saturation, setpoint, simulate
from machines import RATE, block, matrices, observer, servo, stage

MOVE = setpoint(1e-3, velocity=0.02, acceleration=1.0, jerk=100.0, rest=0.01)


@pytest.mark.parametrize("delay", [0.0, 1.0, 2.4])
def test_a_saturated_run_is_the_recursion_by_hand(delay):
    """The observer reads what is applied; sensors count in steps; two actuators differ."""
    plant = stage(delay=delay)
    loop = close_loop(plant, observer(), servo())
    limit, least = np.array([0.3, 0.2]), np.array([-0.1, -0.2])
    change, step = np.array([np.inf, 40.0 / RATE]), 1e-6

    def drive(u, before):
        return np.clip(np.clip(u, before - change, before + change), least, limit)

    def sensed(y):
        return np.array([step * np.rint(y[0] / step), *y[1:]])

    run = simulate(
        loop,
        reference=MOVE,
        disturbance={"amp": lambda t: np.sin(300 * t)},
        elements={
            "u1": Saturation(0.3, least=-0.1),
            "u2": Saturation(0.2, rate=40.0),
            "y1": Quantiser(step),
        },
        noise=False,
        duration=400 / RATE,
    )
    by_hand = oracle.run_sample_by_sample(
        matrices(plant),
        [block(b) for b in loop.blocks],
        {"amp": np.sin(300 * run.time), "die:ref": MOVE.at(run.time).position},
        sensed=sensed,
        drive=drive,
    )
    assert run.peak("u1") == 0.3
    assert np.abs(np.diff(run["u2"])).max() == pytest.approx(0.02, rel=1e-9)
    assert np.unique(run["y1"]).size > 5
    for name in run:
        scale = np.abs(by_hand[name]).max()
        np.testing.assert_allclose(run[name], by_hand[name], rtol=0, atol=1e-9 * scale)


def test_elements_that_never_act_leave_the_run_as_it_is():
    loop = close_loop(stage(), observer(), servo())
    options = {"reference": MOVE, "duration": 0.2, "rng": 1, "runs": 2}
    free = simulate(loop, **options)
    wide = simulate(loop, elements={"u1": Saturation(1e6, rate=1e9)}, anti_windup=0.05, **options)
    scale = np.abs(free.data).max(axis=2, keepdims=True)
    np.testing.assert_allclose(wide.data / scale, free.data / scale, rtol=0, atol=1e-10)


def delayed(samples):
    """y[k] = u[k - samples] + w[k], z the same."""
    n = samples
    A, B = np.eye(n, k=-1), np.zeros((n, 2))
    B[0, 1] = 1.0
    C = np.zeros((3, n))
    C[:2, -1] = 1.0
    D = np.array([[1.0, 0.0, 0.0], [1.0, 0.0, 0.0], [0.0, 1.0, 0.0]])
    g = StateSpace(
        A, np.hstack([np.zeros((n, 1)), B]), C, D, 1e-3,
        inputs=["w", "r", "u"], outputs=["z", "y", "r"],
    )  # fmt: skip
    return StandardPlant.from_statespace(g, u=["u"], y=["y", "r"])


@pytest.mark.parametrize("samples", [1, 2, 5])
@pytest.mark.parametrize("limit", [None, 0.7])
def test_a_pure_delay_is_an_index(samples, limit):
    """u[k] = r[k] - y[k] / 2 - c[k], c[k+1] = c[k] / 2 + y[k] / 10: nothing early, nothing late."""
    law = StateSpace(
        [[0.5]], [[0.1, 0.0]], [[-1.0]], [[-0.5, 1.0]], 1e-3, inputs=["y", "r"], outputs=["u"]
    )
    rng = np.random.default_rng(0)
    w, r = rng.standard_normal((2, 5000))
    u, y, c = np.zeros(5000), np.zeros(5000), 0.0
    for k in range(5000):
        y[k] = w[k] + (u[k - samples] if k >= samples else 0.0)
        u[k] = r[k] - 0.5 * y[k] - c
        u[k] = u[k] if limit is None else min(max(u[k], -limit), limit)
        c = 0.5 * c + 0.1 * y[k]
    run = simulate(
        close_loop(delayed(samples), law),
        reference=r,
        disturbance={"w": w},
        elements=None if limit is None else {"u": Saturation(limit)},
        duration=5.0,
    )
    for name, expected in (("u", u), ("y", y), ("z", y)):
        np.testing.assert_allclose(run[name], expected, rtol=0, atol=1e-12)


def mass_loop():
    """A mass of 1 kg with a PID law, at 1 kHz; the derivative is that of the position."""
    dt = 1e-3
    g = StateSpace(
        [[1.0, dt], [0.0, 1.0]],
        [[0.0, 0.5 * dt**2], [0.0, dt]],
        [[-1.0, 0.0], [1.0, 0.0], [0.0, 0.0]],
        [[1.0, 0.0], [0.0, 0.0], [1.0, 0.0]],
        dt,
        inputs=["r", "u"],
        outputs=["e", "y", "r"],
    )
    # c = [integral of the error, y of the sample before]
    law = StateSpace(
        [[1.0, 0.0], [0.0, 0.0]], [[-dt, dt], [1.0, 0.0]], [[4e4, 60.0 / dt]],
        [[-1500.0 - 60.0 / dt, 1500.0]], dt, inputs=["y", "r"], outputs=["u"],
    )  # fmt: skip
    return close_loop(StandardPlant.from_statespace(g, u=["u"], y=["y", "r"]), law)


def test_anti_windup_returns_the_integrator():
    """Its pole goes from 1 to exp(-dt / tau), and the overshoot of a saturated step goes down."""
    loop, dt, tau = mass_loop(), 1e-3, 0.02
    options = {"reference": 1.0, "duration": 3.0, "elements": {"u": Saturation(20.0)}}
    wound, run = (simulate(loop, anti_windup=a, **options) for a in (None, tau))
    # x is the mass's [position, velocity], c the law's; the moved pole is 1 - back 4e4
    back = (1.0 - np.exp(-dt / tau)) / 4e4
    x, v, integral, old, y = 0.0, 0.0, 0.0, 0.0, []
    for _ in range(3000):
        y.append(x)
        command = 4e4 * integral + 1500.0 * (1.0 - x) - 60.0 / dt * (x - old)
        u = min(max(command, -20.0), 20.0)
        integral += dt * (1.0 - x) + back * (u - command)
        old, x, v = x, x + dt * v + 0.5 * dt**2 * u, v + dt * u
    np.testing.assert_allclose(run["y"], y, rtol=0, atol=1e-9)
    overshoot, before = run["y"].max() - 1.0, wound["y"].max() - 1.0
    assert overshoot < 0.5 * before


@pytest.mark.parametrize(
    ("options", "error", "message"),
    [
        ({"elements": {"u7": Saturation(1.0)}}, LabelError, "no channel for an element 'u7'"),
        ({"elements": {"u": 3.0}}, ModelError, "must be a Saturation, .* got 3.0"),
        ({"elements": {"u": [Saturation(1.0)] * 2}}, ModelError, "two elements of one kind"),
        ({"elements": Saturation(1.0)}, ModelError, "elements must be of type Mapping"),
        ({"anti_windup": -1.0}, ModelError, "anti_windup must be positive"),
    ],
)
def test_wrong_elements(options, error, message):
    with pytest.raises(error, match=message):
        simulate(mass_loop(), duration=0.1, **options)


def test_values_refuse_what_limits_nothing():
    assert repr(Saturation(2.0, rate=3.0)) == "Saturation(limit=2, rate=3)"
    for wrong in (lambda: Saturation(), lambda: Saturation(-1.0), lambda: Quantiser(0.0)):
        with pytest.raises(
            ModelError, match=r"without limits|limit must be positive|step must be positive"
        ):
            wrong()


def test_what_cannot_be_known_in_time_is_refused():
    """A block passes the applied force on to its own actuator within the sample."""
    loop = mass_loop()
    hat = StateSpace([], [], [], [[1e-9]], inputs=["u"], outputs=["hat"])
    law = loop.blocks[0]
    through = law.replace(
        B=np.hstack([law.B, [[0.0], [0.0]]]), D=np.hstack([law.D, [[1.0]]]),
        inputs=[*law.inputs, "hat"],
    )  # fmt: skip
    with pytest.raises(AssumptionError, match="depends on the applied 'u' of the same sample"):
        simulate(
            close_loop(loop.plant, hat, through), duration=0.1, elements={"u": Saturation(1.0)}
        )
    twice = StateSpace(
        np.eye(2), 1e-3 * np.eye(2)[:, :1], [[1.0, 1.0]], [[-1.0]], 1e-3,
        inputs=["y"], outputs=["u"],
    )  # fmt: skip
    with pytest.warns(), pytest.raises(ModelError, match="cannot all be determined"):
        simulate(
            close_loop(loop.plant, twice), duration=0.1, elements={"u": Saturation(1.0)},
            anti_windup=0.1,
        )  # fmt: skip

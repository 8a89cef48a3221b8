"""The error of a given observer on machines that are not its model, open and in a closed loop."""

from functools import cache

import numpy as np
import pytest
from test_kalman import plate_plant

import flexplant as fx
from flexplant.errors import AssumptionError, FlexplantWarning, LabelError, ModelError
from flexplant.estimation import design_static
from oracles_estimation import error_covariance, mean_square_and_its_error


@cache
def observer():
    """Designed on 8 modes at 1 %."""
    plant = plate_plant(1e-2, count=8, sensor_asd=1e-11)
    return fx.design_kalman(plant.replace(evaluation=None))


@cache
def servo():
    return fx.design_servo(observer().plant, bandwidth=40.0, observer=observer())


@cache
def machine():
    """Twelve modes, of another damping: another order."""
    return plate_plant(4e-3, count=12, sensor_asd=1e-11)


def joint(machine, kalman, law):
    """Covariance of z - hat with u = law(hat), dense: states of machine, filter and controller."""
    g, o = machine.system, kalman.system
    y, u = kalman.sensors, machine.u
    z = [name for name in machine.z if name in ("die:z", "die:rx", "die:ry")]
    A, B = g.A, g.B[:, g.input_index(u)]
    C1, C2 = g.C[g.output_index(z)], g.C[g.output_index(y)]
    assert not g.D[np.ix_(g.output_index([*z, *y]), g.input_index(u))].any()
    By, Bu = o.B[:, o.input_index(y)], o.B[:, o.input_index(u)]
    Dy = o.D[:, o.input_index(y)]
    assert not o.D[:, o.input_index(u)].any()
    As, Cs = law.A, law.C[law.output_index(u)]
    hats = [name for name in law.inputs if name in o.outputs]
    assert set(hats) == set(o.outputs)
    order = [law.inputs.index(name) for name in o.outputs]
    Bs, Ds = law.B[:, order], law.D[np.ix_(law.output_index(u), order)]
    n, m, k = A.shape[0], o.A.shape[0], As.shape[0]
    hat = np.hstack([Dy @ C2, o.C, np.zeros((len(z), k))])
    drive = np.hstack([np.zeros((len(u), n + m)), Cs]) + Ds @ hat
    F = np.zeros((n + m + k, n + m + k))
    F[:n, :n], F[n : n + m, n : n + m], F[n + m :, n + m :] = A, o.A, As
    F[n : n + m, :n] = By @ C2
    F[:n] += B @ drive
    F[n : n + m] += Bu @ drive
    F[n + m :] += Bs @ hat
    rows = [machine.y.index(name) for name in y]
    R = machine.sensor_noise[np.ix_(rows, rows)]
    into = np.vstack([B @ Ds @ Dy, By + Bu @ Ds @ Dy, Bs @ Dy])
    Q = into @ R @ into.T
    Q[:n, :n] += machine.process_noise
    assert np.abs(np.linalg.eigvals(F)).max() < 1
    E = np.hstack([C1, np.zeros((len(z), m + k))]) - hat
    X = error_covariance(F, Q)
    return np.diag(E @ X @ E.T + Dy @ R @ Dy.T)


@pytest.mark.slow
def test_in_a_closed_loop_on_another_machine_it_is_the_joint_lyapunov_equation():
    kalman, law = observer(), servo()
    for truth in (machine(), kalman.plant):
        loop = fx.close_loop(truth, kalman, law)
        wanted = np.sqrt(joint(truth, kalman, law.system))
        found = [kalman.rms(name, on=loop) for name in ("die:z", "die:rx", "die:ry")]
        np.testing.assert_allclose(found, wanted, rtol=1e-5)
    # on its own model u is known: the loop changes nothing
    np.testing.assert_allclose(
        found, [kalman.rms(n) for n in ("die", "die:rx", "die:ry")], rtol=1e-6
    )


@pytest.mark.slow
def test_in_a_closed_loop_a_simulation_has_the_same_error():
    kalman = observer()
    loop = fx.close_loop(machine(), kalman, servo())
    run = fx.simulate(loop, duration=1.5, rng=3, runs=6)
    error = (run["die:z"] - run["die:hat"])[:, 5000:].T
    square, deviation = mean_square_and_its_error(error)
    assert deviation < 0.1 * square
    assert abs(square - kalman.rms("die", on=loop) ** 2) < 3 * deviation


@pytest.mark.slow
def test_an_observer_beside_a_loop_and_what_is_refused():
    kalman, law = observer(), servo()
    other = fx.design_kalman(kalman.plant.replace(origin=kalman.plant.origin))
    loop = fx.close_loop(machine(), kalman, law)
    assert other.rms("die", on=loop) == pytest.approx(kalman.rms("die", on=loop), rel=1e-9, abs=0)
    loud = fx.design_kalman(plate_plant(1e-2, count=8, sensor_asd=1e-10))
    with pytest.raises(ModelError, match="another estimator"):
        loud.rms("die", on=loop)
    with pytest.raises(LabelError, match="no POI channel"):
        kalman.rms("dye", on=loop)
    flipped = law.system.replace(C=-law.system.C, D=-law.system.D)
    with pytest.warns(FlexplantWarning, match="unstable"):
        wild = fx.close_loop(machine(), kalman, flipped)
    with pytest.raises(AssumptionError, match="stable closed loop"):
        kalman.rms("die", on=wild)


@pytest.mark.slow
def test_half_a_percent_of_frequency_doubles_the_error_of_a_filter_not_of_geometry():
    """A light plate whose filter leans on its model: 0.1 % damping, quiet sensors."""
    light = plate_plant(1e-3, count=14, sensor_asd=1e-13).replace(evaluation=None)
    known = light.uncertain(frequency=0.01).nominal
    kalman, static = fx.design_kalman(known), design_static(known)
    each = [kalman.rms("die:rx", on=one) for one in known.machines.plants]
    assert np.median(each) > 1.5 * kalman.rms("die:rx")
    low, high, sentence = kalman.interval("die:rx")
    assert low < np.median(each) < high and "95 % of such machines" in sentence
    assert static.interval("die:rx").high < 1.2 * static.rms("die:rx")
    fine = fx.design_kalman(light.uncertain(frequency=1e-4).nominal)
    assert fine.interval("die:rx").high < 1.1 * fine.rms("die:rx")

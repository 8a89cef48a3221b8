"""A Kalman filter that reads decoupled motions: correlated noise, the same information or less."""

import numpy as np
import pytest
import scipy.linalg as la

import flexplant as fx
from flexplant.errors import ModelError
from flexplant.plant import gravity_axes, reference_errors
from stages import CORNERS, L, ports, reduced, sampled, some_modes

#: meshes are small here: what they do not resolve is the subject of test_mesh

WHOLE = some_modes(count=40, attached=False)


def machine(places):
    """The plate with sensors at some places of unequal noise, without references."""
    y = [fx.Sensor(f"y{i}", at=at, asd=i * 1e-11) for i, at in enumerate(places, 1)]
    return sampled(reduced(), ports(y=y, references=()))


@pytest.mark.slow
def test_as_many_motions_as_sensors_are_the_same_filter():
    plant = machine(CORNERS[:3])
    motions = gravity_axes(plant).to_motions
    decoupled = plant.through(motions)
    assert decoupled.y == ("cog:z", "cog:rx", "cog:ry")
    for whole in (None, WHOLE):
        one = fx.design_kalman(plant.replace(evaluation=whole))
        two = fx.design_kalman(decoupled.replace(evaluation=whole))
        for name in ("die:z", "die:rx", "die:ry"):
            assert two.rms(name) == pytest.approx(one.rms(name), rel=1e-6, abs=0)
        # its gain is that of the sensors, times what makes sensors of motions
        np.testing.assert_allclose(
            two.gain @ motions.D, one.gain, rtol=1e-5, atol=1e-8 * np.abs(one.gain).max()
        )
    assert two.certificate["truncated modes"] == one.certificate["truncated modes"] > 0
    assert two.sensors == decoupled.y
    on = two.rms("die:z", on=sampled(reduced(), plant.assembled.ports))
    assert on == pytest.approx(one.rms("die:z", on=plant), rel=1e-6, abs=0)


def test_fewer_motions_than_sensors_against_a_dense_riccati_equation():
    plant = machine([*CORNERS, (L / 2, 0.1, 0.0)])
    T = gravity_axes(plant).to_motions
    decoupled = plant.through(T)
    found = fx.design_kalman(decoupled)
    scale = 1e9  # measurements in nm
    R = T.D @ np.diag([(i * 1e-11) ** 2 * 1e4 / 2 for i in range(1, 6)]) @ T.D.T * scale**2
    A, C = plant.system.A, T.D @ plant.C2 * scale
    P = la.solve_discrete_are(A.T, C.T, plant.process_noise, R)
    after = P - P @ C.T @ np.linalg.solve(C @ P @ C.T + R, C @ P)
    row = plant.C1[plant.z.index("die:z")]
    assert found.rms("die:z") == pytest.approx(np.sqrt(row @ after @ row), rel=1e-5, abs=0)
    assert found.rms("die:z") > fx.design_kalman(plant).rms("die:z")
    # it is a block of a loop, behind the decoupling
    loop = fx.close_loop(plant, T, found, idle=plant.u)
    assert {"cog:z", "die:hat"} <= {*loop.watched}


def test_refusals():
    plant = sampled(reduced(), ports())
    with pytest.raises(ModelError, match="mixes references with sensors"):
        fx.design_kalman(plant.through(reference_errors(plant)))
    decoupled = plant.through(gravity_axes(plant).to_motions)
    with pytest.raises(ModelError, match="read through a block"):
        fx.design_static(decoupled)
    with pytest.raises(ModelError, match="the plant is weighted and read through"):
        fx.design_kalman(decoupled.weighted(z={"die:z": 2.0}))

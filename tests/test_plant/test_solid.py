"""All six rigid-body modes, from an imported solid: the example's numbers, and the body's."""

import importlib.util
from functools import cache
from pathlib import Path

import numpy as np
import pytest

EXAMPLE = Path(__file__).parents[2] / "examples" / "solid_stage.py"


@cache
def example():
    spec = importlib.util.spec_from_file_location("solid_stage", EXAMPLE)
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


@cache
def found():
    return example().main()


def body_row(at, direction, centre):
    """What a rigid block's motion about a point shows: small rotations, r x."""
    arm = np.array(at) - centre
    k = "xyz".index(direction)
    return np.concatenate([np.eye(3)[k], np.cross(np.eye(3), arm)[:, k]])


@pytest.mark.slow
def test_modes_of_the_block():
    modes = found()["modes"]
    assert modes.n_rigid == 6
    assert not modes.freq[:6].any()
    # free eight-node bricks, by a dense eigenvalue solver without flexplant
    M, K, _ = example().mesh()
    import scipy.linalg as la

    values = la.eigvalsh(K.toarray(), M.toarray())
    np.testing.assert_allclose(modes.freq[6:], np.sqrt(values[6:20]) / (2 * np.pi), rtol=1e-8)
    np.testing.assert_allclose(modes.freq[6], 2330.0, rtol=1e-3)


@pytest.mark.slow
def test_all_assumptions_hold_and_one_sensor_less_is_named():
    plant = found()["plant"]
    assert found()["report"].ok
    fewer = plant.with_ports(plant.assembled.ports.replace(y=plant.assembled.ports.y[:-1]))
    assert not fewer.check()["detectable"].holds
    assert "translation y" in fewer.check()["detectable"].finding
    fewer = plant.with_ports(plant.assembled.ports.replace(u=plant.assembled.ports.u[:-1]))
    assert not fewer.check()["stabilisable"].holds


def test_the_decoupling_knows_the_block():
    axes = found()["decoupling"]
    lx, ly, lz = example().SIZE
    mass = 2700.0 * lx * ly * lz
    inertia = mass / 12 * np.array([ly**2 + lz**2, lx**2 + lz**2, lx**2 + ly**2])
    np.testing.assert_allclose(axes.centre, [lx / 2, ly / 2, lz / 2], rtol=1e-9)
    assert axes.axes == example().AXES
    np.testing.assert_allclose(axes.mass, np.diag([mass] * 3 + [*inertia]), atol=1e-8 * mass)
    see = [body_row(p, d, axes.centre) for p, d in example().SENSORS.values()]
    push = [body_row(p, d, axes.centre) for p, d in example().PUSHERS.values()]
    np.testing.assert_allclose(axes.T_y @ np.array(see), np.eye(6), atol=1e-7)
    np.testing.assert_allclose(np.array(push).T @ axes.T_u, np.eye(6), atol=1e-7)


def test_estimates_and_servo_of_six_axes():
    observer, loop = found()["observer"], found()["loop"]
    rms = [1e9 * observer.rms(f"die:{axis}") for axis in example().AXES]
    np.testing.assert_allclose(rms, [0.376, 0.475, 0.349, 2.721, 2.314, 2.581], rtol=2e-3)
    assert loop.spectral_radius == pytest.approx(0.99643, abs=1e-5)
    assert loop.modulus_margin == pytest.approx(0.536, abs=1e-3)
    # 1 mm in x; the error settles to noise
    error = found()["run"]["die:error"]
    assert np.abs(error).max() > 1e-6
    assert np.std(error[-1000:]) < 2e-8
    assert abs(found()["run"]["die:x"][-1] - 1e-3) < 1e-7
    for axis in example().AXES[1:]:
        assert np.abs(found()["run"][f"die:{axis}"][-1000:]).max() < 1e-6


def test_the_poi_between_nodes_moves_rigidly():
    plant = found()["plant"]
    g = plant.continuous.system
    rows = g.C[[plant.z.index(f"die:{axis}") for axis in example().AXES]]
    rigid = rows[:, 0:12:2] * g.A[0, 1]
    # rigid shapes at the sensors determine the body's motion; the POI must follow it
    centre = found()["decoupling"].centre
    see = np.array([body_row(p, d, centre) for p, d in example().SENSORS.values()])
    y = [g.outputs.index(name) for name in example().SENSORS]
    at_sensors = g.C[y][:, 0:12:2] * g.A[0, 1]
    motion = np.linalg.solve(see, at_sensors)
    wanted = [body_row(example().POI, d, centre) @ motion for d in "xyz"] + [*motion[3:]]
    np.testing.assert_allclose(rigid, wanted, atol=1e-8)


@pytest.mark.slow
def test_picture(tmp_path):
    assert example().picture(found(), tmp_path).stat().st_size > 60_000

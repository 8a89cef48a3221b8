"""The static relation: geometry in closed form, its predicted error, refusals."""

import numpy as np
import pytest
from test_kalman import INSET, L, dictionaries, modes, plate_plant, ports

from flexplant import testbeds
from flexplant.errors import AssumptionError, LabelError, ModelError
from flexplant.estimation import design_kalman, design_static
from flexplant.plant import Disturbance, Poi, Sensor, assemble_plant
from oracles_estimation import error_covariance, mean_square_and_its_error, run

CENTRE = [Poi("die", at=(L / 2, L / 2, 0.0), axes=("z", "rx", "ry"))]


def test_gains_of_the_centre_from_the_corners():
    estimator = design_static(plate_plant(z=CENTRE))
    z = np.full(4, 0.25)
    rx = np.array([-1, -1, 1, 1]) / (2 * L)  # dz/dy
    ry = np.array([1, -1, 1, -1]) / (2 * L)  # -dz/dx
    np.testing.assert_allclose(estimator.gain, [z, rx, ry], atol=1e-9)
    assert estimator.system.inputs == ("y1", "y2", "y3", "y4")
    assert estimator.system.outputs == ("die:hat", "die:rx:hat", "die:ry:hat")
    assert estimator.system.dt == pytest.approx(1e-4)


def test_any_point_is_the_plane_through_the_sensors():
    spots = [(0.05, 0.1, 0), (0.5, 0.2, 0), (0.3, 0.55, 0)]
    y = [Sensor(f"s{i}", at=p, asd=1e-12) for i, p in enumerate(spots)]
    gain = design_static(plate_plant(y=y)).gain
    plane = np.linalg.inv(np.array([[1, x, yy] for x, yy, _ in spots]))
    expected = [np.array([1, 0.31, 0.26]) @ plane, plane[2], -plane[1]]
    np.testing.assert_allclose(gain, expected, atol=1e-7)


def test_velocities_are_left_out():
    fast = Sensor("v", at=(0.3, 0.3, 0), quantity="velocity", asd=1e-8)
    assert design_static(plate_plant(y=[fast, *ports().y])).system.inputs == (
        "y1",
        "y2",
        "y3",
        "y4",
    )


@pytest.mark.parametrize("zeta", [1e-2, 1e-3])
@pytest.mark.parametrize("delay", [0.0, 1.5])
def test_rms_is_that_of_the_elastic_modes_and_the_noise(zeta, delay):
    plant = plate_plant(zeta, delay=delay, sensor_asd=1e-10)
    estimator = design_static(plant)
    truth, _ = dictionaries(plant, design_kalman(plant))
    elastic = slice(6, 48)
    P = error_covariance(truth["A"][elastic, elastic], truth["Q"][elastic, elastic])
    left = (truth["C1"] - estimator.gain @ truth["C2"])[:, elastic]
    variance = np.diag(left @ P @ left.T + estimator.gain @ truth["R"] @ estimator.gain.T)
    found = [estimator.rms(name) for name in ("die", "die:rx:hat", "die:ry")]
    np.testing.assert_allclose(found, np.sqrt(variance), rtol=1e-7)


@pytest.mark.slow
def test_a_run_agrees_within_three_standard_errors():
    plant = plate_plant(1e-2)
    estimator = design_static(plant)
    truth, observer = dictionaries(plant, design_kalman(plant))
    observer = {name: 0 * value for name, value in observer.items()} | {"Dy": estimator.gain}
    rng = np.random.default_rng(2)
    errors = run(truth, observer, plant.B2, np.zeros((8_000, 4)), 8_000, rng, count=32)[2_000:]
    for i, channel in enumerate(("die:z", "die:rx", "die:ry")):
        square, deviation = mean_square_and_its_error(errors[:, i])
        assert deviation < 0.1 * square
        assert abs(square - estimator.rms(channel) ** 2) < 3 * deviation


def test_the_kalman_filter_is_better():
    plant = plate_plant()
    assert 2 * design_kalman(plant).rms("die") < design_static(plant).rms("die")


def test_a_continuous_plant_has_gains_but_no_rms():
    estimator = design_static(assemble_plant(modes(), ports(z=CENTRE)))
    np.testing.assert_allclose(estimator.gain[0], 0.25, atol=1e-9)
    with pytest.raises(AssumptionError, match="plant is continuous"):
        estimator.rms("die")


def test_refusals():
    with pytest.raises(AssumptionError, match="do not determine"):
        design_static(plate_plant(y=ports().y[:2]))
    with pytest.raises(LabelError, match="no POI channel"):
        design_static(plate_plant()).rms("u1:effort")
    with pytest.raises(ModelError, match="StandardPlant"):
        design_static("plant")
    only_speed = [Sensor("v", at=p, quantity="velocity", asd=1e-8) for p in INSET[:1]]
    with pytest.raises(AssumptionError, match=r"sensors \(none\)"):
        design_static(plate_plant(y=only_speed))


def test_repr():
    text = repr(design_static(plate_plant()))
    assert text == "<StaticEstimator: y1, y2, y3, y4 -> die:hat, die:rx:hat, die:ry:hat>"
    assert Disturbance("a", at=INSET[0]).asd == 0.0


@pytest.mark.parametrize(
    "kind", ["gantry", "dual_stage", "steering_mirror", "flexible_joint", "hexapod", "maglev_block"]
)
def test_what_drives_move_at_rest_is_estimated_exactly(kind):
    """By dense solves next to z = 1: relative encoders, flexures and soft feet alike."""
    plant = getattr(testbeds, kind)()
    found = design_static(plant)
    g, s = plant.system, 1e-3
    rows = [name.removesuffix(":hat") for name in found.system.outputs]
    names = [next(z for z in plant.z if z == n or z.split(":")[0] == n) for n in rows]
    where = [g.outputs.index(name) for name in (*names, *found.system.inputs)]
    columns = [g.inputs.index(name) for name in plant.u]
    pencil = np.expm1(s * g.dt) * np.eye(g.n_states) - (g.A - np.eye(g.n_states))
    G = g.C[where] @ np.linalg.solve(pencil, g.B[:, columns]) + g.D[np.ix_(where, columns)]
    z, y = G[: len(names)], G[len(names) :]
    forces = np.linalg.pinv(z)
    np.testing.assert_allclose(found.gain @ y @ forces, z @ forces, atol=1e-5)
    assert np.linalg.matrix_rank(z @ forces) == len(names)

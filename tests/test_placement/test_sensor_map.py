"""The map of one more sensor, point by point against the filter itself."""

import numpy as np
import pytest

from flexplant import load
from flexplant.errors import AssumptionError, LabelError, ModelError, ShapeError
from flexplant.placement import Disc, Excluded, PoiVariance, Rectangle, sensor_map
from flexplant.plant import Sensor

GRID = np.array([(x, y, 0.0) for y in (0.0, 0.2, 0.35) for x in (0.0, 0.25, 0.5)])


@pytest.mark.slow
def test_every_point_is_the_plant_with_one_more_sensor(make, tmp_path):
    plant, _, _ = make(21)
    found = sensor_map(plant, GRID, PoiVariance("die"), asd=2e-11)
    for point, value in zip(GRID, found.values, strict=True):
        more = [*plant.assembled.ports.y, Sensor("more", at=point, asd=2e-11)]
        direct = PoiVariance("die")(plant.with_ports(plant.assembled.ports.replace(y=more)))
        assert value == pytest.approx(direct, rel=1e-9, abs=0.0)
    assert found.without == pytest.approx(PoiVariance("die")(plant), rel=1e-9, abs=0.0)
    assert np.all(found.ratio < 1)
    assert np.ptp(found.ratio) > 1e-3
    np.testing.assert_array_equal(found.best, GRID[np.argmin(found.values)])
    found.save(tmp_path / "map.npz")
    assert repr(load(tmp_path / "map.npz")) == repr(found)


def test_a_plant_whose_sensors_do_not_suffice(make):
    plant, sensors, _ = make(21)
    two = plant.with_ports(plant.assembled.ports.replace(y=sensors[:2]))
    (x1, y1, _), (x2, y2, _) = (sensor.at for sensor in sensors[:2])
    between = (0.5 * (x1 + x2), 0.5 * (y1 + y2), 0.0)
    found = sensor_map(two, [between, GRID[0], GRID[8]], asd=1e-11)
    assert np.isinf(found.without)
    assert np.isinf(found.values[0])  # three in a row
    assert np.all(np.isfinite(found.values[1:]))
    assert list(found.ratio) == [1.0, 0.0, 0.0]


@pytest.mark.slow
def test_no_sensor_is_tried_where_none_can_be(make, tmp_path):
    plant, _, _ = make(21)
    every = sensor_map(plant, GRID, asd=1e-11)
    zones = [Disc(every.best[:2], 0.01), Rectangle((0.4, 0.1), (0.6, 0.3))]
    found = sensor_map(plant, GRID, asd=1e-11, constraints=[Excluded(zones)])
    left = [
        i
        for i, (x, y, _) in enumerate(GRID)
        if np.hypot(*(every.best[:2] - (x, y))) >= 0.01 and (x, y) != (0.5, 0.2)
    ]
    assert len(left) == len(GRID) - 2
    np.testing.assert_array_equal(found.points, GRID[left])
    np.testing.assert_allclose(found.values, every.values[left], rtol=1e-12)
    assert found.values.min() > every.values.min()
    found.save(tmp_path / "map.npz")
    assert repr(load(tmp_path / "map.npz").excluded) == repr(tuple(zones))
    with pytest.raises(ModelError, match="that satisfies the constraints"):
        sensor_map(plant, GRID[:1], asd=1e-11, constraints=[Excluded(Disc(GRID[0, :2], 0.01))])
    with pytest.raises(ModelError, match="a Rectangle or a Disc, got"):
        sensor_map(plant, GRID, asd=1e-11, constraints=[Excluded([(0.3, 0.3)])])


def test_names_do_not_collide(make):
    plant, sensors, _ = make(21)
    taken = [s.replace(name=f"extra{i}") for i, s in enumerate(sensors[:3])]
    other = plant.with_ports(plant.assembled.ports.replace(y=taken))
    assert sensor_map(other, GRID[:2], asd=1e-11).values == pytest.approx(
        sensor_map(plant, GRID[:2], asd=1e-11).values, rel=1e-12, abs=0.0
    )


def test_bad_input(make):
    plant, sensors, _ = make(21)
    with pytest.raises(ShapeError, match="points"):
        sensor_map(plant, [(0.1, 0.1)], asd=1e-11)
    with pytest.raises(ModelError, match="no point"):
        sensor_map(plant, np.zeros((0, 3)), asd=1e-11)
    with pytest.raises(LabelError, match="off the plate"):
        sensor_map(plant, [(5.0, 0.1, 0.0)], asd=1e-11)
    with pytest.raises(AssumptionError, match="no noise"):
        sensor_map(plant, GRID, asd=0.0)
    with pytest.raises(ModelError, match="continuous"):
        sensor_map(plant.continuous, GRID, asd=1e-11)
    one = plant.with_ports(plant.assembled.ports.replace(y=sensors[:1]))
    with pytest.raises(AssumptionError, match="rigid-body"):
        sensor_map(one, GRID[:1], asd=1e-11)

"""Pictures of placement show what the values hold, in units that people read."""

import numpy as np
import pytest

from flexplant import plot
from flexplant.errors import ModelError
from flexplant.placement import Disc, Exchange, PoiVariance, pareto_curve, place_sensors, sensor_map
from flexplant.plant import Actuator, Disturbance, Poi, Ports, Sensor, assemble_plant
from placement_plate import SIZE, plate_modes


def stage():
    """A plate with four shakers, a die in its middle and candidates on a grid."""
    x, y = SIZE
    grid = [(a, b, 0.0) for a in np.linspace(0, x, 7) for b in np.linspace(0, y, 5)]
    sensors = [Sensor(f"s{i}", at=place, asd=2e-11) for i, place in enumerate(grid)]
    inset = [(a * x, b * y, 0.0) for a in (0.25, 0.75) for b in (0.25, 0.75)]
    ports = Ports(
        w=[Disturbance(f"amp{i}", at=place, asd=1e-3) for i, place in enumerate(inset)],
        u=[Actuator(f"u{i}", at=place) for i, place in enumerate(inset)],
        z=[Poi("die", at=(0.22, 0.16, 0.0), axes=("z", "rx", "ry"))],
        y=[sensors[i] for i in (0, 4, 30)],
    )
    return assemble_plant(plate_modes(10), ports).discretized(5e3, delay=1), sensors, grid


@pytest.mark.slow
def test_the_curve_is_in_nanometres_and_its_bound_below():
    plant, sensors, _ = stage()
    curve = pareto_curve(plant, sensors, range(3, 6), method=Exchange(1), rng=0)
    ax = plot.pareto_curve(curve)
    found, bound = ax.get_lines()[:2]
    factor = {"rms error [nm]": 1e9, "rms error [pm]": 1e12}[ax.get_ylabel()]
    np.testing.assert_allclose(found.get_ydata(), factor * np.sqrt(curve.values))
    assert np.all(bound.get_ydata() < found.get_ydata())
    with pytest.raises(ModelError, match="found must be"):
        plot.pareto_curve(plant)


@pytest.mark.slow
def test_devices_on_a_mode_shape():
    plant, sensors, _ = stage()
    best = place_sensors(plant, sensors, 4, PoiVariance(), method=Exchange(1), rng=0)
    die = Disc((0.22, 0.16), 0.04)
    ax = plot.placed(best.on(plant), mode=4, zones=[die])
    marked = {line.get_label(): line.get_xydata() for line in ax.get_lines()}
    assert len(marked["sensors"]) == 4 and len(marked["actuators"]) == 4
    np.testing.assert_allclose(
        marked["sensors"], [1e3 * np.array(port.at[:2]) for port in best.ports]
    )
    np.testing.assert_allclose(marked["POI"], [[220.0, 160.0]])
    assert (ax.get_xlabel(), ax.get_ylabel()) == ("x [mm]", "y [mm]")
    assert ax.get_title().startswith("mode 4, ")
    assert len(ax.patches) == 1
    with pytest.raises(ModelError, match="mode must be"):
        plot.placed(plant, mode=99)


@pytest.mark.slow
def test_the_map_shows_devices_poi_and_zones():
    plant, _, grid = stage()
    found = sensor_map(plant, grid, asd=2e-11)
    ax = plot.sensor_map(found, ports=plant.assembled.ports)
    marked = {line.get_label() for line in ax.get_lines()}
    assert {"sensors", "actuators", "POI", "best place"} <= marked
    assert "m rms" in repr(found)

"""Workbench, report, scan, moving ports and C code on driven machines: the axes of every verb."""

import warnings
from functools import cache

import numpy as np
import pytest

import flexplant as fx
from flexplant.errors import FlexplantWarning, ModelError
from flexplant.workbench.bench import Bench
from flexplant.workbench.evaluation import Evaluator
from judge import gain, judged

#: bandwidths [Hz]: on masses, below and above springs, of relative drives and of velocities
BANDWIDTHS = {
    "gantry": 4.0,
    "dual_stage": 10.0,
    "steering_mirror": 60.0,
    "isolation_table": 8.0,
    "hexapod": 4.0,
    "ball_screw": 5.0,
    "maglev_block": 20.0,
}
KINDS = tuple(BANDWIDTHS)


@pytest.fixture(autouse=True)
def _quiet():
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", FlexplantWarning)
        yield


@cache
def plant_of(kind):
    return getattr(fx.testbeds, kind)()


@cache
def loop_of(kind):
    plant = plant_of(kind)
    observer = fx.design_kalman(plant)
    servo = fx.design_servo(plant, bandwidth=BANDWIDTHS[kind], observer=observer)
    return fx.close_loop(plant, observer, servo)


def reference_of(kind):
    return next(name for name in plant_of(kind).w if name.endswith(":ref"))


@pytest.mark.slow
@pytest.mark.parametrize("kind", KINDS)
def test_the_workbench_begins_with_a_stable_loop(kind):
    """Poles of the first laws together: of a mass, a spring and a velocity, by the matrices."""
    plant = plant_of(kind)
    bench = Bench.of(plant, None, {})
    design, machine = bench.design, bench.machines[0]
    verdict = judged(plant, fx.design_loops(plant, design.laws))
    assert verdict.radius < 1.0
    assert design.axes.keys() == set(fx.decouple(plant).axes)
    assert set(design.references.values()) == {n for n in plant.y if n.endswith(":ref")}
    # the loop of an axis that is shown, with the others open: the plant by dense solves
    name = next(iter(design.axes))
    opened = {n: axis.replace(closed=n == name) for n, axis in design.axes.items()}
    shown = Evaluator().loop(machine, design.replace(axes=opened), name)
    g, before, after = plant.system, design.before, design.after
    rows, columns = g.output_index(after.inputs), g.input_index(before.outputs)
    some = np.linspace(0, machine.freq.size - 1, 7).astype(int)
    z = np.exp(2j * np.pi * machine.freq[some] * g.dt)
    G = gain(g.A, g.B[:, columns], g.C[rows], g.D[np.ix_(rows, columns)], z)
    i = after.outputs.index(name)
    inner = np.einsum("y,fyu,u->f", after.D[i], G, before.D[:, i])
    law = design.laws[name].system
    C = gain(law.A, law.B, law.C, law.D, z)[:, 0, 0]
    np.testing.assert_allclose(shown.L[some], C * inner, rtol=1e-6, atol=1e-9)


@pytest.mark.long
@pytest.mark.parametrize("kind", ["gantry", "dual_stage", "steering_mirror", "maglev_block"])
def test_a_scan_and_its_report(kind, tmp_path):
    """Constant velocity of the first reference: feedforward makes the error far smaller."""
    plant, loop, ref = plant_of(kind), loop_of(kind), reference_of(kind)
    fast = BANDWIDTHS[kind]
    scan = fx.simulation.scan(
        1e-3, velocity=1e-3 * fast, acceleration=2e-3 * fast**2, jerk=1e-2 * fast**3,
        snap=0.08 * fast**4, rate=1.0 / plant.dt,
    )  # fmt: skip
    fed = fx.close_loop(plant, *loop.blocks, fx.design_feedforward(loop, reference=ref))
    error = ref.replace(":ref", ":error")
    runs = [
        fx.simulate(one, reference={ref: scan}, duration=scan.duration + 2.0 / fast, noise=False)
        for one in (loop, fed)
    ]
    without, left = (run.peak(error) for run in runs)
    assert left < 0.1 * without
    page = fx.plot.report(tmp_path / "page.html", fed, plant, {"scan": runs[1]})
    said = page.read_text(encoding="utf-8")
    assert "from forces along each axis to the POI" in said
    assert all(name in said for name in (error, *plant.u))


@pytest.mark.parametrize("kind", ["gantry", "dual_stage", "hexapod"])
def test_one_place_is_not_where_a_relative_port_moves(kind):
    """The reference point would be lost: gains and runs would be those of an absolute POI."""
    plant = plant_of(kind)
    poi, there = plant.assembled.ports.z[0].name, [[0.0, 0.0, 0.0]]
    for call in (
        lambda: plant.along(poi, there),
        lambda: plant.at({poi: there[0]}),
        lambda: fx.design_feedforward(plant, reference=f"{poi}:ref", along=there),
    ):
        with pytest.raises(ModelError, match="between points"):
            call()
    same = plant.at({poi: dict(plant.assembled.ports.z[0].at)})
    np.testing.assert_allclose(same.system.C, plant.system.C, atol=1e-12)


@pytest.mark.slow
def test_a_poi_moves_over_a_free_block():
    """The response of the POI at a place that is stated is that of the place along a path."""
    plant = plant_of("maglev_block")
    poi = plant.assembled.ports.z[0]
    places = np.array([poi.at, np.add(poi.at, [0.02, -0.01, 0.0])])
    path = plant.along(poi.name, places)
    for k, place in enumerate(places):
        moved = plant.at({poi.name: place.tolist()}).system
        rows = moved.output_index(list(path.channels))
        np.testing.assert_allclose(path.C[k], moved.C[rows], atol=1e-9 * np.abs(moved.C).max())
    gains = fx.design_feedforward(plant, reference=reference_of("maglev_block"), along=places).gains
    assert gains.shape[0] == 2 and not np.allclose(gains[0], gains[1])

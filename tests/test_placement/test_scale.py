"""The same answer on any executor, after being killed, and with a worker that dies."""

import os
import signal
import subprocess
import sys
import time
from collections import Counter
from concurrent.futures import ProcessPoolExecutor
from itertools import combinations
from multiprocessing import get_context
from pathlib import Path

import numpy as np
import pytest

import flexplant.parallel
from flexplant.errors import ModelError, SolverError
from flexplant.estimation import FixedLag
from flexplant.lti import low_pass_filter
from flexplant.modes import Modes
from flexplant.parallel import mapped
from flexplant.placement import (
    BranchAndBound,
    ClosedLoopH2,
    Exchange,
    Exhaustive,
    PoiLqr,
    PoiVariance,
    pareto_curve,
    place_actuators,
    place_both,
    place_sensors,
    score_actuators,
    score_sensors,
    sensor_map,
)
from flexplant.placement.candidates import with_side
from flexplant.placement.criterion import OnPlant
from flexplant.placement.problem import layouts_of
from flexplant.plant import BaseAcceleration, Reference, building
from placement_plate import machine, plate_modes

METHODS = (Exchange(starts=4), Exhaustive(), BranchAndBound(starts=2))


def same(one, other):
    assert one._fields() | {"ports": 0} == other._fields() | {"ports": 0}


@pytest.mark.long
def test_serial_process_pool_and_dask_agree_to_the_bit(make, send_everything):
    distributed = pytest.importorskip("distributed")
    plant, sensors, _ = make(12)
    serial = [place_sensors(plant, sensors, 4, method=method, rng=5) for method in METHODS]
    with (
        ProcessPoolExecutor(2, mp_context=get_context("spawn")) as pool,
        distributed.LocalCluster(n_workers=2, threads_per_worker=1, dashboard_address=None) as own,
        distributed.Client(own) as client,
    ):
        for executor in (pool, client.get_executor()):
            for method, expected in zip(METHODS, serial, strict=True):
                found = place_sensors(plant, sensors, 4, method=method, rng=5, executor=executor)
                same(found, expected)


class Slow:
    """A criterion that notes each call in a file: what is in the checkpoint is not called again."""

    def __init__(self, folder):
        self.folder = folder

    def __repr__(self):
        return "Slow"

    def __call__(self, plant):
        with open(Path(self.folder) / "calls", "a") as file:
            file.write(".")
        time.sleep(0.003)
        return float(sum(sensor.at[0] ** 2 for sensor in plant.assembled.ports.y))


SCRIPT = """
import sys
sys.path[:0] = {paths!r}
from test_scale import Slow
from placement_plate import machine
from flexplant.placement import Exhaustive, place_sensors
plant, sensors, _ = machine(12, count=11)
place_sensors(plant, sensors, 4, Slow({folder!r}), method=Exhaustive(), checkpoint={path!r})
"""


@pytest.mark.slow
def test_killed_and_resumed_nothing_is_lost_or_done_twice(make, tmp_path):
    path, calls = tmp_path / "search.jsonl", tmp_path / "calls"
    here = Path(__file__).parent
    code = SCRIPT.format(paths=[str(here), str(here.parent)], folder=str(tmp_path), path=str(path))
    process = subprocess.Popen([sys.executable, "-c", code])
    while not path.exists() or path.read_bytes().count(b"\n") < 3:
        assert process.poll() is None
        time.sleep(0.01)
    process.send_signal(signal.SIGKILL)
    process.wait()
    before = calls.stat().st_size
    with path.open("ab") as file:  # as a power cut would leave it
        file.write(b"[9, [0.1")
    plant, sensors, _ = make(12, count=11)
    criterion, method = Slow(str(tmp_path)), Exhaustive()
    found = place_sensors(plant, sensors, 4, criterion, method=method, checkpoint=path)
    assert found.evaluations == 330
    seen = calls.stat().st_size
    assert before >= 2 * 60  # two blocks of 64, without sets that miss a rigid-body mode
    assert seen <= 330 + 64  # the block that was under way when it was killed
    same(place_sensors(plant, sensors, 4, criterion, method=method, checkpoint=path), found)
    assert calls.stat().st_size == seen
    lowest = sorted(sensors, key=lambda sensor: sensor.at[0] ** 2)[:4]
    assert set(found.chosen) == {sensor.name for sensor in lowest}


@pytest.mark.slow
@pytest.mark.parametrize("method", METHODS, ids=lambda method: type(method).__name__)
def test_a_file_that_was_cut_gives_the_same_answer(make, tmp_path, method):
    plant, sensors, _ = make(12)
    path = tmp_path / "search.jsonl"
    found = place_sensors(plant, sensors, 4, method=method, checkpoint=path)
    lines = path.read_bytes().splitlines(keepends=True)
    assert len(lines) > 2
    for kept in (1 + len(lines) // 2, len(lines)):
        path.write_bytes(b"".join(lines[:kept]))
        same(place_sensors(plant, sensors, 4, method=method, checkpoint=path), found)
    other = make(13)[0]
    for changed, count, criterion in (
        (plant, 5, None),
        (other, 4, None),
        (plant, 4, PoiVariance("die", "rx")),
    ):
        with pytest.raises(ModelError, match="checkpoint of another search"):
            place_sensors(changed, sensors, count, criterion, method=method, checkpoint=path)


def ends_once(item):
    """End the process at item 7, the first time only."""
    folder, number = item
    mark = Path(folder) / "died"
    if number == 7 and not mark.exists():
        mark.touch()
        os._exit(1)
    return number**2


def ends(number):
    if number == 7:
        os._exit(1)
    return number


@pytest.mark.slow
def test_a_worker_that_dies_is_survived_once(tmp_path, monkeypatch):
    monkeypatch.setattr(flexplant.parallel, "PROBE", 0.0)
    monkeypatch.setattr(flexplant.parallel, "CHUNK", 1e-7)
    with ProcessPoolExecutor(2) as pool:
        found = mapped(ends_once, [(str(tmp_path), i) for i in range(12)], executor=pool)
    assert found == [i**2 for i in range(12)]
    with ProcessPoolExecutor(2) as pool, pytest.raises(SolverError, match="worker died, twice"):
        mapped(ends, range(12), executor=pool)


@pytest.mark.slow
def test_a_criterion_whose_worker_dies_leaves_the_search_as_it_was(make, tmp_path, send_everything):
    plant, sensors, _ = make(12)
    method = Exhaustive()
    plain = place_sensors(plant, sensors, 4, PoiVariance("die"), method=method)
    criterion = Fragile(str(tmp_path), os.getpid())
    with ProcessPoolExecutor(2) as pool:
        found = place_sensors(plant, sensors, 4, criterion, method=method, executor=pool)
    assert (tmp_path / "died").exists()
    assert found.chosen == plain.chosen


class Fragile:
    """The variance at the POI; the first worker that computes it dies."""

    def __init__(self, folder, home):
        self.mark, self.home = Path(folder) / "died", home

    def __call__(self, plant):
        if os.getpid() != self.home and not self.mark.exists():
            self.mark.touch()
            os._exit(1)
        return PoiVariance("die")(plant)


def _shaken(count, shape=None, seed=12):
    """Return a plant on a shaken floor, with candidates of both kinds."""
    plant, sensors, actuators = machine(seed, count=count)
    ports = plant.assembled.ports
    floor = BaseAcceleration("floor", "z", asd=1e-4, shape=shape)
    return plant.with_ports(ports.replace(w=[*ports.w, floor])), sensors, actuators


def _spread(plant):
    """A criterion of a user's own: it looks at the plant."""
    return float(np.linalg.norm(plant.system.C @ plant.system.B))


USES = {
    "place_sensors": lambda p, y, u, how: place_sensors(p, y, 4, how("y"), method=Exchange(1)),
    "place_actuators": lambda p, y, u, how: place_actuators(p, u, 3, how("u"), method=Exchange(1)),
    "place_both": lambda p, y, u, how: place_both(p, y, u, (4, 3), how("yu"), method=Exchange(1)),
    "score_sensors": lambda p, y, u, how: score_sensors(p, list(combinations(y, 4)), how("y")),
    "score_actuators": lambda p, y, u, how: score_actuators(p, list(combinations(u, 3)), how("u")),
    "sensor_map": lambda p, y, u, how: sensor_map(p, [s.at for s in y], how("y"), asd=1e-10),
    "pareto_curve": lambda p, y, u, how: pareto_curve(p, y, [4, 5], how("y"), method=Exchange(1)),
}
WAYS = {
    "usual": lambda side: None,
    "own": lambda side: _spread,
    "judged": lambda side: PoiVariance() if side == "y" else None,
}


@pytest.mark.slow
@pytest.mark.parametrize(
    ("use", "way", "shape"),
    [
        *((use, "usual", None) for use in USES),
        *((use, "own", None) for use in ("place_actuators", "score_sensors", "pareto_curve")),
        *((use, "usual", low_pass_filter(60.0)) for use in ("place_both", "sensor_map")),
        ("sensor_map", "judged", None),
    ],
)
def test_plants_are_assembled_once_not_per_choice(monkeypatch, use, way, shape):
    """However many candidates there are, and what depends on the model alone is found once."""
    calls = Counter()

    def counted(owner, name):
        plain = getattr(owner, name)

        def wrapper(*given, **options):
            calls[name] += 1
            return plain(*given, **options)

        monkeypatch.setattr(owner, name, wrapper)

    seen = []
    plants = [_shaken(count, shape) for count in (5, 7)]
    counted(building, "continuous_plant")
    counted(Modes, "inertia")
    for plant, sensors, actuators in plants:
        plant = plant.replace(evaluation=plate_modes(12) if way == "judged" else None)
        calls.clear()
        USES[use](plant, sensors, actuators, WAYS[way])
        seen.append(dict(calls))
    assert seen[0] == seen[1]
    each = 2 if use == "pareto_curve" else 1
    # all candidates, the evaluation model and the confirmation of the answer by another route
    assert seen[0].get("continuous_plant", 0) <= 4 * each
    # of the floor, and of the rigid body: its mass about two points, its motions
    assert seen[0].get("inertia", 0) <= 2 * 4 * each  # those of the evaluation model too


@pytest.mark.slow
@pytest.mark.parametrize(
    ("shape", "delay", "references"),
    [
        (None, 1.0, (Reference("die"),)),
        (None, 1.5, ()),
        (low_pass_filter(60.0), 1.0, ()),
        (low_pass_filter(60.0), 1.5, (Reference("die"),)),
    ],
)
def test_on_a_shaken_floor_fast_scores_are_those_of_the_criteria(shape, delay, references):
    plant, sensors, actuators = _shaken(6, shape)
    plant = plant.with_ports(plant.assembled.ports.replace(references=references))
    plant = plant.continuous.discretized(4e3, delay=delay)
    for side, criterion, ports, size in (
        ("y", PoiVariance("die"), sensors, 4),
        ("y", PoiVariance("die", lag=FixedLag(3)), sensors, 4),
        ("u", PoiLqr("die", effort=1e-6), actuators, 3),
        ("y", ClosedLoopH2("die", effort=1e-6), sensors, 4),
        ("u", ClosedLoopH2("die", effort=1e-6), actuators, 3),
    ):
        layouts = layouts_of(plant, side, ports, criterion)
        part = isinstance(criterion, ClosedLoopH2) and delay == 1.5
        assert isinstance(layouts.scorer, OnPlant) == part
        for chosen in ([0, 1, 2, 3][:size], [1, 3, 4, 5][:size]):
            direct = criterion(with_side(plant, side, [ports[i] for i in chosen]))
            assert layouts.score([chosen])[0] == pytest.approx(direct, rel=1e-7, abs=0)

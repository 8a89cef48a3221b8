"""Faults for real: processes killed, disks full or read-only, schedulers that die and return.

Nothing is lost but the item in work, and the error is ours. Pools whose processes die or hang:
`test_study`; Ctrl-C in each long function: `test_progress`.
"""

import os
import signal
import socket
import subprocess
import sys
import threading
import time
from concurrent.futures import Executor, Future, ProcessPoolExecutor
from multiprocessing import get_context
from pathlib import Path

import numpy as np
import pytest

import flexplant as fx
from flexplant import parallel
from flexplant.errors import FlexplantError, SolverError
from flexplant.export import write_c, write_fmu
from flexplant.io import write_frf_csv, write_mat
from flexplant.placement import Exhaustive, place_sensors
from flexplant.plot import report
from placement_plate import machine

pytestmark = pytest.mark.skipif(sys.platform == "win32", reason="signals and mounts of Linux")
FORK = get_context("fork") if sys.platform != "win32" else None
HERE = Path(__file__).parent


@pytest.fixture
def disk(tmp_path):
    """Return a folder on a disk of its own, of 256 KiB; needs the right to mount."""
    place = tmp_path / "disk"
    place.mkdir()
    mounted = subprocess.run(
        ["mount", "-t", "tmpfs", "-o", "size=256k", "tmpfs", place], capture_output=True
    )
    if mounted.returncode:
        pytest.skip("needs the right to mount a small disk")
    yield place
    subprocess.run(["umount", place], check=True)


def fill(place):
    """Fill a disk and return the file that does it."""
    filler = place / "filler"
    with filler.open("wb", buffering=0) as file, pytest.raises(OSError, match="No space left"):
        while True:
            file.write(bytes(1024))
    return filler


def numbered(number):
    """Return a value of 0.3 MB, all of whose entries are one number."""
    return fx.StateSpace(np.eye(2), np.full((2, 20_000), number), np.eye(2), 0.0)


def saved_for_ever(path, numbers):
    for number in numbers:
        numbered(number).save(path)


def whole(path):
    """Return the number that a file holds: all of its entries."""
    found = np.unique(fx.load(path).B)
    assert found.size == 1
    return found[0]


@pytest.mark.slow
def test_killed_in_the_middle_of_save_the_old_file_or_the_new_one_is_there(tmp_path):
    path, rng = tmp_path / "value.npz", np.random.default_rng(0)
    numbered(0.0).save(path)
    cut = 0
    for _ in range(8):
        saving = FORK.Process(target=saved_for_ever, args=(path, range(1, 10**6)))
        saving.start()
        while not list(tmp_path.glob("*.part")):
            time.sleep(0.001)
        time.sleep(0.02 * rng.random())
        saving.kill()
        saving.join()
        assert whole(path) >= 0
        cut += len(parts := list(tmp_path.glob("*.part")))
        for part in parts:
            part.unlink()
    assert cut  # some were in the middle


@pytest.mark.slow
def test_two_that_save_to_one_file_and_one_that_loads(tmp_path):
    path = tmp_path / "value.npz"
    numbered(0.0).save(path)
    both = [FORK.Process(target=saved_for_ever, args=(path, [n] * 6)) for n in (1.0, 2.0)]
    for one in both:
        one.start()
    seen = {whole(path)}
    while any(one.is_alive() for one in both):
        seen.add(whole(path))
    assert {one.exitcode for one in both} == {0}
    assert {1.0, 2.0} & seen <= seen | {whole(path)} <= {0.0, 1.0, 2.0}
    assert [entry.name for entry in tmp_path.iterdir()] == ["value.npz"]


SYSTEM = fx.StateSpace([[0.5]], [[1.0]], [[1.0]], 0.0, dt=1e-3)
FRF = fx.Frf(np.arange(1.0, 4000.0), np.ones((1, 1, 3999)))
WRITERS = {
    "law.npz": SYSTEM.save,
    "law.mat": lambda path: write_mat(path, {"A": SYSTEM.A}),
    "law.c": lambda path: write_c(SYSTEM, path),
    "law.fmu": lambda path: write_fmu(SYSTEM, path),
    "law.csv": lambda path: write_frf_csv(path, FRF),
    "law.html": lambda path: report(path, fx.chain(masses=[1.0], stiffnesses=[])),
}


@pytest.mark.slow
@pytest.mark.parametrize("fault", ["No space left on device", "Read-only file system"])
@pytest.mark.filterwarnings("ignore:no C compiler")
def test_what_cannot_be_written_leaves_the_old_file(disk, fault):
    for name in WRITERS:
        (disk / name).write_text("old")
    before = sorted(disk.iterdir())
    if fault.startswith("No space"):
        filler = fill(disk)
    else:
        subprocess.run(["mount", "-o", "remount,ro", disk], check=True)
    for name, write in WRITERS.items():
        with pytest.raises(FlexplantError, match=rf"cannot be written \({fault}\).*is kept"):
            write(disk / name)
        assert (disk / name).read_text() == "old", name
    with pytest.raises(FlexplantError, match=f"({fault}).*results would be lost"):
        fx.study([1.0], noted, checkpoint=disk / "rows.jsonl")
    if fault.startswith("No space"):
        filler.unlink()
        (disk / "rows.jsonl").unlink()
    assert sorted(disk.iterdir()) == before


def noted(machine):
    """Fill the disk at machine 3 the first time, and note each call."""
    if isinstance(machine, tuple):
        folder, number = machine
        with open(f"{folder}/calls", "a") as file:
            file.write(f"{number}\n")
        if number == 3 and not Path(folder, "filled").exists():
            Path(folder, "filled").touch()
            fill(Path(folder, "disk"))
        return {"value": float(number), "page": 5000 * "x"}
    return {"value": machine}


def test_a_study_whose_disk_is_full_goes_on_when_there_is_room(disk):
    machines, path = [(str(disk.parent), number) for number in range(6)], disk / "rows.jsonl"
    with pytest.raises(FlexplantError, match=r"No space left .* begin again with the same file"):
        fx.study(machines, noted, checkpoint=path)
    (disk / "filler").unlink()
    assert fx.study(machines, noted, checkpoint=path)["value"].tolist() == [*map(float, range(6))]
    calls = (disk.parent / "calls").read_text().split()
    assert sorted(calls) in (sorted("0123345"), sorted("012345"))  # but the item in work


class Filling:
    """A criterion that fills the disk once, at its hundredth call; it notes each call in a file."""

    def __init__(self, folder):
        self.folder = folder

    def __repr__(self):
        return "Filling"

    def __call__(self, plant):
        with open(self.folder.parent / "calls", "ab") as file:
            file.write(b".")
            if file.tell() == 100:
                fill(self.folder)
        return float(sum(sensor.at[0] ** 2 for sensor in plant.assembled.ports.y))


@pytest.mark.slow
def test_a_placement_whose_disk_is_full_goes_on_when_there_is_room(disk, tmp_path):
    plant, sensors, _ = machine(12, count=11)
    criterion, path = Filling(disk), disk / "search.jsonl"
    kept = {"method": Exhaustive(), "checkpoint": path}
    with pytest.raises(FlexplantError, match=r"No space left .* begin again with the same file"):
        place_sensors(plant, sensors, 4, criterion, **kept)
    (disk / "filler").unlink()
    found = place_sensors(plant, sensors, 4, criterion, **kept)
    assert found.evaluations == 330
    assert 330 <= (tmp_path / "calls").stat().st_size <= 330 + 64  # but the block in work
    lowest = sorted(sensors, key=lambda sensor: sensor.at[0] ** 2)[:4]
    assert set(found.chosen) == {sensor.name for sensor in lowest}


def little_memory():
    import resource

    resource.setrlimit(resource.RLIMIT_AS, (3 * 2**30, 3 * 2**30))


def greedy(number):
    if number == 1:
        return {"value": float(np.ones(2**30).sum())}  # 8 GiB
    return {"value": float(number)}


def test_a_worker_out_of_memory_takes_its_machine_alone():
    with ProcessPoolExecutor(1, mp_context=FORK, initializer=little_memory) as pool:
        table = fx.study(range(3), greedy, executor=pool)
    assert [bool(reason) for reason in table["failed"]] == [False, True, False]
    assert "MemoryError: Unable to allocate 8" in table["failed"][1]


class Scheduler:
    """A scheduler of dask with one worker, in processes of their own, at a port of this machine."""

    def __init__(self):
        with socket.socket() as free:
            free.bind(("127.0.0.1", 0))
            self.port = free.getsockname()[1]
        self.address, self.processes = f"tcp://127.0.0.1:{self.port}", []

    def start(self):
        at = ["--host", "127.0.0.1", "--port", str(self.port)]
        for kind, arguments in (
            ("scheduler", at),
            ("worker", [self.address, "--no-nanny", "--nthreads", "1"]),
        ):
            code = ["-W", "ignore", "-m", f"distributed.cli.dask_{kind}", "--no-dashboard"]
            env = {**os.environ, "PYTHONPATH": os.pathsep.join([str(HERE), *sys.path])}
            quiet = {"stdout": subprocess.DEVNULL, "stderr": subprocess.DEVNULL}
            run = subprocess.Popen([sys.executable, *code, *arguments], env=env, **quiet)
            self.processes.append(run)

    def kill(self):
        for process in self.processes:
            process.send_signal(signal.SIGKILL)
            process.wait()
        self.processes = []


def on_the_scheduler(folder, number):
    """Return a row, its call noted; machine 2 waits for the scheduler to have died."""
    with open(f"{folder}/calls", "a") as file:
        file.write(f"{number}\n")
    while number == 2 and not Path(folder, "died").exists():
        time.sleep(0.01)
    return {"value": float(number)}


def of_folder(item):
    return on_the_scheduler(*item)


@pytest.mark.long
def test_a_study_waits_for_a_scheduler_that_dies_and_returns(tmp_path):
    distributed = pytest.importorskip("distributed")
    scheduler, calls = Scheduler(), tmp_path / "calls"

    def fault():
        while not calls.exists() or "2\n" not in calls.read_text():
            time.sleep(0.01)
        scheduler.kill()
        (tmp_path / "died").touch()
        scheduler.start()

    scheduler.start()
    accident = threading.Thread(target=fault)
    try:
        with distributed.Client(scheduler.address, timeout=60) as client:
            accident.start()
            machines = [(str(tmp_path), number) for number in range(6)]
            table = fx.study(machines, of_folder, executor=client.get_executor())
    finally:
        accident.join()
        scheduler.kill()
    assert table["value"].tolist() == [0.0, 1.0, 2.0, 3.0, 4.0, 5.0]


class Dropping(Executor):
    """Cancels the second of what it is given, so many times."""

    def __init__(self, times):
        self.times = times

    def submit(self, function, /, *args):
        future = Future()
        if args[1] == 1 and self.times:
            self.times -= 1
            future.cancel()
            future.set_running_or_notify_cancel()
        else:
            future.set_result(function(*args))
        return future


def test_what_an_executor_drops_twice_is_an_error_and_the_rest_is_kept(tmp_path, monkeypatch):
    monkeypatch.setattr(parallel, "CHUNK", 0.0)
    path = tmp_path / "rows.jsonl"
    plain = fx.study(range(4), noted)
    assert np.array_equal(fx.study(range(4), noted, executor=Dropping(1))["value"], plain["value"])
    with pytest.raises(SolverError, match="its scheduler ended and is not back"):
        fx.study(range(4), noted, executor=Dropping(2), checkpoint=path)
    assert path.read_bytes().count(b"\n") == 1 + 3
    assert len(fx.study(range(4), noted, checkpoint=path)) == len(plain)

"""study: the same table whoever computes it, nothing lost or done twice, failures as rows."""

import gc
import json
import os
import signal
import subprocess
import sys
import time
from concurrent.futures import ProcessPoolExecutor, ThreadPoolExecutor
from multiprocessing import current_process, get_context
from pathlib import Path

import numpy as np
import pytest

import flexplant as fx
from flexplant import load
from flexplant.errors import FlexplantError, FlexplantWarning, LabelError, ModelError
from flexplant.simulation import StudyTable, study


def drawn(machine, generator):
    """Linear algebra whose last bits hang on threads, and chance."""
    if machine == 3:
        raise ValueError("no pole\nwas found")
    M = generator.normal(size=(60, 60))
    return {"largest": np.linalg.norm(M @ M, 2), "stable": machine % 2 == 0, "name": f"m{machine}"}


def counted(machine):
    folder, number = machine
    with (Path(folder) / "calls").open("a") as file:
        file.write(f"{number}\n")
    time.sleep(0.05)
    return {"value": 0.1 * number}


def same(a, b):
    assert list(a) == list(b)
    for name in a:
        assert a[name].dtype == b[name].dtype
        np.testing.assert_array_equal(a[name], b[name])


@pytest.mark.slow
def test_serial_and_process_pool_agree_to_the_bit():
    plain = study(range(8), drawn, rng=5)
    with ProcessPoolExecutor(2) as pool:
        same(study(range(8), drawn, rng=5, executor=pool), plain)
    with ThreadPoolExecutor(2) as pool:
        same(study(range(8), drawn, rng=np.random.SeedSequence(5), executor=pool), plain)
    expected = [
        np.linalg.norm(M @ M, 2)
        for seed in np.random.SeedSequence(5).spawn(8)
        if (M := np.random.default_rng(seed).normal(size=(60, 60))) is not None
    ]
    ok = plain["failed"] == ""
    np.testing.assert_allclose(plain["largest"][ok], np.array(expected)[ok], rtol=1e-12)


@pytest.mark.long
def test_dask_agrees_to_the_bit():
    distributed = pytest.importorskip("distributed")
    plain = study(range(8), drawn, rng=5)
    with (
        distributed.LocalCluster(n_workers=2, threads_per_worker=1, dashboard_address=None) as own,
        distributed.Client(own) as client,
    ):
        same(study(range(8), drawn, rng=5, executor=client.get_executor()), plain)


def test_a_machine_that_fails_is_a_row_with_its_reason():
    table = study(range(5), drawn, rng=0)
    assert table["failed"].tolist() == ["", "", "", "ValueError: no pole was found", ""]
    assert np.isnan(table["largest"][3])
    assert (table["name"][3], bool(table["stable"][3])) == ("", False)
    shown = repr(table)
    assert "5 machines, 1 failed" in shown
    assert "machine 3: ValueError: no pole was found" in shown
    assert "stable" in shown
    assert "3 of 4" in shown


CONTEXTS = ["fork", pytest.param("spawn", marks=pytest.mark.slow)]


def begun(mark):
    """Initialise a process of a pool."""
    os.environ["STUDY_MARK"] = mark


def marked(machine):
    if machine == 2:
        os._exit(1)
    method = type(current_process()).__name__
    return {"pid": os.getpid(), "mark": os.environ.get("STUDY_MARK", ""), "method": method}


@pytest.mark.long
@pytest.mark.parametrize("context", CONTEXTS)
def test_a_process_that_dies_takes_only_its_machine_with_it(context):
    """The rest goes on in processes like those of the pool, no more of them at a time."""
    machines = list(range(20))
    where = get_context(context)
    with ProcessPoolExecutor(2, mp_context=where, initializer=begun, initargs=("set",)) as pool:
        table = study(machines, marked, executor=pool)
    failed = {m: reason for m, reason in zip(machines, table["failed"], strict=True) if reason}
    assert list(failed) == [2]
    assert "worker died, twice" in failed[2]
    ok = table["failed"] == ""
    assert set(table["mark"][ok]) == {"set"}
    assert set(table["method"][ok]) == {f"{context.title()}Process"}
    assert len(set(table["pid"][ok])) <= 2 + 2 + 4  # of both pools, and of those tried alone


def test_a_pool_that_cannot_start():
    with ProcessPoolExecutor(1, initializer=os._exit, initargs=(1,)) as pool:
        assert "worker died, twice" in study([1.0], drawn, executor=pool)["failed"][0]
    with pytest.raises(ModelError, match="names this study"):
        study([1.0], drawn, key=3)


def leaves(machine):
    if machine == 1:
        sys.exit("no licence")
    return {"value": 1.0}


def test_a_pipeline_that_exits_is_a_machine_that_fails():
    expected = ["", "SystemExit: no licence", ""]
    assert study(range(3), leaves)["failed"].tolist() == expected
    with ProcessPoolExecutor(1) as pool:
        assert study(range(3), leaves, executor=pool)["failed"].tolist() == expected


SCRIPT = """
import sys
sys.path.insert(0, {tests!r})
from test_study import counted
from flexplant.simulation import study
study([({folder!r}, i) for i in range(40)], counted, checkpoint={path!r})
"""


@pytest.mark.slow
def test_killed_and_resumed_nothing_is_lost_or_done_twice(tmp_path):
    path = tmp_path / "rows.jsonl"
    code = SCRIPT.format(tests=str(Path(__file__).parent), folder=str(tmp_path), path=str(path))
    process = subprocess.Popen([sys.executable, "-c", code])
    while not path.exists() or path.read_bytes().count(b"\n") < 6:
        assert process.poll() is None
        time.sleep(0.01)
    process.send_signal(signal.SIGKILL)
    process.wait()
    kept = path.read_bytes().count(b"\n") - 1
    with path.open("ab") as file:  # as a power cut would leave it
        file.write(b'[39, {"val')
    machines = [(str(tmp_path), i) for i in range(40)]
    table = study(machines, counted, checkpoint=path)
    np.testing.assert_array_equal(table["value"], 0.1 * np.arange(40))
    calls = [int(line) for line in (tmp_path / "calls").read_text().splitlines()]
    assert set(calls) == set(range(40))
    assert len(calls) <= 41  # the one that was under way when it was killed
    assert kept >= 5
    same(study(machines, counted, checkpoint=path), table)
    assert len((tmp_path / "calls").read_text().splitlines()) == len(calls)


def test_a_resumed_study_has_the_seeds_that_it_began_with(tmp_path):
    path = tmp_path / "rows.jsonl"
    table = study(range(4), drawn, rng=np.random.default_rng(3), checkpoint=path)
    lines = path.read_bytes().splitlines(keepends=True)
    path.write_bytes(b"".join(lines[:3]))
    again = study(range(4), drawn, rng=np.random.default_rng(99), checkpoint=path)
    same(again, table)


def test_the_checkpoint_of_another_study_is_refused(tmp_path):
    path = tmp_path / "rows.jsonl"
    study(range(4), drawn, rng=1, checkpoint=path)
    before = path.read_bytes()
    for machines, pipeline, options in (
        (range(5), drawn, {"rng": 1}),
        ([0, 1, 2, 4], drawn, {"rng": 1}),
        (range(4), lambda machine, rng: drawn(machine, rng), {"rng": 1}),
        (range(4), drawn, {"rng": 1, "key": "stiffer"}),
        (range(4), drawn, {"rng": 2}),
        (range(4), leaves, {}),
    ):
        with pytest.raises(ModelError, match="of another study"):
            study(machines, pipeline, checkpoint=path, **options)
    other = tmp_path / "notes.txt"
    other.write_text("mine\n")
    with pytest.raises(ModelError, match="not the checkpoint of a study: nothing is written"):
        study(range(4), drawn, rng=1, checkpoint=other)
    assert (path.read_bytes(), other.read_text()) == (before, "mine\n")
    assert json.loads(before.splitlines()[0])["machines"] == 4


def damaged(lines):
    """Yield a checkpoint of five lines as accidents leave it, and the rows that are lost."""
    head, *rows = lines
    yield [head, rows[0], b"\0" * 30 + b"\n", *rows[2:]], {1}  # a power cut
    yield [head, b"\0" * 9 + rows[0], *rows[1:]], set()
    yield [head, rows[0][:-1], *rows[1:]], set()  # two in a line
    yield [head, rows[0], rows[1][:9], *rows[2:]], {1}  # cut, and the next in its line
    yield [head, *rows[:3], rows[3][:-9]], {3}
    yield [head, rows[0].replace(b"1", b"7", 1), *rows[1:]], {0}  # another value
    yield [head, b"\xff\xfe[[{\n", *rows], set()
    yield [head[:20]], {0, 1, 2, 3}
    yield [], {0, 1, 2, 3}


@pytest.mark.parametrize("case", range(9))
def test_of_a_damaged_file_all_that_is_whole_is_taken(tmp_path, case):
    path = tmp_path / "rows.jsonl"

    def noted(machine):
        (tmp_path / f"computed-{machine}").touch()
        return {"value": machine + 0.1, "name": '[1, {"'}

    def computed():
        found = {int(file.name.partition("-")[2]) for file in tmp_path.glob("computed-*")}
        for number in found:
            (tmp_path / f"computed-{number}").unlink()
        return found

    table = study(range(1, 5), noted, checkpoint=path)
    assert computed() == {1, 2, 3, 4}
    lines, lost = list(damaged(path.read_bytes().splitlines(keepends=True)))[case]
    path.write_bytes(b"".join(lines))
    same(study(range(1, 5), noted, checkpoint=path), table)
    assert computed() == {number + 1 for number in lost}
    same(study(range(1, 5), noted, checkpoint=path), table)
    assert computed() == set()


@pytest.mark.parametrize("process", [False, pytest.param(True, marks=pytest.mark.slow)])
def test_two_studies_do_not_write_to_one_file(tmp_path, process):
    path = tmp_path / "rows.jsonl"
    code = SCRIPT.format(tests=str(Path(__file__).parent), folder=str(tmp_path), path=str(path))

    def inner(machine):
        if not process:
            return study([1.0], drawn, checkpoint=path)
        done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True)
        raise FlexplantError(done.stderr.splitlines()[-1])

    failed = study([1.0], inner, checkpoint=path)["failed"][0]
    assert f"other work writes to the checkpoint {path} now" in failed
    assert study([1.0], inner, checkpoint=path)["failed"][0] == failed  # not locked any more


def test_a_full_disk_and_what_cannot_be_written(tmp_path):
    with pytest.raises(FlexplantError, match="cannot be opened for writing"):
        study([1.0], drawn, checkpoint=tmp_path)
    path = tmp_path / "rows.jsonl"
    study([0, 1], drawn, rng=1, checkpoint=path)
    path.write_bytes(b"".join(path.read_bytes().splitlines(keepends=True)[:2]))
    resource = pytest.importorskip("resource")
    limits = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (path.stat().st_size + 9, limits[1]))
    try:
        with pytest.raises(FlexplantError, match=r"cannot be written \(File too large\)"):
            study([0, 1], drawn, rng=1, checkpoint=path)
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, limits)
    same(study([0, 1], drawn, rng=1, checkpoint=path), study([0, 1], drawn, rng=1))


@pytest.mark.parametrize(
    ("result", "message"),
    [
        (3.0, "pipeline returns must be of type Mapping"),
        ({"a": np.zeros(3)}, "column 'a' holds"),
        ({"failed": 1.0}, "cannot be the name of a column"),
    ],
)
def test_what_is_no_row_is_refused(result, message):
    with pytest.raises(ModelError, match=message):
        study([1], lambda machine: result)


def test_what_is_no_row_of_another_machine_than_the_first_fails():
    table = study(range(3), lambda machine: [{"a": 1.0}, {"a": [1, 2]}, 3.0][machine])
    assert table["failed"][0] == ""
    assert table["failed"][1].startswith("ModelError: column 'a' holds [1, 2]")
    assert table["failed"][2].startswith("ModelError: what the pipeline returns must be")


def test_columns_that_differ_are_missing_where_they_are_not(tmp_path):
    rows = [{"a": 1.0, "b": True}, {"a": 2, "c": "x"}, {"c": "y", "a": 3.0, "b": True}]
    lines = []
    for _ in range(2):  # computed, then from the file
        with pytest.warns(FlexplantWarning, match=r"2 machines of 3 \(number 0 first\).*'c', 'b'"):
            lines.append(study(range(3), lambda m: rows[m], checkpoint=tmp_path / "rows.jsonl"))
    same(*lines)
    assert list(lines[0]) == ["a", "b", "c", "failed"]
    assert lines[0]["a"].tolist() == [1.0, 2.0, 3.0]
    assert lines[0]["b"].tolist() == [True, False, True]
    assert lines[0]["c"].tolist() == ["", "x", "y"]
    assert lines[0]["failed"].tolist() == ["", "", ""]


@pytest.mark.parametrize("odd", range(3))
def test_a_value_of_another_kind_than_most_fails_its_machine(odd):
    table = study(range(3), lambda machine: {"a": "?" if machine == odd else 1.0 * machine})
    assert np.isnan(table["a"]).tolist() == [machine == odd for machine in range(3)]
    said = "column 'a' holds '?', a text: most machines have a number there"
    assert table["failed"].tolist() == [said if machine == odd else "" for machine in range(3)]


def remembering(machine):
    """Return a row, and how many blocks of memory objects of Python have."""
    plant = fx.testbeds.three_masses()
    observer = fx.design_kalman(plant)
    servo = fx.design_servo(plant, bandwidth=10.0 + machine / 100, observer=observer)
    loop = fx.close_loop(plant, observer, servo)
    gc.collect()
    return {"margin": loop.modulus_margin, "blocks": sys.getallocatedblocks()}


@pytest.mark.long
def test_memory_does_not_grow_with_the_machines():
    """But for the rows."""
    used = study(range(24), remembering)["blocks"]
    assert used[-1] - used[14] < 9 * 50.0  # the first have met all code and filled its caches


def test_wrong_calls():
    with pytest.raises(ModelError, match="needs machines, got an empty"):
        study([], drawn)
    with pytest.raises(ModelError, match="pipeline must be callable"):
        study([1], "update")


def test_the_table_is_a_mapping_that_is_saved_and_that_pandas_takes(tmp_path):
    table = study(range(5), drawn, rng=0)
    table.save(tmp_path / "t.npz")
    same(load(tmp_path / "t.npz"), table)
    pandas = pytest.importorskip("pandas")
    frame = pandas.DataFrame(dict(table))
    assert list(frame.columns) == ["largest", "stable", "name", "failed"]
    with pytest.raises(LabelError, match="no column 'larges'"):
        table["larges"]
    assert isinstance(table, StudyTable)

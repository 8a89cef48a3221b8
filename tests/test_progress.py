"""Long work shows a bar where somebody sees it, says so once in pipes, and can be interrupted."""

import json
import os
import re
import signal
import subprocess
import sys
import threading
import time
import types
from concurrent.futures import ThreadPoolExecutor
from functools import partial
from pathlib import Path

import numpy as np
import pytest

import flexplant as fx
from flexplant import parallel as progress
from flexplant.parallel import Progress, expect, interruptible, mapped, so_far, tick
from stages import RATE, ports, some_modes

HERE = Path(__file__).parent

#: what takes long, made small: each with the name of its bar
WORK = """
import numpy as np, sys
import flexplant as fx
from flexplant import parallel as progress
from stages import RATE, Z8, ports, reduced, some_modes

rng = np.random.default_rng(0)
block = fx.solid_block(size=(0.4, 0.3, 0.1), elements=(12, 9, 4), density=2700,
                       youngs_modulus=70e9, poisson_ratio=0.33)
rom = reduced()
at = rom.full_dofs.nearest(Z8, "z")
poles = fx.testbeds.wafer_stage(elements=(8, 8)).poles([6, 7]).replace(covariance=0.1 * np.eye(4))
unknowns = [fx.AddedMass(at, bounds=(0.0, 2.0)), fx.AddedDamping(at, bounds=(-20.0, 20.0))]
small = fx.assemble_plant(some_modes(count=8, attached=False), ports())
weights = fx.stage_weights(small, 50.0)
weighted = small.through(fx.reference_errors(small)).weighted(z=weights.z, w=weights.w)
plate = fx.kirchhoff_plate(size=(0.4, 0.3), thickness=0.01, elements=(4, 3), density=2700,
                           youngs_modulus=70e9, poisson_ratio=0.33)
four = fx.reduction.Guyan(["1:z", "5:z", "16:z", "20:z"])
z1 = {"inputs": ["1:z"], "outputs": ["1:z"]}
noise = rng.standard_normal((4, 16000))
WORK = {
    "modes, steps of Lanczos": lambda: fx.solve_modes(block, count=30),
    "frequency response:": lambda: fx.frequency_response(
        plate, fx.Ports(u=[fx.Actuator("f", "1:z")], y=[fx.Sensor("s", "1:z")]), [10.0, 900.0]),
    "check:": lambda: fx.check(plate),
    "reduction:": lambda: fx.reduce(plate, four),
    "quality:": lambda: fx.reduce(plate, four).quality(plate, band=(10.0, 200.0), **z1),
    "update, iterations": lambda: fx.update(rom, unknowns, [fx.Eigenvalues(poles)], starts=20),
    "parts of the record": lambda: fx.identification.identify_output_only(
        noise, rate=1e3, band=(20.0, 200.0), orders=range(4, 12, 2)),
    "steps of the search": lambda: fx.design_hinf(weighted, fx.Riccati()),
}
def tried(work):
    try:
        return work()
    except fx.FlexplantError as error:  # noise has no modes
        return error
"""


@pytest.fixture(autouse=True)
def _own_watcher(monkeypatch):
    """A thread that waits by the clock of another test would be late here."""
    monkeypatch.setattr(progress, "_watcher", progress._Watcher())


def child(code, stream):
    """Run code in a process of its own, its streams given."""
    paths = os.pathsep.join([str(HERE), *sys.path])
    env = {**os.environ, "PYTHONPATH": paths, "OMP_NUM_THREADS": "2"}
    return subprocess.Popen(
        [sys.executable, "-W", "ignore", "-c", WORK + code], env=env, stdout=stream, stderr=stream
    )


SHOWN = """
progress.BAR_DELAY = 0.0
for work in WORK.values():
    tried(work)
print("done")
"""


@pytest.mark.long
def test_bars_on_a_terminal_and_a_line_each_in_a_pipe():
    pty, termios = pytest.importorskip("pty"), pytest.importorskip("termios")
    ours, theirs = pty.openpty()
    termios.tcsetwinsize(theirs, (24, 100))
    process = child(SHOWN, theirs)
    os.close(theirs)
    seen = b""
    while True:
        try:
            part = os.read(ours, 65536)
        except OSError:  # the other end is closed
            break
        if not part:
            break
        seen += part
    os.close(ours)
    assert process.wait(timeout=300) == 0
    text = seen.decode()
    names = re.findall('    "(.*)": lambda', WORK)
    assert len(names) == 8 and not [name for name in names if name[:12] not in text]
    piped = child(SHOWN, subprocess.PIPE)
    out, said = piped.communicate(timeout=300)
    assert out == b"done\n"
    lines = said.decode().splitlines()
    assert len(lines) > 4, "a line each, where they run at once"
    assert not [
        line
        for line in lines
        if not re.search(r": (\d+ s(, .*)?|(some|at least) .* s expected)(\. .*)?$", line)
    ]


INTERRUPTED = """
import json, multiprocessing, os, signal, threading, time
from concurrent.futures import ProcessPoolExecutor
from threadpoolctl import threadpool_info
import machines

def study():
    with ProcessPoolExecutor(2) as executor:
        return fx.study(list(range(200)), machines.slow_machine, executor=executor,
                        checkpoint=sys.argv[1] if len(sys.argv) > 1 else None)

sampled = small.discretized(1e4, delay=1)
observer = fx.design_kalman(sampled)
servo = fx.design_servo(sampled, bandwidth=30.0, observer=observer)
loop = fx.close_loop(sampled, observer, servo)
fit = fx.update(rom, unknowns, [fx.Eigenvalues(poles)])
seen = list(sampled.assembled.ports.y)
slow = fx.lti.low_pass_filter(0.1)
mixed = fx.plant.mixed_sensitivity(fx.lti.tf([1.0], [1.0, 1.0]), S=slow, KS=0.1)
MORE = {
    "machines": study,
    "samples": lambda: fx.simulate(loop, duration=2.0, rng=1, runs=3),
    "sets of sensors": lambda: fx.place_sensors(sampled, seen, len(seen) - 1),
    "tuning": lambda: fx.tune_loops(
        fx.lti.discretized(fx.lti.tf([1.0], [1.0, 0.0, 0.0]), 2e3, delay=2)),
    "structured": lambda: fx.synthesis.design_structured(mixed, fx.synthesis.FixedOrder(1)),
    "tolerance": lambda: fx.close_loop(sampled, observer, servo).mode_tolerances(),
}

def threads():
    return [pool["num_threads"] for pool in threadpool_info()]

signal.signal(signal.SIGINT, signal.default_int_handler)  # jobs in the background ignore it
before, found = threads(), {}
for name, work in {**WORK, **MORE}.items():
    if name == "parts of the record":
        work = lambda: [WORK["parts of the record"]() for _ in range(50)]
    timer = threading.Timer(0.1, os.kill, (os.getpid(), signal.SIGINT))
    timer.start()
    try:
        while True:  # until the signal comes
            tried(work)
    except KeyboardInterrupt:
        timer.join()
    # a thread that was interrupted while it was started ends by itself a moment later
    end = time.monotonic() + 20.0
    while threading.active_count() > 1 and time.monotonic() < end:
        time.sleep(0.01)
    found[name] = {
        "threads": threads() == before,
        "bars": len(progress.bars_of_thread()),
        "children": len(multiprocessing.active_children()),
        "alive": threading.active_count(),
    }
modes = fx.solve_modes(block, count=30)
same = np.array_equal(modes.phi, fx.solve_modes(block, count=30).phi)
print(json.dumps({"found": found, "same": bool(same)}))
"""


@pytest.mark.long
def test_interrupted_work_leaves_nothing_behind():
    """By the signal of Ctrl-C: threads of BLAS, bars and processes are as before."""
    process = child(INTERRUPTED, subprocess.PIPE)
    try:
        out, err = process.communicate(timeout=300)
    finally:
        process.kill()
    assert process.returncode == 0, err.decode()
    answer = json.loads(out)
    assert len(answer["found"]) == 14 and answer["same"]
    for name, left in answer["found"].items():
        assert left == {"threads": True, "bars": 0, "children": 0, "alive": 1}, name


def test_a_notebook_is_somebody(monkeypatch, capsys):
    class ZMQInteractiveShell:
        """What IPython calls the shell of a notebook."""

    shell = types.SimpleNamespace(get_ipython=ZMQInteractiveShell)
    monkeypatch.setitem(sys.modules, "IPython", shell)
    monkeypatch.setattr(progress, "BAR_DELAY", 0.0)
    with Progress(3, "modes") as bar:
        bar.advance()
    said = capsys.readouterr()
    assert "modes" in said.out and not said.err


@pytest.mark.slow
def test_where_nobody_looks_one_line_says_how_long(monkeypatch, capsys):
    monkeypatch.setattr(progress, "BAR_DELAY", 0.05)
    first = r"modes: 0 s, 1 of 4 done, some 0 s more\n"
    for total, said in ((4, f"{first}(modes: 0 s, 1 of 4 done, .*\n)*"), (None, r"modes: 0 s\n")):
        with Progress(total, "modes:") as bar:
            bar.advance()
            time.sleep(0.2)
            with Progress(3, "inside"):
                time.sleep(0.1)
        printed = capsys.readouterr()
        assert re.fullmatch(said, printed.err) and not printed.out
    with Progress(4, "modes", progress=False):
        time.sleep(0.1)
    with Progress(4, "modes"):
        pass  # over before
    assert capsys.readouterr() == ("", "")


@pytest.mark.slow
def test_a_long_first_item_and_a_long_rest(monkeypatch, capsys):
    """As soon as one is done it is said how long all take; of much, what would make it less."""
    monkeypatch.setattr(progress, "BAR_DELAY", 0.05)
    for most, more in ((20.0, ""), (0.4, r"\. Take fewer\.")):
        monkeypatch.setattr(progress, "LONG", most)
        with Progress(4, "machines", advice="Take fewer.") as bar:
            time.sleep(0.2)
            bar.advance()
            time.sleep(0.3)
            bar.advance()
        said = capsys.readouterr().err.splitlines()
        assert len(said) >= 2 and said[0] == "machines: 0 s"
        assert re.fullmatch(r"machines: 0 s, 1 of 4 done, some 1 s more" + more, said[1])


@pytest.fixture
def clock(monkeypatch):
    """Seconds that tests set, in place of those of the machine."""
    now = types.SimpleNamespace(seconds=0.0)
    monkeypatch.setattr(progress, "monotonic", lambda: now.seconds)
    return now


def said_of(capsys):
    return [line.partition(": ")[2] for line in capsys.readouterr().err.splitlines()]


def test_a_promise_is_corrected_where_it_is_off_by_two(clock, capsys):
    """Each estimate follows from the share that is done; advice is given once, where it is long."""
    with Progress(None, "machines", advice="Take fewer."):
        expect(seconds=4.4)
        assert said_of(capsys) == ["some 4 s expected"]
        for second in range(1, 101):  # 100 steps of a second each, of which 50 were expected
            clock.seconds = float(second)
            so_far(second, 50)
        said = said_of(capsys)
    assert said == [
        "3 s, some 50 s more. Take fewer.",
        "50 s, some 50 s more",
        "100 s, some 100 s more",
    ]


def test_a_part_takes_less_than_the_whole(clock, capsys):
    """What inner work expects is no promise of the whole, which takes at least as long."""
    with Progress(None, "update", advice="Take fewer."):
        with Progress(None, "modes"):
            expect(seconds=3.0)
            expect(seconds=3.1)
        clock.seconds = 3.0
        for _ in range(9):
            expect(seconds=20.0, more=True)
            clock.seconds += 20.0
        with Progress(None, "modes"):
            so_far(1, 1000)
    assert said_of(capsys) == [
        *("at least 3 s expected", "3 s, at least 20 s more", "43 s, at least 20 s more"),
        "123 s, at least 20 s more",
    ]


@pytest.mark.parametrize("spent", [2.0, 9.0])
def test_the_item_under_way_counts(spent, clock):
    """Equal items: three of four seconds are left; an item that takes longer makes all longer."""
    bar = Progress(4, "machines", progress=False)
    clock.seconds = 1.0
    bar.advance()
    clock.seconds += spent
    assert bar._left() == pytest.approx(3.0 * max(spent, 1.0) - spent)


@pytest.mark.parametrize(("rate", "advice"), [(2000.0, "Decimate the record"), (400.0, "Fewer")])
def test_a_rate_far_above_the_band_is_named_before(rate, advice, monkeypatch, capsys):
    """The record is decimated to five times the end of the band."""
    monkeypatch.setattr(progress, "LONG", 0.0)
    monkeypatch.setattr(progress, "BAR_DELAY", 0.2)
    monkeypatch.setattr(progress, "_seconds_each", lambda: 1e-6)
    noise, to = (
        np.random.default_rng(0).standard_normal((2, 16000)),
        {"orders": range(4, 12, 2), "lags": 100},
    )
    with pytest.raises(fx.FlexplantError):
        fx.identification.identify_output_only(noise, rate=rate, band=(20.0, 50.0), **to)
    first = capsys.readouterr().err.splitlines()[0]
    assert "s expected" in first and advice in first
    assert ("decimate(outputs, 8), rate=250)" in first) == (rate == 2000.0)


@pytest.mark.slow
def test_a_promise_that_is_broken_is_taken_back(monkeypatch, capsys):
    """Also where nothing says how much is left, and with the advice that a minute is worth."""
    monkeypatch.setattr(progress, "BAR_DELAY", 0.02)
    monkeypatch.setattr(progress, "LONG", 0.05)
    with Progress(None, "modes", advice="Take fewer."):
        expect(seconds=0.04)
        time.sleep(0.3)
    first, second, *_ = said_of(capsys)
    assert first == "some 0.04 s expected"
    assert re.fullmatch(r"0 s, longer than expected\. Take fewer\.", second)


@pytest.mark.slow
def test_what_is_known_before_is_said_before(monkeypatch, capsys):
    """With the advice where it is long; what a checkpoint has does not count as quick."""
    for seconds, line in ((4.4, "some 4 s expected"), (444.0, "some 400 s expected. Take fewer.")):
        with Progress(None, "machines", advice="Take fewer."):
            expect(seconds=1.9)
            assert not capsys.readouterr().err
            expect(seconds=seconds)
            assert capsys.readouterr().err == f"machines: {line}\n"
            expect(seconds=1.5 * seconds)
            assert not capsys.readouterr().err
    with Progress(None, "machines", progress=False):
        expect(seconds=1e4)
    expect(seconds=1e4)  # of no work
    assert not capsys.readouterr().err
    monkeypatch.setattr(progress, "BAR_DELAY", 0.05)
    with Progress(100, "machines") as bar:
        bar.advance(90, known=True)
        bar.advance()
        time.sleep(0.3)
    assert "91 of 100 done" in capsys.readouterr().err
    assert 2.0 < bar._left() < 10.0, "nine more, each as long as the one"


def test_advice_on_a_terminal(monkeypatch, capsys):
    monkeypatch.setattr(sys.stderr, "isatty", lambda: True, raising=False)
    monkeypatch.setattr(progress, "BAR_DELAY", 0.02)
    monkeypatch.setattr(progress, "LONG", 0.0)
    with Progress(1000, "machines", advice="Take fewer.") as bar:
        bar.advance()
        time.sleep(0.2)
    assert capsys.readouterr().err.count("s more. Take fewer.\n") == 1


@pytest.mark.slow
@pytest.mark.benchmark  # a clock decides
@pytest.mark.parametrize("name", ["modes", "identification", "placement", "response"])
def test_estimates_before_the_start_hold_to_a_factor(name, monkeypatch, capsys):
    """What is said before is right within five times, whatever the machine."""
    monkeypatch.setattr(progress, "BAR_DELAY", 0.1)
    rng = np.random.default_rng(0)
    if name == "modes":
        block = fx.solid_block(
            size=(0.4, 0.4, 0.1),
            elements=(14, 14, 5),
            density=2700,
            youngs_modulus=70e9,
            poisson_ratio=0.33,
        )
        work = partial(fx.solve_modes, block, count=30)
    elif name == "identification":
        plant = fx.assemble_plant(some_modes(count=12, attached=False), ports())
        frf = fx.frequency_response(plant.Gyu, np.linspace(100.0, 900.0, 800))
        size = 1e-3 * float(np.median(abs(frf.data)))
        noise = rng.standard_normal((2, *frf.data.shape)) * size
        data = frf.data + noise[0] + 1j * noise[1]
        work = partial(
            fx.identify_modes, frf.replace(data=data, variance=np.full(data.shape, 2 * size**2))
        )
    elif name == "placement":
        plant = fx.assemble_plant(some_modes(count=12, attached=False), ports())
        grid = [(x, y, 0.0) for x in np.linspace(0, 0.6, 6) for y in np.linspace(0, 0.6, 6)]
        sensors = [fx.Sensor(f"s{i}", at=place, asd=1e-11) for i, place in enumerate(grid)]
        work = partial(fx.place_sensors, plant.discretized(rate=RATE), sensors, 4, rng=0)
    else:
        A = rng.standard_normal((700, 700)) / 30 - 1.5 * np.eye(700)
        B = rng.standard_normal((700, 4))
        work = partial(
            fx.frequency_response,
            fx.StateSpace(A, B, B.T, np.zeros((4, 4))),
            np.linspace(1.0, 2.0, 500),
        )
    begin = time.process_time()  # others may compute beside it
    work()
    spent = time.process_time() - begin
    said = capsys.readouterr().err.splitlines()
    seconds = float(re.search(r": (some|at least) ([\d.e-]+) s expected", "\n".join(said))[2])
    assert spent / 5 < seconds < spent * 5, (name, spent, said)


def test_the_outermost_work_has_the_bar(monkeypatch, capsys):
    """Also for what runs in the threads of a pool; a tick counts for its own work only."""
    monkeypatch.setattr(sys.stderr, "isatty", lambda: True, raising=False)
    monkeypatch.setattr(progress, "BAR_DELAY", 0.0)

    def inner(item):
        with Progress(2, "inner") as bar:
            tick("outer")
            tick("inner")
        return bar.done

    with ThreadPoolExecutor(2) as pool, Progress(10, "outer") as outer:
        assert mapped(inner, range(4)) == [1] * 4
        assert mapped(inner, range(4), executor=pool) == [1] * 4
        tick("outer")
    assert outer.done == 1
    said = capsys.readouterr().err
    assert "outer" in said and "inner" not in said and "items" not in said


def test_what_compiled_code_does_not_look_for():
    """A program of semidefinite matrices is left at once; results and errors come through."""
    before = signal.signal(signal.SIGINT, signal.default_int_handler)  # test workers ignore it
    started, over = threading.Event(), threading.Event()

    def program():
        started.set()
        return over.wait(60.0)

    def interrupt():
        started.wait(60.0)
        os.kill(os.getpid(), signal.SIGINT)

    threading.Thread(target=interrupt, daemon=True).start()
    try:
        with pytest.raises(KeyboardInterrupt):
            interruptible(program)
    finally:
        signal.signal(signal.SIGINT, before)
        over.set()
    assert interruptible(lambda: 3) == 3
    with pytest.raises(ZeroDivisionError):
        interruptible(lambda: 1 // 0)


def test_a_bar_is_drawn_while_the_first_item_takes_its_time(monkeypatch, capsys):
    monkeypatch.setattr(sys.stderr, "isatty", lambda: True, raising=False)
    monkeypatch.setattr(progress, "BAR_DELAY", 0.02)
    with Progress(1, "one long program"):
        for _ in range(500):
            time.sleep(0.01)
            if "one long program" in capsys.readouterr().err:
                return
    raise AssertionError("no bar")

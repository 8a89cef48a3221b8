"""Executors: the same to the bit, in order, seeded per item, in chunks of the right size."""

import sys
import time
from concurrent.futures import Executor, Future, ProcessPoolExecutor, ThreadPoolExecutor
from multiprocessing import get_context

import numpy as np
import pytest
from threadpoolctl import threadpool_info, threadpool_limits

import flexplant
import machines
import stages
from flexplant.errors import ModelError
from flexplant.estimation import kalman
from flexplant.lti import (
    balanced,
    balancing,
    control_care,
    controllability_gramian,
    equations,
    lyapunov,
    norms,
    response_solvers,
    riccati,
    solve_lyapunov,
    solve_stein,
)
from flexplant.lti import norms as h2_norms
from flexplant.parallel import CHUNK, PROBE, mapped
from flexplant.synthesis.hinf import hinf_design as attempts
from flexplant.synthesis.laws import servo_design as servo


def square(item):
    return item**2


def drawn(item, rng):
    return item + rng.standard_normal()


def slow_draw(item, rng):
    time.sleep(0.01)
    return item + rng.standard_normal()


def solved(item):
    time.sleep(0.005)
    rng = np.random.default_rng(item)
    A = rng.standard_normal((150, 150))
    return np.linalg.solve(A @ A.T + np.eye(150), A).sum()


def threads_used(_):
    time.sleep(0.03)
    return max(lib["num_threads"] for lib in threadpool_info() if lib["user_api"] == "blas")


class Here(Executor):
    """Runs at once and notes what it was given."""

    def __init__(self):
        self.sizes, self.durations = [], []

    def submit(self, function, /, *args):
        future = Future()
        start = time.perf_counter()
        result = function(*args)
        self.durations.append(time.perf_counter() - start)
        self.sizes.append(len(result))
        future.set_result(result)
        return future


class Lazy(Executor):
    """Runs nothing but the first chunk."""

    def __init__(self):
        self.futures = []

    def submit(self, function, /, *args):
        future = Future()
        self.futures.append(future)
        if len(self.futures) == 1:
            future.set_exception(ZeroDivisionError("the first chunk"))
        return future


def test_a_plain_loop():
    assert mapped(square, range(5)) == [0, 1, 4, 9, 16]
    assert mapped(square, iter([])) == []


@pytest.mark.parametrize("seed", [7, np.random.SeedSequence(7), 2**70])
def test_seeds_belong_to_items(seed):
    make = lambda: np.random.SeedSequence(7) if isinstance(seed, np.random.SeedSequence) else seed  # noqa: E731
    long = mapped(drawn, range(6), rng=make())
    assert long == mapped(drawn, range(6), rng=make())
    assert mapped(drawn, range(3), rng=make()) == long[:3]
    assert len({value - i for i, value in enumerate(long)}) == 6
    entropy = seed.entropy if isinstance(seed, np.random.SeedSequence) else seed
    children = np.random.SeedSequence(entropy).spawn(6)
    expected = [
        i + np.random.default_rng(child).standard_normal() for i, child in enumerate(children)
    ]
    assert long == expected


def test_a_generator_is_spawned_from_not_drawn_from():
    rng = np.random.default_rng(3)
    state = rng.bit_generator.state
    first = mapped(drawn, range(4), rng=rng)
    assert rng.bit_generator.state == state
    assert mapped(drawn, range(4), rng=rng) != first  # new children each time
    assert mapped(drawn, range(4), rng=np.random.default_rng(3)) == first


@pytest.mark.slow
def test_threads_give_the_same_to_the_bit():
    serial = mapped(slow_draw, range(40), rng=11)
    with ThreadPoolExecutor(3) as pool:
        assert mapped(slow_draw, range(40), executor=pool, rng=11) == serial
        assert mapped(solved, range(30), executor=pool) == mapped(solved, range(30))


@pytest.mark.slow
def test_processes_give_the_same_to_the_bit():
    with ProcessPoolExecutor(2, mp_context=get_context("spawn")) as pool:
        assert mapped(slow_draw, range(40), executor=pool, rng=11) == mapped(
            slow_draw, range(40), rng=11
        )
        assert mapped(solved, range(30), executor=pool) == mapped(solved, range(30))


def test_linear_algebra_runs_on_one_thread():
    before = {lib["filepath"]: lib["num_threads"] for lib in threadpool_info()}
    assert mapped(threads_used, range(2)) == [1, 1]
    with ThreadPoolExecutor(2) as pool:
        assert set(mapped(threads_used, range(5), executor=pool)) == {1}
    assert {lib["filepath"]: lib["num_threads"] for lib in threadpool_info()} == before


@pytest.mark.slow
def test_chunks_last_about_half_a_second():
    here = Here()

    def nap(item):
        time.sleep(0.02)
        return item

    assert mapped(nap, range(80), executor=here) == list(range(80))
    assert sum(here.sizes) < 80  # the first ones told how long it takes
    assert len(here.sizes) > 1
    assert 0.2 <= here.durations[0] <= 1.0
    assert 0.5 * CHUNK / 0.02 <= here.sizes[0] <= CHUNK / 0.02


def test_long_items_go_out_one_by_one():
    here = Here()

    def nap(item):
        time.sleep(PROBE + 0.01 if item == 0 else 0.0)
        return item

    mapped(nap, range(4), executor=here)
    assert here.sizes == [3]  # 0.06 s each: eight would fit a chunk


def test_an_error_stops_what_has_not_begun():
    lazy = Lazy()

    def nap(item):
        time.sleep(0.1)
        return item

    with pytest.raises(ZeroDivisionError, match="the first chunk"):
        mapped(nap, range(30), executor=lazy)
    assert len(lazy.futures) > 2
    assert all(future.cancelled() for future in lazy.futures[1:])


def test_errors_of_items_come_through():
    with pytest.raises(TypeError):
        mapped(square, [1, None])
    with ThreadPoolExecutor(1) as pool, pytest.raises(TypeError):
        mapped(square, [1, None], executor=pool)


@pytest.mark.parametrize(("progress", "shown"), [(True, True), (False, False), (None, False)])
def test_the_bar_shows_when_asked_or_on_a_terminal(capsys, progress, shown):
    mapped(square, range(3), progress=progress, description="squares")
    said = capsys.readouterr()
    assert ("squares" in said.err) is shown
    assert not said.out


def test_short_work_on_a_terminal_shows_no_bar(capsys, monkeypatch):
    monkeypatch.setattr(sys.stderr, "isatty", lambda: True, raising=False)
    mapped(square, range(3), description="squares")
    assert "squares" not in capsys.readouterr().err


def test_bad_input():
    with pytest.raises(ModelError, match="callable"):
        mapped(3, [1])
    with pytest.raises(ModelError, match="not its map"):
        mapped(square, [1], executor=map)


def test_the_name_is_the_module():
    """The connection of two systems of this name is in `flexplant.lti` only."""
    assert flexplant.parallel.mapped is mapped
    assert "parallel" in vars(flexplant.lti)


def loaded(g):
    """Return a plant with a disturbance at u, noise on y and the effort in z."""
    B, C = np.hstack([g.B, 0 * g.B, g.B]), np.vstack([g.C, 0 * g.C, g.C])
    D = [[0, 0, 0], [0, 0, 1], [0, 1, 0]]
    return flexplant.StateSpace(g.A, B, C, D, inputs=["w", "n", "u"], outputs=["z", "e", "y"])


@pytest.mark.slow
@pytest.mark.parametrize(
    ("module", "inner", "call"),
    [
        (response_solvers, "points", lambda g: flexplant.frequency_response(g, [1.0])),
        (
            response_solvers,
            "points",
            lambda g: flexplant.frequency_response(g.replace(blocks=None), [1]),
        ),
        (norms, "_proved", flexplant.hinf_norm),
        (h2_norms, "controllability_gramian", flexplant.h2_norm),
        (riccati, "_solution", lambda g: control_care(g.A, g.B, Q=np.eye(2), R=np.eye(1))),
        (equations, "symmetric", lambda g: solve_lyapunov(g.A, np.eye(2))),
        (equations, "symmetric", lambda g: solve_stein(0.1 * g.A, np.eye(2))),
        (lyapunov, "is_block_diagonal", controllability_gramian),
        (balancing, "split_stable", lambda g: balanced(g, order=1)),
        (kalman, "auto_filter_design", lambda g: flexplant.design_kalman(machines.stage())),
        (
            servo,
            "servo_task",
            lambda g: flexplant.design_servo(stages.sampled(stages.reduced()), bandwidth=20.0),
        ),
        (attempts, "certified_norm", lambda g: flexplant.design_hinf(loaded(g), u=["u"], y=["y"])),
    ],
)
def test_dense_loops_run_on_one_thread(monkeypatch, module, inner, call):
    """More BLAS threads than one wait for each other; afterwards there are as many as before."""
    g = flexplant.StateSpace([[0, 1], [-9, -0.1]], [[0], [1]], [[1, 0]], [[0]], blocks=[2])
    used = []
    original = getattr(module, inner)

    def now():
        """Threads of the BLAS of NumPy and SciPy: other packages bring libraries of their own."""
        return max(lib["num_threads"] for lib in flexplant.parallel._thread_pools().info())

    def noted(*arguments, **options):
        used.append(now())
        return original(*arguments, **options)

    monkeypatch.setattr(module, inner, noted)
    with threadpool_limits(2, user_api="blas"):
        call(g)
        assert now() == 2
    assert used and set(used) == {1}

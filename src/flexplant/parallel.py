"""The same function of many items, on any executor: chunks, seeds, progress.

Results are those of a plain loop, in order and to the bit: seeds belong to items, not to workers,
and linear algebra runs on one thread while items are computed (its rounding depends on how many).
"""

from __future__ import annotations

import threading
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from concurrent.futures import Executor, Future, wait
from contextlib import contextmanager
from functools import cache
from time import perf_counter
from typing import Any, TypeVar

import numpy as np

from .errors import ModelError, SolverError
from .progress import Progress as Progress
from .surviving import Lost, survived

Item = TypeVar("Item")
Result = TypeVar("Result")

#: work of one chunk [s]: long beside the cost of sending it, short beside the whole
CHUNK = 0.5
#: items computed here before the rest is sent take this long [s]: they show how long one takes
PROBE = 0.05


@cache
def _controller() -> Any:
    from threadpoolctl import ThreadpoolController

    return ThreadpoolController()


#: how deep a thread is in `one_thread`; how many threads are in it, and what they found before
_depth = threading.local()
_lock, _inside = threading.Lock(), 0
_original: Any = None


@contextmanager
def one_thread() -> Iterator[None]:
    """Return a context, also a decorator, in which BLAS runs on one thread.

    For loops over small matrices: more threads wait for each other, 3 to 30 times as long on a busy
    machine. Inside another one it costs nothing; the last of several threads restores what was.
    """
    global _inside, _original
    if getattr(_depth, "value", 0):
        yield
        return
    with _lock:  # the number of threads may belong to each thread, or to all
        limited = _controller().limit(limits=1, user_api="blas")
        _original = limited if _inside == 0 else _original
        _inside += 1
    _depth.value = 1
    try:
        yield
    finally:
        _depth.value = 0
        with _lock:
            _inside -= 1
            if _inside == 0:
                _original.restore_original_limits()


def interruptible(function: Callable[[], Result]) -> Result:
    """Return ``function()``, which Ctrl-C ends at once although compiled code does not look for it.

    It runs in a thread of its own, on one thread of BLAS, while this one waits. Interrupted, it is
    left alone and ends with the limit of time that it has.
    """
    if threading.current_thread() is not threading.main_thread():  # signals reach the main thread
        return function()
    outcome: Future[Result] = Future()

    def run() -> None:
        try:
            with one_thread():
                outcome.set_result(function())
        except BaseException as error:
            outcome.set_exception(error)

    threading.Thread(target=run, daemon=True).start()
    while not outcome.done():
        wait([outcome], timeout=CHUNK)
    return outcome.result()


def mapped(
    function: Callable[..., Result],
    items: Iterable[Item],
    *,
    executor: Executor | None = None,
    progress: bool | None = None,
    rng: int | np.random.SeedSequence | np.random.Generator | None = None,
    description: str = "items",
    known: Mapping[int, Result] | None = None,
    each: Callable[[int, Result], None] | None = None,
) -> list[Result]:
    """Return ``[function(item) for item in items]``, computed on an executor."""
    if not callable(function):
        raise ModelError(f"function must be callable, got {type(function).__name__}.")
    if executor is not None and not callable(getattr(executor, "submit", None)):
        raise ModelError(
            f"executor must be a concurrent.futures.Executor, got {type(executor).__name__}. "
            "Pass the pool itself, such as ProcessPoolExecutor(), not its map."
        )
    listed = list(items)
    calls: list[tuple[Any, ...]] = [(item,) for item in listed]
    if rng is not None:
        calls = [(*call, seed) for call, seed in zip(calls, _seeds(rng, len(calls)), strict=True)]
    results: dict[int, Result] = dict(known or {})
    left = [(i, call) for i, call in enumerate(calls) if i not in results]

    def keep(number: int, result: Result) -> None:
        results[number] = result
        if each is not None:
            each(number, result)
        bar.advance()

    with one_thread(), Progress(len(calls), description, progress=progress) as bar:
        bar.advance(len(results))
        start = perf_counter()
        for done, (number, call) in enumerate(left):
            if executor is not None and done and perf_counter() - start > PROBE:
                seconds = (perf_counter() - start) / done
                _send(function, left[done:], seconds, executor, keep)
                break
            keep(number, _call(function, call))
        return [results[i] for i in range(len(calls))]


def _send(
    function: Callable[..., Result],
    calls: Sequence[tuple[int, tuple[Any, ...]]],
    seconds: float,
    executor: Executor,
    keep: Callable[[int, Result], None],
) -> None:
    """Compute calls, each of which takes so many seconds, in chunks on an executor."""
    size = max(1, round(CHUNK / max(seconds, 1e-9)))
    chunks = [calls[i : i + size] for i in range(0, len(calls), size)]
    out = {i: (function, [call for _, call in chunk]) for i, chunk in enumerate(chunks)}
    for i, found in survived(_chunk, out, executor):
        if isinstance(found, Lost):
            raise SolverError(
                f"items from number {chunks[i][0][0]}: {found.reason}. Give the workers "
                "more memory, or compute without an executor."
            )
        for (number, _), result in zip(chunks[i], found, strict=True):
            keep(number, result)


def _chunk(function: Callable[..., Result], calls: Sequence[tuple[Any, ...]]) -> list[Result]:
    with one_thread(), Progress(None, "chunk", progress=False):  # no bars inside
        return [_call(function, call) for call in calls]


def _call(function: Callable[..., Result], call: tuple[Any, ...]) -> Result:
    item, *seed = call
    return function(item, np.random.default_rng(seed[0])) if seed else function(item)


def _seeds(
    rng: int | np.random.SeedSequence | np.random.Generator, count: int
) -> list[np.random.SeedSequence]:
    if isinstance(rng, np.random.Generator):
        source = rng.bit_generator.seed_seq
    else:
        source = rng if isinstance(rng, np.random.SeedSequence) else np.random.SeedSequence(rng)
    return list(source.spawn(count))  # type: ignore[attr-defined]

"""Calls on an executor whose workers may die or hang: what was lost is done again, once."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping
from concurrent.futures import (
    FIRST_COMPLETED,
    BrokenExecutor,
    Executor,
    Future,
    ProcessPoolExecutor,
    ThreadPoolExecutor,
    wait,
)
from dataclasses import dataclass
from math import inf
from os import cpu_count
from time import monotonic
from typing import Any, Final

from .errors import SolverError

#: calls that are sent out at once
_SENT = 64
#: what is said of a call whose process ended twice
DIED: Final = "its worker died, twice (out of memory, or a crash of compiled code?)"


@dataclass(frozen=True)
class Lost:
    """What comes out of a call whose process ended twice, or took too long, and why."""

    reason: str


def survived(
    function: Callable[..., Any],
    calls: Mapping[int, tuple[Any, ...]],
    executor: Executor,
    timeout: float | None = None,
) -> Iterator[tuple[int, Any]]:
    """Yield numbers and results of ``function(*call)`` as they come.

    When a process of a pool dies, the rest goes on in as many processes as the pool had, started
    as its own were, one call at a time in each: the calls that were out are done once more, and
    one whose process dies again yields `Lost`. With a timeout [s] this is so from the beginning,
    and a process that takes longer is ended. What the function raises is raised.
    """
    left, tried = dict(calls), set[int]()
    if timeout is None:
        for number, result in _pooled(function, left, executor, tried):
            del left[number]
            yield number, result
    if left:
        yield from _single(function, left, executor, tried, inf if timeout is None else timeout)


def _pooled(
    function: Callable[..., Any],
    calls: Mapping[int, tuple[Any, ...]],
    executor: Executor,
    lost: set[int],
) -> Iterator[tuple[int, Any]]:
    """Yield what an executor finds; when it breaks, the calls that were out go to lost."""
    waiting = iter(list(calls.items()))
    out: dict[Future[Any], int] = {}
    broken = False
    try:
        while True:
            while not broken and len(out) < _SENT and (item := next(waiting, None)) is not None:
                try:
                    out[executor.submit(function, *item[1])] = item[0]
                except BrokenExecutor:
                    broken = True
            if not out:
                return
            done = wait(out, return_when=FIRST_COMPLETED).done
            for future in sorted(done, key=lambda one: out[one]):
                number = out.pop(future)
                error = future.exception()
                if error is None:
                    yield number, future.result()
                elif isinstance(error, BrokenExecutor):
                    broken = True
                    lost.add(number)
                elif type(error).__name__ == "KilledWorker":  # of dask, which tried it again
                    yield number, Lost(DIED)
                else:
                    raise error
    finally:
        for future in out:
            future.cancel()


def _single(
    function: Callable[..., Any],
    calls: Mapping[int, tuple[Any, ...]],
    executor: Executor,
    tried: set[int],
    timeout: float,
) -> Iterator[tuple[int, Any]]:
    """Yield what processes like those of a pool find, each of which has one call at a time.

    The process that dies is that of the call to blame, and it can be ended without another.
    """
    waiting = list(calls)[::-1]
    first = next(iter(calls.values()))[0]  # a function that the calls have in common
    #: the process of each call that is out, its number (None while it starts), and its end [s]
    out: dict[Future[Any], tuple[ProcessPoolExecutor, int | None, float]] = {}

    def start() -> None:
        process = _one_like(executor)
        out[process.submit(_started, function, first)] = process, None, inf

    def send(process: ProcessPoolExecutor, number: int) -> None:
        try:
            sent = process.submit(function, *calls[number])
        except BrokenExecutor:  # it died while it had nothing to do
            waiting.append(number)
            start()
        else:
            out[sent] = process, number, monotonic() + timeout

    try:
        for _ in range(
            min(getattr(executor, "_max_workers", None) or cpu_count() or 1, len(calls))
        ):
            start()
        while out:
            soonest = min(end for _, _, end in out.values())
            pause = None if soonest == inf else max(0.0, soonest - monotonic())
            wait(out, timeout=pause, return_when=FIRST_COMPLETED)
            now = monotonic()
            over = [one for one, (_, _, end) in out.items() if one.done() or end <= now]
            for future in over:
                process, number, _ = out.pop(future)
                late = not future.done()
                error = None if late else future.exception()
                if late or isinstance(error, BrokenExecutor):
                    _end(process)
                    if number is None:
                        raise SolverError(
                            "a process like those of the executor ends while it starts. Check the "
                            "executor's initializer, or compute without an executor."
                        ) from error
                    if late:
                        yield number, Lost(f"took longer than {timeout:g} s, and was ended")
                    elif number in tried:
                        yield number, Lost(DIED)
                    else:
                        tried.add(number)
                        waiting.append(number)
                    if waiting:
                        start()
                    continue
                if error is not None:
                    _end(process)
                    raise error
                if waiting:
                    send(process, waiting.pop())
                else:
                    process.shutdown()
                if number is not None:
                    yield number, future.result()
    finally:  # interrupted too: no process stays
        for process, _, _ in out.values():
            _end(process)


def _one_like(executor: Executor) -> ProcessPoolExecutor:
    """Return a pool of one process, which starts as those of an executor do.

    The settings of a pool are not public; those that another kind of executor lacks are defaults.
    """
    if isinstance(executor, ThreadPoolExecutor):  # its threads could not start
        raise SolverError(
            "the executor is broken: its initializer failed. Mend that, or leave it out."
        )
    return ProcessPoolExecutor(
        1,
        mp_context=getattr(executor, "_mp_context", None),
        initializer=getattr(executor, "_initializer", None),
        initargs=getattr(executor, "_initargs", ()),
        max_tasks_per_child=getattr(executor, "_max_tasks_per_child", None),
    )


def _end(process: ProcessPoolExecutor) -> None:
    """End a pool of one process, whatever it is doing."""
    for one in list((getattr(process, "_processes", None) or {}).values()):
        one.kill()
    process.shutdown(cancel_futures=True)


def _started(*_functions: Any) -> None:
    """Return at once: the process has started, and imported what some functions need."""

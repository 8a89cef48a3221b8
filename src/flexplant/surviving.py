"""Calls on an executor whose workers may die: what was lost is done again, once."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping
from concurrent.futures import (
    FIRST_COMPLETED,
    BrokenExecutor,
    Executor,
    Future,
    ProcessPoolExecutor,
    wait,
)
from typing import Any, Final

#: calls that are sent out at once
_SENT = 64
#: what is said of a call whose process ended twice
DIED: Final = "its worker died, twice (out of memory, or a crash of compiled code?)"


class Died:
    """What comes out of a call whose process ended twice."""


def survived(
    function: Callable[..., Any], calls: Mapping[int, tuple[Any, ...]], executor: Executor
) -> Iterator[tuple[int, Any]]:
    """Yield numbers and results of ``function(*call)`` as they come.

    When a process of a pool dies, the calls that were out are done once more, each in a process of
    its own; one that dies there too yields `Died`, and the rest goes on in a new pool. What the
    function raises is raised.
    """
    left, own = dict(calls), executor
    while left:
        lost: list[int] = []
        try:
            for number, result in _pooled(function, left, own, lost):
                del left[number]
                yield number, result
        finally:  # interrupted too: no process stays
            if own is not executor:
                own.shutdown(cancel_futures=True)
        for number in lost:  # one of them ended the process
            yield number, _alone(function, left.pop(number))
        if left:
            own = ProcessPoolExecutor()


def _pooled(
    function: Callable[..., Any],
    calls: Mapping[int, tuple[Any, ...]],
    executor: Executor,
    lost: list[int],
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
                    lost.append(number)
                elif type(error).__name__ == "KilledWorker":  # of dask, which tried it again
                    yield number, Died()
                else:
                    raise error
    finally:
        for future in out:
            future.cancel()


def _alone(function: Callable[..., Any], call: tuple[Any, ...]) -> Any:
    """Return the result of one call in a process of its own."""
    with ProcessPoolExecutor(1) as single:
        try:
            return single.submit(function, *call).result()
        except BrokenExecutor:
            return Died()

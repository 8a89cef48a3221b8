"""The same function of many items, on any executor: chunks, seeds, progress.

Results are those of a plain loop, in order and to the bit: seeds belong to items, not to workers,
and linear algebra runs on one thread while items are computed (its rounding depends on how many).
"""

from __future__ import annotations

import os
import sys
import threading
from collections import deque
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from concurrent.futures import (
    FIRST_COMPLETED,
    BrokenExecutor,
    Executor,
    Future,
    ProcessPoolExecutor,
    ThreadPoolExecutor,
    wait,
)
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from functools import cache
from time import monotonic, perf_counter, sleep
from typing import Any, Final, Self, TypeVar

import numpy as np

from .errors import ModelError, SolverError

Item = TypeVar("Item")
Result = TypeVar("Result")

#: samples, lines or columns that are computed at once: they stay in the cache
PIECE = 2048
#: work of one chunk [s]: long relative to the cost of sending it, short relative to the whole
CHUNK = 0.5
#: items computed here before the rest is sent take this long [s]: they show how long one takes
PROBE = 0.05


@cache
def _thread_pools() -> Any:
    from threadpoolctl import ThreadpoolController

    return ThreadpoolController()


#: the threads that are in `one_thread`, and what they found before
_lock = threading.Lock()
_inside: set[int] = set()
_original: Any = None


@contextmanager
def one_thread() -> Iterator[None]:
    """Return a context, also a decorator, in which BLAS runs on one thread."""
    # for loops over small matrices: more threads wait for each other, 3 to 30 times as long on a
    # busy machine. Inside another one it costs nothing; the last of several threads restores what
    # was
    global _original
    own = threading.get_ident()
    if own in _inside:
        yield
        return
    with _lock:  # the number of threads may belong to each thread, or to all
        limited = _thread_pools().limit(limits=1, user_api="blas")
        _original = _original if _inside else limited
        _inside.add(own)
    try:
        yield
    finally:
        with _lock:
            _inside.remove(own)
            if not _inside:
                _original.restore_original_limits()


def interruptible(function: Callable[[], Result]) -> Result:
    """Return ``function()``, which Ctrl-C ends at once although compiled code does not look for it.

    It runs in a separate thread, on one thread of BLAS, while this one waits. Interrupted, it is
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
    advice: str = "",
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

    with one_thread(), Progress(len(calls), description, progress=progress, advice=advice) as bar:
        bar.advance(len(results), known=True)
        start = perf_counter()
        for done, (number, call) in enumerate(left):
            if executor is not None and done and perf_counter() - start > PROBE:
                seconds = (perf_counter() - start) / done
                _send(function, left[done:], seconds, executor, keep)
                break
            keep(number, _call_seeded(function, call))
        return [results[i] for i in range(len(calls))]


def _send(
    function: Callable[..., Result],
    calls: Sequence[tuple[int, tuple[Any, ...]]],
    seconds: float,
    executor: Executor,
    keep: Callable[[int, Result], None],
) -> None:
    """Compute calls, each of which takes some seconds, in chunks on an executor."""
    size = max(1, round(CHUNK / max(seconds, 1e-9)))  # clocks have no finer tick
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
        return [_call_seeded(function, call) for call in calls]


def _call_seeded(function: Callable[..., Result], call: tuple[Any, ...]) -> Result:
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


#: calls that are sent out at once, to an executor that does not say how many workers it has; to
#: another one two for each worker, so that few are tried again where a process dies
_SENT = 64
#: what is said of a call whose process ended twice
DIED: Final = "its worker died, twice (out of memory, or a crash of compiled code?)"
#: what is said where an executor twice drops what it was given
GONE: Final = (
    "the executor dropped what it was given, twice: its scheduler ended and is not back, or it was "
    "shut down. What a checkpoint has is kept: begin again with it when the executor runs."
)


@dataclass(frozen=True)
class Lost:
    """What comes out of a call whose process ended twice, and why."""

    reason: str


def survived(
    function: Callable[..., Any], calls: Mapping[int, tuple[Any, ...]], executor: Executor
) -> Iterator[tuple[int, Any]]:
    """Yield numbers and results of ``function(*call)`` as they come."""
    # when a process of a pool dies, the calls that were out are done once more, each in a
    # separate process, where one that dies again yields `Lost`; the rest goes on in another pool
    left, pool, own = dict(calls), executor, False
    while left:
        lost: set[int] = set()
        for number, result in _pooled(function, left, pool, lost):
            del left[number]
            yield number, result
        if own:
            pool.shutdown()
        for number in sorted(lost):
            with _pool_like(executor, 1) as alone:
                sent = alone.submit(function, *left.pop(number))
                died = isinstance(sent.exception(), BrokenExecutor)
                yield number, Lost(DIED) if died else sent.result()
        if left:
            pool, own = _pool_like(executor, getattr(executor, "_max_workers", None)), True


def _pooled(
    function: Callable[..., Any],
    calls: Mapping[int, tuple[Any, ...]],
    executor: Executor,
    lost: set[int],
) -> Iterator[tuple[int, Any]]:
    """Yield what an executor finds; when it breaks, the calls that were out go to lost."""
    # what a scheduler of dask had when it died comes back as cancelled, or not at all: all is sent
    # once more, and waits until the scheduler is back, as long as its client does
    waiting, most = deque(calls), 2 * getattr(executor, "_max_workers", _SENT // 2)
    out: dict[Future[Any], int] = {}
    broken, again = False, set[int]()
    try:
        while True:
            while waiting and not broken and len(out) < most:
                number = waiting.popleft()
                try:
                    out[executor.submit(function, *calls[number])] = number
                except BrokenExecutor:
                    broken = True
                    lost.update(() if out or lost else (number,))
            if not out:
                return
            done = wait(out, return_when=FIRST_COMPLETED).done
            if any(future.cancelled() for future in done):
                dropped = {f: n for f, n in out.items() if f.cancelled() or not f.done()}
                if not again.isdisjoint(dropped.values()):
                    raise SolverError(GONE)
                for future, number in dropped.items():
                    future.cancel()
                    del out[future]
                    again.add(number)
                    waiting.append(number)
                sleep(CHUNK)  # its client drops what it had, also what is sent too soon
            for future in sorted(done & out.keys(), key=lambda one: out[one]):
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


def _pool_like(executor: Executor, workers: int | None) -> ProcessPoolExecutor:
    """Return a pool whose processes start as those of an executor do."""
    if isinstance(executor, ThreadPoolExecutor):  # its threads could not start
        raise SolverError(
            "the executor is broken: its initializer failed. Mend that, or leave it out."
        )
    # the settings of a pool are not public; those that another kind of executor lacks are defaults
    return ProcessPoolExecutor(
        workers,
        mp_context=getattr(executor, "_mp_context", None),
        initializer=getattr(executor, "_initializer", None),
        initargs=getattr(executor, "_initargs", ()),
        max_tasks_per_child=getattr(executor, "_max_tasks_per_child", None),
    )


#: shorter work than this shows no bar [s]
BAR_DELAY = 2.0
#: a bar that nothing advances is drawn anew after this long, for the time it shows [s]
_AGAIN = 1.0
#: with more than this left to do, advice on how to have less is worth its words [s]
LONG = 20.0
#: a promise that is wrong by this factor is corrected
_OFF = 2.0
#: share of the work from which on its time tells that of all
_TELLS = 0.05
#: the bars that a thread is inside of
_open = threading.local()


class _Watcher:
    """One thread that shows all work under way; it ends when there is no more work."""

    # starting a thread for each work would take 150 us, more than a small problem itself
    def __init__(self) -> None:
        self.forget()

    def forget(self) -> None:
        """Begin anew, as in a process that was forked: the thread is not in it."""
        self._wake, self._thread, self._until = threading.Condition(), threading.Thread(), 0.0
        #: when the next step of showing a work is due, and the steps, each of which gives a pause
        self._due: dict[Progress, tuple[float, Iterator[float]]] = {}

    def begin(self, work: Progress, steps: Iterator[float]) -> None:
        """Show a work, step by step, from the first pause on."""
        with self._wake:
            self._due[work] = (due := monotonic() + next(steps)), steps
            if not self._thread.is_alive():
                self._thread = threading.Thread(target=self._run, daemon=True)
                self._thread.start()
            elif due < self._until:
                self._wake.notify()

    def end(self, work: Progress) -> None:
        """Show no more of a work; a step that is under way is finished."""
        with self._wake:
            self._due.pop(work, None)

    def _run(self) -> None:
        idle = False
        with self._wake:
            while self._due or not idle:
                idle, now = not self._due, monotonic()
                for work, (due, steps) in list(self._due.items()):
                    if due <= now:
                        pause = np.inf
                        with suppress(OSError, ValueError):  # a closed stream
                            pause = next(steps, np.inf)
                        self._due[work] = now + pause, steps
                self._until = min(now + _AGAIN, *(due for due, _ in self._due.values()), np.inf)
                self._wake.wait(self._until - now)
            self._thread = threading.Thread()


_watcher = _Watcher()
if hasattr(os, "register_at_fork"):
    os.register_at_fork(after_in_child=_watcher.forget)


class Progress:
    """A bar for long work: after two seconds, on a terminal or in a notebook, unless forced.

    Elsewhere (pipes, log files of a cluster) one line on the standard error says after two seconds
    what runs, and how long it will take where this is known. An estimate follows from the work that
    is done (`expect`, `so_far`, or the items counted). It is corrected by a further line where it
    proves wrong by a factor of two. `advice` follows where more than 20 seconds are left.

    Work inside other work shows no bar, neither here nor in the process of a pool.
    """

    def __init__(
        self,
        total: int | None,
        description: str,
        *,
        progress: bool | None = None,
        advice: str = "",
        even: bool = True,
    ) -> None:
        self.bar: Any = None
        self._begin = monotonic()
        #: items counted, those of them that were known before, when the last was counted [s], and
        #: whether they take about equally long, so that they show how much is done
        self.done, self._known, self._last, self._counts = 0, 0, 0.0, even
        #: seconds in all that were last promised, 0 before; and whether advice was given
        self._promised, self._advised = 0.0, not advice
        self.description, self.advice = description, advice
        if not (progress is None or isinstance(progress, bool | np.bool_)):
            raise ModelError(
                f"progress must be True, False or None, got {progress!r:.60}. Leave it out: then "
                "it is shown on a terminal."
            )
        self._forced, self._total = bool(progress), total
        outermost = progress is None and not bars_of_thread()
        self._stream = watched() if outermost else None
        self._unseen = outermost and self._stream is None and sys.stderr is not None
        if progress or self._stream is not None:
            from tqdm import tqdm

            self.bar = tqdm(
                total=total,
                desc=description,
                bar_format=None if total != 0 else "{desc}: {elapsed}",
                delay=0.0 if progress else BAR_DELAY,
                leave=bool(progress),
                file=self._stream or sys.stderr,
            )

    def __enter__(self) -> Self:
        try:
            bars_of_thread().append(self)
            if (self.bar is not None and not self._forced) or self._unseen:
                _watcher.begin(self, self._said() if self._unseen else self._shown())
        except BaseException:  # Ctrl-C while a thread starts: nothing would close it
            self._close()
            raise
        return self

    def __exit__(self, *_: object) -> None:
        try:
            self._close()
        except BaseException:  # Ctrl-C in there
            self._close()
            raise

    def _close(self) -> None:
        """End what shows the work; again where that was interrupted."""
        _watcher.end(self)
        if self in bars_of_thread():
            bars_of_thread().remove(self)
        if self.bar is not None:
            self.bar.close()

    def advance(self, items: int = 1, *, known: bool = False) -> None:
        """Count some items as done; `known` ones took no time, as those of a checkpoint."""
        self.done += items
        if known:
            self._known += items
        else:
            self._last = self.elapsed
        if self.bar is not None:
            self.bar.update(items)

    @property
    def elapsed(self) -> float:
        """Seconds since the work began."""
        return monotonic() - self._begin

    def expects(self, seconds: float, *, at_least: bool = False) -> None:
        """Say how long all of it will take; again where that differs by a factor of two."""
        known = self._promised
        if seconds < max(BAR_DELAY, self.elapsed) or not (self._unseen or self.bar is not None):
            return
        if seconds < _OFF * known and (at_least or seconds > known / _OFF - BAR_DELAY):
            return
        self._promised, some = seconds, "at least" if at_least else "some"
        if known:
            left = seconds - self.elapsed
            self._write(f"{self.elapsed:.0f} s, {some} {_rounded(left)} s more", left)
        else:
            self._write(f"{some} {_rounded(seconds)} s expected", seconds)

    def _shown(self) -> Iterator[float]:
        """Draw the bar while the first item, or any later one, takes its time; yield pauses [s]."""
        yield BAR_DELAY
        while True:
            left = self._left()
            if not self._advised and left > LONG:
                self._write(f"some {left:.0f} s more", left)
            self.bar.refresh()
            yield _AGAIN

    def _said(self) -> Iterator[float]:
        """Say what runs, how long it will take, and again where that proves wrong; yield pauses."""
        yield BAR_DELAY
        said = False
        while True:
            left, spent = self._left(), self.elapsed
            total, known = spent + left, self._promised
            if known and left and not known / _OFF - BAR_DELAY < total < _OFF * known:
                self._say(left)
            elif not left and spent > (_OFF * known or LONG):
                self._promised = spent
                more = ", longer than expected" if known else ""
                self._write(f"{spent:.0f} s{more}", np.inf)
            elif not known and (left or not said):
                self._say(left)
            said = True
            yield min(BAR_DELAY, _AGAIN)

    def _left(self) -> float:
        """Return the seconds that what is not done will take, by what is; 0 where unknown."""
        own = self.done - self._known
        if not (self._total and self._counts) or own <= 0:
            return 0.0
        if (
            own < _TELLS * (self._total - self._known) and self.elapsed < LONG
        ):  # the first ones may take longer
            return 0.0
        since = self.elapsed - self._last  # of the item under way, which may take longer
        each = max(self._last / own, since)
        return max(each * (self._total - self.done) - since, 1e-9)

    def _say(self, left: float) -> None:
        text = f"{self.elapsed:.0f} s"
        if left:
            self._promised = self.elapsed + left
            text += f", {self.done} of {self._total} done, some {left:.0f} s more"
        self._write(text, left)

    def _write(self, text: str, left: float) -> None:
        """Write a line, with the advice where much is left."""
        line = f"{self.description.rstrip(':')}: {text}"
        if left > LONG and not self._advised:
            self._advised, line = True, f"{line}. {self.advice}"
        with suppress(OSError, ValueError):  # a closed stream
            if self.bar is not None:
                self.bar.write(line, file=self._stream or sys.stderr)
            else:
                sys.stderr.write(line + "\n")


def _rounded(seconds: float) -> str:
    return f"{float(f'{seconds:.1g}'):g}"


@cache
def _seconds_each() -> float:
    """Return the seconds of one multiplication here, in products of matrices."""
    square, spent = np.ones((256, 256)), []
    with one_thread():
        for _ in range(5):  # the quickest: others compute at the same time
            start = perf_counter()
            square @ square
            spent.append(perf_counter() - start)
    return min(spent) / 256**3


#: no processor does a multiplication in less [s]: shorter work is not worth measuring
_LEAST = 1e-12


def expect(multiplications: float = 0.0, *, seconds: float = 0.0, more: bool = False) -> None:
    """Say how long the work under way takes in all, where that is long.

    `multiplications` are those of products of matrices that take as long. Where this is `more` that
    follows, or work inside other work, the outermost one takes at least as long.
    """
    bars = bars_of_thread()
    if not bars:
        return
    if multiplications * _LEAST > BAR_DELAY * 1e-2:
        seconds += multiplications * _seconds_each()
    if len(bars) == 1 and not more:
        bars[0].expects(seconds)
    else:
        bars[0].expects(bars[0].elapsed + seconds, at_least=True)


def so_far(done: float, expected: float) -> None:
    """Say how long the work under way takes in all, by what is done of what is expected."""
    bars = bars_of_thread()
    if len(bars) != 1:
        return
    bars[0]._counts = False
    while done >= expected:  # as much again
        expected *= 2.0
    if done > _TELLS * expected:
        bars[0].expects(bars[0].elapsed * expected / done)


def tick(description: str, expected: float = 0.0) -> None:
    """Count an item of the innermost work, where that is its description; else do nothing."""
    bars = bars_of_thread()
    if bars and bars[-1].description == description:
        bars[-1].advance()
        if expected:
            so_far(bars[-1].done, expected)


def watched() -> Any:
    """Return the stream of a terminal or notebook that somebody sees; None in pipes and files."""
    if sys.stderr is not None and sys.stderr.isatty():
        return sys.stderr
    return sys.stdout if in_notebook() else None


def in_notebook() -> bool:
    """Return whether a notebook shows what a cell returns."""
    shell = getattr(sys.modules.get("IPython"), "get_ipython", lambda: None)()
    return type(shell).__name__ == "ZMQInteractiveShell"


def bars_of_thread() -> list[Progress]:
    """Return the list of work under way in this thread, the innermost last: it goes on changing."""
    _open.bars = bars = getattr(_open, "bars", [])
    return bars

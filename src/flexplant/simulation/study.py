"""study: one pipeline over many machines, on any executor, resumed where it was stopped."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from concurrent.futures import (
    FIRST_COMPLETED,
    BrokenExecutor,
    Executor,
    Future,
    ProcessPoolExecutor,
    wait,
)
from pathlib import Path
from typing import Any, TypeAlias

import numpy as np

from ..errors import ModelError
from ..parallel import Progress, one_thread
from ..values import seed_sequence, short
from .study_log import StudyLog
from .study_table import StudyTable, checked_row, tabled

#: machines that are sent out at once
_SENT = 64
#: what is said of a machine whose process ended twice
_DIED = "its worker died, twice (out of memory, or a crash of compiled code?)"

#: a row of the table, or the reason why there is none
Outcome: TypeAlias = Mapping[str, Any] | str


def study(
    machines: Sequence[Any],
    pipeline: Callable[..., Mapping[str, Any]],
    *,
    executor: Executor | None = None,
    checkpoint: str | Path | None = None,
    rng: Any = None,
    progress: bool | None = None,
) -> StudyTable:
    """Return the table of what a pipeline finds for each machine.

    A machine that raises gets a row with its reason, the others go on. The table is the same to
    the bit whatever executes it: seeds belong to machines, linear algebra runs on one thread.

    Parameters
    ----------
    machines : sequence
        What differs from row to row: virtual machines, measurements, parameters.
    pipeline : callable
        ``pipeline(machine)``, or ``pipeline(machine, generator)`` when rng is given; returns a
        mapping {column: number, truth or text}. For a process pool it can be pickled: defined in a
        module, or a value like `MachinePipeline`.
    executor : concurrent.futures.Executor, optional
        A process pool, `dask.distributed`'s `Client.get_executor()`, `mpi4py.futures`; None is a
        plain loop. When a process of a pool dies, its machines are tried once more, each in a
        process of its own; one that dies there too fails, and the rest goes on in a new pool.
    checkpoint : path, optional
        A file that keeps each row as it comes. With a file that exists the study goes on where it
        was stopped, also after being killed: no machine that is in the file is computed again.
    rng : int, SeedSequence or Generator, optional
        From it a seed is spawned for each machine.
    progress : bool, optional
        A bar: None shows one on a terminal for work of more than two seconds.

    Returns
    -------
    StudyTable
        A mapping of arrays by column, in the order of the machines.

    Raises
    ------
    ModelError
        When there are no machines, the pipeline cannot be called or returns something else than a
        mapping of numbers, truths and texts, or the checkpoint is of another study.
    """
    items = list(machines)
    if not items:
        raise ModelError("a study needs machines, got none. Give a sequence of them.")
    if not callable(pipeline):
        raise ModelError(
            f"pipeline must be callable, got {short(pipeline)}. Give a function of a machine that "
            "returns a mapping, or a MachinePipeline."
        )
    source = None if rng is None else seed_sequence(rng)
    entropy = None if source is None else [source.entropy, list(source.spawn_key)]
    fixed = not isinstance(rng, np.random.Generator)
    path = None if checkpoint is None else Path(checkpoint)
    log = StudyLog(path, items, pipeline, entropy, fixed)
    seeds: list[Any] = [None] * len(items)
    if log.entropy is not None:
        own = np.random.SeedSequence(log.entropy[0], spawn_key=tuple(log.entropy[1]))
        seeds = list(own.spawn(len(items)))
    left = [i for i in range(len(items)) if i not in log.rows]
    calls = {i: (pipeline, items[i], seeds[i]) for i in left}
    with Progress(len(items), "machines", progress=progress) as bar:
        bar.advance(len(log.rows))
        for number, outcome in _outcomes(calls, executor):
            log.add(number, outcome)
            bar.advance()
    return tabled([log.rows[i] for i in range(len(items))])


def _outcomes(
    calls: dict[int, tuple[Any, ...]], executor: Executor | None
) -> Iterator[tuple[int, Outcome]]:
    """Yield numbers and outcomes as they come; outcomes that are errors of the pipeline raise."""
    if executor is None:
        for number, call in calls.items():
            yield number, _kept(_outcome(*call))
        return
    left, own = dict(calls), executor
    while left:
        lost: list[int] = []
        for number, outcome in _pooled(left, own, lost):
            del left[number]
            yield number, outcome
        if own is not executor:
            own.shutdown(cancel_futures=True)
        for number in lost:  # one of them ended the process
            yield number, _alone(left.pop(number))
        if left:
            own = ProcessPoolExecutor()


def _pooled(
    calls: Mapping[int, tuple[Any, ...]], executor: Executor, lost: list[int]
) -> Iterator[tuple[int, Outcome]]:
    """Yield what an executor finds; when it breaks, the machines that were out go to lost."""
    waiting = iter(list(calls.items()))
    out: dict[Future[Any], int] = {}
    broken = False
    try:
        while True:
            while not broken and len(out) < _SENT and (item := next(waiting, None)) is not None:
                try:
                    out[executor.submit(_outcome, *item[1])] = item[0]
                except BrokenExecutor:
                    broken = True
            if not out:
                return
            for future in wait(out, return_when=FIRST_COMPLETED).done:
                number = out.pop(future)
                error = future.exception()
                if error is None:
                    yield number, _kept(future.result())
                elif isinstance(error, BrokenExecutor):
                    broken = True
                    lost.append(number)
                elif type(error).__name__ == "KilledWorker":  # of dask, which tried it again
                    yield number, _DIED
                else:
                    raise error
    finally:
        for future in out:
            future.cancel()


def _alone(call: tuple[Any, ...]) -> Outcome:
    """Return the outcome of one machine in a process of its own."""
    with ProcessPoolExecutor(1) as single:
        try:
            return _kept(single.submit(_outcome, *call).result())
        except BrokenExecutor:
            return _DIED


def _outcome(pipeline: Callable[..., Any], machine: Any, seed: Any) -> Outcome | ModelError:
    """Return the row of one machine, or why there is none; what is no row is an error."""
    try:
        with one_thread():
            if seed is None:
                found = pipeline(machine)
            else:
                found = pipeline(machine, np.random.default_rng(seed))
    except Exception as error:  # whatever it is, the other machines go on
        return f"{type(error).__name__}: {' '.join(str(error).split())}"
    try:
        return checked_row(found)
    except ModelError as error:
        return error


def _kept(outcome: Outcome | ModelError) -> Outcome:
    if isinstance(outcome, ModelError):
        raise outcome
    return outcome

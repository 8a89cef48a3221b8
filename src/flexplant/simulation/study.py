"""study: one pipeline over many machines, on any executor, resumed where it was stopped."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from concurrent.futures import Executor, ProcessPoolExecutor
from pathlib import Path
from typing import Any, TypeAlias

import numpy as np

from ..checkpoint import Checkpoint
from ..errors import ModelError
from ..fingerprint import fingerprint
from ..parallel import Progress, one_thread
from ..surviving import Lost, survived
from ..values import instance, positive, seed_sequence, short
from .study_table import StudyTable, checked_row, tabled

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
    timeout: float | None = None,
) -> StudyTable:
    """Return the results of a pipeline for each machine, as a table.

    A machine that raises, exits or returns something else than a row gets a row with its reason,
    the others go on. The table is the same to the bit whatever executes it: seeds belong to
    machines, linear algebra runs on one thread.

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
        plain loop. When a process of a pool dies, the rest goes on in as many processes started
        like its own (context, initializer); the machines that were out are tried once more, and
        one whose process dies again fails.
    checkpoint : path, optional
        A file that keeps each row as it comes. With a file that exists the study goes on where it
        was stopped, also after being killed: no machine that is in the file is computed again. It
        belongs to the values of the machines and to the code of the pipeline, with what it reaches
        in modules of yours: functions, classes, global values.
    rng : int, SeedSequence or Generator, optional
        From it a seed is spawned for each machine.
    progress : bool, optional
        A bar: None shows one on a terminal for work of more than two seconds.
    timeout : float [s], optional
        A machine that takes longer fails, and its process is ended; for a `ProcessPoolExecutor`,
        whose processes can be. Each machine then goes out alone, to processes started like those
        of the pool.

    Returns
    -------
    StudyTable
        A mapping of arrays by column, in the order of the machines. What only some rows have is
        missing in the others (NaN, False or ""), with a warning.

    Raises
    ------
    ModelError
        When there are no machines, the pipeline cannot be called, it returns something else than
        a mapping of numbers, truths and texts for the first machine, a timeout is given without a
        process pool, or the checkpoint is of another study.
    FlexplantError
        When the checkpoint cannot be written, or another study writes to it now.

    Examples
    --------
    >>> import flexplant as fx
    >>> def pipeline(machine):
    ...     return {"root": machine**0.5}
    >>> fx.study([4.0, 9.0], pipeline)["root"]
    array([2., 3.])
    """
    items = list(machines)
    if not items:
        raise ModelError("a study needs machines, got none. Give a sequence of them.")
    if not callable(pipeline):
        raise ModelError(
            f"pipeline must be callable, got {short(pipeline)}. Give a function of a machine that "
            "returns a mapping, or a MachinePipeline."
        )
    if timeout is not None:
        positive(timeout, "timeout")
        hint = "Only a process can be ended: pass a ProcessPoolExecutor, or leave timeout= out."
        instance(executor, ProcessPoolExecutor, "the executor of a study with a timeout", hint)
    source = None if rng is None else seed_sequence(rng)
    header: dict[str, Any] = {
        "machines": len(items),
        "rng": None if source is None else [source.entropy, list(source.spawn_key)],
    }
    if checkpoint is not None:
        header |= {"pipeline": fingerprint([pipeline]), "values of machines": fingerprint(items)}
    free = ("rng",) if isinstance(rng, np.random.Generator) else ()
    with (
        Checkpoint(checkpoint, "study", header, free) as log,
        Progress(len(items), "machines", progress=progress) as bar,
    ):
        seeds: list[Any] = [None] * len(items)
        if log.header["rng"] is not None:
            entropy, key = log.header["rng"]
            seeds = list(np.random.SeedSequence(entropy, spawn_key=tuple(key)).spawn(len(items)))
        left = [i for i in range(len(items)) if i not in log.rows]
        calls = {i: (pipeline, items[i], seeds[i]) for i in left}
        bar.advance(len(log.rows))
        for number, outcome in _outcomes(calls, executor, timeout):
            log.add(number, _kept(outcome, number))
            bar.advance()
        return tabled([log.rows[i] for i in range(len(items))])


def _outcomes(
    calls: Mapping[int, tuple[Any, ...]], executor: Executor | None, timeout: float | None
) -> Iterator[tuple[int, Any]]:
    if executor is not None:
        return survived(_outcome, calls, executor, timeout)
    return ((number, _outcome(*call)) for number, call in calls.items())


def _outcome(pipeline: Callable[..., Any], machine: Any, seed: Any) -> Outcome | ModelError:
    """Return the row of one machine, or why there is none; what is no row is an error."""
    try:
        with one_thread():
            if seed is None:
                found = pipeline(machine)
            else:
                found = pipeline(machine, np.random.default_rng(seed))
    except (Exception, SystemExit) as error:  # whatever it is, the other machines go on
        return _reason(error)
    try:
        return checked_row(found)
    except ModelError as error:
        return error


def _kept(outcome: Outcome | ModelError | Lost, number: int) -> Outcome:
    """Return a row or a reason; that the first machine has no row is an error of the pipeline."""
    if isinstance(outcome, ModelError):
        if number == 0:
            raise outcome
        return _reason(outcome)
    return outcome.reason if isinstance(outcome, Lost) else outcome


def _reason(error: BaseException) -> str:
    return f"{type(error).__name__}: {' '.join(str(error).split())}"

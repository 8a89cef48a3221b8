"""study: one pipeline over many machines, on any executor, resumed where it was stopped."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from concurrent.futures import Executor
from pathlib import Path
from typing import Any, TypeAlias

import numpy as np

from ..checkpoint import Checkpoint
from ..errors import ModelError
from ..fingerprint import fingerprint
from ..parallel import Progress, one_thread
from ..surviving import DIED, Died, survived
from ..values import seed_sequence, short
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
) -> StudyTable:
    """Return the results of a pipeline for each machine, as a table.

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
        for number, outcome in _outcomes(calls, executor):
            log.add(number, _kept(outcome))
            bar.advance()
        return tabled([log.rows[i] for i in range(len(items))])


def _outcomes(
    calls: Mapping[int, tuple[Any, ...]], executor: Executor | None
) -> Iterator[tuple[int, Any]]:
    if executor is not None:
        return survived(_outcome, calls, executor)
    return ((number, _outcome(*call)) for number, call in calls.items())


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


def _kept(outcome: Outcome | ModelError | Died) -> Outcome:
    """Return a row or a reason; what is an error of the pipeline is raised."""
    if isinstance(outcome, ModelError):
        raise outcome
    return DIED if isinstance(outcome, Died) else outcome

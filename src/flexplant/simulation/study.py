"""study: one pipeline over many machines, on any executor, resumed where it was stopped."""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from concurrent.futures import Executor, ProcessPoolExecutor
from dataclasses import dataclass
from pathlib import Path
from typing import Any, TypeAlias

import numpy as np
import numpy.typing as npt

from ..checks import Value, instance, positive, seed_sequence, short
from ..errors import ModelError, counted, require_known, warn
from ..fingerprint import fingerprint
from ..parallel import Lost, Progress, one_thread, survived
from ..work import Checkpoint

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
    items = list(instance(machines, Iterable, "machines", "Give a sequence of them."))
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
        Progress(len(items), "machines", progress=progress, advice=_ADVICE) as bar,
    ):
        seeds: list[Any] = [None] * len(items)
        if log.header["rng"] is not None:
            entropy, key = log.header["rng"]
            seeds = list(np.random.SeedSequence(entropy, spawn_key=tuple(key)).spawn(len(items)))
        left = [i for i in range(len(items)) if i not in log.rows]
        calls = {i: (pipeline, items[i], seeds[i]) for i in left}
        bar.advance(len(log.rows), known=True)
        for number, outcome in _outcomes(calls, executor, timeout):
            log.add(number, _kept(outcome, number))
            bar.advance()
        return tabled([log.rows[i] for i in range(len(items))])


_ADVICE = "Fewer machines or executor=ProcessPoolExecutor() help; checkpoint= keeps the rows."


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
        return _error_text(error)
    try:
        return checked_row(found)
    except ModelError as error:
        return error


def _kept(outcome: Outcome | ModelError | Lost, number: int) -> Outcome:
    """Return a row or a reason; that the first machine has no row is an error of the pipeline."""
    if isinstance(outcome, ModelError):
        if number == 0:
            raise outcome
        return _error_text(outcome)
    return outcome.reason if isinstance(outcome, Lost) else outcome


def _error_text(error: BaseException) -> str:
    return f"{type(error).__name__}: {' '.join(str(error).split())}"


#: reasons that the repr lists
_SHOWN = 3
#: what stands for a missing number, truth or text, and what each is called
_MISSING: dict[type, Any] = {float: np.nan, bool: False, str: ""}
_CALLED = {float: "number", bool: "truth", str: "text"}


@dataclass(frozen=True, eq=False, repr=False)
class StudyTable(Value, Mapping[str, npt.NDArray[Any]]):
    """Results by column, ``table["MA"]`` of shape (n_machines,); ``pandas.DataFrame(dict(table))``.

    Where a machine failed or lacks a column, numbers are NaN, texts empty and truths False; the
    column "failed" holds the reason, empty otherwise.

    Parameters
    ----------
    columns : mapping {str: (n,) array}
        Of numbers, truths or texts.
    failed : sequence of str
        Why each machine has no results; "" where it has.

    Examples
    --------
    >>> import flexplant as fx
    >>> def pipeline(machine):
    ...     return {"root": machine**0.5}
    >>> table = fx.study([4.0, 9.0], pipeline)
    >>> sorted(table)
    ['failed', 'root']
    """

    columns: Mapping[str, npt.NDArray[Any]]
    failed: tuple[str, ...]

    def __getitem__(self, name: str) -> npt.NDArray[Any]:
        if isinstance(name, str) and name == "failed":
            return np.array(self.failed, dtype=np.str_)
        require_known("column", [name], self)
        return self.columns[name]

    def __iter__(self) -> Iterator[str]:
        yield from (*self.columns, "failed")

    def __len__(self) -> int:
        return len(self.columns) + 1

    def __repr__(self) -> str:
        reasons = [(i, reason) for i, reason in enumerate(self.failed) if reason]
        lines = [f"<StudyTable: {counted(len(self.failed), 'machine')}, {len(reasons)} failed>"]
        width = max((len(name) for name in self.columns), default=0) + 2
        numeric = {n: c for n, c in self.columns.items() if c.dtype.kind == "f"}
        if numeric:
            lines.append(f"  {'':{width}s}{'5 %':>10s}{'median':>10s}{'95 %':>10s}")
        for name, column in numeric.items():
            known = column[np.isfinite(column)]
            shown = np.quantile(known, (0.05, 0.5, 0.95)) if known.size else np.full(3, np.nan)
            lines.append(f"  {name:{width}s}" + "".join(f"{value:10.4g}" for value in shown))
        done = np.array([not reason for reason in self.failed])
        for name, column in self.columns.items():
            if column.dtype.kind == "b":
                lines.append(f"  {name:{width}s}{np.count_nonzero(column[done])} of {done.sum()}")
        lines += [f"  machine {i}: {reason}" for i, reason in reasons[:_SHOWN]]
        if len(reasons) > _SHOWN:
            lines.append(f"  and {len(reasons) - _SHOWN} more that failed")
        return "\n".join(lines)


def tabled(rows: Sequence[Mapping[str, Any] | str]) -> StudyTable:
    """Return the table of rows; a text in place of a row is the reason why there is none.

    A row whose value is of another kind than most in its column counts as failed.
    """
    found = [row for row in rows if not isinstance(row, str)]
    kinds: dict[str, type] = {}
    for name in dict.fromkeys(name for row in found for name in row):
        counts = Counter(type(row[name]) for row in found if name in row)
        kinds[name] = counts.most_common(1)[0][0]
    judged = [row if isinstance(row, str) else _row_misfit(row, kinds) or row for row in rows]
    lacking = {
        i: [name for name in kinds if name not in row]
        for i, row in enumerate(judged)
        if not isinstance(row, str) and len(row) < len(kinds)
    }
    if lacking:
        names = ", ".join(map(repr, dict.fromkeys(n for few in lacking.values() for n in few)))
        warn(
            f"{counted(len(lacking), 'machine')} of {len(rows)} (number {min(lacking)} first) lack "
            f"columns that others have: {names}. There the table has NaN, False or ''. Return the "
            "same names for all of them."
        )
    columns = {
        name: np.array([none if isinstance(row, str) else row.get(name, none) for row in judged])
        for name, none in ((name, _MISSING[kind]) for name, kind in kinds.items())
    }
    return StudyTable(columns, tuple(row if isinstance(row, str) else "" for row in judged))


def _row_misfit(row: Mapping[str, Any], kinds: Mapping[str, type]) -> str:
    """Return why a row does not fit into a table; "" when it does."""
    for name, value in row.items():
        if type(value) is not kinds[name]:
            return (
                f"column {name!r} holds {short(value)}, a {_CALLED[type(value)]}: most machines "
                f"have a {_CALLED[kinds[name]]} there"
            )
    return ""


def checked_row(row: Any) -> dict[str, Any]:
    """Return what a pipeline returned as plain numbers, truths and texts."""
    instance(row, Mapping, "what the pipeline returns", "Return {column: number, truth or text}.")
    plain: dict[str, Any] = {}
    for name, value in row.items():
        if not isinstance(name, str) or name == "failed":
            raise ModelError(f"{name!r} cannot be the name of a column. Use another text.")
        if isinstance(value, bool | np.bool_):
            plain[name] = bool(value)
        elif isinstance(value, str):
            plain[name] = str(value)
        elif isinstance(value, int | float | np.integer | np.floating):
            plain[name] = float(value)
        else:
            raise ModelError(
                f"column {name!r} holds {short(value)}: a table has one number, truth or text for "
                "each machine. Return several columns, or save arrays to files of your own."
            )
    return plain

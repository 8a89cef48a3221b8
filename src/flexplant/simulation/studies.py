"""Tables: one pipeline over many machines, with resume; comparison of estimators."""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from concurrent.futures import Executor
from dataclasses import dataclass
from pathlib import Path
from typing import Any, TypeAlias

import numpy as np
import numpy.typing as npt

from ..arrays import FloatArray, instance, mapping, seed_sequence
from ..errors import (
    SHOWN,
    LabelError,
    ModelError,
    aligned,
    counted,
    require_known,
    short,
    unknown_label,
    warn,
)
from ..estimation import KalmanEstimator, StaticEstimator
from ..estimation.error import estimates, row_of
from ..estimation.filter_models import poi_channels
from ..fingerprints import fingerprint
from ..lti.statespace import StateSpace
from ..parallel import Lost, Progress, one_thread, survived
from ..store import Value
from ..work import Checkpoint
from .response import Response

#: a row of the table, or the reason why it is missing
Outcome: TypeAlias = Mapping[str, Any] | str


def study(
    machines: Sequence[Any],
    pipeline: Callable[..., Mapping[str, Any]],
    *,
    executor: Executor | None = None,
    checkpoint: str | Path | None = None,
    rng: Any = None,
    progress: bool | None = None,
    key: str = "",
) -> StudyTable:
    """Return a table with the results of a pipeline, which is run for each machine.

    If the pipeline of a machine raises an error, exits or does not return a row, the row of this
    machine contains the reason, and the other machines continue. The table is equal to the last bit
    for every executor, because each machine has its own seed and linear algebra uses one thread.

    Parameters
    ----------
    machines : sequence
        Inputs of the pipeline, one for each row: virtual machines, measurements or parameters.
    pipeline : callable
        Function called as ``pipeline(machine)``, or as ``pipeline(machine, generator)`` when rng is
        given. It returns a mapping {column: number, truth value or text}. A process pool must be
        able to pickle it: it is a function of a module, or a `functools.partial` of one.
        `examples/fleet.py` has the usual chain.
    executor : concurrent.futures.Executor, optional
        A process pool, `dask.distributed`'s `Client.get_executor()`, or an executor of
        `mpi4py.futures`. With None the machines are computed one after another in this process.
        When a process of a pool dies, its machines are tried again one by one. A machine whose
        process dies again gets a row with the reason. The others continue in a new pool with the
        same settings (context, initializer).
    checkpoint : path, optional
        File that stores each finished row. With an existing file, an interrupted study continues:
        machines in the file are not computed again. The file is only accepted for the same values
        of the machines, the same name of the pipeline (with the arguments of a partial) and the
        same `key`.
    rng : int, SeedSequence or Generator, optional
        Seed from which a separate seed is derived for each machine.
    progress : bool, optional
        Whether to show a progress bar. By default (None) it is shown on a terminal for work of more
        than two seconds.
    key : str
        Name of this study in its checkpoint. The code of the pipeline is not compared. Therefore
        give another key when you change the code.

    Returns
    -------
    StudyTable
        Mapping from each column to an array, in the order of the machines. If only some rows have a
        column, its entries in the others are NaN, False or "", and a warning is given.

    Raises
    ------
    ModelError
        When `machines` is empty, the pipeline cannot be called, its result for the first machine is
        not a mapping of numbers, truth values and texts, or the checkpoint belongs to another
        study.
    FlexplantError
        When the checkpoint cannot be written, or another study is writing to it.

    Examples
    --------
    >>> import flexplant as fx
    >>> def pipeline(machine):
    ...     return {"root": machine**0.5}
    >>> table = fx.study([4.0, 9.0], pipeline)
    >>> sorted(table), table["root"]
    (['failed', 'root'], array([2., 3.]))
    """
    items = list(instance(machines, Iterable, "machines", "Give a sequence of them."))
    if not items:
        raise ModelError("a study needs machines, got an empty sequence. Give at least one.")
    if not callable(pipeline):
        raise ModelError(
            f"pipeline must be callable, got {short(pipeline)}. Give a function of a machine that "
            "returns a mapping."
        )
    instance(key, str, "key", "Give a text that names this study.")
    source = None if rng is None else seed_sequence(rng)
    header: dict[str, Any] = {
        "machines": len(items),
        "rng": None if source is None else [source.entropy, list(source.spawn_key)],
    }
    if checkpoint is not None:
        header |= {"key": key, "pipeline": fingerprint([pipeline])}
        header |= {"values of machines": fingerprint(items)}
    free = ("rng",) if isinstance(rng, np.random.Generator) else ()
    with (
        Checkpoint(checkpoint, "study", header, free) as log,
        Progress(len(items), "machines", progress=progress, advice=_ADVICE) as bar,
    ):
        seeds: list[Any] = [None] * len(items)
        if log.header["rng"] is not None:
            entropy, spawned = log.header["rng"]
            seeds = list(
                np.random.SeedSequence(entropy, spawn_key=tuple(spawned)).spawn(len(items))
            )
        calls = {i: (pipeline, item, seeds[i]) for i, item in enumerate(items) if i not in log.rows}
        bar.advance(len(log.rows), known=True)
        outcomes: Iterator[tuple[int, Any]]
        outcomes = ((number, _outcome(*call)) for number, call in calls.items())
        if executor is not None:
            outcomes = survived(_outcome, calls, executor)
        for number, outcome in outcomes:
            log.add(number, _kept(outcome, number))
            bar.advance()
        return tabled([log.rows[i] for i in range(len(items))])


_ADVICE = "Fewer machines or executor=ProcessPoolExecutor() help; checkpoint= keeps the rows."


def _outcome(pipeline: Callable[..., Any], machine: Any, seed: Any) -> Outcome | ModelError:
    """Return the row of one machine, or the reason why it is missing."""
    try:
        with one_thread():
            if seed is None:
                found = pipeline(machine)
            else:
                found = pipeline(machine, np.random.default_rng(seed))
    except (Exception, SystemExit) as error:  # for any error the other machines continue
        return _error_text(error)
    try:
        return checked_row(found)
    except ModelError as error:
        return error


def _kept(outcome: Outcome | ModelError | Lost, number: int) -> Outcome:
    """Return a row or a reason; a missing row of the first machine is an error of the pipeline."""
    if isinstance(outcome, ModelError):
        if number == 0:
            raise outcome
        return _error_text(outcome)
    return outcome.reason if isinstance(outcome, Lost) else outcome


def _error_text(error: BaseException) -> str:
    return f"{type(error).__name__}: {' '.join(str(error).split())}"


#: value of a missing number, truth or text, and its name
_MISSING: dict[type, Any] = {float: np.nan, bool: False, str: ""}
_CALLED = {float: "number", bool: "truth", str: "text"}
#: types that become each of these, truth before number
_PLAIN: dict[type, Any] = {
    bool: bool | np.bool_,
    str: str,
    float: int | float | np.integer | np.floating,
}


@dataclass(frozen=True, eq=False, repr=False)
class StudyTable(Value, Mapping[str, npt.NDArray[Any]]):
    """Results of a study by column. ``table["MA"]`` is an array of shape (n_machines,).

    ``pandas.DataFrame(dict(table))`` makes a data frame. If a machine failed or lacks a column, its
    numbers are NaN, its texts are empty and its truth values are False. The column "failed" holds
    the reason of a failure, and is empty otherwise.

    Parameters
    ----------
    columns : mapping {str: (n,) array}
        Columns of numbers, truth values or texts.
    failed : sequence of str
        Reason why each machine has no results; "" if it has results.
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
        done, rows, said = np.array([not reason for reason in self.failed]), [], []
        for name, column in self.columns.items():
            if column.dtype.kind == "f":
                known = column[np.isfinite(column)]
                shown = np.quantile(known, (0.05, 0.5, 0.95)) if known.size else np.full(3, np.nan)
                rows.append((name, *(f"{value:.4g}" for value in shown)))
            elif column.dtype.kind == "b":
                said.append(f"{name}  {np.count_nonzero(column[done])} of {done.sum()}")
        numbers = aligned(("", "5 %", "median", "95 %"), rows) if rows else []
        lines += [f"  {line}" for line in (*numbers, *said)]
        lines += [f"  machine {i}: {reason}" for i, reason in reasons[:SHOWN]]
        if len(reasons) > SHOWN:
            lines.append(f"  and {len(reasons) - SHOWN} more that failed")
        return "\n".join(lines)


def tabled(rows: Sequence[Mapping[str, Any] | str]) -> StudyTable:
    """Return the table of rows; a text in place of a row is the reason why it is missing."""
    # a row whose value is of another kind than most in its column counts as failed
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
    """Return the reason why a row does not fit into a table, or ""."""
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
    found: dict[str, Any] = {}
    for name, value in row.items():
        if not isinstance(name, str) or name == "failed":
            raise ModelError(f"{name!r} cannot be the name of a column. Use another text.")
        kind = next((plain for plain, given in _PLAIN.items() if isinstance(value, given)), None)
        if kind is None:
            raise ModelError(
                f"column {name!r} holds {short(value)}: a table has one number, truth or text for "
                "each machine. Return several columns, or save arrays to separate files."
            )
        found[name] = kind(value)
    return found


Estimator = KalmanEstimator | StaticEstimator


@dataclass(frozen=True, eq=False, repr=False)
class EstimatorComparison(Value):
    """Predicted and measured rms errors of several estimators; prints as a table.

    This is the result of `compare_estimators`.

    Parameters
    ----------
    channel : str
        Name of the estimated motion.
    names : sequence of str
        Names of the estimators.
    errors : (n, 4) array [m or rad]
        Four columns: the predicted error, the measured error, and the lower and upper end of the
        confidence interval of the measured error.
    level : float
        Probability of the interval.
    """

    channel: str
    names: tuple[str, ...]
    errors: FloatArray
    level: float

    def __getitem__(self, name: str) -> FloatArray:
        require_known("estimator", [name], self.names)
        found: FloatArray = self.errors[self.names.index(name)]
        return found

    def __repr__(self) -> str:
        unit = "nrad" if self.channel.rpartition(":")[2].startswith("r") else "nm"
        shown = [[f"{value:.3f}" for value in row] for row in 1e9 * self.errors]
        rows = [
            (name, *both, f"{low} to {high}")
            for name, (*both, low, high) in zip(self.names, shown, strict=True)
        ]
        table = aligned(("", "predicted", "measured", f"{self.level:.0%} interval"), rows)
        return "\n".join([f"rms error of the estimate of {self.channel} [{unit}]", *table])


def reading_along(designs: Mapping[str, Estimator]) -> tuple[StateSpace, ...]:
    """Return estimators as blocks that read the signals of a loop but do not influence it.

    Parameters
    ----------
    designs : mapping {name: KalmanEstimator or StaticEstimator}
        Estimators by name. The names of their estimates begin with this name: the design "updated"
        gives `updated|die:hat`.

    Returns
    -------
    tuple of StateSpace
        Blocks for `close_loop` or `simulate`, in addition to the controllers.

    Raises
    ------
    ModelError
        When `designs` is not a mapping of estimators.

    Examples
    --------
    >>> import flexplant as fx
    >>> plant = fx.testbeds.three_masses()
    >>> designs = {"static": fx.design_static(plant), "filter": fx.design_kalman(plant)}
    >>> [output for block in fx.simulation.reading_along(designs) for output in block.outputs]
    ['static|die:hat', 'filter|die:hat']
    """
    mapping(designs, "designs", "Pass {'updated': design_kalman(plant)}.", least=1, kind=Estimator)
    return tuple(
        design.system.renamed(outputs={hat: f"{name}|{hat}" for hat in design.system.outputs})
        for name, design in designs.items()
    )


def compare_estimators(
    designs: Mapping[str, Estimator],
    run: Response,
    channel: str,
    *,
    start: float = 0.0,
    level: float = 0.95,
) -> EstimatorComparison:
    """Return the predicted errors of estimators, and the errors measured in runs of a machine.

    Parameters
    ----------
    designs : mapping {name: KalmanEstimator or StaticEstimator}
        Estimators by name, the same as for `reading_along`.
    run : Response
        Two or more runs of a loop that contains the estimators and the motion of the POI.
    channel : str
        Motion of the POI (point of interest) that is estimated, such as `die:z`.
    start : float [s]
        Start time; earlier samples (transients) are left out.
    level : float
        Probability of the confidence intervals (`Response.rms_interval`).

    Returns
    -------
    EstimatorComparison

    Raises
    ------
    ModelError
        When `designs` is not a mapping of estimators, or only one run is given.
    LabelError
        When the run lacks the motion or an estimate of it.

    Examples
    --------
    >>> import flexplant as fx
    >>> plant = fx.testbeds.three_masses()
    >>> designs = {"static": fx.design_static(plant), "filter": fx.design_kalman(plant)}
    >>> servo = fx.design_servo(plant, bandwidth=20.0, observer=designs["filter"])
    >>> loop = fx.close_loop(plant, designs["filter"], servo, *fx.simulation.reading_along(designs))
    >>> run = fx.simulate(loop, duration=0.5, rng=1, runs=5)
    >>> found = fx.simulation.compare_estimators(designs, run, "die:x", start=0.2)
    >>> bool(found["filter"][1] < found["static"][1])  # measured
    True
    """
    hint = "Pass {'updated': design_kalman(plant)}."
    mapping(designs, "designs", hint, least=1, kind=Estimator)
    instance(run, Response, "run", "Pass what simulate returned.")
    rows = []
    for name, design in designs.items():
        channels = poi_channels(design.plant)
        hat = f"{name}|{estimates(channels)[row_of(channels, channel)]}"
        for wanted in (channel, hat):
            if wanted not in run:
                raise LabelError(
                    f"{unknown_label('channel', wanted, list(run))} Estimators read along in a "
                    "loop as blocks: close_loop(plant, *blocks, "
                    "*fx.simulation.reading_along(designs))."
                )
        error = run[channel] - run[hat]
        seen = run.replace(data=error[..., None, :], names=["error"], units={})
        rows.append((design.rms(channel), *seen.rms_interval("error", start=start, level=level)))
    return EstimatorComparison(channel, tuple(designs), np.array(rows), level)

"""The table of a study: one row for each machine, a column for each result."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import numpy.typing as npt

from ..errors import ModelError, counted, require_known, warn
from ..values import Value, instance, short

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

    def __post_init__(self) -> None:
        self._set(columns=dict(self.columns), failed=tuple(self.failed))

    def __getitem__(self, name: str) -> npt.NDArray[Any]:
        if name == "failed":
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
    judged = [row if isinstance(row, str) else _misfit(row, kinds) or row for row in rows]
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


def _misfit(row: Mapping[str, Any], kinds: Mapping[str, type]) -> str:
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

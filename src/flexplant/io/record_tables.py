"""Records in text: tables of loggers, and LabVIEW measurement files."""

from __future__ import annotations

import re
from collections.abc import Iterator
from pathlib import Path
from typing import NamedTuple

import numpy as np

from ..arrays import FloatArray
from ..errors import FlexplantError, ModelError
from ..tolerances import NEGLIGIBLE
from .files import damaged, decimal, numbers_of_lines, refused, text_of, unread, wrong_line_of
from .unit_labels import plain_label, seconds_of, unit_of

_TIME = {"time", "t", "zeit", "seconds", "sec", "x_value", "x-value", "timestamp", "elapsed time"}
#: a name with its unit in brackets
_UNIT = re.compile(r"(.*?)\s*[\[(]([^\[\]]*)[\])]")
_RATE = re.compile(
    r"(?:sampl\w*[\s_-]*(?:rate|freq\w*)|\bfs\b)[^0-9\n]*?([0-9][0-9.,eE+]*)\s*(k?)(?:hz)?",
    re.IGNORECASE,
)
#: ratio of a step to the usual step above which samples are missing; rounding of the times to two
#: digits gives ratios up to 1.5
_GAP = 1.75


class RecordedChannels(NamedTuple):
    """Names, labels of units and data (n, n_time) of each run; the rate where the file says it."""

    names: list[str]
    labels: list[str]
    runs: list[FloatArray]
    rate: float | None
    start: float = 0.0


def read_table_records(path: Path) -> RecordedChannels:
    """Return the channels of a table with the names of its columns above the numbers."""
    lines = text_of(path).splitlines()
    first, mark = _first_numbers(lines, path)
    width = len(_cells(lines[first], mark))
    above = [row for line in lines[:first] if (row := _titles(line, mark, width))][-2:]
    if not above:
        what = f"has {width} columns from line {first + 1} on and no names above them"
        raise refused(path, what, "Write a line with a name for each.")
    parted = [_name_and_unit(cell) for cell in above[-1]]
    named, below = ([_is_unit(cell) for cell in row] for row in (above[0], above[-1]))
    if sum(below) > sum(named):
        parted = [(name.strip(), unit) for name, unit in zip(*above, strict=True)]
    table = _table(lines[first:], first, width, mark, path)
    rate, start = None, 0.0
    found = _RATE.search("\n".join(lines[:first]))
    if found is not None:
        rate = decimal(found[1].replace(",", ".")) * (1e3 if found[2] else 1.0)
    name, unit = parted[0]
    seconds = seconds_of(unit)
    if name.lower() in _TIME and seconds is not None:
        rate, start = _even_rate(seconds * table[:, 0], path, first)
        parted, table = parted[1:], table[:, 1:]
    if not parted:
        raise refused(path, "holds times and no channel", "Export the channels with them.")
    names = [name for name, _ in parted]
    return RecordedChannels(names, [unit for _, unit in parted], [table.T], rate, start)


def _first_numbers(lines: list[str], path: Path) -> tuple[int, str]:
    """Return the first of two lines with equal numbers of values, and their separator."""
    for mark in (";", "\t", ",", ""):
        widths = [_numbers_in(line, mark) for line in lines[:_HEAD]]
        for place, width in enumerate(widths[:-1]):
            if width and width == widths[place + 1] and (width > 1 or not mark):
                return place, mark
    raise refused(
        path,
        "holds no two lines of numbers one below the other",
        "Export a table: names in one line, numbers below, times in seconds.",
    )


#: number of lines within which the numbers must begin
_HEAD = 500


def _numbers_in(line: str, mark: str) -> int:
    cells = _cells(line, mark)
    try:
        for cell in cells:
            decimal(_point(cell, mark))
    except ValueError:
        return 0
    return len(cells)


def _cells(line: str, mark: str) -> list[str]:
    """Return the cells of a line; a mark at its end closes the last one."""
    cells = line.split(mark) if mark else line.split()
    cells = [cell.strip().strip('"') for cell in cells]
    return cells[:-1] if mark and len(cells) > 1 and not cells[-1] else cells


def _titles(line: str, mark: str, width: int) -> list[str]:
    """Return the cells of a line of titles; empty if their number is not that of the columns."""
    cells = [cell.strip().strip('"') for cell in (line.split(mark) if mark else line.split())]
    ends = len(cells) == width + 1 and not cells[-1]
    return cells[:width] if (len(cells) == width or ends) and any(cells) else []


def _point(text: str, mark: str) -> str:
    return text if mark == "," else text.replace(",", ".")


def _table(lines: list[str], first: int, width: int, mark: str, path: Path) -> FloatArray:
    """Return the numbers (n, width) of the lines behind the first ones."""
    body = [" ".join(_cells(_point(line, mark), mark)) for line in lines]

    def wrong(place: int, _: bytes) -> FlexplantError:
        due = f"{width} numbers are"
        do = "Complete it, or cut the file off before it."
        return wrong_line_of(path, first + place + 1, due, lines[place], do)

    return numbers_of_lines("\n".join(body).encode("latin-1", "replace"), width, wrong)


def _name_and_unit(cell: str) -> tuple[str, str]:
    match = _UNIT.fullmatch(cell)
    return (match[1], match[2]) if match and match[1] else (cell, "")


def _is_unit(cell: str) -> bool:
    label = plain_label(cell.strip("()"))
    return bool(label) and (unit_of(label) is not None or seconds_of(label) is not None)


def _even_rate(time: FloatArray, path: Path, first: int) -> tuple[float, float]:
    """Return the rate [Hz] of times in equal steps, and the first one."""
    if time.size < 2:
        raise damaged(path, "holds one sample")
    step, steps = (time[-1] - time[0]) / (time.size - 1), np.diff(time)
    off = np.abs(time - time[0] - step * np.arange(time.size))
    digits = next((n for n in range(16) if np.allclose(time, np.round(time, n), 0, 1e-13)), 16)
    gap = steps.min() <= 0 or steps.max() > _GAP * np.median(steps)
    if gap or off.max() > 10.0**-digits + NEGLIGIBLE * step:
        k = int(np.argmax(np.abs(steps - np.median(steps))))
        raise ModelError(
            f"{str(path)!r} was not sampled in equal steps: {np.median(steps):.6g} s, and "
            f"{steps[k]:.6g} s before line {first + k + 2}. Fill the gap, or leave out the column "
            "of times and say rate=... where they are those of a clock that jitters."
        )
    # rates are usually round numbers, but rounded times give slightly different ones
    rate, doubt = 1.0 / float(step), 10.0**-digits / float(time[-1] - time[0])
    round_ones = (round(rate, -n) for n in range(6, -1, -1))
    near = (one for one in round_ones if abs(one / rate - 1.0) <= doubt)
    return next(near, rate), float(time[0])


_END = "***End_of_Header***"


def read_lvm(path: Path) -> RecordedChannels:
    """Return the channels of a LabVIEW measurement file, its segments joined or taken as runs."""
    lines = text_of(path).splitlines()
    ends = [place for place, line in enumerate(lines) if line.strip().startswith(_END)]
    if not lines or not lines[0].startswith("LabVIEW Measurement") or len(ends) < 2:
        what = "is not a LabVIEW measurement file with the headers of the file and of its channels"
        raise refused(path, what, "Write it with headers, or export a table.")
    comma = any(line.startswith("Separator") and "Comma" in line for line in lines[: ends[0]])
    mark = "," if comma else "\t"
    said = _entries(lines[: ends[0]], mark)
    point = said.get("Decimal_Separator", ["."])[0]
    columns = said.get("X_Columns", ["One"])[0]
    segments = list(_segments(lines, ends, mark, point, columns, path))
    names, labels, dt = segments[0][:3]
    if any(one[:3] != segments[0][:3] for one in segments):
        what = "holds segments of different channels, units or rates"
        raise refused(path, what, "Write each into its own file.")
    runs: list[FloatArray] = []
    due = np.nan
    for *_, x0, data in segments:
        if runs and abs(x0 - due) < 0.5 * dt:
            runs[-1] = np.hstack([runs[-1], data])
        else:
            runs.append(data)
        due = x0 + dt * data.shape[1]
    return RecordedChannels(names, labels, runs, 1.0 / dt, segments[0][3])


def _entries(lines: list[str], mark: str) -> dict[str, list[str]]:
    cells = ([cell.strip() for cell in line.split(mark)] for line in lines)
    return {row[0]: row[1:] for row in cells if row}


def _segments(
    lines: list[str], ends: list[int], mark: str, point: str, columns: str, path: Path
) -> Iterator[tuple[list[str], list[str], float, float, FloatArray]]:
    """Yield names, labels of units, step, first time and data (n, n_time) of each segment."""
    for before, end, after in zip(ends, ends[1:], [*ends[2:], None], strict=False):
        said = _entries(lines[before + 1 : end], mark)
        try:
            count, samples = int(said["Channels"][0]), int(said["Samples"][0])
            dt, x0 = (decimal(said[key][0].replace(point, ".")) for key in ("Delta_X", "X0"))
        except (KeyError, IndexError, ValueError) as error:
            raise damaged(path, f"line {end + 1}: a header of channels lacks {error}") from None
        over = "".join(said.get("X_Dimension", ["Time"])[:1]) or "Time"
        if over != "Time" or dt <= 0:
            what = f"holds channels over {over} in steps of {dt:g}"
            raise unread(path, what, "Write the samples over time.")
        rows = lines[end + 2 : after] if 0 < samples <= len(lines) else []
        if len(rows) < samples or not rows:
            raise damaged(path, f"line {end + 2}: {samples} samples are expected, fewer follow")
        picked = slice(1, None, 2 if columns == "Multi" else 1)
        names = [name.strip() for name in lines[end + 1].split(mark)[picked][:count]]
        labels = [*said.get("Y_Unit_Label", []), *[""] * len(names)][: len(names)]
        if len(names) != count or not count:
            raise damaged(path, f"line {end + 2}: {count} names of channels are expected")
        data = np.empty((count, samples))
        for k, row in enumerate(rows[:samples]):
            cells = row.split(mark)[picked][:count]
            try:
                data[:, k] = [decimal(cell.replace(point, ".")) for cell in cells]
            except ValueError:
                due = f"numbers of {count} channels are"
                raise wrong_line_of(path, end + 3 + k, due, row) from None
        yield names, labels, dt, x0, data

"""The columns of a set of DOFs: nodes, directions, coordinates; from a table too."""

from __future__ import annotations

import csv
from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import Any

import numpy as np

from .errors import LabelError
from .values import FloatArray, IntArray, check_names, name_list, short

_COLUMNS = ("node", "direction", "x", "y", "z")
#: node numbers stay exact as floats, and their keys in 64 bits
LARGEST_NODE = 2**53


def columns_of(
    table: str | Path | Iterable[Mapping[str, Any]],
) -> tuple[IntArray, tuple[str, ...], FloatArray]:
    """Return nodes (n,), directions and coordinates (n, 3) [m] of a table or a CSV file."""
    if isinstance(table, str | Path):
        with open(table, newline="", encoding="utf-8") as file:
            rows: list[Mapping[str, Any]] = list(csv.DictReader(file))
    else:
        rows = listed(table, "a DOF table", "a CSV file or a list of mappings")
    if not rows or not all(isinstance(row, Mapping) for row in rows):
        raise LabelError(
            "a DOF table needs rows with columns node, direction, x, y, z, got "
            f"{f'a {type(rows[0]).__name__} as its first row' if rows else 'no row'}. "
            "The first line of a CSV file names its columns."
        )
    missing = [c for c in _COLUMNS if any(row.get(c) is None for row in rows)]
    if missing:
        raise LabelError(
            f"a DOF table needs rows with columns {', '.join(_COLUMNS)}; missing: {missing}. "
            "Name the columns so; where a line is cut short, complete it."
        )
    return (
        node_numbers([_number(row, "node", i) for i, row in enumerate(rows)]),
        tuple(str(row["direction"]).strip() for row in rows),
        np.array([[_number(row, c, i) for c in "xyz"] for i, row in enumerate(rows)]),
    )


def _number(row: Mapping[str, Any], column: str, line: int) -> float:
    try:
        return float(row[column])
    except (TypeError, ValueError):
        raise LabelError(
            f"column {column!r} of the DOF table holds {row[column]!r:.60} in row {line} (from 0), "
            "which is no number. Write it with a decimal point and no unit; coordinates are [m]."
        ) from None


def listed(items: Any, name: str, form: str) -> list[Any]:
    """Return items as a list; LabelError when there is nothing to list."""
    if not isinstance(items, Iterable):
        raise LabelError(f"{name} must be {form}, got {items!r:.60}. Pass it in [...].")
    return list(items)


def node_numbers(nodes: Any) -> IntArray:
    """Return node numbers as int64; LabelError when one is not whole or too large."""
    try:
        numbers = np.asarray(nodes if isinstance(nodes, np.ndarray) else list(nodes))
        with np.errstate(invalid="ignore"):  # NaN is refused below
            whole = numbers.astype(np.int64)
    except (TypeError, ValueError, OverflowError):
        numbers, whole = np.zeros(1), np.ones(1, dtype=np.int64)
    if numbers.dtype == bool or np.any(whole != numbers) or np.any(abs(whole) > LARGEST_NODE):
        raise LabelError(
            f"node numbers must be whole numbers, got {nodes!r:.80}. Give the nodes numbers, from "
            "1 say, and keep the foreign program's names elsewhere."
        )
    return np.asarray(whole, dtype=np.int64)


def direction_names(directions: Any) -> tuple[str, ...]:
    """Return directions as a tuple of str; LabelError for a single one."""
    if isinstance(directions, str):
        raise LabelError(
            f"directions must be one for each DOF, got the single {directions!r}: write "
            f"[{directions!r}] * n."
        )
    # the million of a large model are strings already, and few different ones
    given = tuple(listed(directions, "directions", "a list with one for each DOF"))
    try:
        if all(type(d) is str for d in set(given)):
            return given
    except TypeError:
        pass
    return tuple(str(direction) for direction in given)


def component_columns(
    names: Any, owners: Any, count: int
) -> tuple[tuple[str, ...], IntArray | None]:
    """Return the names of components and which of them (count,) each DOF belongs to."""
    listed_names = name_list(names, "components")
    if owners is None and not listed_names:
        return (), None
    check_names(listed_names, "components")
    wrong = [name for name in listed_names if ":" in name or name != name.strip(" /")]
    if wrong:
        raise LabelError(
            f"{wrong[0]!r} cannot name a component: labels are 'stage/41:z', so that names hold no "
            "':' and neither begin nor end with '/' or a blank. Rename it."
        )
    numbers = np.zeros(0, dtype=np.int64) if owners is None else node_numbers(owners)
    if numbers.shape != (count,) or not np.all((numbers >= 0) & (numbers < len(listed_names))):
        raise LabelError(
            f"component_of must hold the number (from 0) of one of the {len(listed_names)} "
            f"components for each of the {count} DOFs, got {short(owners)}."
        )
    return listed_names, numbers


def at_nodes(wanted: IntArray, known: IntArray, xyz: FloatArray, source: str) -> FloatArray:
    """Return the coordinates (n, 3) of some nodes out of a table of all."""
    numbers, count = np.unique(known, return_counts=True)
    if numbers.size < known.size:
        first, again = np.flatnonzero(known == numbers[np.argmax(count > 1)])[:2] + 1
        raise LabelError(
            f"{source!r} defines node {int(known[again - 1])} twice, as its nodes {first} and "
            f"{again}: which place holds is not known. Remove the one of another model."
        )
    missing = np.setdiff1d(wanted, known)
    if missing.size:
        raise LabelError(
            f"{source!r} has no coordinates for nodes {missing[:6].tolist()} ({missing.size} in "
            "all). Is it the table of the same model?"
        )
    order = np.argsort(known, kind="stable")
    return np.asarray(xyz[order[np.searchsorted(known[order], wanted)]], dtype=np.float64)

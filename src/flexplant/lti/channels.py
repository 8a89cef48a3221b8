"""Channels of a system chosen by name, number or slice."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from typing import TypeAlias

import numpy as np

from ..errors import LabelError, unknown_label
from ..values import IntArray
from .joining import short_list

#: what selects channels: a name or number, several, or a slice
Channels: TypeAlias = "str | int | slice | Sequence[str | int]"


def chosen_names(known: Sequence[str], key: Channels, side: str) -> list[str]:
    """Return the names that a name, a number, several or a slice selects."""
    if isinstance(key, slice):
        return list(known[key])
    several = [key] if isinstance(key, str | int | np.integer) else list(key)
    for item in several:
        if isinstance(item, int | np.integer) and not -len(known) <= item < len(known):
            raise LabelError(
                f"there is no {side} number {item}: the system has {len(known)} "
                f"({short_list(known)}), counted from 0."
            )
    return [item if isinstance(item, str) else known[item] for item in several]


def rows_of(known: Sequence[str], names: Iterable[str], side: str, owner: str | None) -> IntArray:
    """Return the positions of names; LabelError where one is unknown."""
    position = {name: i for i, name in enumerate(known)}
    if isinstance(names, str):
        names = [names]
    rows = []
    for name in names:
        if name not in position:
            raise unknown_label(side, name, known, owner or "")
        rows.append(position[name])
    return np.array(rows, dtype=np.int64)

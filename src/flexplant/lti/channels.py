"""Channels of a system chosen by name, number or slice."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from typing import TypeAlias

import numpy as np

from ..errors import LabelError, unknown_label
from ..values import IntArray, short
from .joining import short_list

#: what selects channels: a name or number, several, or a slice
Channels: TypeAlias = "str | int | slice | Sequence[str | int]"


def chosen_names(known: Sequence[str], key: Channels, side: str) -> list[str]:
    """Return the names that a name, a number, several or a slice selects."""
    if isinstance(key, slice):
        return list(known[key])
    several = list(key) if isinstance(key, Iterable) and not isinstance(key, str) else [key]
    for item in several:
        if not isinstance(item, str | int | np.integer) or isinstance(item, bool):
            raise LabelError(
                f"{side}s are chosen by name, number or slice, got {short(item)}. Known are: "
                f"{short_list(known)}."
            )
        if isinstance(item, int | np.integer) and not -len(known) <= item < len(known):
            raise LabelError(
                f"there is no {side} number {item}: the system has {len(known)} "
                f"({short_list(known)}), counted from 0."
            )
    return [item if isinstance(item, str) else known[item] for item in several]


def chosen_pair(
    outputs: Sequence[str], inputs: Sequence[str], key: tuple[Channels, Channels]
) -> tuple[list[str], list[str]]:
    """Return the outputs and inputs that `sys[output, input]` selects."""
    if not isinstance(key, tuple) or len(key) != 2:
        raise LabelError(
            f"a channel is a pair, sys[output, input], by name or number, got {short(key)}."
        )
    return chosen_names(outputs, key[0], "output"), chosen_names(inputs, key[1], "input")


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

"""Rows of DOFs by label, found by number: a million labels need no dictionary."""

from __future__ import annotations

import re
from collections.abc import Sequence

import numpy as np

from .dof_columns import LARGEST_NODE
from .errors import LabelError, unknown_label
from .places import DIRECTIONS
from .values import IntArray

#: of so many labels the closest are found by comparing each with the one that is unknown
_COMPARABLE = 2000


class DofIndex:
    """The rows of DOFs, given their node numbers (n,) and kinds (n,), 0 to 5 for x to rz.

    Attributes
    ----------
    keys : (n,) array of int
        One whole number for each DOF, ascending.
    order : (n,) array of int
        The rows in this order.
    """

    def __init__(self, nodes: IntArray, kinds: IntArray) -> None:
        keys = nodes * len(DIRECTIONS) + kinds
        order = np.arange(keys.size)
        if np.any(keys[1:] < keys[:-1]):
            order = np.argsort(keys, kind="stable")
        self.keys, self.order = keys[order], order

    def found(self, label: object) -> int:
        """Return the row of a label, or -1: by its number, so that a million need no dictionary."""
        if not isinstance(label, str):
            return -1
        node, _, direction = label.partition(":")
        if direction not in DIRECTIONS:
            return -1
        try:
            number = int(node)
        except ValueError:
            return -1
        if str(number) != node or abs(number) > LARGEST_NODE:  # "07:z" and "1_0:z" are no labels
            return -1
        keys, order = self.keys, self.order
        key = number * len(DIRECTIONS) + DIRECTIONS.index(direction)
        place = int(np.searchsorted(keys, key))
        return int(order[place]) if place < keys.size and keys[place] == key else -1


def unknown_dof(label: object, nodes: IntArray, directions: Sequence[str]) -> LabelError:
    """Return the error for a label that is not there, without comparing it with a million."""
    if nodes.size <= _COMPARABLE:
        known = [f"{n}:{d}" for n, d in zip(nodes.tolist(), directions, strict=True)]
        return unknown_label("DOF", label, known)
    number = re.match(r"-?\d{1,15}", str(label))
    near = int(number.group()) if number else int(nodes[0])
    rows = np.argsort(np.abs(nodes - near), kind="stable")[:6]
    listed = ", ".join(f"'{nodes[i]}:{directions[i]}'" for i in rows)
    return LabelError(
        f"no DOF {label!r} ({nodes.size} known). At the nodes next to it there are: {listed}."
    )

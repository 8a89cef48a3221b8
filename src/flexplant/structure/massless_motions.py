"""Motions without inertia, of single DOFs or of several together, refused or condensed."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, NamedTuple

import numpy as np

from ..errors import ModelError
from ..values import IntArray
from .condense import condensed, empty_rows
from .singular_mass import left_out, null_motions, projected


class Inertial(NamedTuple):
    """Matrices on the motions with inertia, the rows (k,) that are left, and what was done."""

    K: Any
    M: Any
    D: Any
    rows: IntArray
    notes: tuple[str, ...]


def inertial(
    K: Any,
    M: Any,
    D: Any,
    names: Callable[[IntArray], tuple[str, ...]],
    *,
    digits: int | None,
    massless: str,
) -> Inertial:
    """Return matrices whose M is definite: motions without inertia follow the others statically.

    Parameters
    ----------
    K, M, D : (n, n) sparse; D or None
        The matrices.
    names : function
        Of rows (from 0), gives their labels.
    digits : int or None
        Significant digits of the entries; None: double precision.
    massless : "refuse" or "condense"
        What to do with such motions.

    Raises
    ------
    ModelError
        When there are such motions and they are to be refused, or cannot be condensed.
    """
    notes: tuple[str, ...] = ()
    rows: IntArray = np.arange(M.shape[0])
    without = empty_rows(M)
    if without.any():
        if massless == "refuse":
            some = names(np.flatnonzero(without))
            listed = ", ".join(repr(name) for name in some[:6])
            more = f" ({len(some)} in all)" if len(some) > 6 else ""
            raise ModelError(
                f"DOFs without mass: {listed}{more}. They have no motion of their own. Condense "
                "them, which is exact: model(massless='condense'); or give them their mass."
            )
        K, M, D = condensed(K, M, D, without, names)
        rows = np.flatnonzero(~without)
        notes = (f"{int(without.sum())} massless DOFs condensed",)
    motions = null_motions(M, digits)
    count = motions.shape[1]
    if count:
        if massless == "refuse":
            at = ", ".join(names(rows[left_out(motions, M)[:6]]))
            raise ModelError(
                f"{count} motions have no inertia, turning {at} among others: offset "
                "masses without rotary inertia, or rods that do not resist turning? Condense them, "
                "which is exact: model(massless='condense'); or give them their inertia."
            )
        left = rows
        K, M, D, kept = projected(K, M, D, motions, lambda some: names(left[some]))
        rows = rows[kept]
        notes = (*notes, f"{count} motions without inertia condensed")
    return Inertial(K, M, D, rows, notes)

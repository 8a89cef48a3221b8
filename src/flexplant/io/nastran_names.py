"""Which matrices of a Nastran file are K, M and D: by the usual names, or those that are given."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

from ..errors import ModelError, require_known
from .formats import USUAL

_LETTERS = {"stiffness": "K", "mass": "M", "damping": "B"}


def named_matrices(
    found: Mapping[str, Any],
    given: Mapping[str, str | None],
    endings: Sequence[str],
    path: str,
) -> list[str | None]:
    """Return the names of stiffness, mass and damping; of the latter two None where not there."""
    names: list[str | None] = []
    for what, said in given.items():
        if what == "damping" and said is None:
            names.append(None)
            continue
        name = None if said == USUAL else said
        require_known("matrix", () if name is None else (name,), found, repr(path))
        usual = [_LETTERS[what] + ending for ending in endings]
        there = [one for one in usual if one in found] if name is None else [name]
        if len(there) > 1:
            raise ModelError(
                f"{path!r} holds {there}, any of which may be the {what}. Say which: "
                f"{what}={there[0]!r}."
            )
        if not there and what == "stiffness":
            raise ModelError(
                f"{path!r} holds {sorted(found)}, none of which has a usual name of a stiffness "
                f"matrix ({', '.join(usual)}). Say which it is: stiffness='...'."
            )
        names.append(there[0] if there else None)
    return names

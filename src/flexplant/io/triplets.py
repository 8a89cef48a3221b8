"""FEMatrices from the matrices of a file: complete triangles, drop held rows, count digits."""

from __future__ import annotations

import importlib
from collections.abc import Callable, Iterable, Mapping
from pathlib import Path
from typing import Any

import numpy as np
import scipy.sparse as sp

from ..arrays import FloatArray, IntArray
from ..errors import FlexplantError, ModelError
from ..labels import DofSet
from ..structure import FEMatrices
from ..structure.definite import digits_of
from ..structure.matrices import completed
from .files import USUAL, damaged, file_path, parsing
from .foreign_parsers import sound
from .tables import read_dofs

#: names of K, M and D that are searched, in upper or lower case
USUAL_NAMES: Mapping[str, tuple[str, ...]] = {
    "K": ("k", "k0", "kaa", "kgg", "kaax", "kmat", "stiffness", "stiff", "kff", "kred"),
    "M": ("m", "m0", "maa", "mgg", "maax", "mmat", "mass", "mff", "mred"),
    "D": ("d", "c", "d0", "c0", "baa", "bgg", "b", "baax", "cmat", "damping", "damp"),
}


def assembled(
    parts: Mapping[str, Any],
    *,
    dofs: DofSet | str | Path | None,
    source: str,
    digits: int | None = None,
    located: bool = True,
    notes: Iterable[str] = (),
) -> FEMatrices:
    """Return the FEMatrices of what a file holds under "K", "M", "D" (None: absent)."""
    if parts.get("K") is None:
        raise ModelError(f"{source!r} holds no stiffness matrix. Name the variable: stiffness=...")
    done: dict[str, Any] = {"M": None, "D": None}
    said = list(notes)
    for name, given in parts.items():
        if given is not None:
            with parsing(source):
                sound(given)
            done[name], note = completed(given, name)
            said += [note] if note else []
    named = read_dofs(dofs) if isinstance(dofs, str | Path) else dofs
    whole = FEMatrices(
        done["K"],
        done["M"],
        done["D"],
        dofs=named,
        digits=digits_of(parts["K"]) if digits is None else digits,
        source=source,
        located=located,
        notes=tuple(said),
    )
    return whole.trimmed()


def one_matrix_each(
    paths: Mapping[str, str | Path | None],
    read: Callable[[Path], tuple[Any, int | None]],
    dofs: DofSet | str | Path | None,
) -> FEMatrices:
    """Return the FEMatrices of files that hold one matrix each."""
    parts: dict[str, Any] = {}
    digits: int | None = None
    for name, path in paths.items():
        if path is not None:
            parts[name], printed = read(file_path(path, name))
            digits = printed if name == "K" else digits
    return assembled(parts, dofs=dofs, source=Path(str(paths["K"])).name, digits=digits)


def from_triplets(
    values: FloatArray, i: IntArray, j: IntArray, n: int, path: object
) -> sp.csc_array:
    """Return the full matrix (n, n) of listed entries, of one triangle or of both."""
    twice = np.count_nonzero(np.unique(i * n + j, return_counts=True)[1] > 1)
    if twice:
        raise damaged(path, f"entries stored twice: {twice} (several steps?)")
    # if labels are not sorted, the entries of one triangle may lie on both sides of the diagonal,
    # but an entry and its mirror image are never both listed
    return completed(sp.coo_array((values, (i, j)), shape=(n, n)), "a matrix")[0]


def chosen(
    variables: Mapping[str, Any], wanted: Mapping[str, str | None], source: str
) -> dict[str, Any]:
    """Return the variables of a file that are K, M and D; named ones must exist."""
    # "usual" stands for a variable with a usual name, and so does None, except that None leaves D
    # out. The shortest path comes first: K before model.K
    there = sorted(variables, key=lambda text: (text.count("."), text))
    found: dict[str, Any] = {}
    for part, name in wanted.items():
        if name not in (None, USUAL) and name not in variables:
            raise ModelError(
                f"{source!r} has no variable {name!r}: it holds {list(variables)[:10]}. Names are "
                "case-sensitive; fields of a structure are written 'structure.field'."
            )
        usual = [
            known
            for usual_name in USUAL_NAMES[part]
            for known in there
            if known.rsplit(".", 1)[-1].lower() == usual_name and (name or part != "D")
        ]
        own = name if name not in (None, USUAL) else next(iter(usual), None)
        alike = [known for known in usual if own and known.count(".") == own.count(".")]
        if own != name and len(alike) > 1:
            kind = {"K": "stiffness", "M": "mass", "D": "damping"}[part]
            raise ModelError(
                f"{source!r} holds {alike}, any of which may be the {kind}. Name one: "
                f"{kind}={own!r}."
            )
        if own is not None:
            found[part] = variables[own]
    if "K" not in found:
        raise ModelError(
            f"{source!r} holds {list(variables)[:10]}, but nothing that looks like a stiffness "
            "matrix. Say which it is: stiffness='...', mass='...'."
        )
    return found


def extra_module(module: str, extra: str, what: str) -> Any:
    """Return a module that `flexplant[extra]` installs, or say the line to type."""
    try:
        return importlib.import_module(module)
    except ImportError:
        raise missing_extra(module, extra, what) from None


def missing_extra(package: str, extra: str, what: str) -> FlexplantError:
    """Return the error for an extra that is not installed, with the line to type."""
    return FlexplantError(
        f"{what} needs {package}, which is not installed. Type: pip install 'flexplant[{extra}]'"
    )

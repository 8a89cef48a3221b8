"""Nastran OUTPUT4 files, binary and text, dense and sparse, of either byte order."""

from __future__ import annotations

from collections.abc import Iterable
from pathlib import Path
from typing import Any, TypeAlias

import numpy as np
import scipy.sparse as sp

from ..checks import name_list
from ..errors import FlexplantError, ModelError, require_known
from ..labels import DofSet
from ..structure.matrices import FEMatrices, completed
from .nastran import named_matrices
from .op4_binary import binary_matrices, text_matrices
from .paths import FORMATS, USUAL, Format, file_path

#: a matrix of the file: dense where the file holds it dense, real or complex
Op4Matrix: TypeAlias = Any
_ENDINGS = ("AA", "AAX", "GG", "XX", "FF", "LL", "2GG", "TT", "")


def read_op4(
    path: str | Path,
    *,
    stiffness: str | None = None,
    mass: str | None = None,
    damping: str | None = USUAL,
    dofs: DofSet | None = None,
) -> FEMatrices:
    r"""Return the stiffness, mass and damping matrices of a Nastran OUTPUT4 file.

    The file names its matrices, but neither nodes nor units. Rows that are zero are kept.

    Parameters
    ----------
    path : str or Path
        An .op4 file, binary (32 or 64 bit integers, either byte order) or text.
    stiffness, mass, damping : str, optional
        Names of the matrices; when not given, the one of the usual names (KAA, KAAX, KGG, KXX,
        KFF, KLL; MAA, ...; BAA, ...) that is there. `damping=None`: none. A null matrix of 1 x 1
        stands for one that is not there (EXTSEOUT writes it).
    dofs : DofSet, optional
        The rows of the matrices.

    Returns
    -------
    FEMatrices
        With the `digits` of K as printed in a text file, 7 in single precision (type 1).

    Raises
    ------
    FlexplantError
        When the file is cut off, damaged, or no OUTPUT4 file; the byte or line is named.
    LabelError
        When there is no matrix of such a name.
    ModelError
        When which matrix is meant is not clear, or it is complex.
    FileNotFoundError
        When there is no such file.

    Notes
    -----
    Format: MSC Nastran Quick Reference Guide and DMAP manual, OUTPUT4; matrices of form 6
    (symmetric) with one triangle only are completed.

    Examples
    --------
    >>> import flexplant as fx
    >>> import pathlib, tempfile
    >>> text = "       2       2       6       2KAA     1P,3E16.9\n"
    >>> for i, (a, b) in enumerate([(4e5, -4e5), (-4e5, 4e5), (1.0, None)], 1):
    ...     text += f"{i:8d}{1:8d}{2 if b else 1:8d}\n{a:16.9E}" + (f"{b:16.9E}\n" if b else "\n")
    >>> with tempfile.TemporaryDirectory() as folder:
    ...     file = pathlib.Path(folder, "run.op4")
    ...     _ = file.write_text(text)
    ...     found = fx.io.read_op4(file, dofs=fx.chain(masses=[1, 1], stiffnesses=[1]).dofs)
    >>> found.K.toarray().tolist(), found.digits
    ([[400000.0, -400000.0], [-400000.0, 400000.0]], 10)
    """
    found = _read(path, None)
    given = {"stiffness": stiffness, "mass": mass, "damping": damping}
    chosen = named_matrices(found, given, _ENDINGS, str(path))
    K, M, D = (_real(found, name, path) for name in chosen)
    assert K is not None  # noqa: S101 - its name is known
    M, D = (None if _is_absent(part, K.shape[0]) else part for part in (M, D))
    digits = found[str(chosen[0])][2]
    return FEMatrices(K, M, D, dofs=dofs, digits=digits, source=str(path))


def read_op4_matrices(
    path: str | Path, *, names: Iterable[str] | None = None
) -> dict[str, Op4Matrix]:
    r"""Return the matrices of a Nastran OUTPUT4 file by their names.

    Parameters
    ----------
    path : str or Path
        An .op4 file, binary (32 or 64 bit integers, either byte order) or text.
    names : sequence of str, optional
        Those to return; all when not given.

    Returns
    -------
    dict {name: (m, n) array or csc_array}
        Sparse where the file holds it sparse, or a large one is nearly empty; float64, or
        complex128. A doubled name gets `_2`.

    Raises
    ------
    FlexplantError
        When the file is cut off, damaged, or no OUTPUT4 file; the byte or line is named.
    LabelError
        When there is no matrix of such a name.
    FileNotFoundError
        When there is no such file.

    Examples
    --------
    >>> import flexplant as fx
    >>> import pathlib, tempfile
    >>> text = "       2       2       6       2KAA     1P,3E16.9\n"
    >>> for i, (a, b) in enumerate([(4e5, -4e5), (-4e5, 4e5), (1.0, None)], 1):
    ...     text += f"{i:8d}{1:8d}{2 if b else 1:8d}\n{a:16.9E}" + (f"{b:16.9E}\n" if b else "\n")
    >>> with tempfile.TemporaryDirectory() as folder:
    ...     file = pathlib.Path(folder, "run.op4")
    ...     _ = file.write_text(text)
    ...     found = fx.io.read_op4_matrices(file)
    >>> found["KAA"].tolist()
    [[400000.0, -400000.0], [-400000.0, 400000.0]]
    """
    found = _read(path, None if names is None else name_list(names, "matrices"))
    return {name: matrix for name, (matrix, _, _) in found.items()}


def _is_absent(matrix: sp.csc_array | None, n: int) -> bool:
    """Return whether a matrix is the null of 1 x 1 that stands for none."""
    return matrix is None or (n > 1 and matrix.shape == (1, 1) and not matrix.count_nonzero())


def _real(found: dict[str, Any], name: str | None, path: str | Path) -> sp.csc_array | None:
    if name is None:
        return None
    matrix, form, _ = found[name]
    if np.iscomplexobj(matrix):
        raise ModelError(
            f"matrix {name} of {str(path)!r} is complex: a structure's M, D and K are real. "
            "Structural damping belongs into a damping matrix; read_op4_matrices reads it."
        )
    sparse = sp.csc_array(matrix)
    if form == 6 and sparse.shape[0] == sparse.shape[1]:
        return completed(sparse, name)[0]
    return sparse


def _read(
    path: str | Path, names: tuple[str, ...] | None
) -> dict[str, tuple[Op4Matrix, int, int | None]]:
    """Return {name: (matrix, form, decimal digits of its entries)}; None is double precision."""
    content = file_path(path).read_bytes()
    if len(content) < 16:
        raise FlexplantError(
            f"{str(path)!r} has {len(content)} bytes, too few for an OUTPUT4 file. Write it again."
        )
    try:
        form_of_file = binary_matrices if content[:4].count(0) else text_matrices
        parts = list(form_of_file(content, str(path)))
    except MemoryError:
        raise FlexplantError(
            f"{str(path)!r} holds a matrix that does not fit into memory. Write it again, sparse."
        ) from None
    found: dict[str, tuple[Op4Matrix, int, int | None]] = {}
    matrix: Any
    for name, matrix, form, digits in parts:
        entries = matrix.data if hasattr(matrix, "indptr") else matrix
        if not np.all(np.isfinite(entries)):
            raise FlexplantError(
                f"matrix {name} of {str(path)!r} has NaN or infinite entries: the file is damaged, "
                "or the run that wrote it failed. Write it again."
            )
        key, count = name, 1
        while key in found:
            count += 1
            key = f"{name}_{count}"
        found[key] = (matrix, form, digits)
    if names is None:
        return found
    require_known("matrix", names, found, repr(str(path)))
    return {name: found[name] for name in names}


FORMATS.append(Format((".op4",), read_op4))

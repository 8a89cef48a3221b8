"""CHOLMOD of SuiteSparse and MKL PARDISO as optional solvers."""

from __future__ import annotations

import ctypes
import ctypes.util
import os
import weakref
from collections.abc import Iterator
from dataclasses import dataclass, field
from functools import cache
from importlib import metadata
from pathlib import Path
from types import ModuleType
from typing import Any

import numpy as np
import scipy.sparse as sp

from ..arrays import FloatArray
from ..errors import SolverError
from ..store import Value, checked
from ..words import one_of
from .factor import not_definite

_ORDERS = ("default", "best", "amd", "metis", "nesdis")


@dataclass(frozen=True, eq=False, repr=False)
class Cholmod(Value):
    """Factor with CHOLMOD [Chen2008]_: ``pip install scikit-sparse``, 0.4.16 or later.

    It needs SuiteSparse and a compiler (Debian: ``apt-get install libsuitesparse-dev``), and parts
    of CHOLMOD are under the GPL, so that no extra of this package installs it. 24 modes of a plate
    of 99 400 DOFs took 5.6 s with it and 5.2 s without, of a solid of 52 700 DOFs 24 s and 10 s.
    Modes are counted and checked as always, by the library's own factorisation.

    Parameters
    ----------
    order : str
        How CHOLMOD orders the unknowns: "default" (minimum degree, METIS where that fills),
        "best", "amd", "metis" or "nesdis".

    Examples
    --------
    To be passed as ``solve_modes(model, count=24, factor=Cholmod())``:

    >>> Cholmod()
    Cholmod()
    """

    order: str = field(default="default", metadata=checked(one_of, choices=_ORDERS))

    def factored(self, matrix: Any) -> CholmodCholesky:
        """Return the factor of a sparse symmetric positive definite matrix."""
        return CholmodCholesky(matrix, self)


class CholmodCholesky:
    """``A = L L^T`` of a sparse symmetric positive definite matrix, held by CHOLMOD."""

    def __init__(self, matrix: Any, method: Cholmod) -> None:
        cholmod = _installed()
        lower: Any = sp.tril(sp.csc_array(matrix), format="csc")
        lower.sort_indices()
        try:
            if hasattr(cholmod, "cho_factor"):  # scikit-sparse 0.5
                self._factor = cholmod.cho_factor(lower, lower=True, order=method.order)
                self._solve = self._factor.solve
            else:
                self._factor = self._solve = cholmod.cholesky(
                    sp.csc_matrix(lower), ordering_method=method.order, mode="supernodal"
                )
        except cholmod.CholmodNotPositiveDefiniteError as error:
            raise not_definite("CHOLMOD") from error
        except cholmod.CholmodError as error:
            raise SolverError(
                f"CHOLMOD failed: {error}. Leave out factor= to use the library's own factor."
            ) from error

    @property
    def n_entries(self) -> int:
        """Entries of the factor, from a copy, since version 0.4 only shows another form."""
        shown = self._factor.copy()
        return int(shown.nnz if hasattr(shown, "nnz") else shown.L().nnz)

    def solve(self, right: FloatArray) -> FloatArray:
        """Return ``A^-1 right`` for (n,) or (n, m) right-hand sides."""
        return np.ascontiguousarray(self._solve(np.asfortranarray(right)))


def _installed() -> ModuleType:
    try:
        from sksparse import cholmod
    except ImportError as error:
        raise SolverError(
            f"Cholmod needs scikit-sparse, which cannot be imported ({error}): install SuiteSparse "
            "and pip install scikit-sparse, or leave out factor= to use the library's own factor."
        ) from error
    return cholmod  # type: ignore[no-any-return]


#: matrix type: real, symmetric, positive definite
_POSITIVE_DEFINITE = 2
_FACTOR, _SOLVE, _RELEASE = 12, 33, -1
_NAMES = ("libmkl_rt.so*", "libmkl_rt*.dylib", "mkl_rt*.dll")


@dataclass(frozen=True, eq=False, repr=False)
class Pardiso(Value):
    """Factor with MKL PARDISO, on one thread: ``pip install 'flexplant[mkl]'``.

    On an Intel processor 24 modes of a plate of 99 400 DOFs took 4.4 s with it and 5.2 s without,
    of a solid of 98 300 DOFs 27 s and 23 s. Modes are counted and checked as always, by the
    library's own factorisation.

    Parameters
    ----------
    library : str, optional
        Path of the shared library mkl_rt. None: that of the installed `mkl`, or of MKLROOT.

    Examples
    --------
    To be passed as ``solve_modes(model, count=24, factor=Pardiso())``:

    >>> Pardiso()
    Pardiso()
    """

    library: str | None = None

    def factored(self, matrix: Any) -> PardisoCholesky:
        """Return the factor of a sparse symmetric positive definite matrix."""
        return PardisoCholesky(matrix, self)


class PardisoCholesky:
    """``A = L L^T`` of a sparse symmetric positive definite matrix, held by MKL."""

    def __init__(self, matrix: Any, method: Pardiso) -> None:
        self._mkl = _load_mkl(method.library)
        given: Any = sp.csc_array(matrix)
        # columns of the lower triangle are rows of the upper one
        lower: Any = sp.csc_array(sp.tril(given, format="csc"))
        lower.sort_indices()
        self._n = lower.shape[0]
        self._begin = (lower.indptr + 1).astype(np.int32)
        self._columns = (lower.indices + 1).astype(np.int32)
        self._entries = np.ascontiguousarray(lower.data, dtype=np.float64)
        self._memory = np.zeros(64, dtype=np.int64)
        self._options = np.zeros(64, dtype=np.int32)
        self._options[0] = 1  # no default options
        self._options[1] = 2  # nested dissection (METIS)
        self._options[17] = -1  # report the entries of the factor
        nothing = np.zeros(1)
        self._call(_FACTOR, nothing, nothing, 1)
        # memory and options remain in the arguments until MKL has released what it holds
        weakref.finalize(self, _release, self._mkl, self._memory, self._options, self._n)

    @property
    def n_entries(self) -> int:
        """Stored entries of the factor."""
        return int(self._options[17])

    def solve(self, right: FloatArray) -> FloatArray:
        """Return ``A^-1 right`` for (n,) or (n, m) right-hand sides."""
        b = np.asfortranarray(right.reshape(self._n, -1), dtype=np.float64)
        x = np.empty_like(b, order="F")
        self._call(_SOLVE, b, x, b.shape[1])
        return np.ascontiguousarray(x).reshape(right.shape)

    def _call(self, phase: int, b: FloatArray, x: FloatArray, columns: int) -> None:
        error = ctypes.c_int32(0)
        arguments = [
            *(_pardiso_integer(v) for v in (1, 1, _POSITIVE_DEFINITE, phase, self._n)),
            *(a.ctypes.data_as(ctypes.c_void_p) for a in (self._entries, self._begin)),
            self._columns.ctypes.data_as(ctypes.c_void_p),
            _pardiso_integer(0),
            _pardiso_integer(columns),
            self._options.ctypes.data_as(ctypes.c_void_p),
            _pardiso_integer(0),
            *(a.ctypes.data_as(ctypes.c_void_p) for a in (b, x)),
        ]
        self._mkl.pardiso(
            self._memory.ctypes.data_as(ctypes.c_void_p), *arguments, ctypes.byref(error)
        )
        if error.value == -4:
            raise not_definite("PARDISO")
        if error.value:
            raise SolverError(
                f"PARDISO failed with error {error.value} (see MKL's documentation; -2 is too "
                "little memory). Leave out factor= to use the library's own factor."
            )


def _pardiso_integer(value: int) -> Any:
    return ctypes.byref(ctypes.c_int32(value))


def _release(mkl: Any, memory: Any, options: Any, n: int) -> None:
    nothing = [ctypes.byref(ctypes.c_int32(0)) for _ in range(6)]
    mkl.pardiso(
        memory.ctypes.data_as(ctypes.c_void_p),
        *(_pardiso_integer(v) for v in (1, 1, _POSITIVE_DEFINITE, _RELEASE, n)),
        *nothing[:4],
        _pardiso_integer(1),
        options.ctypes.data_as(ctypes.c_void_p),
        _pardiso_integer(0),
        *nothing[4:],
        ctypes.byref(ctypes.c_int32(0)),
    )


def _library_paths() -> Iterator[Path]:
    """Yield possible paths of mkl_rt: the installed package, below MKLROOT, the system's path."""
    try:
        for file in metadata.files("mkl") or []:
            if any(file.match(name) for name in _NAMES):
                yield Path(str(file.locate())).resolve()
    except metadata.PackageNotFoundError:
        pass
    root = os.environ.get("MKLROOT")
    if root:
        for folder in ("lib", "lib/intel64", "bin"):
            for name in _NAMES:
                yield from sorted((Path(root) / folder).glob(name))
    found = ctypes.util.find_library("mkl_rt")
    if found:
        yield Path(found)


@cache
def _load_mkl(library: str | None) -> Any:
    places = list(_library_paths()) if library is None else [Path(library)]
    for place in places:
        try:
            mkl = ctypes.CDLL(str(place), mode=getattr(ctypes, "RTLD_GLOBAL", 0))
        except OSError:
            continue
        # 32-bit integers, one thread: before anything else is called
        mkl.MKL_Set_Interface_Layer(ctypes.c_int(0))
        mkl.MKL_Set_Threading_Layer(ctypes.c_int(1))
        return mkl
    raise SolverError(
        f"Pardiso needs MKL's library mkl_rt, not found {f'at {library}' if library else 'here'}: "
        "pip install 'flexplant[mkl]', or leave out factor= to use the library's own factor."
    )

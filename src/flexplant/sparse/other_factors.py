"""CHOLMOD of SuiteSparse as an optional solver."""

from __future__ import annotations

from dataclasses import dataclass, field
from types import ModuleType
from typing import Any

import numpy as np
import scipy.sparse as sp

from ..arrays import FloatArray, one_of
from ..errors import SolverError
from ..store import Value, checked
from .factor import not_definite

_ORDERS = ("default", "best", "amd", "metis", "nesdis")


@dataclass(frozen=True, eq=False, repr=False)
class Cholmod(Value):
    """Factor with CHOLMOD [Chen2008]_: ``pip install scikit-sparse``, 0.4.16 or later.

    It needs SuiteSparse and a compiler (Debian: ``apt-get install libsuitesparse-dev``). No extra
    of this package installs it, because parts of CHOLMOD are under the GPL. 24 modes of a plate of
    99 400 DOFs took 5.6 s with it and 5.2 s without it. For a solid of 52 700 DOFs the times were
    24 s and 10 s. The modes are always counted and checked by flexplant's own factorisation.

    Parameters
    ----------
    order : str
        Method by which CHOLMOD orders the unknowns: "default" (minimum degree, or METIS if that
        gives too many nonzero entries), "best", "amd", "metis" or "nesdis".

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

"""Factor of a complex symmetric sparse matrix, such as a damped dynamic stiffness, by fronts."""

from __future__ import annotations

from typing import Any

import numpy as np
import scipy.sparse as sp
from scipy.linalg import lapack

from ..errors import SolverError
from ..parallel import one_thread
from ..values import ComplexArray, FloatArray
from .multifrontal import assembled
from .ordering import Dissection, dissect

#: columns of a remainder that are updated at once: of its symmetric upper part little is computed
_STRIP = 256


class ComplexSymmetricFactor:
    """``A = L D L^T`` (not conjugated) of a sparse complex symmetric matrix, by fronts.

    Each pivot block D is factored with row exchanges of its own; pivots are not moved between
    fronts. That is stable for the dynamic stiffness ``K + i omega D - omega^2 M`` of a damped
    structure; the residual of a solution shows it.
    """

    def __init__(self, matrix: Any, dissection: Dissection | None = None) -> None:
        lower = sp.csc_array(matrix, dtype=np.complex128)
        self.dissection = dissect(lower) if dissection is None else dissection
        #: of each front: LU of its pivot block, the exchanges, and ``D^-1 B^T``
        self._blocks: list[tuple[ComplexArray, Any, ComplexArray]] = []
        with one_thread():
            for _, pivots, below, rest in assembled(lower, self.dissection):
                block = np.asfortranarray(np.tril(pivots) + np.tril(pivots, -1).T)
                factor, exchanges, info = lapack.zgetrf(block, overwrite_a=1)
                if info:
                    raise SolverError(
                        "a dynamic stiffness is singular: its frequency is a resonance of an "
                        "undamped structure. Move it a little, or give the structure damping."
                    )
                solved: Any = below.T
                if rest.size:
                    solved, _ = lapack.zgetrs(factor, exchanges, below.T)
                    for j in range(0, rest.shape[0], _STRIP):
                        strip = slice(j, j + _STRIP)
                        # in the order in which both are stored, columns of `rest` as rows
                        rest.T[strip, j:] -= solved[:, strip].T @ below[j:].T
                self._blocks.append((factor, exchanges, solved))

    @property
    def n_entries(self) -> int:
        """Stored entries of the factor."""
        return sum(factor.size + solved.size for factor, _, solved in self._blocks)

    def solve(self, right: FloatArray | ComplexArray) -> ComplexArray:
        """Return ``A^-1 right`` for (n,) or (n, m) right-hand sides."""
        order = self.dissection.order
        x = np.ascontiguousarray(right.reshape(order.size, -1)[order], dtype=np.complex128)
        fronts = self.dissection.fronts
        with one_thread():
            for front, (_, _, solved) in zip(fronts, self._blocks, strict=True):
                if front.rows.size:
                    x[front.rows] -= solved.T @ x[front.first : front.last]
            for front, (factor, exchanges, solved) in zip(
                fronts[::-1], self._blocks[::-1], strict=True
            ):
                part, _ = lapack.zgetrs(factor, exchanges, x[front.first : front.last])
                if front.rows.size:
                    part -= solved @ x[front.rows]
                x[front.first : front.last] = part
        answer = np.empty_like(x)
        answer[order] = x
        return answer.reshape(right.shape)

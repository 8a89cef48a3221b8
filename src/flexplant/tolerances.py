"""Small numbers in words, each relative to what it is compared with; double precision has 2e-16."""

from __future__ import annotations

from typing import Any

import numpy as np

from .arrays import FloatArray

#: in the place of zero where something is divided by it, or its logarithm taken; not relative:
#: no size in SI units is smaller, and 1e8 times its reciprocal is a number still
TINY = 1e-300
#: singular values below this part of the largest are rounding of a few hundred rows: no rank
RANK = 1e-13
#: a number below this part of the terms it is a sum of is their rounding
ROUNDING = 1e-12
#: two numbers given as the same one, through a unit or a binary file, have nine digits alike, and
#: so have the coordinates of nodes: a motion that they show no more is none
SAME = 1e-9
#: numbers that were typed, or printed into a file by another program, have at least six digits
TYPED = 1e-6
#: a search whose value moves by less has ended: nothing in a machine is known to nine digits
SETTLED = 1e-9
#: eigenvalue solvers split a double pole, as of a rigid-body mode, by the root of their rounding
#: (1.5e-8) times its condition: nearer ones are one, and those nearer to zero are zero
SPLIT = 1e-6


def divisor(size: Any) -> FloatArray:
    """Return what to divide by: sizes, and 1 where there is none."""
    return np.asarray(np.where(size > 0, size, 1.0))

"""The direct gain D of a system, which users also write as the number 0."""

from __future__ import annotations

from typing import Any

import numpy as np

from ..errors import ShapeError
from ..values import FloatArray, real_array


def direct_gain(D: Any, B: Any, C: Any) -> FloatArray:
    """Return D (p, m) of a system with inputs B and outputs C; the number 0 stands for zeros."""
    if np.ndim(D):
        return real_array(D, "D", (None, None))
    (m,) = real_array(B, "B", (None, None)).shape[1:]
    p = len(real_array(C, "C", (None, None)))
    if real_array(D, "D", ()) != 0:
        raise ShapeError(
            f"D is the gain from {m} inputs to {p} outputs, an array of shape ({p}, {m}); got the "
            f"number {D:g}. Pass that array, or 0 where no input acts on an output directly."
        )
    return np.zeros((p, m))

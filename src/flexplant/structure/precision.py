"""What the digits of a text file do to the soft modes of a model."""

from __future__ import annotations

from typing import Any

from ..errors import SolverError
from .lowest import Lowest, lowest_modes

#: relative error of the first elastic eigenvalue from which on it is worth a warning
_WORTH = 1e-4
#: a text of this many digits loses nothing of a double
_ALL_DIGITS = 16


def loss(found: Lowest, digits: int) -> float | None:
    """Return the relative error of the first elastic eigenvalue that `digits` digits allow.

    ``10^-digits |phi|^T |K| |phi| / lambda``: rounding each entry of K by that much.
    """
    if found.n_zero >= found.values.size:
        return None
    first = found.n_zero
    return float(10.0**-digits * found.spread[first] / abs(found.values[first]))


def endangered(K: Any, M: Any, digits: int) -> str | None:
    """Return what to say when the digits of a text endanger the first elastic eigenvalue."""
    if digits >= _ALL_DIGITS:
        return None
    try:
        found = lowest_modes(K, M, 8, rounding=10.0**-digits)
    except SolverError:
        return None
    return verdict(loss(found, digits), digits)


def verdict(error: float | None, digits: int) -> str | None:
    """Return what to say of an error of the first elastic eigenvalue, None when it is harmless."""
    if error is None or error <= _WORTH:
        return None
    percent = f"up to {100 * error:.2g} %" if error < 1 else "wholly"
    return (
        f"K was written with {digits} digits, which may change the first elastic eigenvalue "
        f"{percent}: digits times the norm of K drown its softness. Export in binary (OP4, HDF5, "
        "npz), or with 16 digits."
    )

"""The error of soft modes when K has few digits, printed or of single precision."""

from __future__ import annotations

from typing import Any

import numpy as np
import scipy.sparse as sp

from ..checks import FloatArray, real_array
from ..errors import SolverError, attempted
from ..labels import DofSet
from ..sparse.lowest import Lowest, lowest_modes
from .rigid import force_free
from .zero_energy import nearly_free

#: relative error of the first elastic eigenvalue from which on it is worth a warning
_WORTH = 1e-4
#: relative errors of entries of K that are noticed, and that are rounding still
_FINE, _COARSE = 3e-12, 1e-4
#: rows that a motion loads, for a median of their forces
_ROWS = 12
#: a text of this many digits loses nothing of a double
_ALL_DIGITS = 16
#: numbers of fewer digits may be exact; those of more cannot be distinguished from computed ones
_WRITTEN = range(5, 15)
#: so many different entries, at least and at most, say with how many digits they were written
_SAMPLE = (20, 400)
#: the part of them that needs every digit: of ten last digits one is zero
_FULL = 0.6


def digits_of(given: Any) -> int | None:
    """Return the decimal digits that entries hold, None for double precision.

    Rounding to nearest changes an entry by half a unit in the last place: 2^-24 of it, hence 7
    digits, in single precision. Entries in double precision that came from a text of few digits
    show it: written with as few digits as distinguish them, none has more.
    """
    if not hasattr(given, "dtype"):
        real_array(given, "K")
        given = np.asarray(given)
    kind = np.dtype(given.dtype)
    if kind.kind not in "fc":
        return None
    digits = int(-np.log10(np.finfo(kind).eps / 2))
    return digits if digits < np.finfo(np.float64).precision else _written_digits(given)


def _written_digits(given: Any) -> int | None:
    """Return with how many digits some numbers were written, None when that does not show."""
    columns: Any = sp.csc_array
    held: Any = columns(given).data if sp.issparse(given) else np.ravel(given)
    entries = np.abs(held.real)
    step = max(1, entries.size // (20 * _SAMPLE[1]))
    some = np.unique(entries[::step])
    some = some[(some > 0) & np.isfinite(some)]
    if some.size < _SAMPLE[0]:
        return None
    chosen = some[:: max(1, some.size // _SAMPLE[1])]
    count = [len(f"{x!r}".partition("e")[0].replace(".", "").strip("0")) for x in chosen.tolist()]
    most = max(count)
    return most if most in _WRITTEN and count.count(most) >= _FULL * len(count) else None


def shown_digits(K: Any, dofs: DofSet) -> int | None:
    """Return to how many digits the entries of K are right, None where they are to more than 11.

    Rigid translations t cost no energy, so that ``K t`` is rounding: in every row, of either sign.
    Springs to ground act in few rows, or with the motion. Errors uniform up to a relative d leave
    ``|K t|_i = 0.39 d (sum_j K_ij^2 t_j^2)^(1/2)`` in the median.
    """
    stiffness: Any = sp.csr_array(K)
    size = stiffness.multiply(stiffness)
    worst = 0.0
    for direction in range(3):
        motion = (dofs.kinds == direction).astype(np.float64)
        force = stiffness @ motion
        scale = np.sqrt(size @ motion)
        rows = np.flatnonzero(scale > 0)
        if rows.size < _ROWS:
            continue
        error = float(np.median(np.abs(force[rows]) / scale[rows])) / 0.39
        work = np.abs(motion * force)
        aligned = abs(float(motion @ force)) > 0.5 * float(work.sum())
        if error < _COARSE and not aligned:
            worst = max(worst, error)
    return round(-float(np.log10(worst))) if worst > _FINE else None


def loss(found: Lowest, digits: int) -> float | None:
    """Return the relative error of the first elastic eigenvalue that `digits` digits allow.

    ``10^-digits |phi|^T |K| |phi| / lambda``: rounding each entry of K by that much.
    """
    if found.n_zero >= found.values.size:
        return None
    first = found.n_zero
    return float(10.0**-digits * found.spread[first] / abs(found.values[first]))


def endangered(K: Any, M: Any, digits: int) -> str | None:
    """Return what to say when the digits of K endanger the first elastic eigenvalue."""
    if digits >= _ALL_DIGITS:
        return None
    with attempted("the check of the digits of K by its lowest modes", SolverError):
        found = lowest_modes(K, M, 8, rounding=10.0**-digits)
        return verdict(loss(found, digits), digits)
    return None


def verdict(error: float | None, digits: int) -> str | None:
    """Return what to say of an error of the first elastic eigenvalue, None when it is harmless."""
    if error is None or error <= _WORTH:
        return None
    percent = f"up to {100 * error:.2g} %" if error < 1 else "wholly"
    return (
        f"K was written with {digits} digits, which may change the first elastic eigenvalue "
        f"{percent}: their rounding times the norm of K exceeds its softness. Export in double "
        "precision: in binary (OP4, HDF5, npz), or with 16 digits."
    )


def held_by_rounding(
    K: Any, M: Any, dofs: DofSet, digits: int, found: FloatArray | None = None
) -> str | None:
    """Return what to say when only rounding of the entries of K holds rigid-body motions."""
    nearly = nearly_free(K, M, dofs, digits).shape[1]
    if found is not None and force_free(M, K, found):
        nearly -= found.shape[1]
    return held_motions(nearly, digits)


def held_motions(count: int, digits: int) -> str | None:
    """Return what to say of some rigid-body motions that rounding holds, None when it is none."""
    if count <= 0:
        return None
    return (
        f"{count} of its rigid-body motions are held by nothing but the rounding of K's entries "
        f"to {digits} digits, and modes at or below 0 would follow. Export in double precision, or "
        "free them: FEMatrices(K, M, dofs=dofs).model(free=True), read_model(..., free=True)."
    )

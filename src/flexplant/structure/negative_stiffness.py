"""Negative stiffness: magnets that attract make rigid-body motions unstable."""

from __future__ import annotations

from typing import Any

import numpy as np

from ..errors import ModelError, counted
from ..sparse.factor import by_rows
from ..sparse.rayleigh_ritz import rounding_of
from ..values import FloatArray

#: part of its kinetic energy that an unstable mode has in rigid-body motion, at least
_RIGID = 0.99


def signed_root(squares: FloatArray) -> FloatArray:
    """Return frequencies omega [rad/s] of omega^2, negative ones for a negative omega^2.

    As finite-element programs print them: a mode of -3 rad/s has the poles +3 and -3 1/s.
    """
    return np.asarray(np.sign(squares) * np.sqrt(np.abs(squares)))


def signed_square(omega: FloatArray) -> FloatArray:
    """Return ``omega |omega|`` [1/s^2], the stiffness of mass-normalised modes."""
    return np.asarray(omega * np.abs(omega))


def rigid_shares(M: Any, motions: FloatArray, phi: FloatArray) -> FloatArray:
    """Return the parts (k,) of the kinetic energy of M-orthonormal shapes in rigid-body motions."""
    part = np.asarray(by_rows(M) @ motions).T @ phi
    return np.asarray(np.sum(part**2, axis=0))


def are_rigid(M: Any, motions: FloatArray, phi: FloatArray) -> np.ndarray:
    """Return which shapes (k,) are rigid-body motions but for 1 % of their kinetic energy."""
    return np.asarray(rigid_shares(M, motions, phi) > _RIGID)


def unstable_stiffness(K: Any, motions: FloatArray) -> FloatArray:
    """Return the negative eigenvalues [1/s^2] of ``R' K R``, R M-orthonormal rigid-body motions.

    There are as many as K has negative ones when these belong to rigid-body motion; they lie
    above those (Rayleigh, Courant).
    """
    if not motions.shape[1]:
        return np.zeros(0)
    energy = motions.T @ np.asarray(by_rows(K) @ motions)
    values = np.linalg.eigvalsh(0.5 * (energy + energy.T))
    return np.asarray(values[values < -10.0 * rounding_of(K, motions).max()])


def refuse_unstable(model: Any, what: str) -> None:
    """Raise ModelError when springs of negative stiffness make a model unstable."""
    count = int(getattr(model, "n_unstable", 0))
    if count:
        raise ModelError(
            f"springs of negative stiffness make {counted(count, 'rigid-body motion')} of "
            f"this structure unstable: {what} is for structures that are free or held. Do it with "
            "the free structure, then suspend the result: suspend(model, springs)."
        )

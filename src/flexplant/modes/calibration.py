"""Measured poles put into a model: its own shapes, the machine's frequencies and damping."""

from __future__ import annotations

from typing import Any

import numpy as np
import scipy.linalg as la

from ..checks import ComplexArray, FloatArray, IntArray
from ..errors import ModelError, SolverError, unknown_label

#: relative distance of the poles from those measured at which the search ends, and its most steps:
#: with coupling by damping of a share c of a pole's distance from the next an error falls by c
_REACHED, _STEPS = 1e-10, 50


def measured_poles(measured: Any, known: range) -> tuple[IntArray, ComplexArray]:
    """Return the places (m,) from 0 of measured modes among all, and their poles [rad/s].

    Raises
    ------
    ModelError, LabelError
        When they are no numbered measured poles, or a mode is not among those known.
    """
    poles, numbers = getattr(measured, "poles", None), getattr(measured, "modes", None)
    if poles is None or numbers is None:
        raise ModelError(
            "a model is calibrated by measured poles with the numbers of its modes, got "
            f"{type(measured).__name__}" + (" without numbers" if poles is not None else "") + ". "
            "Pass MeasuredModes(poles, modes=[...]), or flexplant.numbered(measured, model)."
        )
    for number in numbers:
        if number not in known:
            raise unknown_label("elastic mode", number, map(str, known))
    return np.asarray(numbers, dtype=np.int64) - 1, np.asarray(poles, dtype=np.complex128)


def calibrated_matrices(
    M: FloatArray, D: FloatArray, K: FloatArray, n_rigid: int, places: IntArray, poles: ComplexArray
) -> tuple[FloatArray, FloatArray]:
    """Return D and K with the poles of some modes as measured, and the shapes as they are.

    With phi of (K, M), ``K + M phi diag(omega_m^2 - omega^2) phi^T M`` and the same of D; the
    coupling of modes by D stays, so that the diagonal is searched for.

    Raises
    ------
    SolverError
        When damping couples the modes so much that no such diagonal is found.
    """
    phi = la.eigh(K, M)[1]
    stiff, damp = phi.T @ K @ phi, phi.T @ D @ phi
    square, rate = np.diag(stiff).copy(), np.diag(damp).copy()
    square[:n_rigid] = 0.0  # not the rounding of K
    square[places], rate[places] = np.abs(poles) ** 2, -2.0 * poles.real
    for _ in range(_STEPS):
        now = _poles_near(square, rate, damp, poles)
        if np.all(np.abs(now - poles) <= _REACHED * np.abs(poles)):
            moved = M @ phi[:, places]
            change_k = (moved * (square - np.diag(stiff))[places]) @ moved.T
            change_d = (moved * (rate - np.diag(damp))[places]) @ moved.T
            return D + 0.5 * (change_d + change_d.T), K + 0.5 * (change_k + change_k.T)
        square[places] += np.abs(poles) ** 2 - np.abs(now) ** 2
        rate[places] += 2.0 * (now.real - poles.real)
    raise SolverError(
        "damping couples the modes so much that no change of each alone gives them the measured "
        "poles. Update the dampers first (AddedDamping), or measure the coupled modes too."
    )


def _poles_near(
    square: FloatArray, rate: FloatArray, damp: FloatArray, wanted: ComplexArray
) -> ComplexArray:
    """Return the poles of ``p'' + (rate + coupling) p' + square p = 0`` next to those wanted."""
    C, scale = damp.copy(), np.sqrt(np.maximum(square, 0.0))
    np.fill_diagonal(C, rate)
    # balanced: speeds beside frequency times position, which rigid-body modes do not need
    A = np.block([[np.zeros_like(C), np.diag(scale)], [-np.diag(scale), -C]])
    found = np.linalg.eigvals(A)
    return np.asarray(found[np.argmin(np.abs(found[:, None] - wanted), axis=0)])

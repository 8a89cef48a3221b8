"""Which mode of a model a measured pole is."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np

from ..arguments import between
from ..errors import LabelError, ModelError
from ..labels import Place
from ..modes import Modes
from ..values import ComplexArray, FloatArray, instance, positive
from .measured import MeasuredModes

#: modes of a model nearer than this share are one family, whose shapes are known as a span only
FAMILY = 5e-3
#: and nearer than this one frequency, which only rounding splits
EQUAL = 1e-6


def numbered(
    measured: MeasuredModes,
    model: Any,
    *,
    at: Mapping[str, Place] | None = None,
    tolerance: float = 0.15,
    least_mac: float = 0.7,
    partial: bool = False,
) -> MeasuredModes:
    r"""Return measured modes with the numbers of the model's modes that they are.

    Pairs minimise the sum of ``(ln(f / f_model) / tolerance)^2 + 1 - MAC`` (Hungarian method),

    .. math:: MAC = \frac{|\phi^H \psi|^2}{(\phi^H\phi)(\psi^H\psi)}

    over the measured DOFs; for repeated modes of the model (within 0.5 %) it is the MAC with the
    nearest shape of their span, which cannot distinguish them: they are numbered by frequency, and
    where fewer poles than modes of one frequency are measured, by the lowest numbers.

    Parameters
    ----------
    measured : MeasuredModes
        With shapes, or paired by frequency alone.
    model : Modes, or a model with `.modes()`
        Its modes are numbered from 1, rigid-body modes included.
    at : mapping {label of a shape's row: place}, optional
        Where the rows of the shapes are; by default their labels are DOFs of the model.
    tolerance : float
        Largest relative difference of frequencies in a pair.
    least_mac : float
        Smallest MAC in a pair.
    partial : bool
        Leave out poles without a partner instead of refusing them: modes above half the
        sampling rate fold into the band of a sampled measurement, and no model has them there.

    Returns
    -------
    MeasuredModes
        Of the same kind, in the same order, with `modes`.

    Raises
    ------
    ModelError
        When a pole has no partner (all of them, when `partial`), or an argument is out of range.
    LabelError
        When a shape's row is not known to the model.

    References
    ----------
    [Allemang2003]_.

    Examples
    --------
    >>> import flexplant as fx
    >>> modes = fx.solve_modes(fx.chain(masses=[1.0, 1.0, 1.0], stiffnesses=[4e5, 4e5]), count=3)
    >>> model = fx.reduce(modes, fx.DesiredDofs(["1:x", "2:x", "3:x"]))
    >>> shape = [[1.0], [0.02], [-1.0]]
    >>> measured = fx.MeasuredModes(poles=[-6 + 630j], shapes=shape, dofs=["1:x", "2:x", "3:x"])
    >>> fx.numbered(measured, model).modes
    (2,)
    """
    import scipy.optimize as so

    instance(measured, MeasuredModes, "measured", "Pass identify_modes(frf).")
    modes = model.modes() if hasattr(model, "modes") and not isinstance(model, Modes) else model
    instance(modes, Modes, "model", "Solve it first: solve_modes(model, count=...).")
    width = positive(tolerance, "tolerance")
    least_mac = between(least_mac, "least_mac", 0.0, 1.0, "Try 0.5.", ends="[")
    elastic = np.flatnonzero(modes.omega > 0)
    if not elastic.size:
        raise ModelError("the model has no elastic modes to compare with.")
    distance = np.abs(np.log(measured.freq[:, None] / modes.freq[elastic]))
    alike = _likeness(measured, modes, elastic, at)
    allowed = (distance <= width) & (alike >= least_mac)
    cost = np.where(allowed, (distance / width) ** 2 + 1.0 - alike, 1e6)
    rows, columns = so.linear_sum_assignment(cost)
    pairs = {
        int(i): int(elastic[j]) + 1 for i, j in zip(rows, columns, strict=True) if allowed[i, j]
    }
    lost = [i for i in range(len(measured)) if i not in pairs]
    if lost and (not partial or not pairs):
        worst = lost[0]
        near = elastic[int(np.argmin(distance[worst]))]
        raise ModelError(
            f"no mode of the model of its own within {width:.0%} and a MAC of {least_mac:g} for "
            f"the poles at {[round(float(measured.freq[i]), 2) for i in lost[:6]]} Hz; nearest to "
            f"the first is mode {near + 1} at {modes.freq[near]:.5g} Hz with a MAC of "
            f"{alike[worst, int(np.argmin(distance[worst]))]:.2f}. Add modes to the model, loosen "
            "tolerance=, or leave these poles out with partial=True."
        )
    _in_order(pairs, measured.freq, modes.omega)
    kept = sorted(pairs)
    chosen = measured if len(kept) == len(measured) else measured.select(kept)
    return chosen.replace(modes=tuple(pairs[i] for i in kept))


def _in_order(pairs: dict[int, int], freq: FloatArray, omega: FloatArray) -> None:
    """Give the numbers of each family of modes to its poles by frequency; rounding chose else."""
    free = sorted(pairs, key=lambda i: pairs[i])
    while free:
        first = pairs[free[0]] - 1
        family = [i for i in free if omega[pairs[i] - 1] <= omega[first] * (1.0 + FAMILY)]
        free = free[len(family) :]
        numbers = _lowest([pairs[i] for i in family], omega, set(pairs.values()))
        pairs.update(zip(sorted(family, key=lambda i: float(freq[i])), numbers, strict=True))


def _lowest(numbers: list[int], omega: FloatArray, taken: set[int]) -> list[int]:
    """Return rising numbers, each the lowest free one of the modes of its frequency."""
    lowest = []
    for number in numbers:
        taken.discard(number)
        equal = np.flatnonzero(np.abs(omega / omega[number - 1] - 1.0) <= EQUAL) + 1
        lowest.append(next(int(n) for n in equal if n not in taken))
        taken.add(lowest[-1])
    return lowest


def _likeness(measured: MeasuredModes, modes: Modes, elastic: Any, at: Any) -> FloatArray:
    if measured.shapes is None or measured.dofs is None:
        return np.ones((len(measured), elastic.size))
    if at is not None and not isinstance(at, Mapping):
        raise LabelError(f"at is a mapping from the labels of shapes to places, got {at!r:.60}.")
    places = [(at or {}).get(label, label) for label in measured.dofs]
    phi: ComplexArray = np.array(
        [modes.at(place)[elastic] for place in places], dtype=np.complex128
    )
    unit = measured.shapes / np.linalg.norm(measured.shapes, axis=0)
    alike = np.zeros((len(measured), elastic.size))
    omega = modes.omega[elastic]
    for j in range(elastic.size):
        family = np.flatnonzero(np.abs(omega / omega[j] - 1.0) <= FAMILY)
        basis, size, _ = np.linalg.svd(phi[:, family], full_matrices=False)
        basis = basis[:, size > 1e-9 * max(float(size[0]), 1e-300)]
        alike[:, j] = np.linalg.norm(basis.conj().T @ unit, axis=0) ** 2
    return alike

"""Whether sensors determine forces that nothing is assumed of: ranks and invariant zeros."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
import scipy.linalg as la

from ..arrays import ComplexArray, FloatArray
from ..errors import AssumptionError, require_known
from ..lti.equations import state_scale
from ..lti.statespace import System
from ..plant import AnyPlant
from ..plant.partitioned import require_sampled
from ..store import Value
from ..tolerances import SAME, SPLIT, TINY, TYPED, divisor
from ..words import check_names, name_list
from .estimator_channels import checked_plant
from .filter_models import FilterModel, filter_model


class InputEntry(NamedTuple):
    """How unknown inputs enter: ``x+ = A x + B u + G d``, ``y = C2 x + D2 u + H d``."""

    G: FloatArray
    H: FloatArray
    at_pois: FloatArray


@dataclass(frozen=True, eq=False, repr=False)
class InvertibilityReport(Value):
    """Whether sensors determine unknown inputs d held over each sample, and how late.

    Parameters
    ----------
    inputs, sensors : tuples of str
        Names of d and y.
    rank_direct : int
        Of H: how many combinations of d reach y in their own sample.
    rank_delayed : int
        Of C2 G: how many reach y one sample later.
    delay : int or None
        Samples from an input to its estimate: 0 when H has full rank, 1 when H is zero and C2 G
        has full rank; None when neither holds, so that no unbiased filter exists.
    zeros : array of complex
        Invariant zeros from d to y on or outside the unit circle, upper half plane: motions of d
        and x together that leave y at rest and do not decay. Empty when delay is None.
    dt : float [s]
        Sampling time.
    """

    inputs: tuple[str, ...]
    sensors: tuple[str, ...]
    rank_direct: int
    rank_delayed: int
    delay: int | None
    zeros: ComplexArray
    dt: float

    def __repr__(self) -> str:
        holds = "holds" if self.holds else "does not hold"
        return f"<InvertibilityReport {holds}: {self.text}>"

    @property
    def holds(self) -> bool:
        """Whether a stable unbiased filter of x and d exists."""
        return self.delay is not None and not self.zeros.size

    @property
    def text(self) -> str:
        """The condition in words."""
        m, names = len(self.inputs), ", ".join(self.inputs)
        if m > len(self.sensors):
            return f"{m} unknown inputs ({names}) need as many sensors, there are " + str(
                len(self.sensors)
            )
        ranks = f"D has rank {self.rank_direct}, C B has rank {self.rank_delayed} of {m}"
        if self.delay is None and self.rank_direct:
            return (
                f"{ranks}: some combinations of {names} reach the sensors at once and some later, "
                "so no filter with one delay is unbiased"
            )
        if self.delay is None:
            return f"{ranks}: combinations of {names} reach no sensor within one sample"
        if self.zeros.size:
            shown = "; ".join(self._described(zero) for zero in self.zeros[:3])
            return f"{ranks}, but the sensors stay at rest for {shown}"
        late = "in its own sample" if not self.delay else "one sample late"
        return f"{ranks}: {names} is determined {late}, no zero on or outside the unit circle"

    def _described(self, zero: complex) -> str:
        size = abs(zero)
        grows = f" that grows by {size:.6g} per sample" if size > 1 + SPLIT else ""
        # a double zero at 1 comes out at the root of rounding times its condition
        if abs(zero - 1) < 1e-5:
            return "a constant force (zero at 1: no sensor sees a displacement that it makes)"
        if zero.real < 0 and abs(zero.imag) < SPLIT * size:
            return f"a force of alternating sign{grows} (zero at {zero.real:.6g}, by the sampling)"
        if abs(zero.imag) < SPLIT * size:
            return f"a force{grows} (zero at {zero.real:.6g})"
        freq = abs(np.angle(zero)) / (2 * np.pi * self.dt)
        return f"a force of {freq:.4g} Hz{grows}"


def invertibility(plant: AnyPlant | System, inputs: Sequence[str]) -> InvertibilityReport:
    """Return whether the sensors determine disturbances that nothing is assumed of.

    With d held over each sample, ``x+ = A x + G d``, ``y = C x + H d``, an unbiased filter with
    minimum variance exists when H has full column rank (d is then estimated in its own sample), or
    when H = 0 and C G has (one sample late); it is stable when the invariant zeros

    ``rank [z I - A, -G; C, H] < n + m``

    all lie inside the unit circle. Displacement sensors see the square of the sampling time of a
    force within a sample: with as many sensors as forces the sampling itself makes zeros near -1.
    More sensors than forces, or an acceleration sensor beside displacement sensors, have none.

    Parameters
    ----------
    plant : StandardPlant
        Sampled.
    inputs : sequence of str
        Disturbances in w.

    Returns
    -------
    InvertibilityReport

    Raises
    ------
    AssumptionError
        When the plant is continuous, or has no sensor or POI.
    ModelError
        When the plant is weighted.

    Examples
    --------
    >>> import flexplant as fx
    >>> found = fx.estimation.invertibility(fx.testbeds.three_masses(), ["amp"])
    >>> found.holds, found.rank_direct, found.rank_delayed, found.delay
    (True, 0, 1, 1)
    """
    plant = checked_plant(plant)
    names = unknown_names(plant, inputs)
    return ranks_and_zeros(filter_model(plant), input_entry(plant, names), names)


def unknown_names(plant: AnyPlant, inputs: Sequence[str]) -> tuple[str, ...]:
    """Return the names of unknown inputs, each a disturbance of w."""
    require_sampled(plant, "unknown inputs are held over samples")
    names = name_list(inputs, "unknown inputs")
    check_names(names, "unknown inputs")
    forces = [w for w in plant.w if w not in plant.y and not w.endswith(":noise")]
    require_known("disturbance of w", names, forces)
    if not names:
        raise AssumptionError(
            f"no unknown input is named: pass some of {', '.join(forces) or 'none'}."
        )
    return names


def input_entry(plant: AnyPlant, names: Sequence[str]) -> InputEntry:
    """Return how disturbances, held over each sample, enter states, sensors and POIs."""
    g, m = plant.system, filter_model(plant)
    columns = g.input_index(names)
    rows = g.output_index(m.sensors), g.output_index(m.channels)
    return InputEntry(g.B[:, columns], *(g.D[np.ix_(row, columns)] for row in rows))


def ranks_and_zeros(
    model: FilterModel, d: InputEntry, names: tuple[str, ...]
) -> InvertibilityReport:
    """Return ranks and zeros; see `invertibility`."""
    out = 1.0 / np.sqrt(np.maximum(model.R.diagonal(), TINY))[:, None]
    C, H = out * model.C2, out * d.H
    direct, delayed, m = _rank(H), _rank(C @ d.G), len(names)
    delay = 0 if direct == m else 1 if not direct and delayed == m else None
    zeros = np.zeros(0, dtype=np.complex128)
    if delay is not None:
        zeros = _zeros(model.A, d.G, C, H if delay == 0 else C @ d.G, delay)
    return InvertibilityReport(names, model.sensors, direct, delayed, delay, zeros, model.dt)


def _rank(matrix: FloatArray) -> int:
    """Return the rank, columns and rows of unit size."""
    return int(np.linalg.matrix_rank(_unit_sized(matrix)[0], tol=SAME))


def _unit_sized(matrix: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Return a matrix with columns and then rows of unit size, and the sizes of its columns."""
    columns = divisor(np.linalg.norm(matrix, axis=0))
    scaled = matrix / columns
    return scaled / divisor(np.linalg.norm(scaled, axis=1, keepdims=True)), columns


def _zeros(A: FloatArray, G: FloatArray, C: FloatArray, F: FloatArray, delay: int) -> ComplexArray:
    """Return the zeros that do not decay: modes of A - G F^+ C (or ... C A) that C does not see."""
    # with d eliminated by what it does first, `d = -F^+ C x` or `-F^+ C A x`, they are the modes of
    # the rest that the sensors do not see
    size = np.linalg.norm(F, axis=0)
    left = np.linalg.pinv(F / size) / size[:, None]
    inner = A - G @ left @ (C if delay == 0 else C @ A)
    seen = C - F @ left @ C if delay == 0 else C
    d = state_scale(inner, G / size, C)
    inner, seen = inner * d / d[:, None], seen * d
    rows = np.linalg.norm(C * d, axis=1, keepdims=True)
    seen = seen / divisor(rows)
    found: list[complex] = []
    for value in la.eigvals(inner):
        size_of = abs(value)
        if size_of < 1 - 1e-5 or value.imag < -1e-9:  # well inside, or a conjugate
            continue
        near = 1.0 if abs(value - 1) < 1e-4 else value  # Jordan blocks come out at the root
        if abs(near) < 1 - SPLIT or any(abs(near - other) < SPLIT for other in found):
            continue
        test = np.vstack([near * np.eye(len(inner)) - inner, seen])
        columns = np.linalg.norm(test, axis=0)
        if la.svdvals(test / divisor(columns))[-1] < SAME:
            found.append(complex(near))
    return np.array(found, dtype=np.complex128)


def check_bias(plant: AnyPlant | System, inputs: Sequence[str]) -> None:
    """Raise AssumptionError, with the names, when sensors do not determine constant forces.

    A constant force d is seen unless some x and d leave the machine at rest and y at zero, or it
    moves a free machine along an axis that the sensors do not see::

        rank [A - I, G; C2, H] < n + m

    A filter with such a bias as a state (`RandomWalk(...).rigid("bias:rx", "rx")` in w) does not
    reduce its variance: what an unseen bias does at a POI is an error that no gain removes.

    Parameters
    ----------
    plant : StandardPlant
        Sampled.
    inputs : sequence of str
        Disturbances in w, such as the forces on rigid-body axes.

    Raises
    ------
    AssumptionError
        When a force, or a combination of them, is not seen, or a rigid-body motion is not; or the
        plant is continuous.
    ModelError
        When the plant is weighted.

    Examples
    --------
    >>> import flexplant as fx
    >>> fx.estimation.check_bias(fx.testbeds.three_masses(), ["amp"])  # seen
    """
    plant = checked_plant(plant)
    names = unknown_names(plant, inputs)
    plant.check().require(("detectable",), "an estimate of a bias")
    missing = _unseen_forces(plant, names)
    if not missing.shape[1]:
        return
    listed = []
    for column in sorted(missing.T, key=lambda one: int(np.argmax(np.abs(one)))):
        # what takes no part in a motion comes out as rounding
        parts = np.flatnonzero(np.abs(column) > 1e-6 * np.abs(column).max())
        listed.append(" + ".join(f"{column[i]:.3g} {names[i]}" for i in parts))
        if parts.size == 1:
            listed[-1] = names[int(parts[0])]
    raise AssumptionError(
        f"the sensors do not show constant forces along {'; '.join(listed)}: such a bias cannot be "
        "distinguished from none, and its variance does not fall. Add a displacement sensor that "
        "moves with that axis, or leave the bias out."
    )


def _unseen_forces(plant: AnyPlant, names: Sequence[str]) -> FloatArray:
    """Return the combinations (m, k) of constant forces that leave y at zero, in reduced form."""
    m, d = filter_model(plant), input_entry(plant, names)
    n = len(m.A)
    noise = 1.0 / np.sqrt(np.maximum(m.R.diagonal(), TINY))[:, None]
    whole = np.block([[m.A - np.eye(n), d.G], [noise * m.C2, noise * d.H]])
    scaled, columns = _unit_sized(whole)
    _, sizes, right = np.linalg.svd(scaled)
    null = right[sizes.size - np.count_nonzero(sizes < SAME) :, n:]
    # what is left at rest without a force is no bias
    _, parts, combinations = np.linalg.svd(null)
    forces = combinations[: np.count_nonzero(parts > TYPED)]
    forces = forces / columns[n:]
    # one axis for each combination, taken out of the others
    for row in range(len(forces)):
        axis = int(np.argmax(np.abs(forces[row])))
        forces[row] /= forces[row, axis]
        share = np.where(np.arange(len(forces)) == row, 0.0, forces[:, axis])
        forces -= np.outer(share, forces[row])
    return np.asarray(forces.T)

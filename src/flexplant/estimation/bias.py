"""Which slow disturbances the sensors determine, axis by axis."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from ..errors import AssumptionError
from ..lti.statespace import System
from ..plant import StandardPlant
from ..values import FloatArray
from .estimator_channels import checked_plant
from .filter_model import filter_model
from .invertibility import entry, unknown_names

#: singular values below this part of a column of unit size are rounding
_UNSEEN = 1e-9
#: part of the force in a motion of unit size that leaves the sensors at zero, above which it counts
_PART = 1e-6


def check_bias(plant: StandardPlant | System, inputs: Sequence[str]) -> None:
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
    LabelError
        When a name is no disturbance of w.
    ModelError
        When the plant is weighted.

    Examples
    --------
    >>> import flexplant as fx
    >>> try:
    ...     fx.estimation.check_bias(fx.testbeds.three_masses(), ["amp", "amp"])
    ... except fx.FlexplantError as error:
    ...     print(type(error).__name__)
    LabelError
    """
    plant = checked_plant(plant)
    names = unknown_names(plant, inputs)
    plant.check().require(("detectable",), "an estimate of a bias")
    missing = _unseen(plant, names)
    if not missing.shape[1]:
        return
    listed = []
    for column in sorted(missing.T, key=lambda one: int(np.argmax(np.abs(one)))):
        parts = np.flatnonzero(np.abs(column) > 1e-6 * np.abs(column).max())
        listed.append(" + ".join(f"{column[i]:.3g} {names[i]}" for i in parts))
        if parts.size == 1:
            listed[-1] = names[int(parts[0])]
    raise AssumptionError(
        f"the sensors do not show constant forces along {'; '.join(listed)}: such a bias cannot be "
        "distinguished from none, and its variance does not fall. Add a displacement sensor that "
        "moves with that axis, or leave the bias out."
    )


def _unseen(plant: StandardPlant, names: Sequence[str]) -> FloatArray:
    """Return the combinations (m, k) of constant forces that leave y at zero, in reduced form."""
    m, d = filter_model(plant), entry(plant, names)
    n = len(m.A)
    noise = 1.0 / np.sqrt(np.maximum(m.R.diagonal(), 1e-300))[:, None]
    whole = np.block([[m.A - np.eye(n), d.G], [noise * m.C2, noise * d.H]])
    columns = np.linalg.norm(whole, axis=0)
    whole = whole / np.where(columns > 0, columns, 1.0)
    rows = np.linalg.norm(whole, axis=1, keepdims=True)
    _, sizes, right = np.linalg.svd(whole / np.where(rows > 0, rows, 1.0))
    null = right[sizes.size - np.count_nonzero(sizes < _UNSEEN) :, n:]
    # what is left at rest without a force is no bias
    _, parts, combinations = np.linalg.svd(null)
    forces = combinations[: np.count_nonzero(parts > _PART)]
    forces = forces / np.where(columns[n:] > 0, columns[n:], 1.0)
    # one axis for each combination, taken out of the others
    for row in range(len(forces)):
        axis = int(np.argmax(np.abs(forces[row])))
        forces[row] /= forces[row, axis]
        for other in range(len(forces)):
            if other != row:
                forces[other] -= forces[other, axis] * forces[row]
    return np.asarray(forces.T)

"""A real uncertainty on a mode, and the plant with modes changed by it."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Literal

import numpy as np

from ...errors import ModelError
from ...values import Value
from ..building import P, rebuilt
from ..partition import Partition
from ..realisation import MODAL, ModalRealisation


@dataclass(frozen=True, eq=False)
class Delta(Value):
    """One real uncertainty, ``w = delta z`` with ``|delta| <= 1``.

    Parameters
    ----------
    name : str
        Of the channels: `mode6:freq` has the input `mode6:freq:w` and the output `mode6:freq:z`.
    mode : int
        Number of the mode, from 1, rigid-body modes included.
    kind : {"freq", "damping"}
        Stiffness ``omega^2 (1 + scale delta)`` or damping ``2 zeta omega (1 + scale delta)``.
    scale : float
        Relative change at delta = 1.
    """

    name: str
    mode: int
    kind: Literal["freq", "damping"]
    scale: float


def modal_realisation(plant: Partition) -> ModalRealisation:
    """Return the modes of a plant, each of which has its own frequency and damping.

    Raises
    ------
    ModelError
        When the plant is weighted or made elsewhere, or damping couples its modes.
    """
    if plant.is_weighted:
        raise ModelError("the plant is weighted: uncertain modes are those of plant.unweighted.")
    realisation = plant.assembled.realisation
    if plant.form != MODAL:
        raise ModelError(
            f"the modes of this plant are coupled by damping ({plant.form}): frequency and "
            "damping of one mode are not its own, so that no Delta belongs to it. Draw machines "
            "from the fit itself (its parameters and covariance), or lower the damping."
        )
    return realisation


def with_changes(plant: P, changes: Sequence[tuple[Delta, float]]) -> P:
    """Return the plant with modes' stiffness or damping changed by some relative amounts.

    Rows [1, 0] and [a00 / s, 1] of a block [[a00, s], [a10, a11]] are a mode's displacement and
    its rate over s; only the second row of the block changes, whatever its form.
    """
    realisation = modal_realisation(plant)
    pairs = np.array(realisation.pairs)
    for delta, amount in changes:
        if not amount > -1:
            raise ModelError(
                f"{delta.name} = {amount / delta.scale:.4g} leaves mode {delta.mode} with negative "
                f"{'stiffness' if delta.kind == 'freq' else 'damping'}."
            )
        nominal = realisation.pairs[delta.mode - 1]
        s = nominal[0, 1]
        if delta.kind == "freq":
            row = np.array([np.linalg.det(nominal) / s, 0.0])
        else:
            row = -np.trace(nominal) * np.array([nominal[0, 0] / s, 1.0])
        pairs[delta.mode - 1, 1] -= amount * row
    return rebuilt(plant, realisation=realisation.replace(pairs=pairs))

"""The kinetic energy of the modes where sensors are."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np

from ..errors import ModelError
from ..plant import StandardPlant
from ..reduction import ReducedModel
from ..structure import FEModel
from ..values import short
from .candidate_shapes import ByShapes, Shapes
from .summed import SummedWorth


@dataclass(frozen=True, eq=False, repr=False)
class KineticEnergy(ByShapes):
    """Minus the part of the elastic modes' kinetic energy at the sensors.

    ``sum_i sum_k (r_i phi_k) (r_i M phi_k)``, 1 for each mode over all DOFs: places that move much,
    and are heavy. Each place counts by itself, so that neighbours that see the same are both
    chosen. Of a POI it says next to nothing, as `ModeInformation`.

    Parameters
    ----------
    model : FEModel, optional
        Of the mass matrix; not needed where the plant was assembled from matrices or a reduced
        model.

    Raises
    ------
    ModelError
        When the model is no structure; when called, where no mass matrix is known or it is of
        another structure.

    References
    ----------
    [Kammer1991]_.

    Examples
    --------
    >>> import flexplant as fx
    >>> plant = fx.testbeds.three_masses()
    >>> candidates = [fx.Sensor(f"s{i}", at=f"{i}:x", direction="x", asd=1e-10) for i in (1, 2, 3)]
    >>> masses = fx.chain(masses=[1.0, 1.0, 1.0], stiffnesses=[4e5, 4e5])
    >>> fx.place_sensors(plant, candidates, 2, fx.placement.KineticEnergy(masses)).chosen
    ('s1', 's3')
    """

    model: Any = None

    def __post_init__(self) -> None:
        if not isinstance(self.model, FEModel | ReducedModel | None):
            raise ModelError(f"model must be an FEModel, got {short(self.model)}. Pass one.")

    def __repr__(self) -> str:
        return f"KineticEnergy({'' if self.model is None else 'model=...'})"

    def of(self, plant: StandardPlant, shapes: Shapes) -> SummedWorth:
        """Return the energy of choices."""
        model = plant.assembled.realisation.model if self.model is None else self.model
        if not isinstance(model, FEModel | ReducedModel):
            raise ModelError(
                "the plant was assembled from modes, which have no mass matrix. Pass "
                "KineticEnergy(model), the FEModel that they are of."
            )
        if model.M.shape[0] != shapes.full.shape[0]:
            raise ModelError(
                f"the model has {model.M.shape[0]} DOFs, the plant's {shapes.full.shape[0]}: pass "
                "the one that the plant's modes are of."
            )
        moving = shapes.phi[:, shapes.elastic] * (
            shapes.rows @ (model.M @ shapes.full[:, shapes.elastic])
        )
        return SummedWorth(np.sum(moving, axis=1))

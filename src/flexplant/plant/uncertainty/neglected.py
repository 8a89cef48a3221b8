"""The modes that a plant lacks, as a kind of uncertainty."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any

from ...arrays import whole
from ...errors import ModelError
from ..partitioned import Partition, is_plant
from .delta import Uncertainty
from .neglected_dynamics import NeglectedModes, neglected_modes


@dataclass(frozen=True, eq=False)
class Neglected(Uncertainty):
    """The modes that a plant lacks: one dynamic Delta with weights that bound their effect.

    The machines ``plant.machines``, which are drawn at random, have these modes. Deltas of modes
    act on the modes with the same numbers. If parameters of the plant's own model are drawn,
    however, the machines do not have the neglected modes.

    Parameters
    ----------
    model : StandardPlant, FEModel, Modes, ReducedModel or NeglectedModes, optional
        Model of the same machine with more modes. Additive weights bound its difference from the
        plant, from w and u to z and y (see `NeglectedModes`). A structure gets the plant's ports; a
        plant must have the same channels. By default this is the plant's evaluation model.
    resonances : int
        Number of neglected modes that the weights follow.

    Raises
    ------
    ModelError, CertificateError
        When the model has other channels, does not differ from the plant, or differs in its
        rigid-body modes. Also when the bound cannot be verified.

    Examples
    --------
    >>> import flexplant as fx
    >>> model = fx.chain(masses=[1.0] * 4, stiffnesses=[4e5] * 3)
    >>> modes = fx.solve_modes(model, count=4, damping=fx.ModalDamping(0.01))
    >>> ports = fx.testbeds.three_masses().assembled.ports
    >>> plant = fx.assemble_plant(modes.select([0, 1, 2]), ports)
    >>> plant.uncertain(fx.plant.Neglected(modes), frequency=0.01).neglected.outputs
    ('die:x', 'y1', 'y2')
    """

    model: Any = None
    resonances: int = field(default=24, kw_only=True)

    def __post_init__(self) -> None:
        self._set(resonances=whole(self.resonances, "resonances"))

    def bound(self, plant: Partition) -> NeglectedModes:
        """Return the weights that bound the effect of the neglected modes."""
        if isinstance(self.model, NeglectedModes):
            return self.model
        return neglected_modes(plant, self._whole(plant), resonances=self.resonances)

    def larger(self, plant: Partition) -> Any:
        """Return the plant with the neglected modes; None if only a bound is known."""
        return None if isinstance(self.model, NeglectedModes) else self._whole(plant)

    def _whole(self, plant: Any) -> Any:
        """Return the plant with the modes."""
        if self.model is not None and is_plant(self.model):
            return self.model
        judged = plant if self.model is None else plant.replace(evaluation=self.model)
        found = judged.evaluation_plant
        if found is None:
            raise ModelError(
                "the plant has no evaluation model, so that it is not known which modes it lacks. "
                "Pass plant.Neglected(model), or assemble_plant(model, ports, evaluation=model)."
            )
        return found

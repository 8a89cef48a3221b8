"""The evaluation model of a plant: a larger model of the same machine, which judges answers."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from typing import Any

from ..lti.statespace import StateSpace
from ..modes import Modes
from ..reduction import ReducedModel
from ..store import Value
from ..structure import FEModel
from ..structure.rigid import Structure
from ..words import instance
from .ports import Ports
from .realisation import ModalRealisation, plant_modes

#: what a result of a plant without an evaluation model says
NOT_JUDGED = "not judged on a larger model"
_HINT = "Pass Modes, an FEModel, a ReducedModel or a StandardPlant."


@dataclass(frozen=True, eq=False)
class EvaluationModel(Value):
    """A model of the machine with the modes that the design model of a plant lacks.

    Made by ``assemble_plant(model, ports, evaluation=source)``. Every plant that is made from that
    plant has it too; `StandardPlant.evaluation_plant` is this model with the plant's channels.

    Parameters
    ----------
    source : Modes, FEModel, ReducedModel or StandardPlant
        The larger model. If it is a structure, the ports of the plant are applied to it. If it is a
        reduced model, the modes that it left out are included. If it is a plant, it must have the
        same channels as the plant that is judged on it.
    ports : Ports, optional
        Ports that replaced those of the plant after its assembly. A source that is a plant gets
        these ports too.

    Examples
    --------
    >>> import flexplant as fx
    >>> modes = fx.solve_modes(fx.chain(masses=[1.0] * 4, stiffnesses=[4e5] * 3), count=4)
    >>> ports = fx.testbeds.three_masses().assembled.ports
    >>> plant = fx.assemble_plant(modes.select([0, 1]), ports, evaluation=modes)
    >>> plant.evaluation.source.n_modes
    4
    """

    source: Any
    ports: Ports | None = None

    @classmethod
    def of(cls, given: Any) -> EvaluationModel | None:
        """Return the argument `evaluation` of `assemble_plant` as an EvaluationModel.

        For None the result is None.
        """
        if given is None or isinstance(given, cls):
            return given
        given = getattr(given, "nominal", given)
        if not is_channelled(given):
            instance(given, FEModel | Modes | ReducedModel, "evaluation", _HINT)
        return cls(given)

    @classmethod
    def known_to(cls, model: Structure) -> EvaluationModel | None:
        """Return a ReducedModel with its truncated modes as an evaluation model, or None.

        The result is None for other models, and if the reduced model has not kept its truncated
        modes.
        """
        known = isinstance(model, ReducedModel) and model.truncated is not None
        return cls(model) if known else None

    @property
    def is_structure(self) -> bool:
        """Whether the source is a structure, to which the ports of the plant are applied."""
        return not is_channelled(self.source)

    def with_ports(self, ports: Ports) -> EvaluationModel:
        """Return the same evaluation model with other ports."""
        return self if self.is_structure else self.replace(ports=ports)

    @cached_property
    def realisation(self) -> ModalRealisation:
        """The modes of a structure, solved once for all plants that are judged on it."""
        given = self.source
        return plant_modes(given.completed() if isinstance(given, ReducedModel) else given)

    @property
    def text(self) -> str:
        """The model in a few words."""
        kind = type(self.source).__name__
        count = getattr(self.source, "n_modes", None)
        return kind if count is None else f"{kind}, {count} modes"


def is_channelled(given: object) -> bool:
    """Return whether it is a plant or a system with labels, not a structure."""
    if isinstance(given, FEModel | Modes | ReducedModel):
        return False  # `hasattr` is slow here: it makes the message with similar names
    return hasattr(given, "Gyu") or isinstance(given, StateSpace) or hasattr(given, "input_labels")

"""One real uncertainty of a plant: how it changes the machine, and the channels that open it."""

from __future__ import annotations

import warnings
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, ClassVar, TypeAlias

import numpy as np

from ...arrays import FloatArray
from ...errors import FlexplantWarning
from ...lti.statespace import as_statespace
from ...store import Value
from ..building import P, sampled
from ..forces import Actuator
from ..partitioned import Partition
from ..port import ForcePort, SensorPort
from ..ports import Poi, Ports
from ..realisation import ModalRealisation, plant_modes
from ..remade import rebuilt
from .channels import EvenUnits, Opened, with_parts

Port: TypeAlias = ForcePort | SensorPort | Poi


@dataclass(frozen=True, eq=False, repr=False)
class MachineParts(Value):
    """What a machine is assembled from, which Deltas change: modes, ports, and delay.

    Parameters
    ----------
    plant : StandardPlant
        The nominal plant.
    realisation : ModalRealisation
        Modes; their blocks (b, 2, 2) are those of `pairs`.
    pairs : (b, 2, 2) array [rad/s]
    ports : Ports
        Its ports; `with_port` and `with_gain` change one.
    model : FEModel or ReducedModel, optional
        A model with other matrices, whose modes are then solved again in place of `realisation`.
    late : float [samples]
        Change of the delay.

    Examples
    --------
    >>> import flexplant as fx
    >>> plant = fx.testbeds.three_masses()
    >>> machine = fx.plant.MachineParts.of(plant).with_gain("u1", 1.1)
    >>> machine.assembled().Gyu.D.shape == plant.Gyu.D.shape
    True
    """

    plant: Partition
    realisation: ModalRealisation
    pairs: FloatArray
    ports: Ports
    model: Any = None
    late: float = 0.0

    @classmethod
    def of(cls, plant: Partition) -> MachineParts:
        """Return the nominal machine of a plant."""
        own = plant.assembled
        return cls(plant, own.realisation, own.realisation.pairs, own.ports)

    def with_port(self, port: Port) -> MachineParts:
        """Return the machine with a port in place of the one of its name: at another place, say."""
        side = [port if one.name == port.name else one for one in getattr(self.ports, port.home)]
        return self.replace(ports=self.ports.replace(**{port.home: side}))

    def with_gain(self, name: str, gain: float) -> MachineParts:
        """Return the machine with the gain of an actuator or sensor times a number."""
        every: tuple[Actuator | SensorPort, ...] = (*self.ports.u, *self.ports.y)
        port = next(one for one in every if one.name == name)
        part = as_statespace([[1.0]]) if port.dynamics is None else port.dynamics
        # states as before: a command is scaled before the filter, a reading behind it
        driven = {"B": gain * part.B} if isinstance(port, ForcePort) else {"C": gain * part.C}
        return self.with_port(port.replace(dynamics=part.replace(D=gain * part.D, **driven)))

    def assembled(self) -> Any:
        """Return the plant of the machine, with the nominal one's ports and sampled like it."""
        plant, realisation = self.plant, self.realisation
        if self.model is not None:
            with warnings.catch_warnings():  # the nominal plant has said in which form it is
                warnings.simplefilter("ignore", FlexplantWarning)
                realisation = plant_modes(self.model)
        elif not np.array_equal(self.pairs, realisation.pairs):
            realisation = realisation.replace(pairs=self.pairs)
        ports = None if self.ports is plant.assembled.ports else self.ports
        if not self.late:
            return rebuilt(plant, ports=ports, realisation=realisation)
        fresh = rebuilt(plant.continuous, ports=ports, realisation=realisation)
        return sampled(fresh, 1.0 / plant.dt, plant.delay + self.late)


@dataclass(frozen=True, eq=False)
class Delta(Value):
    """One real uncertainty, ``w = delta z`` with ``|delta| <= 1``.

    A new kind says by `changed` what a machine is at an amount, for example by `with_port`. Its
    channels are then read off the plants at both ends, so that [A B; C D] must be affine in the
    amount, or a fraction of it: the row of a sensor that moves is taken as linear between the ends,
    ``at={p: 1.0, p + h: a / 2, p - h: -a / 2}``. A kind with other channels has its own `opened`.

    Parameters
    ----------
    name : str
        Prefix of the channel names: `mode6:freq` has the input `mode6:freq:w` and the output
        `mode6:freq:z`.
    scale : float
        Change at delta = 1: relative; for a parameter in its unit, for the delay in samples.
    mode : int
        Number of the mode, from 1, rigid-body modes included; 0 of what is not of a mode.

    Examples
    --------
    >>> import flexplant as fx
    >>> one = fx.testbeds.three_masses().uncertain(frequency=0.01).deltas[0]
    >>> one.name, one.scale  # of the stiffness
    ('mode2:freq', 0.02)
    """

    name: str
    scale: float
    mode: int = 0

    #: the kind of quantity that changes, for tables
    kind: ClassVar[str] = ""
    #: Deltas of a lower stage are applied first: 0 matrices, 1 poles, 2 shapes and places, 3 gains,
    #: 4 the delay
    stage: ClassVar[int] = 1
    #: whether it changes the matrices or shapes of the plant's own model, not of a larger one
    of_own_model: ClassVar[bool] = False
    #: whether its channels act on what those of all others do, exactly: of a sampled plant too
    outermost: ClassVar[bool] = False

    def changed(self, machine: MachineParts, amount: float) -> MachineParts:
        """Return a machine that is off by an amount, in the unit of `scale`."""
        raise NotImplementedError(f"{type(self).__name__} must say by `changed` what it changes.")

    def amount(self, drawn: float) -> float:
        """Return the amount of a number drawn, which is 1 at `scale`."""
        return self.scale * drawn

    def of_matrices(self, plant: Partition) -> Delta:
        """Return this Delta as one on M, D and K of the plant's model, where it is of modes."""
        return self

    def require_in_range(self, deviations: float) -> None:
        """Raise ModelError where the Delta reaches what no machine is."""

    @property
    def text(self) -> str:
        """Name and amount at delta = 1 in words."""
        return f"{self.name} +- {100 * self.scale:.3g} %"

    @classmethod
    def opened(cls, plant: Partition, opened: Opened, deltas: Sequence[Delta]) -> Opened:
        """Return a continuous plant's system with channels for all Deltas of this kind."""
        base = plant.system
        units = EvenUnits.of(base)
        parts = []
        for delta in deltas:
            ends = [with_changes(plant, [(delta, end * delta.scale)]).system for end in (1, -1)]
            parts.append(units.part(delta.name, units.change(base, *ends)))
        return with_parts(opened, parts)


def with_changes(plant: P, changes: Sequence[tuple[Delta, float]]) -> P:
    """Return the machine that is off by some amounts, sampled like the nominal plant."""
    machine = MachineParts.of(plant)
    for delta, amount in sorted(changes, key=lambda one: one[0].stage):
        machine = delta.changed(machine, amount)
    found: P = machine.assembled()
    return found

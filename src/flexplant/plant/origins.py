"""Where a plant comes from: a structure, a system made elsewhere; what was measured of it."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any, ClassVar, TypeAlias

import numpy as np

from ..arrays import FloatArray
from ..errors import LabelError
from ..labels import DIRECTIONS
from ..lti.frequency import Frf
from ..lti.statespace import StateSpace
from ..store import Value
from .ports import Ports
from .realisation import ModalRealisation


@dataclass(frozen=True, eq=False, repr=False)
class Assembled(Value):
    """Origin of a plant that was assembled from a structure: ports, modes, noise and delay.

    Parameters
    ----------
    ports : Ports
        Places of the channels.
    realisation : ModalRealisation
        The structure's modes.
    physical : StateSpace
        System from forces to motions, before noise, references and efforts are connected to it.
    noise_factor : (n, r) array, optional
        Factor G of the covariance G G' that the disturbances add to the states x in one sample.
    delay : float [samples]
        Delay of the inputs u.
    continuous : StandardPlant, optional
        The plant before sampling.

    Examples
    --------
    >>> import flexplant as fx
    >>> made = fx.testbeds.three_masses().assembled
    >>> made.ports, made.delay
    (<Ports w: amp, u: u1, z: die, y: y1 y2, references: die>, 1.0)
    """

    ports: Ports
    realisation: ModalRealisation
    physical: StateSpace
    noise_factor: FloatArray | None = None
    delay: float = 0.0
    continuous: Any = None


#: the modes of matrices of which no structure is known
_NO_MODEL: Any = None
_NO_MODES = ModalRealisation(
    _NO_MODEL, np.zeros((0, 2, 2)), np.zeros((0, 0)), np.zeros((0, 0)), (), 0, form="as given"
)


@dataclass(frozen=True, eq=False)
class PlantChannel(Value):
    """A port that stands for a channel of a plant without a structure: a row of C or a column of B.

    Parameters
    ----------
    name : str
        Name of the channel.
    home : {"y", "u"}
        Whether the channel is a sensor ("y") or an actuator ("u").

    Examples
    --------
    >>> import flexplant as fx
    >>> fx.placement.PlantChannel("y1", "y")
    PlantChannel(name='y1', home='y')
    """

    asd: ClassVar = 0.0
    latency: ClassVar = 0.0
    unit: ClassVar = None
    name: str
    home: str


@dataclass(frozen=True, eq=False)
class Foreign(Value):
    """Origin of a plant that was not assembled from a structure, so that its modes are not known.

    It has the same attributes as `Assembled`, so that most functions treat both alike. A function
    that needs a structure uses `plant.assembled`.

    Parameters
    ----------
    noise_factor, delay, continuous : as for `Assembled`
    ports : Ports
        Actuators and sensors by name.

    Examples
    --------
    >>> import flexplant as fx
    >>> A, B, C = [[-1.0]], [[1.0, 1.0]], [[1.0], [1.0]]
    >>> sys = fx.StateSpace(A, B, C, [[0, 0], [0, 0]], inputs=["w", "u"], outputs=["z", "y"])
    >>> plant = fx.StandardPlant.from_statespace(sys, w=["w"], u=["u"], z=["z"], y=["y"])
    >>> type(plant.origin).__name__
    'Foreign'
    """

    noise_factor: FloatArray | None = None
    delay: float = 0.0
    continuous: Any = None
    ports: Ports = field(default_factory=Ports)
    realisation: ClassVar[ModalRealisation] = _NO_MODES


@dataclass(frozen=True, eq=False)
class MeasuredResponse(Value):
    """The measured response of a machine; see `StandardPlant.measured`.

    Parameters
    ----------
    frf : Frf
        Response from actuators to sensors.
    hold : bool
        False if the response was measured from sample to sample and contains the zero-order hold.
    delay : float [samples]
        Delay that the response contains.

    Examples
    --------
    >>> import flexplant as fx
    >>> plant = fx.testbeds.three_masses()
    >>> frf = fx.frequency_response(plant.continuous.Gyu, [10.0, 20.0])
    >>> plant.measured(frf.select(outputs=["y1"])).measurement.hold
    True
    """

    frf: Frf
    hold: bool = True
    delay: float = 0.0


#: where a plant may have come from
Origin: TypeAlias = "Assembled | Foreign"
#: nothing is known but the names
ELSEWHERE = Foreign()


#: what to type for a system whose names do not show its channels
TYPE_THIS = "StandardPlant.from_statespace(sys, w=[...], u=[...], z=[...], y=[...], asd={...})"


def sides_of(g: StateSpace) -> tuple[list[str], list[str], list[str], list[str]]:
    """Return w, u, z, y of a system whose channels are named like those of an assembled plant."""
    # each actuator `u1` has its effort `u1:effort` among the outputs: these inputs are u, the
    # others w. Outputs that are efforts, errors (`die:error`) or motions of POIs (`die:z`) are z;
    # the others are y: references (`die:ref`, an input too), outputs with a noise `y1:noise` in w,
    # and plain names
    efforts = [name.removesuffix(":effort") for name in g.outputs if name.endswith(":effort")]
    u = [name for name in g.inputs if name in efforts]
    noisy = [name.removesuffix(":noise") for name in g.inputs if name.endswith(":noise")]
    references = [name for name in g.inputs if name.endswith(":ref")]
    if not u:
        raise _untold("no input has an effort among the outputs, such as 'u1:effort' for 'u1'")
    z, y = [], []
    for name in g.outputs:
        ending = name.rpartition(":")[2] if ":" in name else ""
        if name in noisy or name in references or not ending:
            y.append(name)
        elif ending in ("effort", "error", *DIRECTIONS):
            z.append(name)
        else:
            raise _untold(f"the output {name!r} may be a measurement or a performance")
    for name, listed, what in (
        *((name, g.inputs, "effort") for name in efforts),
        *((name, y, "noise") for name in noisy),
    ):
        if name not in listed:
            raise _untold(f"{name + ':' + what!r} is there, {name!r} is not")
    if not y:
        raise _untold("no output is a measurement")
    return [name for name in g.inputs if name not in u], u, z, y


def _untold(why: str) -> LabelError:
    return LabelError(
        f"the names of the channels do not show which are w, u, z and y: {why}. Type {TYPE_THIS}."
    )

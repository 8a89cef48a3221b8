"""Where a plant comes from: a structure that it was assembled from, or a system made elsewhere."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, TypeAlias

from ..checks import FloatArray, Value
from ..lti.statespace import StateSpace
from .ports import Ports
from .realisation import ModalRealisation


@dataclass(frozen=True, eq=False, repr=False)
class Assembled(Value):
    """What is known of a plant that was assembled from a structure.

    Parameters
    ----------
    ports : Ports
        Where the channels are.
    realisation : ModalRealisation
        The structure's modes.
    physical : StateSpace
        Forces to motions, before noise, references and efforts are wired to it.
    noise_factor : (n, r) array, optional
        G with G G' the covariance of x that disturbances add in one sample.
    delay : float [samples]
        Of the inputs u.
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


@dataclass(frozen=True, eq=False)
class Foreign(Value):
    """What is known of a plant that was made elsewhere.

    Parameters
    ----------
    noise_factor, delay, continuous : as for `Assembled`

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


#: where a plant may have come from
Origin: TypeAlias = "Assembled | Foreign"
#: nothing is known but the system
ELSEWHERE = Foreign()

"""Where a plant came from: assembled from a structure, weighted, or made elsewhere."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, TypeAlias

from ..checks import FloatArray, Value
from ..lti.statespace import StateSpace
from .ports import Ports
from .realisation import ModalRealisation


class _Unknown:
    """What is known of a plant only when it was assembled from a structure."""

    #: what it was assembled from, the plant before weights, and the block before y
    structure: Any = None
    plain: Any = None
    reading: Any = None
    scaled: bool = False
    steps: tuple[Any, ...] = ()
    #: the plant before sampling, the factor of its noise, and its delay
    continuous: Any = None
    noise_factor: FloatArray | None = None
    delay: float = 0.0


@dataclass(frozen=True, eq=False, repr=False)
class Assembled(_Unknown, Value):
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

    @property
    def structure(self) -> Assembled:
        """What is known of the structure: this value."""
        return self


@dataclass(frozen=True, eq=False)
class Foreign(_Unknown, Value):
    """What is known of a plant that was made elsewhere.

    Parameters
    ----------
    noise_factor, delay, continuous
        As for `Assembled`.

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


@dataclass(frozen=True, eq=False)
class Weighted(_Unknown, Value):
    """A plant made from another one by `weighted` or `through`.

    Parameters
    ----------
    plain : StandardPlant
        The plant before weights and blocks; its structure and its delay are this plant's too.
    reading : StateSpace, optional
        The block of `through`: from `plain.y` to y.
    scaled : bool
        Whether weights were applied: w and z are then no physical channels.
    steps : sequence
        What was applied to `plain`, in order: a block, or the weights of z and of w.

    Examples
    --------
    >>> import flexplant as fx
    >>> plant = fx.testbeds.three_masses()
    >>> weights = fx.stage_weights(plant, 20.0)
    >>> type(plant.weighted(z=weights.z, w=weights.w).origin).__name__
    'Weighted'
    """

    plain: Any
    reading: StateSpace | None = None
    scaled: bool = False
    steps: tuple[Any, ...] = ()


#: where a plant may have come from
Origin: TypeAlias = "Assembled | Foreign | Weighted"
#: nothing is known but the system
ELSEWHERE = Foreign()

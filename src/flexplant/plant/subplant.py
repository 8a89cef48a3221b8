"""A plant with some of the ports of another one: rows and columns of it, nothing made anew."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import numpy.typing as npt

from ..checks import Value
from ..lti.discretisation import acting
from ..lti.statespace import StateSpace
from .origin import Assembled
from .ports import Ports
from .sensors import Poi


def selected(own: Assembled, ports: Ports) -> Assembled | None:
    """Return a plant's origin with some of its sensors, actuators and POIs in their order."""
    # None for ports that are others or in another order, or whose noise the states hold mixed
    if not _among(ports, own.ports):
        return None
    kept = [poi.channel(axis) for poi in ports.z for axis in poi.axes]
    outputs = [*kept, *(sensor.name for sensor in ports.y)]
    inputs = [*(port.name for port in ports.forces), *ports.input_noises]
    if not inputs or not outputs:
        return None
    modes = np.isin(own.physical.states, own.realisation.names)
    chosen = own.physical.select(outputs, inputs)
    reached = acting(own.physical.A != 0)
    stay = modes | _linked(chosen, reached, modes) | ~_linked(own.physical, reached, modes)
    factor = own.noise_factor
    return own.replace(
        ports=ports,
        physical=_with_states(chosen, stay),
        noise_factor=None if factor is None else factor[stay],
    )


def _among(ports: Ports, own: Ports) -> bool:
    """Return whether the ports are some of a plant's own, in their order, without lost noise."""
    some = _in_order(ports.u, own.u) and _in_order(ports.y, own.y)
    same = len(ports.w) == len(own.w) and _in_order(ports.w, own.w)
    noisy = own.input_noises.keys() == ports.input_noises.keys()
    known = {poi.name: poi for poi in own.z}
    return some and same and noisy and all(_part(poi, known.get(poi.name)) for poi in ports.z)


def _in_order(ports: Sequence[Value], own: Sequence[Value]) -> bool:
    """Return whether all of some ports are among others, in their order."""
    left = iter(own)
    return all(any(port is other for other in left) for port in ports)


def _part(poi: Poi, own: Poi | None) -> bool:
    """Return whether a POI is one of the plant's, or has some of its axes."""
    if own is None or not set(poi.axes) <= set(own.axes):
        return False
    return poi is own or own.replace(axes=poi.axes)._fields() == poi._fields()


def _linked(
    g: StateSpace, reached: npt.NDArray[np.bool_], modes: npt.NDArray[np.bool_]
) -> npt.NDArray[np.bool_]:
    """Return which states an input or a mode acts on and an output or a mode sees."""
    driven = reached @ (np.any(g.B, axis=1) | modes)
    return np.asarray(driven & ((np.any(g.C, axis=0) | modes) @ reached))


def _with_states(g: StateSpace, stay: npt.NDArray[np.bool_]) -> StateSpace:
    """Return a system without some of its states, which nothing reaches or nothing shows."""
    if np.all(stay):
        return g
    blocks = None
    if g.blocks is not None:
        owner = np.repeat(np.arange(len(g.blocks)), g.blocks)
        sizes = np.bincount(owner[stay], minlength=len(g.blocks))
        blocks = sizes[sizes > 0].tolist()
    return g.replace(
        A=g.A[np.ix_(stay, stay)],
        B=g.B[stay],
        C=g.C[:, stay],
        states=[name for name, kept in zip(g.states, stay.tolist(), strict=True) if kept],
        blocks=blocks,
    )

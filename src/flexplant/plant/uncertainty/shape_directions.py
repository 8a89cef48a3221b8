"""Shapes of modes that are known within measured directions."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Any, ClassVar

import numpy as np

from ...arrays import FloatArray, positive, real_array
from ...errors import ModelError
from ...tolerances import DEVIATIONS, SAME, TINY
from ..building import another_machine
from ..machine_plants import MachineParts
from ..partitioned import Partition
from ..realisation import ModalRealisation
from .channels import DeltaChannel, Opened, system_matrix, with_each
from .delta import Delta, Known, Uncertainty
from .mode_delta import require_elastic


@dataclass(frozen=True, eq=False)
class ShapeDelta(Delta):
    """The shape of a mode, ``phi + scale delta along``, where forces act and motions show."""

    along: FloatArray = field(default_factory=lambda: np.zeros(0))

    kind: ClassVar[str] = "shape"
    stage: ClassVar[int] = 2
    of_own_model: ClassVar[bool] = True

    def changed(self, machine: MachineParts, amount: float) -> MachineParts:
        """Return a machine with another shape of the mode."""
        return machine.replace(realisation=_reshaped(machine.realisation, self, amount))

    def of_matrices(self, plant: Partition) -> Delta:
        """Refuse to be one: M, D and K hold no shape alone."""
        raise ModelError(
            f"{self.name} is of the shape of a mode, and parameters of the model move all shapes. "
            "Leave plant.Shapes out, or plant.Parameters."
        )

    @classmethod
    def opened(cls, plant: Partition, opened: Opened, deltas: Sequence[Any]) -> Opened:
        """Return a system with the channels of shapes."""
        matrix = system_matrix(plant.system)
        found = [(one.name, one.scale, _channels(plant, one, matrix)) for one in deltas]
        return with_each(opened, found)


def _reshaped(
    realisation: ModalRealisation,
    delta: ShapeDelta,
    amount: float,
    *,
    inputs: bool = True,
    outputs: bool = True,
) -> ModalRealisation:
    """Return a realisation with ``phi + amount along`` where forces act, motions show, or both."""
    first = 2 * delta.mode - 2
    if np.any(realisation.inputs[:, first]) or np.any(realisation.outputs[:, first + 1]):
        raise ModelError(
            f"mode {delta.mode} has a complex shape: deviations of shapes are of real ones. Leave "
            "it out."
        )
    pushed, shown = np.array(realisation.inputs), np.array(realisation.outputs)
    moved = amount * np.asarray(delta.along)
    if inputs:
        pushed[:, first + 1] += moved
    if outputs:
        shown[:, first] += moved / realisation.pairs[delta.mode - 1, 0, 1]
    return realisation.replace(inputs=pushed, outputs=shown)


def _channels(plant: Partition, delta: ShapeDelta, base: FloatArray) -> list[DeltaChannel]:
    """Return the channels of the shape of a mode."""
    # `phi + d v` drives the mode by `d v^T f` more and shows `d v q`, `d v q'` or `d v q''` of its
    # motion more: four channels at most, of which q'' feels what the first one drives. Their
    # columns are read off the plant assembled with forces or motions changed alone, so that they
    # hold for any port and filter
    q, v = (int(plant.modal_states[2 * delta.mode - i]) for i in (2, 1))
    realisation = plant.assembled.realisation.uncoupled
    driven, seen = (
        system_matrix(another_machine(plant, one, plant.ports).system) - base
        for one in (
            _reshaped(realisation, delta, 1.0, outputs=False),
            _reshaped(realisation, delta, 1.0, inputs=False),
        )
    )
    row = driven[v]
    parts = [(driven @ row / (row @ row), row, None)] if np.any(row) else []
    # displacements and velocities read the states, accelerations what else their rate holds
    size, rest, beyond = np.linalg.norm(seen, axis=1), seen.copy(), base[v].copy()
    rest[:, [q, v]], beyond[[q, v]] = 0.0, 0.0
    amount = rest @ beyond / max(float(beyond @ beyond), TINY)
    amount[np.linalg.norm(rest, axis=1) <= SAME * size] = 0.0
    plain = seen - np.outer(amount, base[v])
    motion, speed = (np.eye(base.shape[1])[i] for i in (q, v))
    for column, right, rate in (
        (plain[:, q], motion, None),
        (plain[:, v], speed, None),
        (amount, base[v], np.eye(plant.system.n_states)[v]),
    ):
        small = np.abs(column) * np.linalg.norm(right) <= SAME * size
        parts += [] if np.all(small) else [(np.where(small, 0.0, column), right, rate)]
    if not parts:
        raise ModelError(f"{delta.name} moves no port of the plant: leave that mode out.")
    found = []
    for i, (left, right, rate) in enumerate(parts, 1):
        even = np.sqrt(np.linalg.norm(left) / np.linalg.norm(right))
        name = f":{i}" if i > 1 else ""
        found.append(
            DeltaChannel(left / even, even * right, name, None if rate is None else even * rate)
        )
    return found


@dataclass(frozen=True, eq=False, repr=False)
class Shapes(Uncertainty):
    """Uncertain shapes of modes: how strongly a mode is driven, and how it is seen.

    Parameters
    ----------
    directions : (m, n, r) array
        Changes of the mode shapes: r directions for each of the m modes, over the n DOFs of the
        plant's modes. Each direction is one standard deviation of the shape and is independent of
        the others (`flexplant.identification.shape_deviations`).
    modes : sequence of m int
        Numbers of the modes, from 1, rigid-body modes included.
    deviations : float
        Number of standard deviations at which a delta is 1.

    Raises
    ------
    LabelError, ModelError, ShapeError
        When a plant lacks a mode or has complex shapes, or the array has another size.

    Examples
    --------
    >>> import flexplant as fx
    >>> import numpy as np
    >>> off = fx.plant.Shapes(1e-3 * np.ones((1, 3, 1)), [2])
    >>> [delta.name for delta in fx.testbeds.three_masses().uncertain(off).deltas]
    ['mode2:shape1']
    """

    directions: FloatArray
    modes: Sequence[int]
    deviations: float = field(default=DEVIATIONS, kw_only=True)

    def __post_init__(self) -> None:
        given = real_array(self.directions, "directions of shapes", (len(self.modes), None, None))
        self._set(
            directions=given,
            modes=tuple(self.modes),
            deviations=positive(self.deviations, "deviations"),
        )

    def known(self, plant: Partition) -> Known:
        """Return a Delta for each direction of change of a mode shape."""
        realisation = plant.assembled.realisation.uncoupled
        require_elastic(realisation, self.modes)
        n = realisation.outputs.shape[0]
        real_array(self.directions, "directions of shapes", (len(self.modes), n, None))
        found = []
        for number, own in zip(self.modes, self.directions, strict=True):
            phi = realisation.inputs[:, 2 * number - 1]
            for j, direction in enumerate(own.T, 1):
                size = float(np.linalg.norm(direction) / np.linalg.norm(phi))
                if size > 0:
                    name, along = f"mode{number}:shape{j}", direction / size
                    found.append(ShapeDelta(name, self.deviations * size, number, along=along))
        return Known.independent(found, deviations=self.deviations)

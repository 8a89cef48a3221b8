"""A position-dependent controller: designs at several positions, interpolated linearly."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np
import numpy.typing as npt

from ..arrays import FloatArray, function, instance, members, real_array
from ..errors import AssumptionError, LabelError, ModelError, counted, only_one
from ..lti.statespace import StateSpace
from ..plant import AnyPlant, StandardPlant
from ..store import Value
from .blocks import with_known
from .closed import ClosedLoop, close_loop


@dataclass(frozen=True, eq=False, repr=False)
class ScheduledLoop(Value):
    """Closed loops of one machine at several positions: the result of `schedule_loops`.

    Between these positions the matrices of the controller are interpolated linearly. All designs
    have the same states in the same coordinates. The commands therefore stay continuous while the
    machine moves.

    Parameters
    ----------
    position : str
        Name of the scheduling variable.
    places : (k,) array [m or rad]
        Increasing values of the scheduling variable at which loops are given.
    loops : sequence of k ClosedLoop
        Loop at each place.

    Raises
    ------
    LabelError, ModelError
        When controllers differ in channels or states, or places do not increase.
    """

    position: str
    places: FloatArray
    loops: tuple[ClosedLoop, ...]

    def __post_init__(self) -> None:
        loops = members(self.loops, ClosedLoop, "loops", "Pass what close_loop returned.", least=2)
        places = real_array(self.places, "places", (len(loops),))
        if np.any(np.diff(places) <= 0):
            raise ModelError("the places of a schedule must increase. Sort them with their loops.")
        first = loops[0].controller
        for x, loop in zip(places, loops, strict=True):
            own = loop.controller
            if own.inputs != first.inputs or own.outputs != first.outputs:
                raise LabelError(
                    f"the controller at {x:g} has other channels than that at {places[0]:g}: "
                    "schedule designs of one kind."
                )
            if own.n_states != first.n_states:
                raise ModelError(
                    f"the controller at {x:g} has {counted(own.n_states, 'state')}, that at "
                    f"{places[0]:g} {first.n_states}: they cannot be interpolated. Use the same "
                    "design for all, with the same notches."
                )
        self._set(loops=loops, places=places)

    def __repr__(self) -> str:
        low, high = self.places[0], self.places[-1]
        margins = [loop.modulus_margin for loop in self.loops]
        worst = int(np.argmin(margins))
        return (
            f"<ScheduledLoop: {len(self.loops)} designs, {self.position} {low:g} to {high:g}, "
            f"controller {self.loops[0].controller.n_states} states>\n"
            f"  least modulus margin of the designs {margins[worst]:.3g}, at {self.position} = "
            f"{self.places[worst]:g}"
        )

    @property
    def plant(self) -> AnyPlant:
        """The plant at its present position, which `StandardPlant.at` changes."""
        return self.loops[0].plant

    @cached_property
    def standing(self) -> ClosedLoop:
        """The loop at the present position of its plant, which `StandardPlant.at` changes."""
        return self.at(self.plant.assembled.ports.values[self.position])

    @cached_property
    def stacked(self) -> tuple[FloatArray, ...]:
        """Matrices A, B, C and D of the k controllers. The first axis of each has length k."""
        systems = [loop.controller for loop in self.loops]
        return tuple(np.array([getattr(one, part) for one in systems]) for part in "ABCD")

    def matrices(self, x: float) -> tuple[FloatArray, ...]:
        """Return A, B, C and D of the controller at a position."""
        places = self.places
        i = int(np.clip(np.searchsorted(places, x) - 1, 0, places.size - 2))
        share = float(np.clip((x - places[i]) / (places[i + 1] - places[i]), 0.0, 1.0))
        return tuple((1.0 - share) * part[i] + share * part[i + 1] for part in self.stacked)

    def at(self, x: float) -> ClosedLoop:
        """Return the loop of the machine that stands still at a position."""
        loop = self.loops[0]
        # references with derivatives in its blocks are read there too
        plant = with_known(loop.plant.at(None, **{self.position: x}), loop.blocks)
        own = loop.controller
        A, B, C, D = self.matrices(float(x))
        law = StateSpace(
            A, B, C, D, own.dt, inputs=own.inputs, outputs=own.outputs, units=own.units,
            states=own.states,
        )  # fmt: skip
        return ClosedLoop(plant, (law,), law, loop.idle)

    def around(self, plant: AnyPlant) -> ScheduledLoop:
        """Return the same controllers around another machine with the same ports."""
        loops = [
            close_loop(plant.at(None, **{self.position: float(x)}), *loop.blocks)
            for x, loop in zip(self.places, self.loops, strict=True)
        ]
        return self.replace(loops=loops)


def schedule_loops(
    plant: StandardPlant,
    design: Callable[[StandardPlant], Any],
    *,
    position: str | None = None,
    places: npt.ArrayLike,
) -> ScheduledLoop:
    """Return a closed loop whose controller is interpolated between designs at several positions.

    Parameters
    ----------
    plant : StandardPlant
        Plant with positions (`Ports(positions=[...])`).
    design : callable
        Function that takes the plant at a position and returns the blocks that run there, such as a
        Kalman filter, a servo and a feedforward. The blocks must have the same channels and states
        at all positions. Therefore fix choices that a design makes automatically, such as the
        number of notches.
    position : str, optional
        The scheduling variable; by default the only position.
    places : (k,) array [m or rad]
        Positions of the designs, two or more.

    Returns
    -------
    ScheduledLoop
        Loop for `simulate(..., moving=)` and `rms_along`.

    Raises
    ------
    AssumptionError
        When the machine at rest half way between two places is not stable with the interpolated
        controller.
    LabelError
        When the position is unknown, `position` is missing although the plant has several, or
        channels differ between positions.
    ModelError
        When a place is out of range, or designs differ in their states.

    Notes
    -----
    Stability is checked with the machine at rest, at the places and half way between them.
    ``rms_along(..., repeats=True)`` checks stability while the machine moves, for one repeated
    trajectory.

    Examples
    --------
    >>> import flexplant as fx
    >>> import numpy as np
    >>> plate = fx.kirchhoff_plate(size=(0.6, 0.6), thickness=0.0272, elements=(8, 8),
    ...     density=2702, youngs_modulus=70e9, poisson_ratio=0.35)
    >>> corners = [(x, y, 0.0) for y in (0.1, 0.5) for x in (0.2, 0.4)]
    >>> ports = fx.Ports(
    ...     u=[fx.Actuator(f"u{i}", at=p, asd=1e-3) for i, p in enumerate(corners)],
    ...     z=[fx.Poi("die", at=(0.3, 0.3, 0.0), axes=("z", "rx", "ry"), moves={"x": (-1, 0, 0)})],
    ...     y=[fx.Sensor(f"y{i}", at=p, asd=1e-12, moves={"x": (-1, 0, 0)})
    ...        for i, p in enumerate(corners)],
    ...     references=[fx.Reference("die")],
    ...     positions=[fx.plant.Position("x", range=(-0.1, 0.1))],
    ... )
    >>> modes = fx.solve_modes(plate, count=10, damping=fx.ModalDamping(0.01))
    >>> plant = fx.assemble_plant(modes, ports).discretized(1e4, delay=1)
    >>> def design(there):
    ...     return fx.design_kalman(there), fx.design_servo(there, bandwidth=25.0, notches=[])
    >>> found = fx.loop.schedule_loops(plant, design, places=np.linspace(-0.1, 0.1, 9))
    >>> found.at(0.03).is_stable
    True
    """
    instance(plant, StandardPlant, "plant", "Pass an assembled plant with positions.")
    function(design, "design", "Pass a function of a plant that returns its blocks.")
    known = [one.name for one in plant.assembled.ports.positions]
    position = only_one("position", known, position, "position=")
    values = real_array(places, "places", (None,))
    loops = []
    for x in values.tolist():
        there = plant.at(None, **{position: x})
        blocks = design(there)
        own = blocks if isinstance(blocks, Sequence) else (blocks,)
        loops.append(close_loop(there, *own))
    found = ScheduledLoop(position, values, tuple(loops))
    for x in [*values.tolist(), *(0.5 * (values[1:] + values[:-1])).tolist()]:
        loop = found.loops[values.tolist().index(x)] if x in values else found.at(x)
        radius = loop.spectral_radius
        if radius >= 1.0 and not loop.is_stable:
            where = "" if x in values else ", where the controller lies between two designs"
            raise AssumptionError(
                f"the loop is not stable at {position} = {x:g}{where} (spectral radius "
                f"{radius:.6g}). Take less bandwidth, notches for all places, or more places."
            )
    return found

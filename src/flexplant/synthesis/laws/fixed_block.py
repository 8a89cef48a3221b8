"""FixedBlock: a system of one channel as an element of a law, such as a controller of a design."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from typing import Any

from ...checks import Value, short
from ...errors import ModelError, ShapeError, counted
from ...lti.discretisation import bilinear
from ...lti.statespace import StateSpace, as_statespace
from ..controller import Controller
from ..hinf.shaping import ShapedLoop
from .law import BlockSection, SingleElement


@dataclass(frozen=True, eq=False, repr=False)
class FixedBlock(SingleElement):
    """A system of one input and one output as it is, as an element of a law.

    Parameters
    ----------
    block : StateSpace
        From error to command, continuous or sampled; a sampled one runs at its own rate only.
    label : str
        What it is, for those who read the law.

    Examples
    --------
    >>> import flexplant as fx
    >>> fx.synthesis.FixedBlock(fx.lti.tf([1.0], [0.01, 1.0]), "shaping filter")
    FixedBlock shaping filter: 1 state
    """

    block: StateSpace
    label: str = "block"

    def __post_init__(self) -> None:
        g = as_statespace(self.block)
        if (len(g.outputs), len(g.inputs)) != (1, 1):
            raise ShapeError(
                "a block of a law has one input and one output, got "
                f"{counted(len(g.inputs), 'input')} and {counted(len(g.outputs), 'output')}. Pass "
                "one channel: system['out', 'in']."
            )
        self._set(block=g, label=str(self.label))

    @classmethod
    def of(cls, given: Any, *, label: str = "") -> FixedBlock:
        """Return the element of a system, or of a designed controller.

        Parameters
        ----------
        given : StateSpace, Controller or ShapedLoop
            A controller of a design, ``u = K y``, has the sign of the feedback in it: the element
            is ``-K``. A StateSpace is taken from error to command as it is.
        label : str, optional
            What it is; else what `given` says of itself.

        Raises
        ------
        ModelError
            When it is no system.
        ShapeError
            When it has several channels.
        """
        if isinstance(given, Controller | ShapedLoop):
            method = getattr(given, "method", "shaped loop")
            return cls(-given.system, label or method)
        if isinstance(given, Value) and not isinstance(given, StateSpace):
            raise ModelError(
                f"a block of a law is a system, got {short(given)}. Pass a StateSpace."
            )
        return cls(as_statespace(given), label or getattr(given, "name", None) or "block")

    def __repr__(self) -> str:
        rate = f" at {1.0 / self.block.dt:g} Hz" if self.own_rate else ""
        return f"FixedBlock {self.label}: {counted(self.block.n_states, 'state')}{rate}"

    @property
    def own_rate(self) -> float:
        """The only rate [Hz] at which it runs; 0 where any will do."""
        return 1.0 / self.block.dt if self.block.dt and self.block.n_states else 0.0

    @cached_property
    def section(self) -> BlockSection:
        """Its system, of a sampled one the continuous one that Tustin's rule samples to it."""
        rate, g = self.own_rate, self.block
        return BlockSection(bilinear(g, rate) if rate else g.replace(dt=0.0))

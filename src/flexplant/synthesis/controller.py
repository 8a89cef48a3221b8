"""The answer of every controller design, with the certificate that was checked after it."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

from ..certificates import in_words
from ..errors import counted
from ..loop import SpillOver
from ..lti.statespace import StateSpace
from ..values import Value


@dataclass(frozen=True, eq=False, repr=False)
class Controller(Value):
    """A controller with named channels and what was verified about it.

    Parameters
    ----------
    system : StateSpace
        From measurements, references or estimates to actuators; the sign of the feedback is in it.
    method : str
        How it was designed.
    gamma : float, optional
        The norm that its closed loop was verified to stay below: H-infinity, of `design_h2` the H2.
    lower : float, optional
        A bound from below on what controllers reach; see the method for its conditions.
    certificate : mapping {str: float}
        Numbers computed after the design by another computation.
    reached : mapping {str: float}
        Of a weighted design: the norm from each group of w to each group of z, beside 1, which
        is what the weights require. The largest is close to gamma.
    left_out : SpillOver, optional
        How the loop stands on the plant with the modes left out, where these are known.
    notes : sequence of str
        What the certificate does not cover, and what else is worth knowing.
    structure : FixedOrder, TunedLaws or ObserverGains, optional
        Of `design_structured`: what it was given, with the numbers that it found.
    tried : mapping {str: float}
        What was tried, in turn, and the gamma that each reached; infinite where it failed.

    Examples
    --------
    >>> import flexplant as fx
    >>> controller = fx.design_h2(fx.testbeds.three_masses())
    >>> controller.system.inputs, controller.system.outputs
    (('y1', 'y2', 'die:ref'), ('u1',))
    """

    system: StateSpace
    method: str
    gamma: float | None = None
    lower: float | None = None
    certificate: Mapping[str, float] | None = None
    reached: Mapping[str, float] | None = None
    left_out: SpillOver | None = None
    notes: tuple[str, ...] = ()
    structure: Value | None = None
    tried: Mapping[str, float] | None = None

    def __post_init__(self) -> None:
        self._set(
            certificate=dict(self.certificate or {}),
            reached=dict(self.reached or {}),
            notes=tuple(self.notes),
            tried=dict(self.tried or {}),
        )

    def to_control(self) -> Any:
        """Return the controller as a `control.StateSpace` with the same names."""
        return self.system.to_control()

    def __repr__(self) -> str:
        gamma = "" if self.gamma is None else f", gamma {self.gamma:.4g}"
        if self.gamma is not None and self.lower is not None:
            gamma += f" (lower bound {self.lower:.4g})"
        lines = [f"<Controller {self.method}: {counted(self.system.n_states, 'state')}{gamma}>"]
        if self.reached:
            shown = ", ".join(f"{key} {value:.3g}" for key, value in self.reached.items())
            lines.append(f"  reached, of 1 that the weights require: {shown}")
        if self.certificate:
            own = {k: v for k, v in self.certificate.items() if "left out" not in k}
            lines.append(f"  verified: {in_words(own)}")
        if self.left_out is not None:
            lines.append(f"  with the modes left out: {self.left_out.summary}")
        lines += [f"  {note}" for note in self.notes]
        return "\n".join(lines)

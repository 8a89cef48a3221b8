"""The answer of every controller design, with the certificate that was checked after it."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

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
        The norm that its closed loop was verified to stay below.
    lower : float, optional
        A bound from below on what controllers reach; see the method for its conditions.
    certificate : mapping {str: float}
        Numbers computed after the design by another route.
    """

    system: StateSpace
    method: str
    gamma: float | None = None
    lower: float | None = None
    certificate: Mapping[str, float] | None = None

    def __post_init__(self) -> None:
        self._set(certificate=dict(self.certificate or {}))

    def __repr__(self) -> str:
        gamma = "" if self.gamma is None else f", gamma {self.gamma:.4g}"
        lines = [f"<Controller {self.method}: {self.system.n_states} states{gamma}>"]
        if self.certificate:
            shown = ", ".join(f"{key} {value:.4g}" for key, value in self.certificate.items())
            lines.append(f"  verified: {shown}")
        return "\n".join(lines)

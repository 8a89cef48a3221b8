"""What a loop keeps when its controller is replaced: stability, margin and gamma."""

from __future__ import annotations

import warnings
from typing import Any, NamedTuple

import numpy as np

from ...certificates import stability, stability_name
from ...errors import CertificateError, FlexplantWarning
from ...loop import close_loop
from ...lti.interconnection import lft
from ...lti.norms import peak_gain
from ...lti.statespace import StateSpace
from ...plant import StandardPlant


class LoopFacts(NamedTuple):
    """Stability, at which frequency [Hz], modulus margin at u, and gamma of a weighted plant."""

    sampled: bool
    stability: float
    freq: float
    is_stable: bool
    margin: float
    gamma: float

    @property
    def why(self) -> str:
        """The least stable pole, in words."""
        return f"{stability_name(self.sampled)} {self.stability:.6g}, at {self.freq:.4g} Hz"

    @property
    def certificate(self) -> dict[str, float]:
        """The numbers, named."""
        found = {stability_name(self.sampled): self.stability, "modulus margin": self.margin}
        return found if np.isnan(self.gamma) else found | {"gamma": self.gamma}


def loop_facts(plant: StandardPlant, controller: StateSpace) -> LoopFacts:
    """Return what a controller keeps on a plant."""
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", FlexplantWarning)
        loop = close_loop(plant, controller, larger=None)
    poles = loop.poles()
    dt = loop.plant.dt
    size = np.abs(poles) if dt else poles.real
    least = poles[np.argmax(size)] if poles.size else np.nan
    freq = np.abs(np.angle(least) / dt if dt else np.imag(least)) / (2.0 * np.pi)
    gamma = float("nan")
    if plant.is_weighted and loop.obstacle is None:
        gamma = peak_gain(lft(plant.system, controller))[0]
    stable = loop.obstacle is None
    margin = loop.modulus_margin if stable else 0.0
    return LoopFacts(bool(dt), stability(poles, dt), float(freq), stable, margin, gamma)


def kept(before: LoopFacts, after: LoopFacts, loss: float) -> str:
    """Return what was lost in words; empty when nothing was."""
    if not after.is_stable:
        return f"the loop becomes unstable ({after.why})"
    if after.margin < (1.0 - loss) * before.margin:
        return (
            f"the modulus margin falls from {before.margin:.3g} to {after.margin:.3g}, by more "
            f"than {100 * loss:.3g} %"
        )
    if after.gamma > (1.0 + loss) * before.gamma:
        return (
            f"gamma grows from {before.gamma:.4g} to {after.gamma:.4g}, by more than "
            f"{100 * loss:.3g} %"
        )
    return ""


def required(before: LoopFacts, after: LoopFacts, loss: float, cure: str) -> None:
    """Raise CertificateError when a loop lost more than is allowed."""
    lost = kept(before, after, loss)
    if lost:
        raise CertificateError(f"{lost}: the controller is refused. {cure}")


def stable_before(plant: StandardPlant, controller: StateSpace) -> Any:
    """Return the facts of the loop as it was designed."""
    facts = loop_facts(plant, controller)
    if not facts.is_stable:
        raise CertificateError(
            f"the controller as given does not stabilise the plant ({facts.why}): "
            "there is no loop to preserve. Is it the plant that it was made for?"
        )
    return facts

"""The machines that a plant may be, and intervals of figures over them."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, NamedTuple

import numpy as np

from ..arrays import FloatArray, between
from ..errors import ModelError
from ..updating.machines import Machines
from ..words import in_unit
from .building import continuous_plant, loud_like, sampled_like
from .machine_draws import drawn_modes

#: share of machines that a printed interval holds
LEVEL = 0.95


class FigureInterval(NamedTuple):
    """Where a figure lies on a share of the machines that the measurement allows.

    Parameters
    ----------
    low, high : float or None
        Its ends; None where `sentence` says what is missing.
    sentence : str
        The interval in words, or what is missing for one.

    Examples
    --------
    >>> import flexplant as fx
    >>> fx.plant.FigureInterval(None, None, "measure more modes").low is None
    True
    """

    low: float | None
    high: float | None
    sentence: str


def known_machines(plant: Any) -> Machines | None:
    """Return what is not known of a plant's machine: stated, or of the fit that its model is of."""
    for kind in () if plant.uncertainty is None else plant.uncertainty.kinds:
        if isinstance(source := getattr(kind, "source", None), Machines):
            return source
    found = getattr(plant.model, "machines", None)
    return found if isinstance(found, Machines) else None


class PlantMachines:
    """The machines that a plant may be, sampled like it: drawn once and kept.

    Parameters
    ----------
    plant : StandardPlant
        The plant, with an evaluation model.
    machines : Machines
        What is not known of it.
    """

    def __init__(self, plant: Any, machines: Machines) -> None:
        self.plant, self.machines = plant, machines
        self._plants: list[Any] = []
        self._values: dict[Any, FloatArray] = {}

    @property
    def missing(self) -> str:
        """What is missing for an interval; empty where nothing is."""
        return self.machines.missing

    @property
    def plants(self) -> list[Any]:
        """The machines with the channels of the plant."""
        if not self._plants:
            before = self.plant.continuous
            for modes in drawn_modes(before.evaluation_plant.assembled.realisation, self.machines):
                own = continuous_plant(type(before), modes, before.assembled.ports, None)
                self._plants.append(sampled_like(self.plant, loud_like(self.plant, own)))
        return self._plants


def interval_of(values: FloatArray, level: float = LEVEL) -> tuple[float, float]:
    """Return the ends between which a log-normal figure of a further machine lies, from n drawn.

    Of the logarithm it is ``mean +- t s sqrt(1 + 1 / n)``, Student's t with n - 1 degrees of
    freedom.
    """
    from scipy.special import stdtrit

    share = between(level, "level", 0.0, 1.0, "Choose 0.95, say.")
    if np.any(values <= 0.0):
        raise ModelError("a figure of a log-normal distribution is positive.")
    logs, n = np.log(values), len(values)
    half = stdtrit(n - 1, 0.5 * (1 + share)) * np.std(logs, ddof=1) * np.sqrt(1 + 1 / n)
    centre = float(np.mean(logs))
    return float(np.exp(centre - half)), float(np.exp(centre + half))


def interval(
    machines: PlantMachines | None, figures: Callable[[], FloatArray], level: float, unit: str
) -> FigureInterval:
    """Return the interval of a figure over machines, or what is missing for one."""
    if machines is None:
        return FigureInterval(
            None,
            None,
            "no interval: nothing is known of other machines. Make the plant of "
            "fit.calibrated(measured) with evaluation=, or pass plant.uncertain(machines)",
        )
    if machines.missing:
        return FigureInterval(None, None, f"no interval: {machines.missing}")
    low, high = interval_of(figures(), level)
    return FigureInterval(
        low, high, f"{interval_text(low, high, unit)} on {100 * level:.3g} % of such machines"
    )


def interval_text(low: float, high: float, unit: str) -> str:
    """Return two numbers in one unit."""
    factor, name = in_unit(high, unit or None)
    return f"{low / factor:.3g} to {high / factor:.3g} {name}".rstrip()

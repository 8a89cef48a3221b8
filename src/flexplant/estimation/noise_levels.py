"""Levels of the noises of a plant, by channel, from recorded data: what is estimated."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from ..errors import counted
from ..plant import StandardPlant
from ..values import FloatArray, Value

#: channel that stands for all disturbances of a plant made elsewhere
PROCESS = "process"
#: relative deviation of a density from which its variance less two deviations is below 0
_BOUND = 0.25


@dataclass(frozen=True, eq=False, repr=False)
class NoiseLevels(Value):
    """Amplitude densities of disturbances and sensors from a record, with their uncertainty.

    Parameters
    ----------
    given : StandardPlant
        The plant with the densities that the search started from.
    channels : tuple of str
        Disturbances of w, then sensors (`y1:noise`); `process` stands for all disturbances of a
        plant made elsewhere.
    ratios : (p,) array
        Estimated density of each channel beside the given one.
    covariance : (p, p) array
        Of the logarithms of the ratios: the inverse of Fisher's information.
    start : (p,) array
        Ratios by autocovariance least squares, where the search began; 0 where it gave none.
    slope : float
        Largest derivative of the likelihood at the end, beside its standard deviation: below 1e-3.
    nis : float
        Mean normalised innovation squared per sensor of the filter with these levels, from the
        record itself: 1 when the model explains it.
    samples : int
        Used.
    verdict : str
        Of `consistency`, on the record with these levels.

    Examples
    --------
    >>> import flexplant as fx
    >>> plant = fx.testbeds.three_masses()
    >>> observer = fx.design_kalman(plant)
    >>> servo = fx.design_servo(plant, bandwidth=20.0, observer=observer)
    >>> run = fx.simulate(fx.close_loop(plant, observer, servo), duration=4.0, rng=1)
    >>> fx.estimation.estimate_noise(plant, run).channels
    ('amp', 'y1:noise', 'y2:noise')
    """

    given: StandardPlant
    channels: tuple[str, ...]
    ratios: FloatArray
    covariance: FloatArray
    start: FloatArray
    slope: float
    nis: float
    samples: int
    verdict: str = ""

    def __repr__(self) -> str:
        shown = [f"  {name} {self._shown(i)}" for i, name in enumerate(self.channels[:5])]
        more = [f"  ... and {len(self.channels) - 5} more"] if len(self.channels) > 5 else []
        first = f"<NoiseLevels from {counted(self.samples, 'sample')}, NIS {self.nis:.4g}"
        return "\n".join([first, *shown, *more]) + ">"

    def _shown(self, i: int) -> str:
        """Return a level in words: a bound where it may be 0 just as well (two deviations).

        The variance t of a ratio has the deviation 2 t times that of the density's logarithm.
        """
        ratio, off = float(self.ratios[i]), self.relative[self.channels[i]]
        if off > _BOUND:
            return f"at most {ratio * np.sqrt(1.0 + 4.0 * off):.2g} times the given density"
        return f"{ratio:.4g} times the given density, +- {100 * off:.2g} %"

    @property
    def asd(self) -> Mapping[str, float]:
        """Estimated densities [unit/sqrt(Hz)] of the channels that have one."""
        return {
            name: float(ratio * self.given.asd[name])
            for name, ratio in zip(self.channels, self.ratios, strict=True)
            if name in self.given.asd
        }

    @property
    def relative(self) -> Mapping[str, float]:
        """Relative standard deviation of each density."""
        sizes = np.sqrt(np.maximum(self.covariance.diagonal(), 0.0))
        return dict(zip(self.channels, sizes.tolist(), strict=True))

    @property
    def plant(self) -> StandardPlant:
        """The plant with the estimated densities."""
        given = self.given
        if not given.is_assembled:
            factor = given.noise_factor * self.ratios[self.channels.index(PROCESS)]
            origin = given.origin.replace(noise_factor=factor)
            return given.replace(asd={**given.asd, **self.asd}, origin=origin)
        return with_densities(given, self.asd)


def with_densities(plant: StandardPlant, asd: Mapping[str, float]) -> StandardPlant:
    """Return an assembled plant with other densities of some of the noises that it has."""

    def changed(ports: Sequence[Any], ending: str = "") -> list[Any]:
        given = [asd.get(f"{port.name}{ending}", port.asd) if port.asd else 0.0 for port in ports]
        return [port.replace(asd=level) for port, level in zip(ports, given, strict=True)]

    own = plant.assembled.ports
    return plant.with_ports(
        own.replace(w=changed(own.w), u=changed(own.u, ":disturbance"), y=changed(own.y, ":noise"))
    )

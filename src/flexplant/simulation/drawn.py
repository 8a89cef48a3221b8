"""White noise for a simulation: few columns of it, drawn for a stretch of samples at a time."""

from __future__ import annotations

import numpy as np

from ..loop.noise_sources import WhiteNoise
from ..plant import StandardPlant
from ..values import FloatArray

#: part of a state's largest noise that is rounding: its square is that of a covariance
_NO_NOISE = 1e-8
#: states of a plant from which on this is not searched for: it would take longer than a run
_MANY = 256
#: samples that are drawn and mixed at a time: they stay in the cache
_CHUNK = 256


class Drawn:
    """The white noises of a plant, drawn for a stretch of samples at a time.

    Few forces through many modes make a factor whose singular values fall fast: r columns of white
    samples are mixed into the few that are not rounding, ``L V'`` the factor. They are drawn as r,
    whose number and order do not hang on rounding. And always for a whole stretch: a longer run
    begins with the shorter one, bit by bit.

    Attributes
    ----------
    factor, mix : (n, few) and (r, few) arrays
        L and V.
    columns : (k,) int array
        Of w that have noises of their own.
    """

    def __init__(self, noise: WhiteNoise, plant: StandardPlant) -> None:
        names = [plant.w[i].removesuffix(":noise") for i in noise.columns]
        self.read = np.array([name in plant.y for name in names], dtype=bool)
        self.columns, self.deviation = noise.columns, noise.deviation
        self.factor, self.mix = noise.factor, np.eye(noise.factor.shape[1])
        self.thin = noise.factor.shape[0] <= _MANY
        if self.thin:
            size = np.linalg.norm(noise.factor, axis=1)
            unit = noise.factor / np.where(size > 0, size, 1.0)[:, None]
            U, s, V = np.linalg.svd(unit, full_matrices=False)
            kept = int(np.count_nonzero(s > _NO_NOISE * s.max(initial=0.0)))
            self.factor = size[:, None] * U[:, :kept] * s[:kept]
            self.mix = np.ascontiguousarray(V[:kept].T)
        self.buffer = np.empty((_CHUNK, self.mix.shape[0] + self.columns.size))

    @property
    def cost(self) -> int:
        """Operations for a sample: products of matrices."""
        return 2 * (self.factor.size + (self.mix.size if self.thin else 0))

    def draw(
        self, generator: np.random.Generator, samples: int, hold: int = 1
    ) -> tuple[FloatArray, FloatArray]:
        """Return white samples (samples, few) for the factor, and noises of the columns of w.

        Sensors are read in the first of every `hold` samples, with the noise of that rate.
        """
        rank, few = self.mix.shape
        white, single = np.empty((samples, few)), np.empty((samples, self.columns.size))
        for start in range(0, samples, _CHUNK):
            part = slice(start, min(start + _CHUNK, samples))
            drawn = self.buffer[: part.stop - start]
            generator.standard_normal(out=drawn)
            if self.thin:
                np.matmul(drawn[:, :rank], self.mix, out=white[part])
            else:
                white[part] = drawn[:, :rank]
            np.multiply(drawn[:, rank:], self.deviation, out=single[part])
        if hold > 1:
            single[:, self.read] /= np.sqrt(hold)
            single[np.ix_(np.arange(samples) % hold > 0, self.read)] = 0.0
        return white, single

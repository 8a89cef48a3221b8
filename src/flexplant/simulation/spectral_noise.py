"""Records of Gaussian noise with a spectrum that was measured, or is a law such as 1/f."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any, TypeAlias

import numpy as np
import numpy.typing as npt

from ..checks import MOST_DRAWS, FloatArray, generator, positive, real_array, short, whole
from ..errors import ModelError

#: a density over frequency [Hz]: a function, or frequencies and densities
Density: TypeAlias = (
    "Callable[[FloatArray], npt.ArrayLike] | Sequence[npt.ArrayLike] | npt.NDArray[Any]"
)
#: length of the record of which one is a part, so that its ends do not meet
_LONGER = 4


def spectral_noise(
    asd: Density, *, rate: float, duration: float, runs: int | None = None, rng: Any = None
) -> FloatArray:
    """Return Gaussian noise of a given spectrum, for `simulate(disturbance=)`.

    A floor's measured vibration, 1/f noise of a sensor, slow drift: lines of random amplitude and
    phase, ``E |X_k|^2 = asd(f_k)^2 rate n / 2``, four times as dense as the record can resolve.
    Slower parts than a quarter of a period in the record are left out, a mean too: a drift beyond
    that is an array of one's own. What the synthesis shall know of goes into a port
    (`fx.plant.FirstOrder`, `NarrowBand`, `RandomWalk`, a shape).

    Parameters
    ----------
    asd : function or (frequencies [Hz], densities)
        One-sided amplitude spectral density [unit/sqrt(Hz)]. A function of an array of
        frequencies; a measured one is interpolated, both scales logarithmic, and is nothing
        outside its band.
    rate : float [Hz]
        Of the samples: that of the plant, or `finer` times it.
    duration : float [s]
        Of the record.
    runs : int, optional
        So many records; one without that axis when not given.
    rng : int, SeedSequence, Generator or None
        Seed.

    Returns
    -------
    (n_time,) or (runs, n_time) array

    Raises
    ------
    ModelError, ShapeError
        When a density is negative or not finite, frequencies do not rise, or a number is not
        positive.

    Examples
    --------
    >>> import flexplant as fx
    >>> slow = fx.simulation.spectral_noise(lambda f: 1e-9 / f**0.5, rate=1e3, duration=2.0, rng=1)
    >>> slow.shape, bool(1e-9 < slow.std() < 5e-9)
    ((2000,), True)
    >>> floor = ([1.0, 10.0, 100.0], [1e-5, 1e-4, 1e-6])  # m/s^2/sqrt(Hz), measured
    >>> fx.simulation.spectral_noise(floor, rate=1e3, duration=0.5, runs=3, rng=1).shape
    (3, 500)
    """
    rate = positive(rate, "rate")
    count = whole(round(positive(duration, "duration") * rate), "samples", maximum=10**8)
    number = 1 if runs is None else whole(runs, "runs", maximum=MOST_DRAWS)
    draws = generator(rng)
    n = _LONGER * count
    freq: FloatArray = np.asarray(np.arange(1, n // 2) * (rate / n), dtype=np.float64)
    size = _density_at(asd, freq) * np.sqrt(rate * n / 4.0)
    found = np.empty((number, count))
    for one in found:
        lines = np.zeros(n // 2 + 1, dtype=np.complex128)
        drawn = draws.standard_normal((2, freq.size))
        lines[1 : 1 + freq.size] = size * (drawn[0] + 1j * drawn[1])
        one[:] = np.fft.irfft(lines, n)[:count]
    return found[0] if runs is None else found


def _density_at(asd: Any, freq: FloatArray) -> FloatArray:
    """Return the density at frequencies."""
    if callable(asd):
        values = real_array(asd(freq), "asd")
        values = real_array(values, "asd of the frequencies", freq.shape if values.ndim else ())
    else:
        if isinstance(asd, str) or not hasattr(asd, "__len__") or len(asd) != 2:
            raise ModelError(
                f"asd must be a function of frequency or (frequencies, densities), got {short(asd)}"
                ". Pass lambda f: level / f**0.5, or both arrays."
            )
        at = real_array(asd[0], "frequencies of asd")
        level = real_array(asd[1], "densities of asd", at.shape)
        if at.ndim != 1 or at.size < 2 or at[0] <= 0 or np.any(np.diff(at) <= 0):
            raise ModelError(
                "the frequencies of asd must be positive and rise, and be two or more: they are "
                "interpolated. Sort them, and leave 0 Hz out."
            )
        if np.any(level <= 0):
            raise ModelError(
                f"the densities of asd must be positive, got {level.min():.3g}: they are "
                "interpolated by their logarithms. Leave lines without noise out."
            )
        inside = (freq >= at[0]) & (freq <= at[-1])
        values = np.where(inside, np.exp(np.interp(np.log(freq), np.log(at), np.log(level))), 0.0)
    if np.any(values < 0):
        raise ModelError(f"asd must not be negative, got {values.min():.3g}.")
    return np.asarray(values, dtype=np.float64)

"""Whether innovations are what the filter's model says: NIS, correlation, spectrum."""

from __future__ import annotations

from collections.abc import Sequence

import matplotlib.pyplot as plt
import numpy as np
import numpy.typing as npt
from matplotlib.axes import Axes

from ..arguments import between
from ..errors import ModelError
from ..estimation import Consistency, Estimate
from ..estimation.whiteness import spectrum_of
from ..values import FloatArray, instance
from ._axes import finish, legend, named, shown_in
from ._style import BLACK, BLUE, CYCLE, STYLES

#: windows of the mean NIS over a record, and samples in one at least
_WINDOWS, _SHORTEST = 60, 20
#: fewest samples for a picture
_FEWEST = 100


def consistency(
    estimate: Estimate,
    found: Consistency | None = None,
    *,
    level: float = 0.95,
    ax: Sequence[Axes] | None = None,
) -> Axes:
    """Draw three tests of whether the innovations of a filter are those of its model.

    The normalised innovation squared (NIS) over time, 1 when the noises have the stated size; its
    correlation over lags, 0 when the model leaves nothing; and the cumulative periodogram less a
    straight line, which leaves 0 for white innovations. A right model stays between the dotted
    bounds at the level: everywhere in the third, for that share of the points in the others.

    Parameters
    ----------
    estimate : Estimate
        Of `observer.estimate(records)`.
    found : Consistency, optional
        The verdict of `flexplant.estimation.consistency`, as the title.
    level : float
        Of the bounds.
    ax : three Axes, optional
        Where to draw.

    Returns
    -------
    Axes
        Of the NIS; `.figure.axes` are all.

    Raises
    ------
    ModelError
        When the kinds are wrong, there are fewer than 100 samples with all innovations, or not
        three axes.

    References
    ----------
    [BarShalom2001]_, ch. 5.4; [Bartlett1955]_.

    Examples
    --------
    >>> import flexplant as fx
    >>> plant = fx.testbeds.three_masses()
    >>> observer = fx.design_kalman(plant)
    >>> servo = fx.design_servo(plant, bandwidth=20.0, observer=observer)
    >>> loop = fx.close_loop(plant, observer, servo)
    >>> estimate = observer.estimate(fx.simulate(loop, duration=0.2, rng=1))
    >>> fx.plot.consistency(estimate).get_ylabel()
    'NIS per sensor [-]'
    """
    instance(estimate, Estimate, "estimate", "Pass what observer.estimate returned.")
    instance(found, Consistency | None, "found", "Pass what consistency returned.")
    between(level, "level", 0.5, 1.0, "Pass 0.95.", ends="[")
    white = estimate.whitened.T
    there = _there(white)
    if int(there.sum()) < _FEWEST:
        raise ModelError(
            f"a picture needs at least {_FEWEST} samples with all innovations, got "
            f"{int(there.sum())}. Pass a longer record."
        )
    if ax is not None and np.size(np.asarray(ax, dtype=object)) != 3:
        raise ModelError("ax= takes three axes. Leave it out for a new figure.")
    given = ax is not None
    panels = ax if ax is not None else plt.subplots(
        1, 3, figsize=(13.0, 3.8), layout="constrained"
    )[1]  # fmt: skip
    _nis(panels[0], estimate.time[there], white[there], level)
    dt = float(np.median(np.diff(estimate.time)))
    _correlation(panels[1], white, dt, level)
    _periodogram(panels[2], white, 1.0 / dt, level)
    legend(panels[0], given=True)
    if found is not None and not given:
        panels[0].figure.suptitle(found.text, fontsize="medium", wrap=True)
    first: Axes = panels[0]
    return first


def _there(white: FloatArray) -> npt.NDArray[np.bool_]:
    """Return at which samples all innovations are known."""
    return np.asarray(np.all(np.isfinite(white), axis=1))


def _nis(ax: Axes, time: FloatArray, white: FloatArray, level: float) -> None:
    from scipy.stats import chi2

    length = max(_SHORTEST, len(white) // _WINDOWS)
    count = len(white) // length
    mean = (white[: count * length] ** 2).reshape(count, -1).mean(axis=1)
    middle = time[: count * length].reshape(count, -1).mean(axis=1)
    second, unit = shown_in(ax.xaxis, float(np.max(np.abs(time))), "s")
    freedom = length * white.shape[1]
    ax.plot(middle / second, mean, ".-", color=BLUE, linewidth=0.8, label="mean of windows")
    ax.axhline(1.0, color=BLACK, linewidth=0.8)
    for i, tail in enumerate((0.5 - 0.5 * level, 0.5 + 0.5 * level)):
        bound = float(chi2.ppf(tail, freedom)) / freedom
        ax.axhline(bound, label=None if i else f"{100 * level:g} % bounds", **STYLES["bound"])
    finish(ax, x=named("time", unit), y="NIS per sensor [-]")


def _correlation(ax: Axes, white: FloatArray, dt: float, level: float) -> None:
    from scipy.stats import norm

    there = _there(white)
    x = np.where(there[:, None], white, 0.0)
    count = int(there.sum())
    lags = min(100, count // 20)
    second, unit = shown_in(ax.xaxis, lags * dt, "s")
    for j, look in zip(range(x.shape[1]), CYCLE, strict=False):
        power = np.fft.rfft(x[:, j], 2 * len(x))
        whole = np.fft.irfft(np.abs(power) ** 2)[: lags + 1]
        marker = "o^sDvP"[j % 6]
        ax.plot(
            dt * np.arange(1, lags + 1) / second,
            whole[1:] / whole[0],
            marker,
            color=look["color"],
            markersize=2.5,
        )
    bound = float(norm.ppf(0.5 + 0.5 * level)) / np.sqrt(count)
    for sign in (-1.0, 1.0):
        ax.axhline(sign * bound, **STYLES["bound"])
    ax.axhline(0.0, color=BLACK, linewidth=0.8)
    finish(ax, x=named("lag", unit), y="correlation of whitened innovations [-]")


def _periodogram(ax: Axes, white: FloatArray, rate: float, level: float) -> None:
    from scipy.stats import kstwobign

    found = spectrum_of(white)
    total = np.cumsum(found.density) / found.density.sum()
    line = np.arange(1, total.size + 1) / total.size
    bound = float(kstwobign.ppf(level)) / np.sqrt(found.density.size * found.channels)
    factor, unit = shown_in(ax.xaxis, 0.5 * rate, "Hz")
    freq = found.freq * rate / factor
    ax.plot(freq, total - line, color=BLUE)
    ax.axhline(0.0, color=BLACK, linewidth=0.8)
    for sign in (-1.0, 1.0):
        ax.axhline(sign * bound, **STYLES["bound"])
    finish(ax, x=named("frequency", unit), y="cumulative periodogram less a straight line [-]")

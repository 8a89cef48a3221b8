"""Pictures of error budgets."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np
from matplotlib.axes import Axes

from ..checks import in_unit, instance, short, with_unit
from ..errors import ModelError, counted
from ..loop import ClosedLoop, ErrorBudget, Spectrum
from ..simulation import Response
from ._axes import CYCLE, axes, finish, legend, named, shown_in, styles
from .gains import by_label

#: of the areas, which differ without colour too
_HATCHES = ("", "//", "", "\\\\", "", "..")
_BESIDE: dict[str, Any] = {"loc": "center left", "bbox_to_anchor": (1.0, 0.5)}


def budget(found: ErrorBudget, *, most: int = 5, ax: Axes | None = None) -> Axes:
    """Draw the cumulative spectra of an error budget as stairs, one source upon the other.

    Each area is the variance that a source has below a frequency; they end at the shares of the
    budget, the top at the square of the rms.

    Parameters
    ----------
    found : ErrorBudget
        From `ClosedLoop.budget`.
    most : int
        Sources that are drawn by themselves, the largest first; the others are one area.
    ax : Axes, optional
        Where to draw.

    Returns
    -------
    Axes

    Raises
    ------
    ModelError
        When it is no ErrorBudget.

    Examples
    --------
    >>> import flexplant as fx
    >>> plant = fx.testbeds.three_masses()
    >>> observer = fx.design_kalman(plant)
    >>> servo = fx.design_servo(plant, bandwidth=20.0, observer=observer)
    >>> ax = fx.plot.budget(fx.close_loop(plant, observer, servo).budget("die:x"))
    >>> ax.get_xlabel()
    'frequency [Hz]'
    """
    instance(found, ErrorBudget, "found", "Pass loop.budget(channel).")
    given, ax = ax is not None, axes(ax, figsize=(9.0, 4.0))
    order = [int(i) for i in np.argsort(-found.variances, kind="stable")]
    shown, rest = order[: max(most, 1)], order[max(most, 1) :]
    factor, unit = in_unit(found.rms, found.unit)
    # from where a thousandth of the variance has come
    low = found.cumulative.sum(axis=0) < 1e-3 * found.variances.sum()
    inside = np.isfinite(found.freq) & (found.freq > 0) & ~low
    freq, stairs = found.freq[inside], found.cumulative[:, inside] / factor**2
    layers = [(found.names[i], stairs[i], found[found.names[i]]) for i in shown]
    if rest:
        others = float(np.sqrt(found.variances[rest].sum()))
        layers.append((f"{counted(len(rest), 'other')}", stairs[rest].sum(axis=0), others))
    base = np.zeros(freq.size)
    for i, (name, rows, rms) in enumerate(layers):
        ax.fill_between(
            freq,
            base,
            base + rows,
            facecolor=CYCLE[i % len(CYCLE)]["color"],
            hatch=_HATCHES[i % len(_HATCHES)],
            alpha=0.75,
            edgecolor="white",
            linewidth=0.8,
            label=f"{name}: {with_unit(rms, found.unit)} rms",
        )
        base = base + rows
    ax.set(xscale="log", ylim=(0.0, None))
    where = {"loc": "upper left"} if given else _BESIDE
    ax.legend(reverse=True, frameon=False, **where)  # the uppermost area comes first
    total = f"{found.channel}: {with_unit(found.rms, found.unit)} rms"
    squared = f"({unit})^2" if set(unit) & set(" /") else f"{unit}^2" if unit else ""
    label = named("variance below the frequency", squared)
    return finish(ax, x="frequency [Hz]", y=label, title=total)


def spectra(
    found: Any,
    channel: str | None = None,
    *,
    unit: str | None = None,
    colors: Mapping[str, str] | None = None,
    ax: Axes | None = None,
) -> Axes:
    """Draw amplitude spectral densities, such as those of a loop and of its run.

    Parameters
    ----------
    found : ClosedLoop, Response, Spectrum, or mapping {label: one of these}
        Of one signal.
    channel : str, optional
        Which signal of loops and runs; a Spectrum, from `loop.psd(channel)`, is of one already.
    unit : str, optional
        SI unit of the signal; that of the channel when not given.
    colors : mapping {label: color}, optional
        Of some lines.
    ax : Axes, optional
        Where to draw.

    Returns
    -------
    Axes
        The roots of the one-sided densities.

    Raises
    ------
    ModelError
        When there is nothing that has a spectrum, or no channel is named.
    LabelError
        When there is no such channel.

    Examples
    --------
    >>> import flexplant as fx
    >>> plant = fx.testbeds.three_masses()
    >>> observer = fx.design_kalman(plant)
    >>> servo = fx.design_servo(plant, bandwidth=20.0, observer=observer)
    >>> loop = fx.close_loop(plant, observer, servo)
    >>> fx.plot.spectra({"model": loop}, "die:error").get_ylabel()
    'amplitude spectral density [nm/√Hz]'
    """
    named_ones = by_label(found, Response)
    spectra_of = {label: _spectrum(one, channel) for label, one in named_ones.items()}
    known = [getattr(one, "units", {}).get(channel) for one in named_ones.values()]
    unit = unit or next(filter(None, known), None)
    lines = {k: (s.freq[s.freq > 0], np.sqrt(s.psd[s.freq > 0])) for k, s in spectra_of.items()}
    given, ax = ax is not None, axes(ax, figsize=(9.0, 4.2))
    largest = float(max(size.max(initial=0.0) for _, size in lines.values()))
    density = f"{unit}/\N{SQUARE ROOT}Hz" if unit else None
    factor, shown = shown_in(ax.yaxis, largest, density)
    shown = shown or "SI unit/\N{SQUARE ROOT}Hz"
    for (label, (freq, size)), look in zip(lines.items(), styles(lines, colors), strict=True):
        ax.loglog(freq, size / factor, label=label or None, **look)
    legend(ax, given=given)
    return finish(ax, x="frequency [Hz]", y=named("amplitude spectral density", shown))


def _spectrum(one: Any, channel: str | None) -> Spectrum:
    if isinstance(one, Spectrum):
        return one
    if not isinstance(one, ClosedLoop | Response):
        raise ModelError(
            f"a loop, a run or the spectrum of one has a density to draw, got {short(one)}. Pass "
            "{'model': loop, 'measured': run}, 'die:error'."
        )
    if channel is None:
        raise ModelError(f"which signal? {list(one.units)[:6]} are there: name a channel.")
    return one.psd(channel)

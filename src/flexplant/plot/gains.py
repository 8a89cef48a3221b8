"""What pictures over frequency draw: responses of systems, measurements or several of them."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, NamedTuple

import numpy as np
from matplotlib.axes import Axes

from ..checks import ComplexArray, FloatArray, short
from ..errors import FlexplantError, ModelError
from ..lti.frequency import Frf, frequency_response
from ..lti.statespace import as_statespace
from ..tolerances import TINY
from ._axes import POINTS, Style, role_of, styles

#: of a magnitude below the largest one that is drawn, nothing can be read: zeros at half the rate
_DEPTH = 160.0
#: share of the decades that may lie below the axis, and by how much it reaches below the others
_SHARE, _MORE = 0.03, 15.0


class Curve(NamedTuple):
    """A response with its label and the style of its line; measured ones are black points."""

    label: str
    response: Frf
    line: Style


def labelled(found: Any) -> dict[str, Any]:
    """Return what to draw by label: of a mapping, a list of systems (numbered from 1), or one."""
    numbers = (int, float, list, tuple)  # of a static gain
    if isinstance(found, list | tuple) and not any(isinstance(one, numbers) for one in found):
        found = {f"system {k}": one for k, one in enumerate(found, 1)}
    return by_label(found)


def by_label(found: Any, one: type = Frf) -> dict[str, Any]:
    """Return the entries of a mapping, or {"": found} of anything else and of kind `one`."""
    several = isinstance(found, Mapping) and not isinstance(found, one)
    named = {str(label): part for label, part in found.items()} if several else {"": found}
    if not named:
        raise ModelError("there is nothing to draw: the mapping or list is empty.")
    return named


def curves(
    found: Any, freq: FloatArray | None = None, colors: Mapping[str, str] | None = None
) -> list[Curve]:
    """Return what to draw of a system, an Frf, or a mapping {label: one of these} or list.

    Systems are evaluated at `freq`; when it is not given, on their own grids.
    """
    named = labelled(found)
    measured = [label for label, one in named.items() if _is_measured(label, one)]
    modelled = iter(styles([label for label in named if label not in measured], colors))
    drawn = []
    for label, one in named.items():
        line = dict(POINTS) if label in measured else next(modelled)
        if colors and label in colors:
            line["color"] = colors[label]
        drawn.append(Curve(label, _response(one, freq), line))
    return drawn


def _is_measured(label: str, one: Any) -> bool:
    if role_of(label) == "measured":
        return True
    return isinstance(one, Frf) and (one.variance is not None or one.coherence is not None)


def _response(one: Any, freq: FloatArray | None) -> Frf:
    if isinstance(one, Frf):
        return one
    if isinstance(one, int | float):
        raise ModelError(f"need systems or Frfs to draw, got {short(one)}. Pass StateSpaces.")
    try:
        return frequency_response(as_statespace(one), freq)
    except FlexplantError as error:
        if freq is not None:
            raise
        raise ModelError(
            f"need a system, an Frf or a mapping of labels to such, got {short(one)}: {error}"
        ) from error


def decibel(values: ComplexArray | FloatArray) -> FloatArray:
    """Return 20 log10 of sizes; zero is far below all."""
    return np.asarray(20.0 * np.log10(np.maximum(np.abs(values), TINY)))


def readable(ax: Axes) -> None:
    """End a decibel axis where magnitudes can be read: zeros at half the rate would draw it down.

    Over a small share of the decades, lines may lie below the axis.
    """
    left, right = ax.get_xlim()
    lines = [np.asarray(line.get_xydata(), dtype=float) for line in ax.get_lines()]
    whole = [line[line[:, 0] > 0] for line in lines if len(line) > 2]
    over = [line[(line[:, 0] >= left) & (line[:, 0] <= right)] for line in whole]
    over = [line for line in over if len(line) > 1]
    if not over:
        return
    top = max(float(line[:, 1].max()) for line in over)
    deep = min(_depth(line) for line in over)
    lowest = min(float(line[:, 1].min()) for line in over)
    floor = max(deep - _MORE, top - _DEPTH)
    if lowest < floor or sum(map(len, over)) < sum(map(len, whole)):
        bottom = max(lowest, floor)
        room = 0.05 * (top - bottom)
        ax.set_ylim(bottom - room, top + room, auto=True)  # for what is drawn later


def _depth(line: FloatArray) -> float:
    """Return the level below which a line is over `_SHARE` of its decades."""
    decades = np.log10(line[:, 0])
    levels = np.interp(np.linspace(decades[0], decades[-1], 400), decades, line[:, 1])
    return float(np.quantile(levels, _SHARE))


def gain_label(output: str, input: str, unit: str | None) -> str:
    """Return the label of a decibel axis, with what 0 dB is."""
    return f"|{output} / {input}| [dB, 0 dB = {reference_of(unit)}]"


def shared_unit(response: Frf) -> str | None:
    """Return the unit of a gain that all channels share; None when they do not."""
    units = {response.unit(*channel) for channel in response}
    return units.pop() if len(units) == 1 else None


def shared_reference(response: Frf) -> str:
    """Return what 0 dB is for all gains together: of unlike units, 1 in SI units."""
    alike = len({response.unit(*channel) for channel in response}) == 1
    return reference_of(shared_unit(response)) if alike else "1 in SI units"


def reference_of(unit: str | None) -> str:
    """Return what 0 dB is: one of the unit of a gain."""
    return "1" if unit in (None, "1") else f"1 {unit}"

"""What pictures over frequency draw: responses of systems, measurements or several of them."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, NamedTuple

import numpy as np
from matplotlib.axes import Axes

from ..errors import FlexplantError, ModelError
from ..lti.frequency import Frf, frequency_response
from ..lti.statespace import as_statespace
from ..values import ComplexArray, FloatArray, short
from ._axes import CYCLE, MEASURED

#: of a magnitude below the largest one that is drawn, nothing can be read: zeros at half the rate
_DEPTH = 160.0


class Curve(NamedTuple):
    """A response with its label and the style of its line; measured ones are black points."""

    label: str
    response: Frf
    line: dict[str, Any]


def curves(found: Any, freq: FloatArray | None = None) -> list[Curve]:
    """Return what to draw of a system, an Frf, or a mapping {label: one of these}.

    Systems are evaluated at `freq`; when it is not given, on their own grids.

    Raises
    ------
    ModelError
        When it is none of these, or a mapping without entries.
    """
    several = isinstance(found, Mapping) and not isinstance(found, Frf)
    named = dict(found) if several else {"": found}
    if not named:
        raise ModelError("there is nothing to draw: the mapping is empty.")
    drawn = []
    for i, (label, one) in enumerate(named.items()):
        measured = isinstance(one, Frf) and (one.variance is not None or one.coherence is not None)
        line: dict[str, Any] = {"color": CYCLE[i % len(CYCLE)], "linewidth": 1.3}
        if measured:
            line = {"color": MEASURED, "linestyle": "none", "marker": ".", "markersize": 3.0}
        drawn.append(Curve(str(label), _response(one, freq), line))
    return drawn


def _response(one: Any, freq: FloatArray | None) -> Frf:
    if isinstance(one, Frf):
        return one
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
    return np.asarray(20.0 * np.log10(np.maximum(np.abs(values), 1e-300)))


def readable(ax: Axes) -> None:
    """Limit a decibel axis below where magnitudes can be read: zeros would draw it down."""
    sizes = np.concatenate([np.ravel(np.asarray(line.get_ydata())) for line in ax.get_lines()])
    top = float(np.max(sizes))
    if float(np.min(sizes)) < top - _DEPTH:
        ax.set_ylim(top - _DEPTH, top + 0.05 * _DEPTH)


def gain_label(output: str, input: str, curve: Curve) -> str:
    """Return the label of a decibel axis, with what 0 dB is."""
    unit = curve.response.unit(output, input)
    return f"|{output} / {input}| [dB, 0 dB = {'1' if unit in (None, '1') else f'1 {unit}'}]"

"""Pictures over frequency."""

from __future__ import annotations

from collections.abc import Collection, Mapping

import numpy as np
from matplotlib.axes import Axes

from ..errors import ModelError, unknown_label
from ..loop import ClosedLoop
from ..loop.comparison import error_sensitivity
from ..lti.frequency import Frf
from ..values import ComplexArray, FloatArray, instance, short
from ._axes import CYCLE, axes, finish, legend


def frf(
    responses: Mapping[str, Frf],
    output: str,
    input: str,
    *,
    colors: Mapping[str, str] | None = None,
    unit: str | None = None,
    reference: str | None = None,
    ax: Axes | None = None,
) -> Axes:
    """Draw the magnitude of one channel of several FRFs (paper, Figs. 4, 10 and 11).

    The first one is drawn as a thick line, so that those that cover it do not hide it.

    Parameters
    ----------
    responses : mapping {label: Frf}
        What to compare.
    output, input : str
        The channel.
    colors : mapping {label: color}, optional
        Of some lines.
    unit : str, optional
        Of the gain, where the responses have none; 0 dB is one of it.
    reference : str, optional
        A label: the differences of the other responses from this one are drawn as dotted lines,
        where they share its frequencies.
    ax : Axes, optional
        Where to draw.

    Returns
    -------
    Axes

    Raises
    ------
    LabelError
        When there is no such reference.
    ModelError
        When there is no such mapping, or the responses are of different units.
    """
    if not isinstance(responses, Mapping) or isinstance(responses, Frf):
        raise ModelError(
            f"need a mapping of labels to Frfs, got {short(responses)}. Type {{'model': frf}}."
        )
    wrong = [found for found in responses.values() if not isinstance(found, Frf)]
    if wrong:
        raise ModelError(f"need Frfs to draw, got {short(wrong[0])}. Use frequency_response(sys).")
    units = {label: found.unit(output, input) or unit for label, found in responses.items()}
    known = {own for own in units.values() if own is not None}
    if len(known) > 1:
        raise ModelError(
            f"{output} / {input} is in different units, which share no axis: {units}. Convert one "
            "(frf.converted), or draw them apart."
        )
    if reference is not None and reference not in responses:
        raise unknown_label("response", reference, responses)
    given, ax = ax is not None, axes(ax, figsize=(8.0, 4.5))
    for i, (label, response) in enumerate(responses.items()):
        color = (colors or {}).get(label, CYCLE[i % len(CYCLE)])
        thick = i == 0 and len(responses) > 1
        line = {"color": color, "linewidth": 2.6 if thick else 1.1, "alpha": 0.6 if thick else 1.0}
        ax.semilogx(response.freq, _decibel(response[output, input]), label=label, **line)
        base = None if reference in (None, label) else responses[str(reference)]
        if base is not None and np.array_equal(base.freq, response.freq):
            error = _decibel(response[output, input] - base[output, input])
            text = f"{label} less {reference}"
            ax.semilogx(response.freq, error, ":", color=color, label=text, linewidth=1.1)
    legend(ax, given=given)
    one = f"1 {known.pop()}".removesuffix(" 1") if known else "1"
    return finish(ax, x="frequency [Hz]", y=f"|{output} / {input}| [dB, 0 dB = {one}]")


def _decibel(values: ComplexArray) -> FloatArray:
    return np.asarray(20.0 * np.log10(np.maximum(np.abs(values), 1e-300)))


def sensitivity(
    curves: Mapping[str, ClosedLoop | tuple[FloatArray, FloatArray]],
    *,
    colors: Mapping[str, str] | None = None,
    dashed: Collection[str] = (),
    ax: Axes | None = None,
) -> Axes:
    """Draw the size of sensitivities over frequency, with lines at 0 and 6 dB.

    Parameters
    ----------
    curves : mapping {label: ClosedLoop, or (freq [Hz], size)}
        What to compare; of a loop |S| from its reference to the error at the POI.
    colors : mapping {label: color}, optional
        Of some lines.
    dashed : collection of str
        Labels of lines to draw thin and dashed, so that they show on equal ones.
    ax : Axes, optional
        Where to draw.

    Returns
    -------
    Axes

    Raises
    ------
    ModelError
        When there is no such mapping.
    """
    instance(curves, Mapping, "curves", "Type {'model': (freq, size)}.")
    given, ax = ax is not None, axes(ax, figsize=(8.0, 4.5))
    for i, (label, curve) in enumerate(curves.items()):
        freq, size = error_sensitivity(curve) if isinstance(curve, ClosedLoop) else curve
        color = (colors or {}).get(label, CYCLE[i % len(CYCLE)])
        thin = label in dashed
        line = {"linestyle": "--", "linewidth": 1.0} if thin else {"linewidth": 2.2, "alpha": 0.8}
        ax.semilogx(freq, 20.0 * np.log10(size), color=color, label=label, **line)
    for level, style in ((0.0, "-"), (6.0, ":")):
        ax.axhline(level, color="0.4", linestyle=style, linewidth=0.8)
    legend(ax, given=given)
    return finish(ax, x="frequency [Hz]", y="|S| [dB]")

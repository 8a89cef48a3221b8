"""Pictures of estimates: predictions of a design, and errors on a machine."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np
import numpy.typing as npt
from matplotlib.axes import Axes
from matplotlib.lines import Line2D

from ..arrays import FloatArray, between, instance, mapping, name_list, positive, real_array
from ..errors import ModelError, ShapeError
from ..estimation import ConsistencyReport, Estimate, LagReport
from ..estimation.consistency_tests import FEWEST
from ..estimation.error import row_of
from ..estimation.innovations import lines_of
from ..estimation.lag_report import PREDICTOR, SMOOTHER, STATIC
from ..simulation import EstimatorComparison
from ._axes import (
    BLACK,
    BLUE,
    CYCLE,
    GREY,
    ORANGE,
    RED,
    STYLES,
    axes,
    finish,
    legend,
    named,
    shown_in,
    three_axes,
)


def predictions(
    rows: Mapping[str, npt.ArrayLike] | Sequence[EstimatorComparison],
    *,
    colors: Mapping[str, str] | None = None,
    cases: Sequence[str] = (),
    unit: str = "m",
    ax: Axes | None = None,
) -> Axes:
    """Draw predicted errors next to measured ones, one line for each design.

    Parameters
    ----------
    rows : sequence of EstimatorComparison, or mapping {design: (k, 4) array}
        Comparisons of the same estimators in k cases. A mapping gives four numbers for each design
        and case: the predicted rms error, the measured one, and both ends of its confidence
        interval.
    colors : mapping {design: color}, optional
        Colours of the diamonds.
    cases : sequence of str, optional
        Names of the k cases, written above the marks of the first design.
    unit : str
        SI unit of the errors; a prefix is chosen.
    ax : Axes, optional
        Axes to draw on; by default those of a new figure.

    Returns
    -------
    Axes
        Logarithmic axes; a diamond is a prediction, a black bar a measured interval.

    Raises
    ------
    ModelError
        When `rows` is neither a mapping nor a sequence of comparisons, or an error is not positive.
    ShapeError
        When a row has not four columns, or there are not as many names as cases.

    Examples
    --------
    >>> import flexplant as fx
    >>> rows = {"filter": [[0.5e-9, 0.51e-9, 0.48e-9, 0.53e-9]]}  # predicted, found, 95 % from, to
    >>> fx.plot.predictions(rows).get_xlabel()
    'rms error [pm]'
    """
    title = ""
    if isinstance(rows, Sequence) and all(isinstance(c, EstimatorComparison) for c in rows):
        title = f" of {rows[0].channel}" if rows else ""
        rows = {name: [case[name] for case in rows] for name in (rows[0].names if rows else ())}
    hint = "Pass [comparison] or {'updated': [(predicted, found, lower, upper)]}."
    given = mapping(rows, "rows", hint, least=1)
    tables = {
        name: real_array(row, f"errors of {name!r}", (None, 4)) for name, row in given.items()
    }
    if any(np.any(table[:, :2] <= 0) for table in tables.values()):
        raise ModelError("errors must be positive: they are drawn on a logarithmic axis.")
    ax = axes(ax, figsize=(7.0, 3.6))
    typical = float(np.median([np.median(t[:, 1]) for t in tables.values()]))
    factor, shown = shown_in(ax.xaxis, typical, unit)
    names = list(tables)
    for i, (name, table) in enumerate(tables.items()):
        color = (colors or {}).get(name, str(CYCLE[i % len(CYCLE)]["color"]))
        _draw_row(ax, len(names) - 1 - i, table / factor, color)
    ax.set_xscale("log")
    _name_cases(ax, cases, [table[:, :2] / factor for table in tables.values()])
    ax.set_yticks(range(len(names)), names[::-1])
    ax.set_ylim(-0.6, len(names) - 0.4)
    handles = [
        Line2D([], [], marker="D", fillstyle="none", linestyle="", color="0.4",
               label="predicted by the design"),
        Line2D([], [], marker="|", linestyle="", color=BLACK, markersize=12, markeredgewidth=2.0,
               label="on the machine, 95 %"),
    ]  # fmt: skip
    ax.legend(
        handles=handles, frameon=False, loc="lower center", bbox_to_anchor=(0.5, 1.0), ncols=2
    )
    return finish(ax, x=named(f"rms error{title}", shown), y="")


def lag_report(report: LagReport, channel: str | None = None, *, ax: Axes | None = None) -> Axes:
    """Draw the rms error of an estimate over its lag.

    An estimate with a lag also uses the measurements of this time after the estimated sample.

    Parameters
    ----------
    report : LagReport
        Report from `observer.report()`.
    channel : str, optional
        Motion of a POI; by default the first of the report.
    ax : Axes, optional
        Axes to draw on; by default those of a new figure.

    Returns
    -------
    Axes
        Axes with the curve from one sample on; predictor, smoother and static relation are
        horizontal lines.

    Raises
    ------
    ModelError
        When it is not a LagReport.
    LabelError
        When it has no such channel.

    Examples
    --------
    >>> import flexplant as fx
    >>> ax = fx.plot.lag_report(fx.design_kalman(fx.testbeds.three_masses()).report())
    >>> ax.get_xlabel()
    'lag [ms]'
    """
    instance(report, LagReport, "report", "Pass observer.report().")
    row = row_of(report.channels, report.channels[0] if channel is None else channel)
    name = report.channels[row]
    given, ax = ax is not None, axes(ax, figsize=(9.0, 4.0))
    size = float(report.curve[0, row])
    factor, unit = shown_in(ax.yaxis, size, report.units.get(name))
    lag, second = shown_in(ax.xaxis, float(np.median(report.lag)), "s")
    later = report.lag > 0
    ax.semilogx(report.lag[later] / lag, report.curve[later, row] / factor, color=BLUE,
                label="estimate with this lag")  # fmt: skip
    levels = (("filter", ORANGE, "--"), (PREDICTOR, RED, ":"),
              (SMOOTHER, BLACK, (0, (5, 1, 1, 1))), (STATIC, GREY, "-."))  # fmt: skip
    for level, color, style in levels:
        value = float(report[level][row])
        if np.isfinite(value):
            ax.axhline(value / factor, color=color, linestyle=style, linewidth=1.2, label=level)
    static = float(report[STATIC][row])
    if np.isfinite(static) and static > 3 * report[PREDICTOR][row]:
        ax.set_yscale("log")
    else:
        ax.set_ylim(bottom=0.0)
    y = named(f"rms error of {name}", unit)
    return finish(ax, x=named("lag", second), y=y, given=given)


def estimate(
    result: Estimate,
    channel: str | None = None,
    *,
    truth: npt.ArrayLike | None = None,
    deviations: float = 2.0,
    ax: Axes | None = None,
) -> Axes:
    """Draw an estimate over time with a band of its standard deviation.

    Parameters
    ----------
    result : Estimate
        Result of `observer.estimate(records)`.
    channel : str, optional
        `die:hat` or `y1:innovation`; by default the first estimate.
    truth : (N,) array, optional
        True motion, where it is known; the error of the estimate is then drawn.
    deviations : float
        Half the width of the band, in standard deviations.
    ax : Axes, optional
        Axes to draw on; by default those of a new figure.

    Raises
    ------
    ModelError
        When `result` is not an Estimate, or the truth or the width is not a number.

    Examples
    --------
    >>> import flexplant as fx
    >>> import numpy as np
    >>> observer = fx.design_kalman(fx.testbeds.three_masses())
    >>> found = observer.estimate({name: np.zeros(50) for name in ("y1", "y2", "u1")})
    >>> ax = fx.plot.estimate(found)
    >>> ax.get_xlabel()
    'time [ms]'
    """
    instance(result, Estimate, "result", "Pass what observer.estimate returned.")
    name = result.names[0] if channel is None else channel
    signal, spread = result[name], positive(deviations, "deviations") * result.deviation(name)
    middle = np.zeros_like(signal) if name.endswith(":innovation") else signal
    label = name
    if truth is not None:
        signal = signal - real_array(truth, "truth", signal.shape)
        middle, label = np.zeros_like(signal), f"error of {name}"
    known = np.isfinite(signal) & np.isfinite(spread)
    size = float(np.max(np.abs(signal[known]), initial=0.0))
    given, ax = ax is not None, axes(ax, figsize=(9.0, 3.6))
    factor, unit = shown_in(ax.yaxis, size, result.units.get(name))
    second, time = shown_in(ax.xaxis, float(np.max(np.abs(result.time), initial=0.0)), "s")
    low, high = (np.where(known, middle + s * spread, np.nan) / factor for s in (-1.0, 1.0))
    ax.fill_between(result.time / second, low, high, color=BLUE, alpha=0.25, linewidth=0.0,
                    label=f"\N{PLUS-MINUS SIGN} {deviations:g} standard deviations")  # fmt: skip
    ax.plot(result.time / second, signal / factor, color=BLUE, linewidth=0.8, label=label)
    return finish(ax, x=named("time", time), y=named(label, unit), given=given)


def _name_cases(ax: Axes, cases: Sequence[str], errors: Sequence[FloatArray]) -> None:
    """Write the names of cases above each of their pairs of errors, row by row, within the axes."""
    texts = name_list(cases, "cases")
    count = len(errors[0])
    if texts and len(texts) != count:
        raise ShapeError(f"{len(texts)} names of cases are given for {count}. Name each.")
    for i, pairs in enumerate(errors):
        for name, (predicted, found) in zip(texts, pairs, strict=False):
            middle = np.sqrt(predicted * found)
            ax.annotate(
                name, (middle, len(errors) - 1 - i), (0, 11),
                textcoords="offset points", ha="center", fontsize="small",
            )  # fmt: skip
    ends = [text.get_window_extent().transformed(ax.transAxes.inverted()) for text in ax.texts]
    beyond = max((max(-box.x0, box.x1 - 1.0) for box in ends), default=0.0)
    ax.margins(x=0.05 + 1.5 * max(beyond, 0.0))


def _draw_row(ax: Axes, place: float, table: FloatArray, color: str) -> None:
    """Draw one design: bars first, so that the diamonds around them stay visible."""
    predicted, found, low, high = table.T
    ax.hlines(np.full(found.size, place), np.minimum(predicted, found),
              np.maximum(predicted, found), color=color, linewidth=1.0)  # fmt: skip
    bars = np.maximum(np.array([found - low, high - found]), 0.0)
    ax.errorbar(found, np.full(found.size, place), xerr=bars, fmt="|", color=BLACK, capsize=4,
                markersize=14, markeredgewidth=2.0)  # fmt: skip
    ax.plot(predicted, np.full(found.size, place), "D", color=color, fillstyle="none",
            markersize=9, markeredgewidth=2.0)  # fmt: skip


#: number of windows for the mean NIS of a record, and least number of samples in a window
_WINDOWS, _SHORTEST = 60, 20


def consistency(
    estimate: Estimate,
    found: ConsistencyReport | None = None,
    *,
    level: float = 0.95,
    ax: Sequence[Axes] | None = None,
) -> Axes:
    """Draw three tests of the innovations of a filter against its model.

    The first test is the normalised innovation squared (NIS) over time, which is about 1 if the
    noises have the stated size. The second is its correlation over lags, which is about 0 for a
    correct model. The third is the cumulative periodogram minus a straight line, which is about 0
    for white innovations. Dotted lines are bounds at the given `level`. For a correct model this
    fraction of the points lies between the bounds in the first two tests. In the third test the
    whole curve lies between them with this probability.

    Parameters
    ----------
    estimate : Estimate
        Result of `observer.estimate(records)`.
    found : ConsistencyReport, optional
        Result of `flexplant.estimation.consistency`, whose verdict becomes the title.
    level : float
        Confidence level of the bounds.
    ax : three Axes, optional
        Three axes to draw on; by default those of a new figure.

    Returns
    -------
    Axes
        Axes of the NIS; its `.figure.axes` lists all axes.

    Raises
    ------
    ModelError
        When an argument has a wrong type, there are fewer than 200 samples with all innovations, or
        `ax` does not hold three axes.

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
    instance(found, ConsistencyReport | None, "found", "Pass what consistency returned.")
    between(level, "level", 0.5, 1.0, "Pass 0.95.", ends="[")
    white = estimate.whitened.T
    there = np.all(np.isfinite(white), axis=1)
    if int(there.sum()) < FEWEST:
        raise ModelError(
            f"a picture needs at least {FEWEST} samples with all innovations, got "
            f"{int(there.sum())}. Pass a longer record."
        )
    given, panels = ax is not None, three_axes(ax, 1, 3, figsize=(13.0, 3.8))
    _nis(panels[0], estimate.time[there], white[there], level)
    dt = float(np.median(np.diff(estimate.time)))
    _draw_correlation(panels[1], white, dt, level)
    _periodogram(panels[2], white, 1.0 / dt, level)
    legend(panels[0], given=True)
    if found is not None and not given:
        panels[0].figure.suptitle(found.text, fontsize="medium", wrap=True)
    return panels[0]


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


def _draw_correlation(ax: Axes, white: FloatArray, dt: float, level: float) -> None:
    from scipy.stats import norm

    there = np.all(np.isfinite(white), axis=1)
    x = np.where(there[:, None], white, 0.0)
    count = int(there.sum())
    lags = min(100, count // 20)
    second, unit = shown_in(ax.xaxis, lags * dt, "s")
    for j, look in zip(range(x.shape[1]), CYCLE, strict=False):
        power = np.fft.rfft(x[:, j], 2 * len(x))
        whole = np.fft.irfft(np.abs(power) ** 2)[: lags + 1]
        lag = dt * np.arange(1, lags + 1) / second
        marker = "o^sDvP"[j % 6]
        ax.plot(lag, whole[1:] / whole[0], marker, color=look["color"], markersize=2.5)
    _level_bounds(ax, float(norm.ppf(0.5 + 0.5 * level)) / np.sqrt(count))
    finish(ax, x=named("lag", unit), y="correlation of whitened innovations [-]")


def _periodogram(ax: Axes, white: FloatArray, rate: float, level: float) -> None:
    from scipy.stats import kstwobign

    found = lines_of(white).pooled
    total = np.cumsum(found.density) / found.density.sum()
    line = np.arange(1, total.size + 1) / total.size
    bound = float(kstwobign.ppf(level)) / np.sqrt(found.density.size * found.channels)
    factor, unit = shown_in(ax.xaxis, 0.5 * rate, "Hz")
    freq = found.freq * rate / factor
    ax.plot(freq, total - line, color=BLUE)
    _level_bounds(ax, bound)
    finish(ax, x=named("frequency", unit), y="cumulative periodogram minus a straight line [-]")


def _level_bounds(ax: Axes, bound: float) -> None:
    ax.axhline(0.0, color=BLACK, linewidth=0.8)
    for sign in (-1.0, 1.0):
        ax.axhline(sign * bound, **STYLES["bound"])

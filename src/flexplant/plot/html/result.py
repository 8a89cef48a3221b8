"""What a report begins with: the error at the POI, the margins, stability with modes left out."""

from __future__ import annotations

import re
from collections.abc import Callable, Iterator, Mapping, Sequence
from html import escape
from typing import Any, TypeVar

import numpy as np

from ...certificates import one_line, stability_name
from ...checks import Value, short, with_unit
from ...errors import FlexplantError, ModelError, counted
from ...loop import (
    ClosedLoop,
    ErrorBudget,
    LoopComparison,
    LoopFigures,
    compare_loops,
    report_loops,
)
from ...loop.blocks import references
from ...loop.report import axis_sensitivities, error_sensitivity
from ...plant import StandardPlant
from ...simulation import ExposureErrors, Verdict
from ..errors import budget
from ..loops import nyquist, sensitivity
from .page import Chapter, Gallery, note, table, tiles

Tile = tuple[str, str, str, str]


def result(design: Design, gallery: Gallery, channel: str | None) -> Chapter | None:
    """Return the section of what matters most, of the first loop; None without a loop."""
    loops = design.of(ClosedLoop)
    if not loops:
        return None
    name, loop = next(iter(loops.items()))
    main = _main(loop, channel)
    compared = _loop_figures(loops, main)
    found, why = _budget(loop, main)
    parts = [tiles([_error_tile(main, found), *_stability(loop), *_margins(compared.rows[name])])]
    for verdict in design.of(Verdict).values():
        said = "The specification is met."
        if not verdict.passed:
            said = f"The specification is not met: {', '.join(verdict.failed)}."
        parts.append(note(said, "note" if verdict.passed else "bad"))
    for kind in (Verdict, ExposureErrors):
        parts += [one._repr_html_() for one in design.of(kind).values()]
    if len(loops) > 1:
        parts += [note(f"These figures are of {name}; all loops:"), compared._repr_html_()]
    if found is None:
        return Chapter("Result", "".join([*parts, note(why, "bad")]))
    caption = f"Where the error of {main} comes from, by frequency and source"
    picture = gallery.picture(lambda: budget(found), caption)
    # without reference an error is as large as the motion
    errors = [n for n in loop.plant.z if n.endswith(":error")] if loop.plant.is_assembled else []
    followed = loop.plant.assembled.ports.followed if errors else ()
    twice = {poi.channel(axis) for poi, axis in followed}
    shown = [n for n in loop.plant.z if n not in twice]
    rows = [[n, with_unit(loop.rms(n), loop.units.get(n))] for n in shown]
    motions = table(["channel", "rms under all noises"], rows)
    parts.append(
        f"<h3>Error budget of {escape(main)}</h3>"
        f'<div class="pictures">{picture}<div>{found._repr_html_()}{motions}</div></div>'
    )
    others = [n for n in loop.plant.z if n != main and n.endswith(":error")]
    drawn = "".join(html_or_why(lambda n=n: _other_budget(loop, n, gallery)) for n in others)  # type: ignore[misc]
    if drawn:
        parts.append(f'<h3>Error budgets of the other axes</h3><div class="pictures">{drawn}</div>')
    return Chapter("Result", "".join(parts))


def _other_budget(loop: ClosedLoop, channel: str, gallery: Gallery) -> str:
    found = loop.budget(channel)
    return gallery.picture(lambda: budget(found, most=3), f"Where {channel} comes from")


def _main(loop: ClosedLoop, channel: str | None) -> str:
    """Return the channel that comes first: the one asked for, else the first error."""
    return channel or next((n for n in loop.plant.z if n.endswith(":error")), loop.plant.z[0])


def loops_section(design: Design, gallery: Gallery, channel: str | None) -> Chapter | None:
    """Return the section of margins, loop by loop, and of sensitivities; None without a loop."""
    loops = design.of(ClosedLoop)
    if not loops:
        return None
    parts = []
    compared = _loop_figures(loops, _main(next(iter(loops.values())), channel))
    stable = {name: loop for name, loop in loops.items() if compared.rows[name].stable}
    if compared.channel and stable:
        name, first = next(iter(stable.items()))
        axes = axis_sensitivities(first)
        caption, drawn = f"Sensitivity |S|, {compared.channel}", ""
        if len(axes) < 2 or len(stable) > 1:
            pair = compared.channel.split(" to ")
            lines = {label: error_sensitivity(one, *pair) for label, one in stable.items()}
            drawn = gallery.picture(lambda: sensitivity(lines), caption)
        if len(axes) > 1:
            caption = f"{name}: sensitivity |S| of each axis, from its reference to its error"
            drawn += gallery.picture(lambda: sensitivity(axes), caption)
        caption = f"{name}: each loop broken at its actuator while the others stay closed"
        drawn += gallery.picture(lambda: nyquist(first), caption)
        parts.append(f'<div class="pictures">{drawn}</div>')
    for name, loop in loops.items():
        parts += [f"<h3>{escape(name)}</h3>", loop._repr_html_()]
        parts.append(html_or_why(lambda loop=loop: _margin_table(loop)))  # type: ignore[misc]
    return Chapter("Loop", "".join(parts))


def _loop_figures(loops: Mapping[str, ClosedLoop], channel: str) -> LoopComparison:
    """Return the figures of loops, of S from the reference of an error, else from the first."""
    known = references(next(iter(loops.values())).plant)
    own = f"{channel.removesuffix(':error')}:ref"
    return compare_loops(loops, reference=own if own in known else next(iter(known), None))


def html_or_why(make: Callable[[], str]) -> str:
    """Return HTML, or in its place why it cannot be computed."""
    try:
        return make()
    except FlexplantError as error:
        return note(f"Not shown: {error}")


def _budget(loop: ClosedLoop, channel: str) -> tuple[ErrorBudget | None, str]:
    """Return the error budget, or why there is none."""
    try:
        return loop.budget(channel), ""
    except FlexplantError as error:
        return None, f"No error budget: {error}"


def _error_tile(channel: str, found: ErrorBudget | None) -> Tile:
    if found is None:
        return (f"{channel}, rms", "none", "see below", "bad")
    beside, kind = "modes left out: not known", ""
    if np.isinf(found.left_out):
        beside, kind = "unstable with the modes left out", "bad"
    elif np.isfinite(found.left_out):
        beside = f"with the modes left out {with_unit(found.left_out, found.unit)}"
    return (f"{channel}, rms", with_unit(found.rms, found.unit), beside, kind)


def _stability(loop: ClosedLoop) -> list[Tile]:
    stable = loop.obstacle is None
    sampled = bool(loop.plant.dt)
    size = loop.spectral_radius if sampled else loop.spectral_abscissa
    own = one_line({stability_name(sampled): size})
    found = [("stability", "stable" if stable else "UNSTABLE", own, "good" if stable else "bad")]
    left = loop.left_out
    if left is None:
        return [*found, ("with the modes left out", "not checked", "close_loop(larger=...)", "")]
    figure = "stable" if left.is_stable else "UNSTABLE"
    beside = one_line({stability_name(sampled): left.stability})
    if left.modes:
        beside = left.named_modes
    kind = "good" if left.is_fine else "bad"
    return [
        *found,
        (f"with the modes left out ({counted(left.states, 'state')})", figure, beside, kind),
    ]


def _margins(row: LoopFigures) -> list[Tile]:
    if not row.stable:
        return []
    peak = 20.0 * np.log10(1.0 / row.margin)
    tiles: list[Tile] = [
        ("|S| at u, largest", f"{peak:.1f} dB", f"modulus margin {row.margin:.3g}", "")
    ]
    if np.isfinite(row.bandwidth):
        most = f"|S| at most {20.0 * np.log10(row.peak):.1f} dB, at {row.peak_freq:.4g} Hz"
        tiles.append(("|S| < 1 up to", f"{row.bandwidth:.4g} Hz", most, ""))
    return tiles


def _margin_table(loop: ClosedLoop) -> str:
    if loop.obstacle is not None:
        return note(f"No margins: {loop.obstacle.reason}.", "bad")
    found: Any = report_loops(loop)
    rows = []
    for one in found.values():
        gain = f"{20.0 * np.log10(one.gain_margin):.1f}" if np.isfinite(one.gain_margin) else "none"
        if one.gain_reduction:
            gain += f" and {20.0 * np.log10(one.gain_reduction):.1f}"
        crosses = ", ".join(f"{f:.4g}" for f in one.crossovers[:3]) or "none"
        rows.append([
            one.name, crosses, gain, f"{one.phase_margin:.0f}",
            f"{one.modulus_margin:.3f}", f"{one.freq:.4g}",
        ])  # fmt: skip
    head = [
        *("loop broken at", "crosses 1 at [Hz]", "gain margin [dB]", "phase margin [deg]"),
        *("modulus margin", "at [Hz]"),
    ]
    return table(head, rows, "Each loop broken at its actuator while the others stay closed")


Kind = TypeVar("Kind")


class Design:
    """Named values in the order in which they were given."""

    def __init__(self, parts: Sequence[Any]) -> None:
        self.named: dict[str, Any] = {}
        for name, value in _named_parts(parts):
            own = name or _free_name(type(value).__name__, self.named)
            if own in self.named:
                raise ModelError(f"two parts of the report are named {own!r}: rename one.")
            self.named[own] = value
        if not self.named:
            raise ModelError(
                "there is nothing to report: pass values, such as a closed loop and its run."
            )

    def of(self, kind: type[Kind]) -> dict[str, Kind]:
        """Return the values of a kind by name."""
        return {name: one for name, one in self.named.items() if isinstance(one, kind)}

    @property
    def plant(self) -> StandardPlant | None:
        """The plant that was given, else that of the first loop."""
        own: list[StandardPlant] = list(self.of(StandardPlant).values())
        return next(iter([*own, *(loop.plant for loop in self.of(ClosedLoop).values())]), None)


def _named_parts(parts: Sequence[Any]) -> Iterator[tuple[str, Any]]:
    for part in parts:
        named = isinstance(part, Mapping) and not isinstance(part, Value)
        for name, value in part.items() if named else [("", part)]:
            if not isinstance(value, Value):
                raise ModelError(
                    f"a report holds values of flexplant, got {short(value)}. Pass plants, loops, "
                    "controllers, runs and so on, or mappings of names to such."
                )
            yield str(name), value


def _free_name(name: str, taken: Mapping[str, Any]) -> str:
    name = re.sub(r"(?<=[a-z])(?=[A-Z])", " ", name).capitalize()
    numbers = (f" {i}" if i > 1 else "" for i in range(1, len(taken) + 2))
    return next(f"{name}{number}" for number in numbers if f"{name}{number}" not in taken)

"""report: a design as one self-contained HTML page."""

from __future__ import annotations

import re
from collections.abc import Callable, Iterator, Mapping, Sequence
from functools import partial
from html import escape
from pathlib import Path
from typing import Any, TypeVar

import numpy as np

from ..certificates import Certificate, Verified, one_line, stability_check, stability_name
from ..errors import FlexplantError, ModelError, counted, short, with_unit
from ..estimation import LagReport, consistency
from ..identification import StabilisationDiagram
from ..loop import ClosedLoop, ErrorBudget, LoopComparison, LoopFigures, compare_loops, report_loops
from ..loop.blocks import references
from ..loop.broken import axis_sensitivities, error_sensitivity
from ..loop.other_machines import BANDWIDTH, MODULUS_MARGIN
from ..lti.frequency import Frf, frequency_response
from ..lti.statespace import StateSpace
from ..modes import Modes
from ..parallel import Progress, tick
from ..placement import ParetoCurve, Placement, SensorMap
from ..plant import AnyPlant, StandardPlant, driven_axes
from ..plant.partitioned import NOT_JUDGED
from ..reduction import ReducedModel
from ..rooms import versions
from ..simulation import ErrorMap, ExposureErrors, Response, Verdict
from ..store import Value, written
from ..synthesis import Controller
from ..tolerances import CHANCE
from ..updating import Localisation, UpdateResult
from ._axes import (
    CHANNELS,
    STYLES,
    bottom_only,
    decibel,
    finish,
    name_panel,
    panel_axes,
    port_directions,
    readable,
)
from .bode_diagrams import bode, singular_values
from .errors import budget, error_map
from .estimation import lag_report
from .html_page import Chapter, Gallery, moving_shapes, note, page, table, tiles
from .identification import stabilisation
from .loops import nyquist, sensitivity
from .placement import pareto_curve, placed, sensor_map
from .run_pictures import response
from .updating import localisation, parameters, residual

#: headings in the order of the page, and the packages of their values
_HEADINGS = {
    "Runs": ("simulation",),
    "Controller": ("synthesis",),
    "Observer": ("estimation",),
    "Placement": ("placement",),
    "Plant": ("plant",),
    "Measurement and update": ("identification", "updating"),
    "Machine": ("structure", "modes", "reduction", "labels"),
}

Picture = tuple[str, Callable[[], Any]]


def room_sections(design: Designed, gallery: Gallery) -> Iterator[Chapter]:
    """Yield the sections of all values but loops and verdicts, each value under its room."""
    shown = {
        name: value
        for name, value in design.named.items()
        if not isinstance(value, ClosedLoop | Verdict | ExposureErrors)
    }
    plant = design.plant
    if plant is not None and not any(isinstance(one, AnyPlant) for one in shown.values()):
        shown["Plant of the loop"] = plant
    headed = {room: heading for heading, rooms in _HEADINGS.items() for room in rooms}
    for heading in (*_HEADINGS, "Other values"):
        parts = [
            _value_lines(name, value, design, gallery)
            for name, value in shown.items()
            if headed.get(type(value).__module__.split(".")[1], "Other values") == heading
        ]
        if parts:
            yield Chapter(heading, "".join(parts))


def _value_lines(name: str, value: Any, design: Designed, gallery: Gallery) -> str:
    """Return a value: its name, its repr, tables and pictures."""
    own = value._repr_html_()
    parts = [f"<h3>{escape(name)}</h3>", own]
    loop = next(iter(design.of(ClosedLoop).values()), None)
    if isinstance(value, Response) and value.seed is not None and loop is not None:
        parts.append("<h4>Compared with the model of the loop</h4>")
        parts.append(html_or_why(lambda: consistency(loop, value)._repr_html_()))
    modes = value.modes() if isinstance(value, ReducedModel) else value
    if isinstance(modes, Modes):
        parts.append(
            f'<div class="pictures">{moving_shapes(modes)}<div>{_modes_table(modes)}</div></div>'
        )
    drawn = [
        html_or_why(partial(gallery.picture, draw, said))
        for said, draw in _pictures(name, value, design)
    ]
    if len(drawn) == 1 and len(parts) == 2:  # side by side: no half of the page stays empty
        parts[1:] = [f'<div class="pictures">{drawn[0]}<div>{own}</div></div>']
    elif drawn:
        parts.append(f'<div class="pictures">{"".join(drawn)}</div>')
    if isinstance(value, AnyPlant):
        shown = html_or_why(lambda: value.check()._repr_html_())
        parts.append(html_or_why(lambda: _ports_table(value.machine)))
        parts.append(f"<details><summary>Standard assumptions</summary>{shown}</details>")
    tick("report")
    return "".join(parts)


def _pictures(name: str, value: Any, design: Designed) -> list[Picture]:
    """Return captions and functions that draw a value."""
    if isinstance(value, Response):
        over: list[Picture] = [(f"{name}: errors over time", partial(response, value))]
        forces = [n for n in value if n.endswith(":effort")]
        if forces and any(n.endswith(":error") for n in value):
            over.append((f"{name}: forces over time", partial(response, value, forces)))
        return over
    if isinstance(value, AnyPlant) and value.machine.model is not None:
        said = "Sensors, actuators and POIs; arrows show the directions of action and measurement"
        own = value.machine
        return [
            (said, partial(placed, own)),
            ("The plant, from forces along each axis to the POI", partial(_axis_responses, own)),
        ]
    plant = design.plant
    if isinstance(value, Placement) and plant is not None and plant.model is not None:
        return [("The chosen places", lambda: placed(value.on(plant.machine)))]
    if isinstance(value, Controller | StateSpace | Frf):
        system: Any = value.system if isinstance(value, Controller) else value
        if len(system.inputs) * len(system.outputs) <= CHANNELS:
            return [(f"Bode diagram of {name}", partial(bode, system))]
        caption = f"Singular values of {name}, the area down to the smallest"
        return [(caption, partial(singular_values, system))]
    if isinstance(value, UpdateResult):
        few = len(value.parameters) <= CHANNELS
        through: list[Picture] = [("Parameters through the update", partial(parameters, value))]
        return through * few + [("Residuals through the update", partial(residual, value))]
    simple: dict[type, tuple[str, Callable[[Any], Any]]] = {
        ErrorBudget: ("Error budget", budget),
        ErrorMap: ("Errors over the surface", error_map),
        LagReport: ("Error of the estimate over its lag", lag_report),
        Localisation: ("Places where the model differs", localisation),
        ParetoCurve: ("Benefit of each further device", pareto_curve),
        SensorMap: ("Benefit of one more sensor by place", sensor_map),
        StabilisationDiagram: ("Stabilisation diagram", stabilisation),
    }
    fit = (picture for kind, picture in simple.items() if isinstance(value, kind))
    return [(said, partial(draw, value)) for said, draw in fit]


def _axis_responses(plant: StandardPlant) -> None:
    """Draw the plant from a total force along each axis that the actuators move to the axis."""
    # where they do not move axes independently, the singular values from u to y
    try:
        driven = driven_axes(plant)
    except FlexplantError:
        singular_values(plant.Gyu)
        return
    channels = list(driven.channels)
    P = frequency_response(plant.system.select(channels, plant.u))
    data = np.einsum("kuf,uk->kf", P.data, driven.T / np.abs(driven.T).sum(axis=0))
    panels = panel_axes(None, len(channels))
    for panel, name, row in zip(panels, channels, data, strict=True):
        panel.semilogx(P.freq, decibel(row), **STYLES["model"])
        unit = "rad/(N m)" if plant.units.get(name) == "rad" else "m/N"
        name_panel(panel, name)
        readable(panel)
        finish(panel, x="frequency [Hz]", y=f"[dB, 0 dB = 1 {unit}]")
    bottom_only(panels)


def _modes_table(modes: Modes) -> str:
    rows = []
    for k in range(min(modes.n_modes, 40)):
        elastic = k >= modes.n_rigid
        freq = f"{modes.freq[k]:.5g} Hz" if elastic else "rigid-body"
        rows.append([str(k + 1), freq, f"{100 * modes.zeta[k]:.3g} %" if elastic else ""])
    more = f"The first 40 of {modes.n_modes} modes" if modes.n_modes > 40 else ""
    return table(["mode", "frequency", "damping"], rows, more)


def _ports_table(plant: StandardPlant) -> str:
    """Return the channels with their places and noise."""
    ports = plant.assembled.ports
    units = {"w": "N/√Hz", "u": "N", "y": "m/√Hz"}
    kinds = {"w": "w disturbance", "u": "u actuator", "z": "z POI", "y": "y sensor"}
    rows = []
    for side, kind in kinds.items():
        for port in getattr(ports, side):
            where = _place_text(getattr(port, "at", ""))
            own = plant.units.get(port.name)
            unit, asd = f"{own}/√Hz" if own else units.get(side, ""), getattr(port, "asd", 0.0)
            density = with_unit(asd, unit) if asd else ""
            rows.append([port.name, kind, where, " ".join(port_directions(port)), density])
    return table(["channel", "kind", "place [m]", "along", "noise density"], rows)


def _place_text(at: Any) -> str:
    """Return a place in words: a label, a point, or a weighted sum of such."""
    if isinstance(at, Mapping):
        parts = (f"{weight:+g} of {_place_text(one)}" for one, weight in at.items())
        return " ".join(parts).removeprefix("+")
    return at if isinstance(at, str) else f"({', '.join(f'{x:g}' for x in at)})"


def certificates(design: Designed) -> Chapter | None:
    """Return the section of all checks."""
    rows = [
        [name, check.what.replace("_", " "), *check.row[1:3], _VERDICTS[check.holds], check.route]
        for name, value in design.named.items()
        for check in _checks_of(value)
    ]
    if not rows:
        return None
    head = ["value", "checked", "figure", "limit", "verdict", "route"]
    return Chapter("Certificates", table(head, rows))


#: words for whether a figure keeps its limit; without a limit it only informs
_VERDICTS = {True: "good", False: "bad", None: "no limit"}


def _checks_of(value: Any) -> Iterator[Verified]:
    own = getattr(value, "certificate", None)
    if isinstance(own, Certificate):
        yield from own.checks
    if isinstance(value, ClosedLoop):
        sampled = bool(value.plant.dt)
        least = value.spectral_radius if sampled else value.spectral_abscissa
        yield stability_check(least, sampled)
        yield Verified("modulus margin", value.modulus_margin, "a sweep of |1 + L|")
        if value.left_out is not None:
            yield from value.left_out.certificate.checks
    if isinstance(value, UpdateResult) and value.chi2 is not None:
        what = f"p-value of chi-square {value.chi2:.4g}, {value.dof} expected"
        yield Verified(
            what, value.p_value or 0.0, "residuals over their covariance", CHANCE, at_least=True
        )
    if isinstance(value, Placement):
        what = f"value [{value.unit}]" if value.unit else "value"
        yield Verified(what, value.value, "lower bound of all choices", value.bound, at_least=True)


Tile = tuple[str, str, str, str]


def result(design: Designed, gallery: Gallery, channel: str | None) -> Chapter | None:
    """Return the section of the main results, for the first loop; None without a loop."""
    loops = design.of(ClosedLoop)
    if not loops:
        return None
    name, loop = next(iter(loops.items()))
    main = _main(loop, channel)
    compared = _loop_figures(loops, main)
    found, why = None, ""
    try:
        found = loop.budget(main)
    except FlexplantError as error:
        why = f"No error budget: {error}"
    margins = _margins(loop, compared.rows[name])
    parts = [tiles([_error_tile(main, found), *_stability(loop), *margins])]
    for verdict in design.of(Verdict).values():
        said = "The specification is met."
        if not verdict.passed:
            said = f"The specification is not met: {', '.join(verdict.failed)}."
        parts.append(note(said, "note" if verdict.passed else "bad"))
    for kind in (Verdict, ExposureErrors):
        parts += [one._repr_html_() for one in design.of(kind).values()]
    if len(loops) > 1:
        parts += [note(f"These figures belong to {name}; all loops:"), compared._repr_html_()]
    if found is None:
        return Chapter("Result", "".join([*parts, note(why, "bad")]))
    caption = f"Contributions to the error of {main}, by frequency and source"
    picture = gallery.picture(lambda: budget(found), caption)
    # without a reference the error equals the motion
    twice = {poi.channel(axis) for poi, axis in loop.plant.ports.followed}
    shown = [n for n in loop.plant.z if n not in twice]
    rows = [[n, with_unit(loop.rms(n), loop.units.get(n))] for n in shown]
    motions = table(["channel", "rms under all noises"], rows)
    parts.append(
        f"<h3>Error budget of {escape(main)}</h3>"
        f'<div class="pictures">{picture}<div>{found._repr_html_()}{motions}</div></div>'
    )
    others = [n for n in loop.plant.z if n != main and n.endswith(":error")]
    drawn = "".join(html_or_why(partial(_other_budget, loop, n, gallery)) for n in others)
    if drawn:
        parts.append(f'<h3>Error budgets of the other axes</h3><div class="pictures">{drawn}</div>')
    return Chapter("Result", "".join(parts))


def _other_budget(loop: ClosedLoop, channel: str, gallery: Gallery) -> str:
    found = loop.budget(channel)
    return gallery.picture(lambda: budget(found, most=3), f"Contributions to {channel}")


def _main(loop: ClosedLoop, channel: str | None) -> str:
    """Return the main channel: the requested one, else the first error."""
    return channel or next((n for n in loop.plant.z if n.endswith(":error")), loop.plant.z[0])


def loops_section(design: Designed, gallery: Gallery, channel: str | None) -> Chapter | None:
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
        parts.append(html_or_why(partial(_margin_table, loop)))
    return Chapter("Loop", "".join(parts))


def _loop_figures(loops: Mapping[str, ClosedLoop], channel: str) -> LoopComparison:
    """Return the figures of loops, of S from the reference of an error, else from the first."""
    known = references(next(iter(loops.values())).plant)
    own = f"{channel.removesuffix(':error')}:ref"
    return compare_loops(loops, reference=own if own in known else next(iter(known), None))


def html_or_why(make: Callable[[], str]) -> str:
    """Return HTML, or the reason why it cannot be computed."""
    try:
        return make()
    except FlexplantError as error:
        return note(f"Not shown: {error}")


def _error_tile(channel: str, found: ErrorBudget | None) -> Tile:
    if found is None:
        return (f"{channel}, rms", "none", "see below", "bad")
    detail, kind = "truncated modes: not known", ""
    if np.isinf(found.left_out):
        detail, kind = "unstable with the truncated modes", "bad"
    elif np.isfinite(found.left_out):
        detail = f"with the truncated modes {with_unit(found.left_out, found.unit)}"
    if found.interval:
        detail += f"; {found.interval}"
    return (f"{channel}, rms", with_unit(found.rms, found.unit), detail, kind)


def _stability(loop: ClosedLoop) -> list[Tile]:
    stable = loop.obstacle is None
    sampled = bool(loop.plant.dt)
    size = loop.spectral_radius if sampled else loop.spectral_abscissa
    own = one_line({stability_name(sampled): size})
    found = [("stability", "stable" if stable else "UNSTABLE", own, "good" if stable else "bad")]
    left = loop.left_out
    if left is None:
        return [*found, ("with the truncated modes", NOT_JUDGED, "assemble_plant(evaluation=)", "")]
    word, kind = "stable" if left.is_stable else "UNSTABLE", "good" if left.is_fine else "bad"
    detail = left.named_modes if left.modes else one_line({stability_name(sampled): left.stability})
    what = f"with the truncated modes ({counted(left.states, 'state')})"
    return [*found, (what, word, detail, kind)]


def _margins(loop: ClosedLoop, row: LoopFigures) -> list[Tile]:
    if not row.stable:
        return []
    known = bool(loop.plant.dt) and loop.plant.machine.machines is not None
    margin, reached = (
        f"; {loop.interval(name).sentence}" if known else "" for name in (MODULUS_MARGIN, BANDWIDTH)
    )
    peak = 20.0 * np.log10(1.0 / row.margin)
    judged = "" if loop.left_out is None else " with the truncated modes"
    most = f"modulus margin {row.margin:.3g}{judged}{margin}"
    tiles: list[Tile] = [("|S| at u, largest", f"{peak:.1f} dB", most, "")]
    if np.isfinite(row.bandwidth):
        most = f"|S| at most {20.0 * np.log10(row.peak):.1f} dB, at {row.peak_freq:.4g} Hz"
        tiles.append(("|S| < 1 up to", f"{row.bandwidth:.4g} Hz", most + reached, ""))
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


class Designed:
    """Named values in the given order."""

    def __init__(self, parts: Sequence[Any]) -> None:
        self.named: dict[str, Any] = {}
        for name, value in _named_parts(parts):
            own = name or _free_name(type(value).__name__, self.named)
            if own in self.named:
                raise ModelError(f"two parts of the report are named {own!r}: rename one.")
            self.named[own] = value
        if not self.named:
            raise ModelError("the report is empty: pass values, such as a closed loop and its run.")

    def of(self, kind: type[Kind]) -> dict[str, Kind]:
        """Return the values of a kind by name."""
        return {name: one for name, one in self.named.items() if isinstance(one, kind)}

    @property
    def plant(self) -> AnyPlant | None:
        """The given plant, else that of the first loop."""
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


def report(
    path: str | Path,
    *parts: Any,
    title: str = "Design report",
    subtitle: str = "",
    channel: str | None = None,
    seeds: Mapping[str, Any] | None = None,
) -> Path:
    """Write a design to one self-contained HTML file: result, design, certificates, versions.

    The file needs no other files and no network. Its pictures can be zoomed, dragged and read with
    the cursor, mode shapes move, and it can be printed. Equal values give identical files.

    Parameters
    ----------
    path : str or Path
        Path of the file; an existing file is replaced.
    *parts : values of this package, or mappings {name: value}
        Values to report, in any order: plants, observers, controllers, loops, runs, placements,
        modes, updates, studies. If there are several loops, the figures at the top belong to the
        first one. Values of other kinds are shown as text.
    title, subtitle : str
        Title and subtitle. No date is added, so that equal designs give equal files.
    channel : str, optional
        Channel of z that is shown first; by default the first error at a POI.
    seeds : mapping {str: seed}, optional
        Seeds of random numbers, for the record, in addition to the seeds stored in runs.

    Returns
    -------
    Path
        The file.

    Raises
    ------
    ModelError
        When no value is given, or a part is not a value of this package.

    Examples
    --------
    >>> import flexplant as fx, tempfile
    >>> folder = tempfile.mkdtemp()
    >>> file = fx.plot.report(f"{folder}/filter.html", {"filter": fx.lti.low_pass_filter(10.0)})
    >>> "filter" in file.read_text(encoding="utf-8")
    True
    """
    design, gallery = Designed(parts), Gallery()
    runs = design.of(Response).items()
    noisy = {name: run.seed for name, run in runs if run.seed is not None}
    with Progress(len(design.named) + 2, "report", even=False) as bar:
        found = [result(design, gallery, channel)]
        bar.advance()
        found += [loops_section(design, gallery, channel)]
        bar.advance(1 + len(design.of(ClosedLoop)))
        rows = [
            [f"seed of {name}", short(seed)] for name, seed in {**noisy, **(seeds or {})}.items()
        ]
        rows += [list(pair) for pair in versions().items()]
        origin = Chapter("Seeds and versions", table(["", ""], rows, words=True))
        found += [*room_sections(design, gallery), certificates(design), origin]
    text = page(str(title), str(subtitle), [one for one in found if one is not None])
    with written(path) as file:
        file.write(text.encode("utf-8"))
    return Path(path)

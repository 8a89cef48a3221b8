"""report: a design as one self-contained page, to be mailed; its parts, each as it shows itself."""

from __future__ import annotations

import json
from collections.abc import Callable, Iterator, Mapping
from html import escape
from pathlib import Path
from typing import Any

import numpy as np

from ..certificates import Certificate, figure
from ..checks import FloatArray, IntArray, short, with_unit
from ..errors import FlexplantError
from ..estimation import LagReport, consistency
from ..identification import StabilisationDiagram
from ..loop import ClosedLoop, ErrorBudget
from ..lti.frequency import Frf, frequency_response
from ..lti.statespace import StateSpace
from ..modes import Modes
from ..parallel import Progress, tick
from ..placement import ParetoCurve, Placement, SensorMap
from ..placement.criterion import in_words
from ..plant import StandardPlant, decouple
from ..reduction import ReducedModel
from ..simulation import ErrorMap, ExposureErrors, Response, Verdict
from ..store import written
from ..synthesis import Controller
from ..tolerances import divisor
from ..updating import Localisation, UpdateResult
from ..versions import versions
from ._axes import STYLES, bottom_only, decibel, finish, name_panel, panel_axes, readable
from .bode import bode, singular_values
from .errors import budget, error_map
from .estimation import lag_report
from .html.page import Chapter, Gallery, page, table
from .html.result import Design, html_or_why, loops_section, result
from .identification import stabilisation
from .placement import pareto_curve, placed, sensor_map
from .response import response
from .updating import localisation, parameters, residual

#: headings in the order of the page, and the rooms whose values stand below them
_HEADINGS = {
    "Runs": ("simulation",),
    "Controller": ("synthesis",),
    "Observer": ("estimation",),
    "Placement": ("placement",),
    "Plant": ("plant",),
    "Measurement and update": ("identification", "updating"),
    "Machine": ("structure", "modes", "reduction", "labels"),
}
#: channels of a Bode diagram that can be read on a page
_CHANNELS = 9
#: parameters of an update that are drawn, each by itself
_PARAMETERS = 6

#: what numbers of a Kalman filter's certificate are, where their names alone do not say it
_WORDS = {
    "difference": "difference between two ways to the variances",
    "left_out": "modes left out, counted as noise",
    "unresolved": "share of a variance from modes the mesh hardly resolves",
    "residual": "residual of the equation that was solved, relative",
    "orthonormality": "shapes less orthonormal in the mass matrix",
    "rigid_residual": "force that rigid-body motions take, relative",
    "rigid_rounding": "what rounding could hide of rigid-body frequencies, Hz",
}

Picture = tuple[str, Callable[[], Any]]


def room_sections(design: Design, gallery: Gallery) -> Iterator[Chapter]:
    """Yield the sections of all values but loops and verdicts, each value under its room."""
    shown = {
        name: value
        for name, value in design.named.items()
        if not isinstance(value, ClosedLoop | Verdict | ExposureErrors)
    }
    plant = design.plant
    if plant is not None and not any(isinstance(one, StandardPlant) for one in shown.values()):
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


def _value_lines(name: str, value: Any, design: Design, gallery: Gallery) -> str:
    """Return a value: its name, what it says of itself, tables and pictures."""
    parts = [f"<h3>{escape(name)}</h3>", value._repr_html_()]
    loop = next(iter(design.of(ClosedLoop).values()), None)
    if isinstance(value, Response) and value.seed is not None and loop is not None:
        parts.append("<h4>Beside the model of the loop</h4>")
        parts.append(html_or_why(lambda: consistency(loop, value)._repr_html_()))
    modes = _modes_of(value)
    if modes is not None:
        parts.append(
            f'<div class="pictures">{moving_shapes(modes)}<div>{_modes_table(modes)}</div></div>'
        )
    drawn = [
        html_or_why(lambda draw=draw, said=said: gallery.picture(draw, said))  # type: ignore[misc]
        for said, draw in _pictures(name, value, design)
    ]
    if isinstance(value, StandardPlant):
        drawn.append(f"<div>{html_or_why(lambda: _ports_table(value))}{_assumptions(value)}</div>")
    if drawn:
        parts.append(f'<div class="pictures">{"".join(drawn)}</div>')
    tick("report")
    return "".join(parts)


def _pictures(name: str, value: Any, design: Design) -> list[Picture]:
    """Return captions and functions that draw a value."""
    if isinstance(value, Response):
        return _of_run(name, value)
    if isinstance(value, StandardPlant) and value.is_assembled:
        said = "Sensors, actuators and POIs; arrows: along what they act and measure"
        return [
            (said, lambda: placed(value)),
            ("The plant, from forces along each axis to the POI", lambda: _axis_responses(value)),
        ]
    if isinstance(value, Placement):
        plant = design.plant
        if plant is None or not plant.is_assembled:
            return []
        own = plant
        return [("The places that were chosen", lambda: placed(value.on(own)))]
    if isinstance(value, Controller | StateSpace | Frf):
        system: Any = value.system if isinstance(value, Controller) else value
        if len(system.inputs) * len(system.outputs) <= _CHANNELS:
            return [(f"Bode diagram of {name}", lambda: bode(system))]
        caption = f"Singular values of {name}, the area down to the smallest"
        return [(caption, lambda: singular_values(system))]
    if isinstance(value, UpdateResult):
        few = len(value.parameters) <= _PARAMETERS
        through: list[Picture] = [("Parameters through the update", lambda: parameters(value))]
        return through * few + [("Residuals through the update", lambda: residual(value))]
    simple: dict[type, tuple[str, Callable[[Any], Any]]] = {
        ErrorBudget: ("Error budget", budget),
        ErrorMap: ("Errors over the surface", error_map),
        LagReport: ("Error of the estimate by lag", lag_report),
        Localisation: ("Where the model differs", lambda one: localisation(one)),
        ParetoCurve: ("What each further device buys", pareto_curve),
        SensorMap: ("Where one more sensor helps", sensor_map),
        StabilisationDiagram: ("Stabilisation diagram", stabilisation),
    }
    return [
        (said, lambda draw=draw: draw(value))  # type: ignore[misc]
        for kind, (said, draw) in simple.items()
        if isinstance(value, kind)
    ]


def _axis_responses(plant: StandardPlant) -> None:
    """Draw the plant from a force at the centre of gravity to the POI, along each axis.

    Where its rigid-body motions cannot be decoupled, the singular values from u to y.
    """
    pois = plant.assembled.ports.z
    try:
        axes = decouple(plant, axes=pois[0].axes)
    except (FlexplantError, IndexError):
        singular_values(plant.Gyu)
        return
    channels = [pois[0].channel(axis) for axis in axes.axes]
    P = frequency_response(plant.system.select(channels, plant.u))
    data = np.einsum("kuf,uk->kf", P.data, axes.T_u)
    panels = panel_axes(None, len(channels))
    for panel, name, row in zip(panels, channels, data, strict=True):
        panel.semilogx(P.freq, decibel(row), **STYLES["model"])
        unit = "rad/(N m)" if plant.units.get(name) == "rad" else "m/N"
        name_panel(panel, name)
        readable(panel)
        finish(panel, x="frequency [Hz]", y=f"[dB, 0 dB = 1 {unit}]")
    bottom_only(panels)


def _of_run(name: str, run: Response) -> list[Picture]:
    errors = [n for n in run if n.endswith(":error")]
    efforts = [n for n in run if n.endswith(":effort")]
    pictures: list[Picture] = [(f"{name}: errors over time", lambda: response(run))]
    if errors and efforts:
        pictures.append((f"{name}: forces over time", lambda: response(run, efforts)))
    return pictures


def _modes_of(value: Any) -> Modes | None:
    if isinstance(value, Modes):
        return value
    return value.modes() if isinstance(value, ReducedModel) else None


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
            at = getattr(port, "at", "")
            where = ", ".join(f"{x:g}" for x in at) if _is_point(at) else str(at)
            asd = getattr(port, "asd", 0.0)
            density = with_unit(asd, _unit(plant, port.name, units.get(side, ""))) if asd else ""
            along = getattr(port, "direction", None) or " ".join(getattr(port, "axes", ()))
            rows.append([port.name, kind, where, str(along), density])
    return table(["channel", "kind", "place [m]", "along", "noise density"], rows)


def _unit(plant: StandardPlant, name: str, otherwise: str) -> str:
    own = plant.units.get(name)
    return f"{own}/√Hz" if own else otherwise


def _is_point(at: Any) -> bool:
    return isinstance(at, tuple | list | np.ndarray) and len(at) == 3 and not isinstance(at[0], str)


def _assumptions(plant: StandardPlant) -> str:
    shown = html_or_why(lambda: plant.check()._repr_html_())
    return f"<details><summary>Standard assumptions</summary>{shown}</details>"


def certificates(design: Design) -> Chapter | None:
    """Return the section of all that was verified after it was computed."""
    rows = []
    for name, value in design.named.items():
        for what, number in _certificate_lines(value):
            plain = _WORDS.get(what, what.replace("_", " "))
            rows.append([name, plain, figure(what, number)])
    if not rows:
        return None
    return Chapter("Certificates", table(["value", "verified by another computation", ""], rows))


def _certificate_lines(value: Any) -> Iterator[tuple[str, Any]]:
    own = getattr(value, "certificate", None)
    if isinstance(own, Certificate):
        own = {n: v for n, v in own._fields().items() if v is not None}
    if isinstance(own, Mapping):
        yield from own.items()
    if isinstance(value, ClosedLoop):
        if value.plant.dt:
            yield "spectral radius", value.spectral_radius
        else:
            yield "largest real part", value.spectral_abscissa
        yield "modulus margin", value.modulus_margin
        if value.left_out is not None:
            yield from value.left_out.certificate.items()
    if isinstance(value, UpdateResult) and value.chi2 is not None:
        yield "chi-square of the fit", value.chi2
        yield "its degrees of freedom", value.dof
    if isinstance(value, Placement):
        yield "value", in_words(value.value, value.unit)
        yield "no choice is below", in_words(value.bound, value.unit)


#: nodes and modes that are drawn at most
_NODES, _MODES = 1200, 24
#: neighbours of a node among which its lines are searched
_NEIGHBOURS = 27
_SELECTED = ' selected="selected"'


def moving_shapes(modes: Modes) -> str:
    """Return a figure whose modes move; empty where no DOF is a translation."""
    xyz, shapes = _translations(modes)
    if not len(xyz):
        return ""
    chosen = _thinned(xyz)
    xyz, shapes = xyz[chosen], shapes[chosen]
    centre, size = (xyz.max(axis=0) + xyz.min(axis=0)) / 2, float(np.ptp(xyz, axis=0).max()) or 1.0
    largest = np.linalg.norm(shapes, axis=1).max(axis=0)
    shapes = shapes / divisor(largest)
    count = shapes.shape[2]
    data = {
        "xyz": _whole_thousandths((xyz - centre) / size),
        "edges": neighbours(xyz).tolist(),
        "modes": [_whole_thousandths(shapes[:, :, k]) for k in range(count)],
    }
    first = min(modes.n_rigid, count - 1)  # the first that deforms
    options = "".join(
        f'<option value="{k}"{_SELECTED if k == first else ""}>{escape(name)}</option>'
        for k, name in enumerate(_mode_name(modes, k) for k in range(count))
    )
    text = json.dumps(data, separators=(",", ":")).replace("<", "\\u003c")
    return (
        '<figure class="shape"><div class="bar">'
        f'<label>mode <select>{options}</select></label><button type="button">pause</button>'
        '<label>amplitude <input type="range" min="0" max="40" value="12"/></label></div>'
        '<canvas role="img" aria-label="moving mode shape"></canvas>'
        "<figcaption>Drag to turn. Colour: size of the displacement, grey to orange; light lines: "
        "at rest. Amplitudes are exaggerated.</figcaption>"
        f'<script type="application/json">{text}</script></figure>\n'
    )


def _mode_name(modes: Modes, k: int) -> str:
    if k < modes.n_rigid:
        return f"{k + 1}: rigid-body"
    return f"{k + 1}: {modes.freq[k]:.4g} Hz, damping {100 * modes.zeta[k]:.2g} %"


def _whole_thousandths(values: FloatArray) -> list[int]:
    """Return thousandths, row by row."""
    return [int(v) for v in np.rint(1000.0 * values).ravel()]


def _translations(modes: Modes) -> tuple[FloatArray, FloatArray]:
    """Return the nodes (n, 3) that translate, and how they do in each mode (n, 3, modes)."""
    dofs, count = modes.dofs, min(modes.n_modes, _MODES)
    axis = {"x": 0, "y": 1, "z": 2}
    rows = [i for i, direction in enumerate(dofs.directions) if direction in axis]
    nodes = dofs.nodes[rows]
    unique, first, place = np.unique(nodes, return_index=True, return_inverse=True)
    shapes = np.zeros((unique.size, 3, count))
    phi = np.asarray(modes.phi)[:, :count]
    if np.iscomplexobj(phi):  # nearly real shapes, turned so that they are
        largest = phi[np.argmax(np.abs(phi), axis=0), np.arange(count)]
        phi = (phi * np.exp(-1j * np.angle(largest))).real
    shapes[place, [axis[dofs.directions[i]] for i in rows]] = phi[rows]
    return dofs.xyz[rows][first], shapes


def _thinned(xyz: FloatArray) -> IntArray:
    """Return about so many nodes as can be drawn, one for each cell of a grid."""
    cells = 4 * _NODES
    chosen: IntArray = np.arange(len(xyz))
    while chosen.size > _NODES:
        # a plane has no third extent to be divided into cells
        extent = np.maximum(np.ptp(xyz, axis=0), 1e-12)
        present = extent > 1e-6 * extent.max()
        edge = (np.prod(extent[present]) / cells) ** (1.0 / max(int(present.sum()), 1))
        place = np.floor((xyz - xyz.min(axis=0)) / edge).astype(np.int64)
        chosen = np.sort(np.unique(place, axis=0, return_index=True)[1])
        cells = int(0.7 * cells)
    return chosen


def neighbours(xyz: FloatArray) -> IntArray:
    """Return the pairs (m, 2) of nodes between which no other lies (a Gabriel graph).

    A pair is joined when the sphere with it as diameter holds no third node: the lines of a
    regular mesh without its diagonals, whatever its ratio of sides.
    """
    from scipy.spatial import cKDTree

    count = min(len(xyz), _NEIGHBOURS)
    if count < 2:
        return np.zeros((0, 2), dtype=np.int64)
    tree: Any = cKDTree(xyz)
    distance, near = tree.query(xyz, k=count)
    i = np.repeat(np.arange(len(xyz)), count)
    pairs = np.column_stack([i, near.ravel()])[distance.ravel() > 0]
    pairs = np.unique(np.sort(pairs, axis=1), axis=0)
    a, b = xyz[pairs[:, 0]], xyz[pairs[:, 1]]
    radius = 0.5 * np.linalg.norm(b - a, axis=1)
    closest, _ = tree.query((a + b) / 2, k=min(3, len(xyz)))
    # the pair itself is at the radius; a third node inside or on the sphere is nearer or as near
    # nodes of a regular mesh lie on the sphere: rounding must not decide
    inside = np.atleast_2d(closest)[:, : min(3, len(xyz))] < radius[:, None] * (1.0 - 1e-6)
    on = np.sum(closest <= radius[:, None] * (1.0 + 1e-6), axis=1) > 2
    return np.asarray(pairs[~inside.any(axis=1) & ~on], dtype=np.int64)


def report(
    path: str | Path,
    *parts: Any,
    title: str = "Design report",
    subtitle: str = "",
    channel: str | None = None,
    seeds: Mapping[str, Any] | None = None,
) -> Path:
    """Write a design to one self-contained HTML file: result, design, certificates, versions.

    The file loads nothing from elsewhere. Its pictures can be zoomed, dragged and read with the
    cursor, mode shapes move, and it prints. The same values give the same file, to the byte.

    Parameters
    ----------
    path : str or Path
        The file, replaced when it is there.
    *parts : values of this package, or mappings {name: value}
        What to report, in any order: plants, observers, controllers, loops, runs, placements,
        modes, updates, studies. Of several loops the figures at the top are those of the first.
        A value of another kind shows its repr.
    title, subtitle : str
        What stands at the top. No date is added, which would make equal designs differ.
    channel : str, optional
        The z whose error comes first; the first error at a POI when not given.
    seeds : mapping {str: seed}, optional
        What chance was drawn from, for the record, beside the seeds that runs keep.

    Returns
    -------
    Path
        The file.

    Raises
    ------
    ModelError
        When there is nothing to report, or a part is no value of this package.

    Examples
    --------
    >>> import flexplant as fx, tempfile
    >>> folder = tempfile.mkdtemp()
    >>> file = fx.plot.report(f"{folder}/filter.html", {"filter": fx.lowpass(10.0)})
    >>> "filter" in file.read_text(encoding="utf-8")
    True
    """
    design, gallery = Design(parts), Gallery()
    runs = design.of(Response).items()
    noisy = {name: run.seed for name, run in runs if run.seed is not None}
    with Progress(len(design.named) + 2, "report") as bar:
        found = [result(design, gallery, channel)]
        bar.advance()
        found += [loops_section(design, gallery, channel)]
        bar.advance(1 + len(design.of(ClosedLoop)))
        found += room_sections(design, gallery)
        found += [certificates(design), _origin({**noisy, **(seeds or {})})]
    text = page(str(title), str(subtitle), [one for one in found if one is not None])
    with written(path) as file:
        file.write(text.encode("utf-8"))
    return Path(path)


def _origin(seeds: Mapping[str, Any]) -> Chapter:
    """Return the section of versions and seeds."""
    rows = [[f"seed of {name}", short(seed)] for name, seed in seeds.items()]
    rows += [list(pair) for pair in versions().items()]
    return Chapter("Seeds and versions", table(["", ""], rows, words=True))

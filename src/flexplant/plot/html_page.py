"""One self-contained page of HTML, with its pictures and with mode shapes that move."""

from __future__ import annotations

import base64
import io
import json
import re
from collections.abc import Callable, Iterable, Sequence
from html import escape
from importlib.resources import files
from typing import Any, NamedTuple

import matplotlib as mpl
import matplotlib.pyplot as plt
import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.ticker import FixedFormatter, FuncFormatter

from ..arrays import FloatArray, IntArray, divisor
from ..modes import Modes
from .node_lines import neighbours, translations


class Chapter(NamedTuple):
    """A part of the page: its heading, and its HTML."""

    heading: str
    html: str

    @property
    def anchor(self) -> str:
        """Where a link goes to."""
        return "".join(c if c.isalnum() else "-" for c in self.heading.lower()).strip("-")


def page(title: str, subtitle: str, sections: Sequence[Chapter]) -> str:
    """Return the page: title, contents, sections, style and scripts, well-formed as XML too."""
    links = "".join(
        f'<li><a href="#{one.anchor}">{escape(one.heading)}</a></li>' for one in sections
    )
    body = "\n".join(
        f'<section id="{one.anchor}">\n<h2>{escape(one.heading)}</h2>\n{one.html}\n</section>'
        for one in sections
    )
    return f"""<!DOCTYPE html>
<html lang="en">
<head>
<meta charset="utf-8"/>
<meta name="viewport" content="width=device-width, initial-scale=1"/>
<meta http-equiv="Content-Security-Policy" content="{_ALLOWED}"/>
<title>{escape(title)}</title>
<style>
{_resource("report.css")}</style>
</head>
<body>
<header><h1>{escape(title)}</h1>{f"<p>{escape(subtitle)}</p>" if subtitle else ""}</header>
<nav aria-label="Contents"><ol>{links}</ol></nav>
<main>
{body}
</main>
<script>
{_resource("pictures.js")}{_resource("shapes.js")}</script>
</body>
</html>
"""


#: content policy: the page loads only its own content
_ALLOWED = (
    "default-src 'none'; img-src data:; style-src 'unsafe-inline'; script-src 'unsafe-inline'"
)


def _resource(name: str) -> str:
    return (files(__package__) / "html" / name).read_text(encoding="utf-8")


def table(
    head: Iterable[str], rows: Iterable[Sequence[str]], caption: str = "", *, words: bool = False
) -> str:
    """Return a table; but in one of words a cell that begins with a digit or sign stands right."""
    top = "".join(f'<th scope="col">{escape(cell)}</th>' for cell in head)
    lines = "".join(
        "<tr>"
        f'<th scope="row">{escape(first)}</th>'
        + "".join(f"<td{'' if words else _aligned(cell)}>{escape(cell)}</td>" for cell in rest)
        + "</tr>\n"
        for first, *rest in rows
    )
    said = f"<caption>{escape(caption)}</caption>" if caption else ""
    return (
        f'<div class="wide"><table>{said}<thead><tr>{top}</tr></thead>\n'
        f"<tbody>{lines}</tbody></table></div>"
    )


def _aligned(cell: str) -> str:
    return ' class="number"' if cell[:1].isdigit() or cell[:1] in "+-" else ""


def note(text: str, kind: str = "note") -> str:
    """Return a paragraph of kind `note`, or `bad` for important warnings."""
    return f'<p class="{kind}">{escape(text)}</p>'


def tiles(found: Iterable[tuple[str, str, str, str]]) -> str:
    """Return large figures side by side: (what, figure, text next to it, "good", "bad" or "")."""
    return (
        '<div class="tiles">'
        + "".join(
            f'<div class="tile {kind}"><div class="what">{escape(what)}</div>'
            f'<div class="figure">{escape(figure)}</div>'
            f'<div class="detail">{escape(detail)}</div></div>'
            for what, figure, detail, kind in found
        )
        + "</div>"
    )


#: number of characters of an SVG above which a picture is stored as pixels, and resolution [dots
#: per inch]
_LARGEST, _DPI = 1_200_000, 170


class Gallery:
    """Draws pictures into figures of HTML; their elements have names that are unique in a page."""

    def __init__(self) -> None:
        self._count = 0

    def picture(self, draw: Callable[[], Any], caption: str) -> str:
        """Return what `draw` draws on new axes as a figure with a caption."""
        self._count += 1
        prefix = f"p{self._count}-"
        open_before = set(plt.get_fignums())
        settings: Any = {
            "svg.fonttype": "path",
            "svg.hashsalt": prefix,
            "figure.max_open_warning": 0,
        }
        with plt.ioff(), mpl.rc_context(settings):
            try:
                draw()
                new = [n for n in plt.get_fignums() if n not in open_before]
                for n in new:
                    _fit_page(plt.figure(n))
                parts = [_picture_html(plt.figure(n), prefix, caption) for n in new]
            finally:
                for n in set(plt.get_fignums()) - open_before:
                    plt.close(n)
        return "".join(parts)


#: width [inch] at which text of 10 points can be read in a column of 30 rem, or on 500 pixels
_COLUMN = 5.6
#: height of a label next to the axes, with a legend below them
_LOWEST = 4.2


def _fit_page(figure: Figure) -> None:
    """Make a wide figure as narrow as a column, with its legends below and larger text."""
    width, height = figure.get_size_inches()
    if width <= _COLUMN:
        return
    specs = [spec for ax in figure.axes if (spec := ax.get_subplotspec()) is not None]
    if len({spec.colspan.start for spec in specs}) <= 1:
        figure.set_size_inches(_COLUMN, max(height * _COLUMN / width + 0.1 * height, _LOWEST))
    else:
        figure.set_size_inches(1.15 * _COLUMN, height)
    for ax in figure.axes:
        shown = ax.get_legend()
        if shown is None or shown.get_window_extent().x0 < ax.get_window_extent().x1:
            continue  # not next to the axes
        texts = [text.get_text() for text in shown.get_texts()]
        across = 1 if max(map(len, texts)) > 30 else 2
        # a fixed distance below the axes, for the label of the abscissa
        place: Any = {"loc": "upper center", "bbox_to_anchor": (0.5, 0.0), "borderaxespad": 4.8}
        handles: Any = shown.legend_handles
        ax.legend(handles, texts, frameon=False, ncols=across, fontsize="small", **place)


def _picture_html(figure: Figure, prefix: str, caption: str) -> str:
    file = io.StringIO()
    figure.savefig(file, format="svg", metadata=dict.fromkeys(_METADATA))
    image = _inline(file.getvalue(), prefix, caption)
    width, height = 72.0 * figure.get_size_inches()
    if len(image) > _LARGEST:
        pixels = io.BytesIO()
        figure.savefig(pixels, format="png", dpi=_DPI, metadata={"Software": None})
        data = base64.b64encode(pixels.getvalue()).decode()
        image = (
            f'<svg viewBox="0 0 {width:g} {height:g}" role="img" aria-label="{escape(caption)}">'
            f'<image width="{width:g}" height="{height:g}" href="data:image/png;base64,{data}"/>'
            "</svg>"
        )
    panels = [panel for ax in figure.axes if (panel := _axes_frame(ax, width, height))]
    buttons = "".join(
        f'<button type="button" data-do="{what}" title="{said}" aria-label="{said}">{sign}</button>'
        for what, said, sign in _BUTTONS
    )
    return (
        f'<figure class="picture" data-panels="{escape(json.dumps(panels))}">'
        f'<div class="canvas">{image}</div><figcaption>{escape(caption)}'
        f'<div class="tools"><output></output>{buttons}</div></figcaption></figure>\n'
    )


_METADATA = ("Creator", "Date", "Format", "Type")
_BUTTONS = (
    ("in", "zoom in", "+"),
    ("out", "zoom out", "\N{MINUS SIGN}"),
    ("reset", "whole picture", "\N{ANTICLOCKWISE OPEN CIRCLE ARROW}"),
    ("large", "large, and back", "\N{NORTH EAST ARROW}"),
)


def _inline(svg: str, prefix: str, caption: str) -> str:
    """Return an SVG for a page: without prolog, with its own names, coordinates in 1/100 pt."""
    svg = svg[svg.index("<svg") :].replace("xlink:href", "href")
    svg = re.sub(r"<metadata>.*?</metadata>\s*", "", svg, flags=re.DOTALL)
    svg = re.sub(r'\s(?:xmlns(?::\w+)?|version)="[^"]*"', "", svg)
    svg = re.sub(r'(<svg[^>]*?) width="[^"]*"', r"\1", svg, count=1)
    svg = re.sub(r'(<svg[^>]*?) height="[^"]*"', r"\1", svg, count=1)
    svg = svg.replace("<svg", f'<svg role="img" aria-label="{escape(caption)}"', 1)
    used = set(re.findall(r'(?:url\(|href=")#([^)"]+)', svg))

    def named(match: re.Match[str]) -> str:
        return f' id="{prefix}{match[1]}"' if match[1] in used else ""

    svg = re.sub(r'\sid="([^"]*)"', named, svg)
    svg = re.sub(r'(url\(|href=")#', rf"\1#{prefix}", svg)
    return re.sub(r'\sd="([^"]*)"', _short_path, svg)


def _short_path(match: re.Match[str]) -> str:
    short = re.sub(r"-?\d+\.\d{3,}", lambda n: f"{float(n[0]):.2f}", match[1])
    return f' d="{" ".join(short.split())}"'


def _axes_frame(ax: Axes, width: float, height: float) -> dict[str, Any] | None:
    """Return where axes lie in the picture, and what their two scales show there."""
    if ax.name != "rectilinear" or ax.get_label() == "<colorbar>" or not ax.axison:
        return None
    box = ax.get_position()
    scales = [
        _axis_scale(axis, limits)
        for axis, limits in ((ax.xaxis, ax.get_xlim()), (ax.yaxis, ax.get_ylim()))
    ]
    if not any(scales):
        return None
    corners = box.x0 * width, (1 - box.y1) * height, box.x1 * width, (1 - box.y0) * height
    return {"box": [round(c, 2) for c in corners], "x": scales[0], "y": scales[1]}


def _axis_scale(axis: Any, limits: tuple[float, float]) -> list[Any] | None:
    """Return (low, high, whether logarithmic, label) of an axis of numbers."""
    kind, formatter = axis.get_scale(), axis.get_major_formatter()
    if kind not in ("linear", "log") or isinstance(formatter, FixedFormatter | FuncFormatter):
        return None
    low, high = (float(f"{limit:.6g}") for limit in limits)
    label = axis.get_label_text().replace("$^2$", "\N{SUPERSCRIPT TWO}")
    return [low, high, kind == "log", label]


#: largest number of nodes and modes that are drawn
_NODES, _MODES = 1200, 24
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


def moving_frame(modes: Modes, height: int = 520) -> str:
    """Return a frame of a given height [px] with a separate page, in which the modes move."""
    shapes = moving_shapes(modes)
    style, script = _resource("report.css"), _resource("shapes.js")
    page = f"<style>{style}</style><main>{shapes}</main><script>{script}</script>"
    size = f"width:100%;max-width:44em;height:{height}px;border:0"
    frame = f'<iframe srcdoc="{escape(page)}" title="moving mode shape" style="{size}"></iframe>'
    return frame if shapes else ""


def _mode_name(modes: Modes, k: int) -> str:
    if k < modes.n_rigid:
        return f"{k + 1}: rigid-body"
    return f"{k + 1}: {modes.freq[k]:.4g} Hz, damping {100 * modes.zeta[k]:.2g} %"


def _whole_thousandths(values: FloatArray) -> list[int]:
    """Return thousandths, row by row."""
    return [int(v) for v in np.rint(1000.0 * values).ravel()]


def _translations(modes: Modes) -> tuple[FloatArray, FloatArray]:
    """Return the nodes (n, 3) that translate, and how they do in each mode (n, 3, modes)."""
    _, xyz, rows = translations(modes.dofs)
    moves = np.any(rows >= 0, axis=1)
    phi = np.asarray(modes.phi)[:, :_MODES]
    count = phi.shape[1]
    if np.iscomplexobj(phi):  # nearly real shapes, turned so that they are
        largest = phi[np.argmax(np.abs(phi), axis=0), np.arange(count)]
        phi = (phi * np.exp(-1j * np.angle(largest))).real
    return xyz[moves], np.where(rows[moves, :, None] >= 0, phi[rows[moves]], 0.0)


def _thinned(xyz: FloatArray) -> IntArray:
    """Return about the largest number of nodes that can be drawn, one per grid cell."""
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

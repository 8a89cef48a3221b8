"""One self-contained page of HTML: nothing of it comes from elsewhere."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from html import escape
from importlib.resources import files
from typing import NamedTuple


class Chapter(NamedTuple):
    """A part of the page: what it is called, and its HTML."""

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


#: what the page may load: only what is in it
_ALLOWED = (
    "default-src 'none'; img-src data:; style-src 'unsafe-inline'; script-src 'unsafe-inline'"
)


def _resource(name: str) -> str:
    return (files(__package__) / name).read_text(encoding="utf-8")


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
    """Return a paragraph: of kind `note`, or `bad` for what must not be overlooked."""
    return f'<p class="{kind}">{escape(text)}</p>'


def tiles(found: Iterable[tuple[str, str, str, str]]) -> str:
    """Return large figures side by side: (what, figure, beside it, "good", "bad" or "")."""
    return (
        '<div class="tiles">'
        + "".join(
            f'<div class="tile {kind}"><div class="what">{escape(what)}</div>'
            f'<div class="figure">{escape(figure)}</div>'
            f'<div class="beside">{escape(beside)}</div></div>'
            for what, figure, beside, kind in found
        )
        + "</div>"
    )

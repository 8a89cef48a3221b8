"""Values in notebooks: the lines of their repr as HTML."""

from __future__ import annotations

import re
from html import escape
from itertools import groupby
from typing import cast

#: `name: text` or `name = text` after two spaces of indent, as values print what they hold; columns
#: that two spaces set apart are none
_ENTRY = re.compile(r"^  (?! )((?:(?!  ).){1,48}?)(?:: | = )(\S.*)$")
_CELL = "padding:.1em .8em .1em 0;text-align:left;vertical-align:top;border:0;background:none"


def as_html(text: str) -> str:
    """Return the repr of a value as HTML: a heading, named entries as rows, the rest as it is.

    Lines that are aligned by spaces, tables among them, keep their alignment.
    """
    first, *rest = text.split("\n")
    parts = []
    if first.startswith("<"):
        if rest and not first.endswith(">"):  # it ends where the last line does
            rest[-1] = rest[-1].removesuffix(">")
        first = first[1:].removesuffix(">")
        kind = re.match(r"\w+", first)
        end = kind.end() if kind else 0
        parts.append(f"<div><b>{escape(first[:end])}</b>{escape(first[end:])}</div>")
    else:
        rest = [first, *rest]
    for shape, lines in groupby(rest, key=_kind):
        part = list(lines)
        if shape == "entry":
            rows = "".join(_row(line) for line in part)
            parts.append(f'<table style="border-collapse:collapse"><tbody>{rows}</tbody></table>')
        elif shape == "text":
            parts += [f"<div>{escape(line.strip())}</div>" for line in part]
        else:
            shown = escape("\n".join(part))
            parts.append(f'<pre style="margin:.2em 0;line-height:1.35">{shown}</pre>')
    return f'<div class="flexplant">{"".join(parts)}</div>'


def _kind(line: str) -> str:
    """Return whether a line is a named entry, a sentence, or part of a table."""
    if _ENTRY.match(line):
        return "entry"
    indent = len(line) - len(line.lstrip())
    return "text" if indent <= 2 and "  " not in line.strip() else "table"


def _row(line: str) -> str:
    name, text = cast(re.Match[str], _ENTRY.match(line)).groups()
    return (
        f'<tr><th style="{_CELL};font-weight:600">{escape(name.strip())}</th>'
        f'<td style="{_CELL}">{escape(text)}</td></tr>'
    )

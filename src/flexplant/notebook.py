"""Values in notebooks: the lines of their repr as HTML."""

from __future__ import annotations

import re
from html import escape

#: `name: text` or `name = text` after two spaces of indent, as values print what they hold; columns
#: that two spaces set apart are none
_ENTRY = re.compile(r"^  (?! )((?:(?!  ).){1,48}?)(?:: | = )(\S.*)$")
_CELL = "padding:.1em .8em .1em 0;text-align:left;vertical-align:top;border:0;background:none"


def as_html(text: str) -> str:
    """Return the repr of a value as HTML: a heading, named entries as rows, the rest as it is.

    Lines that are aligned by spaces, tables among them, keep their alignment.

    Parameters
    ----------
    text : str
        What `repr` returns, of any number of lines.

    Returns
    -------
    str
        Well-formed, all names escaped, without scripts.

    Examples
    --------
    >>> as_html("<Modes: 3 of 9 DOFs>")
    '<div class="flexplant"><div><b>Modes</b>: 3 of 9 DOFs</div></div>'
    """
    first, *rest = text.split("\n")
    parts = []
    if first.startswith("<"):
        whole = "\n".join([first, *rest])
        if whole.endswith(">"):
            whole = whole[:-1]
        first, *rest = whole[1:].split("\n")
        kind = re.match(r"\w+", first)
        end = kind.end() if kind else 0
        parts.append(f"<div><b>{escape(first[:end])}</b>{escape(first[end:])}</div>")
    else:
        rest = [first, *rest]
    entries = [_ENTRY.match(line) for line in rest]
    while rest:
        named = entries[0] is not None
        count = next((i for i, e in enumerate(entries) if (e is not None) != named), len(rest))
        part, rest = rest[:count], rest[count:]
        matched, entries = entries[:count], entries[count:]
        if named:
            rows = "".join(_row(entry[1], entry[2]) for entry in matched if entry)
            parts.append(f'<table style="border-collapse:collapse"><tbody>{rows}</tbody></table>')
        else:
            shown = escape("\n".join(part))
            parts.append(f'<pre style="margin:.2em 0;line-height:1.35">{shown}</pre>')
    return f'<div class="flexplant">{"".join(parts)}</div>'


def _row(name: str, text: str) -> str:
    return (
        f'<tr><th style="{_CELL};font-weight:600">{escape(name.strip())}</th>'
        f'<td style="{_CELL}">{escape(text)}</td></tr>'
    )

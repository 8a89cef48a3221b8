"""How the page looks: sizes and colours of its widgets, and the tables of verdicts."""

from __future__ import annotations

from collections.abc import Sequence
from html import escape

from .evaluation import AxisLoop
from .limits import Judged
from .verdict import figures, stability_verdict

#: of all widgets: small, so that a law is seen as a whole
COMPACT = """
:host { --pane-gap: 4px; font-size: 12px; }
.bk-input { height: 26px; font-size: 12px; padding: 0 6px; border-radius: 4px; }
textarea.bk-input { height: auto; font-family: monospace; font-size: 11px; padding: 6px; }
.bk-btn { font-size: 12px; padding: 2px 8px; border-radius: 4px; line-height: 1.5; }
.bk-input-group label { font-size: 11px; color: #5B6670; }
.noUi-target { margin-top: 2px; }
.bk-clearfix, .bk-input-group { margin: 0; }
"""
SMALL = {"stylesheets": [COMPACT], "height": 28}
CARD = {
    "background": "#FFFFFF", "border": "1px solid #D5DADF", "border-radius": "6px",
    "padding": "6px 8px",
}  # fmt: skip
ELEMENT = CARD | {"border-left": "3px solid #0B6FB8", "padding": "4px 6px"}
OFF = ELEMENT | {"border-left": "3px solid #C9CFD5", "opacity": "0.55"}
PAGE = {"background": "#F3F5F7", "font-family": "system-ui, sans-serif", "color": "#1D2730"}
ERROR = (
    '<div role="alert" style="background:#FCEBE8;border:1px solid #C23B22;border-radius:6px;'
    'padding:6px 10px;font-size:12px;color:#7A2014">{}<br><span style="color:#5B6670">'
    "The last good design stands.</span></div>"
)
_GOOD, _BAD, _OPEN = "#1F7A47", "#C23B22", "#9A6700"


def title(text: str) -> str:
    """Return the heading of a group."""
    return f'<div style="font-size:12px;font-weight:600;color:#33404D">{escape(text)}</div>'


def error(text: str) -> str:
    """Return a message of what is wrong."""
    return ERROR.format(escape(text))


def remark(text: str) -> str:
    """Return a short remark."""
    return f'<div style="font-size:11px;color:#5B6670">{escape(text)}</div>'


def _state(stable: bool | None) -> str:
    return {True: _GOOD, False: _BAD, None: _OPEN}[stable]


def headline(loop: AxisLoop) -> str:
    """Return the verdict of the axis that is shaped, with its figures."""
    cells = "".join(
        f'<td style="padding:0 14px 0 0;vertical-align:top"><div style="font-size:11px;'
        f'color:#5B6670">{escape(name)}</div><div style="font-size:14px;font-weight:600" '
        f'data-figure="{escape(name)}">{escape(value)}</div><div style="font-size:11px;'
        f'color:#5B6670">{escape(where)}</div></td>'
        for name, value, where in figures(loop)
    )
    word, how = stability_verdict(loop)
    return (
        f'<div data-verdict="{escape(loop.name)}" style="display:flex;flex-wrap:wrap;gap:4px 18px;'
        'align-items:center"><div style="min-width:120px;max-width:290px"><div style="font-size:'
        f'16px;font-weight:700;color:{_state(loop.is_stable)}">{escape(loop.name)}: {escape(word)}'
        f'</div><div style="font-size:11px;color:#5B6670">{escape(how)}</div></div>'
        f'<table style="border-collapse:collapse"><tr>{cells}</tr></table></div>'
    )


def limit_verdicts(limits: Sequence[Judged]) -> str:
    """Return each limit with whether it is met."""
    parts = []
    for one in limits:
        mark, word = {
            True: ("&#10003;", "met"),
            False: ("&#10007;", "not met"),
            None: ("?", "open"),
        }[one.met]
        parts.append(
            f'<span style="white-space:nowrap;color:{_state(one.met)}">{mark} {escape(one.name)} '
            f"{escape(one.required)}: {escape(one.reached)}, {word}</span>"
        )
    look = "font-size:12px;display:flex;flex-wrap:wrap;gap:2px 16px"
    return f'<div style="{look}">{"".join(parts)}</div>'


def lines(rows: Sequence[tuple[str, str, bool | None]]) -> str:
    """Return further verdicts: a name, what was found, whether that is good."""
    found = "".join(
        f'<tr><td style="padding:0 10px 1px 0;color:#5B6670;white-space:nowrap;vertical-align:top">'
        f'{escape(name)}</td><td style="color:{"#1D2730" if good is None else _state(good)}">'
        f"{escape(text)}</td></tr>"
        for name, text, good in rows
    )
    return f'<table style="font-size:12px;border-collapse:collapse">{found}</table>'

"""Limits of a loop and whether they are met, in words and in HTML."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field
from html import escape
from typing import NamedTuple

import numpy as np

from ..arrays import positive
from ..store import Value, checked
from ..tolerances import TINY
from .evaluation import AxisLoop


class Judged(NamedTuple):
    """One limit: the required and the reached value, and whether it is met (None: not known)."""

    name: str
    required: str
    reached: str
    met: bool | None


@dataclass(frozen=True, eq=False, repr=False)
class LoopLimits(Value):
    """Limits on each loop; None means no limit.

    Parameters
    ----------
    peak : float
        Largest allowed |S|. The value 2 (6 dB) is a modulus margin of 0.5.
    gain_margin : float, optional
        Smallest allowed gain margin, as a factor.
    phase_margin : float, optional [deg]
        Smallest allowed phase margin.
    bandwidth : float, optional [Hz]
        Lowest frequency at which |S| may cross 0 dB.
    suppressed, below : float, optional
        Largest allowed |S| up to the frequency `below` [Hz].
    rms : float, optional
        Largest allowed predicted rms of the error, in its unit.

    Examples
    --------
    >>> import flexplant as fx
    >>> fx.workbench.LoopLimits(peak=2.0, phase_margin=30.0)
    LoopLimits(peak=2, phase_margin=30 deg)
    """

    peak: float = field(default=2.0, metadata=checked(positive))
    gain_margin: float | None = field(default=None, metadata=checked(positive))
    phase_margin: float | None = field(default=None, metadata=checked(positive, unit="deg"))
    bandwidth: float | None = field(default=None, metadata=checked(positive, unit="Hz"))
    suppressed: float | None = field(default=None, metadata=checked(positive))
    below: float | None = field(default=None, metadata=checked(positive, unit="Hz"))
    rms: float | None = field(default=None, metadata=checked(positive))

    def judged(self, loop: AxisLoop, rms: float | None = None) -> Iterator[Judged]:
        """Yield each limit with the value that a loop reaches.

        Parameters
        ----------
        loop : AxisLoop
            Loop of one axis.
        rms : float, optional
            Predicted rms of the error, if it is known.
        """
        stable, margins = loop.is_stable, loop.margins

        def at_least(name: str, wanted: float | None, value: float, unit: str) -> Iterator[Judged]:
            if wanted is not None:
                met = None if stable is None else bool(stable and value >= wanted)
                yield Judged(name, f"at least {wanted:.4g}{unit}", f"{value:.4g}{unit}", met)

        def at_most(name: str, wanted: float, value: float) -> Judged:
            met = None if stable is None else bool(stable and value <= wanted)
            level = 20.0 * np.log10([wanted, max(value, TINY)])
            return Judged(name, f"at most {level[0]:.3g} dB", f"{level[1]:.3g} dB", met)

        peak = 1.0 / margins.modulus_margin if margins.modulus_margin else np.inf
        yield at_most("peak of |S|", self.peak, peak)
        gain = min(margins.gain_margin, 1.0 / (margins.gain_reduction or TINY))
        yield from at_least("gain margin", self.gain_margin, gain, "")
        yield from at_least("phase margin", self.phase_margin, margins.phase_margin, " deg")
        yield from at_least("bandwidth", self.bandwidth, loop.bandwidth, " Hz")
        low = loop.freq <= (self.below or 0.0)
        if self.suppressed is not None and not np.any(low):
            reached = "no frequency given" if self.below is None else "no line there"
            yield Judged("|S| at low frequencies", f"at most {self.suppressed:.3g}", reached, None)
        elif self.suppressed is not None and self.below is not None:
            worst = float(np.abs(loop.S[low]).max(initial=0.0))
            yield at_most(f"|S| to {self.below:.4g} Hz", self.suppressed, worst)
        if self.rms is not None:
            known = rms is not None and np.isfinite(rms)
            met = bool(rms <= self.rms) if rms is not None and known else None
            reached = f"{rms:.3g}" if known else "not known"
            yield Judged("rms of the error", f"at most {self.rms:.3g}", reached, met)


def decibels(gain: float) -> str:
    """Return a factor on the gain in dB."""
    return f"{20.0 * np.log10(gain):.1f} dB" if np.isfinite(gain) and gain else "infinite"


def stability_verdict(loop: AxisLoop) -> tuple[str, str]:
    """Return whether a loop is stable, how this was counted, and what measured lines leave open."""
    count, measured = loop.count, loop.machine.is_measured
    if count.unstable is None:
        return "stability not judged", count.reason
    how = "Nyquist criterion on the measured lines" if measured else "Poles of the closed loop"
    said = f"{how}: {count.unstable or 'no'} unstable pole{'' if count.unstable == 1 else 's'}."
    if measured and count.narrowest and not count.unstable:
        said += (
            f" This misses only a mode narrower than {count.narrowest:.2g} Hz between the lines "
            f"near {count.near:.4g} Hz: finer lines there would show it."
        )
    return ("UNSTABLE" if count.unstable else "stable"), said


def figures(loop: AxisLoop) -> list[tuple[str, str, str]]:
    """Return name, value and frequency of each figure of a loop."""
    m = loop.margins

    def at(freq: float) -> str:
        return f"{freq:.4g} Hz" if np.isfinite(freq) else ""

    gains = [g for g in (m.gain_margin, m.gain_reduction) if g]
    peak = 1.0 / m.modulus_margin if m.modulus_margin else float("inf")
    return [
        ("crossover", at(m.crossovers[0]) if m.crossovers else "none",
         "" if len(m.crossovers) < 2 else f"and {', '.join(f'{f:.4g}' for f in m.crossovers[1:3])}"
         f"{' ...' if len(m.crossovers) > 3 else ''} Hz"),
        ("bandwidth of |S|", at(loop.bandwidth) or "none", ""),
        ("gain margin", " / ".join(map(decibels, gains)) or "none", at(m.gain_freq)),
        ("phase margin", f"{m.phase_margin:.1f} deg", at(m.phase_freq)),
        ("modulus margin", f"{m.modulus_margin:.3f} ({decibels(peak)})", at(m.freq)),
    ]  # fmt: skip


def of_fleet(loops: Sequence[AxisLoop]) -> tuple[str, int]:
    """Return the verdict of a fleet in words, and the machine that is worst."""
    stable = [loop.is_stable is True for loop in loops]
    margins = [loop.modulus_margin if ok else -1.0 for loop, ok in zip(loops, stable, strict=True)]
    unstable = [loop for loop in loops if loop.is_stable is False]
    worst = int(np.argmin(margins))
    unknown = sum(loop.is_stable is None for loop in loops)
    text = f"{sum(stable)} of {len(loops)} stable"
    if unknown:
        text += f", {unknown} not judged"
    if not unstable and not unknown:
        text += f", least margin {margins[worst]:.2f} on {loops[worst].machine.name}"
    elif unstable:
        # the worst: the most unstable poles, then the least distance from the critical point
        names = ", ".join(loop.machine.name for loop in unstable[:3])
        text += f"; unstable: {names}{' ...' if len(unstable) > 3 else ''}"
        if any(stable):
            left = min(
                (one for one, ok in zip(loops, stable, strict=True) if ok),
                key=lambda one: one.modulus_margin,
            )
            text += f"; least margin of the others {left.modulus_margin:.2f} on {left.machine.name}"
    return text, worst


#: style of all widgets: small, so that a whole law fits on the screen
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


def heading(text: str) -> str:
    """Return the heading of a group."""
    return f'<div style="font-size:12px;font-weight:600;color:#33404D">{escape(text)}</div>'


def refusal(text: str) -> str:
    """Return an error message."""
    return ERROR.format(escape(text))


def remark(text: str) -> str:
    """Return a short remark."""
    return f'<div style="font-size:11px;color:#5B6670">{escape(text)}</div>'


def _state(stable: bool | None) -> str:
    return {True: _GOOD, False: _BAD, None: _OPEN}[stable]


def headline(loop: AxisLoop) -> str:
    """Return the verdict on the present axis, with its figures."""
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


def verdict_rows(rows: Sequence[tuple[str, str, bool | None]]) -> str:
    """Return further verdicts: name, finding, and whether it is good."""
    found = "".join(
        f'<tr><td style="padding:0 10px 1px 0;color:#5B6670;white-space:nowrap;vertical-align:top">'
        f'{escape(name)}</td><td style="color:{"#1D2730" if good is None else _state(good)}">'
        f"{escape(text)}</td></tr>"
        for name, text, good in rows
    )
    return f'<table style="font-size:12px;border-collapse:collapse">{found}</table>'

"""The verdict of a loop and of a fleet, in words."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from .evaluation import AxisLoop


def decibels(gain: float) -> str:
    """Return a factor on the gain in dB."""
    return f"{20.0 * np.log10(gain):.1f} dB" if np.isfinite(gain) and gain else "infinite"


def stability_verdict(loop: AxisLoop) -> tuple[str, str]:
    """Return whether a loop is stable, and how that was counted, with what lines leave open."""
    count, measured = loop.count, loop.machine.is_measured
    if count.unstable is None:
        return "stability not judged", count.reason
    how = "the Nyquist count" if measured else "the poles"
    said = f"{count.unstable} unstable pole{'' if count.unstable == 1 else 's'} by {how}"
    if measured and count.narrowest and not count.unstable:
        said += f", if no mode is narrower than {count.narrowest:.2g} Hz (near {count.near:.4g} Hz)"
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
        # the farthest beyond: most unstable poles, then the closest to the critical point
        names = ", ".join(loop.machine.name for loop in unstable[:3])
        text += f"; unstable: {names}{' ...' if len(unstable) > 3 else ''}"
        if any(stable):
            left = min(
                (one for one, ok in zip(loops, stable, strict=True) if ok),
                key=lambda one: one.modulus_margin,
            )
            text += f"; least margin of the others {left.modulus_margin:.2f} on {left.machine.name}"
    return text, worst

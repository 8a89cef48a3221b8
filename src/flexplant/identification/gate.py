"""Which poles of a fit are reported: those with a reason against them are listed instead."""

from __future__ import annotations

from collections.abc import Callable, Sequence

import numpy as np
import scipy.linalg as la

from ..checks import ComplexArray, FloatArray, IntArray
from ..errors import SolverError, attempted
from ..tolerances import RANK, TINY
from .line_weights import NARROW, Rejected, mains_multiple
from .model_error import ALIKE, Disagreement, column_mac, strength, twin_poles
from .pole_test import pole_price, shared, unit
from .refine import Fit, Lines, pivoted, refined

#: half-widths beside a pole within which another one may stand for the same resonance
BESIDE = 3.0


def gated(
    lines: Lines,
    fit: Fit,
    fitted: Callable[[ComplexArray, ComplexArray], Fit],
    *,
    alone: bool,
    compare: bool,
) -> tuple[Fit, IntArray, tuple[Rejected, ...]]:
    """Return the fit without poles that are none, the places of those reported, and the others.

    Twins, and poles that nothing is known of, are left out of the fit, one by one; what lies at the
    edge of the band or is mains remains in the fit, which explains it, and is not reported. Poles
    chosen by hand are not merged (`alone`: none were).
    """
    listed: list[Rejected] = []
    while True:
        found = _needless(lines, fit, fitted, alone, compare)
        if found is None:
            break
        place, reason = found
        listed.append(rejection(fit, place, reason))
        if fit.poles.size == 1:
            raise SolverError(
                f"no pole is left: {listed[-1][0]:.5g} Hz is {reason}. Widen the band, measure "
                "longer, or average more."
            )
        rest = np.delete(np.arange(fit.poles.size), place)
        fit = fitted(fit.poles[rest], fit.participation[:, rest])
    reasons = [_rejection(lines, pole) for pole in fit.poles]
    listed += [rejection(fit, k, why) for k, why in enumerate(reasons) if why]
    kept = np.array([k for k, why in enumerate(reasons) if why is None], dtype=np.int64)
    if not kept.size:
        raise _none_left(listed)
    return fit, kept, tuple(sorted(listed))


def steady(
    fit: Fit, reported: IntArray, apart: Disagreement
) -> tuple[IntArray, tuple[Rejected, ...]]:
    """Return which poles outputs (or inputs) that disagree share, and the others.

    One beside another, whose damping at one of them is not known from zero (95 %), stands for what
    the outputs differ by; of one whose mean damping is known no better, nothing is known.
    """
    damping, m = -fit.poles.real, fit.m
    beside = np.array([
        np.any(np.abs(np.delete(fit.poles.imag, k) - pole.imag) < -pole.real)
        for k, pole in enumerate(fit.poles)
    ])  # fmt: skip
    differs = beside & (1.96 * apart.spread[:m] > damping)
    unknown = apart.deviation[:m] >= -apart.poles.real
    side, listed = fit.lines.side, []
    for k in reported[(differs | unknown)[reported]]:
        reason = (
            f"not shared by the {side}: its damping differs by as much as it is"
            if differs[k]
            else f"without information: over the {side} the deviation of its damping exceeds it"
        )
        listed.append(rejection(fit, int(k), reason))
    kept = reported[~(differs | unknown)[reported]]
    if not kept.size:
        raise _none_left(listed)
    return kept, tuple(listed)


def _none_left(listed: Sequence[Rejected]) -> SolverError:
    """Return the error of an answer without poles."""
    return SolverError(
        "no pole is left within the band: "
        + "; ".join(f"{f:.5g} Hz is {why}" for f, _, why in listed[:3])
        + ". Widen the band, measure longer, or average more."
    )


def rejection(fit: Fit, k: int, reason: str) -> Rejected:
    """Return the line of a list of what is not reported."""
    pole = complex(fit.poles[k])
    return abs(pole) / (2 * np.pi), -pole.real / abs(pole), reason


def _needless(
    lines: Lines,
    fit: Fit,
    fitted: Callable[[ComplexArray, ComplexArray], Fit],
    alone: bool,
    compare: bool,
) -> tuple[int, str] | None:
    """Return a pole that is to be left out, and why."""
    size, std = np.abs(fit.poles), _deviations(lines, fit)
    unknown = np.maximum(std[1] / size, std[0] / np.maximum(-fit.poles.real, TINY))
    inside = [k for k in range(size.size) if _rejection(lines, fit.poles[k]) is None]
    worst = max(inside, key=lambda k: float(unknown[k]), default=None)
    if worst is not None and unknown[worst] >= 1.0:
        return worst, "without information: its deviation of frequency or damping exceeds it"
    if not alone:
        return None
    found = twin_poles(fit)
    if found is not None:
        other, place = found
        alike = column_mac(fit.shapes, other, place) > ALIKE
        if not compare or alike or not _is_shared(lines, fit, fitted, place):
            return place, f"a twin of the pole at {size[other] / (2 * np.pi):.5g} Hz"
    for place in lesser(fit, fit.shapes) if compare else []:
        if not _is_shared(lines, fit, fitted, place):
            return place, f"not shared by the {lines.side}: it stands for what they differ by"
    return None


def _is_shared(
    lines: Lines, fit: Fit, fitted: Callable[[ComplexArray, ComplexArray], Fit], place: int
) -> bool:
    """Return whether the outputs share a pole of the fit, true where there is no fit without it."""
    rest = np.delete(np.arange(fit.poles.size), place)
    with attempted("a fit without one of its poles", SolverError):
        less = fitted(fit.poles[rest], fit.participation[:, rest])
        return shared(lines, less, fit, pole_price(lines) * unit(lines, fit))
    return True


def _deviations(lines: Lines, fit: Fit) -> FloatArray:
    """Return the deviations (2, m) of Re and Im of the poles, misfit included."""
    N, _ = fit.gradient()
    size = np.sqrt(np.maximum(np.diag(N), TINY))
    inverse = la.pinvh(N / np.outer(size, size), rtol=RANK)
    variance = np.diag(inverse) / size**2 * unit(lines, fit) * lines.inflation
    return np.asarray(np.sqrt(variance[: 2 * fit.poles.size]).reshape(2, -1))


def lesser(fit: Fit, vectors: ComplexArray, alike: float = 0.0) -> list[int]:
    """Return the weaker poles beside others (of vectors of so high a MAC), the weakest first."""
    height, found = strength(fit), []
    for k in np.argsort(height):
        reach = BESIDE * (-fit.poles.real - fit.poles.real[k])
        near = (np.abs(fit.poles - fit.poles[k]) < reach) & (height > height[k])
        if any(column_mac(vectors, int(j), int(k)) >= alike for j in np.flatnonzero(near)):
            found.append(int(k))
    return found


def single(lines: Lines, fit: Fit, vectors: ComplexArray, steps: int) -> Fit:
    """Return the fit of lines, of one pole a resonance, whose participation are these vectors.

    Outputs that disagree give each resonance several poles of one participation; references do of
    one shape, which is the participation once inputs and outputs are exchanged. It is held: poles
    that the rows do not share would bend it.
    """
    keep = np.delete(np.arange(fit.m), lesser(fit, vectors, ALIKE))
    start = pivoted(lines, fit.poles[keep], vectors[:, keep])
    now = start.poles, start.participation
    return refined(lines, *now, steps=steps, strict=False, poles_only=True, first=start)


def _rejection(lines: Lines, pole: complex) -> str | None:
    """Return why a pole of the fit is not reported, None where it is."""
    freq, width = abs(pole) / (2 * np.pi), -2.0 * pole.real / (2 * np.pi)
    low, high = float(lines.freq[0]), float(lines.freq[-1])
    spacing = float(np.median(np.diff(lines.freq)))
    if not low <= freq <= high:
        return "outside the band"
    if min(freq - low, high - freq) < max(spacing, width / 2):
        return "at the edge of the band"
    if width < NARROW * spacing:
        return mains_multiple(freq, spacing)
    return None

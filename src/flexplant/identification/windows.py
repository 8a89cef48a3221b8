"""Wide bands in parts: weak modes are found where strong ones elsewhere do not dominate."""

from __future__ import annotations

from dataclasses import dataclass
from itertools import pairwise

import numpy as np

from ..values import ComplexArray, FloatArray
from .diagram import StabilisationDiagram, built_diagram
from .line_weights import PreparedLines
from .plscf import Moments, OrderPoles

#: lines of a part, and the share of it that is used beyond each of its ends
LINES, OVERLAP = 400, 0.25
#: poles this share of the band outside of it are looked for: they bend the responses inside
MARGIN = 0.04


@dataclass(frozen=True, eq=False)
class Window:
    """A part of the band: its own lines first..last, and those used."""

    first: int
    last: int
    seen: slice


def windows(ready: PreparedLines) -> list[Window]:
    """Return parts of about 400 lines, cut where the responses are weakest."""
    import scipy.ndimage as ndi

    n_freq = ready.freq.size
    count = max(1, round(n_freq / LINES))
    power = np.sum(np.abs(ready.data * ready.weight) ** 2, axis=(0, 1))
    power = ndi.uniform_filter1d(np.log(power + 1e-300), 9)
    cuts = [0]
    for i in range(1, count):
        middle, reach = round(i * n_freq / count), n_freq // (4 * count)
        cuts.append(middle - reach + int(np.argmin(power[middle - reach : middle + reach])))
    cuts.append(n_freq)
    parts = []
    for first, last in pairwise(cuts):
        beyond = round(OVERLAP * (last - first))
        parts.append(Window(first, last, slice(max(0, first - beyond), min(n_freq, last + beyond))))
    return parts


def diagram_of(
    ready: PreparedLines, orders: list[int], tolerances: tuple[float, float, float], max_zeta: float
) -> StabilisationDiagram:
    """Return the diagrams of all parts as one; a track belongs where its median lies."""
    low, high = float(ready.freq[0]), float(ready.freq[-1])
    edge = MARGIN * (high - low)
    found = []
    for window in windows(ready):
        freq = ready.freq[window.seen]
        moments = _moments(ready, window, orders[-1])
        results = [
            _inside(moments.solve(order), (float(freq[0]), float(freq[-1])), max_zeta)
            for order in orders
        ]
        diagram = built_diagram(results, np.array([low, high]), tolerances)
        ends = (
            low - edge if window.first == 0 else ready.freq[window.first],
            high + edge if window.last == ready.freq.size else ready.freq[window.last],
        )
        keep = np.zeros(len(diagram), dtype=bool)
        for track in np.unique(diagram.tracks):
            mine = diagram.tracks == track
            keep[mine] = ends[0] <= np.median(diagram.freq[mine]) < ends[1]
        found.append((diagram, keep))
    offsets = np.cumsum([0] + [int(d.tracks.max(initial=-1)) + 1 for d, _ in found])
    tracks = [d.tracks[k] + o for (d, k), o in zip(found, offsets[:-1], strict=True)]
    return StabilisationDiagram(
        np.concatenate([d.orders[k] for d, k in found]),
        np.concatenate([d.poles[k] for d, k in found]),
        np.concatenate([d.flags[k] for d, k in found]),
        np.concatenate(tracks),
        shapes=np.concatenate([d.shapes[:, k] for d, k in found], axis=1),
        participation=np.concatenate([d.participation[:, k] for d, k in found], axis=1),
        band=np.array([low, high]),
    )


def weighted_by_remainder(ready: PreparedLines, order: int) -> PreparedLines:
    """Return the same with weights from what matrix fractions of high order leave."""
    now = ready
    n_out, n_in, n_freq = ready.data.shape
    for _ in range(2):
        error: FloatArray = np.zeros(ready.data.shape)
        parts = windows(now)
        for window in parts:
            own = slice(window.first, window.last)
            fitted: ComplexArray = _moments(now, window, order).response(order, now.freq[own])
            error[:, :, own] = np.abs(now.data[:, :, own] - fitted) ** 2
        share = (order + 1) * len(parts) / n_freq * (1 + n_in / n_out)
        now = now.from_errors(error, min(0.5, share))
    return now


def _moments(ready: PreparedLines, window: Window, order: int) -> Moments:
    seen = window.seen
    return Moments(ready.freq[seen], ready.data[:, :, seen], ready.line_weight[:, seen], order)


def _inside(found: OrderPoles, band: tuple[float, float], max_zeta: float) -> OrderPoles:
    freq = np.abs(found.poles) / (2 * np.pi)
    zeta = -found.poles.real / np.abs(found.poles)
    edge = MARGIN * (band[1] - band[0])
    keep = (freq > max(band[0] - edge, 0.5 * band[0])) & (freq < band[1] + edge)
    keep &= (zeta > 0) & (zeta < max_zeta) & (found.poles.imag > 0)
    return OrderPoles(
        found.order, found.poles[keep], found.shapes[:, keep], found.participation[:, keep]
    )

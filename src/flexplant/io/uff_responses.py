"""Responses of a model in universal files (dataset 2414), from load sets to all nodes."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np

from ..labels import DIRECTIONS
from ..lti.frequency import Frf
from .paths import ONCE, at_zero, refused, unread
from .uff_analysis import FREQUENCY_RESPONSE, AnalysisData, check_nodes, read_analysis
from .uff_units import KINDS, ORDERS


def responses_of_model(
    path: Path, factors: dict[str, Any] | None, quantity: str | None, scale: float | None
) -> Frf | None:
    """Return the frequency responses of dataset 2414, None when there are none.

    Parameters
    ----------
    path : Path
        The file.
    factors : dict, optional
        Its dataset 164: lengths divided by its factor are in metres.
    quantity : str, optional
        What the outputs shall be; that of the file when not given.
    scale : float, optional
        Factor that brings displacements to SI, in place of `factors`.

    Raises
    ------
    FlexplantError
        When frequencies or nodes of load sets differ, or results are there twice.
    ModelError
        When the file holds several quantities and none is chosen, or would be integrated at 0 Hz.
    """
    parts = [
        part
        for part in read_analysis(path)
        if part.analysis == FREQUENCY_RESPONSE and part.result in KINDS
    ]
    if not parts:
        return None
    found = sorted({KINDS[part.result] for part in parts})
    if len(found) > 1 and quantity not in found:
        do = f"One Frf is of one quantity: choose, quantity={found[0]!r}."
        raise unread(path, f"holds responses in {', '.join(found)}", do)
    kind = quantity if quantity in found else found[0]
    parts = [part for part in parts if KINDS[part.result] == kind]
    check_nodes(parts, path)
    sets = _by_load(parts, path)
    freq = np.array(list(next(iter(sets.values()))))
    data = np.array([[part.motions.ravel() for part in lines.values()] for lines in sets.values()])
    data = np.moveaxis(data.astype(np.complex128), 0, 2)  # (frequency, motion, load)
    length = scale or (1.0 if factors is None else 1 / float(factors["length"]))
    motion = np.arange(data.shape[1]) % 6
    data[:, motion < 3] *= length
    order = ORDERS[quantity or kind] - ORDERS[kind]
    if order < 0 and freq[0] == 0:
        raise at_zero(path, kind, str(quantity))
    data = data * ((2j * np.pi * freq) ** order)[:, None, None]
    seen = np.isin(motion, motion[np.any(data, axis=(0, 2))])
    names = [f"{node}:{axis}" for node in parts[0].nodes.tolist() for axis in DIRECTIONS]
    return Frf(
        freq,
        np.moveaxis(data[:, seen], 0, 2),
        inputs=[f"load {number}" for number in sets],
        outputs=[name for name, there in zip(names, seen, strict=True) if there],
        quantity=quantity or kind,
    )


def _by_load(parts: list[AnalysisData], path: Path) -> dict[int, dict[float, AnalysisData]]:
    """Return the results of each load set by frequency, ascending."""
    sets: dict[int, dict[float, AnalysisData]] = {}
    for part in sorted(parts, key=lambda part: (part.load, part.freq)):
        lines = sets.setdefault(part.load, {})
        if part.freq in lines:
            what = f"holds the response to load set {part.load} at {part.freq:g} Hz twice"
            raise refused(path, what, ONCE)
        lines[part.freq] = part
    first = next(iter(sets.values()))
    for number, lines in sets.items():
        if list(lines) != list(first):
            other = f"has load set {number} at other frequencies than load set {next(iter(sets))}"
            raise refused(path, other, "Export all alike.")
    return sets

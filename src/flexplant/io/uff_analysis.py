"""Results of analyses in universal files: motions of nodes in datasets 55 and 2414."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from ..arrays import ComplexArray, FloatArray, IntArray
from ..errors import FlexplantError
from ..labels import DIRECTIONS
from ..lti.frequency import Frf
from .coordinate_systems import turned_motions
from .files import ONCE, damaged, refused, spaced_numbers, unread
from .uff_records import KINDS, datasets, derivative, whole_entry
from .uff_systems import UffNodes

#: number of lines of records 1 to 13 in dataset 2414
_HEAD = 13
#: codes of data that are motions, each with its number of values per node, 3 or 6
_MOTIONS = {2: 3, 3: 6}
_AT_NODES = 1
_COMPLEX = (5, 6)
#: codes of analysis types
NORMAL_MODE, COMPLEX_MODES, FREQUENCY_RESPONSE = 2, (3, 7), 5
#: code of the result type
DISPLACEMENT = next(code for code, kind in KINDS.items() if kind == "displacement")


class AnalysisData(NamedTuple):
    """Motions of nodes in one result of an analysis."""

    analysis: int
    result: int
    load: int
    mode: int
    freq: float
    mass: float
    viscous: float
    hysteretic: float
    eigenvalue: complex
    nodes: IntArray
    motions: FloatArray | ComplexArray
    #: whether test software wrote it: zeros then mean DOFs that were not measured
    measured: bool = False

    @property
    def zeta(self) -> float:
        """The damping ratio of a normal mode."""
        return self.viscous or self.hysteretic / 2

    @property
    def pole(self) -> complex:
        """The pole of a mode [rad/s]."""
        if self.analysis != NORMAL_MODE:
            return self.eigenvalue
        swing = 1j * np.sqrt(1 - min(abs(self.zeta), 1.0) ** 2)
        return complex(2 * np.pi * self.freq * (swing - self.zeta))


def mode_records(path: Path, *, measured: bool) -> list[AnalysisData]:
    """Return the modes of a file."""
    of_tests = [_of_55(part, path) for part in datasets(path, (55,))]
    of_models = [part for part in read_analysis(path) if part.result == DISPLACEMENT]
    kinds = (NORMAL_MODE, *COMPLEX_MODES)
    both = [[part for part in parts if part.analysis in kinds] for parts in (of_tests, of_models)]
    modes = (both[0] or both[1]) if measured else (both[1] or both[0])
    check_nodes(modes, path)
    return modes


def check_nodes(parts: list[AnalysisData], path: Path) -> None:
    """Raise FlexplantError when results are at different nodes."""
    for part in parts:
        if not np.array_equal(part.nodes, parts[0].nodes):
            raise FlexplantError(
                f"{str(path)!r}: mode {part.mode} is at other nodes than mode {parts[0].mode}, or "
                "its numbers are cut off. Export all at the same nodes."
            )


def _of_55(part: dict[str, Any], path: Path) -> AnalysisData:
    nodes = np.asarray(part["node_nums"]).astype(np.int64)
    rows = [np.asarray(part[f"r{i}"]) for i in range(1, 7) if part.get(f"r{i}") is not None]
    if not nodes.size or any(row.size != nodes.size for row in rows):
        raise damaged(path, "a dataset 55 whose numbers are cut off", "Export it again.")

    def number(name: str) -> float:
        return float(np.real(part.get(name) or 0.0))

    rows += [np.zeros(nodes.size)] * (6 - len(rows))
    return AnalysisData(
        analysis=whole_entry(part, "analysis_type"),
        result=DISPLACEMENT,
        load=0,
        mode=whole_entry(part, "mode_n"),
        freq=number("freq"),
        mass=number("modal_m"),
        viscous=number("modal_damp_vis"),
        hysteretic=number("modal_damp_his"),
        eigenvalue=complex(part.get("eig") or 0.0),
        nodes=nodes,
        motions=np.stack(rows, axis=1),
        measured=True,
    )


def read_analysis(path: Path) -> list[AnalysisData]:
    """Return all motions at nodes in the datasets 2414 of a file; other results are passed over."""
    found = [_parse_2414(lines, place, path) for place, lines in _response_blocks(path)]
    return [part for part in found if part is not None]


def _response_blocks(path: Path) -> Iterator[tuple[int, list[bytes]]]:
    """Yield the place, from 1, and the lines of each dataset 2414."""
    place = 0
    lines: list[bytes] | None = None
    with path.open("rb") as file:
        for line in file:
            if line.strip() != b"-1":
                if lines is not None and (not lines or lines[0].strip() == b"2414"):
                    lines.append(line)
                continue
            if lines is None:
                place, lines = place + 1, []
                continue
            if lines and lines[0].strip() == b"2414":
                yield place, lines[1:]
            lines = None


def _parse_2414(lines: list[bytes], place: int, path: Path) -> AnalysisData | None:
    what = f"dataset {place} (type 2414)"
    head = [_line_numbers(line, path, what) for line in (lines[2:3] + lines[8:_HEAD])]
    if len(head) < 6 or not head[0].size or head[1].size < 6 or head[2].size < 8:
        raise damaged(path, f"{what} is cut off", "Export it again.")
    location, (_, analysis, kind, result, data, count) = head[0][0], head[1][:6].astype(int)
    if location != _AT_NODES or kind not in _MOTIONS:
        return None
    if count != _MOTIONS[kind]:
        raise damaged(path, f"{what} has {count} numbers of a node", "Export it again.")
    width = count * (2 if data in _COMPLEX else 1)
    table = spaced_numbers(b"".join(lines[_HEAD:]))
    if table is None or not table.size or table.size % (1 + width):
        raise damaged(path, f"{what} has other numbers than {width} of each node")
    table = table.reshape(-1, 1 + width)
    nodes = table[:, 0].astype(np.int64)
    if np.any(nodes != table[:, 0]) or np.any(nodes < 1) or np.unique(nodes).size < nodes.size:
        raise damaged(path, f"{what}: node numbers are not whole, positive and different")
    motions: Any = table[:, 1:]
    if data in _COMPLEX:
        motions = motions[:, ::2] + 1j * motions[:, 1::2]
    real = np.zeros(12)
    listed = np.concatenate([part[:6] for part in head[4:6]])
    real[: listed.size] = listed
    return AnalysisData(
        analysis=int(analysis),
        result=int(result),
        load=int(head[2][4]),
        mode=int(head[2][5]),
        freq=float(real[1]),
        mass=float(real[3]),
        viscous=float(real[4]),
        hysteretic=float(real[5]),
        eigenvalue=complex(real[6], real[7]),
        nodes=nodes,
        motions=np.hstack([motions, np.zeros((nodes.size, 6 - count))]),
    )


def _line_numbers(line: bytes, path: Path, what: str) -> FloatArray:
    found = spaced_numbers(line)
    if found is None or not np.all(np.isfinite(found)) or np.any(np.abs(found) > 1e15):
        raise damaged(path, f"{what}: {line[:60]!r} holds other things than numbers")
    return found


def responses_of_model(
    path: Path,
    factors: dict[str, Any] | None,
    quantity: str | None,
    scale: float | None,
    nodes: UffNodes,
) -> Frf | None:
    """Return the frequency responses of dataset 2414, None without these datasets."""
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
    data = np.array([[part.motions for part in lines.values()] for lines in sets.values()])
    data = np.transpose(data.astype(np.complex128), (2, 3, 1, 0))  # (node, motion, frequency, load)
    data = turned_motions(data, parts[0].nodes.tolist(), nodes.axes(parts[0].nodes))
    data = np.moveaxis(data.reshape(-1, *data.shape[2:]), 0, 1)  # (frequency, motion, load)
    length = scale or (1.0 if factors is None else 1 / float(factors["length"]))
    motion = np.arange(data.shape[1]) % 6
    data[:, motion < 3] *= length
    data = data * derivative(freq, kind, quantity or kind, path)[:, None, None]
    seen = np.isin(motion, motion[np.any(data, axis=(0, 2))])
    names = [f"{node}:{axis}" for node in parts[0].nodes.tolist() for axis in DIRECTIONS]
    outputs = [name for name, there in zip(names, seen, strict=True) if there]
    return Frf(
        freq,
        np.moveaxis(data[:, seen], 0, 2),
        inputs=[f"load {number}" for number in sets],
        outputs=outputs,
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

"""Records of universal files, whether they are whole, and the motions of nodes in them."""

from __future__ import annotations

import re
import warnings
from collections.abc import Iterable, Iterator
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from ..checks import ComplexArray, FloatArray, IntArray, short
from ..errors import FlexplantError, ModelError
from ..labels import DIRECTIONS
from ..lti.frequency import ORDERS, Frf
from ..structure.units import GRAVITY, LENGTHS, POUND
from ..tolerances import SAME
from .assembled import extra_module
from .files import GLOBAL, ONCE, damaged, file_path, parsing, refused, spaced_numbers, unread


def check_systems(parts: list[dict[str, Any]], path: str) -> None:
    """Raise ModelError when system 0 or 1, which stands for the global one, is another (2420)."""
    straight = np.vstack([np.eye(3), np.zeros((1, 3))])
    for part in parts:
        listed = zip(part["CS_sys_labels"], part["CS_types"], part["CS_matrices"], strict=True)
        for label, kind, matrix in listed:
            if label in (0, 1) and (kind or np.abs(np.asarray(matrix) - straight).max() > SAME):
                what = f"gives nodes in coordinate system {int(label)}, turned, moved or curved"
                raise unread(path, f"{what} by dataset 2420", GLOBAL)


def datasets(path: str | Path, kinds: tuple[int, ...]) -> list[dict[str, Any]]:
    """Return the datasets of some kinds, as pyuff reads them."""
    with file_path(path).open("rb") as file:
        start = file.read(200)
    pyuff = extra_module("pyuff", "uff", "reading universal files")
    if start.split()[:1] != [b"-1"]:
        what = f"is no universal file: it begins with {start[:20]!r}, not with -1"
        raise refused(path, what, "Export it as one, .uff or .unv.")
    _check_end(file_path(path))
    found = []
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # NumPy's of what pyuff calls
        with parsing(f"{path}", "Export it again."):
            file = pyuff.UFF(str(path))
            types = [int(kind) for kind in file.get_set_types()]
        for place, kind in enumerate(types):
            if kind not in kinds:
                continue
            try:
                part = file.read_sets(place)
                part = part[0] if isinstance(part, list) else part
                if "node_nums" in part:
                    part["node_nums"] = np.atleast_1d(part["node_nums"]).astype(np.int64)
            except Exception as error:
                what = f"dataset {place + 1} (type {kind}) cannot be read ({error!s:.100})"
                raise damaged(path, what, "Export it again.") from None
            if kind == 58:
                _check_58(part, path, place)
            found.append(part)
    return found


def _check_end(path: Path) -> None:
    """Refuse a file that ends within a dataset: pyuff passes over what has no end."""
    # lines of -1, in columns 5 and 6, begin and end each dataset, right behind the bytes of a
    # binary one (58b); its type stands in the second line
    place, inside, kind = 0, False, ""
    with path.open("rb") as file:
        for line in file:
            text = line.rstrip()
            if text != b"    -1" and not (kind.endswith("b") and text.endswith(b"    -1")):
                continue
            inside = not inside
            kind = file.readline().strip().decode("latin-1").partition(" ")[0] if inside else ""
            place += inside
    if inside:
        which = f"dataset {place} of type {short(kind)}" if kind else f"dataset {place}"
        raise refused(path, f"is cut off: {which} has no end", "Export it, or copy it, again.")


def _check_58(part: dict[str, Any], path: str | Path, place: int) -> None:
    data, x = np.asarray(part.get("data", ())), np.asarray(part.get("x", ()))
    points = whole_entry(part, "num_pts")
    if data.size != points or x.size != points or not points:
        wrong = f"{data.size} of {points} points are there"
    elif not (np.all(np.isfinite(data)) and np.all(np.isfinite(x))):
        wrong = "NaN or infinite numbers"
    else:
        return
    what = f"dataset {place + 1} (type 58) cannot be read ({wrong})"
    raise damaged(path, what, "Export it again.")


def whole_entry(part: dict[str, Any], name: str) -> int:
    """Return an entry of a record as an int, 0 where it is not there."""
    try:
        return int(part.get(name) or 0)
    except (TypeError, ValueError):
        raise FlexplantError(
            f"dataset {part.get('type')}: {name} is {short(part.get(name))}, no whole number. The "
            "file is damaged: export it again."
        ) from None


def _channel_of(part: dict[str, Any], side: str) -> tuple[str, int]:
    """Return the name of a channel and the sign of its direction."""
    node, code = whole_entry(part, f"{side}_node"), whole_entry(part, f"{side}_dir")
    if 1 <= abs(code) <= 6:
        return f"{node}:{DIRECTIONS[abs(code) - 1]}", 1 if code > 0 else -1
    entity = str(part.get(f"{side}_ent_name") or "").strip().replace(".", " ")
    return (entity if entity.strip("- ") and entity != "NONE" else str(node)), 1


def paired_records(
    records: list[dict[str, Any]], path: str
) -> dict[tuple[str, str], tuple[int, dict[str, Any]]]:
    """Return {(output, input): (sign, record)}, each pair once."""
    pairs: dict[tuple[str, str], tuple[int, dict[str, Any]]] = {}
    doubled = []
    for part in records:
        (output, up), (name, down) = _channel_of(part, "rsp"), _channel_of(part, "ref")
        pair = (output, f"u {name}")
        if pair in pairs:
            doubled.append(" <- ".join(pair))
        pairs[pair] = (up * down, part)
    if doubled:
        do = "Repeated ones are averaged: export each pair once (average_frfs joins files)."
        raise refused(path, f"holds {', '.join(doubled[:6])} more than once", do)
    return pairs


def record_sides(pairs: Iterable[tuple[str, str]]) -> tuple[list[str], list[str]]:
    """Return outputs and inputs of pairs, in order of nodes and directions."""

    def place(name: str) -> tuple[Any, ...]:
        node, _, direction = name.removeprefix("u ").partition(":")
        known = direction in DIRECTIONS
        return (0, int(node), DIRECTIONS.index(direction)) if known else (1, name)

    listed = list(pairs)
    return (
        sorted({output for output, _ in listed}, key=place),
        sorted({name for _, name in listed}, key=place),
    )


def check_complete(
    pairs: Iterable[tuple[str, str]],
    outputs: list[str],
    inputs: list[str],
    what: str,
    path: str,
    remedy: str,
) -> None:
    """Raise FlexplantError unless every output is there for every input."""
    there = set(pairs)
    missing = [f"{a} <- {b}" for a in outputs for b in inputs if (a, b) not in there]
    if missing:
        few = f"lacks {len(missing)} of {len(outputs) * len(inputs)} {what}: "
        do = f"Export every output for every input{remedy}."
        raise refused(path, few + ", ".join(missing[:8]), do)


def common_frequencies(records: list[dict[str, Any]], path: str) -> FloatArray:
    """Return the frequencies [Hz] of all records, which must be the same."""
    first = np.asarray(records[0]["x"], dtype=np.float64)
    for part in records:
        if whole_entry(part, "abscissa_spec_data_type") not in (0, 1, 18):
            kind = whole_entry(part, "abscissa_spec_data_type")
            what = f"has a response not over frequency (abscissa type {kind}, 18 is frequency)"
            raise refused(path, what, "Export it in Hz.")
        own = np.asarray(part["x"], dtype=np.float64)
        step = float(np.ptp(first)) / max(first.size - 1, 1)
        if own.size != first.size or np.max(np.abs(own - first)) > 1e-3 * step:  # single precision
            two = [
                f"{_channel_of(one, 'rsp')[0]} <- u {_channel_of(one, 'ref')[0]} ({x.size} from "
                f"{x[0]:g} to {x[-1]:g} Hz)"
                for one, x in ((part, own), (records[0], first))
            ]
            what = f"has {two[0]} at other frequencies than {two[1]}"
            raise refused(path, what, "Export all alike.")
    return first


def coherence_of(
    records: list[dict[str, Any]],
    outputs: list[str],
    inputs: list[str],
    freq: FloatArray,
    path: str,
) -> FloatArray:
    """Return the coherence (n_out, n_in, n_freq) of the records of type 6."""
    pairs = {
        pair: record
        for pair, record in paired_records(records, path).items()
        if pair[0] in outputs and pair[1] in inputs
    }
    check_complete(pairs, outputs, inputs, "coherences", path, ", or pass coherence=False")
    if any(np.size(part["data"]) != freq.size for _, part in pairs.values()):
        what = "has coherences at other frequencies than the responses"
        raise refused(path, what, "Export all alike, or pass coherence=False.")
    rows = [[np.real(pairs[a, b][1]["data"]) for b in inputs] for a in outputs]
    # single precision goes beyond 1 by its rounding
    return np.minimum(np.array(rows, dtype=np.float64), 1.0)


#: specific data types of dataset 58
KINDS = {8: "displacement", 11: "velocity", 12: "acceleration"}
#: what one of a named unit is in SI
_LENGTHS = {**LENGTHS, "nm": 1e-9}
_ANGLES = {"rad": 1.0, "mrad": 1e-3, "urad": 1e-6}
_FORCES = {"n": 1.0, "kn": 1e3, "mn": 1e-3, "lbf": POUND * GRAVITY, "nm": 1.0, "n*m": 1.0}
_SECONDS = re.compile(r"\(?s(?:ec)?(?:\^|\*\*)?2?\)?")


def record_scale(
    part: dict[str, Any], factors: dict[str, Any] | None, quantity: str | None, path: str
) -> float:
    """Return the factor that brings a response of dataset 58 to SI."""
    above = _clean_text(part, "ordinate_axis_units_lab")
    below = _clean_text(part, "orddenom_axis_units_lab")
    if "/" in above and not below:  # all in one label: m/s^2/N
        head, _, last = above.rpartition("/")
        if last.lower() in _FORCES and not _SECONDS.fullmatch(last):
            above, below = head, last
    length, force = _motion(above, quantity), _FORCES.get(below.lower()) if below else 1.0
    # "nm" is a length above and a moment below; "mn" a millinewton
    if length is None or force is None:
        raise ModelError(
            f"{path!r}: the units of a response are {above or '?'!r} per {below or '?'!r}, which "
            "are not known here. Say what brings the numbers to SI: scale=9.80665 where they are "
            "g/N, scale=1 where they are SI."
        )
    if factors is None:
        return length / force
    to_length, to_force = 1 / float(factors["length"]), 1 / float(factors["force"])
    named_length = to_length if not above else length
    named_force = to_force if not below else force
    # factors are printed with four digits or more
    if abs(named_length / to_length - 1) > 1e-3 or abs(named_force / to_force - 1) > 1e-3:
        raise ModelError(
            f"{path!r}: the axes say {above!r} per {below!r}, dataset 164 (units) factors "
            f"{factors['length']:g} and {factors['force']:g} for length and force: they contradict "
            "each other. Say what brings the numbers to SI: scale=..."
        )
    return to_length / to_force


def _clean_text(part: dict[str, Any], name: str) -> str:
    text = str(part.get(name) or "").strip().strip("[]").replace(" ", "")
    return "" if text.upper() in ("NONE", "UNKNOWN", "-") else text


def _motion(label: str, quantity: str | None) -> float | None:
    if not label:
        return 1.0
    first, *rest = label.strip("()").replace("²", "2").split("/")
    if any(not _SECONDS.fullmatch(item.lower()) for item in rest):
        return None
    if first == "g" and quantity in ("acceleration", None) and not rest:
        return GRAVITY
    return (_LENGTHS | _ANGLES).get(first.replace("µ", "u").replace("\xb5", "u"))


#: of dataset 2414: lines of records 1 to 13
_HEAD = 13
#: data characteristics that are motions: 3 or 6 numbers of each node
_MOTIONS = {2: 3, 3: 6}
_AT_NODES = 1
_COMPLEX = (5, 6)
#: kinds of analysis
NORMAL_MODE, COMPLEX_MODES, FREQUENCY_RESPONSE = 2, (3, 7), 5
#: kinds of results
DISPLACEMENT = 8


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

    @property
    def zeta(self) -> float:
        """The damping ratio of a normal mode."""
        return self.viscous or self.hysteretic / 2

    @property
    def pole(self) -> complex:
        """The pole of a mode [rad/s]."""
        if self.analysis != NORMAL_MODE:
            return self.eigenvalue
        swing = 1j * np.sqrt(max(0.0, 1 - self.zeta**2))
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
    if any(row.size != nodes.size for row in rows):
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
    path: Path, factors: dict[str, Any] | None, quantity: str | None, scale: float | None
) -> Frf | None:
    """Return the frequency responses of dataset 2414, None when there are none."""
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
    data = data * derivative(freq, kind, quantity or kind, path)[:, None, None]
    seen = np.isin(motion, motion[np.any(data, axis=(0, 2))])
    names = [f"{node}:{axis}" for node in parts[0].nodes.tolist() for axis in DIRECTIONS]
    return Frf(
        freq,
        np.moveaxis(data[:, seen], 0, 2),
        inputs=[f"load {number}" for number in sets],
        outputs=[name for name, there in zip(names, seen, strict=True) if there],
        quantity=quantity or kind,
    )


def derivative(
    freq: FloatArray, kind: str | None, target: str | None, path: str | Path
) -> ComplexArray:
    """Return the factors (n_freq,) from one quantity to another, 1 where neither is known."""
    order = ORDERS[target] - ORDERS[kind] if kind and target else 0
    if order < 0 and freq[0] == 0:
        what = f"holds {kind} at zero frequency, which cannot be integrated to {target}"
        raise unread(path, what, f"Read it as {kind}, or export from above zero.")
    return np.asarray((2j * np.pi * freq) ** order)


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

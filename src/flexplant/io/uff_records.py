"""Records of universal files, whether they are whole, and the motions of nodes in them."""

from __future__ import annotations

import warnings
from collections.abc import Iterable
from pathlib import Path
from typing import Any

import numpy as np

from ..arrays import ComplexArray, FloatArray
from ..errors import FlexplantError, ModelError, short
from ..labels import DIRECTIONS
from ..lti.frequency import ORDERS
from ..structure.unit_systems import GRAVITY, POUND
from .files import damaged, file_path, parsing, refused, unread
from .triplets import extra_module
from .unit_labels import plain_label, prefixed, unit_of


def dataset_types(path: str | Path) -> list[int]:
    """Return the types of all datasets of a file that is whole."""
    return [int(kind) for kind in _opened(path).get_set_types()]


def _opened(path: str | Path) -> Any:
    """Return the file as pyuff opens it; refuse other files, and those cut off."""
    with file_path(path).open("rb") as file:
        start = file.read(200)
    pyuff = extra_module("pyuff", "uff", "reading universal files")
    if start.split()[:1] != [b"-1"]:
        what = f"is not a universal file: it begins with {start[:20]!r}, not with -1"
        raise refused(path, what, "Export it as one, .uff or .unv.")
    _begins(file_path(path))
    with (
        warnings.catch_warnings(action="ignore"),  # NumPy's of what pyuff calls
        parsing(f"{path}", "Export it again."),
    ):
        file = pyuff.UFF(str(path))
        file.get_set_types()
        return file


def datasets(path: str | Path, kinds: tuple[int, ...]) -> list[dict[str, Any]]:
    """Return the datasets of some kinds, as pyuff reads them."""
    file = _opened(path)
    found = []
    with warnings.catch_warnings(action="ignore"):  # NumPy's of what pyuff calls
        for place, kind in enumerate(int(kind) for kind in file.get_set_types()):
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
                if any("\ufffd" in str(value) for value in part.values()):
                    part |= _latin_texts(file_path(path), place)
            found.append(part)
    return found


def _begins(path: Path) -> list[int]:
    """Return the byte behind the type of each dataset; refuse a file that ends within one."""
    # pyuff passes over what has no end. Lines of -1, in columns 5 and 6, begin and end each
    # dataset, right behind the bytes of a binary one (58b); its type stands in the second line
    found, inside, kind = list[int](), False, ""
    with path.open("rb") as file:
        for line in file:
            text = line.rstrip()
            if text != b"    -1" and not (kind.endswith("b") and text.endswith(b"    -1")):
                continue
            inside = not inside
            kind = file.readline().strip().decode("latin-1").partition(" ")[0] if inside else ""
            if inside:
                found.append(file.tell())
    if inside:
        which = f"dataset {len(found)} of type {short(kind)}" if kind else f"dataset {len(found)}"
        raise refused(path, f"is cut off: {which} has no end", "Export it, or copy it, again.")
    return found


#: texts of dataset 58: line behind that of its type, first column and last + 1
_TEXTS = {
    "rsp_ent_name": (5, 30, 41),
    "ref_ent_name": (5, 55, 66),
    "ordinate_axis_units_lab": (8, 46, 67),
    "orddenom_axis_units_lab": (9, 46, 67),
}


def _latin_texts(path: Path, place: int) -> dict[str, str]:
    """Return the texts of a dataset 58 in Latin-1: names of channels and units."""
    begin = _begins(path)[place]
    with path.open("rb") as file:
        file.seek(begin)
        lines = [file.readline().decode("latin-1") for _ in range(12)]
    return {name: lines[row][a:b].strip() for name, (row, a, b) in _TEXTS.items()}


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
            f"dataset {part.get('type')}: {name} is {short(part.get(name))}, not an integer. The "
            "file is damaged: export it again."
        ) from None


def channel_of(part: dict[str, Any], side: str) -> tuple[str, int]:
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
        (output, up), (name, down) = channel_of(part, "rsp"), channel_of(part, "ref")
        pair = (output, f"u {name}")
        if pair in pairs:
            doubled.append(" <- ".join(pair))
        pairs[pair] = (up * down, part)
    if doubled:
        do = "Repeated ones are averaged: export each pair once (average_frfs joins files)."
        raise refused(path, f"holds {', '.join(doubled[:6])} more than once", do)
    return pairs


def channel_order(name: str) -> tuple[Any, ...]:
    """Return what channels are sorted by: node and direction, then names without them."""
    node, _, direction = name.removeprefix("u ").partition(":")
    known = direction in DIRECTIONS and node.isdigit()
    return (0, int(node), DIRECTIONS.index(direction)) if known else (1, name)


def record_sides(pairs: Iterable[tuple[str, str]]) -> tuple[list[str], list[str]]:
    """Return outputs and inputs of pairs, in order of nodes and directions."""
    listed = list(pairs)
    return (
        sorted({output for output, _ in listed}, key=channel_order),
        sorted({name for _, name in listed}, key=channel_order),
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
        few = f"does not contain {len(missing)} of {len(outputs) * len(inputs)} {what}: "
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
                f"{channel_of(one, 'rsp')[0]} <- u {channel_of(one, 'ref')[0]} ({x.size} from "
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
_FORCES = {
    label.lower(): size
    for label, size in (prefixed("N", "km") | prefixed("Nm", "") | prefixed("N*m", "")).items()
} | {"lbf": POUND * GRAVITY}


def record_scale(
    part: dict[str, Any], factors: dict[str, Any] | None, quantity: str | None, path: str
) -> float:
    """Return the factor that brings a response of dataset 58 to SI."""
    above = unit_text(part, "ordinate_axis_units_lab")
    below = unit_text(part, "orddenom_axis_units_lab")
    if "/" in above and not below:  # all in one label: m/s^2/N
        head, _, last = above.rpartition("/")
        if last.lower() in _FORCES:
            above, below = head, last
    length, force = _motion(above, quantity), _FORCES.get(below.lower()) if below else 1.0
    # "nm" is a length above and a moment below; "mn" a millinewton
    if length is None or force is None:
        raise ModelError(
            f"{path!r}: the units of a response are {above or '?'!r} per {below or '?'!r}, which "
            "are unknown. Give the factor to SI: scale=9.80665 for g/N, scale=1 for SI."
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
            f"{factors['length']:g} and {factors['force']:g} for length and force: they "
            "contradict each other. Give the factor to SI: scale=..."
        )
    return to_length / to_force


def unit_text(part: dict[str, Any], name: str) -> str:
    """Return the label of a unit, without blanks and brackets; empty for none."""
    return plain_label(str(part.get(name) or ""))


def _motion(label: str, quantity: str | None) -> float | None:
    """Return the size in SI of a unit of motion, 1 where none is named."""
    if not label:
        return 1.0
    unit = unit_of(label)
    if unit is None or unit[1][:1] not in ("m", "r"):
        return None
    return None if plain_label(label) == "g" and quantity not in ("acceleration", None) else unit[0]


def derivative(
    freq: FloatArray, kind: str | None, target: str | None, path: str | Path
) -> ComplexArray:
    """Return the factors (n_freq,) from one quantity to another, 1 where neither is known."""
    order = ORDERS[target] - ORDERS[kind] if kind and target else 0
    if order < 0 and freq[0] == 0:
        what = f"holds {kind} at zero frequency, which cannot be integrated to {target}"
        raise unread(path, what, f"Read it as {kind}, or export from above zero.")
    return np.asarray((2j * np.pi * freq) ** order)

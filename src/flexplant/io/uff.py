"""Universal files (UFF) of a measurement: responses (58), shapes (55), nodes (15, 2411)."""

from __future__ import annotations

import importlib
import warnings
from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from ..errors import FlexplantError, LabelError, ModelError, unknown_label
from ..identification import MeasuredModes
from ..labels import DIRECTIONS, DofSet
from ..lti.frequency import Frf
from ..values import FloatArray, positive, short
from .formats import Elsewhere
from .paths import file_path
from .uff_units import KINDS, ORDERS, record_scale


def read_frf_uff(
    path: str | Path,
    *,
    quantity: str | None = None,
    scale: float | None = None,
    coherence: bool = True,
) -> Frf:
    """Return the frequency response functions of a universal file (dataset 58, text or binary).

    Every record gives one pair; a direction -3 is z with the sign turned.

    Parameters
    ----------
    path : str or Path
        A .uff, .unv or .uf file. Needs pyuff: pip install 'flexplant[uff]'.
    quantity : {"displacement", "velocity", "acceleration"}, optional
        What the outputs shall be. Records that say what they are are converted, those that do not
        are taken as this. When not given, all must be of one kind.
    scale : float, optional
        Factor that brings the numbers to SI (m, m/s or m/s^2 per N), where the file's units are
        not clear; otherwise it follows from the labels of the axes and dataset 164.
    coherence : bool
        Whether to attach the coherence records (function type 6).

    Returns
    -------
    Frf
        Outputs "41:z", inputs "u 41:z" by node and direction, sorted; the name of the entity in
        the place of a missing direction.

    Raises
    ------
    FlexplantError
        When pyuff is missing, the file is damaged, pairs are missing or doubled, or records are
        over different frequencies; the pairs are listed.
    ModelError
        When units or quantities are not clear, or zero frequency would be integrated.
    LabelError
        When `quantity` is another word.
    FileNotFoundError
        When there is no such file.

    Notes
    -----
    Format: Structural Dynamics Research Laboratory, University of Cincinnati, "Universal File
    Formats for Modal Analysis Testing", dataset 58.
    """
    if quantity is not None and quantity not in ORDERS:
        raise unknown_label("quantity", quantity, ORDERS)
    if scale is not None:
        scale = positive(scale, "scale")
    sets = _sets(path, (58, 164))
    factors = next((part for part in sets if part["type"] == 164), None)
    records = [part for part in sets if part["type"] == 58]
    responses = [part for part in records if _whole(part, "func_type") == 4]
    if not responses:
        kinds = sorted({_whole(part, "func_type") for part in records})
        raise FlexplantError(
            f"{str(path)!r} holds no frequency response function: {len(records)} records 58 of "
            f"function types {kinds} (4 is a frequency response). Export these, or estimate them "
            "from time records: estimate_frf."
        )
    found = {KINDS.get(_whole(part, "ordinate_spec_data_type")) for part in responses}
    if len(found) > 1 and quantity is None:
        raise ModelError(
            f"{str(path)!r} holds records of {sorted(str(kind or 'unknown') for kind in found)}: "
            "one Frf is of one quantity. Say which to convert to: quantity='acceleration'."
        )
    target = quantity or found.pop()
    pairs = _paired(responses, str(path))
    freq = _frequencies(responses, str(path))
    outputs, inputs = _sides(pairs)
    _complete(pairs, outputs, inputs, "frequency responses", str(path), "")
    data = np.empty((len(outputs), len(inputs), freq.size), dtype=np.complex128)
    for (output, name), (sign, part) in pairs.items():
        kind = KINDS.get(_whole(part, "ordinate_spec_data_type"))
        factor = sign * (scale or record_scale(part, factors, kind or target, str(path)))
        row = factor * np.asarray(part["data"], dtype=np.complex128)
        if kind is not None and target is not None and kind != target:
            order = ORDERS[target] - ORDERS[kind]
            if order < 0 and freq[0] == 0:
                raise ModelError(
                    f"{str(path)!r} holds {kind} at zero frequency, which cannot be integrated to "
                    f"{target}. Read it as {kind}, or export from above zero."
                )
            row = row * (2j * np.pi * freq) ** order
        data[outputs.index(output), inputs.index(name)] = row
    measured = [part for part in records if _whole(part, "func_type") == 6] if coherence else []
    return Frf(
        freq,
        data,
        inputs=inputs,
        outputs=outputs,
        quantity=target,
        coherence=_coherence(measured, outputs, inputs, freq, str(path)) if measured else None,
    )


def read_modes_uff(path: str | Path, *, modes: Iterable[int] | None = None) -> MeasuredModes:
    """Return poles and mode shapes of a universal file (dataset 55: normal or complex modes).

    The numbers of the modes in the file count what was measured; which modes of a model they are
    is found by `numbered`.

    Parameters
    ----------
    path : str or Path
        A .uff, .unv or .uf file. Needs pyuff: pip install 'flexplant[uff]'.
    modes : sequence of int, optional
        Which of the file's modes, by their numbers there; all when not given.

    Returns
    -------
    MeasuredModes
        Shapes at the DOFs "41:z"; directions that are zero in all modes were not measured and are
        left out.

    Raises
    ------
    FlexplantError
        When pyuff is missing, the file is damaged or holds no modes, or modes at other nodes.
    LabelError
        When a mode asked for is not there.
    ModelError
        When a mode has zero frequency (a rigid-body mode), or a pole is not stable.
    FileNotFoundError
        When there is no such file.
    """
    parts = {}
    for part in _sets(path, (55,)):
        if part["type"] == 55 and _whole(part, "analysis_type") in (2, 3, 7):
            number = _whole(part, "mode_n")
            if number in parts:
                raise FlexplantError(
                    f"{str(path)!r} holds mode {number} twice. Export each once (one result set)."
                )
            parts[number] = part
    if not parts:
        newer = (
            " Its dataset 2414 (results of a finite-element program) is not read."
            if 2414 in _types(path)
            else ""
        )
        raise FlexplantError(
            f"{str(path)!r} holds no mode shapes: dataset 55 of normal (2) or complex modes "
            f"(3, 7).{newer} Export these."
        )
    chosen = list(parts) if modes is None else list(modes)
    for number in chosen:
        if number not in parts:
            raise LabelError(f"no mode {number!r} in {str(path)!r}: it holds {list(parts)[:12]}.")
    poles = np.array([_pole(parts[number]) for number in chosen])
    if np.any(poles.imag == 0):
        rigid = [number for number, pole in zip(chosen, poles, strict=True) if pole.imag == 0]
        raise ModelError(
            f"modes {rigid} of {str(path)!r} do not oscillate (rigid-body or overdamped): they "
            f"cannot be compared. Leave them out: modes={[n for n in chosen if n not in rigid]}."
        )
    nodes = np.asarray(parts[chosen[0]]["node_nums"]).astype(np.int64)
    shapes = []
    for number in chosen:
        part = parts[number]
        own = np.asarray(part["node_nums"]).astype(np.int64)
        rows = [np.asarray(part[f"r{i}"]) for i in range(1, 7) if part.get(f"r{i}") is not None]
        if not np.array_equal(own, nodes) or any(row.size != nodes.size for row in rows):
            raise FlexplantError(
                f"{str(path)!r}: mode {number} is at other nodes than mode {chosen[0]}, or its "
                "numbers are cut off. Export all at the same nodes."
            )
        rows += [np.zeros(nodes.size)] * (6 - len(rows))
        shapes.append(np.stack(rows, axis=1).ravel())
    phi = np.array(shapes, dtype=np.complex128).T
    labels = [f"{node}:{direction}" for node in nodes.tolist() for direction in DIRECTIONS]
    seen = np.array([np.any(phi[i::6]) for i in range(6)])
    keep = np.tile(seen, nodes.size)
    names = [label for label, kept in zip(labels, keep, strict=True) if kept]
    return MeasuredModes(poles, shapes=phi[keep], dofs=tuple(names))


def read_nodes_uff(path: str | Path, *, directions: Sequence[str] = ("x", "y", "z")) -> DofSet:
    """Return the nodes of a universal file (datasets 15 and 2411) as DOFs with coordinates.

    Parameters
    ----------
    path : str or Path
        A .uff, .unv or .uf file. Needs pyuff: pip install 'flexplant[uff]'.
    directions : sequence of str
        Which DOFs each node gets.

    Returns
    -------
    DofSet
        In metres, by dataset 164 where there is one.

    Raises
    ------
    FlexplantError
        When pyuff is missing, the file is damaged, or holds no nodes.
    ModelError
        When nodes are given, or move, in a coordinate system of their own (dataset 2420).
    LabelError
        When a direction is unknown or a node appears twice.
    FileNotFoundError
        When there is no such file.
    """
    sets = _sets(path, (15, 2411, 164, 2420))
    length = next((float(part["length"]) for part in sets if part["type"] == 164), 1.0)
    _check_systems([part for part in sets if part["type"] == 2420], str(path))
    parts = [part for part in sets if part["type"] in (15, 2411)]
    if not parts:
        raise FlexplantError(f"{str(path)!r} holds no nodes (datasets 15, 2411). Export them.")
    nodes, places = [], []
    for part in parts:
        numbers = np.atleast_1d(part["node_nums"]).astype(np.int64)
        system = np.atleast_1d(part.get("def_cs", 0)).astype(np.int64)
        moved = np.atleast_1d(part.get("disp_cs", 0)).astype(np.int64)
        # 0 and 1 both stand for the global system in files of test software
        for what, of in (("gives", system), ("moves", moved)):
            if np.any(of > 1):
                raise ModelError(
                    f"{str(path)!r} {what} node {int(numbers[np.argmax(of > 1)])} in coordinate "
                    f"system {int(of.max())}: only global coordinates and directions are read. "
                    "Export these."
                )
        nodes.append(numbers)
        places.append(np.stack([np.atleast_1d(part[axis]) for axis in "xyz"], axis=1))
    count = len(directions)
    ids, xyz = np.concatenate(nodes), np.concatenate(places) / length
    return DofSet(np.repeat(ids, count), tuple(directions) * ids.size, np.repeat(xyz, count, 0))


def _check_systems(parts: list[dict[str, Any]], path: str) -> None:
    """Raise ModelError when system 0 or 1, which stands for the global one, is another (2420)."""
    straight = np.vstack([np.eye(3), np.zeros((1, 3))])
    for part in parts:
        listed = zip(part["CS_sys_labels"], part["CS_types"], part["CS_matrices"], strict=True)
        for label, kind, matrix in listed:
            if label in (0, 1) and (kind or np.abs(np.asarray(matrix) - straight).max() > 1e-9):
                raise ModelError(
                    f"{path!r} defines coordinate system {int(label)} as a turned, moved or curved "
                    "one (dataset 2420), and nodes are given in it: only global coordinates are "
                    "read. Export these."
                )


def _types(path: str | Path) -> list[int]:
    """Return the types of the datasets in a file."""
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        try:
            file = importlib.import_module("pyuff").UFF(str(path))
            return [int(kind) for kind in file.get_set_types()]
        except Exception as error:
            raise _damaged(path, "its datasets", error) from None


def _sets(path: str | Path, kinds: tuple[int, ...]) -> list[dict[str, Any]]:
    """Return the datasets of some kinds, as pyuff reads them."""
    with file_path(path).open("rb") as file:
        start = file.read(200)
    try:
        pyuff = importlib.import_module("pyuff")
    except ImportError:
        raise FlexplantError(
            "universal files need pyuff. Install it: pip install 'flexplant[uff]'."
        ) from None
    if start.split()[:1] != [b"-1"]:
        raise FlexplantError(
            f"{str(path)!r} is no universal file: it begins with {start[:20]!r}, not with -1."
        )
    found = []
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # NumPy's of what pyuff calls
        types = _types(path)
        file = pyuff.UFF(str(path))
        for place, kind in enumerate(types):
            if kind not in kinds:
                continue
            try:
                part = file.read_sets(place)
            except Exception as error:
                raise _damaged(path, f"dataset {place + 1} (type {kind})", error) from None
            part = part[0] if isinstance(part, list) else part
            if kind == 58:
                _check_58(part, path, place)
            found.append(part)
    return found


def _damaged(path: str | Path, what: str, error: object) -> FlexplantError:
    return FlexplantError(
        f"{str(path)!r}: {what} cannot be read ({error!s:.100}). The file is cut off or damaged: "
        "export it again."
    )


def _check_58(part: dict[str, Any], path: str | Path, place: int) -> None:
    data, x = np.asarray(part.get("data", ())), np.asarray(part.get("x", ()))
    points = _whole(part, "num_pts")
    if data.size != points or x.size != points or not points:
        raise _damaged(
            path, f"dataset {place + 1} (type 58)", f"{data.size} of {points} points are there"
        )
    if not (np.all(np.isfinite(data)) and np.all(np.isfinite(x))):
        raise _damaged(path, f"dataset {place + 1} (type 58)", "NaN or infinite numbers")


def _whole(part: dict[str, Any], name: str) -> int:
    try:
        return int(part.get(name) or 0)
    except (TypeError, ValueError):
        raise FlexplantError(
            f"dataset {part.get('type')}: {name} is {short(part.get(name))}, no whole number. The "
            "file is damaged: export it again."
        ) from None


def _channel(part: dict[str, Any], side: str) -> tuple[str, int]:
    """Return the name of a channel and the sign of its direction."""
    node, code = _whole(part, f"{side}_node"), _whole(part, f"{side}_dir")
    if 1 <= abs(code) <= 6:
        return f"{node}:{DIRECTIONS[abs(code) - 1]}", 1 if code > 0 else -1
    entity = str(part.get(f"{side}_ent_name") or "").strip().replace(".", " ")
    return (entity if entity.strip("- ") and entity != "NONE" else str(node)), 1


def _paired(
    records: list[dict[str, Any]], path: str
) -> dict[tuple[str, str], tuple[int, dict[str, Any]]]:
    pairs: dict[tuple[str, str], tuple[int, dict[str, Any]]] = {}
    doubled = []
    for part in records:
        (output, up), (name, down) = _channel(part, "rsp"), _channel(part, "ref")
        pair = (output, f"u {name}")
        if pair in pairs:
            doubled.append(" <- ".join(pair))
        pairs[pair] = (up * down, part)
    if doubled:
        raise FlexplantError(
            f"{path!r} holds {', '.join(doubled[:6])} more than once: repeated measurements are "
            "averaged, not chosen from. Export each pair once (average_frfs joins files)."
        )
    return pairs


def _sides(pairs: Iterable[tuple[str, str]]) -> tuple[list[str], list[str]]:
    def place(name: str) -> tuple[Any, ...]:
        node, _, direction = name.removeprefix("u ").partition(":")
        known = direction in DIRECTIONS
        return (0, int(node), DIRECTIONS.index(direction)) if known else (1, name)

    listed = list(pairs)
    return (
        sorted({output for output, _ in listed}, key=place),
        sorted({name for _, name in listed}, key=place),
    )


def _complete(
    pairs: Iterable[tuple[str, str]],
    outputs: list[str],
    inputs: list[str],
    what: str,
    path: str,
    remedy: str,
) -> None:
    there = set(pairs)
    missing = [f"{a} <- {b}" for a in outputs for b in inputs if (a, b) not in there]
    if missing:
        raise FlexplantError(
            f"{path!r} lacks {len(missing)} of {len(outputs) * len(inputs)} {what}: "
            f"{', '.join(missing[:8])}. Export every output for every input{remedy}."
        )


def _frequencies(records: list[dict[str, Any]], path: str) -> FloatArray:
    first = np.asarray(records[0]["x"], dtype=np.float64)
    for part in records:
        if _whole(part, "abscissa_spec_data_type") not in (0, 1, 18):
            raise FlexplantError(
                f"{path!r}: a response is not over frequency (abscissa type "
                f"{_whole(part, 'abscissa_spec_data_type')}, 18 is frequency). Export it in Hz."
            )
        own = np.asarray(part["x"], dtype=np.float64)
        step = float(np.ptp(first)) / max(first.size - 1, 1)
        if own.size != first.size or np.max(np.abs(own - first)) > 1e-3 * step:
            raise FlexplantError(
                f"{path!r}: {_channel(part, 'rsp')[0]} <- u {_channel(part, 'ref')[0]} is at other "
                f"frequencies ({own.size} from {own[0]:g} to {own[-1]:g} Hz) than "
                f"{_channel(records[0], 'rsp')[0]} <- u {_channel(records[0], 'ref')[0]} "
                f"({first.size} from {first[0]:g} to {first[-1]:g} Hz). Export all alike."
            )
    return first


def _coherence(
    records: list[dict[str, Any]],
    outputs: list[str],
    inputs: list[str],
    freq: FloatArray,
    path: str,
) -> FloatArray:
    pairs = {p: v for p, v in _paired(records, path).items() if p[0] in outputs and p[1] in inputs}
    _complete(pairs, outputs, inputs, "coherences", path, ", or pass coherence=False")
    if any(np.size(part["data"]) != freq.size for _, part in pairs.values()):
        raise FlexplantError(
            f"{path!r}: coherences are at other frequencies than the responses. Export all alike, "
            "or pass coherence=False."
        )
    rows = [[np.real(pairs[a, b][1]["data"]) for b in inputs] for a in outputs]
    # single precision goes beyond 1 by its rounding
    return np.minimum(np.array(rows, dtype=np.float64), 1.0)


def _pole(part: dict[str, Any]) -> complex:
    if _whole(part, "analysis_type") != 2:
        return complex(part["eig"])
    omega = 2 * np.pi * float(part["freq"])
    viscous, hysteretic = float(part["modal_damp_vis"]), float(part["modal_damp_his"])
    zeta = viscous or hysteretic / 2
    return complex(omega * (-zeta + 1j * np.sqrt(max(0.0, 1 - zeta**2))))


UNIVERSAL = Elsewhere(
    (".unv", ".uff"),
    "measured data: read_frf_uff, read_modes_uff, read_nodes_uff of flexplant.io",
)

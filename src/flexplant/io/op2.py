"""Modes in Nastran OUTPUT2 files: eigenvectors (OUG), generalised masses (LAMA), nodes (GEOM1)."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np

from ..errors import FlexplantError, ModelError
from ..values import FloatArray, IntArray
from .file_shapes import FileShapes, ModesFormat
from .nastran import Nodes, nodes_of
from .nastran_shapes import shapes_at
from .op2_records import Block, blocks
from .paths import damaged

#: approach (real eigenvalues) and table (eigenvectors, real numbers, mode by mode)
_APPROACH, _TABLE = 2, 7
_IDENT = 146
#: what a table of GEOM1 begins with: kind of card, words of an entry
_CARDS = {4501: ("GRID", 8), 2101: ("CORD2R", 13), 2001: ("CORD2C", 13), 2201: ("CORD2S", 13)}


def read_op2_shapes(path: Path, nodes: Path | None) -> FileShapes:
    """Return the mode shapes of an .op2 file.

    Parameters
    ----------
    path : Path
        The file (PARAM,POST,-1 or -2), of 32 or 64 bit words in either byte order.
    nodes : Path, optional
        The bulk data, where the file has no GEOM1.

    Raises
    ------
    FlexplantError
        When it is damaged, or holds no modes.
    ModelError
        When it holds several sets of modes.
    LabelError
        When a node or its coordinate system is not there.
    """
    found = list(blocks(path.read_bytes(), str(path)))
    vectors = [block for block in found if block.name.lstrip("B").startswith(("OUG", "OPHIG"))]
    sets = [(block, part) for block in vectors for part in _modes(block, str(path))]
    if not sets:
        raise FlexplantError(
            f"{str(path)!r} holds no modes: its tables are {sorted({b.name for b in found})[:12]}. "
            "Write them in a run of SOL 103 with DISPLACEMENT=ALL and PARAM,POST,-1."
        )
    if len(sets) > 1:
        listed = [f"{len(part[1])} in {block.name}" for block, part in sets]
        raise ModelError(
            f"{str(path)!r} holds several sets of modes ({', '.join(listed)}), of subcases or "
            "superelements: one structure has one. Write one subcase."
        )
    block, (numbers, eigenvalues, ids, kinds, phi) = sets[0]
    known = _nodes(found, str(path)) if nodes is None else None
    return shapes_at(
        (ids, kinds, phi),
        np.sign(eigenvalues) * np.sqrt(np.abs(eigenvalues)),
        nodes=nodes if known is None else known,
        turned=block.name.startswith("B"),
        masses=_masses(found, numbers, eigenvalues),
        path=str(path),
    )


def _modes(block: Block, path: str) -> list[Any]:
    """Return (numbers, eigenvalues, nodes, kinds, shapes) of each subcase of a table."""
    parts: dict[int, list[Any]] = {}
    for ident, data in zip(block.records[::2], block.records[1::2], strict=False):
        head, real = block.integers(ident), block.reals(ident)
        if head.size < _IDENT or head[0] // 10 != _APPROACH or head[1] != _TABLE or head[9] != 8:
            continue
        parts.setdefault(int(head[3]), []).append((int(head[4]), float(real[5]), data))
    return [_one(block, part, path) for part in parts.values()]


def _one(block: Block, part: list[Any], path: str) -> Any:
    numbers = np.array([number for number, _, _ in part])
    eigenvalues = np.array([value for _, value, _ in part])
    lengths = {len(data) for _, _, data in part}
    if len(lengths) > 1 or lengths.pop() % (8 * block.size):
        raise damaged(path, f"modes of {block.name} are at other nodes than the first")
    tables = [block.integers(data).reshape(-1, 8) for _, _, data in part]
    heads = tables[0][:, :2].astype(np.int64)
    if any(not np.array_equal(table[:, :2], tables[0][:, :2]) for table in tables[1:]):
        raise damaged(path, f"modes of {block.name} are at other nodes than the first")
    values = [block.reals(data).reshape(-1, 8)[:, 2:].astype(np.float64) for _, _, data in part]
    return numbers, eigenvalues, heads[:, 0] // 10, heads[:, 1], np.stack(values, axis=2)


def _masses(found: list[Block], numbers: IntArray, eigenvalues: FloatArray) -> FloatArray | None:
    """Return the generalised masses of the modes by a table LAMA of the same eigenvalues."""
    for block in found:
        if block.name.startswith("LAMA") and len(block.records) > 1:
            whole = block.integers(block.records[1])
            table = block.reals(block.records[1])[: whole.size // 7 * 7].reshape(-1, 7)
            order = {int(n): i for i, n in enumerate(whole[::7][: len(table)].tolist())}
            if not set(numbers.tolist()) <= set(order):
                continue
            rows = table[[order[n] for n in numbers.tolist()]].astype(np.float64)
            if np.allclose(rows[:, 2], eigenvalues, rtol=1e-5, atol=1e-30):
                return np.asarray(rows[:, 5])
    return None


def _nodes(found: list[Block], path: str) -> Nodes | None:
    """Return the nodes of the tables GEOM1, None where there are none."""
    grids: dict[int, list[Any]] = {}
    systems: dict[int, tuple[str, list[str]]] = {}
    for block in found:
        if not block.name.startswith("GEOM1"):
            continue
        for record in block.records:
            head = block.integers(record[: 3 * block.size])
            kind, count = _CARDS.get(int(head[0]) if head.size else 0, ("", 0))
            if not kind:
                continue
            body = record[3 * block.size :]
            entries = len(body) // (count * block.size) * count
            whole = block.integers(body)[:entries].reshape(-1, count).tolist()
            real = block.reals(body)[:entries].reshape(-1, count).tolist()
            for integers, numbers in zip(whole, real, strict=True):
                if kind == "GRID":
                    node, into, *_ = integers
                    grids[node] = [into, numbers[2:5], integers[5]]
                else:
                    texts = [repr(number) for number in numbers[4:]]
                    systems[integers[0]] = (kind, [str(integers[0]), str(integers[3]), *texts])
    return nodes_of(grids, systems, path) if grids else None


OUTPUT2 = ModesFormat((".op2",), read_op2_shapes)

"""Modes in Nastran OUTPUT2 files, whose data blocks are of 32 or 64 bit words in either order."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from ..checks import FloatArray, IntArray
from ..errors import FlexplantError, ModelError
from .file_shapes import FileShapes, ModesFormat
from .nastran import Nodes, basic_nodes, shapes_at
from .paths import damaged, defined_twice


@dataclass(frozen=True)
class Block:
    """A data block: its name, and its logical records as bytes without trailer and header."""

    name: str
    records: list[bytes]
    order: str
    size: int

    def integers(self, record: bytes) -> Any:
        """Return a record as whole numbers."""
        return self._words(record, "i")

    def reals(self, record: bytes) -> Any:
        """Return a record as real numbers, of the precision of its words."""
        return self._words(record, "f")

    def _words(self, record: bytes, kind: str) -> Any:
        whole = len(record) // self.size * self.size
        return np.frombuffer(record[:whole], f"{self.order}{kind}{self.size}")


def blocks(content: bytes, path: str) -> Iterator[Block]:
    """Yield the data blocks of a file.

    Format: MSC Nastran DMAP Programmer's Guide, OUTPUT2. Fortran records, of which those of one
    word are keys: above 0 as many words follow as the next record, below 0 a logical record ends,
    0 ends a data block, and once more the file. Each logical record begins with its kind.
    """
    order, size = _word_layout(content, path)
    at, pieces, records = 0, list[bytes](), list[bytes]()
    while at < len(content):
        piece, at = _record(content, at, order, path)
        if len(piece) != size:
            raise damaged(path, f"byte {at}: a key of {size} bytes is due, got {len(piece)}")
        key = int(np.frombuffer(piece, f"{order}i{size}")[0])
        if key > 0:
            piece, after = _record(content, at, order, path)
            # columns of matrices, of kind 1, count numbers of two words
            column = len(records) > 2 and pieces and any(pieces[0])
            if len(piece) != key * size and not column:
                what = f"byte {at}: a record of {len(piece)} bytes for {key} words of {size}"
                raise damaged(path, what, "Write or copy it again, in binary mode.")
            pieces.append(piece)
            at = after
        elif key < 0:
            records.append(b"".join(pieces))
            pieces = []
        else:
            # name, trailer and header, the last one and all data behind the word of their kind
            if len(records) > 2 and len(records[0]) == 2 * size:
                name = _letters(records[0], size)
                yield Block(name, [record[size:] for record in records[3:]], order, size)
            pieces, records = [], []
    if pieces or records:
        raise damaged(path, f"byte {at}: the file ends inside of a data block: cut off")


def _word_layout(content: bytes, path: str) -> tuple[str, int]:
    """Return byte order and bytes of a word: the first record is a key of one word."""
    for order, name in (("<", "little"), (">", "big")):
        size = int.from_bytes(content[:4], name)  # type: ignore[arg-type]
        if size in (4, 8):
            return order, size
    raise FlexplantError(
        f"{path!r} is no OUTPUT2 file: it begins with {content[:8].hex(' ')}, not with a record of "
        "one word. Was it changed in transfer? Copy it in binary mode."
    )


def _record(content: bytes, at: int, order: str, path: str) -> tuple[bytes, int]:
    name: Any = "little" if order == "<" else "big"
    length = int.from_bytes(content[at : at + 4], name, signed=True)
    start, stop = at + 4, at + 4 + length
    if length < 0 or stop + 4 > len(content) or content[at:start] != content[stop : stop + 4]:
        what = f"byte {at}: a record of {length} bytes does not end in a file of {len(content)}"
        raise damaged(path, what, "It is cut off, or was not copied in binary mode.")
    return content[start:stop], stop + 4


def _letters(record: bytes, size: int) -> str:
    text = record.decode("latin-1")
    # words of 8 bytes hold 4 letters each
    if size == 8 and not text[4:8].strip():
        text = text[:4] + text[8:12]
    return text.replace("\0", " ").strip()


#: approach (real eigenvalues) and table (eigenvectors, real numbers, mode by mode)
_APPROACH, _TABLE = 2, 7
_IDENT = 146
#: what a table of GEOM1 begins with: kind of card, words of an entry
_CARDS = {4501: ("GRID", 8), 2101: ("CORD2R", 13), 2001: ("CORD2C", 13), 2201: ("CORD2S", 13)}


def read_op2_shapes(path: Path, nodes: Path | None) -> FileShapes:
    """Return the mode shapes of an .op2 file."""
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
    known = _geometry_nodes(found, str(path)) if nodes is None else None
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
            # single precision; eigenvalues of free motions are exact zeros in such tables
            if np.allclose(rows[:, 2], eigenvalues, rtol=1e-5, atol=1e-30):
                return np.asarray(rows[:, 5])
    return None


def _geometry_nodes(found: list[Block], path: str) -> Nodes | None:
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
                    entry = [into, numbers[2:5], integers[5]]
                    if grids.setdefault(node, entry) != entry:  # superelements repeat their nodes
                        first, again = (f"{g[1]} of system {g[0]}" for g in (grids[node], entry))
                        what = f"{path!r}: GRID {node}"
                        raise defined_twice(what, first, again, "Write one run to it.")
                else:
                    texts = [repr(number) for number in numbers[4:]]
                    systems[integers[0]] = (kind, [str(integers[0]), str(integers[3]), *texts])
    return basic_nodes(grids, systems, path) if grids else None


OUTPUT2 = ModesFormat((".op2",), read_op2_shapes)

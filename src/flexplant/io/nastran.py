"""Nastran: positions and directions of nodes; modes of OUTPUT2 files."""

from __future__ import annotations

import re
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from ..arrays import FloatArray, IntArray
from ..dof_columns import at_nodes
from ..errors import FlexplantError, LabelError, ModelError, counted, require_known
from ..labels import DIRECTIONS, node_dofs
from .coordinate_systems import (
    BASIC,
    CARTESIAN,
    CYLINDRICAL,
    SPHERICAL,
    System,
    axes_along,
    turned_motions,
)
from .fe_modes import MODE_READERS, FileShapes
from .files import USUAL, damaged, decimal, defined_twice, file_path, refused, unread
from .tables import read_nodes_table

_KINDS = ("GRID", "GRDSET", "CORD2R", "CORD2C", "CORD2S")
_INCLUDE = re.compile(r"\s*INCLUDE\s+(?:'([^']*)'|\"([^\"]*)\"|([^\s$]+))", re.IGNORECASE)
_END = re.compile(r"\s*ENDDATA\b", re.IGNORECASE)
#: largest depth of files that include other files
_DEEP = 20
#: advice for two cards with the same number
_DEFINED_ONCE = "Remove the card that is not of this run."


@dataclass(frozen=True)
class Nodes:
    """Positions (n, 3) in the basic system, and the axes (3, 3) of each node's displacements."""

    xyz: dict[int, FloatArray]
    axes: dict[int, FloatArray]  # columns are the local axes; absent: the basic ones


def read_nodes(path: str | Path) -> Nodes:
    """Return the nodes of a Nastran bulk data file."""
    # GRID, GRDSET and CORD2R, CORD2C, CORD2S in free, small or large fields, also in files that it
    # INCLUDEs, up to ENDDATA; all other cards are passed over
    lines = _bulk_lines(file_path(path, "bdf"))
    grids: dict[int, list[str]] = {}
    systems: dict[int, tuple[str, list[str]]] = {}
    default = ["", ""]
    defined: dict[str, str] = {}
    for number, kind, fields in cards((line for _, _, line in lines), _KINDS):
        fields = fields + [""] * 12
        file, line, _ = lines[number - 1]
        try:
            key = 0 if kind == "GRDSET" else int(fields[0])
        except ValueError as error:
            raise FlexplantError(f"{file!r}, line {line}: {kind} {fields[:8]}: {error}.") from None
        what = {"GRID": f"GRID {key}", "GRDSET": kind}.get(kind, f"coordinate system {key}")
        if what in defined:
            raise defined_twice(what, defined[what], f"line {line} of {file!r}", _DEFINED_ONCE)
        defined[what] = f"line {line} of {file!r}"
        if kind == "GRID":
            grids[key] = fields
        elif kind == "GRDSET":
            default = [fields[1], fields[5]]
        else:
            systems[key] = (kind, fields)
    parsed: dict[int, list[Any]] = {}
    for node, fields in grids.items():
        try:
            place = [nastran_float(item) for item in fields[2:5]]
            into, moves = int(fields[1] or default[0] or 0), int(fields[5] or default[1] or 0)
        except ValueError as error:
            raise FlexplantError(f"{str(path)!r}, GRID {node}: {error}.") from None
        parsed[node] = [into, place, moves]
    return basic_nodes(parsed, systems, str(path))


def basic_nodes(
    grids: Mapping[int, Sequence[Any]], systems: dict[int, tuple[str, list[str]]], path: str
) -> Nodes:
    """Return nodes of (system of the place, place, system of the displacements) by number."""
    known = _Systems(systems, path)
    xyz, axes = {}, {}
    for node, (into, place, moves) in grids.items():
        point = np.array(place, dtype=np.float64)
        xyz[node] = known.system(into).position(point) if into else point
        if moves > 0:
            axes[node] = known.system(moves).axes_at(xyz[node])
    return Nodes(xyz, axes)


def _bulk_lines(path: Path, above: tuple[Path, ...] = ()) -> list[tuple[str, int, str]]:
    """Return (file, line number, text) of all lines, those of INCLUDEd files in their place."""
    # ENDDATA ends the whole input, also in an included file
    found = []
    continued = ""
    for number, line in enumerate(path.read_text(encoding="latin-1").splitlines(), 1):
        joined = continued + (line.lstrip() if continued else line)
        # the name may continue in the next lines, until its quote is closed
        continued = joined.rstrip() if _goes_on(joined) else ""
        match = None if continued else _INCLUDE.match(joined)
        if match is None:
            if not continued:
                found.append((str(path), number, joined))
            if _END.match(joined):
                break
            continue
        name = (match[1] or match[2] or match[3] or "").strip()
        # in the folder of the file that names it, or of the first one
        places = [file.parent / name for file in (path, *above[:1])]
        file = next((place for place in places if name and place.is_file()), None)
        if file is None or len(above) == _DEEP:
            why = "includes itself" if file else "is not there"
            raise FlexplantError(
                f"{str(path)!r}, line {number}: the INCLUDEd file {name!r} {why}: its nodes "
                "would be missing. Put it in the same folder, or give the file with the GRID "
                "cards."
            )
        found += _bulk_lines(file, (*above, path))
        if found and _END.match(found[-1][2]):
            break
    return found


def _goes_on(line: str) -> bool:
    quotes = line.count("'") + line.count('"')
    return line.lstrip()[:8].upper() == "INCLUDE " and quotes == 1 and len(line) < 1000


def nastran_float(text: str) -> float:
    """Return a number as Nastran writes it: 1.5, 1.5E3, 1.5D3, 1.5+3; blank is 0."""
    return decimal(text) if text.strip() else 0.0


def cards(lines: Iterable[str], kinds: tuple[str, ...]) -> Iterator[tuple[int, str, list[str]]]:
    """Yield (line number, name, fields after the name) of the cards of some kinds."""
    number, kind, fields = 0, "", list[str]()
    for at, raw in enumerate(lines, 1):
        line = raw.split("$", 1)[0].rstrip().expandtabs(8)
        if not line:
            continue
        if line[0] in "+* ,":
            if kind:
                fields += _card_fields(line)[1]
            continue
        if kind:
            yield number, kind, fields
        name, found = _card_fields(line)
        number, kind, fields = at, name if name in kinds else "", found
    if kind:
        yield number, kind, fields


def _card_fields(line: str) -> tuple[str, list[str]]:
    if "," in line:
        words = [word.strip() for word in line.split(",")]
        wide = words[0].endswith("*") or words[0].startswith("*")
        count = 4 if wide else 8
        return words[0].rstrip("*").upper(), (words[1 : 1 + count] + [""] * count)[:count]
    head = line[:8].strip().upper()
    width = 16 if "*" in head else 8
    body = line[8:72].ljust(64)
    return head.rstrip("*"), [body[i : i + width].strip() for i in range(0, 64, width)]


_POLAR = {"CORD2R": CARTESIAN, "CORD2C": CYLINDRICAL, "CORD2S": SPHERICAL}


class _Systems:
    """Coordinate systems, each defined in another one down to the basic one, 0."""

    def __init__(self, given: dict[int, tuple[str, list[str]]], path: str) -> None:
        self.given, self.path = given, path
        self.known: dict[int, System] = {0: BASIC}

    def system(self, name: int, above: tuple[int, ...] = ()) -> System:
        """Return a system in the basic one."""
        if name in self.known:
            return self.known[name]
        if name not in self.given:
            raise LabelError(
                f"{self.path!r} has no coordinate system {name} as CORD2R, CORD2C or CORD2S: nodes "
                "refer to it. Add its card (convert CORD1R and the like to CORD2R)."
            )
        if name in above:
            raise ModelError(f"{self.path!r}: coordinate system {name} refers to itself.")
        kind, fields = self.given[name]
        try:
            numbers = [nastran_float(item) for item in fields[2:11]]
            number = int(fields[1] or 0)
        except ValueError as error:
            raise FlexplantError(f"{self.path!r}, {kind} {name}: {error}.") from None
        base = self.system(number, (*above, name))
        origin, on_z, in_xz = (base.position(np.array(numbers[i : i + 3])) for i in (0, 3, 6))
        axes = axes_along(on_z - origin, in_xz - origin)  # z, x, y
        if axes is None:
            raise ModelError(
                f"{self.path!r}: the three points of {kind} {name} lie on a line, which gives no "
                "axes. Correct the card."
            )
        self.known[name] = System(_POLAR[kind], origin, axes[:, [1, 2, 0]])
        return self.known[name]


_LETTERS = {"stiffness": "K", "mass": "M", "damping": "B"}


def named_matrices(
    found: Mapping[str, Any], given: Mapping[str, str | None], endings: Sequence[str], path: str
) -> list[str | None]:
    """Return the names of stiffness, mass and damping; None for missing mass or damping."""
    names: list[str | None] = []
    for what, said in given.items():
        if what == "damping" and said is None:
            names.append(None)
            continue
        name = None if said == USUAL else said
        require_known("matrix", () if name is None else (name,), found, repr(path))
        usual = [_LETTERS[what] + ending for ending in endings]
        there = [name]
        if name is None:  # a name that the file holds several times has _2, _3 behind it
            there = [one for one in usual if one in found]
            there = [one for one in found if one in there or re.sub(r"_\d+$", "", one) in there]
        if len(there) > 1:
            raise ModelError(
                f"{path!r} holds {there}, any of which may be the {what}. Name one: "
                f"{what}={there[0]!r}."
            )
        if not there and what == "stiffness":
            raise ModelError(
                f"{path!r} holds {sorted(found)}, but no usual name of a stiffness matrix "
                f"({', '.join(usual)}). Name it: stiffness='...'."
            )
        names.append(there[0] if there else None)
    return names


_BULK = (".bdf", ".dat", ".nas", ".blk")


def shapes_at(
    table: tuple[Any, Any, Any],
    omega: FloatArray,
    *,
    nodes: Nodes | Path | None,
    turned: bool,
    masses: FloatArray | None,
    path: str,
) -> FileShapes:
    """Return the FileShapes of eigenvectors."""
    ids, kinds, values = table
    grid = kinds == 1
    notes: tuple[str, ...] = ()
    if not grid.all():
        scalar = counted(int(np.count_nonzero(~grid)), "scalar point")
        notes = (f"without a position, left out: {scalar}",)
    ids, values = ids[grid], values[grid]
    xyz, axes = _node_places(ids, nodes, path)
    local = np.intersect1d(ids, list(axes)) if not turned else ids[:0]
    if local.size:
        values = turned_motions(values, ids.tolist(), axes)
        moved = counted(local.size, "node")
        notes = (*notes, f"{moved} moved in local directions: turned into the basic ones")
    dofs = node_dofs(ids, DIRECTIONS, xyz)
    phi = values.reshape(6 * ids.size, omega.size)
    return FileShapes(omega, phi, dofs, masses=masses, notes=notes)


def _node_places(ids: Any, nodes: Nodes | Path | None, path: str) -> tuple[FloatArray, Any]:
    if isinstance(nodes, Path):
        if not nodes.name.lower().endswith(_BULK):
            known, xyz = read_nodes_table(nodes)
            return at_nodes(ids, known, xyz, str(nodes)), {}
        nodes = read_nodes(nodes)
    missing = [node for node in ids.tolist() if nodes is None or node not in nodes.xyz]
    if nodes is None or missing:
        raise LabelError(
            f"{path!r} does not say where {len(missing)} of its nodes are, the first "
            f"{missing[:6]}, nor in which directions they move. Give the bulk data: nodes=."
        )
    return np.array([nodes.xyz[node] for node in ids.tolist()]).reshape(-1, 3), nodes.axes


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
    """Yield the data blocks of a file."""
    # format: MSC Nastran DMAP Programmer's Guide, OUTPUT2. The file consists of Fortran records. A
    # record of one word is a key: above 0 it is the number of words of the next record, below 0 it
    # ends a logical record, 0 ends a data block, and a second 0 ends the file. Each logical record
    # begins with its kind
    order, size = _word_layout(content, path)
    at, pieces, records = 0, list[bytes](), list[bytes]()
    while at < len(content):
        piece, at = _record(content, at, order, path)
        if len(piece) != size:
            raise damaged(path, f"byte {at}: a key of {size} bytes is due, got {len(piece)}")
        key = int(np.frombuffer(piece, f"{order}i{size}")[0])
        if key > 0:
            piece, after = _record(content, at, order, path)
            # keys of matrix columns (kind 1) count numbers, which may have two words each
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
            # the first records are name, trailer and header; data follow, after a word for the kind
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
        f"{path!r} is not an OUTPUT2 file: it begins with {content[:8].hex(' ')}, not with a "
        "record of "
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


#: codes of the approach (real eigenvalues) and of the table (real eigenvectors, mode by mode)
_APPROACH, _TABLE = 2, 7
_IDENT = 146  # number of words of the record before the numbers
#: cards of nodes and of coordinate systems in GEOM1. A record begins with three words: the first is
#: the key of this table, the second is a hundredth of the first, and `_THIRD` holds the third
_NUMBERED = {4501: "GRID", 2101: "CORD2R", 2001: "CORD2C", 2201: "CORD2S"}
_THIRD = {"GRID": 1, "CORD2R": 8, "CORD2C": 9, "CORD2S": 10}
#: number that is added to the third word if real numbers have 8 bytes
_DOUBLE = {kind: 1_120_000 if kind == "GRID" else 2_220_000 for kind in _THIRD}
#: card by its three words, and number of bytes of its real numbers (None: as a word of the file)
_CARDS = {
    (first, first // 100, _THIRD[kind] + more): (kind, size)
    for first, kind in _NUMBERED.items()
    for more, size in ((0, None), (_DOUBLE[kind], 8))
}


def read_op2_shapes(path: Path, nodes: Path | None) -> FileShapes:
    """Return the mode shapes of an .op2 file."""
    found = list(blocks(path.read_bytes(), str(path)))
    vectors = [block for block in found if block.name.lstrip("B").startswith(("OUG", "OPHIG"))]
    sets = [(block, part) for block in vectors for part in _modes(block, str(path))]
    if not sets:
        do = "Write them in a run of SOL 103 with DISPLACEMENT=ALL and PARAM,POST,-1."
        raise refused(path, _instead_of_modes(found, vectors), do)
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


#: kind of results by its code in the record before the numbers
_APPROACHES = {
    1: "static displacements",
    5: "frequency responses",
    6: "transient responses",
    7: "displacements before buckling",
    8: "shapes of buckling",
    9: "complex mode shapes",
    10: "nonlinear static displacements",
}


def _instead_of_modes(found: list[Block], vectors: list[Block]) -> str:
    """Return what a file without real normal modes holds."""
    heads = [block.integers(ident)[:10] for block in vectors for ident in block.records[::2]]
    heads = [head for head in heads if head.size == 10]
    kinds = {int(head[0]) // 10 for head in heads}
    if named := [name for kind, name in _APPROACHES.items() if kind in kinds]:
        return f"holds {' and '.join(named)}, no real normal modes"
    if heads:
        form = {(int(head[1]), int(head[9])) for head in heads}
        return f"holds modes in a form that is not read (table code, words a node: {sorted(form)})"
    if found:
        return f"holds no modes: its tables are {sorted({block.name for block in found})[:12]}"
    return (
        "holds no table that is known here: it was written by another program than MSC or NX "
        "Nastran, or in another form than that of PARAM,POST,-1"
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
    """Return the nodes of the tables GEOM1, None without these tables."""
    grids: dict[int, list[Any]] = {}
    systems: dict[int, tuple[str, list[str]]] = {}
    records = [(block, record) for block in found for record in block.records]
    for block, record in records:
        if not block.name.startswith("GEOM1"):
            continue
        kind, entries = _card_entries(block, record, path)
        if kind != "GRID":
            for number, base, points in entries:
                systems[number] = (kind, [str(number), str(base), *map(repr, points)])
            continue
        for node, into, place, moves in entries:
            entry = [into, place, moves]
            if grids.setdefault(node, entry) != entry:  # superelements repeat their nodes
                first, again = (f"{g[1]} of system {g[0]}" for g in (grids[node], entry))
                raise defined_twice(f"{path!r}: GRID {node}", first, again, "Write one run to it.")
    return basic_nodes(grids, systems, path) if grids else None


def _card_entries(block: Block, record: bytes, path: str) -> tuple[str, list[Any]]:
    """Return the kind of card of a record of GEOM1 and its entries; of other cards no entries."""
    key = tuple(block.integers(record[: 3 * block.size]).tolist())
    if not key or key[0] not in _NUMBERED:
        return "", []
    kind, wide = _CARDS.get(key, ("", None))
    if not kind or wide == block.size:
        what = f"holds {_NUMBERED[key[0]]} cards with the key {key} in words of {block.size} bytes"
        do = "Give the bulk data of the run: nodes='run.bdf'."
        raise unread(path, f"{what}, whose layout is not known here", do)
    whole, real = f"{block.order}i{block.size}", f"{block.order}f{wide or block.size}"
    if kind == "GRID":
        fields = [("node", whole), ("into", whole), ("place", real, 3), ("moves", whole)]
        fields += [("held", whole), ("superelement", whole)]
        read = ["node", "into", "place", "moves"]
    else:
        fields = [("number", whole), ("kind", whole, 2), ("base", whole), ("points", real, 9)]
        read = ["number", "base", "points"]
    layout = np.dtype(fields)
    body = record[3 * block.size :]
    if len(body) % layout.itemsize:
        due = f"{kind} cards of {layout.itemsize} bytes in a record of {len(body)}"
        raise damaged(path, f"{block.name}: {due}")
    table = np.frombuffer(body, layout)
    return kind, list(zip(*(table[name].tolist() for name in read), strict=True))


MODE_READERS[".op2"] = read_op2_shapes

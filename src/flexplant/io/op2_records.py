"""The data blocks of Nastran OUTPUT2 files, in 32 or 64 bit words of either byte order."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any

import numpy as np

from ..errors import FlexplantError
from .paths import damaged


@dataclass(frozen=True)
class Block:
    """A data block: its name, and its logical records as bytes, the name, trailer and header out.

    Parameters
    ----------
    name : str
        Such as OUGV1, LAMA or GEOM1.
    records : list of bytes
        The data.
    order : {"<", ">"}
        Byte order.
    size : {4, 8}
        Bytes of a word, integer or real.
    """

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

    Parameters
    ----------
    content : bytes
        The file.
    path : str
        Its name, for messages.

    Raises
    ------
    FlexplantError
        When it is no OUTPUT2 file, cut off or damaged; the byte is named.

    Notes
    -----
    Format: MSC Nastran DMAP Programmer's Guide, OUTPUT2. Fortran records, of which those of one
    word are keys: above 0 as many words follow as the next record, below 0 a logical record ends,
    0 ends a data block, and once more the file. Each logical record begins with its kind.
    """
    order, size = _layout(content, path)
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


def _layout(content: bytes, path: str) -> tuple[str, int]:
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

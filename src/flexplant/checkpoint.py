"""Results in a file, a line for each: what is written is never computed again."""

from __future__ import annotations

import hashlib
import json
import os
import pickle
from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import Any

from .errors import ModelError


class Checkpoint:
    """A file of JSON lines: what the work is, then ``[number, result]`` of each item.

    Each line is written at once and reaches the disk before the next item is counted; a line
    that was cut off is dropped and its item computed again.

    Parameters
    ----------
    path : Path or None
        The file; None keeps nothing.
    kind : str
        What the work is called: "study", say.
    header : mapping
        What must be the same for the work to go on: a fingerprint, sizes, the entropy of seeds.
    free : iterable of str
        Entries of the header that are taken from the file instead.

    Raises
    ------
    ModelError
        When the file is of other work, or no such file.
    """

    def __init__(
        self,
        path: str | Path | None,
        kind: str,
        header: Mapping[str, Any],
        free: Iterable[str] = (),
    ) -> None:
        if not isinstance(path, str | Path | None):
            raise ModelError(f"a checkpoint is a path, got {path!r:.80}. Pass 'search.jsonl', say.")
        self.path = None if path is None else Path(path)
        self.header = {"kind": f"flexplant {kind}", **header}
        self.rows: dict[int, Any] = {}
        if self.path is None:
            return
        if not self.path.parent.is_dir():
            raise ModelError(
                f"the folder {self.path.parent} of the checkpoint does not exist, so that nothing "
                "could be kept. Make it, or give another path."
            )
        if self.path.exists() and self.path.stat().st_size:
            self._resume(self.path, kind, set(free))
        else:
            _append(self.path, self.header)

    def add(self, number: int, result: Any) -> None:
        """Keep what came out for an item."""
        self.rows[number] = result
        if self.path is not None:
            _append(self.path, [number, result])

    def _resume(self, path: Path, kind: str, free: set[str]) -> None:
        content = path.read_bytes()
        whole = content.rfind(b"\n") + 1
        lines = content[:whole].splitlines()
        try:
            found = json.loads(lines[0])
            known = isinstance(found, dict) and found.get("kind") == self.header["kind"]
            entries = [json.loads(line) for line in lines[1:]]
        except (ValueError, IndexError):
            known = False
        if not known:
            raise ModelError(
                f"{path} is not the checkpoint of a {kind}: nothing is written to it. Name a "
                f"file that does not exist, or one that a {kind} wrote."
            )
        other = [
            name
            for name, value in self.header.items()
            if (found.get(name) is None) != (value is None)
            or (name not in free and found[name] != value)
        ]
        if other:
            raise ModelError(
                f"{path} is the checkpoint of another {kind}: what differs is "
                f"{', '.join(other)}. Give another file, or delete this one."
            )
        self.header = found
        self.rows = {int(number): row for number, row in entries}
        if whole < len(content):  # a line that was cut off
            with path.open("r+b") as file:
                file.truncate(whole)


def fingerprint(items: Iterable[Any]) -> str:
    """Return a digest of what can be pickled, and of the names of what cannot."""
    digest = hashlib.sha256()
    for item in items:
        try:
            content = pickle.dumps(item, protocol=5)
        except (pickle.PicklingError, AttributeError, TypeError):  # a function made on the spot
            content = str(getattr(item, "__qualname__", type(item).__qualname__)).encode()
        digest.update(hashlib.sha256(content).digest())
    return digest.hexdigest()


def _append(path: Path, entry: Any) -> None:
    with path.open("ab") as file:
        file.write(json.dumps(entry, default=lambda value: value.tolist()).encode() + b"\n")
        file.flush()
        os.fsync(file.fileno())

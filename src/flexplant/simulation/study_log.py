"""The rows of a study in a file, a line for each machine: what is written is never done again."""

from __future__ import annotations

import hashlib
import json
import os
import pickle
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any

from ..errors import ModelError

_KIND = "flexplant study"


class StudyLog:
    """A file of JSON lines: what the study is, then ``[number, row or reason]`` of each machine.

    Each line is written at once and reaches the disk before the next machine is counted; a line
    that was cut off is dropped and its machine computed again.

    Parameters
    ----------
    path : Path or None
        The file; None keeps nothing.
    machines : sequence
        The machines, of which a fingerprint goes into the file.
    pipeline : callable
        As well.
    entropy : int, list of int or None
        Of the seeds; None when chance does not enter.
    fixed : bool
        Whether the caller chose the entropy; otherwise that of the file is taken.

    Raises
    ------
    ModelError
        When the file is of another study, or no such file.
    """

    def __init__(
        self,
        path: Path | None,
        machines: Sequence[Any],
        pipeline: Callable[..., Any],
        entropy: Any,
        fixed: bool,
    ) -> None:
        self.path, self.entropy = path, entropy
        self.rows: dict[int, Mapping[str, Any] | str] = {}
        if path is None:
            return
        header = {
            "kind": _KIND,
            "machines": len(machines),
            "fingerprint": _fingerprint(machines, pipeline),
            "entropy": entropy,
        }
        if path.exists() and path.stat().st_size:
            self._resume(path, header, fixed)
        else:
            _append(path, header)

    def add(self, number: int, row: Mapping[str, Any] | str) -> None:
        """Keep what came out for a machine."""
        self.rows[number] = row
        if self.path is not None:
            _append(self.path, [number, row])

    def _resume(self, path: Path, header: Mapping[str, Any], fixed: bool) -> None:
        content = path.read_bytes()
        whole = content.rfind(b"\n") + 1
        lines = content[:whole].splitlines()
        try:
            found = json.loads(lines[0])
            known = isinstance(found, dict) and found.get("kind") == _KIND
            entries = [json.loads(line) for line in lines[1:]]
        except (ValueError, IndexError):
            known = False
        if not known:
            raise ModelError(
                f"{path} is not the checkpoint of a study: nothing is written to it. Name a "
                "file that does not exist, or one that a study wrote."
            )
        names = ("machines", "fingerprint", *(("entropy",) if fixed else ()))
        other = [name for name in names if found[name] != header[name]]
        if other or (found["entropy"] is None) != (header["entropy"] is None):
            raise ModelError(
                f"{path} is the checkpoint of another study (machines, pipeline or rng "
                f"differ: {', '.join(other) or 'rng'}). Give another file, or delete this one."
            )
        self.entropy = found["entropy"]
        self.rows = {int(number): row for number, row in entries}
        if whole < len(content):  # a line that was cut off
            with path.open("r+b") as file:
                file.truncate(whole)


def _append(path: Path, entry: Any) -> None:
    with path.open("ab") as file:
        file.write(json.dumps(entry).encode() + b"\n")
        file.flush()
        os.fsync(file.fileno())


def _fingerprint(machines: Sequence[Any], pipeline: Callable[..., Any]) -> str:
    digest = hashlib.sha256()
    for item in (pipeline, *machines):
        try:
            content = pickle.dumps(item, protocol=5)
        except (pickle.PicklingError, AttributeError, TypeError):  # a function made on the spot
            content = str(getattr(item, "__qualname__", type(item).__qualname__)).encode()
        digest.update(hashlib.sha256(content).digest())
    return digest.hexdigest()

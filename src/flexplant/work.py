"""Means of long work: an executor, a progress bar, and a file from which it can continue."""

from __future__ import annotations

import json
import os
import re
import sys
import zlib
from collections.abc import Callable, Iterable, Mapping
from concurrent.futures import Executor
from contextlib import suppress
from pathlib import Path
from typing import IO, Any, Self, TypeVar

import numpy as np

from .arrays import Rng, seed_sequence
from .errors import FlexplantError, ModelError
from .parallel import mapped

Item = TypeVar("Item")
Result = TypeVar("Result")


class Work:
    """Steps of long work; each is `mapped` on the executor, except for results in a file.

    As a context it closes the file.

    The same steps come in the same order when the work is begun again, so that results are known
    by their number.
    """

    def __init__(
        self,
        executor: Executor | None = None,
        progress: bool | None = None,
        rng: Rng = None,
        checkpoint: str | Path | None = None,
        kind: str = "work",
        header: Mapping[str, Any] | None = None,
    ) -> None:
        self.executor, self.progress = executor, progress
        source = seed_sequence(rng)
        seeds = [source.entropy, list(source.spawn_key)]
        free = ("rng",) if rng is None or isinstance(rng, np.random.Generator) else ()
        self._log = Checkpoint(checkpoint, kind, {**(header or {}), "rng": seeds}, free)
        self._done = 0

    @property
    def rng(self) -> np.random.SeedSequence:
        """The SeedSequence of random draws."""
        entropy, key = self._log.header["rng"]
        return np.random.SeedSequence(entropy, spawn_key=tuple(key))

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self._log.close()

    def mapped(
        self,
        function: Callable[..., Result],
        items: Iterable[Item],
        *,
        rng: Rng = None,
        description: str = "items",
        advice: str = "",
        progress: bool | None = None,
        restored: Callable[[Any], Result] | None = None,
    ) -> list[Result]:
        """Return ``[function(item) for item in items]``, without those that the file has."""
        listed = list(items)
        first, self._done = self._done, self._done + len(listed)
        rows, back = self._log.rows, restored or (lambda row: row)
        known = {i: back(rows[first + i]) for i in range(len(listed)) if first + i in rows}
        return mapped(
            function,
            listed,
            executor=self.executor,
            progress=self.progress if progress is None else progress,
            rng=rng,
            description=description,
            advice=advice,
            known=known,
            each=lambda i, result: self._log.add(first + i, result),
        )


#: files that this process has locked: a lock of the system holds between processes only
_locked: set[tuple[int, int]] = set()
#: where a result begins, in a line that was cut or joined with the next
_BEGIN = re.compile(r"\[\d+, ")
#: the byte that Windows locks, far behind the end: locked bytes cannot be read there
_FAR = 2**40


class Checkpoint:
    """A file of JSON lines: a description of the work, then ``[number, result, sum]`` of each item.

    Each line is written at once and reaches the disk before the next item is counted. If a file was
    damaged, all results with a correct check sum are used, and the others are computed again. As a
    context manager it closes the file. Only one process at a time can write to it.
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
        version = sys.modules["flexplant"].__version__
        self.header = {"kind": f"flexplant {kind}", "flexplant": version, **header}
        self.rows: dict[int, Any] = {}
        self._file: IO[bytes] | None = None
        self._key: tuple[int, int] | None = None
        if self.path is None:
            return
        if not self.path.parent.is_dir():
            raise ModelError(
                f"the folder {self.path.parent} of the checkpoint does not exist, so that nothing "
                "could be kept. Make it, or give another path."
            )
        try:
            self._file = self.path.open("a+b")
        except OSError as error:
            raise self._failed("opened for writing", error) from error
        try:
            self._lock(self._file)
            self._resume(self._file, kind, set(free))
        except BaseException:
            self.close()
            raise

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def close(self) -> None:
        """Close the file, which ends its lock."""
        if self._file is not None:
            with suppress(OSError):  # each line was already written and flushed
                self._file.close()
        if self._key is not None:
            _locked.discard(self._key)
        self._file = self._key = None

    def add(self, number: int, result: Any) -> None:
        """Store the result of an item."""
        self.rows[number] = result
        if self._file is not None:
            text = _dumped([number, result])
            self._append(self._file, f"{text[:-1]}, {_crc(text)}]\n".encode())

    def _resume(self, file: IO[bytes], kind: str, free: set[str]) -> None:
        """Take what the file has; write the header where there is nothing."""
        file.seek(0)
        content = file.read()
        first, *lines = content.split(b"\n")
        start = _dumped(self.header).partition(",")[0].encode()
        if not lines and (first[: len(start)] == start[: len(first)] or not first.strip(b"\0")):
            file.truncate(0)  # empty, or its first line was cut
            self._append(file, _dumped(self.header).encode() + b"\n")
            return
        try:
            found = json.loads(first)
        except ValueError:
            found = None
        if not isinstance(found, dict) or found.get("kind") != self.header["kind"]:
            raise ModelError(
                f"{self.path} is not the checkpoint of a {kind}: nothing is written to it. Name a "
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
                f"{self.path} is the checkpoint of another {kind}: what differs is "
                f"{', '.join(other)}. Values count by content. Give another file, or delete this "
                "one."
            )
        self.header = found
        for line in lines:
            self.rows.update(_parsed_results(line.decode(errors="replace")))
        if lines[-1]:  # cut off: appended results start on a new line
            self._append(file, b"\n")

    def _append(self, file: IO[bytes], line: bytes) -> None:
        try:
            file.write(line)
            file.flush()
            os.fsync(file.fileno())
        except OSError as error:
            raise self._failed("written", error) from error

    def _failed(self, done: str, error: OSError) -> FlexplantError:
        return FlexplantError(
            f"the checkpoint {self.path} cannot be {done} ({error.strerror or error}): results "
            "would be lost. What it has is kept: make room or give the right to write, and "
            "begin again with the same file."
        )

    def _lock(self, file: IO[bytes]) -> None:
        """Lock the file for this process, until it is closed or the process ends."""
        status = os.fstat(file.fileno())
        key = status.st_dev, status.st_ino
        if key in _locked or not _is_locked_now(file):
            raise FlexplantError(
                f"other work writes to the checkpoint {self.path} now: results of both would be "
                "mixed. Wait until it ends, or give another file."
            )
        _locked.add(key)
        self._key = key


def _is_locked_now(file: IO[bytes]) -> bool:
    """Lock a file and return True; False when another process has locked it."""
    try:
        if sys.platform == "win32":
            import msvcrt

            file.seek(_FAR)
            msvcrt.locking(file.fileno(), msvcrt.LK_NBLCK, 1)
        else:
            import fcntl

            fcntl.lockf(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except (BlockingIOError, PermissionError):
        return False
    except OSError:  # a file system without locks
        return True
    return True


def _parsed_results(line: str) -> dict[int, Any]:
    """Return the results of a line whose check sums are right, wherever they begin in it."""
    found: dict[int, Any] = {}
    at = 0
    while (begin := _BEGIN.search(line, at)) is not None:
        at = begin.start() + 1
        try:
            entry, end = json.JSONDecoder().raw_decode(line, begin.start())
        except ValueError:
            continue
        if len(entry) == 3 and isinstance(entry[0], int) and entry[2] == _crc(_dumped(entry[:2])):
            found[entry[0]] = entry[1]
            at = end
    return found


def _dumped(entry: Any) -> str:
    return json.dumps(entry, default=lambda value: value.tolist())


def _crc(text: str) -> int:
    return zlib.crc32(text.encode())

"""Reads with the parsers of other packages in a process of its own, so that ours survives."""

from __future__ import annotations

import atexit
import os
import pickle
import subprocess
import sys
from pathlib import Path
from typing import Any

from . import foreign_parsers
from .files import file_path

#: children that wait for the next file, by the process that started them and their package
_WAITING: dict[tuple[int, str], subprocess.Popen[bytes]] = {}


def in_child(function: str, path: str | Path, *, keep: str = "") -> tuple[str, Any]:
    """Return ("value", value) of one of `foreign_parsers`, or the name and the text of its error.

    A damaged file may make a parser crash, take all memory or never end: in a process of its own,
    with bounds, that is an error like any other. Where there is no Python to start (a frozen or
    embedded program), the function is run here.
    """
    file = file_path(path)
    if not file.is_file():
        raise FileNotFoundError(f"no such file: {str(file)!r}")
    key = (os.getpid(), keep)
    # taken out while it is used: another thread starts its own
    child = _WAITING.pop(key, None)
    if child is not None and child.poll() is not None:
        _close(child)
        child = None
    child = child or _start_child()
    if child is None:
        return foreign_parsers.run(function, str(file))
    assert child.stdin is not None and child.stdout is not None  # noqa: S101 - both are pipes
    try:
        pickle.dump(([*sys.path], function, str(file.absolute())), child.stdin)
        child.stdin.flush()
        outcome: tuple[str, Any] = pickle.load(child.stdout)
    except (OSError, EOFError, pickle.UnpicklingError):
        _close(child)
        return "crash", f"its parser ended with code {child.returncode}"
    except BaseException:  # interrupted: the answer would be that of the next file
        child.kill()
        _close(child)
        raise
    old = _WAITING.pop(key, None) if keep else child
    if keep:
        _WAITING[key] = child
    if old is not None:
        _close(old)
    return outcome


def _start_child() -> subprocess.Popen[bytes] | None:
    """Return a new child; None where there is no Python interpreter to start."""
    if "python" not in Path(sys.executable or "").name.lower():
        return None
    # -P: the folder of the script, whose modules have names of the standard library, stays out
    command = [sys.executable, "-P", foreign_parsers.__file__]
    threads = {"OPENBLAS_NUM_THREADS": "1", "OMP_NUM_THREADS": "1"}
    pipe, nothing = subprocess.PIPE, subprocess.DEVNULL
    environment = os.environ | threads
    try:
        return subprocess.Popen(command, stdin=pipe, stdout=pipe, stderr=nothing, env=environment)
    except OSError:
        return None


def _close(child: subprocess.Popen[bytes]) -> None:
    """End a child that has nothing to do: it ends when its input does."""
    for pipe in (child.stdin, child.stdout):
        try:
            if pipe is not None:
                pipe.close()
        except OSError:
            continue
    child.wait()


@atexit.register
def _close_all() -> None:
    for (process, _), child in _WAITING.items():
        if process == os.getpid():
            _close(child)

"""How the files of one program are known and read: a value beside each reader."""

from __future__ import annotations

import inspect
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

from ..structure import FEMatrices

#: stands for the matrix that has a usual name, where one is there
USUAL = "usual"
#: this many bytes at the beginning of a file must show its format
HEAD = 20000


@dataclass(frozen=True)
class Format:
    """Files that hold matrices, and their reader."""

    suffixes: tuple[str, ...]
    read: Callable[..., FEMatrices]
    begins: Callable[[bytes], bool] = lambda head: False
    mesh: tuple[str, ...] = ()
    mesh_option: str = ""

    @property
    def options(self) -> tuple[str, ...]:
        """What the reader takes beside the file, `nodes` for a mesh."""
        taken = tuple(inspect.signature(self.read).parameters)[1:]
        return tuple("nodes" if name == self.mesh_option else name for name in taken)

    @property
    def several(self) -> bool:
        """Whether its files hold several matrices, of which those with usual names are taken."""
        damping = inspect.signature(self.read).parameters.get("damping")
        return damping is not None and damping.default == USUAL


@dataclass(frozen=True)
class Elsewhere:
    """Files without matrices, and what to do with them."""

    suffixes: tuple[str, ...]
    reader: str
    begins: Callable[[bytes], bool] = lambda head: True


def is_text(head: bytes) -> bool:
    """Return whether a file begins as text."""
    return bool(head) and not head.translate(None, delete=bytes(range(32, 256)) + b"\t\r\n\f")


def ends(path: Path, suffixes: tuple[str, ...]) -> bool:
    """Return whether the name of a file has one of the suffixes."""
    return path.name.lower().endswith(suffixes)

"""How the files of one program are known and read: a value beside each reader."""

from __future__ import annotations

import inspect
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

from ..structure import FEMatrices

#: this many bytes at the beginning of a file must show its format
HEAD = 20000


@dataclass(frozen=True)
class Format:
    """Files that hold matrices, and their reader.

    Parameters
    ----------
    suffixes : tuple of str
        Endings of their names, in lower case.
    read : callable
        The reader: the file, then options by name, to FEMatrices.
    begins : callable, optional
        Decides from the first `HEAD` bytes, in lower case: what a file says of itself goes before
        its name.
    mesh : tuple of str
        Endings of the files that hold the nodes of such matrices.
    mesh_option : str
        What the reader calls such a file.
    """

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


@dataclass(frozen=True)
class Elsewhere:
    """Files without matrices, and who reads them."""

    suffixes: tuple[str, ...]
    reader: str


def ends(path: Path, suffixes: tuple[str, ...]) -> bool:
    """Return whether the name of a file has one of the suffixes."""
    return path.name.lower().endswith(suffixes)

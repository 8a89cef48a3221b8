"""What names a file, and what is said of a damaged one."""

from __future__ import annotations

import inspect
from collections.abc import Callable, Iterable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from ..checks import several, short
from ..errors import FlexplantError, ModelError
from ..structure import FEMatrices
from .numbers import cut_short

#: what to do with a file that says a thing twice, and one in axes of its own
ONCE = "Export each once (one result set)."
GLOBAL = "Only global coordinates and directions are read: export these."


def file_path(path: Any, name: str = "path") -> Path:
    """Return the path of a file; its absence is left to what opens it."""
    if not isinstance(path, str | Path):
        raise FlexplantError(
            f"{name} must name a file, got {short(path)}. Pass matrices that are in memory already "
            "to FEModel(M, K, dofs=...) or FEMatrices(K, M, dofs=...)."
        )
    if Path(path).is_dir():
        raise FlexplantError(f"{str(path)!r} is a folder. Name the file in it.")
    return Path(path)


def damaged(path: object, what: object, do: str = "Write it again.") -> FlexplantError:
    """Return the error of a file that is not what its format says; `what` is cut to 200 letters."""
    return FlexplantError(f"{str(path)!r}, {what!s:.200}: the file is damaged or cut off. {do}")


def wrong_line_of(
    path: object, number: int, due: str, line: str | bytes, do: str = "Write it again."
) -> FlexplantError:
    """Return the error of a line, counted from 1, that does not hold what is due there."""
    got = line.decode("latin-1") if isinstance(line, bytes) else line
    return FlexplantError(
        f"{str(path)!r}, line {number}: {due} due, got {got.strip()[:72]!r}. {do}"
    )


def defined_twice(what: str, first: str, again: str, do: str) -> FlexplantError:
    """Return the error of an identifier with two definitions, both of which are named."""
    return FlexplantError(
        f"{what} is defined twice, in {first} and in {again}: which of the two the numbers belong "
        f"to is not known. {do}"
    )


def refused(path: object, what: str, do: str) -> FlexplantError:
    """Return the error of a file that holds another thing than what is read of it."""
    return FlexplantError(f"{str(path)!r} {what}. {do}")


def unread(path: object, what: str, do: str) -> ModelError:
    """Return the error of a file that holds what is no M, D, K or shape of a structure."""
    return ModelError(f"{str(path)!r} {what}. {do}")


def at_zero(path: object, kind: str, target: str) -> ModelError:
    """Return the error of responses at 0 Hz that were to be integrated."""
    what = f"holds {kind} at zero frequency, which cannot be integrated to {target}"
    return unread(path, what, f"Read it as {kind}, or export from above zero.")


def no_motion(path: object, kinds: object) -> ModelError:
    """Return the error of a file with DOFs that are no displacement or rotation."""
    what = (
        f"has DOFs that are no displacement or rotation ({kinds}): temperature, pressure, voltage"
    )
    return unread(path, f"{what}, warping or a multiplier", "Export the structural part alone.")


def three_units(units: Any) -> tuple[Any, ...]:
    """Return the units of length, mass and time."""
    sizes = tuple(units) if several(units) else ()
    if len(sizes) != 3:
        raise ModelError(
            f"units must be three, of length, mass and time, got {short(units)}: "
            "give ('mm', 't', 's') for instance."
        )
    return sizes


def check_whole(content: bytes, words: Iterable[bytes], path: object) -> None:
    """Refuse a text that ends, without a line end, in a number shorter than all others."""
    if cut_short(content, words):
        raise damaged(path, "the last number is shorter than all others")


@contextmanager
def parsing(path: object, do: str = "Write it again.") -> Iterator[None]:
    """Turn whatever a parser of another package raises into the error of a damaged file."""
    try:
        yield
    except FlexplantError:
        raise
    except Exception as error:  # its bytes lead anywhere
        raise damaged(path, f"{type(error).__name__}: {error}", do) from None


def check_count(size: int, held: int, path: object) -> None:
    """Refuse a number of rows or columns that a damaged count has made."""
    if size > max(2**20, held):
        raise damaged(path, f"a matrix of {size} rows or columns in {held} bytes")


def text_of(path: Path, encoding: str = "utf-8-sig") -> str:
    """Return the text of a file."""
    try:
        return path.read_text(encoding=encoding)
    except UnicodeDecodeError as error:
        what = f"byte {error.start} is no text of UTF-8"
        raise damaged(path, what, "Is it another format? Save it as plain text, UTF-8.") from None


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


#: what each reader's module registers: its files, and those without matrices beside them
FORMATS: list[Format] = []
ELSEWHERE: list[Elsewhere] = []


def is_text(head: bytes) -> bool:
    """Return whether a file begins as text."""
    return bool(head) and not head.translate(None, delete=bytes(range(32, 256)) + b"\t\r\n\f")


def ends(path: Path, suffixes: tuple[str, ...]) -> bool:
    """Return whether the name of a file has one of the suffixes."""
    return path.name.lower().endswith(suffixes)

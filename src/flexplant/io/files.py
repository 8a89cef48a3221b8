"""Common functions for files: paths, numbers in Fortran text, errors for damaged files."""

from __future__ import annotations

import inspect
import re
import warnings
from collections.abc import Callable, Iterable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from ..arrays import FloatArray, several
from ..errors import FlexplantError, ModelError, short
from ..structure import FEMatrices
from ..structure.definite import EVERY_DIGIT

#: least number of characters of a number printed by a program; shorter ones may be typed by hand
_PRINTED = 12
#: least number of digits of a rounded number; a number with fewer digits may be exact
_ROUNDED = 6
#: number of digits that a number in a fixed field loses to its sign and to a longer exponent
_FIELD = 2
#: a number with this number of digits shows double precision, even if all others are shorter
_DOUBLE = np.finfo(np.float64).precision
#: an exponent without the letter E or D: 1.5-100, 3.+7
_BARE = re.compile(rb"([\d.])([+-]\d)")
_DECIMAL = re.compile(r"([+-]?(?:[0-9]+\.?[0-9]*|\.[0-9]+))(?:[eEdDqQ]([+-]?[0-9]+)|([+-][0-9]+))?")
_DIGITS = re.compile(rb"[+-]?0*(\d*)\.?(\d*)")


def decimal(text: str) -> float:
    """Return a decimal number as Fortran or C writes it: 7.5, 7.5e3, 7.5D+03, 7.5+03."""
    match = _DECIMAL.fullmatch(text.strip())
    if match is None:
        raise ValueError(f"{text.strip()!r:.40} is not a decimal number")
    return float(f"{match[1]}e{match[2] or match[3] or 0}")


def fixed_numbers(text: bytes, width: int) -> FloatArray | None:
    """Return the numbers in fields of `width` characters, None when one is not a number."""
    fields = np.frombuffer(text, np.uint8).reshape(-1, width)
    shown = np.zeros((fields.shape[0], width + 1), dtype=bool)
    shown[:, 1:] = fields != ord(" ")
    # one number in each field: a blank within a field next to an empty field would shift all
    # following ones
    if np.any(np.count_nonzero(shown[:, 1:] & ~shown[:, :-1], axis=1) != 1):
        return None
    return spaced_numbers(_separated(fields).tobytes(), len(fields))


def _separated(fields: Any) -> Any:
    spaced = np.full((fields.shape[0], fields.shape[1] + 1), ord(" "), dtype=np.uint8)
    spaced[:, :-1] = fields
    return spaced


def spaced_numbers(text: bytes, count: int | None = None) -> FloatArray | None:
    """Return the numbers of a text that separates them with spaces or line ends."""
    # None when one is not a number, or there are not `count`
    clean = text.translate(_LETTERS)
    seen = np.frombuffer(clean, np.uint8)
    signs = np.flatnonzero((seen[1:] == ord("+")) | (seen[1:] == ord("-")))
    before = seen[signs]
    if np.any((before >= ord("0")) & (before <= ord("9")) | (before == ord("."))):
        clean = _BARE.sub(rb"\1e\2", clean)
    numbers = _parse_numbers(clean)
    return None if numbers is None or (count is not None and numbers.size != count) else numbers


def rows_of_numbers(text: bytes, width: int) -> FloatArray | None:
    r"""Return the numbers (m, width) of m lines, None when a line does not hold `width` numbers."""
    seen = np.frombuffer(text, np.uint8)
    shown = np.zeros(seen.size + 1, dtype=bool)
    shown[1:] = (seen > ord(" ")) & (seen != 127)
    starts = np.flatnonzero(shown[1:] & ~shown[:-1])
    ends = np.append(np.flatnonzero(seen == ord("\n")), seen.size)
    held = np.diff(np.searchsorted(starts, ends), prepend=0)
    if np.any((held != width) & (held != 0)):
        return None
    numbers = spaced_numbers(text, starts.size)
    return None if numbers is None else numbers.reshape(-1, width)


def numbers_of_lines(
    text: bytes, width: int, wrong: Callable[[int, bytes], FlexplantError]
) -> FloatArray:
    """Return the finite numbers (m, width) of m lines."""
    # `wrong` makes the error for the first line, by its number from 0, without these numbers
    table = rows_of_numbers(text, width)
    if table is None or not np.all(np.isfinite(table)):
        lines = text.split(b"\n")
        at = wrong_line(lines, width) or 0
        raise wrong(at, lines[at])
    return table


def wrong_line(lines: Iterable[bytes], width: int) -> int | None:
    """Return the place (from 0) of the first line that does not hold `width` finite numbers."""
    for place, line in enumerate(lines):
        try:
            held = [decimal(word.decode("latin-1")) for word in line.split()]
        except ValueError:
            return place
        if held and (len(held) != width or not np.all(np.isfinite(held))):
            return place
    return None


_LETTERS = bytes.maketrans(b"DdEQq", b"eeeee")


def _parse_numbers(text: bytes) -> FloatArray | None:
    with warnings.catch_warnings():
        # message of NumPy when it stops before the end
        warnings.simplefilter("error", DeprecationWarning)
        try:
            return np.asarray(np.fromstring(text.decode("latin-1"), sep=" "), dtype=np.float64)
        except (DeprecationWarning, ValueError):
            return None


def printed_digits(words: Iterable[bytes]) -> int | None:
    """Return the number of significant digits of printed numbers; None if unknown.

    A program that rounds prints all numbers in the same way: in a fixed field, apart from the
    characters of sign and exponent, or with the same number of digits, without zeros at the end.
    Numbers of a few digits, such as 5 or 2.5, and some long ones among them, may be exact.
    """
    found = []
    for word in words:
        match = _DIGITS.match(word.strip())
        if match:
            whole, part = match[1], match[2]
            found.append(len(whole) + len(part if whole else part.lstrip(b"0")))
    counts = [count for count in found if count]
    most = max(counts, default=0)
    alike = sum(count >= most - _FIELD for count in counts) >= EVERY_DIGIT * len(counts)
    return most if most >= _DOUBLE or (most >= _ROUNDED and alike) else None


#: advice for a file that contains an item twice
ONCE = "Export each once (one result set)."


def file_path(path: Any, name: str = "path") -> Path:
    """Return the path of a file; a missing file is reported when it is opened."""
    if not isinstance(path, str | Path):
        raise FlexplantError(
            f"{name} must name a file, got {short(path)}. Pass matrices that are in memory already "
            "to FEModel(M, K, dofs=...) or fx.structure.FEMatrices(K, M, dofs=...)."
        )
    if Path(path).is_dir():
        raise FlexplantError(f"{str(path)!r} is a folder. Name the file in it.")
    return Path(path)


def damaged(path: object, what: object, do: str = "Write it again.") -> FlexplantError:
    """Return the error of a file that violates its format; `what` is cut to 200 letters."""
    return FlexplantError(f"{str(path)!r}, {what!s:.200}: the file is damaged or cut off. {do}")


def wrong_line_of(
    path: object, number: int, due: str, line: str | bytes, do: str = "Write it again."
) -> FlexplantError:
    """Return the error of a line, counted from 1, with unexpected content."""
    got = line.decode("latin-1") if isinstance(line, bytes) else line
    return FlexplantError(
        f"{str(path)!r}, line {number}: {due} expected, got {got.strip()[:72]!r}. {do}"
    )


def defined_twice(what: str, first: str, again: str, do: str) -> FlexplantError:
    """Return the error of an identifier with two definitions, both of which are named."""
    return FlexplantError(
        f"{what} is defined twice, in {first} and in {again}: it is not clear to which of the "
        f"two the numbers belong. {do}"
    )


def refused(path: object, what: str, do: str) -> FlexplantError:
    """Return the error of a file with other content than the reader expects."""
    return FlexplantError(f"{str(path)!r} {what}. {do}")


def unread(path: object, what: str, do: str) -> ModelError:
    """Return the error for a file that does not hold M, D, K or shapes of a structure."""
    return ModelError(f"{str(path)!r} {what}. {do}")


def no_motion(path: object, kinds: object) -> ModelError:
    """Return the error of a file with DOFs that are not displacements or rotations."""
    what = (
        f"has DOFs other than displacements and rotations ({kinds}): temperature, pressure, voltage"
    )
    return unread(path, f"{what}, warping or a multiplier", "Export only the structural part.")


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
    # a number that lost its last digits is still a valid number
    last = content[-80:].split()[-1:]
    if content.endswith((b"\n", b"\r")) or not last:
        return
    # the words may contain the last number too
    others = [len(word) for word in (w.strip().lstrip(b"+-") for w in words) if word not in last[0]]
    if others and len(last[0].lstrip(b"+-")) < min(others) >= _PRINTED:
        raise damaged(path, "the last number is shorter than all others")


@contextmanager
def parsing(path: object, do: str = "Write it again.") -> Iterator[None]:
    """Turn every exception of a parser of another package into the error for a damaged file."""
    try:
        yield
    except FlexplantError:
        raise
    except Exception as error:  # damaged bytes may raise anything
        raise damaged(path, f"{type(error).__name__}: {error}", do) from None


def check_count(size: int, held: int, path: object) -> None:
    """Refuse an impossible number of rows or columns from a damaged count."""
    if size > max(2**20, held):
        raise damaged(path, f"a matrix of {size} rows or columns in {held} bytes")


def text_of(path: Path, encoding: str = "utf-8-sig") -> str:
    """Return the text of a file: UTF-8, or Latin-1 as older programs write it."""
    content = path.read_bytes()
    try:
        text = content.decode(encoding)
    except UnicodeDecodeError as error:
        if not is_text(content):
            what = f"byte {error.start} is not UTF-8 text"
            do = "Is it another format? Save it as plain text, UTF-8."
            raise damaged(path, what, do) from None
        text = content.decode("latin-1")
    return text.replace("\r\n", "\n").replace("\r", "\n")


#: stands for the matrix that has one of the usual names, if there is such a matrix
USUAL = "usual"
#: largest number of characters of a line of numbers; lines of cards have 80
LINE = 4096
#: number of bytes at the beginning of a file from which its format is recognised
HEAD = 20000


def _by_suffix_alone(head: bytes) -> bool:
    """Return False: the format is not recognised from the first bytes of a file."""
    return False


@dataclass(frozen=True)
class Format:
    """A format of files that hold matrices, with its reader; `add_format` registers it.

    Parameters
    ----------
    suffixes : sequence of str
        Ends of the names of such files, in lower case, for example ".mtx".
    read : function
        ``read(path, **options)`` returns the `FEMatrices` of a file.
    begins : function, optional
        Function of the first bytes of a file that returns whether they show this format. It finds
        the format of files with any name.
    mesh : sequence of str
        Ends of the names of files that hold only the nodes.
    mesh_option : str
        The option of `read` that takes such a file.

    Examples
    --------
    >>> import flexplant as fx
    >>> form = fx.io.Format((".rows",), lambda path: fx.structure.FEMatrices([[1.0]]))
    >>> form.options
    ()
    """

    suffixes: tuple[str, ...]
    read: Callable[..., FEMatrices]
    begins: Callable[[bytes], bool] = _by_suffix_alone
    mesh: tuple[str, ...] = ()
    mesh_option: str = ""

    @property
    def options(self) -> tuple[str, ...]:
        """Options of the reader in addition to the file, `nodes` for a mesh."""
        taken = tuple(inspect.signature(self.read).parameters)[1:]
        return tuple("nodes" if name == self.mesh_option else name for name in taken)

    @property
    def several(self) -> bool:
        """Whether a file holds several matrices, so that they are chosen by their names."""
        damping = inspect.signature(self.read).parameters.get("damping")
        return damping is not None and damping.default == USUAL


@dataclass(frozen=True)
class Elsewhere:
    """Files without matrices, and what to do with them."""

    suffixes: tuple[str, ...]
    reader: str
    begins: Callable[[bytes], bool] = lambda head: True


#: formats that the readers register, and files of the same programs without matrices
FORMATS: list[Format] = []
ELSEWHERE: list[Elsewhere] = []


def add_format(form: Format) -> None:
    """Register your own format for `read_matrices` and `read_model`.

    Parameters
    ----------
    form : Format
        Description of the format, with its reader.

    Raises
    ------
    ModelError
        When a format with one of its suffixes is known.

    Examples
    --------
    >>> import flexplant as fx
    >>> form = fx.io.Format((".mtx",), lambda path: fx.structure.FEMatrices([[1.0]]))
    >>> fx.io.add_format(form)
    Traceback (most recent call last):
    flexplant.errors.ModelError: files that end in .mtx have a reader. Choose another suffix.
    """
    taken = {suffix for known in FORMATS for suffix in known.suffixes}.intersection(form.suffixes)
    if taken:
        raise ModelError(
            f"files that end in {', '.join(sorted(taken))} have a reader. Choose another suffix."
        )
    FORMATS.append(form)


def is_text(head: bytes) -> bool:
    """Return whether a file begins as text."""
    return bool(head) and not head.translate(None, delete=bytes(range(32, 256)) + b"\t\r\n\f")


def ends(path: Path, suffixes: tuple[str, ...]) -> bool:
    """Return whether the name of a file has one of the suffixes."""
    return path.name.lower().endswith(suffixes)

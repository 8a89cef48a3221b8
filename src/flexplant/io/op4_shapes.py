"""Which sizes of matrices an OUTPUT4 file can hold, and which are kept sparse."""

from __future__ import annotations

from .paths import check_size

#: entries that are kept dense however few of them the file holds
_SMALL = 2**20
#: a dense matrix may take so many times the numbers in the file
_TIMES = 16


def check_shape(columns: int, rows: int, held: int, path: str) -> None:
    """Refuse a size of a matrix that a file of `held` bytes cannot hold.

    Raises
    ------
    FlexplantError
        When rows or columns are too many: a damaged count.
    """
    check_size(max(columns, abs(rows)), held, path)


def is_thin(shape: tuple[int, int], held: int) -> bool:
    """Return whether a matrix of which the file holds so many numbers is too large to be dense."""
    return shape[0] * shape[1] > max(_SMALL, _TIMES * held)

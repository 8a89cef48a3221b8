"""What names a file, and what is said of a damaged one."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from ..errors import FlexplantError
from ..values import short


def file_path(path: Any, name: str = "path") -> Path:
    """Return the path of a file; its absence is left to what opens it.

    Raises
    ------
    FlexplantError
        When it is no path, or that of a folder.
    """
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
    return FlexplantError(f"{str(path)!r}, {what!s:.200}: the file is damaged. {do}")

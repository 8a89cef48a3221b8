"""The variables of a MATLAB file, up to version 7."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import scipy.io

from ..errors import FlexplantError
from .paths import file_path


def mat_variables(path: str | Path, **options: Any) -> dict[str, Any]:
    """Return {name: value}; options are those of `scipy.io.loadmat`.

    Raises
    ------
    FlexplantError
        When it is no MATLAB file, or of version 7.3.
    """
    file: Any  # the type stubs take names of files only
    with file_path(path).open("rb") as file:
        try:
            content = scipy.io.loadmat(file, **options)
        except Exception as error:  # a damaged file raises whatever its bytes lead to
            raise FlexplantError(
                f"{str(path)!r} cannot be read as a MATLAB file ({error!s:.80}). Version 7.3 is "
                "another format: save it with '-v7'."
            ) from None
    return {name: value for name, value in content.items() if not name.startswith("__")}

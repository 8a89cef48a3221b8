"""The variables of a MATLAB file, up to version 7."""

from __future__ import annotations

import struct
from pathlib import Path
from typing import Any

from ..errors import FlexplantError
from .child import in_child
from .paths import file_path


def mat_variables(path: str | Path) -> dict[str, Any]:
    """Return {name: value}, structures as dicts, cells as arrays of objects."""
    wrong = _cut(file_path(path).read_bytes())
    kind, found = ("cut off", {}) if wrong else in_child("matlab", path, keep="matlab")
    if kind != "value":
        raise FlexplantError(
            f"{str(path)!r} cannot be read as a MATLAB file ({wrong or found!s:.80}). It is "
            "damaged or of version 7.3, which is another format: save it with '-v7'."
        )
    content: dict[str, Any] = found
    return content


def _cut(content: bytes) -> str:
    """Return what is wrong with the lengths of the variables of a file of version 5, in words."""
    order = {b"IM": "<", b"MI": ">"}.get(content[126:128])
    at = 128
    while order and at < len(content):
        size = struct.unpack_from(f"{order}I", content[at : at + 8].ljust(8, b"\0"), 4)[0]
        if at + 8 + size > len(content):
            return f"a variable at byte {at} of {size} bytes in a file of {len(content)}"
        at += 8 + size
    return ""

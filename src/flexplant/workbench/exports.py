"""Exports: a design as files: itself, C99, MATLAB, second-order sections, Python, a report."""

from __future__ import annotations

import io
import tempfile
import zipfile
from collections.abc import Callable
from pathlib import Path
from typing import Any

from ..errors import FlexplantError, ModelError
from ..io import write_mat
from ..lti.statespace import StateSpace
from ..store import load
from ..synthesis import (
    Controller,
    FixedBlock,
    Law,
    LoopDesign,
    ShapedLoop,
    second_order_sections,
    write_c,
)
from ..synthesis.laws.law import LawElement

#: a file that a browser hands over, at most [bytes]
_LARGEST = 64_000_000


def design_file(design: LoopDesign) -> bytes:
    """Return the design as `.save` writes it."""
    return _written("design.npz", design.save)


def c_code(design: LoopDesign) -> bytes:
    """Return source and header of the controller as a zip archive."""
    with tempfile.TemporaryDirectory() as folder:
        files = write_c(design.controller(), Path(folder) / "loops.c")
        return _zipped({file.name: file.read_bytes() for file in files})


def matlab_file(design: LoopDesign) -> bytes:
    """Return the controller, and the laws of the axes, for MATLAB."""
    values: dict[str, Any] = {"controller": design.controller()}
    for i, law in enumerate(design.laws.values(), 1):
        values[f"law{i}"] = law.system
    return _written("design.mat", lambda path: write_mat(path, values))


def sections(design: LoopDesign) -> bytes:
    """Return the second-order sections of each law as a table."""
    rows = ["axis,section,b0,b1,b2,a0,a1,a2"]
    for name, law in design.laws.items():
        found = second_order_sections(law.system)["command", "error"]
        rows += [
            f"{name},{k}," + ",".join(repr(float(v)) for v in row) for k, row in enumerate(found, 1)
        ]
    return ("\n".join(rows) + "\n").encode()


def script(design: LoopDesign, plant: str = "") -> bytes:
    """Return the script that makes the design."""
    return design.script(plant).encode()


def report_page(design: LoopDesign, plant: Any, larger: Any = None) -> bytes:
    """Return the report page of the design and its loops."""
    from ..plot import report as write_report

    loops = design.loops(plant, larger=larger)
    parts = {"design": design, "loops": loops, "controller": loops.system}
    return _written("loops.html", lambda path: write_report(path, parts, title="Loops by hand"))


def _written(name: str, write: Callable[[Path], Any]) -> bytes:
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / name
        write(path)
        return path.read_bytes()


def _zipped(files: dict[str, bytes]) -> bytes:
    out = io.BytesIO()
    with zipfile.ZipFile(out, "w", zipfile.ZIP_DEFLATED) as archive:
        for name, data in files.items():
            archive.writestr(name, data)
    return out.getvalue()


def given_file(data: bytes) -> LoopDesign | tuple[Any, ...]:
    """Return the design of a file that was handed over, or the elements that it gives a law.

    Files are ours alone (`.save`): arrays and JSON, never a pickle.
    """
    if len(data) > _LARGEST:
        raise ModelError(f"the file has {len(data) / 1e6:.0f} MB: a design has less than 64.")
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "given.npz"
        path.write_bytes(data)
        try:
            value = load(path)
        except FlexplantError as problem:
            raise FlexplantError(str(problem).replace(repr(str(path)), "the file")) from None
    if isinstance(value, LoopDesign):
        return value
    if isinstance(value, Law):
        return (*value.factors,) if value.gain == 1.0 else (*value.factors, value.gain)
    if isinstance(value, LawElement):
        return (value,)
    if isinstance(value, StateSpace | Controller | ShapedLoop):
        return (FixedBlock.of(value),)
    raise ModelError(
        f"the file holds a {type(value).__name__}: a LoopDesign, a Law, or a controller of one "
        "channel can be taken."
    )

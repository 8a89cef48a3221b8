"""Frequency response functions as CSV: one line a frequency, names and units in the header."""

from __future__ import annotations

import csv
import io
import re
from collections.abc import Mapping
from pathlib import Path

import numpy as np

from ..checks import FloatArray, instance, mapping
from ..errors import FlexplantError, LabelError
from ..lti.frequency import Frf
from ..store import written
from .numbers import decimal
from .paths import file_path, refused, text_of

_FREQ = "frequency [Hz]"
_ARROW = " <- "
_COLUMN = re.compile(r"(.+) <- (.+) (real|imag|coherence|variance)(?: \[(.*)\])?")
_UNITS = {"displacement": "m", "velocity": "m/s", "acceleration": "m/s^2"}


def write_frf_csv(path: str | Path, frf: Frf, *, units: Mapping[str, str] | None = None) -> None:
    """Write frequency response functions as a CSV file.

    A line `# quantity: displacement`, a header `frequency [Hz], y1 <- u1 real [m/N],
    y1 <- u1 imag [m/N], ...` (and `... coherence`, `... variance` where
    known), then one line a frequency, with
    all digits. Where known, lines `# resolution: 0.5` [Hz], `# window: hann` and `# overlap: 0.5`
    follow the first. The correlation between outputs and a window with parameters stay behind:
    `.save` keeps them.

    Parameters
    ----------
    path : str or Path
        The file, written atomically.
    frf : Frf
        What to write.
    units : mapping {channel: unit}, optional
        Such as {"y1": "rad", "u1": "N m"}. Where not given, those of the Frf; else N for inputs,
        and m, m/s or m/s^2 for outputs by the quantity of the Frf; none when that is not known.

    Raises
    ------
    LabelError
        When a name holds the arrow ' <- ', or units name no channel.
    ModelError
        When it is no Frf.
    OSError
        When the file cannot be written.

    Examples
    --------
    >>> import flexplant as fx
    >>> import os, tempfile
    >>> frf = fx.Frf([10.0, 20.0], [[[1.0, 2.0]]], outputs=["y1"], inputs=["u1"])
    >>> with tempfile.TemporaryDirectory() as folder:
    ...     path = os.path.join(folder, "frf.csv")
    ...     fx.io.write_frf_csv(path, frf)
    ...     again = fx.io.read_frf_csv(path)
    >>> again["y1", "u1"].real
    array([1., 2.])
    """
    instance(frf, Frf, "frf", "Pass frequency_response(sys).")
    given = dict(frf.units)
    given |= {} if units is None else mapping(units, "units", "Pass {channel: unit}.")
    for name in given:
        if name not in (*frf.inputs, *frf.outputs):
            raise LabelError(f"units name {name!r}, which is no channel of {frf!r}.")
    header, columns = [_FREQ], [frf.freq]
    own = _UNITS.get(frf.quantity or "", "")
    for i, output in enumerate(frf.outputs):
        for j, name in enumerate(frf.inputs):
            if _ARROW in output or _ARROW in name:
                raise LabelError(f"{output!r} or {name!r} holds {_ARROW!r}: rename the channel.")
            above, below = given.get(output, own), given.get(name, "N" if own else "")
            unit = f" [{above}/{below}]" if above and below else ""
            header += [f"{output}{_ARROW}{name} {part}{unit}" for part in ("real", "imag")]
            columns += [frf.data[i, j].real, frf.data[i, j].imag]
            if frf.coherence is not None:
                header.append(f"{output}{_ARROW}{name} coherence")
                columns.append(frf.coherence[i, j])
            if frf.variance is not None:
                header.append(f"{output}{_ARROW}{name} variance")
                columns.append(frf.variance[i, j])
    text = io.StringIO()
    text.write(f"# quantity: {frf.quantity or 'unknown'}\n")
    if frf.resolution is not None:
        text.write(f"# resolution: {frf.resolution!r}\n")
        if isinstance(frf.window, str):
            text.write(f"# window: {frf.window}\n# overlap: {frf.overlap!r}\n")
    table = csv.writer(text, lineterminator="\n")
    table.writerow(header)
    table.writerows([repr(number) for number in row] for row in np.column_stack(columns).tolist())
    with written(path) as file:
        file.write(text.getvalue().encode("utf-8"))


def read_frf_csv(path: str | Path) -> Frf:
    """Return the frequency response functions of a CSV file.

    Parameters
    ----------
    path : str or Path
        A file in the form of `write_frf_csv`.

    Raises
    ------
    FlexplantError
        When the header or a line has another form, or a cell is no number; the line is named.
    ModelError
        When frequencies do not increase.

    Examples
    --------
    >>> import flexplant as fx
    >>> import os, tempfile
    >>> frf = fx.Frf([10.0, 20.0], [[[1.0, 2.0]]], outputs=["y1"], inputs=["u1"])
    >>> with tempfile.TemporaryDirectory() as folder:
    ...     path = os.path.join(folder, "frf.csv")
    ...     fx.io.write_frf_csv(path, frf)
    ...     fx.io.read_frf_csv(path)
    <Frf: u1 -> y1, 2 frequencies 10 .. 20 Hz>
    """
    lines = text_of(file_path(path), "utf-8").splitlines()
    comments = [line for line in lines if line.startswith("#")]
    said = dict(re.findall(r"^#\s*(\w+):\s*(.*?)\s*$", "\n".join(comments), re.MULTILINE))
    quantity = said.get("quantity", "unknown")
    try:
        resolution = float(said["resolution"]) if "resolution" in said else None
        overlap = float(said.get("overlap", 0.0))
    except ValueError as error:
        raise refused(path, "has a resolution or overlap that is no number", f"{error}.") from None
    first = len(comments) + 1
    rows = list(csv.reader(line for line in lines if not line.startswith("#")))
    keys = _column_keys(rows[0] if rows else [], str(path))
    values = []
    for line, row in enumerate(rows[1:], first + 1):
        try:
            values.append([decimal(cell) for cell in row])
        except ValueError as error:
            raise FlexplantError(f"{str(path)!r}, line {line}: {error}.") from None
        if len(row) != len(keys) + 1:
            what = f"has {len(row)} numbers in line {line}, and {len(keys) + 1} columns"
            raise refused(path, what, "Complete it.")
    table = np.array(values, dtype=np.float64).reshape(len(values), len(keys) + 1)
    outputs = list(dict.fromkeys(key[0] for key in keys))
    inputs = list(dict.fromkeys(key[1] for key in keys))
    column = {key: table[:, i] for i, key in enumerate(keys, 1)}
    missing = [
        f"{a}{_ARROW}{b} {part}"
        for a in outputs
        for b in inputs
        for part in ("real", "imag")
        if (a, b, part) not in column
    ]
    if missing or len(column) != len(keys):
        raise FlexplantError(f"{str(path)!r} lacks or doubles columns: {missing[:3]}.")
    pairs = [[(a, b) for b in inputs] for a in outputs]
    data = np.array([[column[*p, "real"] + 1j * column[*p, "imag"] for p in row] for row in pairs])

    def known(part: str) -> FloatArray | None:
        if any((*pair, part) not in column for row in pairs for pair in row):
            return None
        return np.array([[column[*pair, part] for pair in row] for row in pairs])

    return Frf(
        table[:, 0],
        data,
        inputs=inputs,
        outputs=outputs,
        quantity=None if quantity == "unknown" else quantity,
        coherence=known("coherence"),
        variance=known("variance"),
        resolution=resolution,
        window=said.get("window") if resolution is not None else None,
        overlap=overlap,
    )


def _column_keys(cells: list[str], path: str) -> list[tuple[str, str, str]]:
    if not cells or cells[0].strip() != _FREQ or len(cells) < 3:
        raise FlexplantError(
            f"{path!r} has no header as {_FREQ!r}, 'y1 <- u1 real', 'y1 <- u1 imag', got "
            f"{cells[:3]}. Write it like this, or make Frf(freq, data) from your own columns."
        )
    keys = []
    for cell in cells[1:]:
        match = _COLUMN.fullmatch(cell.strip())
        if match is None:
            raise FlexplantError(f"{path!r}: column {cell!r} is not like 'y1 <- u1 real [m/N]'.")
        keys.append((match[1], match[2], match[3]))
    return keys

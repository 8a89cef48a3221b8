"""Frequency responses from CSV, a line a frequency, and from plain arrays in .npz and .mat."""

from __future__ import annotations

import csv
import io
import re
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np

from ..arrays import FloatArray, instance, mapping
from ..errors import FlexplantError, LabelError, ModelError, ShapeError, require_known
from ..lti.frequency import Frf
from ..store import written
from .files import decimal, file_path, parsing, refused, text_of
from .mat_matrices import mat_variables

_FREQ = "frequency [Hz]"
_ARROW = " <- "
_COLUMN = re.compile(r"(.+) <- (.+) (real|imag|coherence|variance)(?: \[(.*)\])?")
_UNITS = {"displacement": "m", "velocity": "m/s", "acceleration": "m/s^2"}


def write_frf_csv(path: str | Path, frf: Frf, *, units: Mapping[str, str] | None = None) -> None:
    """Write frequency response functions as a CSV file.

    The file has a line `# quantity: displacement`, a header `frequency [Hz], y1 <- u1 real [m/N],
    y1 <- u1 imag [m/N], ...` (and `... coherence`, `... variance` where known), and then one line
    for each frequency, with all digits. If they are known, the lines `# resolution: 0.5` [Hz],
    `# window: hann` and `# overlap: 0.5` follow the first line. The correlation between outputs and
    a window with parameters are not written: `.save` keeps them.

    Parameters
    ----------
    path : str or Path
        Path of the file, which is written completely or not at all.
    frf : Frf
        Frequency responses to write.
    units : mapping {channel: unit}, optional
        Units of channels, such as {"y1": "rad", "u1": "N m"}. By default those of the Frf are
        written. If it has no units, inputs have the unit N, and outputs the unit m, m/s or m/s^2
        that belongs to the quantity of the Frf.

    Raises
    ------
    LabelError
        When a name contains the arrow ' <- ', or units name an unknown channel.
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
            raise LabelError(f"units name {name!r}, which is not a channel of {frf!r}.")
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
            for part in ("coherence", "variance"):
                if (values := getattr(frf, part)) is not None:
                    header.append(f"{output}{_ARROW}{name} {part}")
                    columns.append(values[i, j])
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
        When the header or a line has another form, or a cell is not a number; the line is named.
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
        raise refused(
            path, "has a resolution or overlap that is not a number", f"{error}."
        ) from None
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
    outputs, inputs = (list(dict.fromkeys(key[side] for key in keys)) for side in (0, 1))
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


_OPTIONAL = ("inputs", "outputs", "quantity", "coherence", "variance")


def read_frf_npz(
    path: str | Path,
    *,
    freq: str = "freq",
    data: str = "data",
    quantity: str | None = None,
    frequency_axis: int | None = None,
) -> Frf:
    """Return the frequency response functions that `numpy.savez` wrote as plain arrays.

    Parameters
    ----------
    path : str or Path
        A .npz file with frequencies [Hz] and responses; `inputs`, `outputs`, `quantity`,
        `coherence` and `variance` are read if present. What `Frf.save` wrote is read by
        `flexplant.load`.
    freq, data : str
        Names of the arrays of frequencies (n_freq,) and of responses (n_out, n_in, n_freq). The
        responses may have the shape (n_freq,) for one output and one input.
    quantity : {"displacement", "velocity", "acceleration"}, optional
        Quantity of the outputs, where the file does not contain it.
    frequency_axis : int, optional
        Axis of frequency of the responses, such as 0 for (n_freq, n_out, n_in); by default the only
        axis with that length.

    Raises
    ------
    FlexplantError
        When it is not an .npz file, or arrays are missing.
    ShapeError
        When sizes do not match, or it is not clear which axis is that of frequency.
    ModelError
        When frequencies do not increase, or entries are not finite.

    Examples
    --------
    >>> import os, tempfile
    >>> path = os.path.join(tempfile.mkdtemp(), "frf.npz")
    >>> np.savez(path, freq=[1.0, 2.0], data=[0.5, 0.25j], quantity="velocity")
    >>> read_frf_npz(path).quantity
    'velocity'
    """
    do = "Write plain arrays with numpy.savez(path, freq=..., data=...)."
    with file_path(path).open("rb") as file, parsing(path, do):
        archive = np.load(file, allow_pickle=False)
        if not isinstance(archive, np.lib.npyio.NpzFile):
            raise ValueError("one array only")
        content = {name: archive[name] for name in archive.files}
        for array in content.values():
            if array.dtype.kind == "U":
                # letters beyond those of Unicode would fail where they are printed
                array.astype(array.dtype.newbyteorder("=")).tobytes().decode("utf-32")
    if "__flexplant__" in content:
        raise FlexplantError(f"{str(path)!r} is flexplant's own: flexplant.load(path) reads it.")
    return _frf(content, path, freq, data, quantity, frequency_axis)


def read_frf_mat(
    path: str | Path,
    *,
    freq: str = "freq",
    data: str = "data",
    quantity: str | None = None,
    frequency_axis: int | None = None,
) -> Frf:
    """Return the frequency response functions in a MATLAB file, as arrays.

    Parameters
    ----------
    path : str or Path
        A .mat file (up to version 7; save with '-v7') with the variables of `read_frf_npz`;
        `inputs` and `outputs` are cell arrays of names.
    freq, data, quantity, frequency_axis : as in `read_frf_npz`

    Raises
    ------
    FlexplantError, ShapeError, ModelError, LabelError
        As for `read_frf_npz`.

    Examples
    --------
    >>> import flexplant as fx
    >>> import os, scipy.io, tempfile
    >>> with tempfile.TemporaryDirectory() as folder:
    ...     path = os.path.join(folder, "frf.mat")
    ...     scipy.io.savemat(path, {"freq": [10.0, 20.0], "data": [[[1.0, 2.0]]]})
    ...     fx.io.read_frf_mat(path)
    <Frf: u1 -> y1, 2 frequencies 10 .. 20 Hz>
    """
    plain = mat_variables(path)
    for side in ("inputs", "outputs"):
        if side in plain:
            plain[side] = [str(np.squeeze(cell)).strip() for cell in np.ravel(plain[side])]
    return _frf(plain, path, freq, data, quantity, frequency_axis)


def _frf(
    content: Mapping[str, Any],
    path: str | Path,
    freq: str,
    data: str,
    quantity: str | None,
    axis: int | None,
) -> Frf:
    try:
        require_known("array", (freq, data), content, repr(str(path)))
    except LabelError as error:
        raise LabelError(f"{error} Name them: freq='...', data='...'.") from None
    grid, responses = np.ravel(content[freq]), np.asarray(content[data])
    for name, array in ((freq, grid), (data, responses)):
        if array.dtype.kind not in "iufc":
            raise FlexplantError(
                f"{name!r} of {str(path)!r} holds no numbers ({array.dtype}). Name the array: "
                "freq='...', data='...'."
            )
    responses = _ordered(responses, grid.size, axis, data, path)
    others = {name: content[name] for name in _OPTIONAL if name in content}
    said = "".join(map(str, np.ravel(others.pop("quantity", ""))))
    instance(quantity, str | None, "quantity", "Pass 'displacement', say.")
    if quantity is not None and said and said != quantity:
        raise ModelError(
            f"{str(path)!r} says it holds {said}, not {quantity}. Read it without quantity=, and "
            "convert: "
            f".converted({quantity!r})."
        )
    kind = quantity or said or None
    require_known("quantity", [kind] if kind else (), _UNITS)
    for name in ("coherence", "variance"):
        if name in others:
            others[name] = _ordered(np.asarray(others[name]), grid.size, axis, name, path).real
    if np.iscomplexobj(grid):
        raise ModelError(f"{freq!r} of {str(path)!r} is complex: give frequencies in Hz.")
    inputs, outputs = ([str(name) for name in np.ravel(others.pop(s, []))] for s in _OPTIONAL[:2])
    return Frf(grid, responses, inputs=inputs, outputs=outputs, quantity=kind, **others)


def _ordered(array: Any, n: int, axis: int | None, name: str, path: str | Path) -> Any:
    """Return responses as (n_out, n_in, n)."""
    squeezed = array.reshape(-1) if array.size == n and axis is None else array
    if squeezed.ndim == 1 and squeezed.size == n:
        return squeezed.reshape(1, 1, n)
    fits = [i for i, size in enumerate(array.shape) if size == n]
    chosen = fits[0] if axis is None and fits else axis
    wrong = ""
    if array.ndim != 3 or chosen is None or not -3 <= chosen < 3 or array.shape[chosen] != n:
        wrong = f"axis {chosen} is not the {n} frequencies. Save (n_out, n_in, {n}), or ({n},)"
    elif axis is None and len(fits) > 1:
        wrong = f"axes {fits} are as long as freq. Choose one: frequency_axis=2"
    if wrong or chosen is None:
        raise ShapeError(f"{name!r} of {str(path)!r} has shape {array.shape}: {wrong}.")
    return np.moveaxis(array, chosen, 2)

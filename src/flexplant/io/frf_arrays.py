"""Frequency response functions from plain arrays in a file: NumPy's .npz and MATLAB's .mat."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np

from ..checks import instance
from ..errors import FlexplantError, ModelError, ShapeError, require_known, unknown_label
from ..lti.frequency import Frf
from .mat_matrices import mat_variables
from .paths import file_path, parsing

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
        `coherence` and `variance` are taken where they are there. What `Frf.save` wrote is read by
        `flexplant.load`.
    freq, data : str
        Names of the arrays (n_freq,) and (n_out, n_in, n_freq); (n_freq,) for a single pair.
    quantity : {"displacement", "velocity", "acceleration"}, optional
        What the outputs are, where the file does not say.
    frequency_axis : int, optional
        Which axis of the responses is frequency, such as 0 for (n_freq, n_out, n_in); when not
        given, the only one of that length.

    Raises
    ------
    FlexplantError
        When it is no .npz file, or the arrays are not there.
    ShapeError
        When sizes do not match, or which axis is frequency is not clear.
    ModelError
        When frequencies do not increase, or entries are not finite.
    LabelError
        When an array or the quantity is unknown.

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
    freq, data, quantity, frequency_axis : optional
        As in `read_frf_npz`.

    Raises
    ------
    FlexplantError
        When it is no MATLAB file, or the variables are not there.
    ShapeError
        When sizes do not match, or which axis is frequency is not clear.
    ModelError
        When frequencies do not increase, or entries are not finite.
    LabelError
        When a variable or the quantity is unknown.

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
    require_known("array", (freq, data), content, repr(str(path)))
    grid, responses = np.ravel(content[freq]), np.asarray(content[data])
    for name, array in ((freq, grid), (data, responses)):
        if array.dtype.kind not in "iufc":
            raise FlexplantError(
                f"{name!r} of {str(path)!r} holds no numbers ({array.dtype}). Name the array: "
                "freq='...', data='...'."
            )
    responses = _ordered(responses, grid.size, axis, data, path)
    others = {name: content[name] for name in _OPTIONAL if name in content}
    said = "".join(str(part) for part in np.ravel(others.pop("quantity", "")))
    instance(quantity, str | None, "quantity", "Pass 'displacement', say.")
    if quantity is not None and said and said != quantity:
        raise ModelError(
            f"{str(path)!r} says it holds {said}, not {quantity}. Read it as it is, and convert: "
            f".converted({quantity!r})."
        )
    kind = quantity or said or None
    if kind not in (None, "displacement", "velocity", "acceleration"):
        raise unknown_label("quantity", kind, ["displacement", "velocity", "acceleration"])
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
        wrong = f"axes {fits} are as long as freq. Say which it is: frequency_axis=2"
    if wrong or chosen is None:
        raise ShapeError(f"{name!r} of {str(path)!r} has shape {array.shape}: {wrong}.")
    return np.moveaxis(array, chosen, 2)

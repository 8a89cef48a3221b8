"""Time records and power spectral densities of universal files: dataset 58 of types 1 and 9."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np

from ..arrays import FloatArray, positive
from ..loop import Spectrum
from ..lti.frequency import ORDERS, PER_TIME
from .files import file_path, refused, unread
from .record_tables import RecordedChannels
from .uff_records import KINDS, channel_of, channel_order, datasets, unit_text, whole_entry
from .uff_systems import is_permutation, turning, uff_nodes
from .unit_labels import density_of

_TIME, _DENSITY = 1, 9
#: content of dataset 58 by its function type, and the function that reads it
_FUNCTIONS = {
    _TIME: ("time record", "read_records"),
    4: ("frequency response", "read_frf_uff"),
    _DENSITY: ("power spectral density", "read_spectra"),
}
#: code of the data type of a force
_FORCE = 13
UNIVERSAL = (".uff", ".unv", ".uf")


def read_uff_records(path: Path) -> RecordedChannels:
    """Return the time records of a universal file; those of one channel are runs, in order."""
    parts = _of_type(path, _TIME)
    by_name: dict[str, list[tuple[int, dict[str, Any]]]] = {}
    for part in parts:
        name, sign = _named(part)
        by_name.setdefault(name, []).append((sign, part))
    counts = {name: len(found) for name, found in by_name.items()}
    if len(set(counts.values())) > 1:
        what = f"holds {counts} records of its channels, which do not form runs"
        raise refused(path, what[:200], "Export each channel once, or in every run.")
    step, start, size = _even(parts, path)
    names = sorted(by_name, key=channel_order)
    labels = [_label(by_name[name][0][1], path) for name in names]
    data = np.empty((next(iter(counts.values())), len(names), size))
    for row, name in enumerate(names):
        for run, (sign, part) in enumerate(by_name[name]):
            data[run, row] = sign * np.real(np.asarray(part["data"]))
    plain = [name.removeprefix("u ") for name in names]
    axes = uff_nodes(path).axes(np.array([int(p.partition(":")[0]) for p in plain if ":" in p]))
    for forces in (False, True):
        rows = [i for i, name in enumerate(names) if name.startswith("u ") == forces]
        turned, turn = turning([plain[i] for i in rows], axes, str(path))
        if not is_permutation(turn) and len({labels[i] for i in rows}) > 1:
            what = "holds channels in local directions with different units"
            raise unread(path, what, "Export them in global directions.")
        data[:, rows] = np.einsum("ab,rbt->rat", turn, data[:, rows])
        for i, name in zip(rows, turned, strict=True):
            names[i] = f"u {name}" if forces else name
    return RecordedChannels(names, labels, list(data), 1.0 / step, start)


def read_spectra(path: str | Path, *, scale: float | None = None) -> dict[str, Spectrum]:
    """Return the power spectral densities of a universal file, in SI, by channel.

    They are read from dataset 58, function type 9; cross spectra are not read.

    Parameters
    ----------
    path : str or Path
        A .uff, .unv or .uf file. Needs pyuff: pip install 'flexplant[uff]'.
    scale : float, optional
        Factor to SI, where the units of the file are not clear.

    Returns
    -------
    dict {channel: Spectrum}
        One-sided densities as the file holds them; channels as for `read_records`.

    Raises
    ------
    FlexplantError
        When the format is not known, holds no such spectra, or the file is damaged.
    ModelError
        When units are not known.

    Examples
    --------
    >>> import flexplant as fx
    >>> import numpy as np, os, pyuff, tempfile
    >>> one = pyuff.prepare_58(
    ...     func_type=9, binary=0, rsp_node=41, rsp_dir=3, ref_node=41, ref_dir=3,
    ...     x=np.array([1.0, 2.0]), data=np.array([4.0, 9.0]), abscissa_spec_data_type=18,
    ...     ordinate_spec_data_type=12, ordinate_axis_units_lab="(mm/s^2)^2/Hz",
    ...     orddenom_spec_data_type=0,
    ... )
    >>> with tempfile.TemporaryDirectory() as folder:
    ...     path = os.path.join(folder, "noise.uff")
    ...     pyuff.UFF(path).write_sets(one, "overwrite")
    ...     found = fx.io.read_spectra(path)
    >>> found["41:z"].psd.round(12)
    array([4.e-06, 9.e-06])
    """
    path = file_path(path)
    scale = None if scale is None else positive(scale, "scale")
    parts = _of_type(path, _DENSITY)
    found: dict[str, Spectrum] = {}
    for part in parts:
        name, _ = _named(part)
        if (
            whole_entry(part, "ref_node")
            and channel_of(part, "ref")[0] != channel_of(part, "rsp")[0]
        ):
            continue
        if name in found:
            raise refused(path, f"holds the density of {name} twice", "Export each once.")
        label = unit_text(part, "ordinate_axis_units_lab")
        factor = density_of(label) if scale is None else scale
        if factor is None:
            what = f"holds the density of {name} in {label or 'no unit'}, which is unknown"
            raise unread(path, what, "Say what brings the numbers to SI: scale=...")
        freq = np.asarray(part["x"], dtype=np.float64)
        found[name] = Spectrum(freq, factor * np.real(np.asarray(part["data"], dtype=complex)))
    if not found:
        raise refused(path, "holds cross spectra only", "Export densities of single channels.")
    return dict(sorted(found.items(), key=lambda item: channel_order(item[0])))


def _of_type(path: Path, kind: int) -> list[dict[str, Any]]:
    records = datasets(path, (58,))
    found = [part for part in records if whole_entry(part, "func_type") == kind]
    if not found:
        kinds = sorted({whole_entry(part, "func_type") for part in records})
        what = _FUNCTIONS[kind][0]
        told = f"holds no {what}: {len(records)} records 58 of function types {kinds}"
        others = [f"flexplant.io.{_FUNCTIONS[one][1]}" for one in kinds if one in _FUNCTIONS]
        do = f"Read what is there: {', '.join(others)}." if others else f"Export a {what}."
        raise refused(path, f"{told} (1 is time, 4 a frequency response, 9 a density)", do)
    return found


def _named(part: dict[str, Any]) -> tuple[str, int]:
    """Return the name of a channel, forces as inputs are named, and the sign of its direction."""
    name, sign = channel_of(part, "rsp")
    force = whole_entry(part, "ordinate_spec_data_type") == _FORCE
    return f"u {name}" if force and ":" in name else name, sign


def _label(part: dict[str, Any], path: Path) -> str:
    """Return the unit of a channel; where the axis has none, that of dataset 164 if it is SI."""
    label = unit_text(part, "ordinate_axis_units_lab")
    kind = whole_entry(part, "ordinate_spec_data_type")
    if label or kind not in (*KINDS, _FORCE):
        return label
    factors = next(iter(datasets(path, (164,))), {"length": 1.0, "force": 1.0})
    if float(factors["length"]) != 1.0 or float(factors["force"]) != 1.0:
        what = "holds channels without units, and numbers that are not SI by dataset 164"
        raise unread(path, what, "Export the labels of the units with them.")
    return "N" if kind == _FORCE else "m" + PER_TIME[ORDERS[KINDS[kind]]]


def _even(parts: list[dict[str, Any]], path: Path) -> tuple[float, float, int]:
    """Return the common step [s] of all records, the first time and the number of samples."""
    grids: set[tuple[float, float, int]] = set()
    for part in parts:
        x: FloatArray = np.asarray(part["x"], dtype=np.float64)
        step = float(x[-1] - x[0]) / max(x.size - 1, 1)
        # times in single precision
        even = x.size > 1 and step > 0 and np.abs(np.diff(x) / step - 1.0).max() < 0.5
        if whole_entry(part, "abscissa_spec_data_type") not in (0, 1, 17) or not even:
            what = f"holds a record of {_named(part)[0]} that is not over time in equal steps"
            raise refused(path, what, "Export it evenly sampled.")
        inc = float(part.get("abscissa_inc") or 0.0)
        listed = whole_entry(part, "abscissa_spacing") == 1 and inc > 0
        grids.add((inc if listed else step, float(x[0]), x.size))
    if len(grids) > 1:
        shown = [
            f"{size} samples of {step:.6g} s from {x0:g} s" for step, x0, size in sorted(grids)
        ]
        raise refused(path, f"holds records on several grids: {shown[:4]}", "Export all alike.")
    return next(iter(grids))

"""Time records of measuring systems, with names, sampling rate and units."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import numpy as np

from ..arrays import positive
from ..errors import FlexplantError
from ..simulation import Response
from .files import file_path, refused, unread
from .record_tables import RecordedChannels, read_lvm, read_table_records
from .uff_times import UNIVERSAL, read_uff_records
from .unit_labels import unit_of

#: function by suffix that reads the channels of a file
RECORD_READERS: dict[str, Callable[[Path], RecordedChannels]] = {
    **dict.fromkeys(UNIVERSAL, read_uff_records),
    ".lvm": read_lvm,
    **dict.fromkeys((".csv", ".txt", ".tsv", ".dat", ".asc"), read_table_records),
}


def read_records(path: str | Path, *, rate: float | None = None) -> Response:
    r"""Return the time records of a file, in SI, with their names, sampling rate and units.

    The suffix determines the format: universal files .uff, .unv (dataset 58 of function type 1),
    LabVIEW .lvm, and tables .csv, .txt with the names of the channels above the numbers.

    Parameters
    ----------
    path : str or Path
        The file. Universal files need pyuff: pip install 'flexplant[uff]'.
    rate : float [Hz], optional
        Sampling rate, where the file holds neither times nor a rate.

    Returns
    -------
    Response
        ``found["acc"]`` is the record of a channel, with the shape (n_time,), or (n_runs, n_time)
        if each channel was recorded several times. `found.rate` is the sampling rate [Hz], and
        `found.units` are the units. Known units are converted (g to m/s^2). Numbers in unknown
        units are unchanged, and the channel is missing in `units`. Channels of universal files are
        named by node and direction: motions "41:z", forces "u 41:z".

    Raises
    ------
    FlexplantError
        When the format is not known, holds no time records, or the file is damaged. The message
        names the line.
    ModelError
        When no rate is known, or `rate` is given although the file holds one. Also when samples
        were not taken in equal steps.

    See Also
    --------
    flexplant.estimate_frf, flexplant.identification.impact_frf : frequency responses from records.
    flexplant.io.read_spectra : power spectral densities of universal files.

    Examples
    --------
    >>> import flexplant as fx
    >>> import pathlib, tempfile
    >>> file = pathlib.Path(tempfile.mkdtemp(), "logger.csv")
    >>> lines = ["Time [s];force [N];acc [g]", "0,0;1,5;0,0", "0,5;2,5;1,0", "1,0;0,5;0,0"]
    >>> _ = file.write_text("\n".join(lines))
    >>> found = fx.io.read_records(file)
    >>> found.rate, dict(found.units), found["acc"].tolist()
    (2.0, {'force': 'N', 'acc': 'm/s^2'}, [0.0, 9.80665, 0.0])
    """
    path = file_path(path)
    read = RECORD_READERS.get(path.suffix.lower())
    if read is None:
        known = ", ".join(RECORD_READERS)
        raise FlexplantError(
            f"{path.name!r} is not in a known format of time records; known are {known}. "
            "Export it as one of these, or pass arrays with their rate to estimate_frf."
        )
    found = read(path)
    if (rate is None) == (found.rate is None):
        if rate is None:
            what, do = "holds neither times nor a sampling rate", "Give rate=... [Hz]."
        else:
            what, do = f"holds its sampling rate, {found.rate:.6g} Hz", "Leave rate= out."
        raise unread(path, what, do)
    fast = found.rate or positive(rate, "rate")
    sizes = [unit_of(label) for label in found.labels]
    if len({run.shape for run in found.runs}) > 1:
        lengths = sorted({run.shape[1] for run in found.runs})
        raise refused(path, f"holds runs of {lengths} samples", "Export runs of one length.")
    data = np.stack(found.runs) * np.array([[one[0] if one else 1.0] for one in sizes])
    time = found.start + np.arange(data.shape[2]) / fast
    units = {name: one[1] for name, one in zip(found.names, sizes, strict=True) if one}
    return Response(time, data[0] if len(data) == 1 else data, found.names, units=units)

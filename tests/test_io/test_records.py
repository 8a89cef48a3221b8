"""Time records: files that are written here by their descriptions, with random channels."""

import numpy as np
import pytest
from scipy.spatial.transform import Rotation
from test_uff import nodes, record, systems, written

import flexplant as fx
import shared_data
from flexplant.errors import FlexplantError, ModelError
from flexplant.io import read_records, read_spectra

#: label: size in SI, unit of SI
UNITS = {
    "m/s^2": (1.0, "m/s^2"),
    "m/s²": (1.0, "m/s^2"),
    "mm/s2": (1e-3, "m/s^2"),
    "g": (9.80665, "m/s^2"),
    "um": (1e-6, "m"),
    "µm": (1e-6, "m"),
    "in/s": (0.0254, "m/s"),
    "mrad": (1e-3, "rad"),
    "N": (1.0, "N"),
    "kN": (1e3, "N"),
    "mV": (1e-3, "V"),
    "bar": (1.0, None),
    "": (1.0, None),
}


def channels(rng, count):
    """Names and labels of units of some channels, and records (count, n_time)."""
    names = [f"{kind} {i}" for i, kind in enumerate(rng.choice(["acc", "F", "Weg"], count))]
    labels = rng.choice(list(UNITS), count).tolist()
    return names, labels, rng.normal(size=(count, int(rng.integers(20, 60))))


def check(found, names, labels, data, rate, *, digits=1e-9):
    assert tuple(found) == tuple(names)
    assert found.rate == pytest.approx(rate, rel=1e-6)
    for name, label, row in zip(names, labels, data, strict=True):
        size, unit = UNITS[label]
        np.testing.assert_allclose(found[name], size * row, rtol=digits, atol=digits * size)
        assert found.units.get(name) == unit


@pytest.mark.parametrize("seed", range(24))
def test_tables_of_loggers(tmp_path, seed):
    """Any mark between cells, decimal commas, units in brackets or below, text above."""
    rng = np.random.default_rng(seed)
    names, labels, data = channels(rng, int(rng.integers(1, 5)))
    rate = float(rng.choice([512.0, 1000.0, 5120.0, 12800.0, 51200.0]))
    mark = rng.choice([";", "\t", ","])
    timed, ms, below = rng.random() < 0.7, rng.random() < 0.5, rng.random() < 0.5
    # a logger prints its times with a few digits
    time = np.round(np.arange(data.shape[1]) / rate, 7) * (1e3 if ms else 1.0)
    left, right = rng.choice(["[]", "()"])
    head = ["Device: L7", "recorded 2024-05-01", ""][: int(rng.integers(0, 4))]
    if not timed:
        head += [f"Sampling rate{rng.choice([':', mark])} {rate:g} Hz"]
    titles = [f"{name} {left}{label}{right}" for name, label in zip(names, labels, strict=True)]
    rows = data.T
    columns = names
    if timed:
        titles = [f"Time {left}{'ms' if ms else 's'}{right}", *titles]
        columns, rows = ["Time", *names], np.column_stack([time, data.T])
    if not timed and len(names) == 1:
        mark = ";"
    if below:
        units = [*(["ms" if ms else "s"] if timed else []), *labels]
        head += [mark.join(columns), mark.join(units)]
    else:
        head += [mark.join(titles)]
    texts = [[f"{x:.10g}" for x in row] for row in rows.tolist()]
    if mark != "," and rng.random() < 0.5:
        texts = [[cell.replace(".", ",") for cell in row] for row in texts]
    end = mark if rng.random() < 0.3 and len(rows[0]) > 1 else ""
    lines = [*head, *(mark.join(row) + end for row in texts)]
    path = tmp_path / "logger.csv"
    path.write_bytes("\r\n".join(lines).encode(rng.choice(["latin-1", "utf-8", "utf-8-sig"])))
    if not timed and len(names) == 1:  # one number a line may be anything
        return
    found = read_records(path)
    if below and not any(labels):
        labels = [""] * len(labels)
    check(found, names, labels, data, rate)


def lvm(rng, names, labels, segments, dt, *, columns, comma, point):
    """Segments of a LabVIEW measurement: (first time, data (n, n_time))."""
    mark = "," if comma else "\t"

    def number(x):
        return f"{x:.9f}".replace(".", point)

    head = [
        "LabVIEW Measurement",
        f"Writer_Version{mark}2",
        "Reader_Version" + mark + "2",
        f"Separator{mark}{'Comma' if comma else 'Tab'}",
        f"Decimal_Separator{mark}{point}",
        f"Multi_Headings{mark}{'Yes' if len(segments) > 1 else 'No'}",
        f"X_Columns{mark}{columns}",
        f"Time_Pref{mark}Absolute",
        "***End_of_Header***" + mark,
        "",
    ]
    lines, count = head, len(names)
    for x0, data in segments:
        n = data.shape[1]
        lines += [
            mark.join(["Channels", str(count)]),
            mark.join(["Samples", *[str(n)] * count]),
            mark.join(["Date", *["2024/05/01"] * count]),
            mark.join(["Y_Unit_Label", *labels]),
            mark.join(["X_Dimension", *["Time"] * count]),
            mark.join(["X0", *[number(x0)] * count]),
            mark.join(["Delta_X", *[number(dt)] * count]),
            "***End_of_Header***" + mark * count,
        ]
        if columns == "Multi":
            lines.append(mark.join([item for name in names for item in ("X_Value", name)]))
        else:
            lines.append(mark.join(["X_Value", *names, "Comment"]))
        for k in range(n):
            x = number(x0 + k * dt)
            values = [number(v) for v in data[:, k]]
            if columns == "Multi":
                lines.append(mark.join([item for v in values for item in (x, v)]))
            else:
                lines.append(mark.join([x if columns == "One" else "", *values]))
        lines.append("")
    return "\n".join(lines)


@pytest.mark.parametrize("seed", range(18))
def test_labview_measurements(tmp_path, seed):
    """Segments that follow each other are one record, those that begin again are runs."""
    rng = np.random.default_rng(seed)
    names, labels, data = channels(rng, int(rng.integers(1, 5)))
    dt = float(rng.choice([1e-3, 5e-4, 2e-3]))
    comma = rng.random() < 0.5
    options = {
        "columns": ["No", "One", "Multi"][seed % 3],
        "comma": comma,
        "point": "." if comma else rng.choice([".", ","]),
    }
    parts = np.array_split(data, int(rng.integers(1, 4)), axis=1)
    begins = np.cumsum([0, *(part.shape[1] for part in parts[:-1])]) * dt
    path = tmp_path / "run.lvm"
    segments = list(zip(begins, parts, strict=True))
    path.write_bytes(lvm(rng, names, labels, segments, dt, **options).encode("latin-1"))
    check(read_records(path), names, labels, data, 1 / dt, digits=2e-9)
    again = [(0.0, data), (0.0, -2 * data)]
    path.write_bytes(lvm(rng, names, labels, again, dt, **options).encode("utf-8"))
    found = read_records(path)
    check(found.replace(data=found.data[1]), names, labels, -2 * data, 1 / dt, digits=2e-9)
    assert found[names[0]].shape == (2, data.shape[1])


def time_record(node, direction, data, rate, label, kind, **changes):
    n = data.size
    fields = {
        "func_type": 1,
        "x": np.arange(n) / rate,
        "abscissa_inc": 1 / rate,
        "abscissa_min": 0.0,
        "num_pts": n,
        "abscissa_spec_data_type": 17,
        "ordinate_spec_data_type": kind,
        "orddenom_spec_data_type": 0,
        "ordinate_axis_units_lab": label,
        "orddenom_axis_units_lab": "NONE",
    }
    return record((node, direction), (0, 0), data, **(fields | changes))


@pytest.mark.parametrize("binary", [0, 1])
@pytest.mark.parametrize("runs", [1, 3])
def test_universal_files_become_an_frf(tmp_path, binary, runs):
    """Forces and accelerations of one point, in any order, of either sign, in g and kN."""
    rng = np.random.default_rng(runs)
    rate, n = 2048.0, 1024
    force, acc = rng.normal(size=(runs, n)), rng.normal(size=(2, runs, n))
    sets = []
    for run in range(runs):
        sets.append(time_record(7, 3, force[run] / 1e3, rate, "kN", 13, binary=binary))
        sets.append(time_record(7, -3, -acc[0, run] / 9.80665, rate, "g", 12, binary=binary))
        sets.append(time_record(9, 1, acc[1, run], rate, "m/s^2", 12, binary=binary))
    found = read_records(written(tmp_path, sets))
    assert tuple(found) == ("7:z", "u 7:z", "9:x") or set(found) == {"7:z", "u 7:z", "9:x"}
    assert found.rate == pytest.approx(rate)
    assert found.units == {"u 7:z": "N", "7:z": "m/s^2", "9:x": "m/s^2"}
    shape = (n,) if runs == 1 else (runs, n)
    for name, data in (("u 7:z", force), ("7:z", acc[0]), ("9:x", acc[1])):
        np.testing.assert_allclose(found[name], data.reshape(shape), rtol=1e-5, atol=1e-5)
    outputs = {name: found[name] for name in ("7:z", "9:x")}
    frf = fx.estimate_frf({"u 7:z": found["u 7:z"]}, outputs, found.rate)
    known = fx.estimate_frf(force[:, None], np.moveaxis(acc, 0, 1), rate)
    np.testing.assert_allclose(frf.data, known.data, rtol=1e-3, atol=1e-3)


def test_records_of_local_directions_are_turned(tmp_path):
    turn = Rotation.from_euler("zyx", [30, 40, 50], degrees=True).as_matrix()
    system = systems(CS_sys_labels=[5], CS_matrices=[np.vstack([turn.T, np.zeros(3)])])
    moved = nodes(2411, node_nums=[1, 2], disp_cs=[5, 0])
    data = np.random.default_rng(1).normal(size=(3, 64))
    local = turn.T @ data
    sets = [time_record(1, i + 1, local[i], 100.0, "m/s^2", 12) for i in range(3)]
    found = read_records(written(tmp_path, [system, moved, *sets]))
    for name, row in zip(("1:x", "1:y", "1:z"), data, strict=True):
        np.testing.assert_allclose(found[name], row, atol=1e-5)
    with pytest.raises(ModelError, match="node 1 move along"):
        read_records(written(tmp_path, [system, moved, sets[0]]))


@pytest.mark.parametrize(
    ("label", "size"), [("g^2/Hz", 9.80665**2), ("(mm/s^2)^2/Hz", 1e-6), ("N**2/Hz", 1.0)]
)
def test_power_spectral_densities(tmp_path, label, size):
    freq, psd = np.arange(32) * 0.5, np.random.default_rng(2).uniform(1, 2, 32)
    changes = {"func_type": 9, "x": freq, "ordinate_axis_units_lab": label, "abscissa_inc": 0.5}
    changes |= {"orddenom_axis_units_lab": "NONE", "orddenom_spec_data_type": 0}
    changes |= {"ordinate_spec_data_type": 13 if label[0] == "N" else 12, "abscissa_min": 0.0}
    auto = record((4, 2), (4, 2), psd, **changes)
    cross = record((4, 2), (5, 2), psd + 1j, **changes)
    name = "u 4:y" if label[0] == "N" else "4:y"
    path = written(tmp_path, [cross, auto])
    found = read_spectra(path)
    assert list(found) == [name]
    np.testing.assert_allclose(found[name].psd, size * psd, rtol=1e-5)
    np.testing.assert_allclose(found[name].freq, freq)
    np.testing.assert_allclose(read_spectra(path, scale=2.0)[name].psd, 2 * psd, rtol=1e-5)
    with pytest.raises(FlexplantError, match=r"no time record.*\[9\].*io\.read_spectra"):
        read_records(path)
    unknown = record((4, 2), (4, 2), psd, **(changes | {"ordinate_axis_units_lab": "EU"}))
    with pytest.raises(ModelError, match="scale="):
        read_spectra(written(tmp_path, [unknown]))
    with pytest.raises(FlexplantError, match="cross spectra only"):
        read_spectra(written(tmp_path, [cross]))


def test_what_is_no_record_is_said(tmp_path):
    def table(text, name="a.csv"):
        path = tmp_path / name
        path.write_text(text)
        return path

    rows = "".join(f"{k / 100:.2f},{k}\n" for k in range(9))
    assert read_records(table(f"Time (s),a\n{rows}")).rate == pytest.approx(100.0)
    with pytest.raises(ModelError, match=r"equal steps: 0\.01 s, and 0\.02 s before line 6"):
        read_records(table("t,a\n" + rows.replace("0.04,4\n", "")))
    with pytest.raises(ModelError, match="neither times nor a sampling rate"):
        read_records(table("b,a\n1,2\n3,4\n"))
    assert read_records(table("b,a\n1,2\n3,4\n"), rate=8.0).rate == pytest.approx(8.0)
    with pytest.raises(ModelError, match=r"holds its sampling rate, 100 Hz.*Leave rate= out"):
        read_records(table(f"t,a\n{rows}"), rate=8.0)
    with pytest.raises(FlexplantError, match=r"line 7: 2 numbers are expected, got '0\.05,over'"):
        read_records(table(f"t,a\n{rows}".replace("0.05,5", "0.05,over")))
    with pytest.raises(FlexplantError, match="no names above"):
        read_records(table(rows))
    with pytest.raises(FlexplantError, match="no two lines of numbers"):
        read_records(table("t,a\n12:00:01,5\n12:00:02,6\n"))
    with pytest.raises(FlexplantError, match=r"not in a known format of time records.*\.lvm"):
        read_records(table(rows, "a.tdms"))
    with pytest.raises(FlexplantError, match="not a LabVIEW measurement file"):
        read_records(table(rows, "a.lvm"))
    text = lvm(None, ["a"], ["V"], [(0.0, np.ones((1, 9)))], 1e-3,
               columns="One", comma=False, point=".")  # fmt: skip
    with pytest.raises(FlexplantError, match="9 samples are expected, fewer follow"):
        read_records(table("\n".join(text.splitlines()[:-3]), "a.lvm"))
    with pytest.raises(FlexplantError, match="several grids"):
        one = np.ones(8)
        sets = [time_record(1, 1, one, rate, "V", 0) for rate in (10.0, 20.0)]
        sets[1]["rsp_dir"] = 2
        read_records(written(tmp_path, sets))


@shared_data.needs(shared_data.data_file("fe/uff/Sample_UFF58b_bin.uff"))
def test_a_real_binary_file():
    pyuff = pytest.importorskip("pyuff")
    path = shared_data.data_file("fe/uff/Sample_UFF58b_bin.uff")
    parts = pyuff.UFF(str(path)).read_sets()
    parts = [part for part in np.atleast_1d(parts).tolist() if part["type"] == 58]
    found = read_records(path)
    assert found.rate == pytest.approx(1 / parts[0]["abscissa_inc"], rel=1e-6)
    assert found.time.size == parts[0]["num_pts"]

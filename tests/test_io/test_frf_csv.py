"""FRFs as CSV: read by the csv module alone and read back to the bit."""

import csv

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from flexplant.errors import FlexplantError, LabelError, ModelError
from flexplant.io import read_frf_csv, write_frf_csv
from flexplant.lti import Frf


def an_frf(**changes):
    rng = np.random.default_rng(5)
    fields = {
        "freq": [0.0, 1.0, 10.0 / 3.0],
        "data": rng.standard_normal((2, 2, 3)) + 1j * rng.standard_normal((2, 2, 3)) * 1e-12,
        "inputs": ["u1", 'a "quoted", name'],
        "outputs": ["die:z", "y1 [mean]"],
        "quantity": "velocity",
    }
    return Frf(**(fields | changes))


def test_the_table_as_others_read_it(tmp_path):
    frf = an_frf(coherence=np.full((2, 2, 3), 0.25))
    write_frf_csv(tmp_path / "frf.csv", frf, units={"die:z": "rad/s"})
    lines = (tmp_path / "frf.csv").read_text().splitlines()
    assert lines[0] == "# quantity: velocity"
    header, *rows = csv.reader(lines[1:])
    assert header[:4] == [
        "frequency [Hz]",
        "die:z <- u1 real [rad/s/N]",
        "die:z <- u1 imag [rad/s/N]",
        "die:z <- u1 coherence",
    ]
    assert header[-2] == 'y1 [mean] <- a "quoted", name imag [m/s/N]'
    table = np.array(rows, dtype=float)
    assert table.shape == (3, 1 + 4 * 3)
    assert np.array_equal(table[:, 0], frf.freq)
    assert np.array_equal(table[:, 1] + 1j * table[:, 2], frf["die:z", "u1"])
    assert np.array_equal(table[:, -3] + 1j * table[:, -2], frf.data[1, 1])
    assert np.array_equal(table[:, -1], [0.25] * 3)


@pytest.mark.parametrize("quantity", [None, "displacement", "velocity", "acceleration"])
@pytest.mark.parametrize("known", [True, False])
def test_it_comes_back(tmp_path, quantity, known):
    frf = an_frf(quantity=quantity, coherence=np.full((2, 2, 3), 1 / 3) if known else None)
    frf = frf.replace(variance=np.arange(12.0).reshape(2, 2, 3) / 7 if known else None)
    write_frf_csv(tmp_path / "frf.csv", frf)
    found = read_frf_csv(tmp_path / "frf.csv")
    assert np.array_equal(found.freq, frf.freq)
    assert np.array_equal(found.data, frf.data)
    assert (found.inputs, found.outputs) == (frf.inputs, frf.outputs)
    assert found.quantity == quantity
    assert (found.coherence is not None) == known
    if known:
        assert np.array_equal(found.coherence, frf.coherence)
        assert np.array_equal(found.variance, frf.variance)


NUMBERS = st.floats(-1e99, 1e99)
NAMES = st.text("abuy1:/ <[-],\"'", min_size=1, max_size=8).map(lambda text: f"x{text}x")


@pytest.mark.slow
@given(
    st.lists(NUMBERS, min_size=4, max_size=4), st.lists(NAMES, min_size=3, max_size=3, unique=True)
)
def test_any_numbers_and_names(tmp_path_factory, numbers, names):
    path = tmp_path_factory.getbasetemp() / "any.csv"
    data = np.array(numbers).reshape(2, 1, 2) * (1 + 1j)
    frf = Frf([1.0, 2.0], data, inputs=names[:1], outputs=names[1:])
    if any(" <- " in name for name in names):
        with pytest.raises(LabelError, match="rename the channel"):
            write_frf_csv(path, frf)
        return
    write_frf_csv(path, frf)
    found = read_frf_csv(path)
    assert np.array_equal(found.data, frf.data)
    assert (found.inputs, found.outputs) == (frf.inputs, frf.outputs)


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ("", "no header"),
        ("f,a,b\n1,2,3\n", "no header"),
        ("frequency [Hz],y real,y imag\n1,2,3\n", r"'y real' is not like 'y1 <- u1 real"),
        ("frequency [Hz],y <- u real,y <- u real\n1,2,3\n", r"lacks or doubles.*y <- u imag"),
        ("# x\nfrequency [Hz],y <- u real,y <- u imag\n1,2,3\n4,5\n", r"2 numbers in line 4"),
        ("frequency [Hz],y <- u real,y <- u imag\n1,2,x\n", r"line 2: 'x' is not a decimal number"),
    ],
)
def test_other_files_are_refused(tmp_path, text, words):
    (tmp_path / "frf.csv").write_text(text)
    with pytest.raises(FlexplantError, match=words):
        read_frf_csv(tmp_path / "frf.csv")


def test_bad_numbers_and_arguments(tmp_path):
    path = tmp_path / "frf.csv"
    path.write_text("frequency [Hz],y <- u real,y <- u imag\n2,1,1\n1,1,1\n")
    with pytest.raises(ModelError, match="increase strictly"):
        read_frf_csv(path)
    path.write_text("frequency [Hz],y <- u real,y <- u imag\n2,nan,1\n")
    with pytest.raises(FlexplantError, match="line 2: 'nan' is not a decimal number"):
        read_frf_csv(path)
    with pytest.raises(ModelError, match="frf must be of type Frf, got list"):
        write_frf_csv(path, [1])
    with pytest.raises(LabelError, match="units name 'y9'"):
        write_frf_csv(path, an_frf(), units={"y9": "m"})


@pytest.mark.parametrize("encoding", ["latin-1", "utf-8", "cp1252"])
def test_units_in_the_encoding_of_older_programs(tmp_path, encoding):
    frf = an_frf(inputs=["u1", "Tür"], outputs=["y1", "y2"])
    write_frf_csv(tmp_path / "frf.csv", frf, units={"y1": "µm/s²", "y2": "m/s²"})
    text = (tmp_path / "frf.csv").read_bytes().decode("utf-8")
    (tmp_path / "old.csv").write_bytes(text.encode(encoding))
    found = read_frf_csv(tmp_path / "old.csv")
    assert found.inputs == ("u1", "Tür")
    assert np.array_equal(found.data, frf.data)
    (tmp_path / "damaged.csv").write_bytes(text.encode("latin-1") + b"\x00\xff")
    with pytest.raises(FlexplantError, match="is not UTF-8 text"):
        read_frf_csv(tmp_path / "damaged.csv")

"""Numbers in text files: read as Fortran and C write them, or refused with their line."""

import numpy as np
import pytest

import flexplant as fx
from flexplant.errors import FlexplantError
from flexplant.io.files import decimal, fixed_numbers, rows_of_numbers, wrong_line

#: what a program may print for 7500
RIGHT = ["7.5D+03", "7.5d3", "7.5+03", "7500", "7.5E+003", "+7500.", "75.Q+2"]
#: what no program should, and what may not be taken for its first digits
WRONG = ["7,5", "0x10", "1_0", "7.5E", "7.5e+", "12.3.4", "7 5", "nan", "inf", "abc", "--5", "***"]


def matrix_market(word):
    return f"%%MatrixMarket matrix coordinate real symmetric\n% by hand\n\n2 2 2\n1 1 {word}\n2 2 3"


def matrix_market_array(word):
    return f"%%MatrixMarket matrix array real general\n2 2\n% four\n0\n0\n{word}\n3"


def harwell_boeing(word):
    sizes = ["".join(f"{c:14d}" for c in row) for row in ((3, 1, 1, 1, 0), (2, 2, 2, 0))]
    head = ["K", sizes[0], f"{'RSA':14s}{sizes[1]}", f"{'(3I4)':16s}{'(2I4)':16s}{'(2E12.5)':20s}"]
    return "\n".join([*head, "   1   2   3", "   1   2", f"{word:>12s}{'3.0':>12s}"])


def dmig_free(word):
    return f"DMIG,KAAX,0,6,2,0,,,2\nDMIG,KAAX,1,3,,1,3,{word}\nDMIG,KAAX,2,3,,2,3,3.\n"


def dmig_small(word):
    card = "DMIG    KAAX    {0}       3               {0}       3       {1:>8s}\n"
    return "DMIG    KAAX    0       6       2\n" + card.format(1, word) + card.format(2, "3.")


def dmig_large(word):
    card = "DMIG*   KAAX                           {0}               3\n"
    card += "*                      {0}               3{1:>16s}\n"
    return "DMIG    KAAX    0       6       2\n" + card.format(1, word) + card.format(2, "3.")


def abaqus(word):
    return f"** by hand\n1,3,1,3,{word}\n2,3,2,3,3.0\n"


def abaqus_coordinate(word):
    return f"1 1 {word}\n2 2 3.0\n"


FORMATS = {
    matrix_market: (fx.io.read_matrix_market, ".mtx", 5),
    matrix_market_array: (fx.io.read_matrix_market, ".mtx", 6),
    harwell_boeing: (fx.io.read_harwell_boeing, ".rsa", 7),
    dmig_free: (fx.io.read_dmig, ".pch", 2),
    dmig_small: (fx.io.read_dmig, ".pch", 2),
    dmig_large: (fx.io.read_dmig, ".pch", 3),
    abaqus: (fx.io.read_abaqus, ".mtx", 2),
    abaqus_coordinate: (fx.io.read_abaqus, ".mtx", 1),
}


@pytest.mark.parametrize("make", FORMATS, ids=lambda make: make.__name__)
def test_a_number_is_read_whole_or_refused_with_its_line(tmp_path, make):
    read, suffix, line = FORMATS[make]
    path = tmp_path / f"K{suffix}"
    for word in RIGHT:
        path.write_text(make(word))
        found = read(path).K.toarray()
        if make is matrix_market_array:  # a general one with its upper triangle
            assert found.tolist() == [[0, 7500], [7500, 3]], word
        else:
            assert found.tolist() == [[7500, 0], [0, 3]], word
    for word in WRONG:
        path.write_text(make(word))
        with pytest.raises(FlexplantError) as told:
            read(path)
        assert f"line {line}" in str(told.value) or "NaN or infinite" in str(told.value), word


@pytest.mark.parametrize("word", ["7,5", "0x10", "1_0", "nan"])
def test_tables_name_the_line_of_what_is_no_number(tmp_path, word):
    path = tmp_path / "t.csv"
    path.write_text(f"# by hand\nnode;direction;x;y;z\n\n1;z;0;0;0\n2;z;{word};0;0\n")
    with pytest.raises(FlexplantError, match=r"line 5, column 'x'"):
        fx.io.read_dofs(path)
    path.write_text("node;direction;x;y;z\n1;z;7.5D-01;-2.5-3;0\n")
    assert fx.io.read_dofs(path).xyz.tolist() == [[0.75, -0.0025, 0.0]]
    path.write_text(f"frequency [Hz],y1 <- u1 real,y1 <- u1 imag\n1,2,3\n2,{word},1\n")
    with pytest.raises(FlexplantError, match="line 3"):
        fx.io.read_frf_csv(path)


def test_abaqus_coordinates_and_scale_factors(tmp_path):
    (tmp_path / "K.mtx").write_text("*MATRIX INPUT, SCALE FACTOR=1.5D1\n1,3,1,3,2.0\n")
    (tmp_path / "a.inp").write_text("*NODE\n1, 1.5D-1, 2.-1, 0x3\n")
    with pytest.raises(FlexplantError, match=r"line 2.*0x3"):
        fx.io.read_abaqus(tmp_path / "K.mtx", inp=tmp_path / "a.inp")
    (tmp_path / "a.inp").write_text("*NODE\n1, 1.5D-1, 2.-1\n")
    found = fx.io.read_abaqus(tmp_path / "K.mtx", inp=tmp_path / "a.inp")
    assert found.K.toarray().tolist() == [[30.0]]
    assert found.dofs.xyz.tolist() == [[0.15, 0.2, 0.0]]
    (tmp_path / "K.mtx").write_text("*MATRIX INPUT, SCALE FACTOR=1x\n1,3,1,3,2.0\n")
    with pytest.raises(FlexplantError, match="SCALE FACTOR"):
        fx.io.read_abaqus(tmp_path / "K.mtx")


@pytest.mark.parametrize(
    ("body", "match"),
    [
        ("2 2 2\n1 1 1\n", "announces 2 entries and holds 1"),
        ("2 2 1\n1 1 1\n2 2 1\n", "announces 1 entries and holds 2"),
        ("2 2 2\n1 1 1\n2 2\n", "line 4"),
        ("2 2 1\n0 1 1\n", "row 0, column 1"),
        ("2 2 1\n3 1 1\n", "row 3, column 1"),
        ("2 2 1\n1.5 1 1\n", "row 1.5"),
        ("2 2\n1 1 1\n", "size of a matrix"),
        ("2 3 1\n1 1 1\n", "not square"),
        ("", "size of a matrix"),
        ("2 2 1\n99999999999999999999 1 1\n", r"row 1e\+20"),
        ("2 2 1\n1 1 1e400\n", "line 3.*finite"),
        ("2 2 3\n1 1 1\n2 1 -1\n1 2 -1\n", r"both \(2, 1\) and \(1, 2\)"),
        ("2 2 3\n1 1 1\n2 1 -1D0\n1 2 -1\n", r"both \(2, 1\) and \(1, 2\)"),
    ],
)
@pytest.mark.filterwarnings("error")
def test_matrix_market_entries_that_do_not_fit_are_refused(tmp_path, body, match):
    (tmp_path / "K.mtx").write_text(f"%%MatrixMarket matrix coordinate real symmetric\n{body}")
    with pytest.raises(FlexplantError, match=match):
        fx.io.read_matrix_market(tmp_path / "K.mtx")


@pytest.mark.parametrize("end", ["\n", "\r\n"])
def test_plain_matrix_market_lines_go_through_the_fast_reader(tmp_path, monkeypatch, end):
    """Every digit arrives, and the slower reader of any notation is not called."""
    values = np.random.default_rng(3).standard_normal(400) * 10.0 ** np.arange(-300, 100)
    lines = [f"{i} {i} {value!r}" for i, value in enumerate(values.tolist(), 1)]
    lines += ["7 3 -.5", "\t9 3  2.  ", "3 11 1E-3", "3 11 1e-3"]  # either triangle, one twice
    text = [f"%%MatrixMarket matrix coordinate real symmetric{end}400 400 {len(lines)}", *lines]
    (tmp_path / "K.mtx").write_bytes(end.join(text).encode())
    with monkeypatch.context() as patched:
        patched.setattr("flexplant.io.files.rows_of_numbers", None)
        fast = fx.io.read_matrix_market(tmp_path / "K.mtx").K.toarray()
    assert np.array_equal(np.diag(fast), values)
    assert fast[6, 2] == fast[2, 6] == -0.5
    assert fast[8, 2] == fast[2, 8] == 2.0
    assert fast[10, 2] == fast[2, 10] == 2e-3
    (tmp_path / "K.mtx").write_bytes(end.join(text).replace("1E-3", "1D-3").encode())
    assert np.array_equal(fx.io.read_matrix_market(tmp_path / "K.mtx").K.toarray(), fast)


def test_a_blank_within_a_field_does_not_shift_the_others():
    """Two numbers in one field beside an empty one have the right count."""
    assert fixed_numbers(b" 1 2     3.5", 4) is None
    assert fixed_numbers(b" 1.0-2.0 3.5", 4).tolist() == [1.0, -2.0, 3.5]
    assert rows_of_numbers(b"1 2 3\n4 5\n6 7 8 9\n", 3) is None
    assert wrong_line([b"1 2 3", b"", b"4 5", b"6"], 3) == 2
    assert rows_of_numbers(b"", 3).shape == (0, 3)


def test_every_float_is_read_as_python_reads_it():
    rng = np.random.default_rng(5)
    values = rng.normal(size=300) * 10.0 ** rng.integers(-300, 300, 300)
    words = [f"{v:.16e}" for v in values.tolist()]
    assert [decimal(w.replace("e", "D")) for w in words] == values.tolist()
    text = "\n".join(w.replace("e", "") for w in words).encode()
    assert rows_of_numbers(text, 1).ravel().tolist() == values.tolist()

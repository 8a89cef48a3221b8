"""OUTPUT4 files: every variant that pyYeti writes, real ones with a twin, and damaged ones."""

import contextlib

import numpy as np
import pytest
import scipy.io
import scipy.sparse as sp

import flexplant as fx
from flexplant.errors import FlexplantError, LabelError, ModelError
from flexplant.io import read_op4, read_op4_matrices
from shared_data import data_file, needs

SHARED = data_file("fe/nastran")


@pytest.fixture(scope="module")
def op4():
    with np.printoptions():  # importing it changes how all arrays are printed
        return pytest.importorskip("pyyeti.nastran.op4")


def matrices():
    rng = np.random.default_rng(1)
    mats = {
        "A": rng.normal(size=(7, 5)),
        "Z": np.zeros((4, 6)),
        "C": rng.normal(size=(9, 9)) + 1j * rng.normal(size=(9, 9)),
        "S": sp.random(300, 200, 0.02, rng=rng).toarray() * 1e-120,
    }
    mats["C"][2:4] = 0
    return mats


def dense(matrix):
    return matrix.toarray() if sp.issparse(matrix) else matrix


@pytest.mark.parametrize("endian", "<>")
@pytest.mark.parametrize("sparse", ["dense", "bigmat", "nonbigmat"])
@pytest.mark.parametrize("binary", [True, False])
def test_every_variant_of_pyyeti(op4, tmp_path, binary, sparse, endian):
    given = matrices()
    path = tmp_path / "x.op4"
    op4.write(path, given, binary=binary, sparse=sparse, endian=endian, digits=16)
    found = read_op4_matrices(path)
    assert list(found) == list(given)
    for name, matrix in given.items():
        assert np.array_equal(dense(found[name]), matrix), name
    if sparse != "dense":
        assert sp.issparse(found["S"])
    assert list(read_op4_matrices(path, names=["C", "A"])) == ["C", "A"]


@pytest.mark.parametrize("integer", [4, 8])
@pytest.mark.parametrize("marker", [4, 8])
@pytest.mark.parametrize("order", "<>")
def test_words_and_markers_of_any_length(tmp_path, order, marker, integer):
    """A column of single precision (or, of 8 byte words, double), a gap, and the last record."""

    def record(*parts):
        body = b"".join(parts)
        length = np.array(len(body), f"{order}i{marker}").tobytes()
        return length + body + length

    def whole(*numbers):
        return np.array(numbers, f"{order}i{integer}").tobytes()

    def real(*numbers):
        return np.array(numbers, f"{order}f{integer}").tobytes()

    name = b"KAA".ljust(2 * integer)
    content = record(whole(3, 4, 2, 1), name)
    content += record(whole(1, 2, 2), real(1.5, -2.5))
    content += record(whole(3, 1, 1), real(0.25))
    content += record(whole(4, 1, 1), real(1.0))
    # 65536 (L + 1) + row, for strings of L words
    content += record(whole(2, 4, 2, 1), b"MAA".ljust(2 * integer))
    first, second = whole(2 * 65536 + 1) + real(7.0), whole(3 * 65536 + 3) + real(8.0, 9.0)
    content += record(whole(2, 0, 5), first, second) + record(whole(3, 1, 1), real(1.0))
    path = tmp_path / "x.op4"
    path.write_bytes(content)
    found = read_op4_matrices(path)
    # words of 8 bytes hold type 1 in double precision
    path_of_K = tmp_path / "k.op4"
    square = record(whole(2, 2, 2, 1), name) + record(whole(1, 1, 2), real(2.0, -1.0))
    path_of_K.write_bytes(square + record(whole(3, 1, 1), real(1.0)))
    assert read_op4(path_of_K).digits == (7 if integer == 4 else None)
    expected = np.zeros((4, 3))
    expected[1:3, 0], expected[0, 2] = (1.5, -2.5), 0.25
    assert np.array_equal(found["KAA"], expected)
    assert found["MAA"].toarray().tolist() == [[0, 7], [0, 0], [0, 8], [0, 9]]
    # the form of many rows, with a length whose bytes have no number of 64 bits
    long = record(whole(2, 0, 4), whole(2 ** (8 * integer - 4) + 1, 1), real(7.0, 8.0))
    path.write_bytes(record(whole(2, -4, 2, 1), name) + long + record(whole(3, 1, 1), real(1.0)))
    with pytest.raises(FlexplantError, match="impossible length"):
        read_op4_matrices(path)


@needs(SHARED)
@pytest.mark.parametrize("name", ["nastran_op4_data_r_c_rc", "nastran_op4_data_double_bigmat_le"])
def test_files_of_nastran_have_their_twins_content(name):
    found = read_op4_matrices(SHARED / f"{name}.op4")
    wanted = scipy.io.loadmat(SHARED / "nastran_op4_data_r_c_rc.mat", spmatrix=False)
    assert len(found) == 3
    for key, matrix in found.items():
        twin = next(wanted[k] for k in wanted if k.upper() == key)
        assert dense(matrix) == pytest.approx(dense(twin), rel=1e-14, abs=0), key


@needs(SHARED)
def test_superelements_of_nastran_have_their_twins_content():
    path = SHARED / "nas2cam_extseout_nas2cam"
    found = read_op4_matrices(path.with_suffix(".op4"))
    twin = scipy.io.loadmat(path.with_suffix(".mat"), spmatrix=False)["nas"][0, 0]
    compared = 0
    for kind in ("kaa", "maa"):
        for part in (twin[kind][0, 0][name] for name in twin[kind].dtype.names):
            ours = [m for k, m in found.items() if k[:3] == kind.upper() and m.shape == part.shape]
            assert len(ours) == 1
            full = np.diag(part.ravel()) if 1 in part.shape else part
            assert dense(ours[0]) == pytest.approx(full, rel=1e-14, abs=0)
            compared += 1
    assert compared == 6


@needs(SHARED)
def test_integers_of_64_bits(op4):
    path = SHARED / "nastran_op4_data_binary_fabiola.op4"
    names, wanted, _, _ = op4.read(path, into="list")
    found = read_op4_matrices(path)
    assert [name.lower() for name in found] == names
    for ours, theirs in zip(found.values(), wanted, strict=True):
        assert np.array_equal(dense(ours), dense(theirs))


def test_text_of_other_formats(tmp_path):
    """D exponents, no letter before long ones, touching fields, numbers with no scale factor."""
    path = tmp_path / "x.op4"
    path.write_text(
        "       2       2       6       2KAA     2D12.4\n"
        "       1       1       2\n  0.1000D+01 -0.2500D+01\n"
        "       2       1       2\n -0.2500D+01  0.1234-101\n"
        "       3       1       1\n  1.0000D+00\n"
    )
    found = read_op4(path)
    assert found.K.toarray().tolist() == [[1.0, -2.5], [-2.5, 0.1234e-101]]
    assert found.digits == 4
    path.write_text(
        "       2       2       2       2KAA     1P,2E10.3\n"
        "       1       1       2\n-1.000E+00-2.500E+00\n"
        "       2       2       1\n 3.000E+00\n"
        "       3       1       1\n 1.000E+00\n"
    )
    assert read_op4_matrices(path)["KAA"].tolist() == [[-1.0, 0.0], [-2.5, 3.0]]


def test_digits_and_names(op4, tmp_path):
    K = np.array([[2.0, -1.0], [-1.0, 3.0]])
    path = tmp_path / "x.op4"
    op4.write(path, {"KAA": K, "MAA": np.eye(2), "UNUSED": np.ones((1, 3))}, binary=False, digits=9)
    found = read_op4(path)
    assert found.digits == 10  # 1P: one before the point
    assert np.array_equal(found.K.toarray(), K)
    assert np.array_equal(found.M.toarray(), np.eye(2))
    assert found.dofs is None
    assert found.D is None
    op4.write(path, {"KAA": K, "KGG": K}, binary=True)
    with pytest.raises(ModelError, match=r"holds \['KAA', 'KGG'\].*stiffness='KAA'"):
        read_op4(path)
    assert read_op4(path, stiffness="KGG").digits is None
    with pytest.raises(LabelError, match="no matrix 'KGF'"):
        read_op4(path, stiffness="KGF")
    with pytest.raises(LabelError, match="no matrix 'X'"):
        read_op4_matrices(path, names="X")
    op4.write(path, {"A": K})
    with pytest.raises(ModelError, match="but no usual name"):
        read_op4(path)
    op4.write(path, {"KAA": K * (1 + 0.1j)})
    lossy = read_op4(path)
    np.testing.assert_allclose(lossy.K.toarray(), K)
    assert lossy.loss_factor == pytest.approx(0.1)
    op4.write(path, {"KAA": K, "MAA": np.eye(2) * 1j})
    with pytest.raises(ModelError, match=r"MAA.*complex"):
        read_op4(path)


def test_a_triangle_of_a_symmetric_matrix_is_completed(op4, tmp_path):
    path = tmp_path / "x.op4"
    K = np.array([[2.0, -1.0, 0], [-1.0, 3.0, 1.0], [0, 1.0, 1.0]])
    for form, wanted in ((6, K), (1, np.tril(K))):
        op4.write(path, ["KAA"], [np.tril(K)], forms=[form])
        assert np.array_equal(read_op4(path).K.toarray(), wanted)


def test_doubled_names_are_kept_apart(op4, tmp_path):
    path = tmp_path / "x.op4"
    op4.write(path, ["K", "K", "K"], [np.eye(1), 2 * np.eye(1), 3 * np.eye(1)])
    assert {k: float(m[0, 0]) for k, m in read_op4_matrices(path).items()} == {
        "K": 1,
        "K_2": 2,
        "K_3": 3,
    }


@pytest.mark.parametrize("sparse", ["dense", "bigmat", "nonbigmat"])
@pytest.mark.parametrize("binary", [True, False])
@pytest.mark.slow
def test_cut_or_damaged_files_are_named(op4, tmp_path, binary, sparse):
    rng = np.random.default_rng(2)
    path, part = tmp_path / "x.op4", tmp_path / "part.op4"
    given = {"KAA": rng.normal(size=(11, 11)), "MAA": sp.random(40, 40, 0.1, rng=rng).toarray()}
    op4.write(path, given, binary=binary, sparse=sparse, digits=16)
    content = path.read_bytes()
    whole = 0
    for cut in np.linspace(0, len(content) - 3, 50).astype(int).tolist():
        part.write_bytes(content[:cut])
        try:
            found = read_op4_matrices(part)
        except FlexplantError as error:
            assert "byte" in str(error) or "line" in str(error)
        else:  # cut just between the two
            whole += 1
            assert list(found) == ["KAA"]
    assert whole <= 1
    for _ in range(100):
        spoiled = bytearray(content)
        spoiled[rng.integers(len(content))] = rng.integers(256)
        part.write_bytes(spoiled)
        with contextlib.suppress(FlexplantError):
            read_op4_matrices(part)


def test_what_is_no_op4(op4, tmp_path):
    path = tmp_path / "x.op4"
    path.write_bytes(b"\x00\x01" * 40)
    with pytest.raises(FlexplantError, match=r"byte 0.*copy it in binary mode"):
        read_op4(path)
    path.write_text("# quantity: unknown\nfrequency [Hz]\n1, 2, 3\n")
    with pytest.raises(FlexplantError, match="line 1: 4 whole numbers are due"):
        read_op4(path)
    op4.write(path, {"KAA": np.array([[np.nan]])})
    with pytest.raises(FlexplantError, match=r"KAA.*NaN"):
        read_op4(path)
    path.write_bytes(np.array([24, 2**30, 2**30, 2, 2], "<i4").tobytes() + b"KAA     ")
    with pytest.raises(FlexplantError, match="byte 0"):
        read_op4(path)
    with pytest.raises(FileNotFoundError):
        read_op4(tmp_path / "none.op4")


@pytest.mark.parametrize("kind", [3, 4])
def test_complex_text_whose_last_record_counts_words(tmp_path, kind):
    """Sparse, of either form: the count of the last, meaningless record is of words or numbers."""
    words = 4 if kind == 4 else 2
    numbers = " 1.500000000E+00-2.500000000E+00\n"
    for big in (False, True):
        head = f"{2:8}{-3 if big else 3:8}{2:8}{kind:8}{'C':8}1P,5E16.9\n"
        string = f"{words + 1:8}{2:8}\n" if big else f"{65536 * (words + 1) + 2:12}\n"
        text = f"{head}{2:8}{0:8}{words + (2 if big else 1):8}\n{string}{numbers}"
        text += f"{3:8}{1:8}{2:8}\n 1.000000000E+00\n"
        (tmp_path / "c.op4").write_text(text + text.replace("C   ", "D   "))
        found = read_op4_matrices(tmp_path / "c.op4")
        for name in "CD":
            assert found[name].toarray().tolist() == [[0, 0], [0, 1.5 - 2.5j], [0, 0]]


@needs(SHARED)
def test_superelements_whose_damping_is_a_null_of_one_entry(tmp_path):
    path = tmp_path / "inboard.op4"
    content = (SHARED / "extseout" / "inboard.op4").read_bytes()
    assert content.count(b"BXX1    ") == 1
    path.write_bytes(content.replace(b"BXX1    ", b"BXX     "))
    assert read_op4_matrices(path)["BXX"].shape == (1, 1)
    found = read_op4(path)
    assert found.n_dof == 32
    assert found.D is None
    # a real one is taken, unless none is wanted
    path.write_bytes(content.replace(b"MXX     ", b"BXX     "))
    assert read_op4(path).D is not None
    assert read_op4(path, damping=None).D is None
    assert fx.read_matrices(path).D is not None
    assert fx.read_matrices(path, damping=None).D is None


@needs(SHARED)
def test_names_in_words_of_eight_bytes():
    names = list(read_op4_matrices(SHARED / "extseout" / "nas2cam_notall6_msc2017.op4"))
    assert names[:4] == ["SE_START", "LAMBDA", "MAA", "KAA"]


@pytest.mark.parametrize("usual", [("KAA", "MAA", "BAA"), ("KGG", "MGG", "BGG"), ("K", "M", "B")])
@pytest.mark.parametrize("doubled", [0, 1, 2])
def test_a_matrix_that_the_file_holds_twice_must_be_named(op4, tmp_path, usual, doubled):
    """pyYeti writes them one behind the other; the third of a kind is another than the first."""
    rng = np.random.default_rng(doubled)
    names = [*usual, usual[doubled], usual[doubled]]
    given = [rng.normal(size=(4, 4)) for _ in names]
    given = [one @ one.T for one in given]
    path = tmp_path / "run.op4"
    op4.write(path, [name.lower() for name in names], given)
    option = ("stiffness", "mass", "damping")[doubled]
    first, second, third = usual[doubled], f"{usual[doubled]}_2", f"{usual[doubled]}_3"
    listed = rf"\['{first}', '{second}', '{third}'\], any of which may be the {option}"
    for read in (read_op4, fx.read_matrices):
        with pytest.raises(ModelError, match=listed):
            read(path)
    for name, place in ((first, doubled), (second, 3), (third, 4)):
        found = fx.read_matrices(path, **{option: name})
        chosen = (found.K, found.M, found.D)[doubled]
        np.testing.assert_allclose(dense(chosen), given[place], rtol=1e-12)

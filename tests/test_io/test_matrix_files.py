"""Matrix Market, Harwell-Boeing, MATLAB and NumPy files: written by others and read back."""

import sys

import numpy as np
import pytest
import scipy.io
import scipy.linalg as la
import scipy.sparse as sp

import flexplant as fx
from flexplant.errors import FlexplantError, FlexplantWarning, LabelError, ModelError, ShapeError
from flexplant.io import Format, models
from shared_data import data_file, needs

FE = data_file("fe")
needs_data = needs(FE)


def pair(n=6):
    """A grounded chain with awkward numbers."""
    rng = np.random.default_rng(1)
    k, m = 1000 * rng.random(n + 1), rng.random(n) + 0.5
    K = np.diag(k[:-1] + k[1:]) - np.diag(k[1:-1], 1) - np.diag(k[1:-1], -1)
    return K, np.diag(m)


def named(n=6):
    return fx.DofSet(np.arange(1, n + 1), ["z"] * n, np.column_stack([np.arange(n)] * 3))


def same(found, K, M=None, rtol=1e-15):
    np.testing.assert_allclose(found.K.toarray(), K, rtol=rtol)
    if M is not None:
        np.testing.assert_allclose(found.M.toarray(), M, rtol=rtol)


# Matrix Market


@pytest.mark.parametrize("symmetry", ["symmetric", "general"])
@pytest.mark.parametrize("dense", [False, True])
def test_matrix_market(tmp_path, symmetry, dense):
    K, M = pair()
    store = np.asarray if dense else sp.coo_array
    scipy.io.mmwrite(tmp_path / "K.mtx", store(K), symmetry=symmetry)
    scipy.io.mmwrite(tmp_path / "M.mtx", store(M), symmetry=symmetry)
    found = fx.io.read_matrix_market(tmp_path / "K.mtx", tmp_path / "M.mtx", dofs=named())
    same(found, K, M)
    assert found.digits >= 15
    assert found.source == "K.mtx"
    model = fx.read_model(tmp_path / "K.mtx", mass=tmp_path / "M.mtx", dofs=named())
    assert model.name == "K.mtx"
    np.testing.assert_array_equal(model.K.toarray(), found.K.toarray())


def test_a_general_matrix_market_file_with_one_triangle_is_completed(tmp_path):
    K, _ = pair()
    scipy.io.mmwrite(tmp_path / "K.mtx", sp.coo_array(np.triu(K)), symmetry="general")
    found = fx.io.read_matrix_market(tmp_path / "K.mtx")
    same(found, K)
    assert found.notes == ("K: upper triangle only, completed",)


def test_numbers_count_from_one_and_their_digits_are_counted(tmp_path):
    path = tmp_path / "K.mtx"
    path.write_text(
        "%%MatrixMarket matrix coordinate real symmetric\n% a comment\n\n2 2 3\n"
        "1 1  1.234567890E+03\n2 1 -1.000000000E0\n2 2  2.500000000E0\n"
    )
    found = fx.io.read_matrix_market(path)
    same(found, [[1234.56789, -1.0], [-1.0, 2.5]])
    assert found.digits == 10
    # among numbers of any length, no program has rounded them to the longest
    path.write_text(
        path.read_text().replace("1.000000000E0", "1.0").replace("2.500000000E0", "2.5")
    )
    assert fx.io.read_matrix_market(path).digits is None
    path.write_text("%%MatrixMarket matrix coordinate real symmetric\n2 2 2\n1 1 5.\n2 2 -2.5\n")
    assert fx.io.read_matrix_market(path).digits is None  # short numbers were not rounded
    path.write_text("%%MatrixMarket matrix coordinate integer general\n1 1 1\n1 1 123456789\n")
    assert fx.io.read_matrix_market(path).digits is None


@pytest.mark.parametrize(
    ("text", "error", "match"),
    [
        ("1 1 3.0\n", FlexplantError, "Abaqus"),
        ("%%MatrixMarket matrix coordinate complex symmetric\n1 1 1\n1 1 1 1", ModelError, "comp"),
        ("%%MatrixMarket matrix coordinate pattern general\n1 1 1\n1 1\n", ModelError, "pattern"),
        ("%%MatrixMarket matrix coordinate real skew-symmetric\n2 2 1\n2 1 1", ModelError, "skew"),
        ("%%MatrixMarket matrix coordinate real general\n2 2 3\n1 1 1\n", FlexplantError, "cut"),
        ("%%MatrixMarket matrix coordinate real general\n2 3 1\n1 1 1\n", ShapeError, "square"),
    ],
)  # fmt: skip
def test_bad_matrix_market_files_are_refused(tmp_path, text, error, match):
    (tmp_path / "K.mtx").write_text(text)
    with pytest.raises(error, match=match):
        fx.io.read_matrix_market(tmp_path / "K.mtx")


@needs_data
@pytest.mark.slow
def test_bcsstk11_and_its_published_eigenvalues():
    found = fx.io.read_matrix_market(FE / "hb/bcsstk11.mtx", FE / "hb/bcsstm11.mtx")
    assert found.digits == 14
    truth = np.sort(scipy.io.mmread(FE / "hb/bcsst11eig.mtx").ravel())
    values = la.eigh(found.K.toarray(), found.M.toarray(), eigvals_only=True)
    np.testing.assert_allclose(values, truth, rtol=1e-8)  # dense LAPACK loses the lowest two
    np.testing.assert_allclose(truth[:2], [10.51148, 10.51839], rtol=1e-6)
    report = fx.check(found)
    assert "digits" not in report.of("note")
    assert (2 * np.pi * report.first_freq) ** 2 == pytest.approx(truth[0], rel=3e-9)
    dofs = fx.DofSet(np.arange(1473) // 3 + 1, ("x", "y", "z") * 491, np.zeros((1473, 3)))
    # the fast suite turns warnings into errors: fourteen digits do not warn
    model = found.with_dofs(dofs).model()
    np.testing.assert_allclose(fx.solve_modes(model, count=4).omega ** 2, truth[:4], rtol=1e-7)


# Harwell-Boeing


def write_rsa(path, K, *, form="(4E20.12)", width=20, per_line=4, kind="RSA", digits=12):
    """Write the lower triangle as the users' guide of 1992 says."""
    low = sp.csc_array(np.tril(K))
    low.sort_indices()
    n = K.shape[0]
    pointer, index = low.indptr + 1, low.indices + 1

    def cards(items, per, make):
        return ["".join(make(i) for i in items[k : k + per]) for k in range(0, len(items), per)]

    blocks = [
        cards(pointer, 10, lambda i: f"{i:8d}"),
        cards(index, 10, lambda i: f"{i:8d}"),
        cards(low.data, per_line, lambda v: f"{v:{width}.{digits}E}"),
    ]
    sizes = [len(block) for block in blocks]
    head = [
        f"{'a chain':72s}{'CHAIN':8s}",
        "".join(f"{c:14d}" for c in (sum(sizes), *sizes, 0)),
        f"{kind:14s}" + "".join(f"{c:14d}" for c in (n, n, low.nnz, 0)),
        f"{'(10I8)':16s}{'(10I8)':16s}{form:20s}",
    ]
    path.write_text("\n".join(head + [line for block in blocks for line in block]) + "\n")


@pytest.mark.parametrize(
    ("form", "width", "per_line"),
    [("(4E20.12)", 20, 4), ("(1P,3E25.16)", 25, 3), ("(1P4D20.12)", 20, 4)],
)
def test_symmetric_harwell_boeing(tmp_path, form, width, per_line):
    K, M = pair()
    digits = 16 if width == 25 else 12
    write_rsa(tmp_path / "K.rsa", K, form=form, width=width, per_line=per_line, digits=digits)
    write_rsa(tmp_path / "M.rsa", M)
    found = fx.io.read_harwell_boeing(tmp_path / "K.rsa", tmp_path / "M.rsa", dofs=named())
    same(found, K, M, rtol=1e-12)
    assert found.digits == digits + 1
    again = fx.read_matrices(tmp_path / "K.rsa", mass=tmp_path / "M.rsa")
    same(again, K, M, rtol=1e-12)


@pytest.mark.filterwarnings("ignore::PendingDeprecationWarning")
def test_unsymmetric_harwell_boeing_as_scipy_writes_it(tmp_path):
    K, _ = pair()
    scipy.io.hb_write(tmp_path / "K.rua", sp.csc_matrix(K))
    same(fx.io.read_harwell_boeing(tmp_path / "K.rua"), K, rtol=1e-12)


@pytest.mark.parametrize(
    ("change", "error", "match"),
    [
        (lambda t: t.replace("RSA", "CSA"), ModelError, "'CSA'"),
        (lambda t: t.replace("RSA", "RZA"), ModelError, "gyroscopic"),
        (lambda t: t.replace("RSA", "RSE"), ModelError, "elemental"),
        (lambda t: t[:-40], FlexplantError, "cut short"),
        (lambda t: "nonsense\n", FlexplantError, "header"),
        (lambda t: t.replace("(4E20.12)", "(what)   "), FlexplantError, "header"),
    ],
)
def test_bad_harwell_boeing_files_are_refused(tmp_path, change, error, match):
    path = tmp_path / "K.rsa"
    write_rsa(path, pair()[0])
    path.write_text(change(path.read_text()))
    with pytest.raises(error, match=match):
        fx.io.read_harwell_boeing(path)


# MATLAB


@pytest.mark.parametrize("version", ["4", "5"])
def test_matlab_finds_the_usual_names(tmp_path, version):
    K, M = pair()
    path = tmp_path / "model.mat"
    scipy.io.savemat(path, {"Kaa": sp.csc_matrix(K), "M0": M, "c": 0.1 * M}, format=version)
    found = fx.io.read_matlab(path, dofs=named())
    same(found, K, M)
    same(fx.structure.FEMatrices(found.D), 0.1 * M)
    assert found.digits is None
    same(fx.read_matrices(path), K, M)


@pytest.mark.parametrize("seed", range(6))
def test_several_matrices_with_usual_names_must_be_named(tmp_path, seed):
    """Of one kind two or more are there, at the same depth, with other values."""
    rng = np.random.default_rng(seed)
    usual = {
        "stiffness": ["K", "kaa", "Stiffness", "K0"],
        "mass": ["M", "maa", "Mass"],
        "damping": ["D", "baa", "Damping"],
    }
    kind = ("stiffness", "mass", "damping")[seed % 3]
    names = {
        one: rng.permutation(listed)[: int(rng.integers(2, 4)) if one == kind else 1].tolist()
        for one, listed in usual.items()
    }
    held = {name: np.diag(rng.uniform(1, 2, 3)) for listed in names.values() for name in listed}
    scipy.io.savemat(tmp_path / "m.mat", held)
    np.savez(tmp_path / "m.npz", **held)
    for path in (tmp_path / "m.mat", tmp_path / "m.npz"):
        with pytest.raises(ModelError, match=rf"any of which may be the {kind}\. Name one") as said:
            fx.read_matrices(path)
        assert all(repr(name) in str(said.value) for name in names[kind])
    for name in names[kind]:
        found = fx.read_matrices(tmp_path / "m.mat", **{kind: name})
        chosen = {"stiffness": found.K, "mass": found.M, "damping": found.D}[kind]
        np.testing.assert_array_equal(chosen.toarray(), held[name])


def test_matlab_structures_and_chosen_names(tmp_path):
    K, M = pair()
    path = tmp_path / "model.mat"
    scipy.io.savemat(path, {"fem": {"left": {"K": K, "Mx": M}, "K2": 2 * K}, "x": np.ones(3)})
    same(fx.io.read_matlab(path), K)
    found = fx.io.read_matlab(path, stiffness="fem.K2", mass="fem.left.Mx")
    same(found, 2 * K, M)
    with pytest.raises(ModelError, match=r"no variable 'Ky'.*fem\.left\.K"):
        fx.io.read_matlab(path, stiffness="Ky")
    scipy.io.savemat(path, {"odd": K})
    with pytest.raises(ModelError, match="looks like a stiffness"):
        fx.io.read_matlab(path)


def test_matlab_7_3(tmp_path):
    h5py = pytest.importorskip("h5py")
    K, M = pair()
    K[0, 1] = 0.0  # one triangle of one pair: MATLAB's columns must not become rows
    path = tmp_path / "model.mat"
    with h5py.File(path, "w", userblock_size=512) as file:
        low = sp.csc_array(np.tril(pair()[0]))
        group = file.create_group("fem/K")
        group.attrs["MATLAB_sparse"] = np.uint64(6)
        for name, data in (("data", low.data), ("ir", low.indices), ("jc", low.indptr)):
            group.create_dataset(name, data=data.astype("u8") if name != "data" else data)
        file["M"] = M.T
        file["Q"] = K.T
        empty = file.create_group("fem/D")
        empty.attrs["MATLAB_sparse"] = np.uint64(6)
        empty.create_dataset("jc", data=np.zeros(7, "u8"))
        file.create_group("#refs#/K")
    with path.open("r+b") as file:
        file.write(b"MATLAB 7.3 MAT-file, written by a test".ljust(116) + b" " * 8 + b"\0\2IM")
    found = fx.io.read_matlab(path)
    same(found, pair()[0], M)
    assert found.notes == ("K: lower triangle only, completed",)
    assert found.D.nnz == 0
    np.testing.assert_array_equal(fx.io.read_matlab(path, stiffness="Q").K.toarray(), K)
    same(fx.read_matrices(path), pair()[0], M)


def test_a_missing_extra_gives_the_line_to_type(tmp_path, monkeypatch):
    path = tmp_path / "model.mat"
    path.write_bytes(b"MATLAB 7.3".ljust(512) + b"\x89HDF\r\n\x1a\n")
    monkeypatch.setitem(sys.modules, "h5py", None)
    with pytest.raises(FlexplantError, match=r"pip install 'flexplant\[hdf5\]'"):
        fx.io.read_matlab(path)


def test_no_matlab_file_is_refused(tmp_path):
    path = tmp_path / "model.mat"
    path.write_bytes(b"nothing of the kind" * 40)
    with pytest.raises(FlexplantError, match="MATLAB file"):
        fx.io.read_matlab(path)


@pytest.mark.slow
@needs_data
def test_published_matlab_models():
    shaft = fx.io.read_matlab(FE / "nlevp/shaft.mat")
    content = scipy.io.loadmat(FE / "nlevp/shaft.mat", spmatrix=False)
    assert shaft.D.nnz == content["C"].nnz
    values = la.eigvals(content["K"].toarray(), content["M"].toarray())
    lowest = np.sqrt(np.sort(values[np.isfinite(values)].real)[0]) / (2 * np.pi)
    report = fx.check(shaft)
    assert report.first_freq == pytest.approx(lowest, rel=1e-6)
    assert len(report.massless) == 201
    disk = fx.io.read_matlab(FE / "nlevp/cd_player.mat")
    assert disk.M is None
    assert "mass" in fx.check(disk).of("fail")


@needs(data_file("fe/updating"))
def test_a_published_bridge_with_massless_rows():
    bridge = fx.io.read_matlab(data_file("fe/updating") / "SteelPedBrdg_sim_form1_LM.mat")
    assert (bridge.n_dof, len(bridge.massless)) == (274, 138)
    dofs = fx.DofSet(np.arange(274), ["z"] * 274, np.zeros((274, 3)))
    held = bridge.with_dofs(dofs).replace(located=False).model(massless="condense")
    full = la.eigvals(bridge.K.toarray(), bridge.M.toarray())
    expected = np.sort(full[np.isfinite(full) & (abs(full) < 1e12)].real)
    got = la.eigh(held.K.toarray(), held.M.toarray(), eigvals_only=True)
    np.testing.assert_allclose(got[:40], expected[:40], rtol=1e-7)


# NumPy and SciPy


def test_numpy_files(tmp_path):
    K, M = pair()
    sp.save_npz(tmp_path / "K.npz", sp.csr_array(K))
    np.save(tmp_path / "M.npy", M)
    same(fx.io.read_npz(tmp_path / "K.npz", tmp_path / "M.npy", dofs=named()), K, M)
    np.savez(tmp_path / "both.npz", K=K, M=M, extra=np.ones(2))
    same(fx.read_matrices(tmp_path / "both.npz"), K, M)
    fx.ModalDamping(0.01).save(tmp_path / "own.npz")
    with pytest.raises(FlexplantError, match=r"flexplant\.load"):
        fx.io.read_npz(tmp_path / "own.npz")
    (tmp_path / "bad.npz").write_bytes(b"PK nothing")
    with pytest.raises(FlexplantError, match="save_npz"):
        fx.io.read_npz(tmp_path / "bad.npz")


# one function


def test_units_and_held_rows_through_the_door(tmp_path):
    K, M = pair()
    K[2], K[:, 2], M[2, 2] = 0, 0, 0
    sp.save_npz(tmp_path / "K.npz", sp.csc_array(K))
    sp.save_npz(tmp_path / "M.npz", sp.csc_array(M))
    model = fx.read_model(
        tmp_path / "K.npz", mass=tmp_path / "M.npz", dofs=named(), units=("mm", "t", "s"), name="mm"
    )
    keep = [0, 1, 3, 4, 5]
    np.testing.assert_allclose(model.K.toarray(), 1e3 * K[np.ix_(keep, keep)], rtol=1e-14)
    np.testing.assert_allclose(model.M.toarray(), 1e3 * M[np.ix_(keep, keep)], rtol=1e-14)
    np.testing.assert_allclose(model.dofs.xyz[:, 0], [0, 1e-3, 3e-3, 4e-3, 5e-3])
    assert model.name == "mm"
    with pytest.raises(ModelError, match="units"):
        fx.read_model(tmp_path / "K.npz", units="mm")
    with pytest.raises(ModelError, match="one matrix"):
        fx.read_matrices(tmp_path / "K.npz", stiffness="K")


def test_lost_digits_are_warned_of_through_the_door(tmp_path):
    # stiff among themselves, soft to ground: eight digits of 1e9 leave 40 of about 1400 1/s^2
    K = 1.1234567891e9 * (2 * np.eye(7) - np.eye(7, k=1) - np.eye(7, k=-1))
    K[0, 0], K[6, 6] = K[0, 0] / 2 + 1e4, K[6, 6] / 2
    M = np.eye(7)
    for name, matrix in (("K", K), ("M", M)):
        scipy.io.mmwrite(tmp_path / f"{name}.mtx", sp.coo_array(matrix), precision=8)
    table = fx.DofSet(np.arange(1, 8), ["z"] * 7, np.zeros((7, 3)))
    with pytest.warns(FlexplantWarning, match="8 digits.*binary"):
        fx.read_model(tmp_path / "K.mtx", mass=tmp_path / "M.mtx", dofs=table)


@pytest.mark.parametrize(
    ("name", "content", "match"),
    [
        ("a.xyz", b"1 2 3", "not known"),
        ("a.exo", b"CDF", "read_modes"),
        ("a.rst", b"", "read_ansys"),
        ("nothing", b"", "not known"),
    ],
)
def test_what_is_no_matrix_file_is_said(tmp_path, name, content, match):
    (tmp_path / name).write_bytes(content)
    with pytest.raises(FlexplantError, match=match):
        fx.read_matrices(tmp_path / name)
    with pytest.raises(FileNotFoundError):
        fx.read_matrices(tmp_path / "not there.mtx")


def test_content_goes_before_the_suffix(tmp_path):
    K, _ = pair()
    scipy.io.mmwrite(tmp_path / "K.mtx", sp.coo_array(K))
    (tmp_path / "K.mtx").rename(tmp_path / "K.txt")
    same(fx.read_matrices(tmp_path / "K.txt"), K)
    text = "".join(
        f"{i + 1},3,{j + 1},3,{K[i, j]:.15e}\n" for i in range(6) for j in range(i + 1) if K[i, j]
    )
    (tmp_path / "job_STIF2.mtx").write_text(text)
    found = fx.read_matrices(tmp_path / "job_STIF2.mtx")
    same(found, K)
    assert found.dofs.labels[0] == "1:z"
    (tmp_path / "nodes.csv").write_text("".join(f"{i + 1},{i},0,0\n" for i in range(6)))
    placed = fx.read_matrices(tmp_path / "job_STIF2.mtx", nodes=tmp_path / "nodes.csv")
    np.testing.assert_array_equal(placed.dofs.xyz[:, 0], np.arange(6))
    assert placed.located
    # both ways to say so lead to the call that reads a table of nodes
    call = r"fx\.io\.read_dofs\('nodes\.csv', directions="
    with pytest.raises(ModelError, match=rf"does not name its rows.*{call}"):
        fx.read_matrices(tmp_path / "K.txt", nodes=tmp_path / "nodes.csv")
    (tmp_path / "nodes.csv").write_text("node,x,y,z\n1,0,0,0\n2,1,0,0\n")
    with pytest.raises(LabelError, match=rf"no column.*{call}"):
        fx.read_matrices(tmp_path / "K.txt", dofs=tmp_path / "nodes.csv")
    dofs = fx.io.read_dofs(tmp_path / "nodes.csv", directions=("x", "y", "z"))
    assert fx.read_matrices(tmp_path / "K.txt", dofs=dofs).dofs.labels[-1] == "2:z"


def test_a_new_format_is_one_value(tmp_path, monkeypatch):
    """A reader with options of its own, known by its suffix or by what the file begins with.

    The beginning comes as it is in the file, with its capital letters.
    """

    def read_rows(path, *, mass=None, mesh=None):
        K = np.loadtxt(path, comments="!", ndmin=2)
        return fx.structure.FEMatrices(K, None if mass is None else np.diag(np.loadtxt(mass)))

    rows = Format((".rows",), read_rows, lambda head: head.startswith(b"!Rows"), (".grid",), "mesh")
    monkeypatch.setattr(models, "FORMATS", (*models.FORMATS, rows))
    (tmp_path / "K.rows").write_text("2 -1\n-1 2\n")
    (tmp_path / "K.txt").write_text("!Rows\n2 -1\n-1 2\n")
    (tmp_path / "M.txt").write_text("3 4\n")
    for name in ("K.rows", "K.txt"):
        found = fx.read_matrices(tmp_path / name, mass=tmp_path / "M.txt")
        np.testing.assert_array_equal(found.K.toarray(), [[2, -1], [-1, 2]])
        np.testing.assert_array_equal(found.M.toarray(), np.diag([3, 4]))
    with pytest.raises(ModelError, match=r"no option 'damping'.*'mass', 'nodes'"):
        fx.read_matrices(tmp_path / "K.rows", damping="D.txt")
    (tmp_path / "a.grid").write_text("1 0 0 0\n")
    with pytest.raises(FlexplantError, match=r"mesh.*read_rows\(..., mesh=...\)"):
        fx.read_matrices(tmp_path / "a.grid")


def test_no_suffix_has_two_formats():
    # what the content decides has the suffix of another
    elsewhere = [other for other in models.ELSEWHERE if other.begins(b"\0")]
    known = [s for form in (*models.FORMATS, *elsewhere) for s in form.suffixes]
    known += [suffix for form in models.FORMATS for suffix in form.mesh]
    assert len(set(known)) == len(known)

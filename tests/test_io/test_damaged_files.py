"""Damaged files end in an error of ours: no crash, no foreign error, little memory."""

import json
import os
import subprocess
import sys
import tracemalloc
from pathlib import Path

import numpy as np
import pytest
import scipy.io
import scipy.sparse as sp

import flexplant as fx
from flexplant import io
from flexplant.errors import FlexplantError
from flexplant.io import foreign_parsers
from fuzz_files import READERS

SCRIPT = Path(__file__).parents[1] / "fuzz_files.py"
#: CPU seconds a reader; 90 in a run that looks for new ways to fail
SECONDS = float(os.environ.get("FLEXPLANT_FUZZ", "0.1"))


@pytest.mark.long
@pytest.mark.skipif(sys.platform == "win32", reason="forks")
def test_readers_survive_random_damage():
    """Thousands of files of every format; the script runs each reader in a process of its own."""
    for package in ("pyuff", "h5py", "pyyeti"):
        pytest.importorskip(package)
    # those of ANSYS start in seconds
    names = [name for name in READERS if SECONDS > 1 or "ansys" not in name]
    done = subprocess.run(
        [sys.executable, str(SCRIPT), str(SECONDS), *names],
        capture_output=True, text=True, check=True,
    )  # fmt: skip
    print(done.stdout)
    found = [json.loads(line) for line in done.stdout.splitlines()]
    assert len(found) == len(names) > 25
    for result in found:
        assert not result["crash"], result
        assert not result["foreign"], result
        assert result["files"] > 3, result
        assert result["MB"] < 200, result


def test_a_blank_after_the_last_number_is_no_number(tmp_path):
    """SciPy's reader of Matrix Market files goes on beyond the end there."""
    path = tmp_path / "K.mtx"
    for end in (" ", "\t", " \n ", " \r\n"):
        head = "%%MatrixMarket matrix coordinate real symmetric\n2 2 2\n"
        path.write_bytes(f"{head}1 1 7500.25\n2 2 3.5{end}".encode())
        assert io.read_matrix_market(path).K.toarray().tolist() == [[7500.25, 0], [0, 3.5]]
    path.write_text(
        "%%MatrixMarket matrix coordinate real general\n999999999 999999999 1\n1 1 2.\n"
    )
    with pytest.raises(FlexplantError, match=r"999999999 rows or columns in 7\d bytes"):
        io.read_matrix_market(path)


def test_pointers_that_lead_out_of_the_matrix(tmp_path):
    path = tmp_path / "K.rua"
    K = sp.csc_array(np.diag([1.0, 2.0, 3.0]) + np.eye(3, k=1))
    scipy.io.hb_write(path, K)
    assert io.read_harwell_boeing(path).n_dof == 3
    lines = path.read_bytes().split(b"\n")
    assert lines[4].split() == [b"1", b"2", b"4", b"6"]
    for wrong in (lines[4].replace(b"4", b"9"), lines[4].replace(b"6", b"1")):
        path.write_bytes(b"\n".join([*lines[:4], wrong, *lines[5:]]))
        with pytest.raises(FlexplantError, match="damaged"):
            io.read_harwell_boeing(path)
    # decreasing ones, of which SciPy's own check says nothing in an empty matrix
    parts = {"data": np.ones(3), "indices": np.arange(3), "format": b"csc", "shape": (3, 3)}
    np.savez(tmp_path / "K.npz", indptr=np.array([0, 1, 10**8, 0]), **parts)
    with pytest.raises(FlexplantError, match="decrease"):
        io.read_npz(tmp_path / "K.npz")


def test_one_count_of_an_op4_file_takes_no_memory(tmp_path):
    """Columns, rows: 2^24 each in a file of 8 kB, and 5000 in one that holds ten numbers."""
    path = tmp_path / "K.op4"

    def record(*parts):
        body = b"".join(np.asarray(part).tobytes() for part in parts)
        return np.int32(len(body)).tobytes() + body + np.int32(len(body)).tobytes()

    def whole(*numbers):
        return np.array(numbers, np.int32)

    def file(columns, rows):
        columns_of_it = [record(whole(j, j, 2), [1.5]) for j in range(1, 300)]
        end = record(whole(columns + 1, 1, 2), [1.0])
        head = record(whole(columns, rows, 2, 2), np.frombuffer(b"KAA     ", np.int32))
        return head + b"".join(columns_of_it) + end

    tracemalloc.start()
    for columns, rows in ((2**24, 300), (300, 2**24), (300, -(2**24))):
        path.write_bytes(file(columns, rows))
        with pytest.raises(FlexplantError, match="16777216 rows or columns"):
            io.read_op4_matrices(path)
    # of the form of dense matrices, nearly empty: read, and kept sparse
    path.write_bytes(file(5000, 5000))
    found = io.read_op4_matrices(path)["KAA"]
    assert sp.issparse(found)
    assert found.shape == (5000, 5000)
    assert found[298, 298] == 1.5
    assert found.nnz == 299
    assert tracemalloc.get_traced_memory()[1] < 20e6
    tracemalloc.stop()


@pytest.mark.slow
def test_a_parser_that_dies_leaves_this_process_alive(tmp_path):
    """An unknown type of numbers in a .mat file: SciPy reads memory that is not there."""
    path = tmp_path / "K.mat"
    scipy.io.savemat(path, {"K": np.ones((2, 2))})
    content = bytearray(path.read_bytes())
    assert content[176] == 9
    content[176] = 255
    good = tmp_path / "good.mat"
    scipy.io.savemat(good, {"K": np.eye(2)})
    path.write_bytes(content)
    with pytest.raises(FlexplantError, match="damaged"):
        io.read_matlab(path)
    assert io.read_matlab(good).n_dof == 2
    # the next one finds the process of the last, or a new one
    waiting = foreign_parsers._WAITING[os.getpid(), "matlab"]
    assert io.read_matlab(good).n_dof == 2
    assert foreign_parsers._WAITING[os.getpid(), "matlab"] is waiting
    waiting.kill()
    waiting.wait()
    assert io.read_matlab(good).n_dof == 2


@pytest.mark.slow
def test_without_an_interpreter_to_start_files_are_read_here(tmp_path, monkeypatch):
    scipy.io.savemat(tmp_path / "K.mat", {"K": np.eye(2), "s": {"a": 1.0}})
    foreign_parsers._close_all()
    foreign_parsers._WAITING.clear()
    monkeypatch.setattr(sys, "executable", "/opt/cad/bin/host")
    assert io.read_matlab(tmp_path / "K.mat").n_dof == 2
    assert (os.getpid(), "matlab") not in foreign_parsers._WAITING
    resource = pytest.importorskip("resource")
    assert resource.getrlimit(resource.RLIMIT_DATA)[0] == resource.RLIM_INFINITY


def test_a_number_without_its_last_digits(tmp_path):
    rows = [f"{i} {i} {1000 / i:.12e}" for i in range(1, 6)]
    head = "%%MatrixMarket matrix coordinate real symmetric\n5 5 5\n"
    texts = {
        "K.mtx": (io.read_matrix_market, head + "\n".join(rows)),
        "job_STIF2.mtx": (io.read_abaqus, "\n".join(rows)),
    }
    for name, (read, text) in texts.items():
        (tmp_path / name).write_text(text)
        assert read(tmp_path / name).n_dof == 5
        for cut in (1, 2, 5):  # 2.000e+02 becomes 2.000e+0, and 2.0
            (tmp_path / name).write_text(text[:-cut].removesuffix("e").removesuffix("e+"))
            with pytest.raises(FlexplantError, match="shorter than all others"):
                read(tmp_path / name)
    scipy.io.hb_write(tmp_path / "K.rua", sp.csc_array(np.diag(1000 / np.arange(1.0, 6.0))))
    content = (tmp_path / "K.rua").read_bytes().rstrip()
    (tmp_path / "K.rua").write_bytes(content[:-1])
    with pytest.raises(FlexplantError, match="shorter than all others"):
        io.read_harwell_boeing(tmp_path / "K.rua")


@pytest.mark.parametrize(
    ("name", "advice"),
    [
        ("run.f06", r"EXTSEOUT.*read_op4"),
        ("job.odb", r"MATRIX GENERATE.*read_abaqus"),
        ("plate.mph", r"mphmatrix.*read_matlab"),
        ("file.emat", r"WRFULL.*read_ansys"),
        ("readme.rst", r"reStructuredText"),
        ("file.rst", r"read_ansys\(\.\.\., nodes=\.\.\.\)"),
    ],
)
def test_what_is_refused_gets_advice(tmp_path, name, advice):
    text = b"Title\n=====\n" if name == "readme.rst" else b"\x64\x00\x00\x00\x0c\x00\x00\x00"
    (tmp_path / name).write_bytes(text)
    with pytest.raises(FlexplantError, match=advice):
        fx.read_matrices(tmp_path / name)

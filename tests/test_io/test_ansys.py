"""ANSYS .full files: the sample with its published frequencies, and a stand-in for the reader."""

import sys
from pathlib import Path

import numpy as np
import pytest
import scipy.sparse as sp
from scipy.spatial.transform import Rotation

import flexplant as fx
from flexplant.errors import FlexplantError, LabelError, ModelError
from flexplant.io import ansys, foreign_parsers
from flexplant.io.ansys import cosines_of
from shared_data import data_file, needs

FULL = data_file("fe/ansys/file.full")


@needs(FULL)
class TestSample:
    @pytest.mark.slow
    def test_frequencies_of_the_held_beam(self):
        pytest.importorskip("ansys.mapdl.reader")
        found = fx.io.read_ansys(FULL)
        assert found.n_dof == 900
        assert len(found.constrained) == 63
        assert not found.located
        assert any("completed" in note for note in found.notes)
        model = fx.read_model(FULL)
        np.testing.assert_allclose(
            fx.solve_modes(model, count=4).freq, [1283.200, 1283.200, 5781.975, 6919.399], atol=5e-4
        )

    @pytest.mark.slow
    def test_coordinates_from_the_result_file_of_the_same_model(self):
        examples = pytest.importorskip("ansys.mapdl.reader.examples")
        found = fx.read_matrices(FULL, nodes=examples.rstfile)
        assert found.located
        report = fx.check(found)
        assert report.ok
        assert report.grounded == ("x", "y", "z", "rx", "ry", "rz")
        # a square bar of 1 x 1 x 5, held at z = 0
        np.testing.assert_allclose(np.ptp(found.dofs.xyz, axis=0), [1, 1, 4.75], atol=0.26)
        np.testing.assert_allclose(report.center[:2], [0.5, 0.5], atol=1e-9)

    @pytest.mark.slow
    def test_results_are_no_matrices(self, tmp_path):
        examples = pytest.importorskip("ansys.mapdl.reader.examples")
        with pytest.raises(FlexplantError, match=r"not a \.full file"):
            fx.io.read_ansys(examples.rstfile)


#: words of the headers that begin at byte 420 of the sample files
NODES, DISTRIBUTED, ALL_NODES = 32, 62, 65
RST_ALL_NODES = 48


def with_words(source, path, words):
    """A copy of a binary file with other words in its header."""
    content = bytearray(source.read_bytes())
    for place, value in words.items():
        at = 420 + 4 * place
        content[at : at + 4] = np.array(value, "<i4").tobytes()
    path.write_bytes(bytes(content))
    return path


@needs(FULL)
@pytest.mark.slow
def test_parts_of_a_distributed_run_are_refused(tmp_path):
    """Each process writes its part; the header counts the nodes of the whole."""
    examples = pytest.importorskip("ansys.mapdl.reader.examples")
    part = with_words(FULL, tmp_path / "file0.full", {DISTRIBUTED: 1, ALL_NODES: 640})
    for read in (fx.io.read_ansys, fx.read_matrices, fx.read_model):
        with pytest.raises(ModelError, match="part of a distributed run, with 321 of 640 nodes"):
            read(part)
    older = with_words(FULL, tmp_path / "file1.full", {DISTRIBUTED: 1})
    with pytest.raises(ModelError, match="distributed run, with some of the nodes"):
        fx.read_matrices(older)
    whole = with_words(FULL, tmp_path / "file.full", {DISTRIBUTED: 1, ALL_NODES: 321})
    assert fx.read_matrices(whole).n_dof == 900
    results = with_words(Path(examples.rstfile), tmp_path / "file1.rst", {RST_ALL_NODES: 640})
    with pytest.raises(ModelError, match="part of a distributed run, with 321 of 640 nodes"):
        fx.io.read_modes(results, zeta=0.01)


def stand_in(monkeypatch, K, M, table, damped=False):
    full = {"table": np.asarray(table), "K": K, "M": M, "damped": damped}
    monkeypatch.setattr(ansys, "in_child", lambda function, path, keep: ("value", full))


def local_pair():
    rng = np.random.default_rng(2)
    A = rng.standard_normal((6, 6))
    return A @ A.T + 6 * np.eye(6), np.diag([1.0, 1, 1, 2, 2, 2])


def test_rows_are_sorted_named_and_placed(monkeypatch, tmp_path):
    K, M = local_pair()
    table = [(9, 2), (9, 0), (9, 1), (4, 0), (4, 1), (4, 2)]
    stand_in(monkeypatch, sp.csc_matrix(np.triu(K)), sp.csc_matrix(np.triu(M)), table, damped=True)
    (tmp_path / "nodes.txt").write_text("4 1 0 0\n9 0 2 0\n")
    found = fx.io.read_ansys("x.full", nodes=tmp_path / "nodes.txt")
    assert found.dofs.labels == ("4:x", "4:y", "4:z", "9:x", "9:y", "9:z")
    order = [3, 4, 5, 1, 2, 0]
    np.testing.assert_allclose(found.K.toarray(), K[np.ix_(order, order)], rtol=1e-14)
    np.testing.assert_array_equal(found.dofs.xyz[[0, 3]], [[1, 0, 0], [0, 2, 0]])
    assert any("damping" in note for note in found.notes)
    with pytest.raises(LabelError, match=r"\[9\]"):
        fx.io.read_ansys("x.full", nodes={4: (0, 0, 0)})


def test_local_coordinate_systems_are_turned_or_refused(monkeypatch):
    K, M = local_pair()
    C = np.eye(6)
    C[3:, 3:] = turn = Rotation.from_euler("ZXY", [20, -30, 40], degrees=True).as_matrix().T
    table = [(n, d) for n in (4, 9) for d in range(3)]
    stand_in(monkeypatch, sp.csc_matrix(C @ K @ C.T), sp.csc_matrix(C @ M @ C.T), table)
    found = fx.io.read_ansys("x.full", rotations={9: turn})
    np.testing.assert_allclose(found.K.toarray(), K, rtol=1e-10, atol=1e-12)
    stand_in(monkeypatch, sp.csc_matrix(K[:5, :5]), sp.csc_matrix(M[:5, :5]), table[:5])
    with pytest.raises(ModelError, match="only 2 of three"):
        fx.io.read_ansys("x.full", rotations={9: turn})


def test_nodal_angles_turn_about_z_then_new_x_then_new_y():
    for angles in ([30, 0, 0], [0, 30, 0], [0, 0, 30], [20, -35, 50]):
        # columns of the rotation are the local axes
        expected = Rotation.from_euler("ZXY", angles, degrees=True).as_matrix().T
        np.testing.assert_allclose(cosines_of(angles), expected, atol=1e-15)


@pytest.mark.parametrize(
    ("K", "M", "kinds", "match"),
    [
        (None, np.eye(1), [0], "no stiffness"),
        (np.eye(1), None, [0], "no mass"),
        (np.eye(1), np.eye(1), [20], "temperature"),
    ],
)
def test_what_is_no_structure_is_refused(monkeypatch, K, M, kinds, match):
    stand_in(monkeypatch, K, M, [(1, kind) for kind in kinds])
    with pytest.raises(ModelError, match=match):
        fx.io.read_ansys("x.full")


@pytest.mark.slow
def test_a_missing_extra_gives_the_line_to_type(monkeypatch, tmp_path):
    (tmp_path / "x.full").write_bytes(b"")
    foreign_parsers._close_all()  # one that waits has imported it
    foreign_parsers._WAITING.clear()
    monkeypatch.setattr(sys, "path", [place for place in sys.path if "site-packages" not in place])
    with pytest.raises(FlexplantError, match=r"pip install 'flexplant\[ansys\]'"):
        fx.io.read_ansys(tmp_path / "x.full")


@pytest.mark.slow
def test_other_files_are_refused(tmp_path):
    pytest.importorskip("ansys.mapdl.reader")
    (tmp_path / "x.full").write_bytes(bytes(range(256)) * 20)
    with pytest.raises(FlexplantError, match=r"x\.full"):
        fx.io.read_ansys(tmp_path / "x.full")
    with pytest.raises(FileNotFoundError):
        fx.io.read_ansys(tmp_path / "none.full")

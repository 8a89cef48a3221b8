"""Abaqus matrix files, written by hand in the documented form."""

import numpy as np
import pytest

import flexplant as fx
from flexplant import DofSet
from flexplant.errors import FlexplantError, LabelError, ModelError, ShapeError
from flexplant.io import read_abaqus, read_dmig

K = np.array(
    [[4.0, -1.5, 0.0, 0.25], [-1.5, 3.0, 1e-3, 0.0], [0.0, 1e-3, 2.0, -0.5], [0.25, 0.0, -0.5, 5.0]]
)
M = np.diag([1.0, 2.0, 3.0, 4.0])
DOFS = [(1, 1), (1, 2), (12, 3), (12, 6)]
INP = """\
*HEADING
 a beam
** comment
*NODE, NSET=ALL
 1, 0.0, 1.0, 2.0
12, 3.5
*ELEMENT, TYPE=B31
1, 1, 12
"""


def entries(matrix, dofs=DOFS, order=None):
    """The lower triangle as FORMAT=MATRIX INPUT, in an order of nodes of Abaqus's own."""
    rows = range(len(matrix)) if order is None else order
    lines = []
    for at, i in enumerate(rows):
        for j in list(rows)[: at + 1]:
            if matrix[i, j]:
                (a, b), (c, d) = dofs[i], dofs[j]
                lines.append(f"{a},{b}, {c},{d}, {matrix[i, j]:.15e}")
    return "\n".join(lines) + "\n"


def coordinates(matrix):
    i, j = np.nonzero(matrix)
    return "".join(f"{a + 1} {b + 1} {matrix[a, b]:.16E}\n" for a, b in zip(i, j, strict=True))


def written(tmp_path, text, name="job_STIF2.mtx"):
    path = tmp_path / name
    path.write_text(text)
    return path


@pytest.mark.parametrize("order", [None, [2, 0, 3, 1]])
def test_a_triangle_with_labels(tmp_path, order):
    k = written(tmp_path, entries(K, order=order))
    m = written(tmp_path, entries(M), "job_MASS2.mtx")
    d = written(tmp_path, entries(0.1 * K), "job_DMPV2.mtx")
    inp = written(tmp_path, INP, "job.inp")
    found = read_abaqus(k, mass=m, damping=d, inp=inp)
    assert np.array_equal(found.K.toarray(), K)
    assert np.array_equal(found.M.toarray(), M)
    assert found.D.toarray() == pytest.approx(0.1 * K, rel=1e-15)
    assert found.dofs.labels == ("1:x", "1:y", "12:z", "12:rz")
    assert found.dofs.xyz.tolist() == [[0, 1, 2], [0, 1, 2], [3.5, 0, 0], [3.5, 0, 0]]
    assert found.digits == 16
    assert found.located
    assert not read_abaqus(k).located


@pytest.mark.parametrize("form", ["{:g}.", "{:.1f}", "{:.9e}", "{:.15e}"])
@pytest.mark.parametrize("kind", ["mtx", "pch"])
def test_small_numbers_written_by_hand_are_exact(tmp_path, form, kind):
    """diag(1, 2) is regular, with however few digits it is written."""
    matrices = {"K": [300.0, 500.0], "M": [1.0, 2.0]}
    if kind == "pch":
        cards = "".join(
            f"DMIG    {name}AAX    0       6       2       0\n"
            + "".join(f"DMIG,{name}AAX,{i},1,,{i},1,{form.format(v)}\n" for i, v in enumerate(d, 1))
            for name, d in matrices.items()
        )
        found = read_dmig(written(tmp_path, cards, "run.pch"))
    else:
        line = "{i},1, {i},1, {v}\n"
        files = [
            written(
                tmp_path,
                "".join(line.format(i=i, v=form.format(v)) for i, v in enumerate(d, 1)),
                f"{name}.{kind}",
            )
            for name, d in matrices.items()
        ]
        found = read_abaqus(files[0], mass=files[1])
    model = found.with_dofs(DofSet([1, 2], ["x"] * 2, np.eye(2, 3))).model()
    assert fx.solve_modes(model, count=2).omega == pytest.approx(np.sqrt([250.0, 300.0]))
    assert found.digits == {"{:.9e}": 10, "{:.15e}": 16}.get(form)


def test_both_triangles_and_a_keyword_line(tmp_path):
    text = "** by hand\n*MATRIX INPUT, NAME=K1, SCALE FACTOR=2.0\n"
    for i in range(4):
        for j in range(4):
            (a, b), (c, d) = DOFS[i], DOFS[j]
            text += f"{a},{b},{c},{d},{K[i, j]:.10e}\n"
    assert np.array_equal(read_abaqus(written(tmp_path, text)).K.toarray(), 2 * K)


def test_coordinate_format(tmp_path):
    dofs = DofSet([1, 1, 12, 12], ["x", "y", "z", "rz"], np.ones((4, 3)))
    for matrix in (K, np.tril(K), np.triu(K)):
        found = read_abaqus(written(tmp_path, coordinates(matrix)), dofs=dofs)
        assert np.array_equal(found.K.toarray(), K)
        assert found.dofs.labels == dofs.labels
    assert read_abaqus(written(tmp_path, coordinates(K))).dofs is None
    with pytest.raises(ShapeError, match="K has 3 rows"):
        read_abaqus(written(tmp_path, coordinates(K[:3, :3])), dofs=dofs)


def test_held_dofs_are_dropped_and_named(tmp_path):
    held = K.copy()
    held[1, :] = held[:, 1] = 0
    held[1, 1] = 1e36
    k, m = written(tmp_path, entries(held)), written(tmp_path, entries(M), "m.mtx")
    found = read_abaqus(k, mass=m)
    keep = [0, 2, 3]
    assert np.array_equal(found.K.toarray(), K[np.ix_(keep, keep)])
    assert np.array_equal(found.M.toarray(), M[np.ix_(keep, keep)])
    assert found.constrained == ("1:y",)
    with pytest.raises(ModelError, match=r"rows \[2\].*held by boundary conditions"):
        read_abaqus(written(tmp_path, coordinates(held)))


def test_rows_of_all_matrices_are_those_of_any(tmp_path):
    """A rotation without mass is in K only: an empty row of M."""
    k = written(tmp_path, entries(K))
    m = written(tmp_path, entries(M[:3, :3]), "m.mtx")
    found = read_abaqus(k, mass=m)
    assert found.M.toarray().diagonal().tolist() == [1, 2, 3, 0]


@pytest.mark.parametrize(
    ("old", "new", "error", "match"),
    [
        ("12,3, 1,2", "-3,1, 1,2", ModelError, r"internal nodes \[-3\]: Lagrange"),
        ("12,3, 1,2", "12,8, 1,2", ModelError, r"other than displacements and rotations \(\[8\]"),
        ("12,3, 1,2", "12,3, 1,x", FlexplantError, r"line 4: 'node, dof, node, dof, value'"),
        ("12,3, 1,2", "12.5,3, 1,2", FlexplantError, "line 4"),
        ("12,3, 1,2", "99999999999999999999,3, 1,2", FlexplantError, "line 4"),
        ("2.000000000000000e+00", "2e999", FlexplantError, "line 5"),
        ("12,3, 1,2", "1,1, 1,1", FlexplantError, "stored twice: 1"),
        ("2.000000000000000e+00", "nan", FlexplantError, "line 5"),
        (", 2.000000000000000e+00", "", FlexplantError, "line 5"),
    ],
)
def test_bad_lines_are_named(tmp_path, old, new, error, match):
    text = entries(K)
    assert old in text
    with pytest.raises(error, match=match):
        read_abaqus(written(tmp_path, text.replace(old, new, 1)))


@pytest.mark.parametrize(
    ("old", "new", "error", "match"),
    [
        ("12, 3.5", "13, 3.5", LabelError, r"\*NODE.*\[12\]"),
        ("12, 3.5", "12, three", FlexplantError, "line 6"),
        ("*ELEMENT", "*TRANSFORM, NSET=ALL", ModelError, "line 7.*coordinate system"),
        ("*ELEMENT", "*INCLUDE, INPUT=x", ModelError, "line 7.*flattened"),
        ("NSET=ALL", "SYSTEM=C", ModelError, "line 4.*coordinate system"),
        ("12, 3.5", "1, 3.5", FlexplantError, "node 1 is defined twice, in line 5 and in line 6"),
        (
            "*ELEMENT",
            "*ASSEMBLY\n*NODE\n12, 3.5\n*E",
            FlexplantError,
            r"12 is defined twice, in line 6 and in line 9 \(\*assembly\).*flattened",
        ),
        ("*ELEMENT", "*INSTANCE, NAME=a\n*INSTANCE, NAME=b", ModelError, "several instances"),
        ("*ELEMENT", "*INSTANCE, NAME=a\n1.0, 0.0, 0.0\n*E", ModelError, "instance that is moved"),
    ],
)
def test_nodes_that_cannot_be_placed(tmp_path, old, new, error, match):
    k, inp = written(tmp_path, entries(K)), written(tmp_path, INP.replace(old, new), "job.inp")
    with pytest.raises(error, match=match):
        read_abaqus(k, inp=inp)


def test_files_that_do_not_belong_together(tmp_path):
    k, m = written(tmp_path, entries(K)), written(tmp_path, coordinates(M), "m.mtx")
    with pytest.raises(ModelError, match="two formats"):
        read_abaqus(k, mass=m)
    with pytest.raises(ModelError, match="dofs= is for FORMAT=COORDINATE"):
        read_abaqus(k, dofs=DofSet([1], ["x"], [[0, 0, 0]]))
    with pytest.raises(FlexplantError, match="holds no matrix"):
        read_abaqus(written(tmp_path, "** nothing\n"))
    with pytest.raises(FlexplantError, match="line 1"):
        read_abaqus(written(tmp_path, "a picture of a matrix\n"))
    with pytest.raises(FileNotFoundError):
        read_abaqus(tmp_path / "none.mtx")


@pytest.mark.slow
def test_cut_files(tmp_path):
    content = entries(K)
    for cut in range(len(content) - 2):
        try:
            found = read_abaqus(written(tmp_path, content[:cut]))
        except FlexplantError:
            continue
        # whole lines are left, or of the first one so much that none tells how long it is
        whole = content[:cut].rstrip("\n") + "\n" in content
        assert whole or cut < content.index("\n")
        assert found.n_dof <= 4


def test_format_labels_with_both_triangles(tmp_path):
    """FORMAT=LABELS: the same five columns, with a header, and a symmetric matrix in full."""
    full = "".join(
        f"{a}, {b}, {c}, {d}, {K[i, j]:.15e}\n"
        for i, (a, b) in enumerate(DOFS)
        for j, (c, d) in enumerate(DOFS)
        if K[i, j]
    )
    found = read_abaqus(written(tmp_path, "**\n** ASSEMBLED\n**\n" + full))
    assert np.array_equal(found.K.toarray(), read_abaqus(written(tmp_path, entries(K))).K.toarray())
    assert np.array_equal(found.K.toarray(), K)

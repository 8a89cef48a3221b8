"""MATLAB text of Sierra/SD: triplets, the map of rows, the mesh."""

import numpy as np
import pytest
import scipy.io

from flexplant.errors import FlexplantError, ModelError, ShapeError
from flexplant.io import read_sierra
from shared_data import data_file, needs

SHARED = data_file("fe/sierra")

K = np.array([[4.0, -1.5, 0.25], [-1.5, 3.0, 0.0], [0.25, 0.0, 5.0]])
M = np.diag([1.0, 2.0, 3.0])
# two nodes; rows 1..3 are node 2's x, node 1's z and node 2's ry
MAP = [0, 0, 2, 0, 0, 0, 0, 0, 1, 0, 0, 0, 3, -1, 0, 0]


def table(matrix):
    i, j = np.nonzero(np.triu(matrix))
    rows = [f"{a + 1} {b + 1} {matrix[a, b]:.12e}" for a, b in zip(i, j, strict=True)]
    return "% written by Salinas\nfunction A = Kssr\nA = [\n" + "\n".join(rows) + "\n];\n"


def written(tmp_path, text, name="Kssr.m"):
    path = tmp_path / name
    path.write_text(text)
    return path


def map_text(entries):
    return "function m = FetiMap_a\nm = [\n" + "\n".join(map(str, entries)) + "];\n"


def mesh(path):
    with scipy.io.netcdf_file(path, "w") as file:
        file.createDimension("num_nodes", 2)
        for i, axis in enumerate("xyz"):
            file.createVariable(f"coord{axis}", "d", ("num_nodes",))[:] = [i, i + 0.5]
        file.createVariable("node_num_map", "i", ("num_nodes",))[:] = [30, 10]
    return path


def test_matrices_map_and_mesh(tmp_path):
    k, m = written(tmp_path, table(K)), written(tmp_path, table(M), "Mssr.m")
    a = written(tmp_path, map_text(MAP), "FetiMap_a.m")
    found = read_sierra(k, mass=m, damping=k, dof_map=a, exodus=mesh(tmp_path / "a.exo"))
    for ours, given in ((found.K, K), (found.M, M), (found.D, K)):
        assert np.array_equal(ours.toarray(), given)
    assert found.dofs.labels == ("10:x", "30:z", "10:ry")
    assert found.dofs.xyz.tolist() == [[0.5, 1.5, 2.5], [0, 1, 2], [0.5, 1.5, 2.5]]
    assert found.located
    assert found.digits == 13
    found = read_sierra(k, dof_map=a)
    assert found.dofs.labels == ("2:x", "1:z", "2:ry")
    assert not found.located
    assert read_sierra(k).dofs is None


def test_other_spellings(tmp_path):
    i, j = np.nonzero(K)
    rows = [f"{a + 1}, {b + 1}, {K[a, b]:.3f};" for a, b in zip(i, j, strict=True)]
    for text in ("\n".join(rows), "K = [" + "\n ".join(rows) + "]; % done"):
        assert np.array_equal(read_sierra(written(tmp_path, text)).K.toarray(), K)


@pytest.mark.parametrize(
    ("old", "new", "match"),
    [
        ("2 2 3.0", "2 2 x3.0", "line 7: 3 numbers are due, got '2 2 x3"),
        ("2 2 3.0", "2 2", "line 7"),
        ("2 2 3.0", "0 2 3.0", "0 is no row"),
        ("2 2 3.0", "1 1 3.0", "twice"),
        ("];", "", "cut off"),
        ("3.000000000000e+00", "NaN", "line"),
    ],
)
def test_bad_lines(tmp_path, old, new, match):
    text = table(K)
    old = "2 2 3.000000000000e+00" if old == "2 2 3.0" and new == "2 2" else old
    assert old in text
    with pytest.raises(FlexplantError, match=match):
        read_sierra(written(tmp_path, text.replace(old, new, 1)))


def test_maps_that_do_not_fit(tmp_path):
    k = written(tmp_path, table(K))
    for entries in (MAP[:-1], [0, *MAP[1:8], *[0] * 8], [4 if i == 3 else i for i in MAP]):
        with pytest.raises(ShapeError, match="Is it of the same run"):
            read_sierra(k, dof_map=written(tmp_path, map_text(entries), "a.m"))
    other = [*MAP[:7], 3, *MAP[8:12], 0, *MAP[13:]]
    with pytest.raises(ModelError, match="no displacement or rotation"):
        read_sierra(k, dof_map=written(tmp_path, map_text(other), "a.m"))
    longer = written(tmp_path, map_text([*MAP, *[0] * 8]), "a.m")
    with pytest.raises(ShapeError, match="same mesh"):
        read_sierra(k, dof_map=longer, exodus=mesh(tmp_path / "a.exo"))
    with pytest.raises(ModelError, match="named twice"):
        read_sierra(k, dof_map=longer, dofs=read_sierra(k, dof_map=longer).dofs)
    with pytest.raises(FileNotFoundError):
        read_sierra(tmp_path / "none.m")


def test_cut_files(tmp_path):
    text = table(K)
    for cut in range(text.index("[") + 1):
        with pytest.raises(FlexplantError):
            read_sierra(written(tmp_path, text[:cut]))
    for cut in range(text.index("[") + 1, text.index("]")):
        with pytest.raises(FlexplantError, match="cut off"):
            read_sierra(written(tmp_path, text[:cut]))


def assigned(entries, name="x"):
    lines = [f"{name}({i}) = {value};\n" for i, value in enumerate(entries, 1) if value]
    return f"function {name} = ASetMap_a()\n{name} = zeros({len(entries)}, 1);\n" + "".join(lines)


def test_maps_that_are_filled_entry_by_entry(tmp_path):
    """As Sierra writes them: nine entries a node, and the numbers of the nodes in a file beside."""
    k = written(tmp_path, table(K))
    nine = [*MAP[:8], 0, *MAP[8:], 0]
    for entries in (nine, MAP):
        a = written(tmp_path, assigned(entries), "a_ASetMap.m")
        assert read_sierra(k, dof_map=a).dofs.labels == ("2:x", "1:z", "2:ry")
    gid = written(tmp_path, assigned([30, 10]), "a_gid.m")
    found = read_sierra(k, dof_map=a, exodus=gid)
    assert found.dofs.labels == ("10:x", "30:z", "10:ry")
    assert not found.located
    # of 72 entries: nine nodes of 8, or eight of 9
    a = written(tmp_path, assigned([1, 2, 3, *[0] * 69]), "a_ASetMap.m")
    with pytest.raises(ShapeError, match="8 or 9 of them is not clear"):
        read_sierra(k, dof_map=a)
    for wrong in ("x(1) = 1;\nx(0) = 2;", "x(1) = 1;\nx(99) = 2;", "x(1) = 1;\ny = 3;"):
        text = f"x = zeros(18, 1);\n{wrong}\n"
        with pytest.raises(FlexplantError, match="damaged"):
            read_sierra(k, dof_map=written(tmp_path, text, "a.m"))


@needs(SHARED)
def test_a_real_map_and_its_list_of_nodes(tmp_path):
    """630 nodes, three DOFs each; as a matrix it is none."""
    with pytest.raises(FlexplantError, match="A map of DOFs goes to dof_map="):
        read_sierra(SHARED / "block_c_ASetMap.m")
    diagonal = "".join(f"{i} {i} 2.0\n" for i in range(1, 1891))
    k = written(tmp_path, f"K = [\n{diagonal}];\n")
    files = {"dof_map": SHARED / "block_c_ASetMap.m", "exodus": SHARED / "block_c_gid.m"}
    dofs = read_sierra(k, **files).dofs
    assert dofs.labels[:4] == ("580:x", "580:y", "580:z", "586:x")
    assert len(dofs) == 1890
    assert np.unique(dofs.nodes).size == 630
    assert set(dofs.directions) == {"x", "y", "z"}

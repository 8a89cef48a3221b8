"""Tables of degrees of freedom in the forms that other programs write."""

import numpy as np
import pytest

import flexplant as fx
from flexplant.errors import FlexplantError, LabelError

LABELS = ("7:z", "7:rx", "2:z")
XYZ = np.array([[0.5, 0, 0], [0.5, 0, 0], [1.5, 2, 3]])


@pytest.mark.parametrize(
    "text",
    [
        "node,direction,x,y,z\n7,z,0.5,0,0\n7,rx,0.5,0,0\n2,z,1.5,2,3\n",
        "\ufeffNODE;DOF;X;Y;Z\n7;UZ;0.5;0;0\n7;ROTX;0.5;0;0\n2;UZ;1.5;2;3\n",
        "# made by hand\nNode Dir X Y Z\n 7  3  .5 0 0\n\n 7 4 .5 0 0\n2 3 1.5 2 3\n",
        "grid\tcomp\tx [m]\ty [m]\tz [m]\n7\tT3\t.5\t0\t0\n7\tR1\t.5\t0\t0\n2\tT3\t1.5\t2\t3\n",
        "row,node,direction,x,y,z\n3,2,z,1.5,2,3\n1,7,z,0.5,0,0\n2,7,rx,0.5,0,0\n",
    ],
)
def test_one_line_a_dof(tmp_path, text):
    (tmp_path / "dofs.csv").write_text(text, encoding="utf-8")
    dofs = fx.io.read_dofs(tmp_path / "dofs.csv")
    assert dofs.labels == LABELS
    np.testing.assert_array_equal(dofs.xyz, XYZ)


@pytest.mark.parametrize("head", ["", "node,x,y,z\n"])
def test_coordinates_in_a_second_table(tmp_path, head):
    (tmp_path / "dofs.csv").write_text("node,direction\n7,z\n7,rx\n2,z\n")
    (tmp_path / "nodes.csv").write_text(head + "1,9,9,9\n2,1500,2000,3000\n7,500,0,0\n")
    dofs = fx.io.read_dofs(tmp_path / "dofs.csv", nodes=tmp_path / "nodes.csv", length="mm")
    assert dofs.labels == LABELS
    np.testing.assert_allclose(dofs.xyz, XYZ)


def test_a_table_places_each_node_once(tmp_path):
    (tmp_path / "dofs.csv").write_text("node,direction\n7,z\n")
    (tmp_path / "nodes.csv").write_text("1,9,9,9\n7,500,0,0\n7,0,0,0\n")
    with pytest.raises(LabelError, match="node 7 twice, as its nodes 2 and 3"):
        fx.io.read_dofs(tmp_path / "dofs.csv", nodes=tmp_path / "nodes.csv")


def test_the_same_directions_at_every_node(tmp_path):
    (tmp_path / "nodes.csv").write_text("node,x,y,z\n3,1,0,0\n1,2,0,0\n")
    dofs = fx.io.read_dofs(tmp_path / "nodes.csv", directions=("z", "rx"))
    assert dofs.labels == ("3:z", "3:rx", "1:z", "1:rx")
    np.testing.assert_array_equal(dofs.xyz[:, 0], [1, 1, 2, 2])


@pytest.mark.parametrize(
    ("text", "options", "error", "match"),
    [
        ("", {}, FlexplantError, "empty"),
        ("1,z,0,0,0\n", {}, LabelError, "names of its columns"),
        ("node,direction\n1,z\n", {}, LabelError, "no column"),
        ("node,direction,x,y,z\n1,z,0,0\n", {}, FlexplantError, "line 2"),
        ("node,direction,x,y,z\n1,z,0,a,0\n", {}, FlexplantError, "'y'"),
        ("node,direction,x,y,z\n1.5,z,0,0,0\n", {}, FlexplantError, "whole"),
        ("node,direction,x,y,z\n1e30,z,0,0,0\n", {}, FlexplantError, "whole"),
        ("node,id,direction,x,y,z\n1,2,z,0,0,0\n", {}, FlexplantError, "2 columns 'node'"),
        ('node,direction,x,y,z\n1,"z\n",0,0,0\n', {}, FlexplantError, "several lines"),
        ("node,direction,x,y,z\n1,TEMP,0,0,0\n", {}, LabelError, "'TEMP'"),
        ("node,direction,x,y,z\n1,z,0,0,0\n1,z,0,0,0\n", {}, LabelError, "twice"),
        ("row,node,direction,x,y,z\n0,1,z,0,0,0\n1,2,z,0,0,0\n", {}, LabelError, "from 1"),
        ("node,x,y\n1,0,0\n", {"directions": ["z"]}, LabelError, "node, x, y, z"),
        ("node,direction,x,y,z\n1,z,0,0,0\n", {"length": "mil"}, ValueError, "mil"),
    ],
)
def test_bad_tables_are_refused(tmp_path, text, options, error, match):
    (tmp_path / "dofs.csv").write_text(text)
    with pytest.raises(error, match=match):
        fx.io.read_dofs(tmp_path / "dofs.csv", **options)


def test_a_node_without_coordinates_is_named(tmp_path):
    (tmp_path / "dofs.csv").write_text("node,direction\n7,z\n8,z\n")
    (tmp_path / "nodes.csv").write_text("7 0 0 0\n")
    with pytest.raises(LabelError, match=r"\[8\]"):
        fx.io.read_dofs(tmp_path / "dofs.csv", nodes=tmp_path / "nodes.csv")

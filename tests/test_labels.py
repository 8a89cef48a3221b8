"""DofSet: labels, places, tables."""

import ast
import pickle
import time

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from flexplant import DofSet, load
from flexplant.errors import LabelError, ModelError, ShapeError
from flexplant.labels import DIRECTIONS, Interpolation

DOFS = DofSet([7, 7, 3, 3], ["z", "rx", "z", "rx"], [[0, 0, 0], [0, 0, 0], [1, 2, 0], [1, 2, 0]])


@st.composite
def dofsets(draw):
    nodes = draw(st.lists(st.integers(1, 999), min_size=1, max_size=8, unique=True))
    kinds = draw(st.lists(st.sampled_from(DIRECTIONS), min_size=1, max_size=6, unique=True))
    xyz = [[float(i), 2.0 * i, 0.5 * i] for i in range(len(nodes))]
    return DofSet(
        np.repeat(nodes, len(kinds)), kinds * len(nodes), np.repeat(xyz, len(kinds), axis=0)
    )


@pytest.mark.slow
@given(dofsets())
def test_labels_and_rows_are_each_other_s_inverse(dofs):
    assert [dofs.index(label) for label in dofs] == list(range(len(dofs)))
    assert list(dofs) == list(dofs.labels)
    assert len(set(dofs.labels)) == len(dofs)
    assert all(label in dofs for label in dofs)
    np.testing.assert_array_equal([dofs.row(label) for label in dofs], np.eye(len(dofs)))
    for label, xyz in zip(dofs, dofs.xyz, strict=True):
        assert dofs.nearest(xyz, label.split(":")[1]) == label
        assert dofs.row(xyz, label.split(":")[1])[dofs.index(label)] == 1


@pytest.mark.slow
@given(dofsets(), st.randoms())
def test_select_keeps_the_order_given(dofs, random):
    labels = list(dofs)
    random.shuffle(labels)
    chosen = dofs.select(labels)
    assert list(chosen) == labels
    np.testing.assert_array_equal(chosen.xyz, dofs.xyz[dofs.indices(labels)])


def test_where():
    assert DOFS.where(directions="z").labels == ("7:z", "3:z")
    assert DOFS.where(nodes=3).labels == ("3:z", "3:rx")
    assert DOFS.where(nodes=[3, 7], directions=["rx"]).labels == ("7:rx", "3:rx")
    assert DOFS.where().labels == DOFS.labels
    with pytest.raises(LabelError, match=r"nodes \[4\]"):
        DOFS.where(nodes=[3, 4])
    with pytest.raises(LabelError, match="ry"):
        DOFS.where(directions="ry")


def test_nearest():
    assert DOFS.nearest((0.9, 1.9, 0.3), "rx") == "3:rx"
    with pytest.raises(LabelError, match="'x'"):
        DOFS.nearest((0, 0, 0), "x")
    with pytest.raises(ShapeError, match=r"xyz must have shape \(3,\)"):
        DOFS.nearest((0, 0), "z")
    with pytest.raises(ModelError, match="xyz has a NaN"):
        DOFS.nearest((0, 0, np.nan), "z")


def test_unknown_labels_name_close_ones():
    with pytest.raises(LabelError, match=r"no DOF '7:zz' \(4 known\).*'7:z'"):
        DOFS.index("7:zz")
    with pytest.raises(LabelError, match="no DOF 7"):
        DOFS.index(7)
    with pytest.raises(LabelError, match=r"no DOF ..7:z"):
        DOFS.index(["7:z"])
    with pytest.raises(LabelError, match="no DOF '8:z'"):
        DOFS.indices(["7:z", "8:z"])
    assert "8:z" not in DOFS
    assert DOFS.indices("3:z").tolist() == [2]


@pytest.mark.parametrize("seed", range(3))
def test_a_point_next_to_a_rigid_body_gets_weights_of_its_motions(seed):
    """The mapping in the message gives the motion t + w x r of the body at the point."""
    node, point, t, w = np.random.default_rng(seed).normal(size=(4, 3))
    body = DofSet([5] * 6, DIRECTIONS, [node] * 6)
    for axis, wanted in zip("xyz", t + np.cross(w, point - node), strict=True):
        with pytest.raises(LabelError, match="rigidly with node 5: at=") as refusal:
            body.row(point, axis)
        place = ast.literal_eval(str(refusal.value).rpartition("at=")[2].rstrip("."))
        assert body.row(place) @ [*t, *w] == pytest.approx(wanted, rel=1e-4)


def test_rows_of_places():
    np.testing.assert_array_equal(DOFS.row({"7:z": 0.5, "3:z": -2}), [0.5, 0, -2, 0])
    np.testing.assert_array_equal(DOFS.row((1, 2, 0)), [0, 0, 1, 0])
    np.testing.assert_array_equal(DOFS.row((1, 2, 1e-12), "rx"), [0, 0, 0, 1])
    with pytest.raises(LabelError, match="no shape functions"):
        DOFS.row((0.5, 1, 0))
    with pytest.raises(LabelError, match="'u'"):
        DOFS.row((0, 0, 0), "u")
    with pytest.raises(LabelError, match="no DOF '9:z'"):
        DOFS.row({"9:z": 1.0})
    with pytest.raises(ModelError, match="weight of '7:z'"):
        DOFS.row({"7:z": np.nan})
    with pytest.raises(ShapeError, match="at must have shape"):
        DOFS.row((1, 2))


def test_an_interpolation_must_say_how():
    with pytest.raises(TypeError, match=r"abstract method '?row"):
        Interpolation()


@pytest.mark.parametrize(
    ("nodes", "directions", "xyz", "error", "cause"),
    [
        ([1, 2], ["z"], [[0, 0, 0]] * 2, ShapeError, "one direction per DOF"),
        ([[1, 2]], ["z", "z"], [[0, 0, 0]] * 2, ShapeError, "one direction per DOF"),
        ([1, 2], ["z", "z"], [[0, 0]] * 2, ShapeError, "xyz must have shape"),
        ([1, 2], ["z", "z"], [[0, 0, np.inf]] * 2, ModelError, "xyz has a NaN"),
        ([1, 2], ["z", "w"], [[0, 0, 0]] * 2, LabelError, "w"),
        ([1, 1], ["z", "z"], [[0, 0, 0]] * 2, LabelError, "1:z"),
    ],
)
def test_bad_sets(nodes, directions, xyz, error, cause):
    with pytest.raises(error, match=cause):
        DofSet(nodes, directions, xyz)


def test_repr_is_short():
    assert repr(DOFS) == "<DofSet 4 DOFs at 2 nodes: 2 z, 2 rx>"


def test_from_table(tmp_path):
    rows = [
        {"node": 4, "direction": "z", "x": 0.1, "y": 0.2, "z": 0},
        {"node": "5", "direction": " rx ", "x": "1e-1", "y": "0", "z": "0"},
    ]
    dofs = DofSet.from_table(rows)
    assert dofs.labels == ("4:z", "5:rx")
    np.testing.assert_array_equal(dofs.xyz, [[0.1, 0.2, 0], [0.1, 0, 0]])
    path = tmp_path / "dofs.csv"
    path.write_text("node,direction,x,y,z,remark\n4,z,0.1,0.2,0,corner\n5,rx,0.1,0,0,\n")
    for source in (path, str(path)):
        read = DofSet.from_table(source)
        assert read.labels == dofs.labels
        np.testing.assert_array_equal(read.xyz, dofs.xyz)
    with pytest.raises(LabelError, match=r"missing: \['direction'\]"):
        DofSet.from_table([{"node": 4, "x": 0, "y": 0, "z": 0}])
    with pytest.raises(LabelError, match="needs rows"):
        DofSet.from_table([])


def test_where_in_a_box():
    assert DOFS.where(box=[(0, 0, 0), (0.5, 5, 5)]).labels == ("7:z", "7:rx")
    assert DOFS.where(directions="z", box=[(1, 2, 0), (1, 2, 0)]).labels == ("3:z",)
    assert DOFS.where(box=[(-np.inf,) * 3, (np.inf,) * 3]).labels == DOFS.labels
    with pytest.raises(LabelError, match="nodes reach from"):
        DOFS.where(box=[(5, 5, 5), (6, 6, 6)])
    for box in ([(1, 0, 0), (0, 0, 0)], [(0, 0, 0)], "all", [(0, 0, np.nan), (1, 1, 1)]):
        with pytest.raises(ShapeError, match="lowest and its highest"):
            DOFS.where(box=box)


def test_only_the_canonical_label_is_one():
    for label in (
        "07:z",
        "+7:z",
        " 7:z",
        "7 :z",
        "7:Z",
        "7",
        ":z",
        "7:z:z",
        "7_0:z",
        "7.0:z",
        "",
        None,
    ):
        assert label not in DOFS
        with pytest.raises(LabelError, match="no DOF"):
            DOFS.index(label)
    many = DofSet([-3, 70], ["x", "rz"], np.zeros((2, 3)))
    assert many.index("-3:x") == 0
    assert "9" * 30 + ":z" not in many


def test_kinds_are_numbers_of_directions():
    dofs = DofSet([1] * 6, DIRECTIONS, np.zeros((6, 3)))
    assert dofs.kinds.tolist() == list(range(6))
    with pytest.raises(ValueError, match="read-only"):
        dofs.kinds[0] = 1


@pytest.mark.parametrize(
    ("make", "error", "says"),
    [
        (lambda: DofSet([1, 2, 1], ["z"] * 3, np.zeros((3, 3))), LabelError,
         r"'1:z' appears twice, in rows 0 and 2.*Drop one"),
        (lambda: DofSet([1.5], ["z"], np.zeros((1, 3))), LabelError, "whole numbers"),
        (lambda: DofSet(["a"], ["z"], np.zeros((1, 3))), LabelError, "whole numbers"),
        (lambda: DofSet([None], ["z"], np.zeros((1, 3))), LabelError, "whole numbers"),
        (lambda: DofSet([2**60], ["z"], np.zeros((1, 3))), LabelError, "whole numbers"),
        (lambda: DofSet([1], "z", np.zeros((1, 3))), LabelError, "one for each DOF"),
        (lambda: DofSet([1], ["up"], np.zeros((1, 3))), LabelError, "Translate the names"),
        (lambda: DofSet([1], [["z"]], np.zeros((1, 3))), LabelError, "unknown directions"),
        (lambda: DofSet([1], ["z"], np.zeros((1, 3)), "cubic"), LabelError, "interpolated"),
        (lambda: DofSet.from_table([{"node": "a", "direction": "z", "x": 0, "y": 0, "z": 0}]),
         LabelError, "column 'node'.*row 0.*not a number"),
        (lambda: DofSet.from_table([{"node": 1, "direction": "z", "x": "1 m", "y": 0, "z": 0}]),
         LabelError, "column 'x'.*'1 m'"),
        (lambda: DofSet.from_table([{"node": 1, "direction": "z", "x": None, "y": 0, "z": 0}]),
         LabelError, r"missing: \['x'\]"),
        (lambda: DofSet.from_table([(1, "z", 0, 0, 0)]), LabelError, "a tuple as its first row"),
        (lambda: DOFS.where(nodes=["seven"]), LabelError, "whole numbers"),
    ],
)  # fmt: skip
def test_errors_say_what_to_do(make, error, says):
    with pytest.raises(error, match=says):
        make()


@pytest.mark.slow
def test_many_dofs_stay_quick(tmp_path):
    """60 000 DOFs: no dictionary, no comparing of each label, a file in tenths of a second."""
    n = 60_000
    rng = np.random.default_rng(0)
    nodes = np.repeat(rng.permutation(n // 2) + 1, 2)
    start = time.process_time()
    dofs = DofSet(nodes, ("z", "rx") * (n // 2), rng.random((n, 3)))
    assert dofs.index(f"{nodes[777]}:rx") == 777
    with pytest.raises(LabelError, match=r"no DOF '7:zz' \(60000 known\).*'7:z', '7:rx'"):
        dofs.index("7:zz")
    with pytest.raises(LabelError, match="no DOF"):
        dofs.index(None)
    assert dofs.where(nodes=7).labels == ("7:z", "7:rx")
    assert dofs.nearest(dofs.xyz[500], "z") == f"{nodes[500]}:z"
    dofs.save(tmp_path / "dofs.npz")
    other = load(tmp_path / "dofs.npz")
    assert other.directions == dofs.directions
    assert other.index(f"{nodes[777]}:rx") == 777
    assert "labels" not in vars(dofs)
    assert time.process_time() - start < 2  # 0.3 s


def test_travels_read_only(tmp_path):
    DOFS.save(tmp_path / "dofs.npz")
    for other in (DOFS, pickle.loads(pickle.dumps(DOFS)), load(tmp_path / "dofs.npz")):
        assert other.labels == DOFS.labels
        assert other.index("3:rx") == 3
        with pytest.raises(ValueError, match="read-only"):
            other.nodes[0] = 1
        with pytest.raises(ValueError, match="read-only"):
            other.xyz[0, 0] = 1


def test_the_caller_s_arrays_stay_the_caller_s():
    nodes, xyz = np.array([1]), np.zeros((1, 3))
    dofs = DofSet(nodes, ["z"], xyz)
    nodes[0], xyz[0, 0] = 9, 9
    assert dofs.labels == ("1:z",)
    assert dofs.xyz[0, 0] == 0


@pytest.mark.parametrize("count", [8, 3000])
def test_rotations_of_a_solid_are_those_of_its_points(count):
    """Displacements alone: a rotation that is named leads to where it can be had."""
    nodes = np.repeat(np.arange(1, count + 1), 3)
    dofs = DofSet(nodes, ["x", "y", "z"] * count, np.zeros((3 * count, 3)))
    for asked in (
        lambda: dofs.index("5:rx"),
        lambda: dofs.row((0.0, 0.0, 0.0), "ry"),
        lambda: dofs.where(directions="rz"),
    ):
        with pytest.raises(LabelError, match=r"no DOF .* displacements.*flexplant\.interpolated"):
            asked()
    with pytest.raises(LabelError, match="no DOF") as found:
        dofs.index("999999:rx")
    assert "interpolated" not in str(found.value)


def test_coordinates_may_be_unknown():
    dofs = DofSet([1, 1, 2], ["x", "y", "x"])
    assert dofs.labels == ("1:x", "1:y", "2:x") and not dofs.xyz.any()

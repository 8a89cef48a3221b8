"""Local directions of universal files: random systems, turned by SciPy, become global again."""

import numpy as np
import pytest
from scipy.spatial.transform import Rotation
from test_uff import nodes, record, shape, systems, units, written

import flexplant as fx
from flexplant.errors import FlexplantError, ModelError
from flexplant.io import read_frf_uff, read_modes_uff, read_nodes_uff
from uff_files import analysis

pyuff = pytest.importorskip("pyuff")
DIRECTIONS = ("x", "y", "z", "rx", "ry", "rz")
#: dataset 18 and shapes have six digits
CLOSE = {"rtol": 3e-5, "atol": 3e-5}


class Geometry:
    """Nodes 1 to 5 at random places, given and moving in random systems 1 to 4."""

    def __init__(self, rng, kind):
        self.xyz = rng.uniform(-1.0, 1.0, (5, 3))
        self.turns = Rotation.random(4, random_state=int(rng.integers(2**31)))
        self.origins = rng.uniform(-1.0, 1.0, (4, 3))
        self.cylindrical = rng.integers(0, 2, 4) if kind == 2420 else np.zeros(4, dtype=int)
        self.moves = rng.integers(0, 5, 5)
        self.kind = kind
        straight = [0, *(number for number in range(1, 5) if not self.cylindrical[number - 1])]
        self.given = rng.choice(straight, 5)

    def axes(self, row):
        """Columns: what node row + 1 calls x, y, z, in the global system."""
        number = self.moves[row] - 1
        if number < 0:
            return np.eye(3)
        axes = self.turns[number].as_matrix()
        if self.cylindrical[number]:
            x, y, _ = axes.T @ (self.xyz[row] - self.origins[number])
            axes = axes @ Rotation.from_euler("z", np.arctan2(y, x)).as_matrix()
        return axes

    def blocks(self):
        """(30, 30): six motions of every node, from local ones to global ones."""
        whole = np.zeros((30, 30))
        for row in range(5):
            for first in (6 * row, 6 * row + 3):
                whole[first : first + 3, first : first + 3] = self.axes(row)
        return whole

    def sets(self):
        places = self.xyz.copy()
        for row, number in enumerate(self.given):
            if number:
                places[row] = (
                    self.turns[number - 1].inv().apply(places[row] - self.origins[number - 1])
                )
        listed = nodes(
            15,
            node_nums=[1, 2, 3, 4, 5],
            def_cs=self.given.tolist(),
            disp_cs=self.moves.tolist(),
            color=[1] * 5,
            **dict(zip("xyz", places.T, strict=True)),
        )
        return [self.of_18() if self.kind == 18 else self.of_2420(), listed]

    def of_2420(self):
        matrices = [
            np.vstack([turn.as_matrix().T, origin])
            for turn, origin in zip(self.turns, self.origins, strict=True)
        ]
        return systems(
            CS_sys_labels=[1, 2, 3, 4],
            CS_types=self.cylindrical.tolist(),
            CS_colors=[8] * 4,
            CS_names=["a", "b", "c", "d"],
            CS_matrices=matrices,
        )

    def of_18(self):
        """Each system by three points in the one before it, the first in the global one."""
        points = np.empty((4, 3, 3))
        for number in range(4):
            axes, origin = self.turns[number].as_matrix(), self.origins[number]
            points[number] = [origin, origin + 2 * axes[:, 0], origin + axes @ [0.5, 0.0, 3.0]]
            if number:
                before = self.turns[number - 1]
                points[number] = before.inv().apply(points[number] - self.origins[number - 1])
        return pyuff.prepare_18(
            cs_num=[1, 2, 3, 4],
            cs_type=[0] * 4,
            ref_cs_num=[0, 1, 2, 3],
            color=[1] * 4,
            method=[1] * 4,
            cs_name=["a", "b", "c", "d"],
            ref_o=points[:, 0],
            x_point=points[:, 1],
            xz_point=points[:, 2],
        )


@pytest.mark.parametrize("kind", [18, 2420])
@pytest.mark.parametrize("seed", range(4))
def test_all_four_readers_turn_to_global_directions(tmp_path, kind, seed):
    rng = np.random.default_rng(100 * kind + seed)
    geometry = Geometry(rng, kind)
    local = geometry.blocks().T
    motions = rng.normal(size=(30, 2)) + 1j * rng.normal(size=(30, 2))
    geometry_sets = geometry.sets()

    # measured FRFs: three directions of nodes, forces at two of them, in random order and sign
    rows = [6 * row + i for row in range(5) for i in range(3)]
    columns = [*range(3), *range(12, 15)]
    frf = rng.normal(size=(30, 30, 32)) + 1j * rng.normal(size=(30, 30, 32))
    seen = np.einsum("ab,bcf,dc->adf", local, frf, local)
    sets = []
    for row in rng.permutation(rows).tolist():
        for column in columns:
            up, down = rng.choice([-1, 1], 2).tolist()
            out, into = (
                (row // 6 + 1, up * (row % 6 + 1)),
                (column // 6 + 1, down * (column % 6 + 1)),
            )
            sets.append(record(out, into, up * down * seen[row, column]))
    found = read_frf_uff(written(tmp_path, [*sets, *geometry_sets]))
    names = [f"{row // 6 + 1}:{DIRECTIONS[row % 6]}" for row in range(30)]
    assert found.outputs == tuple(names[row] for row in rows)
    assert found.inputs == tuple(f"u {names[column]}" for column in columns)
    np.testing.assert_allclose(found.data, frf[np.ix_(rows, columns)], rtol=1e-3, atol=3e-4)

    # measured shapes, dataset 55 with six directions
    parts = []
    for number in (1, 2):
        own = np.real(local @ motions[:, number - 1]).reshape(5, 6)
        values = {f"r{i + 1}": own[:, i] for i in range(6)}
        parts.append(
            shape(number, data_ch=3, n_data_per_node=6, node_nums=np.arange(1, 6), **values)
        )
    path = written(tmp_path, [*parts, *geometry_sets])
    measured = read_modes_uff(path)
    assert measured.dofs == tuple(names)
    np.testing.assert_allclose(measured.shapes, np.real(motions), **CLOSE)

    # the same as modes of a model, with places
    solved = fx.io.read_modes(path, zeta=None)
    assert solved.dofs.labels == tuple(names)
    np.testing.assert_allclose(solved.phi, np.real(motions), **CLOSE)
    np.testing.assert_allclose(solved.dofs.xyz[::6], geometry.xyz, **CLOSE)
    moved = np.count_nonzero(geometry.moves)
    assert any(f"{moved} node" in note and "turned into" in note for note in solved.notes)

    # nodes
    np.testing.assert_allclose(read_nodes_uff(path).xyz[::3], geometry.xyz, **CLOSE)


@pytest.mark.parametrize("kind", [18, 2420])
def test_computed_results_are_turned(tmp_path, kind):
    """Dataset 2414, whose nodes are 9 and 4: modes and responses to a load."""
    rng = np.random.default_rng(kind)
    geometry = Geometry(rng, kind)
    geometry.moves = np.array([2, 3, 0, 1, 4])
    local = geometry.blocks()[:12, :12].T
    motions = rng.normal(size=12) + 1j * rng.normal(size=12)
    sets = geometry.sets()
    sets[1]["node_nums"] = [9, 4, 1, 2, 3]
    path = written(tmp_path, [units(), *sets], "m.unv")
    head = path.read_text()
    path.write_text(head + analysis(5, (local @ motions).reshape(2, 6), load=1, freq=5.0))
    frf = read_frf_uff(path)
    assert frf.outputs == tuple(f"{node}:{d}" for node in (9, 4) for d in DIRECTIONS)
    np.testing.assert_allclose(frf.data[:, 0, 0], motions, **CLOSE)
    path.write_text(head + analysis(2, (local @ motions.real).reshape(2, 6), mode=1, freq=5.0))
    for found in (read_modes_uff(path).shapes, fx.io.read_modes(path, zeta=0.0).phi):
        np.testing.assert_allclose(found[:, 0], motions.real, **CLOSE)


def quarter(**changes):
    """System 5: its x is global y, its y is -x."""
    matrix = np.vstack([Rotation.from_euler("z", 90, degrees=True).as_matrix().T, np.zeros(3)])
    return systems(CS_sys_labels=[5], CS_matrices=[matrix]) | changes


def test_single_directions_along_a_global_axis_keep_their_coherence(tmp_path):
    moved = nodes(2411, node_nums=[1, 2], disp_cs=[5, 0])
    one = np.arange(32) + 1j
    sets = [record((1, 1), (1, 2), one), record((1, 1), (1, 2), np.linspace(0, 1, 32), func_type=6)]
    found = read_frf_uff(written(tmp_path, [quarter(), moved, *sets]))
    assert (found.outputs, found.inputs) == (("1:y",), ("u 1:x",))
    np.testing.assert_allclose(found.data[0, 0], -one, rtol=1e-5)
    np.testing.assert_allclose(found.coherence[0, 0], np.linspace(0, 1, 32), rtol=1e-4)
    # order of the global names, not of the local ones
    sets = [record((1, i), (2, 3), i * one) for i in (1, 2)]
    found = read_frf_uff(written(tmp_path, [quarter(), moved, *sets]))
    assert (found.outputs, found.inputs) == (("1:x", "1:y"), ("u 2:z",))
    np.testing.assert_allclose(found.data[:, 0], [-2 * one, one], rtol=1e-5)
    # a shape measured in one direction only
    zero = np.zeros(2)
    part = shape(1, node_nums=np.array([1, 2]), r1=np.array([3.0, 0]), r2=zero, r3=np.array([0, 4]))
    modes = read_modes_uff(written(tmp_path, [quarter(), moved, part]))
    assert modes.dofs == ("1:y", "2:x", "2:z")
    np.testing.assert_allclose(modes.shapes[:, 0], [3, 0, 4])


def test_directions_that_give_no_global_one_are_refused_by_name(tmp_path):
    turn = Rotation.from_euler("z", 30, degrees=True).as_matrix()
    skew = quarter(CS_matrices=[np.vstack([turn.T, np.zeros(3)])])
    moved = nodes(2411, node_nums=[1, 2], disp_cs=[5, 0])
    one = np.arange(32) + 1j
    path = written(tmp_path, [skew, moved, record((1, 1), (2, 3), one)])
    with pytest.raises(ModelError, match=r"node 1 move along \[ ?0\.866.*Measure all three"):
        read_frf_uff(path)
    with pytest.raises(ModelError, match="node 1 move along"):
        read_frf_uff(written(tmp_path, [skew, moved, record((2, 3), (1, 2), one)]))
    # of nodes that were not measured nothing is asked, and z is z in both
    both = [record((1, 3), (2, 3), one), record((1, 3), (2, 3), np.ones(32), func_type=6)]
    assert read_frf_uff(written(tmp_path, [skew, moved, *both])).outputs == ("1:z",)
    pair = [record((1, i), (2, 3), one) for i in (1, 2)]
    coherent = [record((1, i), (2, 3), np.ones(32), func_type=6) for i in (1, 2)]
    path = written(tmp_path, [skew, moved, *pair, *coherent])
    with pytest.raises(ModelError, match="coherence=False"):
        read_frf_uff(path)
    expected = np.outer([turn[0, :2].sum(), turn[1, :2].sum()], one)
    np.testing.assert_allclose(read_frf_uff(path, coherence=False).data[:, 0], expected, rtol=1e-5)
    part = shape(1, node_nums=np.array([1, 2]), r1=np.ones(2), r2=np.zeros(2), r3=np.zeros(2))
    with pytest.raises(ModelError, match="node 1 move along"):
        read_modes_uff(written(tmp_path, [skew, moved, part]))


def test_systems_0_and_1(tmp_path):
    """0 is global, and so is 1 unless the file defines it."""
    one = np.arange(32) + 1j
    frf = record((1, 1), (2, 3), one)
    moved = nodes(15, node_nums=[1, 2], def_cs=[0, 1], disp_cs=[1, 0])
    assert read_frf_uff(written(tmp_path, [moved, frf])).outputs == ("1:x",)
    turned = quarter(CS_sys_labels=[1])
    path = written(tmp_path, [turned, moved, frf])
    assert read_frf_uff(path).outputs == ("1:y",)
    np.testing.assert_allclose(read_nodes_uff(path).xyz[3], [-4, 2, 6])
    with pytest.raises(ModelError, match="defines coordinate system 0, the global one, as turned"):
        read_frf_uff(written(tmp_path, [quarter(CS_sys_labels=[0]), moved, frf]))
    straight = np.vstack([np.eye(3), np.zeros(3)])
    same = quarter(CS_sys_labels=[0], CS_matrices=[straight])
    assert read_frf_uff(written(tmp_path, [same, moved, frf])).outputs == ("1:x",)


def test_systems_that_are_not_read_are_named(tmp_path):
    one = np.arange(32) + 1j
    frf = record((1, 1), (2, 3), one)
    moved = nodes(15, node_nums=[1, 2], def_cs=[0, 0], disp_cs=[5, 0])
    stretched = quarter()["CS_matrices"][0] * 1.1
    for system, why in (
        (units(), "5, which the file does not define"),
        (quarter(CS_types=[2]), "5, which is spherical"),
        (quarter(CS_types=[7]), "unknown type 7"),
        (quarter(CS_matrices=[stretched]), "not orthogonal"),
    ):
        with pytest.raises(ModelError, match=f"moves node 1 in coordinate system .*{why}"):
            read_frf_uff(written(tmp_path, [system, moved, frf]))
    eighteen = {"cs_num": [5], "cs_type": [1], "ref_cs_num": [0], "cs_name": ["a"]}
    eighteen |= {"type": 18, "ref_o": [[0, 0, 0]], "x_point": [[1, 0, 0]], "xz_point": [[0, 0, 1]]}
    for changes, why in (
        ({}, "type 1 of dataset 18"),
        ({"cs_type": [0], "ref_cs_num": [8]}, "refers to system 8"),
        ({"cs_type": [0], "xz_point": [[2, 0, 0]]}, "three points on a line"),
    ):
        with pytest.raises(ModelError, match=why):
            read_frf_uff(written(tmp_path, [eighteen | changes, moved, frf]))
    with pytest.raises(FlexplantError, match="coordinate system 5 is defined twice"):
        read_frf_uff(written(tmp_path, [quarter(), eighteen | {"cs_type": [0]}, moved, frf]))
    # places: dataset 2411 calls its coordinates those of the part; programs differ
    given = {"node_nums": [1, 2], "def_cs": [5, 0], "disp_cs": [0, 0]}
    with pytest.raises(ModelError, match="node 1 in coordinate system 5 in dataset 2411"):
        read_nodes_uff(written(tmp_path, [quarter(), nodes(2411, **given)]))
    with pytest.raises(ModelError, match="system 5, which is cylindrical"):
        read_nodes_uff(written(tmp_path, [quarter(CS_types=[1]), nodes(15, **given)]))
    with pytest.raises(ModelError, match="moves 1 node in local directions, the first 1"):
        read_nodes_uff(written(tmp_path, [quarter(), moved]))
    again = nodes(2411, node_nums=[1, 2], disp_cs=[0, 0])
    with pytest.raises(FlexplantError, match="moves node 1 in one coordinate system and again"):
        read_frf_uff(written(tmp_path, [quarter(), moved, again, frf]))


def test_places_and_directions_may_come_from_another_file(tmp_path):
    """Shapes in one file, nodes in another; and a table of places."""
    geometry = Geometry(np.random.default_rng(8), 2420)
    motions = np.random.default_rng(9).normal(size=30)
    own = (geometry.blocks().T @ motions).reshape(5, 6)
    values = {f"r{i + 1}": own[:, i] for i in range(6)}
    part = shape(1, data_ch=3, n_data_per_node=6, node_nums=np.arange(1, 6), **values)
    alone = written(tmp_path, [part], "shapes.uff")
    places = written(tmp_path, [*geometry.sets(), part], "nodes.uff")
    modes = fx.io.read_modes(alone, zeta=None, nodes=places)
    np.testing.assert_allclose(modes.phi[:, 0], motions, **CLOSE)
    table = tmp_path / "nodes.csv"
    lines = [f"{i + 1},{','.join(map(repr, row.tolist()))}" for i, row in enumerate(geometry.xyz)]
    table.write_text("\n".join(["node,x,y,z", *lines]))
    modes = fx.io.read_modes(places, zeta=None, nodes=table)
    np.testing.assert_allclose(modes.phi[:, 0], motions, **CLOSE)

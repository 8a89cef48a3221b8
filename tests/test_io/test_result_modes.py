"""Modes of result files: real ones of Nastran and ANSYS, and files written here word by word."""

import re

import numpy as np
import pytest
from test_exodus import write as write_exodus

import flexplant as fx
from flexplant.errors import FlexplantError, LabelError, ModelError, ShapeError
from flexplant.io import read_modes
from op2_files import op2, punch
from shared_data import data_file, needs

SHARED = data_file("fe/nastran")
needs_data = needs(SHARED)
#: two nodes; the second moves in system 5, turned by 90 degrees about z
XYZ = {7: (0.0, 0.0, 0.0), 9: (0.5, 0.25, 0.0)}
VALUES = np.random.default_rng(4).normal(size=(3, 2, 6))
EIGENVALUES = np.array([-1e-7, 400.0, 10000.0])
MASSES = np.array([1.0, 4.0, 0.25])


def in_basic(values=VALUES):
    """(12, 3) of unit mass: what node 9 calls x is basic y, and its y is -x."""
    turned = values.copy()
    for first in (0, 3):
        turned[:, 1, first] = -values[:, 1, first + 1]
        turned[:, 1, first + 1] = values[:, 1, first]
    return turned.reshape(3, 12).T / np.sqrt(MASSES)


@pytest.mark.parametrize("order", "<>")
@pytest.mark.parametrize("size", [4, 8])
def test_every_kind_of_words(tmp_path, order, size):
    path = tmp_path / "run.op2"
    path.write_bytes(op2(XYZ, {9: 5}, VALUES, EIGENVALUES, MASSES, order=order, size=size))
    modes = read_modes(path, zeta=[0.01, 0.02, 0.03], rigid_below=0.1)
    assert modes.dofs.labels[:2] == ("7:x", "7:y")
    np.testing.assert_allclose(modes.omega, [0, 20, 100], rtol=1e-6)
    assert modes.n_rigid == 1
    np.testing.assert_allclose(modes.phi, in_basic(), rtol=1e-6, atol=1e-12)
    np.testing.assert_allclose(modes.dofs.xyz[[0, 6]], list(XYZ.values()), rtol=1e-6)
    assert modes.zeta.tolist() == [0, 0.02, 0.03]
    said = repr(modes)
    for words in ("no residual attachment", "1 node moved in local", "generalised masses of 0.25"):
        assert words in said
    # basic directions by the name of the table; other units
    content = op2(XYZ, {9: 5}, VALUES, EIGENVALUES, MASSES, order=order, size=size, name="BOUGV1")
    path.write_bytes(content)
    plain = read_modes(path, zeta=0.0, rigid_below=0.1, units=("mm", "t", "s"))
    expected = VALUES.reshape(3, 12).T / np.sqrt(MASSES) / np.sqrt(1000.0)
    expected[[3, 4, 5, 9, 10, 11]] /= 1e-3
    np.testing.assert_allclose(plain.phi, expected, rtol=1e-6)
    np.testing.assert_allclose(plain.dofs.xyz[6], [0.5e-3, 0.25e-3, 0], rtol=1e-6)


#: sizes of the three coordinates, angles in degrees
SIZES = {"CORD2R": (1, 1, 1), "CORD2C": (1, 180, 1), "CORD2S": (1, 90, 180)}


def random_geometry(rng):
    """Systems of all kinds in each other, and nodes {id: (system, place, system of motions)}."""
    systems, coordinates = [], [SIZES["CORD2R"]]
    for number in range(1, 7):
        kind = ("CORD2R", "CORD2C", "CORD2S")[number % 3]
        base = int(rng.integers(0, number)) if number > 1 else 0
        points = rng.uniform(0.2, 1.0, (3, 3)) * coordinates[base]
        coordinates.append(SIZES[kind])
        systems.append((kind, number, base, points))
    nodes = {}
    for node in range(11, 19):
        inside, moves = (int(i) for i in rng.integers(0, 7, 2))
        nodes[node] = (inside, rng.uniform(0.2, 1.0, 3) * coordinates[inside], moves)
    return systems, nodes


@pytest.mark.slow
@pytest.mark.parametrize("order", "<>")
@pytest.mark.parametrize("double", [False, True])
def test_places_and_local_directions_by_another_program(tmp_path, order, double):
    """Rigid motions that pyyeti forms in local directions are rigid again in basic ones."""
    n2p, pd = pytest.importorskip("pyyeti.nastran.n2p"), pytest.importorskip("pandas")
    path = tmp_path / "run.op2"
    for seed in range(10):
        systems, nodes = random_geometry(np.random.default_rng(seed))
        known, table = {}, None
        for kind, number, base, points in systems:
            head = [number, ("CORD2R", "CORD2C", "CORD2S").index(kind) + 1, base]
            n2p.mkusetcoordinfo(np.vstack([head, points]), None, known)
        for node, (inside, place, moves) in nodes.items():
            one = n2p.addgrid(None, node, "b", inside, place, moves, known)
            table = one if table is None else pd.concat([table, one])
        rigid = n2p.rbgeom_uset(table)
        xyz = table.loc[(slice(None), 1), "x":"z"].to_numpy()
        content = op2(
            {node: place for node, (_, place, _) in nodes.items()},
            {node: moves for node, (_, _, moves) in nodes.items()},
            rigid.T.reshape(6, len(nodes), 6),
            np.arange(1.0, 7.0) ** 2,
            np.ones(6),
            order=order,
            into={node: inside for node, (inside, _, _) in nodes.items()},
            cards=systems,
            double=double,
        )
        path.write_bytes(content)
        modes = read_modes(path, zeta=0.01)
        exact = 1e-13 if double else 2e-5
        np.testing.assert_allclose(modes.dofs.xyz[::6], xyz, rtol=exact, atol=exact)
        expected = n2p.rbgeom(xyz)
        np.testing.assert_allclose(modes.phi, expected, atol=2e-5)


def test_geometry_of_an_unknown_layout_is_named(tmp_path):
    path = tmp_path / "run.op2"
    for card, key in (("GRID", 4501), ("CORD2R", 2101)):
        for wrong in (0, 9, 1120002, 2220008 + 1):
            content = op2(XYZ, {9: 5}, VALUES, EIGENVALUES, MASSES, keys={card: wrong})
            path.write_bytes(content)
            with pytest.raises(
                ModelError, match=rf"{card} cards with the key \({key}, .*{wrong}\)"
            ):
                read_modes(path, zeta=0.01, rigid_below=0.1)
    # a layout of 4-byte words in a file of 8-byte ones
    path.write_bytes(op2(XYZ, {}, VALUES, EIGENVALUES, MASSES, size=8, keys={"GRID": 1120001}))
    with pytest.raises(ModelError, match="words of 8 bytes"):
        read_modes(path, zeta=0.01, rigid_below=0.1)
    # cards of another layout than their key says
    path.write_bytes(op2(XYZ, {}, VALUES, EIGENVALUES, MASSES, keys={"GRID": 1120001}))
    with pytest.raises(FlexplantError, match="GRID cards of 44 bytes in a record of 64"):
        read_modes(path, zeta=0.01, rigid_below=0.1)


@pytest.mark.parametrize(("mode", "mass"), [(1, 0.0), (2, -1.0), (2, np.inf), (3, np.nan)])
def test_masses_that_none_has_are_refused(tmp_path, mode, mass):
    masses = MASSES.copy()
    masses[mode - 1] = mass
    path = tmp_path / "run.op2"
    path.write_bytes(op2(XYZ, {}, VALUES, EIGENVALUES, masses))
    with pytest.raises(
        ModelError, match=f"gives mode {mode} an impossible generalised mass of {mass:g}"
    ):
        read_modes(path, zeta=0.01, rigid_below=0.1)
    with pytest.raises(ModelError, match="matrices need M"):
        path.write_bytes(op2(XYZ, {}, VALUES, EIGENVALUES, MASSES))
        read_modes(path, zeta=0.0, rigid_below=0.1, matrices=fx.structure.FEMatrices(np.eye(12)))


def test_what_op2_files_lack_is_said(tmp_path):
    path = tmp_path / "run.op2"

    def written(**options):
        path.write_bytes(op2(XYZ, {9: 5}, VALUES, EIGENVALUES, MASSES, **options))
        return path

    with pytest.raises(ModelError, match=r"Give zeta=0\.01"):
        read_modes(written(), zeta=None, rigid_below=0.1)
    with pytest.raises(ModelError, match="rigid_below"):
        read_modes(path, zeta=0.0)
    with pytest.raises(ShapeError, match="3 modes"):
        read_modes(path, zeta=[0.1, 0.2], rigid_below=0.1)
    assert "does not say" in repr(read_modes(written(lama=False), zeta=0.01, rigid_below=0.1))
    with pytest.raises(LabelError, match=r"no coordinate system 5"):
        read_modes(written(systems=False), zeta=0.01, rigid_below=0.1)
    with pytest.raises(LabelError, match=r"where 2 of its nodes are.*nodes="):
        read_modes(written(geometry=False), zeta=0.01, rigid_below=0.1)
    # the bulk data says it, local directions included
    bulk = "CORD2R,5,,0.,0.,0.,0.,0.,1.\n,0.,1.,0.\nGRID,7,,0.,0.,0.\nGRID,9,,.5,.25,0.,5\n"
    (tmp_path / "run.bdf").write_text(bulk)
    modes = read_modes(path, zeta=0.01, rigid_below=0.1, nodes=tmp_path / "run.bdf")
    np.testing.assert_allclose(modes.phi, in_basic(), rtol=1e-6, atol=1e-12)
    with pytest.raises(ModelError, match=r"several sets of modes \(3 in OUGV1, 3 in OUGV1\)"):
        read_modes(written(subcases=2), zeta=0.01, rigid_below=0.1)
    content = written().read_bytes()
    for cut in range(0, len(content), 97):
        path.write_bytes(content[:cut])
        with pytest.raises(FlexplantError):
            read_modes(path, zeta=0.01, rigid_below=0.1)
    with pytest.raises(FlexplantError, match=r"run\.op2.*read_modes.*MATOP4"):
        fx.read_model(path)


@pytest.mark.parametrize(
    ("code", "said"),
    [
        ((9, 7, 14), "holds complex mode shapes, no real normal modes"),
        ((8, 7, 8), "holds shapes of buckling, no real normal modes"),
        ((1, 1, 8), "static displacements"),
        ((5, 1, 14), "frequency responses"),
        ((6, 1, 8), "transient responses"),
        ((2, 2007, 8), r"form that is not read .*2007, 8"),
        ((2, 7, 14), r"form that is not read .*7, 14"),
    ],
)
@pytest.mark.parametrize("size", [4, 8])
def test_other_vectors_are_named(tmp_path, code, said, size):
    path = tmp_path / "run.op2"
    path.write_bytes(op2(XYZ, {}, VALUES, EIGENVALUES, MASSES, size=size, table_code=code))
    with pytest.raises(FlexplantError, match=said):
        read_modes(path, zeta=0.01)


def test_an_op2_file_of_another_dialect_is_said_to_be(tmp_path):
    """Data blocks without a trailer, whose names are not known."""
    path = tmp_path / "run.op2"
    four = np.array(4, "<i4").tobytes()

    def key(number):
        return four + np.array(number, "<i4").tobytes() + four

    path.write_bytes(key(-1) + key(-2) + key(0))
    with pytest.raises(FlexplantError, match=r"no table that is known here.*another program"):
        read_modes(path, zeta=0.01)
    path.write_bytes(op2(XYZ, {}, VALUES, EIGENVALUES, MASSES, name="STRANGE"))
    with pytest.raises(FlexplantError, match=r"tables are \['GEOM1', 'LAMA', 'STRANGE'\]"):
        read_modes(path, zeta=0.01)


def test_punched_eigenvectors(tmp_path):
    path = tmp_path / "run.pch"
    path.write_text(punch(VALUES, EIGENVALUES, list(XYZ)))
    bulk = "CORD2R,5,,0.,0.,0.,0.,0.,1.\n,0.,1.,0.\nGRID,7,,0.,0.,0.\nGRID,9,,.5,.25,0.,5\n"
    (tmp_path / "run.dat").write_text(bulk)
    modes = read_modes(path, zeta=0.01, rigid_below=0.1, nodes=tmp_path / "run.dat")
    np.testing.assert_allclose(modes.phi, in_basic() * np.sqrt(MASSES), rtol=2e-6, atol=1e-9)
    assert modes.freq[1:] == pytest.approx([20 / 2 / np.pi, 100 / 2 / np.pi], rel=1e-6)
    with pytest.raises(LabelError, match="nodes="):
        read_modes(path, zeta=0.01, rigid_below=0.1)
    text = path.read_text()
    path.write_text(text.replace("-CONT-", "-CON--", 1))
    with pytest.raises(FlexplantError, match="line 7: a point of an eigenvector"):
        read_modes(path, zeta=0.01, rigid_below=0.1, nodes=tmp_path / "run.dat")
    for wrong, why in ((text[:-90], "whole"), ("DMIG    KAAX", "DMIG .* are read by")):
        path.write_text(wrong)
        with pytest.raises(FlexplantError, match=why):
            read_modes(path, zeta=0.01, rigid_below=0.1, nodes=tmp_path / "run.dat")
    with pytest.raises(FlexplantError, match=r"not a known file of modes.*PARAM,POST,-1"):
        read_modes(path.rename(tmp_path / "run.f06"), zeta=0.01)


@needs_data
@pytest.mark.parametrize("name", ["beam_modes_m1.op2", "beam_modes_m2.op2"])
def test_a_real_beam_has_the_modes_that_were_printed(name):
    """In f06 the shapes have other norms: of unit mass they agree, to the digits printed."""
    modes = read_modes(SHARED / "results" / name, zeta=0.01)
    text = (SHARED / "results" / "beam_modes.f06").read_text()
    table = text[text.index("R E A L   E I G E N V A L U E S") :].splitlines()[3:13]
    rows = np.array([[float(word) for word in line.split()] for line in table])
    np.testing.assert_allclose(modes.omega, rows[:, 3], rtol=1e-6)
    for mode in (5, 6):  # the others are pairs of equal frequency
        part = text[re.search(rf"E I G E N V E C T O R   N O \. +{mode}\n", text).end() :]
        lines = re.findall(r"^ +(\d+) +G +(.*)$", part.split("\n1 ")[0], flags=re.MULTILINE)
        printed = {int(node): np.array(row.split(), dtype=float) for node, row in lines}
        phi = np.array([printed[node] for node in np.unique(modes.dofs.nodes)]).ravel()
        labels = [f"{n}:{d}" for n in np.unique(modes.dofs.nodes) for d in fx.labels.DIRECTIONS]
        own = dict(zip(labels, phi, strict=True))
        expected = np.array([own[label] for label in modes.dofs.labels]) / np.sqrt(
            rows[mode - 1, 5]
        )
        found = modes.phi[:, mode - 1]
        sign = np.sign(found @ expected)
        np.testing.assert_allclose(sign * found, expected, atol=2e-6 * np.abs(expected).max())
    np.testing.assert_allclose(np.ptp(modes.dofs.xyz[:, 0]), 9.0)


@needs_data
def test_rigid_modes_of_a_real_assembly_are_rigid_in_global_directions():
    """Two of the nodes move in a cylindrical system: untransformed, the motion is not rigid."""
    modes = read_modes(SHARED / "extseout" / "assemble.op2", zeta=0.01, rigid_below=0.01)
    assert modes.n_rigid == 6
    wanted = modes.rigid_motions()
    rigid = modes.phi[:, :6]
    off = rigid - wanted @ np.linalg.lstsq(wanted, rigid, rcond=None)[0]
    assert np.abs(off).max() < 1e-5 * np.abs(rigid).max()
    assert any("2 nodes moved in local" in note for note in modes.notes)
    assert any("1 within" in note for note in modes.notes)


def channels(label):
    return fx.Ports(
        w=[fx.Disturbance("d", at=label)],
        u=[fx.Actuator("f", at=label)],
        z=[fx.Poi("tip", at=label)],
        y=[fx.Sensor("s", at=label, asd=1e-12)],
    )


@needs_data
def test_a_plant_of_modes_of_a_file():
    """Its response is the modal sum, with the frequencies and shapes as read."""
    modes = read_modes(SHARED / "results" / "beam_modes_m1.op2", zeta=0.02)
    plant = fx.assemble_plant(modes, channels("8:z"))
    freq = np.array([10.0, 456.0, 3000.0])
    found = fx.frequency_response(plant.system, freq)["s", "f"]
    s = 2j * np.pi * freq[:, np.newaxis]
    row = modes.at("8:z")
    terms = row**2 / (s**2 + 2 * 0.02 * modes.omega * s + modes.omega**2)
    np.testing.assert_allclose(found, terms.sum(axis=1), rtol=1e-9)


def test_modes_of_exodus_and_universal_files(tmp_path):
    path = write_exodus(tmp_path / "a.exo")
    with pytest.raises(ModelError, match="holds its nodes"):
        read_modes(path, zeta=0.01, nodes=path)
    ours = read_modes(path, zeta=0.01, rigid_below=0.1)
    theirs = fx.io.read_exodus_modes(path, zeta=0.01, rigid_below=0.1)
    assert ours.dofs.labels == theirs.dofs.labels
    np.testing.assert_array_equal(ours.phi, theirs.phi)
    pyuff = pytest.importorskip("pyuff")
    path = tmp_path / "m.unv"
    nodes = {"type": 15, "node_nums": [4, 2], "def_cs": [0, 0], "disp_cs": [0, 0], "color": [1, 1]}
    nodes |= {"x": [0.0, 1.0], "y": [0.0, 0.5], "z": [0.0, 0.0]}
    shape = {
        "type": 55, "model_type": 1, "analysis_type": 2, "data_ch": 3, "spec_data_type": 8,
        "data_type": 2, "r1": np.zeros(2), "r2": np.zeros(2), "r3": np.array([0.5, 2.0]),
        "n_data_per_node": 3, "node_nums": np.array([4, 2]), "load_case": 1, "mode_n": 1,
        "freq": 12.5, "modal_m": 4.0, "modal_damp_vis": 0.015, "modal_damp_his": 0.0,
    }  # fmt: skip
    pyuff.UFF(str(path)).write_sets([nodes, shape])
    modes = read_modes(path, zeta=None)
    assert modes.dofs.labels == ("4:z", "2:z")
    assert modes.phi[:, 0].tolist() == [0.25, 1.0]
    assert (modes.freq.item(), modes.zeta.item()) == (pytest.approx(12.5), pytest.approx(0.015))
    assert modes.dofs.xyz[1].tolist() == [1.0, 0.5, 0.0]


def test_shapes_are_checked_with_the_matrices_of_the_model(tmp_path):
    """Modes solved here and written as .op2 pass; with a mass that is 1 % larger they do not."""
    n = 3
    dofs = fx.DofSet([1, 2, 3], ["z"] * n, [[i, 0.0, 0.0] for i in range(n)])
    K = 100 * (2 * np.eye(n) - np.eye(n, k=1) - np.eye(n, k=-1))
    model = fx.FEModel(np.diag([1.0, 2.0, 1.5]), K, dofs=dofs)
    modes = fx.solve_modes(model, damping=fx.ModalDamping(0.01))
    values = np.zeros((n, n, 6))
    values[:, :, 2] = modes.phi.T
    path = tmp_path / "run.op2"
    xyz = {i + 1: tuple(row) for i, row in enumerate(dofs.xyz)}
    path.write_bytes(op2(xyz, {}, values, modes.omega**2, np.ones(n)))
    assert read_modes(path, zeta=0.01, matrices=model).certificate["mass"] < 1e-6
    heavier = fx.FEModel(1.01 * model.M, K, dofs=dofs)
    with pytest.raises(ModelError, match="not mass-normalised with M"):
        read_modes(path, zeta=0.01, matrices=heavier)
    less = fx.FEModel(model.M[:2, :2], K[:2, :2], dofs=dofs.select(["1:z", "2:z"]))
    with pytest.raises(LabelError, match=r"1 DOFs that the matrices do not have.*'3:z'"):
        read_modes(path, zeta=0.01, matrices=less)


@pytest.mark.slow
def test_modes_of_ansys_with_the_published_frequencies(tmp_path):
    examples = pytest.importorskip("ansys.mapdl.reader.examples")
    modes = read_modes(examples.rstfile, zeta=0.01)
    np.testing.assert_allclose(
        modes.freq, [7366.495, 7366.495, 11504.895, 17285.705, 17285.705, 20137.193], rtol=1e-7
    )
    assert len(modes.dofs) == 963
    np.testing.assert_allclose(np.ptp(modes.dofs.xyz, axis=0), [1, 1, 5])
    # a square bar: bending in x and in y come as a pair, and twist moves no point of the axis
    power = {d: (modes.phi[[x == d for x in modes.dofs.directions]] ** 2).sum(0) for d in "xyz"}
    np.testing.assert_allclose(power["x"][:2].sum(), power["y"][:2].sum(), rtol=1e-6)
    (tmp_path / "text.rst").write_text("Title\n=====\n")
    with pytest.raises(FlexplantError, match=r"text\.rst"):
        read_modes(tmp_path / "text.rst", zeta=0.01)

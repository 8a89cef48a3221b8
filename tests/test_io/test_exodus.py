"""Exodus files of modes, written here variable by variable."""

import numpy as np
import pytest
import scipy.io

from flexplant.errors import FlexplantError, LabelError, ModelError, ShapeError
from flexplant.io import read_exodus_modes

FREQ = np.array([0.0, 1e-5, 12.5, 40.0])
XYZ = np.array([[0.0, 1.0, 2.0], [3.0, 4.0, 5.0], [6.0, 7.0, 8.0]])
NAMES = ("DispX", "DispY", "DispZ", "RotX")
#: (variable, mode, node)
VALUES = np.random.default_rng(0).normal(size=(4, 4, 3))
# node by node: x, y, z, rx
PHI = VALUES.transpose(2, 0, 1).reshape(12, 4)


def write(path, *, names=NAMES, times=FREQ, values=VALUES, coord=False, ids=(7, 3, 9), one=False):
    with scipy.io.netcdf_file(path, "w") as file:
        file.createDimension("time_step", None)
        for name, size in (("num_nodes", 3), ("num_dim", 3), ("len_name", 33)):
            file.createDimension(name, size)
        file.createDimension("num_nod_var", len(names))
        if coord:
            file.createVariable("coord", "d", ("num_dim", "num_nodes"))[:] = XYZ.T
        else:
            for i, axis in enumerate("xyz"):
                file.createVariable(f"coord{axis}", "d", ("num_nodes",))[:] = XYZ[:, i]
        if ids:
            file.createVariable("node_num_map", "i", ("num_nodes",))[:] = ids
        table = np.zeros((len(names), 33), "S1")
        for row, name in zip(table, names, strict=True):
            row[: len(name)] = list(name)
        file.createVariable("name_nod_var", "c", ("num_nod_var", "len_name"))[:] = table
        time = file.createVariable("time_whole", "d", ("time_step",))
        time[: len(times)] = times
        if one:
            dims = ("time_step", "num_nod_var", "num_nodes")
            file.createVariable("vals_nod_var", "d", dims)[: len(times)] = values.transpose(1, 0, 2)
        else:
            for i, value in enumerate(values, 1):
                shape = file.createVariable(f"vals_nod_var{i}", "d", ("time_step", "num_nodes"))
                shape[: len(times)] = value
    return path


@pytest.mark.parametrize("coord", [False, True])
@pytest.mark.parametrize("one", [False, True])
def test_modes(tmp_path, coord, one):
    path = write(tmp_path / "a.exo", coord=coord, one=one)
    modes = read_exodus_modes(path, rigid_below=0.1, zeta=0.01)
    assert modes.n_rigid == 2
    assert modes.freq == pytest.approx([0, 0, 12.5, 40.0])
    assert modes.zeta.tolist() == [0, 0, 0.01, 0.01]
    assert np.array_equal(modes.phi, PHI)
    assert modes.dofs.labels[:5] == ("7:x", "7:y", "7:z", "7:rx", "3:x")
    assert modes.dofs.xyz[4].tolist() == [3.0, 4.0, 5.0]
    assert modes.at("3:z").tolist() == VALUES[2, :, 1].tolist()


def test_what_stands_in_the_place_of_time(tmp_path):
    omega = 2 * np.pi * FREQ
    for times, values in (("frequency", FREQ), ("omega", omega), ("eigenvalue", omega**2)):
        path = write(tmp_path / "a.exo", times=values, ids=None)
        modes = read_exodus_modes(path, times=times, rigid_below=0.1)
        assert modes.omega == pytest.approx([0, 0, *omega[2:]])
        assert modes.dofs.nodes[-1] == 3
    with pytest.raises(ModelError, match="times must be one of"):
        read_exodus_modes(path, times="hertz")


def test_rigid_body_modes_that_came_out_anywhere_come_first(tmp_path):
    path = write(tmp_path / "a.exo", times=[30.0, -1e-4, 5.0, 1e-6])
    with pytest.raises(ModelError, match="rigid_below"):
        read_exodus_modes(path)
    modes = read_exodus_modes(path, rigid_below=0.1)
    assert modes.freq == pytest.approx([0, 0, 5.0, 30.0])
    assert np.array_equal(modes.phi, PHI[:, [1, 3, 2, 0]])


def test_the_mass_matrix_checks_the_shapes(tmp_path):
    rng = np.random.default_rng(5)
    root = rng.normal(size=(12, 12)) + 5 * np.eye(12)
    M = root @ root.T
    phi = np.linalg.solve(root.T, np.linalg.qr(rng.normal(size=(12, 4)))[0])
    values = phi.reshape(3, 4, 4).transpose(1, 2, 0)
    path = write(tmp_path / "a.exo", values=values)
    modes = read_exodus_modes(path, rigid_below=0.1, M=M)
    assert modes.phi.T @ M @ modes.phi == pytest.approx(np.eye(4), abs=1e-9)
    with pytest.raises(ModelError, match="not mass-normalised"):
        read_exodus_modes(path, rigid_below=0.1, M=1.01 * M)
    with pytest.raises(ShapeError, match="node by node"):
        read_exodus_modes(path, rigid_below=0.1, M=M[:4, :4])


def test_names_of_variables(tmp_path):
    names = ("temp", "displ_y", "DISP_Z", "RotX")
    modes = read_exodus_modes(write(tmp_path / "a.exo", names=names), rigid_below=0.1)
    assert modes.dofs.directions[:3] == ("y", "z", "rx")
    assert modes.at("7:y").tolist() == VALUES[1, :, 0].tolist()
    strange = write(tmp_path / "b.exo", names=("a", "b", "c", "e"))
    with pytest.raises(FlexplantError, match=r"\['a', 'b', 'c', 'e'\].*variables="):
        read_exodus_modes(strange, rigid_below=0.1)
    modes = read_exodus_modes(strange, rigid_below=0.1, variables={"z": "c"})
    assert modes.dofs.labels == ("7:z", "3:z", "9:z")
    for wrong in ({"z": "q"}, {"up": "c"}, {}):
        with pytest.raises(LabelError, match="variables="):
            read_exodus_modes(strange, variables=wrong)
    with pytest.raises(LabelError, match="variables must be a mapping"):
        read_exodus_modes(strange, variables="c")
    with pytest.raises(ShapeError, match="one of each of 4 modes"):
        read_exodus_modes(strange, zeta=np.ones(3), rigid_below=0.1, variables={"z": "c"})
    strange.write_bytes(strange.read_bytes().replace(b"coord", b"place"))
    with pytest.raises(FlexplantError, match="no coordinates of nodes"):
        read_exodus_modes(strange)
    with pytest.raises(FlexplantError, match="not clear which"):
        read_exodus_modes(write(tmp_path / "c.exo", names=("ux", "DispX", "uy", "uz")))


def test_hdf5(tmp_path, monkeypatch):
    h5py = pytest.importorskip("h5py")
    path = tmp_path / "a.exo"
    with h5py.File(path, "w") as file:
        for i, axis in enumerate("xyz"):
            file[f"coord{axis}"] = XYZ[:, i]
        file["name_nod_var"] = np.array([list(n.ljust(6, "\0")) for n in NAMES], dtype="S1")
        file["time_whole"] = FREQ
        for i, value in enumerate(VALUES, 1):
            file[f"vals_nod_var{i}"] = value
    modes = read_exodus_modes(path, rigid_below=0.1)
    assert np.array_equal(modes.phi, PHI)
    content = path.read_bytes()
    for cut in np.linspace(9, len(content) - 9, 20).astype(int).tolist():
        (tmp_path / "b.exo").write_bytes(content[:cut])
        with pytest.raises(FlexplantError):
            read_exodus_modes(tmp_path / "b.exo", rigid_below=0.1)
    monkeypatch.setitem(__import__("sys").modules, "h5py", None)
    with pytest.raises(FlexplantError, match=r"pip install 'flexplant\[hdf5\]'"):
        read_exodus_modes(path)


@pytest.mark.slow
def test_cut_or_foreign_files(tmp_path):
    path, part = write(tmp_path / "a.exo"), tmp_path / "b.exo"
    content = path.read_bytes()
    for cut in np.linspace(0, len(content) - 9, 50).astype(int).tolist():
        part.write_bytes(content[:cut])
        with pytest.raises(FlexplantError):
            read_exodus_modes(part, rigid_below=0.1)
    part.write_text("no netCDF at all")
    with pytest.raises(FlexplantError, match="Is it an Exodus"):
        read_exodus_modes(part)
    rng = np.random.default_rng(1)
    for _ in range(100):
        spoiled = bytearray(content)
        spoiled[rng.integers(600)] = rng.integers(256)
        part.write_bytes(spoiled)
        try:
            read_exodus_modes(part, rigid_below=0.1)
        except FlexplantError as error:
            assert str(error)
    with pytest.raises(FlexplantError, match="NaN"):
        read_exodus_modes(write(part, times=[0, 1, np.nan, 3]), rigid_below=0.1)
    with pytest.raises(FlexplantError, match="no time steps"):
        read_exodus_modes(write(part, times=[], values=VALUES[:, :0]))
    with pytest.raises(FileNotFoundError):
        read_exodus_modes(tmp_path / "none.exo")

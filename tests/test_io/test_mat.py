"""MATLAB files, read by scipy alone and read back."""

import re

import control
import numpy as np
import pytest
import scipy.io

import flexplant as fx
from flexplant.errors import FlexplantError, LabelError, ModelError, ShapeError
from flexplant.io import read_mat, write_mat
from flexplant.lti import StateSpace
from flexplant.plant import StandardPlant
from machines import stage


def cells(content, name):
    """A cell array of strings as MATLAB shows it: n x 1, one char row in each."""
    array = content[name]
    assert array.dtype == object
    assert array.shape[1] == 1
    return [str(cell[0]) for cell in array[:, 0]]


def test_a_plant_as_scipy_reads_it(tmp_path):
    plant = stage()
    write_mat(tmp_path / "plant.mat", plant)
    content = scipy.io.loadmat(tmp_path / "plant.mat")
    g = plant.system
    for name in "ABCD":
        assert np.array_equal(content[name], getattr(g, name))
    assert content["dt"].item() == g.dt
    assert cells(content, "inputs") == list(g.inputs)
    assert cells(content, "outputs") == list(g.outputs)
    assert cells(content, "states") == list(g.states)
    for side in "wuzy":
        assert cells(content, side) == list(getattr(plant, side))
    wanted = [plant.asd.get(name, 0.0) for name in plant.w]
    assert content["asd"].ravel().tolist() == wanted
    assert wanted[0] > 0
    assert wanted[-1] == 0


def test_a_plant_comes_back(tmp_path):
    plant = stage()
    write_mat(tmp_path / "plant.mat", plant)
    found = read_mat(tmp_path / "plant.mat")
    assert isinstance(found, StandardPlant)
    for name in "ABCD":
        assert np.array_equal(getattr(found.system, name), getattr(plant.system, name))
    for name in ("dt", "inputs", "outputs", "states", "name"):
        assert getattr(found.system, name) == getattr(plant.system, name)
    assert [found.w, found.u, found.z, found.y] == [plant.w, plant.u, plant.z, plant.y]
    assert dict(found.asd) == dict(plant.asd)
    assert not found.system.A.flags.writeable


def test_a_weighted_plant_is_written_with_its_weights(tmp_path):
    plant = fx.testbeds.three_masses()
    heavy = plant.weighted(fx.stage_weights(plant, 20.0))
    write_mat(tmp_path / "plant.mat", heavy)
    found = read_mat(tmp_path / "plant.mat")
    assert isinstance(found, StandardPlant)
    assert [found.w, found.u, found.z, found.y] == [heavy.w, heavy.u, heavy.z, heavy.y]
    np.testing.assert_array_equal(found.system.A, heavy.system.A)


@pytest.mark.parametrize("n", [0, 1, 3])
def test_systems_of_any_order_come_back(tmp_path, n):
    rng = np.random.default_rng(n)
    g = StateSpace(
        rng.standard_normal((n, n)),
        rng.standard_normal((n, 2)),
        rng.standard_normal((1, n)),
        rng.standard_normal((1, 2)),
        inputs=["amp1", "u with a space"],
        outputs=["die:z"],
        name="small",
    )
    write_mat(tmp_path / "g", g)
    assert [entry.name for entry in tmp_path.iterdir()] == ["g"]
    found = read_mat(tmp_path / "g")
    assert isinstance(found, StateSpace)
    for name in "ABCD":
        assert np.array_equal(getattr(found, name), getattr(g, name))
    for name in ("dt", "inputs", "outputs", "states", "name"):
        assert getattr(found, name) == getattr(g, name)


def test_a_control_system_is_written(tmp_path):
    sys = control.ss([[-1.0]], [[2.0]], [[3.0]], [[0.0]], 0.1, inputs=["f"], outputs=["x"])
    write_mat(tmp_path / "g.mat", sys)
    found = read_mat(tmp_path / "g.mat")
    assert (found.inputs, found.outputs, found.dt) == (("f",), ("x",), 0.1)
    assert found.B.item() == 2.0


def test_a_file_from_matlab_needs_only_matrices(tmp_path):
    content = {"A": -1.0, "B": [[1.0, 2.0]], "C": [[3.0]], "D": [[0.0, 0.0]], "other": "text"}
    scipy.io.savemat(tmp_path / "g.mat", content)
    found = read_mat(tmp_path / "g.mat")
    assert found.inputs == ("u1", "u2")
    assert found.dt == 0.0
    assert found.A.item() == -1.0


def test_what_is_no_system_is_refused(tmp_path):
    path = tmp_path / "g.mat"
    with pytest.raises(FileNotFoundError):
        read_mat(path)
    path.write_text("these are no matrices, but enough characters to look at" * 9)
    with pytest.raises(FlexplantError, match=r"cannot be read as a MATLAB file.*-v7"):
        read_mat(path)
    scipy.io.savemat(path, {"P": 1.0, "A": 2.0})
    with pytest.raises(ModelError, match=r"no B, C, D: it holds \['A', 'P'\].*ssdata"):
        read_mat(path)
    matrices = {"A": -1.0, "B": 1.0, "C": 1.0, "D": 0.0}
    scipy.io.savemat(path, matrices | {"dt": -1.0})
    with pytest.raises(ModelError, match="dt must be zero or positive"):
        read_mat(path)
    scipy.io.savemat(path, matrices | {"dt": [1.0, 2.0]})
    with pytest.raises(FlexplantError, match=f"^'{re.escape(str(path))}', TypeError"):
        read_mat(path)
    scipy.io.savemat(path, matrices | {"B": np.ones((2, 1))})
    with pytest.raises(ShapeError, match="B must have shape"):
        read_mat(path)
    sides = {side: np.array([["x"]], dtype=object) for side in "wuzy"}
    scipy.io.savemat(path, matrices | sides)
    with pytest.raises(LabelError, match=r"inputs .* are not "):
        read_mat(path)
    with pytest.raises(ModelError, match="python-control or SciPy, got str"):
        write_mat(path, "plant")


def test_a_failed_write_leaves_the_old_file(tmp_path, monkeypatch):
    write_mat(tmp_path / "g.mat", stage())
    monkeypatch.setattr(scipy.io, "savemat", lambda *_, **__: 1 / 0)
    with pytest.raises(ZeroDivisionError):
        write_mat(tmp_path / "g.mat", StateSpace([], [], [], [[1.0]]))
    assert isinstance(read_mat(tmp_path / "g.mat"), StandardPlant)
    assert len(list(tmp_path.iterdir())) == 1


def test_several_values_in_one_file(tmp_path):
    """A plant, a controller and responses: structures for MATLAB; systems are read back by name."""
    path = tmp_path / "design.mat"
    plant = stage()
    frf = fx.frequency_response(plant.system, [1.0, 10.0]).replace(quantity="displacement")
    K = fx.StateSpace([[-1.0]], [[1.0]], [[2.0]], [[0.0]], inputs=["a"], outputs=["b"])
    write_mat(path, {"plant": plant, "K": K, "frf": frf})
    # as MATLAB sees it
    content = scipy.io.loadmat(path, squeeze_me=True, struct_as_record=False)
    assert np.array_equal(content["plant"].A, plant.system.A)
    assert np.array_equal(content["frf"].data, frf.data)
    found = read_mat(path, "plant")
    assert isinstance(found, StandardPlant)
    assert dict(found.asd) == dict(plant.asd)
    assert np.array_equal(read_mat(path, "K").C, K.C)
    with pytest.raises(ModelError, match=r"are read by name, \['K', 'frf', 'plant'\]"):
        read_mat(path)
    with pytest.raises(LabelError, match="no structure 'k'"):
        read_mat(path, "k")


def test_responses_are_plain_variables(tmp_path):
    frf = fx.Frf([1.0, 2.0], [[[1 + 2j, 3.0]]], inputs=["u"], outputs=["y"], quantity="velocity")
    write_mat(tmp_path / "frf.mat", frf)
    found = fx.io.read_frf_mat(tmp_path / "frf.mat")
    assert np.array_equal(found.data, frf.data)
    assert found.quantity == "velocity"
    for name in ("my plant", "1st", "_x", 3, "x" * 64):
        with pytest.raises(LabelError, match="not a valid name of a MATLAB variable"):
            write_mat(tmp_path / "g.mat", {name: frf})
    with pytest.raises(ModelError, match="need a system"):
        write_mat(tmp_path / "g.mat", {"a": "plant"})

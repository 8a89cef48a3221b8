"""Units for co-simulation: checked and run by FMPy, beside simulate and by hand."""

import shutil
import zipfile

import numpy as np
import pytest

import flexplant as fx
from flexplant.errors import FlexplantWarning, LabelError, ModelError
from flexplant.export import write_fmu
from flexplant.lti import StateSpace

fmpy = pytest.importorskip("fmpy", reason="extra test")
validate_fmu = pytest.importorskip("fmpy.validation").validate_fmu
VERSIONS = ["2.0", "3.0"]
compiles = pytest.mark.skipif(
    not any(map(shutil.which, ("cc", "gcc", "clang"))), reason="no C compiler"
)


class Unit:
    """A unit of either version by FMPy's calls, in a folder of its own."""

    def __init__(self, path, folder):
        self.described = fmpy.read_model_description(str(path))
        place = fmpy.extract(str(path), unzipdir=str(folder))
        name = self.described.coSimulation.modelIdentifier
        self.three = self.described.fmiVersion == "3.0"
        kind = fmpy.fmi3.FMU3Slave if self.three else fmpy.fmi2.FMU2Slave
        guid = self.described.guid
        self.unit = kind(guid=guid, unzipDirectory=place, modelIdentifier=name, instanceName="x")
        self.unit.instantiate()
        if self.three:
            self.unit.enterInitializationMode(startTime=0.0)
        else:
            self.unit.setupExperiment(startTime=0.0)
            self.unit.enterInitializationMode()
        self.unit.exitInitializationMode()
        self.number = {v.name: v.valueReference for v in self.described.modelVariables}

    def set(self, values):
        call = self.unit.setFloat64 if self.three else self.unit.setReal
        call([self.number[name] for name in values], list(map(float, values.values())))

    def get(self, names):
        call = self.unit.getFloat64 if self.three else self.unit.getReal
        return np.array(call([self.number[name] for name in names]))

    def end(self):
        self.unit.terminate()
        self.unit.freeInstance()


def masses():
    plant = fx.testbeds.three_masses()
    observer = fx.design_kalman(plant)
    servo = fx.design_servo(plant, bandwidth=20.0, observer=observer)
    return plant, fx.close_loop(plant, observer, servo)


@pytest.mark.slow
@compiles
@pytest.mark.parametrize("version", VERSIONS)
def test_plant_and_controller_as_units_give_the_run_of_simulate(version, tmp_path):
    """Both validate; joined sample by sample they are the loop, to 1e-9 of each channel."""
    plant, loop = masses()
    files = [
        write_fmu(one, tmp_path / f"{name}.fmu", version=version)
        for name, one in (("plant", plant), ("law", loop))
    ]
    for file in files:
        assert validate_fmu(str(file)) == []
    machine, law = (Unit(file, tmp_path / file.stem) for file in files)
    units = {v.name: v.unit for v in machine.described.modelVariables if v.name != "time"}
    assert units["u1"] == "N"
    assert units["die:x"] == "m"
    assert set(plant.system.inputs) <= set(units)
    move = fx.setpoint(1e-3, velocity=0.1, acceleration=5.0, jerk=1e3)
    run = fx.simulate(loop, reference=move, duration=0.2, noise=False)
    found = {name: [] for name in ("u1", "die:x", "die:error", "die:hat")}
    for t in run.time:
        machine.set({"die:ref": move.at(t).position})
        y = [f"{name}|y" if name in plant.w else name for name in plant.y]
        law.set(dict(zip(plant.y, machine.get(y), strict=True)))
        u, hat = law.get(["u1", "die:hat"])
        machine.set({"u1": u})
        for name, value in zip(found, [u, *machine.get(["die:x", "die:error"]), hat], strict=True):
            found[name].append(value)
        for unit in (machine, law):
            unit.unit.doStep(currentCommunicationPoint=t, communicationStepSize=plant.dt)
    for unit in (machine, law):
        unit.end()
    for name, values in found.items():
        np.testing.assert_allclose(values, run[name], atol=1e-9 * np.abs(run[name]).max())


@pytest.mark.slow
@compiles
@pytest.mark.parametrize("version", VERSIONS)
def test_fmpy_runs_a_unit_with_names_of_any_letters(version, tmp_path):
    """Held inputs, several samples a communication step, names as they are, states set back."""
    names = ['stage <z> & "tilt"', "Prüfkraft µ"]
    shown = "y \u03b8"
    g = StateSpace([[0.9, 0.2], [-0.2, 0.9]], np.eye(2), [[1.0, 1.0]], [[0.0, 0.0]], 0.01,
                   inputs=names, outputs=[shown], units={shown: "N m/s^2"})  # fmt: skip
    file = write_fmu(g, tmp_path / "any.fmu", version=version)
    assert validate_fmu(str(file)) == []
    rows = [(0.0, 1.0, 0.0), (0.1, 0.0, 2.0), (0.4, 0.0, 0.0)]
    given = np.array(rows, dtype=[("time", float), (names[0], float), (names[1], float)])
    result = fmpy.simulate_fmu(
        str(file), stop_time=0.5, step_size=0.02, output_interval=0.02, input=given
    )
    x, wanted = np.zeros(2), [0.0]
    for k in range(50):
        t = 0.02 * (k // 2) + 1e-9  # FMPy sets inputs at communication points
        x = g.A @ x + g.B @ np.array(rows[np.searchsorted([r[0] for r in rows], t) - 1][1:])
        if k % 2:
            wanted.append(x.sum())
    np.testing.assert_allclose(result[shown], wanted, atol=1e-12)
    # a state set back, an unknown variable refused
    unit = Unit(file, tmp_path / "one")
    unit.set({names[0]: 1.0})
    state = unit.unit.getFMUState()
    unit.unit.doStep(currentCommunicationPoint=0.0, communicationStepSize=0.03)
    after = unit.get([shown])
    unit.unit.setFMUState(state)
    unit.unit.doStep(currentCommunicationPoint=0.0, communicationStepSize=0.03)
    np.testing.assert_array_equal(unit.get([shown]), after)
    assert after[0] != 0.0
    unit.number["no"] = 99
    with pytest.raises(Exception, match=r"fmi[23]Set"):
        unit.set({"no": 1.0})
    unit.end()


def test_without_a_compiler_the_sources_are_written_and_it_is_said(monkeypatch, tmp_path):
    monkeypatch.setattr(shutil, "which", lambda name: None)
    plant, _ = masses()
    with pytest.warns(FlexplantWarning, match="no C compiler"):
        file = write_fmu(plant, tmp_path / "masses.fmu")
    names = zipfile.ZipFile(file).namelist()
    assert sorted(names) == [
        "modelDescription.xml", "sources/buildDescription.xml", "sources/masses.c",
        "sources/masses.h", "sources/masses_fmi.c",
    ]  # fmt: skip


def test_refusals_of_units(tmp_path):
    plant, _ = masses()
    for error, cause, call in (
        (ModelError, r"\.fmu", lambda: write_fmu(plant, tmp_path / "a.zip")),
        (ModelError, "version", lambda: write_fmu(plant, tmp_path / "a.fmu", version="1")),
        (
            LabelError,
            "not allowed as a function name in C",
            lambda: write_fmu(plant, tmp_path / "1a.fmu"),
        ),
        (ModelError, "continuous", lambda: write_fmu(plant.continuous, tmp_path / "a.fmu")),
    ):
        with pytest.raises(error, match=cause):
            call()


@pytest.mark.parametrize("name", ["time", "two\nlines"])
def test_names_that_no_variable_may_have(name, tmp_path):
    gain = fx.StateSpace([], [], [], [[-2.0]], 1e-4, inputs=[name], outputs=["u1"])
    with pytest.raises(LabelError, match="not allowed in a functional mock-up"):
        write_fmu(gain, tmp_path / "unit.fmu")

"""Every public value goes through a file: all fields equal, arrays read-only, facts the same."""

import os
import pickle
import re
import subprocess
import sys
from collections.abc import Mapping
from dataclasses import fields, is_dataclass
from functools import cache
from inspect import get_annotations, isabstract
from pathlib import Path
from xml.etree import ElementTree as ET

import numpy as np
import pytest
import scipy.sparse as sp

import flexplant as fx
from flexplant import estimation, load, lti, placement, structure, synthesis
from flexplant import plant as plants
from flexplant.errors import FlexplantError
from flexplant.estimation import LeftOut
from flexplant.loop import close_loop
from flexplant.modes import normal_form
from flexplant.reduction import select_dofs
from flexplant.simulation import LearnedFeedforward, error_map, exposure_errors
from flexplant.store import Value, rebuild
from flexplant.updating import eigenvalue_sensitivities
from stages import CORNERS, RATE, Z8, full, ports, reduced, some_modes
from test_layers import LEVEL


def all_values(base=Value):
    """Every subclass of Value that this package defines."""
    found = set()
    for cls in base.__subclasses__():
        found |= all_values(cls)
        if cls.__module__.startswith("flexplant"):
            found.add(cls)
    return found


def public(cls):
    """Whether a room shows it, and it is no base of others."""
    room = sys.modules[".".join(cls.__module__.split(".")[:2])]
    based = any(cls in other.__mro__[1:] for other in all_values())
    return is_dataclass(cls) and vars(room).get(cls.__name__) is cls and not based


def inside(item):
    """Yield every value in a value, itself included."""
    if isinstance(item, Value):
        yield item
        for part in item._fields().values():
            yield from inside(part)
    elif isinstance(item, Mapping):
        for part in item.values():
            yield from inside(part)
    elif isinstance(item, list | tuple):
        for part in item:
            yield from inside(part)


def made():
    """One of each, as a user gets them."""
    fe, modes, rom = full(), some_modes(), reduced()
    at = rom.full_dofs.nearest(Z8, "z")
    unknowns = [fx.AddedMass(at), fx.AddedDamping(at)]
    poles = (
        fx.testbeds.wafer_stage(elements=(8, 8)).poles([6, 7]).replace(covariance=0.1 * np.eye(4))
    )
    residual = fx.Eigenvalues(poles)
    fit = fx.update(rom, unknowns, [residual])
    yield from (fit.machines(poles), fx.placement.LeftOutModes())
    yield from (
        fit.trend(poles),
        fx.structure.ThickPlateShape((1.0, 1.0), 0.1, (2, 2), softness=3e-3),
    )
    plant = fx.assemble_plant(rom, ports())
    sampled = plant.discretized(RATE, delay=1)
    yield fx.assemble_plant(rom, ports(), evaluation=fe).evaluation
    updated = fx.assemble_plant(fit.model, ports())
    uncertain = updated.uncertain(
        fx.plant.Fit(fit, modes=[6]), fx.plant.Neglected(full(mass=fit.values[0]))
    )
    kinds = fx.plant
    yield from (kinds.Frequencies({4: 0.01}), kinds.Dampings(0.3), kinds.Gains({"u1": 0.02}))
    yield from (kinds.Delay(0.2), kinds.Parameters({unknowns[0]: 0.05}), uncertain.neglected)
    yield kinds.Shapes(np.ones((1, 3, 1)), [4])
    yield from (uncertain.deltas[0], kinds.MachineParts.of(updated))
    static = fx.design_static(sampled)
    servo = fx.design_servo(sampled, bandwidth=40.0)
    loop = close_loop(sampled, static, servo)
    yield fx.compare_loops({"servo": loop})
    yield from (loop.budget("die:error"), loop.mode_tolerances(known=1e-9))
    yield fx.modes.MeshError(np.array([4]), np.array([10.0]), np.array([10.1]), 2.0, np.array([3]))
    yield fx.loop.OnMeasurement(0.5, 100.0)
    yield fx.plant.MeasuredResponse(fx.frequency_response(plant.continuous.Gyu, [10.0, 20.0]))
    yield fx.loop.SpillOver(0.99, True, 0.5, 0.6, 100.0, 490)
    yield LeftOut(np.array([25]), np.eye(4), np.eye(3), np.zeros((3, 4)), plant, plant)
    point = fx.setpoint(distance=1e-3, velocity=0.1, acceleration=1.0, jerk=100.0)
    response = fx.simulate(loop, reference=point, duration=0.1, rng=1)
    yield exposure_errors(response, window=0.01)
    yield error_map(loop, CORNERS, duration=0.02)
    forward = fx.design_feedforward(sampled)
    yield from (forward, LearnedFeedforward(forward, np.ones(2), np.ones((2, 3, 5))))
    yield fx.plant.SlowZeros(np.array([-1.0 + 5.0j]), np.array([[1.0j]]), 1e-3)
    yield from (fx.Specification(noise=1e-6), fx.Specification(noise=1e-6).check(loop))
    yield from (fx.simulation.Saturation(1.0, rate=10.0), fx.simulation.Quantiser(1e-9))
    yield from (fx.simulation.Hysteresis(0.1), fx.simulation.Dropout(0.01))
    yield from (fx.simulation.Jitter(1e-5), fx.simulation.Friction(1.0, 1e6, "y1"))
    yield fx.study([1.0, 2.0], lambda machine: {"twice": 2 * machine, "name": "m"})
    along = fx.close_loop(sampled, static, servo, *fx.simulation.reading_along({"static": static}))
    runs = fx.simulate(along, duration=0.01, rng=1, runs=2)
    yield fx.simulation.compare_estimators({"static": static}, runs, "die:z")
    candidates = [fx.Sensor(f"c{i}", at=p, asd=1e-12) for i, p in enumerate([*CORNERS, Z8])]
    small = fx.assemble_plant(some_modes(count=8, attached=False), ports()).discretized(RATE)
    sensors = fx.place_sensors(small, candidates=candidates, count=4)
    g = fx.StateSpace([[-1.0]], [[1.0]], [[1.0]], [[0.0]])
    solution = fx.lti.filter_care(np.array([[-1.0]]), np.eye(1), Q=np.eye(1), R=np.eye(1))
    yield from (fe, modes, rom, fx.DesiredDofs(rom.dofs.labels), select_dofs(modes, 25))
    yield from (normal_form(rom.M, rom.D, rom.K, rom.rigid_body), fx.ModalDamping(0.01))
    yield fx.sparse.Cholmod()
    law = fx.ModalDamping(0.01)
    yield fx.frequency_response(fe, ports(), [50.0, 80.0], damping=law, checks=1)
    yield from (
        fx.structure.Rayleigh(1.0, 1e-6),
        fx.AddedStiffness(at),
        *unknowns,
        residual,
        poles,
        fit,
    )
    yield eigenvalue_sensitivities(rom, unknowns, modes=[6])
    yield from of_updates(rom, unknowns, residual, fit)
    yield from of_reductions(fe, modes, rom)
    yield from (plant, sampled, sampled.weighted(z={"die:z": 2.0}), uncertain, plant.check())
    yield from (*plant.check().assumptions, *plant.check().modes, fx.stage_weights(plant, 50.0))
    yield from (static, servo, loop, point, response)
    law = fx.Pid(1e3, 1.0, 20.0, 200.0) * fx.Lead(30.0) * fx.Notch(300.0) * fx.LowPass(400.0)
    yield from (synthesis.TunedLaws(law), synthesis.FixedOrder(1), synthesis.ObserverGains())
    yield from (*law.factors, law, fx.design_loops(sampled, law))
    yield from by_hand()
    zero, one = np.zeros(1), {"mode6:freq": 1.0}
    yield synthesis.RobustStability(0.5, 0.4, 10.0, one, plant, zero, zero, {"machines": 1.0})
    yield synthesis.WorstCaseGain(2.0, 1.9, 1.0, 10.0, one, plant, zero, zero)
    yield from of_estimators(sampled, small)
    yield from (fx.Riccati(), fx.testbeds.wafer_stage(), sensors, solution)
    more = a_system()
    yield from (lti.balanced(more, order=2), lti.modal_form(more), lti.norm_report(more))
    yield fx.simulation.input_shaper(10.0)
    yield fx.synthesis.tune_pid(fx.lti.tf([1.0], [1.0, 1.0]), bandwidth=1.0)
    yield fx.synthesis.margins(fx.lti.tf([1.0], [1.0, 1.0, 0.0]))
    yield from (lti.step(fx.lti.tf([1.0], [1.0, 1.0])), lti.step_info(fx.lti.tf([1.0], [1.0, 1.0])))
    yield from (
        lti.split_stable(more),
        synthesis.AutoBackOff(0.1),
        synthesis.Lmi(),
        synthesis.RepeatedScalar(2),
        synthesis.H2(z=["die:z"]),
        synthesis.Hinf(below=1.0),
        synthesis.PeakGain(decay=1.0),
        synthesis.PoleRegion(decay=1.0, damping=0.1),
        synthesis.FullBlock(2, 3),
        synthesis.mu(np.diag([1.0, 2.0]), [synthesis.FullBlock()] * 2),
        placement.Exchange(),
        placement.BranchAndBound(gap=0.1),
    )
    disc = fx.placement.Disc((0.1, 0.1), 0.05)
    yield from (
        placement.Excluded(disc),
        placement.ZoneLimits(disc, at_most=1),
        placement.OffPoi(0.1),
    )
    yield from (placement.ModalObservability("trace"), placement.ModalControllability())
    loss = placement.DeviceLoss(fx.PoiVariance("die", lag=fx.estimation.FixedLag(3), measure="max"))
    yield loss
    yield placement.ModeInformation()
    yield placement.ClosedLoopH2("die")
    yield placement.RowSelection(fx.reduction.PivotedQr())
    yield from (placement.OverMachines(loss, [small]), placement.CountLimits(["a", "b"], at_most=1))
    yield placement.OverPositions(loss, 3, measure="mean")
    curve = placement.pareto_curve(small, candidates, [4, 5])
    yield from (placement.PlantChannel("y1", "y"), curve, placement.Screened(loss, keep=3))
    yield placement.device_worth(small, sensors)
    yield placement.MinimumDistance(0.1)
    yield from (placement.JointGroups([("a", "b")]), placement.Budget(3.0, {"a": 2.0}))
    yield from (placement.Exhaustive(), placement.PoiLqr("die"), placement.PoiVariance("die"))
    yield placement.score_sensors(small, [[c.name for c in candidates[:4]]], candidates=candidates)
    yield placement.sensor_map(small, [CORNERS[0], (0.2, 0.3, 0.0)], asd=1e-12)
    yield from (plants.GroundSpring(Z8, 1e3), plants.decouple(plant), plants.FastStates())
    yield from (plants.gravity_axes(plant), plants.driven_axes(plant))
    yield plants.StandardPlant.from_statespace(plant.system)
    yield from (plants.FirstOrder(1e-3, 10.0), plants.NarrowBand(1e-3, 50.0))
    yield from (plants.RandomWalk(1e-3), plants.RigidForce("drag", asd=1e-3))
    yield from (plants.Feedthrough(), plants.OutputDisturbance("hum", "y1", asd=1e-12))
    yield from (plants.BaseAcceleration("floor", asd=1e-3), plant.along("die", CORNERS))
    yield from of_positions(modes)
    yield structure.interpolated(modes.dofs).interpolation
    yield from (g, fx.frequency_response(g, np.array([1.0, 2.0])))
    yield from of_structures()
    late = fx.lti.Delayed.tf([0.2, 0.6], [1.0])
    yield from (late, fx.loop.DelayedLoop(fx.lti.Delayed(fx.lti.tf([1.0], [1.0, 0.0]), 1.0), -late))
    masses = fx.testbeds.three_masses()
    damped = fx.synthesis.damp_modes(masses, "velocity", y="y1", damping=0.1)
    yield from (damped, damped.element, fx.plant.UnmodelledDynamics(0.1, at="u1"))
    yield fx.synthesis.PositivePositionFeedback(100.0, 20.0)
    yield fx.synthesis.IntegralResonantControl(100.0, 20.0)
    observer = fx.design_kalman(masses)
    loop = fx.close_loop(masses, observer, fx.design_servo(masses, bandwidth=20.0))
    move = fx.setpoint(1e-3, velocity=0.05, acceleration=2.0, jerk=200.0)
    yield fx.simulation.residual_vibration(loop, move)
    M = fx.StateSpace([[-1.0]], [[1.0, 1.0]], [[1.0], [1.0]], 0, inputs=["d", "f"],
                      outputs=["e", "x"])  # fmt: skip
    yield fx.synthesis.uncertain_system(M, [fx.synthesis.RepeatedScalar()]).kinds[0]


def of_positions(modes):
    """A stage that moves, and what is said of it."""
    x = plants.Position("x", range=(-0.1, 0.1))
    places = [(0.2, 0.3, 0.0), (0.1, 0.3, 0.0)]
    table = plants.PlaceTable({"x": [-0.1, 0.1]}, places)
    given = ports()
    moving = given.replace(
        y=[*given.y, fx.Sensor("head", at=places[0], asd=1e-12, moves=table)], positions=[x]
    )
    plant = fx.assemble_plant(modes, moving).discretized(RATE, delay=1)
    yield from (x, table, moving.y[-1].moves, plant.map(points=2))
    servo = fx.design_servo(plant, bandwidth=20.0, notches=[])
    loops = [fx.close_loop(plant.at(x=v), fx.design_static(plant.at(x=v)), servo) for v in (0, 0.1)]
    yield fx.loop.ScheduledLoop("x", [0.0, 0.1], loops)
    yield fx.simulation.PathRms([0.0], [[1e-9]], ["die:error"], {"die:error": "m"})
    one = np.ones((1, 1))
    yield fx.simulation.PathFilters([0.0], ["die:z"], one, one, one, {"die:z": "m"})


def of_estimators(plant, small):
    """One of each way to estimate, and what is said of the answer."""
    kalman, rng = fx.design_kalman(plant), np.random.default_rng(4)
    yield kalman.report([1])
    records = {name: 1e-9 * rng.standard_normal(5) for name in (*plant.y, *plant.u)}
    yield from (kalman, kalman.model, kalman.estimate(records), kalman.report())
    yield from (estimation.Predictor(), estimation.Filter(), estimation.FixedLag(2))
    yield estimation.Smoother()
    longer = {name: 1e-9 * rng.standard_normal(400) for name in (*small.y, *small.u)}
    observer = fx.design_kalman(small)
    one = np.ones(1)
    yield estimation.NoiseLevels(small, ("y1:noise",), one, np.eye(1), one, 0.0, 1.0, 400)
    yield estimation.consistency(observer, observer.estimate(longer))
    pole = np.array([-1.0 + 100.0j])
    yield estimation.MovedModes((4,), pole, 1.01 * pole, np.eye(2))


def of_reductions(fe, modes, rom):
    """One of each way to reduce, and what is said of the answer."""
    at = rom.dofs.labels[:6:2]
    truncation = fx.reduction.ModalTruncation(count=8, inputs=at)
    yield from (truncation, fx.reduce(modes, truncation), fx.ModalBalanced(8, at))
    yield from (
        fx.reduction.Guyan(at),
        fx.reduction.Irs(at, iterations=2),
        fx.reduction.Serep(at),
        fx.reduction.Krylov(at, [0.0, 500.0]),
    )
    yield from (
        fx.reduction.CraigBampton(at, 3),
        fx.reduction.Rubin(at, 5),
        fx.reduction.MacNeal(at, 5),
    )
    yield from (
        fx.reduction.PivotedQr(),
        fx.reduction.EffectiveIndependence(),
        fx.reduction.Greedy(),
    )
    yield fx.reduction.rank_modes(modes, inputs=at)
    yield fx.reduce(modes, truncation).quality(fe, band=(100.0, 400.0), freq=np.array([250.0]))


def by_hand():
    """One of each value that a loop shaped by hand is made of."""
    block = synthesis.FixedBlock(fx.lti.tf([1.0], [0.01, 1.0]), "shaping filter")
    axis = synthesis.ShapedAxis([fx.Pid(2.0), synthesis.Lag(5.0), block], on=[True, False, True])
    yield from (block, synthesis.Lag(5.0), synthesis.Integrator(5.0), axis)
    yield synthesis.LoopDesign.on(fx.lti.tf([1.0], [1.0, 0.0, 0.0]), {"out": axis})
    yield fx.workbench.LoopLimits(peak=2.0, phase_margin=30.0)


def of_structures():
    """One of each value that a structure is made of."""
    steel = {"density": 7850.0, "youngs_modulus": 210e9}
    bar = fx.beam(length=1.0, elements=2, area=1e-4, inertia=1e-9, **steel)
    yield bar.fixed(["1:z"]).dofs.interpolation
    yield from (fx.PointMass((0.1, 0, 0), 0.5, inertia=0.1), fx.Damper("1:z", 2.0))
    yield fx.Spring("1:z", 2.0, to="2:z")
    yield from (fx.placement.Rectangle((0, 0), (1, 1)), fx.placement.Disc((0, 0), 1.0))
    block = {"size": (1, 1, 1), "elements": (2, 1, 1), "poisson_ratio": 0.3}
    corner = fx.solid_block(**block, **steel, holes=np.array([[[True]], [[False]]]))
    yield corner.dofs.interpolation
    ends = fx.joining.Patch("up", [1, 2]), fx.joining.Joint("up/1:z", "bar/1:z")
    machine = fx.joined({"up": bar, "bar": bar}, ends[1], placed={"up": fx.joining.Pose((0, 0, 1))})
    yield from (*ends, machine, fx.joining.Pose((0, 0, 1)))
    foreign = fx.structure.FEMatrices(np.eye(2), np.diag([1.0, 0.0]), digits=9, constrained=["3:x"])
    yield from (foreign, fx.check(foreign))


def of_updates(rom, unknowns, residual, fit):
    """One of each value around an update and an identification."""
    at = unknowns[0].at
    poles = residual.measured
    shapes = fit.model.modes()
    rows = shapes.dofs.indices(rom.dofs.labels[:5])
    seen = np.asarray(shapes.phi)[np.ix_(rows, np.array(poles.modes) - 1)]
    force = fx.assemble_plant(rom, ports()).Gyu.select([f"y{i}" for i in range(1, 5)])
    frf = fx.frequency_response(force, np.linspace(200, 800, 200))
    yield from (fx.MatrixParameter("spring", dK=np.eye(25)), fx.updating.ModeDamping(6))
    yield fx.updating.PolynomialParameter("thickness", dK=[np.eye(25), None, np.eye(25)], unit="m")
    yield from (fx.FrfResidual(frf, variance=np.ones(frf.data.shape), lines=[0, 1]),)
    yield from (fx.ModeShapes(poles, seen, rom.dofs.labels[:5]),)
    yield from (fx.updating.ShapeCorrelation(poles, seen, rom.dofs.labels[:5]),)
    yield from (
        fx.updating.Antiresonances([-5 + 1300j], at, at),
        fx.updating.StaticCompliance(1e-6, at, at),
    )
    yield from (fx.updating.GaussNewton(), fx.updating.TrustRegion())
    blow, answer = np.zeros(90), np.arange(90.0) % 7
    blow[[10, 50]] = 1.0
    yield fx.identification.impact_frf(blow, answer, 100.0, segment=0.3)
    yield fx.updating.identifiability(rom, unknowns, [residual])
    yield fx.updating.localise(
        rom, [fx.AddedMass(label) for label in rom.dofs.labels[:4]], [residual]
    )
    yield fx.updating.correlate(fit.model, [residual])
    yield from (fx.updating.Discrepancy("damping", 0.3, 6.0), fit.uncertainty())
    bounded = [fx.AddedMass(at, bounds=(0.0, 1.0)), fx.AddedDamping(at, bounds=(-1.0, 1.0))]
    yield fx.update(rom, bounded, [residual], method=fx.updating.TrustRegion(), starts=2)
    yield fx.updating.validate(rom, unknowns[:1], [residual.select([6])], [residual.select([7])])
    yield from (
        fx.identification.H1Estimator(),
        fx.identification.H2Estimator(),
        fx.identification.HvEstimator(),
        fx.identification.Periodic(period=1.0),
    )
    # modes far away leave more than nothing where there is no noise at all
    noise = np.random.default_rng(5).normal(size=(2, *frf.data.shape)) * np.abs(frf.data).max()
    frf = frf.replace(data=frf.data + 1e-4 * (noise[0] + 1j * noise[1]))
    diagram = fx.identification.stabilisation_diagram(frf, band=(400.0, 700.0), orders=range(2, 14))
    yield from (diagram, fx.identify_modes(frf, band=(400.0, 700.0), orders=range(2, 14)))
    yield diagram.select([463.1])


def a_system():
    rng = np.random.default_rng(2)
    A = np.diag([-1.0, -2.0, -3.0, -5.0])
    return fx.StateSpace(A, rng.standard_normal((4, 2)), rng.standard_normal((1, 4)), [[0, 0]])


@cache
def zoo():
    """Name of the class -> an instance."""
    found = {}
    for value in made():
        for part in inside(value):
            found.setdefault(type(part).__name__, part)
    return found


def same(a, b, where):
    """Assert that two contents are equal to the bit, and the second is read-only."""
    assert type(a) is type(b), where
    if isinstance(a, Value):
        for name, part in a._fields().items():
            same(part, getattr(b, name), f"{where}.{name}")
    elif isinstance(a, np.ndarray):
        assert a.dtype == b.dtype, where
        assert a.shape == b.shape, where
        assert a.tobytes() == b.tobytes(), where
        assert not b.flags.writeable, where
    elif sp.issparse(a):
        assert (a != b).nnz == 0, where
        assert not b.data.flags.writeable, where
    elif isinstance(a, Mapping):
        same(list(a), list(b), where)
        for key, twin in zip(a, b, strict=True):
            same(a[key], b[twin], f"{where}[{key!r}]")
        with pytest.raises(TypeError):
            b["new"] = 1
    elif isinstance(a, list | tuple):
        assert len(a) == len(b), where
        for i, (one, two) in enumerate(zip(a, b, strict=True)):
            same(one, two, f"{where}[{i}]")
    else:
        assert a == b or a != a, where


NAMES = sorted(cls.__name__ for cls in all_values() if public(cls))


def test_names_of_values_are_unique():
    """Files say a value's type by its name."""
    every = [cls.__name__ for cls in all_values() if not cls.__subclasses__()]
    assert sorted(set(every)) == sorted(every)


@pytest.mark.slow
@pytest.mark.parametrize("name", NAMES)
def test_goes_through_a_file(name, tmp_path):
    value = zoo().get(name)
    assert value is not None, f"let made() in this file make a {name}"
    value.save(tmp_path / "value")
    found = load(tmp_path / "value")
    same(value, found, name)
    assert repr(found) == repr(value)
    in_notebook = "".join(ET.fromstring(value._repr_html_()).itertext())  # well-formed, complete
    text = repr(value)
    if text.startswith(f"{name}("):  # in a table, fields that say nothing are left out
        text = Value.__repr__(value)
    assert re.sub(r"\W", "", in_notebook) == re.sub(r"\W", "", text)
    assert repr(value).count("\n") < 15 and not re.search(r"mappingproxy\(|array\(\[", repr(value))
    same(value, pickle.loads(pickle.dumps(value)), name)


#: loads files one after the other in a process that imported nothing else, and saves them again
READER = """
import sys
import flexplant as fx
rooms = lambda: {name.split(".")[1] for name in sys.modules if name.startswith("flexplant.")}
assert not rooms()
for path in sys.argv[1:]:
    before = rooms()
    value = fx.load(path)
    print(type(value).__name__, *sorted(rooms() - before))
    value.save(path + ".again")
"""


def read_elsewhere(*paths):
    """Load files in a new process; return [type, room that was imported, ...] of each."""
    home = str(Path(fx.__file__).parents[1])
    said = subprocess.run(
        [sys.executable, "-c", READER, *map(str, paths)],
        capture_output=True,
        text=True,
        check=False,
        env=os.environ | {"PYTHONPATH": home},
    )
    assert not said.returncode, said.stdout.splitlines()[-1:] + said.stderr.splitlines()[-1:]
    return [line.split() for line in said.stdout.splitlines()]


def check_elsewhere(values, folder):
    """Values come back to the bit; return by which of them each room was imported."""
    # in the order of the rooms: no room was imported by an earlier file
    level = {cls: LEVEL[cls.__module__.split(".")[1]] for cls in values}
    kinds = sorted(values, key=level.__getitem__)
    for cls in kinds:
        values[cls].save(folder / cls.__name__)
    read = read_elsewhere(*(folder / cls.__name__ for cls in kinds))
    for cls, (name, *_) in zip(kinds, read, strict=True):
        assert name == cls.__name__
        one, two = (np.load(folder / f"{name}{end}") for end in ("", ".again"))
        assert one.files == two.files
        assert all(one[part].tobytes() == two[part].tobytes() for part in one.files), name
    return {room: cls for cls, (_, *rooms) in zip(kinds, read, strict=True) for room in rooms}


@pytest.mark.slow
def test_every_kind_loads_in_a_new_process(tmp_path):
    """Also kinds that no room shows; each room is imported by the first file that needs it."""
    kinds = [cls for cls in all_values() if is_dataclass(cls) and not isabstract(cls)]
    blank = {cls: rebuild(cls, {field.name: None for field in fields(cls)}) for cls in kinds}
    assert len(blank) > 250
    by = check_elsewhere(blank, tmp_path)
    shown = {cls.__module__.split(".")[1] for cls in kinds} - {"labels"}
    assert all(by[room].__module__.split(".")[1] == room for room in shown)
    assert not {"plot", "documentation"} & set(by)  # what no value needs


@pytest.mark.slow
def test_every_value_loads_in_a_new_process(tmp_path):
    """All public values with what they hold, as users get them."""
    every = {cls: zoo()[cls.__name__] for cls in all_values() if cls.__name__ in zoo()}
    assert {cls.__name__ for cls in every} >= set(NAMES)
    check_elsewhere(every, tmp_path)


def rewritten(path, old, new):
    """Change the text of a file's header."""
    with np.load(path) as file:
        parts = dict(file)
    text = str(parts["__flexplant__"])
    assert old in text
    parts["__flexplant__"] = np.array(text.replace(old, new))
    with path.open("wb") as file:
        np.savez(file, **parts)


@pytest.mark.slow
def test_files_import_little_and_nothing_of_others(tmp_path):
    """A system needs no plant; files that name no module, or one that is gone, load too."""
    g, forward = fx.lti.tf([1.0], [1.0, 1.0]), fx.Specification(noise=1e-6)
    g.save(tmp_path / "system")
    assert "plant" not in read_elsewhere(tmp_path / "system")[0]
    module = type(forward).__module__
    for new in ("", ', "module": "flexplant.gone.by"'):
        forward.save(tmp_path / "old")
        rewritten(tmp_path / "old", f', "module": "{module}"', new)
        assert read_elsewhere(tmp_path / "old")[0][0] == "Specification"
    g.save(tmp_path / "other")
    rewritten(tmp_path / "other", type(g).__module__, "antigravity")
    rewritten(tmp_path / "other", "StateSpace", "Balloon")
    with pytest.raises(FlexplantError, match=r"'Balloon' of the module 'antigravity'.* Import"):
        load(tmp_path / "other")
    assert "antigravity" not in sys.modules
    rewritten(tmp_path / "other", "antigravity", "flexplant.lti")
    with pytest.raises(FlexplantError, match="'Balloon', which this version of flexplant lacks"):
        load(tmp_path / "other")


@pytest.mark.slow
def test_what_was_loaded_works(tmp_path):
    """Designs and runs from files give the same numbers."""
    loop = zoo()["ClosedLoop"]
    loop.save(tmp_path / "loop")
    found = load(tmp_path / "loop")
    assert found.modulus_margin == loop.modulus_margin
    one, two = (fx.simulate(item, duration=0.01, rng=3) for item in (loop, found))
    assert np.array_equal(one.data, two.data)
    uncertain = zoo()["UncertainPlant"]
    uncertain.save(tmp_path / "uncertain")
    again = load(tmp_path / "uncertain")
    (one,), (other,) = (each.machines.drawn(1) for each in (again, uncertain))
    assert np.array_equal(one.system.A, other.system.A)


@pytest.mark.slow
def test_files_of_other_versions(tmp_path, monkeypatch):
    """A field that came later has its default; what the class does not know is named."""
    plant = zoo()["StandardPlant"]
    kept = plant._fields()
    monkeypatch.setattr(type(plant), "_fields", lambda self: {
        name: part for name, part in kept.items() if name != "origin"
    })  # fmt: skip
    plant.save(tmp_path / "old")
    assert load(tmp_path / "old").model is None
    monkeypatch.setattr(type(plant), "_fields", lambda self: {
        name: part for name, part in kept.items() if name != "system"
    })  # fmt: skip
    plant.save(tmp_path / "old")
    with pytest.raises(FlexplantError, match=r"another version.*lacks \['system'\]"):
        load(tmp_path / "old")
    monkeypatch.setattr(type(plant), "_fields", lambda self: kept | {"colour": 1})
    plant.save(tmp_path / "new")
    with pytest.raises(FlexplantError, match=r"it has \['colour'\]"):
        load(tmp_path / "new")


@pytest.mark.parametrize("content", [b"", b"text", b"PK\x03\x04 broken"])
def test_what_is_no_file_of_ours(tmp_path, content):
    (tmp_path / "x").write_bytes(content)
    with pytest.raises(FlexplantError, match="not written by flexplant"):
        load(tmp_path / "x")
    with (tmp_path / "array.npy").open("wb") as file:
        np.save(file, np.ones(3))
    with pytest.raises(FlexplantError, match="not written by flexplant"):
        load(tmp_path / "array.npy")
    with pytest.raises(FileNotFoundError):
        load(tmp_path / "none")


def test_files_can_be_read_by_whom_the_folder_allows(tmp_path):
    (tmp_path / "plain").write_bytes(b"")
    fx.ModalDamping(0.01).save(tmp_path / "value")
    modes = [(tmp_path / name).stat().st_mode for name in ("plain", "value")]
    assert modes[0] == modes[1]


def test_every_dataclass_field_is_saved():
    """A value without the dataclass decorator would save those of its base only."""
    for cls in all_values():
        if public(cls):
            notes = get_annotations(cls)
            own = {n for n, kind in notes.items() if not re.search("ClassVar|KW_ONLY", str(kind))}
            assert own <= {field.name for field in fields(cls)}, cls

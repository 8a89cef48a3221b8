"""Stages on springs, which move a million times as far as the estimate errs."""

from functools import cache

import numpy as np
import pytest

from flexplant.errors import AssumptionError, FlexplantWarning
from flexplant.estimation import design_kalman
from flexplant.estimation.error import error_variances
from flexplant.lti import low_pass_filter
from flexplant.modes import solve_modes
from flexplant.plant import (
    Actuator,
    Disturbance,
    GroundSpring,
    Poi,
    Ports,
    Sensor,
    assemble_plant,
    suspend,
)
from flexplant.reduction import DesiredDofs, ModalTruncation, reduce, select_dofs
from flexplant.structure import ModalDamping, Spring, kirchhoff_plate, solid_block
from oracles_estimation import error_in_extended_precision
from plates import make_plate
from stages import CORNERS
from stages import ports as square_ports
from stages import sampled as square_sampled

#: meshes are small here: what they do not resolve is the subject of test_mesh

WIDE, DEEP, THICK = 0.4, 0.3, 0.02
EDGES = [(x, y, 0.0) for x in (0.0, WIDE) for y in (0.0, DEEP)]
QUARTERS = [(x, y, 0.0) for x in (WIDE / 4, 3 * WIDE / 4) for y in (DEEP / 4, 3 * DEEP / 4)]
CUBES = {"flat": (0.4, 0.4, 0.06), "long": (0.3, 0.2, 0.05)}
AXES = ("die:z", "die:rx", "die:ry")


@cache
def plate_modes(stiffness=4650.0):
    """A steel plate on springs in its corners: 5 Hz, with 0.3 % damping in all modes."""
    plate = kirchhoff_plate(
        size=(WIDE, DEEP), thickness=THICK, elements=(8, 6), density=7850, youngs_modulus=210e9,
        poisson_ratio=0.3,
    )  # fmt: skip
    if stiffness:
        plate = plate.with_parts([Spring(p, stiffness, direction="z") for p in EDGES])
    return solve_modes(plate, count=100, damping=ModalDamping(0.003))


def plate_plant(modes, delay=1, **of_sensors):
    ports = Ports(
        w=[],
        u=[Actuator(f"u{i}", at=p, asd=2e-3) for i, p in enumerate(QUARTERS)],
        z=[Poi("die", at=(WIDE / 2, DEEP / 2, 0.0), axes=("z", "rx", "ry"))],
        y=[Sensor(f"y{i}", at=p, asd=4e-12, **of_sensors) for i, p in enumerate(EDGES)],
    )
    return assemble_plant(modes, ports).discretized(10e3, delay=delay)


@cache
def block_modes(kind, freq):
    """A block of aluminium on springs in all directions."""
    size = CUBES[kind]
    block = solid_block(
        size=size, elements=(6, 4, 2), density=2700, youngs_modulus=70e9, poisson_ratio=0.33
    )
    stiffness = 2700 * np.prod(size) * (2 * np.pi * freq) ** 2 / 4
    feet = [(x, y, 0.0) for x in (0.0, size[0]) for y in (0.0, size[1])]
    springs = [Spring(p, part * stiffness, direction=axis)
               for p in feet for axis, part in (("x", 0.6), ("y", 0.7), ("z", 1.0))]  # fmt: skip
    return solve_modes(block.with_parts(springs), count=40, damping=ModalDamping(0.003))


def block_plant(kind, modes):
    a, b, c = CUBES[kind]
    places = [("z", (x, y, c)) for y in (0.0, b) for x in (0.0, a)]
    places += [("x", (0.0, 0.0, 0.0)), ("x", (0.0, b, 0.0)), ("y", (a, 0.0, 0.0))]
    along = [{"direction": d, "at": p} for d, p in places]
    ports = Ports(
        w=[Disturbance(f"amp{i}", asd=1e-2, **place) for i, place in enumerate(along)],
        u=[Actuator(f"u{i}", **place) for i, place in enumerate(along)],
        z=[Poi("die", at=(a / 2, b / 2, c), axes=("z", "rx", "ry"))],
        y=[Sensor(f"y{i}", asd=1e-12, **place) for i, place in enumerate(along)],
    )
    return assemble_plant(modes, ports).discretized(20e3, delay=1)


def exact(plant, observer):
    """The variances of an observer's error, from the matrices in extended precision."""
    if np.finfo(np.longdouble).eps > 1e-18:
        pytest.skip("long double is no longer than double here")
    g = plant.system
    read = [name for name in observer.inputs if name in plant.y]
    rows = [plant.y.index(name) for name in read]
    columns = [observer.inputs.index(name) for name in read]
    truth = {"A": g.A, "C1": g.C[g.output_index(AXES)], "C2": g.C[g.output_index(read)]}
    truth |= {"factor": plant.noise_factor, "R": plant.sensor_noise[np.ix_(rows, rows)]}
    own = {"A": observer.A, "B": observer.B[:, columns], "C": observer.C}
    return error_in_extended_precision(truth, own | {"D": observer.D[:, columns]})


def check(plant, whole):
    """Design, and hold the predicted variances against extended precision."""
    plant = plant.replace(evaluation=whole)
    found = design_kalman(plant)
    assert found.certificate["difference"] < 1e-7
    expected = exact(plant.evaluation_plant, found.system)
    np.testing.assert_allclose(found.variances, expected, rtol=1e-6)
    return found


@pytest.mark.slow
@pytest.mark.parametrize("count", [10, 20])
def test_a_plate_on_springs(count):
    modes = plate_modes()
    check(plate_plant(modes.select(range(count))), modes.select(range(40)))


@pytest.mark.slow
def test_every_order_passes_and_weak_springs_change_little():
    """Beside the free plate, whose rigid-body motion leaves no square behind."""
    for count in (10, 20):
        errors = []
        for modes in (plate_modes(), plate_modes(0.0)):
            plant = plate_plant(modes.select(range(count)))
            found = [
                design_kalman(plant.replace(evaluation=modes.select(range(k)))) for k in (40, 100)
            ]
            assert max(one.certificate["difference"] for one in found) < 1e-9
            errors.append([one.variances for one in found])
        np.testing.assert_allclose(errors[0], errors[1], rtol=1e-3)


@pytest.mark.slow
@pytest.mark.parametrize(
    ("kind", "freq", "count"),
    [("flat", 2.0, 12), ("flat", 8.0, 18), ("long", 2.0, 18), ("long", 8.0, 12)],
)
def test_a_block_on_springs(kind, freq, count):
    modes = block_modes(kind, freq)
    check(block_plant(kind, modes.select(range(count))), modes)


@pytest.mark.slow
@pytest.mark.parametrize("reading", [{}, {"dynamics": low_pass_filter(3e3)}, {"latency": 3e-5}])
def test_dampers_filters_and_delays(reading):
    """Complex modes; states of the sensors, which follow the suspension too."""
    springs = [GroundSpring(p, 4650.0, 0.03) for p in EDGES]
    modes = suspend(plate_modes(0.0).select(range(20)), springs)
    plant = plate_plant(modes.select(range(9)), delay=1.5, **reading)
    check(plant, plate_plant(modes, delay=1.5, **reading))


@pytest.mark.slow
@pytest.mark.parametrize("stiffness", [10.0, 4650.0, 1e5])
@pytest.mark.parametrize("method", ["truncation", "dofs"])
def test_a_reduced_model_on_springs(stiffness, method):
    """Its suspension is not quite that of the evaluation model: what is missed counts."""
    modes = plate_modes(0.0).select(range(26))
    how = ModalTruncation(17) if method == "truncation" else DesiredDofs(select_dofs(
        modes.select(range(17)), 17))  # fmt: skip
    springs = [GroundSpring(p, stiffness, 1e-4 * stiffness) for p in EDGES]
    plant = plate_plant(suspend(reduce(modes, how), springs))
    check(plant, suspend(modes, springs))


def suspended_plants(damping):
    """Nine of 16 modes on four springs, with seven that are left out known; and all 16."""
    modes = solve_modes(make_plate(), count=16, damping=ModalDamping(1e-4))
    few = reduce(modes, DesiredDofs(select_dofs(modes.select(range(9)), 9)))
    springs = [GroundSpring(at=p, stiffness=2000.0, damping=damping) for p in CORNERS]
    models = [suspend(model, springs) for model in (few, modes)]
    return [square_sampled(model, square_ports(asd=1e-3)) for model in models]


def test_dampers_of_a_suspension_damp_the_modes_left_out_as_well():
    plant, truth = suspended_plants(damping=10.0)
    kalman = design_kalman(plant)
    assert kalman.certificate["truncated modes"] == 7
    for axis in AXES:
        assert kalman.rms(axis) == pytest.approx(kalman.rms(axis, on=truth), rel=0.02, abs=0)


@pytest.mark.slow
@pytest.mark.parametrize("damping", [1e-2, 1e-5, 1e-7])
def test_the_certificate_states_the_digits_that_hold(damping):
    """Rounding of the damping that a mode hardly has is in both routes: it is added."""
    plant, truth = suspended_plants(damping)
    observer = design_kalman(plant).system
    if damping < 1e-2:
        with pytest.warns(FlexplantWarning, match=r"modes at .* Hz .* fx\.plant\.GroundSpring\("):
            found = error_variances(truth, observer)
    else:
        found = error_variances(truth, observer)
    off = np.abs(found.values / exact(truth, observer) - 1.0)
    assert off.max() < max(2.0 * found.difference, 1e-8) < 1e-3


def test_a_suspension_without_damping_is_refused_where_the_two_models_differ():
    plant, truth = suspended_plants(damping=1e-10)
    with pytest.raises(AssumptionError, match=r"grows without limit.*fx\.plant\.GroundSpring\("):
        design_kalman(plant).rms("die:z", on=truth)

"""Places that move: a POI along a trajectory changes C_z alone, an actuator its column of B."""

import numpy as np
import pytest

from flexplant.errors import LabelError, ModelError
from flexplant.lti import low_pass_filter
from flexplant.plant import Actuator, Feedthrough, Poi, Sensor, assemble_plant
from oracles_plant import motion_row, receptance, z_row
from stages import AXES, CORNERS, INSET, OFF_NODE, RATE, Z8, L, full, ports, reduced, some_modes

PATH = np.column_stack([np.linspace(0.11, 0.53, 7), np.linspace(0.13, 0.46, 7), np.zeros(7)])


@pytest.mark.parametrize("model", [some_modes, reduced, full])
def test_rows_along_are_those_of_the_plant_at_each_point(model):
    plant = assemble_plant(model(), ports())
    for base in (plant, plant.discretized(RATE, delay=1.5)):
        rows = base.along("die", PATH)
        assert rows.channels == ("die:z", "die:rx", "die:ry", "die:error")
        at = [base.z.index(name) for name in rows.channels]
        for i in (0, 3, 6):
            there = base.at(PATH[i])
            for name in ("A", "B"):
                np.testing.assert_array_equal(
                    getattr(there.system, name), getattr(base.system, name)
                )
            np.testing.assert_allclose(rows.C[i], there.system.C[at], rtol=0, atol=1e-14)
            np.testing.assert_array_equal(rows.D[i], there.system.D[at])
            others = np.setdiff1d(np.arange(base.system.C.shape[0]), at)
            np.testing.assert_array_equal(there.system.C[others], base.system.C[others])
            np.testing.assert_array_equal(there.system.D, base.system.D)


def test_rows_along_against_the_dense_plate():
    """The response at 200 Hz at each point, from M, D, K and the element's polynomial."""
    from oracles_plant import machine

    plant = assemble_plant(full(), ports())
    rows = plant.along("die", PATH)
    g, s = plant.system, 2j * np.pi * 200.0
    state = np.linalg.solve(s * np.eye(g.n_states) - g.A, g.B[:, g.input_index(["u1"])])
    see = np.array([motion_row(*p[:2], axis) for p in PATH for axis in AXES])
    wanted = receptance(*machine(), see, z_row(*INSET[0][:2])[None], [abs(s)])[:, 0, 0]
    np.testing.assert_allclose((rows.C[:, :3] @ state).ravel(), wanted, rtol=1e-6)


@pytest.mark.slow
def test_a_force_along_against_the_dense_plate():
    """What a force does to the POI, a sensor and an accelerometer, from wherever it acts."""
    from oracles_plant import machine

    die = (L / 2 + 0.01, L / 2 + 0.02, 0.0)
    y = [*ports().y, Sensor("a", at=Z8, quantity="acceleration", asd=1e-3)]
    plant = assemble_plant(full(), ports(y=y, die=die))
    g, s = plant.system, 2j * np.pi * 200.0
    see = [*(motion_row(*die[:2], axis) for axis in AXES), z_row(*CORNERS[0][:2]), z_row(*Z8[:2])]
    push = np.array([z_row(*p[:2]) for p in PATH])
    wanted = receptance(*machine(), np.array(see), push, [abs(s)])[:, :, 0]
    wanted[4] *= s * s
    size = np.abs(wanted).max(axis=1, keepdims=True)
    assert np.all(np.ptp(wanted.real, axis=1) > 0.1 * size[:, 0])
    rows = g.output_index(["die:z", "die:rx", "die:ry", "y1", "a"])
    answer = g.C[rows] @ np.linalg.inv(s * np.eye(g.n_states) - g.A)
    for name in ("u2", "amp1"):
        moving = plant.along(name, PATH)
        found = [answer @ B + D[rows] for B, D in zip(moving.B, moving.D, strict=True)]
        np.testing.assert_allclose(np.hstack(found) / size, wanted / size, atol=1e-6)


def test_a_feedthrough_moves_with_the_poi():
    plant = assemble_plant(some_modes(), ports(), residual=Feedthrough())
    rows = plant.along("die", PATH)
    assert np.ptp(rows.D[:, 0, -4:], axis=0).min() > 1e-12
    there = plant.at(PATH[2])
    changed = there.system.D != plant.system.D
    assert changed[0, -4:].all()  # D12 of die:z
    assert not changed[len(plant.z) :].any()
    np.testing.assert_array_equal(rows.D[2, 0], there.system.D[0])


def test_moving_an_actuator_changes_one_column_of_b():
    plant = assemble_plant(some_modes(), ports())
    moved = plant.at({"u2": OFF_NODE})
    column = plant.system.inputs.index("u2")
    changed = np.any(moved.system.B != plant.system.B, axis=0)
    assert np.flatnonzero(changed).tolist() == [column]
    for name in "ACD":
        np.testing.assert_array_equal(getattr(moved.system, name), getattr(plant.system, name))
    along = plant.along("u2", [OFF_NODE, Z8])
    np.testing.assert_allclose(along.B[0, :, 0], moved.system.B[:, column], rtol=0, atol=1e-14)
    np.testing.assert_allclose(
        along.B[1, :, 0], plant.at({"u2": Z8}).system.B[:, column], atol=1e-14
    )
    # reciprocity: force at the POI's place is the POI's row
    spot = plant.at({"u2": (L / 2, L / 2, 0.0)}).system
    first = plant.modal_blocks[:, 0, 1]
    np.testing.assert_allclose(
        spot.B[1::2, column], spot.C[0, 0::2] * first, rtol=1e-12, atol=1e-15
    )


def test_several_ports_move_at_once():
    plant = assemble_plant(some_modes(), ports())
    moved = plant.at({"die": OFF_NODE, "y1": Z8, "amp1": OFF_NODE})
    assert moved.assembled.ports.poi("die").at == OFF_NODE
    assert moved.assembled.ports.sensor("y1").at == Z8
    assert moved.assembled.ports.w[0].at == OFF_NODE
    assert plant.assembled.ports.sensor("y1").at != Z8


def test_refusals():
    plant = assemble_plant(some_modes(), ports())
    with pytest.raises(LabelError, match=r"no POI 'dye'.*'die'"):
        plant.along("dye", PATH)
    with pytest.raises(LabelError, match="off the plate"):
        plant.along("die", [[0.7, 0.1, 0.0]])
    with pytest.raises(ModelError, match="NaN"):
        plant.along("die", [[np.nan, 0.1, 0.0]])
    with pytest.raises(ModelError, match=r"plant.continuous.along"):
        plant.discretized(RATE, delay=1).along("u1", PATH)
    with pytest.raises(ModelError, match="is a Sensor"):
        plant.along("y1", PATH)
    slow = ports(u=[Actuator("u1", at=Z8, dynamics=low_pass_filter(100.0))])
    with pytest.raises(ModelError, match="acts through a filter"):
        assemble_plant(some_modes(), slow).along("u1", PATH)
    twice = ports(z=[Poi("die", at=Z8), Poi("edge", at=OFF_NODE)], references=[])
    assert assemble_plant(some_modes(), twice).along("edge", PATH).channels == ("edge:z",)

"""The evaluation model of a plant: from what the model knows, or from what is given."""

import numpy as np
import pytest

import flexplant as fx
from flexplant.errors import FlexplantWarning, LabelError, ModelError
from flexplant.lti import frequency_response
from flexplant.modes import solve_modes
from flexplant.plant import assemble_plant
from flexplant.reduction import DesiredDofs, ModalTruncation, reduce
from flexplant.structure import ModalDamping
from plates import make_plate
from stages import ports

PLATE = make_plate(elements=(4, 4)).with_damping(ModalDamping(0.01))
MODES = solve_modes(PLATE, count=30)
GRID = [PLATE.dofs.nearest((x, y, 0), "z") for x in (0, 0.3, 0.6) for y in (0, 0.3, 0.6)]
FREQ = np.array([3.0, 47.0, 290.0, 1410.0])


def plant_of(model, *, rate=10e3, delay=1.5):
    return assemble_plant(model, ports()).discretized(rate, delay=delay)


def same_response(ours, theirs):
    assert (ours.w, ours.u, ours.z, ours.y) == (theirs.w, theirs.u, theirs.z, theirs.y)
    assert (ours.dt, ours.delay) == (theirs.dt, theirs.delay)
    one, two = (frequency_response(plant.system, FREQ).data for plant in (ours, theirs))
    np.testing.assert_allclose(one, two, rtol=1e-7, atol=1e-9 * np.abs(two).max(axis=2).min())


@pytest.mark.parametrize("method", [DesiredDofs(GRID), ModalTruncation(9, static_at=["1:z"])])
def test_what_the_model_knows_is_the_plant_of_all_modes(method):
    plant = plant_of(reduce(MODES, method))
    same_response(plant.evaluation_plant, plant_of(MODES))
    continuous = plant.continuous
    assert not continuous.evaluation_plant.dt


@pytest.mark.parametrize("given", ["modes", "model", "reduced", "plant", "sampled plant"])
def test_any_evaluation_model_serves(given):
    whole = {
        "modes": MODES,
        "model": PLATE,
        "reduced": reduce(MODES, ModalTruncation(30)),
        "plant": assemble_plant(MODES, ports()),
        "sampled plant": plant_of(MODES),
    }[given]
    plant = plant_of(reduce(MODES, ModalTruncation(9)))
    expected = plant_of(PLATE if given == "model" else MODES)
    same_response(plant.replace(evaluation=whole).evaluation_plant, expected)


def test_weights_and_blocks_are_taken_off():
    plant = plant_of(reduce(MODES, DesiredDofs(GRID)))
    weighted = plant.through(fx.reference_errors(plant)).weighted(z={"die:error": 2.0})
    same_response(weighted.evaluation_plant, plant_of(MODES))


def test_nothing_known_is_none():
    assert plant_of(solve_modes(PLATE, count=9)).evaluation_plant is None
    assert fx.StandardPlant.from_statespace(plant_of(MODES).system).evaluation_plant is None


def test_refusals():
    plant = plant_of(reduce(MODES, ModalTruncation(9)))
    with pytest.raises(ModelError, match=r"delay 1, the plant .* and 1\.5"):
        _ = plant.replace(evaluation=plant_of(MODES, delay=1)).evaluation_plant
    slow = assemble_plant(MODES, ports()).discretized(5e3, delay=1.5)
    assert slow.dt != plant.dt
    with pytest.raises(ModelError, match="could not be compared"):
        _ = plant.replace(evaluation=slow).evaluation_plant
    other = assemble_plant(MODES, ports().replace(y=ports().y[:3]))
    with pytest.raises(LabelError, match="other channels in w"):
        _ = plant.replace(evaluation=other).evaluation_plant
    foreign = fx.StandardPlant.from_statespace(plant.system)
    with pytest.raises(ModelError, match="this plant was not assembled from one"):
        _ = foreign.replace(evaluation=MODES).evaluation_plant
    with pytest.raises(ModelError, match="evaluation must be of type FEModel"):
        plant.replace(evaluation="whole")


def test_an_evaluation_model_of_another_machine_is_warned_of():
    """A plate of 0.7 m beside one of 0.6 m: 13.5 nm were predicted for 0.67."""

    def plate(size, count, density=2702):
        model = fx.kirchhoff_plate(
            size=(size, size),
            thickness=0.0272,
            elements=(4, 4),
            density=density,
            youngs_modulus=70e9,
            poisson_ratio=0.35,
        )
        return fx.solve_modes(model, count=count, damping=fx.ModalDamping(1e-3))

    own = fx.Ports(
        w=[fx.Disturbance("w", at=(0.15, 0.15, 0.0), asd=1e-3)],
        u=[fx.Actuator("u", at=(0.1, 0.1, 0.0))],
        z=[fx.Poi("die", at=(0.3, 0.3, 0.0), axes=("z",))],
        y=[fx.Sensor("y", at=(0.0, 0.0, 0.0), asd=1e-11)],
    )
    plant = fx.assemble_plant(plate(0.6, 12), own).discretized(1e4, delay=1.0)
    with pytest.warns(FlexplantWarning, match="another rigid body.* differs by"):
        _ = plant.replace(evaluation=plate(0.7, 20)).evaluation_plant
    # an added mass of some per cent is that of an update
    _ = plant.replace(evaluation=plate(0.6, 20, density=2702 * 1.05)).evaluation_plant

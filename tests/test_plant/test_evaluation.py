"""The evaluation model of a plant: from what the model knows, or from what is given."""

from collections import Counter

import numpy as np
import pytest

import flexplant as fx
from flexplant.errors import FlexplantWarning, LabelError, ModelError
from flexplant.lti import StateSpace, frequency_response
from flexplant.modes import solve_modes
from flexplant.plant import assemble_plant, building, partitioned
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


def test_weights_and_blocks_stand_around_the_evaluation_plant_too():
    plant = plant_of(reduce(MODES, DesiredDofs(GRID)))
    weighted = plant.through(fx.reference_errors(plant)).weighted(z={"die:error": 2.0})
    same_response(weighted.unweighted.evaluation_plant, plant_of(MODES))
    every = plant_of(MODES)
    every = every.through(fx.reference_errors(every)).weighted(z={"die:error": 2.0})
    same_response(weighted.evaluation_plant, every)


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
    with pytest.raises(ModelError, match="this plant was not assembled from a structure"):
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


#: a block that reads two sensors
READ = {"inputs": ["y1", "y2"], "outputs": ["a", "b"]}
STEPS = {
    "discretized": lambda plant: plant.discretized(4e3, delay=1.0),
    "at": lambda plant: plant.at((0.15, 0.3, 0.0)),
    "with_ports": lambda plant: plant.with_ports(ports().replace(y=ports().y[:3])),
    "asd": lambda plant: plant.replace(asd={**plant.asd, "amp1": 2e-3}),
    "uncertain": lambda plant: plant.uncertain(frequency=0.01).nominal,
    "evaluation": lambda plant: plant.replace(evaluation=MODES),
}


@pytest.mark.parametrize("seed", range(6))
def test_what_is_made_of_a_plant_is_judged_on_what_is_made_of_its_evaluation_model(seed):
    """Steps in any order: the evaluation plant is the plant of all modes after the same steps."""
    rng = np.random.default_rng(seed)
    names = [str(name) for name in rng.permutation(sorted(STEPS))]
    # a density of a channel stays where its port stays; a Delta is of the plant as it is last
    plant, every = assemble_plant(MODES.select(range(9)), ports()), assemble_plant(MODES, ports())
    for name in names:
        plant = STEPS[name](plant)
        every = every if name in ("uncertain", "evaluation") else STEPS[name](every)
    judge = plant.evaluation_plant
    same_response(judge, every)
    assert judge.asd == every.asd and judge.evaluation is None
    assert plant.evaluation_plant is judge
    heavy = plant.weighted(z={"die:z": 2.0}).through(StateSpace([], [], [], np.eye(2), **READ))
    assert heavy.unweighted.evaluation_plant is judge
    same_response(heavy.evaluation_plant, heavy.around(judge))


def test_a_plant_that_is_the_evaluation_model_follows_the_steps():
    """A plant has ports of its own: it is moved, gets other ports and is sampled by itself."""
    small, every = (assemble_plant(model, ports()) for model in (MODES.select(range(9)), MODES))
    plant = assemble_plant(small.model, ports(), evaluation=every)
    for name in ("at", "discretized", "with_ports", "uncertain"):
        plant = STEPS[name](plant)
        every = every if name == "uncertain" else STEPS[name](every)
        same_response(plant.evaluation_plant, every)


def test_a_system_made_elsewhere_has_a_plant_as_its_evaluation_model():
    few, every = (plant_of(model) for model in (MODES.select(range(9)), MODES))
    plant = fx.StandardPlant.from_statespace(
        few.system, w=few.w, u=few.u, z=few.z, y=few.y, evaluation=every.system
    )
    same_response(plant.evaluation_plant.replace(origin=every.origin), every)
    with pytest.raises(ModelError, match="this plant was not assembled from a structure"):
        _ = plant.replace(evaluation=MODES).evaluation_plant


@pytest.mark.slow
def test_it_is_solved_and_assembled_once(monkeypatch):
    """Its modes are solved once, and its plant is assembled once, whoever asks for it."""
    calls = Counter()
    for owner, name in ((partitioned, "plant_modes"), (building, "continuous_plant")):
        plain = getattr(owner, name)

        def counted(*given, plain=plain, name=name):
            calls[name] += 1
            return plain(*given)

        monkeypatch.setattr(owner, name, counted)
    plant = assemble_plant(MODES.select(range(9)), ports(), evaluation=PLATE)
    assert not calls  # only answers need it
    plant = plant.discretized(10e3, delay=1.5)
    observer = fx.design_kalman(plant)
    servo = fx.design_servo(plant, bandwidth=40.0, observer=observer)
    loop = fx.close_loop(plant, observer, servo)
    assert np.isfinite(loop.budget("die:error").left_out)
    assert fx.design_static(plant.continuous.discretized(10e3, delay=1.5)).rms("die") > 0
    assert calls == {"plant_modes": 1, "continuous_plant": 1}
    _ = plant.at((0.15, 0.3, 0.0)).evaluation_plant
    assert calls["plant_modes"] == 1


def test_machines_drawn_from_a_plant_have_no_evaluation_model():
    """They have its modes, off by what is stated."""
    plant = assemble_plant(MODES.select(range(9)), ports(), evaluation=MODES)
    (drawn,) = plant.uncertain(frequency=0.01).machines.drawn(1)
    assert drawn.evaluation is None
    assert drawn.system.n_states == plant.evaluation_plant.system.n_states
    known = assemble_plant(reduce(MODES, ModalTruncation(9)), ports())
    (drawn,) = known.uncertain(frequency=0.01).machines.drawn(1)
    assert drawn.system.n_states == known.evaluation_plant.system.n_states


@pytest.mark.slow
def test_results_say_where_they_are_not_judged():
    """Once in each printed result; nothing of it where there is an evaluation model."""
    alone = plant_of(MODES.select(range(9)))
    judged = alone.replace(evaluation=MODES)
    for plant, count in ((alone, 4), (judged, 4), (plant_of(PLATE), 3)):
        static = fx.design_static(plant)
        servo = fx.design_servo(plant, bandwidth=40.0, observer=static)
        loop = fx.close_loop(plant, static, servo)
        for result in (servo, loop, fx.design_kalman(plant), loop.budget("die:error"))[:count]:
            assert repr(result).count("not judged on a larger model") == (plant is alone)

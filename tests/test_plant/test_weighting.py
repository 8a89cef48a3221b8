"""Weighted plants: Wz P Ww, names kept."""

import control
import numpy as np
import pytest

import flexplant as fx
from driven_kinds import table
from flexplant.errors import LabelError, ModelError
from flexplant.lti import StateSpace, frequency_response, high_pass_filter, low_pass_filter, tustin
from flexplant.plant import StandardPlant, assemble_plant, standard_plant
from judge import judged
from stages import RATE, ports, some_modes

FREQ = np.array([1.0, 50.0, 245.0, 700.0])


def gain_of(sys):
    return frequency_response(sys, FREQ).data


@pytest.mark.parametrize("rate", [0.0, RATE])
def test_the_transfer_is_wz_p_ww(rate):
    plant = assemble_plant(some_modes(), ports())
    low, high = low_pass_filter(100.0, order=2, gain=1e9), high_pass_filter(20.0, gain=3.0)
    if rate:
        plant, low, high = plant.discretized(rate, delay=1), tustin(low, rate), tustin(high, rate)
    heavy = plant.weighted(
        z={"die:z": low, "u1:effort": 0.1, "die:rx": None, "die:ry": None},
        w={"amp2": high, "y1:noise": 1e-10, "die:ref": None},
    )
    assert heavy.z == tuple(n for n in plant.z if n not in ("die:rx", "die:ry"))
    assert heavy.w == tuple(n for n in plant.w if n != "die:ref")
    assert (heavy.u, heavy.y) == (plant.u, plant.y)
    assert heavy.unweighted is plant
    assert heavy.dt == plant.dt
    # oracle: frequency by frequency, numbers times numbers
    P = gain_of(plant.system.select([*heavy.z, *heavy.y], [*heavy.w, *heavy.u])).copy()
    for name, factor in (("die:z", gain_of(low)[0, 0]), ("u1:effort", 0.1)):
        P[heavy.z.index(name)] = P[heavy.z.index(name)] * factor
    for name, factor in (("amp2", gain_of(high)[0, 0]), ("y1:noise", 1e-10)):
        P[:, heavy.w.index(name)] = P[:, heavy.w.index(name)] * factor
    found = gain_of(heavy.system)
    np.testing.assert_allclose(found, P, rtol=1e-9, atol=1e-12 * np.abs(P).max())
    np.testing.assert_allclose(gain_of(heavy.Gyu), gain_of(plant.Gyu), rtol=1e-10)
    assert heavy.system.n_states == plant.system.n_states + low.n_states + high.n_states


def test_nothing_named_changes_nothing():
    plant = assemble_plant(some_modes(), ports())
    same = plant.weighted()
    np.testing.assert_allclose(gain_of(same.system), gain_of(plant.system), rtol=1e-12)
    assert same.unweighted is plant
    assert not same.asd  # H-infinity sees the noise only through weights


def test_a_continuous_weight_is_sampled_at_the_plants_rate():
    plant = assemble_plant(some_modes(), ports()).discretized(RATE)
    slow = low_pass_filter(10.0)
    heavy, wanted = (plant.weighted(z={"die:z": weight})
                     for weight in (slow, tustin(slow, RATE)))  # fmt: skip
    np.testing.assert_array_equal(heavy.system.A, wanted.system.A)
    np.testing.assert_array_equal(heavy.system.C, wanted.system.C)


def test_weights_of_python_control():
    plant = assemble_plant(some_modes(), ports())
    twin = control.tf([1.0], [0.01, 1.0])
    heavy = plant.weighted(z={"die:z": twin})
    wanted = gain_of(plant.Gzw)[0] / (0.02j * np.pi * FREQ + 1)
    np.testing.assert_allclose(gain_of(heavy.Gzw)[0], wanted, rtol=1e-9, atol=1e-20)


def test_check_looks_at_the_machine_behind_the_weights():
    plant = assemble_plant(some_modes(), ports())
    heavy = plant.weighted(z={"die:z": low_pass_filter(10.0)})
    assert heavy.check()["excited"].holds
    assert heavy.check().ok


def test_a_plant_says_what_was_done_to_it():
    plant = assemble_plant(some_modes(), ports())
    block = StateSpace([], [], [], [[0.5, 0.5]], inputs=["y1", "y2"], outputs=["mean"])
    mean = plant.through(block)
    both = mean.weighted(z={"die:z": 2.0})
    for altered, words in ((mean, "read through a block"), (both, "weighted and read through"),
                           (plant.weighted(z={"die:z": 2.0}), "weighted")):  # fmt: skip
        assert words in repr(altered).splitlines()[0]
        with pytest.raises(ModelError, match=f"the plant is {words}.*Use plant.unweighted"):
            standard_plant(altered)
    assert "weighted" not in repr(mean)
    # w is physical still, and the noise of the two sensors is that of their mean
    assert mean.asd == plant.asd
    assert not both.asd
    sampled = plant.discretized(RATE, delay=1).through(block)
    alone = plant.asd["y1:noise"] ** 2 * RATE / 2
    np.testing.assert_allclose(sampled.sensor_noise, [[0.5 * alone]], rtol=1e-12)
    np.testing.assert_array_equal(sampled.process_noise, sampled.unweighted.process_noise)
    slow = plant.discretized(RATE, delay=1).through(
        tustin(low_pass_filter(100.0), RATE).replace(inputs=["y1"], outputs=["slow"])
    )
    with pytest.raises(ModelError, match=r"block .* has 1 states"):
        _ = slow.sensor_noise


def test_refusals():
    plant = assemble_plant(some_modes(), ports()).discretized(RATE)
    with pytest.raises(LabelError, match=r"no channel of z 'dye:z'.*'die:z'"):
        plant.weighted(z={"dye:z": 1.0})
    with pytest.raises(LabelError, match="no channel of w 'amp9'"):
        plant.weighted(w={"amp9": 1.0})
    with pytest.raises(ModelError, match=r"has dt 0.01 s, the plant 0.0001 s.*continuous system"):
        plant.weighted(z={"die:z": tustin(low_pass_filter(10.0), 100.0)})
    with pytest.raises(ModelError, match=r"one input and one output.*Select a channel"):
        plant.weighted(z={"die:z": StateSpace([], [], [], np.eye(2))})
    with pytest.raises(ModelError, match="left out: keep at least one"):
        plant.weighted(z=dict.fromkeys(plant.z))
    with pytest.raises(ModelError, match="NaN"):
        plant.weighted(z={"die:z": np.nan})
    with pytest.raises(ModelError, match="need a system"):
        plant.weighted(z={"die:z": "heavy"})
    g = StateSpace([[-1.0]], [[1.0, 1.0]], [[1.0], [1.0]], np.zeros((2, 2)))
    small = StandardPlant.from_statespace(g, u=["u2"], y=["y2"]).weighted(w={"u1": 2.0})
    assert gain_of(small.Gzw)[0, 0, 0] == pytest.approx(2 / (2j * np.pi + 1))


#: what is done to a plant, each once
STEPS = {
    "discretized": lambda plant: plant.discretized(4e3, delay=1.0),
    "at": lambda plant: plant.at((0.15, 0.3, 0.0)),
    "weighted": lambda plant: plant.weighted(z={"die:z": low_pass_filter(100.0)}, w={"amp1": 3.0}),
    "through": lambda plant: plant.through(
        StateSpace([], [], [], [[0.5, 0.5]], inputs=["y1", "y2"], outputs=["mean"])
    ),
    "uncertain": lambda plant: plant.uncertain(frequency=0.01),
    "evaluation": lambda plant: plant.replace(evaluation=some_modes(attached=False)),
}


@pytest.mark.parametrize("seed", range(8))
def test_steps_in_any_order_give_the_same_plant(seed):
    """Of plants with uncertainty and evaluation model, against one fixed order."""
    names = [str(name) for name in np.random.default_rng(seed).permutation(sorted(STEPS))]
    few = some_modes(attached=False).select(range(12))
    plant = assemble_plant(few, ports())
    for name in names:
        known = name == "evaluation" and hasattr(plant, "nominal")
        plant = STEPS[name](plant.nominal if known else plant)
    wanted = assemble_plant(few, ports(), evaluation=some_modes(attached=False))
    for name in ("discretized", "at", "uncertain", "through", "weighted"):
        wanted = STEPS[name](wanted)
    plant = getattr(plant, "nominal", plant)
    freq = np.array([3.0, 100.0, 700.0])
    for one, two in ((plant, wanted), (plant.evaluation_plant, wanted.evaluation_plant),
                     (plant.uncertainty, wanted.uncertainty)):  # fmt: skip
        assert one.system.outputs == two.system.outputs
        assert one.system.inputs == two.system.inputs
        ours, theirs = (frequency_response(each.system, freq).data for each in (one, two))
        np.testing.assert_allclose(ours, theirs, rtol=1e-9, atol=1e-12 * np.abs(theirs).max())
    assert (plant.w, plant.u, plant.z, plant.y) == (wanted.w, wanted.u, wanted.z, wanted.y)
    assert plant.asd == wanted.asd
    assert plant.unweighted.dt == plant.dt == wanted.dt


def test_disturbances_along_levers_have_sizes():
    """A force by a combination of translation and rotation has no unit of its own."""
    plant = table(np.random.default_rng([3, 4]))
    found = fx.stage_weights(plant, 64.0)
    forces = [found.w[name] for name in found.w if name.startswith("air")]
    assert len(forces) == 4 and min(forces) > 0.0


@pytest.mark.parametrize("rate", [0.0, RATE])
def test_a_signal_is_a_sensor_without_its_noise(rate):
    """A weight of `y1:signal` adds the channel, before or after a block and other weights."""
    plant = assemble_plant(some_modes(), ports())
    plant = plant.discretized(rate, delay=1) if rate else plant
    low = low_pass_filter(100.0, gain=2.0)
    gain = gain_of(plant.system.select(["y2"]))[0].copy()
    gain[plant.system.inputs.index("y2:noise")] -= 1.0
    factor = gain_of(tustin(low, rate) if rate else low)[0, 0]
    block = StateSpace([], [], [], [[1.0, -1.0]], inputs=["y1", "y2"], outputs=["apart"])
    louder = 1.0 + 2.0 * (np.array(plant.system.inputs) == "amp1")
    shown = {"z": {"y2:signal": low}}
    read = plant.through(block)
    for heavy in (
        plant.weighted(**shown, w={"amp1": 3.0}),
        read.weighted(**shown).weighted(w={"amp1": 3.0}),
        read.weighted(w={"amp1": 3.0}).weighted(**shown),
        read.weighted(z={"y1:signal": 1.0}, w={"amp1": 3.0}).weighted(**shown),
    ):
        found = gain_of(heavy.system.select(["y2:signal"]))[0]
        wanted = gain * louder[:, None] * factor
        np.testing.assert_allclose(found, wanted, rtol=1e-8, atol=1e-12 * np.abs(wanted).max())
        assert heavy.around(plant).z == heavy.z
        assert "y2:signal" not in heavy.select(z=plant.z).z
    with pytest.raises(LabelError, match="y9:signal"):
        plant.weighted(z={"y9:signal": 1.0})


@pytest.mark.parametrize("rate", [0.0, RATE])
def test_a_push_at_an_actuator_needs_no_noise(rate):
    """A weight of `u1:disturbance` adds the channel: it moves what u1 moves, and no effort."""
    plant = assemble_plant(some_modes(), ports())
    plant = plant.discretized(rate, delay=1) if rate else plant
    pushed = "u1:disturbance"
    assert pushed not in plant.w
    heavy = plant.weighted(w={pushed: 3.0})
    assert heavy.w == (*plant.w, pushed)
    gain = frequency_response(heavy.system, FREQ)
    for name in (*heavy.z, *heavy.y):
        wanted = 0.0 if name.endswith(":effort") else 3.0 * gain[name, "u1"]
        np.testing.assert_allclose(gain[name, pushed], wanted + 0.0 * FREQ, rtol=1e-12)
    # the channel follows the weights to another machine, and to another selection
    assert pushed in heavy.around(plant).w and pushed not in heavy.select(u=["u2"]).w
    with pytest.raises(LabelError, match="u9:disturbance"):
        plant.weighted(w={"u9:disturbance": 1.0})


@pytest.mark.slow
@pytest.mark.parametrize("seed", range(3))
@pytest.mark.parametrize("noisy", [True, False])
def test_tables_with_geophones_are_damped(seed, noisy):
    """Velocities do not show where a table rests: gamma is near 1, not the stiffness it lacks."""
    plant = table(np.random.default_rng([7000 + seed, 4]))
    drawn = plant.assembled.ports
    if not noisy:  # one push at the payload leaves axes at rest: disturbances at u are added
        held = fx.Disturbance("pull", at="2:z", asd=0.01)
        plant = plant.with_ports(drawn.replace(w=[held]))
    weights = fx.stage_weights(plant, 8.0)
    assert noisy or set(weights.w) > {f"{name}:disturbance" for name in plant.u}
    law = fx.design_hinf(plant.weighted(weights))
    assert law.gamma < 1.5
    assert judged(plant, law).together > 0.4

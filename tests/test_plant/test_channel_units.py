"""Every channel knows its unit, from the ports to the run; implausible rates and delays."""

import numpy as np
import pytest

import flexplant as fx
from flexplant.errors import FlexplantWarning, ModelError
from flexplant.lti import Frf, StateSpace, append, connect, feedback, lft, parallel, series
from stages import ports, some_modes


def every_kind():
    return fx.Ports(
        w=[
            fx.Disturbance("push", at="1:z", asd=1.0),
            fx.Disturbance("twist", at=(0, 0, 0), direction="rx"),
            fx.BaseAcceleration("floor"),
            fx.plant.OutputDisturbance("drift", sensor="tilt"),
            fx.Disturbance("mixed", at={"1:z": 3.0, "1:rx": 2.0}),
            fx.Disturbance("levered", at={"1:z": 1.0, "1:rx": 0.4, "9:z": -1.0}),
            fx.Disturbance("leg", at={"1:x": 0.6, "1:z": 0.8, "1:ry": 0.3}),
        ],
        u=[fx.Actuator("u1", at=(0, 0, 0)), fx.Actuator("m1", at="1:ry")],
        z=[
            fx.Poi("die", at="41:z", axes=("z", "rx")),
            fx.Poi("turn", at={"1:rx": 1, "9:rx": -1}, axes=("z",)),
        ],
        y=[
            fx.Sensor("pos", at="1:z", asd=1e-9),
            fx.Sensor("tilt", at=(0, 0, 0), direction="rx"),
            fx.Sensor("speed", at="1:z", quantity="velocity"),
            fx.Sensor("acc", at="1:rx", quantity="acceleration"),
            fx.Sensor("geared", at={"1:rx": 1.0, "9:z": 200.0}),
            fx.Sensor("unclear", at={"1:rx": 1.0, "9:z": 1.0}),
        ],
        references=[fx.Reference("die")],
    )


def test_ports_tell_the_unit_of_every_channel():
    found = every_kind().units
    wanted = {
        "push": "N", "twist": "N m", "floor": "m/s^2", "drift": "rad", "u1": "N", "m1": "N m",
        "u1:effort": "N", "m1:effort": "N m", "die:z": "m", "die:rx": "rad", "die:ref": "m",
        "die:error": "m", "die:hat": "m", "die:rx:hat": "rad", "turn:z": "rad", "pos": "m",
        "pos:noise": "m", "tilt": "rad", "speed": "m/s", "acc": "rad/s^2",
        "levered": "N", "leg": "N", "geared": "rad",
    }  # fmt: skip
    assert {name: found.get(name) for name in wanted} == wanted
    assert "mixed" not in found
    assert "unclear" not in found


@pytest.mark.slow
def test_units_travel_with_the_channels(tmp_path):
    plant = fx.assemble_plant(some_modes(), ports())
    sampled = plant.discretized(10e3, delay=1)
    for which in (plant, sampled):
        assert set(which.system.units) == {*which.system.inputs, *which.system.outputs}
    assert plant.system.units["die:rx"] == "rad"
    sampled.save(tmp_path / "p.npz")
    assert dict(fx.load(tmp_path / "p.npz").system.units) == dict(sampled.system.units)
    part = sampled.system["die:rx", "u1"]
    assert dict(part.units) == {"u1": "N", "die:rx": "rad"}
    assert dict(part.renamed(inputs={"u1": "f"}, outputs={"die:rx": "a"}).units) == {
        "f": "N",
        "a": "rad",
    }
    frf = fx.frequency_response(part, np.array([10.0, 20.0]))
    assert frf.unit("die:rx", "u1") == "rad/N"
    frf.save(tmp_path / "f.npz")
    assert fx.load(tmp_path / "f.npz").unit("die:rx", "u1") == "rad/N"
    observer, servo = fx.design_kalman(sampled), fx.design_servo(sampled, bandwidth=50.0)
    loop = fx.close_loop(sampled, observer, servo)
    assert loop.system.units["die:error"] == "m"
    S, KS = fx.loop.sensitivity(loop, at="y"), fx.loop.control_sensitivity(loop)
    assert (S.unit("y1", "y2"), KS.unit("u1", "y1")) == ("1", "N/m")
    assert "[1]" in repr(fx.loop.loop_gain(loop)) and "[N/m]" in repr(KS)
    measured = fx.frequency_response(sampled.system.select(sampled.y, sampled.u), S.freq)
    measured = measured.replace(units={}, quantity="displacement")
    assert fx.loop.control_sensitivity((measured, loop)).unit("u1", "y1") == "N/m"
    assert "0 dB = 1 N/m" in fx.plot.frf({"KS": KS}, "u1", "y1").get_ylabel()
    assert "0 dB = 1]" in fx.plot.frf({"S": S}, "y1", "y1").get_ylabel()
    # the controller takes m and rad: of its gains together only "SI units" is true
    assert "0 dB = 1 in SI units]" in fx.plot.singular_values(servo.system).get_ylabel()
    assert "0 dB = 1 N/m]" in fx.plot.singular_values(KS).get_ylabel()
    run = fx.simulate(loop, duration=0.01, rng=1)
    assert [run.units[n] for n in ("die:z", "die:rx", "u1", "die:rx:hat", "y1")] == [
        "m", "rad", "N", "rad", "m"
    ]  # fmt: skip
    run.save(tmp_path / "r.npz")
    assert dict(fx.load(tmp_path / "r.npz").units) == dict(run.units)
    elsewhere = fx.StandardPlant.from_statespace(plant.system.replace(units={}))
    assert not elsewhere.system.units


@pytest.mark.slow
def test_designs_know_the_units_of_their_channels():
    """Controllers, estimators and geometric transformations: what they read and what they drive."""
    plant = fx.assemble_plant(some_modes(), ports())
    sampled = plant.discretized(10e3, delay=1)
    weights = fx.stage_weights(plant, 30.0)
    apart = fx.plant.gravity_axes(sampled)
    systems = [
        fx.design_servo(sampled, bandwidth=50.0).system,
        fx.design_static(sampled).system,
        fx.design_hinf(plant.weighted(z=weights.z, w=weights.w)).system,
        fx.reference_errors(sampled),
        apart.to_actuators,
        apart.to_motions,
        apart.accelerations,
    ]
    for system in systems:
        assert set(system.units) == {*system.inputs, *system.outputs}, system
    assert systems[0].units["die:rx:hat"] == "rad"
    assert systems[3].units["y1:error"] == "m"
    assert apart.to_actuators.units["cog:rx:force"] == "N m"
    assert apart.to_motions.units["cog:ry"] == "rad"
    assert apart.accelerations.units["cog:z:acceleration"] == "m/s^2"
    law = fx.frequency_response(systems[0], np.array([10.0, 20.0]))
    assert law.unit("u1", "die:hat") == "N/m"


def test_connections_keep_the_units_of_what_is_left():
    one = [[1.0]]
    g = StateSpace(
        [[-1.0]], one, one, [[0.0]], inputs=["f"], outputs=["x"], units={"f": "N", "x": "m"}
    )
    k = StateSpace(
        [[-2.0]], one, one, [[0.0]], inputs=["x"], outputs=["f"], units={"x": "m", "f": "N"}
    )
    other = g.renamed(inputs={"f": "f2"}, outputs={"x": "x2"})
    assert dict(append(g, other).units) == {"f": "N", "x": "m", "f2": "N", "x2": "m"}
    assert dict(series(k, g).units) == {"x": "m"}
    assert dict(parallel(g, g).units) == dict(feedback(g).units) == {"f": "N", "x": "m"}
    both = append(g, other)
    assert dict(lft(both, k).units) == {"f2": "N", "x2": "m"}
    joined = connect([g, other.renamed(inputs={"f2": "x"})], ["f"], ["x", "x2"])
    assert dict(joined.units) == {"f": "N", "x": "m", "x2": "m"}
    with pytest.raises(ModelError, match="units must be a mapping"):
        g.replace(units=["m"])


def test_a_derivative_changes_the_unit():
    frf = Frf(
        [1.0],
        [[[1.0]]],
        inputs=["u"],
        outputs=["y"],
        quantity="displacement",
        units={"u": "N m", "y": "rad"},
    )
    assert frf.converted("acceleration").unit("y", "u") == "rad/s^2/(N m)"
    assert frf.converted("velocity").converted("displacement").unit("y", "u") == "rad/(N m)"
    assert Frf([1.0], [[[1.0]]]).unit("y1", "u1") is None


@pytest.mark.parametrize(
    ("rate", "delay", "said"),
    [
        (1e-4, 0.0, r"0.0001 s as a sampling period is rate=10000"),
        (10.0, 0.0, r"10 kHz is rate=10000"),
        (1e4, 1e-4, r"delay=0.0001 is in samples.*delay=1 at 10000 Hz"),
    ],
)
def test_rates_and_delays_in_another_unit_are_warned_of(rate, delay, said):
    """Sampling with a period of 10 000 s takes no longer than any other."""
    plant = fx.assemble_plant(some_modes(), ports())
    with pytest.warns(FlexplantWarning, match=said):
        plant.discretized(rate, delay=delay)
    elsewhere = fx.StandardPlant.from_statespace(plant.system)
    with pytest.warns(FlexplantWarning, match=said):
        elsewhere.discretized(rate, delay=delay)


def test_modes_partly_above_half_the_rate_are_normal_and_all_are_warned_of():
    plant = fx.assemble_plant(some_modes(), ports())  # elastic modes from 246 Hz on
    plant.discretized(600.0)
    with pytest.warns(
        FlexplantWarning, match=r"all 2\d elastic modes.*24\d\.\d Hz and above.*rate is in Hz"
    ):
        plant.discretized(400.0)


def test_delays_of_more_than_1000_samples_are_refused():
    """Latencies of ports are in seconds, the delay of a sampled loop is in samples."""
    late = ports().replace(u=[a.replace(latency=0.5) for a in ports().u])
    with pytest.raises(ModelError, match=r"'u1' is 5000 samples, 0.5 s at 10000 Hz.*seconds"):
        fx.assemble_plant(some_modes(), late).discretized(1e4)
    with pytest.raises(ModelError, match=r"delay is 1500 samples, 0.15 s"):
        fx.assemble_plant(some_modes(), ports()).discretized(1e4, delay=1500)

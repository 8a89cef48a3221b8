"""Noise at an amplifier's input: what the doubled amplifier gives, without its states."""

import numpy as np
import pytest

import flexplant as fx
from flexplant.errors import AssumptionError, LabelError, ModelError
from flexplant.lti import low_pass_filter
from flexplant.placement import PoiLqr, score_actuators
from flexplant.plant import Actuator, Disturbance, Sensor
from stages import CORNERS, INSET, RATE, ports, reduced, some_modes

AMP = low_pass_filter(800.0, order=2)
ASD = 2e-3


def machine(*, doubled, latency=0.0, dynamics=AMP):
    """Four amplifiers with noise: as `asd`, or as disturbances through filters of their own."""
    base = ports()
    asd = 0.0 if doubled else ASD
    u = [
        Actuator(f"u{i}", at=p, dynamics=dynamics, latency=latency, asd=asd)
        for i, p in enumerate(INSET, 1)
    ]
    w = [Disturbance(f"n{i}", at=p, shape=AMP, asd=ASD) for i, p in enumerate(INSET, 1)]
    y = [Sensor(f"y{i}", at=p, asd=1e-11) for i, p in enumerate(CORNERS, 1)]
    return base.replace(w=w if doubled else [], u=u, y=y, references=())


@pytest.mark.slow
def test_noise_of_amplifiers_is_that_of_doubled_ones_without_their_states():
    model = reduced()
    plants = [
        fx.assemble_plant(model, machine(doubled=doubled, latency=3e-5))
        for doubled in (True, False)
    ]
    double, single = plants
    assert double.system.n_states - single.system.n_states == 4 * AMP.n_states
    assert single.w[:4] == tuple(f"u{i}:disturbance" for i in range(1, 5))
    assert single.asd["u2:disturbance"] == ASD
    assert single.units["u2:disturbance"] == "N"
    freq = np.array([1.0, 120.0, 700.0])
    found = fx.frequency_response(single.Gzw, freq)["die:z", "u2:disturbance"]
    wanted = fx.frequency_response(double.Gzw, freq)["die:z", "n2"]
    np.testing.assert_allclose(found, wanted, rtol=1e-9)
    double, single = (plant.discretized(RATE, delay=1) for plant in plants)
    rms = [fx.design_kalman(plant).rms("die") for plant in (double, single)]
    assert rms[0] == pytest.approx(rms[1], rel=1e-7, abs=0)
    # the truncated modes are moved by it, too
    whole = some_modes(count=40, attached=False)
    both = [fx.design_kalman(plant.replace(evaluation=whole)) for plant in (double, single)]
    assert both[0].certificate["truncated modes"] == both[1].certificate["truncated modes"] > 0
    assert both[0].rms("die") == pytest.approx(both[1].rms("die"), rel=1e-7, abs=0)
    assert both[0].rms("die") > 1.001 * rms[0]


@pytest.mark.slow
def test_weights_placement_and_refusals():
    plant = fx.assemble_plant(reduced(), machine(doubled=False))
    weights = fx.stage_weights(plant, 50.0)
    plain = fx.stage_weights(fx.assemble_plant(reduced(), ports()), 50.0).w["amp1"]
    # the noise of an actuator has its unit of force; a force at its place that of equal motion
    assert weights.w["u1:disturbance"] == pytest.approx(plain, rel=0.25)
    # an actuator that is not chosen has no noise either
    noisy = fx.assemble_plant(reduced(), ports()).discretized(RATE, delay=1)
    layout = [Actuator(f"c{i}", at=p, asd=ASD * i) for i, p in enumerate(INSET, 1)]
    scores = score_actuators(noisy, [layout, layout[::-1]], criterion=PoiLqr("die"))
    direct = PoiLqr("die")(noisy.with_ports(noisy.assembled.ports.replace(u=layout)))
    np.testing.assert_allclose(scores.values, direct, rtol=1e-6)
    silent = [port.replace(asd=0.0) for port in layout]
    assert PoiLqr("die")(noisy.with_ports(noisy.assembled.ports.replace(u=silent))) < direct
    with pytest.raises(ModelError, match="asd of 'u' must be zero or positive"):
        Actuator("u", at="1:z", asd=-1.0)
    with pytest.raises(LabelError, match=r"end in ':disturbance'"):
        Sensor("u:disturbance", at="1:z")
    # without dynamics it reaches an accelerometer at once
    bare = machine(doubled=False, dynamics=None)
    shaken = bare.replace(y=[*bare.y, Sensor("a", at=INSET[0], quantity="acceleration", asd=1e-6)])
    with pytest.raises(AssumptionError, match=r"'u1:disturbance' reaches 'a' without delay"):
        fx.design_kalman(fx.assemble_plant(reduced(), shaken).discretized(RATE, delay=1))
    # and the compliance of truncated modes does not answer white noise at once
    late = fx.assemble_plant(reduced(), bare).discretized(RATE, delay=1)
    found = fx.design_kalman(late.replace(evaluation=some_modes(count=40, attached=False)))
    assert found.certificate["truncated modes"] > 0

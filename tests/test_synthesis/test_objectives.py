"""Several objectives by LMIs, against optima of single ones and the norms of the closed loop."""

from functools import cache

import numpy as np
import pytest
from scipy.linalg import expm

import flexplant as fx
from flexplant.errors import AssumptionError, InfeasibleError, LabelError, ModelError
from flexplant.lti import StateSpace, lft
from flexplant.synthesis import H2, Hinf, PeakGain, PoleRegion, design_lmi

pytestmark = pytest.mark.slow


@cache
def plant(sampled=False):
    """Two modes of four masses, weighted."""
    model = fx.chain(masses=[1.0] * 4, stiffnesses=[2000.0] * 3, ground=20.0)
    modes = fx.solve_modes(model, count=2, damping=fx.ModalDamping(0.001))
    ports = fx.Ports(
        w=[fx.Disturbance("d", at="2:x", asd=1e-3)],
        u=[fx.Actuator("f", at="1:x")],
        z=[fx.Poi("tip", at="4:x", axes=("x",))],
        y=[fx.Sensor("s", at="1:x", asd=1e-6)],
    )
    found = fx.assemble_plant(modes, ports)
    given = found.discretized(500.0, delay=0.5) if sampled else found
    return given.weighted(z={"tip:x": 100.0, "f:effort": 0.05}, w={"s:noise": 1e-2})


def closed(given, controller):
    return lft(given.system, controller.system)


@pytest.mark.parametrize("sampled", [False, True])
def test_single_objectives_have_their_known_optima(sampled):
    """LQG by two Riccati equations; H-infinity by the projected LMIs."""
    given = plant(sampled)
    lqg = fx.design_h2(given)
    found = design_lmi(given, minimize=H2())
    assert found.certificate["LMI optimum"] == pytest.approx(lqg.gamma, rel=2e-3, abs=0)
    assert lqg.gamma * (1 - 1e-6) <= found.gamma <= 1.04 * lqg.gamma
    assert found.gamma == pytest.approx(fx.h2_norm(closed(given, found)), rel=1e-6, abs=0)
    best = fx.design_hinf(given, fx.StructuredLmi())
    found = design_lmi(given, minimize=Hinf())
    assert found.gamma <= 1.05 * best.gamma
    assert found.gamma >= best.lower * (1 - 1e-3)


@pytest.mark.parametrize("sampled", [False, True])
def test_mixed_h2_and_hinf(sampled):
    """Between the two: less H2 than the H-infinity design, less peak than LQG."""
    given = plant(sampled)
    lqg = fx.design_h2(given)
    bound = 1.25 * fx.design_hinf(given).gamma
    assert fx.hinf_norm(closed(given, lqg)) > bound
    found = design_lmi(given, minimize=H2(), subject_to=[Hinf(below=bound)])
    loop = closed(given, found)
    assert fx.hinf_norm(loop) <= bound * 1.001
    assert lqg.gamma <= fx.h2_norm(loop) <= found.certificate["LMI optimum"] * 1.05
    assert fx.h2_norm(loop) < fx.h2_norm(closed(given, fx.design_hinf(given)))
    assert set(found.reached) == {repr(H2()), repr(Hinf(below=bound))}
    assert "modulus margin" not in found.certificate


def test_channels_are_chosen_by_name():
    given = plant()
    free = design_lmi(given, minimize=Hinf(w=["d"], z=["tip:x"]), subject_to=[H2(below=20.0)])
    tight = design_lmi(
        given, minimize=Hinf(w=["d"], z=["tip:x"]), subject_to=[Hinf(z=["f:effort"], below=1.0)]
    )
    assert fx.hinf_norm(closed(given, tight)["f:effort", ["d", "s:noise"]]) <= 1.001
    assert fx.h2_norm(closed(given, free)) <= 20.02
    assert tight.gamma <= tight.certificate["LMI bound"] * 1.001


def test_poles_lie_in_their_region():
    region = PoleRegion(decay=0.4, damping=0.1, bandwidth=40.0)
    loop = closed(plant(), design_lmi(plant(), minimize=H2(), subject_to=[region]))
    poles = loop.poles()
    assert poles.real.max() <= -0.4 * (1 - 1e-3)
    assert (-poles.real / np.abs(poles)).min() >= 0.1 * (1 - 1e-3)
    assert np.abs(poles).max() <= 2 * np.pi * 40.0 * (1 + 1e-3)
    sampled = plant(True)
    found = design_lmi(sampled, minimize=H2(), subject_to=[PoleRegion(decay=0.4)])
    assert np.abs(closed(sampled, found).poles()).max() <= np.exp(-0.4 / 500.0) * (1 + 1e-6)


def test_peak_gain_is_the_integral_of_the_impulse_response():
    given = plant()
    goal = PeakGain(w=["d"], z=["tip:x"])
    found = design_lmi(given, minimize=goal, subject_to=[Hinf(z=["f:effort"], below=2.0)])
    loop = closed(given, found)["tip:x", "d"]
    end = 30.0 / np.min(-loop.poles().real)
    t, step = np.linspace(0.0, end, 60_000, retstep=True)
    x, move, h = loop.B[:, 0], expm(loop.A * step), np.empty(t.size)
    for k in range(t.size):
        h[k] = (loop.C @ x)[0]
        x = move @ x
    assert found.gamma == pytest.approx(np.trapezoid(np.abs(h), t), rel=2e-3, abs=0)
    assert found.gamma <= found.certificate["LMI bound"]  # the star norm is larger


def test_the_scale_of_units_does_not_matter():
    """In nanometres and kilohertz the same controller: norms scale with the units."""
    given = plant()
    g = given.system
    small = fx.StandardPlant.from_statespace(
        StateSpace(
            1e3 * g.A, np.sqrt(1e3) * g.B, np.sqrt(1e3) * np.diag([1, 1, 1e-9]) @ g.C,
            np.diag([1, 1, 1e-9]) @ g.D, inputs=g.inputs, outputs=g.outputs,
        ),
        u=given.u, y=given.y,
    )  # fmt: skip
    one = design_lmi(given, minimize=H2())
    other = design_lmi(small, minimize=H2())
    assert other.gamma == pytest.approx(np.sqrt(1e3) * one.gamma, rel=1e-2, abs=0)


def test_refusals():
    given = plant()
    with pytest.raises(InfeasibleError):
        design_lmi(given, minimize=H2(), subject_to=[Hinf(below=0.2)])
    with pytest.raises(ModelError, match="without below"):
        design_lmi(given, minimize=H2(below=1.0))
    with pytest.raises(ModelError, match="with below="):
        design_lmi(given, minimize=H2(), subject_to=[Hinf()])
    with pytest.raises(LabelError, match="no channel of z 'top'"):
        design_lmi(given, minimize=H2(z=["top"]))
    with pytest.raises(ModelError, match="no convex regions"):
        design_lmi(plant(True), minimize=H2(), subject_to=[PoleRegion(damping=0.1)])
    with pytest.raises(ModelError, match="Reduce the order"):
        design_lmi(given, minimize=H2(), max_states=3)
    direct = given.system.replace(D=given.system.D + np.array([[1.0, 0, 0], [0, 0, 0], [0, 0, 0]]))
    with pytest.raises(AssumptionError, match="at once"):
        design_lmi(fx.StandardPlant.from_statespace(direct, u=["f"], y=["s"]), minimize=H2())

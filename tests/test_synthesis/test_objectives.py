"""Several objectives by LMIs, against optima of single ones and the norms of the closed loop."""

from functools import cache

import numpy as np
import pytest
import scipy.linalg as la
from scipy.linalg import expm

import flexplant as fx
from flexplant.errors import (
    AssumptionError,
    CertificateError,
    InfeasibleError,
    LabelError,
    ModelError,
    SolverError,
)
from flexplant.lti import StateSpace, lft
from flexplant.lti.sampling import held_exactly
from flexplant.synthesis import H2, AutoBackOff, Hinf, PeakGain, PoleRegion, design_lmi
from flexplant.synthesis.lmi.objective_design import _balanced_plant
from flexplant.synthesis.lmi.objectives import ObjectivePrograms, damped, within

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


@pytest.mark.parametrize("sampled", [False, pytest.param(True, marks=pytest.mark.long)])
def test_single_objectives_have_their_known_optima(sampled):
    """LQG by two Riccati equations; H-infinity by the projected LMIs."""
    given = plant(sampled)
    lqg = fx.design_h2(given)
    found = design_lmi(given, minimize=H2())
    assert found.certificate["LMI optimum"] == pytest.approx(lqg.gamma, rel=2e-3, abs=0)
    assert lqg.gamma * (1 - 1e-6) <= found.gamma <= 1.04 * lqg.gamma
    assert found.gamma == pytest.approx(fx.h2_norm(closed(given, found)), rel=1e-6, abs=0)
    best = fx.design_hinf(given, fx.Lmi())
    found = design_lmi(given, minimize=Hinf())
    assert found.gamma <= 1.05 * best.gamma
    assert found.gamma >= best.lower * (1 - 1e-3)


@pytest.mark.parametrize("sampled", [False, pytest.param(True, marks=pytest.mark.long)])
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
    assert "of 1 that" not in repr(found), "the H2 norm has a unit, the bound is in the objective"
    assert repr(found).count(repr(Hinf(below=bound))) == 1


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


@pytest.mark.long
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


def mass(rate=0.0):
    """A mass on a soft spring, with force d, noise n, effort e."""
    g = StateSpace(
        [[0, 1.0], [-4.0, -0.04]], [[0, 0, 0], [1, 0, 1.0]], [[1.0, 0], [0, 0], [1, 0]],
        [[0, 0, 0], [0, 0, 0.3], [0, 0.1, 0]], inputs=["d", "n", "f"], outputs=["x", "e", "s"],
    )  # fmt: skip
    return fx.StandardPlant.from_statespace(held_exactly(g, rate) if rate else g, u=["f"], y=["s"])


@pytest.mark.long
def test_sampled_poles_lie_in_their_region():
    """Damping, bandwidth of log(z) / dt by eigenvalues; the optimum without them breaks both."""
    region = PoleRegion(decay=0.5, damping=0.75, bandwidth=0.5)
    given = mass(50.0)
    found = design_lmi(given, minimize=H2(), subject_to=[region])
    s = np.log(la.eigvals(closed(given, found).A).astype(complex)) * 50.0
    assert s.real.max() <= -0.5 * (1 - 1e-3)
    assert (-s.real / np.abs(s)).min() >= 0.75 * (1 - 1e-3)
    assert np.abs(s).max() <= 2 * np.pi * 0.5 * (1 + 1e-3)
    free = np.log(closed(given, fx.design_h2(given)).poles().astype(complex)) * 50.0
    assert (-free.real / np.abs(free)).min() < 0.4
    assert np.abs(free).max() > 2 * np.pi * 0.52
    # the discrete LMIs promise what the continuous ones do, at so high a rate
    same = design_lmi(mass(), minimize=H2(), subject_to=[PoleRegion(damping=0.5)])
    other = design_lmi(given, minimize=H2(), subject_to=[PoleRegion(damping=0.5)])
    claims = [one.certificate["LMI optimum"] for one in (same, other)]
    assert np.sqrt(50.0) * claims[1] == pytest.approx(claims[0], rel=0.1)


@pytest.mark.parametrize("ratio", [0.02, 0.1, 0.5, 0.9])
def test_the_regions_of_z_are_inside_those_of_s(ratio):
    """Random points: all that polygon and disc hold has damping and speed; they hold much."""
    rng = np.random.default_rng(0)
    z = np.sqrt(rng.uniform(size=200_000)) * np.exp(1j * rng.uniform(-np.pi, np.pi, 200_000))
    s = np.log(z)
    held = np.all([x * z.real + y * abs(z.imag) <= most for x, y, most in damped(ratio)], axis=0)
    right = -s.real >= ratio * np.abs(s)
    assert not np.any(held & ~right)
    assert np.count_nonzero(held) > 0.7 * np.count_nonzero(right)
    for speed in (0.05, 0.5, 2.0):
        disc = within(speed)
        held = np.abs(z - disc.centre) <= disc.radius
        assert not np.any(held & (np.abs(s) > speed * (1 + 1e-3)))
        assert np.count_nonzero(held) > 0.5 * np.count_nonzero(np.abs(s) <= speed)


@pytest.mark.long
def test_the_rate_of_decay_is_searched():
    """The least over 40 rates, each given to PeakGain, is found without naming one."""
    given = mass()
    found = design_lmi(given, minimize=PeakGain()).certificate["LMI optimum"]
    plant = _balanced_plant(given)
    single = [
        ObjectivePrograms(given, plant, PeakGain(decay=rate * plant.speed), (), found).smallest(1.0)
        for rate in np.geomspace(0.05, 2.0, 40)
    ]
    assert found == pytest.approx(min(single), rel=5e-3, abs=0)


@pytest.mark.long
def test_the_peak_gain_of_a_sampled_plant_is_the_sum_of_its_impulse_response():
    given, goal = mass(50.0), PeakGain(w=["d"], z=["x"], decay=1.5)
    limit = PeakGain(z=["e"], below=2.0, decay=1.5)
    found = design_lmi(given, minimize=goal, subject_to=[limit])
    loop = closed(given, found)
    for channel, wanted in ((("x", "d"), found.gamma), (("e", "n"), found.reached[repr(limit)])):
        one = loop[channel]
        x, total = one.B[:, 0], np.abs(one.D).item()
        for _ in range(2000):
            total += abs((one.C @ x).item())
            x = one.A @ x
        assert np.abs(x).max() < 1e-9 * np.abs(one.B).max()
        assert total <= wanted * (1 + 1e-6)
        if channel[0] == "x":
            assert wanted == pytest.approx(total, rel=1e-6, abs=0)
    assert found.reached[repr(limit)] <= 2.0
    assert found.gamma <= found.certificate["LMI bound"]
    other = design_lmi(mass(), minimize=goal, subject_to=[limit])
    claims = [one.certificate["LMI optimum"] for one in (found, other)]
    assert claims[0] == pytest.approx(claims[1], rel=0.1)


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


def test_a_back_off_is_used_as_it_is_and_the_automatic_ones_are_listed(monkeypatch):
    given, solve = plant(), ObjectivePrograms.controller
    found = design_lmi(given, minimize=H2(), back_off=0.05)
    assert dict(found.tried) == {"back-off 0.05": found.gamma}
    (only,) = found.tried.checks
    assert only.holds and only.limit == found.certificate["LMI bound"]
    assert only.limit == pytest.approx(1.05 * found.certificate["LMI optimum"])

    def fails_near_the_optimum(self, bound, rate):
        if bound < 1.1 * found.certificate["LMI optimum"]:
            raise SolverError("gains without bound.")
        return solve(self, bound, rate)

    monkeypatch.setattr(ObjectivePrograms, "controller", fails_near_the_optimum)
    with pytest.raises(CertificateError, match=r"0\.05\): gains without bound\. .* raise back_off"):
        design_lmi(given, minimize=H2(), back_off=0.05)
    for back_off in (AutoBackOff(0.05), None):
        again = design_lmi(given, minimize=H2(), back_off=back_off)
        *failed, last = again.tried.checks
        assert failed and all(one.figure == np.inf and not one.holds for one in failed)
        assert {one.route for one in failed} == {"gains without bound."}
        assert last.figure == again.gamma and last.holds
    with pytest.raises(ModelError, match="back_off must be positive"):
        design_lmi(given, minimize=H2(), back_off=-0.1)


def test_refusals():
    given = plant()
    with pytest.raises(InfeasibleError, match="beyond every controller"):
        design_lmi(given, minimize=H2(), subject_to=[Hinf(below=0.2)])
    with pytest.raises(ModelError, match="without below"):
        design_lmi(given, minimize=H2(below=1.0))
    with pytest.raises(ModelError, match="with below="):
        design_lmi(given, minimize=H2(), subject_to=[Hinf()])
    with pytest.raises(LabelError, match="no channel of z 'top'"):
        design_lmi(given, minimize=H2(z=["top"]))
    with pytest.raises(ModelError, match="not below half the rate, 250 Hz"):
        design_lmi(plant(True), minimize=H2(), subject_to=[PoleRegion(bandwidth=260.0)])
    with pytest.raises(ModelError, match="Reduce the order"):
        design_lmi(given, minimize=H2(), max_states=3)
    direct = given.system.replace(D=given.system.D + np.array([[1.0, 0, 0], [0, 0, 0], [0, 0, 0]]))
    with pytest.raises(AssumptionError, match="at once"):
        design_lmi(fx.StandardPlant.from_statespace(direct, u=["f"], y=["s"]), minimize=H2())


def test_a_labelled_system_names_its_u_and_y():
    """As design_hinf: the same controller as of the plant made by hand, and the same refusals."""
    lag = fx.lti.tf([1.0], [1.0, 1.0])
    lag = fx.plant.mixed_sensitivity(lag, S=fx.lti.low_pass_filter(0.1), KS=0.1)
    made = design_lmi(lag, minimize=Hinf())
    named = design_lmi(lag.system, minimize=Hinf(), u=lag.u, y=lag.y)
    assert named.gamma == pytest.approx(made.gamma, rel=1e-9)
    with pytest.raises(ModelError, match="names its u and y"):
        design_lmi(lag, minimize=Hinf(), u=lag.u, y=lag.y)

"""Active damping against closed loops that are written down from M, D and K, and brute force."""

from functools import cache

import numpy as np
import pytest
from scipy.optimize import differential_evolution

import flexplant as fx
from flexplant.errors import AssumptionError, FlexplantWarning, LabelError, ModelError
from flexplant.synthesis import damp_modes

K = np.array([[8e4, -4e4, 0], [-4e4, 8e4, -4e4], [0, -4e4, 4e4]])


@cache
def plant(rate=None):
    """Three unit masses in a row on the ground, forces and sensors on the first and the last."""
    model = fx.chain(masses=[1.0] * 3, stiffnesses=[4e4, 4e4], ground=[4e4, 0.0, 0.0])
    ports = fx.Ports(
        w=[fx.Disturbance("f", at="3:x", asd=1e-3)],
        u=[fx.Actuator("u1", at="3:x"), fx.Actuator("u2", at="1:x")],
        z=[fx.Poi("tip", at="3:x", axes=("x",))],
        y=[fx.Sensor("y1", at="3:x", direction="x", asd=1e-9)],
    )
    modes = fx.solve_modes(model, count=3, damping=fx.ModalDamping(0.005))
    found = fx.assemble_plant(modes, ports)
    return found.discretized(rate, delay=1) if rate else found


def by_hand(element, at):
    """The poles of M q'' + D q' + K q = f with a law of one or two states, sensor on the last."""
    omega2, phi = np.linalg.eigh(K)
    D = phi @ np.diag(2 * 0.005 * np.sqrt(omega2)) @ phi.T
    drive, see = np.zeros(3), np.array([0, 0, 1.0])
    drive[at] = 1.0
    w = 2 * np.pi * getattr(element, "freq", getattr(element, "pole", 0.0))
    if "Velocity" in type(element).__name__:  # u = -g w (y - x), x' = w (y - x)
        A, B, C, direct = [[-w]], [w], [element.gain * w], -element.gain * w
    elif "Integral" in type(element).__name__:
        A, B, C, direct = [[-w]], [w], [element.gain], 0.0
    else:
        A = [[0, 1], [-w * w, -2 * element.damping * w]]
        B, C, direct = [0, w * w], [element.gain, 0], 0.0
    A, B, C = np.array(A, float), np.array(B, float), np.array(C, float)
    n, eye, none = len(A), np.eye(3), np.zeros((3, 3))
    whole = np.block([
        [none, eye, np.zeros((3, n))],
        [-K + direct * np.outer(drive, see), -D, np.outer(drive, C)],
        [np.outer(B, see), np.zeros((n, 3)), A],
    ])  # fmt: skip
    return np.linalg.eigvals(whole)


@pytest.mark.slow
@pytest.mark.parametrize("ends", [("u1", 2), ("u2", 0)], ids=["collocated", "apart"])
@pytest.mark.parametrize("kind", ["velocity", "ppf", "irc"])
def test_poles_are_those_of_the_equations_of_motion(kind, ends):
    """Damping ratio, stability and the damping that the other modes keep."""
    found = damp_modes(plant(), kind, u=ends[0])
    poles = by_hand(found.element, ends[1])
    assert np.sort(poles.imag) == pytest.approx(np.sort(found.loop.poles().imag), abs=1e-4)
    assert poles.real.max() < 0
    ratios = np.sort((-poles.real / np.abs(poles))[poles.imag >= 0])
    assert np.abs(ratios - found.damping).min() < 1e-6 and found.damping > found.before
    kept = ratios[ratios < found.damping - 1e-9]  # the other modes
    assert kept.size <= 2 and np.all(kept >= 0.7 * 0.005 - 1e-9)
    assert found.loop.modulus_margin == pytest.approx(found.margin, rel=0.02)
    assert found.margin >= 0.3


@pytest.mark.long
@pytest.mark.parametrize("kind", ["ppf", "irc"])
def test_one_mode_gets_what_brute_force_finds(kind):
    """On 1 / (s^2 + 0.02 s + 1) global search over all parameters finds at most a quarter more."""
    one = fx.lti.tf([1.0], [1.0, 0.02, 1.0]).replace(inputs=["u"], outputs=["y"])
    made = fx.StandardPlant.from_statespace(one, u=["u"], y=["y"])
    found = damp_modes(made, kind, margin=0.3)
    s = 1j * np.geomspace(1e-2, 1e2, 400)
    G = 1 / (s**2 + 0.02 * s + 1)

    def missed(q):
        g, w, z = np.exp(q[0]), np.exp(q[1]), np.exp(q[2])
        own = [1 / w**2, 2 * z / w, 1] if kind == "ppf" else [1 / w, 1]
        roots = np.roots(np.polysub(np.polymul([1, 0.02, 1], own), [g]))
        if np.any(roots.real >= 0) or np.abs(1 - g * G / np.polyval(own, s)).min() < 0.3:
            return 0.0
        return -np.min(-roots.real / np.abs(roots))

    box = [(-3, 0), (-2.5, 1.5), (-2.5, -0.3)]
    best = -differential_evolution(missed, box, rng=1, maxiter=60, polish=False).fun
    assert found.damping >= 0.8 * best


@pytest.mark.slow
def test_a_stated_damping_ratio_takes_the_least_gain():
    """Half the gain is not enough, and a sampled plant reaches it as well."""
    for own in (plant(), plant(5e3)):
        found = damp_modes(own, "velocity", u="u1", damping=0.1)
        assert 0.1 <= found.damping < 0.105
    weaker = found.element.replace(gain=0.5 * found.element.gain)
    poles = by_hand(weaker, 2)
    first = poles[np.argmin(np.abs(poles - 2j * np.pi * found.freq))]
    assert -first.real / abs(first) < 0.06


@pytest.mark.slow
def test_damping_first_and_motion_after():
    """The loop of both on the machine is that of the servo on the damped plant."""
    damped = damp_modes(plant(5e3), "velocity", u="u1", damping=0.2)
    integral = -fx.Pid(0.0, i=7.5e5).sampled(5e3).system  # 3 Hz, of a compliance of 1 / (40 kN/m)
    law = integral.replace(inputs=["y1"], outputs=["u2"])
    with pytest.warns(FlexplantWarning, match="unstable"):
        fx.close_loop(plant(5e3), law, idle=["u1"])
    loop = fx.close_loop(plant(5e3), damped, law)
    inner = fx.close_loop(damped.plant, law, idle=["u1"])
    assert loop.is_stable
    assert np.sort(np.abs(loop.poles())) == pytest.approx(np.sort(np.abs(inner.poles())), abs=1e-6)


@pytest.mark.slow
def test_modes_left_out_judge_the_damper():
    """The evaluation model comes with the damped plant, its own loop closed."""
    model = fx.chain(masses=[1.0] * 3, stiffnesses=[4e4, 4e4], ground=[4e4, 0.0, 0.0])
    whole = fx.solve_modes(model, count=3, damping=fx.ModalDamping(0.005))
    made = fx.assemble_plant(whole.select([0]), plant().ports, evaluation=whole)
    found = damp_modes(made, "velocity", u="u1", damping=0.05)
    assert found.loop.left_out.is_stable
    assert found.plant.evaluation_plant.system.n_states > found.plant.system.n_states


def test_bad_input_is_refused():
    """What cannot be damped so is said with its cause."""
    free = fx.testbeds.three_masses()
    with pytest.raises(AssumptionError, match="rigid-body"):
        damp_modes(free, "irc", y="y1")
    with pytest.raises(AssumptionError, match="the most is"):
        damp_modes(free, "velocity", y="y1", damping=0.9)
    with pytest.raises(ModelError, match="mode 9 does not exist"):
        damp_modes(free, "velocity", y="y1", mode=9)
    with pytest.raises(LabelError, match="name one"):
        damp_modes(free, "velocity")
    with pytest.raises(ModelError, match="kind must be"):
        damp_modes(free, "sky hook", y="y1")
    with pytest.raises(ModelError, match="damping must"):
        damp_modes(free, "velocity", y="y1", damping=1.2)
    with pytest.raises(LabelError, match="y9"):
        damp_modes(free, "velocity", y="y9")

"""What a move leaves, against a recursion written out, and shapers on the evaluation model."""

from functools import cache

import numpy as np
import pytest

import flexplant as fx
from flexplant.errors import LabelError, ModelError
from flexplant.simulation import input_shaper, residual_vibration
from judge import closed

pytestmark = pytest.mark.slow


@cache
def loop():
    """A chain whose plant has the first two modes and whose evaluation model has all four."""
    model = fx.chain(masses=[1.0] * 4, stiffnesses=[4e4] * 3, ground=[1e3, 0, 0, 0])
    whole = fx.solve_modes(model, count=4, damping=fx.ModalDamping(0.01))
    ports = fx.Ports(
        w=[fx.Disturbance("f", at="1:x", asd=1e-3)],
        u=[fx.Actuator("u", at="1:x")],
        z=[fx.Poi("die", at="4:x", axes=("x",))],
        y=[fx.Sensor("y", at="1:x", direction="x", asd=1e-9)],
        references=[fx.Reference("die")],
    )
    plant = fx.assemble_plant(whole.select([0, 1]), ports, evaluation=whole)
    plant = plant.discretized(2e3, delay=1)
    pd = fx.lti.tustin(fx.lti.tf([60.0, 2e3], [1e-3, 1.0]), 2e3)
    both = fx.StateSpace(pd.A, np.hstack([pd.B, -pd.B]), pd.C, np.hstack([pd.D, -pd.D]), pd.dt,
                         inputs=["die:ref", "y"], outputs=["u"])  # fmt: skip
    return fx.close_loop(plant, both)


MOVE = fx.setpoint(1e-3, velocity=0.1, acceleration=10.0, jerk=1e4)


def test_predicted_and_simulated_and_by_hand():
    """Both agree with x[k+1] = A x + B w of the loop with all modes, sample by sample."""
    found = residual_vibration(loop(), MOVE)
    assert found.judged and found.predicted == pytest.approx(found.simulated, rel=1e-6)
    own = loop().around(loop().plant.evaluation_plant)
    g = own.system.select(["die:error"], ["die:ref"])
    last = int(np.ceil(MOVE.duration * 2e3 - 1e-9))
    time = np.arange(last + 4000) / 2e3
    ref, x = np.asarray(MOVE.at(time).position), np.zeros(g.n_states)
    error, states = [], []
    for r in ref:
        states.append(x)
        error.append(float(g.C[0] @ x + g.D[0, 0] * r))
        x = g.A @ x + g.B[:, 0] * r
    end = 1e-3 * (g.C @ np.linalg.solve(np.eye(len(g.A)) - g.A, g.B) + g.D)[0, 0]
    assert found.rest == pytest.approx(end, rel=1e-6)
    assert np.abs(np.array(error[last + 1 :]) - end).max() == pytest.approx(
        found.simulated, rel=1e-6
    )
    assert found.freq.size >= 4  # the truncated modes of the plant are among them
    constant = np.linalg.solve(np.eye(len(g.A)) - g.A, g.B[:, 0] * 1e-3)
    values, right = np.linalg.eig(g.A)
    parts = np.linalg.solve(right, states[last + 1] - constant)[:, None] * right.T @ g.C[0]
    real = np.abs(values.imag) < 1e-12
    slow = (values[real, None] ** np.arange(2000) * parts[real, None]).sum(axis=0)
    assert np.abs(slow).max() == pytest.approx(found.decaying, rel=1e-6)


@pytest.mark.parametrize("delay", [0.0, 1.0, 2.0, 3.5, 5.0])
def test_a_loop_with_long_delays(delay):
    """Chains of delays have no basis of eigenvectors: the sum of modes is the run all the same."""
    plant = fx.testbeds.flexible_joint(delay=delay)
    observer = fx.design_kalman(plant)
    servo = fx.design_servo(plant, bandwidth=3.0, observer=observer)
    move = fx.setpoint(1.0, velocity=2.0, acceleration=10.0, jerk=200.0)
    found = residual_vibration(fx.close_loop(plant, observer, servo), move)
    assert found.predicted == pytest.approx(found.simulated, rel=1e-6)
    A, B, C, D, inputs, outputs = closed(plant, [observer.system, servo.system])
    i, o = inputs.index("tip:ref"), outputs.index("tip:error")
    last = int(np.ceil(move.duration / plant.dt - 1e-9))
    error, x = [], np.zeros(len(A))
    for r in np.asarray(move.at(np.arange(last + 500) * plant.dt).position):
        error.append(C[o] @ x + D[o, i] * r)
        x = A @ x + B[:, i] * r
    assert np.abs(error[last + 1 :]).max() == pytest.approx(found.simulated, rel=1e-6)


@pytest.mark.parametrize("kind", ["ZV", "ZVD", "EI"])
def test_a_shaper_takes_out_of_each_mode_what_its_formula_says(kind):
    """Amplitudes with and without the shaper are in the ratio of `InputShaper.residual`."""
    plain = residual_vibration(loop(), MOVE)
    shaper = input_shaper(plain.freq[0], damping=plain.damping[0], kind=kind)
    shaped = residual_vibration(loop(), shaper.shaped(MOVE))
    assert shaped.predicted == pytest.approx(shaped.simulated, rel=1e-6)
    assert shaped.predicted < 0.4 * plain.predicted
    every = zip(plain.freq, plain.damping, plain.amplitude, strict=True)
    loud = [one for one in every if one[2] > 0.05 * plain.amplitude[0]]
    assert len(loud) >= 2
    for freq, zeta, before in loud:
        i = int(np.argmin(np.abs(shaped.freq - freq)))
        ratio = shaped.amplitude[i] / before
        # both are counted from the end of their move: each decays over the shaper's duration
        wanted = float(shaper.residual(freq, zeta)[0])
        assert abs(ratio - wanted) < 0.01 + 0.1 * wanted  # impulses fall between samples


def test_bad_input_is_refused():
    """What is needed is said."""
    with pytest.raises(ModelError, match="move must be"):
        residual_vibration(loop(), 1.0)
    with pytest.raises(LabelError, match="no reference 'mirror:ref'"):
        residual_vibration(loop(), MOVE, reference="mirror:ref")
    with pytest.raises(LabelError, match="die:y"):
        residual_vibration(loop(), MOVE, channel="die:y")
    with pytest.raises(ModelError, match="wait"):
        residual_vibration(loop(), MOVE, wait=-1.0)
    slow = fx.testbeds.three_masses(rate=None)
    law = -1e3 * fx.lti.tf([0.05, 1.0], [0.002, 1.0]).replace(inputs=["y1"], outputs=["u1"])
    with pytest.raises(ModelError, match="continuous"):
        residual_vibration(fx.close_loop(slow, law), MOVE)

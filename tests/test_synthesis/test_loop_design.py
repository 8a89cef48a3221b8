"""Loops made by hand and tuned on a frequency response alone: verified on the models behind it."""

from functools import cache

import numpy as np
import pytest
import scipy.linalg as la
from test_spill_over import many, small

import flexplant as fx
from flexplant.errors import FlexplantWarning, LabelError, ModelError, ShapeError, SolverError
from flexplant.lti import StateSpace, discretized, frequency_response
from flexplant.plant import assemble_plant, decouple
from flexplant.synthesis import Law, Lead, LowPass, Notch, Pid, design_loops, tune_loops
from flexplant.testbeds import wafer_stage
from stages import RATE, ports, reduced, sampled


def law(bandwidth=40.0, gain=1.0):
    pid = Pid.corners(
        gain * (2 * np.pi * bandwidth) ** 2 / 4,
        integrator=bandwidth / 10,
        zero=bandwidth / 4,
        pole=4 * bandwidth,
    )
    return pid * LowPass(10 * bandwidth) * Notch(458.0) * Notch(640.0)


@cache
def plant():
    return sampled(reduced(0.001))


@cache
def measured():
    """The continuous stage, its Frf on lines, and its axes."""
    continuous = assemble_plant(reduced(0.001), ports(references=[]))
    axes = decouple(continuous, bandwidth=0.01 * RATE)
    frf = frequency_response(continuous.Gyu, np.arange(2.0, 3000.0, 0.5))
    return frf, {"before": axes.accelerations, "after": axes.to_motions}


@pytest.mark.slow
def test_a_law_for_each_decoupled_axis():
    """u = -T_u diag(laws) T_y (y), the reference taken from its axis; the loop is stable."""
    P, axes = plant(), decouple(plant())
    laws = {"die:z": law(), "die:rx": law(45.0), "die:ry": law(50.0)}
    found = design_loops(P, laws, references={"die:z": "die:ref"})
    assert found.system.inputs == ("y1", "y2", "y3", "y4", "die:ref")
    assert found.system.outputs == P.u
    freq = np.array([3.0, 40.0, 900.0])
    K = frequency_response(found, freq).data
    each = [one.sampled(RATE).response(freq) for one in laws.values()]
    wanted = -np.einsum("ua,af,ay->uyf", axes.T_u, each, axes.T_y)
    np.testing.assert_allclose(K[:, :4], wanted, rtol=1e-7, atol=1e-9 * abs(wanted).max())
    reference = axes.T_u[:, :1] * each[0]
    np.testing.assert_allclose(K[:, 4], reference, rtol=1e-7, atol=1e-9 * abs(reference).max())
    loop = fx.close_loop(P, found)
    assert loop.is_stable and found.report.is_stable
    crossings = [found.report[name].crossovers[0] for name in laws]
    assert crossings == pytest.approx([40.3, 45.3, 50.4], rel=0.03)  # the plate bends


@pytest.mark.slow
def test_the_measured_plant_gives_the_same_report():
    """Lines of 0.5 Hz with the hold and the delay put on: what the model says, count included."""
    frf, axes = measured()
    states = {"rate": RATE, "delay": 1, "rigid": 3}
    model = design_loops(plant(), law()).report
    found = design_loops(frf, law(), **axes, **states).report
    assert found.is_stable
    for name, one in found.items():
        assert one.crossovers == pytest.approx(model[name].crossovers, rel=1e-3)
        assert one.phase_margin == pytest.approx(model[name].phase_margin, abs=0.2)
        assert one.gain_margin == pytest.approx(model[name].gain_margin, rel=0.02)
        assert one.modulus_margin == pytest.approx(model[name].modulus_margin, rel=5e-3)
    with pytest.warns(FlexplantWarning, match=r"unstable \(6 poles\); closest .* die:"):
        fast = design_loops(frf, law(gain=8.0), **axes, **states).report
    with pytest.warns(FlexplantWarning, match="unstable"):
        assert design_loops(plant(), law(gain=8.0)).report.unstable == fast.unstable


@pytest.mark.long
def test_modes_left_out_are_checked():
    """Tuned on 12 modes up to 1.3 kHz: the loop reaches those above."""
    P = sampled(small(12), ports(references=[]))
    gentle = Pid.corners(300.0, zero=3.0, pole=50.0) * LowPass(100.0)
    fine = design_loops(P.replace(evaluation=many()), gentle, references={"die:z": "z:ref"})
    assert fine.system.inputs[-1] == "z:ref"  # which takes no part in the loop
    assert fine.left_out is not None and fine.left_out.is_fine
    fast = tune_loops(P, notches=0)
    with pytest.warns(FlexplantWarning, match="with the modes that the plant truncates"):
        assert not design_loops(P.replace(evaluation=many()), fast.laws).left_out.is_fine
    known = tune_loops(P.replace(evaluation=many()), notches=0)
    assert known.report.is_stable
    assert min(known.left_out.modulus_margin, known.left_out.without) >= 0.5


def body(late, spring=0.0):
    """2 kg with a mode at 600 Hz of 0.1 %, sampled with some delay; free, or on a spring [Hz]."""
    w, s = 2 * np.pi * 600.0, 2 * np.pi * spring
    A = la.block_diag([[0, 1], [-(s**2), -0.02 * s]], [[0, 1], [-(w**2), -2e-3 * w]])
    G = StateSpace(A, [[0], [0.5], [0], [0.5]], [[1, 0, -0.4, 0]], [[0]], inputs=["f"])
    return discretized(G, RATE, delay=late)


@pytest.mark.long
@pytest.mark.parametrize(
    ("sign", "cases"), [(1.0, ((6, 2.0), (1, 2.0), (1, 3.0))), (-1.0, ((6, 2.0), (1, 2.0)))]
)
def test_less_delay_or_a_lower_margin_buys_bandwidth(sign, cases):
    """A plant that counts backwards is met by a law of negative gain."""
    reached = []
    for late, peak in cases:
        G = sign * body(late)
        found = tune_loops(G, peak=peak, notches=1)
        (one,) = found.report.loops
        assert 1 / peak <= one.modulus_margin < 1.05 / peak
        assert np.sign(found.laws["y1"].gain) == sign
        K = found.system
        z = np.exp(2j * np.pi * np.geomspace(5.0, 4990.0, 4000) / RATE)
        gains = [(K.evaluated(p) @ G.evaluated(p))[0, 0] for p in z]
        assert np.abs(1.0 / (1.0 - np.array(gains))).max() < peak * 1.01
        reached.append(one.crossovers[0])
    assert reached == sorted(reached)
    assert reached[1] > 1.2 * reached[0]


@pytest.mark.long
def test_on_springs_within_the_lines():
    """A suspension at 3 Hz: the model's own poles, or rigid=0 of an Frf; the same loop."""
    G = body(1, spring=3.0)
    free = tune_loops(body(1), notches=1).report["y1"].crossovers[0]
    found = tune_loops(G, notches=1)
    lines = np.geomspace(0.3, 4900.0, 9000)
    measured = tune_loops(frequency_response(G, lines), rate=RATE, hold=False, rigid=0, notches=1)
    for one in (found, measured):
        g, K = G, one.system
        A = np.block([[g.A + g.B @ K.D @ g.C, g.B @ K.C], [K.B @ g.C, K.A]])
        assert np.abs(la.eigvals(A)).max() < 1.0
        first = min(f for f in one.report["y1"].crossovers if f > 10.0)
        assert first == pytest.approx(free, rel=0.1)
    with pytest.raises(SolverError, match="rigid=0 when it is on springs"):
        tune_loops(frequency_response(G, lines), rate=RATE, hold=False)


@pytest.mark.long
def test_tuned_on_the_measured_machine_stable_on_the_truth():
    """Noise, lines of 2 Hz, a hidden mass: no model but the rigid-body axes of the drawing."""
    machine = wafer_stage()
    channels = ports(asd=1e-4, references=[])
    frf = machine.measure_frf(channels, period=0.5, periods=2, amplitude=30.0, rng=3)
    found = tune_loops(frf, **measured()[1], rate=RATE, delay=1, hold=False, notches=1)
    truth = assemble_plant(machine.truth, ports(references=[])).discretized(RATE, delay=1)
    loop = fx.close_loop(truth, found)
    assert loop.is_stable
    assert loop.modulus_margin > 0.4
    assert min(one.crossovers[0] for one in found.report.loops) > 90.0


@pytest.mark.slow
def test_what_does_not_go_together_is_refused():
    frf, axes = measured()
    with pytest.raises(LabelError, match="axis 'die:ry' has no law"):
        design_loops(plant(), {"die:z": law(), "die:rx": law()})
    with pytest.raises(LabelError, match="no axis 'z'"):
        design_loops(plant(), {"z": law()})
    with pytest.raises(ModelError, match=r"at 2000 Hz, the plant runs at 10000 Hz.*rate="):
        design_loops(plant(), law().sampled(2000.0))
    with pytest.raises(ModelError, match="4 commands act on 3 motions"):
        design_loops(frf, law(), after=axes["after"])
    with pytest.raises(ModelError, match=r"pass fx\.lti\.discretized\(plant"):
        design_loops(plant(), law(), rate=RATE)
    with pytest.raises(ModelError, match=r"is not a product of elements: 3.0.*is Pid\(gain\)"):
        design_loops(plant(), dict.fromkeys(["die:z", "die:rx", "die:ry"], 3.0))
    mass = StateSpace([[0, 1.0], [0, 0]], [[0], [1.0]], [[1.0, 0]], [[0]], inputs=["f"])
    with pytest.warns(FlexplantWarning, match=r"\(2 poles\) at 0.1592 Hz. Check sign"):
        design_loops(mass, Pid(1.0))
    assert "not the plant but the last line" in repr(tune_loops(mass))  # nothing limits it
    with pytest.raises(ModelError, match="after has states"):
        design_loops(mass, Pid(40.0), after=LowPass(9.0).system.replace(inputs=["y1"]))
    with pytest.raises(ShapeError, match="before has 2 channels at the plant, which has 1"):
        tune_loops(mass, before=np.eye(2))
    with pytest.warns(FlexplantWarning, match="unstable"):
        assert "does not cross 1" in repr(design_loops(mass, Pid(0.0)))
    few = design_loops(fx.Frf([10.0, 20.0], np.ones((1, 1, 2))), Pid(1.0), rate=100.0).report
    assert "2 lines are too few" in few.reason
    held = design_loops(mass, Pid(40.0) * Lead(1.0)).report  # no hidden integrator
    assert held.is_stable
    assert held["y1"].gain_reduction == 0.0
    with pytest.raises(ModelError, match="above 1"):
        tune_loops(frf, **axes, peak=1.0)
    late = frf.replace(data=frf.data * np.exp(-2j * np.pi * frf.freq * 0.1))
    with pytest.raises(
        SolverError, match=r"axis 'die:z': no bandwidth from 8 to .* raise the rate"
    ):
        tune_loops(late, **axes, rate=RATE)
    assert Law().system.n_states == 0

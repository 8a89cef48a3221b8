"""Loops shaped by hand: elements against their formulas, the value, its script and its files."""

import numpy as np
import pytest

import flexplant as fx
from flexplant.errors import LabelError, ModelError, ShapeError
from flexplant.synthesis import FixedBlock, Integrator, Lag, LoopDesign, LowPass, Pid, ShapedAxis

FREQ = np.geomspace(0.1, 900.0, 60)
S = 2j * np.pi * FREQ
MASS = fx.lti.tf([1.0], [1.0, 0.0, 0.0]).replace(inputs=["u1"], outputs=["y1"])


def response(law):
    """The response of a system's own matrices, by solving at each frequency."""
    g = law.system
    z = np.exp(S * g.dt) if g.dt else S
    eye = np.eye(g.n_states)
    return np.array([(g.C @ np.linalg.solve(p * eye - g.A, g.B) + g.D)[0, 0] for p in z])


def tustin(rate):
    z = np.exp(S / rate)
    return 2.0 * rate * (z - 1.0) / (z + 1.0)


def test_elements_follow_their_formulas():
    w = 2.0 * np.pi * 40.0
    p = S / w
    q = p / 1.3
    for element, wanted in (
        (Lag(40.0, 5.0), (p + 1.0) / (p + 0.2)),
        (Integrator(40.0), 1.0 + w / S),
        (fx.Notch(40.0, 0.1, 0.2, skew=1.3), (p**2 + 0.04 * p + 1) / (q**2 + 0.4 * q + 1)),
    ):
        np.testing.assert_allclose(response(element), wanted, rtol=1e-12)
        np.testing.assert_allclose(element.law.response(FREQ), wanted, rtol=1e-12)
    assert repr(fx.Notch(40.0, skew=1.3)).endswith("skew=1.3)")


def test_a_pid_by_its_corners_and_back():
    for corners in (
        {"gain": 3.0, "integrator": 2.0, "zero": 10.0, "pole": 100.0},
        {"gain": -3.0, "integrator": 0.0, "zero": 10.0, "pole": 100.0},
        {"gain": 3.0, "integrator": 2.0, "zero": None, "pole": None},
    ):
        back = Pid.corners(**corners).as_corners()
        for name, value in corners.items():
            assert back[name] == (value if value is None else pytest.approx(value, abs=1e-12))
    assert Pid(1.0, i=1e4, d=0.1, pole=100.0).as_corners() is None  # complex zeros
    assert Pid(-1.0, i=1.0).as_corners() is None


def test_a_block_is_what_it_was_continuous_and_sampled():
    own = fx.lti.tf([1.0, 200.0], [1.0, 30.0, 1e5])
    wanted = (S + 200.0) / (S**2 + 30.0 * S + 1e5)
    law = FixedBlock(own) * LowPass(300.0, order=1) * 2.0
    np.testing.assert_allclose(
        law.response(FREQ), 2.0 * wanted / (1.0 + S / (600.0 * np.pi)), rtol=1e-12
    )
    a = tustin(2e3)
    np.testing.assert_allclose(
        response(FixedBlock(own).sampled(2e3)), (a + 200.0) / (a**2 + 30.0 * a + 1e5), rtol=1e-9
    )
    sampled = fx.lti.discretized(own, 2e3)
    block = FixedBlock.of(sampled, label="filter")
    assert block.own_rate == 2e3
    np.testing.assert_allclose(response(block), fx.frequency_response(sampled, FREQ).data[0, 0])
    np.testing.assert_allclose(block.law.response(FREQ), response(block), rtol=1e-9)
    with pytest.raises(ModelError, match="sampled at 2000 Hz, the law runs at 1000 Hz"):
        block.sampled(1e3)
    with pytest.raises(ShapeError, match="one input and one output"):
        FixedBlock(fx.lti.append(own, own.replace(inputs=["b"], outputs=["c"])))


@pytest.fixture(scope="module")
def design():
    block = FixedBlock(fx.lti.tf([1.0], [1e-4, 1.0]), "filter")
    elements = [Pid(2e4), fx.Lead(60.0), fx.Notch(0.3e3, skew=1.1), block, Integrator(4.0)]
    first = ShapedAxis(elements, 1.1, on=[True, True, False, True, True], feedforward=[0, 0, 2.0])
    second = ShapedAxis([Pid(1e4), fx.Lead(30.0)])
    before, after = [[0.5, 0.5], [0.5, -0.5]], [[1.0, 1.0], [1.0, -1.0]]
    return LoopDesign(
        {"z": first, "r": second}, before, after, 5e3, 1.0, True, 2, references={"r": "r:set"}
    )


@pytest.fixture(scope="module")
def frf():
    freq = np.linspace(2.0, 2000.0, 1000)
    G = 1.0 / (2j * np.pi * freq) ** 2
    ends = np.array([[0.5, 0.5], [0.5, -0.5]])
    return fx.Frf(freq, np.einsum("yu,f->yuf", ends @ np.diag([1.0, 1.2]) @ ends * 2.0, G))


def test_what_is_off_takes_no_part(design, frf):
    """The loops are those of design_loops with the elements that are on."""
    z = Pid(2e4) * fx.Lead(60.0) * design.axes["z"].elements[3] * Integrator(4.0) * 1.1
    laws = {"z": z, "r": Pid(1e4) * fx.Lead(30.0)}
    sides = {"before": design.before, "after": design.after}
    other = fx.design_loops(frf, laws, **sides, rate=5e3, delay=1.0, rigid=2)
    found = design.loops(frf)
    assert repr(found.report) == repr(other.report)
    assert found.report.is_stable
    assert np.array_equal(found.system.A, other.system.A)
    assert LoopDesign.on(frf, design.axes, **sides, rate=5e3, delay=1.0).rigid == 2


def test_references_and_feedforward(design):
    controller = design.controller()
    assert controller.inputs == ("y1", "y2", "z:ref", "r:set", "z:ref:acceleration")
    np.testing.assert_allclose(controller.D[:, -1], [1.0, 1.0])  # 2 times the column of `before`
    error = controller.select(inputs=["y1", "r:set"])
    np.testing.assert_allclose(error.B[:, 1], -(controller.B[:, 0] - controller.B[:, 1]) / 2)


def test_script_file_and_digest(design, frf, tmp_path):
    made = {}
    exec(design.script(), made)
    design.save(tmp_path / "design.npz")
    loaded = fx.load(tmp_path / "design.npz")
    for other in (made["design"], loaded):
        one, two = design.controller(), other.controller()
        assert all(np.array_equal(getattr(one, m), getattr(two, m)) for m in "ABCD")
        assert (one.inputs, one.outputs, one.dt) == (two.inputs, two.outputs, two.dt)
        assert repr(other) == repr(design)
    lines = design.script('plant = fx.load("stage.npz")').splitlines()
    assert lines[-2:] == ['plant = fx.load("stage.npz")', "print(design.loops(plant))"]
    single = frf.select(["y1"], ["u1"])
    on = LoopDesign.on(single, rate=5e3)
    assert on.is_made_on(single)
    assert not on.is_made_on(single * 1.0000001)


def test_wrong_designs_are_refused(design, frf):
    with pytest.raises(ShapeError, match="2 elements, got 1"):
        ShapedAxis([Pid(1.0), Integrator(1.0)], on=[True])
    with pytest.raises(ModelError, match="an element"):
        ShapedAxis(["Pid"])
    with pytest.raises(LabelError, match="the axes are z"):
        LoopDesign({"z": ShapedAxis()}, after=design.after)
    with pytest.raises(ModelError, match=r"axis 'z': .*LowPass.freq=3000 Hz.* is at 3000 Hz"):
        _ = design.with_axis("z", ShapedAxis([LowPass(3e3)])).laws
    with pytest.raises(LabelError, match="axis"):
        design.with_axis("x", ShapedAxis())
    with pytest.raises(ModelError, match="runs at 5000 Hz, the plant is continuous"):
        design.loops(fx.lti.append(MASS, MASS.replace(inputs=["u2"], outputs=["y2"])))

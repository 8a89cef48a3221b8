"""MachinePipeline takes what its parts take: delays, evaluation models, damping of large ones."""

from functools import cache

import numpy as np
import pytest

import flexplant as fx
from flexplant.errors import ModelError
from flexplant.identification import MeasuredModes
from flexplant.simulation import MachinePipeline

LAW = fx.ModalDamping(0.02)
PORTS = fx.testbeds.three_masses().assembled.ports
PLACES = ["1:x", "2:x", "3:x"]


@cache
def bare(count=4):
    """Return a free chain; the further masses are light and stiff, so that they hardly move."""
    light = count - 3
    masses, springs = [1.0] * 3 + [0.1 / light] * light, [4e5] * 2 + [1e7 * light] * light
    return fx.chain(masses=masses, stiffnesses=springs)


@cache
def machine(added):
    """Return the measured elastic modes of a chain with more mass at 3:x."""
    heavier = bare().replace(M=bare().M.toarray() + np.diag([0.0, 0.0, added, 0.0]))
    return MeasuredModes(fx.solve_modes(heavier, count=3, damping=LAW).poles[-2:], modes=[2, 3])


def pipeline(**changes):
    drawing = bare().with_damping(LAW)
    rom = fx.reduce(fx.solve_modes(drawing, count=3), fx.DesiredDofs(PLACES))
    options = {"full": drawing, "rate": 2e3, "delay": 1, "bandwidth": 5.0, "duration": 0.05}
    return MachinePipeline(rom, parameters=[fx.AddedMass("3:x")], ports=PORTS, **options | changes)


def close(one, other):
    assert one.keys() == other.keys()
    for name in one.keys() - {"warnings"}:
        assert one[name] == pytest.approx(other[name], rel=1e-5, abs=0, nan_ok=True), name


@pytest.mark.long
def test_modes_and_reduced_models_are_updated_as_the_drawing_is():
    """With all modes of the drawing the rows are the same, attachment vectors included."""
    drawing = bare().with_damping(LAW)
    every = fx.solve_modes(drawing)
    with_vector = fx.solve_modes(bare(), count=3, damping=LAW, compliance_at="3:x")
    rom = fx.reduce(every, fx.reduction.ModalTruncation(2))
    expected = pipeline()(machine(0.1), 1)
    assert expected["mass at 3:x"] == pytest.approx(0.1, rel=0.1)
    assert expected["stable"]
    for full in (every, rom):
        close(pipeline(full=full)(machine(0.1), 1), expected)
    near = pipeline(full=with_vector).report(machine(0.1), 1).left_out
    assert near.modulus_margin == pytest.approx(expected["margin expected"], rel=1e-2)


@pytest.mark.slow
def test_the_report_holds_the_run_against_the_model():
    """Power around each mode beside the predicted; a run that is too short says so."""
    short, longer = (pipeline(duration=t).report(machine(0.1), 1) for t in (0.05, 1.0))
    assert "The run beside the model\n  not judged: " in repr(short)
    assert longer.agreement.holds
    assert set(longer.agreement.spectra) == {2, 3}
    assert "The run beside the model\n  <ConsistencyReport at 95 %" in repr(longer)


@pytest.mark.slow
def test_damping_in_place_of_a_matrix():
    same = pipeline(full=bare(), damping=LAW)
    close(same(machine(0.0), 1), pipeline()(machine(0.0), 1))
    more = pipeline(full=bare(), damping=fx.ModalDamping(0.1)).report(machine(0.0), 1)
    rates = [
        np.trace(one.loop.plant.modal_blocks[-1]) for one in (more, same.report(machine(0.0), 1))
    ]
    assert rates[0] == pytest.approx(5.0 * rates[1])  # of the mode that was not measured
    with pytest.raises(ModelError, match=r"with damping=, full must be .*FEModel"):
        pipeline(full=fx.solve_modes(bare(), damping=LAW), damping=LAW)
    with pytest.raises(ModelError, match=r"damping must be .*Pass ModalDamping\(0.01\)"):
        pipeline(damping=0.01)


@pytest.mark.long
def test_damping_of_a_model_that_is_large():
    """A matrix D would be full; what is light and stiff hardly changes anything."""
    large = bare(5002)
    with pytest.raises(ModelError, match="too large for 5002 DOFs"):
        large.with_damping(LAW)
    rows = [
        pipeline(full=large, damping=LAW, evaluation_modes=4)(machine(0.1), 1),
        pipeline(full=fx.solve_modes(large, count=4, damping=LAW))(machine(0.1), 1),
    ]
    for row in rows:
        assert row["stable"]
        assert row["modulus margin"] == pytest.approx(
            pipeline()(machine(0.1), 1)["modulus margin"], rel=0.05
        )


@pytest.mark.slow
def test_delays_of_a_fraction_of_a_sample():
    report = pipeline(delay=1.5).report(machine(0.1), 1)
    assert report.observer.plant.delay == 1.5
    blocks = report.blocks
    margins = [
        pipeline(delay=d, blocks=blocks)(machine(0.1), 1)["modulus margin"] for d in (1, 1.5, 2)
    ]
    assert margins == sorted(margins, reverse=True)
    assert margins[0] > margins[1] > margins[2]
    with pytest.raises(ModelError, match="delay must be zero or positive"):
        pipeline(delay=-0.5)

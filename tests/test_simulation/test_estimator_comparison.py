"""What estimators predict beside what runs show, on a machine that differs from the model."""

import numpy as np
import pytest

from flexplant import load
from flexplant.errors import LabelError, ModelError
from flexplant.estimation import design_kalman, design_static
from flexplant.loop import close_loop
from flexplant.lti import StateSpace
from flexplant.simulation import compare_estimators, reading_along, simulate
from flexplant.synthesis import design_servo
from stages import reduced, sampled


@pytest.fixture(scope="module")
def made():
    plant = sampled(reduced(0.01))
    designs = {"static": design_static(plant), "filter": design_kalman(plant)}
    servo = design_servo(plant, bandwidth=10.0, observer=designs["static"])
    loop = close_loop(plant, designs["static"], servo, *reading_along(designs))
    return designs, simulate(loop, duration=0.6, rng=4, runs=4)


@pytest.mark.slow
def test_errors_are_those_of_the_run(made, tmp_path):
    designs, run = made
    found = compare_estimators(designs, run, "die:z", start=0.2, level=0.9)
    late = run.time >= 0.2 - 1e-9
    for name, design in designs.items():
        predicted, measured, low, high = found[name]
        error = (run["die:z"] - run[f"{name}|die:hat"])[:, late]
        assert predicted == design.rms("die:z")
        assert measured == pytest.approx(np.sqrt(np.mean(error**2)), rel=1e-12, abs=0)
        assert low < measured < high
    # the filter knows this plant: its prediction holds (99.9 % of 4 x 0.4 s of a slow error)
    assert found["filter"][1] == pytest.approx(found["filter"][0], rel=0.25, abs=0)
    lines = repr(found).splitlines()
    assert lines[0] == "rms error of the estimate of die:z [nm]"
    assert "90% interval" in lines[1]
    assert f"{1e9 * found['filter'][1]:.3f}" in lines[3]
    found.save(tmp_path / "errors.npz")
    assert repr(load(tmp_path / "errors.npz")) == repr(found)
    assert "[nrad]" in repr(compare_estimators(designs, run, "die:rx", start=0.2))


def test_wrong_use_is_refused(made):
    designs, run = made
    with pytest.raises(ModelError, match="designs must be a mapping"):
        reading_along([designs["static"]])
    with pytest.raises(ModelError, match="must be of type KalmanEstimator or"):
        reading_along({"block": StateSpace([], [], [], [[1.0]])})
    with pytest.raises(LabelError, match=r"'other\|die:hat'.*reading_along"):
        compare_estimators({"other": designs["static"]}, run, "die:z")
    with pytest.raises(ModelError, match="run must be of type Response"):
        compare_estimators(designs, dict(run), "die:z")
    with pytest.raises(ModelError, match="scatter between runs"):
        compare_estimators(designs, run.replace(data=run.data[:1]), "die:z")
    with pytest.raises(LabelError, match="no estimator 'filters'"):
        compare_estimators(designs, run, "die:z")["filters"]

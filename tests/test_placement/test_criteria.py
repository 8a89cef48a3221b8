"""Criteria against recursions run to their end, and what they refuse."""

import numpy as np
import pytest

from flexplant import load
from flexplant.errors import AssumptionError, LabelError, ModelError
from flexplant.estimation import design_kalman
from flexplant.placement import Exchange, PoiLqr, PoiVariance, place_sensors, score_sensors
from flexplant.plant import Sensor, StandardPlant
from flexplant.reduction import ModalTruncation, reduce
from oracles_placement import kalman_variance, lqr_cost
from stages import ports, sampled, some_modes


def matrices(plant, axes):
    g = plant.system
    rows = g.C[g.output_index([f"die:{axis}" for axis in axes])]
    return g.A, plant.B2, plant.C2, plant.process_noise, plant.sensor_noise, rows


@pytest.mark.slow
@pytest.mark.parametrize("seed", [1, 2])
@pytest.mark.parametrize("axes", [None, "rx", {"z": 1.0, "ry": 0.05}])
def test_variance_is_that_of_the_recursion(make, seed, axes):
    plant, _, _ = make(seed, delay=0.0)
    named = {None: {"z": 1.0}, "rx": {"rx": 1.0}}.get(axes if isinstance(axes, str) else None)
    named = dict(axes) if isinstance(axes, dict) else named
    A, _, C, Q, R, rows = matrices(plant, named)
    rows = rows * np.array(list(named.values()))[:, None]
    expected = kalman_variance(A, C, Q, R, rows)
    assert PoiVariance("die", axes)(plant) == pytest.approx(expected, rel=1e-8, abs=0.0)


@pytest.mark.slow
@pytest.mark.parametrize("delay", [0.0, 1.0, 2.0, 0.4, 1.6])
def test_cost_is_that_of_the_recursion(make, delay):
    plant, _, _ = make(3, delay=delay)
    A, B, _, W, _, rows = matrices(plant, ("z", "rx", "ry"))
    expected = lqr_cost(A, B, W, rows, 1e-8)
    assert PoiLqr("die", effort=1e-8)(plant) == pytest.approx(expected, rel=1e-8, abs=0.0)


def test_a_factor_scales_a_rotation(make):
    plant, _, _ = make(1)
    assert PoiVariance("die", {"rx": 2.0})(plant) == pytest.approx(
        4 * PoiVariance("die", "rx")(plant), rel=1e-12, abs=0.0
    )
    z, rx = (PoiVariance("die", axis)(plant) for axis in ("z", "rx"))
    assert PoiVariance(axes=("z", "rx"))(plant) == pytest.approx(z + rx, rel=1e-12, abs=0.0)


def test_refusals_name_the_motion(make):
    plant, sensors, actuators = make(1)
    blind = plant.with_ports(plant.assembled.ports.replace(y=sensors[:2]))
    with pytest.raises(AssumptionError, match="y does not see the rigid-body"):
        PoiVariance("die")(blind)
    weak = plant.with_ports(plant.assembled.ports.replace(u=actuators[:2]))
    with pytest.raises(AssumptionError, match="u does not reach the rigid-body"):
        PoiLqr("die")(weak)
    with pytest.raises(AssumptionError, match=r"z does not see the rigid-body.*rotation"):
        PoiLqr("die", "z")(plant)
    still = plant.with_ports(plant.assembled.ports.replace(w=plant.assembled.ports.w[:2]))
    for criterion in (PoiVariance("die"), PoiLqr("die")):
        with pytest.raises(AssumptionError, match="w does not excite the rigid-body"):
            criterion(still)


def test_bad_input(make):
    plant, _, _ = make(1)
    with pytest.raises(LabelError, match="no POI 'dye'"):
        PoiVariance("dye")(plant)
    with pytest.raises(LabelError, match="axis of POI 'die' 'x'"):
        PoiVariance("die", "x")(plant)
    with pytest.raises(LabelError, match="twice"):
        PoiVariance("die", ("z", "z"))
    with pytest.raises(LabelError, match="nothing to sum"):
        PoiVariance("die", ())
    with pytest.raises(ModelError, match="factor of axis 'rx'"):
        PoiVariance("die", {"rx": -1.0})
    with pytest.raises(ModelError, match="effort must be positive"):
        PoiLqr(effort=0.0)
    bare = StandardPlant.from_statespace(plant.system, w=plant.w, u=plant.u, z=plant.z, y=plant.y)
    with pytest.raises(ModelError, match="no noise density"):
        PoiVariance("die")(bare)


@pytest.mark.parametrize(
    "criterion",
    [PoiVariance(), PoiVariance("die", "z"), PoiLqr("die", {"z": 1.0, "rx": 0.1}, effort=1e-8)],
    ids=repr,
)
def test_criteria_are_values(criterion, tmp_path):
    criterion.save(tmp_path / "c.npz")
    assert repr(load(tmp_path / "c.npz")) == repr(criterion)


@pytest.mark.slow
def test_modes_left_out_count_as_in_the_filter():
    """The score of a choice is the claim of the filter on a plant assembled with these sensors."""
    many = some_modes(count=40, attached=False)
    few = many.select(range(12))
    plant, own = sampled(few).replace(evaluation=many), ports().y
    goal, candidates = PoiVariance("die"), [*own, Sensor("mid", at=(0.3, 0.0, 0.0))]
    candidates[-1] = candidates[-1].replace(asd=own[0].asd)
    names = [sensor.name for sensor in candidates]
    sets = [names[:3], names[:4], names]
    found = score_sensors(plant, sets, goal, candidates=candidates)
    for layout, value in zip(found.layouts, found.values, strict=True):
        chosen = ports(y=[s for s in candidates if s.name in layout])
        claim = design_kalman(sampled(few, chosen).replace(evaluation=many)).rms("die")
        assert np.sqrt(value) == pytest.approx(claim, rel=1e-9, abs=0.0)
        on = design_kalman(sampled(few, chosen).replace(evaluation=many)).rms(
            "die", on=sampled(many, chosen)
        )
        assert claim == pytest.approx(on, rel=1e-9, abs=0.0)
    alone = score_sensors(plant, sets, PoiVariance("die", own_modes=True), candidates=candidates)
    assert alone.values[0] < 0.5 * found.values[0]
    # a reduced model's own truncated modes count by default, and no bound is claimed
    reduced = reduce(many, ModalTruncation(12))
    default = sampled(reduced)
    judged = goal(default.replace(evaluation=many))
    assert goal(default) == pytest.approx(judged, rel=1e-9, abs=0.0)
    search = Exchange(starts=1)
    best = place_sensors(default, candidates, 4, PoiVariance("die"), method=search, rng=1)
    assert best.bound == -np.inf and "no bound" in repr(best)

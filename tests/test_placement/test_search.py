"""Search: as good as every subset, bounded from below, feasible or refused by name."""

from concurrent.futures import ThreadPoolExecutor
from math import comb

import numpy as np
import pytest

from flexplant import load
from flexplant.errors import AssumptionError, InfeasibleError, LabelError, ModelError
from flexplant.placement import (
    BranchAndBound,
    Exchange,
    Exhaustive,
    PoiLqr,
    PoiVariance,
    place_actuators,
    place_sensors,
)
from flexplant.placement.problem import layouts_of
from flexplant.plant import Sensor
from oracles_placement import best_subset

CASES = [(seed, n, k) for seed, n, k in ((11, 9, 3), (12, 9, 5), (13, 10, 4), (14, 12, 4))]


@pytest.mark.slow
@pytest.mark.parametrize(("seed", "total", "count"), CASES)
def test_sensors_equal_every_subset_and_the_bound_bounds(make, seed, total, count):
    plant, sensors, _ = make(seed, count=total)
    criterion = PoiVariance("die")
    layouts = layouts_of(plant, "y", sensors, criterion)
    best, values = best_subset(count, total, lambda chosen: layouts.score([chosen])[0])
    assert len(values) == comb(total, count) <= 1500
    found = place_sensors(plant, sensors, count, criterion, method=Exchange(), rng=seed)
    assert found.chosen == tuple(f"s{i}" for i in best)
    assert found.value == values[best]
    assert found.bound <= values[best]
    assert layouts.scorer.bound(count, ()) <= values[best]
    # sharper than all candidates at once, which bounds as well
    everything = layouts.score([range(total)])[0]
    assert everything < found.bound
    assert found.bound > 0.5 * found.value
    assert found.evaluations < 5 * len(values)
    assert found.value == pytest.approx(criterion(found.on(plant)), rel=1e-9, abs=0.0)


@pytest.mark.slow
@pytest.mark.parametrize(
    ("seed", "total", "count", "delay"), [(*CASES[0], 0.4), (*CASES[1], 1.0), (*CASES[2], 0.4)]
)
def test_actuators_equal_every_subset_and_the_bound_bounds(make, seed, total, count, delay):
    plant, _, actuators = make(seed, count=total, delay=delay)
    criterion = PoiLqr("die", effort=1e-8)
    layouts = layouts_of(plant, "u", actuators, criterion)
    best, values = best_subset(count, total, lambda chosen: layouts.score([chosen])[0])
    found = place_actuators(plant, actuators, count, criterion, method=Exchange(), rng=seed)
    assert found.value == values[best]
    assert found.chosen == tuple(f"a{i}" for i in best)
    assert layouts.score([range(total)])[0] <= layouts.scorer.bound(count, ()) <= values[best]
    assert 0.3 * found.value < found.bound <= found.value
    assert found.value == pytest.approx(criterion(found.on(plant)), rel=1e-6, abs=0.0)


@pytest.mark.slow
def test_exchanges_score_only_what_a_bound_leaves(make, monkeypatch):
    """The tangent at a choice excludes most of the exchanges; the answer is the same."""
    plant, sensors, _ = make(5, count=36)
    bounded = place_sensors(plant, sensors, 4, method=Exchange(starts=2), rng=0)
    every_one = "flexplant.placement.branch_and_bound._Run._promising"
    monkeypatch.setattr(every_one, lambda run, trials, *_: run._values(trials))
    every = place_sensors(plant, sensors, 4, method=Exchange(starts=2), rng=0)
    assert bounded.chosen == every.chosen
    assert bounded.history == every.history
    assert bounded.evaluations < 0.7 * every.evaluations


def test_exhaustive_is_every_subset(make):
    plant, sensors, _ = make(11, count=9)
    layouts = layouts_of(plant, "y", sensors, PoiVariance())
    best, values = best_subset(4, 9, lambda chosen: layouts.score([chosen])[0], required=(2, 5))
    found = place_sensors(plant, sensors, 4, method=Exhaustive(), required=["s2", "s5"])
    assert found.chosen == tuple(f"s{i}" for i in best)
    assert (found.value, found.bound) == (values[best], values[best])
    assert found.evaluations == comb(7, 2)
    assert "the optimum" in repr(found)
    with pytest.raises(ModelError, match="126 subsets"):
        place_sensors(plant, sensors, 4, method=Exhaustive(limit=125))


@pytest.mark.slow
def test_required_candidates_stay(make):
    plant, sensors, _ = make(13, count=10)
    free = place_sensors(plant, sensors, 4, rng=0)
    out = next(s.name for s in sensors if s.name not in free.chosen)
    found = place_sensors(plant, sensors, 4, required=[out], rng=0)
    proven = place_sensors(plant, sensors, 4, required=[out], method=Exhaustive())
    assert out in found.chosen
    assert len(found.chosen) == 4
    assert found.chosen == proven.chosen
    assert found.bound <= proven.value
    assert found.value > free.value
    everything = place_sensors(plant, sensors[:4], 4)
    assert everything.chosen == ("s0", "s1", "s2", "s3")
    assert everything.bound == pytest.approx(everything.value, rel=1e-8, abs=0.0)
    fixed = place_sensors(plant, sensors, 3, required=["s0", "s1", "s2"])
    assert fixed.chosen == ("s0", "s1", "s2")


def test_the_slope_of_the_relaxation_is_its_derivative(make):
    plant, sensors, _ = make(12)
    problem = layouts_of(plant, "y", sensors, PoiVariance("die", ("z", "rx"))).scorer
    weights = np.random.default_rng(0).uniform(0.2, 1.0, len(sensors))
    _, fall = problem.tangent(weights).fall(weights)
    for i in range(len(sensors)):
        h = np.zeros_like(weights)
        h[i] = 1e-4
        slope = (problem.cost(weights + h) - problem.cost(weights - h)) / 2e-4
        assert -fall[i] == pytest.approx(slope, rel=1e-5, abs=0.0)


@pytest.mark.slow
def test_a_plain_callable(make):
    plant, sensors, _ = make(11)

    def to_the_left(sampled):
        return sum(sensor.at[0] for sensor in sampled.assembled.ports.y)

    found = place_sensors(plant, sensors, 3, to_the_left, method=Exchange(starts=2), rng=0)
    proven = place_sensors(plant, sensors, 3, to_the_left, method=Exhaustive())
    assert found.chosen == proven.chosen
    left = sorted(sensors, key=lambda s: s.at[0])[:3]
    assert set(found.chosen) == {s.name for s in left}
    assert found.bound == -np.inf
    assert "no bound" in repr(found)
    assert len(found.history) == 2
    assert all(np.all(np.diff(steps) < 0) for steps in found.history)


@pytest.mark.slow
def test_sensors_in_a_row_are_refused_with_the_motion_named(make):
    plant, sensors, _ = make(11)
    row = [Sensor(f"r{i}", at=(0.05 * i, 0.175, 0.0), asd=1e-13) for i in range(8)]
    with pytest.raises(AssumptionError, match="rotation rx"):
        place_sensors(plant, row, 4)
    with pytest.raises(InfeasibleError, match="of the nearest one: y does not see the rigid-body"):
        place_sensors(plant, sensors, 2)
    with pytest.raises(InfeasibleError, match="rigid-body"):
        place_sensors(plant, [*row, *sensors], 3, required=["r0", "r1", "r2"])
    # though far better sensors, no three of the row alone will ever be chosen
    found = place_sensors(plant, [*row, sensors[0]], 3, rng=1)
    assert "s0" in found.chosen
    proven = place_sensors(plant, [*row, sensors[0]], 3, method=Exhaustive())
    assert found.value == pytest.approx(proven.value, rel=1e-9, abs=0.0)


def test_actuators_in_a_row_are_refused_with_the_motion_named(make):
    plant, _, actuators = make(11)
    row = [a.replace(name=f"r{i}", at=(0.1 * i, 0.175, 0.0)) for i, a in enumerate(actuators[:5])]
    with pytest.raises(AssumptionError, match=r"u does not reach the rigid-body.*rotation rx"):
        place_actuators(plant, row, 4)


def test_a_criterion_without_finite_values(make):
    plant, sensors, _ = make(11)
    with pytest.raises(InfeasibleError, match="the criterion is infinite"):
        place_sensors(plant, sensors[:5], 3, lambda p: np.inf, method=Exchange(starts=1))


@pytest.mark.slow
def test_threads_give_the_same_to_the_bit(make, send_everything):
    plant, sensors, _ = make(12)
    for method in (Exchange(starts=4), BranchAndBound(starts=2)):
        serial = place_sensors(plant, sensors, 4, method=method, rng=5)
        with ThreadPoolExecutor(2) as pool:
            other = place_sensors(plant, sensors, 4, method=method, rng=5, executor=pool)
        assert serial._fields() | {"ports": 0} == other._fields() | {"ports": 0}


def test_few_subsets_are_all_scored_unless_told_otherwise(make):
    plant, sensors, _ = make(12)
    found = place_sensors(plant, sensors[:8], 3)
    assert found.evaluations == comb(8, 3)
    assert found.bound == found.value


@pytest.mark.slow
def test_seeds_repeat(make):
    plant, sensors, _ = make(12)
    first, again, other = (
        place_sensors(plant, sensors, 4, method=Exchange(), rng=seed).history for seed in (1, 1, 2)
    )
    assert first == again
    assert first[0] == other[0]  # the greedy start is no matter of chance
    assert first != other


@pytest.mark.slow
def test_placements_are_saved(make, tmp_path):
    plant, sensors, _ = make(12)
    found = place_sensors(plant, sensors, 4, lambda p: float(p.assembled.ports.y[0].at[0]), rng=3)
    found.save(tmp_path / "best.npz")
    again = load(tmp_path / "best.npz")
    assert repr(again) == repr(found)
    assert again.on(plant).y == found.on(plant).y == found.chosen
    assert again.history == found.history


def test_bad_input(make):
    plant, sensors, actuators = make(12)
    for count in (0, 10, 2.5, True):
        with pytest.raises(ModelError, match="count must be"):
            place_sensors(plant, sensors, count)
    with pytest.raises(ModelError, match="count is 3, and 4 candidates are required"):
        place_sensors(plant, sensors, 3, required=["s0", "s1", "s2", "s3"])
    with pytest.raises(LabelError, match="required candidate 's99'"):
        place_sensors(plant, sensors, 3, required=["s99"])
    with pytest.raises(LabelError, match="listed twice"):
        place_sensors(plant, [*sensors, sensors[0]], 3)
    with pytest.raises(ModelError, match="candidates are Actuators"):
        place_actuators(plant, sensors, 3)
    with pytest.raises(ModelError, match="candidates are Sensors"):
        place_sensors(plant, actuators, 3)
    with pytest.raises(ModelError, match="method must be"):
        place_sensors(plant, sensors, 3, method="exchange")
    with pytest.raises(ModelError, match="starts must be"):
        Exchange(starts=0)
    with pytest.raises(ModelError, match="continuous"):
        place_sensors(plant.continuous, sensors, 3)

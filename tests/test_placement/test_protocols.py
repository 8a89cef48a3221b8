"""A new criterion and a new search are one class each: nothing else is changed for them."""

from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from itertools import combinations

import numpy as np
import pytest

from flexplant.errors import ModelError
from flexplant.placement import (
    Criterion,
    Exchange,
    Scorer,
    Search,
    SearchResult,
    place_actuators,
    place_sensors,
    score_sensors,
)


class Additive(Scorer):
    """Scores that are sums over the chosen: all sets at once, and an exact bound."""

    def __init__(self, worth):
        self.worth, self.calls = np.asarray(worth), 0

    def score(self, sets):
        self.calls += 1
        return np.array([-self.worth[list(chosen)].sum() for chosen in sets])

    def bound(self, count, required):
        free = np.delete(self.worth, required)
        return -(
            self.worth[list(required)].sum() + np.sort(free)[::-1][: count - len(required)].sum()
        )


@dataclass(frozen=True, eq=False)
class Precision(Criterion):
    """Minus the sum of 1/asd^2: a vectorised criterion with a bound."""

    sides = "y"

    def __call__(self, plant):
        return -sum(worth(sensor) for sensor in plant.assembled.ports.y)

    def scorer(self, plant, candidates):
        return Additive([worth(sensor) for sensor in candidates])


def worth(sensor):
    return (1e-11 / sensor.asd) ** 2


@dataclass(frozen=True, eq=False)
class Drawn(Search):
    """The best of a few random choices."""

    draws: int = 30

    def search(self, problem, work):
        random = np.random.default_rng(work.rng)
        total = len(problem.layouts.candidates)
        sets = [
            tuple(random.choice(total, problem.count, replace=False)) for _ in range(self.draws)
        ]
        values = problem.layouts.scores(sets, work)
        best = int(np.argmin(values))
        value = float(values[best])
        return SearchResult(sets[best], value, problem.bound(), len(sets), ((value,),))


def test_a_criterion_with_a_scorer_of_its_own(make):
    plant, sensors, actuators = make(11, count=9)
    found = place_sensors(plant, sensors, 4, Precision(), method=Exchange(starts=3), rng=1)
    truth = {chosen: -sum(map(worth, chosen)) for chosen in combinations(sensors, 4)}
    scores = score_sensors(plant, list(truth), Precision())
    for value, chosen in zip(scores.values, scores.order, strict=True):
        if np.isfinite(value):
            assert value == pytest.approx(list(truth.values())[chosen], rel=1e-12, abs=0.0)
    assert found.value == scores.values[0]
    assert found.bound == pytest.approx(min(truth.values()), rel=1e-12, abs=0.0)
    assert found.bound <= found.value * (1 - 1e-12)
    with pytest.raises(ModelError, match="does not depend on actuators"):
        place_actuators(plant, actuators, 4, Precision())


@pytest.mark.slow
def test_the_same_function_without_a_scorer(make):
    """A callable from plant to float gives the same choice, without a bound."""
    plant, sensors, _ = make(11, count=9)
    fast = place_sensors(plant, sensors, 4, Precision(), method=Exchange(starts=3), rng=1)
    slow = place_sensors(
        plant, sensors, 4, lambda p: Precision()(p), method=Exchange(starts=3), rng=1
    )
    assert slow.chosen == fast.chosen
    assert slow.evaluations == fast.evaluations
    assert slow.value == pytest.approx(fast.value, rel=1e-12, abs=0.0)
    assert slow.bound == -np.inf


def test_all_exchanges_of_a_step_are_scored_at_once(make):
    plant, sensors, _ = make(11, count=9)
    scorers = []

    class Counted(Precision):
        def scorer(self, plant, candidates):
            scorers.append(super().scorer(plant, candidates))
            return scorers[-1]

    found = place_sensors(plant, sensors, 4, Counted(), method=Exchange(starts=1))
    assert found.evaluations > 3 * scorers[0].calls


def test_a_search_is_a_class(make):
    plant, sensors, _ = make(11, count=9)
    found = place_sensors(plant, sensors, 4, Precision(), method=Drawn(200), rng=5)
    with ThreadPoolExecutor(2) as pool:
        again = place_sensors(
            plant, sensors, 4, Precision(), method=Drawn(200), rng=5, executor=pool
        )
    best = place_sensors(plant, sensors, 4, Precision())
    assert best.value <= found.value == again.value
    assert (found.evaluations, found.chosen) == (200, again.chosen)
    assert found.bound <= best.value * (1 - 1e-12)
    with pytest.raises(ModelError, match="must be of type Search"):
        place_sensors(plant, sensors, 4, method="drawn")

"""Effective independence by its identities, pivoted QR, and log det by relaxation."""

from itertools import combinations

import numpy as np
import pytest

from flexplant.errors import ModelError
from flexplant.placement import (
    BranchAndBound,
    Exchange,
    ModeInformation,
    Problem,
    RowSelection,
    place_sensors,
)
from flexplant.placement.constraints import LinearRows
from flexplant.placement.mode_shapes import ModeRows
from flexplant.placement.problem import Layouts, RigidPart
from flexplant.reduction import EffectiveIndependence, PivotedQr
from flexplant.work import Work


def test_identities_of_effective_independence_are_exact():
    """E_i in [0, 1], their sum the number of modes, det without i = (1 - E_i) det."""
    rows = np.random.default_rng(3).normal(size=(30, 6)) * 10.0 ** np.arange(-3, 3)
    E = EffectiveIndependence().values(rows)
    assert np.all((E > 0) & (E < 1))
    assert np.sum(E) == pytest.approx(6, rel=1e-12, abs=0.0)
    whole = np.linalg.slogdet(rows.T @ rows)[1]
    for i in range(30):
        rest = np.delete(rows, i, axis=0)
        less = np.linalg.slogdet(rest.T @ rest)[1]
        assert np.exp(less - whole) == pytest.approx(1 - E[i], rel=1e-9, abs=0.0)
    # a mode seen by one sensor only makes it indispensable
    rows[:, 0] = 0.0
    rows[7, 0] = 1.0
    assert EffectiveIndependence().values(rows)[7] == pytest.approx(1.0, rel=1e-12, abs=0.0)


@pytest.mark.slow
def test_searches_by_rows_differ_and_are_bounded(make):
    plant, sensors, _ = make(42, count=14)
    goal = ModeInformation()
    searches = (RowSelection(), RowSelection(driving_point=True), RowSelection(PivotedQr()))
    found = [place_sensors(plant, sensors, 9, goal, method=m) for m in searches]
    assert len({one.chosen for one in found}) == 3
    best = place_sensors(plant, sensors, 9, goal, method=BranchAndBound())
    assert best.proven
    swapped = place_sensors(plant, sensors, 9, goal, method=Exchange(4), rng=0)
    assert swapped.chosen == best.chosen
    for one in found:
        assert one.bound <= best.value <= one.value
    kept = place_sensors(
        plant, sensors, 9, goal, method=RowSelection(PivotedQr()), required=["s0", "s2"]
    )
    assert {"s0", "s2"} <= set(kept.chosen)
    fewer = place_sensors(plant, sensors, 10, ModeInformation(elastic=True), method=searches[0])
    assert len(fewer.chosen) == 10
    with pytest.raises(ModelError, match=r"has none\. Pass criterion=placement\.ModeInformation"):
        place_sensors(plant, sensors, 9, method=RowSelection(PivotedQr()))


def test_pivots_are_those_of_gram_and_schmidt(make):
    """Each next sensor has the largest part that those before it do not see."""
    plant, sensors, _ = make(42, count=14)
    rows = ModeInformation().scorer(plant, sensors).rows
    left, expected = rows.copy(), []
    for _ in range(5):
        pick = int(np.argmax(np.linalg.norm(left, axis=1)))
        expected.append(f"s{pick}")
        unit = left[pick] / np.linalg.norm(left[pick])
        left = left - np.outer(left @ unit, unit)
    found = RowSelection(PivotedQr()).search(_problem(rows, 5), Work())
    assert {f"s{i}" for i in found.chosen} == set(expected)


def _problem(rows, count):
    """The choice of rows with the largest log det, without any plant."""
    total = len(rows)
    matrices = rows[:, :, None] * rows[:, None, :]
    scorer = ModeRows(matrices, rows, np.ones(total))
    free = RigidPart(np.zeros((total, 0)))
    layouts = Layouts(None, "y", (None,) * total, None, free, scorer)
    return Problem(layouts, count, (), LinearRows.stacked([], total))


def test_log_det_is_bounded_for_every_subset():
    rows = np.random.default_rng(0).normal(size=(11, 3))
    problem = _problem(rows, 5)
    truth = max(
        np.linalg.slogdet(rows[list(s)].T @ rows[list(s)])[1] for s in combinations(range(11), 5)
    )
    found = BranchAndBound().search(problem, Work())
    assert found.value == found.bound == pytest.approx(-truth, rel=1e-9, abs=0.0)
    assert problem.bound() <= -truth


def mean_gap(seeds):
    """The mean gap of relaxation to rounding and swaps [nats]: Joshi and Boyd, m = 100, n = 20."""
    gaps = []
    for seed in seeds:
        rows = np.random.default_rng(seed).normal(size=(100, 20)) / np.sqrt(20)
        found = Exchange(starts=1).search(_problem(rows, 30), Work())
        gaps.append(found.value - found.bound)
    return float(np.mean(gaps)), min(gaps)


@pytest.mark.long
def test_the_gap_of_joshi_and_boyd():
    mean, least = mean_gap(range(10))
    assert least >= 0.0
    assert mean <= 1.3

"""Placement over the positions of a stage below heads on its frame."""

from itertools import combinations

import numpy as np
import pytest

from flexplant.errors import AssumptionError, LabelError, ModelError
from flexplant.estimation import design_kalman
from flexplant.placement import (
    BranchAndBound,
    Exchange,
    ModalObservability,
    ModeInformation,
    OverPositions,
    PoiVariance,
    place_sensors,
    score_sensors,
)
from flexplant.plant import Disturbance, Poi, Ports, Position, Sensor, assemble_plant
from placement_plate import plate_modes

X = (-0.1, 0.0, 0.1)
HEADS = [(0.18, 0.11), (0.34, 0.05), (0.28, 0.25), (0.16, 0.04), (0.19, 0.22), (0.27, 0.07)]


def plant_at(x=None, chosen=(0, 1, 2, 3, 4, 5)):
    """Heads and the die are on the frame; at a position by hand where that is given."""
    moves = {"moves": {"x": (-1.0, 0.0, 0.0)}} if x is None else {}
    there = lambda p: (p[0] - (x or 0.0), p[1], 0.0)  # noqa: E731
    heads = [
        Sensor(f"s{i}", at=there(p), asd=(1 + i % 2) * 3e-11, **moves) for i, p in enumerate(HEADS)
    ]
    ports = Ports(
        w=[
            Disturbance(f"d{i}", at=p, asd=1e-3 / (i + 1))
            for i, p in enumerate([(0.1, 0.1, 0.0), (0.4, 0.12, 0.0), (0.2, 0.3, 0.0)])
        ],
        z=[Poi("die", at=there((0.22, 0.14)), axes=("z",), **moves)],
        y=[heads[i] for i in chosen],
        positions=[Position("x", range=(-0.1, 0.1))] if x is None else (),
    )
    return assemble_plant(plate_modes(8), ports).discretized(4e3, delay=1), heads


def by_hand(chosen):
    """The variance at each position: a filter for a plant that was assembled there."""
    return [design_kalman(plant_at(x, chosen)[0]).rms("die:z") ** 2 for x in X]


@pytest.mark.slow
@pytest.mark.parametrize("measure", ["worst", pytest.param("mean", marks=pytest.mark.long)])
def test_the_best_over_positions_is_that_of_plants_by_hand(measure):
    plant, heads = plant_at()
    criterion = OverPositions(PoiVariance("die"), {"x": X}, measure=measure)
    found = place_sensors(plant.at(x=0.07), heads, 4, criterion)
    choices = list(combinations(range(len(HEADS)), 4))
    of = np.max if measure == "worst" else np.mean
    values = [of(by_hand(chosen)) for chosen in choices]
    assert found.value == pytest.approx(min(values), rel=1e-6, abs=0.0)
    assert found.chosen == tuple(f"s{i}" for i in choices[int(np.argmin(values))])
    assert found.proven
    # the same with bounds alone, and a bound that holds with no branch opened
    sought = place_sensors(
        plant, heads, 4, criterion, method=BranchAndBound(starts=1), rng=0
    )  # fmt: skip
    assert sought.proven
    assert sought.chosen == found.chosen
    some = place_sensors(plant, heads, 4, criterion, method=Exchange(starts=1), rng=0)
    assert 0.5 * min(values) < some.bound <= min(values)
    # what is best at the centre alone is worse than this at another place
    alone = place_sensors(plant, heads, 4, PoiVariance("die"))
    assert alone.chosen != found.chosen
    assert criterion(alone.on(plant)) > found.value


@pytest.mark.slow
def test_a_choice_that_loses_a_rigid_body_mode_somewhere_has_no_score():
    """Three heads are on one line where the stage is at 0.1 m."""
    plant, _ = plant_at()
    fixed = [Sensor(f"f{i}", at=(x, 0.1, 0.0), asd=1e-10) for i, x in enumerate((0.1, 0.4))]
    moving = Sensor("m", at=(0.25, 0.2, 0.0), asd=1e-10, moves={"x": (0, -1, 0)})
    more = Sensor("n", at=(0.25, 0.3, 0.0), asd=1e-10)
    names = [["f0", "f1", "m"], ["f0", "f1", "n"]]
    for points, lost in (({"x": [0.0, 0.05]}, False), ({"x": [0.0, 0.1]}, True)):
        criterion = OverPositions(PoiVariance("die"), points)
        found = score_sensors(plant, names, criterion, candidates=[*fixed, moving, more])
        assert np.isinf(found.values).any() == lost
    assert found.best == ("f0", "f1", "n")
    assert "rigid-body mode at 1 of 2 positions" in found.reasons[-1]
    with pytest.raises(AssumptionError, match=r"at x = 0.1 .* all of them miss 1 rigid-body mode"):
        place_sensors(plant, [*fixed, moving], 3, criterion)
    # where it stands counts for a candidate too
    with pytest.raises(AssumptionError, match="does not see the rigid-body"):
        place_sensors(plant.at(x=0.1), [*fixed, moving], 3, PoiVariance("die"))


def test_candidates_are_where_the_machine_stands():
    plant, heads = plant_at()
    found = place_sensors(plant.at(x=0.05), heads, 4, PoiVariance("die"))
    assert all(
        port.at == pytest.approx((HEADS[int(port.name[1:])][0] - 0.05, *port.at[1:]))
        for port in found.ports
    )
    lone = heads[0].replace(moves={"q": (1, 0, 0)}, at=(0.1, 0.1, 0.0))
    with pytest.raises(LabelError, match="'q'"):
        place_sensors(plant, [lone, *heads[1:]], 4)


def test_what_it_refuses():
    plant, heads = plant_at()
    still = plant_at(0.0)[0]
    with pytest.raises(LabelError, match="no positions"):
        place_sensors(still, still.y[:5], 4, OverPositions(PoiVariance("die")))
    with pytest.raises(LabelError, match="position"):
        place_sensors(plant, heads, 4, OverPositions(PoiVariance("die"), {"q": 3}))
    with pytest.raises(ModelError, match="outside its range"):
        place_sensors(plant, heads, 4, OverPositions(PoiVariance("die"), {"x": [0.2]}))
    with pytest.raises(ModelError, match="measure"):
        OverPositions(PoiVariance("die"), measure="median")


@pytest.mark.slow
@pytest.mark.parametrize("measure", ["worst", "mean"])
def test_log_det_over_positions_is_bounded_and_proven(measure):
    """Minus log det of what the heads see of four modes, by hand at each position."""
    plant, heads = plant_at()
    modes = plate_modes(4)
    plant = assemble_plant(modes, plant.assembled.ports).discretized(4e3, delay=1)
    criterion = OverPositions(ModeInformation(), {"x": X}, measure=measure)
    found = place_sensors(plant, heads, 4, criterion, method=BranchAndBound(starts=1), rng=0)
    values = {}
    for chosen in combinations(range(len(HEADS)), 4):
        parts = []
        for x in X:
            rows = [
                modes.dofs.row((HEADS[i][0] - x, HEADS[i][1], 0.0), "z") @ modes.phi
                * 1e-12 / heads[i].asd for i in chosen
            ]  # fmt: skip
            parts.append(-np.linalg.slogdet(np.array(rows).T @ np.array(rows))[1])
        values[chosen] = (np.max if measure == "worst" else np.mean)(parts)
    best = min(values, key=values.get)
    assert found.proven
    assert found.chosen == tuple(f"s{i}" for i in best)
    assert found.value == pytest.approx(values[best], rel=1e-8)


def test_a_measure_without_a_relaxation_is_not_proven_by_one():
    """Of the least eigenvalue a bound of log det would close every branch unseen."""
    plant, heads = plant_at()
    criterion = ModalObservability(measure="least")
    for one in (criterion, OverPositions(criterion, {"x": X})):
        with pytest.raises(ModelError, match="no convex relaxation"):
            place_sensors(plant, heads, 4, one, method=BranchAndBound())
    every = place_sensors(plant, heads, 4, criterion)
    some = place_sensors(plant, heads, 4, criterion, method=Exchange(starts=1), rng=0)
    assert some.bound <= every.value

"""Branch and bound: proven optima are those of every subset, bounds are never above them."""

from functools import cache
from itertools import combinations
from math import comb

import numpy as np
import pytest

from flexplant import DofSet
from flexplant.errors import FlexplantWarning, ModelError
from flexplant.modes import solve_modes
from flexplant.placement import (
    BranchAndBound,
    Exchange,
    OffPoi,
    Placement,
    PoiLqr,
    PoiVariance,
    place_actuators,
    place_sensors,
)
from flexplant.placement.convex import Branch
from flexplant.placement.problem import layouts_of
from flexplant.plant import Actuator, Disturbance, Poi, Ports, Sensor, assemble_plant
from flexplant.structure import FEModel, ModalDamping
from oracles_placement import best_subset, stationary_riccati


@cache
def chain(held, total, asd):
    """Masses on a line, held or free, lightly damped; sensors and actuators on every other one."""
    rng = np.random.default_rng(total)
    n = 2 * total
    K = 2 * np.eye(n) - np.eye(n, k=1) - np.eye(n, k=-1)
    if not held:
        K[0, 0] = K[-1, -1] = 1.0
    xyz = [(0.1 * i, 0.0, 0.0) for i in range(n)]
    dofs = DofSet(range(n), ["z"] * n, xyz)
    modes = solve_modes(
        FEModel(np.diag(rng.uniform(0.5, 2.0, n)), 1e7 * K, dofs=dofs),
        count=7,
        damping=ModalDamping(0.001),
    )
    sensors = [
        Sensor(f"s{i}", at=xyz[2 * i], asd=asd * 10 ** rng.uniform(0, 0.5)) for i in range(total)
    ]
    actuators = [Actuator(f"a{i}", at=xyz[2 * i]) for i in range(total)]
    ports = Ports(
        w=[Disturbance("d1", at=xyz[3], asd=1e-2), Disturbance("d2", at=xyz[-4], asd=3e-3)],
        u=actuators[:3],
        z=[Poi("die", at=xyz[total - 3], axes=("z",))],
        y=sensors[:3],
    )
    return assemble_plant(modes, ports).discretized(5e3, delay=0.0), sensors, actuators


@pytest.fixture(params=["plate", "held", "free"])
def case(request, make):
    """A plant with its candidates and how many are chosen: three machines and noise levels."""
    if request.param == "plate":
        return *make(31, count=10, delay=0.0), 3
    held = request.param == "held"
    return *chain(held, 12 if held else 11, 1e-9 if held else 1e-13), 2


EFFORT = 1e-8


def truths(plant, candidates, count, side):
    """Return the score of every subset by the oracle, from the matrices of the plant with all."""
    full = plant.with_ports(plant.assembled.ports.replace(**{side: candidates}))
    g = full.system
    # a controller must see every rigid-body mode in z, a filter need not
    rows = g.C[
        [i for i, name in enumerate(g.outputs) if name.startswith("die:")][
            : 1 if side == "y" else None
        ]
    ]
    if side == "y":
        A, B, Q, R = g.A.T, full.C2.T, full.process_noise, full.sensor_noise
    else:
        A, B, Q, R = g.A, full.B2, rows.T @ rows, EFFORT**2 * np.eye(len(candidates))

    def score(chosen):
        some = list(chosen)
        X = stationary_riccati(A, B[:, some], Q, R[np.ix_(some, some)])
        if side == "u":
            return float(np.sum(X * full.process_noise))
        seen = X @ B[:, some]
        after = X - seen @ np.linalg.solve(B[:, some].T @ seen + R[np.ix_(some, some)], seen.T)
        return float((rows @ after @ rows.T)[0, 0])

    return best_subset(count, len(candidates), score)


@pytest.mark.long
@pytest.mark.parametrize("side", ["y", "u"])
def test_optima_are_proven_and_no_bound_is_above_any_truth(case, side):
    plant, sensors, actuators, count = case
    candidates = sensors if side == "y" else actuators
    place = place_sensors if side == "y" else place_actuators
    criterion = PoiVariance("die", "z") if side == "y" else PoiLqr("die", effort=EFFORT)
    best, values = truths(plant, candidates, count, side)
    found = place(
        plant,
        candidates,
        count,
        criterion,
        constraints=[OffPoi(-1)],
        method=BranchAndBound(),
        rng=1,
    )
    assert found.proven
    assert found.bound == found.value == pytest.approx(values[best], rel=1e-6, abs=0.0)
    assert found.value == pytest.approx(
        values[tuple(int(n[1:]) for n in found.chosen)], rel=1e-6, abs=0.0
    )
    scorer = layouts_of(plant, side, candidates, criterion).scorer
    whole = Branch(((np.arange(len(candidates)), count),))
    low, weights = scorer.relaxation(whole)
    assert low <= values[best] * (1 + 1e-7)
    # the weights are the least relaxed cost, apart from one in a hundred
    relaxed = scorer.cost(0.999 * weights + 0.001 * whole.centre(len(candidates)))
    assert low <= relaxed <= 1.02 * low
    # every tangent, wherever it touches, is below every truth; every branch below those it holds
    for at in (whole.centre(len(candidates)), 0.9 * weights + 0.1 * whole.centre(len(candidates))):
        tangent = scorer.tangent(at)
        sets = list(values)
        assert np.all(tangent.values(sets) <= np.array([values[s] for s in sets]) * (1 + 1e-7))
        parts = list(whole.halves(tangent.rows, at))
        assert sum(part.size for part in parts) == len(values)
        assert sorted(s for part in parts for s in part.choices()) == sorted(values)
        for part in parts:
            least = min(values[s] for s in part.choices())
            assert tangent.least(part, at)[0] <= least * (1 + 1e-7)


@pytest.mark.slow
@pytest.mark.parametrize("side", [pytest.param("y", marks=pytest.mark.slow), "u"])
def test_branches_find_what_every_subset_shows(make, monkeypatch, side):
    """With branches of a few choices only; required candidates stay, a gap is kept to."""
    for name, few in (("_SCREENED", 6), ("_SCORED", 3)):
        monkeypatch.setattr(f"flexplant.placement.branch_and_bound.{name}", few)
    plant, sensors, actuators = make(14, count=12)
    candidates = sensors if side == "y" else actuators
    place = place_sensors if side == "y" else place_actuators
    criterion = PoiVariance("die") if side == "y" else PoiLqr("die", effort=EFFORT)
    name = candidates[7].name
    for kept in ((), (name,)):
        every = place(plant, candidates, 4, criterion, required=kept)
        search = BranchAndBound(starts=1)
        found = place(plant, candidates, 4, criterion, required=kept, method=search, rng=3)
        assert (found.chosen, found.bound) == (every.chosen, found.value)
        assert found.value == pytest.approx(every.value, rel=1e-12, abs=0.0)
        assert found.evaluations < comb(12 - len(kept), 4 - len(kept))
        assert "the optimum, proven" in repr(found)
    rough = place(plant, candidates, 4, criterion, method=BranchAndBound(gap=0.2, starts=1), rng=3)
    best = place(plant, candidates, 4, criterion).value
    assert 0.8 * rough.value <= rough.bound <= best <= rough.value
    assert rough.gap <= 0.2


@pytest.mark.slow
def test_from_the_worst_start_the_optimum_is_found_all_the_same(make, monkeypatch):
    """A bound too high by a little cuts off the optimum; a start that is best would hide it."""
    room = "flexplant.placement.branch_and_bound"
    for seed in (3, 11, 12):
        plant, sensors, _ = make(seed, count=9)
        for one in (f"{room}._SCREENED", f"{room}._SCORED"):
            monkeypatch.setattr(one, 1)
        layouts = layouts_of(plant, "y", sensors, PoiVariance("die"))
        sets = list(combinations(range(9), 4))
        values = [float(layouts.score([one])[0]) for one in sets]
        worst = sets[int(np.argmax(values))]
        start = (worst, ((max(values),),), 1)
        monkeypatch.setattr(f"{room}.best_start", lambda *_, start=start: start)
        found = place_sensors(plant, sensors, 4, method=BranchAndBound())
        assert found.value == pytest.approx(min(values), rel=1e-12, abs=0.0)
        assert found.bound == found.value


@pytest.mark.slow
def test_a_limit_of_branches_says_that_it_was_hit(make):
    plant, sensors, _ = make(14, count=12)
    best = place_sensors(plant, sensors, 4)
    method = BranchAndBound(branches=0, starts=1)
    with pytest.warns(FlexplantWarning, match=r"limit of 0 branches was reached: no choice is"):
        found = place_sensors(plant, sensors, 4, method=method)
    assert "0 branches" in found.stopped and "0 branches" in repr(found)
    assert not found.proven
    assert 0.5 * best.value < found.bound < best.value <= found.value
    assert found.gap == pytest.approx(1 - found.bound / found.value, rel=1e-12, abs=0.0)
    # the relaxation is that of Exchange
    bound = place_sensors(plant, sensors, 4, method=Exchange(starts=1)).bound
    assert found.bound == pytest.approx(bound, rel=1e-9, abs=0.0)


def test_what_has_no_relaxation_is_refused(make):
    plant, sensors, _ = make(14)
    with pytest.raises(ModelError, match=r"no convex relaxation.*own_modes=True.*Exhaustive"):
        place_sensors(plant, sensors, 4, lambda p: 1.0, method=BranchAndBound())
    for bad, said in (
        ({"gap": 1.0}, "below 1"),
        ({"gap": -0.1}, "gap"),
        ({"branches": -1}, "branches"),
    ):
        with pytest.raises(ModelError, match=said):
            BranchAndBound(**bad)


@pytest.mark.slow
def test_four_of_36_are_proven_with_few_scores(make):
    """Of 58 905 choices, each a Riccati equation, fewer than one in twenty is solved."""
    plant, sensors, _ = make(5, count=36)
    found = place_sensors(plant, sensors, 4, method=BranchAndBound(), rng=0)
    assert found.proven
    assert found.evaluations < comb(36, 4) / 20
    rng = np.random.default_rng(0)
    layouts = layouts_of(plant, "y", sensors, PoiVariance())
    some = [sorted(rng.choice(36, 4, replace=False)) for _ in range(500)]
    assert np.min(layouts.score(some)) >= found.value


def test_a_bound_is_said_in_the_unit_of_the_value():
    """37 % of a variance are 21 % of an rms: beside an rms stands an rms."""
    found = Placement(("a",), 4e-18, 1e-18, 3, ((4e-18,),), "the POI", (), "y", unit="m")
    assert "2 nm rms by the POI, no choice below 1 nm rms" in repr(found)
    assert "no bound" in repr(found.replace(bound=0.0))
    assert "none is more than 75 % better" in repr(found.replace(unit=""))

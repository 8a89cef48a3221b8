"""Scores, gradients, proofs: ours beside SciPy's Riccati solver per set and every subset."""

from itertools import combinations
from math import comb

import numpy as np
import pytest
import scipy.linalg as la
from timing import best

import flexplant as fx
from flexplant.parallel import one_thread
from flexplant.placement import BranchAndBound, Exchange, ModalObservability
from flexplant.placement.problem import layouts_of
from stages import RATE, L, ports

SIDE = 21


def stage(side=SIDE, count=24):
    """48 states and a grid of candidates, none of them on the die."""
    plate = fx.kirchhoff_plate(
        size=(L, L), thickness=0.0272, elements=(8, 8), density=2702,
        youngs_modulus=70e9, poisson_ratio=0.35,
    )  # fmt: skip
    grid = np.linspace(0.0, L, side)
    sensors = [
        fx.Sensor(f"s{i}", at=(x, y, 0.0), asd=1e-11)
        for i, (x, y) in enumerate((x, y) for x in grid for y in grid)
    ]
    modes = fx.solve_modes(plate, count=count, damping=fx.ModalDamping(0.01))
    own = ports(y=sensors[:4], die=(0.31, 0.26, 0.0), references=[])
    return fx.assemble_plant(modes, own).discretized(RATE, delay=1), sensors, plate


def drawn(total, size, count, seed=0):
    """Return so many choices, ascending."""
    rng = np.random.default_rng(seed)
    return np.array([np.sort(rng.choice(total, size, replace=False)) for _ in range(count)])


def by_scipy(scorer, chosen):
    """Return the variance with the chosen sensors by SciPy's Riccati solver, rows given."""
    g = scorer.items[chosen]
    X = la.solve_discrete_are(scorer.A, g.T, scorer.H, np.eye(len(g)))
    gain = np.linalg.solve(np.eye(len(g)) + g @ X @ g.T, g @ X)
    return np.sum(scorer.S @ (X - X @ g.T @ gain) @ scorer.S.T)


@pytest.mark.benchmark
def test_scores_and_gradients():
    plant, sensors, _ = stage()
    goal = fx.PoiVariance("die")
    exact = layouts_of(plant, "y", sensors, goal)
    n = exact.scorer.A.shape[0]
    few, many = drawn(len(sensors), 4, 200), drawn(len(sensors), 4, 20_000)
    rows = []
    with one_thread():
        values, seconds = best(lambda: exact.score(few))
        rows.append(("PoiVariance, exact", len(few) / seconds))
        wanted, seconds = best(lambda: [by_scipy(exact.scorer, one) for one in few[:40]], 2)
        np.testing.assert_allclose(values[:40], wanted, rtol=1e-5)
        rows.append(("SciPy's solve_discrete_are per set", 40 / seconds))
        for criterion in (
            ModalObservability("trace"),
            ModalObservability("log det"),
            ModalObservability("least"),
        ):
            scorer = layouts_of(plant, "y", sensors, criterion).scorer
            cheap = hasattr(scorer, "worth")
            sets = np.tile(many, (10, 1)) if cheap else many[:2000]
            _, seconds = best(lambda scorer=scorer, sets=sets: scorer.score(sets))
            rows.append((f"{criterion!r}", len(sets) / seconds))
        weights = np.full(len(sensors), 4 / len(sensors))
        _, seconds = best(lambda: exact.scorer.relaxed(weights), 20)
    print(f"\n{n} states, {len(sensors)} candidates, four chosen, one core")
    for name, rate in rows:
        print(f"  {name:<48}{rate:12.0f} sets/s")
    print(f"  {'gradient over all candidates':<48}{1e3 * seconds:12.2f} ms")
    assert n == 48


@pytest.mark.benchmark
def test_proofs():
    plant, sensors, _ = stage(side=6, count=12)
    goal = fx.PoiVariance("die")
    layouts = layouts_of(plant, "y", sensors, goal)
    few = drawn(36, 4, 300)
    with one_thread():
        _, seconds = best(lambda: layouts.score(few), 2)
    every = comb(36, 4) * seconds / len(few)
    print("\nfour of 36, 24 states")
    print(f"  {'every subset':<28}{every:8.1f} s ({comb(36, 4)} sets, extrapolated)")
    for method in (Exchange(starts=4), BranchAndBound(gap=0.1), BranchAndBound()):
        found, seconds = best(
            lambda method=method: fx.place_sensors(plant, sensors, 4, goal, method=method, rng=0), 1
        )
        print(f"  {method!r:<28.60}{seconds:8.1f} s, gap {100 * found.gap:.2g} %")
    assert found.proven
    plant, sensors, _ = stage(side=8, count=12)
    found, seconds = best(
        lambda: fx.place_sensors(plant, sensors[:60], 5, goal, method=BranchAndBound(gap=0.1)), 1
    )
    print(f"  five of 60, 10 % wanted:    {seconds:8.1f} s, gap {100 * found.gap:.2g} %")
    assert found.gap <= 0.1


def rank(values):
    return np.argsort(np.argsort(values))


@pytest.mark.benchmark
def test_classical_criteria_beside_the_exact_variance():
    """Spearman's correlation of rankings of every choice: what the docstrings say of it."""
    plant, sensors, _ = stage(side=4, count=12)
    sets = list(combinations(range(16), 4))[::3]
    exact = layouts_of(plant, "y", sensors, fx.PoiVariance("die")).score(sets)
    kept = np.isfinite(exact)
    print("\nSpearman's correlation with the exact variance at the POI")
    for criterion in (ModalObservability("trace"), ModalObservability("log det")):
        found = layouts_of(plant, "y", sensors, criterion).score(sets)
        used = kept & np.isfinite(found)
        correlation = np.corrcoef(rank(exact[used]), rank(found[used]))[0, 1]
        print(f"  {criterion!r:<48}{correlation:6.2f}")


@pytest.mark.benchmark
def test_many_layouts_beside_scipy():
    """6000 layouts on 48 states, disturbances as mappings over 441 DOFs: 5 times SciPy's DARE."""
    plate = fx.kirchhoff_plate(
        size=(L, L), thickness=0.0272, elements=(20, 20), density=2702,
        youngs_modulus=70e9, poisson_ratio=0.35,
    )  # fmt: skip
    grid = np.linspace(0.0, L, SIDE)
    sensors = [
        fx.Sensor(f"s{i}", at=(x, y, 0.0), asd=1e-11)
        for i, (x, y) in enumerate((x, y) for x in grid for y in grid)
    ]
    rng = np.random.default_rng(1)
    everywhere = sorted({f"{n}:z" for n in plate.dofs.nodes})
    assert len(everywhere) == 441
    acoustic = [
        fx.Disturbance(f"d{i}", at=dict(zip(everywhere, rng.standard_normal(441), strict=True)),
                       asd=1e-4)
        for i in range(8)
    ]  # fmt: skip
    modes = fx.solve_modes(plate, count=24, damping=fx.ModalDamping(0.01))
    own = ports(y=sensors[:4], w=acoustic, die=(0.31, 0.26, 0.0), references=[])
    plant = fx.assemble_plant(modes, own).discretized(RATE, delay=1)
    chosen = drawn(len(sensors), 4, 6000)
    exact = layouts_of(plant, "y", sensors, fx.PoiVariance("die"))
    with one_thread():
        scores, seconds = best(
            lambda: fx.score_sensors(plant, [[sensors[i] for i in one] for one in chosen]), 1
        )
        wanted, theirs = best(lambda: [by_scipy(exact.scorer, one) for one in chosen[:60]], 2)
    ratio = 100 * theirs / seconds
    print(f"\n6000 layouts: {seconds:.1f} s, SciPy's DARE alone {100 * theirs:.1f} s, {ratio:.1f}")
    found = np.empty(6000)
    found[scores.order] = scores.values
    np.testing.assert_allclose(found[:60], wanted, rtol=1e-5)
    assert ratio > 5.0

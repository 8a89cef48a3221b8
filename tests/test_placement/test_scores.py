"""Scores: right, sorted, honest about what is infeasible, the same on any executor."""

from concurrent.futures import ThreadPoolExecutor
from dataclasses import fields
from itertools import combinations

import numpy as np
import pytest

from flexplant import load
from flexplant.errors import AssumptionError, CertificateError, LabelError, ModelError, SolverError
from flexplant.estimation import design_kalman
from flexplant.lti import low_pass_filter
from flexplant.placement import PoiLqr, PoiVariance, convex, score_actuators, score_sensors
from flexplant.placement.convex import Quadratic
from flexplant.placement.problem import layouts_of
from flexplant.plant import Sensor, StandardPlant
from oracles_placement import kalman_variance, lqr_cost


def names_count(plant):
    """Few sensors are good, for whom sensors cost: a criterion that can be pickled."""
    return float(len(plant.y))


def first_place(plant):
    return float(plant.assembled.ports.y[0].at[0])


@pytest.mark.slow
@pytest.mark.parametrize("seed", [4, pytest.param(5, marks=pytest.mark.long)])
def test_sensor_scores_are_those_of_the_recursion(make, seed):
    plant, sensors, _ = make(seed)
    layouts = [sensors[:3], sensors[2:6], sensors[1:9:2], sensors]
    scores = score_sensors(plant, layouts, PoiVariance("die", {"z": 1.0, "rx": 0.1}))
    n = 16
    for rank, given in enumerate(scores.order):
        sampled = plant.with_ports(plant.assembled.ports.replace(y=layouts[given]))
        rows = sampled.C1[:2, :n] * np.array([1.0, 0.1])[:, None]
        expected = kalman_variance(
            sampled.system.A[:n, :n],
            sampled.C2[:, :n],
            sampled.process_noise[:n, :n],
            sampled.sensor_noise,
            rows,
        )
        assert scores.values[rank] == pytest.approx(expected, rel=1e-8, abs=0.0)
        assert scores.layouts[rank] == tuple(s.name for s in layouts[given])
    assert np.all(np.diff(scores.values) >= 0)
    assert scores.best == tuple(s.name for s in sensors)  # more sensors are never worse


@pytest.mark.slow
@pytest.mark.parametrize("delay", [0.0, 0.4, 1.6])
def test_actuator_scores_are_those_of_the_recursion(make, delay):
    """The short cut of the delay, against states for every delay line."""
    plant, _, actuators = make(6, delay=delay)
    layouts = [actuators[:3], actuators[3:8]]
    scores = score_actuators(plant, layouts, PoiLqr("die", {"z": 1, "rx": 0.2, "ry": 0.1}))
    for rank, given in enumerate(scores.order):
        sampled = plant.with_ports(plant.assembled.ports.replace(u=layouts[given]))
        rows = sampled.C1[:3] * np.array([1.0, 0.2, 0.1])[:, None]
        expected = lqr_cost(sampled.system.A, sampled.B2, sampled.process_noise, rows, 1e-9)
        assert scores.values[rank] == pytest.approx(expected, rel=1e-7, abs=0.0)


def test_velocity_sensors_count_too(make):
    plant, sensors, _ = make(4)
    moving = Sensor("v", at=sensors[5].at, quantity="velocity", asd=1e-9)
    scores = score_sensors(plant, [[*sensors[:3], moving], sensors[:3], [moving, *sensors[:2]]])
    ports = plant.assembled.ports.replace(y=[*sensors[:3], moving])
    direct = PoiVariance()(plant.with_ports(ports))
    assert scores.values[0] == pytest.approx(direct, rel=1e-9, abs=0.0)
    assert scores.best == ("s0", "s1", "s2", "v")
    assert scores.values[1] > 1.0001 * scores.values[0]
    assert np.isinf(scores.values[2])  # a velocity does not see where a rigid body is


def test_a_layout_that_misses_a_rigid_mode_is_last_and_says_so(make):
    plant, sensors, _ = make(4)
    line = [Sensor(f"line{i}", at=(0.1 * i, 0.175, 0.0), asd=1e-12) for i in range(5)]
    scores = score_sensors(plant, [line, sensors[:3], sensors[:2]])
    assert scores.best == ("s0", "s1", "s2")
    assert list(scores.order) == [1, 0, 2]
    assert np.all(np.isinf(scores.values[1:]))
    assert scores.reasons[0] == ""
    # five in a row see no rotation about the row
    assert "y does not see the rigid-body rotation rx" in scores.reasons[1].replace(
        "translation z + ", ""
    )
    assert "rigid-body" in scores.reasons[2]
    assert "1 feasible" in repr(scores)
    assert "rigid-body" in repr(scores)


def test_actuators_that_leave_a_rigid_mode_alone(make):
    plant, _, actuators = make(4)
    scores = score_actuators(plant, [actuators[:2], actuators[:3]])
    assert list(scores.order) == [1, 0]
    assert "u does not reach the rigid-body" in scores.reasons[1]


def test_nothing_is_feasible(make):
    plant, sensors, _ = make(4)
    scores = score_sensors(plant, [sensors[:2], sensors[1:2]])
    assert np.all(np.isinf(scores.values))
    assert all("rigid-body" in reason for reason in scores.reasons)


def test_names_stand_for_sensors(make):
    plant, sensors, _ = make(4)
    by_name = score_sensors(plant, [("s0", "s1", "s2")])
    by_value = score_sensors(plant, [sensors[:3]])
    assert by_name.values[0] == by_value.values[0]
    scores = score_sensors(plant, [("s0", "s4", "s5")], candidates=sensors)
    assert scores.best == ("s0", "s4", "s5")
    assert [s.name for s in scores.on(plant).assembled.ports.y] == ["s0", "s4", "s5"]
    assert PoiVariance()(scores.on(plant)) == pytest.approx(scores.values[0], rel=1e-9, abs=0.0)


def test_a_doubling_that_is_wrong_is_refused_by_its_residual(monkeypatch):
    A, items = np.array([[0.9, 0.2], [0.0, 0.7]]), np.array([[1.0, 0.0], [0.5, 1.0]])
    cost = convex.quadratic(A, np.eye(2), np.eye(2), items)
    truth, exact = cost.value([0]), convex.doubled_riccati

    def wrong(A, G, H, *, quick):
        X, steps = exact(A, G, H, quick=quick)
        return (1 + 1e-6) * X, steps

    monkeypatch.setattr(convex, "doubled_riccati", wrong)
    assert cost.value([0]) == pytest.approx(truth, rel=1e-9, abs=0)


def test_ports_with_filters_take_the_slow_way(make):
    """What the fast form leaves out is not scored by it."""
    plant, sensors, _ = make(4)
    if "dynamics" not in {field.name for field in fields(Sensor)}:
        pytest.skip("sensors have no dynamics yet")
    slow = [s.replace(dynamics=low_pass_filter(300.0)) for s in sensors[:3]]
    assert not isinstance(layouts_of(plant, "y", slow, PoiVariance()).scorer, Quadratic)
    assert isinstance(layouts_of(plant, "y", sensors[:3], PoiVariance()).scorer, Quadratic)
    value = score_sensors(plant, [slow]).values[0]
    direct = PoiVariance()(plant.with_ports(plant.assembled.ports.replace(y=slow)))
    assert value == direct


def test_any_callable_serves(make):
    plant, sensors, _ = make(4)
    scores = score_sensors(plant, [sensors[:5], sensors[:4], sensors[:2]], names_count)
    assert list(scores.values) == [4.0, 5.0, np.inf]  # detectability comes first for any criterion
    assert "names_count" in scores.criterion
    direct = score_sensors(plant, [sensors[:4], sensors[2:6]], lambda p: PoiVariance("die")(p))
    fast = score_sensors(plant, [sensors[:4], sensors[2:6]], PoiVariance("die"))
    np.testing.assert_allclose(direct.values, fast.values, rtol=1e-9)
    assert list(direct.order) == list(fast.order)


def test_a_criterion_that_fails_on_a_layout_gives_its_reason(make):
    plant, sensors, _ = make(4)

    def picky(sampled):
        if len(sampled.y) == 4:
            raise SolverError("four do not converge.")
        return np.inf if len(sampled.y) == 5 else 1.0

    scores = score_sensors(plant, [sensors[:4], sensors[:5], sensors[:3]], picky)
    assert list(scores.order) == [2, 0, 1]
    assert scores.reasons == ("", "four do not converge.", "the criterion is infinite.")


@pytest.mark.slow
def test_executors_give_the_same_to_the_bit(make, send_everything):
    plant, sensors, _ = make(5)
    layouts = list(combinations(sensors, 3)) + list(combinations(sensors, 2))
    serial = score_sensors(plant, layouts)
    with ThreadPoolExecutor(2) as pool:  # processes: of a search, in test_scale
        other = score_sensors(plant, layouts, executor=pool)
        counted = score_sensors(plant, layouts[::9], names_count, executor=pool)
    assert serial.values.tobytes() == other.values.tobytes()
    assert (serial.layouts, serial.reasons) == (other.layouts, other.reasons)
    assert counted.values[0] == 3.0


def test_scores_are_saved(make, tmp_path):
    plant, sensors, _ = make(4)
    scores = score_sensors(plant, [sensors[:3], sensors[:4], sensors[:2]], first_place)
    scores.save(tmp_path / "scores.npz")
    again = load(tmp_path / "scores.npz")
    assert repr(again) == repr(scores)
    assert again.table(3) == scores.table(3)
    assert len(again) == 3
    assert again.on(plant).y == scores.on(plant).y


def test_the_best_score_is_confirmed_by_the_filter(make):
    plant, sensors, _ = make(4)
    layouts = layouts_of(plant, "y", sensors, PoiVariance("die"))
    value = layouts.score([(0, 1, 2)])[0]
    layouts.confirm((0, 1, 2), value)
    with pytest.raises(CertificateError, match="fast score"):
        layouts.confirm((0, 1, 2), value * (1 + 1e-5))


def test_bad_input(make):
    plant, sensors, actuators = make(4)
    with pytest.raises(ModelError, match="nothing to score"):
        score_sensors(plant, [])
    with pytest.raises(ModelError, match="none of them empty"):
        score_sensors(plant, [sensors[:3], []])
    with pytest.raises(LabelError, match="no sensor 's77'"):
        score_sensors(plant, [("s77",)])
    with pytest.raises(LabelError, match="twice"):
        score_sensors(plant, [("s0", "s0", "s1")])
    with pytest.raises(LabelError, match="two different candidates are called 's0'"):
        score_sensors(plant, [[*sensors[:3]], [sensors[4].replace(name="s0")]])
    with pytest.raises(LabelError, match="off the plate"):
        score_sensors(plant, [[*sensors[:3], Sensor("far", at=(9.0, 0.0, 0.0), asd=1e-11)]])
    with pytest.raises(ModelError, match="candidates are Sensors"):
        score_sensors(plant, [actuators[:3]])
    with pytest.raises(ModelError, match="does not depend on sensors"):
        score_sensors(plant, [sensors[:3]], PoiLqr("die"))
    with pytest.raises(ModelError, match="does not depend on actuators"):
        score_actuators(plant, [actuators[:3]], PoiVariance("die"))
    with pytest.raises(ModelError, match="a criterion is"):
        score_sensors(plant, [sensors[:3]], "die")
    with pytest.raises(ModelError, match="must return a float"):
        score_sensors(plant, [sensors[:3]], lambda p: "good")
    with pytest.raises(ModelError, match="NaN"):
        score_sensors(plant, [sensors[:3]], lambda p: np.nan)
    with pytest.raises(ModelError, match="continuous"):
        score_sensors(plant.continuous, [sensors[:3]])
    with pytest.raises(ModelError, match="unweighted"):
        score_sensors(plant.weighted(z={"die:z": 2.0}), [sensors[:3]])
    with pytest.raises(ModelError, match="need a StandardPlant"):
        score_sensors("plant", [sensors[:3]])
    with pytest.raises(ModelError, match="not assembled from a structure"):
        score_sensors(plant.system, [sensors[:3]])
    bare = StandardPlant.from_statespace(plant.system, w=plant.w, u=plant.u, z=plant.z, y=plant.y)
    with pytest.raises(ModelError, match="not assembled from a structure"):
        score_sensors(bare, [sensors[:3]])


def test_candidates_that_fit_no_filter_are_refused(make):
    plant, sensors, _ = make(4)
    silent = Sensor("quiet", at=sensors[0].at)
    with pytest.raises(AssumptionError, match="quiet have no noise"):
        score_sensors(plant, [[*sensors[:3], silent]])
    shaken = Sensor("acc", at=sensors[0].at, quantity="acceleration", asd=1e-6)
    with pytest.raises(AssumptionError, match=r"reaches 'acc'"):
        score_sensors(plant, [[*sensors[:3], shaken]])
    still = plant.with_ports(plant.assembled.ports.replace(w=plant.assembled.ports.w[:2]))
    with pytest.raises(AssumptionError, match="w does not excite"):
        score_sensors(still, [sensors[:3]])


def test_accelerations_see_held_disturbances_at_once(make):
    plant, sensors, _ = make(4)
    ports = plant.assembled.ports
    held = plant.with_ports(ports.replace(w=[port.replace(held=True) for port in ports.w]))
    shaken = Sensor("acc", at=sensors[0].at, quantity="acceleration", asd=1e-4)
    layouts = [sensors[:3], [*sensors[:3], shaken]]
    found = score_sensors(held, layouts, PoiVariance("die", "z"))
    honest = score_sensors(held, layouts, lambda plant: design_kalman(plant).rms("die:z") ** 2)
    np.testing.assert_allclose(found.values, honest.values, rtol=1e-9)
    assert found.best[-1] == "acc"

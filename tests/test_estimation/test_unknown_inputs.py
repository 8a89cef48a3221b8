"""Unknown inputs: the published recursions, a dense oracle, zeros by hand, runs, refusals."""

from functools import cache

import numpy as np
import pytest
import scipy.linalg as la
from test_kalman import CORNERS, INSET, modes, plate_plant

from flexplant.errors import AssumptionError, LabelError, ModelError
from flexplant.estimation import Augmented, design_input_estimator, invertibility
from flexplant.lti import StateSpace
from flexplant.plant import Actuator, Disturbance, Poi, Ports, Sensor, StandardPlant, assemble_plant
from oracles_estimation import unbiased_direct, unbiased_late

DT = 1e-3


def by_hand(A, G, C, H, q=0.3, r=0.5):
    """x+ = A x + G d + w, y = C x + H d + v; the POI is the first state."""
    n, m = G.shape
    p = C.shape[0]
    B = np.hstack([G, np.zeros((n, p + 1))])
    C_all = np.vstack([np.eye(n)[:1], C])
    D = np.zeros((1 + p, m + p + 1))
    D[1:, :m], D[1:, m : m + p] = H, np.eye(p)
    names = [f"d{i}" for i in range(1, m + 1)]
    sensors = [f"y{i}" for i in range(1, p + 1)]
    g = StateSpace(
        A, B, C_all, D, DT, inputs=[*names, *(f"{y}:noise" for y in sensors), "u1"],
        outputs=["die:z", *sensors],
    )  # fmt: skip
    asd = {f"{y}:noise": np.sqrt(2 * r * DT) for y in sensors}
    factor = np.sqrt(q) * np.eye(n)
    return StandardPlant.from_statespace(g, u=["u1"], y=sensors, asd=asd, noise_factor=factor)


@cache
def random_plant(direct):
    rng = np.random.default_rng(3)
    A = rng.standard_normal((4, 4))
    A = 0.95 * A / np.max(np.abs(np.linalg.eigvals(A)))
    G, C, H = rng.standard_normal((4, 2)), rng.standard_normal((3, 4)), rng.standard_normal((3, 2))
    H = H if direct else 0 * H
    return (A, G, C, H), by_hand(A, G, C, H)


@pytest.mark.slow
@pytest.mark.parametrize("direct", [True, False])
def test_stationary_gains_are_those_of_the_published_recursion(direct):
    (A, G, C, H), plant = random_plant(direct)
    found = design_input_estimator(plant, ["d1", "d2"])
    Q, R = 0.3 * np.eye(4), 0.5 * np.eye(3)
    P, P_d = unbiased_direct(A, G, C, H, Q, R) if direct else unbiased_late(A, G, C, Q, R)
    assert found.delay == (0 if direct else 1)
    assert found.rms("die") ** 2 == pytest.approx(P[0, 0], rel=1e-9, abs=0)
    for i, name in enumerate(("d1", "d2:hat")):
        assert found.rms(name) ** 2 == pytest.approx(P_d[i, i], rel=1e-9, abs=0)
    assert found.certificate["bias"] < 1e-12
    assert found.certificate["difference"] < 1e-9


@pytest.mark.slow
@pytest.mark.parametrize("direct", [True, False])
def test_runs_have_the_predicted_errors_whatever_the_input_is(direct):
    """A ramp, a wave and a jump of a thousand deviations leave no bias."""
    (A, G, C, H), plant = random_plant(direct)
    found = design_input_estimator(plant, ["d1", "d2"])
    o, steps, rng = found.system, 20000, np.random.default_rng(5)
    k = np.arange(steps)
    d = np.array([1e3 * np.sin(0.02 * k) + (k > 9000) * 1e3, 0.1 * k]).T
    x, xo, errors = np.zeros(4), np.zeros(4), []
    estimates = np.zeros((steps, 3))
    for i in range(steps):
        y = C @ x + H @ d[i] + np.sqrt(0.5) * rng.standard_normal(3)
        estimates[i] = o.C @ xo + o.D[:, :3] @ y
        errors.append(x[0] - estimates[i, 0])
        xo = o.A @ xo + o.B[:, :3] @ y
        x = A @ x + G @ d[i] + np.sqrt(0.3) * rng.standard_normal(4)
    late = found.delay
    shown = np.column_stack([errors[late:], d[: steps - late] - estimates[late:, 1:]])[100:]
    predicted = [found.rms(name) for name in ("die", "d1", "d2")]
    np.testing.assert_allclose(np.sqrt(np.mean(shown**2, axis=0)), predicted, rtol=0.05)
    assert np.all(np.abs(shown.mean(axis=0)) < 0.15 * np.array(predicted))


def test_augmented_filter_is_the_kalman_filter_of_the_larger_model():
    (A, G, C, H), plant = random_plant(True)
    method = Augmented(drift=3.0, corner=20.0)
    found = design_input_estimator(plant, ["d1", "d2"], method)
    pole = np.exp(-2 * np.pi * 20 * DT)
    variance = 9.0 * (1 - pole**2) / (4 * np.pi * 20)
    larger = np.block([[A, G], [np.zeros((2, 4)), pole * np.eye(2)]])
    rows = np.hstack([C, H])
    Q = la.block_diag(0.3 * np.eye(4), variance * np.eye(2))
    P = la.solve_discrete_are(larger.T, rows.T, Q, 0.5 * np.eye(3))
    P = P - P @ rows.T @ np.linalg.solve(rows @ P @ rows.T + 0.5 * np.eye(3), rows @ P)
    assert found.rms("die") ** 2 == pytest.approx(P[0, 0], rel=1e-9, abs=0)
    assert found.rms("d2") ** 2 == pytest.approx(P[5, 5], rel=1e-9, abs=0)
    walk = design_input_estimator(plant, ["d1", "d2"], Augmented(3.0))
    slow = design_input_estimator(plant, ["d1", "d2"], Augmented(3.0, corner=1e-6))
    assert walk.rms("d1") == pytest.approx(slow.rms("d1"), rel=1e-6, abs=0)
    # the faster the input may change, the closer to the filter that assumes nothing
    fast = design_input_estimator(plant, ["d1", "d2"], Augmented(1e6))
    assert fast.rms("die") == pytest.approx(
        design_input_estimator(plant, ["d1", "d2"]).rms("die"), rel=1e-4, abs=0
    )


def test_zeros_by_hand():
    """A free mass at 1 kHz: position has the sampling zero at -1, acceleration two zeros at 1."""
    A, G = np.array([[1, DT], [0, 1]]), np.array([[DT**2 / 2], [DT]])
    position = by_hand(A, G, np.array([[1.0, 0]]), np.zeros((1, 1)))
    found = invertibility(position, ["d1"])
    assert (found.rank_direct, found.rank_delayed, found.delay) == (0, 1, 1)
    np.testing.assert_allclose(found.zeros, [-1.0], atol=1e-6)
    assert not found.holds
    assert "alternating sign" in found.text
    acceleration = by_hand(A, G, np.zeros((1, 2)), np.ones((1, 1)))
    found = invertibility(acceleration, ["d1"])
    assert found.delay == 0
    np.testing.assert_allclose(found.zeros, [1.0], atol=1e-6)
    assert "constant force" in found.text
    both = by_hand(A, G, np.array([[1.0, 0], [0, 0]]), np.array([[0.0], [1.0]]))
    assert invertibility(both, ["d1"]).holds
    # growing zero: y = x1 - 0.5 x2 of two decoupled lags
    A, G = np.diag([0.5, 0.2]), np.array([[1.0], [1.0]])
    C = np.array([[1.0, -0.9]])
    zero = (0.2 - 0.9 * 0.5) / (1 - 0.9)  # C adj(zI - A) G = 0
    found = invertibility(by_hand(A, G, C, np.zeros((1, 1))), ["d1"])
    np.testing.assert_allclose(found.zeros, [zero], rtol=1e-9)
    with pytest.raises(AssumptionError, match=r"grows by 2\.5 per sample"):
        design_input_estimator(by_hand(A, G, C, np.zeros((1, 1))), ["d1"])


def amplifiers(**options):
    places = [INSET[0], INSET[2], INSET[3]]
    return [Disturbance(f"amp{i}", at=p, asd=1e-3, **options) for i, p in enumerate(places, 1)]


def plate(y, **options):
    ports = Ports(
        w=[Disturbance("push", at=INSET[1]), *amplifiers(**options)],
        u=[Actuator(f"u{i}", at=p) for i, p in enumerate(INSET, 1)],
        z=[Poi("die", at=(0.31, 0.26, 0.0))],
        y=y,
    )
    return assemble_plant(modes(1e-2, 12), ports).discretized(5e3, delay=1)


@cache
def with_accelerometer():
    places = [Sensor(f"y{i}", at=p, asd=1e-11) for i, p in enumerate(CORNERS, 1)]
    shaped = StateSpace([[-1e4]], [[1.0]], [[1e4]], [[0.0]])
    more = Sensor("a", at=INSET[1], quantity="acceleration", asd=1e-4)
    return plate([*places, more], shape=shaped)


def test_a_force_on_the_plate():
    """Four displacements see a force late; an accelerometer beside it sees it at once."""
    displacements = plate([Sensor(f"y{i}", at=p, asd=1e-11) for i, p in enumerate(CORNERS, 1)])
    late = design_input_estimator(displacements, ["push"])
    at_once = design_input_estimator(with_accelerometer(), ["push"])
    assert (late.delay, at_once.delay) == (1, 0)
    assert at_once.rms("push") < 0.5 * late.rms("push")
    assert max(late.certificate["difference"], at_once.certificate["difference"]) < 1e-6
    # an input that is assumed to change slowly is known better, one that may jump no worse
    slow = design_input_estimator(displacements, ["push"], Augmented(1e-2))
    fast = design_input_estimator(displacements, ["push"], Augmented(1e3))
    assert slow.rms("die") < fast.rms("die") < 1.001 * late.rms("die")


def test_refusals():
    (A, G, C, H), plant = random_plant(False)
    with pytest.raises(LabelError, match="disturbance of w"):
        invertibility(plant, ["d3"])
    with pytest.raises(ModelError, match=r"Unbiased\(\) or estimation\.Augmented"):
        design_input_estimator(plant, ["d1"], "kalman")
    with pytest.raises(AssumptionError, match="need as many sensors"):
        design_input_estimator(by_hand(A, G, C[:1], H[:1]), ["d1", "d2"])
    mixed = by_hand(A, G, C, np.array([[1.0, 0], [0, 0], [0, 0]]))
    with pytest.raises(AssumptionError, match="some combinations"):
        design_input_estimator(mixed, ["d1", "d2"])
    # a random walk is not seen where the accelerometer alone is
    A, G = np.array([[1, DT], [0, 1]]), np.array([[DT**2 / 2], [DT]])
    blind = by_hand(A, G, np.zeros((1, 2)), np.ones((1, 1)))
    with pytest.raises(AssumptionError, match="no filter holds d1"):
        design_input_estimator(blind, ["d1"], Augmented(1.0))
    with pytest.raises(AssumptionError, match="continuous"):
        invertibility(plate_plant().continuous, ["amp1"])
    loud = plant.replace(asd={**plant.asd, "d1": 1.0})
    with pytest.raises(ModelError, match="noise_factor"):
        design_input_estimator(loud, ["d1"])

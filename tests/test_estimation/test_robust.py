"""Filters for other spectra and other machines, beside searches over their gains by brute force."""

from functools import cache

import numpy as np
import pytest
from scipy.linalg import eigh
from scipy.optimize import minimize
from test_kalman import modes, plate_plant, ports

import flexplant as fx
from flexplant.errors import AssumptionError, ModelError
from flexplant.estimation import design_hinf_filter, design_kalman, design_minimax_filter
from flexplant.lti import StateSpace
from flexplant.plant import StandardPlant
from flexplant.plant.uncertainty.delta import with_changes
from flexplant.plant.uncertainty.mode_delta import FrequencyDelta
from oracles_estimation import error_by_frequency, error_peak, scalar_filter_variance

DT = 1e-3


def one_state(a, q=1.0, r=2.0):
    """x+ = a x + xi, y = x + v, z = x, with variances q and r per sample."""
    g = StateSpace(
        [[a]], [[1.0, 0.0, 0.0]], [[1.0], [1.0]], [[0, 0, 0], [0, 1.0, 0]], DT,
        inputs=["force", "y1:noise", "u1"], outputs=["die:z", "y1"],
    )  # fmt: skip
    asd = {"y1:noise": np.sqrt(2 * r * DT)}
    return StandardPlant.from_statespace(
        g, u=["u1"], y=["y1"], asd=asd, noise_factor=[[np.sqrt(q)]]
    )


@cache
def plate():
    return plate_plant(1e-3, count=8)


@cache
def machines(count=6):
    rng = np.random.default_rng(1)
    deltas = [FrequencyDelta.of(k, 1.0) for k in range(4, 9)]
    scatter = 0.01 * rng.standard_normal((count, len(deltas)))
    return [with_changes(plate(), list(zip(deltas, row, strict=True))) for row in scatter]


def as_dict(observer, plant):
    o = observer.system.select(observer.system.outputs, observer.sensors)
    return {"A": o.A, "B": o.B, "C": o.C, "D": o.D}


def truth(plant):
    g, z = plant.system, [n for n in plant.z if not n.endswith((":error", ":effort"))]
    y = [name for name in plant.y if name not in plant.w]
    rows = [plant.y.index(name) for name in y]
    return {
        "A": g.A,
        "C1": g.C[g.output_index(z)],
        "C2": g.C[g.output_index(y)],
        "R": plant.sensor_noise[np.ix_(rows, rows)],
        "factor": plant.noise_factor,
    }


@pytest.mark.slow
@pytest.mark.parametrize("a", [0.6, 1.0])
def test_no_pair_of_gains_has_a_smaller_peak(a):
    """One state: the best of all filters has one state, so two gains are all that there is."""
    plant = one_state(a)
    found = design_hinf_filter(plant, accuracy=1e-5)
    own = truth(plant)

    def peak(x):
        observer = {"A": [[a - x[0]]], "B": [[x[0]]], "C": [[1 - x[1]]], "D": [[x[1]]]}
        if abs(a - x[0]) >= 1:
            return 1e6
        return error_peak(own, {k: np.array(v) for k, v in observer.items()}, 300)

    kalman = design_kalman(plant)
    starts = [(0.5, 0.5), (float(found.gain[0, 0]), float(found.poi_gain[0, 0]))]
    best = min(
        minimize(peak, x, method="Nelder-Mead", options={"xatol": 1e-6, "fatol": 1e-7}).fun
        for x in starts
    )
    assert found.certificate.gamma * kalman.rms("die") == pytest.approx(best, rel=1e-4, abs=0)
    assert found.certificate.lower < found.certificate.gamma <= found.certificate.kalman
    assert found.rms("die") >= kalman.rms("die")


@pytest.mark.slow
def test_hinf_on_the_plate():
    """0.1 % damping, 1e-12 m/sqrt(Hz): the peak is that of a dense sweep, below Kalman's."""
    found = design_hinf_filter(plate())
    assert "m, die:rx " in repr(found) and "rad" in repr(found)
    own, observer = truth(plate()), as_dict(found, plate())
    own["C1"] = own["C1"] / found.sizes[:, None]
    observer |= {name: observer[name] / found.sizes[:, None] for name in "CD"}
    peak = error_peak(own, observer)
    assert found.certificate.gamma == pytest.approx(peak, rel=1e-3, abs=0)
    assert found.certificate.gamma < 0.9 * found.certificate.kalman
    assert found.certificate.gamma < found.certificate.lower * 1.0011
    variances = error_by_frequency(truth(plate()), as_dict(found, plate()))
    predicted = [found.rms(name) for name in ("die:z", "die:rx", "die:ry")]
    np.testing.assert_allclose(predicted, np.sqrt(variances), rtol=1e-3)
    np.testing.assert_allclose(predicted[0], found.rms("die", on=plate()), rtol=1e-6)


def test_no_pair_of_gains_has_a_smaller_worst_variance():
    nominal, poles = 0.9, (0.7, 0.95, 0.99)
    plant, others = one_state(nominal), [one_state(a) for a in poles]
    found = design_minimax_filter(plant, others)

    def worst(x):
        return max(scalar_filter_variance(a, nominal, *x, q=1.0, r=2.0) for a in poles)

    kalman = design_kalman(plant)
    start = float(kalman.gain[0, 0] * nominal), float(kalman.gain[0, 0])
    options = {"xatol": 1e-10, "fatol": 1e-12, "maxiter": 4000}
    best = minimize(worst, start, method="Nelder-Mead", options=options).fun
    size = kalman.rms("die") ** 2
    assert found.certificate.worst * size == pytest.approx(best, rel=2e-3, abs=0)
    assert found.certificate.kalman * size == pytest.approx(worst(start), rel=1e-8, abs=0)
    mine = worst((found.gain[0, 0], found.poi_gain[0, 0]))
    assert found.certificate.worst * size == pytest.approx(mine, rel=1e-9, abs=0)
    own = max(design_kalman(other).rms("die") ** 2 for other in others)
    assert found.certificate.lower * size == pytest.approx(own, rel=1e-9, abs=0)


@pytest.mark.slow
def test_worst_machine_of_the_plate():
    """One percent of frequency scatter: 4.5 times Kalman's variance becomes 2.3 times."""
    found = design_minimax_filter(plate(), machines(), iterations=60)
    names = ("die:z", "die:rx", "die:ry")
    rms = [[found.rms(name, on=machine) for name in names] for machine in machines()]
    worst = machines()[int(np.argmax(np.mean((np.array(rms) / found.sizes) ** 2, axis=1)))]
    variances = error_by_frequency(truth(worst), as_dict(found, worst)) / found.sizes**2
    worst = np.mean(variances)
    assert found.certificate.worst == pytest.approx(worst, rel=2e-3, abs=0)
    assert found.certificate.worst < 0.6 * found.certificate.kalman
    assert found.certificate.lower < found.certificate.worst
    assert found.certificate.difference < 1e-6
    # what it costs on the nominal machine
    assert found.rms("die") < 1.2 * found.sizes[0]


@pytest.mark.slow
def test_machines_of_a_fit():
    """Added masses known to some grams move all modes, rigid-body ones too."""
    grid = list(fx.select_dofs(modes(1e-3, 9), 9))
    rom = fx.reduce(modes(1e-3, 9), fx.DesiredDofs(grid))
    heavier = np.array(rom.M)
    heavier[4, 4] += 0.3
    omega = np.sqrt(np.maximum(eigh(rom.K, heavier, eigvals_only=True), 0.0))[3:6]
    poles = omega * (-1e-3 + 1j)
    spread = np.diag(np.concatenate([(2e-4 * np.abs(poles)) ** 2, (2e-3 * np.abs(poles)) ** 2]))
    measured = fx.MeasuredModes(poles=poles, modes=[4, 5, 6], covariance=spread)
    fit = fx.update(rom, [fx.AddedMass(grid[4]), fx.AddedMass(grid[7])], [fx.Eigenvalues(measured)])
    plant = fx.assemble_plant(fit.model, ports()).discretized(1e4, delay=1)
    drawn = plant.uncertain(fit).sample(3, 4)
    found = design_minimax_filter(plant, drawn, iterations=40)
    assert found.certificate.worst < 0.9 * found.certificate.kalman
    assert found.certificate.difference < 1e-6
    rms = [[found.rms(n, on=one) for n in ("die:z", "die:rx", "die:ry")] for one in drawn]
    worst = np.mean((np.array(rms) / found.sizes) ** 2, axis=1).max()
    assert worst == pytest.approx(found.certificate.worst, rel=1e-9, abs=0)


def test_one_machine_alone_is_its_kalman_filter():
    found = design_minimax_filter(plate(), [plate()], iterations=20)
    assert found.certificate.worst == pytest.approx(1.0, rel=1e-6, abs=0)
    assert found.certificate.lower == pytest.approx(1.0, rel=1e-6, abs=0)


@pytest.mark.slow
def test_refusals():
    with pytest.raises(ModelError, match="at least one StandardPlant"):
        design_minimax_filter(plate(), [])
    with pytest.raises(ModelError, match="sampling time"):
        design_minimax_filter(plate(), [plate().continuous.discretized(5e3, delay=1)])
    with pytest.raises(ModelError, match="accuracy"):
        design_hinf_filter(plate(), accuracy=2.0)
    with pytest.raises(AssumptionError, match="continuous"):
        design_hinf_filter(plate().continuous)

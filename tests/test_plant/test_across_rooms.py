"""What ports with dynamics mean to the rooms above: static relation, servo, placement, pictures."""

import numpy as np
import pytest
import scipy.linalg as la

import flexplant as fx
from flexplant.errors import AssumptionError, ModelError
from stages import CORNERS, INSET, NOISE, RATE, Z8, L, ports, reduced, some_modes


@pytest.fixture(scope="module")
def filtered():
    shaped = fx.lti.low_pass_filter(3000.0)
    sensors = [
        fx.Sensor(f"y{i}", at=p, asd=NOISE, dynamics=shaped) for i, p in enumerate(CORNERS, 1)
    ]
    return fx.assemble_plant(some_modes(), ports(y=sensors)).discretized(RATE, delay=1)


def test_static_gains_see_the_structure_not_the_filters(filtered):
    # oracle: the same relation without filters, whose static gain is one
    plain = fx.design_static(fx.assemble_plant(some_modes(), ports()).discretized(RATE, delay=1))
    found = fx.design_static(filtered)
    np.testing.assert_allclose(found.system.D, plain.system.D, rtol=1e-9, atol=1e-9)
    assert np.abs(plain.system.D).max() > 0.1
    # a filtered sensor lags behind a drift, the more the faster it is
    with pytest.raises(AssumptionError, match="grows without limit"):
        found.rms("die")


def test_a_servo_on_filtered_sensors_is_stable(filtered):
    observer, servo = fx.design_kalman(filtered), fx.design_servo(filtered, bandwidth=40.0)
    assert fx.close_loop(filtered, observer, servo).is_stable


def test_a_filtered_candidate_is_scored_by_its_own_filter(filtered):
    slow = fx.Sensor("slow", at=(0.3, 0.3, 0.0), asd=NOISE, dynamics=fx.lti.low_pass_filter(50.0))
    fast = fx.Sensor("fast", at=(0.3, 0.3, 0.0), asd=NOISE)
    layouts = [["y1", "y2", "y3", name] for name in ("fast", "slow")]
    own = filtered.assembled.ports
    scores = fx.score_sensors(filtered, layouts, candidates=[*own.y, slow, fast])
    value = dict(zip(scores.layouts, scores.values, strict=True))
    rebuilt = filtered.with_ports(own.replace(y=[*own.y[:3], slow]))
    truth = fx.design_kalman(rebuilt).rms("die") ** 2
    assert value["y1", "y2", "y3", "slow"] == pytest.approx(truth, rel=1e-6, abs=0.0)
    assert value["y1", "y2", "y3", "fast"] < value["y1", "y2", "y3", "slow"]


def test_disturbances_that_are_no_forces_at_a_place_can_be_placed_against():
    noisy = [*ports().w, fx.BaseAcceleration("floor", direction="z", asd=1e-6)]
    plant = fx.assemble_plant(some_modes(), ports(w=noisy)).discretized(RATE, delay=1)
    found = fx.place_sensors(plant, plant.assembled.ports.y, count=3)
    assert len(found.chosen) == 3
    rebuilt = plant.with_ports(plant.assembled.ports.replace(y=found.ports))
    truth = fx.design_kalman(rebuilt).rms("die") ** 2
    assert found.value == pytest.approx(truth, rel=1e-6, abs=0.0)


def test_weights_near_half_the_rate_are_refused(filtered):
    with pytest.raises(ModelError, match="not well below the rate"):
        fx.stage_weights(filtered, 2000.0)


def test_points_as_keys_are_drawn():
    pair = fx.Sensor("pair", at={CORNERS[0]: 0.5, CORNERS[3]: 0.5}, asd=NOISE)
    ax = fx.plot.layout(some_modes().dofs, ports=fx.Ports(y=[pair]))
    drawn = [line.get_xydata() for line in ax.lines if line.get_label() == "sensors"]
    np.testing.assert_allclose(drawn[0], [[300.0, 300.0]])


@pytest.mark.slow
def test_a_fit_alone_opens_its_uncertainty():
    rom = reduced()
    at = rom.full_dofs.nearest(Z8, "z")
    poles = (
        fx.testbeds.wafer_stage(elements=(8, 8)).poles([6, 7]).replace(covariance=0.1 * np.eye(4))
    )
    unknowns = [fx.AddedMass(at), fx.AddedDamping(at)]
    fit = fx.update(rom, unknowns, [fx.Eigenvalues(poles)])
    plant = fx.assemble_plant(fit.model, ports())
    alone, told = (
        plant.uncertain(fx.plant.Fit(fit, modes=[6], parameters=given))
        for given in (None, unknowns)
    )
    np.testing.assert_array_equal(alone.system.A, told.system.A)
    assert [p.name for p in fit.unknowns] == list(fit.parameters)


def test_a_reference_without_any_poi_says_so():
    with pytest.raises(fx.errors.LabelError, match="none exists yet"):
        fx.Ports(references=[fx.Reference("die")])


@pytest.mark.slow
def test_an_update_with_a_strong_damper_to_ground_becomes_a_plant():
    """From poles to the plant and its filter; responses against one dense solve per frequency."""
    before = reduced()
    row = before.row(Z8, "z")
    M, D, K = (np.asarray(part) for part in (before.M, before.D, before.K))
    true = D + 300.0 * np.outer(row, row)
    k = M.shape[0]
    A = np.block([[np.zeros((k, k)), np.eye(k)], [-la.solve(M, K), -la.solve(M, true)]])
    poles = la.eigvals(A)
    poles = poles[poles.imag > 500.0]
    poles = poles[np.argsort(np.abs(poles))][:3]
    z8 = before.full_dofs.nearest(Z8, "z")
    measured = fx.MeasuredModes(poles=poles, modes=[4, 5, 6])
    fit = fx.update(before, [fx.AddedMass(z8), fx.AddedDamping(z8)], [fx.Eigenvalues(measured)])
    np.testing.assert_allclose(fit.values, [0.0, 300.0], atol=1e-4)
    with pytest.warns(fx.FlexplantWarning, match="drag rigid-body motion"):
        plant = fx.assemble_plant(fit.model, ports())
    freq = np.array([0.5, 5.0, 300.0, 900.0])
    found = fx.frequency_response(plant.system, freq)["die:z", "u2"]
    see, push = before.row((L / 2, L / 2, 0.0), "z"), before.row(INSET[1], "z")
    for f, value in zip(freq, found, strict=True):
        s = 2j * np.pi * f
        assert value == pytest.approx(see @ la.solve(s**2 * M + s * true + K, push), rel=1e-5)
    observer = fx.design_kalman(plant.discretized(RATE, delay=1))
    assert 0 < observer.rms("die:z") < 1e-9

"""Basis functions, matrix fractions, and what an Frf and MeasuredModes carry along."""

import numpy as np
import pytest

from flexplant import load
from flexplant.errors import LabelError, ModelError, ShapeError
from flexplant.identification import MeasuredModes
from flexplant.identification.diagram import Moments
from flexplant.identification.lines import pole_terms, residual_terms
from flexplant.lti import Frf
from oracles_identification import held_mode, modal_frf, pole

FREQ = np.linspace(10.0, 90.0, 161)
S = 2j * np.pi * FREQ
PHI = np.random.default_rng(3).normal(size=(4, 3))
POLES = pole([30.0, 30.5, 70.0], [0.01, 0.01, 0.02])


@pytest.mark.parametrize("late", [0.0, 0.2, 0.9])
def test_held_poles_make_the_held_mode(late):
    rate, p = 200.0, POLES[1]
    plus, minus = (pole_terms(np.array([q]), S, rate, late=late)[0][0] for q in (p, p.conjugate()))
    want = held_mode(FREQ, p, rate, late) * np.exp(S * late / rate)
    found = (plus - minus) / (2j * p.imag)
    assert np.abs(found / want - 1).max() < 1e-11
    near = pole_terms(np.array([p]), S, 1e7)[0][0]
    assert np.abs(near * (S - p) - 1).max() < 1e-4


@pytest.mark.parametrize(("hold", "late"), [(None, 0.0), (200.0, 0.0), (200.0, 0.3)])
def test_slopes_of_poles(hold, late):
    d = 1e-4
    for step in (d, 1j * d):
        ahead, behind = (pole_terms(POLES + sign * step, S, hold, late=late)[0] for sign in (1, -1))
        slope = (ahead - behind) / (2 * step)
        exact = pole_terms(POLES, S, hold, late=late)[1]
        assert np.abs(slope / exact - 1).max() < 1e-6


def test_residual_terms_are_powers_and_held_integrators():
    top = 2 * np.pi * 90.0
    free = residual_terms(S, lower=2, upper=2, hold=None, top=top)
    assert np.allclose(free, [top / S, top**2 / S**2, 1 + 0 * S, S / top])
    T = 1 / 200.0
    z = np.exp(S * T)
    held = residual_terms(S, lower=2, upper=0, hold=200.0, top=1.0)
    assert np.allclose(held, [T / (z - 1), T**2 * (z + 1) / (2 * (z - 1) ** 2)])
    slow = pole_terms(np.array([-1e-6 + 0j, -2e-6 + 0j]), S, 200.0, late=0.3)[0]
    late = residual_terms(S, lower=2, upper=0, hold=200.0, top=1.0, late=0.3)
    np.testing.assert_allclose(slow[0], late[0], rtol=1e-6)
    np.testing.assert_allclose((slow[0] - slow[1]) / 1e-6, late[1], rtol=1e-5)


def test_a_fraction_of_high_enough_order_finds_every_pole():
    H = modal_frf(FREQ, POLES, PHI, PHI[:2])
    found = Moments(FREQ, H, np.ones((4, FREQ.size)), 16).solve([16], np.isfinite)[0]
    for k, p in enumerate(POLES):
        place = np.argmin(np.abs(found.poles - p))
        assert abs(found.poles[place] / p - 1) < 1e-5
        for shape, want in ((found.shapes, PHI[:, k]), (found.participation, PHI[:2, k])):
            unit = shape[:, place] / np.linalg.norm(shape[:, place])
            assert abs(unit.conj() @ want) / np.linalg.norm(want) == pytest.approx(1, abs=1e-4)


@pytest.mark.parametrize("order", [1, 6])
def test_a_repeated_pole_of_a_fraction_has_two_participations(order):
    """``R / (z - z_0)`` with R of rank two, z over 0.9 of the circle; other poles are not made."""
    step = 0.9 / (FREQ[-1] - FREQ[0])
    z = np.exp(2j * np.pi * (FREQ - FREQ.mean()) * step)
    R = PHI[:, :2] @ PHI[:2, :2].T
    H = R[:, :, None] / (z - 0.98)
    double = np.log(0.98) / step + 2j * np.pi * FREQ.mean()
    moments = Moments(FREQ, H, np.ones((4, FREQ.size)), order)
    (found,) = moments.solve([order], lambda poles: np.abs(poles / double - 1) < 1e-6)
    assert found.poles.size == 2
    assert np.linalg.svd(found.participation, compute_uv=False)[-1] > 0.1
    left = found.shapes - R @ np.linalg.lstsq(R, found.shapes)[0]
    assert np.linalg.norm(left) < 1e-6
    assert moments.solve([order], lambda poles: poles.imag < 0)[0].poles.size == 0


def test_an_frf_carries_its_doubt(tmp_path):
    rng = np.random.default_rng(1)
    variance = rng.random((2, 2, 3))
    correlation = np.repeat(np.array([[1.0, 0.5j], [-0.5j, 1.0]])[:, :, None], 3, axis=2)
    frf = Frf(
        [1.0, 2.0, 3.0],
        np.ones((2, 2, 3)),
        quantity="displacement",
        variance=variance,
        correlation=correlation,
    )
    part = frf.select(outputs=["y2"], inputs=["u1"])
    assert np.array_equal(part.variance, variance[1:, :1])
    assert part.correlation.shape == (1, 1, 3)
    fast = frf.converted("acceleration")
    assert np.allclose(fast.variance, variance * (2 * np.pi * frf.freq) ** 4)
    frf.save(tmp_path / "f.npz")
    again = load(tmp_path / "f.npz")
    assert np.array_equal(again.variance, variance)
    assert np.array_equal(again.correlation, correlation)
    for change, error in (
        ({"variance": -variance}, ModelError),
        ({"variance": variance[:1]}, ShapeError),
        ({"correlation": 2 * correlation}, ModelError),
        ({"correlation": correlation * 1j}, ModelError),
        ({"correlation": correlation[:1]}, ShapeError),
    ):
        with pytest.raises(error, match=next(iter(change))):
            frf.replace(**change)


def test_measured_shapes_are_kept_with_their_poles(tmp_path):
    shapes = np.array([[1.0, 2j], [1j, -1.0]])
    measured = MeasuredModes([-1 + 10j, -2 - 20j], shapes=shapes, dofs=["1:z", "2:z"], modes=[4, 6])
    assert np.array_equal(measured.shapes, np.column_stack([shapes[:, 0], shapes[:, 1].conj()]))
    picked = measured.replace(covariance=[1.0, 2.0]).select([1])
    assert (picked.modes, picked.poles.tolist()) == ((6,), [-2 + 20j])
    assert np.array_equal(picked.covariance, np.eye(2))
    assert np.array_equal(picked.shapes[:, 0], measured.shapes[:, 1])
    measured.save(tmp_path / "m.npz")
    assert load(tmp_path / "m.npz").dofs == ("1:z", "2:z")
    for wrong in ([0, 0], [2], []):
        with pytest.raises(LabelError, match="select"):
            measured.select(wrong)


@pytest.mark.parametrize(
    ("shapes", "dofs", "error"),
    [
        (np.ones((2, 2)), None, ShapeError),
        (None, ["1:z"], ShapeError),
        (np.ones((2, 1)), ["1:z", "2:z"], ShapeError),
        (np.ones((2, 2)), ["1:z", "1:z"], LabelError),
        (np.zeros((2, 2)), ["1:z", "2:z"], ModelError),
        (np.full((2, 2), np.nan), ["1:z", "2:z"], ModelError),
    ],
)
def test_bad_shapes_are_refused(shapes, dofs, error):
    with pytest.raises(error):
        MeasuredModes([-1 + 10j, -2 + 20j], shapes=shapes, dofs=dofs)

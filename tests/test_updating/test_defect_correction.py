"""Defect correction: the fit of a reduced model ends where that of the full model would."""

import numpy as np
import pytest
import scipy.linalg as la
from scipy import stats

from flexplant.errors import FlexplantWarning, ModelError, ShapeError
from flexplant.identification import MeasuredModes
from flexplant.structure import PointMass, kirchhoff_plate
from flexplant.updating import AddedMass, Eigenvalues, MatrixParameter, family, update
from flexplant.updating.full_basis import FullBasis
from other_plate import TRUTH, OtherPlate


@pytest.fixture(scope="module")
def machine():
    return OtherPlate()


def distances(machine, data, estimates):
    """How far each estimate is from the full model's, in standard deviations; densely, by hand.

    One Gauss-Newton step of the full model from the last estimate, with central differences.
    """
    sigma = np.sqrt(machine.variance / 2)

    def residuals(p):
        gap = (data - machine.exact(p)) / sigma
        return np.concatenate([gap.real.ravel(), gap.imag.ravel()])

    last = estimates[-1]
    J = np.array([(residuals(last + h) - residuals(last - h)) / 2e-4 for h in 1e-4 * np.eye(5)]).T
    full = last - np.linalg.lstsq(J, residuals(last))[0]
    std = np.sqrt(np.diag(np.linalg.inv(J.T @ J)))
    return np.abs((estimates - full) / std).max(axis=1)


@pytest.mark.slow
def test_responses_end_at_the_estimate_of_the_full_model(machine):
    """64 standard deviations off on the reduced model alone."""
    [data] = machine.responses(np.random.default_rng(0))
    with pytest.warns(FlexplantWarning, match="not converged"):
        update(machine.rom, machine.unknowns, [data], full=machine.full, rounds=1)
    fit = update(machine.rom, machine.unknowns, [data], full=machine.full, rounds=3)
    far = distances(machine, data.measured.data, fit.rounds)
    assert far[0] > 20
    assert far[2] < 0.15
    assert far[3] < 1e-3
    assert fit.p_value > 1e-3
    np.testing.assert_array_equal(fit.rounds[-1], fit.values)


@pytest.mark.slow
@pytest.mark.parametrize("kind", [pytest.param("responses", marks=pytest.mark.long), "modes"])
def test_the_covariance_is_that_of_the_errors(machine, kind):
    """5 noisy measurements, 5 unknowns: ``(p - p_true)^T C^-1 (p - p_true)`` is chi-square."""
    total = wrong = 0.0
    for seed in range(5):
        data = getattr(machine, kind)(np.random.default_rng(seed))
        fit = update(machine.rom, machine.unknowns, data, full=machine.full, starts=1)
        total += (fit.values - TRUTH) @ np.linalg.solve(fit.covariance, fit.values - TRUTH)
        if seed == 0:
            gap = fit.rounds[0] - TRUTH
            wrong = gap @ np.linalg.solve(fit.covariance, gap)
            assert wrong > 10 * stats.chi2.isf(1e-4, 5) / 5
    assert 1e-3 < stats.chi2.sf(total, 25) < 1 - 1e-3


def test_damping_of_the_reduced_model_is_that_of_the_full_one(machine):
    """D of the full model is not known: its first modes are damped as the reduced model's are."""
    full = machine.full.replace(D=None)
    basis = FullBasis(full, machine.unknowns[:2], [], machine.rom)
    wide = basis.at(np.zeros(2))
    modes = wide.modes()
    known = machine.rom.modes()
    np.testing.assert_allclose(modes.freq[3:15], known.freq[3:15], rtol=1e-9)
    np.testing.assert_allclose(modes.zeta[3:15], 0.008, rtol=1e-9)
    # and the matrices of the full structure are projected
    T = wide.T
    np.testing.assert_allclose(T.T @ (full.M @ T), np.eye(wide.n_dof), atol=1e-11)


@pytest.mark.slow
def test_a_full_model_is_updated_in_a_basis():
    """495 DOFs, 0.4 kg: from poles that are solved densely."""
    full = kirchhoff_plate(
        size=(0.6, 0.5),
        thickness=0.02,
        elements=(14, 10),
        density=2702,
        youngs_modulus=70e9,
        poisson_ratio=0.35,
    )
    at = full.dofs.nearest((0.31, 0.17, 0.0), "z")
    heavy = full.with_parts([PointMass(at, 0.4)])
    omega = np.sqrt(la.eigh(heavy.K.toarray(), heavy.M.toarray(), subset_by_index=[3, 8])[0])
    data = Eigenvalues(MeasuredModes((1j - 1e-9) * omega, modes=range(4, 10)))
    fit = update(full, [AddedMass(at)], [data])
    assert fit.values[0] == pytest.approx(0.4, rel=1e-8)
    modes = fit.modes(count=9)
    np.testing.assert_allclose(2 * np.pi * modes.freq[3:], omega, rtol=1e-8)


def test_what_does_not_go_together_is_refused(machine, monkeypatch):
    data = machine.responses(np.random.default_rng(0))
    with pytest.raises(ModelError, match="needs a reduced model"):
        update(machine.full, machine.unknowns, data, full=machine.full)
    other = kirchhoff_plate(
        size=(0.6, 0.5),
        thickness=0.02,
        elements=(2, 2),
        density=2702,
        youngs_modulus=70e9,
        poisson_ratio=0.35,
    )
    with pytest.raises(ModelError, match="belong to different structures"):
        update(machine.rom, machine.unknowns, data, full=other)
    own = [MatrixParameter("E", dK=machine.rom.K)]
    with pytest.raises(ShapeError, match="full model needs the matrices of all"):
        update(machine.rom, own, data, full=machine.full)
    monkeypatch.setattr(family, "LARGE", 100)
    monkeypatch.setattr(family, "TOO_LARGE", 120)
    with pytest.raises(ModelError, match=r"126 DOFs \(limit 120\).*full=model"):
        update(machine.full, machine.unknowns, data)

"""Chi-square of an update, what a bad fit says, poles in Hz, and starts from far away."""

import warnings

import numpy as np
import pytest
import scipy.linalg as la
from scipy import stats
from scipy.optimize import minimize_scalar

import oracles_updating as oracle
from flexplant.errors import FlexplantWarning, ModelError
from flexplant.identification import MeasuredModes
from flexplant.lti import Frf
from flexplant.updating import (
    AddedDamping,
    AddedMass,
    AddedStiffness,
    Eigenvalues,
    FrfResidual,
    MatrixParameter,
    ModeShapes,
    TrustRegion,
    update,
)

LINKS = [(0, None, 90), (0, 1, 110), (1, 2, 70), (2, 3, 130), (3, None, 60)]


@pytest.fixture
def chain(make):
    return make([1, 2, 1.5, 1.2], LINKS, beta=2e-3)


def heavier(model, place=1, mass=0.3):
    M = np.array(model.M)
    M[place, place] += mass
    return oracle.poles(M, model.D, model.K)


@pytest.mark.slow
@pytest.mark.parametrize(
    ("weights", "prior"),
    [
        (None, False),
        pytest.param([1.0, 9.0, 0.2, 3.0], False, marks=pytest.mark.long),
        pytest.param(None, True, marks=pytest.mark.long),
    ],
)
def test_chi_square_is_that_of_noise(chain, weights, prior):
    """150 noisy measurements: p-values are uniform, whatever the weights, with priors and not."""
    truth = heavier(chain)
    rng = np.random.default_rng(5)
    A = rng.normal(size=(8, 8)) * 2e-3
    C = A @ A.T + 1e-6 * np.eye(8)
    root = np.linalg.cholesky(C)
    found = []
    for _ in range(150):
        noise = root @ rng.normal(size=8)
        poles = MeasuredModes(truth + noise[:4] + 1j * noise[4:], modes=[1, 2, 3, 4], covariance=C)
        known = (0.3 + 0.01 * rng.normal(), 0.01) if prior else None
        unknowns = [AddedMass("2:z", prior=known), AddedDamping("3:z")]
        data = [Eigenvalues(poles, weights=weights)]
        fit = update(chain, unknowns, data, method=TrustRegion() if prior else None, starts=1)
        assert fit.dof == (7 if prior else 6)
        assert fit.p_value == pytest.approx(stats.chi2.sf(fit.chi2, fit.dof), rel=1e-9)
        found.append(fit.p_value)
    assert stats.kstest(found, "uniform").pvalue > 1e-3


@pytest.mark.slow
def test_a_bad_fit_warns_names_and_weighs_anew(chain):
    """A mass looked for at 2:z while a spring changed: chi-square says so, with names.

    It is that of the noise alone, at the mass where it is least; the parameter then counts what the
    model is off by.
    """
    M, D, K = (np.array(part) for part in (chain.M, chain.D, chain.K))
    K[3, 3] += 25.0
    poles = oracle.poles(M, D, K)
    std = 1e-4 * np.abs(poles)
    data = [Eigenvalues(MeasuredModes(poles, modes=[1, 2, 3, 4], covariance=std**2))]
    with pytest.warns(FlexplantWarning, match="leaves more than noise") as said:
        fit = update(chain, [AddedMass("2:z")], data)

    def left(mass):
        heavy = M + np.diag([0, mass, 0, 0])
        return np.abs(oracle.poles(heavy, D, chain.K) - poles) / (std / np.sqrt(2))

    least = minimize_scalar(lambda mass: np.sum(left(mass) ** 2), bounds=(-0.9, 1.0))
    gap = left(least.x)
    M[1, 1] += fit.values[0]
    assert fit.chi2 == pytest.approx(np.sum(gap**2), rel=0.02)
    assert fit.dof == 7
    assert fit.p_value < 1e-12
    order = [f"mode {i + 1} " for i in np.argsort(-gap)[:3]]
    text = str(said[0].message)
    assert [text.index(name) for name in order] == sorted(text.index(name) for name in order)
    assert "localise" in text
    # what the model is off by counts as noise, as large as what is left of the frequencies
    off = {one.kind: one.deviation for one in fit.discrepancy}
    left_over = np.abs(oracle.poles(M, D, chain.K)) / np.abs(poles) - 1.0
    assert 0.5 < off["frequency"] / np.sqrt(np.mean(left_over**2)) < 2.0
    J = [
        oracle.complex_step(M, D, chain.K, [np.diag([0, 1.0, 0, 0]), 0 * M, 0 * M], a)[1]
        for a in range(4)
    ]
    formal = 1 / np.sum(np.abs(J / (std / np.sqrt(2))) ** 2)
    assert fit.std[0] > 50 * formal**0.5
    assert "of frequency" in repr(fit)
    assert f"chi2 {fit.chi2:.4g} for 7 dof" in repr(fit)
    # what was looked for is there: neither
    right = update(chain, [AddedStiffness("4:z")], data)
    assert right.p_value > 0.99
    assert right.values[0] == pytest.approx(25.0, rel=1e-3)


@pytest.mark.slow
def test_responses_that_a_model_does_not_explain_print_no_deviation(chain):
    """Coherent misfit of 45 lines is no noise: what +- would be is not known, and not printed."""
    K, noise = np.array(chain.K), np.random.default_rng(3).normal(size=(2, 4, 1, 45))
    freq, std = np.linspace(0.3, 3.2, 45), 1e-5
    for stiffer, printed in ((0.0, True), (25.0, False)):
        K[3, 3] += stiffer
        s = 2j * np.pi * freq
        heavy = np.array(chain.M) + np.diag([0, 0.3, 0, 0])
        H = np.array([np.linalg.inv(z * z * heavy + z * chain.D + K)[:, :1] for z in s])
        H = np.moveaxis(H, 0, 2) + std * (noise[0] + 1j * noise[1]) / np.sqrt(2)
        frf = Frf(freq, H, inputs=["1:z"], outputs=[f"{k}:z" for k in range(1, 5)])
        with warnings.catch_warnings(record=True) as said:
            warnings.simplefilter("always")
            fit = update(chain, [AddedMass("2:z")], [FrfResidual(frf, variance=std**2)])
        assert (fit.p_value > 1e-3) == printed
        assert any("more than noise" in str(one.message) for one in said) != printed
        named = [line for line in repr(fit).splitlines() if "mass at 2:z =" in line]
        assert len(named) == 1 and ("+-" in named[0]) == printed
        assert ("no +-: the residual is coherent" in repr(fit)) != printed


@pytest.mark.slow
def test_a_negative_mass_is_remarked_on(chain):
    poles = heavier(chain, mass=-0.4)
    data = MeasuredModes(poles, modes=[1, 2, 3, 4], covariance=(1e-3 * np.abs(poles)) ** 2)
    fit = update(chain, [AddedMass("2:z"), AddedMass("4:z")], [Eigenvalues(data)])
    assert fit.negative_masses == ("mass at 2:z",)
    assert "  negative: mass at 2:z" in repr(fit)
    # and in the warning where the place is wrong: a spring there was stiffened
    K = np.array(chain.K)
    K[1, 1] += 30.0
    poles = oracle.poles(chain.M, chain.D, K)
    data = MeasuredModes(poles, modes=[1, 2, 3, 4], covariance=(1e-4 * np.abs(poles)) ** 2)
    with pytest.warns(FlexplantWarning, match="mass at 2:z became negative"):
        update(chain, [AddedMass("2:z")], [Eigenvalues(data)])


def test_without_noise_there_is_no_chi_square(chain):
    data = [Eigenvalues(MeasuredModes(heavier(chain), modes=[1, 2, 3, 4]))]
    fit = update(chain, [AddedMass("2:z")], data)
    assert (fit.chi2, fit.dof, fit.p_value) == (None, 7, None)


@pytest.mark.slow
@pytest.mark.parametrize(("factor", "where"), [(1 / (2 * np.pi), "below"), (2 * np.pi, "above")])
def test_poles_in_hz_are_seen(plate, factor, where):
    rom = plate.reduced(0.01, True)
    data = [Eigenvalues(MeasuredModes(oracle.truth(0.01) * factor, modes=[6, 7]))]
    with pytest.raises(ModelError, match=rf"a factor of 2 pi {where} those of the model.*rad/s"):
        update(rom, [AddedMass(plate.z8), AddedDamping(plate.z8)], data)


# ---- from far away


def changed_plate(plate, zeta, mass, stiffer):
    M, K = oracle.plate()
    D = oracle.modal_damping(M, K, zeta)
    at = oracle.z_dof(0.3, 0.15)
    M[at, at] += mass
    return M, D, (1 + stiffer) * K


@pytest.mark.slow
@pytest.mark.parametrize(
    ("zeta", "mass", "stiffer"),
    [(0.01, 0.7, -0.09), pytest.param(0.002, 0.6, 0.05, marks=pytest.mark.long)],
)
def test_responses_are_fitted_from_far_away(plate, zeta, mass, stiffer):
    """Peaks far from those of the model: by magnitude first it is found, at once it is not."""
    M, D, K = changed_plate(plate, zeta, mass, stiffer)
    corners = [(0.0, 0.0), (0.6, 0.6), (0.3, 0.3), (0.0, 0.6)]
    rows = [oracle.z_dof(*xy) for xy in corners]
    freq = np.linspace(100, 1400, 150)
    s = 2j * np.pi * freq
    force = np.eye(len(M))[:, rows[:1]] + 0j
    H = np.array([np.linalg.solve(z * z * M + z * D + K, force)[rows[1:]] for z in s])
    H = np.moveaxis(H, 0, 2)
    std = 0.01 * np.median(np.abs(H))
    rng = np.random.default_rng(1)
    H = H + std * (rng.normal(size=H.shape) + 1j * rng.normal(size=H.shape)) / np.sqrt(2)
    names = [plate.model.dofs.nearest((*xy, 0.0), "z") for xy in corners]
    data = FrfResidual(Frf(freq, H, inputs=names[:1], outputs=names[1:]), variance=std**2)
    unknowns = [AddedMass(plate.z8), AddedDamping(plate.z8), MatrixParameter("E", dK=plate.model.K)]
    rom = plate.reduced(zeta, True)
    with warnings.catch_warnings():
        # what truncation leaves is more than this noise
        warnings.simplefilter("ignore", FlexplantWarning)
        fit = update(rom, unknowns, [data])
        near = update(rom, unknowns, [data], start=np.zeros(3), starts=1)
    assert fit.converged
    assert fit.values[0] == pytest.approx(mass, rel=0.01)
    assert fit.values[2] == pytest.approx(stiffer, rel=0.02)
    assert np.array_equal(fit.history.parameters[0], np.zeros(3))
    assert near.chi2 > 100 * fit.chi2
    assert abs(near.values[0] - mass) > 0.2 * mass


@pytest.mark.slow
def test_poles_come_before_shapes(plate):
    """Two masses and a modulus: shapes from far away lead astray, poles do not."""
    near = plate.model.dofs.nearest((0.15, 0.45, 0.0), "z")
    M, _, K = changed_plate(plate, 0.01, 2.1, 0.05)
    at = oracle.z_dof(0.15, 0.45)
    M[at, at] += 0.7
    square, phi = la.eigh(K, M)
    omega, labels = np.sqrt(square[3:11]), plate.grid[::2]
    psi = phi[[plate.model.dofs.index(label) for label in labels], 3:11]
    std = np.tile(1e-3 * np.abs(psi).max(axis=0), (len(labels), 1))
    poles = MeasuredModes((1j - 0.01) * omega, modes=range(4, 12), covariance=(1e-4 * omega) ** 2)
    data = [Eigenvalues(poles), ModeShapes(poles, psi, labels, std=std)]
    unknowns = [AddedMass(plate.z8), AddedMass(near), MatrixParameter("E", dK=plate.model.K)]
    rom = plate.reduced(0.01, True)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", FlexplantWarning)
        fit = update(rom, unknowns, data)
        lost = update(rom, unknowns, data, start=np.zeros(3), starts=1)
    np.testing.assert_allclose(fit.values, [2.1, 0.7, 0.05], rtol=0.05)
    assert lost.chi2 > 100 * fit.chi2

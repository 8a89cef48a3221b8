"""All the way from noisy responses to whitened shape residuals at the true model: chi-square."""

import numpy as np
import pytest
import scipy.linalg as la

from flexplant import DofSet
from flexplant.identification import PoleSelection, average_frfs, identify_modes
from flexplant.lti import Frf
from flexplant.structure import FEModel
from flexplant.updating import AddedMass, ModeShapes
from flexplant.updating.search import Objective

M = np.diag([1.0, 2.0, 1.5, 1.2])
K = np.array([[200.0, -110, 0, 0], [-110, 180, -70, 0], [0, -70, 200, -130], [0, 0, -130, 190]])
D = np.diag([0.2, 0.05, 0.4, 0.1])  # complex modes
PLACES = ["1:z", "2:z", "3:z", "4:z"]
FREQ = np.arange(0.5, 3.2, 0.01)


def truth():
    """Complex poles and vectors by the companion matrix."""
    A = np.block([[np.zeros((4, 4)), np.eye(4)], [-la.solve(M, K), -la.solve(M, D)]])
    poles, vectors = la.eig(A)
    keep = np.flatnonzero(poles.imag > 0)
    keep = keep[np.argsort(np.abs(poles[keep]))]
    return poles[keep], vectors[:4, keep]


def response():
    s = 2j * np.pi * FREQ
    return np.array([la.inv(M * x**2 + D * x + K) for x in s]).transpose(1, 2, 0)


def noise(H, sensor, force):
    """Roots (lines, 4, 8) of the errors' covariance: of sensors, and of forces at all masses."""
    own = np.broadcast_to(sensor * np.eye(4), (FREQ.size, 4, 4))
    return np.concatenate([own, force * H.transpose(2, 0, 1)], axis=2)


def drawn(root, rng):
    e = rng.normal(size=(8, 2, FREQ.size)) + 1j * rng.normal(size=(8, 2, FREQ.size))
    return np.einsum("fak,kif->aif", root, e) / np.sqrt(2)


def residual_of(frf):
    poles, vectors = truth()
    found = identify_modes(frf, start=PoleSelection(poles, vectors[:2]), lower=0, upper=0)
    dofs = DofSet([1, 2, 3, 4], ["z"] * 4, [[float(i), 0.0, 0.0] for i in range(4)])
    residual = ModeShapes(found.replace(modes=(1, 2, 3, 4)), at=PLACES)
    objective = Objective(FEModel(M, K, D, dofs=dofs), [AddedMass("2:z")], [residual])
    return objective.values(objective.begin(np.zeros(1)))


#: real numbers of four complex shapes of four entries, a complex scale of each taken out
FREE = 4 * 2 * 3
TRIALS = 20
#: three standard deviations of the mean of so many chi-squares
MARGIN = 3 * np.sqrt(2 / FREE / TRIALS)


def sums(force, *, known):
    """Sum of squares over its expectation for many noisy measurements, and without correlation."""
    H, rng = response(), np.random.default_rng(5)
    level = 1e-2 * np.sqrt(np.mean(np.abs(H[:, :2]) ** 2))
    root = noise(H, 0.1 * level, force)
    C = root @ root.conj().transpose(0, 2, 1)
    std = np.sqrt(np.einsum("faa->fa", C).real)
    variance = np.repeat((std**2).T[:, None], 2, axis=1)
    correlation = (C / std[:, :, None] / std[:, None]).transpose(1, 2, 0)
    found, blind = [], []
    for _ in range(TRIALS):
        if known:
            data = H[:, :2] + drawn(root, rng)
            frf = Frf(FREQ, data, variance=variance, correlation=correlation)
        else:
            repeats = [Frf(FREQ, H[:, :2] + np.sqrt(8) * drawn(root, rng)) for _ in range(8)]
            frf = average_frfs(repeats)
        found.append(np.sum(residual_of(frf) ** 2) / FREE)
        blind.append(np.sum(residual_of(frf.replace(correlation=None)) ** 2) / FREE)
    return np.mean(found), np.mean(blind)


@pytest.mark.long
def test_whitened_shape_residuals_are_chi_square():
    """Forces' noise moves all sensors along the shape at a resonance: correlation must count."""
    found, blind = sums(0.05, known=True)
    assert found == pytest.approx(1.0, abs=MARGIN)
    assert blind < 0.5


@pytest.mark.long
def test_and_with_sensor_noise_alone():
    found, blind = sums(0.0, known=True)
    assert found == pytest.approx(1.0, abs=MARGIN)
    assert blind == pytest.approx(found, rel=1e-6)


@pytest.mark.long
@pytest.mark.filterwarnings("ignore:more than noise")  # few runs: some lines look too certain
def test_and_with_doubt_from_repeated_measurements():
    """Eight runs: variances of 14 degrees of freedom, which weights and doubt are made from."""
    found, _ = sums(0.05, known=False)
    print(f"chi-square over its expectation {found:.3f}")
    assert found == pytest.approx(1.0, abs=0.15 + MARGIN)

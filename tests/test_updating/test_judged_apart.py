"""What has a covariance is judged, whatever stands next to it without one."""

import warnings

import numpy as np
import pytest
import scipy.linalg as la

import flexplant as fx

N, DEVIATION, DAMPING = 6, 2e-3, 40.0  # 1/s: D = DAMPING M
M, SPRINGS = np.linspace(1.0, 2.0, N), np.linspace(2e6, 1e6, N)
PLACES = [f"{i}:x" for i in range(1, N + 1)]


def stiffness(springs):
    """A chain of springs, the first to the ground."""
    lower = np.eye(N) - np.eye(N, k=-1)
    return lower.T @ np.diag(springs) @ lower


def model():
    xyz = np.column_stack([np.arange(N), np.zeros((N, 2))])
    dofs = fx.DofSet(range(1, N + 1), ["x"] * N, xyz)
    return fx.FEModel(np.diag(M), stiffness(SPRINGS), np.diag(DAMPING * M), dofs=dofs)


def spring(i):
    return fx.MatrixParameter(f"k{i}", dK=stiffness(np.eye(N)[i] * SPRINGS[i]))


def data(rng, factors, *, modes=4, shape_noise=0.02):
    """Noisy poles with their covariance, and noisy shapes, of a chain with other springs."""
    values, phi = la.eigh(stiffness(SPRINGS * factors), np.diag(M))
    omega, phi = np.sqrt(values[:modes]), phi[:, :modes]
    noise = DEVIATION * omega * (rng.standard_normal(modes) + 1j * rng.standard_normal(modes))
    poles = -DAMPING / 2 + 1j * np.sqrt(omega**2 - DAMPING**2 / 4) + noise
    covariance = np.diag(np.tile((DEVIATION * omega) ** 2, 2))
    size = np.linalg.norm(phi, axis=0)
    shapes = phi + shape_noise * size / np.sqrt(N) * rng.standard_normal(phi.shape)
    measured = fx.MeasuredModes(poles, modes=range(1, modes + 1), covariance=covariance)
    return measured, shapes, shape_noise * np.tile(size / np.sqrt(N), (N, 1))


def residuals(kind, measured, shapes, std):
    """One residual with its noise beside one without."""
    bare = fx.MeasuredModes(measured.poles, modes=measured.modes)
    at = {"at": PLACES, "direction": "x"}
    if kind == "poles judged":
        return [fx.Eigenvalues(measured), fx.ModeShapes(measured, shapes, **at)]
    if kind == "weighted poles judged":
        weights = 1e-3 / np.abs(measured.poles) ** 2
        return [
            fx.Eigenvalues(measured, weights=weights),
            fx.updating.ShapeCorrelation(measured, shapes, **at),
        ]
    if kind == "shapes judged":
        return [fx.Eigenvalues(bare), fx.ModeShapes(bare, shapes, std=std, **at)]
    return [fx.Eigenvalues(measured), fx.updating.ShapeCorrelation(bare, shapes, **at)]


KINDS = ["poles judged", "weighted poles judged", "shapes judged", "poles beside a MAC"]


@pytest.mark.slow
@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.parametrize("seed", range(4))
def test_a_wrong_parameter_warns(kind, seed):
    rng = np.random.default_rng(seed)
    changed, fitted = rng.permutation(N)[:2].tolist()
    factors = np.ones(N)
    factors[changed] = rng.choice([0.4, 2.5])
    given = residuals(kind, *data(rng, factors))
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        fit = fx.update(model(), [spring(fitted)], given)
    assert any("leaves more than noise" in str(one.message) for one in caught)
    assert fit.p_value < 1e-4 and fit.chi2 > 3 * fit.dof


@pytest.mark.slow
@pytest.mark.parametrize("kind", KINDS)
def test_noise_alone_warns_of_nothing(kind):
    """Chi-square has the mean and the spread that its degrees of freedom say."""
    ratios, scores = [], []
    for seed in range(20):
        rng = np.random.default_rng(seed)
        chosen = rng.permutation(N)[:2].tolist()
        factors = np.ones(N)
        factors[chosen] = true = rng.uniform(0.8, 1.2, 2)
        given = residuals(kind, *data(rng, factors))
        with warnings.catch_warnings():
            warnings.simplefilter("error")
            fit = fx.update(model(), [spring(i) for i in chosen], given)
        assert fit.converged and fit.p_value > 1e-4
        ratios.append((fit.chi2 - fit.dof) / np.sqrt(2 * fit.dof))
        scores.append((fit.values - (true - 1)) / fit.std)
    assert abs(np.mean(ratios)) < 4 / np.sqrt(20)
    # 20 pairs; the residual of a MAC is a square of noise, so that its scale is a careful one
    least = 0.2 if "weighted" in kind else 0.5
    assert least < np.mean(np.square(scores)) < 2.2

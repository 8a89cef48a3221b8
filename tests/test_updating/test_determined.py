"""Every search ends with a rank test: what the data do not determine is said, never "converged"."""

import re
import warnings

import numpy as np
import pytest
import scipy.linalg as la

import flexplant as fx
from flexplant.errors import FlexplantWarning


class Building:
    """Storeys of random masses and stiffnesses; each parameter scales one storey or several."""

    def __init__(self, seed, twins=False):
        self.rng = rng = np.random.default_rng(seed)
        n = int(rng.integers(3, 7))
        self.m, k = rng.uniform(0.5, 2.0, n), rng.uniform(0.5e6, 2e6, n)
        parts = np.zeros((n, n, n))
        for i in range(n):
            ends = [i - 1, i] if i else [0]
            parts[i][np.ix_(ends, ends)] = k[i] * (np.array([[1, -1], [-1, 1]]) if i else 1.0)
        self.K = parts.sum(axis=0)
        chosen = rng.permutation(n)[: int(rng.integers(2, n + 1))]
        self.dK = parts[chosen]
        if twins:
            self.dK = np.concatenate([self.dK, self.dK[:1]])
        xyz = np.column_stack([np.zeros((n, 2)), np.arange(n)])
        self.model = fx.FEModel(
            np.diag(self.m), self.K, dofs=fx.DofSet(range(1, n + 1), ["x"] * n, xyz)
        )
        self.parameters = [fx.MatrixParameter(f"k{i}", dK=d) for i, d in enumerate(self.dK, 1)]
        self.true = rng.uniform(-0.15, 0.15, len(self.dK))
        self.modes = np.sort(rng.permutation(n)[: int(rng.integers(1, n))])
        self.at = np.sort(rng.permutation(n)[: int(rng.integers(2, n + 1))])

    def solved(self, p):
        """Squares of frequencies, and shapes, of the measured modes, by scipy alone."""
        values, phi = la.eigh(self.K + np.tensordot(p, self.dK, 1), np.diag(self.m))
        return values[self.modes], phi[np.ix_(self.at, self.modes)]

    def every(self, p):
        """All squares of frequencies, relative to the largest."""
        found = la.eigvalsh(self.K + np.tensordot(p, self.dK, 1), np.diag(self.m))
        return found / found[-1]

    def jacobian(self, p, shapes):
        """What the data change by with the parameters: relatively, shapes up to their scale."""
        square, phi = self.solved(p)
        rows = []
        for step in 1e-5 * np.eye(len(p)):
            (up, high), (down, low) = self.solved(p + step), self.solved(p - step)
            high, low = high * np.sign(np.sum(high * phi, 0)), low * np.sign(np.sum(low * phi, 0))
            turned = (high - low) / 2e-5
            turned = turned - phi * np.sum(phi * turned, 0) / np.sum(phi**2, 0)
            turned = turned / np.linalg.norm(phi, axis=0)
            rows.append(np.r_[(up - down) / 4e-5 / square, turned.ravel() if shapes else []])
        return np.array(rows).T

    def residuals(self, shapes, *, weight=None):
        square, phi = self.solved(self.true)
        omega = np.sqrt(square)
        measured = fx.MeasuredModes(poles=1j * omega, modes=(self.modes + 1).tolist())
        weights = None if weight is None else np.full(omega.size, weight)
        found = [fx.Eigenvalues(measured, weights=weights)]
        if shapes:
            places = [f"{i + 1}:x" for i in self.at]
            found.append(fx.ModeShapes(measured, phi, places, direction="x"))
        return found


def combination(text, names):
    """The coefficients of a printed combination."""
    signed = re.sub(r"- ", "-", re.sub(r"\+ ", "+", text)).split()
    found, factor = np.zeros(len(names)), 1.0
    for word in signed:
        if word in names:
            found[names.index(word)], factor = factor, 1.0
        else:
            factor = float(word)
    return found


@pytest.mark.parametrize("seed", range(30))
def test_what_the_data_do_not_determine_is_said(seed):
    building = Building(seed)
    values = np.linalg.svd(building.jacobian(building.true, True), compute_uv=False)
    values = np.r_[values, np.zeros(len(building.dK) - values.size)]
    rank = int(np.sum(values > 1e-5 * values[0]))  # differences leave 1e-9
    method = fx.updating.TrustRegion()
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        fit = fx.update(
            building.model, building.parameters, building.residuals(True), method=method
        )
    said = [str(one.message) for one in caught if "not determined" in str(one.message)]
    if rank == len(building.dK):
        assert fit.converged and not said and fit.determined is None
        assert values[-1] < 1e-3 or np.abs(fit.values - building.true).max() < 1e-5
        return
    assert len(said) == 1 and not fit.converged
    assert fit.std is None and fit.reason == "not determined"
    assert len(fit.determined) == rank
    assert f"{rank} of {len(building.dK)} combinations" in said[0]
    assert all(text in said[0] for text in fit.determined)
    if np.min(np.diff(building.every(fit.values), prepend=0)) < 1e-3:
        return  # two modes meet there (seed 17): their shapes have no derivative
    # what is said to be determined does not change along what changes no data
    lost = la.null_space(building.jacobian(fit.values, True), rcond=1e-6)
    names = list(fit.parameters)
    for text in fit.determined:
        row = combination(text, names)
        assert np.abs(row @ lost).max() < 5e-3 * np.linalg.norm(row)


@pytest.mark.parametrize("seed", range(10))
def test_twins_are_determined_together_alone(seed):
    building = Building(seed, twins=True)
    bounded = [
        q.replace(bounds=(-0.9, 0.9)) if i % 2 else q for i, q in enumerate(building.parameters)
    ]
    residuals = building.residuals(True, weight=1e-4 * 10.0 ** (seed % 3))
    with pytest.warns(FlexplantWarning, match=r"not determined: .* determine"):
        fit = fx.update(building.model, bounded, residuals)
    # no combination holds one twin without the other
    names = list(fit.parameters)
    rows = np.array([combination(text, names) for text in fit.determined])
    assert rows[:, 0] == pytest.approx(rows[:, -1], abs=2e-3)
    assert np.abs(rows[:, 0]).max() > 0 and not fit.converged
    assert "determined only" in repr(fit)


def test_a_prior_or_a_bound_determines():
    building = Building(3, twins=True)
    building.modes = np.arange(len(building.m))
    omega = np.sqrt(building.solved(building.true)[0])
    covariance = np.diag(np.tile((1e-3 * omega) ** 2, 2))
    measured = fx.MeasuredModes(
        1j * omega, modes=(building.modes + 1).tolist(), covariance=covariance
    )
    known = [q.replace(prior=(0.0, 0.3)) for q in building.parameters]
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        fit = fx.update(building.model, known, [fx.Eigenvalues(measured)])
    assert fit.converged and fit.determined is None
    # the sum of twins is measured, their difference is what the priors say
    difference = np.eye(len(known))[0] - np.eye(len(known))[-1]
    std = np.sqrt(difference @ fit.covariance @ difference)
    assert std == pytest.approx(0.3 * np.sqrt(2), rel=0.05)

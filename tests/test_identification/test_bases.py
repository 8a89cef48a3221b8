"""Costs that bases of a fit tell, against least squares of all columns at once."""

import numpy as np
import pytest

from flexplant.identification.lines import Lines
from flexplant.identification.pole_test import fewer_terms, more_terms
from flexplant.identification.refine import PoleFit, refined
from oracles_identification import modal_frf, noisy, pole

FREQ = np.arange(8.0, 100.0, 0.25)
DEVIATION, LOWER, UPPER = 1e-4, 2, 3


def least_squares_cost(H, poles, participation):
    """The cost of the best shapes and residual terms, output by output, by numpy alone."""
    s, total = 2j * np.pi * FREQ, 0.0
    powers = [(s / 600.0) ** k for k in range(-LOWER, UPPER)]
    n_in = H.shape[1]
    for data in H:
        columns = []
        for p, along in zip(poles, participation.T, strict=True):
            first, second = along[:, None] / (s - p), along.conj()[:, None] / (s - p.conjugate())
            columns += [(first + second).ravel(), (1j * (first - second)).ravel()]
        for i in range(n_in):
            for term in powers:
                own = np.zeros((n_in, s.size), dtype=complex)
                own[i] = term
                columns.append(own.ravel())
        A = np.array([np.concatenate([c.real, c.imag]) / np.linalg.norm(c) for c in columns]).T
        b = np.concatenate([data.ravel().real, data.ravel().imag])
        rest = b - A @ np.linalg.lstsq(A, b, rcond=None)[0]
        total += float(rest @ rest)
    return 2.0 * total / DEVIATION**2


@pytest.mark.parametrize("seed", range(6))
def test_costs_with_other_poles_are_those_of_whole_fits(seed):
    rng = np.random.default_rng(seed)
    n_in, true = 1 + seed % 3, pole([20.0, 33.0, 50.0, 51.0, 77.0], [0.01] * 5)
    phi = rng.normal(size=(4, 5))
    H = noisy(modal_frf(FREQ, true, phi, phi[:n_in]), DEVIATION, rng)
    weight = np.full(H.shape, np.sqrt(2.0) / DEVIATION)
    poles, part = true * (1.0 + 1e-3 * rng.normal(size=5)), phi[:n_in].astype(complex)
    fit = PoleFit(Lines(FREQ, H, weight, lower=LOWER, upper=UPPER), poles, part)
    whole = least_squares_cost(H, poles, part)
    assert fit.cost == pytest.approx(whole, rel=1e-8)

    kept = [0, 1, 3, 4]
    costs = [
        least_squares_cost(H, poles[some], part[:, some])
        for some in ([k for k in kept if k != gone] for gone in kept)
    ]
    expected = np.array(costs) - least_squares_cost(H, poles[kept], part[:, kept])
    assert fit.rises(kept) == pytest.approx(expected, rel=1e-6)

    new, along = pole([rng.uniform(20, 90)], [0.01]), rng.normal(size=(n_in, 1)) + 0j
    more = np.append(poles, new), np.hstack([part, along])
    assert fit.cost_with(new, along) == pytest.approx(least_squares_cost(H, *more), rel=1e-8)
    two = np.append(new, 1.01 * new), np.hstack([along, along])
    rest = np.delete(poles, 2), np.delete(part, 2, axis=1)
    exchanged = np.append(rest[0], two[0]), np.hstack([rest[1], two[1]])
    expected = least_squares_cost(H, *exchanged)
    assert fit.cost_with(*two, instead=2) == pytest.approx(expected, rel=1e-8)


@pytest.mark.parametrize("seed", range(6))
def test_other_numbers_of_residual_terms_gain_what_whole_fits_gain(seed):
    """Fewer terms suffice for modes of the band; a mode just above it requires more."""
    rng = np.random.default_rng(seed)
    n_in, true = 1 + seed % 3, pole([20.0, 33.0, 50.0, 77.0, 104.0], [0.01] * 5)
    phi = 30.0 * rng.normal(size=(4, 5))
    for propose, upper, count in ((fewer_terms, 9, 4), (more_terms, 3, 5)):
        H = modal_frf(FREQ, true[:count], phi[:, :count], phi[:n_in, :count])
        H = noisy(H, DEVIATION, rng)
        weight = np.sqrt(2.0) / (DEVIATION * rng.uniform(1.0, 2.0, H.shape))
        poles, part = true[:4], phi[:n_in, :4].astype(complex)
        fit = PoleFit(Lines(FREQ, H, weight, lower=LOWER, upper=upper), poles, part)
        trials = next(iter(propose(fit)))
        assert trials
        for trial in trials:
            other = Lines(FREQ, H, weight, lower=LOWER, upper=trial.lines.upper)
            gain = fit.cost - PoleFit(other, poles, part).cost
            assert trial.gain == pytest.approx(gain, rel=1e-6)


def test_a_fit_at_its_minimum_is_returned_as_it_is():
    rng = np.random.default_rng(0)
    true, phi = pole([20.0, 33.0, 50.0], [0.01] * 3), rng.normal(size=(4, 3))
    H = noisy(modal_frf(FREQ, true, phi, phi[:2]), DEVIATION, rng)
    lines = Lines(FREQ, H, np.full(H.shape, np.sqrt(2.0) / DEVIATION), lower=LOWER, upper=UPPER)
    fit = refined(lines, true, phi[:2] + 0j, steps=20, fine=True)
    for _ in range(9):
        again, fit = fit, refined(lines, fit.poles, fit.participation, steps=20, first=fit)
    assert fit is again

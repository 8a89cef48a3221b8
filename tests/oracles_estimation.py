"""Estimation errors from the equations, dense and slow; nothing of flexplant here."""

import numpy as np
import scipy.linalg as la


def error_covariance(closed, noise):
    """Stationary covariance of e[k+1] = closed e[k] + noise, in states of similar size."""
    d = np.sqrt(np.maximum(np.diag(noise), 1e-30 * np.max(np.diag(noise))))
    for _ in range(3):
        P = la.solve_discrete_lyapunov(
            closed * d / d[:, None], noise / d / d[:, None], method="bilinear"
        )
        size = np.sqrt(np.abs(np.diag(P)))
        d = d * np.where(size > 1e-12 * size.max(), size, 1.0)
    return (
        P
        * (d / np.where(size > 1e-12 * size.max(), size, 1.0))[:, None]
        * (d / np.where(size > 1e-12 * size.max(), size, 1.0))
    )


def observer_error(plant, observer):
    """Variances of z - hat, for a truth and an observer that may be anything with its dynamics.

    plant: A, C2, C1, Q, R; observer: A, By, C, Dy. The error is a system of its own only when
    A - By C2 = A_observer and C1 - Dy C2 = C_observer: both are asserted.
    """
    scale = np.abs(plant["A"]).max()
    np.testing.assert_allclose(
        plant["A"] - observer["By"] @ plant["C2"], observer["A"], atol=1e-12 * scale
    )
    left = plant["C1"] - observer["Dy"] @ plant["C2"]
    np.testing.assert_allclose(left, observer["C"], atol=1e-12 * np.abs(plant["C1"]).max())
    noise = plant["Q"] + observer["By"] @ plant["R"] @ observer["By"].T
    P = error_covariance(observer["A"], noise)
    return np.diag(left @ P @ left.T + observer["Dy"] @ plant["R"] @ observer["Dy"].T)


def run(plant, observer, B2, u, steps, rng, count=1):
    """Errors z - hat (steps, nz, count) of runs from rest: measure, update, hold, per sample."""
    factor = plant["factor"]
    x, xo = (np.zeros((m["A"].shape[0], count)) for m in (plant, observer))
    deviation = np.sqrt(np.diag(plant["R"]))[:, None]
    errors = np.empty((steps, plant["C1"].shape[0], count))
    for k in range(steps):
        y = plant["C2"] @ x + deviation * rng.standard_normal((deviation.size, count))
        errors[k] = plant["C1"] @ x - observer["C"] @ xo - observer["Dy"] @ y
        xo = observer["A"] @ xo + observer["By"] @ y + (observer["Bu"] @ u[k])[:, None]
        w = factor @ rng.standard_normal((factor.shape[1], count))
        x = plant["A"] @ x + (B2 @ u[k])[:, None] + w
    return errors


def mean_square_and_its_error(runs):
    """Mean square of stationary Gaussian runs (steps, count), and its standard error.

    The variance of the mean square of one run is 2 / n times the sum of its squared
    autocovariance over all lags.
    """
    n, count = runs.shape
    covariance = np.fft.irfft(np.abs(np.fft.rfft(runs, 2 * n, axis=0)) ** 2, axis=0)[:n] / n
    covariance = covariance.mean(axis=1)
    lags = n // 10
    weight = 1 - np.arange(lags) / n
    total = covariance[0] ** 2 + 2 * np.sum(weight[1:] * covariance[1:lags] ** 2)
    return np.mean(runs**2), np.sqrt(2 * total / n / count)

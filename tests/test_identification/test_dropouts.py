"""A sensor that stands still for a while is named; quantised noise and rest are not."""

import warnings

import numpy as np
import pytest

from flexplant.errors import FlexplantWarning
from flexplant.identification import H1Estimator, estimate_frf


@pytest.fixture
def record():
    rng = np.random.default_rng(0)
    u = rng.normal(size=(1, 8000))
    y = np.vstack([np.convolve(u[0], [0.5, 0.3, 0.2])[:8000], 0.1 * u[0]])
    return u, y + 1e-3 * rng.normal(size=y.shape)


def estimated(u, y):
    names = {"x": y[0], "y": y[1]}
    return estimate_frf(u, names, 1000.0, method=H1Estimator(segment=0.5))


def test_a_drop_out_is_named(record):
    u, y = record
    y[1, 3000:3060] = y[1, 2999]
    with pytest.warns(FlexplantWarning, match=r"^y keeps the value .* for 61 samples from 2.999 s"):
        estimated(u, y)
    y[1, 7950:] = 0.0
    with pytest.warns(FlexplantWarning, match="for 61 samples"):
        estimated(u, y)


@pytest.mark.parametrize("step", [0.0, 0.05, 1.0])
def test_quantised_noise_and_rest_are_no_drop_outs(record, step):
    u, y = record
    y[:, :500] = 0.0
    if step:
        y = step * np.round(y / step)
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        estimated(u, y)

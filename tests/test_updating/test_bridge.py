"""The pedestrian bridge of a published study, where its data are; its numbers: the benchmarks."""

import numpy as np
import pytest

from bridges import FILE, TRUTH, Bridge, ends, noisy_fits

pytestmark = pytest.mark.skipif(not FILE.exists(), reason="the bridge's data are not here")


@pytest.fixture(scope="module")
def bridge():
    return Bridge()


@pytest.mark.long
def test_the_truth_is_reached_from_stored_starts(bridge):
    assert ends(bridge, bridge.starts[:2]).max() < 1e-8


@pytest.mark.long
def test_noise_leaves_the_published_error_and_an_honest_doubt(bridge):
    error, score = noisy_fits(bridge, 8, bounds=(-1, 1))
    assert error < 0.11
    assert 0.8 < score < 1.25
    assert error < 0.5 * np.sqrt(np.mean(TRUTH**2))
    # the prior does it, on the same noise
    plain, _ = noisy_fits(bridge, 8)
    assert plain > 1.3 * error

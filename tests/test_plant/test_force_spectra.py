"""Forces with a spectrum: their rms and drift by the norms of the filters."""

import numpy as np
import pytest

from flexplant.lti import h2_norm
from flexplant.plant import FirstOrder, NarrowBand, RandomWalk


@pytest.mark.parametrize(
    "spectrum", [FirstOrder(2.0, 3.0), NarrowBand(2.0, 50.0, 0.02), RandomWalk(2.0, 1e-3)]
)
def test_rms_is_that_of_the_filter(spectrum):
    """White noise of density asd: variance asd^2 / 2 times the squared H2 norm."""
    wanted = spectrum.asd / np.sqrt(2) * h2_norm(spectrum.shape)
    assert spectrum.rms == pytest.approx(wanted, rel=1e-10, abs=0)
    force = spectrum.force("pump", at="1:x")
    assert (force.asd, force.shape.n_states) == (spectrum.asd, spectrum.shape.n_states)
    assert spectrum.floor("floor").asd == spectrum.asd


def test_a_random_walk_drifts_as_stated():
    walk, dt = RandomWalk(3.0), 0.01
    omega = -walk.shape.A[0, 0]
    step = (walk.asd * walk.shape.B[0, 0]) ** 2 / 2 * -np.expm1(-2 * omega * dt) / (2 * omega)
    assert step == pytest.approx(3.0**2 * dt, rel=1e-4, abs=0)

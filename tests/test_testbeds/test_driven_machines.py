"""Eight driven machines: slides, sizes, and a mode by hand."""

import numpy as np
import pytest
from scipy.linalg import eigh

import flexplant as fx
from flexplant.plant.realisation import natural

KINDS = (
    "gantry",
    "dual_stage",
    "steering_mirror",
    "flexible_joint",
    "isolation_table",
    "hexapod",
    "ball_screw",
    "maglev_block",
)


def frequencies(plant):
    return natural(plant.assembled.realisation.pairs)[0] / (2.0 * np.pi)


@pytest.mark.parametrize("kind", KINDS)
def test_each_is_a_sampled_plant_that_a_controller_can_be_designed_for(kind):
    plant = getattr(fx.testbeds, kind)()
    assert 6 <= plant.system.n_states <= 60 and 2e3 <= 1.0 / plant.dt <= 20e3
    assert 0.0 <= plant.delay <= 2.0
    plant.check().require(("stabilisable", "detectable"), "a controller")


@pytest.mark.parametrize("kind", KINDS)
def test_the_rate_and_the_delay_are_those_asked_for(kind):
    plant = getattr(fx.testbeds, kind)(rate=8e3, delay=0.5)
    assert plant.dt == pytest.approx(1.0 / 8e3) and plant.delay == 0.5


def test_slides_are_free_to_rounding():
    """Three of the gantry, two strokes, a joint and a screw; the others stand on springs."""
    found = {kind: getattr(fx.testbeds, kind)().n_rigid for kind in KINDS}
    assert found == dict(zip(KINDS, (3, 2, 0, 1, 0, 0, 1, 6), strict=True))


def test_the_screw_as_a_chain_of_masses():
    """With the motor's inertia seen at the nut: bed, screw J / r^2, table and workpiece."""
    lead = 10e-3 / (2 * np.pi)
    M = np.diag([1100.0, 2.4e-3 / lead**2, 140.0, 35.0])
    feet, part = 1100.0 * (2 * np.pi * 14.0) ** 2, 35.0 * (2 * np.pi * 48.0) ** 2
    ends = np.array([[1.0, 0, 0, 0], [-1, -1, 1, 0], [0, 0, -1, 1]])
    K = ends.T @ np.diag([feet, 1.3e8, part]) @ ends
    wanted = np.sqrt(np.maximum(eigh(K, M, eigvals_only=True), 0.0)) / (2 * np.pi)
    np.testing.assert_allclose(frequencies(fx.testbeds.ball_screw()), wanted, rtol=1e-6, atol=1e-4)

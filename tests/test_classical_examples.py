"""The examples of classical control and of active damping run, and their claims are true."""

import importlib
from pathlib import Path

import pytest

import flexplant as fx

EXAMPLES = Path(__file__).parents[1] / "examples"
pytestmark = pytest.mark.long


@pytest.fixture(scope="module")
def found():
    with pytest.MonkeyPatch.context() as patch:
        patch.syspath_prepend(str(EXAMPLES))
        yield importlib.import_module("classical"), importlib.import_module("active_damping")


def test_the_column_and_the_masses(found):
    classical, _ = found
    assert classical.column_mu() == pytest.approx((0.53, 5.8), rel=0.02)
    masses = classical.two_masses()
    assert not fx.synthesis.robust_stability(masses, classical.lqg_of(masses)).is_robust


def test_delay_tuning_and_lqg(found):
    classical, _ = found
    pd = classical.delayed_pd()
    assert pd.is_stable and pd.modulus_margin == pytest.approx(0.64, abs=0.01)
    assert all(one.margin >= 0.5 for one in classical.tuned().values())
    table, info = classical.motor()
    assert "phase [deg]" in repr(table) and "2.75 %" in repr(info)


def test_damping_first_and_motion_after(found):
    _, example = found
    plant = example.machine()
    tuned = example.dampers(plant)
    assert all(one.damping >= 0.15 and one.loop.left_out.is_stable for one in tuned.values())
    with pytest.warns(fx.errors.FlexplantWarning, match="modes that the plant truncates"):
        hinf = example.by_hinf(plant)
        rows = example.table(plant, tuned, hinf)
    assert rows.count("yes") == 4
    with pytest.warns(fx.errors.FlexplantWarning, match="unstable"):
        loop, radius = example.moved(plant, tuned["velocity"])
    assert radius > 1.0 > loop.spectral_radius
    left = example.residuals(loop)
    for one in left.values():
        assert one.judged and one.predicted == pytest.approx(one.simulated, rel=1e-6)
    assert left["ZVD"].amplitude[0] < 0.05 * left["plain"].amplitude[0]
    assert left["ZVD"].predicted < 0.15 * left["plain"].predicted

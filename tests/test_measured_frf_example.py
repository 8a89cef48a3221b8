"""The measured-data story runs; its answers are what the machine was built with."""

import importlib
from pathlib import Path

import numpy as np
import pytest
from matplotlib import image

from flexplant.documentation import keep
from shared_data import BUNDLED, ELSEWHERE

FILE = Path(__file__).parents[1] / "examples" / "measured_frf.py"

pytestmark = pytest.mark.long


@pytest.fixture(scope="module")
def example():
    with pytest.MonkeyPatch.context() as patch:
        patch.syspath_prepend(str(FILE.parent))
        patch.setenv("FLEXPLANT_DATA", str(ELSEWHERE if ELSEWHERE.exists() else BUNDLED))
        yield importlib.import_module("measured_frf")


@pytest.fixture(scope="module")
def result(example):
    return example.main()


def test_the_poles_are_the_machines_within_their_doubt(result):
    found = result["numbered"]
    assert found.modes == (4, 6, 7, 8, 9, 10, 11)  # 5 and 12 are zero at the actuators
    error = found.poles - result["true poles"]
    score = np.concatenate([error.real / found.std.real, error.imag / found.std.imag])
    assert np.abs(score).max() < 4.0
    assert 0.6 < np.sqrt(np.mean(score**2)) < 1.6
    assert np.max(np.abs(found.std) / np.abs(found.poles)) < 2e-4


def test_the_mass_is_found_and_its_mirror_images_are_named(example, result):
    """Poles of a square plate are the same at (L/2, L/4) and its three images."""
    length, dofs = example.L, example.plate.dofs
    points = [(0.5, 0.25), (0.25, 0.5), (0.75, 0.5), (0.5, 0.75)]
    images = {dofs.nearest((length * x, length * y, 0.0), "z") for x, y in points}
    assert set(result["by poles"].alike) == images
    assert len(result["by poles"].candidates) == 25
    assert result["by FRFs"].alike == ("23:z",)
    assert result["place"] == example.z8 == "23:z"
    # the hold is in the residual, so what is wrong everywhere comes out right beside the mass
    assert result["by FRFs"].nuisance == ("stiffness", "damping")
    truth = [example.TRUTH["stiffness"], example.TRUTH["damping"]]
    np.testing.assert_allclose(result["by FRFs"].nuisance_values, truth, rtol=0.02)


def test_mass_stiffness_and_damping_within_their_doubt(result):
    # 0.5 kg; E 70 over 69 GPa; D = 2 zeta omega per mode, omega as the square root of E
    truth = np.array([0.5, 70 / 69 - 1, 0.01 / 0.007 * np.sqrt(70 / 69) - 1])
    fit = result["fit"]
    assert fit.converged
    assert np.all(np.abs(fit.values - truth) < 3.5 * fit.std)
    assert fit.std[0] < 1e-3  # kg
    assert fit.std[1] < 5e-5
    assert fit.std[2] < 2e-3
    np.testing.assert_allclose(fit.values, [0.5003, 0.01449, 0.4372], rtol=3e-3)


def test_responses_that_were_not_used(result):
    before, after = result["merit"]["drawing"], result["merit"]["updated"]
    band, above = "unused sensor, identified band", "unused sensor, unused lines above"
    assert before[band][0] > 0.5
    assert after[band][0] < 0.02
    assert after[band][1] < 1.3  # little but noise is left
    for part in (band, above, "fitted sensors, unused lines above"):
        assert after[part][0] < 0.5 * before[part][0]


def test_real_structures_are_shown_or_said_to_be_absent(example, result, monkeypatch, tmp_path):
    said = result["real structures"]
    if example.BRIDGE.exists():
        exact, noisy = said[:2]
        assert float(exact.split("rms error ")[1].split()[0]) < 1e-8
        assert float(noisy.split("rms error ")[1].split()[0]) < 0.2
    monkeypatch.setattr(example, "BRIDGE", tmp_path / "bridge.mat")
    monkeypatch.setattr(example, "SHAKEN", tmp_path / "shaken.uff")
    assert example.real_structures() == [
        f"bridge: {tmp_path / 'bridge.mat'} is not here; it is at {example.BRIDGE_FROM}",
        f"a mode: {tmp_path / 'shaken.uff'} is not here; it is at {example.SHAKEN_FROM}",
    ]


def test_table_and_pictures(example, result, tmp_path):
    text = example.table(result)
    assert "alike: 23:z, 39:z, 43:z, 59:z" in text
    assert max(map(len, text.splitlines())) <= 100
    drawn = example.pictures(result, tmp_path)
    assert [path.stem.removeprefix("measured_") for path in drawn] == [
        "stabilisation",
        "identified",
        "unused_sensor",
        "update",
    ]
    for path in drawn:
        assert np.ptp(image.imread(path)[..., :3]) > 0.5
    keep(FILE, text, drawn)  # the site shows this run

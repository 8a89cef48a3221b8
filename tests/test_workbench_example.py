"""The workbench's example without a browser: its loops hold on the machine that was measured."""

import importlib
from pathlib import Path

import numpy as np
import pytest

import flexplant as fx

pytestmark = pytest.mark.slow


@pytest.fixture(scope="module")
def example():
    with pytest.MonkeyPatch.context() as patch:
        patch.syspath_prepend(str(Path(__file__).parents[1] / "examples"))
        yield importlib.import_module("workbench")


@pytest.fixture(scope="module")
def result(example):
    return example.main()


@pytest.mark.long
def test_six_decibel_on_all_axes_of_the_measurement(result):
    report = result["loops"].report
    assert report.is_stable
    assert list(report) == ["die:z", "die:rx", "die:ry"]
    for loop in report.loops:
        assert loop.modulus_margin > 0.5
        assert loop.crossovers == pytest.approx((61.0,), abs=1.0)


def test_the_drawing_and_its_other_modes_agree(example, result):
    closed = result["closed"]
    assert closed.left_out.is_fine
    assert 1e9 * closed.rms("die:error") == pytest.approx(9.76, abs=0.05)
    assert "truncated modes: stable" in example.table(result)


def test_the_machine_itself_is_stable_with_it(example, result):
    """Its truth, which no step of the design saw, by its own poles."""
    held = fx.testbeds.wafer_stage(rate=example.RATE).loop(
        example.PORTS, result["design"].controller()
    )
    assert held.is_stable
    assert held.modulus_margin > 0.45


def test_the_files_are_the_design(example, result):
    saved = fx.load(example.OUT / "loops.npz")
    assert np.array_equal(saved.controller().A, result["design"].controller().A)
    assert (example.OUT / "loops.h").exists()

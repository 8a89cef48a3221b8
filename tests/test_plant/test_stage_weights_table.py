"""The table of stage_weights, measured again on a machine of another formulation."""

import importlib
import re
import warnings
from functools import cache
from pathlib import Path

import numpy as np
import pytest

import flexplant as fx

EXAMPLES = Path(__file__).parents[2] / "examples"
KNOBS = {"peak", "disturbance", "effort", "noise"}


def rows():
    """Return (bandwidth, changed knobs, numbers) of each line of the table; unstable is 0."""
    found = []
    for line in (fx.plant.__doc__ or "").splitlines():
        cells = re.split(r"\s{2,}", line.strip().replace("unstable", "0"))
        if re.fullmatch(r"\d+", cells[0]) and len(cells) in (6, 7):
            words = " ".join(cells[1:-5]).split()
            knobs = dict(zip(words[::2], map(float, words[1::2]), strict=True))
            found.append((float(cells[0]), knobs, [float(cell) for cell in cells[-5:]]))
    return found


@cache
def stage(damping=0.001):
    """The example, and its machine and models."""
    with pytest.MonkeyPatch.context() as patch:
        patch.syspath_prepend(str(EXAMPLES))
        example = importlib.import_module("wafer_stage")
    return example, example.models(damping)


def judged(bandwidth, knobs, damping=0.001, *, kind="measured", sure=False):
    """Design on a model; |S| of the machine over a grid, and the margin, 0 when unstable."""
    example, case = stage(damping)
    plant = example.plant_of(case, kind)
    known = None if sure else plant.uncertain(frequency=case["off"])
    errors = fx.reference_errors(plant)
    weights = fx.stage_weights(plant, bandwidth, uncertainty=known, **knobs)
    weighted = plant.through(errors).weighted(z=weights.z, w=weights.w)
    with warnings.catch_warnings(action="ignore"):  # one is unstable
        found = fx.design_hinf(weighted, uncertain=known)
        loop = case["machine"].loop(example.ports(), errors, found)
    freq = np.geomspace(0.5, 0.499 * example.RATE, 6000)
    S = np.abs(loop.frequency_response(freq)["die:error", "die:ref"])
    margin = loop.modulus_margin if loop.is_stable else 0.0
    numbers = found.gamma, freq[np.argmax(S >= 1)], 20 * np.log10(S.max()), margin
    return found, [*numbers, np.interp(5.0, freq, S)]


def test_the_table_names_every_knob():
    named = [knobs for _, knobs, _ in rows()]
    assert len(named) == 10
    assert {name for knobs in named for name in knobs} == KNOBS


@pytest.mark.slow
@pytest.mark.parametrize(("bandwidth", "knobs", "numbers"), rows()[1::2])  # 4 s each
def test_a_line_of_the_table(bandwidth, knobs, numbers):
    _, measured = judged(bandwidth, knobs)
    steps = np.array([0.02 * numbers[0], 0.03 * numbers[1], 0.4, 0.015, 0.00006])
    np.testing.assert_array_less(np.abs(np.array(measured) - numbers), steps)


@pytest.mark.slow
def test_what_is_said_of_other_designs():
    assert judged(80.0, {}, sure=True)[1][3] == 0.0
    usual = {"kind": "measured", "sure": True}, {"kind": "drawing", "sure": True}, {}
    margins = [judged(80.0, {}, 0.01, **options)[1][3] for options in usual]
    np.testing.assert_allclose(margins, [0.35, 0.24, 0.48], atol=0.01)


@pytest.mark.slow
@pytest.mark.parametrize(("bandwidth", "damping"), [(30.0, 0.01), (50.0, 0.001), (80.0, 0.001)])
def test_sure_of_its_modes_the_loop_is_within_its_blocks(bandwidth, damping):
    """Gamma is the size of the largest block, beside 1 that is asked; effort decides."""
    found, (gamma, reached, *_) = judged(bandwidth, {}, damping, sure=True)
    assert reached > bandwidth
    assert gamma < 1.15
    assert found.reached["efforts from disturbances"] == pytest.approx(gamma, rel=0.1)
    assert 0.5 * found.gamma < max(found.reached.values()) <= found.gamma * (1 + 1e-3)

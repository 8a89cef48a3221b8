"""The textbook designs run, and their numbers are true by other routes."""

import importlib
from pathlib import Path

import pytest

from oracles_synthesis import brute_norm, closed_loop, split, stability

EXAMPLES = Path(__file__).parents[1] / "examples"

#: gamma of each case
PINS = {
    "slow lag": 0.5369,
    "integrator": 0.6026,
    "double integrator, mode": 0.6549,
    "zero at 10 rad/s": 1.2234,
}

pytestmark = pytest.mark.slow


@pytest.fixture(scope="module")
def textbook():
    with pytest.MonkeyPatch.context() as patch:
        patch.syspath_prepend(str(EXAMPLES))
        yield importlib.import_module("textbook")


@pytest.fixture(scope="module")
def found(textbook):
    return textbook.main()


@pytest.mark.parametrize("name", PINS)
def test_gamma_is_that_of_the_loop_and_near_its_bound(found, name):
    plant, K = found[name]
    assert K.gamma == pytest.approx(PINS[name], rel=3e-3)
    assert K.lower <= K.gamma <= 1.0105 * K.lower
    g, c = plant.system, K.system
    loop = closed_loop(split(g.A, g.B, g.C, g.D, 1, 1), c.A, c.B, c.C, c.D)
    assert stability(loop[0], 0.0) < 0
    assert brute_norm(*loop, 0.0) == pytest.approx(K.gamma, rel=1e-3)


def test_the_zero_sets_a_bound_known_by_hand(textbook, found):
    """(0.5 z + 4) / (z + 4e-4) at z = 10; below gamma, since effort costs too."""
    best = textbook.least_by_hand(textbook.CASES["zero at 10 rad/s"])
    assert best == pytest.approx(9.0 / 10.0004, rel=1e-12)
    assert best < found["zero at 10 rad/s"][1].lower


def test_table_and_picture(textbook, found, tmp_path):
    text = textbook.table(found)
    assert all(f"{K.gamma:.4f}" in text for _, K in found.values())
    assert text.count("met\n") == 3
    assert "missed by at most 22 %" in text
    assert textbook.picture(found, tmp_path).stat().st_size > 10_000

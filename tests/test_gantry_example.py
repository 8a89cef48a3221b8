"""The gantry's story: its axes, both loops by their matrices, and what feedforward leaves."""

import importlib
from pathlib import Path

import pytest

from judge import judged

EXAMPLES = Path(__file__).parents[1] / "examples"

pytestmark = pytest.mark.slow


def test_the_story_of_the_gantry(tmp_path):
    with pytest.MonkeyPatch.context() as patch:
        patch.syspath_prepend(str(EXAMPLES))
        story = importlib.import_module("gantry")
    found = story.main()
    assert found["axes"].channels == ("tool_x:x", "tool_y:y", "skew:y")
    for name, bandwidth in (("servo", found["reach"]), ("H-infinity", story.BANDWIDTH)):
        loop = found["loops"][name]
        assert judged(loop.plant, *loop.blocks).serves(bandwidth)
    assert found["reach"] == pytest.approx(19.0, rel=0.02)
    none, *fed = story.errors(found).values()
    assert none == pytest.approx(357e-6, rel=0.02)
    assert max(fed) < 0.02 * none
    text = story.table(found)
    assert "without feedforward" in text and "H-infinity" in text
    assert story.picture(found, tmp_path).stat().st_size > 20_000

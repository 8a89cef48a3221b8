"""The gantry's story: its axes, both loops by their matrices, and what feedforward leaves."""

import importlib
from pathlib import Path

import pytest

from judge import judged

EXAMPLES = Path(__file__).parents[1] / "examples"

pytestmark = pytest.mark.slow


def test_the_story_of_the_gantry():
    with pytest.MonkeyPatch.context() as patch:
        patch.syspath_prepend(str(EXAMPLES))
        story = importlib.import_module("gantry")
    found = story.main()
    assert found["axes"].channels == ("tool_x:x", "tool_y:y", "skew:y")
    for name, bandwidth in (("servo", found["reach"]), ("hinf", story.BANDWIDTH)):
        loop = found[name]
        assert judged(loop.plant, *loop.blocks).serves(bandwidth)
    assert found["reach"] == pytest.approx(13.6, rel=0.02)
    errors = found["errors"]
    assert errors["none"] == pytest.approx(401e-6, rel=0.02)
    assert max(errors["at rest"], errors["of the move"]) < 0.02 * errors["none"]

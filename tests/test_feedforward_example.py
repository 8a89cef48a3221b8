"""What each order of feedforward buys on the virtual machine of the example."""

import importlib
from pathlib import Path

import pytest

EXAMPLES = Path(__file__).parents[1] / "examples"

pytestmark = pytest.mark.slow


def test_each_order_buys_what_the_example_says(tmp_path):
    with pytest.MonkeyPatch.context() as patch:
        patch.syspath_prepend(str(EXAMPLES))
        example = importlib.import_module("feedforward")
    result = example.main()
    for runs in result["runs"].values():
        peak, late = ({name: example.figures(run)[i] for name, run in runs.items()} for i in (0, 1))
        assert peak["acceleration"] < 0.03 * peak["none"]
        assert peak["jerk"] < 0.5 * peak["acceleration"]
        assert peak["snap"] < 0.9 * peak["jerk"] and peak["inverse"] < 0.8 * peak["snap"]
        assert late["snap"] < 0.02 * late["none"]
    errors = result["learnt"].errors
    assert errors[1] < 0.5 * errors[0] and errors[2] < 1.1 * errors[1]
    text = example.table(result)
    assert "best servo, feedforward" in text and "move 2: rms" in text
    assert example.picture(result, tmp_path).stat().st_size > 20_000

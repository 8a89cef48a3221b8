"""The C controller in a process of its own holds the machine in another as `simulate` has it."""

import importlib
import sys
from pathlib import Path

import numpy as np
import pytest

EXAMPLES = Path(__file__).parents[1] / "examples"


@pytest.mark.long
@pytest.mark.skipif(not sys.platform.startswith("linux"), reason="POSIX clocks, /dev/shm")
def test_two_processes_give_the_run_of_simulate(tmp_path):
    with pytest.MonkeyPatch.context() as patch:
        patch.syspath_prepend(str(EXAMPLES))
        example = importlib.import_module("real_time")
    if example.COMPILER is None:
        pytest.skip("no C compiler")
    result = example.main(duration=0.12)
    assert example.difference(result) < 1e-9
    assert np.abs(result["wanted"]["die:error"]).max() > 1e-7  # the move is in the run
    # times are measured, and not judged: they are the load's
    for name in ("late", "answer"):
        assert result[name].shape == (1200,)
        assert np.all(np.isfinite(result[name]))
        assert result[name].min() > -1e-9
        assert result[name].max() > 0.0
    assert "answers came after" in example.table(result)
    assert example.picture(result, tmp_path).stat().st_size > 20_000

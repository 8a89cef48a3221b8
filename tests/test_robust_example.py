"""From an update's covariance to a guarantee: the story runs, and its numbers are true."""

import importlib
from pathlib import Path

import numpy as np
import pytest

import flexplant as fx

EXAMPLES = Path(__file__).parents[1] / "examples"

pytestmark = pytest.mark.slow


def test_the_guarantee_holds_on_machines_drawn_anew(tmp_path):
    with pytest.MonkeyPatch.context() as patch:
        patch.syspath_prepend(str(EXAMPLES))
        example = importlib.import_module("robust_control")
    found = example.main(tmp_path)
    assert all(found["claims"].values())
    robust, worst = found["robust"], found["worst"]
    assert 0.3 < robust.lower <= robust.upper < 1.05 * robust.lower
    assert robust.left_out.is_stable
    assert worst.upper == pytest.approx(1.868, rel=0.02, abs=0)
    assert worst.nominal == pytest.approx(1.717, rel=5e-3, abs=0)
    # the bound covers the machine that no model here resembles, over a grid of its own
    loop = found["machine"]
    assert loop.is_stable
    gain = np.abs(loop.frequency_response(np.geomspace(10.0, 4e3, 20_000))["die:error", "die:ref"])
    assert gain.max() <= worst.upper
    # and the corners of the Deltas
    gains, blocks = [], found["loop"].blocks
    for sign in (-1.0, 1.0):
        values = {delta.name: sign for delta in found["uncertain"].deltas}
        corner = fx.close_loop(found["uncertain"].lft(values), *blocks)
        gains.append(fx.peak_gain(corner.system["die:error", "die:ref"])[0])
    assert max(gains) <= worst.upper
    # without the modes above, mu of H-infinity says nothing of the machine
    few, sharp = found["few"], found["sharp"]
    assert few.upper < 1.0 < 50.0 < sharp.lower <= sharp.upper < 1.05 * sharp.lower
    assert not found["broken"].is_stable
    text = example.table(found)
    assert "every machine is stable" in text
    assert "stage_hinf.c" in text
    assert example.picture(found, tmp_path).stat().st_size > 20_000

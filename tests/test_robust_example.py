"""From an update's covariance to a guarantee: the story runs, and its numbers are true."""

import importlib
from contextlib import nullcontext
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
    assert robust.upper < 0.1
    assert robust.left_out.is_stable
    assert worst.upper == pytest.approx(1.713, rel=0.01, abs=0)
    assert worst.nominal == pytest.approx(1.691, rel=2e-3, abs=0)
    # the bound covers the machine with all of its modes, which is in the weight
    whole = fx.assemble_plant(found["whole"], example.ports())
    blocks = found["loop"].blocks
    loop = fx.close_loop(whole.discretized(example.RATE, delay=example.DELAY), *blocks)
    assert loop.is_stable
    gain = np.abs(loop.frequency_response(np.linspace(60.0, 140.0, 300))["die:error", "die:ref"])
    assert gain.max() <= worst.upper
    # and the corners of the Deltas
    gains = []
    for sign in (-1.0, 1.0):
        values = {delta.name: sign for delta in found["uncertain"].deltas}
        corner = fx.close_loop(found["uncertain"].lft(values), *blocks)
        gains.append(fx.peak_gain(corner.system["die:error", "die:ref"])[0])
    assert max(gains) <= worst.upper
    # H-infinity is not robust to so bad a measurement, and is to one better by mu
    sharp = found["sharp"]
    assert 5.0 < sharp.lower <= sharp.upper < 1.02 * sharp.lower
    for part, stable in ((0.98, True), (1.02, False)):
        values = {name: part * value for name, value in sharp.values.items()}
        with pytest.warns(fx.FlexplantWarning) if not stable else nullcontext():
            loop = fx.close_loop(found["uncertain"].lft(values), found["errors"], found["hinf"])
        assert loop.is_stable is stable
    text = example.table(found)
    assert "every machine is stable" in text
    assert "stage_hinf.c" in text
    assert example.picture(found, tmp_path).stat().st_size > 20_000

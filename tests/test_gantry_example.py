"""The gantry's story from files to C: what was found, and what its loop does on the true machine.

The truth comes from the script that wrote the files, and is closed by numpy and scipy alone.
"""

import importlib
import re
from pathlib import Path

import numpy as np
import pytest
import scipy.signal

from flexplant.documentation import keep

EXAMPLES = Path(__file__).parents[1] / "examples"

pytestmark = pytest.mark.long


def truth(files, story):
    """Return A, B, C of the sampled machine from motors to encoders, a sample of delay included."""
    omega, zeta, phi = files.machine()
    n, m = omega.size, len(story.DRIVES)
    rows = np.zeros((m, n))
    for row, place in zip(rows, story.DRIVES.values(), strict=True):
        row[[files.DOFS.index(name) for name in place]] = list(place.values())
    shapes = rows @ phi
    A = np.block([[np.zeros((n, n)), np.eye(n)], [-np.diag(omega**2), -np.diag(2 * zeta * omega)]])
    B, C = np.vstack([np.zeros((n, m)), shapes.T]), np.hstack([shapes, np.zeros((m, n))])
    A, B, C, *_ = scipy.signal.cont2discrete((A, B, C, np.zeros((m, m))), 1.0 / story.RATE)
    waits = np.block([[A, B], [np.zeros((m, 2 * n + m))]])
    return waits, np.vstack([np.zeros((2 * n, m)), np.eye(m)]), np.hstack([C, np.zeros((m, m))])


def test_the_story_of_the_gantry(tmp_path):
    with pytest.MonkeyPatch.context() as patch:
        patch.syspath_prepend(str(EXAMPLES))
        patch.syspath_prepend(str(EXAMPLES / "data"))
        story, files = (importlib.import_module(name) for name in ("gantry", "gantry_files"))
    story.OUT = tmp_path
    found = story.main(tmp_path / "files")
    # what the laboratory's machine differs in, and its poles
    wrong = np.subtract(
        [files.TRUE[name] for name in ("tool", "column", "feet")],
        [files.DRAWN[name] for name in ("tool", "column", "feet")],
    )
    np.testing.assert_allclose(found["fit"].values, wrong, atol=0.05)
    omega, zeta, _ = files.machine()
    real = -zeta * omega + 1j * omega * np.sqrt(1 - zeta**2)
    near = np.abs(found["measured"].poles[:, None] - real).min(axis=1)
    assert np.all(near < 2e-3 * np.abs(found["measured"].poles))
    # the loop on the true machine
    law = found["loop"].blocks[0].select(inputs=story.ENCODERS)
    A, B, C = truth(files, story)
    closed = np.block([[A + B @ law.D @ C, B @ law.C], [law.B @ C, law.A]])
    assert np.abs(np.linalg.eigvals(closed)).max() < 1.0
    freq = np.geomspace(1.0, 0.499 * story.RATE, 4000)
    margins = []
    for z in np.exp(2j * np.pi * freq / story.RATE):
        K, G = (
            c @ np.linalg.solve(z * np.eye(a.shape[0]) - a, b) + d
            for a, b, c, d in ((law.A, law.B, law.C, law.D), (A, B, C, 0.0))
        )
        margins.append(np.linalg.svd(np.eye(3) - K @ G, compute_uv=False)[-1])
    margin = min(margins)
    assert found["loop"].modulus_margin == pytest.approx(margin, rel=0.03)
    assert found["by_frf"] == pytest.approx(margin, rel=0.03)  # lines 0.5 Hz apart
    low, high, _ = found["loop"].interval("modulus_margin")
    assert 0.999 * low <= margin <= 1.001 * high
    none, fed = (run.peak("tool_y:error") for run in found["runs"].values())
    assert np.max(fed) < 0.05 * np.max(none)
    # the docstring says what the run says
    numbers = re.compile(r"-?\d+\.?\d*")
    text = story.table(found)
    said = story.__doc__.split("::\n\n")[1].splitlines()
    for line in filter(None, map(str.strip, said)):
        words = numbers.sub("#", line)
        shown = next(one for one in text.splitlines() if words in numbers.sub("#", one))
        pairs = zip(numbers.findall(line), numbers.findall(shown), strict=True)
        for ours, theirs in pairs:
            assert float(ours) == pytest.approx(float(theirs), rel=0.05), line
    assert "laser_tool_y" in found["sensors"].chosen
    drawn = story.picture(found, tmp_path)
    assert drawn.stat().st_size > 20_000
    keep(EXAMPLES / "gantry.py", text, [drawn])  # the site shows this run
    assert (tmp_path / "gantry.c").exists()


def test_the_files_are_written_without_flexplant():
    code = (EXAMPLES / "data" / "gantry_files.py").read_text(encoding="utf-8")
    assert "import flexplant" not in code

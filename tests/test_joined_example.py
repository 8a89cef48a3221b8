"""The stage joined to its frame: it slides at 0 Hz, and every way to the machine says the same."""

import importlib
from pathlib import Path

import numpy as np
import pytest

EXAMPLES = Path(__file__).parents[1] / "examples"

pytestmark = pytest.mark.slow


@pytest.fixture(scope="module")
def example():
    with pytest.MonkeyPatch.context() as patch:
        patch.syspath_prepend(str(EXAMPLES))
        yield importlib.import_module("joined_machine")


@pytest.mark.long
def test_the_joined_machine(example):
    result = example.main()
    full, small = result["modes"]
    machine = result["machine"]
    assert (machine.n_dof, result["small"].n_dof) == (420, 84)
    assert machine.joining.n_rigid == full.n_rigid == small.n_rigid == 1
    assert full.freq[0] == small.freq[0] == 0.0
    assert np.iscomplexobj(full.phi)
    np.testing.assert_allclose(full.freq[[1, 6, 7]], [14.3793, 26.2476, 548.334], rtol=1e-5)
    np.testing.assert_allclose(full.zeta[[1, 7]], [0.09033, 0.00449], rtol=1e-2)
    assert np.abs(small.freq[1:] / full.freq[1:] - 1).max() == pytest.approx(8.5e-4, rel=0.05)
    assert example.largest_error(*result["answers"][::-1]) == pytest.approx(4.6e-3, rel=0.05)
    assert example.largest_error(*result["coupled"]) < 1e-8
    assert example.largest_error(*result["apart"]) < 1e-6
    # the slide moves the stage alone, along x
    slide = machine.rigid_body[:, 0]
    moved = {label for label, size in zip(machine.dofs, np.abs(slide), strict=True) if size > 1e-9}
    assert moved == {label for label in machine.dofs if label.startswith("stage/") and "x" in label}
    text = example.report(result)
    assert "0, exactly" in text
    assert "1 rigid-body motion" in text

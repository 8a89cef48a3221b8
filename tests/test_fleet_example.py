"""examples/fleet.py on a few machines, whose pipeline is a plain function."""

import importlib.util
from functools import partial
from pathlib import Path

import numpy as np
import pytest

import flexplant as fx

EXAMPLE = Path(__file__).parents[1] / "examples" / "fleet.py"


@pytest.fixture(scope="module")
def fleet():
    spec = importlib.util.spec_from_file_location("fleet", EXAMPLE)
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


@pytest.mark.long
def test_each_machine_with_its_own_model_is_faster_and_more_accurate(fleet, tmp_path):
    """A Ritz plate: what is promised is its own; both ways hold."""
    machines = fleet.fleet(1)
    errors = fx.reference_errors
    mean = fx.assemble_plant(fleet.reduced(0.5), fleet.PORTS)
    plant = mean.discretized(fleet.RATE, delay=fleet.DELAY)
    weights = fx.stage_weights(plant, 30.0)
    weighted = plant.through(errors(plant)).weighted(z=weights.z, w=weights.w)
    blocks = errors(plant), fx.design_hinf(weighted)
    pipelines = {
        "one for all": partial(fleet.pipeline, blocks=blocks),
        "one for each": fleet.pipeline,
    }
    tables = {name: fx.study(machines, one, rng=1) for name, one in pipelines.items()}
    own, every = tables["one for each"], tables["one for all"]
    for table in (own, every):
        assert table["failed"].tolist() == [""]
        assert table["stable"].all()
        # promised on the updated, calibrated model with the truncated modes
        np.testing.assert_allclose(table["modulus margin"], table["margin expected"], rtol=0.05)
    assert np.all(own["modulus margin"] > 0.4)
    # of 70 Hz asked, from reference to error; this is |S| at u, of all axes together
    np.testing.assert_allclose(own["bandwidth"], 68.0, rtol=0.02)
    np.testing.assert_allclose(every["bandwidth"], 33.0, rtol=0.05)
    assert np.all(own["MA"] < 0.5 * every["MA"])
    assert own["passed"].all()
    assert not every["passed"].any()
    shown = fleet.table({"asked": 30.0, "tables": tables})
    assert "one for each, failed: unstable: 0" in shown
    assert max(map(len, shown.splitlines())) <= 120
    assert fleet.picture({"asked": 30.0, "tables": tables}, tmp_path).stat().st_size > 10_000

"""examples/fleet.py on a few machines, and the pipeline that it runs."""

import importlib.util
from pathlib import Path

import numpy as np
import pytest

import flexplant as fx
from flexplant.errors import ModelError
from flexplant.simulation import machine_pipeline

EXAMPLE = Path(__file__).parents[1] / "examples" / "fleet.py"


@pytest.fixture(scope="module")
def fleet():
    spec = importlib.util.spec_from_file_location("fleet", EXAMPLE)
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


@pytest.mark.long
def test_each_machine_with_its_own_model_is_faster_and_more_accurate(fleet, tmp_path):
    """A Ritz plate: what is promised is its own; both ways hold; reports are written."""
    machines = fleet.fleet(1)
    errors = fx.reference_errors
    mean = fx.assemble_plant(fleet.reduced(0.5), fleet.PORTS)
    plant = mean.discretized(fleet.RATE, delay=fleet.DELAY)
    weights = fx.stage_weights(plant, 30.0)
    weighted = plant.through(errors(plant)).weighted(z=weights.z, w=weights.w)
    blocks = errors(plant), fx.design_hinf(weighted)
    pipelines = {
        "one for all": fleet.pipeline(blocks),
        "one for each": fleet.pipeline().replace(folder=tmp_path / "reports"),
    }
    tables = {name: fx.study(machines, one, rng=1) for name, one in pipelines.items()}
    own, every = tables["one for each"], tables["one for all"]
    for table in (own, every):
        assert table["failed"].tolist() == [""]
        assert table["stable"].all()
        # promised on the updated, calibrated model with the modes left out
        np.testing.assert_allclose(table["modulus margin"], table["margin expected"], rtol=0.05)
    assert np.all(own["modulus margin"] > 0.4)
    # of 70 Hz asked, from reference to error; this is |S| at u, of all axes together
    np.testing.assert_allclose(own["bandwidth"], 68.0, rtol=0.02)
    np.testing.assert_allclose(every["bandwidth"], 33.0, rtol=0.05)
    assert np.all(own["MA"] < 0.5 * every["MA"])
    assert own["passed"].all()
    assert not every["passed"].any()
    for name, value in zip(own["report"], own["stiffness"], strict=True):
        text = (tmp_path / "reports" / name).read_text()
        assert f"stiffness = {value:.2g}"[:14] in text
        assert "specification: passed" in text
    shown = fleet.table({"asked": 30.0, "tables": tables})
    assert "one for each, failed: unstable: 0" in shown
    assert max(map(len, shown.splitlines())) <= 120
    assert fleet.picture({"asked": 30.0, "tables": tables}, tmp_path).stat().st_size > 10_000


@pytest.mark.long
def test_the_whole_chain_from_a_measured_frf(fleet, tmp_path):
    """Identify, localise among three places, update, design, verify on the evaluation model."""
    machine = fx.testbeds.wafer_stage(
        damping=fleet.DAMPING, rate=fleet.RATE, delay=fleet.DELAY, added_mass=0.6
    )
    points = [(0.3, 0.15, 0.0), (0.075, 0.3, 0.0), (0.225, 0.525, 0.0)]
    labels = [fleet.plate.dofs.nearest(point, "z") for point in points]
    shaken = {"period": 0.5, "periods": 2, "discard": 1, "amplitude": 5.0}
    frf = machine.measure_frf(fleet.PORTS, **shaken, rng=1)
    chain = fleet.pipeline().replace(
        modes=None, band=(200.0, 1300.0), hold=fleet.RATE, starts=1, bandwidth=20.0,
        parameters=fleet.pipeline().parameters[1:], duration=0.4,
        candidates=[fx.AddedMass(label) for label in labels], folder=tmp_path,
    )  # fmt: skip
    report = chain.report(frf, 1)
    # what the drawing lacks counts as discrepancy, so that the interval is wide
    assert f"mass at {labels[0]}" in report.places.chosen
    low, high = report.fit.interval()[
        [q.name for q in report.fit.unknowns].index(f"mass at {labels[0]}")
    ]
    assert low < 0.6 < high < low + 2.0
    # the evaluation model has what decides on the machine, whose loop the chain never sees
    own = machine.loop(fleet.PORTS, *report.blocks)
    assert report.row["stable"] and own.is_stable
    assert report.row["modulus margin"] == pytest.approx(own.modulus_margin, rel=0.05)
    assert report.row["bandwidth"] == pytest.approx(fx.loop.bandwidth(own), rel=0.05)
    assert report.row["margin expected"] == report.row["modulus margin"]
    report.write(tmp_path / "report.txt")
    text = (tmp_path / "report.txt").read_text()
    headings = [line for line in text.splitlines() if line and not line.startswith(" ")]
    assert headings[:6] == ["Measured", "Localised", "Updated", "Observer", "Controller",
                            "Loop on the evaluation model"]  # fmt: skip
    assert "plant 168 states" in text and "specification: " in text
    poles = report.measured  # numbered by now: measuring again is not needed
    assert chain.replace(candidates=()).report(poles, 1).measured.modes == poles.modes


@pytest.mark.long
def test_a_virtual_machine_is_measured_with_the_options_given(fleet, monkeypatch):
    """Where it is not its poles that are taken; the identification has the band and the hold."""

    class Rig:
        def measure_frf(self, ports, *, period, rng):
            return "frf", len(ports.u), period, rng

    seen = {}

    def identified(frf, **options):
        seen.update(options, frf=frf)
        return fx.MeasuredModes([-1 + 1j], modes=[4])

    monkeypatch.setattr(machine_pipeline, "identify_modes", identified)
    chain = fleet.pipeline().replace(measurement={"period": 0.5}, band=(1.0, 2.0), hold=3.0)
    assert chain._measured(Rig(), 7).modes == (4,)
    assert seen == {"band": (1.0, 2.0), "hold": 3.0, "frf": ("frf", 4, 0.5, 7)}


@pytest.mark.long
def test_the_chain_refuses_what_it_cannot_use(fleet):
    chain = fleet.pipeline()
    assert repr(chain) == "<MachinePipeline: 2 parameters updated, H-infinity, 60, 40 Hz>"
    with pytest.raises(ModelError, match="full must be of type FEModel or Modes or ReducedModel"):
        chain.replace(full=chain.ports)
    with pytest.raises(ModelError, match="the ports need a reference"):
        chain.replace(ports=chain.ports.replace(references=()))
    with pytest.raises(ModelError, match="measurement"):
        chain.replace(measurement=3)
    with pytest.raises(ModelError, match="mode must be a whole number"):
        chain.replace(modes=[4.5])
    with pytest.raises(ModelError, match="bandwidth"):
        chain.replace(bandwidth=(80.0, -1.0))
    with pytest.raises(ModelError, match=r"it is not said what to measure on it. Give modes="):
        chain.replace(modes=None).report(fleet.fleet(1)[0])

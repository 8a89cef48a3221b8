"""Pictures: what is drawn is what was given, and nothing is blank."""

import io

import matplotlib.pyplot as plt
import numpy as np
import pytest
from matplotlib import image

import flexplant as fx
from flexplant.errors import LabelError, ModelError, ShapeError
from flexplant.lti import Frf
from flexplant.simulation import EstimatorComparison, Response
from stages import CORNERS, INSET, Z8, L, fitted, ports, reduced, sampled, some_modes

POLES = np.array([-28.569 + 2883.567j, -39.451 + 3983.308j])


def ink(ax):
    """Share of pixels that are not background."""
    buffer = io.BytesIO()
    ax.figure.savefig(buffer, format="png", dpi=50)
    buffer.seek(0)
    pixels = image.imread(buffer)[:, :, :3]
    assert pixels.std() > 0.02
    return float(np.mean(np.any(np.abs(pixels - pixels[0, 0]) > 0.02, axis=2)))


def texts(ax):
    return {text.get_text() for text in ax.texts} | {
        text.get_text() for text in (ax.get_legend().get_texts() if ax.get_legend() else [])
    }


def some_frf(scale=1.0):
    freq = np.geomspace(1.0, 1e3, 50)
    data = scale / (1j * freq + 30.0)
    return Frf(freq, data[None, None], inputs=["u1"], outputs=["y1"])


@pytest.mark.slow
def test_frf():
    ax = fx.plot.frf({"one": some_frf(), "two": some_frf(10.0)}, "y1", "u1", unit="m/N")
    first, second = ax.get_lines()
    np.testing.assert_allclose(first.get_ydata(), 20 * np.log10(np.abs(some_frf()["y1", "u1"])))
    np.testing.assert_allclose(second.get_ydata() - first.get_ydata(), 20.0)
    assert texts(ax) == {"one", "two"}
    assert "Hz" in ax.get_xlabel()
    assert "1 m/N" in ax.get_ylabel()
    assert ax.get_xscale() == "log"
    assert 0.005 < ink(ax) < 0.6
    ax = fx.plot.frf({"one": some_frf()}, "y1", "u1", colors={"one": "black"})
    assert ax.get_lines()[0].get_color() == "black"
    with pytest.raises(LabelError, match="y2"):
        fx.plot.frf({"one": some_frf()}, "y2", "u1")


def covered(ax):
    """How many points of the lines lie under the legend."""
    ax.figure.draw_without_rendering()
    box = ax.get_legend().get_window_extent()
    every = np.linspace(0.0, 1.0, 2000)
    lines = [np.asarray(line.get_xydata(), dtype=float) for line in ax.get_lines()]
    points = np.vstack(
        [np.column_stack([np.interp(every, np.linspace(0, 1, len(p)), v) for v in p.T])
         for p in lines]
    )  # fmt: skip
    inside = ax.bbox.contains
    seen = [p for p in ax.transData.transform(points) if inside(*p)]
    return sum(box.contains(*p) for p in seen)


@pytest.mark.slow
def test_legends_cover_no_line():
    """New axes have theirs beside them, wherever the lines go; given ones in an empty corner."""
    noise = np.random.default_rng(1).standard_normal((2, 50))
    freq = np.geomspace(1.0, 100.0, 20)
    for ax in (
        fx.plot.response(run_of(noise), ["die:z", "die:error"]),
        fx.plot.frf({"one": some_frf(), "two": some_frf(10.0)}, "y1", "u1"),
        fx.plot.sensitivity({"model": (freq, freq), "other": (freq, 1 / freq)}),
    ):
        assert covered(ax) == 0
        assert ax.get_legend().get_window_extent().x0 >= ax.bbox.x1
    wave = np.where(np.arange(50) < 25, -1.0, noise[0])
    run = run_of([wave, wave])
    assert covered(fx.plot.response(run, ax=plt.subplots()[1])) == 0


def test_sensitivity():
    freq = np.geomspace(1.0, 100.0, 20)
    ax = fx.plot.sensitivity({"model": (freq, np.full(20, 10.0))})
    np.testing.assert_allclose(ax.get_lines()[0].get_ydata(), 20.0)
    levels = {line.get_ydata()[0] for line in ax.get_lines()[1:]}
    assert levels == {0.0, 6.0}
    assert ink(ax) > 0.005


def test_sensitivity_of_a_loop():
    plant = sampled(reduced())
    loop = fx.close_loop(plant, fx.design_static(plant), fx.design_servo(plant, bandwidth=30.0))
    (line, *_) = fx.plot.sensitivity({"servo": loop}).get_lines()
    S = loop.frequency_response(line.get_xdata())["die:error", "die:ref"]
    np.testing.assert_allclose(line.get_ydata(), 20 * np.log10(np.abs(S)), rtol=1e-6, atol=1e-6)
    row = fx.compare_loops({"servo": loop})["servo"]
    assert line.get_ydata().max() == pytest.approx(20 * np.log10(row.peak))


def run_of(errors):
    time = np.arange(50) * 1e-3
    units = {"die:z": "m", "die:error": "m"}
    return Response(time, np.array(errors), ("die:z", "die:error"), units)


@pytest.mark.slow
@pytest.mark.parametrize(
    ("size", "prefix"), [(3e-9, "n"), (4e-6, "\N{MICRO SIGN}"), (5e-3, "m"), (20.0, ""), (2e4, "k")]
)
def test_response_chooses_a_prefix(size, prefix):
    wave = size * np.sin(np.arange(50))
    ax = fx.plot.response(run_of([wave, 0.5 * wave]))
    factor = {"n": 1e-9, "\N{MICRO SIGN}": 1e-6, "m": 1e-3, "": 1.0, "k": 1e3}[prefix]
    np.testing.assert_allclose(ax.get_lines()[0].get_ydata(), 0.5 * wave / factor)
    assert ax.get_ylabel() == f"error [{prefix}m]"
    assert texts(ax) == {"die:error"}
    unknown = run_of([wave, wave]).replace(units={})
    both = fx.plot.response(unknown, ["die:z", "die:error"], unit="rad")
    assert len(both.get_lines()) == 2
    assert both.get_ylabel() == f"rotation [{prefix}rad]"
    bare = fx.plot.response(unknown)
    assert bare.get_ylabel() == "error"
    np.testing.assert_allclose(bare.get_lines()[0].get_ydata(), wave)
    assert ink(ax) > 0.005


@pytest.mark.slow
def test_response_gives_each_unit_a_panel():
    wave = np.sin(np.arange(50))
    data = [2e-6 * wave, 3e-7 * wave, 4.0 * wave, 5e-9 * wave]
    names = ["die:z", "die:rx", "u1", "die:error"]
    units = dict(zip(names, ["m", "rad", "N", "m"], strict=True))
    run = Response(np.arange(50) * 1e-3, np.array(data), names, units)
    first = fx.plot.response(run, ["die:z", "die:rx", "u1", "die:error"])
    panels = first.figure.axes
    assert panels[0] is first
    micro = "\N{MICRO SIGN}"
    labels = [f"displacement [{micro}m]", "rotation [nrad]", "force [N]"]
    assert [panel.get_ylabel() for panel in panels] == labels
    assert [len(panel.get_lines()) for panel in panels] == [2, 1, 1]
    np.testing.assert_allclose(panels[1].get_lines()[0].get_ydata(), 300 * wave)
    assert [panel.get_xlabel() for panel in panels] == ["", "", "time [ms]"]
    colors = [line.get_color() for panel in panels for line in panel.get_lines()]
    assert len(set(colors)) == 4
    assert 0.005 < ink(first) < 0.6
    with pytest.raises(ModelError, match=r"one unit, got die:z \[m\]; die:rx \[rad\]"):
        fx.plot.response(run, ["die:z", "die:rx"], ax=first)


def test_frf_names_the_unit_of_its_channel():
    g = some_frf()
    rotation = g.replace(units={"y1": "rad", "u1": "N m"})
    assert "1 rad/(N m)]" in fx.plot.frf({"a": rotation, "b": g}, "y1", "u1").get_ylabel()
    accelerance = g.replace(quantity="acceleration")
    assert "1 m/s^2/N]" in fx.plot.frf({"a": accelerance}, "y1", "u1").get_ylabel()
    assert fx.plot.frf({"a": g}, "y1", "u1").get_ylabel().endswith("0 dB = 1]")
    with pytest.raises(ModelError, match="different units"):
        fx.plot.frf({"a": rotation, "b": accelerance}, "y1", "u1")


def test_response_of_several_runs_and_of_unknown_channels():
    wave = np.random.default_rng(0).standard_normal((3, 2, 50))
    ax = fx.plot.response(run_of(wave))
    np.testing.assert_allclose(ax.get_lines()[0].get_ydata(), wave[0, 1])
    with pytest.raises(LabelError, match="no channel 'dye'"):
        fx.plot.response(run_of(wave), ["dye"])


def test_layout_shows_every_port_where_it_is():
    dofs = some_modes().dofs
    z8 = dofs.nearest(Z8, "z")
    ax = fx.plot.layout(dofs, ports=ports(), desired=[z8], marked={"here": z8})
    lines = {line.get_label(): np.array(line.get_xydata()) for line in ax.get_lines()}
    assert len(lines["nodes"]) == 81
    np.testing.assert_allclose(lines["actuators"], [1e3 * np.array(p[:2]) for p in INSET])
    np.testing.assert_allclose(lines["sensors"], [1e3 * np.array(p[:2]) for p in CORNERS])
    np.testing.assert_allclose(lines["POI"], [[500 * L, 500 * L]])
    np.testing.assert_allclose(lines["1 desired DOF"], [1e3 * np.array(Z8[:2])])
    assert {"u1", "y4", "die", "here"} <= texts(ax)
    assert 0.005 < ink(ax) < 0.5
    bare = fx.plot.layout(dofs)
    assert [line.get_label() for line in bare.get_lines()] == ["nodes"]
    with pytest.raises(LabelError, match="no DOF"):
        fx.plot.layout(dofs, desired=["0:z"])


@pytest.mark.slow
def test_the_update():
    fit = fitted(reduced(), POLES)
    steps = len(fit.history) + 1
    ax = fx.plot.residual(fit)
    np.testing.assert_allclose(ax.get_lines()[0].get_ydata(), fit.history.error)
    assert ax.get_yscale() == "log"
    assert ink(ax) > 0.005
    ax = fx.plot.eigenvalues(fit, POLES)
    lines = ax.get_lines()
    assert len(lines) == 4
    start = np.abs(fit.history.eigenvalues[0] - POLES)
    np.testing.assert_allclose(lines[1].get_ydata()[0], start[0], rtol=0.01)
    assert all(len(line.get_ydata()) == steps for line in lines)
    drawn = fx.plot.parameters(fit, truth=dict(zip(fit.parameters, (0.5, 0.0), strict=True)))
    assert len(drawn) == 2
    true, found = drawn[0].get_lines()
    np.testing.assert_allclose(found.get_ydata(), 1e3 * fit.history.parameters[:, 0])
    assert true.get_ydata()[0] == pytest.approx(500.0)
    assert drawn[0].get_ylabel().endswith("[g]")
    assert ink(drawn[1]) > 0.005
    axs = list(plt.subplots(2)[1])
    assert fx.plot.parameters(fit, axs=axs) == axs


@pytest.mark.slow
def test_what_is_drawn_later_has_the_unit_of_the_axes():
    """A second run of another size lies where its values are; another quantity is refused."""
    ax = plt.subplots()[1]
    wave = np.ones((2, 50))
    assert fx.plot.response(run_of(1e-6 * wave), ax=ax) is ax
    fx.plot.response(run_of(2e-9 * wave), label="small", ax=ax)
    np.testing.assert_allclose(ax.get_lines()[1].get_ydata(), 2e-3)
    assert ax.get_ylabel() == "error [\N{MICRO SIGN}m]"
    bump = np.exp(-(np.linspace(-20.0, 20.0, 50) ** 2))
    for size in (1e-6, 3e-6):  # with room for the legend, also where a larger one comes later
        fx.plot.response(run_of([size * bump] * 2), label=f"run of {1e6 * size:g}", ax=ax)
        assert covered(ax) == 0
    assert ax.get_ylim()[1] > 3.0 * bump.max()
    rotation = run_of(wave).replace(units={"die:error": "rad"})
    with pytest.raises(ModelError, match="one axes holds one unit: it shows 'error"):
        fx.plot.response(rotation, ax=ax)
    with pytest.raises(ModelError, match=r"this is in m\. Draw it"):
        fx.plot.layout(some_modes().dofs, ax=ax)


def test_frf_shows_what_others_cover_and_differ_by():
    one, two = some_frf(), some_frf(1.5)
    ax = fx.plot.frf({"one": one, "two": two}, "y1", "u1", unit="m/N", reference="one")
    thick, thin, difference = ax.get_lines()
    assert thick.get_linewidth() > 2 * thin.get_linewidth()
    np.testing.assert_allclose(difference.get_ydata(), thick.get_ydata() + 20 * np.log10(0.5))
    assert texts(ax) == {"one", "two", "two minus one"}
    other = some_frf().replace(freq=np.geomspace(2.0, 1e3, 50))
    ax = fx.plot.frf({"one": one, "other": other}, "y1", "u1", unit="m/N", reference="one")
    assert len(ax.get_lines()) == 2
    with pytest.raises(LabelError, match="no response 'three'"):
        fx.plot.frf({"one": one}, "y1", "u1", reference="three")


def test_a_part_of_a_run_has_its_own_prefix():
    wave = np.where(np.arange(50) < 25, 1e-3, 1e-9) * np.ones(50)
    ax = fx.plot.response(run_of([wave, wave]), ["die:z"], span=(0.03, 0.045))
    (line,) = ax.get_lines()
    np.testing.assert_allclose(line.get_xdata(), np.arange(30, 46))
    np.testing.assert_allclose(line.get_ydata(), 1.0)
    assert ax.get_ylabel() == "displacement [nm]"
    with pytest.raises(ModelError, match="no sample between 1 and 2 s"):
        fx.plot.response(run_of([wave, wave]), span=(1.0, 2.0))


def test_predictions_beside_what_was_found():
    rows = {
        "hopeful": [(1e-9, 4e-9, 3.5e-9, 4.4e-9), (1e-8, 4e-8, 3e-8, 5e-8)],
        "honest": [(2e-9, 2e-9, 1.9e-9, 2.1e-9)],
    }
    ax = fx.plot.predictions(rows, colors={"honest": "tab:blue"})
    assert [text.get_text() for text in ax.get_yticklabels()] == ["honest", "hopeful"]
    diamonds = [line for line in ax.get_lines() if line.get_marker() == "D"]
    np.testing.assert_allclose(diamonds[0].get_xdata(), [1.0, 10.0])
    np.testing.assert_allclose(diamonds[1].get_xdata(), [2.0])
    np.testing.assert_allclose(diamonds[1].get_ydata(), 0.0)
    assert diamonds[1].get_color() == "tab:blue"
    found = [
        line for line in ax.get_lines() if line.get_marker() == "|" and line.get_markersize() == 14
    ]
    np.testing.assert_allclose(found[0].get_xdata(), [4.0, 40.0])
    assert ax.get_xlabel() == "rms error [nm]"
    assert texts(ax) == {"predicted by the design", "on the machine, 95 %"}
    assert ink(ax) > 0.005
    values = np.array([rows["honest"][0], rows["hopeful"][0]])
    cases = [EstimatorComparison("die:z", ("a", "b"), k * values, 0.95) for k in (1.0, 3.0)]
    ax = fx.plot.predictions(cases, cases=["quiet", "loud"])
    written = {text.get_text(): text.xy[0] for text in ax.texts}
    assert written == pytest.approx({"quiet": 2.0, "loud": 6.0})
    with pytest.raises(ShapeError, match="1 names of cases"):
        fx.plot.predictions(cases, cases=["quiet"])
    diamonds = [line for line in ax.get_lines() if line.get_marker() == "D"]
    np.testing.assert_allclose(diamonds[0].get_xdata(), [2.0, 6.0])
    assert ax.get_xlabel() == "rms error of die:z [nm]"
    for wrong in ([1.0], [], {}):
        with pytest.raises(ModelError, match="rows must be a mapping"):
            fx.plot.predictions(wrong)
    with pytest.raises(ShapeError, match="hopeful"):
        fx.plot.predictions({"hopeful": [(1.0, 2.0)]})
    with pytest.raises(ModelError, match="positive"):
        fx.plot.predictions({"none": [(0.0, 1.0, 0.9, 1.1)]})


@pytest.mark.slow
def test_an_estimate_with_its_band_and_what_waiting_brings():
    observer = fx.design_kalman(sampled(some_modes()))
    report = observer.report()
    ax = fx.plot.lag_report(report, "die:rx")
    assert texts(ax) == {"estimate with this lag", "filter", "predictor", "smoother",
                         "static relation"}  # fmt: skip
    line = ax.get_lines()[0]
    np.testing.assert_allclose(line.get_xdata(), 1e3 * report.lag[1:])
    np.testing.assert_allclose(line.get_ydata(), 1e9 * report.curve[1:, 1], rtol=1e-12)
    assert ax.get_ylabel() == "rms error of die:rx [nrad]"
    assert ink(ax) > 0.005
    rng = np.random.default_rng(0)
    names = (*observer.sensors, *observer.plant.u)
    result = observer.estimate({name: 1e-9 * rng.standard_normal(40) for name in names})
    ax = fx.plot.estimate(result)
    np.testing.assert_allclose(ax.get_lines()[0].get_xdata(), 1e3 * result.time)
    assert ax.get_ylabel().startswith("die:hat [")
    assert ink(ax) > 0.005
    ax = fx.plot.estimate(result, "y1:innovation", deviations=3.0)
    assert "\N{PLUS-MINUS SIGN} 3 standard deviations" in texts(ax)
    ax = fx.plot.estimate(result, truth=np.nan_to_num(result["die:hat"]))
    assert np.nanmax(np.abs(ax.get_lines()[0].get_ydata())) == 0.0
    with pytest.raises(ModelError, match="Estimate"):
        fx.plot.estimate(report)
    with pytest.raises(ModelError, match="LagReport"):
        fx.plot.lag_report(result)

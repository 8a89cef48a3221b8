"""The page without a browser: each change is one of a LoopDesign, errors leave the last good."""

import io
import shutil
import sys
import types

import numpy as np
import pytest
import scipy.io
from scipy import signal

import flexplant as fx
from bench_plants import (
    MODE,
    RATE,
    by_c,
    by_matrices,
    closed_poles,
    coupled,
    design,
    law,
    light,
    measured,
)
from flexplant.synthesis import FixedBlock, LoopDesign, ShapedAxis
from flexplant.workbench import open_file, side
from flexplant.workbench.consequences import step_of_lines, step_of_model
from flexplant.workbench.controls import fields_of, parsed
from flexplant.workbench.evaluation import BenchMachine, Evaluator
from flexplant.workbench.page import Page

pytest.importorskip("panel")
SAMPLED = {"rate": RATE, "hold": False}


@pytest.fixture(scope="module")
def frf():
    return measured(light(), deviation=0.02)


@pytest.fixture
def page(frf):
    return Page(fx.workbench.open_page(frf, **SAMPLED, open_browser=False))


def verdict(page):
    return page.verdict.object


def numbers(page, i):
    """The sliders of a card by their labels."""
    return {field.label: number for field, number in page.cards._numbers[i]}


def test_it_begins_with_a_law_that_is_stable_far_below_the_modes():
    for plant in (coupled(2), coupled(2) * -1.0):
        bench = fx.workbench.open_page(plant, **SAMPLED, open_browser=False)
        assert bench.design.loops(plant).report.is_stable
        assert {type(e).__name__ for e in bench.design.axes["y1"].elements} == {"Pid", "LowPass"}


@pytest.mark.slow
def test_a_slider_and_a_number_change_the_design_and_the_curves(page):
    before = page.views.sources["magnitude main"].data["y"].copy()
    number = numbers(page, 0)["zero"]
    number.slider.value = np.log10(25.0)
    assert page.design.axes["y1"].elements[0].as_corners()["zero"] == pytest.approx(25.0)
    assert number.text.value == "25 Hz"
    assert np.abs(page.views.sources["magnitude main"].data["y"] - before).max() > 0.5
    number.text.value = "0.03 kHz"
    assert page.design.axes["y1"].elements[0].as_corners()["zero"] == pytest.approx(30.0)
    assert 10.0**number.slider.value == pytest.approx(30.0)
    page.gain.text.value = "-3 dB"
    assert page.design.axes["y1"].gain == pytest.approx(10 ** (-3 / 20))
    page.crossover.value = "35 Hz"
    assert page.loop.margins.crossovers[0] == pytest.approx(35.0, rel=0.02)
    fig = page.views.figures["magnitude"]
    fig.y_range.start, page.views.freq_range.start = -55.0, 7.0
    page.gain.slider.value += 0.1
    assert (fig.y_range.start, page.views.freq_range.start) == (-55.0, 7.0)  # zoom stays


@pytest.mark.slow
def test_elements_come_go_move_and_are_switched_off(page):
    page.kind.value = "notch"
    page._add()
    page.kind.value = "lead"
    page._add()
    names = [type(e).__name__ for e in page.design.axes["y1"].elements]
    assert names == ["Pid", "LowPass", "Notch", "Lead"]
    assert page.design.axes["y1"].elements[2].freq == pytest.approx(MODE, rel=0.01)  # at its peak
    up, down, away = page.cards.column[3][0][1:]
    up.clicks += 1
    names = [type(e).__name__ for e in page.design.axes["y1"].elements]
    assert names == ["Pid", "LowPass", "Lead", "Notch"]
    page.cards.column[3][0][0].value = False
    assert page.design.axes["y1"].on == (True, True, True, False)
    away = page.cards.column[2][0][3]
    away.clicks += 1
    assert [type(e).__name__ for e in page.design.axes["y1"].elements] == [
        "Pid",
        "LowPass",
        "Notch",
    ]
    assert down is not None


@pytest.mark.slow
def test_undo_redo_keep_and_go_back(page):
    first = page.design
    for place in (1.0, 1.1, 1.2):
        numbers(page, 1)["frequency"].slider.value += 0.01 * place
    page.buttons["keep"].clicks += 1
    moved = page.design
    page.kind.value = "integrator"
    page._add()
    page.buttons["undo"].clicks += 1
    assert page.design is moved
    page.buttons["undo"].clicks += 1
    assert page.design is first  # one number moved is one step
    page.buttons["redo"].clicks += 1
    assert page.design is moved
    assert page.views.sources["magnitude kept 0"].data["x"].size == page.loop.freq.size
    page.gain.text.value = "5"
    page.kept_row[0].clicks += 1
    assert page.design is moved


@pytest.mark.slow
def test_what_is_wrong_is_said_and_the_last_good_design_stands(page):
    good, shown = page.design, page.views.sources["magnitude main"].data["y"]
    number = numbers(page, 1)["frequency"]
    for text, said in (("3 kHz", "not below half the rate"), ("many", "is not a frequency")):
        number.text.value = text
        assert page.message.visible
        assert said in page.message.object
        assert "The last good design stands" in page.message.object
        assert page.design is good
    page.hand_over(b"\x80\x04K\x01.")  # a pickle
    assert "was not written by flexplant" in page.message.object
    assert page.views.sources["magnitude main"].data["y"] is shown
    number.text.value = "200 Hz"
    assert not page.message.visible


@pytest.mark.slow
def test_two_tabs_do_not_disturb_each_other(frf):
    bench = fx.workbench.open_page(frf, **SAMPLED, open_browser=False)
    one, two = Page(bench), Page(bench)
    one.gain.text.value = "2"
    assert two.design.axes["y1"].gain == bench.start.axes["y1"].gain != 2.0
    assert one.design.axes["y1"].gain == 2.0


@pytest.mark.slow
def test_what_is_refused_is_not_shown(frf):
    """The boxes hold the design's numbers; corners do not change places; a reload goes on."""
    bench = fx.workbench.open_page(frf, **SAMPLED, open_browser=False)
    page = Page(bench)
    (_, integrator), (_, zero), *_ = page.cards._numbers[0]
    kept = page.design.axes["y1"].elements[0].as_corners()
    for number, text in ((integrator, "9 kHz"), (integrator, "-2"), (integrator, "10 mm"),
                         (zero, f"{0.5 * kept['integrator']:g}")):  # fmt: skip
        before = number.text.value
        number.text.value = text
        assert number.text.value == before
        assert page.message.visible
        assert page.design.axes["y1"].elements[0].as_corners() == kept
    integrator.slider.value = integrator.slider.end
    assert "lies below the zero" in page.message.object
    assert 10.0**integrator.slider.value == pytest.approx(kept["integrator"], rel=0.02)
    page.gain.text.value = "0"
    page.crossover.value = "20 Hz"
    assert "loop gain is zero" in page.message.object
    page.gain.text.value = "200"
    assert Page(bench).design.axes["y1"].gain == 200.0
    limits = page.limits.replace(suppressed=0.1, below=1e-6)
    low = [one for one in limits.judged(page.loop) if one.name.startswith("|S|")]
    assert [(one.reached, one.met) for one in low] == [("no line there", None)]
    with pytest.raises(fx.FlexplantError, match="poles is positive"):
        fields_of(fx.Notch(100.0), 1e3)[2].put(fx.Notch(100.0), 0.0)


@pytest.mark.slow
def test_a_handle_is_dragged_a_machine_is_clicked(frf):
    fleet = {f"stage {i}": measured(light(MODE * f)) for i, f in enumerate((1.0, 1.02, 1.3), 1)}
    page = Page(fx.workbench.open_page(fleet, **SAMPLED, open_browser=False))
    page.kind.value = "notch"
    page._add()

    class Event:
        x, y = MODE, 0.0

    Event.y = float(np.interp(MODE, page.loop.freq, page.views.sources["magnitude main"].data["y"]))
    page.gestures.grasp(Event)
    Event.x, Event.y = 310.0, Event.y - 6.0
    page.gestures.drag(Event)
    page.gestures.drop(Event)
    notch = page.design.axes["y1"].elements[2]
    assert notch.freq == 310.0
    assert notch.depth == pytest.approx(0.1 * 10 ** (-6 / 20), rel=0.02)
    page.buttons["undo"].clicks += 1
    assert page.design.axes["y1"].elements[2].freq == pytest.approx(MODE, rel=0.01)
    assert "of 3 stable" in page.further.object
    third = page.fleet[2]
    Event.x = 1.3 * MODE
    Event.y = float(20 * np.log10(np.abs(np.interp(Event.x, third.freq, np.abs(third.L)))))
    page.gestures.tap("magnitude", Event)
    assert page.machine.name == "stage 3"
    assert page.loop.machine is page.machine


@pytest.mark.slow
def test_limits_are_drawn_and_judged():
    page = Page(fx.workbench.open_page(light(), open_browser=False))
    box = page.views._boxes[0]
    assert box.bottom == pytest.approx(20 * np.log10(2.0))
    page.side.limits[0].value = "4 dB"
    assert box.bottom == pytest.approx(4.0)
    disc = page.views.sources["disc"].data
    np.testing.assert_allclose(np.hypot(disc["x"] + 1.0, disc["y"]), 10 ** (-4 / 20))
    page.side.limits[2].value = "80 deg"
    assert "phase margin at least 80 deg" in page.judged.object
    assert "not met" in page.judged.object


@pytest.mark.slow
def test_feedforward_and_files(page, tmp_path):
    page.side.forward[2].value = "1.5"
    assert page.design.axes["y1"].feedforward == (0.0, 0.0, 1.5)
    saved = side._written("design.npz", page.design.save)
    other = Page(page.bench)
    other.hand_over(saved)
    assert np.array_equal(other.design.controller().A, page.design.controller().A)
    assert other.design.controller().inputs == page.design.controller().inputs
    block = FixedBlock(fx.lti.tf([1.0], [1e-4, 1.0]))
    block.block.save(tmp_path / "filter.npz")
    other.hand_over((tmp_path / "filter.npz").read_bytes())
    (fx.Lead(50.0) * 2.0).save(tmp_path / "law.npz")
    gain = other.design.axes["y1"].gain
    other.hand_over((tmp_path / "law.npz").read_bytes())
    elements = other.design.axes["y1"].elements
    assert [type(e).__name__ for e in elements[2:]] == ["FixedBlock", "Lead"]
    assert other.design.axes["y1"].gain == 2.0 * gain
    light().save(tmp_path / "rate.npz")
    other.hand_over((tmp_path / "rate.npz").read_bytes())  # at the rate of the page: taken
    assert len(other.design.axes["y1"].elements) == 5
    LoopDesign({"x": ShapedAxis()}).save(tmp_path / "other.npz")
    other.hand_over((tmp_path / "other.npz").read_bytes())
    assert "the design is of axes x at 0 Hz" in other.message.object


@pytest.mark.slow
def test_what_is_exported_is_the_controller(page, tmp_path):
    """C compiled, sections, MATLAB and the script against the matrices, over 400 samples."""
    K = page.design.controller()
    error = np.random.default_rng(1).normal(size=400)
    wanted = by_matrices(K, error)
    if shutil.which("cc"):
        found = by_c(io.BytesIO(side.c_code(page.design)), tmp_path, error)
        np.testing.assert_allclose(found, wanted, rtol=1e-7)
    table = np.genfromtxt(
        io.BytesIO(side.sections(page.design)), delimiter=",", skip_header=1, usecols=range(2, 8)
    )
    np.testing.assert_allclose(-signal.sosfilt(table, error), wanted, rtol=1e-6)
    mat = scipy.io.loadmat(io.BytesIO(side.matlab_file(page.design)), squeeze_me=True)
    assert np.array_equal(np.atleast_2d(mat["controller"]["A"].item()), K.A)
    made = {}
    exec(page.design.script(""), made)
    assert np.array_equal(made["controller"].A, K.A)
    assert made["controller"].inputs == K.inputs
    text = side.report_page(page.design, page.machine.given).decode()
    assert "LoopDesign" in text
    assert "y1" in text


def test_numbers_as_they_are_typed():
    for text, value in (("1.2 kHz", 1200.0), ("-20 dB", 0.1), ("0.1 %", 1e-3), ("3,5", 3.5),
                        ("1e-3", 1e-3), ("2 ms", 2e-3)):  # fmt: skip
        assert parsed(text) == pytest.approx(value)
    for text in ("", "12 parsec", "1 2"):
        with pytest.raises(fx.FlexplantError, match="is not a number with a unit"):
            parsed(text)
    notch = fx.Notch(100.0, depth=0.1, width=0.5)
    zeros, poles = (f for f in fields_of(notch, 1e3) if f.label.startswith("damping"))
    assert zeros.read(notch) == pytest.approx(0.05)
    wider = poles.put(notch, 0.8)
    assert (poles.read(wider), zeros.read(wider)) == pytest.approx((0.8, 0.05))


def test_the_step_from_lines_is_that_of_the_model():
    plant = light()
    frf = measured(plant, np.linspace(0.25, 2000.0, 8000))
    made = design(frf, law(40.0, fx.Notch(MODE, 0.01, 0.2)), **SAMPLED)
    loop = Evaluator().loop(BenchMachine.on(frf, made, ""), made, "y1")
    time, error = step_of_lines(loop, 0.2)
    model = BenchMachine.on(plant, made, "model")
    exact_time, exact = step_of_model(model, made, "y1", 0.2)
    np.testing.assert_allclose(time, exact_time[: time.size])
    assert np.abs(error - exact[: error.size]).max() < 0.01
    # and the model's by its matrices
    K, P = made.controller(), plant
    x, k, found = np.zeros(P.n_states), np.zeros(K.n_states), []
    for _ in range(200):
        e = 1.0 - (P.C @ x)[0]
        u = K.C @ k - K.D @ np.array([e])
        x, k = P.A @ x + P.B @ u, K.A @ k - K.B @ np.array([e])
        found.append(e)
    np.testing.assert_allclose(exact[:200], found, atol=1e-9)


@pytest.mark.slow
def test_with_a_plant_the_page_shows_the_error_and_the_modes_left_out():
    model = fx.chain(masses=[1.0] * 4, stiffnesses=[4e5] * 3)
    modes = fx.solve_modes(model, count=4, damping=fx.ModalDamping(0.01))
    ports = fx.testbeds.three_masses().assembled.ports
    plant = fx.assemble_plant(modes.select([0, 1]), ports, evaluation=modes)
    plant = plant.discretized(2e3, delay=1)
    bench = fx.workbench.open_page(plant, open_browser=False)
    page = Page(bench)
    assert bench.design.references == {"die:x": "die:ref"}
    K = page.design.controller()
    loop = fx.close_loop(plant, K)
    answer = page.answer
    assert answer.channel == "die:error"
    assert answer.rms == pytest.approx(loop.rms("die:error"), rel=1e-9)
    assert np.sqrt(sum(v**2 for _, v in answer.sources)) == pytest.approx(answer.rms, rel=1e-6)
    assert f"{loop.spectral_radius:.9g}" in page.further.object
    assert "truncated modes" in page.further.object
    assert answer.error[0] == pytest.approx(1.0)
    feedback = K.select(inputs=[n for n in K.inputs if n in plant.y and n != "die:ref"])
    assert page.loop.is_stable is bool(
        np.abs(closed_poles(plant.Gyu.select(feedback.inputs), feedback)).max() < 1.0
    )
    assert "of machines" not in page.further.object
    high = page.loop.margins.modulus_margin
    page.gain.text.value = f"{40 * page.design.axes['die:x'].gain:g}"
    assert "UNSTABLE" in verdict(page)
    assert "unstable" in page.further.object
    assert page.loop.margins.modulus_margin != high


@pytest.mark.slow
def test_with_a_plant_whose_machines_are_known_the_page_has_their_intervals():
    plant = fx.testbeds.three_masses().uncertain(frequency=0.01, damping=0.3)
    page = Page(fx.workbench.open_page(plant, open_browser=False))
    loop = fx.close_loop(plant, page.design.controller())
    for name in ("die:error", "modulus margin", "bandwidth"):
        low, high, sentence = loop.interval(name)
        assert low < high and "on 95 % of such machines" in sentence
        row = page.further.object.split(f"{name} of machines")[1].split("</tr>")[0]
        assert sentence in row


@pytest.mark.slow
def test_a_measurement_over_its_model():
    plant = fx.testbeds.three_masses()
    frf = fx.frequency_response(plant.Gyu.select(["y1"]), np.linspace(0.5, 900.0, 1800))
    bench = fx.workbench.open_page(
        frf, model=plant.Gyu.select(["y1"]), hold=False, open_browser=False
    )
    page = Page(bench)
    main, model = (page.views.sources[f"magnitude {n}"].data for n in ("main", "model"))
    shown = np.interp(np.log(main["x"]), np.log(model["x"]), model["y"])
    assert np.median(np.abs(shown - main["y"])) < 0.05
    assert page.answer.time.size > 10


@pytest.mark.long
def test_tuning_reports_can_be_stopped_and_is_taken():
    plant = light()
    page = Page(fx.workbench.open_page(measured(plant), **SAMPLED, open_browser=False))
    page.tune(1)
    page.tuning.stop()
    assert not page.tuning.is_running
    page.tuning = None
    before = page.design
    page.tune(1)
    page.tuning._process.wait(120)
    page._poll()
    tuned = page.design
    assert tuned is not before
    found = fx.tune_loops(
        measured(plant), **SAMPLED, peak=2.0, notches=1, before=before.before, after=before.after
    )
    np.testing.assert_allclose(tuned.controller().C, found.system.C)
    assert page.kept[0][1] is before


@pytest.mark.slow
def test_files_that_hold_a_plant(frf, tmp_path, capsys):
    frf.save(tmp_path / "a.npz")
    np.savez(tmp_path / "b.npz", freq=frf.freq, data=frf.data)
    fx.io.write_frf_csv(tmp_path / "c.csv", frf)
    fx.io.write_mat(tmp_path / "d.mat", frf)
    for name in ("a.npz", "b.npz", "c.csv", "d.mat"):
        plant, made, line = open_file(tmp_path / name)
        np.testing.assert_allclose(plant.data, frf.data, rtol=1e-9)
        assert made is None
        again = {"fx": fx}
        exec(line, again)
        assert again["plant"].freq.size == frf.freq.size
    pyuff = pytest.importorskip("pyuff")
    record = {
        "type": 58, "func_type": 4, "rsp_node": 41, "rsp_dir": 3, "ref_node": 41, "ref_dir": 3,
        "data": frf.data[0, 0], "x": frf.freq, "id1": "", "abscissa_spacing": 1,
        "abscissa_inc": 0.25, "abscissa_min": 0.25, "spec_data_type": 18,
        "abscissa_spec_data_type": 18, "ordinate_spec_data_type": 8, "ordinate_axis_units_lab": "m",
        "orddenom_spec_data_type": 13, "orddenom_axis_units_lab": "N",
    }  # fmt: skip
    pyuff.UFF(str(tmp_path / "e.uff")).write_sets(record, mode="overwrite")
    plant, _, line = open_file(tmp_path / "e.uff")
    np.testing.assert_allclose(plant.data, frf.data, rtol=1e-6)
    assert line.startswith("plant = fx.io.read_frf_uff(")
    design(frf, **SAMPLED).save(tmp_path / "design.npz")
    assert open_file(tmp_path / "design.npz")[1].rate == RATE
    with pytest.raises(fx.FlexplantError, match="no kind that the workbench opens"):
        open_file(__file__)
    fx.Lead(3.0).save(tmp_path / "lead.npz")
    with pytest.raises(fx.FlexplantError, match="holds a Lead"):
        open_file(tmp_path / "lead.npz")
    from flexplant.workbench.__main__ import main

    assert main([str(tmp_path / "none.npz")]) == 1
    assert main([str(tmp_path / "design.npz")]) == 2
    frf.save(tmp_path / "measured.npz")
    assert main([str(tmp_path / "measured.npz")]) == 2
    assert "give --rate" in capsys.readouterr().err
    assert main([str(tmp_path / "none.npz")]) == 1
    assert "does not exist" in capsys.readouterr().err


@pytest.mark.slow
def test_the_command_takes_what_its_refusals_ask_for(frf, tmp_path, capsys, monkeypatch):
    """A file of several quantities, and one in an unknown unit; advice as it is typed."""
    pyuff = pytest.importorskip("pyuff")
    from flexplant.workbench import __main__ as command

    def written(name, kinds, label):
        path = tmp_path / name
        for node, kind in enumerate(kinds, 1):
            record = {
                "type": 58, "func_type": 4, "rsp_node": node, "rsp_dir": 3, "ref_node": 1,
                "ref_dir": 3, "data": frf.data[0, 0], "x": frf.freq, "abscissa_spacing": 1,
                "abscissa_inc": 0.25, "abscissa_min": 0.25, "abscissa_spec_data_type": 18,
                "ordinate_spec_data_type": kind, "ordinate_axis_units_lab": label,
                "orddenom_spec_data_type": 13, "orddenom_axis_units_lab": "N",
            }  # fmt: skip
            pyuff.UFF(str(path)).write_sets(record, mode="add" if node > 1 else "overwrite")
        return str(path)

    opened = []
    monkeypatch.setattr(command, "open_page", lambda plants, **_: opened.append(plants) or exit(0))
    mixed = written("mixed.uff", (12, 8), "NONE")
    assert command.main([mixed, "--continuous"]) == 1
    said = capsys.readouterr().err
    assert "--quantity acceleration" in said
    assert "quantity='" not in said
    with pytest.raises(SystemExit):
        command.main([mixed, "--continuous", "--quantity", "displacement"])
    plant = opened[-1][mixed]
    assert plant.quantity == "displacement"
    np.testing.assert_allclose(plant.data[1, 0], frf.data[0, 0], rtol=1e-5)
    factor = (2j * np.pi * frf.freq) ** -2.0
    np.testing.assert_allclose(plant.data[0, 0], frf.data[0, 0] * factor, rtol=1e-5)
    line = open_file(mixed, quantity="velocity")[2]
    again = {"fx": fx}
    exec(line, again)
    assert again["plant"].quantity == "velocity"
    strange = written("strange.uff", (8,), "EU")
    assert command.main([strange, "--continuous"]) == 1
    said = capsys.readouterr().err
    assert "--scale 9.80665 for g/N, --scale 1 for SI." in said
    with pytest.raises(SystemExit):
        command.main([strange, "--continuous", "--scale", "3.0"])
    np.testing.assert_allclose(opened[-1][strange].data[0, 0], 3 * frf.data[0, 0], rtol=1e-5)
    # of other files the response is converted
    frf.replace(quantity="displacement").save(tmp_path / "a.npz")
    plant, _, line = open_file(tmp_path / "a.npz", quantity="acceleration")
    np.testing.assert_allclose(plant.data[0, 0], frf.data[0, 0] / factor, rtol=1e-9)
    assert line.endswith(".converted('acceleration')")
    with pytest.raises(fx.FlexplantError, match="takes no scale"):
        open_file(tmp_path / "a.npz", scale=2.0)


@pytest.mark.slow
def test_a_notebook_shows_the_page_in_its_cell(frf, monkeypatch):
    bench = fx.workbench.open_page(frf, **SAMPLED, open_browser=False)
    import panel as pn

    monkeypatch.setattr(pn.extension, "_loaded", True)  # as pn.extension() does in a notebook
    for name in ("IPython", "IPython.display"):  # Panel says there which document is shown
        shell = types.ModuleType(name)
        shell.display, shell.get_ipython = (lambda *args, **more: None), (lambda: None)
        monkeypatch.setitem(sys.modules, name, shell)
    bundle, _ = bench._repr_mimebundle_()
    assert "text/html" in bundle
    assert repr(bench).startswith("<WorkbenchServer of Frf: u1 -> y1")


def test_wrong_options_are_refused(frf):
    for options, said in (
        ({"limits": 2.0}, "limits"), ({"move": 1.0}, "move"),
        ({"design": 3}, "design must be of type LoopDesign"),
        ({"design": design(frf, **SAMPLED), "rate": 2e3}, "are in the design already"),
    ):  # fmt: skip
        with pytest.raises(fx.FlexplantError, match=said):
            fx.workbench.open_page(frf, open_browser=False, **options)
    with pytest.raises(fx.FlexplantError, match="needs a plant"):
        fx.workbench.open_page([], open_browser=False)

"""The report of a design: complete, self-contained, well-formed, and alive in a browser."""

import http.server
import json
import os
import queue
import re
import shutil
import subprocess
import sys
import threading
import urllib.parse
from collections import Counter
from types import SimpleNamespace
from xml.etree import ElementTree as ET

import matplotlib.pyplot as plt
import numpy as np
import pytest

import flexplant as fx
from flexplant.errors import FlexplantWarning, LabelError, ModelError, with_unit
from flexplant.plot._axes import Device
from flexplant.plot.coinciding_curves import widen_hidden
from flexplant.plot.html_report import _ports_table
from flexplant.plot.node_lines import neighbours
from stages import RATE, ports, reduced, some_modes

CHROMIUM = next(
    filter(None, map(shutil.which, ("chromium", "chromium-browser", "google-chrome"))), None
)
HOSTILE = "a <b> & \"'</script>"


def tree_of(text):
    """The page as XML: scripts hold signs that HTML allows there."""
    body = re.sub(r"(<script[^>]*>).*?(</script>)", r"\1\2", text, flags=re.DOTALL)
    return ET.fromstring(body.removeprefix("<!DOCTYPE html>"))


def words(tree):
    return " ".join("".join(tree.itertext()).split())


@pytest.fixture(scope="module")
def design():
    channels = ports(references=[fx.Reference("die", axes=("z", "rx", "ry"))])
    plant = fx.assemble_plant(reduced(), channels).discretized(RATE, delay=1)
    observer = fx.design_static(plant)
    servo = fx.design_servo(
        plant.replace(evaluation=some_modes(count=60)), bandwidth=40.0, observer=observer
    )
    loop = fx.close_loop(plant.replace(evaluation=some_modes(count=60)), observer, servo)
    move = fx.setpoint(1e-4, velocity=5e-3, acceleration=0.5, jerk=100.0)
    run = fx.simulate(loop, reference={"die:ref": move}, duration=0.1, rng=7)
    sensors = tuple(ports().y)
    placement = fx.Placement(("y1", "y2"), 2.0, 1.0, 3, ((2.0,),), "anything", sensors[:2], "y")
    return [loop, plant, {HOSTILE: servo, "run": run}, placement, observer, some_modes()]


@pytest.fixture(scope="module")
def text(design, tmp_path_factory):
    path = tmp_path_factory.mktemp("report") / "design.html"
    fx.plot.report(path, *design, title=f"Stage {HOSTILE}", seeds={"test": 8})
    return path.read_text(encoding="utf-8")


@pytest.mark.slow
def test_the_page_is_well_formed_and_loads_nothing(text):
    tree = tree_of(text)
    ids = Counter(one.get("id") for one in tree.iter() if one.get("id"))
    assert max(ids.values()) == 1
    links = [one.get("href") for one in tree.iter() if one.get("href")]
    assert all(link[1:] in ids for link in links if link[0] == "#")
    assert all(link[0] == "#" or link.startswith("data:image/png") for link in links)
    assert not re.search(r"https?:|//\w|@import|url\((?!#)", re.sub(r"// .*", "", text))
    assert not [one for one in tree.iter() if one.get("src")]
    assert len(text) < 2e6
    assert "<b>" not in text.replace("<b>ClosedLoop", "")[: text.index("</header>")]
    assert HOSTILE in words(tree)


@pytest.mark.slow
def test_it_begins_with_the_result_and_ends_with_versions(text, design):
    tree, loop = tree_of(text), design[0]
    headings = [one.text for one in tree.iter("h2")]
    assert headings[:2] == ["Result", "Loop"] and headings[-2:] == [
        "Certificates",
        "Seeds and versions",
    ]
    assert {"Runs", "Controller", "Observer", "Placement", "Plant", "Machine"} < set(headings)
    tiles = [words(one) for one in tree.iter("div") if "tile " in one.get("class", "")]
    error = with_unit(loop.rms("die:error"), "m")
    beyond = with_unit(loop.completed.rms("die:error"), "m")
    assert tiles[0] == f"die:error, rms{error}with the truncated modes {beyond}"
    assert tiles[1] == f"stabilitystablespectral radius {loop.spectral_radius:.4f}"
    assert "stablespectral radius" in tiles[2] and "(126 states)" in tiles[2]
    whole = loop.completed.modulus_margin
    assert f"modulus margin {whole:.3g} with the truncated modes" in tiles[3]
    said = words(tree)
    seeds = "seed of run7", "seed of test8"
    for part in (
        fx.__version__,
        np.__version__,
        *seeds,
        "u4:effort",
        "Compared with the model of the loop",
        "lower bound of all",
    ):
        assert part in said
    drawn = [one for one in tree.iter("figure") if one.get("class") == "picture"]
    assert len(drawn) >= 8 and all(one.find(".//path") is not None for one in drawn)
    captions = [words(one.find("figcaption")) for one in drawn]
    for part in (
        "Contributions to the error of die:error",
        "Contributions to die:rx:error",
        "Contributions to die:ry:error",
        "sensitivity |S| of each axis, from its reference to its error",
        "Sensors, actuators and POIs",
        "The plant, from forces along each axis to the POI",
    ):
        assert any(part in one for one in captions), part


@pytest.mark.slow
def test_of_several_references_none_is_taken_silently(design):
    loop = design[0]
    with pytest.raises(LabelError, match=r"3 references .*reference='die:ref'"):
        fx.compare_loops({"servo": loop})
    pairs = {"die": "die", "die:rx": "die:rx", "die:ry": "die:ry"}
    drawn = {line.get_label(): line for line in fx.plot.sensitivity(loop).get_lines()}
    named = fx.plot.sensitivity({"servo": loop}).get_legend_handles_labels()[1]
    assert named[:3] == ["servo die", "servo die:rx", "servo die:ry"]
    for label, axis in pairs.items():
        freq, size = drawn[label].get_data()
        point = freq.size // 2
        found = loop.frequency_response(freq[[point]])[f"{axis}:error", f"{axis}:ref"]
        assert size[point] == pytest.approx(20 * np.log10(abs(found[0])), abs=1e-6)
        row = fx.compare_loops({"servo": loop}, reference=f"{axis}:ref")["servo"]
        # the table judges the loop on the evaluation model, the picture shows the design model
        assert row.peak == pytest.approx(10 ** (max(size) / 20), rel=1e-3)


@pytest.mark.slow
def test_pictures_can_be_read_in_a_column(text):
    """Of 10 points, text on 474 pixels (a telephone of 500) is at least 10 pixels high."""
    widths = [float(one) for one in re.findall(r'viewBox="0 0 ([\d.]+) [\d.]+"', text)]
    assert len(widths) >= 8
    assert max(widths) < 474.0


@pytest.mark.long
def test_the_same_values_give_the_same_file(design, tmp_path):
    """Names of elements and the order of all parts hang on nothing else."""
    parts = [one for one in design if not isinstance(one, fx.ClosedLoop)]
    first, second = (fx.plot.report(tmp_path / name, *parts).read_bytes() for name in "ab")
    assert first == second


IN_A_PROCESS = """
import sys
import numpy as np
import flexplant as fx
from flexplant.placement import SensorMap

def drawn():
    return 1

parts = {"filter": fx.lti.low_pass_filter(10.0), "law": fx.workbench.LoopLimits(peak=2.0)}
seeds = {"drawn": drawn, "lambda": lambda: 1, "rng": np.random.default_rng(3),
         "object": object(), "set": {"a", "b", "c", "d"}, "sum": np.linalg.norm}
fx.plot.report(sys.argv[1], parts, seeds=seeds)
"""


@pytest.mark.long
def test_two_processes_write_the_same_file(tmp_path):
    """To the byte, also of functions, objects and sets, whose reprs hold addresses or an order."""
    for number in ("1", "2"):
        env = {**os.environ, "PYTHONHASHSEED": number}
        command = [sys.executable, "-c", IN_A_PROCESS, str(tmp_path / number)]
        subprocess.run(command, env=env, check=True, timeout=120)
    first, second = ((tmp_path / number).read_text(encoding="utf-8") for number in "12")
    assert first == second
    assert "__main__.drawn" in first and " at 0x" not in first


def test_ports_stand_with_their_places_and_true_directions():
    """A label has its direction, a weighted sum those of its parts, a force on the mass its own."""
    at = {"1:x": 0.5, "2:x": -0.5}
    found = fx.Ports(
        u=[fx.Actuator("label", "3:x"), fx.Actuator("point", (0.1, 0.2, 0.0), direction="y")],
        y=[fx.Sensor("sum", at=at, asd=1e-9), fx.Sensor("mixed", at={"1:x": 1.0, "2:rz": 0.25})],
        z=[fx.Poi("die", (0.0, 0.0, 0.0), axes=("z", "rx")), fx.Poi("gap", at)],
        w=[fx.plant.RigidForce("cable", "rz", asd=1e-3)],
    )
    wanted = {
        "label": ("3:x", "x"), "point": ("(0.1, 0.2, 0)", "y"), "cable": ("", "rz"),
        "sum": ("0.5 of 1:x -0.5 of 2:x", "x"), "mixed": ("1 of 1:x +0.25 of 2:rz", "x rz"),
        "die": ("(0, 0, 0)", "z rx"), "gap": ("0.5 of 1:x -0.5 of 2:x", "x"),
    }  # fmt: skip
    plant = SimpleNamespace(assembled=SimpleNamespace(ports=found), units={})
    rows = {cells[0]: cells for cells in table_rows(_ports_table(plant))}
    for name, (place, along) in wanted.items():
        assert rows[name][2:4] == [place, along]
    point = np.zeros(3)
    devices = {port.name: Device.of(port, point) for port in (*found.u, *found.y, *found.z)}
    assert [devices[n].direction for n in ("label", "point", "sum", "mixed", "die", "gap")] == [
        "x", "y", "x", "", "", "",
    ]  # fmt: skip


def table_rows(html):
    return [[words(cell) for cell in row] for row in ET.fromstring(html).iter("tr")]


@pytest.mark.slow
def test_each_test_and_certificate_says_good_or_bad(text):
    tree = tree_of(text)
    (said,) = [one for one in tree.iter("section") if one.get("id") == "certificates"]
    head, *rows = [[words(cell) for cell in row] for row in said.iter("tr")]
    assert head == ["value", "checked", "figure", "limit", "verdict", "route"]
    for _, checked, figure, limit, verdict, _ in rows:
        assert (verdict == "no limit") == (limit == ""), checked
        if limit:
            least = float(re.search(r"[-+.\de]+", limit.split()[2])[0])
            kept = float(figure) >= least if "at least" in limit else float(figure) <= least
            assert verdict == ("good" if kept else "bad"), checked
    (tests,) = re.findall(r"NIS [\d.]+, 1 expected +p \S+ +at least 0.01 +(good|bad)", text)
    assert tests


def test_curves_on_one_another_are_all_seen():
    """The lower of curves that coincide is wider, by as much as each one above it shows."""
    x, rng = np.linspace(0.0, 1.0, 300), np.random.default_rng(1)
    ax = plt.figure().add_subplot()
    y = np.sin(7 * x)
    grids = [x, x, np.sort(rng.uniform(0.0, 1.0, 500)), x]
    for k, own in enumerate(grids):
        ax.plot(own, np.interp(own, x, y) + (0.5 if k == 3 else 0.0), label=f"u{k}", linewidth=1.0)
    ax.plot(x, y, linewidth=1.0)  # without a name, as limits are
    widen_hidden(ax)
    widths = [line.get_linewidth() for line in ax.get_lines()]
    assert widths[0] > widths[1] + 1.0 > widths[2] + 2.0
    assert widths[2:] == [1.0, 1.0, 1.0]
    plt.close("all")


def test_an_unstable_loop_is_reported_as_such(tmp_path):
    """Of a plant made elsewhere, whose noise is not known: what cannot be shown says why."""
    g = fx.StateSpace(
        [[1.0]], [[1.0, 1.0]], [[1.0], [1.0]], 0, inputs=["w", "u"], outputs=["z", "y"]
    )
    plant = fx.StandardPlant.from_statespace(g, w=["w"], u=["u"], z=["z"], y=["y"])
    K = fx.StateSpace(
        np.zeros((0, 0)), np.zeros((0, 1)), np.zeros((1, 0)), [[-0.5]], inputs=["y"], outputs=["u"]
    )
    good = fx.close_loop(plant, K.replace(D=[[-2.0]]))
    with pytest.warns(FlexplantWarning, match="unstable"):
        bad = fx.close_loop(plant, K)
    said = words(tree_of(fx.plot.report(tmp_path / "bad", bad, {"good": good}).read_text()))
    assert "stabilityUNSTABLElargest real part 0.5 rad/s" in said
    assert "No error budget: " in said and "No margins: unstable" in said
    assert (
        "with the truncated modesnot judged on a larger model" in said and "modulus margin" in said
    )


def test_what_is_no_report(tmp_path):
    with pytest.raises(ModelError, match="report is empty"):
        fx.plot.report(tmp_path / "x")
    with pytest.raises(ModelError, match="holds values of flexplant, got 3"):
        fx.plot.report(tmp_path / "x", 3)
    with pytest.raises(ModelError, match="two parts of the report are named 'a'"):
        fx.plot.report(
            tmp_path / "x", {"a": fx.lti.low_pass_filter(1.0)}, {"a": fx.lti.low_pass_filter(2.0)}
        )
    assert not list(tmp_path.iterdir())


def test_what_has_no_picture_says_so(tmp_path):
    """Two points span no map: the rest of the report is there."""
    points = np.array([[0.0, 0.0, 0.0], [1.0, 1.0, 0.0]])
    found = fx.placement.SensorMap(points, np.array([2.0, 1.0]), 4.0, "PoiVariance()", ())
    said = words(tree_of(fx.plot.report(tmp_path / "map", found).read_text()))
    assert "Not shown: 2 points on one line span no map" in said and "versions" in said


def test_neighbours_are_the_lines_of_a_mesh():
    """Of a box of 3 x 2 x 2 cells with sides 1, 4 and 0.5: all edges, no diagonals."""
    x, y, z = np.meshgrid(np.arange(4.0), 4.0 * np.arange(3), 0.5 * np.arange(3), indexing="ij")
    xyz = np.column_stack([x.ravel(), y.ravel(), z.ravel()])
    pairs = neighbours(xyz)
    assert len(pairs) == 3 * 9 + 2 * 12 + 2 * 12
    steps = np.abs(xyz[pairs[:, 0]] - xyz[pairs[:, 1]])
    assert np.all(np.count_nonzero(steps, axis=1) == 1)


PROBE = """
<script>
window.addEventListener("load", async () => {
  const figure = document.querySelector("figure.picture"), svg = figure.querySelector("svg");
  const press = (what) => figure.querySelector(`[data-do=${what}]`).click();
  const box = () => svg.getAttribute("viewBox").split(" ").map(Number);
  const found = { whole: box() };
  const panel = JSON.parse(figure.dataset.panels)[0], rect = svg.getBoundingClientRect();
  const scale = rect.width / found.whole[2];
  const place = (x, y) => ({ clientX: rect.left + x * scale, clientY: rect.top + y * scale });
  const middle = place((panel.box[0] + panel.box[2]) / 2, (panel.box[1] + panel.box[3]) / 2);
  const canvas = figure.querySelector(".canvas"), send = (kind, at, more = {}) =>
    canvas.dispatchEvent(new PointerEvent(kind, { bubbles: true, pointerId: 1, ...at, ...more }));
  send("pointermove", middle);
  found.panel = panel;
  found.read = figure.querySelector("output").textContent;
  press("in");
  found.zoomed = box();
  canvas.setPointerCapture = () => {};
  send("pointerdown", middle);
  send("pointermove", { clientX: middle.clientX + 20, clientY: middle.clientY });
  send("pointerup", middle);
  found.dragged = box();
  press("reset");
  found.reset = box();
  press("large");
  found.large = getComputedStyle(figure).position;
  press("large");
  const shape = document.querySelector("figure.shape canvas");
  shape.scrollIntoView();
  const picture = () => shape.toDataURL();
  const frame = () => new Promise(requestAnimationFrame);
  const first = picture();
  while (picture() === first) await frame();
  document.querySelector("figure.shape button").click();
  const still = picture();
  for (let i = 0; i < 10; i++) await frame();
  found.stops = picture() === still;
  const select = document.querySelector("figure.shape select");
  select.value = "5";
  select.dispatchEvent(new Event("input"));
  found.other = picture() !== still;
  found.wide = document.documentElement.scrollWidth <= window.innerWidth;
  tell(found);
});
const tell = (found) => { location = "/found?" + encodeURIComponent(JSON.stringify(found)); };
window.addEventListener("error", (event) => tell(event.message));
window.addEventListener("unhandledrejection", (event) => tell(String(event.reason)));
</script>
</body>"""


def browsed(page, *options):
    """What the script of a page finds in a browser, which goes to an address that says it."""
    said = queue.Queue()

    class Here(http.server.BaseHTTPRequestHandler):
        def do_GET(self):
            path, _, query = self.path.partition("?")
            if path == "/found":
                said.put(json.loads(urllib.parse.unquote(query)))
            self.send_response(200)
            self.send_header("Content-Type", "text/html; charset=utf-8")
            self.end_headers()
            self.wfile.write(page.encode() if path == "/" else b"")

        def log_message(self, *_):
            pass

    with http.server.ThreadingHTTPServer(("127.0.0.1", 0), Here) as server:
        threading.Thread(target=server.serve_forever, daemon=True).start()
        command = [CHROMIUM, "--headless", "--no-sandbox", "--disable-gpu", *options]
        nothing = {"stdout": subprocess.DEVNULL, "stderr": subprocess.DEVNULL}
        browser = subprocess.Popen([*command, f"http://127.0.0.1:{server.server_port}/"], **nothing)
        try:
            return said.get(timeout=300)
        finally:
            browser.terminate()
            browser.wait()
            server.shutdown()


@pytest.mark.slow
@pytest.mark.skipif(CHROMIUM is None, reason="needs chromium")
@pytest.mark.parametrize("width", [1280, 500])
def test_the_page_lives_in_a_browser(text, tmp_path, width):
    """Zoom, drag, cursor, large view; a mode moves, stops and changes; nothing is too wide.

    The mode moves, or this waits for it in vain.
    """
    found = browsed(
        text.replace("</body>", PROBE), "--disable-dev-shm-usage", f"--window-size={width},900",
        f"--user-data-dir={tmp_path / 'profile'}",
    )  # fmt: skip
    assert isinstance(found, dict), found
    whole, zoomed, dragged = (np.array(found[k]) for k in ("whole", "zoomed", "dragged"))
    np.testing.assert_allclose(zoomed[2:], whole[2:] / 1.6, rtol=1e-3)
    assert dragged[0] < zoomed[0] and dragged[2] == zoomed[2]
    assert found["reset"] == found["whole"] and found["large"] == "fixed"
    assert found["stops"] and found["other"] and found["wide"]
    low, high, logarithmic, label = found["panel"]["x"]
    assert logarithmic and "[Hz]" in label
    read = re.match(rf"{re.escape(label)}: ([\d.e+-]+)", found["read"])
    assert float(read[1]) == pytest.approx(np.sqrt(low * high), rel=0.03)


def test_a_weighted_plant_shows_its_machine(tmp_path):
    """Ports, places and standard assumptions, as of a plant without weights."""
    plant = fx.testbeds.three_masses()
    heavy = plant.weighted(fx.stage_weights(plant, 20.0))
    page = fx.plot.report(tmp_path / "heavy.html", {"heavy": heavy}).read_text(encoding="utf-8")
    assert "Standard assumptions" in page and "u actuator" in page


@pytest.mark.slow
@pytest.mark.parametrize("kind", ["hexapod", "maglev_block"])
def test_a_driven_machine_is_drawn(kind, tmp_path):
    """Its axes; and its devices from above, unless all masses are at one point."""
    page = fx.plot.report(tmp_path / "page.html", {"p": getattr(fx.testbeds, kind)()})
    said = words(tree_of(page.read_text(encoding="utf-8")))
    assert "from forces along each axis to the POI" in said
    assert ("needs at least three DOFs in z at different places" in said) == (kind == "hexapod")

"""The page in a real browser: dragged, typed, exported, reloaded; safe, for this machine only."""

import asyncio
import gc
import os
import signal
import subprocess
import sys
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import numpy as np
import pytest

import flexplant as fx
from bench_plants import (
    MODE,
    RATE,
    by_c,
    by_matrices,
    closed_poles,
    coupled,
    design,
    light,
    measured,
)
from browser_tabs import Tab, browser_of

pytest.importorskip("panel", reason="the workbench needs panel")

#: a browser that is closed leaves sockets which are collected some time later
pytestmark = [
    pytest.mark.slow,
    pytest.mark.filterwarnings("ignore::pytest.PytestUnraisableExceptionWarning"),
]


@pytest.fixture(scope="module", autouse=True)
def collected():
    """What is left is collected here, not in the tests of another file."""
    yield
    gc.collect()


@pytest.fixture(scope="module")
def browser():
    sync = pytest.importorskip("playwright.sync_api", reason="the browser needs playwright")
    with sync.sync_playwright() as play:
        found = browser_of(play)
        yield found
        found.close()


@pytest.fixture(scope="module")
def plant():
    return light()


@pytest.fixture(scope="module")
def served(plant):
    frf = measured(plant, deviation=1e-3)
    bench = fx.workbench.open_page(
        frf, model=plant, hold=False, source='plant = fx.load("a.npz")', open_browser=False
    )
    bench.serve()
    yield bench
    bench.close()


def overflow(page):
    """How much wider than its window the page is [pixels]."""
    return page.evaluate("document.documentElement.scrollWidth - window.innerWidth")


@pytest.mark.long
def test_a_loop_is_shaped_in_a_browser(browser, served, plant, tmp_path):
    """Slid, typed, a notch on a mode of 0.1 %, dragged, exported, compiled, reloaded."""
    tab = Tab(browser, served.url)
    page = tab.page
    start = served.design.axes["y1"]
    assert tab.verdict.startswith("y1: stable")
    # higher: the mode makes it unstable
    page.get_by_placeholder("e.g. 60 Hz").fill("45 Hz")
    page.get_by_placeholder("e.g. 60 Hz").press("Enter")
    tab.until(lambda: tab.figure("crossover").startswith("45"))
    page.get_by_text("new law").click()
    tab.until(lambda: served.design.axes["y1"].elements[0].pole == 135.0)
    tab.until(lambda: "45" in tab.figure("crossover"))
    K = served.design.controller()
    assert np.abs(closed_poles(plant, K)).max() > 1.0
    tab.until(lambda: "UNSTABLE" in tab.verdict)
    # a notch from the list stands at the mode at once: stable
    page.get_by_text("+ add").click()
    tab.until(lambda: tab.verdict.startswith("y1: stable"))
    notch = served.design.axes["y1"].elements[2]
    assert notch.freq == pytest.approx(MODE, rel=0.01)
    # off and on again
    switch = page.locator("input[type=checkbox]").nth(2)
    switch.click()
    tab.until(lambda: "UNSTABLE" in tab.verdict)
    switch.click()
    tab.until(lambda: tab.verdict.startswith("y1: stable"))
    # its handle is dragged in the picture: by 6 % to the right, it misses the mode
    drag(tab, lambda: served.design.axes["y1"].elements[2].freq, 1.03 * MODE)
    # typed back, with a unit
    tab.type(lambda: f"{served.design.axes['y1'].elements[2].freq:.5g} Hz", "0.3 kHz")
    tab.until(lambda: served.design.axes["y1"].elements[2].freq == MODE)
    tab.until(lambda: tab.verdict.startswith("y1: stable"))
    # a slider of the law, moved by the mouse
    before = served.design.axes["y1"].gain
    knob = page.locator(".noUi-handle").first.bounding_box()
    page.mouse.move(knob["x"] + 7, knob["y"] + 9)
    page.mouse.down()
    page.mouse.move(knob["x"] + 5, knob["y"] + 9, steps=2)
    page.mouse.up()
    tab.until(lambda: served.design.axes["y1"].gain != before)
    page.wait_for_timeout(500)  # the hand is off the slider, its last step is drawn
    gain = served.design.axes["y1"].gain
    assert np.sign(gain - before) == -1.0
    assert np.abs(closed_poles(plant, served.design.controller())).max() < 1.0
    # what is wrong is said, the design stands
    tab.type(lambda: "300 Hz", "9 kHz")
    alert = page.get_by_role("alert")
    alert.wait_for()
    assert "not below half the rate" in alert.inner_text()
    assert served.design.axes["y1"].elements[2].freq == MODE
    page.screenshot(path=tmp_path / "shaped.png")
    # C, compiled and compared
    with page.expect_download() as download:
        page.get_by_text("save C99").click()
    download.value.save_as(tmp_path / "loops.zip")
    error = np.random.default_rng(0).normal(size=200)
    wanted = by_matrices(served.design.controller(), error)
    found = by_c(tmp_path / "loops.zip", tmp_path, error)
    np.testing.assert_allclose(found, wanted, rtol=1e-7)
    # saved, everything undone, loaded again
    with page.expect_download() as download:
        page.get_by_text("save design").click()
    download.value.save_as(tmp_path / "design.npz")
    kept = served.design
    assert fx.load(tmp_path / "design.npz").axes["y1"].gain == gain
    for _ in range(12):
        page.get_by_text("undo").click()
    tab.until(lambda: repr(served.design.axes["y1"]) == repr(start))
    page.wait_for_timeout(1000)  # the clicks that are left undo nothing of what is loaded
    page.locator("input[type=file]").set_input_files(tmp_path / "design.npz")
    tab.until(lambda: repr(served.design.axes["y1"]) == repr(kept.axes["y1"]))
    one, two = kept.controller(), served.design.controller()
    assert all(np.array_equal(getattr(one, m), getattr(two, m)) for m in "ABCD")
    # the script that is copied makes the same loop
    text = page.locator("textarea")
    tab.until(lambda: "Notch(freq=300.0" in text.input_value())
    made = {}
    exec(text.input_value().replace('plant = fx.load("a.npz")', "").rpartition("print(")[0], made)
    assert np.array_equal(made["controller"].A, one.A)
    assert not tab.errors
    assert tab.hosts == {served.url.split("/")[2]}  # nothing is loaded from elsewhere
    for width in (1400, 800):
        page.set_viewport_size({"width": width, "height": 1100})
        page.wait_for_timeout(400)
        assert overflow(page) <= 0
    page.close()


def drag(tab, freq, above):
    """Drag a handle by 9 pixels to the right; again where a busy machine drew under the mouse."""
    mouse = tab.page.mouse
    for wait in (6.0, 6.0, 12.0, 25.0, 50.0):  # [s] a lost move is seen soon, a slow one too
        places = [[], handle_of(tab.page, freq())]

        def rests(places=places):
            places.append(handle_of(tab.page, freq()))
            return places[-1] == places[-2] == places[-3]

        tab.until(rests)
        x, y = places[-1]
        mouse.move(x, y)
        mouse.down()
        mouse.move(x + 4, y, steps=2)
        mouse.move(x + 9, y, steps=3)
        mouse.up()
        reached = [0.0, 0.0, freq()]

        def arrived(reached=reached):  # and every move of the mouse is worked off
            reached.append(freq())
            return above < reached[-1] == reached[-2] == reached[-3] == reached[-4]

        try:
            return tab.until(arrived, wait)
        except AssertionError:
            continue
    raise AssertionError(f"the handle at {freq()} Hz does not move: {tab.verdict}")


def handle_of(page, freq):
    """Where a handle is on the screen: Bokeh's own scales say it."""
    found = page.evaluate(
        """freq => {
        const doc = Bokeh.documents[0], all = [...doc._all_models.values()]
        const source = all.find(m => m.type == 'ColumnDataSource' && m.data.name && m.data.at)
        const points = all.find(m => m.type == 'GlyphRenderer' && m.data_source === source
                                && m.glyph.type == 'Scatter')
        const index = [...source.data.x].findIndex(x => Math.abs(x - freq) < 1e-6 * freq)
        const find = views => { for (const view of views) {
            if (view.model && view.model.type == 'Figure' && view.model.renderers.includes(points))
                return view
            const inner = find(view.children ? [...view.children()] : [])
            if (inner) return inner
        } return null }
        const figure = find(Object.values(Bokeh.index.roots ? [...Bokeh.index.roots]
                                          : Object.values(Bokeh.index)))
        const frame = figure.frame, box = figure.canvas_view.el.getBoundingClientRect()
        return [box.x + frame.x_scale.compute(source.data.x[index]),
                box.y + frame.y_scale.compute(source.data.y[index])]
        }""",
        freq,
    )
    return [float(v) for v in found]


@pytest.mark.long
def test_two_tabs_and_a_closed_one(browser, served):
    one, two = Tab(browser, served.url), Tab(browser, served.url, 800)
    before = two.figure("crossover")
    one.page.get_by_placeholder("e.g. 60 Hz").fill("15 Hz")
    one.page.get_by_placeholder("e.g. 60 Hz").press("Enter")
    one.until(lambda: one.figure("crossover").startswith("15"))
    assert two.figure("crossover") == before
    count = served._server.sessions
    assert count >= 2
    one.page.close()
    two.until(lambda: served._server.sessions < count, 30.0)
    assert two.figure("crossover") == before
    two.page.close()


def test_only_the_page_itself_may_talk_to_it(served):
    """A page of another origin is refused by the server, whatever the browser allows."""
    websocket = pytest.importorskip("tornado.websocket")
    from tornado.httpclient import HTTPClientError, HTTPRequest

    address = served.url.replace("http", "ws") + "ws"
    protocols = ["bokeh", token_of(served.url)]

    async def status(origin):
        request = HTTPRequest(address, headers={"Origin": origin})
        try:
            found = await websocket.websocket_connect(request, subprotocols=protocols)
        except HTTPClientError as error:
            return error.code
        found.close()
        while await found.read_message() is not None:  # until the server has closed it too
            pass
        return 101

    async def both():
        return [await status(o) for o in (served.url.rstrip("/"), "http://elsewhere.example")]

    with ThreadPoolExecutor(1) as aside:  # the browser's loop runs in this thread
        assert aside.submit(lambda: asyncio.run(both())).result(60) == [101, 403]
    # and only on this machine's own address
    assert served._server._server.address == "127.0.0.1"


def token_of(url):
    import re
    import urllib.request

    with urllib.request.urlopen(url, timeout=60) as answer:
        text = answer.read().decode()
    return re.search(r'"token":"([^"]+)"', text).group(1)


@pytest.mark.long
def test_from_the_shell_until_ctrl_c(tmp_path):
    measured(light()).save(tmp_path / "measured.npz")
    words = [sys.executable, "-m", "flexplant.workbench", str(tmp_path / "measured.npz")]
    words += ["--sampled", "--rate", str(RATE), "--no-browser"]
    source = str(Path(fx.__file__).parents[1])
    with subprocess.Popen(
        words, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True,
        env=os.environ | {"PYTHONPATH": source},
        # where this runs in the background of a shell, it was started with SIGINT ignored
        preexec_fn=lambda: signal.signal(signal.SIGINT, signal.SIG_DFL),
    ) as process:  # fmt: skip
        try:
            line = process.stdout.readline()
            assert line.startswith("flexplant workbench at http://127.0.0.1:")
            process.send_signal(signal.SIGINT)
            assert process.wait(30) == 0
        finally:
            process.kill()


@pytest.mark.long
def test_a_fleet_of_coupled_axes(browser):
    """Its verdict in words, another axis, another machine, in a narrow window."""
    first = coupled(2, count=600)
    fleet = [first * (1.0 + 0.01 * i) for i in range(4)]
    bench = fx.workbench.open_page(
        fleet, design=design(first, rate=RATE, hold=False), open_browser=False
    ).serve()
    try:
        tab = Tab(browser, bench.url, 800)
        assert tab.page.get_by_text("of 4 stable").count() == 1
        tab.page.get_by_text("y2", exact=True).first.click()
        tab.until(lambda: tab.verdict.startswith("y2"))
        assert overflow(tab.page) <= 0
        assert not tab.errors
    finally:
        bench.close()

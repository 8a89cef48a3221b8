"""From a slider's step to new curves and verdict, in a browser, and the server's share of it.

A step is a new value of a slider's model in the browser, which goes to the server as when it is
moved by hand; it ends when curve and verdict are new and the frame with them is painted.
"""

import statistics
import time

import pytest

import flexplant as fx
from bench_plants import RATE, coupled, design, law
from browser_tabs import Tab, browser_of
from flexplant.workbench.page import Page

pytest.importorskip("panel", reason="the workbench needs panel")
pytestmark = pytest.mark.benchmark

STEPS = 25
STEP = """() => new Promise(resolve => {
    const models = Bokeh.documents.flatMap(doc => [...doc._all_models.values()])
    const slider = models.find(m => m.type == 'Slider')
    const lines = models.filter(m => m.type == 'GlyphRenderer' && m.glyph.type == 'Line')
    const source = lines.map(m => m.data_source).find(s => s.data.x && s.data.x.length == 2000)
    const said = models.find(m => m.text && m.text.includes('data-verdict'))
    let curve = false, verdict = false
    const begin = performance.now()
    const over = () => {
        if (!curve || !verdict) return
        requestAnimationFrame(() => {
            const painted = new MessageChannel()
            painted.port1.onmessage = () => resolve(performance.now() - begin)
            painted.port2.postMessage(0)
        })
    }
    const once = (signal, act) => { const slot = () => { signal.disconnect(slot); act(); over() }
                                    signal.connect(slot) }
    once(source.properties.data.change, () => { curve = true })
    once(said.properties.text.change, () => { verdict = true })
    window.at = (window.at || 0) + 1
    slider.value += (window.at % 2 ? 1 : -1) * 0.03
})"""


@pytest.mark.parametrize(("axes", "machines", "limit"), [(1, 1, 0.1), (6, 20, 0.25)])
def test_a_slider_step(axes, machines, limit, monkeypatch):
    sync = pytest.importorskip("playwright.sync_api")
    drawn, draw = [], Page.draw

    def timed(page):
        begin = time.thread_time()
        draw(page)
        drawn.append(time.thread_time() - begin)

    monkeypatch.setattr(Page, "draw", timed)
    fleet = [coupled(axes, seed=i) for i in range(machines)]
    made = design(fleet[0], law(30.0), rate=RATE, hold=False)
    bench = fx.workbench.open_page(fleet, design=made, open_browser=False).serve()
    try:
        with sync.sync_playwright() as play:
            browser = browser_of(play)
            tab = Tab(browser, bench.url)
            tab.page.wait_for_timeout(3000)
            for _ in range(5):
                tab.page.evaluate(STEP)
            drawn.clear()
            times = []
            for _ in range(STEPS):
                times.append(1e-3 * tab.page.evaluate(STEP))
                tab.page.wait_for_timeout(50)
            browser.close()
    finally:
        bench.close()
    step, share = statistics.median(times), statistics.median(drawn)
    print(
        f"\n{axes} axes, {machines} machines, 2000 lines: {1e3 * step:.0f} ms from a slider's step "
        f"to the screen (worst of {STEPS}: {1e3 * max(times):.0f}), of which the server computes "
        f"{1e3 * share:.0f} ms of CPU; limit {1e3 * limit:.0f} ms"
    )
    assert step < limit

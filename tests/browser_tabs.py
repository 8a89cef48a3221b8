"""The page in a tab of a real browser, for tests and benchmarks."""

import shutil
import time

import pytest

BROWSERS = ("chromium", "chromium-browser", "google-chrome")
WORDS = ["--no-sandbox", "--headless", "--disable-gpu", "--disable-background-networking"]


def browser_of(play):
    """A browser of this machine; the tests that need one are skipped where there is none."""
    path = next((found for name in BROWSERS if (found := shutil.which(name))), None)
    if path is None:
        pytest.skip("no browser: install chromium (apt-get install chromium)")
    return play.chromium.launch(executable_path=path, args=WORDS)


class Tab:
    """A tab of the page, as somebody uses it."""

    def __init__(self, browser, url, width=1400):
        self.page = browser.new_page(viewport={"width": width, "height": 1100})
        self.hosts, self.errors = set(), []
        self.page.on("request", lambda request: self.hosts.add(request.url.split("/")[2]))
        self.page.on("pageerror", lambda error: self.errors.append(str(error)))
        self.page.goto(url)
        self.page.wait_for_selector("[data-verdict]", timeout=60_000)

    @property
    def verdict(self):
        return self.page.locator("[data-verdict]").inner_text()

    def figure(self, name):
        return self.page.locator(f"[data-figure='{name}']").inner_text()

    def until(self, holds, seconds=20.0):
        end = time.monotonic() + seconds
        while not holds():
            assert time.monotonic() < end, f"not in {seconds} s: {self.verdict}"
            self.page.wait_for_timeout(50)

    @property
    def values(self):
        """What stands in the boxes."""
        boxes = self.page.locator("input[type=text]")
        return [boxes.nth(i).input_value() for i in range(boxes.count())]

    def type(self, value, text):
        """Type into the box that shows a value."""
        at = []

        def shown():  # both are read once: they change while a drag is worked off
            held, sought = self.values, value()
            at[:] = [held.index(sought)] if sought in held else []
            return bool(at)

        self.until(shown)
        box = self.page.locator("input[type=text]").nth(at[0])
        box.fill(text)
        box.press("Enter")

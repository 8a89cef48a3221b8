"""The documentation has a page for every room and example, and links that lead somewhere."""

import html
import inspect
import re
import subprocess
import sys
from pathlib import Path

import pytest

import flexplant
from flexplant.documentation import _Site, check_links, rooms
from test_public_api import ROOMS

ROOT = Path(__file__).parents[1]


def test_links_that_lead_nowhere_are_found(tmp_path):
    (tmp_path / "a.html").write_text(
        '<h1 id="top"></h1><a href="b.html#there">x</a><a href="#top">x</a><img src="p.png"/>'
        '<a href="https://example.org/none">x</a>'
    )
    (tmp_path / "b.html").write_text('<p id="here"></p><a href="a.html#top">x</a>')
    found = check_links(tmp_path)
    assert (found.pages, found.links, found.pictures) == (2, 4, 1)
    assert found.broken == ("a.html: b.html#there", "a.html: p.png")
    (tmp_path / "b.html").write_text('<p id="there"></p>')
    (tmp_path / "p.png").write_bytes(b"")
    assert check_links(tmp_path).broken == ()


def test_every_room_has_a_page():
    assert set(rooms()) == ROOMS | {"bibliography", "algorithms"}


def test_what_pdoc_does_not_read_is_put_in_its_words():
    site = _Site()
    site.at("flexplant.loop")
    said = site.markdown("Makes `fx.design_hinf`, `close_loop` of [paper]_::\n\n    code\n")
    assert "[`fx.design_hinf`](../flexplant/synthesis.html#design_hinf)" in said
    assert "`close_loop` of [paper](../flexplant/bibliography.html#paper):\n" in said
    assert "[`close_loop`]" not in said, "a name of the page itself is pdoc's to link"
    # pdoc takes the last colon of a line for the one before the type
    assert site.markdown("z : mapping {name: weight}").count(":") == 1
    table = "=====  =====\na      b\n=====  =====\n1      2\n=====  =====\n"
    assert site.markdown(f"{table}\nText.\n").startswith(f"```text\n{table}```\n")
    assert site.markdown("```python\n`fx.load`\n```\n") == "```python\n`fx.load`\n```\n"


def test_a_story_is_its_text_pictures_and_cells():
    site = _Site()
    path = ROOT / "examples" / "wafer_stage.py"
    text = site.story(path, ["wafer_stage.png"])
    title = path.read_text(encoding="utf-8").strip('"').partition("\n")[0]
    assert text.startswith(f"## {title}\n")
    assert "![wafer_stage.png](../pictures/wafer_stage.png)" in text
    cells = re.findall(r"^# %% (.*)$", path.read_text(encoding="utf-8"), re.MULTILINE)
    assert re.findall(r"^### (.*)$", text, re.MULTILINE) == cells
    assert "``python examples/wafer_stage.py`` draws" in site.story(path, [])


@pytest.mark.long
def test_the_site(tmp_path):
    pytest.importorskip("pdoc")
    command = [sys.executable, "-m", "flexplant.documentation", str(tmp_path)]
    answer = subprocess.run(command, capture_output=True, text=True, check=True)
    assert "links that lead somewhere" in answer.stdout
    for name in rooms():
        page = (tmp_path / "flexplant" / f"{name}.html").read_text(encoding="utf-8")
        shown = {
            n
            for n in dir(getattr(flexplant, name))
            if name not in ("errors", "bibliography", "algorithms")
        }
        assert not {n for n in shown if f'id="{n}"' not in page}
        assert "_public_names" not in page
    for path in (ROOT / "examples").glob("*.py"):
        page = (tmp_path / "examples" / f"{path.stem}.html").read_text(encoding="utf-8")
        assert "<h3" in page
    front = (tmp_path / "flexplant.html").read_text(encoding="utf-8")
    assert 'src="pictures/wafer_stage.png"' in front
    assert "design_hinf" in (tmp_path / "search.js").read_text(encoding="utf-8")
    verbs = html.unescape((tmp_path / "flexplant" / "algorithms.html").read_text(encoding="utf-8"))
    assert 'id="stage_weights"' in verbs and 'href="#design_kalman"' in verbs, "in the contents too"
    text = inspect.getdoc(flexplant.algorithms)
    formulas = re.findall(r"^\.\. math:: (.*?)\n\n", text, re.MULTILINE | re.DOTALL)
    assert len(formulas) == 2
    for formula in formulas:
        assert f"$${' '.join(formula.split())}$$" in verbs, formula

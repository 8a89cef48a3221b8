"""The documentation has a page for every room, example and task, and links that lead somewhere."""

import html
import re
import subprocess
import sys
from html.parser import HTMLParser
from pathlib import Path
from xml.etree import ElementTree as ET

import pytest

import flexplant
from flexplant import documentation
from flexplant.documentation import _TEXTS, Shown, _gallery, _shown, _Site, _story, keep, rooms
from test_public_api import ROOMS

ROOT = Path(__file__).parents[1]
PAGES = ROOT / "src" / "flexplant" / "pages"


class Page(HTMLParser):
    """The places and the references of one page."""

    def __init__(self, text):
        super().__init__()
        self.places, self.references = set(), []
        self.feed(text)

    def handle_starttag(self, tag, attrs):
        """Collect ids, links, pictures and scripts."""
        for name, value in attrs:
            if name == "id" and value:
                self.places.add(value)
            if name in ("href", "src") and value:
                self.references.append((tag, value))


def broken(folder):
    """Return the links of a folder's pages that lead nowhere, and scripts from elsewhere."""
    found = (path.resolve() for path in folder.resolve().rglob("*.html"))
    pages = {path: Page(path.read_text(encoding="utf-8")) for path in found}
    wrong = []
    for path, page in pages.items():
        for tag, reference in page.references:
            if re.match(r"[a-z]+:", reference):  # data in the page, and other places in the net
                foreign = tag in ("script", "img", "link") and not reference.startswith("data:")
                wrong += [f"{path.name}: {reference} from the net"] if foreign else []
                continue
            file, _, place = reference.partition("#")
            target = (path.parent / file).resolve() if file else path
            known = pages.get(target)
            there = known is not None or target.exists()
            if not there or (place and (known is None or place not in known.places)):
                wrong.append(f"{path.relative_to(folder.resolve())}: {reference}")
    return list(dict.fromkeys(wrong))


def test_links_that_lead_nowhere_are_found(tmp_path):
    (tmp_path / "a.html").write_text(
        '<h1 id="top"></h1><a href="b.html#there">x</a><a href="#top">x</a><img src="p.png"/>'
        '<a href="https://example.org/none">x</a><script src="https://example.org/a.js"></script>'
    )
    (tmp_path / "b.html").write_text('<p id="here"></p><a href="a.html#top">x</a>')
    net = "a.html: https://example.org/a.js from the net"
    assert broken(tmp_path) == ["a.html: b.html#there", "a.html: p.png", net]
    (tmp_path / "b.html").write_text('<p id="there"></p>')
    (tmp_path / "p.png").write_bytes(b"")
    assert broken(tmp_path) == [net]


def test_every_room_has_a_page():
    assert set(rooms()) == ROOMS | {"bibliography", "algorithms"}


def test_what_pdoc_does_not_read_is_put_in_its_words():
    site = _Site()
    said = site.markdown("Makes `fx.design_hinf`, `close_loop` of [paper]_::\n\n    code\n")
    said = site.finished("flexplant.loop", said)
    assert "[`fx.design_hinf`](../flexplant/synthesis.html#design_hinf)" in said
    assert "of [paper](../flexplant/bibliography.html#paper):\n" in said
    # pdoc takes the last colon of a line for the one before the type
    assert site.markdown("z : mapping {name: weight}").count(":") == 1
    assert site.markdown("```python\n`fx.load`\n```\n") == "```python\n`fx.load`\n```\n"


def test_formulas_are_mathml_in_the_page():
    pytest.importorskip("latex2mathml")
    site = _Site()
    text = "A\n\n    .. math:: \\frac{a}{b} +\n        c_1\n\n    B, $x^2$\n\n"
    text += "$$y = 1, \\qquad z = 2$$\n"
    page = site.finished("", site.markdown(text))
    formulas = re.findall(r"<math.*?</math>", page)
    assert [ET.fromstring(one).get("display") for one in formulas] == [
        "block", "inline", "block", "block",  # a line may end between equations
    ]  # fmt: skip
    assert "mfrac" in formulas[0] and "msup" in formulas[1]
    assert "math::" not in page and "$" not in page


def test_a_story_is_its_text_pictures_output_and_cells():
    path = ROOT / "examples" / "wafer_stage.py"
    text = _story(path, Shown("margin 0.41", (Path("a/wafer_stage.png"),)))
    title = path.read_text(encoding="utf-8").strip('"').partition("\n")[0]
    assert text.startswith(f"## {title}\n")
    assert "pictures/wafer_stage.png)" in text and "```text\nmargin 0.41\n```" in text
    cells = re.findall(r"^# %% (.*)$", path.read_text(encoding="utf-8"), re.MULTILINE)
    assert re.findall(r"^### (.*)$", text, re.MULTILINE) == ["What it prints", *cells]
    assert "``python examples/wafer_stage.py`` prints" in _story(path, None)
    assert "margin 0.41" in _gallery({path: Shown("margin 0.41", ())})


def test_the_readmes_example_comes_first():
    assert [path.stem for path in _Site().stories][:2] == ["wafer_stage", "gantry"]


def test_what_an_example_shows_is_kept_until_its_source_changes(tmp_path, monkeypatch):
    monkeypatch.setattr(documentation, "_EXAMPLES", tmp_path)
    story = tmp_path / "story.py"
    story.write_text(
        "from pathlib import Path\nout = Path(__file__).parent / 'out'\nout.mkdir()\n"
        "(out / 'story.png').write_bytes(b'x')\nprint('margin', 0.5)\n"
    )
    assert _shown(story) is None
    documentation._run(story)
    printed, pictures = _shown(story)
    assert printed == "margin 0.5\n" and [one.name for one in pictures] == ["story.png"]
    story.write_text("raise ValueError('no machine')\n")
    assert _shown(story) is None
    with pytest.raises(flexplant.errors.SolverError, match=r"(?s)story\.py fails.*no machine"):
        documentation._run(story)
    keep(story, "by hand", [])
    assert _shown(story).printed == "by hand\n"
    assert len(list((tmp_path / "out" / "shown").iterdir())) == 1, "older ones are gone"


CODE = [
    pytest.param(code, id=f"{path.stem}-{i}")
    for path in sorted(PAGES.glob("*.md"))
    for i, code in enumerate(
        re.findall(r"^```python\n(.*?)^```", path.read_text(encoding="utf-8"), re.M | re.S)
    )
]


@pytest.mark.slow
@pytest.mark.filterwarnings("default::flexplant.FlexplantWarning")
@pytest.mark.parametrize("code", CODE)
def test_the_code_of_a_page_runs(code, capsys):
    exec(compile(code, "page", "exec"), {})
    assert capsys.readouterr().out


def test_names_on_the_pages_exist():
    for path in PAGES.glob("*.md"):
        text = path.read_text(encoding="utf-8")
        named = re.findall(r"(?<!`)`((?:fx\.)?[A-Za-z]\w*(?:\.\w+)+)`(?!`)", text)
        for name in named:
            if name.endswith((".mtx", ".full")) or name.startswith("flexplant."):
                continue
            value = flexplant
            for part in name.removeprefix("fx.").split("."):
                value = getattr(value, part)
    assert {path.stem for path in PAGES.glob("*.md")} == set(_TEXTS)


@pytest.mark.long
def test_the_site(tmp_path):
    """Examples are not run here: pages show what is there already."""
    pytest.importorskip("pdoc")
    pytest.importorskip("latex2mathml")
    command = [sys.executable, "-m", "flexplant.documentation", str(tmp_path), "--no-runs"]
    answer = subprocess.run(command, capture_output=True, text=True, check=True)
    assert "pages: open index.html" in answer.stdout
    assert broken(tmp_path) == []
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
    assert 'src="pictures/wafer_stage.png"' in front and "A whole design" in front
    for name in (*_TEXTS, "versions", "examples"):
        assert f'href="{name}.html"' in front
    assert "numpy" in (tmp_path / "versions.html").read_text(encoding="utf-8")
    index = (tmp_path / "search.js").read_text(encoding="utf-8")
    assert "design_hinf" in index and "formula0x" not in index
    verbs = html.unescape((tmp_path / "flexplant" / "algorithms.html").read_text(encoding="utf-8"))
    assert 'id="stage_weights"' in verbs and "#design_kalman" in verbs, "in the contents too"
    assert verbs.count("<math") == 2 and "<math" in (tmp_path / "how_it_works.html").read_text()


@pytest.mark.slow
def test_no_line_within_a_paragraph_looks_like_a_list():
    """A line that begins with a sign or "2." would become an item of a list on its page."""
    item, wrong = re.compile(r"\s*([-+]|\d+[.)]) "), []
    for path in sorted(Path(flexplant.__file__).parent.rglob("*.py")):
        for doc in re.findall(r'"""(.*?)"""', path.read_text(encoding="utf-8"), re.DOTALL):
            for paragraph in re.split(r"\n\s*\n", doc):
                lines = paragraph.splitlines()
                items = [i for i, line in enumerate(lines) if item.match(line)]
                if items and items[0] and "math::" not in paragraph and ">>>" not in paragraph:
                    before = lines[items[0] - 1].strip()
                    wrong += [] if before.endswith(":") else [(path.name, lines[items[0]].strip())]
    assert not wrong

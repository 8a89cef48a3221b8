"""The documentation as a site: ``python -m flexplant.documentation site`` (extra ``docs``).

pdoc writes a page for every room, with its docstring first, followed by its exported names. The
pages of ``flexplant/pages``, the examples and the README are added to these. The page of an example
shows what the example prints and draws. For this the example is run once, and again when its source
has changed. With ``--no-runs`` only the results of earlier runs are shown.
"""

from __future__ import annotations

import hashlib
import inspect
import os
import re
import shutil
import subprocess
import sys
import tempfile
import warnings
from collections.abc import Iterable
from concurrent.futures import ThreadPoolExecutor
from importlib import import_module
from importlib.metadata import requires
from operator import attrgetter
from pathlib import Path
from types import ModuleType
from typing import Any, NamedTuple

from .errors import FlexplantError, SolverError, counted
from .rooms import versions

_ROOT = Path(__file__).parents[2]
_EXAMPLES = _ROOT / "examples"
_PAGES = Path(__file__).parent / "pages"
#: modules that get a page without being rooms
_MORE = ("bibliography", "errors", "algorithms")
#: examples that the gallery shows first
_FIRST = ("wafer_stage", "gantry")
#: texts of the folder `pages`, in the order in which they are listed
_TEXTS = ("how_it_works", "my_matrices", "only_an_frf", "refused", "from_matlab")
#: what runs are given: no browser, and a size that leaves time for the others
_ARGUMENTS = {"workbench": ("--no-browser",), "fleet": ("4",)}
_COLON = "\ue000"  # stands for a colon that pdoc would take for the one before the type
_DOT = "\ue001"  # stands for a dot of a name that is a link already: pdoc would make it one too
_HOME = "@root@/"  # stands for the way from a page to the folder of the site


class Shown(NamedTuple):
    """What an example prints, and the pictures that it draws."""

    printed: str
    pictures: tuple[Path, ...]


# ---- examples are run, and their output is kept by their source


def _kept(story: Path) -> Path:
    source = hashlib.sha256(story.read_bytes()).hexdigest()
    return _EXAMPLES / "out" / "shown" / f"{story.stem}-{source[:16]}"


def keep(story: Path, printed: str, pictures: Iterable[Path]) -> None:
    """Keep what a run of an example printed and drew, for its page."""
    folder = _kept(story)
    for older in folder.parent.glob(f"{story.stem}-*"):
        shutil.rmtree(older)
    folder.mkdir(parents=True)
    for path in pictures:
        shutil.copyfile(path, folder / path.name)
    (folder / "printed.txt").write_text(printed.rstrip() + "\n", encoding="utf-8")


def _run(story: Path) -> None:
    """Run an example in a copy of its folder, and keep what it prints and draws."""
    with tempfile.TemporaryDirectory() as place:
        copy = Path(place) / "examples"
        shutil.copytree(_EXAMPLES, copy, ignore=shutil.ignore_patterns("out", "*.png", "__*"))
        answer = subprocess.run(
            [sys.executable, str(copy / story.name), *_ARGUMENTS.get(story.stem, ())],
            capture_output=True,
            text=True,
            env=os.environ | {"MPLBACKEND": "Agg"},
        )
        if answer.returncode:
            raise SolverError(f"examples/{story.name} fails: {answer.stderr[-2000:]}")
        printed = answer.stdout.replace(str(copy), "examples")
        keep(story, printed, sorted(copy.rglob("out/**/*.png")))


def _shown(story: Path) -> Shown | None:
    folder = _kept(story)
    if not folder.exists():
        return None
    printed = (folder / "printed.txt").read_text(encoding="utf-8")
    return Shown(printed, tuple(sorted(folder.glob("*.png"))))


# ---- texts


def rooms() -> dict[str, ModuleType]:
    """Return the modules that get a page, by name."""
    top = import_module("flexplant")
    names = [name for name in dir(top) if isinstance(getattr(top, name), ModuleType)]
    return {name: import_module(f"flexplant.{name}") for name in (*names, *_MORE)}


def _page_names(name: str, room: ModuleType) -> list[str]:
    """Return the names that the page of a room lists."""
    if name == "errors":
        raised = (n for n, item in vars(room).items() if inspect.isclass(item))
        return [n for n in raised if issubclass(vars(room)[n], FlexplantError | Warning)]
    return [] if name in _MORE else sorted(dir(room), key=lambda n: (n[0].isupper(), n.lower()))


class _Site:
    """The rooms, where each name is, the examples, and the formulas found so far."""

    def __init__(self) -> None:
        self.rooms = rooms()
        self.names = {n: _page_names(n, room) for n, room in self.rooms.items()}
        self.where: dict[str, str] = {}
        for room, names in self.names.items():
            for name in names:
                self.where.setdefault(name, room)
        stories = _EXAMPLES.glob("*.py") if _EXAMPLES.is_dir() else ()
        self.stories = sorted(stories, key=lambda p: (p.stem not in _FIRST, p.stem != _FIRST[0], p))
        self.formulas: dict[str, str] = {}
        self.searched: set[str] | None = None  # full texts, while the search index is written

    def markdown(self, text: str) -> str:
        """Return a docstring or page with what pdoc does not know: formulas, literals, links."""
        if self.searched is not None and text not in self.searched:
            text = text.partition("\n\n")[0]  # of a function its first paragraph is searched
        elif self.searched is not None:
            text = text.partition("\n### What it prints")[0]  # of an example its introduction
        parts = re.split(r"(^ *```.*?^ *```)", text, flags=re.MULTILINE | re.DOTALL)
        parts[::2] = [self._prose(part) for part in parts[::2]]
        return "".join(parts)

    def _prose(self, text: str) -> str:
        text = re.sub(
            r"^(\S[^\n]*? : )([^\n]*:[^\n]*)$",
            lambda m: m[1] + m[2].replace(":", _COLON),
            text,
            flags=re.MULTILINE,
        )
        rst = r"^( *)\.\. math::(?P<latex>(?:.+\n| *\n(?=\1 +))+)"
        text = re.sub(rst, self._formula, text, flags=re.MULTILINE)
        text = re.sub(r"^\$\$(?P<latex>[^$]+)\$\$", self._formula, text, flags=re.MULTILINE)
        text = re.sub(r"(?<!`)\$([^$`\n]+)\$", lambda m: self._mark(m[1], "inline"), text)
        text = re.sub(r"::$", ":", text, flags=re.MULTILINE)
        text = re.sub(r"\[(\w+)\]_", rf"[\1]({_HOME}flexplant/bibliography.html#\1)", text)
        return re.sub(r"(?<!`)`([\w./]+)(\(\))?`(?!`)", self._linked, text)

    def _formula(self, match: re.Match[str]) -> str:
        return f"\n\n{self._mark(match['latex'], 'block')}\n\n"

    def _mark(self, latex: str, display: str) -> str:
        """Return a word that stands for a formula until the page is written."""
        from latex2mathml.converter import convert

        mark = f"formula{len(self.formulas)}x"
        parts = " ".join(latex.split()).split(r"\qquad")  # separate, so that a line may end there
        self.formulas[mark] = " &emsp; ".join(convert(part, display=display) for part in parts)
        if display == "block":
            self.formulas[mark] = f'<div class="formula">{self.formulas[mark]}</div>'
        return mark

    def _linked(self, match: re.Match[str]) -> str:
        """Return a name in single quotes as a link to its page."""
        name = match[1]
        if name.startswith("examples/"):
            known = name.endswith(".py") and _ROOT / name in self.stories
            return f"[{match[0]}]({_HOME}{name[:-3]}.html)" if known else match[0]
        short = name.removeprefix("fx.").removeprefix("flexplant.").split(".")
        room = short.pop(0) if short[0] in self.rooms else self.where.get(short[0])
        if room is None or (short and short[0] not in self.names[room]):
            return match[0]
        # to the class of a member: pdoc would take ".member" in a link for a separate name
        place = f"#{short[0]}" if short else ""
        return f"[{match[0].replace('.', _DOT)}]({_HOME}flexplant/{room}.html{place})"

    def finished(self, page: str, html: str) -> str:
        """Return a page with its formulas, and links that lead from where it is."""
        html = re.sub(r"formula\d+x", lambda m: self.formulas[m[0]], html)
        html = html.replace(_HOME, "../" * page.count("."))
        return html.replace(_COLON, ":").replace(_DOT, ".")

    def bibliography(self) -> str:
        """Return the sources as a list with a place for each key."""
        text = self.rooms["bibliography"].__doc__ or ""
        head, *entries = re.split(r"^\.\. \[(\w+)\] ", text, flags=re.MULTILINE)
        pairs = zip(entries[::2], entries[1::2], strict=True)
        lines = [f'- <a id="{key}"></a>**{key}** {" ".join(e.split())}' for key, e in pairs]
        return "\n".join([head.replace("``[Guyan1965]_``", "``[Guyan1965]``"), *lines])

    def front(self) -> str:
        """Return README, then the rooms, then what the package says of itself."""
        readme = _ROOT / "README.md"
        text = readme.read_text(encoding="utf-8").partition("\n")[2] if readme.exists() else ""
        text = text.replace("](examples/", "](pictures/").replace("](examples)", "](examples.html)")
        own = inspect.getdoc(import_module("flexplant")) or ""
        room = "\n".join(
            f"- `flexplant.{name}`: {(module.__doc__ or '').strip().splitlines()[0]}"
            for name, module in self.rooms.items()
        )
        return f"{text}\n## The rooms\n\n{room}\n\n## In one page\n\n{own}\n"

    def versions(self) -> str:
        """Return the versions that this site was made with, and those that are required."""
        least = "\n".join(f"| {line} |" for line in requires("flexplant") or ())
        made = "\n".join(f"| {name} | {text} |" for name, text in versions().items())
        return (
            f"## Versions\n\nWhat the examples of this site ran with:\n\n| package | version |\n"
            f"|---|---|\n{made}\n\nWhat flexplant requires:\n\n| requirement |\n|---|\n{least}\n"
        )


def _story(path: Path, shown: Shown | None) -> str:
    """Return a story as text: its docstring, its pictures, what it prints, its cells."""
    head, *cells = re.split(r"^# %% ?", path.read_text(encoding="utf-8"), flags=re.MULTILINE)
    title, _, rest = inspect.cleandoc(head.strip().strip('"')).partition("\n")
    text = [f"## {title}", rest]
    if shown is None:
        text.append(f"``python examples/{path.name}`` prints its tables and draws its pictures.")
    else:
        text += [f"![{one.stem}]({_HOME}pictures/{one.name})" for one in shown.pictures]
        if shown.printed.strip():
            command = " ".join([f"examples/{path.name}", *_ARGUMENTS.get(path.stem, ())])
            text += ["### What it prints", f"``python {command}``:"]
            text.append(f"```text\n{shown.printed.strip()}\n```")
    for cell in cells:
        title, _, code = cell.partition("\n")
        text += [f"### {title}", f"```python\n{code.strip()}\n```"]
    return "\n\n".join(text)


def _gallery(stories: dict[Path, Shown | None]) -> str:
    """Return the page that leads to the stories, each with a thumbnail."""
    text = [
        "## Examples",
        "",
        "Each is a script, run by ``python examples/<name>.py`` from the clone.",
        "",
    ]
    text.append('<div class="gallery">')
    for path, shown in stories.items():
        title = path.read_text(encoding="utf-8").strip('"').partition("\n")[0].replace("`", "")
        image = ""
        if shown and shown.pictures:
            image = f'<img src="pictures/{shown.pictures[0].name}" alt="{path.stem}"/>'
        elif shown:
            lines = shown.printed.replace("&", "&amp;").replace("<", "&lt;").splitlines()
            image = f"<pre>{'&#10;'.join(filter(None, lines[:24]))}</pre>"
        text.append(f'<a href="examples/{path.stem}.html">{image}{title}</a>')
    return "\n".join([*text, "</div>"])


# ---- the site by pdoc


class _AsWritten:
    """A type that is shown as it stands in the source, not what its aliases stand for."""

    def __init__(self, text: str) -> None:
        self.text = text

    def __repr__(self) -> str:
        return self.text


def _as_written(kind: Any, *_: Any) -> Any:
    return _AsWritten(kind) if isinstance(kind, str) else kind


def _page(name: str, text: str) -> Any:
    """Return a page of text alone as pdoc's module."""
    from pdoc.doc import Module

    module = ModuleType(name, text)
    vars(module).update(__all__=[], __docformat__="markdown", __path__=[])
    return Module(module)


def _pages(site: _Site, stories: dict[Path, Shown | None]) -> dict[str, Any]:
    """Return all pages: the front, the rooms, those of this folder, and the examples."""
    from pdoc.doc import Module

    for name, names in {"": sorted(site.rooms), **site.names}.items():
        # pdoc shows what __all__ lists; this process writes the site and ends
        vars(import_module(f"flexplant.{name}".rstrip(".")))["__all__"] = names
    pages = {"flexplant": Module.from_name("flexplant")}
    pages |= {f"flexplant.{n}": Module.from_name(f"flexplant.{n}") for n in site.rooms}
    list(map(attrgetter("own_members"), pages.values()))  # pdoc reads stubs' docstrings here
    pages["flexplant"].docstring = site.front()
    verbs = pages["flexplant.algorithms"]
    verbs.docstring = re.sub(r"^\*\*(\w+)\.\*\* ", r"## \1\n\n", verbs.docstring, flags=re.M)
    pages["flexplant.bibliography"].docstring = site.bibliography()
    texts = {name: (_PAGES / f"{name}.md").read_text(encoding="utf-8") for name in _TEXTS}
    texts["versions"] = site.versions()
    if stories:
        texts["examples"] = _gallery(stories)
        texts |= {f"examples.{path.stem}": _story(path, one) for path, one in stories.items()}
    return pages | {name: _page(name, text) for name, text in texts.items()}


def write_site(folder: str | Path, *, runs: bool = True) -> int:
    """Write the documentation as static pages, `folder` / index.html the first; count them."""
    try:
        import latex2mathml.converter  # noqa: F401
        from pdoc import doc, docstrings, render
    except ImportError as error:
        raise SolverError(
            "the documentation is written by pdoc and latex2mathml, which are not installed. "
            "Install them by: python -m pip install 'flexplant[docs]'"
        ) from error
    folder, site = Path(folder), _Site()
    if runs:
        with ThreadPoolExecutor(os.cpu_count()) as pool:
            list(pool.map(_run, [path for path in site.stories if _shown(path) is None]))
    stories = {path: _shown(path) for path in site.stories}
    (folder / "pictures").mkdir(parents=True, exist_ok=True)
    drawn = [one for shown in stories.values() if shown for one in shown.pictures]
    for path in (*_EXAMPLES.glob("*.png"), *drawn):
        shutil.copyfile(path, folder / "pictures" / path.name)

    # pdoc has no setting for these two
    convert = docstrings.convert
    vars(docstrings)["convert"] = lambda text, *how: convert(site.markdown(text), *how)
    vars(doc)["safe_eval_type"] = _as_written
    render.configure(docformat="numpy", show_source=False, template_directory=_PAGES)
    with warnings.catch_warnings():
        # annotations that pdoc cannot evaluate are shown as they are written
        warnings.filterwarnings("ignore", "Error parsing type annotation", UserWarning)
        pages = _pages(site, stories)
        titles = {name: pages[name].docstring.partition("\n")[0].strip("# ") for name in _TEXTS}
        ways = {"flexplant": "Start", "examples": "Examples", **titles, "versions": "Versions"}
        render.env.globals["ways"] = ways
        for name, page in pages.items():
            file = folder / f"{name.replace('.', '/')}.html"
            file.parent.mkdir(parents=True, exist_ok=True)
            html = site.finished(name, render.html_module(page, pages))
            file.write_text(html, encoding="utf-8")
        site.searched = {page.docstring for page in pages.values()}
        index = re.sub(r"formula\d+x", "", render.search_index(pages))
        index = site.finished("", index)
        (folder / "search.js").write_text(index, encoding="utf-8")
    moved = '<!doctype html><meta http-equiv="refresh" content="0; url=flexplant.html"/>'
    (folder / "index.html").write_text(moved, encoding="utf-8")
    return len(pages)


if __name__ == "__main__":
    words = [word for word in sys.argv[1:] if word != "--no-runs"]
    written = write_site(words[0] if words else "site", runs="--no-runs" not in sys.argv)
    sys.stdout.write(f"{counted(written, 'page')}: open index.html\n")

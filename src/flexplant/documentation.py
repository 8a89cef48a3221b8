"""The documentation as a site: ``python -m flexplant.documentation site`` (extra ``docs``: pdoc).

Every room is a page, its docstring first and then what it exports; every example of the repository
is one, its cells as text and code with the pictures that were drawn; README is the front. Links are
checked when all is written: one that leads nowhere is an error.
"""

from __future__ import annotations

import inspect
import re
import shutil
import sys
import warnings
from collections.abc import Iterator
from contextlib import contextmanager
from html.parser import HTMLParser
from importlib import import_module
from pathlib import Path
from types import ModuleType
from typing import Any, NamedTuple

from .errors import CertificateError, FlexplantError, SolverError, counted

_ROOT = Path(__file__).parents[2]
_EXAMPLES = _ROOT / "examples"
#: pages that are no rooms; only sources and what can be raised are read there
_MORE = ("bibliography", "errors", "algorithms")
_COLON = "\ue000"  # stands for a colon that pdoc would take for the one before the type

_PAGE = """{% extends "default/module.html.jinja2" %}
{% block title %}{{ module.modulename }}{% endblock %}
{% block module_list_link %}
{% set root = "../" * module.modulename.count(".") %}
<a class="pdoc-button module-list-button" href="{{ root }}flexplant.html">Start</a>
{% if "examples" in all_modules %}
<a class="pdoc-button module-list-button" href="{{ root }}examples.html">Examples</a>
{% endif %}
{% endblock %}
{% block nav_submodules %}
{% if module.modulename == "flexplant" %}{{ super() | replace("Submodules", "Rooms") }}{% endif %}
{% endblock %}
{% block nav_members %}{{ super() | replace("API Documentation", "Names") }}{% endblock %}
{% defaultmacro bases(cls) %}{% enddefaultmacro %}
{% defaultmacro inherited(cls) %}
{% for base, members in cls.inherited_members.items() if base[0].startswith("flexplant.") %}
{% for m in members if is_public(m) | trim %}
<div id="{{ m.qualname }}" class="classattr">
{% if base[1] == "Value" %}<code>.{{ m.name }}</code>{% else %}{{ member(m) }}{% endif %}
</div>
{% endfor %}
{% endfor %}
{% enddefaultmacro %}
"""
_STYLE = """
main.pdoc img { max-width: 100%; height: auto; }
main.pdoc .docstring table { display: block; overflow-x: auto; font-size: 0.9em; }
main.pdoc pre { overflow-x: auto; font-size: 0.78rem; }
.gallery { display: grid; grid-template-columns: repeat(auto-fill, minmax(15rem, 1fr)); gap: 1rem; }
.gallery > a { border: 1px solid var(--accent2); border-radius: 4px; padding: 0.6rem; }
.gallery img { display: block; width: 100%; height: 10rem; object-fit: cover;
  object-position: top left; margin-bottom: 0.4rem; }
"""


class Links(NamedTuple):
    """What a written site holds."""

    pages: int
    links: int
    pictures: int
    broken: tuple[str, ...]


class _Page(HTMLParser):
    """The places and the references of one page."""

    def __init__(self, text: str) -> None:
        super().__init__()
        self.places: set[str] = set()
        self.references: list[str] = []
        self.pictures = 0
        self.feed(text)

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        """Collect ids, links, pictures and scripts."""
        for name, value in attrs:
            if name == "id" and value:
                self.places.add(value)
            if name in ("href", "src") and value:
                self.references.append(value)
        self.pictures += tag == "img"


def check_links(folder: Path) -> Links:
    """Return what the pages of a folder hold, and which of their links lead nowhere."""
    found = (path.resolve() for path in folder.resolve().rglob("*.html"))
    pages = {path: _Page(path.read_text(encoding="utf-8")) for path in found}
    broken, links = [], 0
    for path, page in pages.items():
        for reference in page.references:
            if re.match(r"[a-z]+:", reference):
                continue  # other places in the net, and data in the page
            links += 1
            file, _, place = reference.partition("#")
            target = (path.parent / file).resolve() if file else path
            known = pages.get(target)
            there = known is not None or target.exists()
            if not there or (place and (known is None or place not in known.places)):
                broken.append(f"{path.relative_to(folder.resolve())}: {reference}")
    pictures = sum(page.pictures for page in pages.values())
    return Links(len(pages), links, pictures, tuple(dict.fromkeys(broken)))


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
    """One run: what is where, and the page that is being written."""

    def __init__(self) -> None:
        self.rooms = rooms()
        self.names = {n: _page_names(n, room) for n, room in self.rooms.items()}
        self.where: dict[str, str] = {}
        for room, names in self.names.items():
            for name in names:
                self.where.setdefault(name, room)
        self.stories = sorted(_EXAMPLES.glob("*.py")) if _EXAMPLES.is_dir() else []
        self.page, self.root = "flexplant", ""
        self.searched: set[str] | None = None  # pages, while the search index is written

    def at(self, page: str) -> None:
        """Say which page is written: links are relative to it."""
        self.page, self.root = page, "../" * page.count(".")

    def markdown(self, text: str) -> str:
        """Return a docstring with what pdoc does not know: tables, literal blocks, links."""
        text = re.sub(r"^(\S[^\n]*? : )([^\n]*:[^\n]*)$", _protected, text, flags=re.MULTILINE)
        text = re.sub(
            r"^( *)\.\. math::((?:.+\n| *\n(?=\1 +))+)", _formula, text, flags=re.MULTILINE
        )
        text = re.sub(r"::$", ":", text, flags=re.MULTILINE)
        rule = r"^ *=+(?: +=+)+ *\n"
        text = re.sub(
            rf"({rule}(?:[^\n]*\n)*?{rule}(?:(?:[^\n=]+[^\n]*\n)+?{rule})?)",
            lambda m: f"```text\n{inspect.cleandoc(m[0])}\n```\n",
            text,
            flags=re.MULTILINE,
        )
        text = re.sub(r"\[(\w+)\]_", rf"[\1]({self.root}flexplant/bibliography.html#\1)", text)
        parts = re.split(r"(^ *```.*?^ *```)", text, flags=re.MULTILINE | re.DOTALL)
        parts[::2] = [re.sub(r"(?<!`)`([\w./]+)(\(\))?`(?!`)", self.linked, p) for p in parts[::2]]
        return "".join(parts)

    def linked(self, match: re.Match[str]) -> str:
        """Return a name in single quotes as a link, where it is on another page."""
        name = match[1]
        if name.startswith("examples/"):
            known = name.endswith(".py") and _ROOT / name in self.stories
            return f"[{match[0]}]({self.root}{name[:-3]}.html)" if known else match[0]
        short = name.removeprefix("fx.").removeprefix("flexplant.").split(".")
        room = short.pop(0) if short[0] in self.rooms else self.where.get(short[0])
        if room is None or self.page == f"flexplant.{room}":
            return match[0]
        if short and short[0] not in self.names[room]:
            return match[0]
        # to the class of a member: pdoc would take ".member" in a link for a name of its own
        place = f"#{short[0]}" if short else ""
        return f"[{match[0]}]({self.root}flexplant/{room}.html{place})"

    def bibliography(self) -> str:
        """Return the sources as a list with a place for each key."""
        text = self.rooms["bibliography"].__doc__ or ""
        head, *entries = re.split(r"^\.\. \[(\w+)\] ", text, flags=re.MULTILINE)
        pairs = zip(entries[::2], entries[1::2], strict=True)
        lines = [f'- <a id="{key}"></a>**{key}** {" ".join(e.split())}' for key, e in pairs]
        return "\n".join([head.replace("``[Guyan1965]_``", "``[Guyan1965]``"), *lines])

    def front(self) -> str:
        """Return README, then what the package says of itself, then the rooms."""
        readme = _ROOT / "README.md"
        text = readme.read_text(encoding="utf-8").partition("\n")[2] if readme.exists() else ""
        text = text.replace("](examples/", "](pictures/").replace("](examples)", "](examples.html)")
        own = inspect.getdoc(import_module("flexplant")) or ""
        room = "\n".join(
            f"- `flexplant.{name}`: {(module.__doc__ or '').strip().splitlines()[0]}"
            for name, module in self.rooms.items()
        )
        return f"{text}\n## The rooms\n\n{room}\n\n## In one page\n\n{own}\n"

    def pictures(self, story: Path, folder: Path) -> list[str]:
        """Copy what a story has drawn; return the names of the copies."""
        source = story.read_text(encoding="utf-8")
        quoted = {story.stem, *re.findall(r'"(\w+)(?:\.png)?"', source)}
        quoted |= {f"{a}{b}" for a in re.findall(r'f"(\w+)\{\w+\}\.png"', source) for b in quoted}
        drawn = sorted((_EXAMPLES / "out").glob("*.png"))
        kept = [p for p in _EXAMPLES.glob("*.png") if not (_EXAMPLES / "out" / p.name).exists()]
        found = [path for path in (*drawn, *kept) if path.stem in quoted]
        folder.mkdir(parents=True, exist_ok=True)
        for path in found:
            shutil.copyfile(path, folder / path.name)
        return [path.name for path in found]

    def story(self, path: Path, drawn: list[str]) -> str:
        """Return a story as text: its docstring, its pictures, its cells."""
        head, *cells = re.split(r"^# %% ?", path.read_text(encoding="utf-8"), flags=re.MULTILINE)
        said = inspect.cleandoc(head.strip().strip('"'))
        title, _, rest = said.partition("\n")
        shown = [f"![{name}](../pictures/{name})" for name in drawn]
        missing = f"``python examples/{path.name}`` draws its pictures."
        text = [f"## {title}", re.sub(r"::$", ":", rest, flags=re.MULTILINE)]
        text += shown or ([missing] if ".png" in "".join(cells) else [])
        for cell in cells:
            title, _, code = cell.partition("\n")
            text += [f"### {title}", f"```python\n{code.strip()}\n```"]
        return "\n\n".join(text)

    def gallery(self, drawn: dict[str, list[str]]) -> str:
        """Return the page that leads to the stories."""
        text = ["Each is a script, run by ``python examples/<name>.py`` from the clone.", ""]
        text.append('<div class="gallery">')
        for path in self.stories:
            title = path.read_text(encoding="utf-8").strip('"').partition("\n")[0]
            first = drawn[path.stem][:1]
            image = f'<img src="pictures/{first[0]}" alt="{path.stem}"/>' if first else ""
            text.append(f'<a href="examples/{path.stem}.html">{image}{title}</a>')
        return "\n".join([*text, "</div>"])


def _protected(match: re.Match[str]) -> str:
    return match[1] + match[2].replace(":", _COLON)


def _public(text: str, pages: dict[str, Any]) -> str:
    """Return a page without the modules behind the rooms, and types without quotes."""

    def short(match: re.Match[str]) -> str:
        return match[0] if match[1] in pages else match[2]

    text = re.sub(r"\b(flexplant(?:\.[a-z_0-9]+)+)\.([A-Z]\w*)", short, text)
    quoted = r"(<span class=\\?\"s\d\\?\">)(?:'|&#39;)([A-Z][\w\[\], .|]*)(?:'|&#39;)(</span>)"
    return re.sub(quoted, r"\2", text)


class _AsWritten:
    """A type that is shown as it stands in the source."""

    def __init__(self, text: str) -> None:
        self.text = text

    def __repr__(self) -> str:
        return self.text


def _as_written(space: Any) -> None:
    """Show types below a page of pdoc as they are written, not what their aliases stand for."""
    for one in space.own_members:
        if one.kind == "class":
            _as_written(one)
        elif one.kind == "function":
            raw = getattr(getattr(one.obj, "__func__", one.obj), "__annotations__", {})
            said = {n: _AsWritten(text) for n, text in raw.items() if isinstance(text, str)}
            given = one.signature
            one.signature = given.replace(
                parameters=[
                    p.replace(annotation=said.get(p.name, p.annotation))
                    for p in given.parameters.values()
                ],
                return_annotation=said.get("return", given.return_annotation),
            )


def _formula(match: re.Match[str]) -> str:
    """Return a formula in one line, which Markdown leaves as it is: no lists, no lost backslash."""
    kept = re.sub(r"(?=[\\`*_{}\[\]()#+.!-])", r"\\", " ".join(match[2].split()))
    return f"{match[1]}$${kept}$$\n"


@contextmanager
def _exporting(site: _Site) -> Iterator[None]:
    """Let pdoc see the public names of the rooms, for this run."""
    given = {"flexplant": sorted(site.rooms)} | {
        f"flexplant.{name}": names for name, names in site.names.items()
    }
    modules = {name: import_module(name) for name in given}
    before = {name: vars(module).get("__all__") for name, module in modules.items()}
    for name, module in modules.items():
        vars(module)["__all__"] = given[name]
    try:
        yield
    finally:
        for name, old in before.items():
            vars(modules[name]).pop("__all__")
            if old is not None:
                vars(modules[name])["__all__"] = old


def _page(name: str, text: str) -> Any:
    """Return a page of text alone as pdoc's module."""
    from pdoc.doc import Module

    module = ModuleType(name, text)
    vars(module).update(__all__=[], __docformat__="markdown", __path__=[])
    return Module(module)


def write_site(folder: str | Path) -> Links:
    """Write the documentation as static pages, `folder` / index.html the first; count them."""
    try:
        import jinja2
        from pdoc import doc, docstrings, render
    except ImportError as error:
        raise SolverError(
            "the documentation is written by pdoc, which is not installed. "
            "Install it by: python -m pip install 'flexplant[docs]'"
        ) from error
    folder, site = Path(folder), _Site()
    texts: Any = docstrings  # whose function is replaced for this run
    convert = texts.convert

    def converted(text: str, docformat: str, source: Path | None) -> str:
        if site.searched is not None and text not in site.searched:
            text = text.partition("\n\n")[0]  # of what a room exports the first lines are enough
        return str(convert(site.markdown(text), docformat, source)).replace(_COLON, ":")

    render.configure(docformat="numpy", show_source=False, math=True)
    ours = jinja2.DictLoader({"module.html.jinja2": _PAGE, "custom.css": _STYLE})
    render.env.loader = jinja2.ChoiceLoader([ours, *filter(None, [render.env.loader])])
    drawn = {path.stem: site.pictures(path, folder / "pictures") for path in site.stories}
    with _exporting(site), warnings.catch_warnings():
        # annotations that pdoc cannot evaluate it shows as they are written
        warnings.filterwarnings("ignore", "Error parsing type annotation", UserWarning)
        pages: dict[str, Any] = {"flexplant": doc.Module.from_name("flexplant")}
        pages |= {f"flexplant.{n}": doc.Module.from_name(f"flexplant.{n}") for n in site.rooms}
        for page in pages.values():
            _as_written(page)
        pages["flexplant"].docstring = site.front()
        verbs = pages["flexplant.algorithms"]
        verbs.docstring = re.sub(r"^\*\*(\w+)\.\*\* ", r"## \1\n\n", verbs.docstring, flags=re.M)
        pages["flexplant.bibliography"].docstring = site.bibliography()
        if site.stories:
            pages["examples"] = _page("examples", site.gallery(drawn))
        for path in site.stories:
            name = f"examples.{path.stem}"
            pages[name] = _page(name, site.story(path, drawn[path.stem]))
        texts.convert = converted
        try:
            for name, page in pages.items():
                site.at(name)
                file = folder / f"{name.replace('.', '/')}.html"
                file.parent.mkdir(parents=True, exist_ok=True)
                file.write_text(_public(render.html_module(page, pages), pages), encoding="utf-8")
            site.searched = {page.docstring for page in pages.values()}
            index = _public(render.search_index(pages), pages)
            (folder / "search.js").write_text(index, encoding="utf-8")
        finally:
            texts.convert = convert
    moved = '<!doctype html><meta http-equiv="refresh" content="0; url=flexplant.html"/>'
    (folder / "index.html").write_text(moved, encoding="utf-8")
    found = check_links(folder)
    if found.broken:
        raise CertificateError("links that lead nowhere: " + "; ".join(found.broken[:20]))
    return found


if __name__ == "__main__":
    written = write_site(sys.argv[1] if len(sys.argv) > 1 else "site")
    sys.stdout.write(
        f"{counted(written.pages, 'page')}, {written.links} links that lead somewhere, "
        f"{counted(written.pictures, 'picture')}\n"
    )

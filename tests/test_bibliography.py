"""One bibliography: docstrings cite its keys, and every key is cited."""

import inspect
import re
from pathlib import Path

from flexplant import bibliography
from test_public_api import DESCRIBED

SRC = Path(bibliography.__file__).parent
MODULES = [path for path in SRC.rglob("*.py") if path.name != "bibliography.py"]
KEYS = re.findall(r"^\.\. \[(\w+)\] \S", bibliography.__doc__, re.MULTILINE)
CITED = r"\[([A-Za-z]\w+\d{4}[ab]?|paper)\]_"


def references(text):
    """Return the References sections of a module's docstrings."""
    return re.findall(r"^( +)References\n\1-{10}\n(.*?)(?=\n\s*\n|\n\1\"\"\")", text, FLAGS)


FLAGS = re.MULTILINE | re.DOTALL


def test_entries_are_sorted_and_named_alike():
    assert KEYS[0] == "paper"
    assert KEYS[1:] == sorted(KEYS[1:], key=str.lower)
    assert len(KEYS) == len(set(KEYS)) > 80
    for entry in bibliography.__doc__.split("\n.. [")[2:]:
        key, text = entry.split("] ", 1)
        assert key[-5:].strip("ab")[-4:] in text, f"the year of {key}"


def test_cited_keys_and_entries_are_the_same():
    cited = {key for path in MODULES for key in re.findall(CITED, path.read_text("utf-8"))}
    assert cited == set(KEYS)


def test_references_are_given_by_keys():
    found = [
        (path.name, text) for path in MODULES for _, text in references(path.read_text("utf-8"))
    ]
    assert len(found) > 80
    for name, text in found:
        assert re.search(CITED, text), f"{name}: {text}"
        assert not re.search(r"\b(19|20)\d\d\b", re.sub(CITED, "", text)), f"{name}: {text}"


def test_nobody_is_cited_by_a_year():
    """In the text too, sources are keys: "[Welch1967]_", not "(Welch 1967)"."""
    year = r"(?!2000)(19[4-9]\d|20[0-3]\d)"
    pattern = rf"[A-Z][\w.']+[),]* \(?{year}\b|\({year}\)|, {year}[).,;\]](?!\d)"
    found = {path.name: re.search(pattern, path.read_text("utf-8")) for path in MODULES}
    assert not {name: match[0] for name, match in found.items() if match}


def test_methods_of_the_literature_say_where_they_are_from():
    """What implements a method that others published cites them."""
    cited = {
        name for name, item in DESCRIBED.items() if "References\n" in (inspect.getdoc(item) or "")
    }
    assert {"reduce", "update", "design_kalman", "design_hinf", "Guyan", "solve_modes"} <= cited
    assert len(cited) > 90

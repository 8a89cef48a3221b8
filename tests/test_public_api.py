"""Every public name says what it does, what it takes and what it raises."""

import inspect
import re
from types import ModuleType

import pytest

import flexplant
from flexplant.errors import FlexplantError


def is_public(name, item):
    ours = getattr(item, "__module__", "flexplant").split(".")[0] == "flexplant"
    return ours and not name.startswith("_") and not isinstance(item, ModuleType)


PUBLIC = {name: item for name, item in vars(flexplant).items() if is_public(name, item)}
CLASSES = {name: item for name, item in PUBLIC.items() if inspect.isclass(item)}
FUNCTIONS = {name: item for name, item in PUBLIC.items() if inspect.isfunction(item)}
ERRORS = {n for n, c in CLASSES.items() if issubclass(c, BaseException)}
CONSTRUCTORS = {name: item for name, item in CLASSES.items() if name not in ERRORS}
DOCUMENTED = FUNCTIONS | CONSTRUCTORS
METHODS = {
    f"{owner}.{name}": getattr(item, name)
    for owner, item in CONSTRUCTORS.items()
    for name, member in vars(item).items()
    if not name.startswith("_") and (inspect.isfunction(member) or isinstance(member, classmethod))
}


def sections(item):
    """Return {title: text} of a numpydoc docstring."""
    doc = inspect.cleandoc(item.__doc__ or "")
    parts = re.split(r"^(\w[\w ]*)\n-{3,}$", doc, flags=re.MULTILINE)
    return dict(zip(parts[1::2], parts[2::2], strict=True))


def parameters(item):
    return [p for p in inspect.signature(item).parameters.values() if p.name not in ("self", "cls")]


def listed(text):
    """Return the names that a Parameters section describes: `u, y : ...` describes two."""
    heads = re.findall(r"^(\*{0,2}\w[\w, *]*?)(?: : .*)?$", text, flags=re.MULTILINE)
    return {name.strip(" *") for head in heads for name in head.split(",")}


def test_there_is_something_public():
    assert {"StateSpace", "lft", "load"} <= set(PUBLIC)
    assert len(PUBLIC) < 260


@pytest.mark.parametrize("name", PUBLIC)
def test_has_a_docstring(name):
    item = PUBLIC[name]
    if not (inspect.isclass(item) or inspect.isroutine(item)):
        pytest.skip("a constant")
    doc = vars(item).get("__doc__") if inspect.isclass(item) else item.__doc__
    assert doc and doc.strip(), f"{name} has no docstring"
    # what dataclass writes when there is none
    assert not doc.startswith(f"{name}("), f"{name} has no docstring of its own"


@pytest.mark.parametrize("name", METHODS)
def test_methods_have_docstrings(name):
    assert (METHODS[name].__doc__ or "").strip(), f"{name} has no docstring"


@pytest.mark.parametrize("name", DOCUMENTED)
def test_every_parameter_is_documented(name):
    wanted = [p.name for p in parameters(DOCUMENTED[name])]
    if not wanted:
        pytest.skip("no parameters")
    described = listed(sections(DOCUMENTED[name]).get("Parameters", ""))
    missing = [p for p in wanted if p not in described]
    assert not missing, f"{name} does not describe {missing} under Parameters"


@pytest.mark.parametrize("name", FUNCTIONS)
def test_functions_say_what_they_raise(name):
    if not parameters(FUNCTIONS[name]):
        pytest.skip("no parameters")
    raised = sections(FUNCTIONS[name]).get("Raises", "")
    names = {
        n for head in re.findall(r"^(\w[\w, ]*)$", raised, re.MULTILINE) for n in head.split(", ")
    }
    known = {c.__name__ for c in all_errors(FlexplantError)} | {"OSError", "FileNotFoundError"}
    assert names & known, f"{name} does not say under Raises which errors a wrong use meets"
    assert names <= known, f"{name} names {sorted(names - known)}, which are no errors of ours"


@pytest.mark.parametrize("name", DOCUMENTED | METHODS)
def test_no_open_keywords(name):
    kinds = parameters((DOCUMENTED | METHODS)[name])
    assert not [p for p in kinds if p.kind is p.VAR_KEYWORD], f"{name} takes **keywords"


def all_errors(base):
    return {base}.union(*(all_errors(sub) for sub in base.__subclasses__()))


def test_the_checks_can_fail():
    def bad(first, second, **rest):
        """Do things.

        Parameters
        ----------
        first : int
            One.
        """

    assert listed(sections(bad)["Parameters"]) == {"first"}
    assert [p.name for p in parameters(bad)] == ["first", "second", "rest"]

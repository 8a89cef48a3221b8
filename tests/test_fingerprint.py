"""fingerprint: other code or other values, another digest; the same ones, the same digest."""

import importlib
import itertools
import sys
import threading
from functools import cached_property, partial

import numpy as np
import pytest
import scipy.sparse as sp

import flexplant as fx
from flexplant.errors import ModelError
from flexplant.fingerprints import fingerprint

MODULE = '''
"""A user's module."""
import functools
import json
import numpy as np
from dataclasses import dataclass

import {helpers} as tools
from {helpers} import smooth

GAIN = 2.0
TABLE = {{"stiff": [1.0, 2.0]}}


def decorated(function):
    @functools.wraps(function)
    def inner(*values):
        return function(*values) + 0.0
    return inner


@decorated
def wrapped(x):
    return x + 0.5


@functools.cache
def cached(x):
    return x * 11


def deep(x):
    return [value * 13 for value in (x, x)]


def even(x):
    return x == 0 or odd(x - 1)


def odd(x):
    return x != 0 and even(x - 1)


@dataclass(frozen=True)
class Machine:
    mass: float = 3.5

    def weight(self):
        return self.mass * 9.81

    @property
    def half(self):
        return self.mass / 2

    @staticmethod
    def unit():
        return "kg"


class Special(Machine):
    pass


def late(x):
    import json

    from {helpers} import constant
    return constant(x)


def scaled(factor):
    return lambda x: x * factor


trebled = scaled(3.0)


def pipeline(machine, limit=10.0, *, kind="plain"):
    """Return a row."""
    first = wrapped(machine) + cached(machine) + sum(deep(machine)) + even(4)
    second = Special().weight() + TABLE["stiff"][0] * GAIN + late(machine) + trebled(machine)
    third = tools.rough(machine) + smooth(machine)
    return {{"value": first + second + third + np.sqrt(2.0)}}  # a comment
'''
HELPERS = """
import {module} as back


def smooth(x):
    return inner(x) + 1.0


def inner(x):
    return x - 0.25


def rough(x):
    return x + 100.0


def constant(x):
    return 42.0


def unused(x):
    return x + 7.0
"""
number = itertools.count()


@pytest.fixture
def written(tmp_path, monkeypatch):
    """Return a function that imports the two modules anew, from edited text."""
    monkeypatch.syspath_prepend(tmp_path)
    module, helpers = (f"of_a_user_{next(number)}" for _ in range(2))

    def read(old="", new=""):
        assert old in MODULE + HELPERS
        for name, text in ((helpers, HELPERS), (module, MODULE)):
            sys.modules.pop(name, None)
            text = text.format(module=module, helpers=helpers)
            (tmp_path / f"{name}.py").write_text(text.replace(old, new) if old else text)
        sys.dont_write_bytecode, before = True, sys.dont_write_bytecode
        importlib.invalidate_caches()
        try:
            return importlib.import_module(module)
        finally:
            sys.dont_write_bytecode = before

    return read


EDITS = {
    "its own code": ("first + second", "first - second"),
    "a global number": ("GAIN = 2.0", "GAIN = 2.5"),
    "a global table": ("[1.0, 2.0]", "[1.0, 3.0]"),
    "a default": ("limit=10.0", "limit=11.0"),
    "a keyword's default": ('kind="plain"', 'kind="other"'),
    "what a decorator wraps": ("x + 0.5", "x + 0.6"),
    "the decorator": ("+ 0.0", "+ 1e-9"),
    "a cached function": ("x * 11", "x * 12"),
    "a function inside": ("value * 13", "value * 14"),
    "one of two that call each other": ("x != 0", "x > 0"),
    "a closure": ("scaled(3.0)", "scaled(4.0)"),
    "a method": ("9.81", "9.82"),
    "a property": ("self.mass / 2", "self.mass / 3"),
    "a static method": ('"kg"', '"t"'),
    "a field's default": ("mass: float = 3.5", "mass: float = 3.25"),
    "a base": ("Special(Machine)", "Special(dict)"),
    "a function of another module": ("x + 100.0", "x + 101.0"),
    "what that calls": ("x - 0.25", "x - 0.5"),
    "what is imported late": ("return 42.0", "return 43.0"),
}


@pytest.mark.parametrize("edit", EDITS, ids=str)
def test_an_edit_of_what_is_reached_changes_it(written, edit):
    before = fingerprint([written().pipeline])
    assert fingerprint([written().pipeline]) == before
    assert fingerprint([written(*EDITS[edit]).pipeline]) != before


@pytest.mark.parametrize(
    "edit",
    [
        ("  # a comment", ""),
        ("Return a row.", "Return a row of the table."),
        ("GAIN = 2.0", "\n\nGAIN = 2.0"),
        ("x + 7.0", "x + 8.0"),
    ],
)
def test_an_edit_of_anything_else_does_not(written, edit):
    assert fingerprint([written().pipeline]) == fingerprint([written(*edit).pipeline])


def made(kind, value):
    """Return what cannot be pickled, or has a value inside."""

    class Local:
        def __init__(self):
            self.value = value
            self.lock = threading.Lock()

        def __reduce__(self):
            raise TypeError("not to be sent")

        def run(self):
            return value

    def function(x=value):
        return x

    return {
        "function": lambda: lambda: value,
        "default": lambda: function,
        "object": Local,
        "class": lambda: Local,
        "method": lambda: Local().run,
        "partial": lambda: partial(max, value),
        "list": lambda: [1, [value]],
        "array": lambda: np.array([1.0, value]),
        "object array": lambda: np.array([None, value], dtype=object),
        "sparse": lambda: sp.csr_array([[0.0, value]]),
        "keys": lambda: {value: 1},
        "set": lambda: {1, value},
        "Value": lambda: fx.chain(masses=[1.0, value], stiffnesses=[1.0]),
        "generator": lambda: np.random.default_rng(int(value)),
        "type": lambda: np.zeros(2, dtype=[("a", f"f{int(value)}")]),
    }[kind]()


KINDS = ("function", "default", "object", "class", "method", "partial", "list", "array")
MORE = ("object array", "sparse", "keys", "set", "Value", "generator", "type")


@pytest.mark.parametrize("kind", KINDS + MORE)
def test_values_count_by_their_contents(kind):
    assert fingerprint([made(kind, 4.0)]) == fingerprint([made(kind, 4.0)])
    assert fingerprint([made(kind, 4.0)]) != fingerprint([made(kind, 8.0)])


class Lazy:
    def __init__(self):
        self.mass = 2.0

    @cached_property
    def weight(self):
        return 9.81 * self.mass


def test_what_is_not_content_does_not_count():
    assert list({0, 8}) != list({8, 0})  # the order of a set hangs on how it was filled
    assert fingerprint([{0, 8}]) == fingerprint([{8, 0}])
    # the first one stays among the constants of Python 3.14's code
    assert fingerprint([lambda x: x in {"a", "b", "c"}]) == fingerprint(
        [lambda x: x in {"a", "c", "b"}]
    )
    used = Lazy()
    assert used.weight > 0.0
    assert fingerprint([used]) == fingerprint([Lazy()])
    matrix = sp.csr_array([[0.0, 1.0]])
    before = fingerprint([matrix])
    assert matrix.has_canonical_format  # notes it in the matrix
    assert fingerprint([matrix]) == before
    assert len({fingerprint([item]) for item in (1, 1.0, True, "1", None, [1], (1,), {1})}) == 8


def test_a_value_inside_itself():
    ring = [1.0]
    ring.append(ring)
    other = [2.0]
    other.append(other)
    assert fingerprint([ring]) != fingerprint([other])


def test_what_has_no_contents_is_refused(tmp_path):
    with (tmp_path / "notes").open("w") as file:
        for item in (file, [{"log": file}], (x for x in range(3))):
            with pytest.raises(ModelError, match=r"item 0.* is a .*cannot be compared"):
                fingerprint([item])
    deep = []
    for _ in range(10**4):
        deep = [deep]
    with pytest.raises(ModelError, match="too deeply"):
        fingerprint([deep])

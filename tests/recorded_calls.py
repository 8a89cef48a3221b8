"""Calls of public functions as the examples in the docstrings make them: arguments that fit."""

import doctest
import importlib
import inspect
import sys
import warnings
from typing import NamedTuple

import numpy as np

from test_doctests import PLOTS
from test_public_api import CONSTRUCTORS, FUNCTIONS

#: what opens servers or windows
LEFT_OUT = {"Workbench", "workbench"}


class Call(NamedTuple):
    """One call: what is called, and the arguments by the names of its parameters."""

    name: str
    target: object
    given: dict


def is_contract(item):
    """A docstring that says what is taken or raised is a promise to users."""
    doc = item.__doc__ or ""
    return "Parameters\n" in doc or "Raises\n" in doc


def by_code():
    """Return {code object: (name, what is called)} of functions, constructors and methods."""
    found = {
        item.__code__: (name, item)
        for name, item in (FUNCTIONS | PLOTS).items()
        if hasattr(item, "__code__")
    }
    for owner, cls in CONSTRUCTORS.items():
        own = vars(cls).get("__init__")
        if hasattr(own, "__code__"):
            found[own.__code__] = (owner, cls)
        for name in dir(cls):
            raw = inspect.getattr_static(cls, name)
            item = getattr(raw, "__func__", raw)
            if not name.startswith("_") and inspect.isfunction(item) and is_contract(item):
                found.setdefault(item.__code__, (f"{owner}.{name}", item))
    return {code: what for code, what in found.items() if what[0].split(".")[0] not in LEFT_OUT}


def arguments(frame):
    """Return the positional and the keyword arguments of a call that begins."""
    code, values = frame.f_code, frame.f_locals
    names, n, k = code.co_varnames, code.co_argcount, code.co_kwonlyargcount
    positional = [values[name] for name in names[:n]]
    keywords = {name: values[name] for name in names[n : n + k]}
    if code.co_flags & inspect.CO_VARARGS:
        positional += values[names[n + k]]
    if code.co_flags & inspect.CO_VARKEYWORDS:
        keywords |= values[names[n + k + bool(code.co_flags & inspect.CO_VARARGS)]]
    return positional, keywords


def recorded(module):
    """Yield the calls of each docstring of a module, after its examples have run."""
    codes, calls = by_code(), []

    def watch(frame, event, _):
        back = frame.f_back
        if event != "call" or back is None or frame.f_code not in codes:
            return
        if not back.f_code.co_filename.startswith("<doctest"):
            return
        name, target = codes[frame.f_code]
        positional, keywords = arguments(frame)
        positional = positional[1:] if inspect.isclass(target) else positional
        try:
            bound = inspect.signature(target).bind(*positional, **keywords)
        except TypeError:  # made by a decorator: its own arguments are not known
            return
        calls.append(Call(name, target, dict(bound.arguments)))

    for test in doctest.DocTestFinder(exclude_empty=True).find(importlib.import_module(module)):
        calls.clear()
        with warnings.catch_warnings(), np.printoptions(legacy=False):
            sys.setprofile(watch)
            try:
                doctest.DocTestRunner().run(test, out=lambda _: None, clear_globs=False)
            finally:
                sys.setprofile(None)
        yield from list(calls)


def replayed(call, **changes):
    """Call again with some arguments changed."""
    given = call.given | changes
    kinds = {p.name: p.kind for p in inspect.signature(call.target).parameters.values()}
    first = [n for n, kind in kinds.items() if kind is inspect.Parameter.POSITIONAL_ONLY]
    if inspect.Parameter.VAR_POSITIONAL in kinds.values():
        bound = inspect.signature(call.target).bind_partial()
        bound.arguments.update({name: given[name] for name in kinds if name in given})
        return call.target(*bound.args, **bound.kwargs)
    positional = [given[name] for name in first if name in given]
    return call.target(*positional, **{n: v for n, v in given.items() if n not in first})


def parameters(call):
    """Return the parameters of a call that can be changed one by one."""
    named = inspect.signature(call.target).parameters.values()
    several = (inspect.Parameter.VAR_POSITIONAL, inspect.Parameter.VAR_KEYWORD)
    return [p.name for p in named if p.kind not in several and p.name not in ("self", "cls")]

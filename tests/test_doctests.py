"""The examples in the docstrings run."""

import doctest
import importlib
import inspect
import pkgutil
import re

import matplotlib.pyplot as plt
import numpy as np
import pytest

import flexplant
from flexplant import plot
from test_public_api import DESCRIBED

MODULES = [module.name for module in pkgutil.walk_packages(flexplant.__path__, "flexplant.")]
#: rooms whose examples design something: they take longer
DESIGNS = tuple(
    f"flexplant.{room}" for room in ("estimation", "placement", "synthesis", "updating", "plot")
)


def runs(name):
    """Run the examples of a module; return how many there are and how many failed."""
    # pyYeti, an oracle, sets the printing of NumPy 1.13 for the whole process when it is imported
    with np.printoptions(legacy=False):
        failed, tried = doctest.testmod(importlib.import_module(name))
    plt.close("all")
    return tried, failed


def check(modules):
    """The report of what failed is in the captured output."""
    found = {name: runs(name) for name in modules}
    wrong = {name: failed for name, (_, failed) in found.items() if failed}
    assert not wrong, f"examples that fail, by module: {wrong}"
    return sum(tried for tried, _ in found.values())


@pytest.mark.slow
def test_doctests():
    assert check([name for name in MODULES if not name.startswith(DESIGNS)]) > 500


@pytest.mark.long
def test_doctests_of_designs():
    assert check([name for name in MODULES if name.startswith(DESIGNS)]) > 500


#: public names without a doctest: what read_ansys reads cannot be written in a few lines, a Problem
#: is what a search is given, an M-Delta structure is made by a function, a run of the others takes
#: seconds; base classes for kinds of one's own have their examples in tests/test_new_kinds.py
WITHOUT = {
    "BlockStructure",
    "DampingElement",
    "read_ansys",
    "Problem",
    "design_mu",
    "Bound",
    "Judge",
}
PLOTS = {n: vars(plot)[n] for n in dir(plot) if inspect.isfunction(vars(plot)[n])}


def test_every_public_name_has_a_doctest():
    """Its own, or, of a value that is not made by hand, that of a function that returns it."""
    named = DESCRIBED | PLOTS
    texts = [inspect.getdoc(item) or "" for item in (*DESCRIBED.values(), *PLOTS.values())]
    shown = [text for text in texts if ">>>" in text]
    made = {kind for text in shown for kind in re.findall(r"^Returns\n-+\n(\w+)", text, re.M)}
    without = {name for name, item in named.items() if ">>>" not in (item.__doc__ or "")} - made
    assert without <= WITHOUT, "write an example of its use under Examples"
    assert without >= WITHOUT, "take these from the list: they have a doctest"

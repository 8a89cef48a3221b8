"""The examples in the docstrings run."""

import doctest
import importlib
import pkgutil

import numpy as np

import flexplant

MODULES = [
    module.name
    for module in pkgutil.walk_packages(flexplant.__path__, "flexplant.")
    if ".plot" not in module.name
]


def runs(name):
    """Run the examples of a module; return how many there are and how many failed."""
    # pyYeti, an oracle, sets the printing of NumPy 1.13 for the whole process when it is imported
    with np.printoptions(legacy=False):
        failed, tried = doctest.testmod(importlib.import_module(name))
    return tried, failed


def test_doctests():
    """The report of what failed is in the captured output."""
    found = {name: runs(name) for name in MODULES}
    wrong = {name: failed for name, (_, failed) in found.items() if failed}
    assert not wrong, f"examples that fail, by module: {wrong}"
    assert sum(tried > 0 for tried, _ in found.values()) > 20

"""The examples in the docstrings run."""

import doctest
import importlib
import pkgutil

import numpy as np
import pytest

import flexplant

MODULES = [
    module.name
    for module in pkgutil.walk_packages(flexplant.__path__, "flexplant.")
    if ".plot" not in module.name
]


@pytest.mark.parametrize("name", MODULES)
def test_doctests(name):
    module = importlib.import_module(name)
    # pyYeti, an oracle, sets the printing of NumPy 1.13 for the whole process when it is imported
    with np.printoptions(legacy=False):
        failed, _ = doctest.testmod(module)
    assert not failed


def test_there_are_some():
    finder = doctest.DocTestFinder()
    modules = [importlib.import_module(name) for name in MODULES]
    assert sum(bool(test.examples) for m in modules for test in finder.find(m)) > 20

"""Oracles know the equations, not the code: they never import the package."""

import ast
from pathlib import Path

import pytest

ORACLES = sorted(Path(__file__).parent.glob("oracles*.py"))


def packages(code):
    """Return the top packages that code imports, dynamically too."""
    found = set()
    for node in ast.walk(ast.parse(code)):
        if isinstance(node, ast.Import):
            found |= {alias.name.split(".")[0] for alias in node.names}
        elif isinstance(node, ast.ImportFrom):
            found.add("." * node.level + (node.module or "").split(".")[0])
        elif isinstance(node, ast.Constant) and node.value == "flexplant":
            found.add("flexplant")
    return found


def test_there_are_oracles():
    assert ORACLES


@pytest.mark.parametrize("path", ORACLES, ids=lambda path: path.name)
def test_an_oracle_does_not_import_the_package(path):
    forbidden = {"flexplant", "machines", "strategies", "conftest"}
    assert not packages(path.read_text()) & forbidden
    assert not [name for name in packages(path.read_text()) if name.startswith(".")]


def test_the_check_can_fail():
    assert "flexplant" in packages("def f():\n    from flexplant.lti import lft")
    assert "flexplant" in packages("import importlib; importlib.import_module('flexplant')")

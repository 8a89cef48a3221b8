"""The house: rooms import only from rooms above, stay small, load nothing heavy."""

import ast
import json
import os
import subprocess
import sys
from functools import cache
from pathlib import Path

import pytest

import flexplant

pytestmark = [pytest.mark.slow, pytest.mark.static]  # every module is parsed

ROOT = Path(flexplant.__file__).parent
#: in import order; the first entry is the foundation, whose modules may use each other
ROOMS = (
    (
        *("errors", "rooms", "arrays", "store", "certificates", "parallel"),
        *("tolerances", "fingerprints", "work", "dof_columns", "labels", "bibliography"),
        "algorithms",
    ),
    "lti",
    "sparse",
    "structure",
    "modes",
    "reduction",
    "joining",
    "identification",
    "updating",
    "plant",
    "loop",
    "estimation",
    "synthesis",
    "placement",
    "simulation",
    "testbeds",
    "io",
    "export",
    "plot",
    "workbench",
    "documentation",
)
LEVEL = {
    name: i for i, room in enumerate(ROOMS) for name in ([room] if isinstance(room, str) else room)
}
HEAVY = {"matplotlib", "control", "cvxpy", "clarabel", "filterpy", "tqdm", "panel", "bokeh"}
MODULES = sorted(ROOT.rglob("*.py"))
LONGEST = 600


@cache
def tree_of(path):
    return ast.parse(path.read_text())


def name_of(path):
    return str(path.relative_to(ROOT))


def room_of(path):
    part = path.relative_to(ROOT).parts[0]
    return part.removesuffix(".py")


def imported(tree, package):
    """Return (line, absolute dotted name) of every import, those inside functions too."""
    found = []
    for node in ast.walk(tree):
        if isinstance(node, ast.Import):
            found += [(node.lineno, alias.name) for alias in node.names]
        elif isinstance(node, ast.ImportFrom):
            base = package[: len(package) - node.level + 1] if node.level else ()
            module = (*base, *(node.module.split(".") if node.module else ()))
            if module == ("flexplant",):
                found += [(node.lineno, f"flexplant.{alias.name}") for alias in node.names]
            else:
                found.append((node.lineno, ".".join(module)))
    return found


def package_of(path):
    parts = ("flexplant", *path.relative_to(ROOT).with_suffix("").parts)
    return parts[:-1]


def test_every_module_is_in_a_room():
    rooms = {room_of(path) for path in MODULES} - {"__init__"}
    assert rooms <= set(LEVEL), f"no place in the import order for {sorted(rooms - set(LEVEL))}"


def test_rooms_import_only_from_rooms_above():
    wrong = []
    for path in MODULES:
        room = room_of(path)
        if room == "__init__":
            continue
        for line, module in imported(tree_of(path), package_of(path)):
            parts = module.split(".")
            if parts[0] != "flexplant":
                continue
            if len(parts) == 1 or parts[1] not in LEVEL:
                wrong.append(f"{name_of(path)}:{line} imports {module}, which is no room")
            elif parts[1] != room and LEVEL[parts[1]] > LEVEL[room]:
                wrong.append(f"{name_of(path)}:{line} imports {module} from below")
    assert not wrong, "\n".join(wrong)


def modules_of(root):
    """Return {dotted name: tree} of the modules under a folder, packages by their own name."""
    found = {}
    for path in sorted(root.rglob("*.py")):
        parts = path.relative_to(root).with_suffix("").parts
        found[".".join(parts)] = tree_of(path)
    return found


def defined_in(modules, dotted, name):
    """Return the module that `from dotted import name` reaches, or None when it is not ours."""
    package = f"{dotted}.__init__" if dotted else "__init__"
    if f"{dotted}.{name}".lstrip(".") in modules:
        return f"{dotted}.{name}".lstrip(".")
    if package in modules:
        for base, names in ours(modules[package], dotted.split(".") if dotted else []):
            if name in names:
                return defined_in(modules, base, names[name])
        return None
    return dotted if dotted in modules else None


def ours(tree, package):
    """Yield (dotted module below flexplant, {name here: name there}) of imports from it."""
    for node in ast.walk(tree):
        if isinstance(node, ast.Import):
            for alias in node.names:
                base, _, name = alias.name.removeprefix("flexplant.").rpartition(".")
                if alias.name.startswith("flexplant."):
                    yield base, {name: name}
        if isinstance(node, ast.ImportFrom):
            names = {alias.asname or alias.name: alias.name for alias in node.names}
            tail = node.module.split(".") if node.module else []
            if node.level:
                yield ".".join([*package[: len(package) - node.level + 1], *tail]), names
            elif tail[0] == "flexplant":
                yield ".".join(tail[1:]), names


def imports_of(modules):
    """Return {module: modules it imports}; what a package re-exports counts for its module."""
    found = {}
    for name, tree in modules.items():
        if not name.endswith("__init__"):
            reached = {
                defined_in(modules, base, there)
                for base, names in ours(tree, name.split(".")[:-1])
                for there in names.values()
            }
            found[name] = reached - {None, name}
    return found


def circles(graph):
    """Return the strongly connected parts of more than one module."""
    reach = {}
    for name in graph:
        seen, stack = set(), [name]
        while stack:
            new = graph.get(stack.pop(), set()) - seen
            seen |= new
            stack += new
        reach[name] = seen
    parts = {frozenset(m for m in reach[n] if n in reach[m]) for n in graph if n in reach[n]}
    return [set(part) for part in sorted(parts, key=min)]


def test_no_circles_between_modules():
    found = [sorted(circle) for circle in circles(imports_of(modules_of(ROOT)))]
    assert not found, f"modules import each other, also inside functions: {found}"


def test_circles_are_found(tmp_path):
    """Through a package's re-export, inside a function, by absolute imports, for types alone."""
    (tmp_path / "room").mkdir()
    (tmp_path / "__init__.py").write_text("from .room import a as a\n")
    (tmp_path / "room" / "__init__.py").write_text("from .one import a as a\n")
    (tmp_path / "room" / "one.py").write_text("def a():\n    from .two import b\n")
    (tmp_path / "room" / "two.py").write_text("from ..base import c\nb = 1\n")
    (tmp_path / "base.py").write_text("c = 1\ndef d():\n    from flexplant.room import a\n")
    (tmp_path / "free.py").write_text("from . import room, base\n")
    (tmp_path / "left.py").write_text("import flexplant.right\n")
    typed = "from typing import TYPE_CHECKING\nif TYPE_CHECKING:\n    from .left import e\n"
    (tmp_path / "right.py").write_text(typed)
    found = circles(imports_of(modules_of(tmp_path)))
    assert found == [{"base", "room.one", "room.two"}, {"left", "right"}]


def test_the_order_is_checked():
    """The walk sees an import from below, at any depth and in any spelling."""
    code = "def f():\n    from ..plant import x\nfrom flexplant import loop\nfrom . import y\n"
    found = imported(ast.parse(code), ("flexplant", "lti"))
    assert found == [(3, "flexplant.loop"), (4, "flexplant.lti"), (2, "flexplant.plant")]


def test_modules_are_short():
    long = {name_of(p): n for p in MODULES if (n := len(p.read_text().splitlines())) > LONGEST}
    assert not long, f"split these, they have more than {LONGEST} lines: {long}"


def at_module_level(tree):
    """Return the top packages imported when the module is loaded."""
    found, stack = set(), list(tree.body)
    while stack:
        node = stack.pop()
        if isinstance(node, ast.Import):
            found |= {alias.name.split(".")[0] for alias in node.names}
        elif isinstance(node, ast.ImportFrom) and not node.level:
            found.add(node.module.split(".")[0])
        elif isinstance(node, ast.If) and "TYPE_CHECKING" in ast.dump(node.test):
            stack += node.orelse
        elif not isinstance(node, ast.FunctionDef | ast.AsyncFunctionDef | ast.Lambda):
            stack += [child for child in ast.iter_child_nodes(node) if isinstance(child, ast.stmt)]
    return found


def test_heavy_packages_are_imported_where_they_are_needed():
    wrong = []
    for path in MODULES:
        allowed = {"matplotlib"} if room_of(path) == "plot" else set()
        found = (at_module_level(tree_of(path)) & HEAVY) - allowed
        if found:
            wrong.append(f"{name_of(path)} imports {sorted(found)}")
    assert not wrong, "import inside the functions that need them: " + ", ".join(wrong)


def only_exports(node, *, root):
    """Whether a statement of a package file re-exports or documents."""
    docstring = isinstance(node, ast.Expr) and isinstance(node.value, ast.Constant)
    names = [ast.unparse(t) for t in node.targets] if isinstance(node, ast.Assign) else []
    lazy = root and isinstance(node, ast.FunctionDef) and node.name in ("__getattr__", "__dir__")
    checking = isinstance(node, ast.If) and "TYPE_CHECKING" in ast.dump(node.test)
    return (
        docstring
        or lazy
        or (root and names == ["(_imported, __dir__, __all__)"])
        or checking
        or isinstance(node, ast.Import | ast.ImportFrom)
        or names in (["__version__"], ["__all__"], ["__dir__"])
    )


def test_package_files_only_re_export():
    wrong = [
        f"{name_of(path)}:{node.lineno} {ast.unparse(node)[:80]}"
        for path in MODULES
        if path.name == "__init__.py"
        for node in tree_of(path).body
        if not only_exports(node, root=path.parent == ROOT)
    ]
    assert not wrong, "\n".join(wrong)


def test_what_package_files_may_hold():
    code = "'Doc.'\nfrom . import x\n__all__ = ['x']\ny = 1\ndef __getattr__(name): return 1\n"
    body = ast.parse(code).body
    assert [only_exports(node, root=False) for node in body] == [True, True, True, False, False]
    assert only_exports(body[-1], root=True)


PROBE = """
import json, sys, warnings
import numpy, scipy.linalg, scipy.sparse.linalg
before = list(warnings.filters), numpy.get_printoptions(), numpy.geterr()
import flexplant
rooms = [name for name in dir(flexplant) if name not in ("plot", "workbench")]
first = [name for name in sys.modules if name.startswith("flexplant.")]
for name in rooms:
    getattr(flexplant, name)
after = list(warnings.filters), numpy.get_printoptions(), numpy.geterr()
heavy = "matplotlib control cvxpy clarabel filterpy tqdm slycot pandas".split()
parts = "io stats ndimage integrate interpolate signal optimize spatial special".split()
heavy += [f"scipy.{name}" for name in parts]
print(json.dumps({
    "heavy": [name for name in heavy if name in sys.modules],
    "same": [a == b for a, b in zip(before, after)],
    "first": first,
    "rooms": len(rooms),
}))
"""


def test_importing_it_is_light_and_changes_nothing():
    answer = subprocess.run(
        [sys.executable, "-c", PROBE], capture_output=True, text=True, check=True, timeout=60
    )
    found = json.loads(answer.stdout)
    assert found.pop("rooms") > 110
    assert found == {"heavy": [], "same": [True, True, True], "first": []}
    assert not answer.stderr


ALONE = """
import importlib, os, sys
import numpy, scipy.linalg, scipy.sparse.linalg
for name in sys.argv[1:]:
    child = os.fork()
    if not child:
        importlib.import_module(f"flexplant.{name}")
        os._exit(0)
    if os.waitpid(child, 0)[1]:
        sys.exit(f"{name} cannot be the first room that is imported")
"""


@pytest.mark.skipif(not hasattr(os, "fork"), reason="needs fork")
def test_any_room_may_be_imported_first():
    rooms = [path.name for path in ROOT.iterdir() if (path / "__init__.py").is_file()]
    assert len(rooms) > 15
    command = [sys.executable, "-c", ALONE, *rooms, "store", "labels"]
    answer = subprocess.run(command, capture_output=True, text=True, check=False, timeout=120)
    assert not answer.returncode, answer.stderr


def test_class_names_are_unique():
    where = {}
    for path in MODULES:
        for node in tree_of(path).body:
            if isinstance(node, ast.ClassDef):
                where.setdefault(node.name, []).append(name_of(path))
    twice = {name: found for name, found in where.items() if len(found) > 1}
    assert not twice, f"one name for two classes: {twice}"


def test_module_names_are_unique():
    """Also where rooms differ; a picture's module is called as what it shows."""
    names = [p.stem for p in MODULES if room_of(p) != "plot" and p.stem != "__init__"]
    assert sorted({name for name in names if names.count(name) > 1}) == []


def named_alike(modules):
    """Return the modules whose name is also that of something they define or their room shows."""
    found = []
    for dotted, tree in modules.items():
        package, _, name = dotted.removesuffix(".__init__").rpartition(".")
        room = tree if dotted.endswith("__init__") else modules.get(f"{package}.__init__", tree)
        shown = {
            alias.asname or alias.name
            for node in room.body
            if room is not tree or dotted.endswith("__init__")
            if isinstance(node, ast.ImportFrom) and node.level and node.module
            for alias in node.names
        }
        own = {n.name for n in tree.body if isinstance(n, ast.FunctionDef | ast.ClassDef)}
        if name in shown | own:
            found.append(dotted)
    return found


def test_no_module_has_the_name_of_a_function_that_it_defines():
    """`flexplant.estimation.kalman` is a module, and nothing hides it."""
    assert named_alike(modules_of(ROOT)) == []


def test_names_alike_are_found(tmp_path):
    room = tmp_path / "room"
    room.mkdir()
    (tmp_path / "__init__.py").write_text("")
    (tmp_path / "alone.py").write_text("def alone(): pass\n")
    (room / "__init__.py").write_text(
        "from .one import two as two\nfrom .one import room as room\n"
    )
    (room / "one.py").write_text("def room(): pass\ntwo = 2\n")
    (room / "two.py").write_text("")
    assert named_alike(modules_of(tmp_path)) == ["alone", "room.__init__", "room.two"]

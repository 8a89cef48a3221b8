"""README and the rooms' docstrings keep their word: commands, names, code and what it prints."""

import os
import re
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
import scipy.io
import scipy.linalg

import flexplant
from flexplant import h2_norm, io, simulation, solid_block
from test_public_api import ROOMS

ROOT = Path(__file__).parents[1]
README = (ROOT / "README.md").read_text(encoding="utf-8")
FLAGS = re.MULTILINE | re.DOTALL
OWN = re.findall(r"^```python\n(.*?)^```", README, FLAGS)
#: code in the rooms' docstrings that goes on with the README's names, or takes long
LONGER = [
    code
    for room in (io, simulation)
    for code in re.findall(r"^```python\n(.*?)^```", room.__doc__ or "", FLAGS)
]
BLOCKS = [*OWN, *LONGER]
COMMANDS = (
    "python -m pip install -e . && python examples/wafer_stage.py",
    "python -m pip install -e '.[test]' && python -m pytest",
)

pytestmark = pytest.mark.skipif(len(README) < 200, reason="the README is not written yet")


@pytest.mark.parametrize("command", COMMANDS)
def test_the_two_commands(command):
    assert command in README.splitlines()
    steps = (ROOT / ".ci" / "run").read_text(encoding="utf-8").splitlines()
    assert command in steps


def test_files_that_it_names_exist():
    named = re.findall(r"(?:examples|tests|src)/[\w/.]+\w", README)
    assert "examples/wafer_stage.py" in named
    for path in named:
        assert (ROOT / path).exists() or path.startswith("examples/out"), path


def test_it_is_short():
    assert len(README.splitlines()) <= 150


def found(name, *places):
    """Return what a dotted name reaches in one of some objects; raise where it reaches nothing."""
    for place in places:
        value = place
        try:
            for part in name.removeprefix("fx.").removeprefix("flexplant.").split("."):
                value = getattr(value, part)
        except AttributeError:
            continue
        return value
    raise AssertionError(f"{name} is no name")


def test_names_that_it_gives_exist():
    named = set(re.findall(r"\bfx(?:\.\w+)+", README))
    assert len(named) > 30
    for name in named:
        found(name, flexplant)


@pytest.mark.parametrize("name", sorted(ROOMS - {"errors"}))
def test_a_rooms_docstring_says_what_it_is_for(name):
    """Names in single quotes are ours, an example runs (test_doctests), names elsewhere follow."""
    room = getattr(flexplant, name)
    text = room.__doc__
    named = re.findall(r"(?<!`)`([A-Za-z_][\w.]*)`(?!`)", text)
    for one in set(named) - {"fx"}:
        assert one.startswith("examples/") or found(one, room, flexplant) is not None
    ours = [one for one in named if one.split(".")[0] in {*dir(room), "fx"}]
    assert len(ours) >= (0 if name == "sparse" else 4), "its main verbs"
    assert ">>> " in text
    assert name in ("testbeds", "io") or "elsewhere" in text or "MATLAB" in text


LISTS = """
two = fx.FEModel([[1, 0], [0, 2]], [[5, -5], [-5, 5]], [[0, 0], [0, 0]],
                 dofs=fx.DofSet([1, 2], ["x", "x"], [[0, 0, 0], [1, 0, 0]]))
pair = fx.solve_modes(two, count=2, damping=fx.ModalDamping([0.0, 0.01]))
tip = fx.Poi("tip", at=[1.0, 0, 0], axes=["x"])
"""


@pytest.mark.long
def test_its_scripts_pass_strict_type_checks(tmp_path):
    """Lists where arrays are held, one name or several; dask's own functions have no types.

    Of the package only what it declares is read: its own code is checked by lint, not here.
    """
    pytest.importorskip("mypy")
    script, options = tmp_path / "readme.py", tmp_path / "options.toml"
    script.write_text(
        "\n".join([*BLOCKS, LISTS, "wrong: str = fx.lti.low_pass_filter(60.0)"]), encoding="utf-8"
    )
    rules = (ROOT / "pyproject.toml").read_text(encoding="utf-8")
    declared = '[[tool.mypy.overrides]]\nmodule = ["flexplant.*"]\nignore_errors = true\n'
    options.write_text(f"{rules}\n{declared}", encoding="utf-8")
    flags = ["--strict", "--allow-untyped-calls", f"--config-file={options}"]
    cache = f"--cache-dir={ROOT / '.mypy_cache' / 'readme'}"  # with options of its own
    command = [sys.executable, "-m", "mypy", *flags, cache, str(script)]
    env = os.environ | {"MYPYPATH": str(ROOT / "src")}
    answer = subprocess.run(command, capture_output=True, text=True, env=env)
    errors = [line for line in answer.stdout.splitlines() if ": error:" in line]
    assert len(errors) == 1, answer.stdout + answer.stderr
    assert 'has type "StateSpace", variable has type "str"' in errors[0], "the last line is wrong"


def write_stage(folder):
    """Write the block of "A model of your own" as a finite-element program would, in mm and t."""
    block = solid_block(
        size=(0.4, 0.3, 0.1),
        elements=(8, 6, 2),
        density=2700,
        youngs_modulus=70e9,
        poisson_ratio=0.33,
    )
    scipy.io.mmwrite(folder / "stage_K.mtx", block.K / 1e3, symmetry="symmetric")
    scipy.io.mmwrite(folder / "stage_M.mtx", block.M / 1e3, symmetry="symmetric")
    dofs = block.dofs
    lines = [
        f"{node},{direction},{x!r},{y!r},{z!r}"
        for node, direction, (x, y, z) in zip(
            dofs.nodes.tolist(), dofs.directions, (1e3 * dofs.xyz).tolist(), strict=True
        )
    ]
    table = "\n".join(["node,direction,x,y,z", *lines])
    (folder / "stage_dofs.csv").write_text(table, encoding="utf-8")


def alike(printed, said):
    """Raise where two texts differ in more than the last digits of their numbers."""
    number = r"-?\d+(?:\.\d+)?(?:e[+-]?\d+)?"
    assert re.sub(number, "#", printed) == re.sub(number, "#", said)
    pairs = zip(re.findall(number, printed), re.findall(number, said), strict=True)
    for ours, theirs in pairs:
        assert float(ours) == pytest.approx(float(theirs), rel=0.02, abs=0), (ours, theirs)


def test_texts_are_compared_by_their_numbers():
    alike("rms 527 pm, 1.2e-06", "rms 527.4 pm, 1.21e-06")
    for other in ("rms 600 pm", "mean 527 pm"):
        with pytest.raises(AssertionError):
            alike("rms 527 pm", other)


def test_the_table_of_peers_is_that_of_the_command():
    """Its rows are those of the script, and neither is always ahead."""
    folder = ROOT / "tests" / "benchmarks"
    script = (folder / "readme_table.py").read_text(encoding="utf-8")
    tasks = re.findall(r"^    (\w+),$", script.split("ROWS = (")[1].split(")")[0], re.MULTILINE)
    text = flexplant.__doc__
    lines = text.split("| ratio |\n|---|---|---|---|---|\n")[1].split("\n\n")[0].splitlines()
    assert "OMP_NUM_THREADS=1 python tests/benchmarks/readme_table.py" in text
    assert len(lines) == len(tasks) > 10
    ratios = [line.split("|")[5].strip() for line in lines]
    known = [float(ratio) for ratio in ratios if ratio != "-"]
    assert min(known) < 1.0 < max(known)


def test_every_example_has_its_task():
    named = set(re.findall(r"`examples/(\w+\.py)`", flexplant.__doc__))
    assert named == {path.name for path in (ROOT / "examples").glob("*.py")}


@pytest.mark.long
def test_the_code_runs(tmp_path, monkeypatch, capsys):
    """All python blocks, in order, in one namespace, as a reader would paste them.

    What those of the README print is the text below each.
    """
    texts = re.findall(r"^```text\n(.*?)^```", README, FLAGS)
    assert len(texts) == len(OWN) == 2
    assert len(LONGER) == 3
    monkeypatch.chdir(tmp_path)
    write_stage(tmp_path)
    names = {"__name__": "__main__"}
    for i, code in enumerate(BLOCKS):
        exec(compile(code, f"block {i + 1}", "exec"), names)
        if "pipeline" in names:  # processes take it from the script that was started
            monkeypatch.setattr("__main__.pipeline", names["pipeline"], raising=False)
        printed = capsys.readouterr().out
        if i < len(texts):
            alike(printed, texts[i])
    g = names["loop"].system
    P = scipy.linalg.solve_discrete_lyapunov(g.A, g.B @ g.B.T)
    by_scipy = np.sqrt(np.trace(g.C @ P @ g.C.T) + np.sum(g.D**2))
    assert h2_norm(g) == pytest.approx(by_scipy, rel=1e-8)
    laptop = names["laptop"]
    assert laptop["failed"].tolist() == ["", ""] and laptop["stable"].all()
    np.testing.assert_allclose(laptop["margin"], names["held"].modulus_margin, rtol=0.05)
    assert np.all(laptop["MA"] < 100e-9)
    for other in ("pool", "cluster"):
        for column, values in names[other].items():
            np.testing.assert_array_equal(values, laptop[column])

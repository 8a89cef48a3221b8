"""Examples open as notebooks, and the short ones print the numbers that are pinned here.

Longer stories have test files of their own (test_examples.py, test_fleet_example.py, ...).
"""

import ast
import importlib
import re
from pathlib import Path

import numpy as np
import pytest
import scipy.sparse.linalg as spla
from matplotlib import image

import flexplant as fx

EXAMPLES = Path(__file__).parents[1] / "examples"
STORIES = sorted(EXAMPLES.glob("*.py"))


@pytest.fixture
def example(monkeypatch):
    monkeypatch.syspath_prepend(str(EXAMPLES))
    return importlib.import_module


def cells(text):
    """Return [(title, code)] of a script in the percent format; the first one has no title."""
    parts = re.split(r"^# %%(.*)$", text, flags=re.MULTILINE)
    return [("", parts[0]), *zip(map(str.strip, parts[1::2]), parts[2::2], strict=True)]


def numbers(text, start):
    """Return the numbers of the line that starts so."""
    line = next(line for line in text.splitlines() if line.startswith(start))
    return [float(n) for n in re.findall(r"-?\d+\.?\d*(?:e-?\d+)?", line.removeprefix(start))]


def test_every_story_has_cells_with_titles():
    assert len(STORIES) > 10
    for path in STORIES:
        first, *rest = cells(path.read_text(encoding="utf-8"))
        story = ast.get_docstring(ast.parse(first[1]))
        assert story and "\n\n" in story, f"{path.name} does not say what it is about"
        assert len(rest) >= 2, path.name
        for title, code in rest:
            assert title and title[0].isupper(), f"{path.name} has a cell without a title"
            ast.parse(code)  # a cell is whole


@pytest.mark.slow
@pytest.mark.parametrize("path", STORIES, ids=lambda path: path.stem)
def test_a_notebook_can_run_its_cells(path, monkeypatch):
    """A notebook has no __file__, its folder is the current one."""
    monkeypatch.chdir(EXAMPLES)
    monkeypatch.syspath_prepend(str(EXAMPLES))
    names = {"__name__": "notebook"}
    for title, code in cells(path.read_text(encoding="utf-8")):
        exec(compile(code, f"{path.stem}: {title}", "exec"), names)
    assert names["fx"] is importlib.import_module("flexplant")


@pytest.mark.long
def test_recorded_data(example, tmp_path, monkeypatch):
    """The densities are those that the record was made with; the filter they give is consistent."""
    story = example("recorded_data")
    monkeypatch.setattr(story, "OUT", tmp_path)
    result = story.main()
    said = story.table(result)
    assert re.search(r"the process noise is about (2\.9\d|3|3\.0\d) times", said)
    assert "filter of the record: the innovations are white" in said
    for name, asd in result["levels"].asd.items():
        truth = story.ENCODER if name.startswith("y") else story.REAL
        assert abs(asd / truth - 1) < 4 * result["levels"].relative[name]
    sheet, record, smoother = story.errors(result).values()
    np.testing.assert_allclose(numbers(said, "data sheet "), [2.17, 0.89], atol=0.02)
    np.testing.assert_allclose(numbers(said, "record  "), [1.83, 1.80], atol=0.02)
    assert sheet[2] > 5.0  # squared errors beside stated variances
    assert abs(record[2] - 1) < 0.1
    assert abs(smoother[2] - 1) < 0.2
    # its own file is read as one that somebody else wrote, whose truth nobody knows
    again = story.main(tmp_path / "record.csv")
    assert again["levels"].asd == pytest.approx(dict(result["levels"].asd), rel=1e-9, abs=0)
    assert "error [nm]" not in story.table(again)
    assert np.ptp(image.imread(story.picture(again, tmp_path))[..., :3]) > 0.5


@pytest.mark.long
def test_moving_poi(example, tmp_path):
    """The path explains what a rigid body and a fixed POI do not; the stated error is the real."""
    story = example("moving_poi")
    result = story.main()
    middle, rigid, along = result["rms"].values()
    said = story.table(result)
    # kernels of processors turn the noise that a seed gives: its rms has a scatter of 1 to 2 %
    np.testing.assert_allclose([middle, rigid, along], [17.05e-9, 1.43e-9, 0.872e-9], rtol=0.05)
    assert numbers(said, "along the path") == [pytest.approx(1e9 * along, abs=1e-3)]
    assert result["stated"] == pytest.approx(along, rel=0.2, abs=0)
    way = result["places"][result["exposed"]][:, 0]
    assert np.ptp(way) == pytest.approx(0.2, abs=2e-3)
    assert np.ptp(image.imread(story.picture(result, tmp_path))[..., :3]) > 0.5


@pytest.mark.long
def test_scanning_stage_with_one_short_run(example, tmp_path, monkeypatch):
    """Designs that follow keep their margin and their estimate on a machine of another kind."""
    story = example("scanning_stage")
    for name, value in (("OUT", tmp_path), ("RUNS", 1), ("DURATION", 0.1)):
        monkeypatch.setattr(story, name, value)
    result = story.main()
    rows = result["rows"]
    for figure, wanted, off in (
        ("margin", (0.448, 0.586), 5e-3),
        ("bandwidth", (16.05, 21.0), 0.1),
    ):
        found = [rows[name][figure] for name in ("fixed", "following")]
        np.testing.assert_allclose(found, wanted, atol=off)
    assert rows["following"]["estimate"] < 0.4 * rows["fixed"]["estimate"]
    filters = result["filters"]
    assert np.all(filters.price("scheduled")["die:z"] < 0.02 * filters.exact[0])
    assert np.ptp(image.imread(tmp_path / "scanning_stage.png")[..., :3]) > 0.5


@pytest.mark.slow
def test_million_dofs_with_fewer(example):
    story = example("million_dofs")
    result = story.main(3000)
    error = story.leissa_error(result["modes"])
    # Ritz bounds from above; a mesh of 32 x 32 elements is converged to 1e-3
    np.testing.assert_allclose(error, [-0.0014, -0.0097, -0.0065, -0.0064, -0.0064], atol=1e-4)
    assert result["modes"].n_rigid == 3
    assert result["loop"].modulus_margin > 0.5
    said = story.table(result)
    assert said.startswith("3267 DOFs")
    assert "none missing" in said
    assert numbers(said, "reduced to")[0] == 28


@pytest.mark.slow
def test_from_nastran(example, tmp_path, monkeypatch):
    """Ten digits of the punch file hold a free block at 0.2 Hz; freed, it is the block again."""
    story = example("from_nastran")
    monkeypatch.setattr(story, "OUT", tmp_path)
    result = story.main()
    block = story.fx.solid_block(
        size=story.SIZE, elements=(6, 5, 1), density=2700, youngs_modulus=70e9, poisson_ratio=0.33
    )
    exact = story.fx.solve_modes(block, count=20).freq
    np.testing.assert_allclose(result["modes"].freq[6:], exact[6:], rtol=1e-7)
    assert result["modes"].n_rigid == 6
    assert 0.05 < result["printed"].freq[5] < 0.5
    said = story.table(result)
    assert "as if all values are in mm, t and s" in said
    assert "rounding of K's entries to 10 digits" in said.replace("\n", " ")
    assert "then 1289.15 Hz" in said
    # files of one's own are taken as they are
    other = story.main(tmp_path / "stage.pch", tmp_path / "stage.bdf")
    np.testing.assert_array_equal(other["modes"].freq, result["modes"].freq)


@pytest.mark.long
def test_from_skfem(example):
    """Mass by geometry, frequencies by ARPACK and of a finer mesh."""
    pytest.importorskip("skfem")
    story = example("from_skfem")
    result = story.main()
    model, freq = result["model"], result["modes"].freq
    volume = (story.SIDE**2 - np.pi * story.RADIUS**2) * story.DEPTH
    assert model.mass == pytest.approx(story.DENSITY * volume, rel=2e-3)
    squares = spla.eigsh(model.K, 12, model.M, sigma=-1e6, return_eigenvectors=False)
    other = np.sqrt(np.sort(squares)[6:]) / (2 * np.pi)
    np.testing.assert_allclose(freq[6:12], other, rtol=1e-6)
    fine = fx.solve_modes(story.model_of(story.plate_with_hole(4, 9)), count=12).freq
    np.testing.assert_allclose(freq[6:12], fine[6:], rtol=6e-3)
    assert np.all(fine[6:] < freq[6:12])
    np.testing.assert_allclose(result["reduced"].modes().freq, freq, rtol=1e-6, atol=1e-6)

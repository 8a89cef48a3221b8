"""The paper's story runs, and its numbers are those of independent oracles or of the notes."""

import importlib
import json
import re
from pathlib import Path

import numpy as np
import pytest
from matplotlib import image
from PIL import Image
from scipy import stats

import flexplant as fx
from oracles_plant import machine
from oracles_structure import elastic_receptance, plate_matrices, undamped
from oracles_structure import poles as dense_poles

FILE = Path(__file__).parents[1] / "examples" / "wafer_stage.py"
FIGURES = ("figure_03", "figure_04", "figure_05", "figure_06", "figure_07", "figure_08")
FIGURES += ("figure_09", "figure_10", "figure_11", "closed_loop")
#: nm rms at 1e-3 N/sqrt(Hz), static, not updated, updated: closed forms, pinned in test_testbeds
PINS = {0.01: (1.845, 0.8282, 0.6395), 0.001: (5.834, 2.297, 1.559)}

pytestmark = pytest.mark.slow


@pytest.fixture(scope="module")
def example():
    # by its own name, from the path: processes that help it import it again
    with pytest.MonkeyPatch.context() as patch:
        patch.syspath_prepend(str(FILE.parent))
        yield importlib.import_module("wafer_stage")


@pytest.fixture(scope="module")
def result(example):
    return example.main()


def test_the_plate(example):
    # oracle: dense eigenvalues of matrices by Gauss points; notes.md
    M, K = plate_matrices(8, 8)
    found = fx.solve_modes(example.plate, count=24).freq
    np.testing.assert_allclose(found[3:], undamped(M, K)[0][3:24] / (2 * np.pi), rtol=1e-8)
    np.testing.assert_allclose(found[3:8], [245.754, 359.312, 463.131, 640.083, 640.083], rtol=1e-5)
    assert np.array_equal(found[:3], np.zeros(3))
    thick = undamped(*plate_matrices(8, 8, thickness=0.0272 * 1.01))[0][3] / (2 * np.pi)
    assert abs(thick / found[3] - 1) > 5e-3
    assert example.z8 == "23:z"


def test_the_reduction(example, result):
    """Corner FRF to mode 20 at 1 %: notes.md's 7 % and 0.5 %, against all modes of the oracle."""
    modal, attached = result["frf_error"]
    assert modal <= 0.07
    assert attached == pytest.approx(0.0040, abs=1e-4)
    M, K = plate_matrices(8, 8)
    omega, phi = undamped(M, K)
    freq = np.linspace(0.0, omega[19] / (2 * np.pi), 4000)
    row = np.eye(243)[0]
    full, static = elastic_receptance(M, K, row, freq, 0.01)
    w, shape = omega[3:24], (row @ phi)[3:24] ** 2
    s = 2 * np.pi * freq[:, None]
    kept = (shape / (w**2 - s**2 + 0.02j * w * s)).sum(axis=1)
    assert modal == pytest.approx(np.abs(kept - full).max() / static, rel=1e-3)
    for zeta in (0.01, 0.001):
        poles = result["cases"][zeta]["nominal"].modes().poles
        assert np.array_equal(poles[:3], np.zeros(3))
        wanted = omega[3:24] * (-zeta + 1j * np.sqrt(1 - zeta**2))
        # repeated pairs come in any order, so by size
        np.testing.assert_allclose(np.abs(poles[3:24]), np.abs(wanted), rtol=1e-8)
        own = fx.solve_modes(example.plate, count=24, damping=fx.ModalDamping(zeta)).poles[3:]
        np.testing.assert_allclose(poles[3:24], own, rtol=1e-11)


def test_the_update(result):
    for zeta, limit in ((0.01, 3e-3), (0.001, 3e-4)):
        case = result["cases"][zeta]
        wanted = dense_poles(*machine(zeta, mass=0.5))[2:4]
        np.testing.assert_allclose(case["measured"].poles, wanted, rtol=1e-7)
        mass, damping = case["fit"].values
        assert mass == pytest.approx(0.5, abs=1e-6)
        assert abs(damping) < limit
        assert case["modal"].values[0] == pytest.approx(0.5035, abs=5e-5)
        assert case["modal"].values[1] == pytest.approx(-21.0 * zeta, rel=0.02)
        assert len(case["fit"].history) <= 5
        assert case["fit"].converged


def test_what_the_update_buys(result):
    """0.1 %, 1e-3 N/sqrt(Hz), 0.1 nm: (c) beats (b) by 1.3, (b) beats (a) by 2, by runs.

    The closed forms of the same loops are pinned in test_testbeds.
    """
    errors = result["cases"][0.001]["errors"]
    assert tuple(errors) == (1e-4, 1e-3, 1e-2)
    static, nominal, updated = (rms for _, rms, _ in errors[1e-3].values())
    assert nominal >= 1.3 * updated
    assert static >= 2 * nominal
    for zeta, wanted in PINS.items():
        for (_, rms, half), pin in zip(
            result["cases"][zeta]["errors"][1e-3].values(), wanted, strict=True
        ):
            assert abs(1e9 * rms - pin) < 2e9 * half
    predicted = errors[1e-3]["updated"][0]
    assert predicted == pytest.approx(0.305e-9, rel=2e-2)  # notes.md


@pytest.mark.parametrize("zeta", [0.01, 0.001])
def test_the_runs_scatter_as_they_should(example, result, zeta):
    """Limits from the correlation time, at 99.9 %: mode 6 rings at the POI for 1 / decay seconds.

    The mean square of a resonance over a time T has the relative variance 1 / (decay T), so
    2 decay T degrees of freedom; what the filters err dies out no slower.
    """
    decay = -dense_poles(*machine(zeta, mass=0.5))[2].real
    seconds, seeds = example.MEASURE, example.SEEDS
    freedom = 2 * decay * seconds * seeds
    low, high = np.sqrt(stats.chi2.ppf([5e-4, 1 - 5e-4], freedom) / freedom)
    # of the interval's half width: Student's factor, times a spread between seeds that scatters
    unit = stats.t.ppf(0.975, seeds - 1) / np.sqrt(decay * seconds * seeds) / 2
    least, most = unit * np.sqrt(stats.chi2.ppf([5e-4, 1 - 5e-4], seeds - 1) / (seeds - 1))
    found = result["cases"][zeta]["errors"][1e-3]
    for (name, (_, rms, half)), pin in zip(found.items(), PINS[zeta], strict=True):
        assert low < 1e9 * rms / pin < high, name
        assert half / rms < most / low, name
    assert found["static"][2] / found["static"][1] > least / high


def test_every_row_has_noise_of_its_own(result):
    """With shared seeds the static error would scale with the force to all digits."""
    for case in result["cases"].values():
        predicted, measured = (
            [errors["static"][i] for errors in case["errors"].values()] for i in (0, 1)
        )
        assert predicted[2] / predicted[1] == pytest.approx(10.0, rel=1e-2)
        assert abs(measured[2] / measured[1] / 10.0 - 1) > 1e-3
    one, other = (case["errors"][1e-3]["nominal"][1] for case in result["cases"].values())
    assert one != other


def test_the_closed_loops(result):
    """The servo: |S| at u below 6 dB on model and machine; pinned densely in test_testbeds."""
    for case in result["cases"].values():
        loop = case["loops"]["servo"]
        for where in ("on model", "on machine"):
            assert loop[where].spectral_radius < 1
            assert 3.0 < -20 * np.log10(loop[where].modulus_margin) < 6.0
        run = loop["run"]
        assert run["die:ref"][-1] == pytest.approx(100e-6)
        np.testing.assert_allclose(run["die:error"], run["die:ref"] - run["die:z"], atol=1e-18)
        assert 0 < loop["MA"] < 50e-9
        assert 0 < loop["MSD"] < 20e-9


def test_the_h_infinity_designs(example, result):
    for case in result["cases"].values():
        loop = case["loops"]["H-infinity"]
        assert loop["blocks"][-1].gamma == pytest.approx(0.983, rel=1e-2)
        for where in ("on model", "on machine"):
            assert loop[where].spectral_radius < 1
            assert 30.0 < example.reached(loop["S"][where]) < 37.0


def test_the_example_fails_when_the_design_is_not_worth_it(example):
    plant = example.study(0.01, ())["plant"]
    comparison, weights = fx.reference_errors(plant), fx.stage_weights(plant, 30.0)
    weighted = plant.through(comparison).weighted(z=weights.z, w=weights.w)
    nothing = example.doing_nothing(weighted)
    assert 2 * 0.98 < nothing < np.inf
    with pytest.raises(RuntimeError, match="doing nothing scores"):
        example.require_worth(nothing, 0.51 * nothing)
    example.require_worth(nothing, 0.49 * nothing)
    freq = np.array([10.0, 29.0, 40.0])
    with pytest.raises(RuntimeError, match="lost below 30 Hz on machine"):
        example.require_bandwidth({"on machine": (freq, np.array([0.1, 1.1, 1.2]))})
    example.require_bandwidth({"on machine": (freq, np.array([0.1, 0.9, 1.2]))})


def test_the_placement(result):
    found = result["placement"]
    assert np.sqrt(found["every"].values[0]) == pytest.approx(0.1214e-9, rel=5e-3)
    assert found["best"].value == pytest.approx(found["every"].values[0], rel=1e-9, abs=0.0)
    np.testing.assert_allclose(found["fifth"].best, [0.3, 0.3, 0.0], atol=1e-9)


def test_the_table_has_the_papers_column(example, result):
    lines = "\n".join(["", *example.model_table(result)]).splitlines()
    assert lines[1].split()[-2:] == ["flexplant", "paper"]

    def row(start):
        return next(line for line in lines if line.startswith(start)).split()

    assert row("plate: degrees of freedom")[-2:] == ["243", "243"]
    assert row("mode 6 before")[-2:] == ["463.131", "461"]
    assert row("mode 6 after")[-1] == "455"
    assert row("added mass, with")[-2:] == ["0.500000", "0.5"]
    assert row("added mass, modes")[-2:] == ["0.503535", "0.5"]
    ours, paper = ["-28.57", "2883.6i"], ["-28.5", "2870i"]
    assert [w for w in row("measured lambda_12")[-6:] if w not in "+-"] == [*ours, *paper]
    ours, paper = ["-39.45", "3983.3i"], ["-39.3", "3970i"]
    assert [w for w in row("measured lambda_14")[-6:] if w not in "+-"] == [*ours, *paper]
    study = [
        line
        for line in example.estimation_table(result)
        if re.match(r"\s+[01]\.[01]%\s+1e-0[234]", line)
    ]
    assert len(study) == 6
    assert all(line.count("+-") == 3 for line in study)


def test_all_of_the_table(example, result):
    lines = example.table(result).splitlines()
    margins = [line for line in lines if "on machine" in line and " dB" in line]
    assert len(margins) >= 2
    assert sum("on model" in line for line in lines) == len(margins)
    assert max(map(len, lines)) < 120
    assert any(
        "0.1%  |S| of H-infinity is largest at 459 Hz on the machine: 6.7" in x for x in lines
    )
    assert len(lines) < 60


def check_the_readmes_picture(example, result, drawn):
    """The committed picture shows this run: its numbers, and pixel by pixel where they can be."""
    advice = "it shows another run: copy examples/out/closed_loop.png to examples/wafer_stage.png"
    with Image.open(FILE.with_suffix(".png")) as old, Image.open(drawn) as new:
        assert "Comment" in old.text, advice
        shown = json.loads(old.text["Comment"])
        now = example.shown_numbers(result["cases"][0.01]["loops"])
        assert json.loads(new.text["Comment"]) == now
        assert list(shown) == list(now), advice
        for name, points in now.items():
            size = np.abs(points).max()
            np.testing.assert_allclose(
                shown[name], points, rtol=0, atol=1e-3 * size, err_msg=advice
            )
        if old.text["Software"] == new.text["Software"]:  # the same release of matplotlib
            pixels = [np.asarray(one.convert("L"), float) / 255 for one in (old, new)]
            assert pixels[0].shape == pixels[1].shape, advice
            assert np.abs(pixels[0] - pixels[1]).mean() < 1e-3, advice


def test_the_pictures(example, result, tmp_path):
    drawn = example.pictures(result, tmp_path / "out")
    check_the_readmes_picture(example, result, tmp_path / "out" / "closed_loop.png")
    assert [any(path.name.startswith(name) for path in drawn) for name in FIGURES] == [True] * 10
    for path in drawn:
        pixels = image.imread(path)[:, :, :3]
        assert pixels.std() > 0.02, f"{path.name} is blank"
        assert min(pixels.shape[:2]) > 300
        coloured = pixels.max(axis=2) - pixels.min(axis=2) > 0.2
        assert coloured.mean() > 1e-3, f"{path.name} has no curve"

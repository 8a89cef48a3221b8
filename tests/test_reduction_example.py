"""The comparison of reduction methods runs, and says what it said."""

import importlib
from pathlib import Path

import numpy as np
import pytest

FILE = Path(__file__).parents[1] / "examples" / "reduction_methods.py"

pytestmark = pytest.mark.slow


@pytest.fixture(scope="module")
def example():
    with pytest.MonkeyPatch.context() as patch:
        patch.syspath_prepend(str(FILE.parent))
        yield importlib.import_module("reduction_methods")


@pytest.fixture(scope="module")
def result(example):
    return example.main()


def worst(result, name):
    """Worst frequency, FRF and static error of a method, and modes without a partner."""
    quality = result["judged"][name][1]
    lost = np.isnan(quality.freq)
    errors = quality.freq_error[~lost]
    return (
        float(np.abs(errors).max()),
        float(quality.frf_error.max()),
        float(quality.static_error.max()),
        int(lost.sum()),
    )


def test_all_have_the_same_order(example, result):
    assert {order for order, _, _ in result["judged"].values()} == {example.ORDER}
    assert len(result["judged"]) == 12


@pytest.mark.parametrize(
    ("name", "freq", "frf", "static"),
    [
        ("Guyan", 6.5e-2, 0.50, 6.8e-3),
        ("Irs", 4.8e-4, 8.3e-3, 1.6e-3),
        ("CraigBampton", 6.5e-2, 8.4e-2, 1.6e-4),
    ],
)
def test_methods_without_exact_modes(result, name, freq, frf, static):
    found = worst(result, name)
    np.testing.assert_allclose(found[:3], [freq, frf, static], rtol=0.05)
    assert found[3] == 0
    assert np.all(result["judged"][name][1].freq_error > -1e-9)  # Rayleigh-Ritz


@pytest.mark.parametrize("name", ["DesiredDofs", "Serep", "ModalTruncation"])
def test_the_paper_and_its_equals(result, name):
    found = worst(result, name)
    assert found[0] < 1e-10
    np.testing.assert_allclose(found[1:3], [2.9e-4, 1.5e-2], rtol=0.05)


def test_iterated_irs_ends_at_serep(result):
    one, two = worst(result, "Irs, 50 iterations"), worst(result, "Serep")
    assert one[0] < 1e-10
    assert one[1] < 1.1 * two[1]


@pytest.mark.parametrize("name", ["ModalTruncation, static", "Rubin", "MacNeal", "Krylov"])
def test_static_methods(result, name):
    assert worst(result, name)[2] < 1e-9


def test_residual_flexibility_and_hankel_values_pay(result):
    frf = {name: worst(result, name)[1] for name in result["judged"]}
    assert frf["Rubin"] == pytest.approx(3.9e-5, rel=0.05)
    assert frf["Rubin"] == pytest.approx(frf["ModalTruncation, static"], rel=1e-3)
    assert frf["Rubin"] < frf["MacNeal"] / 5
    assert frf["ModalBalanced"] < frf["ModalTruncation"] / 4
    # two modes below 1.5 kHz that no channel sees or pushes
    assert worst(result, "ModalBalanced")[3] == 2
    quality = result["judged"]["ModalBalanced"][1]
    assert quality.modes[np.isnan(quality.freq)].tolist() == [5, 12]
    assert not {5, 12} & set(result["ranking"].order[:20].tolist())


def test_bounds_hold(result):
    bounded = [q for _, q, _ in result["judged"].values() if q.bound is not None]
    assert len(bounded) == 3
    assert all(quality.holds for quality in bounded)


def test_table(example, result):
    text = example.table(result)
    assert max(map(len, text.splitlines())) <= 100
    assert text.splitlines()[0].startswith("method")
    assert ["4", "245.75"] in [line.split()[:2] for line in text.splitlines()]


def test_picture(example, result, tmp_path):
    assert example.picture(result, tmp_path).stat().st_size > 40_000

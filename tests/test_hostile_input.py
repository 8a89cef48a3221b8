"""Hostile arguments of the shared checks: a right answer or an error of ours with a way out."""

from functools import partial

import numpy as np
import pandas as pd
import pytest

import flexplant as fx
from flexplant.arrays import complex_array, name_list, positions, positive, real_array, whole
from flexplant.errors import FlexplantError

HUGE = 10**400
#: no number of any use, of one axis or none
NO_NUMBERS = {
    "nan": float("nan"), "inf": float("inf"), "complex": 1j, "huge": HUGE, "-huge": -HUGE,
    "large": 1e300, "text": "a:b:c", "None": None, "object": object(), "[nan]": np.array([np.nan]),
    "ragged": [[1.0], [1.0, 2.0]], "masked": np.ma.masked_array([1.0, 2.0], [False, True]),
    "[huge]": [HUGE], "[complex]": [1j], "set": {1, 2}, "bytes": b"a", "class": int,
}  # fmt: skip


@pytest.fixture(autouse=True)
def _elsewhere(tmp_path, monkeypatch):
    """A text is a path to whoever writes files."""
    monkeypatch.chdir(tmp_path)


@pytest.mark.parametrize("kind", NO_NUMBERS)
@pytest.mark.parametrize(
    "check",
    [real_array, positive, partial(whole, maximum=10)],
    ids=["real_array", "positive", "whole"],
)
def test_what_is_no_number_is_refused_by_name(check, kind):
    with pytest.raises(FlexplantError, match=r"width.*[.] [A-Z]"):
        check(NO_NUMBERS[kind], "width")


def test_numbers_of_other_kinds_are_taken():
    for given in ([1, 2], (1.0, 2.0), np.array([1, 2], np.float32), pd.Series([1, 2])):
        assert real_array(given, "width", (2,)).tolist() == [1.0, 2.0]
    assert complex_array([1, 2j], "width", (2,)).tolist() == [1.0, 2.0j]
    assert positive(np.array(0.5), "width") == 0.5
    assert real_array([1e200], "width", limit=np.inf).tolist() == [1e200]


def test_positions_lie_within_and_names_are_names():
    assert positions([0, -1], "rows", 3).tolist() == [0, -1]
    for wrong in ([3], [-4], [0.5], [HUGE], 1):
        with pytest.raises(FlexplantError, match="rows"):
            positions(wrong, "rows", 3)
    for wrong in (np.array("a"), b"a", 3, [None]):
        with pytest.raises(FlexplantError, match="names"):
            name_list(wrong, "names")


def test_attributes_that_are_not_there_answer_with_those_that_are():
    plant = fx.testbeds.three_masses()
    with pytest.raises(AttributeError, match=r"StandardPlant has no 'Gyy'. Close matches: .*Gyu"):
        _ = plant.Gyy
    with pytest.raises(AttributeError, match=r"Pictures are functions: flexplant\.plot"):
        _ = plant.plot
    assert not hasattr(plant, "_nothing")

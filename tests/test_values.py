"""The base of all values and the checks of arguments."""

import pickle
from dataclasses import FrozenInstanceError, dataclass
from types import MappingProxyType
from typing import Any

import numpy as np
import pytest
import scipy.sparse as sp

from flexplant.arrays import (
    check_names,
    generator,
    name_list,
    positive,
    real_array,
    seed_sequence,
    signal_names,
    whole,
)
from flexplant.errors import LabelError, ModelError, ShapeError
from flexplant.store import Value, frozen, rebuild


@dataclass(frozen=True, eq=False, repr=False)
class Holder(Value):
    """Anything."""

    content: Any

    def __post_init__(self):
        self._set(content=self.content)


def test_arrays_are_copied_in_and_read_only():
    given = np.arange(3.0)
    holder = Holder(given)
    given[0] = 7
    assert holder.content.tolist() == [0, 1, 2]
    with pytest.raises(ValueError, match="read-only"):
        holder.content[0] = 7
    with pytest.raises(FrozenInstanceError):
        holder.content = None


def test_views_of_read_only_arrays_are_copied():
    base = np.arange(4.0)
    view = base[:2]
    view.flags.writeable = False
    kept = frozen(view)
    base[0] = 9
    assert kept[0] == 0


def test_sparse_matrices_and_mappings_are_read_only():
    given = sp.coo_array(([1.0, 2.0], ([0, 0], [1, 1])), shape=(2, 2))
    matrix = Holder(given).content
    assert matrix.format == "csc"
    assert matrix[0, 1] == 3
    with pytest.raises(ValueError, match="read-only"):
        matrix.data[0] = 1
    mapping = Holder({"a": np.ones(2)}).content
    assert isinstance(mapping, MappingProxyType)
    with pytest.raises(TypeError):
        mapping["a"] = 1
    with pytest.raises(ValueError, match="read-only"):
        mapping["a"][0] = 2


def test_pickles_stay_read_only():
    for content in (np.ones((2, 2)), sp.eye_array(3, format="csc"), {"a": np.ones(2)}, 3, "x"):
        other = pickle.loads(pickle.dumps(Holder(content)))
        assert type(other) is Holder
    array = pickle.loads(pickle.dumps(Holder(np.ones(2)))).content
    with pytest.raises(ValueError, match="read-only"):
        array[0] = 2
    inner = pickle.loads(pickle.dumps(Holder({"a": np.ones(2)}))).content["a"]
    with pytest.raises(ValueError, match="read-only"):
        inner[0] = 2


def test_replace_makes_a_checked_copy():
    holder = Holder(np.ones(2))
    other = holder.replace(content=np.zeros(2))
    assert holder.content[0] == 1
    assert other.content[0] == 0
    with pytest.raises(TypeError):
        holder.replace(nothing=1)


def test_rebuild_skips_construction_only():
    other = rebuild(Holder, {"content": np.ones(1)})
    assert isinstance(other, Holder)
    assert not other.content.flags.writeable


def test_values_are_known_by_name():
    assert Value.registry["Holder"] is Holder


@pytest.mark.parametrize(
    ("value", "shape", "error"),
    [
        ([1, np.nan], None, ModelError),
        ([[1, np.inf]], (1, 2), ModelError),
        ([1j], None, ModelError),
        (["a"], None, ModelError),
        (None, (), ModelError),
        ([[1], [1, 2]], None, ModelError),
        (["1", "2"], None, ModelError),
        ([1, None], None, ModelError),
        ([1, "2"], (2,), ModelError),
        (np.array(["2026-01-01"], dtype="datetime64[D]"), None, ModelError),
        ({"a": 1}, (), ModelError),
        ([1, 2], (3,), ShapeError),
        ([1, 2], (1, 2), ShapeError),
        (1.0, (None,), ShapeError),
    ],
)
def test_bad_arrays(value, shape, error):
    with pytest.raises(error, match=r"^x "):
        real_array(value, "x", shape)


def test_good_arrays():
    given = np.ones((2, 3))
    array = real_array(given, "x", (None, 3))
    assert array is not given
    assert array.dtype == np.float64
    assert real_array([True, 2], "x").tolist() == [1, 2]
    with pytest.raises(ModelError, match=r"x has a NaN .* \(1, 0\)"):
        real_array([[0, 0], [np.nan, 0]], "x")


def test_masked_entries_are_no_data():
    """Alone, in lists, of any kind of numbers: what lies under a mask is never read."""
    masked = np.ma.masked_array([1.0, 2.0], [False, True])
    for given in (masked, [masked, [3.0, 4.0]], (masked, masked), masked.astype(int)):
        with pytest.raises(ModelError, match="x has a masked entry, the first at index"):
            real_array(given, "x")
    assert real_array(np.ma.masked_array([1, 2]), "x").tolist() == [1, 2]


@pytest.mark.parametrize(
    ("value", "shape", "text"),
    [
        (None, (), "x must be one number, got None. Pass"),
        ("3", (), "x must be one number, got '3'. Pass"),
        ([1.0, 2.0], (), "x must be one number, got (2,). Pass"),
        ([1.0, 2.0], (3,), "x must have shape (3,), got (2,). Pass"),
        (1.0, (None,), "x must have shape (any,), got the number 1. Pass"),
        (1.0, (None, 3), "x must have shape (any, 3), got the number 1. Pass"),
        (np.nan, (), "x has a NaN or infinite value (nan): no result could be trusted. Pass a"),
        ([1.0, None], None, "x must hold numbers, got [1.0, None]. Pass"),
        (np.array(["a"] * 99), None, "x must hold numbers, got an array of shape (99,). Pass"),
        ([[1], [1, 2]], None, "its rows have different lengths. Give"),
    ],
)
def test_what_is_wrong_is_named_as_it_is(value, shape, text):
    with pytest.raises(ValueError, match="x ") as caught:
        real_array(value, "x", shape)
    assert text in str(caught.value)


def test_whole_numbers():
    assert whole(3, "n") == 3
    assert type(whole(np.int32(3), "n")) is int
    assert whole(0, "n", minimum=0) == 0
    assert whole(5, "n", maximum=5) == 5
    for bad in (True, np.True_, 3.0, np.float64(3), "3", None, [3], np.nan, np.array(3)):
        with pytest.raises(ModelError, match="n must be a whole number at least 1, got"):
            whole(bad, "n")
    for bad in (0, -1, 6):
        with pytest.raises(ModelError, match=f"from 1 to 5, got {bad}. Choose"):
            whole(bad, "n", maximum=5)


def test_seeds():
    for rng in (7, np.int64(7), np.random.SeedSequence(7)):
        assert generator(rng).random() == np.random.default_rng(7).random()
    assert generator([1, 2]).random() == np.random.default_rng([1, 2]).random()
    assert generator(np.array([1, 2])).random() == np.random.default_rng([1, 2]).random()
    given = np.random.default_rng(0)
    assert generator(given) is given
    assert generator(None).random() != generator(None).random()
    # a Generator moves on: two calls with it differ, two with its copy do not
    first, second = (seed_sequence(given).entropy for _ in range(2))
    assert first != second
    assert seed_sequence(np.random.default_rng(3)).entropy == (
        seed_sequence(np.random.default_rng(3)).entropy
    )
    for bad in ("a", -1, 1.0, True, [1, -1], [1, True], {}, np.array([0.5])):
        with pytest.raises(ModelError, match=r"seed must be a seed .* Pass an int"):
            generator(bad, "seed")


def test_lists_of_names():
    assert name_list("a", "sensors") == ("a",)
    assert name_list((n for n in "ab"), "sensors") == ("a", "b")
    for bad in (None, 3, ["a", 3], b"a", [None]):
        with pytest.raises(LabelError, match=r"sensors are chosen by name, got .* Pass a list"):
            name_list(bad, "sensors")


def test_positive():
    assert positive(np.float32(2), "x") == 2
    assert positive(0, "x", zero=True) == 0
    for bad in (0, -1, np.nan, "a", "1", True, None):
        with pytest.raises(ModelError, match=r"^x "):
            positive(bad, "x")
    with pytest.raises(ModelError, match="zero or positive"):
        positive(-1, "x", zero=True)
    with pytest.raises(ShapeError, match="x must be one number"):
        positive([1, 2], "x")


def test_signal_names():
    assert signal_names((), 2, "u", "inputs") == ("u1", "u2")
    assert signal_names("force", 1, "u", "inputs") == ("force",)
    assert signal_names(["die:z", "a b"], 2, "y", "outputs") == ("die:z", "a b")
    with pytest.raises(ShapeError, match="2 inputs need 2 names, got 1"):
        signal_names(["u"], 2, "u", "inputs")


@pytest.mark.parametrize("names", [["a.b"], ["-a"], [""], ["a", "b", "a"]])
def test_names_that_would_break_others_are_refused(names):
    with pytest.raises(LabelError, match=r"cannot name|more than once"):
        check_names(names, "inputs")

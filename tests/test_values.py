"""The base of all values and the checks at the door."""

import pickle
from dataclasses import FrozenInstanceError, dataclass
from types import MappingProxyType
from typing import Any

import numpy as np
import pytest
import scipy.sparse as sp

from flexplant.errors import LabelError, ModelError, ShapeError
from flexplant.values import (
    Value,
    check_names,
    frozen,
    positive,
    real_array,
    rebuild,
    signal_names,
)


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
        ([[1], [1, 2]], None, ValueError),
        ([1, 2], (3,), ShapeError),
        ([1, 2], (1, 2), ShapeError),
        (1.0, (None,), ShapeError),
    ],
)
def test_bad_arrays(value, shape, error):
    with pytest.raises(error):
        real_array(value, "x", shape)


def test_good_arrays():
    given = np.ones((2, 3))
    array = real_array(given, "x", (None, 3))
    assert array is not given
    assert array.dtype == np.float64
    assert real_array([True, 2], "x").tolist() == [1, 2]
    with pytest.raises(ModelError, match=r"x has a NaN .* \(1, 0\)"):
        real_array([[0, 0], [np.nan, 0]], "x")


def test_positive():
    assert positive(np.float32(2), "x") == 2
    assert positive(0, "x", zero=True) == 0
    for bad in (0, -1, np.nan, "a"):
        with pytest.raises(ModelError):
            positive(bad, "x")
    with pytest.raises(ModelError, match="zero or positive"):
        positive(-1, "x", zero=True)
    with pytest.raises(ShapeError):
        positive([1, 2], "x")


def test_signal_names():
    assert signal_names((), 2, "u", "inputs") == ("u1", "u2")
    assert signal_names("force", 1, "u", "inputs") == ("force",)
    assert signal_names(["die:z", "a b"], 2, "y", "outputs") == ("die:z", "a b")
    with pytest.raises(ShapeError, match="2 inputs need 2 names, got 1"):
        signal_names(["u"], 2, "u", "inputs")


@pytest.mark.parametrize("names", [["a.b"], ["-a"], [""], ["a", "b", "a"]])
def test_names_that_would_break_others_are_refused(names):
    with pytest.raises(LabelError):
        check_names(names, "inputs")

"""Files of values: exact, read-only, atomic, without pickle."""

from dataclasses import dataclass
from typing import Any

import numpy as np
import pytest
import scipy.sparse as sp
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra import numpy as hnp

from flexplant import DofSet, load
from flexplant.errors import FlexplantError
from flexplant.lti import StateSpace
from flexplant.store import Value


@dataclass(frozen=True, eq=False, repr=False)
class Parcel(Value):
    """Anything that can be stored."""

    content: Any

    def __post_init__(self):
        self._set(content=self.content)


@pytest.fixture(scope="module")
def path(tmp_path_factory):
    return tmp_path_factory.mktemp("store") / "value.npz"


SCALARS = st.one_of(
    st.none(), st.booleans(), st.integers(), st.floats(), st.text(), st.complex_numbers()
)
ITEMS = st.recursive(
    SCALARS,
    lambda inner: st.one_of(
        st.lists(inner, max_size=3),
        st.lists(inner, max_size=3).map(tuple),
        st.dictionaries(st.text(max_size=3), inner, max_size=3),
    ),
    max_leaves=6,
)


def same(a, b):
    """Equal, NaN included, types included; mappings are read-only ones afterwards."""
    if isinstance(a, dict):
        return list(a) == list(b) and all(same(a[k], b[k]) for k in a)
    if isinstance(a, list | tuple):
        return type(a) is type(b) and len(a) == len(b) and all(map(same, a, b))
    return type(a) is type(b) and repr(a) == repr(b)


@pytest.mark.slow
@given(ITEMS)
def test_scalars_and_containers_come_back(path, item):
    Parcel(item).save(path)
    assert same(item, load(path).content)


@given(hnp.arrays(st.sampled_from([float, complex, int, bool]), hnp.array_shapes(min_dims=0)))
def test_arrays_come_back_to_the_bit(path, array):
    Parcel(array).save(path)
    found = load(path).content
    assert found.dtype == array.dtype
    assert found.tobytes() == array.tobytes()
    assert not found.flags.writeable


def test_sparse_matrices_come_back(path):
    matrix = sp.random_array((7, 5), density=0.3, rng=np.random.default_rng(1), format="csc")
    Parcel(matrix).save(path)
    found = load(path).content
    assert found.format == "csc"
    assert found.shape == (7, 5)
    assert abs(found - matrix).max() == 0
    assert not found.data.flags.writeable


def test_values_inside_values(path):
    dofs = DofSet([1], ["z"], [[0, 0, 0]])
    system = StateSpace([[-1.0]], [[1]], [[1]], [[0]], inputs=["f"], outputs=["1:z"], dt=0.1)
    Parcel((dofs, {"system": system})).save(path)
    kept_dofs, kept = load(path).content
    assert kept_dofs.labels == ("1:z",)
    assert kept["system"].inputs == ("f",)
    assert kept["system"].dt == 0.1
    assert np.array_equal(kept["system"].A, system.A)


def test_numpy_scalars_become_plain_numbers(path):
    Parcel([np.float64(0.1), np.int64(3), np.bool_(True)]).save(path)
    assert load(path).content == [0.1, 3, True]


def test_files_of_others_are_refused(tmp_path):
    np.savez(tmp_path / "other.npz", a=np.ones(2))
    with pytest.raises(FlexplantError, match="not written by flexplant"):
        load(tmp_path / "other.npz")


def test_unknown_types_are_refused(path, monkeypatch):
    Parcel(1).save(path)
    monkeypatch.delitem(Value.registry, "Parcel")
    with pytest.raises(FlexplantError, match="lacks"):
        load(path)


def test_a_failed_save_leaves_the_old_file_and_no_rubbish(tmp_path, monkeypatch):
    target = tmp_path / "value.npz"
    Parcel(1).save(target)
    with pytest.raises(FlexplantError, match="cannot save a function"):
        Parcel(lambda: 0).save(target)
    assert load(target).content == 1

    def broken(*args, **arrays):
        raise OSError("disk full")

    monkeypatch.setattr(np, "savez_compressed", broken)
    with pytest.raises(FlexplantError, match=r"cannot be written \(disk full\): .* before is kept"):
        Parcel(2).save(target)
    assert load(target).content == 1
    assert [entry.name for entry in tmp_path.iterdir()] == ["value.npz"]


def test_no_pickle_in_the_file(path):
    Parcel({"a": np.arange(3)}).save(path)
    with np.load(path, allow_pickle=False) as file:
        for name in file.files:
            assert file[name].dtype != object

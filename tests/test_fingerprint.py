"""fingerprint: other values, another hash; the same values, the same hash."""

from functools import cached_property, partial

import numpy as np
import pytest
import scipy.sparse as sp

import flexplant as fx
from flexplant.errors import ModelError
from flexplant.fingerprints import fingerprint


class Machine:
    def __init__(self, value):
        self.value = value

    def run(self):
        return self.value


def made(kind, value):
    """Return what has a value inside."""
    return {
        "object": lambda: Machine(value),
        "method": lambda: Machine(value).run,
        "partial": lambda: partial(max, value),
        "list": lambda: [1, [value]],
        "array": lambda: np.array([1.0, value]),
        "object array": lambda: np.array([None, value], dtype=object),
        "sparse": lambda: sp.csr_array([[0.0, value]]),
        "keys": lambda: {value: 1},
        "set": lambda: {1, value},
        "Value": lambda: fx.chain(masses=[1.0, value], stiffnesses=[1.0]),
        "generator": lambda: np.random.default_rng(int(value)),
        "type": lambda: np.zeros(2, dtype=[("a", f"f{int(value)}")]),
        "name": lambda: (np.sin, np.cos)[value > 5],
    }[kind]()


KINDS = ("object", "method", "partial", "list", "array", "object array", "sparse", "keys", "set")
MORE = ("Value", "generator", "type", "name")


@pytest.mark.parametrize("kind", KINDS + MORE)
def test_values_count_by_their_contents(kind):
    assert fingerprint([made(kind, 4.0)]) == fingerprint([made(kind, 4.0)])
    assert fingerprint([made(kind, 4.0)]) != fingerprint([made(kind, 8.0)])


class Lazy:
    def __init__(self):
        self.mass = 2.0

    @cached_property
    def weight(self):
        return 9.81 * self.mass


def test_what_is_not_content_does_not_count():
    assert list({0, 8}) != list({8, 0})  # the order of a set hangs on how it was filled
    assert fingerprint([{0, 8}]) == fingerprint([{8, 0}])
    assert fingerprint([lambda x: x]) == fingerprint([lambda x: 2 * x])  # code does not count
    used = Lazy()
    assert used.weight > 0.0
    assert fingerprint([used]) == fingerprint([Lazy()])
    matrix = sp.csr_array([[0.0, 1.0]])
    before = fingerprint([matrix])
    assert matrix.has_canonical_format  # notes it in the matrix
    assert fingerprint([matrix]) == before
    assert len({fingerprint([item]) for item in (1, 1.0, True, "1", None, [1], (1,), {1})}) == 8


def test_a_value_inside_itself():
    ring = [1.0]
    ring.append(ring)
    other = [2.0]
    other.append(other)
    assert fingerprint([ring]) != fingerprint([other])


def test_what_has_no_contents_is_refused(tmp_path):
    with (tmp_path / "notes").open("w") as file:
        for item in (file, [{"log": file}], (x for x in range(3))):
            with pytest.raises(ModelError, match="cannot be compared"):
                fingerprint([item])
    deep = []
    for _ in range(10**4):
        deep = [deep]
    with pytest.raises(ModelError, match="too deeply"):
        fingerprint([deep])

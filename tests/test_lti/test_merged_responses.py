"""Measurements one after the other, as one: arrays put together by hand are the judge."""

import numpy as np
import pytest

from flexplant.errors import LabelError, ModelError
from flexplant.lti import Frf, merged_frf

F = np.array([1.0, 2.0, 5.0])
RNG = np.random.default_rng(5)
DATA = RNG.normal(size=(3, 2, 3)) + 1j * RNG.normal(size=(3, 2, 3))
VARIANCE = RNG.uniform(size=(3, 2, 3))
OUT, IN = ("1:z", "2:z", "9:rx"), ("hammer", "shaker")


def part(rows, columns, **others):
    at = np.ix_(rows, columns)
    names = {"outputs": [OUT[i] for i in rows], "inputs": [IN[j] for j in columns]}
    given = {"quantity": "acceleration", "variance": VARIANCE[at]} | others
    return Frf(F, DATA[at], **names, **given)


@pytest.mark.parametrize(
    "places",
    [
        [([0], [0, 1]), ([1, 2], [0, 1])],  # a sensor moved
        [([0, 1, 2], [0]), ([0, 1, 2], [1])],  # the hammer moved
        [([0], [0]), ([2, 1], [1]), ([1, 2], [0]), ([0], [1])],  # both
    ],
)
def test_each_pair_is_where_it_was_measured(places):
    found = merged_frf([part(*place) for place in places])
    assert sorted(found.outputs) == sorted(OUT) and sorted(found.inputs) == sorted(IN)
    for i, output in enumerate(OUT):
        for j, name in enumerate(IN):
            np.testing.assert_array_equal(found[output, name], DATA[i, j])
            at = found.outputs.index(output), found.inputs.index(name)
            np.testing.assert_array_equal(found.variance[at], VARIANCE[i, j])
    assert found.unit("9:rx", "hammer") == "rad/s^2/N" and found.quantity == "acceleration"


def test_errors_of_different_measurements_are_independent():
    R = np.eye(2)[:, :, None] + np.array([[0, 0.4j], [-0.4j, 0]])[:, :, None] * np.ones(3)
    parts = [
        part([0, 1], [0, 1], correlation=R, freedom=7.0),
        part([2], [0, 1], correlation=np.ones((1, 1, 3)), freedom=3.0),
    ]
    found = merged_frf(parts)
    wanted = np.eye(3, dtype=complex)
    wanted[:2, :2] = R[:, :, 0]
    np.testing.assert_array_equal(found.correlation[:, :, 1], wanted)
    assert found.freedom == 3.0
    assert merged_frf([parts[0], part([2], [0, 1])]).correlation is None
    assert merged_frf([part([0], [0, 1], variance=None), part([1], [0, 1])]).variance is None


def test_lengths_of_segments_that_differ_by_rounding_are_equal():
    found = merged_frf([part([0], [0], resolution=1.0), part([1], [0], resolution=1.0 + 1e-15)])
    assert found.resolution == 1.0
    with pytest.raises(ModelError, match=r"the resolution 2\.0, the first 1\.0"):
        merged_frf([part([0], [0], resolution=1.0), part([1], [0], resolution=2.0)])


def test_refusals():
    with pytest.raises(LabelError, match="hammer -> 1:z was measured more than once"):
        merged_frf([part([0], [0]), part([0, 1], [0])])
    with pytest.raises(LabelError, match=r"shaker -> 1:z was not measured.*merge the modes"):
        merged_frf([part([0], [0]), part([1], [0, 1])])
    with pytest.raises(ModelError, match="measurement 2 has other frequencies"):
        merged_frf([part([0], [0]), Frf(F[:2], DATA[1:2, :1, :2], IN[:1], OUT[1:2])])
    with pytest.raises(ModelError, match="measurement 2 has the quantity 'velocity'"):
        merged_frf([part([0], [0]), part([1], [0], quantity="velocity")])
    with pytest.raises(ModelError, match="at least one Frf"):
        merged_frf([])
    with pytest.raises(ModelError, match="measurement 2 has 'hammer' in V, another one in N"):
        merged_frf([part([0], [0], units={"hammer": "N"}), part([1], [0], units={"hammer": "V"})])

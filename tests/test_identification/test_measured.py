"""MeasuredModes: what is stored, and what is refused."""

import pickle

import numpy as np
import pytest

from flexplant import load
from flexplant.errors import LabelError, ModelError, ShapeError
from flexplant.identification import MeasuredModes

POLES = [-28.5 - 2870j, -39.3 + 3970j]


def test_either_sign_of_the_imaginary_part_is_stored_positive():
    measured = MeasuredModes(POLES, modes=[6, 7])
    assert measured.poles.tolist() == [-28.5 + 2870j, -39.3 + 3970j]
    assert measured.modes == (6, 7)
    assert len(measured) == 2
    assert not measured.poles.flags.writeable


def test_frequency_and_damping_are_those_of_the_pole():
    omega, zeta = 2 * np.pi * 455.0, 0.013
    pole = -zeta * omega + 1j * omega * np.sqrt(1 - zeta**2)
    measured = MeasuredModes([pole])
    assert measured.freq[0] == pytest.approx(455.0, rel=1e-14)
    assert measured.zeta[0] == pytest.approx(0.013, rel=1e-12)


def test_conjugating_a_pole_conjugates_its_covariance():
    C = np.array([[4.0, 1.0], [1.0, 2.0]])
    plus = MeasuredModes([-1 + 10j], covariance=C)
    minus = MeasuredModes([-1 - 10j], covariance=C)
    assert plus.covariance.tolist() == C.tolist()
    assert minus.covariance.tolist() == [[4.0, -1.0], [-1.0, 2.0]]


def test_variances_are_shared_by_real_and_imaginary_parts():
    measured = MeasuredModes(POLES, covariance=[2.0, 8.0])
    assert np.array_equal(measured.covariance, np.diag([1.0, 4.0, 1.0, 4.0]))


def test_value_survives_file_and_pickle(tmp_path):
    measured = MeasuredModes(POLES, modes=[6, 7], covariance=[2.0, 8.0])
    measured.save(tmp_path / "m.npz")
    for again in (load(tmp_path / "m.npz"), pickle.loads(pickle.dumps(measured))):
        assert again.modes == (6, 7)
        assert np.array_equal(again.poles, measured.poles)
        assert np.array_equal(again.covariance, measured.covariance)
        assert not again.poles.flags.writeable


def test_repr_is_one_line_without_arrays():
    text = repr(MeasuredModes([-1 + 100j * k for k in range(1, 10)], modes=range(4, 13)))
    assert text.startswith("<MeasuredModes: 9 poles, modes 4, 5, 6, 7, 8, 9, ... at 15.9")
    assert "\n" not in text
    assert "array" not in text


@pytest.mark.parametrize(
    ("poles", "error", "text"),
    [
        ([], ShapeError, "at least one"),
        ([[-1 + 1j]], ShapeError, "shape"),
        (-1 + 1j, ShapeError, "shape"),
        (["a"], ModelError, "hold numbers"),
        ([-1 + 10j, complex(np.nan, 1)], ModelError, r"index \(1\)"),
        ([complex(-1, np.inf)], ModelError, r"index \(0\)"),
        ([-5.0], ModelError, "overdamped"),
        ([0.0], ModelError, "rigid-body"),
        ([0.1 + 10j], ModelError, "unstable"),
        ([-1 + 10j, -2 + 9j, -1 - 10j], ModelError, "poles 0 and 2 are a conjugate pair"),
    ],
)
def test_bad_poles_are_refused(poles, error, text):
    with pytest.raises(error, match=text):
        MeasuredModes(poles)


@pytest.mark.parametrize(
    ("modes", "error", "text"),
    [
        ([6], ShapeError, "2 poles need 2"),
        (6, ShapeError, "2 poles need 2"),
        ([0, 6], LabelError, "from 1"),
        ([6.0, 7.0], LabelError, "whole numbers"),
        ([True, False], LabelError, "whole numbers"),
        ([6, 6], LabelError, r"modes \[6\] have more than one"),
    ],
)
def test_bad_mode_numbers_are_refused(modes, error, text):
    with pytest.raises(error, match=text):
        MeasuredModes(POLES, modes=modes)


@pytest.mark.parametrize(
    ("covariance", "error", "text"),
    [
        ([1.0], ShapeError, "covariance"),
        (np.eye(3), ShapeError, "covariance"),
        ([1.0, np.nan], ModelError, "NaN"),
        ([1.0, 0.0], ModelError, "positive definite"),
        (np.eye(4) + np.eye(4, k=1), ModelError, "symmetric"),
        (-np.eye(4), ModelError, "positive definite"),
    ],
)
def test_bad_covariance_is_refused(covariance, error, text):
    with pytest.raises(error, match=text):
        MeasuredModes(POLES, covariance=covariance)


@pytest.mark.parametrize("places", [5, "a", [True], [0.0], [0, 0], [3], []])
def test_places_that_are_none_are_refused(places):
    with pytest.raises((LabelError, ModelError), match="place"):
        MeasuredModes([-1 + 10j, -1 + 20j]).select(places)


def test_frequencies_and_dampings_with_their_deviations():
    """The covariance is that of many draws, and of differences; nonsense is refused."""
    f, z = np.array([100.0, 250.0]), np.array([0.02, 0.3])
    found = MeasuredModes.from_freq(f, z, modes=[4, 5], freq_std=[0.5, 1.0], zeta_std=0.004)
    np.testing.assert_allclose(found.freq, f, rtol=1e-14)
    np.testing.assert_allclose(found.zeta, z, rtol=1e-14)
    assert found.modes == (4, 5)
    rng = np.random.default_rng(0)
    draws = np.array([
        MeasuredModes.from_freq(f + [0.5, 1.0] * rng.standard_normal(2),
                                z + 0.004 * rng.standard_normal(2)).poles
        for _ in range(1500)
    ])  # fmt: skip
    wanted = np.cov(np.hstack([draws.real, draws.imag]).T)
    size = np.sqrt(np.outer(np.diag(wanted), np.diag(wanted)))
    assert np.abs((found.covariance - wanted) / size).max() < 0.12
    assert MeasuredModes.from_freq(100.0, 0.01).covariance is None
    with pytest.raises(ModelError, match=r"0\.01 is 1 %"):
        MeasuredModes.from_freq(f, [1.0, 2.0])
    with pytest.raises(ModelError, match="or neither"):
        MeasuredModes.from_freq(f, z, freq_std=1.0)


@pytest.mark.parametrize("seed", range(3))
def test_two_measurements_are_merged_by_mode_number(seed):
    rng = np.random.default_rng(seed)

    def drawn(numbers):
        m = len(numbers)
        root = rng.normal(size=(2 * m, 2 * m))
        poles = -rng.uniform(1.0, 9.0, m) + 1j * 100.0 * np.array(numbers)
        shapes = rng.normal(size=(3, m)) + 1j * rng.normal(size=(3, m))
        covariance = root @ root.T + np.eye(2 * m)
        labels = ["1:x", "2:x", "3:x"]
        return MeasuredModes(
            poles, modes=numbers, covariance=covariance, shapes=shapes, dofs=labels
        )

    low, high = drawn([4, 2, 3]), drawn([7, 3, 9, 5])
    both = low.merged(high)
    assert both.modes == (4, 2, 7, 3, 9, 5)
    for part, numbers in ((low, [2, 4]), (high, [3, 5, 7, 9])):
        own, other = (
            one.select([one.modes.index(number) for number in numbers]) for one in (both, part)
        )
        for name in ("poles", "covariance", "shapes"):
            np.testing.assert_array_equal(getattr(own, name), getattr(other, name))
    # the same DOFs in another order are the same DOFs
    turned = low.replace(shapes=low.shapes[::-1], dofs=low.dofs[::-1])
    np.testing.assert_array_equal(turned.merged(high).shapes, both.shapes)
    # errors of two measurements are independent
    apart = [0, 1, 6, 7], [2, 3, 4, 5, 8, 9, 10, 11]
    assert not np.any(both.covariance[np.ix_(*apart)])
    elsewhere = high.replace(dofs=("4:x", "5:x", "6:x"))
    assert low.merged(elsewhere).shapes is None
    assert low.merged(high.replace(covariance=None)).covariance is None
    with pytest.raises(ModelError, match="merged by their mode numbers, which one of them lacks"):
        low.merged(MeasuredModes(POLES))

"""Damping laws."""

import pickle

import numpy as np
import pytest

from flexplant.errors import ModelError, ShapeError
from flexplant.structure import ModalDamping, Rayleigh


def test_modal_damping():
    np.testing.assert_array_equal(ModalDamping(0.02).zeta([0, 1, 5]), [0, 0.02, 0.02])
    np.testing.assert_array_equal(ModalDamping([0.5, 0.1, 0.2]).zeta([0, 1, 5]), [0, 0.1, 0.2])
    assert repr(ModalDamping(0.01)) == "<ModalDamping 0.01>"
    assert repr(ModalDamping([0.01, 0.03])) == "<ModalDamping of 2 modes, 0.01 to 0.03>"
    assert pickle.loads(pickle.dumps(ModalDamping(0.01))).ratio == 0.01


def test_rayleigh():
    np.testing.assert_allclose(
        Rayleigh(alpha=3.0, beta=0.01).zeta([0.0, 2.0, 10.0]), [0, 0.75 + 0.01, 0.15 + 0.05]
    )
    assert repr(Rayleigh(1, 0)) == "<Rayleigh alpha 1 1/s, beta 0 s>"


@pytest.mark.parametrize("ratio", [-0.01, 1.0, np.nan, [0.1, 2.0], "a", 1j])
def test_bad_ratios(ratio):
    with pytest.raises(ModelError):
        ModalDamping(ratio)


def test_bad_shapes():
    with pytest.raises(ShapeError, match="one per mode"):
        ModalDamping([[0.1]])
    with pytest.raises(ShapeError, match="2 damping ratios for 3 modes"):
        ModalDamping([0.1, 0.1]).zeta([1, 2, 3])
    with pytest.raises(ShapeError):
        ModalDamping(0.1).zeta(3.0)
    with pytest.raises(ModelError):
        Rayleigh(-1, 0)
    with pytest.raises(ModelError):
        Rayleigh(0, np.nan)

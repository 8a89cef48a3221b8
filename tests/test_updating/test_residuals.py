"""Residuals: W of (12), and what is refused."""

import numpy as np
import pytest

from flexplant.errors import LabelError, ModelError, ShapeError
from flexplant.identification import MeasuredModes
from flexplant.updating import Eigenvalues

POLES = [-1 + 10j, -2 + 20j]


def test_weights_are_those_given_else_inverse_variance_else_one():
    plain = MeasuredModes(POLES, modes=[1, 2])
    known = MeasuredModes(POLES, modes=[1, 2], covariance=[0.5, 4.0])
    assert Eigenvalues(plain).W.tolist() == [1.0, 1.0]
    assert Eigenvalues(known).W.tolist() == [2.0, 0.25]
    assert Eigenvalues(known, weights=[3.0, 5.0]).W.tolist() == [3.0, 5.0]


def test_repr_names_modes_and_weights():
    known = MeasuredModes(POLES, modes=[1, 2], covariance=[0.5, 4.0])
    assert repr(Eigenvalues(known)) == "<Eigenvalues: modes 1, 2, weights 1/variance>"


def test_bad_input_is_refused():
    measured = MeasuredModes(POLES, modes=[1, 2])
    with pytest.raises(ModelError, match="MeasuredModes"):
        Eigenvalues(POLES)
    with pytest.raises(LabelError, match="mode numbers"):
        Eigenvalues(MeasuredModes(POLES))
    with pytest.raises(ShapeError, match="weights"):
        Eigenvalues(measured, weights=[1.0])
    with pytest.raises(ModelError, match="positive"):
        Eigenvalues(measured, weights=[1.0, 0.0])
    with pytest.raises(ModelError, match="NaN"):
        Eigenvalues(measured, weights=[1.0, np.nan])

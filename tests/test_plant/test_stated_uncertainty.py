"""Uncertainty of one's own making: by what share frequency and damping of modes may be off."""

from functools import cache

import numpy as np
import pytest

import flexplant as fx
from flexplant.errors import LabelError, ModelError
from stages import sampled, some_modes


@cache
def plant():
    return sampled(some_modes(1e-3, 8, attached=False))


def swing(one):
    """Frequency [rad/s] and damping ratio of each elastic mode, from the poles of A."""
    poles = np.linalg.eigvals(one.continuous.system.A)
    poles = poles[poles.imag > 1.0]
    poles = poles[np.argsort(np.abs(poles))]
    return np.abs(poles), -poles.real / np.abs(poles)


def test_delta_one_is_the_stated_share():
    omega, zeta = swing(plant())
    uncertain = plant().uncertain(frequency={4: 0.01, 6: 0.02}, damping={6: 0.3})
    assert [d.name for d in uncertain.deltas] == ["mode4:freq", "mode6:freq", "mode6:damping"]
    for sign in (-1.0, 1.0):
        moved = uncertain.lft({"mode4:freq": sign, "mode6:damping": sign})
        f, z = swing(moved)
        # the stiffness goes with the square of the frequency
        np.testing.assert_allclose(f[0] / omega[0], np.sqrt(1 + 0.02 * sign), rtol=1e-9)
        np.testing.assert_allclose(f[1:], omega[1:], rtol=1e-9)
        np.testing.assert_allclose(z[2] / zeta[2], 1 + 0.3 * sign, rtol=1e-6)


def test_one_number_is_for_all_elastic_modes_and_an_array_for_some():
    every = plant().uncertain(frequency=0.005, damping=0.3)
    assert sorted({d.mode for d in every.deltas}) == [4, 5, 6, 7, 8]
    assert {d.kind: d.scale for d in every.deltas} == {"freq": 0.01, "damping": 0.3}
    some = plant().uncertain(frequency=[0.01, 0.02], modes=[5, 7])
    assert {d.mode: d.scale for d in some.deltas} == {5: 0.02, 7: 0.04}


def test_draws_spread_as_stated():
    """At delta = 1 two standard deviations: nearly all draws lie within."""
    omega = swing(plant())[0]
    draws = plant().uncertain(frequency=0.005).sample(3, n=200)
    spread = np.array([swing(one)[0] for one in draws]) / omega - 1.0
    assert spread.std(axis=0) == pytest.approx(np.full(5, 0.0025), rel=0.2)
    # modes 7 and 8 are a pair, which the order of their poles makes alike
    several = np.corrcoef(spread[:, :4].T)[np.triu_indices(4, 1)]
    assert several == pytest.approx(np.zeros(6), abs=0.25)


@pytest.mark.parametrize(
    ("arguments", "error", "said"),
    [
        ({"frequency": 0.0}, ModelError, "nothing uncertain"),
        ({"frequency": -0.1}, ModelError, "0 or more, got -0.1"),
        ({"frequency": {99: 0.01}}, LabelError, "99"),
        ({"frequency": 0.01, "modes": [1]}, LabelError, "elastic mode of the plant"),
        ({"frequency": [0.01, 0.02]}, fx.FlexplantError, "frequency of a mode"),
        ({"damping": 1.5}, ModelError, "damping of mode 4"),
        ({}, ModelError, "frequency=0.005"),
    ],
)
def test_what_cannot_be_stated_is_refused(arguments, error, said):
    with pytest.raises(error, match=said):
        plant().uncertain(**arguments)


def test_a_fit_and_a_stated_share_exclude_each_other():
    measured = fx.MeasuredModes([-1 + 1500j], modes=[4], covariance=np.eye(2))
    with pytest.raises(ModelError, match="Pass one or the other"):
        plant().uncertain(measured, frequency=0.01)

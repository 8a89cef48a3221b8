"""What is drawn of an identification."""

import matplotlib as mpl

mpl.use("Agg")

import matplotlib.pyplot as plt
import numpy as np
import pytest

from flexplant.errors import ModelError
from flexplant.identification import identify_modes
from flexplant.lti import Frf
from flexplant.plot import identified, stabilisation
from oracles_identification import modal_frf, noisy, pole


def test_pictures_show_poles_and_responses():
    freq, phi = np.arange(20.0, 100.0, 0.2), np.array([[1.0, -1.0], [1.0, 0.5]])
    H = modal_frf(freq, pole([40.0, 70.0], [0.01, 0.01]), phi, phi)
    deviation = 1e-3 * np.abs(H).max()
    data = noisy(H, deviation, np.random.default_rng(0))
    frf = Frf(freq, data, variance=np.full(H.shape, deviation**2))
    found = identify_modes(frf, orders=range(2, 12))
    axes = stabilisation(found.diagram, frf=frf)
    drawn = sum(line.get_xdata().size for line in axes.lines)
    assert drawn == len(found.diagram)
    assert axes.get_xlim() == (freq[0], freq[-1])
    own = plt.figure().add_subplot()
    axes = identified(frf, found, "y1", "u2", ax=own)
    assert axes is own
    lines = {line.get_label(): line for line in axes.lines}
    assert np.allclose(
        lines["identified"].get_ydata(),
        np.abs(found.frf(lines["identified"].get_xdata())["y1", "u2"]),
    )
    assert np.allclose(lines["standard deviation"].get_ydata(), deviation)
    with pytest.raises(ModelError, match="diagram must be of type StabilisationDiagram"):
        stabilisation(frf)
    with pytest.raises(ModelError, match="modes must be of type IdentifiedModes"):
        identified(frf, frf, "y1", "u1")

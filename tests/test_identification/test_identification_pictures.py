"""What is drawn of an identification."""

import matplotlib as mpl

mpl.use("Agg")

import matplotlib.pyplot as plt
import numpy as np
import pytest
from matplotlib.backend_bases import MouseEvent

from flexplant.errors import ModelError
from flexplant.identification import identify_modes, stabilisation_diagram
from flexplant.lti import Frf
from flexplant.plot import PolePicker, identified, stabilisation
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


@pytest.mark.long
def test_poles_are_picked_by_mouse(tmp_path):
    """Three resonances: two clicks take two, one with the other button gives one back."""
    freq, phi = np.arange(20.0, 100.0, 0.2), np.array([[1.0, -1.0, 0.5], [1.0, 0.5, -1.0]])
    H = modal_frf(freq, pole([40.0, 55.0, 70.0], [0.01, 0.01, 0.01]), phi, phi)
    frf = Frf(freq, noisy(H, 1e-3 * np.abs(H).max(), np.random.default_rng(0)))
    picker = PolePicker(stabilisation_diagram(frf), frf)
    canvas = picker.figure.canvas
    canvas.draw()

    def click(ax, at, button=1):
        x, y = ax.transData.transform((at, np.mean(ax.get_ylim())))
        canvas.callbacks.process(
            "button_press_event", MouseEvent("button_press_event", canvas, x, y, button)
        )

    with pytest.raises(ModelError, match="no pole is picked"):
        _ = picker.selection
    top, below = picker.axes
    click(top, 40.3)
    click(below, 69.5)
    np.testing.assert_allclose(picker.modes.freq, [40.0, 70.0], rtol=1e-3)
    synthesised = {line.get_label(): line for line in below.lines}["of the poles picked"]
    wanted = np.abs(picker.modes.frf(synthesised.get_xdata()).data).sum(axis=(0, 1))
    shown = synthesised.get_ydata()
    np.testing.assert_allclose(shown / shown[0], wanted / wanted[0], rtol=1e-9)
    click(top, 88.0)  # there is none
    assert "no pole of its own within 3 % of [8" in picker.figure.get_suptitle()
    click(top, 55.2)
    click(top, 42.0, button=3)
    np.testing.assert_allclose(np.abs(picker.selection.poles) / 2 / np.pi, [55, 70], rtol=1e-3)
    assert "70.0" in picker.aside[0].texts[0].get_text()
    picker.figure.savefig(tmp_path / "picked.png")
    picker.pick(40.0)
    found = identify_modes(frf, start=picker.selection)
    np.testing.assert_allclose(found.freq, [40.0, 55.0, 70.0], rtol=1e-3)

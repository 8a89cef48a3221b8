"""One look for one thing, units with prefixes, and sensitivities of whatever one has."""

from itertools import pairwise

import matplotlib as mpl
import matplotlib.pyplot as plt
import numpy as np
import pytest

import flexplant as fx
from flexplant.errors import ModelError, in_unit
from flexplant.lti import inverse_sensitivity, tf
from flexplant.plot import CYCLE, STYLES
from flexplant.plot._axes import styles
from stages import reduced, sampled

PLANT = tf([1.0], [1.0, 1.0, 0.0])
CONTROLLER = (-6.0 * tf([0.5, 1.0], [0.02, 1.0])).replace(inputs=["out"], outputs=["in"])


def luminance(color):
    """Relative luminance (WCAG 2): what is left of a colour on a grey printer."""
    rgb = np.array(plt.matplotlib.colors.to_rgb(color))
    linear = np.where(rgb <= 0.04045, rgb / 12.92, ((rgb + 0.055) / 1.055) ** 2.4)
    return float(linear @ (0.2126, 0.7152, 0.0722))


def test_lines_differ_without_colour():
    """Any two of the table, and any two of the cycle, by dashes, by width or clearly in grey."""
    for looks in (list(STYLES.values()), CYCLE):
        for i, one in enumerate(looks):
            for other in looks[:i]:
                dark, light = sorted(luminance(look["color"]) for look in (one, other))
                usual = mpl.rcParams["lines.linewidth"]
                widths = [look.get("linewidth", usual) for look in (one, other)]
                ratio = max(widths) / min(widths)
                contrast = (light + 0.05) / (dark + 0.05)
                assert one["linestyle"] != other["linestyle"] or ratio > 1.5 or contrast > 1.8


def test_the_same_thing_looks_the_same_everywhere():
    g = fx.lti.low_pass_filter(10.0)
    freq = np.geomspace(1.0, 100.0, 30)
    clean = fx.frequency_response(g, freq)
    noisy = clean.replace(variance=np.full(clean.data.shape, 1e-6))
    named = {"a stage": noisy, "drawing": g, "updated": g, "reduced": g, "truth": g, "other": g}
    drawn = [
        {line.get_label(): line for line in ax.get_lines()}
        for ax in (
            fx.plot.bode(named, freq=freq),
            fx.plot.frf(named, "out", "in", freq=freq),
            fx.plot.singular_values(named, freq=freq),
            fx.plot.nyquist(named, freq=freq),
        )
    ]
    for lines in drawn:
        by_name = {str(label).split(":")[0]: line for label, line in lines.items()}
        colors = {name: by_name[name].get_color() for name in named}
        assert colors == {
            "a stage": "black",
            "drawing": STYLES["nominal"]["color"],
            "updated": STYLES["model"]["color"],
            "reduced": STYLES["reduced"]["color"],
            "truth": STYLES["truth"]["color"],
            "other": CYCLE[3]["color"],  # the first that no name has
        }
        assert by_name["a stage"].get_marker() == "."


@pytest.mark.parametrize(
    ("size", "unit", "shown"),
    [
        (1e-6, "m", (1e-6, "\N{MICRO SIGN}m")),
        (0.5, "kg", (1e-3, "g")),
        (30.0, "kg", (1.0, "kg")),
        (4e-18, "m^2", (1e-18, "nm^2")),
        (4e-5, "N m", (1e-6, "\N{MICRO SIGN}N m")),
        (0.02, "m/s^2", (1e-3, "mm/s^2")),
        (0.02, "%", (1.0, "%")),
        (0.02, "1/s", (1.0, "1/s")),
        (0.0, "m", (1.0, "m")),
        (3.0, None, (1.0, "")),
        (np.nan, "m", (1.0, "m")),
    ],
)
def test_prefixes(size, unit, shown):
    factor, text = in_unit(size, unit)
    assert text == shown[1]
    assert factor == pytest.approx(shown[0], rel=1e-12, abs=0)


def test_a_band_is_drawn_to_its_own_scale():
    freq = np.geomspace(0.1, 1e4, 400)
    ax = fx.plot.frf(
        {"model": fx.lti.low_pass_filter(10.0)}, "out", "in", freq=freq, band=(100.0, 1e3)
    )
    line = ax.get_lines()[0]
    assert min(line.get_xdata()) >= 100.0 and max(line.get_xdata()) <= 1e3
    assert -45.0 < ax.get_ylim()[0] < -40.0 and -20.0 < ax.get_ylim()[1] < -15.0
    with pytest.raises(ModelError, match=r"no frequency from 20000 to 30000 Hz"):
        fx.plot.frf(
            {"model": fx.lti.low_pass_filter(10.0)}, "out", "in", freq=freq, band=(2e4, 3e4)
        )


def size_of(response):
    return 20 * np.log10(np.linalg.svd(np.moveaxis(response.data, 2, 0), compute_uv=False)[:, 0])


def test_a_sensitivity_of_a_pair_an_frf_or_a_line():
    pair = (PLANT, CONTROLLER)
    S = fx.loop.sensitivity(pair)
    for given in (pair, S, (S.freq, np.abs(S.data[0, 0]))):
        line = fx.plot.sensitivity(given).get_lines()[0]
        np.testing.assert_allclose(line.get_ydata(), size_of(S), rtol=1e-9, atol=1e-9)
    for wrong in ("servo", {}, 3.0):
        with pytest.raises(ModelError, match=r"need a ClosedLoop|is empty"):
            fx.plot.sensitivity(wrong)


def test_three_sensitivities_under_their_weights():
    weights = {"S": inverse_sensitivity(0.5), "KS": 0.05}
    ax = fx.plot.sensitivities({"lead": (PLANT, CONTROLLER)}, weights=weights)
    S, T, KS = ax.figure.axes
    freq = S.get_lines()[0].get_xdata()
    s = 2j * np.pi * freq
    K = 6.0 * (0.5 * s + 1) / (0.02 * s + 1)
    L = K / (s * (s + 1))
    for panel, truth in ((S, 1 / (1 + L)), (T, L / (1 + L)), (KS, K / (1 + L))):
        line = panel.get_lines()[0]
        assert (line.get_label() == "lead") == (panel is S)
        np.testing.assert_allclose(line.get_ydata(), 20 * np.log10(np.abs(truth)), atol=1e-6)
    bound = KS.get_lines()[1]
    assert bound.get_label() == "1 / |W| of KS"
    np.testing.assert_allclose(bound.get_ydata(), 20 * np.log10(20.0))
    assert len(T.get_lines()) == 3  # T and two levels: it has no weight
    assert [panel.get_ylabel() for panel in (S, KS)] == ["|S| [dB]", "|KS| [dB, 0 dB = 1]"]
    with pytest.raises(ModelError, match="weights are of S, T, KS"):
        fx.plot.sensitivities((PLANT, CONTROLLER), weights={"W": 1.0})
    with pytest.raises(ModelError, match="three axes"):
        fx.plot.sensitivities((PLANT, CONTROLLER), ax=plt.subplots(2)[1])


@pytest.mark.slow
def test_up_to_half_the_rate_the_axes_stay_readable():
    """T of a sampled loop is zero there: the axis ends where curves can be read."""
    plant = sampled(reduced())
    loop = fx.close_loop(plant, fx.design_static(plant), fx.design_servo(plant, bandwidth=30.0))
    T = fx.loop.complementary_sensitivity(loop, freq=np.geomspace(1.0, 5e3, 500))
    assert size_of(T).min() < -160.0
    panels = fx.plot.sensitivities(loop, freq=np.asarray(T.freq)).figure.axes
    assert panels[1].get_ylim()[0] > -140.0
    assert fx.plot.sensitivity(T).get_ylim()[0] > -140.0


def test_what_is_named_keeps_its_colour_for_itself():
    for labels in (["model", "servo"], ["full model", "Guyan", "Irs", "Rubin"], ["a", "b"]):
        drawn = styles(labels)
        assert len({one["color"] for one in drawn}) == len(labels), labels


def test_decades_are_read_as_numbers():
    """Ticks of 20 to 400 Hz have numbers that do not overlap; no powers of ten."""
    freq = np.geomspace(20.0, 400.0, 50)
    ax = fx.plot.sensitivity({"S": (freq, freq / 100.0)}, ax=plt.subplots(figsize=(6, 4))[1])
    ax.set_xlim(20.0, 400.0)
    ax.figure.canvas.draw()
    shown = [one for one in ax.get_xticklabels(which="both") if one.get_text()]
    places = sorted((float(one.get_text()), one.get_window_extent()) for one in shown)
    inside = [(x, box) for x, box in places if 20.0 <= x <= 400.0]
    assert {20.0, 100.0, 200.0, 400.0} <= {x for x, _ in inside}
    for (_, left), (_, right) in pairwise(inside):
        assert left.x1 < right.x0

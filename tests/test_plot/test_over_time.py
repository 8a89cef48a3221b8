"""Steps, exposures, spectra and innovations: what is drawn is what the numbers say."""

import matplotlib.pyplot as plt
import numpy as np
import pytest
from scipy import stats

import flexplant as fx
from flexplant.errors import LabelError, ModelError
from flexplant.estimation import Estimate, Filter
from flexplant.loop import Spectrum
from flexplant.lti import tf
from flexplant.simulation import Response, exposure_errors

LAG = tf([9.0], [1.0, 0.6, 9.0])


def test_a_step_is_the_textbooks():
    """1 - e^(-zeta w t) (cos w_d t + zeta w / w_d sin w_d t), until 1 % is left of it."""
    ax = fx.plot.step({"lag": LAG, "held": fx.lti.discretized(LAG, 5.0)})
    exact, held = ax.get_lines()
    time = np.asarray(exact.get_xdata())
    assert ax.get_xlabel() == "time [s]"
    assert time[-1] == pytest.approx(np.log(100) / 0.3, rel=1e-3)
    damped = np.sqrt(9.0 - 0.09)
    decay = np.exp(-0.3 * time)
    wanted = 1 - decay * (np.cos(damped * time) + 0.3 / damped * np.sin(damped * time))
    np.testing.assert_allclose(exact.get_ydata(), wanted, atol=1e-9)
    assert held.get_drawstyle() == "steps-post"
    at = np.searchsorted(time, held.get_xdata()[:50])
    np.testing.assert_allclose(
        np.interp(time[at], held.get_xdata(), held.get_ydata()), wanted[at], atol=0.1
    )


def test_steps_of_several_channels():
    g = fx.lti.append(
        LAG, fx.lti.low_pass_filter(100.0).replace(inputs=["r"], outputs=["y"])
    ).replace(inputs=["f", "r"], outputs=["x", "y"], units={"f": "N", "x": "m"})
    ax = fx.plot.step(1e-6 * g, duration=0.05)
    labels = [panel.get_ylabel() for panel in ax.figure.axes]
    assert (labels[0], labels[3]) == ("x [nm]", "y")
    titles = [panel.get_title() for panel in ax.figure.axes]
    assert titles == ["step of 1 N at f", "step of 1 at r", "", ""]
    assert ax.figure.axes[3].get_xlabel() == "time [ms]"
    with pytest.raises(LabelError, match="f9"):
        fx.plot.step(g, inputs="f9")
    with pytest.raises(ModelError, match="takes 1 axes, for one channel"):
        fx.plot.step(g, ax=plt.subplots()[1])
    for wrong in ("a", {}):
        with pytest.raises(ModelError, match=r"need a system|is empty"):
            fx.plot.step(wrong)


def some_run():
    rng = np.random.default_rng(3)
    time = np.arange(2000) * 1e-4
    error = 5e-6 * np.exp(-time / 0.01) + 3e-9 * rng.standard_normal(2000)
    return Response(time, error[None], ["die:error"], {"die:error": "m"})


def test_exposures_show_the_figures_of_their_windows():
    run, windows = some_run(), [[0.1, 0.12], [0.15, 0.17]]
    ax = fx.plot.exposures(run, window=2e-3, exposures=windows)
    error, average, deviation = ax.get_lines()[:3]
    np.testing.assert_allclose(error.get_ydata(), 1e9 * run["die:error"])
    np.testing.assert_allclose(
        average.get_ydata(), 1e9 * run.moving_average("die:error", window=2e-3)
    )
    largest = exposure_errors(run, window=2e-3, exposures=windows)["die:error"]
    assert average.get_label() == f"MA, at most {1e9 * largest.ma:.3g} nm"
    assert deviation.get_label() == f"MSD, at most {1e9 * largest.msd:.3g} nm"
    spans = [(p.get_x(), p.get_x() + p.get_width()) for p in ax.patches]
    np.testing.assert_allclose(spans, [[100, 120], [150, 170]])
    assert ax.get_ylabel() == "error [nm]" and ax.get_ylim()[1] < 100.0
    shaded = fx.plot.response(run, exposures=windows)
    assert len(shaded.patches) == 2
    with pytest.raises(ModelError, match="not within the run"):
        fx.plot.exposures(run, exposures=[[0.1, 0.3]])
    with pytest.raises(LabelError, match="no error"):
        fx.plot.exposures(Response([0.0, 0.1], [[1.0, 2.0]], ["u1"]))


def test_spectra_side_by_side():
    freq = np.array([0.0, 1.0, 10.0, 100.0])
    density = np.array([0.0, 4e-18, 1e-18, 1e-20])
    ax = fx.plot.spectra({"model": Spectrum(freq, density)}, unit="m")
    np.testing.assert_allclose(ax.get_lines()[0].get_ydata(), [2.0, 1.0, 0.1])
    assert ax.get_ylabel() == "amplitude spectral density [nm/\N{SQUARE ROOT}Hz]"
    run = Response(np.arange(64) * 1e-3, np.eye(64)[:1], ["e"], {"e": "m"})
    ax = fx.plot.spectra({"run": run}, "e")
    assert ax.get_ylabel().endswith("m/\N{SQUARE ROOT}Hz]")
    np.testing.assert_allclose(ax.get_lines()[0].get_xdata(), run.psd("e").freq[1:])
    for wrong in ({}, 1.0, {"a": (freq, density)}, run):
        with pytest.raises(ModelError, match=r"is empty|a loop, a run|which signal"):
            fx.plot.spectra(wrong)


def estimate_of(white):
    """An estimate whose innovations are given; what is not drawn is zero."""
    count, sensors = white.shape
    zero = np.zeros((1, count))
    return Estimate(
        time=1e-3 * np.arange(count), names=["die:hat"], data=zero, deviations=zero,
        sensors=[f"y{i}" for i in range(sensors)], innovations=white.T,
        innovation_deviations=np.ones((sensors, count)), whitened=white.T, lag=Filter(),
        state=np.zeros(1),
    )  # fmt: skip


@pytest.mark.slow
def test_innovations_beside_their_bounds():
    """White innovations stay inside; larger ones leave the first panel, coloured ones the rest."""
    white = np.random.default_rng(5).standard_normal((6000, 2))
    coloured = np.sqrt(0.75) * np.array([white[1:] + 0.5 * white[:-1]])[0] / np.sqrt(1.25 * 0.75)
    inside = {}
    for name, one in (("white", white), ("large", 1.3 * white), ("coloured", coloured)):
        panels = fx.plot.consistency(estimate_of(one)).figure.axes
        for k, panel in enumerate(panels):
            lines = panel.get_lines()
            bounds = [np.ravel(line.get_ydata())[0] for line in lines if len(line.get_ydata()) == 2]
            points = np.concatenate(
                [line.get_ydata() for line in lines if len(line.get_ydata()) > 2]
            )
            inside[name, k] = np.mean((points > min(bounds)) & (points < max(bounds)))
    assert inside["white", 0] > 0.88 and inside["white", 1] > 0.9 and inside["white", 2] == 1.0
    assert inside["large", 0] < 0.05
    assert inside["coloured", 2] < 0.5
    lag = fx.plot.consistency(estimate_of(coloured)).figure.axes[1].get_lines()[0]
    assert lag.get_ydata()[0] == pytest.approx(0.4, abs=0.05)
    nis = fx.plot.consistency(estimate_of(white), level=0.9).figure.axes[0]
    top = max(np.ravel(line.get_ydata())[0] for line in nis.get_lines()[1:])
    assert top == pytest.approx(stats.chi2.ppf(0.95, 200) / 200, rel=1e-12)
    with pytest.raises(ModelError, match="at least 200 samples"):
        fx.plot.consistency(estimate_of(white[:50]))
    with pytest.raises(ModelError, match="Pass what observer"):
        fx.plot.consistency(white)

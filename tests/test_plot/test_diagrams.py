"""Bode, Nyquist, singular values, poles: what is drawn is what was given."""

import matplotlib.pyplot as plt
import numpy as np
import pytest
from scipy import signal

import flexplant as fx
from flexplant.errors import LabelError, ModelError
from flexplant.lti import tf
from systems_lti import machine, system

LAG = tf([1.0], [1.0, 1.0, 4.0])


def test_bode_is_that_of_scipy():
    freq = np.geomspace(0.01, 10.0, 50)
    ax = fx.plot.bode(LAG, freq=freq)
    _, size, phase = signal.bode(([1.0], [1.0, 1.0, 4.0]), 2 * np.pi * freq)
    first, second = ax.figure.axes
    np.testing.assert_allclose(first.get_lines()[0].get_ydata(), size, rtol=1e-9)
    np.testing.assert_allclose(second.get_lines()[0].get_ydata(), phase, atol=1e-9)
    assert (second.get_xlabel(), second.get_ylabel()) == ("frequency [Hz]", "phase [deg]")


def test_measured_phases_follow_the_model_by_whole_turns():
    delayed = fx.lti.series(LAG, fx.lti.pade(0.3, order=6))
    found = fx.frequency_response(delayed, np.geomspace(0.1, 3.0, 40))
    measured = found.replace(variance=np.full(found.data.shape, 1e-6))
    ax = fx.plot.bode({"measured": measured, "model": delayed})
    phase = ax.figure.axes[1]
    model, points = phase.get_lines()
    assert points.get_linestyle() == "None"
    wanted = np.interp(found.freq, model.get_xdata(), model.get_ydata())
    assert np.abs(points.get_ydata() - wanted).max() < 2.0
    assert np.asarray(points.get_ydata()).min() < -360.0


@pytest.mark.slow
def test_a_grid_of_channels_and_its_refusals():
    g = system()
    ax = fx.plot.bode({"one": g, "two": 2 * g}, outputs=["out1", "out0"], inputs="in2")
    panels = ax.figure.axes
    assert [p.get_ylabel() for p in panels[::2]] == [
        f"|out{i} / in2| [dB, 0 dB = 1]" for i in (1, 0)
    ]
    one, two = panels[2].get_lines()
    assert np.interp(1.0, two.get_xdata(), two.get_ydata()) == pytest.approx(
        np.interp(1.0, one.get_xdata(), one.get_ydata()) + 20 * np.log10(2), abs=1e-6
    )
    with pytest.raises(LabelError, match="in9"):
        fx.plot.bode(g, inputs=["in9"])
    with pytest.raises(ModelError, match=r"more than can be read"):
        fx.plot.bode(machine(2, 2, m=7, p=7))
    with pytest.raises(ModelError, match="one channel; got 2 axes and 6 channels"):
        fx.plot.bode(g, ax=plt.subplots(2)[1])
    with pytest.raises(ModelError, match="need a system"):
        fx.plot.bode("servo")
    with pytest.raises(ModelError, match="list is empty"):
        fx.plot.bode({})


def test_a_zero_at_half_the_rate_does_not_draw_the_axis_down():
    ax = fx.plot.bode(fx.lti.tustin(LAG, 50.0), freq=np.r_[np.geomspace(0.1, 24.0, 50), 25.0])
    assert min(ax.get_lines()[0].get_ydata()) < -180
    low, high = ax.get_ylim()
    assert high - low < 200


@pytest.mark.slow
def test_nyquist_names_the_distance_from_minus_one():
    L = 20.0 * tf([1.0, 1.0], [1.0, 0.0, 0.0]) * tf([1.0], [0.02, 1.0])
    ax = fx.plot.nyquist({"servo": L})
    freq = np.geomspace(1e-2, 1e3, 20001)
    worst = max(-20 * np.log10(abs(1 + L(2j * np.pi * f))) for f in freq)
    assert ax.get_legend().get_texts()[0].get_text().startswith(f"servo: |S| up to {worst:.1f} dB")
    (circle, unit) = ax.patches
    assert (circle.center, circle.radius, unit.radius) == ((-1, 0), 0.5, 1.0)
    assert ax.get_aspect() == 1.0
    with pytest.raises(ModelError, match=r"has 6 channels: choose one"):
        fx.plot.nyquist(system())
    with pytest.raises(LabelError, match="no channel"):
        fx.plot.nyquist(L, channel=("x", "y"))


def test_nyquist_of_a_measured_gain_follows_the_resonance_between_its_lines():
    """Lines of 0.5 Hz over a mode of half-width 0.07 Hz: the circle, not the chord."""
    body, mode = tf([1.0], [1.0, 0.0, 0.0]), tf([-1.5e-3], [1.0, 0.001 * 860.8, 860.8**2])
    L = (2 * np.pi * 20.0) ** 2 * tf([0.02, 1.0], [1e-4, 1.0]) * (body + mode)
    frf = fx.lti.frequency_response(L, np.arange(1.0, 400.0, 0.5) + 0.2)
    labels = []
    for one in (L, frf):
        ax = fx.plot.nyquist({"L": one})
        labels.append(float(ax.get_legend().get_texts()[0].get_text().split()[4]))
    assert labels[1] == pytest.approx(labels[0], abs=0.3)
    on_lines = -20 * np.log10(np.abs(1 + frf.data).min())
    assert labels[0] > on_lines + 1.0


def test_nyquist_of_a_closed_loop_is_broken_at_each_actuator():
    plant = fx.testbeds.three_masses()
    observer = fx.design_kalman(plant)
    loop = fx.close_loop(plant, observer, fx.design_servo(plant, bandwidth=20.0, observer=observer))
    line = fx.plot.nyquist(loop, freq=[5.0, 20.0]).get_lines()[0]
    assert line.get_label().startswith("u1: |S| up to ")
    L = fx.loop.loop_gain(loop, freq=[5.0, 20.0])["u1", "u1"]
    np.testing.assert_allclose(line.get_xdata() + 1j * line.get_ydata(), -L, rtol=1e-9)


def test_singular_values():
    g = system()
    freq = np.geomspace(0.1, 10.0, 20)
    high, low = fx.plot.singular_values(g, freq=freq).get_lines()
    sizes = np.array([np.linalg.svd(g(2j * np.pi * f), compute_uv=False) for f in freq])
    np.testing.assert_allclose(high.get_ydata(), 20 * np.log10(sizes[:, 0]), rtol=1e-9)
    np.testing.assert_allclose(low.get_ydata(), 20 * np.log10(sizes[:, 1]), rtol=1e-9)
    of_rank_one = fx.StateSpace([[-1.0]], [[1.0, 2.0]], [[1.0], [3.0]], 0)
    assert len(fx.plot.singular_values(of_rank_one, freq=freq).get_lines()) == 1


@pytest.mark.slow
def test_systems_may_stand_in_a_list():
    g = system()
    for draw in (fx.plot.bode, fx.plot.singular_values, fx.plot.step, fx.plot.pole_map):
        legends = [ax.get_legend() for ax in draw([g, 2.0 * g]).figure.axes]
        words = [text.get_text() for one in legends if one for text in one.get_texts()]
        assert [w.startswith("system 1") for w in words].count(True) == 1, draw.__name__
        with pytest.raises(ModelError, match="list is empty"):
            draw([])


@pytest.mark.slow
@pytest.mark.parametrize("rate", [0.0, 1e4])
def test_poles_by_frequency_and_damping(rate):
    g = machine(n_rigid=1, n_elastic=4, m=1, p=1)
    ax = fx.plot.pole_map({"stage": fx.lti.discretized(g, rate) if rate else g}, zeros=True)
    poles, wrong = ax.get_lines()[:2]
    np.testing.assert_allclose(np.sort(poles.get_xdata()), np.linspace(245.0, 3700.0, 4), rtol=1e-6)
    np.testing.assert_allclose(poles.get_ydata(), 1e-3, rtol=1e-5)
    assert not len(wrong.get_xdata())
    labels = [text.get_text() for text in ax.get_legend().get_texts()]
    assert labels[0] == "stage poles, 2 more at 0 Hz"
    unstable = tf([1.0], [1.0, -2.0, 100.0])
    assert np.asarray(fx.plot.pole_map(unstable).get_lines()[1].get_ydata()) == pytest.approx(
        [-0.1]
    )


def test_a_root_locus_goes_through_the_closed_loops_poles():
    """Every curve ends at the eigenvalues of A - k B C at the largest gain, lightly damped too."""
    g = fx.lti.series(
        fx.lti.tf([1.0, 0.002, 1.1], [1.0, 0.002, 1.0]), fx.lti.tf([1.0, 0.2], [1.0, 3.0, 0.0])
    )
    ax = fx.plot.root_locus(g, gains=[0.5, 1.0, 2.0])
    paths = ax.get_lines()[: g.n_states]
    for i, k in enumerate((0.5, 1.0, 2.0), 1):
        drawn = [line.get_xdata()[i] + 1j * line.get_ydata()[i] for line in paths]
        exact = np.roots(
            np.polyadd(
                np.polymul([1.0, 0.002, 1.0], [1.0, 3.0, 0.0]),
                k * np.polymul([1.0, 0.002, 1.1], [1.0, 0.2]),
            )
        )
        np.testing.assert_allclose(np.sort_complex(drawn), np.sort_complex(exact), atol=1e-9)
    with pytest.raises(fx.FlexplantError, match="no root locus"):
        fx.plot.root_locus(fx.StateSpace([], [], [], [[1.0]]))

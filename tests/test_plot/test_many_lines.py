"""Many lines: each in a panel or named at its end; what stands beside a magnitude; device maps."""

import matplotlib.pyplot as plt
import numpy as np
import pytest
from matplotlib.colors import to_hex
from matplotlib.text import Annotation

import flexplant as fx
from flexplant.errors import LabelError, ModelError

SIX = ("fx1", "fx2", "fy1", "fz1", "fz2", "fz3")
L = (0.4, 0.3, 0.05)


def run_of(names, unit="N"):
    time = 1e-3 * np.arange(200)
    data = np.array([10.0**-k * np.sin(60 * time + k) for k in range(len(names))])
    return fx.Response(time, data, names, dict.fromkeys(names, unit))


def systems(count):
    return {f"case {k}": fx.lti.low_pass_filter(10.0 * 1.4**k) for k in range(1, count + 1)}


def test_six_forces_are_all_seen():
    """Each in a panel with its name and the unit that brings it to 1 .. 1000; four share one."""
    run = run_of(SIX)
    axs = fx.plot.response(run, SIX).figure.axes
    assert [ax.get_title(loc="left") for ax in axs] == list(SIX)
    factor = {"force [N]": 1.0, "force [mN]": 1e3, "force [µN]": 1e6}
    for ax, name in zip(axs, SIX, strict=True):
        (line,) = ax.get_lines()
        np.testing.assert_allclose(line.get_ydata(), factor[ax.get_ylabel()] * run[name])
        assert 0.1 < np.max(line.get_ydata()) < 1000
    assert [bool(ax.get_xlabel()) for ax in axs] == [False] * 4 + [True] * 2
    together = fx.plot.response(run, SIX[:4])
    assert len(together.figure.axes) == 1 and len(together.get_lines()) == 4


def test_loop_gains_and_sensitivities_of_six_axes():
    """The same six curves, one a panel, with the peak of 1 / (1 + L) in its name."""
    freq = np.geomspace(0.1, 100.0, 400)
    gains = {name: fx.lti.tf([20.0 + k], [1.0, 2.0, 0.0]) for k, name in enumerate(SIX)}
    axs = fx.plot.nyquist(gains, freq=freq).figure.axes
    s = 2j * np.pi * freq
    S = {n: np.abs(1 / (1 + (20.0 + k) / (s**2 + 2 * s))) for k, n in enumerate(SIX)}
    for ax, (name, size) in zip(axs, S.items(), strict=True):
        assert ax.get_title(loc="left").startswith(f"{name}: up to {20 * np.log10(size.max()):.1f}")
        assert ax.get_xlim() == ax.get_ylim() == (-2.5, 2.5)
    axs = fx.plot.sensitivity({name: (freq, size) for name, size in S.items()}).figure.axes
    assert len(axs) == 6
    for ax, size in zip(axs, S.values(), strict=True):
        np.testing.assert_allclose(ax.get_lines()[0].get_ydata(), 20 * np.log10(size))


@pytest.mark.slow
def test_more_lines_than_looks_are_named_at_their_ends():
    ax = fx.plot.frf(systems(9), "out", "in", freq=np.geomspace(1.0, 1e3, 100))
    colours = [to_hex(line.get_color()) for line in ax.get_lines()]
    assert len(set(colours)) == 9 and ax.get_legend() is None
    texts = [one for one in ax.texts if isinstance(one, Annotation)]
    assert {one.get_text() for one in texts} == set(systems(9))
    assert {one.get_text(): to_hex(one.get_color()) for one in texts} == dict(
        zip(systems(9), colours, strict=True)
    )
    ax.figure.draw_without_rendering()
    boxes = sorted((one.get_tightbbox().bounds for one in texts), key=lambda b: b[1])
    places = sorted(one.get_position()[1] for one in texts)
    height = ax.get_window_extent().height
    assert np.all(np.diff(places) * height > 0.9 * plt.rcParams["font.size"]) and len(boxes) == 9
    # names lie in the order in which the lines end: a higher corner ends higher
    order = sorted(texts, key=lambda one: one.get_position()[1])
    assert [one.get_text() for one in order] == list(systems(9))


def test_a_phase_within_half_a_turn():
    """As an analyser draws it, whatever has been wound up; the line is broken at the jumps."""
    freq = np.geomspace(1.0, 1e3, 500)
    g = (
        fx.lti.low_pass_filter(30.0, order=2)
        * fx.lti.low_pass_filter(20.0, order=2)
        * fx.lti.low_pass_filter(10.0)
    )
    response = fx.frequency_response(g, freq)["out", "in"]
    _, phase = fx.plot.bode(g, freq=freq, wrap=True).figure.axes
    drawn = phase.get_lines()[0].get_ydata()
    known = np.isfinite(drawn)
    np.testing.assert_allclose(drawn[known], np.degrees(np.angle(response))[known], atol=1e-9)
    assert np.nanmax(np.abs(drawn)) <= 180.0 and np.count_nonzero(~known) == 1
    unwound = fx.plot.bode(g, freq=freq).figure.axes[1].get_lines()[0].get_ydata()
    assert unwound.min() < -400.0


def test_phase_coherence_and_deviation_beside_a_magnitude():
    freq = np.geomspace(1.0, 1e3, 60)
    clean = fx.frequency_response(fx.lti.low_pass_filter(30.0), freq)
    frf = clean.replace(
        coherence=np.linspace(0.2, 1.0, 60)[None, None], variance=np.full((1, 1, 60), 1e-6)
    )
    also = ("phase", "coherence", "deviation")
    shown = {"measured": frf, "model": clean}
    top, phase, coherence = fx.plot.frf(shown, "out", "in", also=also, band=(2, 900)).figure.axes
    inside = (freq >= 2) & (freq <= 900)
    lines = {line.get_label(): line for line in top.get_lines()}
    np.testing.assert_allclose(lines["standard deviation of measured"].get_ydata(), -60.0)
    angle = np.degrees(np.angle(clean.data[0, 0, inside]))
    for line in phase.get_lines():
        np.testing.assert_allclose(line.get_ydata(), angle)
    (line,) = coherence.get_lines()
    np.testing.assert_allclose(line.get_ydata(), frf.coherence[0, 0, inside])
    assert coherence.get_ylim()[0] == 0.0 and coherence.get_xlabel() == "frequency [Hz]"
    with pytest.raises(ModelError, match="none of the responses has a coherence: model"):
        fx.plot.frf({"model": clean}, "out", "in", also="coherence")
    with pytest.raises(LabelError, match="'colour'"):
        fx.plot.frf(shown, "out", "in", also="colour")
    with pytest.raises(ModelError, match="need separate panels"):
        fx.plot.frf(shown, "out", "in", also="phase", ax=top)


@pytest.mark.slow
def test_many_parameters_are_one_figure():
    modes = fx.solve_modes(fx.chain(masses=[1.0] * 4, stiffnesses=[4e5, 5e5, 6e5]), count=4)
    drawing = fx.reduce(modes, fx.DesiredDofs([f"{k}:x" for k in range(1, 5)]))
    omega = 1.02 * modes.omega[1:]
    measured = fx.MeasuredModes(1j * omega, modes=[2, 3, 4], covariance=(1e-2 * omega) ** 2)
    unknowns = [fx.AddedMass(f"{k}:x", prior=(0.0, 0.1)) for k in range(1, 5)]
    unknowns += [fx.AddedStiffness(f"{k}:x", prior=(0.0, 1e3)) for k in range(1, 3)]
    fit = fx.update(drawing, unknowns, [fx.Eigenvalues(measured)])
    axs = fx.plot.parameters(fit)
    assert len({ax.figure for ax in axs}) == 1 and len(axs) == 6
    assert [ax.get_title(loc="left") for ax in axs] == list(fit.parameters)
    for ax, values in zip(axs, fit.history.parameters.T, strict=True):
        drawn = ax.get_lines()[0].get_ydata()
        size = np.max(np.abs(values))
        np.testing.assert_allclose(drawn / np.max(np.abs(drawn)), values / size, atol=1e-12)


def stage():
    block = fx.solid_block(
        size=L, elements=(4, 3, 1), density=2700, youngs_modulus=70e9, poisson_ratio=0.33
    )
    modes = fx.solve_modes(block, count=8, damping=fx.ModalDamping(0.005))
    y = [
        fx.Sensor("ez", at=(0.1, 0.1, 0.05), direction="z", asd=1e-11),
        fx.Sensor("ex", at=(0.4, 0.1, 0.05), direction="x", asd=1e-11),
    ]
    u = [fx.Actuator("fz", at=(0.3, 0.1, 0.0), direction="z")]
    poi = fx.Poi("wafer", at=(0.2, 0.15, 0.05), axes=("x", "z"))
    return fx.assemble_plant(modes, fx.Ports(u=u, y=y, z=[poi]))


def test_devices_from_above_and_below():
    """What is in the lower half is drawn from below: x runs to the left there; arrows along x."""
    above, below = fx.plot.placed(stage()).figure.axes
    assert {one.get_text() for one in above.texts} == {"ez (z)", "ex", "wafer", ""}
    assert {one.get_text() for one in below.texts} == {"fz (z)"}
    assert above.get_xlim()[0] < above.get_xlim()[1] and below.get_xlim()[0] > below.get_xlim()[1]
    (arrow,) = (one for one in above.texts if not one.get_text())
    np.testing.assert_allclose(arrow.xyann, (400.0, 100.0))
    assert arrow.xy[0] > 410.0 and arrow.xy[1] == pytest.approx(100.0)
    marked = {line.get_label(): line.get_xydata() for line in below.get_lines()}
    np.testing.assert_allclose(marked["actuators"], [[300.0, 100.0]])
    whole = fx.plot.placed(stage(), ax=plt.subplots()[1])
    assert {"ez (z)", "fz (z)"} < {one.get_text() for one in whole.texts}


def test_exposures_begin_before_the_first():
    """What comes before is larger and would be cut off."""
    run = run_of(["die:error"], "m")
    move = fx.plot.exposures(run, "die:error", window=5e-3, exposures=[(0.12, 0.16), (0.17, 0.19)])
    assert move.get_xlim() == pytest.approx((116.5, 191.4))

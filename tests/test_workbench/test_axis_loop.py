"""The loop of an axis with the others closed: against its formula, the poles, report_loops."""

import numpy as np
import pytest
from scipy.ndimage import median_filter

import flexplant as fx
from bench_plants import RATE, closed_poles, coupled, design, law, light, lines, measured
from flexplant.workbench import LoopLimits
from flexplant.workbench.evaluation import BenchMachine, Evaluator, coupling
from flexplant.workbench.verdict import of_fleet, stability_verdict
from flexplant.workbench.views import Views, _is_noise, _ratio, _wrapped

SAMPLED = {"rate": RATE, "hold": False}


def on(plant, made):
    return BenchMachine.on(plant, made, "machine 1")


@pytest.fixture(scope="module")
def frf():
    return coupled(3)


@pytest.fixture(scope="module")
def made(frf):
    return design(frf, law(30.0), **SAMPLED)


def naive(frf, made, name):
    """L of an axis line by line: what returns to its command when that is cut."""
    names, G = list(made.axes), np.moveaxis(frf.data, 2, 0)
    C = np.array([[made.laws[n].system for n in names]])[0]
    z = np.exp(2j * np.pi * frf.freq / RATE)
    a, found = names.index(name), []
    for k, point in enumerate(z):
        D = np.diag([(g.C @ np.linalg.solve(point * np.eye(g.n_states) - g.A, g.B) + g.D)[0, 0]
                     for g in C])  # fmt: skip
        others = np.diag([float(n != name and made.axes[n].closed) for n in names])
        # y = G u with u = e_a - others C y
        y = np.linalg.solve(np.eye(len(names)) + G[k] @ D @ others, G[k][:, a])
        found.append(D[a, a] * y[a])
    return np.array(found)


@pytest.mark.slow
def test_the_loop_gain_line_by_line(frf, made):
    machine = on(frf, made)
    for opened in (None, "y1"):
        d = made
        if opened:
            d = made.with_axis(opened, made.axes[opened].replace(closed=False))
        loop = Evaluator().loop(machine, d, "y2")
        L = naive(frf, d, "y2")
        np.testing.assert_allclose(loop.L, L, rtol=1e-9)
        np.testing.assert_allclose(loop.S, 1.0 / (1.0 + L), rtol=1e-9)
        np.testing.assert_allclose(loop.T + loop.S, 1.0, atol=1e-9)
        np.testing.assert_allclose(loop.KS, loop.law.at(frf.freq) / (1.0 + L), rtol=1e-9)
        np.testing.assert_allclose(loop.PS * loop.C, L / (1.0 + L), rtol=1e-8)


@pytest.mark.slow
def test_numbers_are_those_of_report_loops(frf, made):
    report, evaluator = made.loops(frf).report, Evaluator()
    for name in made.axes:
        loop = evaluator.loop(on(frf, made), made, name)
        one = report[name]
        assert loop.is_stable is report.is_stable is True
        assert loop.margins.crossovers == pytest.approx(one.crossovers, rel=1e-6)
        for figure in ("modulus_margin", "gain_margin", "phase_margin", "freq"):
            assert getattr(loop.margins, figure) == pytest.approx(getattr(one, figure), rel=1e-4)
    L = loop.L[np.searchsorted(frf.freq, loop.margins.phase_freq)]
    assert abs(abs(L) - 1.0) < 0.2  # the margin is where the loop crosses 1
    there = np.interp(loop.margins.gain_freq, frf.freq, loop.L.imag)
    assert abs(there) < 0.05
    assert np.abs(loop.S)[frf.freq < 0.95 * loop.bandwidth].max() < 1.0


def test_a_model_is_judged_by_its_poles():
    plant = light()
    for axis in (law(), law(40.0, fx.Notch(300.0, 0.01, 0.2))):
        made = design(plant, axis)
        loop = Evaluator().loop(on(plant, made), made, "y1")
        size = np.abs(closed_poles(plant, made.controller())).max()
        assert loop.is_stable is bool(size < 1.0)
        assert loop.margins.modulus_margin == pytest.approx(
            made.loops(plant).report["y1"].modulus_margin, rel=1e-9
        )
    assert loop.is_stable


def test_a_notch_on_a_mode_of_a_thousandth_makes_it_stable_also_by_its_lines():
    plant, lit = light(), measured(light())
    evaluator, states = Evaluator(), []
    for axis in (law(), law(40.0, fx.Notch(300.0, 0.01, 0.2))):
        made = design(lit, axis, **SAMPLED)
        loop = evaluator.loop(on(lit, made), made, "y1")
        size = np.abs(closed_poles(plant, made.controller())).max()
        assert loop.is_stable is bool(size < 1.0)
        states.append(loop.is_stable)
    assert states == [False, True]
    word, how = stability_verdict(loop)
    assert word == "stable"
    assert how.startswith("Nyquist criterion on the measured lines: no unstable poles.")
    if loop.count.narrowest:
        assert f"misses only a mode narrower than {loop.count.narrowest:.2g} Hz" in how


def test_the_other_axes_count_too(frf, made):
    """An axis that is fine beside one that is not: the loops together are unstable."""
    wild = made.with_axis("y1", law(30.0).replace(gain=-1.0))
    loop = Evaluator().loop(on(frf, wild), wild, "y2")
    assert loop.is_stable is False
    assert loop.count.unstable == wild.loops(frf).report.unstable
    alone = wild.with_axis("y1", wild.axes["y1"].replace(closed=False))
    assert Evaluator().loop(on(frf, alone), alone, "y2").is_stable


def test_what_is_kept_follows_the_other_axes(frf, made):
    machine, kept = on(frf, made), Evaluator()
    first = kept.loop(machine, made, "y2")
    assert kept.loop(machine, made.with_axis("y2", law(20.0)), "y2").others is first.others
    changed = made.with_axis("y1", law(20.0))
    again = kept.loop(machine, changed, "y2")
    assert again.others is not first.others
    np.testing.assert_allclose(again.L, Evaluator().loop(machine, changed, "y2").L, rtol=1e-12)


def test_lines_that_do_not_resolve_a_mode_are_marked():
    plant = light()
    coarse = measured(plant, lines(200))  # 2.5 Hz apart, the mode is 0.6 Hz wide
    marked = on(coarse, design(coarse, **SAMPLED)).unresolved(0)
    assert np.any(np.abs(coarse.freq[marked] - 300.0) < 3.0)
    fine = measured(plant, np.linspace(0.05, 500.0, 10_000))
    assert not on(fine, design(fine, **SAMPLED)).unresolved(0).any()


def test_coupling_is_what_the_command_does_to_others(frf, made):
    found = coupling(on(frf, made), made, "y1")
    np.testing.assert_allclose(found["y3"], np.abs(frf.data[2, 0] / frf.data[0, 0]))
    assert list(found) == ["y2", "y3"]


def test_a_fleet_in_words():
    made = design(light(), law(40.0, fx.Notch(300.0, 0.01, 0.05)))
    machines = [
        BenchMachine.on(light(f), made, f"machine {i}")
        for i, f in enumerate((300.0, 303.0, 297.0, 330.0), 1)
    ]
    loops = [Evaluator().loop(m, made, "y1") for m in machines]
    sizes = [np.abs(closed_poles(m.given, made.controller())).max() for m in machines]
    assert [one.is_stable for one in loops] == [size < 1.0 for size in sizes]
    text, worst = of_fleet(loops)
    assert text.startswith("3 of 4 stable; unstable: machine 4; least margin of the others 0.")
    assert worst == 3
    text, worst = of_fleet(loops[:3])
    least = min(loops[:3], key=lambda one: one.margins.modulus_margin)
    assert text == (
        f"3 of 3 stable, least margin {least.margins.modulus_margin:.2f} on {least.machine.name}"
    )


def test_limits_are_met_or_not():
    plant = light()
    made = design(plant, law(40.0, fx.Notch(300.0, 0.01, 0.2)))
    loop = Evaluator().loop(on(plant, made), made, "y1")
    limits = LoopLimits(2.5, 1.5, 20.0, 10.0, suppressed=0.5, below=5.0, rms=1e-6)
    found = {one.name: one for one in limits.judged(loop, 2e-6)}
    assert [one.met for one in found.values()] == [True, True, True, True, True, False]
    strict = LoopLimits(1.01, 100.0, 89.0, 1e3, suppressed=1e-3, below=5.0)
    assert not any(one.met for one in strict.judged(loop))
    assert found["rms of the error"].reached == "2e-06"
    bad = design(plant, law())
    wild = Evaluator().loop(on(plant, bad), bad, "y1")
    assert not any(one.met for one in limits.judged(wild))


@pytest.mark.parametrize("level", [1e-3, 1e-1])
def test_the_phase_is_drawn_where_it_is_above_the_noise(level):
    """Resonances of two lines stay, wherever they are; of lines of noise alone next to nothing."""
    rng = np.random.default_rng(int(1e4 * level))
    freq = np.linspace(1.0, 1000.0, 4000)
    s, L = 1j * freq, 0.0
    for at, zeta in zip(rng.uniform(20.0, 300.0, 6), rng.uniform(5e-4, 2e-2, 6), strict=True):
        L = L + at**2 / (s**2 + 2 * zeta * at * s + at**2)
    noise = level * (rng.standard_normal(4000) + 1j * rng.standard_normal(4000))
    size = np.abs(L)
    clear = median_filter(size, 15, mode="nearest") > 6.0 * level
    assert clear.sum() > 300 and _is_noise(L + noise)[clear].mean() < 0.02
    assert np.isfinite(_wrapped(noise)).mean() < 0.05
    assert np.isfinite(_wrapped(L + noise))[clear].mean() > 0.9, "gaps at turns of 360 deg alone"
    phase = _wrapped(L)
    assert np.nanmax(phase) <= 0.0 and np.nanmin(phase) > -360.0
    there = np.isfinite(phase)
    np.testing.assert_allclose(np.exp(1j * np.radians(phase[there])), (L / size)[there], atol=1e-9)


@pytest.mark.slow
def test_gains_say_what_0_db_is():
    """N/m of a translation, N m/rad of a rotation, SI where units are not known."""
    pairs = ("N", "m"), ("m", "N"), ("N m", "rad"), ("rad", "N m"), ("m/s^2", "m")
    texts = ["N/m", "m/N", "N m/rad", "rad/(N m)", "(m/s^2)/m"]
    assert [_ratio(*pair) for pair in pairs] == texts
    plant = light()
    for known, zero in (({}, "1 in SI units"), ({"u1": "N", "y1": "m"}, "1 N/m")):
        made = design(plant.replace(units=known), law())
        loop = Evaluator().loop(on(plant.replace(units=known), made), made, "y1")
        views = Views(LoopLimits())
        views.update(loop, made.axes["y1"])
        own = loop.machine.axes.plant
        if not own.units:
            zero = "1 in SI units"
        assert views.figures["KS"].title.text == f"|KS|: noise to command [dB, 0 dB = {zero}]"

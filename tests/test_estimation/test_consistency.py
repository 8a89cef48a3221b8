"""Verdicts on right and wrong models: shares of passes, power, the cause that is named."""

import re
from functools import cache

import numpy as np
import pytest
from scipy.stats import binom
from test_kalman import modes, one_state, ports

from flexplant.errors import LabelError, ModelError
from flexplant.estimation import consistency, design_kalman
from flexplant.estimation.innovations import cumulative_periodogram, density_of, lines_of, ljung_box
from flexplant.identification import MeasuredModes
from flexplant.loop import close_loop
from flexplant.modes import solve_modes
from flexplant.plant import Sensor, assemble_plant
from flexplant.plant.uncertainty.delta import with_changes
from flexplant.plant.uncertainty.mode_delta import DampingDelta, FrequencyDelta
from flexplant.plot import report
from flexplant.simulation import setpoint, simulate
from flexplant.structure import ModalDamping, chain
from flexplant.synthesis import design_servo
from flexplant.testbeds import three_masses, wafer_stage
from flexplant.updating import AddedMass, Eigenvalues, update
from oracles_estimation import records_of
from stages import Z8, full, reduced
from stages import ports as stage_ports

RATE = 4e3
KINDS = {"freq": FrequencyDelta, "damping": DampingDelta}


@cache
def plant(count=9, scale=1.0, sensor_scale=1.0):
    own = ports(asd=1e-3 * scale, sensor_asd=3e-11 * sensor_scale)
    return assemble_plant(modes(1e-2, count), own).discretized(RATE, delay=1)


@cache
def machine():
    return plant(count=9)


def recorded(truth, steps=20000, seed=1, axes=("die:z", "die:rx", "die:ry")):
    g = truth.system
    y = [name for name in truth.y if name not in truth.w]
    z = list(axes)
    rows = [truth.y.index(name) for name in y]
    records = records_of(
        g.A, g.C[g.output_index(y)], g.C[g.output_index(z)], truth.noise_factor,
        truth.sensor_noise[np.ix_(rows, rows)], steps, np.random.default_rng(seed),
    )  # fmt: skip
    motions = dict(zip(z, records[1].T, strict=True))
    channels = dict(zip(y, records[0].T, strict=True))
    return channels | {u: np.zeros(steps) for u in truth.u}, motions


def judged(design, truth, **options):
    observer = design_kalman(design)
    records, motions = recorded(truth, **options)
    return consistency(observer, observer.estimate(records), truth=motions)


def quiet_plant(chosen):
    """Some of 40 modes, with sensors that see those above half the rate."""
    own = ports(asd=1e-3, sensor_asd=3e-12)
    return assemble_plant(modes(3e-3, 40).select(chosen), own).discretized(RATE, delay=1)


@pytest.mark.long
def test_a_right_model_passes_as_often_as_stated():
    """One state, 200 records of 1000 samples at 95 %: the share is binomial."""
    design = one_state(0.9)
    observer, passed = design_kalman(design), 0
    rng = np.random.default_rng(8)
    for _ in range(200):
        x = np.zeros(1000)
        for k in range(1, 1000):
            x[k] = 0.9 * x[k - 1] + rng.standard_normal()
        y = x + np.sqrt(2.0) * rng.standard_normal(1000)
        estimate = observer.estimate({"y1": y, "u1": np.zeros(1000)}, start=np.zeros(1))
        passed += consistency(observer, estimate).holds
    low, high = binom.ppf([0.001, 0.999], 200, 0.95)
    assert low <= passed <= high


@pytest.mark.slow
def test_a_right_model_of_the_plate():
    found = judged(machine(), machine())
    assert found.holds, found
    assert found.moved is None
    assert list(found.spectra) == [4, 5, 6, 7, 8, 9]
    assert min(p for _, p in found.spectra.values()) > 1e-3
    assert found.nis == pytest.approx(1.0, abs=0.02)
    for mean, low, high in found.nees.values():
        assert low < 1.0 < high
        assert mean == pytest.approx(1.0, abs=0.3)


@pytest.mark.slow
@pytest.mark.parametrize(("factor", "word"), [(1.2, "larger"), (0.8, "smaller")])
def test_all_noises_off_by_a_factor(factor, word):
    found = judged(machine(), plant(scale=factor, sensor_scale=factor))
    assert found.cause == "noise level"
    assert word in found.text
    assert found.nis == pytest.approx(factor**2, rel=0.03, abs=0)
    assert found.nees["die:z"][0] == pytest.approx(factor**2, rel=0.25, abs=0)


@pytest.mark.slow
def test_process_noise_alone_is_off():
    found = judged(machine(), plant(scale=3.0))
    assert found.cause == "noise ratio"
    process, sensors = map(float, re.findall(r"([\d.]+) times", found.text))
    assert process == pytest.approx(3.0, rel=0.1, abs=0)
    assert sensors == pytest.approx(1.0, rel=0.2, abs=0)
    assert judged(plant(scale=3.0), machine()).cause == "noise ratio"


@pytest.mark.slow
@pytest.mark.parametrize("mode", [4, 6])
def test_a_wrong_frequency_is_named_with_its_mode(mode):
    moved = with_changes(machine(), [(FrequencyDelta.of(mode, 1.0), 0.06)])
    found = judged(machine(), moved)
    assert found.causes == ("frequency",)
    assert f"near mode {mode} " in found.text
    shift, deviation = found.moved.frequency[mode]
    assert abs(shift - (np.sqrt(1.06) - 1.0)) < 3.0 * deviation < 5e-3
    assert found.moved.modes == (mode,)
    omega = np.sqrt(np.linalg.det(moved.modal_blocks))[mode - 1]
    assert found.peaks[0][0] == pytest.approx(omega / (2 * np.pi), rel=0.03, abs=0)


@pytest.mark.slow
def test_a_truncated_model_is_named():
    found = judged(plant(count=8), machine())
    assert found.cause == "truncation"
    assert "above all modes" in found.text
    assert found.peaks[0][0] == pytest.approx(modes(1e-2, 9).freq[8], rel=0.03, abs=0)


@pytest.mark.slow
@pytest.mark.parametrize("more", [2, 15])
def test_modes_left_out_beside_a_kept_one_are_no_change_of_it(more):
    """Modes 9 and 10 are a pair, mode 11 lies 1 % above: what shows is near mode 9, kept."""
    blind = judged(machine(), plant(count=9 + more))
    assert blind.causes == ("truncation",)
    assert "near mode 9" not in blind.text or "no change of" in blind.text
    design = machine().replace(evaluation=modes(1e-2, 9 + more))
    known = judged(design, plant(count=9 + more))
    assert known.causes == ("truncation",)
    assert f"the plant is correct, they are coloured by the {more} truncated modes" in known.text
    assert "its predicted errors hold" in known.text


@pytest.mark.slow
def test_a_folded_mode_beside_a_kept_one_is_named():
    """Modes at 4456 Hz appear at 456 Hz, beside mode 6 at 463 Hz."""
    kept = list(range(9))
    whole, design = [*kept, 28, 29], quiet_plant(kept)
    observer = design_kalman(design)
    estimate = observer.estimate(recorded(quiet_plant(whole))[0])
    blind = consistency(observer, estimate)
    assert blind.causes == ("folding",)
    assert "no change of mode 6 (463.1 Hz" in blind.text
    judge = observer.plant.replace(evaluation=modes(3e-3, 40).select(whole))
    known = consistency(observer.replace(plant=judge), estimate)
    assert known.causes == ("folding",)
    assert (
        "the plant is correct" in known.text and "(4456 Hz in the evaluation model)" in known.text
    )


@pytest.mark.slow
@pytest.mark.parametrize(
    ("mode", "kind", "amount"), [(7, "freq", 0.04), (4, "damping", -0.8), (11, "freq", 0.05)]
)
def test_a_changed_mode_is_no_other_mode(mode, kind, amount):
    moved = with_changes(plant(count=12), [(KINDS[kind].of(mode, 1.0), amount)])
    found = judged(plant(count=12), moved)
    assert found.causes == ("frequency",)
    assert f"near mode {mode} " in found.text


def one_sensor(count):
    """Modes of a chain of five masses pushed at one end and seen at the other."""
    every = solve_modes(
        chain(masses=[1.0] * 5, stiffnesses=[4e5] * 4), count=5, damping=ModalDamping(0.01)
    )
    own = three_masses().assembled.ports.replace(y=[Sensor("y1", at="5:x", asd=1e-11)])
    return assemble_plant(every.select(range(count)), own).discretized(2e3, delay=1)


@pytest.mark.slow
@pytest.mark.parametrize(
    ("kept", "mode", "kind", "amount", "cause"),
    [
        (5, 2, "freq", 0.05, "frequency"),
        (5, 3, "damping", -0.8, "frequency"),
        (4, 2, "freq", 0.0, "truncation"),
        (3, 2, "freq", 0.0, "truncation"),
    ],
)
def test_one_sensor_shows_whether_a_mode_has_moved_or_is_left_out(kept, mode, kind, amount, cause):
    truth = with_changes(one_sensor(5), [(KINDS[kind].of(mode, 1.0), amount)])
    observer = design_kalman(one_sensor(kept))
    records, _ = recorded(truth, axes=("die:x",))
    found = consistency(observer, observer.estimate(records))
    assert found.causes == (cause,)
    assert cause == "truncation" or f"near mode {mode} " in found.text


@pytest.mark.slow
@pytest.mark.parametrize(("sensor", "size"), [("y1", 20e-9), ("y3", -5e-9), ("y2", 1e-6)])
def test_an_offset_of_a_sensor_is_named_with_its_size(sensor, size):
    records, _ = recorded(machine())
    observer = design_kalman(machine())
    found = consistency(observer, observer.estimate(records | {sensor: records[sensor] + size}))
    assert found.causes == ("offset",)
    value, unit = re.search(rf"{sensor} by (-?[\d.e+]+) (\S*m)", found.text).groups()
    scale = {"nm": 1e-9, "\N{MICRO SIGN}m": 1e-6}[unit]
    assert float(value) * scale == pytest.approx(size, rel=0.1, abs=0)


@pytest.mark.slow
@pytest.mark.parametrize("count", [1, 30])
def test_outliers_are_named_and_gated(count):
    records, _ = recorded(machine())
    observer = design_kalman(machine())
    rng, bad = np.random.default_rng(3), {name: part.copy() for name, part in records.items()}
    for k in rng.choice(np.arange(200, 19000), count, replace=False):
        bad[f"y{rng.integers(1, 5)}"][k] += rng.choice([-1.0, 1.0]) * rng.uniform(3e-8, 1e-6)
    found = consistency(observer, observer.estimate(bad))
    assert found.causes == ("outliers",)
    assert f"{count} single sample" in found.text and "gate=" in found.text
    gated = observer.estimate(bad, gate=7)
    assert gated.gated.sum() == count
    held = consistency(observer, gated)
    assert held.holds and f"{count} sample" in held.text
    # beside another cause both are named
    bad["y2"] += 20e-9
    assert consistency(observer, observer.estimate(bad)).causes == ("outliers", "offset")


@pytest.mark.slow
def test_a_blow_that_a_mode_left_out_rings_from_is_no_outlier():
    records, _ = recorded(machine())
    ringing = np.zeros(20000)
    k = np.arange(400)
    ringing[8000:8400] = 1e-7 * np.exp(-0.01 * k) * np.sin(2 * np.pi * 0.4 * k)
    bad = {name: part + (ringing if name[0] == "y" else 0.0) for name, part in records.items()}
    observer = design_kalman(machine())
    found = consistency(observer, observer.estimate(bad))
    assert not found.holds
    assert "outliers" not in found.causes and "offset" not in found.causes


def test_the_innovations_on_its_own_plant_have_unit_density():
    """By way of the plant's noises and the open plant, rigid-body modes among it."""
    observer = design_kalman(machine())
    freq = np.geomspace(1e-4, 0.499, 300)
    for other in (machine(), None):
        parts = density_of(observer, other, freq)
        np.testing.assert_allclose(parts.both, np.broadcast_to(np.eye(4), (300, 4, 4)), atol=1e-6)
    own, filtered = density_of(observer, machine(), freq), density_of(observer, None, freq)
    np.testing.assert_allclose(own.pooled, filtered.pooled, atol=1e-6)


def test_statistics_by_direct_sums():
    rng = np.random.default_rng(1)
    x = rng.standard_normal((300, 2))
    N, lags = 300, 5
    G0 = np.linalg.inv(x.T @ x / N)
    total = 0.0
    for lag in range(1, lags + 1):
        G = x[lag:].T @ x[:-lag] / N
        total += N * N / (N - lag) * np.trace(G.T @ G0 @ G @ G0)
    assert ljung_box(x, lags).statistic == pytest.approx(total, rel=1e-10, abs=0)
    found = lines_of(x).pooled
    line = np.exp(-2j * np.pi * found.freq[10] * np.arange(300)) @ x
    assert found.density[10] == pytest.approx(np.mean(np.abs(line) ** 2) / N, rel=1e-10, abs=0)
    distance = cumulative_periodogram(found).statistic
    share = np.cumsum(found.density) / found.density.sum()
    assert distance == pytest.approx(
        np.abs(share - np.arange(1, share.size + 1) / share.size).max(), rel=1e-12, abs=0
    )


def test_refusals():
    design = one_state(0.9)
    observer = design_kalman(design)
    estimate = observer.estimate({"y1": np.zeros(50), "u1": np.zeros(50)}, start=np.zeros(1))
    with pytest.raises(ModelError, match="at least 200 samples"):
        consistency(observer, estimate)
    with pytest.raises(ModelError, match="KalmanEstimator or a ClosedLoop"):
        consistency(observer, 3.0)
    with pytest.raises(LabelError, match="channel 'y1'"):
        consistency(observer, {})
    records, _ = recorded(machine(), steps=300)
    observer = design_kalman(machine())
    with pytest.raises(LabelError, match="POI channel"):
        consistency(observer, observer.estimate(records), truth={"dye": np.zeros(300)})


def calibrated_stage(added_mass):
    """A drawing calibrated with poles of one machine; and that machine with another mass at z8."""
    nominal, first = reduced(0.001), wafer_stage(damping=0.001)
    poles = first.poles(range(4, 20))
    low = MeasuredModes(poles.poles[:4], modes=poles.modes[:4])
    fit = update(nominal, [AddedMass(nominal.dofs.nearest(Z8, "z"))], [Eigenvalues(low)])
    machine = wafer_stage(damping=0.001, added_mass=added_mass)
    plant = assemble_plant(fit.calibrated(poles), stage_ports())
    whole = solve_modes(fit.applied_to(full(0.001)), count=40)
    return plant.discretized(machine.rate, delay=machine.delay), whole, machine


@pytest.mark.long
def test_a_machine_of_another_formulation_that_has_changed_since_it_was_measured():
    """0.4 kg more on a Ritz plate: the modes that moved are named, and where they are.

    The calibrated model that is offered has them there.
    """
    plant, whole, machine = calibrated_stage(0.9)
    observer = design_kalman(plant.replace(evaluation=whole))
    servo = design_servo(plant, bandwidth=20.0, observer=observer)
    move = setpoint(100e-6, velocity=5e-3, acceleration=0.5, jerk=100.0)
    run = machine.run(stage_ports(), observer, servo, duration=1.0, reference=move, rng=2)
    moved = consistency(observer, run).moved
    truth = machine.poles(moved.modes)
    assert 6 in moved.modes
    off = np.abs(moved.measured.freq / truth.freq - 1.0)
    deviation = np.array([moved.frequency[n][1] for n in moved.modes])
    # the drawing's shapes are not the machine's
    assert np.all(off < 3.0 * deviation + 2e-4)
    assert np.all(np.abs(moved.expected / truth.poles - 1.0) > 3.0 * off)
    again = plant.assembled.realisation.model.calibrated(moved.measured)
    at = [again.modes().freq[n - 1] for n in moved.modes]
    np.testing.assert_allclose(at, truth.freq, rtol=float(3.0 * deviation.max() + 2e-4))
    assert f"mode 6 is at {moved.measured.freq[moved.modes.index(6)]:.5g} Hz, not" in repr(moved)


@pytest.mark.long
def test_deviations_of_moved_modes_cover_in_closed_loop():
    """Runs with moves and 1 % damping: frequency and decay lie in their intervals."""
    moved = with_changes(machine(), [(FrequencyDelta.of(6, 1.0), 0.05)])
    observer = design_kalman(machine())
    servo = design_servo(machine(), bandwidth=25.0, observer=observer)
    loop, z = close_loop(moved, observer, servo), []
    move = setpoint(1e-4, velocity=5e-3, acceleration=0.5, jerk=100.0)
    for seed in range(4):
        run = simulate(loop, duration=2.5, rng=seed, reference=move)
        found = consistency(observer, run).moved
        (shift, s), (zeta, d) = found.frequency[6], found.damping[6]
        z.append([(shift - (np.sqrt(1.05) - 1.0)) / s, (zeta - 0.01 / np.sqrt(1.05)) / d])
    # chi-square with 8 degrees of freedom: beyond with a probability of 0.1 %
    assert np.sum(np.square(z)) < 26.0


@pytest.mark.long
def test_the_report_of_a_loop_names_the_mode_that_moved(tmp_path):
    """A run on a machine whose mode 6 is 2.5 % higher, beside the loop on the model."""
    moved = with_changes(machine(), [(FrequencyDelta.of(6, 1.0), 0.05)])
    observer = design_kalman(machine())
    servo = design_servo(machine(), bandwidth=25.0, observer=observer)
    promised, there = (close_loop(P, observer, servo) for P in (machine(), moved))
    run = simulate(there, duration=2.5, rng=3)
    found = consistency(promised, run)
    assert found.moved.modes == (6,)
    assert abs(found.moved.frequency[6][0] - 0.0247) < 2e-3
    text = report(tmp_path / "loop", promised, run).read_text()
    said = text.partition("Compared with the model of the loop")[2]
    assert "near mode 6 " in said and "Calibrate the model" in said

"""Measurements that no linear machine explains: real ones, and outputs that do not agree."""

import warnings

import numpy as np
import pytest
import scipy.io

from disagreeing import drifting, roving
from flexplant import load
from flexplant.errors import FlexplantWarning, LabelError, ModelError, ShapeError
from flexplant.identification import (
    H1Estimator,
    estimate_frf,
    identify_modes,
    stabilisation_diagram,
)
from flexplant.lti import Frf
from oracles_identification import modal_frf, noisy, pole
from shared_data import data_file


def content(name):
    path = data_file("measured") / name
    return scipy.io.loadmat(path) if path.exists() else pytest.skip(f"needs {path}")


def ruler(low, high):
    """Ten outputs of a ruler hit by hand (torebutlin/pydvma, BSD-3), mains of 50 Hz on them."""
    data = content("ruler.mat")
    freq = np.arange(len(data["yspec"])) * data["freq"].item() / data["npts"].item()
    band = (freq >= low) & (freq <= high)
    return Frf(freq[band], data["yspec"][band].T[:, None, :], quantity="acceleration")


def vibration_toolbox(name):
    data = content(name)
    freq, H = data["Freq_domain"].ravel().astype(float), data["Hf_chan_2"].ravel()
    return Frf(freq[1:], H[None, None, 1:], quantity="acceleration")


@pytest.mark.slow
@pytest.mark.parametrize("refine", [pytest.param(None, marks=pytest.mark.long), False])
def test_a_ruler_in_a_wide_band_is_answered_from_the_diagram(refine):
    """11 modes in 114 s, 1305 Hz not among them, when it was refined by default."""
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", FlexplantWarning)
        found = identify_modes(ruler(400.0, 1500.0), refine=refine)
    assert not found.refined
    for peak in (517.5, 551.4, 729.3, 1111.9, 1305.2):  # of the sum of the responses' magnitudes
        near = np.argmin(np.abs(found.freq - peak))
        least = 5e-3 * peak if refine is False else 1.96 * found.std[near].imag / (2 * np.pi)
        assert np.abs(found.freq[near] - peak) < max(least, 2e-3 * peak)
    assert len(found) < 14
    assert np.all(found.std.real < -found.poles.real)
    if refine is None:
        assert "outputs do not share" in repr(found)
        assert found.zeta.max() < 0.05  # what is broader lies under others, or over the edge
        assert found.inconsistency == pytest.approx(3e-3, rel=0.5)


@pytest.mark.slow
def test_a_ruler_by_the_default_call_has_the_five_modes_picked_by_hand():
    """20 modes in 24 s before, mains lines among them; 5 s of CPU."""
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", FlexplantWarning)
        found = identify_modes(ruler(20.0, 400.0))
    assert found.freq.tolist() == pytest.approx([39.5, 108.5, 212.5, 269.7, 352.3], rel=4e-3)
    assert any("mains multiple, 3 x 50 Hz" in reason for _, _, reason in found.rejected)


@pytest.mark.slow
@pytest.mark.parametrize("low, high", [(20.0, 70.0), (28.0, 52.0), (30.0, 50.0)])
def test_one_resonance_of_a_ruler_has_no_twin(low, high):
    """A second pole at 40.0 Hz, zeta 1.4 %, shape of no plane: one hit proves no pair."""
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", FlexplantWarning)
        found = identify_modes(ruler(low, high))
    assert found.freq.tolist() == pytest.approx([39.4], rel=2e-3)


@pytest.mark.slow
def test_a_first_answer_on_a_ruler_has_no_twins():
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", FlexplantWarning)
        found = identify_modes(ruler(20.0, 400.0), refine=False)
    hand = np.array([39.5, 108.5, 212.5, 269.7, 352.3])
    off = np.abs(found.freq[:, None] / hand - 1.0)
    assert len(found) >= 4 and off.min(axis=1).max() < 4e-3
    assert np.unique(off.argmin(axis=1)).size == len(found)


@pytest.mark.slow
def test_poles_of_a_ruler_picked_by_hand_stay_where_outputs_see_them():
    """An output that hardly sees a mode has a broad pole of its own: zeta was 8 +- 9 %."""
    frf = ruler(20.0, 400.0)
    hand = [39.5, 108.5, 212.5, 269.7, 352.3]
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", FlexplantWarning)
        found = identify_modes(frf, start=stabilisation_diagram(frf).select(hand))
        few = identify_modes(frf, most=3)
    assert found.freq.tolist() == pytest.approx(hand, rel=4e-3)
    assert found.zeta.max() < 0.015
    assert len(few) == 3
    assert sum("most=" in reason for _, _, reason in few.rejected) >= 2
    for modes in (found, few):
        assert np.all(modes.std.real < 0.3 * -modes.poles.real)


@pytest.mark.slow
def test_one_odd_output_is_named():
    rng, freq = np.random.default_rng(7), np.arange(20.0, 160.0, 0.25)
    phi, drive, truth = rng.normal(size=(6, 3)), rng.normal(size=(1, 3)), np.array([33.0, 58.0, 91])
    off = [2e-3 if o == 3 else 0.0 for o in range(6)]
    parts = [pole(truth * (1 + one), np.full(3, 0.01)) for one in off]
    H = np.array([modal_frf(freq, p, phi[[o]], drive)[0] for o, p in enumerate(parts)])
    deviation = 1e-3 * np.sqrt(np.mean(np.abs(H) ** 2))
    frf = Frf(freq, noisy(H, deviation, rng), variance=np.full(H.shape, deviation**2))
    with pytest.warns(FlexplantWarning, match=r"y4 deviates by 0\.2 %"):
        assert len(identify_modes(frf)) == 3


@pytest.mark.slow
@pytest.mark.parametrize("seed", range(4))
def test_a_band_little_wider_than_its_resonance(seed):
    """Outputs disagree and few lines allow few orders, over which no pole is stable."""
    rng, freq = np.random.default_rng(seed), 108.5 + 0.6 * (np.arange(33) - 16)
    own = pole(108.5 * (1 + 3e-3 * rng.normal(size=10)), np.full(10, 0.0065))
    parts = [modal_frf(freq, one[None], rng.normal(size=(1, 1)), np.ones((1, 1))) for one in own]
    H = np.concatenate(parts)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", FlexplantWarning)
        found = identify_modes(Frf(freq, noisy(H, 3e-3 * np.sqrt(np.mean(np.abs(H) ** 2)), rng)))
    assert found.freq.tolist() == pytest.approx([108.5], rel=5e-3)


@pytest.mark.slow
def test_a_first_answer_far_from_what_was_measured_is_warned_of():
    frf, _ = roving(1e-3, 3)
    with pytest.warns(FlexplantWarning, match="the residual exceeds the noise"):
        one = identify_modes(frf, refine=False)
    assert one.misfit > 4.0
    with pytest.warns(FlexplantWarning):
        assert identify_modes([frf], refine=False).poles.tolist() == one.poles.tolist()


def hum(freq, at, window):
    """Lines (n_freq,) of a tone: one of whole periods, or as the DFT of Hann's window shows it."""
    if window is None:
        return (freq == at).astype(complex)
    time, spacing = np.arange(4096) / 4096, freq[1] - freq[0]
    tone = np.sin(np.pi * time) ** 2 * np.exp(2j * np.pi * (at - freq[0]) / spacing * time)
    return np.fft.fft(tone)[: freq.size] / 2048


@pytest.mark.slow
@pytest.mark.filterwarnings("ignore:segments of 1 s:flexplant.errors.FlexplantWarning")
@pytest.mark.parametrize("window", [None, "hann"])
@pytest.mark.parametrize("known", [True, False])
def test_mains_in_some_outputs_is_left_out_and_named(window, known):
    """Of 48 such lines none was named; at 1000 sigma a mode was lost and another 1 % off."""
    freq, frequencies = np.arange(40.0, 240.0), [61.0, 97.3, 131.0, 160.0, 214.0]
    reason = "a mains multiple, {} Hz, narrower than half a line"
    for seed, level, at, named in ((1, 1e3, 100.0, "2 x 50"), (2, 1e2, 180.0, "3 x 60")):
        rng = np.random.default_rng(seed)
        truth = pole(frequencies, rng.uniform(2e-3, 8e-3, 5))
        phi = rng.normal(size=(4, 5))
        H = modal_frf(freq, truth, phi, phi[:1])
        sigma = 1e-2 * np.sqrt(np.median(np.abs(H) ** 2))
        H = noisy(H, sigma, rng)
        H[1:3] += level * sigma * hum(freq, at if window is None else at + 0.3, window)
        frf = Frf(freq, H, variance=np.full(H.shape, sigma**2) if known else None)
        frf = frf if window is None else frf.replace(window=window, resolution=1.0)
        found = identify_modes(frf)
        assert [why for _, _, why in found.rejected] == [reason.format(named)]
        assert len(found) == 5
        error = found.poles - truth
        assert np.abs([error.real / found.std.real, error.imag / found.std.imag]).max() < 4


@pytest.mark.slow
@pytest.mark.parametrize("case", [(150.0, 0.001, 0.1), (61.0, 0.0025, 1.0)], ids=["on", "beside"])
def test_a_mode_at_a_mains_multiple_is_kept(case):
    """0.1 % at 150 Hz are three lines; 61 Hz is a third of a line wide, next to the line at 60."""
    at, zeta, step = case
    rng, freq = np.random.default_rng(0), np.arange(40.0, 240.0, step)
    truth, phi = pole([at, 97.3, 214.0], [zeta, 0.005, 0.005]), rng.normal(size=(4, 3))
    H = modal_frf(freq, truth, phi, phi[:1])
    frf = Frf(freq, noisy(H, 1e-2 * np.sqrt(np.median(np.abs(H) ** 2)), rng))
    found = identify_modes(frf)
    assert found.freq.tolist() == pytest.approx(np.sort(np.abs(truth) / 2 / np.pi), rel=1e-4)
    assert found.rejected == ()


@pytest.mark.slow
@pytest.mark.parametrize("band", [(150, 300), (100, 300), (50, 400), (180, 250), (200, 225)])
def test_one_published_mode_has_no_twin(band):
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", FlexplantWarning)
        found = identify_modes(vibration_toolbox("vt_case1.mat"), band=band)
    near = found.freq[np.abs(found.freq - 212.09) < 5.0]
    assert near.tolist() == pytest.approx([212.09], abs=0.05)


BANDS = [(150, 250), (100, 300), (50, 400), (5, 500), (180, 210), (185, 200)]


@pytest.mark.parametrize("band", BANDS)
def test_a_peak_whose_phase_rises_is_found_all_the_same(band):
    """No stable pole has this phase: the diagram is empty, and was refused in all six bands."""
    with pytest.warns(FlexplantWarning, match="no pole is stable"):
        found = identify_modes(vibration_toolbox("vt_case2.mat"), band=band)
    assert found.freq.tolist() == pytest.approx([192.59], abs=0.2)
    assert np.abs(found.freq[0] - 192.59) < 2.0 * found.std[0].imag / (2 * np.pi)


@pytest.mark.slow
def test_a_refinement_that_takes_too_much_leaves_the_first_answer(monkeypatch):
    frf, _ = roving(0.0, 1, step=0.3)
    first = identify_modes(frf, refine=False)
    monkeypatch.setattr("flexplant.identification.identification_stages.BUDGET", 1e6)
    found = identify_modes(frf)
    assert "after 1e+06 operations" in repr(found)
    np.testing.assert_allclose(found.poles, first.poles, rtol=1e-6)  # of one step and of two
    assert identify_modes(frf, refine=True).refined


def test_a_record_of_force_and_motion_gives_five_radians_a_second():
    """vt_frf1: 102 s at 10 Hz; its response at rest is one, so that its peak is 1/(2 zeta)."""
    data = content("vt_frf1.mat")
    force, motion = ({name: data[name].ravel().astype(float)} for name in "fx")
    frf = estimate_frf(force, motion, rate=10.0, method=H1Estimator(segment=25.6))
    found = identify_modes(frf, band=(0.1, 4.9))
    assert len(found) == 1
    assert np.abs(found.poles[0]) == pytest.approx(5.0, rel=2e-3)
    assert found.zeta[0] == pytest.approx(0.05, abs=2 * found.std[0].real / 5.0)
    at_rest = np.abs(found.frf(frf.freq[frf.freq < 0.2]).data).max()
    assert at_rest == pytest.approx(1.0, rel=0.1)


@pytest.mark.slow
@pytest.mark.parametrize("shift", [1e-4, 1e-3])
def test_outputs_of_a_roving_sensor_share_four_modes(shift, tmp_path):
    """7 to 13 modes before, in silence; deviations of chi-square held 5 % of the poles."""
    inside, count = 0, 2
    for seed in range(count):
        frf, truth = roving(shift, seed, step=0.3)
        with pytest.warns(FlexplantWarning, match=r"outputs disagree .* by 0\.\d+ %"):
            found = identify_modes(frf)
        assert len(found) == 4
        assert found.inconsistency == pytest.approx(shift, rel=0.9)
        inside += np.sum(np.abs((found.poles - truth).imag) < 1.96 * found.std.imag)
    assert inside >= 4 * count - 2  # of 95 % three are outside once in two hundred such tests
    found.save(tmp_path / "found.npz")
    assert repr(load(tmp_path / "found.npz")) == repr(found)
    assert "means of separate fits" in repr(found)


CASES = [(1e-4, 8, 0.004), (1e-3, 8, 0.02), (1e-4, 2, 0.004)]


@pytest.mark.slow
@pytest.mark.parametrize(("shift", "sensors", "zeta"), CASES)
def test_inputs_of_a_roving_hammer_share_four_modes(shift, sensors, zeta):
    """6 to 10 modes before where sensors are as many as places hit, in silence."""
    frf, truth = roving(shift, 1, zeta=zeta, step=0.3, n_in=sensors)
    back = {"data": frf.data.transpose(1, 0, 2), "variance": frf.variance.transpose(1, 0, 2)}
    with pytest.warns(FlexplantWarning, match=r"inputs disagree .* by 0\.\d+ %"):
        found = identify_modes(Frf(frf.freq, **back))
    assert len(found) == 4
    assert found.inconsistency == pytest.approx(shift, rel=0.9)
    assert np.all(np.abs((found.poles - truth).imag) < 2.6 * found.std.imag)
    assert f"inputs disagree by {found.inconsistency:.1e}" in repr(found)
    assert found.shapes.shape == (sensors, 4)


@pytest.mark.slow
@pytest.mark.parametrize("references", [2, 3])
def test_broad_resonances_of_several_references_have_one_pole_each(references):
    """Two poles of one participation each, 5 to 8 modes at 18 of 32 machines, 5 s a fit."""
    inside = []
    for seed in (0, 1, 9):
        frf, truth = roving(1e-3, seed, zeta=0.02, n_in=references, step=0.3)
        with pytest.warns(FlexplantWarning, match="outputs disagree"):
            found = identify_modes(frf)
        assert len(found) == 4
        inside.append(np.abs((found.poles - truth).imag) < 1.96 * found.std.imag)
    assert np.sum(inside) >= 10  # of 95 % fewer are inside once in fifty such tests


@pytest.mark.slow
def test_two_modes_of_one_participation_are_two():
    rng, freq = np.random.default_rng(0), np.arange(20.0, 120.0, 0.3)
    truth, phi = pole([47.5, 49.0, 90.0], [0.02, 0.02, 0.02]), rng.normal(size=(6, 3))
    drive = np.array([[1.0, 1.0, 1.0], [0.5, 0.5, -2.0]])
    H = modal_frf(freq, truth, phi, drive)
    sigma = 1e-3 * np.sqrt(np.mean(np.abs(H) ** 2))
    found = identify_modes(Frf(freq, noisy(H, sigma, rng), variance=np.full(H.shape, sigma**2)))
    assert len(found) == 3
    assert np.abs((found.poles - truth).imag / found.std.imag).max() < 3.5
    assert found.inconsistency is None


@pytest.mark.slow
def test_what_was_measured_together_has_one_shift():
    frf, truth = roving(1e-3, 3, step=0.3, n_in=2, setups=3)
    y = list(frf.outputs)
    with pytest.warns(FlexplantWarning, match="outputs disagree"):
        found = identify_modes(frf, setups=[y[:2], y[2:4], y[4:]])
    assert len(found) == 4
    assert found.inconsistency == pytest.approx(1e-3, rel=0.9)
    assert np.all(np.abs((found.poles - truth).imag) < 1.96 * found.std.imag)
    with pytest.warns(FlexplantWarning, match="outputs disagree"):
        each = identify_modes(frf)
    assert np.all(found.std.imag > 1.2 * each.std.imag)  # known from three, not six
    for wrong in ([y[:2], y[2:4]], [y], [[], y], ["y1", "y2"], [y, [*frf.inputs]]):
        with pytest.raises(LabelError, match="each of the outputs"):
            identify_modes(frf, setups=wrong)


@pytest.mark.long
def test_runs_of_a_drifting_machine_give_means_and_how_they_differ():
    """Of the mean of such runs 8 % of the frequencies lay within 1.96 deviations, in silence."""
    inside, dofs = 0, {"y1": "a", "u1": "a", "y2": "b", "u2": "b"}
    for seed in range(3):
        runs, truth, phi = drifting(1e-3, seed)
        with pytest.warns(FlexplantWarning, match=r"runs disagree .* by 0\.\d+ %"):
            found = identify_modes(runs, dofs=dofs)
        assert len(found) == 3
        assert found.inconsistency == pytest.approx(1e-3, rel=0.9)
        assert found.shapes.shape == phi.shape
        assert np.abs(np.abs(found.shapes / phi) - 1).max() < 0.02
        inside += np.sum(np.abs((found.poles - truth).imag) < 1.96 * found.std.imag)
    assert (
        inside >= 6
    )  # a run deviates by one draw at all modes: one machine of three may be outside
    assert "runs disagree by" in repr(found)
    with pytest.raises(ModelError, match="setups= needs a single measurement"):
        identify_modes(runs, setups=[["y1"], ["y2", "y3", "y4", "y5"]])
    with pytest.raises(ShapeError, match="same channels and frequencies"):
        identify_modes([runs[0], runs[1].select(outputs=["y1"])])


@pytest.mark.slow
def test_runs_of_a_machine_that_stays_are_their_mean():
    runs, truth, _ = drifting(0.0, 1)
    alike = np.full((5, 5, runs[0].freq.size), 0.5) + 0.5 * np.eye(5)[:, :, None]
    runs = [run.replace(correlation=alike) for run in runs]
    found, mean = identify_modes(runs), np.mean([run.data for run in runs], axis=0)
    one = identify_modes(runs[0].replace(data=mean, variance=runs[0].variance / 6))
    assert np.abs((found.poles - one.poles).imag / one.std.imag).max() < 0.3
    assert found.std.imag == pytest.approx(one.std.imag, rel=0.1)
    size = np.abs(one.shape_covariance).max()
    assert np.abs(found.shape_covariance - one.shape_covariance).max() < 0.1 * size
    assert found.inconsistency is None
    assert np.abs((found.poles - truth).imag / found.std.imag).max() < 3


def test_default_orders_are_those_that_the_lines_afford():
    freq = np.arange(180.0, 200.0, 0.42)
    H = modal_frf(freq, pole([190.0], [0.005]), np.ones((1, 1)), np.ones((1, 1)))
    found = identify_modes(Frf(freq, H))
    assert freq.size < 50
    assert found.freq.tolist() == pytest.approx([190.0], rel=1e-6)


@pytest.mark.slow
def test_a_costly_refinement_is_said_and_the_first_answer_is_near_it(monkeypatch, capsys):
    monkeypatch.setattr("flexplant.identification.identification_stages.UNASKED", 10.0)
    frf, truth = roving(0.0, 1)
    first = identify_modes(frf)
    assert not first.refined
    assert "first result" in repr(first)
    score = np.abs((first.poles - truth).imag) / first.std.imag
    assert score.max() < 4.0
    assert capsys.readouterr().err == ""
    best = identify_modes(frf, refine=True)
    assert "operations a step" in capsys.readouterr().err
    assert best.refined
    assert np.abs((first.poles - best.poles).imag / best.std.imag).max() < 1.0


@pytest.mark.slow
def test_poles_at_the_edge_are_listed_and_the_limit_of_poles_holds():
    frf, _ = roving(0.0, 1)
    edge = identify_modes(frf, band=(20.0, 110.15))
    assert edge.freq.round().tolist() == [40.0, 75.0]
    assert [reason for _, _, reason in edge.rejected] == ["at the edge of the band"]
    with pytest.raises(ModelError, match="most"):
        identify_modes(frf, most=0)
    with pytest.raises(ModelError, match="refine"):
        identify_modes(frf, refine="yes")

"""Identification beside its peers: a close pair, real sets, 56 FRFs; ``-n 0 -m benchmark -s``."""

import time
import warnings
from pathlib import Path

import numpy as np
import pytest
import scipy.io

from disagreeing import drifting, roving
from flexplant.identification import H1Estimator, estimate_frf, identify_modes
from flexplant.lti import Frf
from oracles_identification import modal_frf, noisy, pole

pytestmark = pytest.mark.benchmark
FREQ = np.arange(10.0, 150.0, 0.05)
TRUTH = pole([47.5, 48.2, 112.0], [0.004, 0.004, 0.01])
MEASURED = Path(__file__).parents[3] / "shared" / "data" / "measured"
PHI = np.random.default_rng(0).normal(size=(5, 3))


def responses(level):
    H = modal_frf(FREQ, TRUTH, PHI, PHI[:1])
    deviation = level * np.sqrt(np.mean(np.abs(H) ** 2))
    return noisy(H, deviation, np.random.default_rng(1)), deviation


def errors(poles):
    """Relative error of the pole nearest to each true one, and how many modes are met."""
    away = np.abs(np.asarray(poles)[:, None] - TRUTH) / np.abs(TRUTH)
    return away.min(axis=0), np.unique(away.argmin(axis=0)).size


def of_flexplant(H, deviation):
    return identify_modes(Frf(FREQ, H, variance=np.full(H.shape, deviation**2))).poles


def of_vector_fitting(H, deviation):
    skrf = pytest.importorskip("skrf")
    # one port matrix is fitted with common poles: outputs on its diagonal
    S = np.zeros((FREQ.size, 5, 5), dtype=complex)
    S[:, :, 0] = H[:, 0].T / np.abs(H).max()
    S[:, 0, 1:] = S[:, 1:, 0]
    fit = skrf.vectorFitting.VectorFitting(skrf.Network(f=FREQ, s=S, f_unit="hz"))
    fit.vector_fit(n_poles_real=0, n_poles_cmplx=3, fit_constant=True, fit_proportional=False)
    return fit.poles


def of_sdypy(H, deviation):
    EMA = pytest.importorskip("sdypy.EMA")
    model = EMA.Model(H[:, 0], FREQ, lower=10, upper=150, pol_order_high=30, frf_form="receptance")
    model.get_poles(show_progress=False)
    model.select_closest_poles(list(np.abs(TRUTH) / (2 * np.pi)), f_window=1)
    omega, zeta = 2 * np.pi * np.array(model.nat_freq), np.array(model.nat_xi)
    return -zeta * omega + 1j * omega * np.sqrt(1 - zeta**2)


@pytest.mark.parametrize("level", [1e-3, 1e-2], ids=["60 dB", "40 dB"])
def test_the_close_pair_beside_peers(level):
    """No peer is told the poles from noise; sdypy-EMA is even told the true frequencies."""
    H, deviation = responses(level)
    rows = {}
    for name, method in {
        "flexplant": of_flexplant,
        "sdypy-EMA": of_sdypy,
        "scikit-rf VectorFitting": of_vector_fitting,
    }.items():
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            start = time.process_time()
            poles = method(H, deviation)
            rows[name] = (*errors(poles), time.process_time() - start)
    ours = rows["flexplant"]
    print(f"\n{level:g} noise           errors at 47.5, 48.2, 112 Hz   poles  CPU [s]  time ratio")
    for name, (error, count, spent) in rows.items():
        print(
            f"{name:24s} {error[0]:.1e} {error[1]:.1e} {error[2]:.1e}    {count}    {spent:6.2f}"
            f"   {spent / ours[2]:6.2f}"
        )
    assert ours[1] == 3
    assert ours[0].max() < 0.1 * level
    for error, _, _ in rows.values():
        assert ours[0].max() < 1.5 * error.max()


def ruler_lines():
    """Real: ten places of a ruler, of examples/ruler.py; picked by hand by those who measured."""
    stored = np.load(Path(__file__).parents[2] / "examples" / "data" / "ruler.npz")
    truth = np.array([39.5, 108.5, 212.5, 269.7, 352.3])
    frf = Frf(stored["freq"], stored["accelerance"][:, None].astype(complex))
    return frf.replace(quantity="acceleration"), truth, None


def one_published_mode():
    content = scipy.io.loadmat(MEASURED / "vt_case1.mat")
    freq, H = content["Freq_domain"].ravel().astype(float), content["Hf_chan_2"].ravel()
    inside = (freq >= 100.0) & (freq <= 300.0)
    frf = Frf(freq[inside], H[None, None, inside], quantity="acceleration")
    return frf, np.array([212.09]), None


def stage_of_56(n_out=14, n_in=4, lines=950):
    rng, freq = np.random.default_rng(3), np.linspace(20.0, 400.0, lines)
    truth = np.array([41.0, 66.0, 93.0, 118.0, 152.0, 187.0, 224.0, 268.0, 311.0, 359.0])
    phi = rng.normal(size=(n_out, 10))
    H = modal_frf(freq, pole(truth, np.full(10, 0.01)), phi, phi[:n_in])
    return Frf(freq, noisy(H, 1e-3 * np.sqrt(np.mean(np.abs(H) ** 2)), rng)), truth, 0.01


def machine_of_60():
    return stage_of_56(20, 3, 1000)


@pytest.mark.parametrize("case", [ruler_lines, one_published_mode, stage_of_56, machine_of_60])
def test_poles_damping_and_time_beside_a_quick_peer(case):
    """Poles of the peer are picked at the true frequencies, ours by nobody."""
    EMA = pytest.importorskip("sdypy.EMA")
    if case is one_published_mode and not MEASURED.exists():
        pytest.skip(f"{MEASURED} is not there")
    frf, truth, zeta = case()

    def of_peer():
        flat = frf.data.reshape(-1, frf.freq.size)
        low, high = float(frf.freq[0]), float(frf.freq[-1])
        form = "accelerance" if frf.quantity == "acceleration" else "receptance"
        model = EMA.Model(
            flat, frf.freq, lower=low, upper=high, pol_order_high=40, frf_form=form
        )  # fmt: skip
        model.get_poles(show_progress=False)
        model.select_closest_poles(list(truth), f_window=3)
        return np.array(model.nat_freq), np.array(model.nat_xi)

    def ours(refine):
        found = identify_modes(frf, refine=refine)
        return found.freq, found.zeta

    rows = {}
    methods = {
        "sdypy-EMA": of_peer,
        "first answer": lambda: ours(False),
        "default": lambda: ours(None),
    }
    found, times = {}, {name: [] for name in methods}
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        # the first loads modules; a tenth of a second varies by half with what else runs
        for _ in range(8):
            for name, method in methods.items():
                start = time.process_time()
                found[name] = method()
                times[name].append(time.process_time() - start)
    for name, (freq, damping) in found.items():
        spent = np.median(times[name][1:])
        near = np.abs(freq[:, None] - truth).argmin(axis=0)
        off = np.abs(freq[near] / truth - 1)
        worst = np.nan if zeta is None else np.abs(damping[near] / zeta - 1).max()
        rows[name] = off, worst, freq.size, spent
    print(f"\n{case.__name__}: {frf.data[..., 0].size} FRFs, {frf.freq.size} lines")
    for name, (off, worst, count, spent) in rows.items():
        ratio = spent / rows["sdypy-EMA"][3]
        print(
            f"{name:14s} {np.sum(off < 5e-3)} of {truth.size} within 0.5 %, worst {off.max():.1e},"
            f" damping off by {worst:.1e}, {count} poles, {spent:.2f} s, ratio {ratio:.1f}"
        )
    default, peer = rows["default"], rows["sdypy-EMA"]
    assert np.all(default[0] < 5e-3)
    if zeta is not None:
        assert default[1] < 0.03
        assert default[2] == truth.size
        assert default[0].max() < 1.1 * peer[0].max()


def disagreeing(what, seed):
    """A machine whose outputs, inputs or runs differ by 0.1 %: what is measured, its poles."""
    if what == "runs":
        return drifting(1e-3, seed)[:2]
    if what == "outputs":
        return roving(1e-3, seed, step=0.3)
    frf, truth = roving(1e-3, seed, zeta=0.02, step=0.3, n_in=8)
    turned = {"data": frf.data.transpose(1, 0, 2), "variance": frf.variance.transpose(1, 0, 2)}
    return Frf(frf.freq, **turned), truth


@pytest.mark.parametrize(("what", "machines"), [("runs", 80), ("outputs", 60), ("inputs", 40)])
def test_deviations_hold_where_what_was_measured_disagrees(what, machines):
    """Within 1.96 deviations lie 95 % of frequencies; poles of one machine err together."""
    inside = []
    for seed in range(100, 100 + machines):
        measured, truth = disagreeing(what, seed)
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            found = identify_modes(measured)
        assert len(found) == truth.size
        inside.append(np.mean(np.abs((found.poles - truth).imag) < 1.96 * found.std.imag))
    share, deviation = np.mean(inside), np.std(inside) / np.sqrt(machines)
    print(f"\n{machines} machines, {what}: {100 * share:.1f} +- {100 * deviation:.1f} %")
    assert share > 0.95 - 2.5 * deviation


def record_of_a_lab(n_out=10, n_in=1, resolution=0.25, seed=0):
    """Accelerance by Hann-windowed segments of 14 modes from 9 to 377 Hz, two of them close."""
    truth = np.array([9.1, 14, 27, 41, 58, 83, 101, 137, 166, 171, 215, 262, 318, 377])
    zeta = np.array([20, 15, 10, 12, 8, 10, 7, 9, 10, 12, 8, 10, 10, 12]) / 1e3
    rng, rate = np.random.default_rng(seed), 2048.0
    phi, samples = rng.normal(size=(n_out, 14)), int(20 * rate / resolution)
    u, omega = rng.normal(size=(n_in, samples)), 2 * np.pi * truth
    s = 2j * np.pi * np.fft.rfftfreq(samples, 1 / rate)
    driven = phi[:n_in].T @ np.fft.rfft(u, axis=1)
    for own, w, z in zip(driven, omega, zeta, strict=True):
        own *= s**2 / (s**2 + 2 * z * w * s + w**2)
    y = np.fft.irfft(phi @ driven, samples, axis=1)
    y += 1e-3 * y.std(axis=1, keepdims=True) * rng.normal(size=y.shape)
    method = H1Estimator(segment=1 / resolution)
    return estimate_frf(u, y, rate, quantity="acceleration", method=method), truth


@pytest.mark.parametrize("channels", [(10, 1), (8, 2), (24, 1)])
def test_a_record_of_a_lab_takes_seconds(channels):
    """7.0, 7.5 and 8.9 s of CPU before poles were judged from the bases of the fit."""
    frf, truth = record_of_a_lab(*channels)
    start = time.process_time()
    with warnings.catch_warnings(action="ignore"):
        found = identify_modes(frf, band=(8.0, 400.0))
    spent = time.process_time() - start
    print(f"\n{channels[0]} outputs, {channels[1]} inputs: {spent:.1f} s, {len(found)} modes")
    assert len(found) == truth.size
    assert np.all(np.abs(found.freq / truth - 1) < 2e-3)
    assert spent < 10.0

"""FRFs from records, against filters whose response is known, and statistics of known noise."""

import numpy as np
import pytest
import scipy.signal as ss

from flexplant.errors import FlexplantWarning, LabelError, ModelError, ShapeError
from flexplant.identification import (
    H1Estimator,
    H2Estimator,
    HvEstimator,
    Periodic,
    average_frfs,
    estimate_frf,
    multisine,
)
from flexplant.lti import Frf
from flexplant.updating import FrfResidual
from oracles_identification import Loop

RATE = 1000.0
B, A = np.array([0.0, 0.2, 0.1]), np.array([1.0, -1.2, 0.72])


def response(freq, b=B, a=A):
    return ss.freqz(b, a, 2 * np.pi * freq / RATE)[1]


def two_by_two(u):
    """y1 = G u1 + 0.5 u2, y2 = -u1 + G u2, with the filter's start-up transient."""
    g = ss.lfilter(B, A, u, axis=2)
    return np.stack([g[:, 0] + 0.5 * u[:, 1], -u[:, 0] + g[:, 1]], axis=1)


def test_periodic_is_exact_once_the_transient_has_died():
    u = multisine(2, rate=RATE, period=0.2, periods=4, rng=1)
    frf = estimate_frf(u, two_by_two(u), RATE, method=Periodic(period=0.2, discard=3))
    assert np.allclose(frf.freq, np.arange(1, 100) * 5.0)
    G = response(frf.freq)
    want = np.array([[G, np.full(G.size, 0.5)], [np.full(G.size, -1.0), G]])
    assert np.abs(frf.data - want).max() < 1e-12
    early = estimate_frf(u, two_by_two(u), RATE, method=Periodic(period=0.2, discard=0))
    assert np.abs(early.data - want).max() > 1e-3


def test_multisines_are_orthogonal_and_only_in_their_band():
    u = multisine(3, rate=RATE, period=0.5, band=(20.0, 60.0), rms=2.0, rng=4)
    assert u.shape == (3, 3, 500)
    assert np.allclose(np.sqrt(np.mean(u**2, axis=2)), 2.0)
    U = np.fft.rfft(u, axis=2)
    inside = np.zeros(251, dtype=bool)
    inside[10:31] = True
    assert np.abs(U[:, :, ~inside]).max() < 1e-9
    gram = np.einsum("eif,ejf->fij", U, U.conj())[10:31]
    size = gram[:, 0, 0].real[:, None, None]
    assert np.abs(gram / size - np.eye(3)).max() < 1e-12


def test_periodic_uses_the_excited_lines_and_names():
    u = multisine(1, rate=RATE, period=0.5, periods=3, band=(20.0, 60.0), rng=4)
    y = ss.lfilter(B, A, u, axis=2)
    frf = estimate_frf({"force": u[:, 0]}, {"die": y[:, 0]}, RATE, method=Periodic(period=0.5))
    assert (frf.inputs, frf.outputs) == (("force",), ("die",))
    assert (frf.freq[0], frf.freq[-1], frf.freq.size) == (20.0, 60.0, 21)
    part = Periodic(period=0.5, band=(30.0, 40.0))
    assert estimate_frf(u, y, RATE, method=part).freq.tolist() == [30 + 2 * k for k in range(6)]


@pytest.mark.long
def test_periodic_variance_and_correlation_are_those_of_the_errors():
    """Common noise on both outputs; 300 trials of 40 lines: 3 standard errors of the mean."""
    rng = np.random.default_rng(5)
    u = multisine(2, rate=RATE, period=0.1, periods=9, rng=1)
    clean = np.stack([2.0 * u[:, 0], 3.0 * u[:, 1]], axis=1)
    want = np.array([[2.0, 0.0], [0.0, 3.0]])[:, :, None]
    ratios, shared = [], []
    for _ in range(300):
        noise = rng.normal(size=clean.shape)
        noise[:, 1] = 0.8 * noise[:, 0] + 0.6 * noise[:, 1]
        frf = estimate_frf(u, clean + 0.1 * noise, RATE, method=Periodic(period=0.1))
        ratios.append(np.mean(np.abs(frf.data - want) ** 2 / frf.variance))
        shared.append(np.mean(frf.correlation[0, 1]))
    # 14 degrees of freedom: the mean of 1/variance is 14/13 of 1
    error = 3 * np.std(ratios) / np.sqrt(300)
    assert abs(np.mean(ratios) - 14 / 13) < error
    assert error < 0.05
    assert np.mean(shared).real == pytest.approx(0.8, abs=0.02)


def records(rng, n=2**17, noise_u=0.0, noise_y=0.0, gain=1.5):
    u = rng.normal(size=n)
    y = gain * u
    return u + noise_u * rng.normal(size=n), y + noise_y * rng.normal(size=n)


@pytest.mark.slow
def test_h1_h2_hv_have_the_bias_of_their_textbook():
    """Noise on the input lowers H1 by 1/(1 + N/S), noise on the output raises H2 by (1 + N/S)."""
    u, y = records(np.random.default_rng(2), noise_u=0.5, noise_y=0.6)
    gains = {
        method: np.mean(estimate_frf(u, y, RATE, method=method(segment=0.25)).data).real
        for method in (H1Estimator, H2Estimator, HvEstimator)
    }
    assert gains[H1Estimator] == pytest.approx(1.5 / 1.25, rel=0.01)
    assert gains[H2Estimator] == pytest.approx(1.5 * (1 + 0.36 / 2.25), rel=0.01)
    assert gains[H1Estimator] < gains[HvEstimator] < gains[H2Estimator]
    frf = {
        m: estimate_frf(u, y, RATE, method=m(segment=0.25))
        for m in (H1Estimator, H2Estimator, HvEstimator)
    }
    mean = np.sqrt(np.abs(frf[H1Estimator].data * frf[H2Estimator].data))
    assert np.allclose(np.abs(frf[HvEstimator].data), mean, rtol=1e-10)


def test_coherence_is_the_share_of_the_signal():
    u, y = records(np.random.default_rng(3), noise_y=1.5)
    frf = estimate_frf(u, y, RATE, method=H1Estimator(segment=0.25))
    assert np.mean(frf.coherence) == pytest.approx(0.5, abs=0.01)


def test_coherence_of_periods_is_that_of_one_of_them():
    """As much noise as signal in each period, however many there are: half."""
    u = multisine(1, rate=400.0, period=1.0, periods=60, rng=1)
    for share, noise in ((0.5, 1.0), (0.8, 0.5)):
        y = u + noise * np.random.default_rng(2).standard_normal(u.shape)
        frf = estimate_frf(u, y, 400.0, method=Periodic(period=1.0))
        assert np.mean(frf.coherence) == pytest.approx(share, abs=0.02)


@pytest.mark.slow
@pytest.mark.parametrize("overlap", [0.0, 0.5])
def test_h1_variance_is_that_of_its_errors_for_two_inputs(overlap):
    rng = np.random.default_rng(6)
    ratios = []
    for _ in range(40):
        u = rng.normal(size=(3, 2, 6000))
        u[:, 1] += 0.5 * u[:, 0]
        y = np.array([[2.0, -1.0]]) @ u + rng.normal(size=(3, 1, 6000))
        frf = estimate_frf(u, y, RATE, method=H1Estimator(segment=0.2, overlap=overlap))
        error = frf.data - np.array([2.0, -1.0])[None, :, None]
        ratios.append(np.mean(np.abs(error) ** 2 / frf.variance))
    assert np.mean(ratios) == pytest.approx(1.0, abs=0.08)


@pytest.fixture(scope="module")
def floating():
    """A loop in which noise on the output is as strong as the excitation."""
    rng = np.random.default_rng(8)
    loop, n = Loop(B, A, 0.9), 2**18
    r, v = rng.normal(size=n), 1.0 * rng.normal(size=n)
    return loop, r, *loop.run(r, v)


@pytest.mark.slow
def test_h1_is_biased_under_feedback_and_joint_input_output_is_not(floating):
    loop, r, u, y = floating
    method = H1Estimator(segment=0.5)
    naive = estimate_frf(u, y, RATE, method=method)
    joint = estimate_frf(u, y, RATE, method=method, reference=r)
    G = loop.plant(joint.freq, RATE)
    biased = loop.biased(joint.freq, RATE, 1.0, 1.0)
    inner = slice(2, None)
    deviation = np.sqrt(joint.variance[0, 0])
    z = np.abs(joint.data[0, 0] - G)[inner] / deviation[inner]
    assert np.mean(z**2) == pytest.approx(1.0, abs=0.5)
    assert np.max(np.abs(naive.data[0, 0] - biased)[inner]) < 0.08
    away = np.abs(naive.data[0, 0] - G) / np.sqrt(naive.variance[0, 0])
    assert np.mean(away[inner]) > 10.0
    assert np.mean(np.abs(joint.data[0, 0] - G)) < 0.1 * np.mean(np.abs(naive.data[0, 0] - G))


def test_periodic_excitation_under_feedback():
    rng = np.random.default_rng(9)
    loop = Loop(B, A, 0.9)
    r = multisine(1, rate=RATE, period=0.1, periods=401, rng=2)[0, 0]
    u, y = loop.run(r, rng.normal(size=r.size))
    for reference in (None, r):
        method = Periodic(period=0.1)
        frf = estimate_frf(u, y, RATE, method=method, reference=reference)
        z2 = np.abs(frf.data[0, 0] - loop.plant(frf.freq, RATE)) ** 2 / frf.variance[0, 0]
        assert 0.6 < np.mean(z2) < 1.5


def test_accelerations_stay_accelerations():
    u, y = records(np.random.default_rng(3), n=4000)
    frf = estimate_frf(u, y, RATE, quantity="acceleration")
    assert frf.quantity == "acceleration"
    moved = frf.converted("displacement")
    squared = (2j * np.pi * frf.freq) ** 2
    np.testing.assert_allclose(moved.data, frf.data / squared, rtol=1e-12)
    np.testing.assert_allclose(moved.variance, frf.variance / np.abs(squared) ** 2, rtol=1e-12)


def test_one_period_says_nothing_of_noise():
    u = multisine(1, rate=RATE, period=0.1, periods=1, rng=2)
    frf = estimate_frf(u, 2 * u, RATE, method=Periodic(period=0.1, discard=0))
    assert frf.variance is None and frf.coherence is None and frf.correlation is None


def test_repeated_measurements_average_to_a_mean_with_doubt():
    rng = np.random.default_rng(4)
    freq, shape = np.arange(1.0, 201.0), (2, 2, 200)
    common = rng.normal(size=(8, 1, 2, 200)) + 1j * rng.normal(size=(8, 1, 2, 200))
    own = rng.normal(size=(8, *shape)) + 1j * rng.normal(size=(8, *shape))
    frfs = [Frf(freq, 5.0 + 0.6 * c + 0.8 * o) for c, o in zip(common, own, strict=True)]
    frf = average_frfs(frfs)
    assert np.mean(frf.variance) == pytest.approx(2.0 / 8, rel=0.05)
    assert np.mean(frf.correlation[0, 1]).real == pytest.approx(0.36, abs=0.05)
    assert np.allclose(frf.data, np.mean([f.data for f in frfs], axis=0))
    with pytest.raises(ModelError, match="at least 2"):
        average_frfs(frfs[:1])
    with pytest.raises(ShapeError, match="same channels"):
        average_frfs([frfs[0], frfs[1].select(outputs=["y1"])])
    with pytest.raises(ModelError, match="identical"):
        average_frfs([frfs[0], frfs[0]])
    with pytest.raises(ModelError, match="quantities differ"):
        average_frfs([frfs[0], frfs[1].replace(quantity="velocity")])


U = np.random.default_rng(0).normal(size=(1, 1, 800))


@pytest.mark.parametrize(
    ("changes", "error", "text"),
    [
        ({"inputs": np.zeros((1, 1, 1, 5))}, ShapeError, "inputs must have shape"),
        ({"inputs": U[:, :, :700]}, ShapeError, "same experiments"),
        ({"inputs": U * np.nan}, ModelError, "NaN"),
        ({"inputs": {}}, ShapeError, "same shape"),
        ({"inputs": {"a.b": U[0, 0]}}, LabelError, "a.b"),
        ({"inputs": np.repeat(U, 2, axis=1)}, ModelError, "dependent"),
        ({"rate": 0.0}, ModelError, "rate"),
        ({"quantity": "position"}, LabelError, "quantity"),
        ({"method": "H1"}, ModelError, "method"),
        ({"method": H2Estimator(), "reference": U}, ModelError, "joint"),
        ({"reference": np.repeat(U, 2, axis=1)}, ShapeError, "one reference per input"),
        ({"method": H1Estimator(segment=2.0)}, ModelError, "segment"),
        ({"method": H1Estimator(segment=0.8)}, ModelError, "averages"),
        ({"method": Periodic(period=0.01234)}, ModelError, "whole number"),
        ({"method": Periodic(period=0.5)}, ModelError, "periods"),
        ({"method": Periodic(period=0.1, band=(1.0, 2.0))}, ModelError, "no line"),
    ],
)
def test_bad_records_are_refused(changes, error, text):
    arguments = {"inputs": U, "outputs": U, "rate": RATE} | changes
    with pytest.raises(error, match=text):
        estimate_frf(**arguments)


@pytest.mark.parametrize(
    ("make", "cause"),
    [
        (lambda: H1Estimator(overlap=1.0), "overlap"),
        (lambda: H1Estimator(segment=-1.0), "segment"),
        (lambda: H1Estimator(window="nonsense"), "window"),
        (lambda: Periodic(period=0.0), "period"),
        (lambda: Periodic(period=1.0, discard=-1), "discard"),
        (lambda: Periodic(period=1.0, band=(3.0, 2.0)), "band"),
        (lambda: multisine(0, rate=1.0, period=10.0), "count"),
        (lambda: multisine(1, rate=1.0, period=10.5), "period"),
        (lambda: multisine(1, rate=1.0, period=10.0, band=(3.0, 4.0)), "band"),
        (lambda: multisine(1, rate=1.0, period=10.0, rms=0.0), "rms"),
    ],
)
def test_bad_methods_are_refused(make, cause):
    with pytest.raises(ModelError, match=cause):
        make()


def test_two_periodic_inputs_need_two_experiments():
    u = multisine(2, rate=RATE, period=0.1, periods=3, rng=1)[:1]
    with pytest.raises(ModelError, match="cannot separate 2"):
        estimate_frf(u, u, RATE, method=Periodic(period=0.1))


def test_h2_needs_as_many_outputs_as_inputs():
    rng = np.random.default_rng(1)
    u = rng.normal(size=(2, 8000))
    with pytest.raises(ShapeError, match="H2"):
        estimate_frf(u, u[:1], RATE, method=H2Estimator(segment=0.1))
    mix = np.array([[1.0, 0.5], [0.0, 2.0]])
    for method in (H1Estimator, H2Estimator, HvEstimator):
        frf = estimate_frf(u, mix @ u, RATE, method=method(segment=0.1))
        assert np.abs(frf.data - mix[:, :, None]).max() < 1e-6


@pytest.mark.slow
@pytest.mark.parametrize("periods", [2, 3, 4, 7])
def test_drift_between_periods_is_not_taken_for_more_noise_than_it_makes(periods):
    """A random walk leaks into all lines, of the mean of P periods with 1/P^2 of its power."""
    rng = np.random.default_rng(periods)
    score = []
    for _ in range(20):
        u = multisine(1, rate=400.0, period=1.0, periods=periods, rng=rng)
        y = u + 0.01 * np.cumsum(rng.normal(size=u.shape), axis=2)
        frf = estimate_frf(u, y, 400.0, method=Periodic(period=1.0, discard=0))
        assert frf.freq.size == 199
        assert np.all((frf.coherence >= 0) & (frf.coherence < 1))
        # pooled over measurements: one has few degrees of freedom
        score.append([np.abs(frf.data - 1).ravel() ** 2, frf.variance.ravel()])
    error, said = np.mean(score, axis=0)
    high = slice(20, None)
    assert np.mean(error[high] / np.mean(said[high])) == pytest.approx(1.0, abs=0.35)


@pytest.mark.parametrize(
    ("runs", "outputs", "inputs", "shared"), [(6, 2, 4, True), (6, 2, 4, False), (4, 3, 1, False)]
)
def test_how_well_the_variance_of_a_few_runs_is_known(runs, outputs, inputs, shared):
    """Noise alone: ``|mean|^2 / variance`` is nu / (nu - 1) in the mean, and a fit counts it."""
    rng = np.random.default_rng(5)
    freq, size = np.arange(1.0, 3001.0), (runs, outputs, inputs, 3000)
    own = rng.normal(size=size) + 1j * rng.normal(size=size)
    noise = own[:, :1] * np.arange(1, outputs + 1)[:, None, None] + 1e-6 * own if shared else own
    places = {"inputs": [f"{i}:z" for i in range(1, inputs + 1)]}
    places["outputs"] = [f"{i}:z" for i in range(1, outputs + 1)]
    frf = average_frfs([Frf(freq, each, **places) for each in noise])
    ratio = np.mean(np.abs(frf.data) ** 2 / frf.variance)
    assert frf.freedom / (frf.freedom - 1) == pytest.approx(ratio, rel=0.04)
    assert frf.select(outputs=["1:z"]).freedom == frf.freedom
    fair = FrfResidual(frf, lines=[0, 1]).variance
    np.testing.assert_allclose(fair, frf.variance * frf.freedom / (frf.freedom - 1), rtol=1e-12)
    if runs == 4:
        with pytest.warns(FlexplantWarning, match="1.2 degrees of freedom"):
            FrfResidual(frf.replace(freedom=1.2), lines=[0, 1])


def test_averages_of_half_overlapping_segments_count_as_in_closed_form():
    """Of a periodic Hann window neighbours share 1/6: ``k / (1 + 2 (1 - 1/k) / 36)`` of k."""
    from flexplant.identification.spectra import _effective

    hann = 0.5 - 0.5 * np.cos(2 * np.pi * np.arange(256) / 256)
    assert _effective(hann, 128, 20) == pytest.approx(20 / (1 + 2 * 0.95 / 36), rel=1e-9)
    assert _effective(hann, 256, 20) == 20.0

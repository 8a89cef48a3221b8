"""Recorded data in, POI out: against the dense normal equations of all samples at once."""

from functools import cache

import numpy as np
import pytest
from test_kalman import modes, plate_plant

import flexplant as fx
from flexplant.errors import FlexplantWarning, LabelError, ModelError, ShapeError
from flexplant.estimation import Filter, FixedLag, Predictor, Smoother, design_kalman, design_static
from flexplant.estimation.estimate import estimated
from flexplant.estimation.passage import Walk
from flexplant.lti import filter_dare
from machines import stage
from oracles_estimation import batch, error_covariance

LAGS = {
    "predictor": (Predictor(), 0),
    "filter": (Filter(), 1),
    "lag 5": (FixedLag(5), 6),
    "smoother": (Smoother(), 10_000),
}


@cache
def observer(**changes):
    return design_kalman(stage(sensor_asd=1e-8, **changes))


def dense(model):
    names = ("A", "B", "C1", "D1", "C2", "D2", "Q", "R", "V", "N", "S")
    return {name: getattr(model, name) for name in names}


def prior(model, rigid=(0, 1), elastic=range(2, 8)):
    """Covariance of the elastic states at rest, delay lines known, and the rigid-body states."""
    n = model.A.shape[0]
    P, at = np.zeros((n, n)), np.ix_(elastic, elastic)
    P[at] = error_covariance(model.A[at], model.Q[at])
    return P, np.eye(n)[:, list(rigid)]


def run(model, count, seed, *, first=None):
    """Measurements, commands and motions of a machine whose rigid body starts anywhere."""
    rng = np.random.default_rng(seed)
    n, ny = model.C2.T.shape
    nz = model.C1.shape[0]
    P, Z = prior(model)
    x = Z @ np.array([1e-4, -1e-3]) + np.linalg.cholesky(P + 1e-40 * np.eye(n)) @ rng.normal(size=n)
    x = x if first is None else first
    joint = np.block([[model.R, model.N.T], [model.N, model.V + 1e-12 * np.diag(np.diag(model.V))]])
    size = np.sqrt(np.diag(model.Q)) + 1e-300
    values, vectors = np.linalg.eigh(model.Q / size / size[:, None])
    root = size[:, None] * vectors * np.sqrt(np.maximum(values, 0))
    half = np.linalg.cholesky(joint) if nz and np.any(model.V) else np.diag(np.sqrt(np.diag(joint)))
    u = 0.1 * rng.standard_normal((count, model.B.shape[1]))
    y, z = np.empty((count, ny)), np.empty((count, nz))
    for k in range(count):
        noise = half @ rng.standard_normal(ny + nz)
        y[k] = model.C2 @ x + model.D2 @ u[k] + noise[:ny]
        z[k] = model.C1 @ x + model.D1 @ u[k] + noise[ny:]
        x = model.A @ x + model.B @ u[k] + root @ rng.standard_normal(n)
    return y, u, z


def records(model, y, u):
    return dict(zip(model.sensors, y.T, strict=True)) | dict(zip(model.commands, u.T, strict=True))


def agree(result, hat, variance, rel=1e-6):
    known = np.isfinite(variance[:, 0])
    np.testing.assert_array_equal(np.isfinite(result["die:hat"]), known)
    np.testing.assert_array_equal(np.isinf(result.deviation("die:hat")), ~known)
    deviation = np.sqrt(variance[known, 0])
    np.testing.assert_allclose(result.deviation("die:hat")[known], deviation, rtol=rel, atol=0)
    off = (result["die:hat"][known] - hat[known, 0]) / deviation
    assert np.abs(off).max() < rel


@pytest.mark.parametrize("lag", LAGS)
@pytest.mark.parametrize("gaps", [False, True])
def test_start_gaps_and_lags_are_the_normal_equations(lag, gaps):
    """An unknown rigid-body motion of 0.1 mm, known inputs with a delay, samples missing."""
    kalman = observer()
    model = kalman.model
    y, u, _ = run(model, 60, seed=3)
    if gaps:
        y[0] = y[20:26] = np.nan
        y[1:4, 0] = y[40:45, 1] = y[-1, 0] = np.nan
    method, later = LAGS[lag]
    result = kalman.estimate(records(model, y, u), method)
    P, Z = prior(model)
    agree(result, *batch(dense(model), y, u, P, Z, np.arange(60) + later))
    missing = np.isnan(result["y1:innovation"])
    assert np.all(missing[np.isnan(y[:, 0])])


@pytest.mark.parametrize("lag", LAGS)
def test_noises_of_process_and_sensors_may_be_correlated(lag):
    model = observer().model
    H = np.array(model.H)  # of the first sensor's noise 0.7 is that of the first disturbance
    H[0] *= np.sqrt(1.0 - 0.7**2)
    H[0, 0] = 0.7 * np.sqrt(model.R[0, 0])
    model = model.replace(H=H)
    solved = filter_dare(model.A, model.C2, Q=model.Q, R=model.R, S=model.S)
    y, u, _ = run(model, 40, seed=10)
    y[12:15, 0] = np.nan
    method, later = LAGS[lag]
    result = estimated(model, solved.P, solved.gain, records(model, y, u), method, None, None, {})
    agree(result, *batch(dense(model), y, u, *prior(model), np.arange(40) + later))


@pytest.mark.parametrize("lag", LAGS)
def test_modes_left_out_are_noise_at_sensors_and_pois_and_a_compliance(lag):
    """Correlated noise of y and z, its share at the POI estimated with it; u with a delay."""
    plant = plate_plant(1e-2, count=5, sensor_asd=1e-10)
    kalman = design_kalman(plant.replace(evaluation=modes(1e-2, 9)))
    model = kalman.model
    assert np.any(model.N)
    assert np.any(model.C1[:, plant.modal_states.max() + 1 :])  # the compliance under late u
    states = plant.modal_states
    P, Z = prior(model, states[:6], states[6:])
    rng = np.random.default_rng(8)
    y = 1e-8 * rng.standard_normal((25, 4)) + 1e-6
    y[10:13, 1] = np.nan
    u = 10 * rng.standard_normal((25, 4))
    method, later = LAGS[lag]
    result = kalman.estimate(records(model, y, u), method)
    hat, variance = batch(dense(model), y, u, P, Z, np.arange(25) + later)
    for i, name in enumerate(result.names):
        known = np.isfinite(variance[:, i])
        assert known.sum() >= 23
        deviation = np.sqrt(variance[known, i])
        np.testing.assert_allclose(result.deviation(name)[known], deviation, rtol=1e-5, atol=0)
        assert np.abs((result[name][known] - hat[known, i]) / deviation).max() < 1e-5


def test_a_millisecond_recovers_most_of_what_a_smoother_can():
    """On the plate with sensors of 0.1 nm / sqrt(Hz): the rotations, beside the static relation."""
    plant = plate_plant(1e-2, count=10, sensor_asd=1e-12)
    kalman = design_kalman(plant.replace(evaluation=modes(1e-2, 24)))
    report = kalman.report()
    assert report.names[3:6] == ("0.1 ms", "1 ms", "10 ms")
    assert np.all(report["static relation"] > 1.5 * report["filter"])
    static = design_static(plant)
    np.testing.assert_allclose(report["static relation"][0], static.rms("die"), rtol=1e-12)
    np.testing.assert_allclose(report.on_whole[0], kalman.rms("die"), rtol=1e-12)
    assert min(report.recovered("10 ms", name) for name in report.channels) > 0.9
    text = repr(report)
    assert "filter *" in text
    assert "die:rx [nrad]" in text


def plain(kalman, y, u):
    """The stationary filter, sample by sample."""
    g = kalman.system
    x, hats = np.zeros(g.n_states), []
    for v in np.hstack([y, u]):
        hats.append(g.C @ x + g.D @ v)
        x = g.A @ x + g.B @ v
    return np.array(hats), x


def test_the_stationary_filter_in_blocks_is_the_plain_loop():
    kalman = observer()
    model = kalman.model
    y, u, z = run(model, 3005, seed=1, first=np.zeros(model.A.shape[0]))
    at_rest = np.zeros(model.A.shape[0])
    result = kalman.estimate(records(model, y, u), start=at_rest)
    hats, last = plain(kalman, y, u)
    size = result.deviation("die:hat")
    np.testing.assert_allclose(size, kalman.rms("die"), rtol=1e-9, atol=0)
    assert np.abs(result["die:hat"] - hats[:, 0]).max() < 1e-10 * np.abs(hats).max()
    scale = np.sqrt(np.diag(kalman.predicted_covariance)) + 1e-12
    assert np.abs((result.state - last) / scale).max() < 1e-8
    error = (result["die:hat"] - z[:, 0])[500:]
    assert np.sqrt(np.mean(error**2)) == pytest.approx(size[0], rel=0.1, abs=0)
    assert np.var(result.whitened[:, 500:]) == pytest.approx(1.0, rel=0.05, abs=0)
    # a record in two parts is the record
    one = kalman.estimate(records(model, y[:1111], u[:1111]), start=at_rest)
    two = kalman.estimate(records(model, y[1111:], u[1111:]), start=one.state)
    np.testing.assert_allclose(
        two["die:hat"], result["die:hat"][1111:], rtol=0, atol=1e-9 * size[0]
    )


@pytest.mark.slow
@pytest.mark.parametrize("method", [Filter(), FixedLag(60), Predictor(), Smoother()])
def test_blocks_and_the_time_varying_filter_agree_around_gaps(method, monkeypatch):
    kalman = observer()
    model = kalman.model
    y, u, _ = run(model, 1000, seed=2)
    y[600:610] = y[940:942, 1] = np.nan
    mixed = kalman.estimate(records(model, y, u), method)
    for module in ("passage", "estimate"):
        monkeypatch.setattr(f"flexplant.estimation.{module}.STATIONARY", -1.0)
    monkeypatch.setattr("flexplant.estimation.passage.excess", lambda *_: None)
    slow = kalman.estimate(records(model, y, u), method)
    for channel in ("die:hat", "y1:innovation", "y2:innovation"):
        deviation, known = slow.deviation(channel), np.isfinite(slow[channel])
        np.testing.assert_allclose(mixed.deviation(channel), deviation, rtol=2e-6, atol=0)
        off = (mixed[channel] - slow[channel])[known] / deviation[known]
        assert np.abs(off).max() < 1e-5
    usual, gap = slow.deviation("die:hat")[500], slow.deviation("die:hat")[595:615].max()
    assert gap > 1.2 * usual


@pytest.mark.slow
@pytest.mark.parametrize("method", [Predictor(), Filter()])
def test_a_start_that_lasts_for_long_goes_in_blocks_and_is_that_of_single_samples(
    method, monkeypatch
):
    # light and little disturbed: the gain becomes stationary in some ten thousand samples only
    kalman = observer(zeta=2e-5, asd=1e-6)
    model = kalman.model
    y, u, _ = run(model, 2500, seed=5)
    y[900:905] = y[1700:1702, 0] = np.nan
    singly, count = Walk._step, []
    monkeypatch.setattr(Walk, "_step", lambda *given: count.append(1) or singly(*given))
    fast = kalman.estimate(records(model, y, u), method)
    assert len(count) < 100
    monkeypatch.setattr("flexplant.estimation.passage.excess", lambda *_: None)
    slow = kalman.estimate(records(model, y, u), method)
    assert len(count) > 2500
    for channel in ("die:hat", "y1:innovation", "y2:innovation"):
        deviation, known = slow.deviation(channel), np.isfinite(slow[channel])
        np.testing.assert_array_equal(np.isfinite(fast[channel]), known)
        np.testing.assert_allclose(fast.deviation(channel), deviation, rtol=1e-9, atol=0)
        off = (fast[channel] - slow[channel])[known] / deviation[known]
        assert np.abs(off).max() < 1e-6
    np.testing.assert_allclose(fast.whitened, slow.whitened, rtol=0, atol=1e-6)
    np.testing.assert_allclose(fast.state, slow.state, rtol=1e-6, atol=1e-12)


class Frame:
    """What a data frame shows of itself."""

    def __init__(self, columns):
        self.columns = columns

    def keys(self):
        return self.columns.keys()

    def __getitem__(self, name):
        return self.columns[name]


def test_what_counts_as_a_record_and_what_comes_out(tmp_path):
    from flexplant import load
    from flexplant.simulation import Response

    kalman = observer()
    model = kalman.model
    y, u, _ = run(model, 50, seed=4)
    channels = records(model, y, u)
    time = 3.0 + model.dt * np.arange(50)
    want = kalman.estimate(channels)
    made = Response(time, np.array(list(channels.values())), list(channels))
    for given in (made, Frame(channels), channels | {"extra": np.zeros(3)}):
        np.testing.assert_array_equal(kalman.estimate(given)["die:hat"], want["die:hat"])
    assert kalman.estimate(made).time[0] == 3.0
    assert kalman.estimate(channels | {"time": time}).time[-1] == time[-1]
    assert list(want) == ["die:hat", "y1:innovation", "y2:innovation"]
    assert len(dict(want)) == len(want) == 3
    assert "50 samples" in repr(want)
    want.save(tmp_path / "e.npz")
    again = load(tmp_path / "e.npz")
    np.testing.assert_array_equal(again.innovations, want.innovations)
    assert again.lag.__class__ is Filter
    with pytest.raises(KeyError, match="no channel 'dye'"):
        want["dye"]
    with pytest.raises(ValueError, match="read-only"):
        want["die:hat"][0] = 0.0


@pytest.mark.slow
@pytest.mark.parametrize("method", [row[0] for row in LAGS.values()], ids=list(LAGS))
def test_a_gate_makes_outliers_missing_samples(method):
    """Alone, in two sensors, one after the other, while the filter starts: the NaN estimate."""
    kalman = observer()
    model = kalman.model
    y, u, _ = run(model, 1600, seed=8)
    placed = [(60, 0), (700, 1), (701, 1), (702, 0), (1200, 0), (1200, 1), (1599, 1)]
    bad, gone = y.copy(), y.copy()
    for k, i in placed:
        bad[k, i] += 1e-3
        gone[k, i] = np.nan
    want = kalman.estimate(records(model, gone, u), method)
    found = kalman.estimate(records(model, bad, u), method, gate=7)
    assert sorted((k, i) for i, k in np.argwhere(found.gated).tolist()) == placed
    off = (found["die:hat"] - want["die:hat"]) / want.deviation("die:hat")
    assert np.nanmax(np.abs(off)) < 1e-6
    np.testing.assert_allclose(found.whitened, want.whitened, rtol=0, atol=1e-5)
    assert "7 samples beyond 7 deviations treated as missing: 3 of y1, 4 of y2" in repr(found)
    blind = kalman.estimate(records(model, bad, u), method)
    off = (blind["die:hat"] - want["die:hat"]) / want.deviation("die:hat")
    assert np.nanmax(np.abs(off)) > 50  # unless a gate is given all samples count
    assert not blind.gated.size and "beyond" not in repr(blind)


@pytest.mark.slow
def test_a_gate_that_silences_a_sensor_warns():
    kalman = observer()
    y, u, _ = run(kalman.model, 1000, seed=8)
    y[500:, 0] += 1e-3  # no outlier: the sensor has jumped
    with pytest.warns(FlexplantWarning, match="samples of y1: these are not outliers"):
        kalman.estimate(records(kalman.model, y, u), gate=6.0)
    with pytest.raises(ModelError, match="gate must be positive"):
        kalman.estimate(records(kalman.model, y, u), gate=0)


def test_masked_samples_are_missing_ones():
    """Whatever lies under the mask, in any kind of numbers: the estimate is that with NaN."""
    kalman = observer()
    y, u, _ = run(kalman.model, 300, seed=7)
    channels = records(kalman.model, y, u)
    gone = (np.arange(300) > 100) & (np.arange(300) < 120)
    want = kalman.estimate(channels | {"y2": np.where(gone, np.nan, channels["y2"])})
    whole = np.round(1e12 * channels["y2"]).astype(np.int64)  # integers hold no NaN
    for under in (1e-3, np.nan, np.inf):
        masked = np.ma.masked_array(np.where(gone, under, channels["y2"]), gone)
        found = kalman.estimate(channels | {"y2": masked})
        np.testing.assert_array_equal(found["die:hat"], want["die:hat"])
    found = kalman.estimate(channels | {"y2": np.ma.masked_array(whole, gone)}).innovations[1]
    np.testing.assert_array_equal(np.isnan(found), np.isnan(want.innovations[1]))
    # nothing masked is as no mask
    found = kalman.estimate({name: np.ma.masked_array(part) for name, part in channels.items()})
    np.testing.assert_array_equal(found["die:hat"], kalman.estimate(channels)["die:hat"])


def test_bad_records_are_refused():
    kalman = observer()
    model = kalman.model
    channels = records(model, *run(model, 20, seed=5)[:2])
    for change, error, match in (
        ({"y1": np.zeros(19)}, ShapeError, "one length"),
        ({"y1": np.zeros((2, 20))}, ShapeError, "one run"),
        ({"u1": np.full(20, np.nan)}, ModelError, "channel 'u1' has a NaN"),
        ({"u1": np.ma.masked_array(np.zeros(20), [True] * 20)}, ModelError, "'u1' has a masked"),
        ({"y1": np.zeros(20, dtype=complex)}, ModelError, "channel 'y1' must be real"),
        ({"u1": np.zeros(20) + 1j}, ModelError, "channel 'u1' must be real"),
        ({"y1": np.ma.masked_array(np.zeros(20) + 1j)}, ModelError, "'y1' must be real"),
        ({"y2": np.full(20, np.inf)}, ModelError, "channel 'y2' has a NaN or infinite"),
        ({"y2": ["a"] * 20}, ModelError, "must hold numbers"),
        ({"time": np.arange(20.0)}, ModelError, "at the rate of the record"),
    ):
        with pytest.raises(error, match=match):
            kalman.estimate(channels | change)
    for name, cure in (("y1", "array of NaN"), ("u2", "array of zeros")):
        with pytest.raises(LabelError, match=cure):
            kalman.estimate({k: v for k, v in channels.items() if k != name})
    with pytest.raises(ModelError, match="channels by name"):
        kalman.estimate(np.zeros((20, 4)))
    with pytest.raises(ModelError, match="Predictor"):
        kalman.estimate(channels, "smoother")
    with pytest.raises(ShapeError, match="start"):
        kalman.estimate(channels, start=np.zeros(3))
    with pytest.raises(ModelError, match="samples"):
        FixedLag(0)


def test_step_is_the_stationary_filter_sample_by_sample():
    kalman = observer()
    model = kalman.model
    y, u, _ = run(model, 30, seed=6)
    hats, last = plain(kalman, y, u)
    state, found = None, []
    for k in range(30):
        hat, state = kalman.step(y[k], u[k], state)
        found.append(hat)
    np.testing.assert_allclose(found, hats, rtol=0, atol=1e-12 * np.abs(hats).max())
    np.testing.assert_allclose(state, last, rtol=0, atol=1e-12 * np.abs(last).max())
    assert kalman.step([0, 0], [0, 0])[0] == 0.0
    for wrong, error, match in (
        ((y[0], u[0, :1]), ShapeError, r"u must have shape \(2,\)"),
        ((1.0, u[0]), ShapeError, "y must have shape"),
        ((y[0], u[0], np.zeros(3)), ShapeError, "state must have shape"),
        ((np.array([np.nan, 0.0]), u[0]), ModelError, "NaN"),
        ((["a", "b"], u[0]), ModelError, "y must hold numbers"),
        ((np.ma.masked_array(y[0], [True, False]), u[0]), ModelError, "y has a masked entry"),
    ):
        with pytest.raises(error, match=match):
            kalman.step(*wrong)


@pytest.mark.slow
def test_the_report_by_lag_is_that_of_the_estimates():
    """Stationary rms of predictor, filter, lags, smoother: those in the middle of a record."""
    kalman = observer()
    model = kalman.model
    report = kalman.report([1e-3, 2e-2])
    assert report.names == ("static relation", "predictor", "filter", "1 ms", "20 ms", "smoother")
    y, u, _ = run(model, 2000, seed=7)
    for row, lag in (("predictor", Predictor()), ("filter", Filter()), ("1 ms", FixedLag(2)),
                     ("20 ms", FixedLag(40)), ("smoother", Smoother())):  # fmt: skip
        deviation = kalman.estimate(records(model, y, u), lag).deviation("die:hat")[1000]
        assert report[row][0] == pytest.approx(deviation, rel=1e-6, abs=0)
    assert report["filter"][0] == pytest.approx(kalman.rms("die"), rel=1e-9, abs=0)
    assert np.all(np.diff(report.curve[:, 0]) <= 0)
    assert report.recovered("smoother", "die") == pytest.approx(1.0)
    assert report.recovered("1 ms", "die") > 0.5
    assert np.isnan(report["static relation"]).all()
    assert "no static relation: this plant was not assembled" in repr(report)
    with pytest.raises(ModelError, match="lags must be positive"):
        kalman.report([0.0])
    with pytest.raises(LabelError, match="no row 'smooth'"):
        report["smooth"]


@pytest.mark.slow
@pytest.mark.parametrize(
    ("method", "truncated"),
    [(Predictor(), True), (Filter(), False), (FixedLag(4), True), (Smoother(), False)],
)
def test_a_moving_poi_is_at_each_sample_a_poi_that_stands_there(method, truncated):
    """Start, a gap, blocks, compliance and noise of truncated modes: row by row the fixed POI's."""
    plant = plate_plant(2e-2, count=5, sensor_asd=1e-10)
    kalman = design_kalman(plant.replace(evaluation=modes(2e-2, 9) if truncated else None))
    model = kalman.model
    rng = np.random.default_rng(9)
    y, u = 1e-8 * rng.standard_normal((600, 4)), 10 * rng.standard_normal((600, 4))
    y[300:303, 1] = np.nan
    places = np.array([(0.31, 0.26, 0.0), (0.1, 0.5, 0.0), (0.45, 0.2, 0.0)])
    which = np.arange(600) % 3
    channels = records(model, y, u)
    for start in (None, np.zeros(model.A.shape[0])):
        found = kalman.estimate(channels, method, start=start, path=places[which])
        for i, point in enumerate(places):
            there = plant.at(point.tolist())
            fixed = design_kalman(there.replace(evaluation=modes(2e-2, 9) if truncated else None))
            wanted = fixed.estimate(channels, method, start=start)
            at = np.flatnonzero(which == i)[1:]
            for name in wanted.names:
                size = wanted.deviation(name)[at]
                np.testing.assert_allclose(found.deviation(name)[at], size, rtol=1e-5)
                assert np.abs((found[name][at] - wanted[name][at]) / size).max() < 1e-5
    with pytest.raises(ShapeError, match="2 points, the record 600 samples"):
        kalman.estimate(channels, path=places[:2])
    with pytest.raises(LabelError, match="no POI 'dye'"):
        kalman.estimate(channels, path={"dye": places[which]})


def test_an_estimate_has_the_names_that_rms_takes():
    """The POI, its channel, its estimate and its error are one, in each of two POIs."""
    rng = np.random.default_rng(3)
    A = np.diag(rng.uniform(0.5, 0.9, 4))
    sys = fx.StateSpace(
        A, rng.standard_normal((4, 3)), rng.standard_normal((5, 4)), np.zeros((5, 3)), 1e-3,
        inputs=["w1", "y1:noise", "y2:noise"], outputs=["p0:rx", "p0:z", "p1:z", "y1", "y2"],
    )  # fmt: skip
    D = np.zeros((5, 3))
    D[3, 1] = D[4, 2] = 1.0
    plant = fx.plant.StandardPlant.from_statespace(
        sys.replace(D=D),
        w=["w1", "y1:noise", "y2:noise"], u=[], z=["p0:rx", "p0:z", "p1:z"], y=["y1", "y2"],
        asd={"w1": 1.0, "y1:noise": 0.1, "y2:noise": 0.1}, noise_factor=sys.B[:, :1],
    )  # fmt: skip
    observer = fx.design_kalman(plant)
    found = observer.estimate({name: rng.standard_normal(50) for name in ("y1", "y2")})
    same = {0: "p0 p0:rx p0:hat p0:error", 1: "p0:z p0:z:hat p0:z:error", 2: "p1 p1:z p1:hat"}
    for row, names in same.items():
        for name in names.split():
            np.testing.assert_array_equal(found.deviation(name), found.deviations[row])
            np.testing.assert_array_equal(found[name], found.data[row])
            assert observer.rms(name) == observer.rms(names.split()[1])
    for wrong in ("p2", "p0:x", "y1", 0):
        with pytest.raises(KeyError):
            found.deviation(wrong)
